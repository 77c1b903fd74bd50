"""The choice of a model by validation links: ``model=auto``."""

import logging
import math
import shutil
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from jaxtyping import Int
from omegaconf import OmegaConf
from torch import Tensor

from gaigs.configuration import composed, differences, preset
from gaigs.core import stages
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.kriging.links import folds_of
from gaigs.model import Model, checkpoint
from gaigs.model.answers import calibrated, predicted
from gaigs.model.ensemble import Ensemble
from gaigs.processes import limited_threads
from gaigs.registry import call, registry
from gaigs.runs.fitting import Fitted, count_gaussians, fit
from gaigs.runs.folder import claim
from gaigs.runs.stacking import stack
from gaigs.training.budget import seconds

log = logging.getLogger(__name__)

NAME = "auto"
"""The name of the choice in place of a model's: ``model=auto``."""


class Tried(NamedTuple):
    """A candidate and its scores at places outside its training."""

    label: str  # its name and options
    config: dict  # configuration of a run with it
    folder: Path  # folder of this run
    # Mean score of the links at each place or in each fold, higher ones better, by its key.
    gains: dict[int, float]
    seconds: float  # duration of fits, training and scores
    asked: Tensor | None = None  # links that it has not learnt from (k,)
    values: Tensor | None = None  # their predictions (k, *shape)
    unseen: Model | None = None  # model without validation links, as it scores at these
    # Result of the training; None for a look-up, which is fitted once it is chosen.
    fitted: Fitted | None = None
    # Members of a blend and their shares; empty for a single model.
    members: "tuple[Tried, ...]" = ()
    weights: tuple[float, ...] = ()


class ChosenModel(NamedTuple):
    """The chosen candidate, and a sentence with the reason."""

    chosen: Tried
    reason: str
    level: Sequence[Tried] = ()  # candidates that no other surely leads


def choose(links: Links, config: dict, folder: Path) -> Fitted:
    """Trains candidates, and returns the simplest one that no other clearly beats, or a blend.

    A blend is a weighted mean of the candidates that no other clearly beats. Look-ups are compared
    at all known places by cross-validation. The best look-up is then compared with trained
    candidates at the validation places. Each candidate is a run in ``candidates/<number>``; an
    interrupted choice resumes these runs. The folder gets checkpoint and log of the chosen
    candidate, and results are named ``auto``.

    Args:
        links: Links with validation links.
        config: Configuration of a run with ``model=auto``.
        folder: The run folder.

    Raises:
        ValueError: There are no validation links or candidates, a candidate does not fit the task,
            or only some candidates have an option.
    """
    if not len(links.split.validation):
        raise ValueError(
            "model=auto chooses by validation links, and the split has none\n"
            "set split.validation=0.1, or choose a model, such as model=gaussian_process"
        )
    began = time.monotonic()
    options = {key: value for key, value in config["model"].items() if key != "name"}
    configs, limit = call("model", _options, options, config=config, links=links)
    # A run with a limit of its own needs the rest for scores and figures.
    end = began + min(limit, 0.8 * stages.left())
    looked = _try_each(look_up, configs, links, folder, end)
    contenders = []
    reasons = []
    if looked:
        best = settle(looked, links)
        reasons = [f"of look-ups {best.reason}"] if len(looked) > 1 else []
        contenders = [_validated(best.chosen, links)]
    trained = _try_each(train_candidate, configs, links, folder, end)
    if not looked and not trained:
        raise ValueError("model=auto has no candidate left; the lines above say why")
    choice = settle([*contenders, *trained], links)
    reason = "; ".join([choice.reason, *reasons] if trained else reasons or [choice.reason])
    log.info("auto: %s", reason)
    # In Python nothing shows the log, unless the caller has set it up.
    if stages.current().shown and not log.isEnabledFor(logging.INFO):
        print(f"auto: {reason}")
    facts = _facts([*looked, *trained], choice.chosen, reason, links.task)
    return _finish(choice.chosen, links, folder, time.monotonic() - began)._replace(facts=facts)


