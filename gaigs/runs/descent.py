"""Gradient descent of a model by Lightning, from its start or resumption to its best step."""

import logging
import math
import signal
import threading
import warnings
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from torch import distributed

from gaigs.core import stages
from gaigs.core.query import drawn
from gaigs.data import Links
from gaigs.model import Model, checkpoint
from gaigs.model.answers import batch_size
from gaigs.processes import STOPPING, Stopped
from gaigs.registry import call, digests, registry
from gaigs.runs.folder import ANOTHER, check_same_links, fingerprint
from gaigs.splatting.loss import Loss
from gaigs.training.batches import Batches, InOrder
from gaigs.training.budget import ENDLESS, Budget, make_budget
from gaigs.training.checkpoints import Interrupted, KeepBest, KeepLast
from gaigs.training.density_control import DensityControl
from gaigs.training.progress import ProgressLine
from gaigs.training.revision import Revision

log = logging.getLogger(__name__)


def descend(
    model: Model,
    loss: Loss,
    links: Links,
    config: dict,
    folder: Path,
    searched: float,
    rival: float | None = None,
) -> tuple[Model, float]:
    """Trains a model by gradient descent, after its ``Model.fit``.

    Args:
        folder: Folder of checkpoints and log; an interrupted training there is resumed.
        searched: Duration of ``Model.fit`` [s].
        rival: A validation score. The training ends early if an extrapolation of its own score
            stays below.

    Returns:
        The model at the step with the best validation score, or at the last step without validation
        links; and the duration of fit and descent [s], summed over the parts of an interrupted run.
    """
    seed = config["seed"]
    identity = _identity(links, config)
    context: dict[str, Any] = {"model": model, "loss": loss, "identity": identity, "seed": seed}
    module = registry("training").build(config["training"], **context)
    last = folder / "last.ckpt"
    best = folder / "best.ckpt"
    options, budget = make_budget(config["trainer"], searched)
    keep_last = KeepLast(last, config["save_every"])
    # Lightning calls the keepers of checkpoints after all others.
    callbacks = [budget, KeepBest(best, module.patience, rival), keep_last]
    callbacks += _callbacks(module, links, config)
    loggers = _loggers(folder, config["tensorboard"])
    trainer = make_trainer(options, default_root_dir=folder, callbacks=callbacks, logger=loggers)
    _check_processes(trainer, config)
    if trainer.world_size > 1:  # further processes end with this training
        model.second_start = {}
    steps = ENDLESS if trainer.max_steps == -1 else trainer.max_steps
    batches = Batches(links, links.split.train, module.batch_size, seed, steps)
    validation = None
    if len(links.split.validation) and links.task.is_scalar:
        # Scalar labels need little memory, and large batches less time.
        validation = InOrder(links, drawn(links.split.validation), batch_size(links))
    elif len(links.split.validation):
        validation = InOrder(links, links.split.validation, module.batch_size)
    resumed = last if last.is_file() else None
    if resumed is not None:
        content = resumable(last, best, module)
        check_same_links(content[checkpoint.KEY], identity, last)
        log.info("going on after step %d", content["global_step"])
        # The time before the interruption counts for the limit of the run.
        stages.current().began -= content["callbacks"][budget.state_key]["seconds"]
    # Lightning converts after it has loaded a checkpoint, which would round the weights.
    module = trainer.precision_plugin.convert_module(module)
    module.train()  # a model that has been trained or loaded is in evaluation mode
    _run(trainer, module, batches, validation, resumed)
    if keep_last.received is not None:  # a signal after the last step
        raise Stopped(f"stopped after step {trainer.global_step}", keep_last.received)
    _log_speed(trainer, budget, module.batch_size)
    module.load_state_dict(checkpoint.trained_weights(checkpoint.read(best)))
    return model.eval().to(trainer.strategy.root_device), budget.seconds


def _identity(links: Links, config: dict) -> dict:
    """Entries of a checkpoint beside the weights: scene, configuration and split."""
    scene = links.scene.state()
    return {
        "version": checkpoint.VERSION,
        "model": config["model"],
        "scene": scene,
        "split": {"name": links.split.name, **links.split.parts()},
        "config": config,
        "links": fingerprint(links),
        "plugins": digests(config, scene["task"]),
    }


def _callbacks(module: Any, links: Links, config: dict) -> list[Callback]:
    """Configured callbacks of a training: density control, revisions and the progress line."""
    callbacks: list[Callback] = []
    if module.density is not None:
        callbacks.append(call("density", DensityControl, module.density, seed=config["seed"]))
    if module.model.revisions:
        callbacks.append(Revision(links, config["seed"]))
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(ProgressLine())
    return callbacks


def _loggers(folder: Path, tensorboard: bool) -> list[Logger]:
    loggers: list[Logger] = [CSVLogger(folder, "log")]
    if tensorboard:
        try:
            loggers.append(TensorBoardLogger(folder, "tensorboard"))
        except ModuleNotFoundError as error:
            raise ImportError(
                "tensorboard=true needs TensorBoard: pip install 'gaigs[tensorboard]'"
            ) from error
    return loggers


