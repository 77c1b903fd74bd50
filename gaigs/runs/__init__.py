"""One run, from its configuration to its folder."""

import json
import logging
from pathlib import Path

import lightning
from rich.console import Console

from gaigs import evaluation
from gaigs.data import load
from gaigs.io.files import write_text
from gaigs.processes import is_first, limited_threads, only_run
from gaigs.registry import registry
from gaigs.report.runs import read_metrics
from gaigs.report.table import metrics_table, verdict
from gaigs.runs.folder import claim, is_configuration, store
from gaigs.runs.training import count_gaussians, fit

log = logging.getLogger(__name__)


def run(config: dict, folder: Path) -> dict | None:
    """Trains, tests, and writes the run folder; goes on where an earlier run of the same configuration stopped there.

    Args:
        config: The resolved configuration.
        folder: Gets ``config.yaml``, ``best.ckpt``, ``last.ckpt``, ``log/``, ``predictions.npz``, what the model
            exports and the task keeps, ``figures/`` and, last of all, ``metrics.json``. Where that is already, nothing
            is done anew. One run holds it at a time.

    Returns:
        The contents of ``metrics.json``; None in all but the first of several processes.

    Raises:
        TypeError: A value of the configuration that is not of its key's type.
        ValueError: A configuration that does not fit the data, another run's folder, or a damaged file in this one.
        FileNotFoundError: Data that are not there.
        OSError: A file cannot be written, e.g. as the disk is full; nothing half-written is left of it.
        KeyboardInterrupt: Ctrl-C, or ``gaigs.processes.Stopped`` for it and SIGTERM.
    """
    with limited_threads(config["threads"]):
        if not is_first():
            logging.getLogger("gaigs").setLevel(logging.WARNING)  # one of them tells it all
            train_and_test(config, folder)
            return None
        metrics = _in_folder(config, folder)
    console = Console()
    console.print(metrics_table(metrics))
    console.print(verdict(metrics))
    console.print(f"results: {folder}", soft_wrap=True)
    return metrics


def _in_folder(config: dict, folder: Path) -> dict:
    """The contents of ``metrics.json``, whether it is there already or not."""
    folder.mkdir(parents=True, exist_ok=True)
    with only_run(folder):
        claim(folder, config)
        finished = folder / "metrics.json"
        if finished.is_file():
            log.info("finished already: %s", finished)
            metrics = read_metrics(finished)
        else:
            metrics = train_and_test(config, folder)
            if not is_configuration(folder / "config.yaml"):  # the folder was removed, and loggers have made it anew
                store(config, folder)
            write_text(finished, json.dumps(metrics, indent=2) + "\n")
    return metrics


def train_and_test(config: dict, folder: Path) -> dict | None:
    """All of a run but the terminal's tables.

    Returns:
        What stands in ``metrics.json``; None for what the model does not have, and in all but the first process.
    """
    lightning.seed_everything(config["seed"], verbose=False)
    links = load(config["data"], config["split"], config["task"]["name"])
    task, name = links.task, config["model"]["name"]
    counts = {part_name: len(part) for part_name, part in links.split.parts().items()}
    if unused := len(links) - sum(counts.values()):
        counts["in no part"] = unused
    sizes = ", ".join(f"{count} {part_name}" for part_name, count in counts.items())
    log.info("data: %s; split %s: %s", config["data"]["name"], links.split.name, sizes)
    scene = links.scene
    box = " x ".join(f"{edge:.2f}" for edge in scene.upper - scene.lower)
    log.info("data: training transmitters within %s m%s", box, links.remarks and f"; {links.remarks}")
    loss = registry("loss").build(config["loss"], task=task)
    baselines = evaluation.baseline_configurations(config["baselines"], name, scene)
    fitted = fit(None, loss, links, config, folder)
    if fitted is None:
        return None
    model, is_trained = fitted.models[name], bool(fitted.unseen)
    scores = evaluation.score(fitted.models, baselines, links, folder)
    look_ups = baselines if is_trained else {name: config["model"], **baselines}
    validation = evaluation.validate(fitted.unseen, look_ups, links)
    metrics = {
        "task": task.name,
        "data": links.remarks,
        "split": links.split.name,
        "seed": config["seed"],
        "device": evaluation.device_name(evaluation.device_of(model)),
        "rasterizer": None,
        "train_seconds": fitted.seconds,
        "inference_ms": evaluation.inference_ms(model, links),
        "render_ms": evaluation.render_ms(model, links),
        "num_gaussians": count_gaussians(model),
        "num_gaussians_start": fitted.start,
        "num_parameters": sum(parameter.numel() for parameter in model.parameters()),
        "checkpoint_bytes": (folder / "best.ckpt").stat().st_size if is_trained else None,
        "models": {name: task.summarise(values) for name, values in scores.items()},
        "validation": {name: task.summarise(values) for name, values in validation.items()},
        "validation_score": validation[name][task.monitor].mean().item() if validation else None,
        "receivers": evaluation.by_receiver(scores, links) if len(links.receivers) > 1 else {},
    } | model.facts()
    if config["kriging"]:
        metrics["kriging"]["seconds"] = fitted.kriging_seconds
    model.export(folder)
    task.keep(folder, model)
    evaluation.write_figures(folder, links, model.primitives, model.learnt_room(links))
    return metrics
