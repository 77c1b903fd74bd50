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
    # Mean score of the links of each place or fold, by the number of the place or fold. The sign is
    # such that higher is better.
    gains: dict[int, float]
    seconds: float  # duration of fits, training and scores
    asked: Tensor | None = None  # numbers of links that the candidate has not learnt from (k,)
    values: Tensor | None = None  # predictions of these links (k, *shape)
    unseen: Model | None = None  # the model fitted without validation links
    # Result of the training; None for a look-up, which is fitted once it is chosen.
    fitted: Fitted | None = None
    # Members of a blend and their shares; empty for a single model.
    members: "tuple[Tried, ...]" = ()
    weights: tuple[float, ...] = ()


class ChosenModel(NamedTuple):
    """The chosen candidate, and the reason as a sentence."""

    chosen: Tried
    reason: str
    level: Sequence[Tried] = ()  # candidates that no other clearly beats


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
    look_ups = _try_each(look_up, configs, links, folder, end)
    contenders = []  # the best look-up with scores at the validation places
    reasons = []
    if look_ups:
        best = settle(look_ups, links)
        reasons = [f"of look-ups {best.reason}"] if len(look_ups) > 1 else []
        contenders = [_validated(best.chosen, links)]
    trained = _try_each(train_candidate, configs, links, folder, end)
    if not look_ups and not trained:
        raise ValueError("model=auto has no candidate left; the lines above say why")
    choice = settle([*contenders, *trained], links)
    if trained:
        reasons = [choice.reason, *reasons]
    reason = "; ".join(reasons or [choice.reason])
    log.info("auto: %s", reason)
    # In Python nothing shows the log, unless the caller has set it up.
    if stages.current().shown and not log.isEnabledFor(logging.INFO):
        print(f"auto: {reason}")
    facts = _facts([*look_ups, *trained], choice.chosen, reason, links.task)
    return _finish(choice.chosen, links, folder, time.monotonic() - began)._replace(facts=facts)