def _check_processes(trainer: lightning.Trainer, config: dict) -> None:
    """Raises a ``ValueError`` if several processes would train with a single-process option."""
    if trainer.world_size == 1:
        return
    if config["ensemble"] > 1:
        raise ValueError(
            "an ensemble trains in one process; set trainer.devices=1 and trainer.num_nodes=1"
        )
    if math.isfinite(stages.left()):
        raise ValueError(
            "max_time and model=auto work with one process; with several, set trainer.max_time"
        )


def resumable(last: Path, best: Path, module: lightning.LightningModule) -> dict:
    """The checkpoint to resume from; a ValueError if it or the best one is damaged or too old."""
    training = ("optimizer_states", "lr_schedulers", "loops", "callbacks", "epoch", "global_step")
    try:
        content = checkpoint.read(last)
        known = content | content[checkpoint.KEY]
        if lacking := [key for key in (*training, "split", "links") if key not in known]:
            raise ValueError(f"{last} lacks {', '.join(lacking)} of a training")
        # The optimizer knows no parameters of a later version.
        parameters = [name for name, _ in module.named_parameters()]
        if lacking := [name for name in parameters if name not in content["state_dict"]]:
            raise ValueError(f"{last} is of another version of gaigs, without {lacking[0]}")
        if best.is_file():
            checkpoint.read(best)
    except ValueError as error:
        cause, *_ = str(error).split("\n")
        raise ValueError(
            f"cannot resume the training: {cause}\n"
            f"move {last} elsewhere to train again, which overwrites best.ckpt, or {ANOTHER}"
        ) from error
    return content


def _run(
    trainer: lightning.Trainer,
    module: lightning.LightningModule,
    batches: Batches,
    validation: InOrder | None,
    resumed: Path | None,
) -> None:
    """Makes all steps of a training. A signal raises ``Stopped`` once handlers are restored."""
    expected = (
        ".*LeafSpec",  # Lightning's use of torch
        "You defined a `validation_step` but",  # a split without validation links
        "The number of training batches",  # few steps
    )
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    try:
        with warnings.catch_warnings():
            for message in expected:
                warnings.filterwarnings("ignore", message)
            trainer.fit(module, batches, validation, ckpt_path=resumed, weights_only=True)
    except Interrupted as stop:
        raise Stopped(str(stop), stop.number) from None
    except SystemExit as end:  # raised by Lightning at a signal before the first step
        if isinstance(end.__context__, KeyboardInterrupt):
            raise Stopped("stopped", getattr(end.__context__, "number", signal.SIGINT)) from None
        raise
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()


def _log_speed(trainer: lightning.Trainer, budget: Budget, batch_places: int) -> None:
    """Logs the rate of steps, and whether the time limit of the run ended the training early."""
    seconds = budget.seconds - budget.searched
    steps = trainer.global_step
    words = "trained %d steps of %d places in %.0f s: %.1f steps/s"
    log.info(words, steps, batch_places, seconds, steps / seconds)
    if budget.seconds >= budget.end and steps < trainer.max_steps:
        stages.leave_out(f"the training ended after {steps} of {trainer.max_steps} steps")


def make_trainer(options: dict, **context: Any) -> lightning.Trainer:
    """A trainer that stops and resumes at any step; a ``ValueError`` if an option prevents it."""
    # Messages of lower levels list unused devices.
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    with warnings.catch_warnings():
        # Advice against an option that was chosen.
        warnings.filterwarnings("ignore", "GPU available but not used")
        trainer = call("trainer", lightning.Trainer, options, **context)
    usual = {
        "fast_dev_run": False,
        "overfit_batches": 0.0,
        "accumulate_grad_batches": 1,
        "limit_train_batches": 1.0,  # all batches, and 1 is one batch
        "limit_val_batches": 1.0,
    }
    for name, value in usual.items():
        given = getattr(trainer, name)
        # With the type, since 1 == 1.0 in Python.
        if (type(given), given) != (type(value), value):
            raise ValueError(
                f"trainer.{name} must be left out\nset trainer.max_steps to end a training early, "
                "training.batch_size for larger batches"
            )
    strategy = trainer.strategy
    launcher = strategy.launcher
    starts_scripts = launcher is None or "Subprocess" in type(launcher).__name__
    if not isinstance(strategy, DDPStrategy | SingleDeviceStrategy) or not starts_scripts:
        raise ValueError(
            "trainer.strategy must be auto for one process or ddp for several, "
            f"got {type(strategy).__name__}"
        )
    return trainer


def check_processes(options: dict, launcher: str) -> None:
    """Raises a ``ValueError`` if a job of a multirun would train in several processes.

    Args:
        options: Options of the trainer.
        launcher: Class name of Hydra's launcher. SLURM's starts the processes of each job; with
            others the processes of one job would start the next job at different times.
    """
    chosen = ("accelerator", "devices", "num_nodes", "strategy")
    options = {key: options[key] for key in chosen if key in options}
    trainer = make_trainer(options, logger=False, enable_checkpointing=False)
    if trainer.strategy.launcher is not None and launcher != "SlurmLauncher":
        raise ValueError(
            "a job of a multirun must train in one process\n"
            "run it alone, or use hydra/launcher=submitit_slurm, "
            "which starts the processes of each job"
        )
