"""Survey planning: where to measure next, and which measured places could have been left out."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from gaigs.core.geometry import Frame, even_places
from gaigs.core.query import Query, as_positions, evenly
from gaigs.core.stages import track
from gaigs.io.tables import read_points, write_csv
from gaigs.kriging.kernel import LIMIT, Process, kernel
from gaigs.kriging.links import coordinates, distances, reception_probability
from gaigs.model import Model
from gaigs.registry import call, check_type
from gaigs.report import style
from gaigs.runs import load

POINTS = 1000
"""Approximate number of candidates, and of places at which the error is stated, of a region."""

MEAN = math.sqrt(2 / math.pi)
"""Mean absolute value of a normal variable over its standard deviation."""

MEMORY = 2e9
"""Bytes of the covariances of all receivers."""

COMPARED = 1500
"""Most readings of a receiver among which those that could be left out are searched."""

TOLERATED = 1.05
"""Largest rise of the mean error for which known places count as superfluous together."""

LENGTH, NUGGET = 0.25, 0.6
"""Correlation length over the diagonal of all points and nugget of the process that stands in for a
model.
"""


@dataclass(frozen=True, repr=False)
class SurveyPlan:
    """The next places to measure, and the mean error that is expected after each.

    Attributes:
        places: To measure, the most useful first (n, 3) [m].
        errors: Expected mean absolute error of a label over the region and all receivers, before
            and after each place, in the label's unit (n + 1,); None without a model.
        known: Places that were measured (k, 3) [m].
        losses: Rise of ``known_error`` if one of them had been left out (k,).
        superfluous: Known places that together raise ``known_error`` by at most 5 % if left out
            (k,).
        unit: Of the errors.
        frame: Place of x and y on a map; None if unknown.
        known_error: Expected mean error over the region, or else the box of the training
            transmitters, now.

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

    def __repr__(self) -> str:
        return f"<{self}>"

    def __str__(self) -> str:
        if self.errors is None:
            return f"{len(self.places)} places to measure first; without a trained model their error is unknown"
        first, last = (f"{error:.3g}" for error in (self.errors[0], self.errors[-1]))
        few = int(self.superfluous.sum())
        words = f"{len(self.places)} more places bring the expected mean error from {first} to {last} {self.unit}".rstrip()
        return f"{words}; {few} of {len(self.known)} measured places could have been left out for 5 % more"

    def save(self, path: str | Path) -> None:
        """Writes a CSV table: places to measure, each with the error after it, then measured ones
        to leave out.

        With a ``frame`` it has easting and northing too. Without a model errors are empty.
        """
        frame = self.frame
        rows = [
            [
                "use",
                "x",
                "y",
                "z",
                *([] if frame is None else ["easting", "northing"]),
                "mean_error",
            ]
        ]
        on_map = lambda x, y, z: () if frame is None else (frame.x + x, frame.y + y)
        row = lambda use, place, word: rows.append(
            [use, *(f"{x:.3f}" for x in (*place, *on_map(*place))), word]
        )
        words = [""] * len(self.places)
        if self.errors is not None:
            words = [f"{error:.6g}" for error in self.errors[1:].tolist()]
        for place, word in zip(self.places.tolist(), words, strict=True):
            row("measure", place, word)
        known, losses = (
            self.known[self.superfluous].tolist(),
            self.losses[self.superfluous].tolist(),
        )
        for place, loss in zip(known, losses, strict=True):
            row("leave out", place, f"{self.known_error + loss:.6g}")
        write_csv(Path(path), rows)


