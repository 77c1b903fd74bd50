"""Training of a model on links: fit, gradient descent, kriging."""

import contextlib
import copy
import logging
import math
import signal
import tempfile
import threading
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from lightning.pytorch.utilities.seed import isolate_rng
from torch import distributed

from gaigs.configuration import composed, preset
from gaigs.core import stages
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.kriging.links import check_known
from gaigs.model import Model, checkpoint
from gaigs.model.answers import calibrated
from gaigs.model.ensemble import Ensemble
from gaigs.model.kriging import Kriging
from gaigs.processes import STOPPING, Stopped, is_first, limited_threads, only_run
from gaigs.registry import call, configuration_of, digests, registry
from gaigs.runs.folder import ANOTHER, check_same_links, claim, fingerprint
from gaigs.splatting.loss import Loss
from gaigs.training.batches import Batches, InOrder
from gaigs.training.budget import ENDLESS, make_budget, watched
from gaigs.training.checkpoints import Interrupted, KeepBest, KeepLast
from gaigs.training.density_control import DensityControl
from gaigs.training.progress import ProgressLine
from gaigs.training.revision import Revision

log = logging.getLogger(__name__)


def train(
    model: str | Model,
    links: Links,
    /,
    *overrides: str,
    folder: str | Path | None = None,
    **options,
) -> Model:
    """Trains a model on links as the command line does, by the preset of the model and the links'
    task.

    Args:
        model: Name of a registered model; or a model, which is trained in place, of a kriged one a
            copy of its trend.
        links: Links to learn from; validation links choose the best step. Test links are not used.
        overrides: Command-line words, e.g. ``"variant=ga"`` or ``"trainer.max_steps=300"``.
        folder: Gets the configuration, the log and the checkpoints; the same call resumes a stopped
            training there. None: no files.
        options: Values by their keys or names, as in ``gaigs.compose``: ``max_steps=300, seed=0``.

    Returns:
        The model with the best validation score, on the CPU and in evaluation mode, as
        ``gaigs.load`` gives it; with ``mirrored`` a kriged model.

    Raises:
        TypeError: An option has the wrong type.
        ValueError: A name is unknown, an option is out of range, or model and links do not fit.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> links = gaigs.links("synthetic", transmitters=40, order=0)
        >>> model = gaigs.train("gaigs", links, max_steps=1, count=20, enable_progress_bar=False)
        >>> model.predict([[1.0, 2.0, 1.5], [2.5, 1.0, 0.8]]).shape  # places, receivers, rows, columns
        torch.Size([2, 1, 90, 360])
    """
    if not isinstance(model, str | Model) or not isinstance(links, Links):
        raise TypeError(
            f"train takes a model and links, got {type(model).__name__} and {type(links).__name__}"
        )
    own = (
        None
        if isinstance(model, str)
        else copy.deepcopy(model.trend)
        if isinstance(model, Kriging)
        else model
    )
    if isinstance(own, Ensemble):
        members = "members" if own is model else "trend.members"
        raise ValueError(
            f"an ensemble cannot be trained further; train one of its models, {members}[0]"
        )
    check_fit(links, own and own.scene)
    name = model if own is None else configuration_of(own)["name"]
    if experiments := [word for word in overrides if word.startswith("+experiment=")]:
        raise ValueError(
            f"leave out {experiments[0]}: train takes the experiment of the model and the task"
        )
    words, parts = (
        preset(name, links.task.name),
        {k: v for k, v in options.items() if hasattr(v, "configuration")},
    )
    config = composed([*words, *overrides], options)
    if overrides or options:
        usual = composed(words, {})
        if config["data"] != usual["data"] or config["split"] != usual["split"]:
            raise ValueError("train takes no options of data and split; pass them to gaigs.links")
        if own is not None and (config["model"] != usual["model"] or parts.keys() - {"loss"}):
            raise ValueError(
                "train takes no options of a model that is made already; pass them to its constructor"
            )
    config |= {"data": {"name": "arrays"}, "split": {"name": links.split.name}, **links.origin}
    if own is not None:
        config["model"] = configuration_of(own)
    with contextlib.ExitStack() as stack:
        stack.enter_context(limited_threads(config["threads"]))
        stack.enter_context(isolate_rng())
        place = Path(
            stack.enter_context(tempfile.TemporaryDirectory()) if folder is None else folder
        )
        place.mkdir(parents=True, exist_ok=True)
        stack.enter_context(only_run(place))
        claim(place, config)
        stack.enter_context(watched(config))
        lightning.seed_everything(config["seed"], verbose=False)
        loss = registry("loss").build(parts.pop("loss", config["loss"]), task=links.task)
        if parts:
            own = registry("model").build(config["model"] | parts, scene=links.scene)
        return fit(own, loss, links, config, place).models[config["model"]["name"]].eval().cpu()


