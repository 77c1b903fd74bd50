"""Evaluation of a trained model beside its baselines: scores, times, predictions."""

import copy
import io
import logging
import math
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from rich.console import Console, Group
from rich.jupyter import JupyterMixin
from rich.markup import escape
from torch import Tensor

from gaigs.calibration import (
    Calibration,
    fewest,
    holds,
    interval_scores,
    nearest,
    summarise_intervals,
    thinned,
)
from gaigs.configuration import composed, files_of
from gaigs.core import stages
from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.data import Links, with_places
from gaigs.data.matching import check_fit
from gaigs.io.files import atomic_write
from gaigs.kriging.links import folds_of, single_readings
from gaigs.model import Model, call_optional
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.kriging import Kriging, predicted
from gaigs.registry import name_of, registry
from gaigs.report.scores import metrics_table, verdict

log = logging.getLogger(__name__)

BATCH = 64
"""Links predicted at a time."""

CALIBRATION_FOLDS, MOST = 5, 1000
"""Folds of known links that calibrate a look-up, and most links that they ask for."""

INTERVALS = "interval_"
"""Beginning of the names of scores of intervals; ``interval_places`` has the number of each link's
place.
"""

Scores = dict[str, dict[str, Tensor]]
"""Scores of every link, by the names of model and score."""


def build_baselines(configurations: Sequence, own: str, scene: Scene) -> dict[str, Model]:
    """The baselines of a run by name, not fitted; the one with the name ``own`` of the run's model
    is left out.

    Raises:
        ValueError: A baseline has no name, an unknown one or options that do not fit, has to be
            trained, or two have the same name.
    """
    models: dict[str, Model | None] = {}
    for config in configurations:
        config = {"name": config} if isinstance(config, str) else config
        if not isinstance(config, Mapping) or "name" not in config:
            raise ValueError(
                f"baselines must be names or model configurations with a name, got {config!r}"
            )
        name = config["name"]
        if name in models:
            raise ValueError(f"baselines must have different names, got {name!r} twice")
        models[name] = None if name == own else registry("model").build(config, scene=scene)
        if name != own and is_trained(models[name]):
            raise ValueError(f"baseline {name!r} has to be trained; run it by model={name}")
    return {name: model for name, model in models.items() if model is not None}


def is_trained(model: Model) -> bool:
    """True if a model has parameters to train, beside those that ``fit`` sets."""
    return any(parameter.requires_grad for parameter in model.parameters())


def fitted(look_up: Model, links: Links) -> Model:
    """A copy of a model without a training, fitted to the known links."""
    model = copy.deepcopy(look_up)
    model.fit(links)
    return model


def spreads(model: Model, links: Links, index: Int[Tensor, " k"], values: Tensor) -> Tensor:
    """The model's own deviations of some links, ``Model.spread``, on the CPU; ``values`` are its
    predictions.
    """
    parts = zip(links.query[index].parts(BATCH), values.split(BATCH), strict=True)
    device, directions = model.device, links.task.directions
    batches = ((Batch(query, directions).to(device), part.to(device)) for query, part in parts)
    return torch.cat([model.spread(batch, part).cpu() for batch, part in batches])


def calibrated(model: Model, links: Links) -> Calibration | None:
    """The calibration of a model, by errors at links that it has not seen, see ``unseen``; None
    without such links.
    """
    if links.held_out is not None:
        return None
    asked, values, deviations, near = [], [], [], []
    for one, part, known in stages.track(unseen(model, links), "intervals", fold_count(model)):
        if one is not model and stages.is_up():  # it was fitted in haste
            break
        asked.append(part)
        values.append(predicted(one, links, part))
        if isinstance(one, GaussianProcess | Kriging) and isinstance(
            model, GaussianProcess | Kriging
        ):
            for process, whole in zip(one.scalar, model.scalar, strict=True):
                process.take(
                    whole
                )  # a fold's hyperparameters may state larger or smaller deviations everywhere
        deviations.append(spreads(one, links, part, values[-1]))
        there = links.query[known]
        near.append(nearest(links.query[part], there.transmitters, there.receivers))
    if stages.is_up() and len(asked) < fold_count(model):
        stages.leave_out(f"{len(asked)} of {fold_count(model)} folds calibrate {name_of(model)}")
    if not asked:
        return None
    index = torch.cat(asked)
    parts = links.labels[index], torch.cat(values), torch.cat(deviations), links.query[index]
    apart = None if hasattr(model, "deviations") else torch.cat(near)
    return Calibration.of(links.task, *parts, apart, links.query[links.split.known])


