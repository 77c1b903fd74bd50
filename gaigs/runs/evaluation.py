"""Evaluation of a trained model and its baselines: scores, times, predictions."""

import copy
import io
import logging
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console, Group
from rich.jupyter import JupyterMixin
from rich.markup import escape
from torch import Tensor

from gaigs.calibration import Calibration, fewest
from gaigs.calibration.conformal import thinned
from gaigs.calibration.scores import scores_of_links, shares_within, summarise_intervals
from gaigs.configuration import composed, files_of
from gaigs.core import stages
from gaigs.core.query import drawn
from gaigs.core.results import plot
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.io.files import atomic_write
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import Model
from gaigs.model.answers import batch_size, calibrated, predicted, spreads
from gaigs.model.kriging import Kriging
from gaigs.registry import name_of, registry
from gaigs.report.paired import Paired, paired
from gaigs.report.scores import metrics_table, score_frame, score_latex, verdict

log = logging.getLogger(__name__)

BATCH = 64
"""Links predicted at a time."""

INTERVALS = "interval_"
"""Beginning of the names of scores of intervals; ``interval_places`` has the number of each link's
place.
"""

Scores = dict[str, dict[str, Tensor]]
"""Scores of every link, by the names of model and score."""


def build_baselines(configurations: Sequence, model_name: str, scene: Scene) -> dict[str, Model]:
    """The baselines of a run by name, not yet fitted, without the run's model.

    Raises a ``ValueError`` for a baseline that has no name, is named twice or has to be trained.
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
        baseline = None if name == model_name else registry("model").build(config, scene=scene)
        if baseline is not None and baseline.is_trained:
            raise ValueError(f"baseline {name!r} has to be trained; run it by model={name}")
        models[name] = baseline
    return {name: model for name, model in models.items() if model is not None}


def fitted(
    look_up: Model, links: Links, before: Model | None = None, many: int = ScalarOptions.large
) -> Model:
    """A copy of a ``look_up``, a model without a training, fitted to the known links.

    With more than ``many`` known links the copy takes hyperparameters from ``before``, the same
    model fitted to most of these links.
    """
    if before is not None and len(links.split.known) > many:
        return before.refitted(links)
    model = copy.deepcopy(look_up)
    model.fit(links)
    return model


@dataclass(frozen=True)
class Evaluation(JupyterMixin):
    """Scores on the test links; printed as a table, in a notebook too.

    Attributes:
        task: Task of the labels.
        split: Name of the split.
        scores: Scores of every test link (k,), by name of the model and of the score; the evaluated
            model comes first.
        device: Name of the device that computed them.
        places: A number for the place of each test link (k,); None if unknown.
    """

    task: Task
    split: str
    scores: Scores
    device: str
    places: Tensor | None = None
    plot = plot

    @property
    def models(self) -> dict[str, dict[str, float]]:
        """The values of the table, by name of the model and of the metric."""
        return {name: summary(self.task, values) for name, values in self.scores.items()}

    @cached_property
    def paired(self) -> Paired | None:
        """A paired test of each score against the best baseline's; None if there is none."""
        return None if self.places is None else compare(self.task, self.scores, self.places)

    @property
    def facts(self) -> dict[str, Any]:
        """Entries as in a ``metrics.json``, from which tables are made."""
        facts = {"task": self.task.name, "split": self.split, "device": self.device}
        return facts | {"models": self.models, "paired": self.paired and self.paired._asdict()}

    def to_dataframe(self) -> Any:
        """A ``pandas.DataFrame``, one row a model; after each score the p-value of
        ``gaigs.report.paired``.

        Raises:
            ImportError: Pandas is not installed.

        Example:
            >>> links = gaigs.links("synthetic_rssi", transmitters=50)
            >>> table = gaigs.evaluate(gaigs.train("knn", links), links).to_dataframe()
            >>> table.columns[:2].tolist()
            ['MAE [dB]', 'MAE [dB], p']
        """
        return score_frame(self.facts)

    def to_latex(self) -> str:
        """A LaTeX table for a paper, without further packages.

        The best score is bold, and so are scores with the same printed value. A star marks a score
        that differs significantly from the best baseline's.
        """
        return score_latex(self.facts)

    def __rich__(self) -> Group:
        return Group(metrics_table(self.facts), escape(verdict(self.facts)))

    def __str__(self) -> str:
        text = io.StringIO()
        Console(file=text, width=120, force_jupyter=False, force_terminal=False).print(self)
        return text.getvalue().rstrip()


