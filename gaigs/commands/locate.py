"""Localisation: where a transmitter is, by the value that receivers measure of it."""

import itertools
import json
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib import rc_context
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from torch import Tensor

from gaigs.calibration import fewest
from gaigs.core import stages
from gaigs.core.geometry import ExtrapolationWarning, Frame, even_places
from gaigs.core.query import ROUNDING, as_positions, as_receivers, as_tensor, evenly
from gaigs.core.task import Task, check_range
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.io.files import write_text
from gaigs.io.tables import find_file, read_table, refuse, shortened
from gaigs.kriging.links import distances, folds_of, reception_probability
from gaigs.model import Model
from gaigs.model.knn import COUNTS
from gaigs.registry import call, check_instance, check_type
from gaigs.report import style
from gaigs.runs import links_of, load
from gaigs.split import rows_of

POINTS, SECONDS, FEWEST = 20_000, 60.0, 1000
"""Candidate places; fewer, down to the last, where the model takes longer than the seconds for
them.
"""

ELSEWHERE = 0.1
"""Prior probability that a transmitter is not near a known place but anywhere in their box."""

HELD_OUT, SCORED, ENOUGH = 500, 200, 300
"""Most fingerprints of a fold whose errors give the axes, most that are located, and number after
which no fold is added."""

DEGREES, FEW = (0.25, 1.0, 4.0, 30.0), 20
"""Degrees of freedom of the likelihood to choose from, and fewest fingerprints that choose: fewer
hardly show whether one of twenty is an outlier. Levels then keep the likelihood of
``Fingerprints``, others take the heaviest tails."""

TEMPERS = tuple(2.0 ** (power / 2) for power in range(-8, 17))
"""Exponents of the likelihood to choose from."""

CHOICES = tuple(itertools.product(DEGREES, TEMPERS))

JUMP = 1e-4
"""Density of a move to any place over that of a move to the same one: a track may jump."""

KEPT, SPREAD = 1500, 75
"""Candidates of each value of a track that are linked to those before and after, and those over
which its own posterior spreads: regions of tracks reach far beyond the likeliest candidates."""

FARTHEST = 5.0
"""Deviations that a reading may be beyond all predictions without a warning, and half of their
range at least.
"""

CELLS = 1500
"""Most cells of the map of a posterior."""

STAYS = 10
"""Most values of a held-out track at each of its places."""


