"""Training: of a model on links, and of one run from its configuration to its folder."""

import contextlib
import hashlib
import json
import logging
import signal
import tempfile
import threading
import warnings
from pathlib import Path
from typing import NamedTuple

import lightning
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from lightning.pytorch.utilities.seed import isolate_rng
from omegaconf import OmegaConf
from rich.console import Console
from torch import Tensor, distributed

from gaigs import checkpoint, evaluation
from gaigs.configuration import composed, differences, preset
from gaigs.data import Links, load
from gaigs.files import whole, write_text
from gaigs.loss import Loss
from gaigs.model import Model
from gaigs.processes import STOPPING, Stopped, is_first, limited_threads, only_run
from gaigs.registry import call, configuration_of, registry
from gaigs.report.runs import read_metrics
from gaigs.report.table import metrics_table, verdict
from gaigs.training.batches import Batches, InOrder
from gaigs.training.budget import ENDLESS, make_budget
from gaigs.training.callbacks import DensityControl, Interrupted, KeepBest, KeepLast, ProgressLine
from gaigs.training.kriging import check_kriging, krige
from gaigs.training.revision import Revision

log = logging.getLogger(__name__)

WRITTEN = ("config.yaml", "best.ckpt", "log", "predictions.npz", "gaussians.ply", "radio_map.npz", "figures")
"""What a run writes into its folder before there is anything to go on from."""


RESUMED = ("optimizer_states", "lr_schedulers", "loops", "callbacks", "epoch", "global_step", "split", "links")
"""What a training goes on from, beside the weights: the most in the words of Lightning."""


LIMITS = {
    "limit_train_batches": "trainer.max_steps ends a training",
    "limit_val_batches": "all validation links decide on the best step",
}
"""Options of Lightning that would leave batches out, and why none may be."""


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


def claim(folder: Path, config: dict) -> None:
    """Writes the configuration into a run folder, unless a run has left something there to go on from.

    Raises:
        ValueError: It has, and it was a run of another configuration; or files of that name are not a run's.
    """
    file = folder / "config.yaml"
    there = [name for name in (*WRITTEN, "last.ckpt", "metrics.json") if (folder / name).exists()]
    if there and not is_configuration(file):
        raise ValueError(
            f"{folder} must be free or hold a run, and it holds {', '.join(there)} of something else; choose another "
            "folder with hydra.run.dir=DIR"
        )
    if not (folder / "last.ckpt").is_file() and not (folder / "metrics.json").is_file():
        store(config, folder)
        return
    try:
        there = OmegaConf.to_container(OmegaConf.load(file))
    except Exception as error:  # whatever a file meets that is YAML, but no configuration
        raise ValueError(
            f"{file} must be what a run wrote, and is damaged ({' '.join(str(error).split())}); take another copy of "
            "it, or choose another folder with hydra.run.dir=DIR"
        ) from error
    differing = differences(there, config)
    if differing:
        told = [key for key in differing if not (key.startswith("model.") and key.removeprefix("model.") in differing)]
        listed = "; ".join("{} was {!r}, is {!r}".format(key, *differing[key]) for key in told)
        raise ValueError(
            f"{folder} must be free or hold a run of the same configuration, but {listed}; choose another folder with "
            "hydra.run.dir=DIR (nothing was written into this one but Hydra's own .hydra/)"
        )


def store(config: dict, folder: Path) -> None:
    """Writes the configuration of a run into its folder."""
    with whole(folder / "config.yaml") as part:
        OmegaConf.save(OmegaConf.create(config), part)


def is_configuration(file: Path) -> bool:
    """Whether a file is the configuration of a run."""
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(content, dict) and {"model", "data"} <= content.keys()