def _try_each(
    work: Callable[[str, dict, Links, Path], Tried],
    configs: Mapping[str, dict],
    links: Links,
    folder: Path,
    end: float,
) -> list[Tried]:
    """Tries either the look-ups or the trained candidates, in their order, until the time is up.

    A candidate that fails is left out with a warning.

    Args:
        work: ``look_up`` for the candidates without a training, or ``train_candidate`` for others.
        configs: Configuration of each candidate by its label.
        end: Reading of ``time.monotonic`` [s] after which no candidate starts. The first look-up is
            always tried.
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
        # An equal share of the time that is left. The first candidates are the cheapest, and leave
        # time to the others.
        share = left / (len(configs) - number)
        candidate_folder = folder / "candidates" / str(number)
        if is_trained:
            candidate_folder.mkdir(parents=True, exist_ok=True)
            claim(candidate_folder, config)
        with stages.watched(max(1.0, share), shown), limited_threads(config["threads"]):
            try:
                tried.append(work(label, config, links, candidate_folder))
            # For example a training that diverges, or a lack of memory.
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
        changed = {key: value for key, value in options.items() if key != "name"}
        label = ", ".join([options["name"], *(f"{key}={value}" for key, value in changed.items())])
        words = preset(options["name"], links.task.name)
        made = composed(words, {"model": changed} if changed else {})
        configs[label] = _with_changes(made, config, changes)
    if not configs:
        raise ValueError("model.candidates must have a model or more, got none")
    # A candidate that does not fit the task ends the choice before the first training.
    for made in configs.values():
        registry("model").build(made["model"], scene=links.scene)
    return configs, seconds("model.max_time", max_time)


def _with_changes(made: dict, config: dict, changes: Mapping[str, tuple]) -> dict:
    """The preset ``made`` of a candidate with the options that the ``model=auto`` run has changed.

    ``changes`` are the keys in which the run's ``config`` differs from its own preset.
    """
    changeable = ("loss", "training", "trainer", "ensemble", "seed")  # all trained models have them
    copied = ("data", "split", "save_every", "tensorboard", "figures")
    made |= {key: config[key] for key in copied} | {"threads": config["threads"] or made["threads"]}
    shows = config["trainer"].get("enable_progress_bar", True)
    made["trainer"]["enable_progress_bar"] = shows
    candidate, run = OmegaConf.create(made), OmegaConf.create(config)
    for key in changes:
        part, _, option = key.partition(".")
        if part in changeable:
            # A changed component replaces the whole part, with all its options.
            path = part if option == "name" else key
            OmegaConf.update(candidate, path, OmegaConf.select(run, path), force_add=True)
        elif part not in (*copied, "model", "baselines", "max_time"):
            raise ValueError(
                f"{key} is an option of some models, and model=auto tries several\n"
                "choose one, such as model=mirrored, or leave the option out"
            )
    plain: Any = OmegaConf.to_container(candidate)
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
    spent = time.monotonic() - began
    if not asked:
        raise ValueError(f"its fit took {spent:.0f} s; raise model.max_time")
    candidate = Tried(label, config, folder, {}, spent)
    return _scored(candidate, links, torch.cat(asked), torch.cat(values))


def train_candidate(label: str, config: dict, links: Links, folder: Path) -> Tried:
    """A trained candidate with its scores at the validation places."""
    began = time.monotonic()
    fitted = _fit(config, links, folder)
    unseen = fitted.unseen[config["model"]["name"]]
    asked = links.split.validation
    values = predicted(unseen, links, asked)
    spent = time.monotonic() - began
    candidate = Tried(label, config, folder, {}, spent, unseen=unseen, fitted=fitted)
    return _scored(candidate, links, asked, values)


def _validated(look_up: Tried, links: Links) -> Tried:
    """A look-up, or a blend of look-ups, with its scores at the validation places."""
    asked = links.split.validation
    if look_up.members:
        members = tuple(_validated(member, links) for member in look_up.members)
        values = _mean([member.values for member in members], look_up.weights)
        return _scored(look_up._replace(members=members), links, asked, values)
    model = registry("model").build(look_up.config["model"], scene=links.scene)
    model.fit(replace(links, split=links.split.validating()))
    values = predicted(model, links, asked)
    return _scored(look_up._replace(unseen=model), links, asked, values)


def _scored(
    candidate: Tried,
    links: Links,
    asked: Int[Tensor, " k"],
    values: Tensor,
    groups: Int[Tensor, " k"] | None = None,
) -> Tried:
    """A candidate with its predictions and their mean score in each group (``Tried.gains``).

    ``values`` are the predictions (k, *shape) of the links ``asked``. Errors within a group, by
    default a place, are correlated.
    """
    task = links.task
    scores = task.scores(_labels(links, asked), values)[task.monitor].double()
    groups = links.query[asked].place_keys if groups is None else groups
    keys, group_of_link = groups.unique(return_inverse=True)
    sums = scores.new_zeros(len(keys)).index_add(0, group_of_link, scores)
    means = sums / group_of_link.bincount()  # (groups,)
    if not task.higher_is_better:
        means = -means
    gains = dict(zip(keys.tolist(), means.tolist(), strict=True))
    return candidate._replace(gains=gains, asked=asked, values=values)


def _labels(links: Links, index: Int[Tensor, " k"]) -> Tensor:
    return torch.cat([links.labels[block] for block in index.split(64)])


def settle(tried: Sequence[Tried], links: Links) -> ChosenModel:
    """The chosen candidate, or a blend of the candidates that no other clearly beats.

    The score of a blend at a place uses weights fitted without the place's fold. A blend is chosen
    unless a candidate clearly beats it, since the error of a mean is at most the mean of the
    errors. Complex channels of unknown phase are not blended.
    """
    choice = pick(tried, links.task)
    unbeaten = choice.level
    if len(unbeaten) < 2 or links.task.phase != "known":
        return choice
    # Links that all candidates have predicted: the time limit may have left out folds of some.
    asked: Any = unbeaten[0].asked
    for candidate in unbeaten:
        asked = asked[torch.isin(asked, candidate.asked)]
    values: Any = [one.values[torch.isin(one.asked, asked)] for one in unbeaten]  # type: ignore
    places = links.query[asked].place_keys
    folds = folds_of(links, asked)
    weights, fold_weights = stack(_labels(links, asked), values, places, folds)
    if weights.max() > 0.85:  # all others together have a tenth at most
        return choice
    blend = _blended(unbeaten, weights.tolist())
    # Links of a fold have the same weights and err together: folds are compared, not places.
    rivals = [_scored(blend, links, asked, _mean(values, fold_weights), folds)]
    for candidate, predictions in zip(unbeaten, values, strict=True):
        rivals.append(_scored(candidate, links, asked, predictions, folds))
    comparison = pick(rivals, links.task, "folds")
    return comparison._replace(chosen=blend) if comparison.chosen.members else choice


def _blended(tried: Sequence[Tried], weights: Sequence[float]) -> Tried:
    """A blend of candidates by weights; a blend among them is replaced by its members."""
    members: dict[str, Tried] = {}
    shares: dict[str, float] = {}
    for weight, candidate in zip(weights, tried, strict=True):
        inner_weights = candidate.weights or (1.0,)
        inner_members = candidate.members or (candidate,)
        for inner_weight, member in zip(inner_weights, inner_members, strict=True):
            if weight * inner_weight > 0:
                members[member.label] = member
                shares[member.label] = weight * inner_weight
    label = " + ".join(f"{share:.2g} {name}" for name, share in shares.items())
    blend = tried[0]._replace(label=label, seconds=sum(candidate.seconds for candidate in tried))
    return blend._replace(members=tuple(members.values()), weights=tuple(shares.values()))


def _mean(values: Sequence[Any], shares: Sequence[float] | Tensor) -> Tensor:
    """Mean of the predictions (k, *shape) of c models by weights (c,), or by link (c, k)."""
    total: Any = 0.0
    for predictions, share in zip(values, torch.as_tensor(shares), strict=True):
        label_axes = [1] * (predictions.ndim - 1)
        total = total + share.to(predictions.real).reshape(-1, *label_axes) * predictions
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
    # Places that all candidates have scores of: the time limit may have left out folds of some.
    shared = set.intersection(*(set(candidate.gains) for candidate in tried))
    keys = sorted(shared)
    rows = [itemgetter(*keys)(candidate.gains) for candidate in tried]
    gains = torch.tensor(rows).reshape(len(tried), len(keys))  # (candidates, places)
    means = gains.mean(1)
    best = int(means.nan_to_num(-math.inf, -math.inf).argmax())
    leads = gains[:, None] - gains  # (c, c, places), of the first candidate over the second
    standard_errors = 0 * leads.mean(2)  # one place has no scatter: the best candidate is taken
    if len(shared) > 1:
        standard_errors = leads.std(2) / len(shared) ** 0.5
    is_beaten = (leads.mean(2) > standard_errors).any(0) | ~means.isfinite()  # (c,)
    chosen = int(is_beaten.int().argmin())  # the first that is not beaten
    level = [tried[number] for number in range(len(tried)) if not is_beaten[number]]
    signed = means if task.higher_is_better else -means
    texts = []
    for candidate, mean in zip(tried, signed.tolist(), strict=True):
        texts.append(f"{candidate.label} {mean:.3g}")
    scores = f"mean {task.monitor} over {len(shared)} {unit}: {', '.join(texts)}"
    if chosen == best:
        return ChosenModel(tried[best], f"{tried[best].label} is the best, {scores}", level)
    error = standard_errors[best, chosen]
    lead = f"{leads[best, chosen].mean():.2g}, standard error {error:.2g}"
    reason = (
        f"{tried[chosen].label} is the first that none surely leads; {tried[best].label} is "
        f"ahead by {lead}, {scores}"
    )
    return ChosenModel(tried[chosen], reason, level)


def _facts(tried: Sequence[Tried], chosen: Tried, reason: str, task: Task) -> dict:
    """The entry ``auto`` of ``metrics.json``: the chosen model, the reason, and all scores."""
    sign = 1 if task.higher_is_better else -1  # gains are negative if lower scores are better
    candidates = {}
    for candidate in tried:
        candidates[candidate.label] = {
            task.monitor: statistics.fmean(candidate.gains.values()) * sign,
            "places": len(candidate.gains),
            "seconds": candidate.seconds,
        }
    labels = [member.label for member in chosen.members or (chosen,)]
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

    The run folder gets the checkpoint, and of a single candidate also the log. A look-up is fitted
    to all known links.
    """
    candidates = chosen.members or (chosen,)
    results = []
    for candidate in candidates:
        results.append(candidate.fitted or _fit(candidate.config, links, candidate.folder))
    if chosen.members:
        members = []
        for candidate, result in zip(candidates, results, strict=True):
            members.append(result.models[candidate.config["model"]["name"]])
        blend = Ensemble(links.scene, members, [*chosen.weights]).eval()
        unseen_members: Any = [candidate.unseen for candidate in candidates]
        unseen = Ensemble(links.scene, unseen_members, blend.weights).eval()
        blend.known_places = links.query[links.split.known].place_keys.unique()
        blend.calibration = calibrated(unseen if blend.is_trained else blend, links)
        checkpoint.save(blend, folder / "best.ckpt")
        return Fitted({NAME: blend}, {NAME: unseen}, count_gaussians(blend), seconds)
    if (chosen.folder / "best.ckpt").is_file():
        shutil.copy(chosen.folder / "best.ckpt", folder / "best.ckpt")
    if (chosen.folder / "log").is_dir():
        shutil.copytree(chosen.folder / "log", folder / "log", dirs_exist_ok=True)
    name = chosen.config["model"]["name"]
    # Names start with ``auto`` in place of the model's; a kriged model has two, see ``Fitted``.
    models = {NAME + key.removeprefix(name): model for key, model in results[0].models.items()}
    assert chosen.unseen is not None
    return results[0]._replace(models=models, unseen={NAME: chosen.unseen}, seconds=seconds)