@torch.no_grad()
def survey(
    model: Model | None = None,
    region: object = None,
    count: int = 20,
    candidates: object = None,
    frequency: float | None = None,
) -> SurveyPlan:
    """The next places to measure: each lowers the mean variance over a region most, at all
    receivers together.

    A receiver counts at a place as much as it is likely to hear it, by the measured places around.
    Labels do not enter beyond the fitted process, so a plan is made before anything is measured.
    The largest variance would be a poor guide: it is in the corners. The first places of a longer
    plan are those of a shorter one.

    Args:
        model: ``gaussian_process``, or a trained model with kriging; None: nothing is measured yet,
            and a default process takes its place.
        region: Two corners of a box ``[[x, y, z], [x, y, z]]`` [m], over which the error is stated;
            None: the candidates or, without these, the box of the training transmitters, of several
            floors these.
        count: Number of places; at most as many as there are candidates.
        candidates: Places that can be measured (c, 3) [m]; None: a grid over the region.
        frequency: Carrier [Hz]; None: that of the training links, of several the middle one.
            Without a model it has no effect.

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
            f"model must be a trained model, got {model!r}\nload one with gaigs.load(...), or give region=..."
        )
    check_type("count", count, int)
    if count < 1:
        raise ValueError(f"count must be at least 1 place, got {count}")
    is_whole = region is None and candidates is None
    if is_whole:
        if model is None:
            raise ValueError(
                "a survey without a model takes a region or candidates, got neither\n"
                "give one (survey.region=...), or a trained model (folder=runs/...)"
            )
        region = torch.stack((model.scene.lower, model.scene.upper))
    even = torch.zeros(0, 3)
    if region is not None:
        box = as_positions("region", region).reshape(-1, 3)
        if len(box) != 2:
            advice = "\ngive places that can be measured as candidates" if len(box) > 2 else ""
            raise ValueError(
                f"region must be two corners [[x, y, z], [x, y, z]] [m], got {len(box)} points{advice}"
            )
        even = even_places(box[0], box[1], POINTS, model.scene.floors if is_whole else ())
    places = even if candidates is None else as_positions("candidates", candidates).reshape(-1, 3)
    beside = even[:0] if candidates is None else even
    points, stated = torch.cat((places, beside)), slice(len(places) if len(beside) else 0, None)
    processes = [] if model is None else processes_of(model)
    most = int((MEMORY / 8 / max(1, len(processes))) ** 0.5)
    if not 0 < len(places) <= most:
        raise ValueError(
            f"a survey takes 1 to {most} candidates, got {len(places)}\nchange candidates, or leave them out"
        )
    if model is None:
        asked, factor = points.double(), MEAN
        processes = [default_process(asked)]
    else:
        scene = model.scene
        frequency = scene.middle_frequency if frequency is None else frequency
        names = [receiver.name for receiver in scene.receivers]

        def at(places: Tensor) -> Tensor:
            query, _ = Query.from_positions(places, 0, frequency, names, scene.frequencies)
            return coordinates(scene, query, 1.0).to(processes[0].places)

        asked = at(points)
        centres = scene.positions(asked) if scene.task.is_scalar else [None] * len(processes)
        processes = [
            with_trend(process, centre) for process, centre in zip(processes, centres, strict=True)
        ]
        factor, calibration = MEAN, model.calibration
        if calibration is not None:
            rms = calibration.sizes.square().mean().sqrt().item()
            factor = MEAN * rms if scene.task.is_scalar else calibration.mean_error
    posteriors, hears = (
        [posterior(process, asked) for process in processes],
        heard(processes, asked),
    )
    noises = [process.noise for process in processes]

    def error(parts: list[Tensor]) -> float:
        variances = torch.stack([part.diagonal()[stated] for part in parts]).clamp_min(0)
        deviations = (variances + variances.new_tensor(noises)[:, None]).sqrt()
        return factor * mean_of_heard(deviations, hears[:, stated])

    chosen, errors = [], [error(posteriors)]
    free = torch.ones(len(places), dtype=torch.bool)
    for _ in track(range(min(count, len(places))), "places to measure"):
        gains = sum(
            own[: len(places)]
            * (own[stated] @ part[stated, : len(places)].square())
            / (part.diagonal()[: len(places)] + noise)
            for part, noise, own in zip(posteriors, noises, hears, strict=True)
        )
        best = int(gains.cpu().masked_fill(~free, -math.inf).argmax())
        free[best] = False
        chosen.append(best)
        for part, noise, own in zip(posteriors, noises, hears, strict=True):
            part -= own[best] * torch.outer(part[best], part[best]) / (part[best, best] + noise)
        errors.append(error(posteriors))
    if model is None:
        return SurveyPlan(
            places[chosen], None, places[:0], places[:0, 0], torch.zeros(0, dtype=torch.bool)
        )
    box = (
        asked[stated]
        if region is not None
        else at(even_places(scene.lower, scene.upper, POINTS, scene.floors))
    )
    known, own, losses, superfluous = without(processes, box, factor)
    unit = model.scene.task.error_unit
    frame = model.scene.frame
    return SurveyPlan(
        places[chosen], torch.tensor(errors), known, losses, superfluous, unit, frame, own
    )


def run(config: dict, folder: Path) -> None:
    """Plans a survey, by the model of a finished run if given; writes ``survey.csv`` and
    ``survey.png``.
    """
    model = None if config["folder"] is None else load(config["folder"], config["trust"])
    options = dict(config["survey"])
    if isinstance(options["candidates"], str):
        options["candidates"] = read_points(
            Path(options["candidates"]), "xyz", "x,y,z [m] of one candidate a line"
        )
    plan = call("survey", survey, options, model=model)
    folder.mkdir(parents=True, exist_ok=True)
    plan.save(folder / "survey.csv")
    style.save(figure(plan), folder / "survey.png")
    print(plan)
    if plan.frame is not None:
        print(f"easting and northing are those of EPSG:{plan.frame.epsg}")
    print(f"results: {folder}")


def figure(plan: SurveyPlan) -> Figure:
    """Places from above and, with a model, the expected error after each new one."""
    with rc_context(style.STYLE):
        drawn = Figure(figsize=(style.PAGE, 0.46 * style.PAGE), layout="compressed")
        (left, *right) = drawn.subplots(1, 1 if plan.errors is None else 2, squeeze=False)[0]
        for rows, look, words in (
            (~plan.superfluous, {"color": style.GREY}, "measured"),
            (
                plan.superfluous,
                {"markeredgecolor": style.GREY, "color": "none"},
                "measured, could be left out",
            ),
        ):
            if len(plan.known):
                left.plot(*plan.known[rows, :2].T.numpy(), "o", markersize=3, label=words, **look)
        left.plot(
            *plan.places[:, :2].T.numpy(),
            "o",
            markersize=8,
            color=style.ORANGE,
            clip_on=False,
            label="to measure, in this order",
        )
        numbers: dict[tuple[float, ...], list[str]] = {}
        for number, place in enumerate(plan.places.tolist(), 1):
            numbers.setdefault(tuple(place[:2]), []).append(str(number))
        for place, words in numbers.items():  # one above the other, for places at several heights
            left.annotate(
                "\n".join(words),
                place,
                ha="center",
                va="center",
                color="white",
                size=5 / len(words) ** 0.5,
            )
        left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        drawn.legend(loc="outside lower left", ncols=3)
        label = f"expected mean error [{plan.unit}]" if plan.unit else "expected mean error"
        for axis in right:
            axis.plot(plan.errors.numpy(), color=style.BLUE)
            axis.set(xlabel="new places", ylabel=label, ylim=(0, 1.05 * plan.errors.max().item()))
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.grid()
            axis.set_axisbelow(True)
    return drawn


def processes_of(model: Model) -> list[Process]:
    """The processes of a model's receivers; raises a ``ValueError`` for a model without."""
    found = [model.process_at(receiver) for receiver in range(len(model.scene.receivers))]
    processes = [process for process in found if process is not None]
    if not processes:
        raise ValueError(
            "a survey takes a process over places; take model=gaussian_process, or kriging=true for RSSI or spectra"
        )
    return processes