def train(model: str | Model, links: Links, /, *overrides: str, folder: str | Path | None = None, **options) -> Model:
    """A model trained on links as the command line would train it, by the preset of the model and the links' task.

    Args:
        model: Name of any registered model; or one that is made already, which is trained where it stands.
        links: What to learn from; validation links choose the best step. Test links are not looked at.
        overrides: Words of the command line, e.g. ``"variant=ga"`` or ``"trainer.max_steps=300"``.
        folder: Gets the configuration, the log and the checkpoints; the same call goes on there where an earlier one
            was stopped. None leaves no files.
        options: Values by their keys or names, as ``gaigs.compose`` takes them: ``max_steps=300, seed=0``.

    Returns:
        The model with the best validation score, in evaluation mode; of ``mirrored`` with kriging on top.

    Raises:
        TypeError: An option is of another type than it must be.
        ValueError: A name is unknown, an option out of range, or model and links do not fit.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> links = gaigs.links("synthetic", transmitters=40, order=0)
        >>> model = gaigs.train("gaigs", links, max_steps=2, count=20, enable_progress_bar=False)
        >>> model.predict([[1.0, 2.0, 1.5], [2.5, 1.0, 0.8]]).shape
        torch.Size([2, 90, 360])
    """
    if links.split is None:
        raise ValueError("links must have a split to be trained on; gaigs.links(..., split='random') gives one")
    own = None if isinstance(model, str) else model
    name = model if own is None else configuration_of(own)["name"]
    config = composed([*preset(name, links.task.name), *overrides], options)
    config |= {"data": {"name": "arrays"}, "split": {"name": links.split.name}, **links.origin}
    if own is not None:
        config["model"] = configuration_of(own)
    with contextlib.ExitStack() as stack:
        stack.enter_context(limited_threads(config["threads"]))
        stack.enter_context(isolate_rng())
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()) if folder is None else folder)
        place.mkdir(parents=True, exist_ok=True)
        stack.enter_context(only_run(place))
        claim(place, config)
        lightning.seed_everything(config["seed"], verbose=False)
        loss = registry("loss").build(config["loss"], task=links.task)
        return fit(own, loss, links, config, place).models[config["model"]["name"]].eval()


class Fitted(NamedTuple):
    """What ``fit`` gives.

    Attributes:
        models: By name: the model, and where it was kriged behind it the trained one alone, ``<name>_trend``.
        unseen: The same without what validation links alone told; empty of a look-up.
        start: Gaussians before the training.
        seconds: Of training; None of a look-up.
        kriging_seconds: None without kriging.
    """

    models: dict[str, Model]
    unseen: dict[str, Model]
    start: int
    seconds: float | None = None
    kriging_seconds: float | None = None


def fit(model: Model | None, loss: Loss, links: Links, config: dict, folder: Path) -> Fitted | None:
    """Builds a model unless it is there already, fits it to links, and trains and kriges it where that is asked for.

    Returns:
        None in all but the first of several processes.
    """
    name = config["model"]["name"]
    if model is None:
        model = registry("model").build(config["model"], scene=links.scene)
    check_kriging(config, model, links)
    parts = {key: part["name"] for key, part in config["model"].items() if isinstance(part, dict) and "name" in part}
    log.info("model: %s", ", ".join([name, *(f"{key} {part}" for key, part in parts.items())]))
    model.fit(links)
    start = count_gaussians(model)
    if not evaluation.is_trained(model):
        return Fitted({name: model}, {}, start)
    model, seconds = descend(model, loss, links, config, folder)
    if not config["kriging"]:
        return Fitted({name: model}, {name: model}, start, seconds) if is_first() else None
    descend_fold = lambda model, part, folder: descend(model, loss, part, config, folder)
    kriged = krige(model, links, config, folder, descend_fold)
    if kriged is None:
        return None
    models, unseen = ({name: own, f"{name}_trend": model} for own in (kriged.model, kriged.blind))
    return Fitted(models, unseen, start, seconds, kriged.seconds)


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
        "validation_score": validation[name][task.watched].mean().item() if validation else None,
        "receivers": evaluation.by_receiver(scores, links) if len(links.receivers) > 1 else {},
    } | model.facts()
    if config["kriging"]:
        metrics["kriging"]["seconds"] = fitted.kriging_seconds
    model.export(folder)
    task.keep(folder, model)
    evaluation.write_figures(folder, links, model.primitives, model.learnt_room(links))
    return metrics