class Fitted(NamedTuple):
    """Result of ``fit``.

    Attributes:
        models: The model by its name; a kriged one is followed by the trained model alone,
            ``<name>_trend``.
        unseen: The same, not fitted to validation links; empty for a model without a training.
        start: Number of Gaussians before the training.
        seconds: Duration of ``Model.fit``, as of a search for planes, and of the training; None
            without one.
        kriging_seconds: Duration of kriging; None without it.
    """

    models: dict[str, Model]
    unseen: dict[str, Model]
    start: int
    seconds: float | None = None
    kriging_seconds: float | None = None


def fit(model: Model | None, loss: Loss, links: Links, config: dict, folder: Path) -> Fitted | None:
    """Builds, fits, trains and kriges a model as configured; None in all but the first of several
    processes.
    """
    name = config["model"]["name"]
    if config["ensemble"] < 1:
        raise ValueError(f"ensemble must be at least 1 model, got {config['ensemble']}")
    if model is None:
        model = registry("model").build(config["model"], scene=links.scene)
    if isinstance(model, Kriging):
        raise ValueError(
            "model=kriging has no training of its own; choose a trained model, and set kriging=true"
        )
    if config["kriging"]:
        check_known(links)  # a training comes before
    make_kriged = lambda trend: (
        Kriging(links.scene, trend, config["kriging_fallback"]) if config["kriging"] else None
    )
    kriged = make_kriged(model)
    parts = {
        key: part["name"]
        for key, part in config["model"].items()
        if isinstance(part, dict) and "name" in part
    }
    if "tokenizer" in parts and getattr(model, "tokenizer", model) is None:
        if parts["tokenizer"] != registry("model").options(name).get(
            "tokenizer", parts["tokenizer"]
        ):
            words = "tokenizer=%s is not read, as deformation=%s takes no tokens"
            log.warning(words, parts["tokenizer"], parts["deformation"])
        parts["tokenizer"] = "none"
    log.info("model: %s", ", ".join([name, *(f"{key} {part}" for key, part in parts.items())]))
    began, places = time.monotonic(), links.query[links.split.known].place_keys.unique()
    # Shares of the run's limit at which parts end: the search 0.3, the training 0.5, kriging and
    # intervals 0.8.
    with stages.stage(until=0.3 if model.is_trained else 0.8):
        model.fit(links)
        if stages.is_up():
            stages.leave_out(f"the time for the fit of {name} was up")
    if model.is_trained and model.known_places is not None:  # a training before this one
        places = torch.cat((places, model.known_places)).unique()
    model.known_places = places
    searched, start = time.monotonic() - began, count_gaussians(model)
    if not model.is_trained:
        with stages.stage(until=0.8):
            model.calibration = calibrated(model, links)
        if is_first() and model.state_dict():
            checkpoint.save(model, folder / "best.ckpt")
        return Fitted({name: model}, {}, start)
    with stages.stage(until=0.5 / config["ensemble"]):
        model, seconds = descend(model, loss, links, config, folder, searched)
    if not is_first():
        return None
    best, trained = folder / "best.ckpt", ""
    if config["ensemble"] > 1:
        model, more = with_others(model, loss, links, config, folder)
        model.known_places = places
        kriged, seconds, trained = make_kriged(model), seconds + more, "members.0"
        checkpoint.update(best, model, trained)
    model.calibration = calibrated(model, links)
    if kriged is None:
        checkpoint.update(best, model)
        return Fitted({name: model}, {name: model}, start, seconds)
    began = time.monotonic()
    with stages.stage(until=0.8):
        validation_model = kriged.to(model.device).krige(links)
        kriging_seconds = time.monotonic() - began
        if stages.is_up():
            stages.leave_out("the fit of kriging ended early")
        kriged.calibration, kriged.known_places = calibrated(validation_model, links), places
    checkpoint.update(best, kriged, ".".join(filter(None, ("trend", trained))))
    models, unseen = ({name: own, f"{name}_trend": model} for own in (kriged, validation_model))
    return Fitted(models, unseen, start, seconds, kriging_seconds)


