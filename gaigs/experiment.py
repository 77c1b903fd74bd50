"""One experiment from its configuration to its run folder."""

import hashlib
import json
import logging
import platform
import signal
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.loggers import CSVLogger, Logger
from omegaconf import OmegaConf
from rich.console import Console
from torch import Tensor

from gaigs import checkpoint
from gaigs.configuration import differences
from gaigs.data import Links
from gaigs.model import Model
from gaigs.radio_map import radio_map
from gaigs.registry import call, registry
from gaigs.report.figures import write_figures
from gaigs.report.table import metrics_table, verdict
from gaigs.training.batches import Batches, Pass, take
from gaigs.training.callbacks import DensityControl, Interrupted, KeepBest, KeepLast, ProgressLine
from gaigs.training.metrics import scoring
from gaigs.training.module import Training

LOOK_UPS = ({"name": "mean"}, {"name": "knn", "k": 3, "power": 2})
"""What every result on spectra stands beside."""

RSSI_LOOK_UPS = ({"name": "mean"}, {"name": "knn", "k": 20, "power": 1}, {"name": "path_loss"})
"""What every result on RSSI stands beside; readings are noisy, so more neighbours count, and more alike."""

log = logging.getLogger(__name__)


def run(config: dict, folder: Path) -> dict:
    """Trains, tests, and writes the run folder; goes on where an earlier run of the same configuration stopped there.

    Args:
        config: The resolved configuration.
        folder: Gets ``config.yaml``, ``best.ckpt``, ``last.ckpt``, ``log/``, ``predictions.npz``, ``gaussians.ply``,
            for RSSI ``radio_map.npz``, ``figures/`` and, last of all, ``metrics.json``. Where that is already, nothing
            is done anew.

    Returns:
        The contents of ``metrics.json``.

    Raises:
        ValueError: A configuration that does not fit the data, or another run's folder.
        FileNotFoundError: Data that are not there.
        KeyboardInterrupt: Ctrl-C.
    """
    claim(folder, config)
    finished = folder / "metrics.json"
    if finished.is_file():
        log.info("finished already: %s", finished)
        metrics = json.loads(finished.read_text())
    else:
        metrics = train_and_test(config, folder)
        part = finished.with_suffix(".part")
        part.write_text(json.dumps(metrics, indent=2) + "\n")
        part.replace(finished)
    console = Console()
    console.print(metrics_table(metrics))
    console.print(verdict(metrics))
    console.print(f"results: {folder}", soft_wrap=True)
    return metrics


