"""One experiment from its configuration to its run folder."""

import json
import logging
import platform
import shutil
import statistics
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint, RichProgressBar, Timer
from lightning.pytorch.loggers import CSVLogger, Logger
from rich.console import Console

from gaigs import checkpoint
from gaigs.data import Links
from gaigs.model import Model
from gaigs.registry import registry
from gaigs.report.figures import write_figures
from gaigs.report.table import metrics_table, verdict
from gaigs.training.batches import Batches, Pass, take
from gaigs.training.callbacks import DensityControl, StopCleanly
from gaigs.training.metrics import spectrum_scores, summarise
from gaigs.training.module import Training

LOOK_UPS = ({"name": "mean"}, {"name": "knn", "k": 3})
"""What every result stands beside."""

SAVE_EVERY = timedelta(seconds=15)
"""What a killed run loses at most."""

log = logging.getLogger(__name__)


def run(config: dict, folder: Path) -> dict:
    """Trains, tests, and writes the run folder; goes on where an earlier run of the same configuration stopped there.

    Args:
        config: The resolved configuration.
        folder: Gets ``metrics.json``, ``predictions.npz``, ``figures/``, ``best.ckpt``, ``last.ckpt``, ``gaussians.ply``,
            ``loss.csv`` and ``config.yaml``.

    Returns:
        The contents of ``metrics.json``.

    Raises:
        ValueError: A configuration that does not fit the data, or another run's folder.
        FileNotFoundError: Data that are not there.
    """
    lightning.seed_everything(config["seed"], verbose=False)
    links = registry("data").build(config["data"])
    sizes = ", ".join(f"{len(part)} {name}" for name, part in links.split.parts().items())
    log.info("data: %s; split %s: %s", config["data"]["name"], links.split.name, sizes)
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)

    metrics = {"split": links.split.name, "seed": config["seed"], "device": device_name()}
    if any(parameter.requires_grad for parameter in model.parameters()):
        if hasattr(model, "gaussians"):
            metrics["num_gaussians_start"] = len(model.gaussians)
        model, seconds = train(model, links, config, folder)
        metrics |= {"train_seconds": seconds, "checkpoint_bytes": (folder / "best.ckpt").stat().st_size}
    gaussians = getattr(model, "gaussians", None)
    metrics |= {
        "inference_ms": inference_ms(model, links),
        "render_ms": render_ms(model, links),
        "num_gaussians": len(gaussians) if gaussians is not None else 0,
        "num_parameters": sum(parameter.numel() for parameter in model.parameters()),
    }
    metrics["models"] = test(model, config["model"]["name"], links, folder)
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")

    if gaussians is not None:
        gaussians.save_ply(folder / "gaussians.ply")
    write_figures(folder, links, gaussians)
    console = Console()
    console.print(metrics_table(metrics))
    console.print(verdict(metrics))
    console.print(f"results: {folder}", soft_wrap=True)
    return metrics


def train(model: Model, links: Links, config: dict, folder: Path) -> tuple[Model, float]:
    """Fits the model by gradient descent.

    Returns:
        The model at the step with the best validation SSIM, or at the last step where nothing is held out for
        validation; and the seconds it took, over all parts of a run that was interrupted.
    """
    options, steps = dict(config["training"]), config["trainer"]["max_steps"]
    batch_size, patience, density = (options.pop(key) for key in ("batch_size", "patience", "density"))
    split = {"name": links.split.name, **links.split.parts()}
    identity = {"model": config["model"], "scene": links.scene.state(), "split": split, "config": config}
    last, best = folder / "last.ckpt", folder / "best.ckpt"
    if last.is_file():
        check_resumable(last, config)
        log.info("going on from %s", last)
    module = Training(model, identity, seed=config["seed"], **options)

    timer = Timer()
    callbacks = [timer, StopCleanly(last), RichProgressBar(leave=True)]
    if density is not None:
        callbacks.append(DensityControl(**density, seed=config["seed"]))
    if len(links.split.validation):
        watched = {"monitor": "validation/ssim", "mode": "max"}
        callbacks.append(ModelCheckpoint(folder, best.stem, **watched, enable_version_counter=False))
        if patience is not None:
            callbacks.append(EarlyStopping(**watched, patience=patience))
    # Behind the others, so that it stores their state of this step too.
    callbacks.append(ModelCheckpoint(folder, last.stem, train_time_interval=SAVE_EVERY, enable_version_counter=False))
    loggers = [CSVLogger(folder, "log")]
    if config["tensorboard"]:
        loggers.append(tensorboard_logger(folder))
    trainer = lightning.Trainer(**config["trainer"], callbacks=callbacks, logger=loggers, default_root_dir=folder)
    batches = Batches(links, links.split.train, batch_size, config["seed"], steps)
    validation = Pass(links, links.split.validation, batch_size) if len(links.split.validation) else None
    resume = last if last.is_file() else None
    trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    trainer.save_checkpoint(last)
    if not len(links.split.validation):
        shutil.copyfile(last, best)
    return checkpoint.load(best), timer.time_elapsed("train")


