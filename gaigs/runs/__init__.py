"""One run: its folder, its training, its evaluation."""

import json
import logging
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from rich.console import Console

from gaigs import data
from gaigs.core.radio_maps import radio_map
from gaigs.core.stages import current, stage, timed
from gaigs.data import Links
from gaigs.io.files import write_text
from gaigs.kriging.links import check_known
from gaigs.model import Model, checkpoint
from gaigs.processes import is_first, limited_threads, only_run
from gaigs.registry import KINDS, check_type, name_of, only_recorded, registry
from gaigs.report.scores import metrics_table, verdict
from gaigs.runs.folder import claim, is_configuration, store, stored_software, warn_of_changes

log = logging.getLogger(__name__)


def run(config: dict, folder: Path, launcher: str | None = None) -> dict | None:
    """Trains, tests, and writes the run folder; resumes a stopped run of this configuration.

    Args:
        config: The resolved configuration.
        folder: The run folder of docs/start.md. A finished run is not repeated. One run holds the
            folder at a time.
        launcher: Class name of Hydra's launcher in a job of a multirun; None elsewhere.

    Returns:
        The contents of ``metrics.json``; None in all but the first of several processes.

    Raises:
        TypeError, ValueError, OSError, KeyboardInterrupt: As for ``gaigs.run``.
    """
    from gaigs.training.budget import watched  # slow to import

    if launcher is not None:
        from gaigs.runs.descent import check_processes

        check_processes(config["trainer"], launcher)
    with limited_threads(config["threads"]), watched(config) as watch:
        if not is_first():
            logging.getLogger("gaigs").setLevel(logging.WARNING)  # the first process logs for all
            train_and_test(config, folder)
            return None
        folder.mkdir(parents=True, exist_ok=True)
        with only_run(folder):
            claim(folder, config)
            finished = folder / "metrics.json"
            if finished.is_file():
                from gaigs.report.run_folders import (
                    read_metrics,
                )  # with Hydra, which loading does without

                log.info("finished already: %s", finished)
                metrics = read_metrics(finished)
            else:
                metrics = train_and_test(config, folder)
                if math.isfinite(watch.limit):
                    metrics |= {"max_time": watch.limit, "left_out": watch.left_out}
                # Loggers make a removed folder again.
                if not is_configuration(folder / "config.yaml"):
                    store(config, folder)
                write_text(finished, json.dumps(metrics, indent=2) + "\n")
    console = Console(emoji=False)
    console.print(metrics_table(metrics))
    console.print(verdict(metrics), markup=False)
    print(f"results: {folder}")
    return metrics


def load(path: str | Path, trust: bool = False) -> Model:
    """The model of a checkpoint or of a finished run, ready to predict.

    It needs neither data nor Hydra.

    Args:
        path: ``best.ckpt`` or ``last.ckpt`` of a run, a file of ``Model.save``, or the folder of a
            run.
        trust: True to import any plug-in of ./plugins that the file names; else only one whose
            source is the recorded one. Installed packages are always imported.

    Returns:
        The model in evaluation mode, on the CPU: ``load(path).predict(transmitters)``.

    Raises:
        FileNotFoundError: The file or folder does not exist, or the run is not finished.
        ValueError: The file is damaged or of another format, a component is not installed, or the
            weights do not fit the configuration or are not finite; or the run is not finished, or
            its data were arrays; or a plug-in of ./plugins has another source.
        ImportError: A component cannot be imported.

    Example:
        >>> gaigs.train("mean", gaigs.links("synthetic_rssi", transmitters=50)).save("room.ckpt")
        >>> model = gaigs.load("room.ckpt")
        >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]], receiver="west").shape  # [dBm]
        torch.Size([2])
    """
    check_type("path", path, str | Path)
    if not os.path.isdir(path):
        loaded: Any = checkpoint.load(path, trust, {})
        return loaded
    folder = Path(path)
    config = configuration_of(path)
    if not (folder / "best.ckpt").is_file():
        raise FileNotFoundError(
            f"{folder} has no best.ckpt: the run is not finished, or one of a look-up by "
            "gaigs 0.3\nstart it again, a finished one in another folder"
        )
    model: Any = checkpoint.load(folder / "best.ckpt", trust, stored_software(folder))
    if config["kriging"] and name_of(model) != "kriging":
        raise ValueError(
            f"the run in {folder} is not finished: it lacks its kriging\nstart it again, it goes on"
        )
    warn_of_changes(folder, config["model"])
    return model


def configuration_of(folder: str | Path) -> dict:
    """The configuration of a run."""
    path = Path(folder) / "config.yaml"
    if not is_configuration(path):
        raise FileNotFoundError(
            f"{folder} holds no run; give the folder with config.yaml, such as runs/room"
        )
    config: Any = OmegaConf.to_container(OmegaConf.load(path))
    return config


def links_of(folder: str | Path, trust: bool) -> Links:
    """The links of a run, read again. ``trust`` is as for ``load``."""
    config = configuration_of(folder)
    if config["data"]["name"] == "arrays":
        raise ValueError(
            f"the data of {folder} were arrays, which are not stored; use the model in Python"
        )
    with only_recorded(None if trust else stored_software(Path(folder))):
        return data.load(config["data"], config["split"], config["task"]["name"])