@stages.with_progress
def evaluate(
    model: Model, links: Links, baselines: Sequence | None = None, *, progress: bool = True
) -> Evaluation:
    """Scores of a model on the test links, next to baselines fitted to the other links.

    A warning names test links at places that the model was trained on, unless the split is
    official.

    Args:
        model: A trained, fitted or loaded model for the same receivers and task.
        links: Links with a split.
        baselines: Names or configurations of models without a training; None: the task's baselines.
        progress: False hides progress bars.

    Raises:
        TypeError: The model is not a ``gaigs.Model``, or the links are not ``gaigs.Links``.
        ValueError: There are no test links, the links have other receivers or another task, or a
            baseline needs a training.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=50)
        >>> model = gaigs.train("knn", links)
        >>> result = gaigs.evaluate(model, links, baselines=["mean", "path_loss"])
        >>> list(result.models)
        ['knn', 'mean', 'path_loss']
        >>> print(result)
        Test scores
        ...
        evaluated on ...
    """
    if not isinstance(model, Model) or not isinstance(links, Links):
        raise TypeError(
            f"evaluate takes a model and links, got {type(model).__name__} and "
            f"{type(links).__name__}"
        )
    check_fit(links, model.scene)
    if not len(links.split.test):
        raise ValueError("links must have some to test on; take another split")
    if model.known_places is not None:
        known = links.query[links.split.known].place_keys
        test = links.query[links.split.test].place_keys
        # An official split may test at known places; other places the model must not know.
        is_seen = torch.isin(test, model.known_places) & ~torch.isin(test, known)
        if seen := int(is_seen.sum()):
            log.warning(
                "%s has learnt from the places of %d of %d test links\n"
                "take links of the split and seed of its training",
                name_of(model),
                seen,
                len(test),
            )
    task = (links.held_out or links).task
    model_name = name_of(model.trend if isinstance(model, Kriging) else model)
    models = {model_name: model}
    if isinstance(model, Kriging):
        models[f"{model_name}_trend"] = model.trend
    if baselines is None:
        baselines = ()
        if files_of("task", task.name):  # a task without a configuration has no baselines
            baselines = composed([f"task={task.name}"], {})["baselines"]
    baselines = [baselines] if isinstance(baselines, str) else baselines
    scores = score(models, build_baselines(baselines, model_name, links.scene), links)
    places = links.query[links.split.test].place_keys
    return Evaluation(task, links.split.name, scores, device_name(model.device), places)


def compare(task: Task, scores: Scores, places: Tensor) -> Paired | None:
    """The paired test of a task's scores, without scores of intervals."""
    return paired(task, {name: task_scores(parts) for name, parts in scores.items()}, places)


def summary(task: Task, scores: dict[str, Tensor]) -> dict[str, float]:
    """Metrics of a model for a table, with those of its intervals if it has any."""
    of_task = task_scores(scores)
    of_intervals = {
        name.removeprefix(INTERVALS): score for name, score in scores.items() if name not in of_task
    }
    return task.summarise(of_task) | summarise_intervals(of_intervals)


def task_scores(scores: dict[str, Tensor]) -> dict[str, Tensor]:
    """The scores of the task, without scores of intervals."""
    return {name: score for name, score in scores.items() if not name.startswith(INTERVALS)}


