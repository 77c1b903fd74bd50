"""Fit, gradient descent, kriging and calibration of one model."""

import logging
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from torch import Tensor

from gaigs.core import stages
from gaigs.core.query import drawn
from gaigs.data import Links
from gaigs.kriging.links import check_known
from gaigs.model import Model, checkpoint
from gaigs.model.answers import calibrated
from gaigs.model.ensemble import Ensemble
from gaigs.model.kriging import Kriging
from gaigs.processes import is_first
from gaigs.registry import registry
from gaigs.runs.descent import descend
from gaigs.splatting.loss import Loss
from gaigs.training.checkpoints import KeepBest

log = logging.getLogger(__name__)


class Fitted(NamedTuple):
    """Models of a run after their training, with durations; the result of ``fit``."""

    # The model by its name; a kriged one is followed by the trained model alone, ``<name>_trend``.
    models: dict[str, Model]
    # The same models, not fitted to validation links; empty for a model without a training.
    unseen: dict[str, Model]
    start: int  # number of Gaussians before the training
    # Duration of ``Model.fit`` and of the training [s]; None without a training.
    seconds: float | None = None
    kriging_seconds: float | None = None  # duration of kriging; None without it
    facts: Mapping[str, Any] = {}  # entries of ``metrics.json`` beside the model's own


class Start(NamedTuple):
    """The better of a model's trainings from two starts."""

    model: Model
    config: dict  # configuration of the run with this start
    seconds: float  # duration of the second training


def fit(model: Model | None, loss: Loss, links: Links, config: dict, folder: Path) -> Fitted | None:
    """Builds, fits, trains and kriges a model as configured; None in further processes."""
    name = config["model"]["name"]
    is_given = model is not None
    model = _checked(model, links, config)
    kriged = _untrained_kriging(model, links, config)
    _log_parts(model, config["model"])
    # Parts end at fractions of the run's time limit: the search 0.3, the training 0.5, kriging and
    # intervals 0.8.
    searched, places = _prepare(model, links, name, until=0.3 if model.is_trained else 0.8)
    if is_given:
        model.second_start = {}  # a given model is trained in place, a second start is not
    start = count_gaussians(model)
    best = folder / "best.ckpt"
    if not model.is_trained:
        with stages.stage(until=0.8):
            model.calibration = calibrated(model, links)
        if is_first() and model.state_dict():
            checkpoint.save(model, best)
        return Fitted({name: model}, {}, start)
    # Kriging falls back on a simple law of levels where the trained model is worse. A training ends
    # early if its score stays two standard errors below the law's.
    rival = None
    validation = drawn(links.split.validation)
    if kriged is not None and model.settles and len(validation) > 1:
        with stages.timed("kriging"):
            # Cleaned as for kriging, which then needs no other law.
            scores = kriged.law_scores(kriged.posterior.cleaned(links), validation)
        # Two standard errors below its mean: kriging leaves out a room that is surely worse.
        rival = (scores.mean() - 2 * scores.std() / len(validation) ** 0.5).item()
    with stages.stage(until=0.5 / config["ensemble"]), stages.timed("training"):
        model, seconds = descend(model, loss, links, config, folder, searched, rival)
    if not is_first():
        return None
    model, config, second_seconds = _try_second_start(model, loss, links, config, folder)
    seconds += second_seconds
    if kriged is not None:
        kriged = _untrained_kriging(model, links, config, kriged)
    member = None  # submodel whose weights the checkpoint already has; None: the model itself
    if config["ensemble"] > 1:
        model, member_seconds = _add_members(model, loss, links, config, folder)
        seconds += member_seconds
        model.known_places = places
        kriged = _untrained_kriging(model, links, config, kriged)
        member = "members.0"
        checkpoint.update(best, model, member)
    model.calibration = calibrated(model, links)
    if kriged is None:
        checkpoint.update(best, model)
        return Fitted({name: model}, {name: model}, start, seconds)
    began = time.monotonic()
    with stages.stage(until=0.8), stages.timed("kriging"):
        validation_model = kriged.to(model.device).krige(links)
        kriging_seconds = time.monotonic() - began
        if stages.is_up():
            stages.leave_out("the fit of kriging ended early")
        kriged.calibration = calibrated(validation_model, links)
        kriged.known_places = places
    checkpoint.update(best, kriged, "trend" if member is None else f"trend.{member}")
    trend = {f"{name}_trend": model}
    models = {name: kriged} | trend
    return Fitted(models, {name: validation_model} | trend, start, seconds, kriging_seconds)