def default_process(points: Float[Tensor, "g 3"]) -> Process:
    """A process without readings and with an unknown constant: its places spread evenly over the
    points' box.
    """
    length = LENGTH * (points.amax(0) - points.amin(0)).norm().item() or 1.0
    return Process(lambda a, b: 100 + kernel(a, b, length), points[:0], points[:0, 0], NUGGET)


def with_trend(process: Process, receiver: Float[Tensor, "3"] | None) -> Process:
    """The process with the coefficients of its trend, which readings have to determine too.

    They are a constant and, for labels of one number, a slope over the logarithm of the distance to
    the receiver, with a standard deviation of twice that of the readings: as much as receivers of
    one survey may differ.
    """
    scale = (
        2
        * float(process.covariances(process.places[:1], process.places[:1])[0, 0] + process.noise)
        ** 0.5
    )
    decades = lambda places: (places[:, :3] - receiver).norm(dim=1).clamp_min(0.1).log10()
    middle = decades(process.places).mean() if receiver is not None else 0.0

    def covariances(a: Tensor, b: Tensor) -> Tensor:
        products = torch.ones(len(a), len(b), dtype=a.dtype, device=a.device)
        if receiver is not None:
            products = products + torch.outer(decades(a) - middle, decades(b) - middle)
        return process.covariances(a, b) + scale**2 * products

    return replace(process, covariances=covariances)