def _try_each(
    work: Callable[[str, dict, Links, Path], Tried],
    configs: Mapping[str, dict],
    links: Links,
    folder: Path,
    end: float,
) -> list[Tried]:
    """Tries either the look-ups or the trained candidates, in their order, until the time is up.

    ``work`` is ``look_up`` for candidates without a training, otherwise ``train_candidate``. No
    candidate starts after ``end``, a reading of ``time.monotonic`` [s]; the first look-up is always
    tried.
    """
    tried: list[Tried] = []
    shown = stages.current().shown
    for number, (label, config) in enumerate(configs.items()):
        lightning.seed_everything(config["seed"], verbose=False)
        is_trained = registry("model").build(config["model"], scene=links.scene).is_trained
        if is_trained != (work is train_candidate):
            continue
        left = end - time.monotonic()
        if left <= 0 and (tried or is_trained):
            stages.leave_out(f"model=auto has not tried {label}")
            continue
        # The first are the cheapest, and leave time to the others.
        share = left / (len(configs) - number)
        place = folder / "candidates" / str(number)
        if is_trained:
            place.mkdir(parents=True, exist_ok=True)
            claim(place, config)
        with stages.watched(max(1.0, share), shown), limited_threads(config["threads"]):
            try:
                tried.append(work(label, config, links, place))
            # Such as of a training that diverges, or of memory.
            except (ValueError, RuntimeError) as error:
                log.warning("auto: %s is left out: %s", label, error)
    return tried


def _options(
    candidates: list, max_time: str | dict, config: dict, links: Links
) -> tuple[dict[str, dict], float]:
    """Configurations of the candidates by label, and the time limit [s]."""
    configs: dict[str, dict] = {}
    usual = composed(preset(NAME, links.task.name), {})
    changes = differences(usual, config)
    for candidate in candidates:
        options = {"name": candidate} if isinstance(candidate, str) else candidate
        if not isinstance(options, Mapping) or options.get("name") in (None, NAME):
            raise ValueError(
                f"model.candidates must be names or configurations of models, got {candidate!r}"
            )
        others = {key: value for key, value in options.items() if key != "name"}
        label = ", ".join([options["name"], *(f"{key}={others[key]}" for key in others)])
        made = composed(
            preset(options["name"], links.task.name), {"model": others} if others else {}
        )
        configs[label] = _with_changes(made, config, changes)
    if not configs:
        raise ValueError("model.candidates must have a model or more, got none")
    # A candidate that does not fit the task ends the choice before the first training.
    for made in configs.values():
        registry("model").build(made["model"], scene=links.scene)
    return configs, seconds("model.max_time", max_time)


def _with_changes(made: dict, config: dict, changes: Mapping[str, tuple]) -> dict:
    """The configuration of a candidate, with the changes of the ``model=auto`` run."""
    shared = ("loss", "training", "trainer", "ensemble", "seed")  # of all that are trained
    kept = ("data", "split", "save_every", "tensorboard", "figures")
    made |= {key: config[key] for key in kept} | {"threads": config["threads"] or made["threads"]}
    shows = config["trainer"].get("enable_progress_bar", True)
    made["trainer"]["enable_progress_bar"] = shows
    ours, theirs = OmegaConf.create(made), OmegaConf.create(config)
    for key in changes:
        part, _, rest = key.partition(".")
        if part in shared:
            # A changed component replaces the whole part, with all its options.
            path = part if rest == "name" else key
            OmegaConf.update(ours, path, OmegaConf.select(theirs, path), force_add=True)
        elif part not in (*kept, "model", "baselines", "max_time"):
            raise ValueError(
                f"{key} is an option of some models, and model=auto tries several\n"
                "choose one, such as model=mirrored, or leave the option out"
            )
    plain: Any = OmegaConf.to_container(ours)
    return plain


def look_up(label: str, config: dict, links: Links, folder: Path) -> Tried:
    """A look-up with its scores at known places; each place is predicted without its fold."""
    began = time.monotonic()
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    asked = []
    values = []
    for unseen in model.unseen(links):
        asked.append(unseen.asked)
        values.append(predicted(unseen.model, links, unseen.asked))
    if not asked:
        raise ValueError(f"its fit took {time.monotonic() - began:.0f} s; raise model.max_time")
    one = Tried(label, config, folder, {}, time.monotonic() - began)
    return _scored(one, links, torch.cat(asked), torch.cat(values))


def train_candidate(label: str, config: dict, links: Links, folder: Path) -> Tried:
    """A trained candidate with its scores at the validation places."""
    began = time.monotonic()
    fitted = _fit(config, links, folder)
    unseen = fitted.unseen[config["model"]["name"]]
    asked = links.split.validation
    values = predicted(unseen, links, asked)
    spent = time.monotonic() - began
    one = Tried(label, config, folder, {}, spent, unseen=unseen, fitted=fitted)
    return _scored(one, links, asked, values)