def with_others(
    model: Model, loss: Loss, links: Links, config: dict, folder: Path
) -> tuple[Ensemble, float]:
    """An ensemble of a trained model and of others with the next seeds, each trained in a folder of
    its own.
    """
    members, total = [model], 0.0
    for number in range(1, config["ensemble"]):
        place, seed = folder / "members" / str(number), config["seed"] + number
        place.mkdir(parents=True, exist_ok=True)
        lightning.seed_everything(seed, verbose=False)
        other = registry("model").build(config["model"], scene=links.scene)
        with stages.stage(until=0.5 * (number + 1) / config["ensemble"]):
            began = time.monotonic()
            other.fit(links)
            searched = time.monotonic() - began
            other, seconds = descend(other, loss, links, config | {"seed": seed}, place, searched)
        members.append(other)
        total += seconds
    ensemble = Ensemble(links.scene, members).eval().to(model.device)
    ensemble.fit(links)
    return ensemble, total


def descend(
    model: Model, loss: Loss, links: Links, config: dict, folder: Path, searched: float
) -> tuple[Model, float]:
    """Trains a model by gradient descent, which ``Model.fit`` has prepared in ``searched`` [s].

    Returns:
        The model at the step with the best validation score, or at the last step without validation
        links; and the duration of both [s], summed over the parts of an interrupted run.
    """
    split = {"name": links.split.name, **links.split.parts()}
    identity = {
        "version": checkpoint.VERSION,
        "model": config["model"],
        "scene": links.scene.state(),
        "split": split,
    }
    identity |= {
        "config": config,
        "links": fingerprint(links),
        "plugins": digests(config, links.scene.state()["task"]),
    }
    context = {"model": model, "loss": loss, "identity": identity, "seed": config["seed"]}
    module = registry("training").build(config["training"], **context)
    last, best = folder / "last.ckpt", folder / "best.ckpt"
    keep_last = KeepLast(last, config["save_every"])
    options, budget = make_budget(config["trainer"], searched)
    callbacks = [
        budget,
        KeepBest(best, module.patience),
        keep_last,
    ]  # Lightning calls the last two after all others
    if module.density is not None:
        callbacks.append(call("density", DensityControl, module.density, seed=config["seed"]))
    if model.revisions:
        callbacks.append(Revision(links, config["seed"]))
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(ProgressLine())
    loggers: list[Logger] = [CSVLogger(folder, "log")]
    if config["tensorboard"]:
        try:
            loggers.append(TensorBoardLogger(folder, "tensorboard"))
        except ModuleNotFoundError as error:
            raise ImportError(
                "tensorboard=true needs TensorBoard: pip install 'gaigs[tensorboard]'"
            ) from error
    context = {"callbacks": callbacks, "logger": loggers, "default_root_dir": folder}
    trainer = make_trainer(options, **context)
    if config["ensemble"] > 1 and trainer.world_size > 1:
        raise ValueError(
            "an ensemble trains in one process; set trainer.devices=1 and trainer.num_nodes=1"
        )
    if math.isfinite(stages.left()) and trainer.world_size > 1:
        raise ValueError("max_time limits a run of one process; of several set trainer.max_time")
    steps = ENDLESS if trainer.max_steps == -1 else trainer.max_steps
    batches = Batches(links, links.split.train, module.batch_size, config["seed"], steps)
    validation = (
        InOrder(links, links.split.validation, module.batch_size)
        if len(links.split.validation)
        else None
    )
    resume = None
    if last.is_file():
        resume = last
        content = resumable(last, best)
        check_same_links(content[checkpoint.KEY], identity, last)
        log.info("going on after step %d", content["global_step"])
        stages.current().began -= content["callbacks"][budget.state_key]["seconds"]
    # Lightning converts after it has loaded a checkpoint, which would round the weights: so convert
    # first.
    module = trainer.precision_plugin.convert_module(module)
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    module.train()  # a model that has been trained or loaded is in evaluation mode
    try:
        with warnings.catch_warnings():
            # Warnings about Lightning's use of torch, splits without validation links, and few
            # steps.
            for message in (
                ".*LeafSpec",
                "You defined a `validation_step` but",
                "The number of training batches",
            ):
                warnings.filterwarnings("ignore", message)
            trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
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
    if keep_last.received is not None:  # after the last step
        raise Stopped(f"stopped after step {trainer.global_step}", keep_last.received)
    seconds, steps, size = budget.seconds - budget.searched, trainer.global_step, module.batch_size
    log.info(
        "trained %d steps of %d places in %.0f s: %.1f steps/s",
        steps,
        size,
        seconds,
        steps / seconds,
    )
    if budget.seconds >= budget.end and steps < trainer.max_steps:
        stages.leave_out(f"the training ended after {steps} of {trainer.max_steps} steps")
    module.load_state_dict(checkpoint.trained_weights(checkpoint.read(best)))
    return model.eval().to(trainer.strategy.root_device), budget.seconds