@dataclass(frozen=True, repr=False)
class Location:
    """Where transmitters may be, from ``locate``.

    Attributes:
        places: Candidate places (g, 3) [m].
        probabilities: Of each candidate, for each value (n, g).
        mean: Mean place of each value (n, 3) [m].
        median: Place with the least expected distance from the transmitter (n, 3) [m].
        likeliest: Place of the highest density (n, 3) [m].
        region: True for candidates in the region that holds the transmitter with the asked
            probability (n, g).
        sizes: Prior probability of each region (n,).
        calibrated: True if held-out fingerprints set the region; else the posterior does, often too
            small.
        frame: Place of x and y on a map; None if unknown.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> found = gaigs.locate(gaigs.train("knn", links), [-50.0, -48.0, -55.0, -61.0])
        >>> found.holds(found.likeliest)
        tensor([True])
        >>> found.save("locate.csv")
    """

    places: Float[Tensor, "g 3"]
    probabilities: Float[Tensor, "n g"]
    mean: Float[Tensor, "n 3"]
    median: Float[Tensor, "n 3"]
    likeliest: Float[Tensor, "n 3"]
    region: Bool[Tensor, "n g"]
    sizes: Float[Tensor, " n"]
    calibrated: bool
    frame: Frame | None = None

    def __repr__(self) -> str:
        count, place = len(self.median), ", ".join(f"{x:.2f}" for x in self.median[0].tolist())
        which = "transmitter" if count == 1 else f"{count} transmitters, the first"
        return f"<{which} near ({place}) m, in a region of {self.region[0].sum()} of {len(self.places)} candidates>"

    def holds(self, places: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """True for each value whose region holds a place: that has the candidate nearest to it."""
        near = distances(places.double(), self.places.double()).argmin(1)
        return self.region.gather(1, near[:, None])[:, 0]

    def save(self, path: str | Path) -> None:
        """Writes a CSV table of each value's mean, median and likeliest place, with a ``frame``
        also their eastings and northings, and the size of its region."""
        write_table(path, self.columns())

    def columns(self) -> dict[str, Tensor]:
        """Columns (n,) of ``save`` by their names."""
        found: dict[str, Tensor] = {}
        for name in ("mean", "median", "likeliest"):
            x, y, z = getattr(self, name).double().T
            found |= {f"{name}_x": x, f"{name}_y": y, f"{name}_z": z}
            if self.frame is not None:
                found |= {f"{name}_easting": self.frame.x + x, f"{name}_northing": self.frame.y + y}
        return found | {"region_share": self.sizes}


class Candidates(NamedTuple):
    """Candidate places, and what is known of them before anything is received.

    Attributes:
        places: (g, 3) [m].
        prior: Logarithm of each candidate's probability (g,).
        density: Logarithm of the prior density there, but for a constant (g,).
    """

    places: Float[Tensor, "g 3"]
    prior: Float[Tensor, " g"]
    density: Float[Tensor, " g"]


class Held(NamedTuple):
    """Held-out fingerprints in the map of a model that does not know them, by a likelihood chosen
    without them.

    Attributes:
        candidates: Of the map.
        likelihoods: Logarithms there, with known and with unknown power (2, n, g).
        truth: Their places (n, 3) [m].
    """

    candidates: Candidates
    likelihoods: Float[Tensor, "2 n g"]
    truth: Float[Tensor, "n 3"]


@dataclass(frozen=True, repr=False)
class Fingerprints:
    """Values that a model predicts at candidate places, from ``fingerprints``; ``locate`` looks a
    value up in them.

    Attributes:
        task: Of the values.
        frequency: Carrier [Hz]; None if unknown.
        receivers: Their names.
        candidates: Where the values are predicted, g places.
        axes: Of the numbers of a label, of independent errors of the same size (m, k).
        values: Predictions at the candidates along these axes (g, r, k).
        deviations: Standard deviations of labels of one number (g, r); else 1.
        hearing: Probability that each receiver hears a transmitter there (g, r); without links a
            half.
        degrees, temper: Of the likelihood, see ``log_likelihood``.
        held: Held-out fingerprints of each fold, which calibrate regions; empty without links.
        frame: Place of x and y on a map; None if unknown.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=500)
        >>> len(prints.candidates.places) == len(prints.values), prints.degrees in (0.25, 1, 4, 30)
        (True, True)
    """

    task: Task
    frequency: float | None
    receivers: Sequence[str]
    candidates: Candidates
    axes: Float[Tensor, "m k"]
    values: Float[Tensor, "g r k"]
    deviations: Float[Tensor, "g r"]
    hearing: Float[Tensor, "g r"]
    degrees: float = 4.0
    temper: float = 1.0
    held: tuple[Held, ...] = ()
    frame: Frame | None = None
    _drops: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        places, receivers, _ = self.values.shape
        return (
            f"<fingerprints of task {self.task.name!r}: {places} candidates, {receivers} receivers>"
        )

    def drops(self, unknown_power: bool = False, step: float | None = None) -> Float[Tensor, " h"]:
        """Logarithm of the best candidate's density over that at the true place, of held-out
        fingerprints, ascending.

        Options are those of ``locate``. With ``step`` fingerprints are values of walks, see
        ``walk``.
        """
        if (unknown_power, step) not in self._drops:
            found = [torch.zeros(0, dtype=torch.float64)]
            for own, likelihoods, truth in self.held:
                logarithms = likelihoods[int(unknown_power)] + own.prior.double()
                if step is not None:
                    order = walk(truth, step)
                    own, logarithms = track(
                        own, logarithms[order], step, torch.ones(len(order)).bool()
                    )
                    truth = truth[order]
                heights = logarithms - own.prior + own.density
                near = distances(truth.double(), own.places.double()).argmin(1)
                found.append(heights.amax(1) - heights.gather(1, near[:, None])[:, 0])
            self._drops[unknown_power, step] = torch.cat(found).sort().values
        return self._drops[unknown_power, step]


@torch.no_grad()
def fingerprints(
    model: Model,
    links: Links | None = None,
    region: object = None,
    frequency: float | None = None,
    points: int | None = None,
) -> Fingerprints:
    """The map of predictions in which ``locate`` looks values up; make it once for many of them.

    Args:
        model: Trained, fitted or loaded, with intervals.
        links: Links that the model was trained on. Transmitters are then likely where the known
            ones are dense, and held-out ones set the width of the likelihood and the size of
            regions. None: they are anywhere alike, and the errors of a label's numbers are
            independent, which makes regions too small.
        region: Two corners of a box ``[[x, y, z], [x, y, z]]`` [m] in which transmitters are
            anywhere alike; None: the box of the training transmitters.
        frequency: Carrier of known links, with a region any [Hz]; None: that of the training links,
            of several the middle one.
        points: Number of candidate places; None: 20,000, fewer where the model takes more than a
            minute for them.

    Raises:
        ValueError: The model has no intervals, or an option is impossible.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> prints = gaigs.fingerprints(gaigs.train("gaussian_process", links), links, points=500)
        >>> gaigs.locate(prints, [-50.0, -48.0, float("nan"), -61.0]).mean.shape
        torch.Size([1, 3])
    """
    check_instance("model", model, Model)
    check_type("points", points, int | None)
    scene = model.scene
    if links is not None:
        check_instance("links", links, Links)
        check_fit(links, scene)
    if points is not None and points < 2:
        raise ValueError(f"points must be at least 2 candidates, got {points}")
    box = (
        torch.stack((scene.lower, scene.upper))
        if region is None
        else as_positions("region", region).reshape(-1, 3)
    )
    if len(box) != 2:
        raise ValueError(
            f"region must be two corners [[x, y, z], [x, y, z]] [m], got {len(box)} points"
        )
    frequency = scene.middle_frequency if frequency is None else frequency
    if points is None:
        some = even_places(box[0], box[1], 512)
        predicted(model, some[:2], frequency)  # the first prediction compiles and loads
        start = time.perf_counter()
        predicted(model, some, frequency)
        points = min(POINTS, max(FEWEST, int(SECONDS * len(some) / (time.perf_counter() - start))))

    def mapped(one: Model, known: Tensor) -> Fingerprints:
        made = (
            candidates(box, points, scene.floors, links, known)
            if region is None
            else candidates(box, points)
        )
        values, deviations = predicted(one, made.places, frequency)
        axes, hears = torch.eye(values.shape[2]), torch.full(values.shape[:2], 0.5)
        if len(known) and tells:
            hears = reception_probability(made.places, *heard_places(links, known), prior=0.5)
        names = [receiver.name for receiver in scene.receivers]
        parts = scene.task, frequency, names, made, axes, values, deviations, hears
        return Fingerprints(*parts, frame=scene.frame)

    known = tested = torch.zeros(0).long()
    if links is not None:
        known, tested = (
            at_carrier(links, frequency, *parts) for parts in (("train", "validation"), ("test",))
        )
    if links is not None and region is None and not len(known):
        carriers = ", ".join(f"{carrier:.7g}" for carrier in scene.frequencies.tolist())
        raise ValueError(
            f"frequency must be that of known links, {carriers} Hz, got {frequency:.7g}; or give a region"
        )
    # A receiver may have no link of a transmission because that is in the test.
    tells = (
        links is None or not torch.isin(*(rows_of(links)[part] for part in (known, tested))).any()
    )
    whole = mapped(model, known)
    tries: list[Any] = []
    unknown = () if links is None else model.unseen(links)
    for one, part, others in stages.track(unknown, "folds", model.fold_count):
        one.calibration = model.calibration
        rows = rows_of(links)  # those known links that share a transmission with the part
        asked, truth = received(links, known[torch.isin(rows[known], rows[part])])
        some, others = evenly(torch.arange(len(truth)), HELD_OUT), others[torch.isin(others, known)]
        if len(some) and (len(others) or region is not None):
            errors = asked[some] - predicted(one, truth[some], frequency)[0]
            if region is not None:  # a value from elsewhere is not like those that will be asked
                some = some[((truth[some] >= box.amin(0)) & (truth[some] <= box.amax(0))).all(1)]
            tries.append((mapped(one, others), asked[some], truth[some], errors))
        if sum(min(len(places), SCORED) for _, _, places, _ in tries) >= ENOUGH:
            break
    if len(tries) == 1 and len(tries[0][1]) > 1:
        one, *parts = tries[0]
        tries = [(one, *(part[half::2] for part in parts)) for half in range(2)]
    held = []
    for number, (one, asked, truth, _) in enumerate(tries):
        # Axes of the other errors: along those of its own a value would be too near.
        one = along(one, [errors for other, (*_, errors) in enumerate(tries) if other != number])
        some = evenly(torch.arange(len(truth)), SCORED)
        both = [squares(one, asked[some] @ one.axes, unknown) for unknown in (False, True)]
        if len(some):
            held.append(Try(one, both, truth[some]))
    whole = along(whole, [errors for *_, errors in tries])
    return fitted(whole, held) if held else whole


@torch.no_grad()
def locate(
    model: Model | Fingerprints,
    value: object,
    links: Links | None = None,
    region: object = None,
    unknown_power: bool = False,
    step: float | None = None,
    level: float = 0.9,
) -> Location:
    """Places where transmitters may be, by the values that receivers measure of them.

    Args:
        model: A model with intervals; or its ``fingerprints``, which then take a few milliseconds a
            value.
        value: A label of each receiver (r, *shape), or those of several transmissions (n, r,
            *shape), scaled as the training labels; with one receiver also (*shape) or (n, *shape);
            or a mapping of the receivers' names to their labels, (*shape) or (n, *shape). NaN, of
            channels also zeros, where a receiver has not heard it, as if a mapping lacks it; of a
            track, a value may be unheard by all.
        links, region: As for ``fingerprints``.
        unknown_power: True if all labels of a transmission share an unknown offset [dB], or factor
            of amplitudes. Channels are always compared without their power and phase.
        step: Standard deviation of the move from one value to the next along each axis, if values
            are a track [m].
        level: Probability with which the region holds the transmitter, by held-out fingerprints (9
            or more for 0.9), with ``step`` by walks among them, once for each step. With fewer and
            without links the posterior counts, whose regions are often too small.

    Raises:
        ValueError: A value has another shape than the labels, or was heard by no receiver and is no
            part of a track; or an option is impossible.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> prints = gaigs.fingerprints(gaigs.train("gaussian_process", links), links, points=500)
        >>> walk = [[-50.0, -48.0, -55.0, -61.0], [-51.0, -47.0, -56.0, -60.0]]  # [dBm]
        >>> found = gaigs.locate(prints, walk, step=0.5)
        >>> found.mean.shape, found.region.shape == (2, len(found.places))
        (torch.Size([2, 3]), True)

    Source: Haeberlen et al., Practical robust localization over large-scale 802.11 wireless
    networks, 2004, for the posterior over places; Rabiner, A tutorial on hidden Markov models,
    1989, for tracks.
    """
    if isinstance(model, Fingerprints):
        if links is not None or region is not None:
            raise ValueError("fingerprints have their links and region; leave links and region out")
        prints = model
    else:
        prints = fingerprints(model, links, region)
    asked = as_fingerprints(value, prints, step is not None)
    if not prints.task.shape and not unknown_power:
        lowest, highest = prints.values.aminmax()
        beyond = torch.maximum(asked - highest, lowest - asked).nan_to_num(0)
        if beyond.max() > max(FARTHEST * prints.deviations.max(), (highest - lowest) / 2):
            unit = getattr(prints.task, "error_unit", prints.task.unit)
            words = f"readings are up to {beyond.max():.3g} {unit} beyond all predicted ones"
            advice = "check their unit, and leave out what was not heard"
            warnings.warn(
                f"{words}; {advice}", ExtrapolationWarning, stacklevel=3
            )  # as of a radio map
    return posterior(prints, asked, unknown_power, step, level)


def posterior(
    prints: Fingerprints,
    asked: Float[Tensor, "n r m"],
    unknown_power: bool,
    step: float | None,
    level: float,
) -> Location:
    """``locate`` for the fingerprints of values."""
    check_type("level", level, float)
    check_type("step", step, float | None)
    if not 0 < level < 1:
        raise ValueError(f"level must be a probability between 0 and 1 such as 0.9, got {level!r}")
    if step is not None and not 0 < step < math.inf:
        raise ValueError(f"step must be above 0 m, got {step!r}")
    step = step if len(asked) > 1 else None  # one value is no track
    drops, count = prints.drops(unknown_power, step), sum(len(one.truth) for one in prints.held)
    calibrated, found = count >= fewest(level), []
    # In parts: a value takes 60 bytes a candidate, and its posterior 9. A track is one part.
    for part in asked.split(64 if step is None else len(asked)):
        logarithms = log_likelihood(
            *squares(prints, part @ prints.axes, unknown_power), prints.degrees, prints.temper
        )
        own, logarithms = prints.candidates, logarithms + prints.candidates.prior
        if step is not None:
            own, logarithms = track(own, logarithms, step, ~part.isnan().all((1, 2)))
        probabilities, heights = torch.softmax(logarithms, 1), logarithms - own.prior + own.density
        order = heights.argsort(1, descending=True)
        ordered = probabilities.gather(1, order)
        region = torch.zeros_like(order, dtype=torch.bool).scatter(
            1, order, ordered.cumsum(1) - ordered < level
        )
        if count:
            rank = min(math.ceil(level * (count + 1) / count * len(drops)), len(drops))
            near = heights >= heights.gather(1, order[:, :1]) - drops[rank - 1]
            region = near if calibrated else near | region
        mean = (probabilities @ own.places.double()).float()
        median = torch.cat([geometric_median(own.places, some) for some in probabilities.split(64)])
        sizes = (region * own.prior.softmax(0)).sum(1)
        found.append((probabilities, mean, median, own.places[order[:, 0]], region, sizes))
    probabilities, mean, median, likeliest, region, sizes = map(torch.cat, zip(*found, strict=True))
    return Location(
        own.places, probabilities, mean, median, likeliest, region, sizes, calibrated, prints.frame
    )


def run(config: dict, folder: Path) -> None:
    """Locates the transmitters of received values, or those of a finished run's test; writes
    ``locate.csv``, ``locate.png`` and, of a test, ``locate.json`` into a folder."""
    if config["folder"] is None:
        raise ValueError("command=locate needs the folder of a finished run; add folder=runs/...")
    model, links = (
        load(config["folder"], config["trust"]),
        links_of(config["folder"], config["trust"]),
    )
    options = dict(config["locate"])
    own, value = (
        {name: options.pop(name) for name in ("region", "frequency", "points")},
        options.pop("value"),
    )
    value = read_value(Path(value), links) if isinstance(value, str) else value
    start = time.perf_counter()
    prints = call("locate", fingerprints, own, model=model, links=links)
    made = time.perf_counter() - start
    index, rows = (
        at_carrier(links, prints.frequency, *parts)
        for parts in (("test",), ("train", "validation"))
    )
    known, places = received(links, rows)
    if value is not None:
        found = call("locate", locate, options, model=prints, value=value)
        folder.mkdir(parents=True, exist_ok=True)
        found.save(folder / "locate.csv")
        style.save(map_figure(found, options["level"]), folder / "locate.png")
        print(str(found)[1:-1])
        conclude(prints, found, options["level"], folder)
        return
    if not len(index):
        raise ValueError(
            "the run has no test links at this carrier; take another split or locate.frequency"
        )
    asked, truth = received(links, index)
    start = time.perf_counter()
    found = call("locate", posterior, options, prints=prints, asked=asked)
    taken = time.perf_counter() - start
    _, groups = places.unique(dim=0, return_inverse=True)
    strip = without_power if options["unknown_power"] else lambda prints: prints
    guess = neighbours(strip(asked), strip(known), places, groups)
    guesses = {
        "mean": found.mean,
        "median": found.median,
        "likeliest": found.likeliest,
        "knn": guess,
    }
    errors = {name: (guess - truth).norm(dim=1) for name, guess in guesses.items()}
    numbers: dict[str, Any] = {
        name: {"median_m": error.median().item(), "mean_m": error.mean().item()}
        for name, error in errors.items()
    }
    numbers = {"locate": numbers.pop("mean"), **numbers}
    numbers["locate"] |= {
        f"region_{100 * options['level']:g}": found.holds(truth).double().mean().item(),
        f"share_{100 * options['level']:g}": found.sizes.mean().item(),
        "milliseconds": 1e3 * taken / len(truth),
    }
    numbers |= {"transmissions": len(truth), "candidates": len(prints.values), "map_seconds": made}
    numbers["calibrated"] = found.calibrated
    numbers |= {"task": links.task.name, "split": links.split.name}
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "locate.json", json.dumps(numbers, indent=2) + "\n")
    named = lambda places, prefix: {
        f"{prefix}{axis}": column for axis, column in zip("xyz", places.T, strict=True)
    }
    own_errors = {f"{name}_error": error for name, error in errors.items()}
    write_table(
        folder / "locate.csv",
        named(truth, "") | found.columns() | named(guess, "knn_") | own_errors,
    )
    style.save(figure(truth, found.mean, places, errors), folder / "locate.png")
    shown = numbers["locate"], numbers["knn"]
    words = (f"median {part['median_m']:.3g} m, mean {part['mean_m']:.3g} m" for part in shown)
    print(f"{len(truth)} transmitters: {'; nearest neighbours '.join(words)}")
    conclude(prints, found, options["level"], folder)