def score(
    models: Mapping[str, Model],
    look_ups: Mapping[str, Model],
    links: Links,
    folder: Path | None = None,
    has_intervals: bool = True,
    fits: dict[str, Model] | None = None,
) -> Scores:
    """Scores of every test link, for models and look-ups.

    Models and look-ups with a calibration also have scores of intervals. If subcarriers are held
    out, ``nearest_frequency`` predicts the label at the nearest known subcarrier, as uplink
    channels are used for the downlink. After the time limit of the run baselines are left out.

    Args:
        models: Fitted models by name.
        look_ups: Look-ups that are still to be fitted, by name.
        folder: Folder of ``predictions.npz``, with the first model's predictions; None: no file.
        has_intervals: True for scores of intervals; False in a validation.
        fits: Models of an earlier call by name, whose hyperparameters a look-up may reuse. The
            models of this call replace them.
    """
    test = LinkScores(links)
    look_ups = able_look_ups(look_ups, links)
    frequencies = None if links.held_out is None else test.task.frequencies
    states_intervals = has_intervals and frequencies is None
    first = next(iter([*models, *look_ups]), None)
    left_out = []
    earlier = {} if fits is None else fits
    for key in [*models, *look_ups]:
        is_baseline = key in look_ups and key != first
        if is_baseline and stages.is_up():
            left_out.append(key)
            continue
        with stages.timed(key):
            model = models[key] if key in models else fitted(look_ups[key], links, earlier.get(key))
        if is_baseline and stages.is_up():  # the limit has cut its fit short
            left_out.append(key)
            continue
        earlier[key] = model
        with stages.timed(key):
            values = predicted(model, links, test.index, frequencies)
        test.add(key, values)
        calibration = model.calibration
        if key not in models and has_intervals:
            calibration = calibrated(model, links)
        has_enough = calibration is not None and calibration.gives(0.9)
        is_main = key == next(iter(models), None)
        if states_intervals and is_main and not has_enough:
            log.warning("%s has no intervals: %s", key, _lack(calibration))
        if states_intervals and calibration is not None and has_enough:
            with stages.timed("intervals"):
                deviations = spreads(model, links, test.index, values)
                test.add_intervals(key, calibration, values, deviations, is_main)
    if left_out:
        part = "test" if has_intervals else "validation"
        stages.leave_out(f"no {part} scores of {', '.join(left_out)}")
    if frequencies is not None:
        known: Any = links.task
        closest = (known.frequencies - frequencies[:, None]).abs().argmin(1)
        test.add("nearest_frequency", links.labels[test.index][..., closest])
    if folder is not None:
        with atomic_write(folder / "predictions.npz") as part_file:
            np.savez_compressed(part_file, **test.content)
    return test.scores


def _lack(calibration: Calibration | None) -> str:
    """What a model lacks for intervals of 90 %, for a warning."""
    count = 0 if calibration is None else int(calibration.counts.min())
    if count >= fewest(0.9):
        return "at new receivers three others with links must calibrate them"
    return f"{count} links calibrate them, and {fewest(0.9)} are needed"


def able_look_ups(look_ups: Mapping[str, Model], links: Links) -> dict[str, Model]:
    """Look-ups that can predict all receivers of the test links, also ones without known links."""
    if not links.split.by_receivers:
        return dict(look_ups)
    return {key: model for key, model in look_ups.items() if model.any_receiver}