def posterior(process: Process, asked: Float[Tensor, "g d"]) -> Float[Tensor, "g g"]:
    """Covariances of the process at places, given its readings; of many an even part."""
    rows = evenly(torch.arange(len(process.places)), LIMIT).to(process.places.device)
    left, _ = process.whitened(asked, rows)
    return process.covariances(asked, asked) - left.mT @ left


def heard(processes: list[Process], asked: Float[Tensor, "g d"]) -> Float[Tensor, "r g"]:
    """Shares of the measured places around others that each receiver hears at the asked carrier, or
    the nearest one.
    """
    places = torch.cat([process.places for process in processes])
    if not len(places):
        return asked.new_ones(len(processes), len(asked))
    apart = (places[:, 3:] - asked[:1, 3:]).abs().sum(1)  # of carriers
    at_carrier = apart <= apart.min() + 1e-6
    own = torch.repeat_interleave(torch.tensor([len(process.places) for process in processes])).to(
        places.device
    )
    known, rows = places[at_carrier, :3].unique(dim=0, return_inverse=True)
    hears = known.new_zeros(len(known), len(processes))
    hears[rows, own[at_carrier]] = 1
    for receiver, process in enumerate(processes):
        if len(process.places) >= LIMIT:  # a part of its readings, so their places do not tell
            hears[:, receiver] = 1
    return reception_probability(asked, known, hears, hears.mean(0)).mT


def mean_of_heard(values: Float[Tensor, "r g"], hears: Float[Tensor, "r g"]) -> float:
    """Mean over links that are likely to be heard."""
    return ((values * hears).sum() / hears.sum()).item()


def without(
    processes: list[Process], asked: Float[Tensor, "g d"], factor: float
) -> tuple[Float[Tensor, "k 3"], float, Float[Tensor, " k"], Bool[Tensor, " k"]]:
    """Known places, the mean error, its rise without each of them, and those that together raise it
    by little.
    """
    rows = [
        evenly(torch.arange(len(process.places)), COMPARED).to(asked.device)
        for process in processes
    ]
    measured = [process.places[own, :3] for process, own in zip(processes, rows, strict=True)]
    known = torch.cat(measured).unique(dim=0)
    which = [distances(places, known).argmin(1) for places in measured]
    variances = lambda process: torch.cat(
        [process.covariances(x, x).diagonal() for x in asked.split(16)]
    )
    prior, hears = [variances(process) for process in processes], heard(processes, asked)

    def error(kept: Bool[Tensor, " k"]) -> float:
        parts = []
        for process, own, place, variance in zip(processes, rows, which, prior, strict=True):
            left, _ = process.whitened(asked, own[kept[place]])
            parts.append(((variance - left.square().sum(0)).clamp_min(0) + process.noise).sqrt())
        return mean_of_heard(torch.stack(parts), hears)

    losses = known.new_zeros(len(known))
    parts = zip(processes, rows, which, prior, hears, strict=True)
    for process, own, place, variance, likely in track(
        parts, "places to leave out", len(processes)
    ):
        left, root = process.whitened(asked, own)
        deviations = ((variance - left.square().sum(0)).clamp_min(0) + process.noise).sqrt()
        weights = torch.linalg.solve_triangular(root.mT, left, upper=True)
        inverse = torch.cholesky_inverse(root)
        for number in place.unique().tolist():  # all readings of a place go together
            there = (place == number).nonzero()[:, 0]
            gone = weights[there]
            # Variances rise by w' (inverse of these rows)^-1 w; roots by half of it over
            # themselves.
            rises = (gone * torch.linalg.solve(inverse[there[:, None], there], gone)).sum(0)
            losses[number] += likely @ (rises / (2 * deviations)) / hears.sum()
    order, before = (
        losses.argsort(),
        error(torch.ones(len(known), dtype=torch.bool, device=known.device)),
    )
    fewest, most = 0, len(known) - 1  # places that may, and may not be left out together
    superfluous = torch.zeros(len(known), dtype=torch.bool)
    while most - fewest > max(1, len(known) // 32):
        middle = (fewest + most) // 2
        kept = torch.ones(len(known), dtype=torch.bool, device=known.device)
        kept[order[:middle]] = False
        fewest, most = (middle, most) if error(kept) <= TOLERATED * before else (fewest, middle)
    superfluous[order[:fewest].cpu()] = True
    return known.float().cpu(), factor * before, factor * losses.cpu(), superfluous