def conclude(prints: Fingerprints, found: Location, level: float, folder: Path) -> None:
    """Prints what a user has to know of the results in a folder."""
    if not found.calibrated:
        count = sum(len(one.truth) for one in prints.held)
        print(
            f"regions are not calibrated: {count} fingerprints are held out, and {fewest(level)} needed"
        )
    if found.frame is not None:
        print(f"easting and northing are those of EPSG:{found.frame.epsg}")
    print(f"results: {folder}")


def read_value(file: Path, links: Links) -> object:
    """Values for ``locate`` from a file: an array (n, r, *shape) of NumPy or, of RSSI, a table with
    a column for each receiver's name, whose cells are empty where it has not heard a value."""
    content = "received values" if links.task.is_scalar else "a .npy array of received values"
    file = find_file(file, content, "locate.value")
    if file.suffix.lower() == ".npy":
        try:
            return np.load(file, allow_pickle=False)
        except (ValueError, EOFError):
            raise ValueError(f"{file} must be {content}, and is no array of numbers") from None
    if not links.task.is_scalar:
        raise ValueError(
            f"locate.value must be a .npy array of labels of each receiver, got {file}"
        )
    table = read_table(file, "a heading with names of receivers, and one value a line")
    names = [receiver.name for receiver in links.receivers]
    if others := [name for name in table.names if name not in names]:
        raise ValueError(
            f"{file}, line 1: expected names of receivers, {shortened(names)}, got {shortened(others)}"
        )
    bad = np.isinf(table.numbers)
    wrong = {
        row + 2: table.cell(row, int(bad[row].argmax())) for row in bad.any(1).nonzero()[0].tolist()
    }
    refuse(file, wrong, "a level [dBm], or an empty cell")
    return dict(zip(table.names, table.numbers.T, strict=True))