def _check_options(config: dict) -> None:
    """Raises a ``ValueError`` for an unknown option of a part, before data are read."""
    parts = {kind: config[kind] for kind in ("data", "split", "loss", "model", "training")}
    if config["model"]["name"] == "auto":
        del parts["model"]  # no component: the choice checks its options
    for kind, part in (parts | config["model"]).items():
        if kind in KINDS and isinstance(part, Mapping) and "name" in part:
            registry(kind).check_options(part)


def train_and_test(config: dict, folder: Path) -> dict | None:
    """Contents of ``metrics.json`` of a run in a claimed folder; None in further processes."""
    import lightning

    _check_options(config)
    lightning.seed_everything(config["seed"], verbose=False)
    with timed("reading"):
        links = data.load(config["data"], config["split"], config["task"]["name"])
    if not len(links.split.test):
        raise ValueError(
            "a run takes links to test on; set split.test above 0, or use gaigs.train in Python"
        )
    # Slow to import: errors in data come first.
    from gaigs.runs import evaluation
    from gaigs.runs.choice import NAME, choose
    from gaigs.runs.fitting import fit

    name = config["model"]["name"]
    _log_links(links, config["data"]["name"])
    loss = registry("loss").build(config["loss"], task=links.task)
    baselines = evaluation.build_baselines(config["baselines"], name, links.scene)
    if baselines:
        check_known(links)  # a training comes before
    if name == NAME:
        fitted = choose(links, config, folder)
    else:
        fitted = fit(None, loss, links, config, folder)
    if fitted is None:
        return None
    look_ups = dict(baselines)
    if not fitted.unseen:  # a model without a training is fitted for the validation, too
        look_ups = {name: registry("model").build(config["model"], scene=links.scene)} | baselines
    fits: dict[str, Model] = {}
    # Fractions of the run's time limit at which parts end; figures have the remaining time.
    with stage(until=0.86), timed("validation"):
        validation = evaluation.validate(fitted.unseen, look_ups, links, fits)
    with stage(until=0.92):
        scores = evaluation.score(fitted.models, baselines, links, folder, fits=fits)
    model = fitted.models[name]
    metrics = _facts(links, config["seed"], model, fitted, folder / "best.ckpt")
    metrics |= {
        "models": {key: evaluation.summary(links.task, values) for key, values in scores.items()},
        "validation": {
            key: evaluation.summary(links.task, values) for key, values in validation.items()
        },
        "validation_score": None,
        "receivers": evaluation.by_receiver(scores, links) if len(links.receivers) > 1 else {},
    }
    places = links.query[links.split.test].place_keys
    test = evaluation.compare((links.held_out or links).task, scores, places)
    metrics["paired"] = None if test is None else test._asdict()
    if validation:
        metrics["validation_score"] = validation[name][links.task.monitor].mean().item()
    metrics |= model.facts() | fitted.facts
    if config["kriging"]:
        metrics["kriging"]["seconds"] = fitted.kriging_seconds
    model.export(folder)
    _draw(folder, links, model)
    metrics["seconds"] = dict(current().seconds)
    parts = [f"{name} {spent:.1f}" for name, spent in metrics["seconds"].items()]
    log.info("seconds: %s", ", ".join(parts))
    return metrics


def _draw(folder: Path, links: Links, model: Model) -> None:
    """Writes the radio map of scalar labels, and all figures, into the run folder."""
    if links.task.is_scalar:
        with timed("radio map"):
            radio_map(model).save(folder / "radio_map.npz")
    with timed("figures"):
        from gaigs.report.run_figures import write_figures  # matplotlib is slow to import

        write_figures(folder, links, model)


def _log_links(links: Links, name: str) -> None:
    """Logs the split of the links that were read by ``name``, and the extent of their places."""
    counts = {part_name: len(part) for part_name, part in links.split.parts().items()}
    if unused := len(links) - sum(counts.values()):
        counts["in no part"] = unused
    sizes = ", ".join(f"{count} {part_name}" for part_name, count in counts.items())
    log.info("data: %s; split %s: %s", name, links.split.name, sizes)
    box = " x ".join(f"{edge:.2f}" for edge in links.scene.upper - links.scene.lower)
    remarks = f"; {links.remarks}" if links.remarks else ""
    log.info("data: training transmitters within %s m%s", box, remarks)


def _facts(links: Links, seed: int, model: Model, fitted: Any, best: Path) -> dict:
    """Entries of ``metrics.json`` beside the scores; ``fitted`` comes from ``fitting.fit``."""
    from gaigs.runs import evaluation
    from gaigs.runs.fitting import count_gaussians

    return {
        "task": links.task.name,
        "data": links.remarks,
        "split": links.split.name,
        "seed": seed,
        "device": evaluation.device_name(model.device),
        "rasterizer": None,
        "train_seconds": fitted.seconds,
        "inference_ms": evaluation.inference_ms(model, links),
        "render_ms": evaluation.render_ms(model, links),
        "num_gaussians": count_gaussians(model),
        "num_gaussians_start": fitted.start,
        "num_parameters": sum(parameter.numel() for parameter in model.parameters()),
        "checkpoint_bytes": best.stat().st_size if best.is_file() else None,
    }