class LinkScores:
    """Scores of the test links, and the content of ``predictions.npz``.

    Attributes:
        size: Number of links predicted at a time.
        index: Numbers of the test links (k,).
        task: Task of the predicted labels.
        labels: Labels of the test links (k, *shape).
        scores: Scores of every test link by name of the model and of the score.
        content: Arrays by name.
    """

    def __init__(self, links: Links):
        labelled = links.held_out or links  # held-out subcarriers have their own task and labels
        self.size = batch_size(links)
        self.index = links.split.test
        self.task: Any = labelled.task
        self.query = links.query[self.index]
        self.labels = torch.cat([labelled.labels[rows] for rows in self.index.split(self.size)])
        self.scores: Scores = {}
        self.content: dict[str, Any] = {
            "link": self.index.numpy(),
            "transmitters": self.query.transmitters.numpy(),
            "receiver": self.query.receivers.numpy(),
            "labels": self.task.packed(self.labels),
        }
        if self.query.frequencies is not None:
            self.content["frequencies"] = self.query.frequencies.numpy()
        if self.task.directions is not None:
            self.content["elevations"] = self.task.directions.elevations.numpy()
            self.content["azimuths"] = self.task.directions.azimuths.numpy()

    def add(self, key: str, values: Tensor) -> None:
        """Scores predictions of the model ``key``, and stores them if it is the first model."""
        self.scores[key] = self.task.scores(self.labels, values)
        self.content.setdefault("prediction", self.task.packed(values))
        stored = self.task.stored(self.labels, values, self.scores[key])
        self.content |= {f"{kind}_{key}": array for kind, array in stored.items()}

    def add_intervals(
        self,
        key: str,
        calibration: Calibration,
        values: Tensor,
        deviations: Tensor,
        is_main: bool,
    ) -> None:
        """Scores the intervals of a model; calibrated deviations of the main model are stored.

        ``deviations`` are standard deviations of the predictions ``values`` before calibration.
        """
        if is_main:
            blocks = []
            for rows in torch.arange(len(self.index)).split(self.size):
                # An interval brings the deviation, whatever its level.
                estimate = calibration.estimate(
                    values[rows], deviations[rows], self.query[rows], 0.9
                )
                blocks.append(self.task.packed(estimate.std))
            self.content["deviation"] = np.concatenate(blocks)
        # Some numbers of each label are enough for scores of intervals.
        sampled = thinned(self.task, self.labels, values, deviations)
        scores = scores_of_links(calibration, sampled, self.query, self.size)
        self.scores[key] |= {f"{INTERVALS}{name}": score for name, score in scores.items()}
        self.content[f"shares_{key}"] = shares_within(calibration, sampled, self.query)


def validate(
    models: Mapping[str, Model],
    look_ups: Mapping[str, Model],
    links: Links,
    fits: dict[str, Model] | None = None,
) -> Scores:
    """Scores of the validation links, by models and by look-ups fitted without these links.

    The result is empty without validation links. Of many validation links a random part is scored.
    ``models`` have not learnt from validation links; other arguments are as for ``score``.
    """
    if not len(links.split.validation):
        return {}
    split = links.split.validating()
    split = replace(split, test=drawn(split.test))
    held_out = replace(links, split=split, held_out=None)
    return score(models, look_ups, held_out, has_intervals=False, fits=fits)


def by_receiver(scores: Scores, links: Links) -> dict[str, dict]:
    """Metrics by receiver and model, for receivers with test links."""
    receivers = links.query.receivers[links.split.test]
    summaries: dict[str, dict] = {}
    for number, receiver in enumerate(links.receivers):
        rows = receivers == number
        if not rows.any():
            continue
        summaries[receiver.name] = {}
        for name, values in scores.items():
            of_receiver = {key: score[rows] for key, score in task_scores(values).items()}
            summaries[receiver.name][name] = links.task.summarise(of_receiver)
    return summaries


def inference_ms(model: Model, links: Links) -> float:
    """Time from a query to its value [ms]."""
    query = links.query[links.split.test[:1]]
    return median_ms(lambda: model.predict(query))


def render_ms(model: Model, links: Links) -> float | None:
    """Time of only the rendering [ms]; None for a model without rendering."""
    work = model.rendering(links.batch(links.split.test[:1]).to(model.device))
    if work is None:
        return None
    with torch.no_grad():
        return median_ms(work)


def median_ms(work: Callable, warm_up: int = 5, repeats: int = 25) -> float:
    """Median duration of ``work`` [ms] in ``repeats`` calls, after ``warm_up`` calls."""
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
    name = names[0] if names else platform.processor() or platform.machine()
    threads = torch.get_num_threads()
    return f"{name}, {threads} thread{'s' * (threads > 1)}"
