"""The next places to measure, chosen one by one for the least mean variance."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.commands.survey.measured import measured_places
from gaigs.commands.survey.processes import (
    default_process,
    mean_of_received,
    posterior,
    processes_of,
    reception_chances,
    with_trend,
)
from gaigs.core.geometry import Frame, even_places
from gaigs.core.query import Query, as_positions
from gaigs.core.results import plot
from gaigs.core.stages import track, with_progress
from gaigs.io.tables import write_table
from gaigs.kriging.kernel import Process
from gaigs.kriging.links import coordinates
from gaigs.model import Model
from gaigs.registry import check_type


@dataclass(frozen=True, repr=False)
class SurveyPlan:
    """The next places to measure, and the mean error that is expected after each.

    Attributes:
        places: Places to measure, the most useful first (n, 3) [m].
        errors: Expected mean absolute error of a label over the region and all receivers, before
            and after each place, in the label's unit (n + 1,); None without a model.
        known: Places that were measured (k, 3) [m].
        losses: Rise of ``known_error`` if each known place had been left out (k,).
        superfluous: Known places that together raise ``known_error`` by at most 5 % if left out
            (k,).
        unit: Unit of the errors.
        frame: Place of x and y on a map; None if unknown.
        known_error: Expected mean error before any new place, over the region or else the box of
            the training transmitters.
        scatter: Part of the error that no measurement lowers: the noise of labels at one place.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> print(gaigs.survey(gaigs.train("gaussian_process", links), count=3))
        3 more places bring the expected mean error from ...
    """

    places: Float[Tensor, "n 3"]
    errors: Float[Tensor, " n1"] | None
    known: Float[Tensor, "k 3"]
    losses: Float[Tensor, " k"]
    superfluous: Bool[Tensor, " k"]
    unit: str = ""
    frame: Frame | None = None
    known_error: float = math.nan
    scatter: float = math.nan
    plot = plot

    def __repr__(self) -> str:
        return f"<{self}>"

    def __str__(self) -> str:
        count = len(self.places)
        if self.errors is None:
            return (
                f"{count} places to measure first; without a trained model their error is unknown"
            )
        superfluous = int(self.superfluous.sum())
        left_out = (
            f"{superfluous} of {len(self.known)} measured places could have been left out "
            "for 5 % more"
        )
        now, last = (f"{error:.3g} {self.unit}".rstrip() for error in self.errors[[0, -1]])
        scatter = f"{self.scatter:.3g} {self.unit}".rstrip()
        if not count:
            return (
                f"measure no more: labels at one place scatter by {scatter} of the expected mean "
                f"error of {now}; {left_out}"
            )
        share = 1 - self.errors[-1] / self.errors[0]
        return (
            f"{count} more places bring the expected mean error from {now} to {last}, "
            f"{100 * share:.1f} % less; labels at one place scatter by {scatter}; {left_out}"
        )

    def save(self, path: str | Path) -> None:
        """Writes a CSV table: places to measure, then places to leave out.

        A place to measure has the mean error after its measurement, a place to leave out the mean
        error without it. Without a model errors are empty. With a ``frame`` the table has easting
        and northing too.
        """
        errors = [None] * len(self.places) if self.errors is None else self.errors[1:].tolist()
        rows = [("measure", *row) for row in zip(self.places.tolist(), errors, strict=True)]
        losses = self.losses[self.superfluous].tolist()
        for place, loss in zip(self.known[self.superfluous].tolist(), losses, strict=True):
            rows.append(("leave out", place, self.known_error + loss))
        write_places(Path(path), "mean_error", rows, self.frame)


def write_places(file: Path, title: str, rows: Iterable[tuple], frame: Frame | None) -> None:
    """Writes a CSV table of places [m], with easting and northing if there is a frame.

    Args:
        title: Heading of the last column.
        rows: Use, place and number of each row; None for no number.
    """
    on_map = [] if frame is None else ["easting", "northing"]
    lines = [["use", "x", "y", "z", *on_map, title]]
    for use, place, number in rows:
        numbers = [*place] if frame is None else [*place, frame.x + place[0], frame.y + place[1]]
        end = "" if number is None else f"{number:.6g}"
        lines.append([use, *(f"{coordinate:.3f}" for coordinate in numbers), end])
    write_table(file, lines)


@with_progress
@torch.no_grad()
def survey(
    model: Model | None = None,
    region: object = None,
    count: int = 20,
    candidates: object = None,
    frequency: float | None = None,
    stop: float = 0.1,
    *,
    progress: bool = True,
) -> SurveyPlan:
    """The next places to measure: each lowers the mean variance over a region and receivers most.

    The mean is weighted by the probability that a receiver receives from a place, estimated from
    the measured places around it. A variance depends on where measurements are, not on their
    labels, so a whole plan can be made before any new measurement. The place of largest variance
    would be a poor choice, since it is in a corner. Places are at least half a correlation length
    apart, as long as there is room. The first places of a longer plan are the shorter plan. A plan
    ends when the noise of labels is nearly the whole error.

    Args:
        model: ``gaussian_process``, or a trained model with kriging. None: nothing is measured yet,
            and a default process is used.
        region: Two corners of a box ``[[x, y, z], [x, y, z]]`` [m], over which the error is stated;
            None: the candidates or, without these, the box of the training transmitters, or a box
            for each of several floors.
        count: Number of places; at most as many as there are candidates.
        candidates: Places that can be measured (c, 3) [m]; None: a grid over the region.
        frequency: Carrier [Hz]; None: the training links' carrier, of several the middle one.
            Without a model it has no effect.
        stop: Fraction of the expected error. The plan ends when no number of further places can
            lower the error by more; 0 gives all places. Without a model it has no effect.
        progress: False for no bars.

    Raises:
        ValueError: The model has no process over places, the count is less than 1, a place is
            impossible, or there is neither model nor region nor candidates.

    Example:
        >>> first = gaigs.survey(region=[[0, 0, 1], [6, 4, 1]], count=15)  # nothing is measured yet
        >>> first.places.shape, first.errors
        (torch.Size([15, 3]), None)
        >>> model = gaigs.train("gaussian_process", gaigs.links("synthetic_rssi", transmitters=60))
        >>> plan = gaigs.survey(model, count=5)
        >>> plan.places.shape, bool(plan.errors[-1] < plan.errors[0])
        (torch.Size([5, 3]), True)
        >>> plan.save("survey.csv")

    Source: Krause, Singh and Guestrin, Near-optimal sensor placements in Gaussian processes, 2008;
    the criterion is the A-optimal one of Cohn, Neural network exploration using optimal experiment
    design, 1996.
    """
    if not isinstance(model, Model | None):
        raise TypeError(
            f"model must be a trained model, got {model!r}\n"
            "load one with gaigs.load(...), or give region=..."
        )
    check_type("count", count, int)
    if count < 1:
        raise ValueError(f"count must be at least 1 place, got {count}")
    if not 0 <= stop < 1:
        raise ValueError(f"stop must be a share from 0 to less than 1, got {stop}")
    places = survey_places(model, region, candidates)
    processes = [] if model is None else processes_of(model)
    check_memory(len(places.candidates), len(processes))
    if model is None:
        everywhere = places.all.double()
        process = default_process(everywhere)
        selection = Selection([process], everywhere, places, mean_absolute(1.0))
        chosen, _ = selection.choose(count)
        no_places = places.candidates[:0]
        losses = no_places[:, 0]
        return SurveyPlan(places.candidates[chosen], None, no_places, losses, losses.bool())

    everywhere = coordinates_of(model, places.all, frequency).to(processes[0].places)
    trend_centres: Sequence = [None] * len(processes)
    if model.scene.task.is_scalar:  # levels fall with the distance from the receiver
        trend_centres = model.scene.positions(everywhere)
    spacing = Spacing(processes, everywhere[: len(places.candidates)])
    # After the spacing, as a trend correlates all places.
    pairs = zip(processes, trend_centres, strict=True)
    processes = [with_trend(process, centre) for process, centre in pairs]
    factor = error_factor(model)
    selection = Selection(processes, everywhere, places, factor)
    scatter = selection.scatter()
    chosen, errors = selection.choose(count, spacing, enough=scatter / (1 - stop))
    # Measured places count over the region, or the whole room if there are candidates alone.
    evaluated = everywhere[places.evaluated]
    if region is None and candidates is not None:
        grid = coordinates_of(model, training_grid(model), frequency)
        evaluated = grid.to(processes[0].places)
    measured = measured_places(processes, evaluated, factor)
    return SurveyPlan(
        places.candidates[chosen],
        errors,
        measured.places,
        measured.losses,
        measured.superfluous,
        model.scene.task.error_unit,
        model.scene.frame,
        measured.error,
        scatter,
    )


class SurveyPlaces(NamedTuple):
    """Candidates of a survey, and places over which its error is stated."""

    candidates: Float[Tensor, "c 3"]  # places that can be measured [m]
    # Places over which the error is stated [m]; if empty, it is stated over the candidates.
    others: Float[Tensor, "e 3"]

    @property
    def all(self) -> Float[Tensor, "g 3"]:
        """The candidates, then the other places."""
        return torch.cat((self.candidates, self.others))

    @property
    def evaluated(self) -> slice:
        """Slice of ``all`` with the places over which the error is stated."""
        return slice(len(self.candidates) if len(self.others) else 0, None)


def survey_places(model: Model | None, region: object, candidates: object) -> SurveyPlaces:
    """Candidates and other places from the arguments of ``survey``.

    Raises:
        ValueError: There is neither model nor region nor candidates, or the region is no box.
    """
    no_places = torch.zeros(0, 3)
    even = no_places
    if region is not None:
        box = as_positions("region", region).reshape(-1, 3)
        if len(box) != 2:
            advice = "\ngive places that can be measured as candidates" if len(box) > 2 else ""
            raise ValueError(
                "region must be two corners [[x, y, z], [x, y, z]] [m], "
                f"got {len(box)} points{advice}"
            )
        even = even_places(box[0], box[1], 1000)
    elif candidates is None:
        if model is None:
            raise ValueError(
                "a survey without a model takes a region or candidates, got neither\n"
                "give one (survey.region=...), or a trained model (folder=runs/...)"
            )
        even = training_grid(model)
    if candidates is None:
        return SurveyPlaces(even, no_places)
    return SurveyPlaces(as_positions("candidates", candidates).reshape(-1, 3), even)


def training_grid(model: Model) -> Float[Tensor, "g 3"]:
    """A thousand even places in the box of the training transmitters, or on their floors."""
    return even_places(model.scene.lower, model.scene.upper, 1000, model.scene.floors)


def check_memory(candidates: int, receivers: int, limit: float = 2e9) -> None:
    """Raises a ``ValueError`` unless all receivers' covariances take at most ``limit`` bytes."""
    # A receiver has candidates² numbers of 8 bytes.
    most = int((limit / 8 / max(1, receivers)) ** 0.5)
    if not 0 < candidates <= most:
        raise ValueError(
            f"a survey takes 1 to {most} candidates, got {candidates}\n"
            "change candidates, or leave them out"
        )