def _validated(look_up: Tried, links: Links) -> Tried:
    """A look-up, or a blend of look-ups, with its scores at the validation places."""
    asked = links.split.validation
    if look_up.members:
        members = tuple(_validated(member, links) for member in look_up.members)
        values = _mean([one.values for one in members], look_up.weights)
        return _scored(look_up._replace(members=members), links, asked, values)
    model = registry("model").build(look_up.config["model"], scene=links.scene)
    model.fit(replace(links, split=links.split.validating()))
    values = predicted(model, links, asked)
    return _scored(look_up._replace(unseen=model), links, asked, values)


def _scored(
    one: Tried,
    links: Links,
    asked: Int[Tensor, " k"],
    values: Tensor,
    groups: Int[Tensor, " k"] | None = None,
) -> Tried:
    """A candidate with predictions and its mean score of each group, by default of each place.

    Errors within a group are correlated.
    """
    task = links.task
    scores = task.scores(_labels(links, asked), values)[task.monitor].double()
    named = links.query[asked].place_keys if groups is None else groups
    keys, which = named.unique(return_inverse=True)
    sums = scores.new_zeros(len(keys)).index_add(0, which, scores)
    means = sums / which.bincount()  # (g,)
    if not task.higher_is_better:
        means = -means
    gains = dict(zip(keys.tolist(), means.tolist(), strict=True))
    return one._replace(gains=gains, asked=asked, values=values)


def _labels(links: Links, index: Int[Tensor, " k"]) -> Tensor:
    return torch.cat([links.labels[part] for part in index.split(64)])


def settle(tried: Sequence[Tried], links: Links) -> ChosenModel:
    """The chosen candidate, or a blend of the candidates that no other clearly beats.

    The score of a blend at a place uses weights fitted without the place's fold. A blend is chosen
    unless a candidate clearly beats it, since the error of a mean is at most the mean of the
    errors. Complex channels of unknown phase are not blended.
    """
    choice = pick(tried, links.task)
    level = choice.level
    if len(level) < 2 or links.task.phase != "known":
        return choice
    asked: Any = level[0].asked
    for one in level:  # the time limit may have left out folds of some
        asked = asked[torch.isin(asked, one.asked)]
    values: Any = [one.values[torch.isin(one.asked, asked)] for one in level]  # type: ignore
    places = links.query[asked].place_keys
    folds = folds_of(links, asked)
    shares, crossed = stack(_labels(links, asked), values, places, folds)
    if shares.max() > 0.85:  # a second model is worth more than a tenth
        return choice
    blend = _blended(level, shares.tolist())
    # Links of a fold have the same shares and err together: folds are compared, not places.
    rivals = zip([blend, *level], [_mean(values, crossed), *values], strict=True)
    scored = [_scored(one, links, asked, some, folds) for one, some in rivals]
    judged = pick(scored, links.task, "folds")
    return judged._replace(chosen=blend) if judged.chosen.members else choice


def _blended(tried: Sequence[Tried], weights: Sequence[float]) -> Tried:
    """A blend of candidates by weights; a blend among them is replaced by its members."""
    members: dict[str, Tried] = {}
    shares: dict[str, float] = {}
    for weight, part in zip(weights, tried, strict=True):
        for share, one in zip(part.weights or (1.0,), part.members or (part,), strict=True):
            if weight * share > 0:
                members[one.label] = one
                shares[one.label] = weight * share
    label = " + ".join(f"{share:.2g} {name}" for name, share in shares.items())
    blend = tried[0]._replace(label=label, seconds=sum(one.seconds for one in tried))
    return blend._replace(members=tuple(members.values()), weights=tuple(shares.values()))


def _mean(values: Sequence[Any], shares: Sequence[float] | Tensor) -> Tensor:
    """Mean of predictions (k, *shape), weighted by (c,) or for each link (c, k)."""
    total: Any = 0.0
    for one, share in zip(values, torch.as_tensor(shares), strict=True):
        total = total + share.to(one.real).reshape(-1, *[1] * (one.ndim - 1)) * one
    return total