def claim(folder: Path, config: dict) -> None:
    """Writes the configuration into a run folder, unless a run has left something there to go on from.

    Raises:
        ValueError: It has, and it was a run of another configuration.
    """
    file = folder / "config.yaml"
    if not (folder / "last.ckpt").is_file() and not (folder / "metrics.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(OmegaConf.create(config), file)
        return
    differing = differences(OmegaConf.to_container(OmegaConf.load(file)), config)
    if differing:
        told = [key for key in differing if not (key.startswith("model.") and key.removeprefix("model.") in differing)]
        listed = "; ".join("{} was {!r}, is {!r}".format(key, *differing[key]) for key in told)
        raise ValueError(
            f"{folder} must be free or hold a run of the same configuration, but {listed}; choose another folder with "
            "hydra.run.dir=DIR (nothing was written into this one but Hydra's own .hydra/)"
        )


def train_and_test(config: dict, folder: Path) -> dict:
    """All of a run but the terminal's tables.

    Returns:
        What stands in ``metrics.json``; None for what the model does not have.
    """
    lightning.seed_everything(config["seed"], verbose=False)
    links = registry("data").build(config["data"])
    sizes = ", ".join(f"{len(part)} {name}" for name, part in links.split.parts().items())
    log.info("data: %s; split %s: %s", config["data"]["name"], links.split.name, sizes)
    box = " x ".join(f"{edge:.2f}" for edge in links.scene.upper - links.scene.lower)
    log.info("data: training transmitters within %s m%s", box, links.remarks and f"; {links.remarks}")
    model = registry("model").build(config["model"], scene=links.scene)
    parts = {key: part["name"] for key, part in config["model"].items() if isinstance(part, dict) and "name" in part}
    log.info("model: %s", ", ".join([config["model"]["name"], *(f"{key} {name}" for key, name in parts.items())]))
    model.fit(links)

    start, seconds, size = count_gaussians(model), None, None
    if any(parameter.requires_grad for parameter in model.parameters()):
        model, seconds = train(model, links, config, folder)
        size = (folder / "best.ckpt").stat().st_size
    scores, receivers = test(model, config["model"]["name"], links, folder)
    summarise = scoring(links.grid).summarise
    metrics = {
        "data": links.remarks,
        "split": links.split.name,
        "seed": config["seed"],
        "device": device_name(device_of(model)),
        "rasterizer": getattr(getattr(model, "rasterizer", None), "used", parts.get("rasterizer")),
        "train_seconds": seconds,
        "inference_ms": inference_ms(model, links),
        "render_ms": render_ms(model, links),
        "num_gaussians": count_gaussians(model),
        "num_gaussians_start": start,
        "num_parameters": sum(parameter.numel() for parameter in model.parameters()),
        "checkpoint_bytes": size,
        "models": {name: summarise(values) for name, values in scores.items()},
        "receivers": by_receiver(scores, receivers, links) if len(links.receivers) > 1 else {},
    }
    gaussians = getattr(model, "gaussians", None)
    if gaussians is not None:
        gaussians.save_ply(folder / "gaussians.ply")
    if links.grid is None:
        radio_map(model).save(folder / "radio_map.npz")
    write_figures(folder, links, gaussians)
    return metrics


def train(model: Model, links: Links, config: dict, folder: Path) -> tuple[Model, float]:
    """Fits the model by gradient descent.

    Returns:
        The model at the step with the best validation score, or at the last step where nothing is held out for
        validation; and the seconds it took, over all parts of a run that was interrupted.

    Raises:
        KeyboardInterrupt: Ctrl-C; ``last.ckpt`` is written.
    """
    split = {"name": links.split.name, **links.split.parts()}
    identity = {"model": config["model"], "scene": links.scene.state(), "split": split, "config": config}
    identity["links"] = fingerprint(links)
    module = call("training", Training, config["training"], model=model, identity=identity, seed=config["seed"])
    last, best = folder / "last.ckpt", folder / "best.ckpt"
    timer, keep_last = Timer(), KeepLast(last, config["save_every"])
    callbacks = [timer, KeepBest(best, module.patience), keep_last]  # Lightning puts the last two behind all others
    if module.density is not None:
        callbacks.append(call("density", DensityControl, module.density, seed=config["seed"]))
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(ProgressLine())
    loggers = [CSVLogger(folder, "log")]
    if config["tensorboard"]:
        loggers.append(tensorboard_logger(folder))
    context = {"callbacks": callbacks, "logger": loggers, "default_root_dir": folder}
    trainer = call("trainer", lightning.Trainer, config["trainer"], **context)
    if trainer.world_size > 1 or trainer.accumulate_grad_batches > 1:
        raise ValueError("trainer.devices and accumulate_grad_batches must be 1; set training.batch_size instead")
    batches = Batches(links, links.split.train, module.batch_size, config["seed"], trainer.max_steps)
    validation = Pass(links, links.split.validation, module.batch_size) if len(links.split.validation) else None
    resume = None
    if last.is_file():
        resume = last
        content = checkpoint.read(last)
        check_same_links(content[checkpoint.KEY], identity, last)
        log.info("going on after step %d", content["global_step"])
    handler = signal.signal(signal.SIGINT, keep_last.interrupt)
    try:
        with warnings.catch_warnings():
            # Of Lightning's own dealings with torch, and of a split without validation links.
            for message in (".*LeafSpec", "You defined a `validation_step` but have no `val_dataloader`"):
                warnings.filterwarnings("ignore", message)
            trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    except Interrupted as stop:
        raise KeyboardInterrupt(str(stop)) from None
    finally:
        signal.signal(signal.SIGINT, handler)
    seconds, steps, size = timer.time_elapsed("train"), trainer.global_step, module.batch_size
    log.info("trained %d steps of %d transmitters in %.0f s: %.1f steps/s", steps, size, seconds, steps / seconds)
    module.load_state_dict(checkpoint.read(best)["state_dict"])
    return model.eval().to(trainer.strategy.root_device), seconds


def check_same_links(there: dict, here: dict, path: Path) -> None:
    """Sees to it that a training goes on with the links it began with, so that none of the test has been trained on.

    Raises:
        ValueError: The split or the links are others.
    """
    parts = ("train", "validation", "test")
    same = all(torch.equal(there["split"][part], here["split"][part]) for part in parts)
    if not same or there["links"] != here["links"]:
        raise ValueError(
            f"{path} must be of these very data to go on, but they have another split, or other transmitters, "
            "receivers or labels now; choose another folder with hydra.run.dir=DIR"
        )


def fingerprint(links: Links) -> str:
    """A digest of who sent and who heard, and of labels that are in memory; images would have to be decoded for it."""
    poses = [part for receiver in links.receivers for part in (receiver.pose.position, receiver.pose.rotation)]
    parts = [links.transmitters, links.receiver_index, *poses]
    if isinstance(links.labels, Tensor):
        parts.append(links.labels)
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()


def test(model: Model, name: str, links: Links, folder: Path) -> tuple[dict[str, dict[str, Tensor]], Tensor]:
    """Scores of the model and the look-ups on every test link; writes ``predictions.npz``.

    Returns:
        The scores of each model by name, and the receiver of each test link (k,).
    """
    models = {name: model}
    for config in LOOK_UPS if links.grid is not None else RSSI_LOOK_UPS:
        if config["name"] != name:
            models[config["name"]] = registry("model").build(config, scene=links.scene)
            models[config["name"]].fit(links)
    batches = Pass(links, links.split.test, 64)
    index = torch.cat(batches.parts)
    labels = torch.cat([batch.labels for batch in batches])
    scores, content = {}, {}
    for key, candidate in models.items():
        predicted = torch.cat([candidate.predict(batch.transmitters, batch.receivers).cpu() for batch in batches])
        scores[key] = scoring(links.grid).scores(labels, predicted)
        if candidate is model:
            content["prediction"] = predicted
        if links.grid is None:
            content[f"error_{key}"] = predicted - labels
        else:
            content[f"ssim_{key}"] = scores[key]["ssim"]
    if links.grid is not None:  # half of a float's digits are enough for an image, and half of the room
        labels, content["prediction"] = labels.half(), content["prediction"].half()
    np.savez_compressed(
        folder / "predictions.npz",
        link=index.numpy(),
        transmitters=links.transmitters[index].numpy(),
        receiver=links.receiver_index[index].numpy(),
        labels=labels.numpy(),
        **{key: values.numpy() for key, values in content.items()},
    )
    return scores, links.receiver_index[index]


def by_receiver(scores: dict[str, dict[str, Tensor]], receivers: Tensor, links: Links) -> dict[str, dict]:
    """The numbers of a table for each receiver that has test links, by its name and the model's."""
    summarise = scoring(links.grid).summarise
    return {
        receiver.name: {
            name: summarise({metric: score[receivers == i] for metric, score in values.items()})
            for name, values in scores.items()
        }
        for i, receiver in enumerate(links.receivers)
        if (receivers == i).any()
    }


def inference_ms(model: Model, links: Links) -> float:
    """Milliseconds from a transmitter's position to its label, everything included."""
    link = links.split.test[0]
    return median_ms(lambda: model.predict(links.transmitters[link], int(links.receiver_index[link])))


def render_ms(model: Model, links: Links) -> float | None:
    """Milliseconds of the rasterizer alone; None for a model without one."""
    if not hasattr(model, "render_arguments"):
        return None
    batch = take(links, links.split.test[:1]).to(device_of(model))
    with torch.no_grad():
        arguments = model.render_arguments(batch)
        return median_ms(lambda: model.rasterizer(*arguments))


def median_ms(work: Callable, warm_up: int = 5, repeats: int = 25) -> float:
    """Median duration of a call [ms], after warm-up."""
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    seconds = []
    for _ in range(warm_up + repeats):
        wait()
        start = time.perf_counter()
        work()
        wait()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds[warm_up:])


def count_gaussians(model: Model) -> int:
    """How many Gaussians a model has; 0 for one of another kind."""
    return len(getattr(model, "gaussians", ()))


def device_of(model: Model) -> torch.device:
    """Where a model computes."""
    return next((tensor.device for tensor in model.state_dict().values()), torch.device("cpu"))


def device_name(device: torch.device) -> str:
    """What the numbers were computed on."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    names = [line.split(":")[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    threads = torch.get_num_threads()
    return f"{names[0] if names else platform.processor() or platform.machine()}, {threads} thread{'s' * (threads > 1)}"


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