def check_resumable(path: Path, config: dict) -> None:
    """Sees to it that a checkpoint is of this very configuration.

    Raises:
        ValueError: It is of another, or it is no checkpoint.
    """
    there, here = _flat(checkpoint.read(path)[checkpoint.KEY]["config"]), _flat(config)
    differing = [key for key in there.keys() | here.keys() if there.get(key) != here.get(key)]
    if differing:
        listed = "; ".join(f"{key} was {there.get(key)!r}, is {here.get(key)!r}" for key in sorted(differing)[:5])
        raise ValueError(
            f"{path} is of another configuration ({len(differing)} differing: {listed}); choose another folder with "
            "hydra.run.dir=DIR, or give the same configuration to go on"
        )


def test(model: Model, name: str, links: Links, folder: Path) -> dict[str, dict[str, float]]:
    """Scores of the model and the look-ups on the test links; writes ``predictions.npz``."""
    models = {name: model}
    for config in LOOK_UPS:
        if config["name"] != name:
            models[config["name"]] = registry("model").build(config, scene=links.scene)
            models[config["name"]].fit(links)
    batches = Pass(links, links.split.test, 64)
    scores, predictions = {}, []
    for key, candidate in models.items():
        parts = []
        for batch in batches:
            predicted = candidate.predict(batch.transmitters, batch.receiver).cpu()
            parts.append(spectrum_scores(batch.labels, predicted))
            if candidate is model:
                predictions.append(predicted.half().numpy())
        scores[key] = {metric: torch.cat([part[metric] for part in parts]) for metric in parts[0]}
    index = torch.cat(batches.parts)
    np.savez_compressed(
        folder / "predictions.npz",
        link=index.numpy(),
        transmitters=links.transmitters[index].numpy(),
        labels=np.concatenate([batch.labels.half().numpy() for batch in batches]),
        prediction=np.concatenate(predictions),
        **{f"ssim_{key}": value["ssim"].numpy() for key, value in scores.items()},
    )
    return {key: summarise(value) for key, value in scores.items()}


def inference_ms(model: Model, links: Links) -> float:
    """Milliseconds from a transmitter's position to its label, everything included."""
    transmitter = links.transmitters[links.split.test[:1]]
    return median_ms(lambda: model.predict(transmitter))


def render_ms(model: Model, links: Links) -> float | None:
    """Milliseconds of the rasterizer alone; None for a model without one."""
    if not hasattr(model, "render_arguments"):
        return None
    batch = take(links, links.split.test[:1])
    with torch.no_grad():
        arguments = model.render_arguments(batch)
        return median_ms(lambda: model.rasterizer(*arguments))


def median_ms(work: Callable, warm_up: int = 5, repeats: int = 25) -> float:
    """Median duration of a call [ms], after warm-up."""
    seconds = []
    for _ in range(warm_up + repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds[warm_up:])


def device_name() -> str:
    """What the numbers were computed on."""
    if torch.cuda.is_available():
        return torch.cuda.get_device_name()
    names = [line.split(":")[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"


def tensorboard_logger(folder: Path) -> Logger:
    """The logger for TensorBoard, an extra.

    Raises:
        ImportError: It is not installed.
    """
    from lightning.pytorch.loggers import TensorBoardLogger

    try:
        return TensorBoardLogger(folder, "tensorboard")
    except ModuleNotFoundError as error:
        raise ImportError("tensorboard=true needs TensorBoard: pip install 'gaigs[tensorboard]'") from error


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.is_file() else []


def _flat(config: dict, prefix: str = "") -> dict:
    """Nested keys joined by dots."""
    flat = {}
    for key, value in config.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