def _checked(model: Model | None, links: Links, config: dict) -> Model:
    """The model, built if it is None; a ``ValueError`` if it cannot be trained on these links."""
    if config["ensemble"] < 1:
        raise ValueError(f"ensemble must be at least 1 model, got {config['ensemble']}")
    if model is None:
        model = registry("model").build(config["model"], scene=links.scene)
    if isinstance(model, Kriging):
        raise ValueError(
            "model=kriging has no training of its own; choose a trained model, and set kriging=true"
        )
    if links.split.by_receivers and not model.any_receiver:
        raise ValueError(
            f"model {config['model']['name']!r} predicts for receivers with links alone\n"
            "take another split, or mirrored, gaigs, friis, path_loss, mean or gaussian_process"
        )
    if config["kriging"]:
        check_known(links)  # a training comes before
    return model


def _untrained_kriging(
    trend: Model, links: Links, config: dict, before: Kriging | None = None
) -> Kriging | None:
    """The kriging of a model's residuals, not yet fitted; None if it is not configured.

    It keeps the law of distance that the kriging ``before`` has fitted.
    """
    if not config["kriging"]:
        return None
    kriged = Kriging(links.scene, trend, config["kriging_fallback"])
    kriged.laws = None if before is None else before.laws
    return kriged


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
    """Calls ``Model.fit``, for parts that need no gradient, such as a search for planes.

    Returns:
        The duration [s], and the keys of all places that the model has learnt from.
    """
    began = time.monotonic()
    places = links.query[links.split.known].place_keys.unique()
    with stages.stage(until=until), stages.timed("fit"):
        model.fit(links)
        if stages.is_up():
            stages.leave_out(f"the time for the fit of {name} was up")
    if model.is_trained and model.known_places is not None:  # a training before this one
        places = torch.cat((places, model.known_places)).unique()
    model.known_places = places
    return time.monotonic() - began, places


def _try_second_start(model: Model, loss: Loss, links: Links, config: dict, folder: Path) -> Start:
    """The trained model, or one trained from its second start if that has a better validation.

    The options ``model.second_start`` configure the second start. The winner's checkpoint becomes
    ``best.ckpt``. With ``trainer.max_time`` there is no second start, since that limit is for a
    single training.
    """
    first = Start(model, config, 0.0)
    is_limited = config["trainer"].get("max_time") is not None
    if is_limited or not model.second_start or not len(links.split.validation):
        return first
    second = config | {"model": config["model"] | model.second_start}
    place = folder / "second_start"
    place.mkdir(exist_ok=True)
    lightning.seed_everything(config["seed"], verbose=False)
    with stages.stage(until=0.5 / config["ensemble"]), stages.timed("second start"):
        if stages.is_up():
            stages.leave_out("the training from a second start")
            return first
        other = registry("model").build(second["model"], scene=links.scene)
        other.fit(links)
        other, seconds = descend(other, loss, links, second, place, searched=0.0)
    other.known_places = model.known_places
    content = checkpoint.read(place / "best.ckpt")
    scores = []
    # last.ckpt has the first start's score: after a resume best.ckpt may be of the second start.
    for trained in (checkpoint.read(folder / "last.ckpt"), content):
        scores.append(trained["callbacks"][KeepBest.__name__]["best"])
    log.info("validation: %.4f from the first start, %.4f from %s", *scores, model.second_start)
    if scores[1] <= scores[0]:
        return first._replace(seconds=seconds)
    checkpoint.write(content, folder / "best.ckpt")
    # Figures draw the curves of the latest log.
    for version in (place / "log").iterdir():
        target = folder / "log" / f"second_start_{version.name}"
        shutil.copytree(version, target, dirs_exist_ok=True)
    return Start(other, second, seconds)


def _add_members(
    model: Model, loss: Loss, links: Links, config: dict, folder: Path
) -> tuple[Ensemble, float]:
    """An ensemble of a trained model and of models that are trained here with the next seeds.

    Returns:
        The ensemble, and the duration of the trainings here [s].
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
