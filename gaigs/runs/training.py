"""Training of a model on links: fit, gradient descent, kriging."""

import contextlib
import copy
import logging
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import lightning
import torch
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from gaigs.configuration import composed, preset
from gaigs.core import stages
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.kriging.links import check_known
from gaigs.model import Model, checkpoint
from gaigs.model.answers import calibrated
from gaigs.model.ensemble import Ensemble
from gaigs.model.kriging import Kriging
from gaigs.processes import is_first, limited_threads, only_run
from gaigs.registry import configuration_of, registry
from gaigs.runs.descent import descend
from gaigs.runs.folder import claim
from gaigs.splatting.loss import Loss
from gaigs.training.budget import watched

log = logging.getLogger(__name__)


def train(
    model: str | Model,
    links: Links,
    /,
    *overrides: str,
    folder: str | Path | None = None,
    progress: bool = True,
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
        progress: False for no bars, as ``enable_progress_bar=False``.
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
        >>> model.predict([[1.0, 2.0, 1.5], [2.5, 1.0, 0.8]]).shape
        torch.Size([2, 1, 90, 360])
    """
    if not isinstance(model, str | Model) or not isinstance(links, Links):
        raise TypeError(
            f"train takes a model and links, got {type(model).__name__} and {type(links).__name__}"
        )
    if not progress:
        options["enable_progress_bar"] = False
    made = _made(model)
    check_fit(links, None if made is None else made.scene)
    parts = {key: option for key, option in options.items() if hasattr(option, "configuration")}
    config = _configuration(model, made, links, overrides, options)
    with contextlib.ExitStack() as stack:
        stack.enter_context(limited_threads(config["threads"]))
        stack.enter_context(isolate_rng())
        if folder is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        stack.enter_context(only_run(place))
        claim(place, config)
        stack.enter_context(watched(config))
        lightning.seed_everything(config["seed"], verbose=False)
        loss = registry("loss").build(parts.pop("loss", config["loss"]), task=links.task)
        if parts:
            made = registry("model").build(config["model"] | parts, scene=links.scene)
        return fit(made, loss, links, config, place).models[config["model"]["name"]].eval().cpu()


def _made(model: str | Model) -> Model | None:
    """The model that is to be trained further; None for a name."""
    if isinstance(model, str):
        return None
    made = copy.deepcopy(model.trend) if isinstance(model, Kriging) else model
    if isinstance(made, Ensemble):
        members = "members" if made is model else "trend.members"
        raise ValueError(
            f"an ensemble cannot be trained further; train one of its models, {members}[0]"
        )
    return made


def _configuration(
    model: str | Model, made: Model | None, links: Links, overrides: Sequence[str], options: dict
) -> dict:
    """The configuration of a training on links that exist, of a model that may exist.

    Raises:
        ValueError: Overrides or options are of what exists.
    """
    name = model if made is None else configuration_of(made)["name"]
    if experiments := [word for word in overrides if word.startswith("+experiment=")]:
        raise ValueError(
            f"leave out {experiments[0]}: train takes the experiment of the model and the task"
        )
    words = preset(name, links.task.name)
    config = composed([*words, *overrides], options)
    if overrides or options:
        usual = composed(words, {})
        if config["data"] != usual["data"] or config["split"] != usual["split"]:
            raise ValueError("train takes no options of data and split; pass them to gaigs.links")
        made_here = {key for key, option in options.items() if hasattr(option, "configuration")}
        if made is not None and (config["model"] != usual["model"] or made_here - {"loss"}):
            raise ValueError(
                "train takes no options of a model that is made already; "
                "pass them to its constructor"
            )
    config |= {"data": {"name": "arrays"}, "split": {"name": links.split.name}, **links.origin}
    if made is not None:
        config["model"] = configuration_of(made)
    return config


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
    """Builds, fits, trains and kriges a model as configured.

    The result is None in all but the first of several processes.
    """
    name = config["model"]["name"]
    model = _checked(model, links, config)
    kriged = _untrained_kriging(model, links, config)
    _log_parts(model, config["model"])
    # Shares of the run's limit at which parts end: the search 0.3, the training 0.5, kriging and
    # intervals 0.8.
    searched, places = _prepare(model, links, name, until=0.3 if model.is_trained else 0.8)
    start = count_gaussians(model)
    best = folder / "best.ckpt"
    if not model.is_trained:
        with stages.stage(until=0.8):
            model.calibration = calibrated(model, links)
        if is_first() and model.state_dict():
            checkpoint.save(model, best)
        return Fitted({name: model}, {}, start)
    with stages.stage(until=0.5 / config["ensemble"]):
        model, seconds = descend(model, loss, links, config, folder, searched)
    if not is_first():
        return None
    trained = None
    if config["ensemble"] > 1:
        model, more = _add_members(model, loss, links, config, folder)
        seconds += more
        model.known_places = places
        kriged = _untrained_kriging(model, links, config)
        trained = "members.0"  # where the weights of the checkpoint belong
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
        kriged.calibration = calibrated(validation_model, links)
        kriged.known_places = places
    checkpoint.update(best, kriged, "trend" if trained is None else f"trend.{trained}")
    trend = {f"{name}_trend": model}
    models = {name: kriged} | trend
    return Fitted(models, {name: validation_model} | trend, start, seconds, kriging_seconds)


def _checked(model: Model | None, links: Links, config: dict) -> Model:
    """The model, built if there is none; a ``ValueError`` if the configuration cannot train it."""
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
    return model


def _untrained_kriging(trend: Model, links: Links, config: dict) -> Kriging | None:
    """Kriging of what a model leaves over, if it is configured."""
    return Kriging(links.scene, trend, config["kriging_fallback"]) if config["kriging"] else None


def _log_parts(model: Model, config: dict) -> None:
    """Logs the names of a model and its parts; warns of a tokenizer that no part reads."""
    parts = {}
    for key, part in config.items():
        if isinstance(part, dict) and "name" in part:
            parts[key] = part["name"]
    tokenizer = parts.get("tokenizer")
    if tokenizer is not None and getattr(model, "tokenizer", model) is None:
        if tokenizer != registry("model").options(config["name"]).get("tokenizer", tokenizer):
            words = "tokenizer=%s is not read, as deformation=%s takes no tokens"
            log.warning(words, tokenizer, parts["deformation"])
        parts["tokenizer"] = "none"
    names = [f"{key} {part}" for key, part in parts.items()]
    log.info("model: %s", ", ".join([config["name"], *names]))


def _prepare(model: Model, links: Links, name: str, until: float) -> tuple[float, Tensor]:
    """Fits what needs no gradient, as a search for planes does.

    Returns:
        The duration [s], and the keys of all places that the model has learnt from.
    """
    began = time.monotonic()
    places = links.query[links.split.known].place_keys.unique()
    with stages.stage(until=until):
        model.fit(links)
        if stages.is_up():
            stages.leave_out(f"the time for the fit of {name} was up")
    if model.is_trained and model.known_places is not None:  # a training before this one
        places = torch.cat((places, model.known_places)).unique()
    model.known_places = places
    return time.monotonic() - began, places


def _add_members(
    model: Model, loss: Loss, links: Links, config: dict, folder: Path
) -> tuple[Ensemble, float]:
    """An ensemble of a trained model and of others with the next seeds, each trained in a folder of
    its own; and the time of the others [s].
    """
    members = [model]
    total = 0.0
    for number in range(1, config["ensemble"]):
        place = folder / "members" / str(number)
        place.mkdir(parents=True, exist_ok=True)
        seeded = config | {"seed": config["seed"] + number}
        lightning.seed_everything(seeded["seed"], verbose=False)
        other = registry("model").build(config["model"], scene=links.scene)
        with stages.stage(until=0.5 * (number + 1) / config["ensemble"]):
            began = time.monotonic()
            other.fit(links)
            searched = time.monotonic() - began
            other, seconds = descend(other, loss, links, seeded, place, searched)
        members.append(other)
        total += seconds
    ensemble = Ensemble(links.scene, members).eval().to(model.device)
    ensemble.fit(links)
    return ensemble, total


def count_gaussians(model: Model) -> int:
    """The number of Gaussians of a model; 0 for another kind of model."""
    return 0 if model.primitives is None else len(model.primitives)