def write_table(path: str | Path, columns: Mapping[str, Tensor]) -> None:
    """Writes columns as a CSV table, rounded to six decimals."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = (",".join(f"{round(x, 6):.12g}" for x in row) for row in rows)
    write_text(Path(path), "\n".join((",".join(columns), *lines, "")))


def map_figure(found: Location, level: float) -> Figure:
    """Where the transmitters are from above: the probability of cells, of a single value also its
    region.
    """
    places, weights = (
        found.places[:, :2].double().numpy(),
        found.probabilities.mean(0).double().numpy(),
    )
    low, high = np.quantile(places, (0.001, 0.999), 0)
    spare = np.maximum(0, 0.15 * ((high - low).max() or 1.0) - (high - low)) / 2  # of a corridor
    low, high = low - spare, high + spare
    pitch = math.sqrt((high - low).prod() / min(CELLS, len(places) / 8))
    across, up = (
        np.arange(start, end + pitch, pitch) for start, end in zip(low, high, strict=True)
    )
    middles = [(lines[1:] + lines[:-1]) / 2 for lines in (across, up)]
    counted = lambda weights: (
        np.histogram2d(places[:, 0], places[:, 1], (across, up), weights=weights)[0].T
    )
    with rc_context(style.STYLE):
        drawn = Figure(figsize=(0.6 * style.PAGE, 0.6 * style.PAGE), layout="compressed")
        axis = drawn.subplots()
        # Smooth over neighbouring cells: they hold different numbers of candidates.
        image = axis.pcolormesh(
            across, up, 100 * gaussian_filter(counted(weights), 1), cmap="Blues", rasterized=True
        )
        drawn.colorbar(image, ax=axis, location="bottom", label="probability of a cell [%]")
        axis.plot(*found.mean[:, :2].T.numpy(), "o", markersize=4, color=style.ORANGE, label="mean")
        if len(found.mean) == 1:
            inside = gaussian_filter(
                (counted(found.region[0].double().numpy()) > 0).astype(float), 1
            )
            axis.contour(*middles, inside, [0.3 * inside.max()], colors=style.GREY, linewidths=0.8)
            axis.plot([], [], color=style.GREY, lw=0.8, label=f"region of {100 * level:g} %")
        axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        drawn.legend(loc="outside lower left", ncols=3)
    return drawn


def figure(
    truth: Float[Tensor, "n 3"],
    mean: Float[Tensor, "n 3"],
    known: Float[Tensor, "k 3"],
    errors: dict[str, Tensor],
) -> Figure:
    """Transmitters from above with their estimates, and the shares of errors below a distance."""
    with rc_context(style.STYLE):
        drawn = Figure(figsize=(style.PAGE, 0.46 * style.PAGE), layout="compressed")
        left, right = drawn.subplots(1, 2)
        left.plot(
            *known[:, :2].T.numpy(), "o", markersize=1.5, color=style.GREY, label="known places"
        )
        some = evenly(torch.arange(len(truth)), 150)
        left.plot(
            *torch.stack((truth[some], mean[some]))[..., :2].permute(2, 0, 1).numpy(),
            color=style.ORANGE,
            lw=0.6,
        )
        left.plot(
            *truth[some, :2].T.numpy(), "o", markersize=3, color=style.BLUE, label="transmitters"
        )
        left.plot(
            *mean[some, :2].T.numpy(), "o", markersize=3, color=style.ORANGE, label="estimates"
        )
        left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        shares = (torch.arange(len(truth)) + 0.5) / len(truth)
        neighbours, _ = style.looks(["knn"])["knn"]
        for name, colour, words in (
            ("mean", style.ORANGE, "estimates"),
            ("knn", neighbours, "nearest neighbours"),
        ):
            right.plot(
                errors[name].sort().values.numpy(), shares.numpy(), color=colour, label=words
            )
        right.set(xlabel="error [m]", ylabel="share of transmitters", ylim=(0, 1), xlim=(0, None))
        right.grid()
        right.set_axisbelow(True)
        right.legend(loc="lower right")
        drawn.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=3)
    return drawn


# --- the map ---


def candidates(
    box: Float[Tensor, "2 3"],
    points: int,
    floors: Sequence[float] | Float[Tensor, " f"] = (),
    links: Links | None = None,
    known: Int[Tensor, " k"] | None = None,
) -> Candidates:
    """A grid in the box or on separate floors, with links denser about known places.

    The density about known places is a sum of normal ones, each on its floor. Places of other folds
    are most likely under their width.
    """
    if links is None:
        places = even_places(box[0], box[1], points, floors)
        return Candidates(
            places, torch.full((len(places),), -math.log(len(places))), torch.zeros(len(places))
        )
    sites, which = links.query.transmitters[known].double().unique(dim=0, return_inverse=True)
    folds = torch.zeros(len(sites), dtype=torch.long).index_copy(0, which, folds_of(links, known))
    edges = (box[1] - box[0]).double()
    edges[2] *= not len(floors)
    extended = edges > 1e-3 * edges.max()
    dimensions, volume = int(extended.sum()), edges[extended].prod() * max(1, len(floors))
    floor_of = lambda places: (places[:, 2:] - floors).abs().argmin(1)

    def log_density(asked: Tensor, width: float, own: Tensor | None = None) -> Tensor:
        squared = distances(asked[:, extended], sites[:, extended]).square_()
        if len(floors):
            squared = squared.masked_fill(floor_of(asked)[:, None] != floor_of(sites), math.inf)
        if own is not None:
            squared = squared.masked_fill(own[:, None] == folds, math.inf)
        size = (
            math.log(1 - ELSEWHERE)
            - math.log(len(sites))
            - dimensions * math.log(width * math.sqrt(2 * math.pi))
        )
        near = torch.logsumexp(squared / (-2 * width**2), 1) + size
        return torch.logaddexp(near, (ELSEWHERE / volume).log())

    some = evenly(torch.arange(len(sites)), POINTS // 20)
    widths = torch.logspace(
        math.log10(links.scene.spacing / 4), math.log10(edges.norm()), 24
    ).tolist()
    width = max(
        widths, key=lambda width: log_density(sites[some], width, folds[some]).mean().item()
    )
    even, count = even_places(box[0], box[1], max(1, points // 4), floors), points - points // 4
    noise = width * extended * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    places = torch.cat((even, (sites[torch.arange(count) * len(sites) // count] + noise).float()))
    shares = torch.tensor([ELSEWHERE / len(even), (1 - ELSEWHERE) / count]).log()
    density = torch.cat([log_density(part.double(), width) for part in places.split(1024)])
    return Candidates(
        places, shares.repeat_interleave(torch.tensor([len(even), count])), density.float()
    )


def predicted(
    model: Model, places: Float[Tensor, "g 3"], frequency: float | None
) -> tuple[Float[Tensor, "g r m"], Float[Tensor, "g r"]]:
    """A model's values at places for all receivers, as ``task.fingerprint`` has them, and their
    deviations.
    """
    count, task = len(model.scene.receivers), model.scene.task
    found, deviations = [], []
    # A look-up reads its labels once a batch.
    size = 8192 if not task.shape else 64 if model.is_trained else 512
    with warnings.catch_warnings(
        action="ignore", category=ExtrapolationWarning
    ):  # prior places may be outside
        for part in stages.track(places.split(max(1, size // count)), "fingerprints"):
            asked = part[:, None].expand(-1, count, 3), torch.arange(count).expand(len(part), -1)
            if task.shape:
                value = (
                    model.predict(*asked, frequency=frequency, batch_size=size).cpu().flatten(0, 1)
                )
                deviations.append(torch.ones(len(part), count))
            else:
                estimate = model.predict(*asked, frequency=frequency, batch_size=size, interval=0.5)
                value = estimate.value.cpu().flatten()
                deviations.append(estimate.std.cpu())
            found.append(task.fingerprint(value).unflatten(0, (len(part), count)))
    return torch.cat(found), torch.cat(deviations)


def along(prints: Fingerprints, errors: list[Float[Tensor, "_ r m"]]) -> Fingerprints:
    """Fingerprints along the axes of some errors; without any along those of their own differences."""
    if not prints.task.shape:
        return replace(prints, axes=torch.eye(1))
    values = torch.cat(errors or [prints.values - prints.values.mean(0)]).flatten(0, 1)
    axes = independent(values[~values.isnan().any(1)])
    return replace(prints, axes=axes, values=prints.values @ axes)


def at_carrier(links: Links, frequency: float | None, *parts: str) -> Int[Tensor, " k"]:
    """Links of some parts of the split at a carrier."""
    index = torch.cat([getattr(links.split, part) for part in parts])
    if frequency is None or links.query.frequencies is None:
        return index
    return index[(links.query.frequencies[index] / frequency - 1).abs() < ROUNDING]


def received(
    links: Links, index: Int[Tensor, " k"]
) -> tuple[Float[Tensor, "n r m"], Float[Tensor, "n 3"]]:
    """Fingerprints of the transmissions of some links, NaN where a receiver has none, and their
    places.
    """
    rows, which = rows_of(links)[index].unique(return_inverse=True)
    own = torch.cat([links.task.fingerprint(links.labels[part]) for part in index.split(256)])
    found = own.new_full((len(rows), len(links.receivers), own.shape[1]), math.nan)
    found[which, links.query.receivers[index]] = own
    places = torch.zeros(len(rows), 3)
    places[which] = links.query.transmitters[index]
    return found, places


def heard_places(
    links: Links, index: Int[Tensor, " k"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n r"]]:
    """Places of the transmissions of some links, and 1 for each receiver that has a link of them,
    else 0.
    """
    rows, which = rows_of(links)[index].unique(return_inverse=True)
    places, hears = torch.zeros(len(rows), 3), torch.zeros(len(rows), len(links.receivers))
    places[which], hears[which, links.query.receivers[index]] = links.query.transmitters[index], 1
    return places, hears


def as_fingerprints(
    value: object, prints: Fingerprints, is_track: bool = False
) -> Float[Tensor, "n r m"]:
    """The fingerprints of values that a user gives; raises a ``ValueError`` for other shapes.

    A track may have values that no receiver has heard.
    """
    shape, count = tuple(prints.task.shape), prints.values.shape[1]
    if isinstance(value, Mapping):
        if not value:
            raise ValueError("value must have the label of one receiver or more, got none")
        which = as_receivers([*value], prints.receivers)
        parts = as_tensor(
            "value", [*value.values()], "a label, or as many labels, of each receiver"
        )
        kind = torch.promote_types(parts.dtype, torch.float32)
        whole = torch.full((count, *parts.shape[1:]), math.nan, dtype=kind)
        whole[which] = parts.detach().cpu().to(kind)
        value = whole.transpose(0, 1) if parts.ndim == 2 + len(shape) else whole
    given = as_tensor("value", value, f"labels of {count} receivers").detach().cpu()
    if given.is_complex() != prints.task.dtype.is_complex and not given.isnan().all():
        raise ValueError(
            f"value must have {'complex' if prints.task.dtype.is_complex else 'real'} labels"
        )
    given = given.to(prints.task.dtype)
    is_single = (
        count == 1
        and tuple(given.shape[given.ndim - len(shape) :]) == shape
        and given.ndim <= 1 + len(shape)
    )
    values = given.reshape(-1, 1, *shape) if is_single else given
    values = values[None] if values.ndim == 1 + len(shape) else values
    if values.ndim != 2 + len(shape) or values.shape[1:] != (count, *shape) or not len(values):
        need = f"{(count, *shape)} or {('n', count, *shape)}, a label of each receiver"
        raise ValueError(f"value must be {need}, got {tuple(given.shape)}")
    flat = values.reshape(*values.shape[:2], -1)
    missing = flat.isnan().any(2) | ((flat == 0).all(2) if values.is_complex() else False)
    silent = missing.all(1)
    if silent.all() if is_track else silent.any():
        raise ValueError(
            f"value {int(silent.int().argmax())} was heard by no receiver; leave it out, or give step of a track"
        )
    if not flat[~missing].isfinite().all():
        raise ValueError("value must be finite, or NaN where a receiver has not heard it")
    check_range(prints.task, values.flatten(0, 1), "value")
    found = prints.task.fingerprint(values.flatten(0, 1)).unflatten(0, values.shape[:2])
    return found.masked_fill(missing[..., None], math.nan)


# --- likelihood ---


def independent(errors: Float[Tensor, "n m"]) -> Float[Tensor, "m k"]:
    """Axes along which errors of a label's numbers are independent, scaled to a mean square of 1 a
    label.

    Source: Ledoit and Wolf, A well-conditioned estimator for large-dimensional covariance matrices,
    2004.
    """
    errors = errors[evenly(torch.arange(len(errors)), 4000)].double()
    if not errors.any():
        return torch.eye(errors.shape[1])
    sizes, vectors = torch.linalg.eigh(errors.mT @ errors / len(errors))
    scatter = (errors.square().sum(1).square().mean() - sizes.square().sum()) / len(errors)
    share = (
        (scatter / (sizes - sizes.mean()).square().sum()).nan_to_num(1.0).clamp(0, 1)
    )  # 0 / 0 if all are equal
    sizes = (1 - share) * sizes.clamp_min(0) + share * sizes.mean()
    axes = (
        vectors / sizes.clamp_min(1e-6 * sizes.max()).sqrt()
    )  # numbers that never err have no infinite weight
    return (axes / (errors @ axes).square().sum(1).mean().sqrt()).float()


def squares(
    prints: Fingerprints, asked: Float[Tensor, "n r k"], unknown_power: bool = False
) -> tuple[Float[Tensor, "n g"], Float[Tensor, "n g"], Float[Tensor, " n"], Float[Tensor, "n g"]]:
    """Squared distances of values from the candidates' over the deviations, sums of the deviations'
    logarithms, numbers of receivers, and logarithms of the probability that these receivers hear
    the value and no other; with ``unknown_power`` the least distance with any offset of the value,
    or any factor of the prediction, which a factor of the value leaves as it is, and 0 in place of
    these logarithms."""
    shape = len(asked), len(prints.values)
    total, logarithms, count = torch.zeros(shape), torch.zeros(shape), torch.zeros(len(asked))
    with_all, alone, powers = torch.zeros(shape), torch.zeros(shape), torch.zeros(len(asked), 1)
    for receiver in range(asked.shape[1]):
        heard = ~asked[:, receiver, 0].isnan()
        own, values, deviations = (
            asked[heard, receiver],
            prints.values[:, receiver],
            prints.deviations[:, receiver],
        )
        count[heard] += 1
        if not prints.task.shape:
            deviations = deviations.clamp_min(
                ROUNDING * values.abs().max()
            )  # of labels without any error
            errors = (own - values[:, 0]) / deviations
            total[heard] += errors.square()
            with_all[heard] += errors / deviations
            alone[heard] += deviations.square().reciprocal()
            logarithms[heard] += deviations.log()
            continue
        with_all[heard] += own @ values.mT
        alone[heard] += values.square().sum(1)
        powers[heard] += own.square().sum(1, keepdim=True)
    tiny = torch.finfo(torch.float32).tiny
    if (
        prints.task.shape and unknown_power
    ):  # the part of the value that no factor of the prediction gives
        total = alone.mean(1, keepdim=True) * (
            1 - with_all.clamp_min(0).square() / (alone * powers).clamp_min(tiny)
        )
    elif prints.task.shape:
        total = alone - 2 * with_all + powers
    elif unknown_power:
        total, count = total - with_all.square() / alone.clamp_min(tiny), count - 1
    hears = (~asked[..., 0].isnan()).float()
    likely = hears @ prints.hearing.log().mT + (1 - hears) @ (-prints.hearing).log1p().mT
    # Of a track, a value that no receiver has heard may not have been sent.
    return (
        total.clamp_min(0),
        logarithms,
        count,
        likely * (count > 0)[:, None] * (not unknown_power),
    )


def log_likelihood(
    total: Float[Tensor, "n g"],
    logarithms: Float[Tensor, "n g"],
    count: Float[Tensor, " n"],
    likely: Float[Tensor, "n g"],
    degrees: float,
    temper: float,
) -> Float[Tensor, "n g"]:
    """Student's t of all receivers together, to the power ``temper``, and who hears; arguments are
    from ``squares``.

    The t lets one unlike place or receiver count little. The exponent stands for what the errors of
    receivers have in common, and for what ``axes`` miss.
    """
    together = (degrees + count[:, None]) / 2 * torch.log1p(total / degrees) + logarithms
    return (likely - temper * together).double()


class Try(NamedTuple):
    """Held-out values: ``squares`` of them in the map of a model that does not know them, and their
    places (n, 3).

    The squares are those with known and with unknown power.
    """

    prints: Fingerprints
    squares: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]]
    truth: Float[Tensor, "n 3"]

    def score(self, degrees: float, temper: float) -> float:
        """Sum of the energy scores of the posteriors by a likelihood.

        Source: Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation,
        2007, section 4.3.
        """
        places, prior, _ = self.prints.candidates
        probabilities = torch.softmax(log_likelihood(*self.squares[0], degrees, temper) + prior, 1)
        rng = torch.Generator().manual_seed(0)
        drawn = places[torch.multinomial(probabilities, 128, True, generator=rng)]
        apart = (drawn[:, ::2] - drawn[:, 1::2]).norm(dim=2).mean(1)
        return ((drawn - self.truth[:, None]).norm(dim=2).mean(1) - apart / 2).sum().item()


def fitted(prints: Fingerprints, tries: Sequence[Try]) -> Fingerprints:
    """The likelihood with the least energy score of held-out values, and these values by that of
    the other folds; few labels of one number keep that of ``prints``."""
    choices = CHOICES
    if sum(len(one.truth) for one in tries) < FEW:
        choices = (
            CHOICES[: len(TEMPERS)] if prints.task.shape else ((prints.degrees, prints.temper),)
        )
    scores = torch.tensor([[one.score(*choice) for choice in choices] for one in tries])
    degrees, temper = choices[int(scores.sum(0).argmin())]
    held = []
    for one, own in zip(tries, scores, strict=True):
        choice = choices[int((scores.sum(0) - own if len(tries) > 1 else own).argmin())]
        likelihoods = torch.stack([log_likelihood(*part, *choice).float() for part in one.squares])
        held.append(Held(one.prints.candidates, likelihoods, one.truth))
    return replace(prints, degrees=degrees, temper=temper, held=tuple(held))


def walk(places: Float[Tensor, "n 3"], step: float) -> Int[Tensor, " k"]:
    """A walk through places, always to the nearest one that is left.

    It stays for as many values as moves of ``step`` along each axis take to the next place: errors
    of values that are received near each other have much in common.
    """
    apart, left = distances(places, places), torch.ones(len(places), dtype=torch.bool)
    order, moves = [0], []
    left[0] = False
    while left.any():
        move, following = apart[order[-1]].masked_fill(~left, math.inf).min(0)
        left[following] = False
        order.append(int(following))
        moves.append(move)
    stays = round(float(torch.stack(moves).median()) / (step * math.sqrt(3))) if moves else 1
    return torch.tensor(order).repeat_interleave(min(max(1, stays), STAYS))


def track(
    candidates: Candidates, logarithms: Float[Tensor, "n g"], step: float, heard: Bool[Tensor, " n"]
) -> tuple[Candidates, Float[Tensor, "n j"]]:
    """An even part of the candidates, and the posterior of a track there.

    Posteriors of single values, ``logarithms``, still spread over ``SPREAD`` of them, so that
    ``KEPT`` hold them.
    """
    spread = torch.softmax(logarithms[heard], 1).square().sum(1).reciprocal().median()
    some = torch.arange(0, len(candidates.places), max(1, int(spread / SPREAD)))
    part = Candidates(*(each[some] for each in candidates))
    # Single precision halves the time; across a room it moves the mean by less than a micrometre.
    own, places = logarithms[:, some], (part.places - part.places.mean(0)).float()
    return part, smoothed((own - own.amax(1, keepdim=True)).float(), places, step, heard).to(
        logarithms
    )


def geometric_median(
    places: Float[Tensor, "g 3"], probabilities: Float[Tensor, "n g"]
) -> Float[Tensor, "n 3"]:
    """Places with the least mean distance from the candidates, weighted by each row of
    probabilities.

    Source: Weiszfeld, Sur le point pour lequel la somme des distances de n points donnés est
    minimum, 1937.
    """
    places = places.double()
    found = probabilities @ places
    for _ in range(100):
        weights = probabilities / distances(found, places).clamp_min(
            1e-3
        )  # [m]: a candidate may be the place itself
        before, found = found, weights @ places / weights.sum(1, keepdim=True)
        if (found - before).abs().max() < 1e-3:
            break
    return found.float()


def smoothed(
    logarithms: Float[Tensor, "n g"],
    places: Float[Tensor, "g 3"],
    step: float,
    heard: Bool[Tensor, " n"],
) -> Float[Tensor, "n g"]:
    """Posterior of each place of a track given all values, from those given each value alone:
    forward and backward.

    While no value is ``heard``, the track is near the line between the likeliest places before and
    after.
    """
    hearing, numbers = heard.nonzero()[:, 0], torch.arange(len(heard))
    after = torch.searchsorted(hearing, numbers).clamp_max(len(hearing) - 1)
    before = (torch.searchsorted(hearing, numbers, right=True) - 1).clamp_min(0)
    ends, gaps = (
        places[logarithms[hearing].argmax(1)],
        (hearing[after] - hearing[before]).clamp_min(1),
    )
    parts = ((numbers - hearing[before]) / gaps).clamp(0, 1)[:, None].to(places)
    lines = torch.lerp(ends[before], ends[after], parts)
    chosen = torch.where(heard[:, None], logarithms, -distances(lines, places))
    indices = chosen.topk(min(KEPT, len(places)), dim=1).indices
    best = logarithms.gather(1, indices)
    spacing = (
        distances(places[indices[0]], places[indices[0]]).fill_diagonal_(math.inf).amin(1).median()
    )
    step = math.hypot(step, spacing.item())  # candidates are no finer

    known: list[Tensor] = []

    def moved(logarithm: Tensor, first: Tensor, second: Tensor) -> Tensor:
        if not known or not all(map(torch.equal, known, (first, second))):  # a walk may stay
            moves = (distances(places[second], places[first]) / step).square_().div_(-2)
            known[:] = (
                first,
                second,
                moves.clamp_min_(-30).exp_().add_(JUMP),
            )  # less is no number beside JUMP, and slow
        moves = known[2]
        return (
            moves @ (logarithm - logarithm.max()).exp()
        ).log()  # above 0: each move may be a jump

    forward, backward = [best[0]], [torch.zeros_like(best[0])]
    for own, pair in zip(best[1:], itertools.pairwise(indices), strict=True):
        forward.append(own + moved(forward[-1], *pair))
    for own, pair in zip(best.flip(0), itertools.pairwise(indices.flip(0)), strict=False):
        backward.append(moved(own + backward[-1], *pair))
    found = torch.stack(forward) + torch.stack(backward[::-1])
    return torch.full_like(logarithms, -math.inf).scatter(1, indices, found)


def without_power(prints: Float[Tensor, "n r m"]) -> Float[Tensor, "n r m"]:
    """Fingerprints less their mean level, or over their norm: of all receivers that hear a
    transmission.
    """
    if prints.shape[2] == 1:
        return prints - prints.nanmean(1, keepdim=True)
    return prints / prints.nan_to_num(0).flatten(1).norm(dim=1)[:, None, None]


def neighbours(
    asked: Float[Tensor, "n r m"],
    known: Float[Tensor, "k r m"],
    places: Float[Tensor, "k 3"],
    groups: Int[Tensor, " k"],
) -> Float[Tensor, "n 3"]:
    """Means of the known places with the nearest fingerprints, weighted by 1 / distance; the
    yardstick of ``locate``.

    A receiver that has not heard a transmission counts as the least known value. The number of
    neighbours is that of ``COUNTS`` with the least mean error of known transmissions, without those
    of the same group.
    """
    least = known[~known.isnan()].min() if known.shape[2] == 1 else 0.0
    flat = lambda prints: prints.where(~prints.isnan(), least).flatten(1)

    def guesses(apart: Tensor, count: int) -> Tensor:
        near = apart.topk(min(count, apart.shape[1]), largest=False)
        weights = 1 / near.values.clamp_min(1e-6)
        return (places[near.indices] * (weights / weights.sum(1, keepdim=True))[..., None]).sum(1)

    some = evenly(torch.arange(len(known)), 500)
    apart = torch.cdist(flat(known[some]), flat(known)).masked_fill(
        groups[some][:, None] == groups, math.inf
    )
    error = lambda count: (guesses(apart, count) - places[some]).norm(dim=1).mean().item()
    return guesses(torch.cdist(flat(asked), flat(known)), min(COUNTS, key=error))