def fold_count(model: Model) -> int:
    """Most models that ``unseen`` gives."""
    if isinstance(model, Kriging):
        return 2
    return 1 if is_trained(model) else CALIBRATION_FOLDS


def unseen(
    model: Model, links: Links
) -> Iterator[tuple[Model, Int[Tensor, " k"], Int[Tensor, " j"]]]:
    """Models like a model, links that they have not seen, and the links that they know; each when
    it is asked for.

    A look-up is fitted anew without each fold of the known links; so are estimated places of
    receivers. A trained model has the validation links; the step of its training stays the one
    chosen on all of them. Kriging is fitted anew to the training links, and its weights and
    hyperparameters are chosen for each half of the validation links by the other half; one group
    alone chooses, too. Of repeated readings one calibrates, see ``single_readings``. The time limit
    of a run leaves later folds out.
    """
    split, validation, receivers = links.split, links.split.validation, links.query.receivers
    if not (is_trained(model) or isinstance(model, Kriging)):
        index = split.known
        folds, asked = (
            folds_of(links, index) % CALIBRATION_FOLDS,
            evenly(single_readings(links, index), MOST),
        )
        for fold in range(CALIBRATION_FOLDS):
            if stages.is_up():
                return
            is_known = folds != fold
            # A receiver that a fold alone has heard keeps its links there.
            is_known |= torch.isin(receivers[index], receivers[index[is_known]], invert=True)
            known, part = index[is_known], index[~is_known & torch.isin(index, asked)]
            if len(part):
                rest = replace(links, split=split.only(known))
                memo: dict[int, Any] = (
                    {id(model.links): model.links} if hasattr(model, "links") else {}
                )
                if links.uncertainties is not None and links.uncertainties.any():
                    at_all = torch.where(links.uncertainties > 0, math.inf, 0.0)
                    rest = with_places(replace(rest, uncertainties=at_all))
                    memo[id(model.scene)] = replace(model.scene, receivers=rest.receivers)
                copied = copy.deepcopy(model, memo)
                (copied.refit if hasattr(copied, "refit") else copied.fit)(rest)
                yield copied, part, known
        return
    if not len(validation):
        return
    if not isinstance(model, Kriging):
        yield model, single_readings(links, validation), split.train
        return
    halves = folds_of(links, validation) % 2
    parts = validation[halves == 0], validation[halves == 1]
    for own, other in (parts, parts[::-1]) if all(map(len, parts)) else ((validation, validation),):
        if stages.is_up():
            return
        kriged = Kriging(links.scene, model.trend, model.fallback_options).to(model.device)
        kind = {"is_final": False, "by_paths": model.by_paths}
        kriged = kriged.krige(replace(links, split=split.choosing(own)), **kind)
        yield kriged, single_readings(links, other), split.train


@dataclass(frozen=True)
class Evaluation(JupyterMixin):
    """Scores on the test links; prints as a table, in a notebook too.

    Attributes:
        task: Task of the labels.
        split: Name of the split.
        scores: Scores of every test link (k,), by the names of model and score; the evaluated model
            first.
        device: Name of the device that computed them.
    """

    task: Task
    split: str
    scores: Scores
    device: str

    @property
    def models(self) -> dict[str, dict[str, float]]:
        """The numbers of the table, by the model's name and the metric's."""
        return {name: summary(self.task, values) for name, values in self.scores.items()}

    def __rich__(self) -> Group:
        facts = {
            "task": self.task.name,
            "split": self.split,
            "device": self.device,
            "models": self.models,
        }
        return Group(metrics_table(facts), escape(verdict(facts)))

    def __str__(self) -> str:
        text = io.StringIO()
        Console(file=text, width=120, force_jupyter=False, force_terminal=False).print(self)
        return text.getvalue().rstrip()


