"""Training of a model on links: fitted, descended, kriged."""

import contextlib
import logging
import signal
import tempfile
import threading
import warnings
from pathlib import Path
from typing import NamedTuple

import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from lightning.pytorch.utilities.seed import isolate_rng
from torch import distributed

from gaigs import checkpoint, evaluation
from gaigs.configuration import composed, preset
from gaigs.data import Links, check_fit
from gaigs.loss import Loss
from gaigs.model import Model
from gaigs.processes import STOPPING, Stopped, is_first, limited_threads, only_run
from gaigs.registry import call, configuration_of, registry
from gaigs.runs.folder import check_same_links, claim, fingerprint
from gaigs.training.batches import Batches, InOrder
from gaigs.training.budget import ENDLESS, make_budget
from gaigs.training.callbacks import DensityControl, Interrupted, KeepBest, KeepLast, ProgressLine
from gaigs.training.kriging import check_kriging, krige
from gaigs.training.revision import Revision

log = logging.getLogger(__name__)

RESUMED = ("optimizer_states", "lr_schedulers", "loops", "callbacks", "epoch", "global_step", "split", "links")
"""What a training goes on from, beside the weights: the most in the words of Lightning."""


LIMITS = {
    "limit_train_batches": "trainer.max_steps ends a training",
    "limit_val_batches": "all validation links decide on the best step",
}
"""Options of Lightning that would leave batches out, and why none may be."""


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
    if not isinstance(model, str | Model) or not isinstance(links, Links):
        raise TypeError(f"train takes a model and links, got {type(model).__name__} and {type(links).__name__}")
    own = None if isinstance(model, str) else model
    check_fit(links, own and own.scene)
    name = model if own is None else configuration_of(own)["name"]
    if experiments := [word for word in overrides if word.startswith("+experiment=")]:
        raise ValueError(f"{experiments[0]} must be left out: train takes that of the model and the task by itself")
    words, parts = preset(name, links.task.name), {k: v for k, v in options.items() if hasattr(v, "configuration")}
    config = composed([*words, *overrides], options)
    if overrides or options:
        usual = composed(words, {})
        if config["data"] != usual["data"] or config["split"] != usual["split"]:
            raise ValueError("data and split are the links' own; give their options to gaigs.links")
        if own is not None and (config["model"] != usual["model"] or parts.keys() - {"loss"}):
            raise ValueError("the model is made already; give the options of its parts where it is made")
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
        loss = registry("loss").build(parts.pop("loss", config["loss"]), task=links.task)
        if parts:
            own = registry("model").build(config["model"] | parts, scene=links.scene)
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
    module.train()  # a model that has been trained or loaded is in evaluation mode
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
            "best.ckpt, or choose another folder (hydra.run.dir=DIR)"
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