def coordinates_of(
    model: Model, places: Float[Tensor, "g 3"], frequency: float | None
) -> Float[Tensor, "g d"]:
    """Coordinates of a model's processes at places [m] and a carrier [Hz]."""
    scene = model.scene
    frequency = scene.middle_frequency if frequency is None else frequency
    names = [receiver.name for receiver in scene.receivers]
    query, _ = Query.from_positions(places, 0, frequency, names, scene.frequencies)
    return coordinates(scene, query, 1.0)


def mean_absolute(deviation: float) -> float:
    """Mean absolute value of a normal variable with mean 0 and a standard deviation."""
    return math.sqrt(2 / math.pi) * deviation


def error_factor(model: Model) -> float:
    """Ratio of a label's mean absolute error to the standard deviation that the model states.

    Without calibration the ratio is that of a normal variable.
    """
    calibration = model.calibration
    if calibration is None:
        return mean_absolute(1.0)
    if not model.scene.task.is_scalar:
        return calibration.mean_error
    # ``sizes`` are root mean squares of held-out errors over stated standard deviations, by group.
    return mean_absolute(calibration.sizes.square().mean().sqrt().item())


class Selection:
    """The choice of candidates, one by one, by the posterior covariances of all receivers.

    Args:
        processes: Process of each of r receivers, with its readings.
        everywhere: Coordinates of ``places.all``, as the processes take them.
        places: Candidates, and places over which the error is stated.
        factor: Ratio of a label's mean absolute error to its standard deviation.
    """

    def __init__(
        self,
        processes: Sequence[Process],
        everywhere: Float[Tensor, "g d"],
        places: SurveyPlaces,
        factor: float,
    ):
        self.posteriors = [posterior(process, everywhere) for process in processes]  # r of (g, g)
        self.chances = reception_chances(processes, everywhere)  # (r, g)
        self.noises = [process.noise for process in processes]
        self.evaluated = places.evaluated
        self.factor = factor
        self.is_free = torch.ones(len(places.candidates), dtype=torch.bool)

    def choose(
        self, count: int, spacing: "Spacing | None" = None, enough: float = -math.inf
    ) -> tuple[list[int], Float[Tensor, " n1"]]:
        """Chooses up to ``count`` candidates, until the error is at most ``enough``.

        The readings of chosen candidates stay in the covariances of this selection.

        Args:
            spacing: Keeps the candidates apart; None: they may be neighbours.

        Returns:
            Numbers of the candidates, and the expected error before and after each.
        """
        numbers = []
        errors = [self.error()]
        for _ in track(range(min(count, len(self.is_free))), "places to measure"):
            if errors[-1] <= enough:
                break
            is_free = self.is_free if spacing is None else spacing.apart(self.is_free)
            gains = self.gains().cpu().masked_fill(~is_free, -math.inf)
            number = int(gains.argmax())
            self.measure(number)
            if spacing is not None:
                spacing.add(number)
            numbers.append(number)
            errors.append(self.error())
        return numbers, torch.tensor(errors)

    def error(self) -> float:
        """Expected mean error of a new reading, in the unit of labels."""
        rows = [covariances.diagonal()[self.evaluated] for covariances in self.posteriors]
        variances = torch.stack(rows).clamp_min(0)  # (r, e)
        noises = variances.new_tensor(self.noises)[:, None]
        deviations = (variances + noises).sqrt()
        return self.factor * mean_of_received(deviations, self.chances[:, self.evaluated])

    def scatter(self) -> float:
        """Mean error by the noise of a reading alone, which no further measurement lowers."""
        noises = self.chances.new_tensor(self.noises)[:, None].sqrt()  # (r, 1)
        chances = self.chances[:, self.evaluated]  # (r, e)
        return self.factor * mean_of_received(noises.expand_as(chances), chances)

    def gains(self) -> Float[Tensor, " c"]:
        """Fall of the summed variances by a reading at each candidate.

        A reading at candidate x lowers the variance at place y by c(x, y)² / (c(x, x) + noise),
        with the posterior covariance c. It counts by the probabilities that the receiver receives
        from x and from y.
        """
        count = len(self.is_free)
        total = torch.zeros_like(self.chances[0, :count])
        receivers = zip(self.posteriors, self.noises, self.chances, strict=True)
        for covariances, noise, chances in receivers:
            squares = covariances[self.evaluated, :count].square()  # (e, c)
            falls = chances[:count] * (chances[self.evaluated] @ squares)  # (c,)
            total = total + falls / (covariances.diagonal()[:count] + noise)
        return total

    def measure(self, number: int) -> None:
        """Adds a reading at a candidate to the posterior covariances.

        A receiver that receives from the candidate with probability p gets p of the fall.
        """
        self.is_free[number] = False
        receivers = zip(self.posteriors, self.noises, self.chances, strict=True)
        for covariances, noise, chances in receivers:
            column = covariances[number]
            fall = chances[number] * torch.outer(column, column)
            covariances -= fall / (covariances[number, number] + noise)