def evaluate(model: Model, links: Links, baselines: Sequence | None = None) -> Evaluation:
    """Scores of a model on the test links, beside those of baselines that are fitted to the other
    links.

    Args:
        model: A trained, fitted or loaded model, of the same receivers and task.
        links: Links with a split.
        baselines: Names or configurations of models without a training; None: those of the task.

    Raises:
        TypeError: The model is not a ``gaigs.Model``, or the links are not ``gaigs.Links``.
        ValueError: There are no test links, the links have other receivers or another task, or a
            baseline has to be trained.

    It warns of test links at places that the model has learnt from, where those are not official
    ones.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=50)
        >>> result = gaigs.evaluate(gaigs.train("knn", links), links, baselines=["mean", "path_loss"])
        >>> list(result.models)
        ['knn', 'mean', 'path_loss']
        >>> print(result)
        Test scores
        ...
        evaluated on ...
    """
    if not isinstance(model, Model) or not isinstance(links, Links):
        raise TypeError(
            f"evaluate takes a model and links, got {type(model).__name__} and {type(links).__name__}"
        )
    check_fit(links, model.scene)
    if not len(links.split.test):
        raise ValueError("links must have some to test on; take another split")
    if model.known_places is not None:
        known, test = (
            links.query[part].place_keys for part in (links.split.known, links.split.test)
        )
        if seen := int((torch.isin(test, model.known_places) & ~torch.isin(test, known)).sum()):
            words = "%s has learnt from the places of %d of %d test links\ntake links of the split and seed of its training"
            log.warning(words, name_of(model), seen, len(test))
    task = (links.held_out or links).task
    own = name_of(model.trend if isinstance(model, Kriging) else model)
    models = {own: model} | ({f"{own}_trend": model.trend} if isinstance(model, Kriging) else {})
    if baselines is None:
        baselines = (
            composed([f"task={task.name}"], {})["baselines"] if files_of("task", task.name) else ()
        )
    baselines = [baselines] if isinstance(baselines, str) else baselines
    scores = score(models, build_baselines(baselines, own, links.scene), links)
    return Evaluation(task, links.split.name, scores, device_name(model.device))


def summary(task: Task, scores: dict[str, Tensor]) -> dict[str, float]:
    """The numbers of a table, and those of intervals where a model has them."""
    own = own_scores(scores)
    return task.summarise(own) | summarise_intervals(
        {name.removeprefix(INTERVALS): score for name, score in scores.items() if name not in own}
    )


def own_scores(scores: dict[str, Tensor]) -> dict[str, Tensor]:
    """The scores of the task, without those of intervals."""
    return {name: score for name, score in scores.items() if not name.startswith(INTERVALS)}