def descend(model: Model, loss: Loss, links: Links, config: dict, folder: Path) -> tuple[Model, float]:
    """Trains the model by gradients.

    Returns:
        The model at the step with the best validation score, or at the last step where nothing is held out for
        validation; and the seconds it took, over all parts of a run that was interrupted.

    Raises:
        Stopped: Ctrl-C or SIGTERM; ``last.ckpt`` is written.
    """
    split = {"name": links.split.name, **links.split.parts()}
    identity = {"version": checkpoint.VERSION, "model": config["model"], "scene": links.scene.state(), "split": split}
    identity |= {"config": config, "links": fingerprint(links)}
    context = {"model": model, "loss": loss, "identity": identity, "seed": config["seed"]}
    module = registry("training").build(config["training"], **context)
    last, best = folder / "last.ckpt", folder / "best.ckpt"
    timer, keep_last = Timer(), KeepLast(last, config["save_every"])
    options, budget = make_budget(config["trainer"], timer)
    callbacks = [timer, KeepBest(best, module.patience), keep_last]  # Lightning puts the last two behind all others
    if budget is not None:
        callbacks.insert(1, budget)
    if module.density is not None:
        callbacks.append(call("density", DensityControl, module.density, seed=config["seed"]))
    if model.revisions:
        callbacks.append(Revision(links, config["seed"]))
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(ProgressLine())
    loggers = [CSVLogger(folder, "log")]
    if config["tensorboard"]:
        loggers.append(tensorboard_logger(folder))
    context = {"callbacks": callbacks, "logger": loggers, "default_root_dir": folder}
    for name in ("lightning.pytorch", "lightning.fabric"):  # which tell of devices that are there and not taken
        logging.getLogger(name).setLevel(logging.WARNING)
    trainer = call("trainer", lightning.Trainer, options, **context)
    check_trainer(trainer)
    steps = ENDLESS if trainer.max_steps == -1 else trainer.max_steps
    batches = Batches(links, links.split.train, module.batch_size, config["seed"], steps)
    validation = InOrder(links, links.split.validation, module.batch_size) if len(links.split.validation) else None
    resume = None
    if last.is_file():
        resume = last
        content = resumable(last, best)
        check_same_links(content[checkpoint.KEY], identity, last)
        log.info("going on after step %d", content["global_step"])
    # Before weights come from a checkpoint: Lightning converts behind that, which would round them.
    module = trainer.precision_plugin.convert_module(module)
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    try:
        with warnings.catch_warnings():
            # Of Lightning's own dealings with torch, of a split without validation links, and of few steps.
            for message in (".*LeafSpec", "You defined a `validation_step` but", "The number of training batches"):
                warnings.filterwarnings("ignore", message)
            trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    except Interrupted as stop:
        raise Stopped(str(stop), stop.number) from None
    except SystemExit as end:  # Lightning's for a signal that came before its handler was ours
        if isinstance(end.__context__, KeyboardInterrupt):
            raise Stopped("stopped", getattr(end.__context__, "number", signal.SIGINT)) from None
        raise
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()
    if keep_last.received is not None:  # behind the last step
        raise Stopped(f"stopped after step {trainer.global_step}", keep_last.received)
    seconds, steps, size = timer.time_elapsed("train"), trainer.global_step, module.batch_size
    log.info("trained %d steps of %d places in %.0f s: %.1f steps/s", steps, size, seconds, steps / seconds)
    module.load_state_dict(checkpoint.trained_weights(checkpoint.read(best)))
    return model.eval().to(trainer.strategy.root_device), seconds