def pick(tried: Sequence[Tried], task: Task, unit: str = "places") -> ChosenModel:
    """The first candidate whose score no other one beats by more than a standard error.

    Candidates with scores that are not finite come last. Scores are compared place by place, since
    a hard place is hard for all. A candidate is compared with each other one, not only with the
    best: with few places the best mean often has the largest scatter.

    Source: Breiman, Friedman, Olshen and Stone, Classification and regression trees, 1984, section
    3.4.3, for the rule of one standard error; Hansen, Lunde and Nason, The model confidence set,
    2011, for the comparison of all pairs.
    """
    # The time limit may have left out folds of some.
    shared = set.intersection(*(set(one.gains) for one in tried))
    keys = sorted(shared)
    rows = [itemgetter(*keys)(one.gains) for one in tried]
    gains = torch.tensor(rows).reshape(len(tried), len(keys))  # (c, p)
    means = gains.mean(1)
    best = int(means.nan_to_num(-math.inf, -math.inf).argmax())
    leads = gains[:, None] - gains  # (c, c, p), of the first over the second
    # One place has no scatter: the best candidate is taken.
    scatter = leads.std(2) / len(shared) ** 0.5 if len(shared) > 1 else 0 * leads.mean(2)
    is_beaten = (leads.mean(2) > scatter).any(0) | ~means.isfinite()  # (c,)
    chosen = int(is_beaten.int().argmin())
    level = [one for one, beaten in zip(tried, is_beaten.tolist(), strict=True) if not beaten]
    signed = means if task.higher_is_better else -means
    texts = [f"{one.label} {mean:.3g}" for one, mean in zip(tried, signed.tolist(), strict=True)]
    scores = f"mean {task.monitor} over {len(shared)} {unit}: {', '.join(texts)}"
    if chosen == best:
        return ChosenModel(tried[best], f"{tried[best].label} is the best, {scores}", level)
    lead = f"{leads[best, chosen].mean():.2g}, standard error {scatter[best, chosen]:.2g}"
    reason = (
        f"{tried[chosen].label} is the first that none surely leads; {tried[best].label} is "
        f"ahead by {lead}, {scores}"
    )
    return ChosenModel(tried[chosen], reason, level)


def _facts(tried: Sequence[Tried], chosen: Tried, reason: str, task: Task) -> dict:
    """Entry of ``metrics.json`` on the choice."""
    candidates = {}
    for one in tried:
        score = statistics.fmean(one.gains.values()) * (1 if task.higher_is_better else -1)
        facts = {task.monitor: score, "places": len(one.gains), "seconds": one.seconds}
        candidates[one.label] = facts
    labels = [one.label for one in chosen.members or (chosen,)]
    weights = dict(zip(labels, chosen.weights or (1.0,), strict=True))
    about = {"chosen": chosen.label, "weights": weights, "reason": reason}
    return {NAME: about | {"candidates": candidates}}


def _fit(config: dict, links: Links, folder: Path) -> Fitted:
    """The result of a candidate's run, which may be resumed."""
    folder.mkdir(parents=True, exist_ok=True)
    lightning.seed_everything(config["seed"], verbose=False)
    loss = registry("loss").build(config["loss"], task=links.task)
    fitted = fit(None, loss, links, config, folder)
    assert fitted is not None  # a time limit is for one process
    return fitted


def _finish(chosen: Tried, links: Links, folder: Path, seconds: float) -> Fitted:
    """The result of the chosen candidate's run, or the blend of several candidates.

    The folder gets its checkpoint and log. A look-up is fitted to all known links.
    """
    parts = chosen.members or (chosen,)
    results = [one.fitted or _fit(one.config, links, one.folder) for one in parts]
    if chosen.members:
        names = [one.config["model"]["name"] for one in parts]
        members = [one.models[name] for one, name in zip(results, names, strict=True)]
        blend = Ensemble(links.scene, members, [*chosen.weights]).eval()
        unseen: Any = Ensemble(links.scene, [one.unseen for one in parts], blend.weights).eval()
        blend.known_places = links.query[links.split.known].place_keys.unique()
        blend.calibration = calibrated(unseen if blend.is_trained else blend, links)
        checkpoint.save(blend, folder / "best.ckpt")
        return Fitted({NAME: blend}, {NAME: unseen}, count_gaussians(blend), seconds)
    if (chosen.folder / "best.ckpt").is_file():
        shutil.copy(chosen.folder / "best.ckpt", folder / "best.ckpt")
    if (chosen.folder / "log").is_dir():
        shutil.copytree(chosen.folder / "log", folder / "log", dirs_exist_ok=True)
    name = chosen.config["model"]["name"]
    # The trend of a kriged model is named after the row, too.
    models = {NAME + key.removeprefix(name): model for key, model in results[0].models.items()}
    assert chosen.unseen is not None
    return results[0]._replace(models=models, unseen={NAME: chosen.unseen}, seconds=seconds)