def score(
    models: Mapping[str, Model],
    look_ups: Mapping[str, Model],
    links: Links,
    folder: Path | None = None,
    has_intervals: bool = True,
) -> Scores:
    """Scores of every test link by fitted models and by look-ups; a folder gets predictions of the
    first.

    Look-ups and models with a calibration have scores of intervals too. If subcarriers are held
    out, ``nearest_frequency`` scores the test links' own labels at the nearest other ones, as an
    uplink is taken for a downlink.
    """
    asked, index = links.held_out or links, links.split.test
    task: Any = asked.task
    labels = torch.cat([asked.labels[part] for part in index.split(BATCH)])
    query = links.query[index]
    content = {
        "link": index.numpy(),
        "transmitters": query.transmitters.numpy(),
        "receiver": query.receivers.numpy(),
        "labels": task.packed(labels),
    }
    if query.frequencies is not None:
        content["frequencies"] = query.frequencies.numpy()
    if task.directions is not None:
        content |= {
            "elevations": task.directions.elevations.numpy(),
            "azimuths": task.directions.azimuths.numpy(),
        }
    scores = {}

    def add(key: str, values: Tensor) -> None:
        scores[key] = task.scores(labels, values)
        content.setdefault("prediction", task.packed(values))
        content.update(
            {
                f"{kind}_{key}": array
                for kind, array in task.stored(labels, values, scores[key]).items()
            }
        )

    frequencies = None if links.held_out is None else task.frequencies
    keys, gone = [*models, *look_ups], list[str]()

    def is_left_out(key: str) -> bool:
        """True for a baseline if time is up: it has no fit, or one in haste."""
        is_out = key in look_ups and key != keys[0] and stages.is_up()
        if is_out:
            gone.append(key)
        return is_out

    for key in keys:
        if is_left_out(key):
            continue
        model = models[key] if key in models else fitted(look_ups[key], links)
        if is_left_out(key):
            continue
        values = predicted(model, links, index, frequencies)
        add(key, values)
        calibration = (
            model.calibration if key in models or not has_intervals else calibrated(model, links)
        )
        enough = calibration is not None and calibration.gives(0.9)
        if has_intervals and frequencies is None and key == next(iter(models), None) and not enough:
            count = 0 if calibration is None else int(calibration.counts.min())
            log.warning(
                "%s has no intervals: %d links calibrate them, and %d are needed",
                key,
                count,
                fewest(0.9),
            )
        if has_intervals and frequencies is None and enough:
            deviations = spreads(model, links, index, values)
            batches = torch.arange(len(index)).split(
                BATCH
            )  # estimates take ten times the memory of labels
            if key == next(iter(models), None):
                stated = (
                    calibration.estimate(values[some], deviations[some], query[some], 0.9)
                    for some in batches
                )
                content["deviation"] = np.concatenate(
                    [task.packed(estimate.std) for estimate in stated]
                )
            aligned, thin_values, thin_deviations = thinned(task, labels, values, deviations)
            parts = []
            for some in batches:
                own = thin_values[some], thin_deviations[some], query[some]
                half, most = (calibration.estimate(*own, level) for level in (0.5, 0.9))
                parts.append(interval_scores(aligned[some], half, most))
            found = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            found["calibration_links"] = torch.full((len(index),), float(calibration.counts.sum()))
            found["places"] = query.place_keys.unique(return_inverse=True)[1].double()
            scores[key] |= {f"{INTERVALS}{name}": score for name, score in found.items()}
            content[f"shares_{key}"] = shares(
                calibration, aligned, thin_values, thin_deviations, query
            )
    if gone:
        stages.leave_out(
            f"no {'test' if has_intervals else 'validation'} scores of {', '.join(gone)}"
        )
    if links.held_out is not None:
        known: Any = links.task
        closest = (known.frequencies - frequencies[:, None]).abs().argmin(1)
        add("nearest_frequency", links.labels[index][..., closest])
    if folder is not None:
        with atomic_write(folder / "predictions.npz") as part:
            np.savez_compressed(part, **content)
    return scores


def shares(
    calibration: Calibration, labels: Tensor, values: Tensor, deviations: Tensor, query: Query
) -> np.ndarray:
    """Shares of the aligned labels of at most 300 links within intervals of the levels 0.05 to 0.95
    (19,).
    """
    some = evenly(torch.arange(len(labels)), 300)
    labels, values, deviations, query = labels[some], values[some], deviations[some], query[some]
    found = []
    for level in np.arange(1, 20) / 20:
        if not calibration.gives(level):
            found.append(math.nan)
            continue
        estimate = calibration.estimate(values, deviations, query, level)
        found.append(holds(estimate, labels)[~estimate.std.isnan()].double().mean().item())
    return np.array(found)


def validate(models: Mapping[str, Model], look_ups: Mapping[str, Model], links: Links) -> Scores:
    """Scores of every validation link, by models that have not been fitted to these links; empty
    without such links.
    """
    if not len(links.split.validation):
        return {}
    held_out = replace(links, split=links.split.validating(), held_out=None)
    return score(models, look_ups, held_out, has_intervals=False)


def by_receiver(scores: Scores, links: Links) -> dict[str, dict]:
    """The table's numbers for each receiver with test links, by the names of receiver and model."""
    receivers = links.query.receivers[links.split.test]
    return {
        receiver.name: {
            name: links.task.summarise(
                {key: score[receivers == i] for key, score in own_scores(values).items()}
            )
            for name, values in scores.items()
        }
        for i, receiver in enumerate(links.receivers)
        if (receivers == i).any()
    }


def inference_ms(model: Model, links: Links) -> float:
    """Time from a query to its value [ms]."""
    query = links.query[links.split.test[:1]]
    return median_ms(lambda: model.predict(query))


def render_ms(model: Model, links: Links) -> float | None:
    """Time of rendering alone [ms]; None for a model that renders nothing."""
    work = call_optional(model, "rendering", links.batch(links.split.test[:1]).to(model.device))
    if work is None:
        return None
    with torch.no_grad():
        return median_ms(work)


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


def device_name(device: torch.device) -> str:
    """The name of a device, for tables."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    threads = torch.get_num_threads()
    return f"{names[0] if names else platform.processor() or platform.machine()}, {threads} thread{'s' * (threads > 1)}"