def resumable(last: Path, best: Path) -> dict:
    """The checkpoint to go on from, where it and the best one so far are whole; changes neither.

    Raises:
        ValueError: One of them is not.
    """
    try:
        content = checkpoint.read(last)
        if lacking := [key for key in RESUMED if key not in content | content[checkpoint.KEY]]:
            raise ValueError(f"{last} must hold the state of a training, and lacks {', '.join(lacking)}")
        if best.is_file():
            checkpoint.read(best)
    except ValueError as error:
        raise ValueError(
            f"the training cannot go on: {error}; move {last} elsewhere to train anew in this folder, which overwrites "
            "best.ckpt, or choose another folder with hydra.run.dir=DIR"
        ) from error
    return content


def check_trainer(trainer: lightning.Trainer) -> None:
    """Sees to it that a training can stop anywhere and go on there, in one process or several.

    Raises:
        ValueError: The trainer's options do not allow it.
    """
    if trainer.accumulate_grad_batches > 1:
        raise ValueError("trainer.accumulate_grad_batches must be 1; set training.batch_size instead")
    for name in ("fast_dev_run", "overfit_batches"):  # which set the others
        if getattr(trainer, name):
            raise ValueError(f"trainer.{name} must be left out; set trainer.max_steps to end a training early")
    for name, reason in LIMITS.items():
        share = getattr(trainer, name)
        if isinstance(share, int) or share != 1:  # 1 is one batch, 1.0 all of them
            raise ValueError(f"trainer.{name} must be left out, as {reason}")
    strategy, launcher = trainer.strategy, trainer.strategy.launcher
    starts_scripts = launcher is None or "Subprocess" in type(launcher).__name__
    if not isinstance(strategy, DDPStrategy | SingleDeviceStrategy) or not starts_scripts:
        raise ValueError(
            f"trainer.strategy must be auto for one process or ddp for several, got {type(strategy).__name__}"
        )
    is_sweep = HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN
    # Others would have the processes of one job come to the next at different times.
    if is_sweep and launcher is not None and not HydraConfig.get().launcher["_target_"].endswith("SlurmLauncher"):
        raise ValueError(
            "a job of a multirun must train in one process; run it alone, or take hydra/launcher=submitit_slurm, which "
            "starts the processes of each job"
        )


def check_same_links(there: dict, here: dict, path: Path) -> None:
    """Sees to it that a training goes on with the links it began with, so that none of the test has been trained on.

    Raises:
        ValueError: The split or the links are others.
    """
    parts = ("train", "validation", "test")
    same = all(torch.equal(there["split"][part], here["split"][part]) for part in parts)
    same = same and _is_same(there.get("scene"), here.get("scene"))
    if not same or there["links"] != here["links"]:
        raise ValueError(
            f"{path} must be of these very data to go on, but they have another split, or other transmitters, "
            "receivers, frequencies or labels now; choose another folder with hydra.run.dir=DIR"
        )


def _is_same(a: object, b: object) -> bool:
    """Whether two nested states hold the same values."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_is_same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_is_same, a, b))
    return torch.equal(a, b) if isinstance(a, Tensor) and isinstance(b, Tensor) else a == b


def fingerprint(links: Links) -> str:
    """A digest of queries and receivers, and of labels that are in memory; images would have to be decoded for it."""
    parts = [links.query.transmitters, links.query.receivers]
    for receiver in links.receivers:
        parts += [receiver.pose.position, receiver.pose.rotation, receiver.array.elements]
    if links.query.frequencies is not None:
        parts.append(links.query.frequencies)
    if isinstance(links.labels, Tensor):
        parts.append(links.labels)
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()


def count_gaussians(model: Model) -> int:
    """How many Gaussians a model has; 0 for one of another kind."""
    return 0 if model.primitives is None else len(model.primitives)


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