class Spacing:
    """Keeps the places of a plan apart, by the correlation of their labels.

    A second place nearby mostly averages noise. A wrong hyperparameter would make such a place look
    better than one farther off.

    Args:
        processes: Processes of the receivers, without their trends.
        candidates: Coordinates of the candidates.
        most: Largest mean correlation of two places of a plan; the default is reached at half a
            correlation length.
    """

    def __init__(
        self,
        processes: Sequence[Process],
        candidates: Float[Tensor, "c d"],
        most: float = math.exp(-0.5),
    ):
        self.processes = processes
        self.candidates = candidates
        self.most = most
        self.nearest = torch.zeros(len(candidates))  # largest correlation with a chosen place

    def apart(self, is_free: Bool[Tensor, " c"]) -> Bool[Tensor, " c"]:
        """True for free candidates whose correlation with each chosen one is at most ``most``.

        If there is none, ``most`` is lowered for this and all later calls: it becomes its square
        root, which candidates at half the distance have. From 0.99 on all free candidates are True.
        """
        while self.most < 0.99:
            is_apart = is_free & (self.nearest <= self.most)
            if is_apart.any():
                return is_apart
            self.most **= 0.5
        return is_free

    def add(self, number: int) -> None:
        """Adds a chosen candidate by its number."""
        chosen = self.candidates[number : number + 1]  # (1, d)
        total = torch.zeros_like(self.candidates[:, 0])  # sum of correlations over receivers
        for process in self.processes:
            variance = process.covariances(chosen, chosen)[0, 0]
            total += process.covariances(chosen, self.candidates)[0] / variance
        correlations = (total / len(self.processes)).cpu().float()  # (c,)
        self.nearest = torch.maximum(self.nearest, correlations)