def resumable(last: Path, best: Path) -> dict:
    """The checkpoint to resume from; a ValueError if it or the best one is damaged."""
    needed = (
        "optimizer_states",
        "lr_schedulers",
        "loops",
        "callbacks",
        "epoch",
        "global_step",
        "split",
        "links",
    )
    try:
        content = checkpoint.read(last)
        if lacking := [key for key in needed if key not in content | content[checkpoint.KEY]]:
            raise ValueError(f"{last} lacks {', '.join(lacking)} of a training")
        if best.is_file():
            checkpoint.read(best)
    except ValueError as error:
        raise ValueError(
            f"cannot resume the training: {str(error).partition(chr(10))[0]}\n"
            f"move {last} elsewhere to train again, which overwrites best.ckpt, or {ANOTHER}"
        ) from error
    return content


def make_trainer(options: dict, **context: Any) -> lightning.Trainer:
    """A trainer that can stop and resume at any step, in one process or several; a ``ValueError``
    for other options.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):  # their messages list unused devices
        logging.getLogger(name).setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "GPU available but not used"
        )  # advice against an option that was chosen
        trainer = call("trainer", lightning.Trainer, options, **context)
    # The first two set the limits of batches: 1 is one batch, 1.0 is all batches.
    usual = {"fast_dev_run": False, "overfit_batches": 0.0, "accumulate_grad_batches": 1}
    for name, value in (usual | {"limit_train_batches": 1.0, "limit_val_batches": 1.0}).items():
        found = getattr(trainer, name)
        if (type(found), found) != (type(value), value):
            raise ValueError(
                f"trainer.{name} must be left out\n"
                "set trainer.max_steps to end a training early, training.batch_size for larger batches"
            )
    strategy = trainer.strategy
    launcher = strategy.launcher
    starts_scripts = launcher is None or "Subprocess" in type(launcher).__name__
    if not isinstance(strategy, DDPStrategy | SingleDeviceStrategy) or not starts_scripts:
        raise ValueError(
            f"trainer.strategy must be auto for one process or ddp for several, got {type(strategy).__name__}"
        )
    return trainer


def check_processes(options: dict, launcher: str) -> None:
    """Raises a ``ValueError`` if a job of a multirun would train in several processes.

    Args:
        options: Of the trainer.
        launcher: Class name of Hydra's launcher. That of SLURM starts the processes of each job;
            with others they would start the next job at different times.
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


def count_gaussians(model: Model) -> int:
    """The number of Gaussians of a model; 0 for another kind of model."""
    return 0 if model.primitives is None else len(model.primitives)
