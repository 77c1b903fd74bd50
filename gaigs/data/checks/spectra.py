"""Checks of spatial spectra: constant ones, and conventions of their directions."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Grid, from_spherical, to_spherical
from gaigs.core.task.spectrum import SSIM_WINDOW
from gaigs.data.checks.conventions import (
    changing,
    of_axes,
    of_frames,
    of_orientations,
    of_receivers,
    of_units,
)
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Hypothesis, Sample, sample_of
from gaigs.data.checks.places import scale_of


def check_extremes(links: Any) -> Iterator[Finding]:
    """Findings that count constant spectra, and min-max scaled spectra without a pixel of 0 or 1.

    Raises:
        ValueError: All spectra are constant, or too small for SSIM.
    """
    task, labels = links.task, links.labels
    if min(task.shape) < SSIM_WINDOW:
        rows, columns = task.shape
        raise ValueError(
            f"spectra must have {SSIM_WINDOW} x {SSIM_WINDOW} pixels or more, got {rows} x "
            f"{columns}"
        )
    ranges = []
    for index in torch.arange(len(labels)).split(256):  # as many as fit into memory
        pixels = labels[index].flatten(1)  # (256, pixels)
        ranges.append(torch.stack((pixels.amin(1), pixels.amax(1)), 1))
    low, high = torch.cat(ranges).T  # (n,) each
    constant = low == high
    if constant.all():
        raise ValueError(
            f"a spectrum must have pixels of different values; all {len(labels)} are constant"
        )
    lacking = torch.zeros_like(constant)
    if task.normalisation.startswith("min-max"):
        lacking = ((low != 0) | (high != 1)) & ~constant
    for which, defect in ((constant, "are constant"), (lacking, "lack a pixel of 0 or of 1")):
        if which.any():
            first = int(which.nonzero()[0])
            span = f"{low[first]:.3g} to {high[first]:.3g}"
            yield Finding(
                "range of spectra",
                f"{int(which.sum())} of {len(labels)} spectra {defect}, first that of link "
                f"{first}, {span}",
            )


@dataclass(frozen=True)
class Limits:
    """Limits of the check of directions."""

    fewest: int = 16  # fewest spectra that are checked
    near: int = 32  # fewest spectra that show whether nearby places have similar ones
    most: int = 160  # most spectra that are read
    # Most rows and columns that are compared; an array resolves fewer.
    pixels: tuple[int, int] = (45, 90)
    better: float = 0.08  # least excess of the score over the score of the data as read
    share: float = 0.35  # the same as a share of the score
    known: float = 0.2  # score of the data as read above which two faults at once are not sought
    # The excess in standard errors. Axes that point the other way need more, as reflections look
    # like them; hundreds of pairs need most.
    of_others: float = 3.0
    of_axes: float = 4.0
    of_pairs: float = 4.5


def check_directions(links: Any, limits: Limits | None = None) -> Iterator[Finding]:
    """A finding if spectra are bright towards their transmitters only under another convention.

    The score of a link is how rare pixels are that are as bright as the pixel towards its
    transmitter, minus the mean of this quantity over all spectra of the receiver. So pixels that
    are bright in every spectrum have no effect, and a link behind walls scores about 0 under every
    convention. The strongest pixel need not be the direct path.
    """
    limits = limits or Limits()
    sample = sample_of(links, limits.most)
    if len(sample.labels) < limits.fewest:
        return
    directions = Directions(links.task.directions, sample, limits.pixels)
    sample = replace(sample, labels=directions.ranks)
    read = directions.scores(sample)  # score of each link as the data were read
    best = best_directions(links, sample, directions, read, limits)
    if best is not None:
        yield Finding(
            "directions of spectra",
            f"spectra are bright towards their transmitters (score {best.score:.2f} instead of "
            f"{read.mean():.2f}) if {best.convention.name}",
            best.convention.mend,
            read.mean().item(),
            best.score,
            "rareness of pixels as bright as the one towards the transmitter, less that in other "
            "spectra",
        )
        return
    # In a survey spectra of near places are similar, also behind walls. If they are not, places
    # and spectra may be in different orders.
    likeness = near_likeness(sample)
    is_dark = read.mean() < 2 * read.std() / math.sqrt(len(read))  # two standard errors
    if len(read) >= limits.near and is_dark and likeness < 0.1:
        text = (
            "spectra are not bright towards their transmitters, and near places have a "
            f"correlation of {likeness:.2f}"
        )
        yield Finding("order of rows", text, "are places and spectra in the same order?")


class Scored(NamedTuple):
    """A convention and its score."""

    convention: Hypothesis
    score: float


class Trials(NamedTuple):
    """Conventions to compare."""

    conventions: list[Hypothesis]
    deviations: float  # least excess of the best score [standard errors]
    step: int  # 1 to compare at every link, 2 at every other one


def trials(
    links: Any, sample: Sample, directions: "Directions", is_known: bool, limits: Limits
) -> Iterator[Trials]:
    """Rounds of conventions to compare: single changes, then axes, then pairs of changes.

    Args:
        directions: Brightness of the sample's spectra.
        is_known: True if the data as read score well. Two faults at once are then impossible, and
            the round of pairs is skipped.
        limits: Significance, in standard errors, that each round requires.
    """
    axes = [*of_axes(sample, [("tx",), ("rx",), ("tx", "rx")])]
    units = [*of_units([("tx",), ("rx",)])]  # in any unit of both, directions are the same
    orientations = [*of_orientations(sample)]
    pixels = pixel_changes(sample)
    columns = column_changes(directions.grid)
    single = [*of_frames(), *units, *orientations, *pixels, *columns]
    single += [*scaling_changes(sample, directions.grid), *order_changes(links)]
    single += of_receivers(sample, lambda changed: directions.scores(changed).mean().item())
    yield Trials(single, limits.of_others, 1)
    yield Trials(axes, limits.of_axes, 1)
    if is_known:
        return
    pairs = []
    for first, second in itertools.combinations([axes, units, orientations, pixels, columns], 2):
        for a, b in itertools.product(first, second):
            pairs.append(both(a, b))
    yield Trials(pairs, limits.of_pairs, 2)  # there are hundreds


def best_directions(
    links: Any,
    sample: Sample,
    directions: "Directions",
    read: Float[Tensor, " n"],
    limits: Limits,
) -> Scored | None:
    """The convention with a clearly higher score than the data as read; None if there is none.

    Args:
        sample: Links with the ranks of their pixels as labels.
        directions: Brightness of the sample's spectra.
        read: Score of each link under the convention as read.
    """
    best: Scored | None = None
    is_known = bool(read.mean() >= limits.known)
    for conventions, deviations, step in trials(links, sample, directions, is_known, limits):
        few = sample.at(torch.arange(0, len(read), step))
        means = []
        for convention in conventions:
            means.append(directions.scores(convention.change(few)).mean().item())
        # Conventions are sorted, likeliest fault first: take the first of nearly equal scores.
        first = next(k for k, mean in enumerate(means) if mean > max(means) - 0.01)
        scores = directions.scores(conventions[first].change(sample))
        score = scores.mean().item()
        excess = scores - read
        # Standard error of the mean, with near places counted as one.
        needed = deviations * excess.std().item() / math.sqrt(directions.places)
        is_clear = excess.mean() >= max(limits.better, needed, limits.share * score)
        # A pair (step 2) has to be clearly better than one fault, which is simpler.
        least = (best.score if best else 0.0) + limits.better * (step - 1)
        if is_clear and score > least:
            best = Scored(conventions[first], score)
    return best


def near_likeness(sample: Sample) -> float:
    """Mean correlation of each spectrum with the spectrum of the nearest place.

    The mean of all spectra is subtracted first.
    """
    pixels = sample.labels.flatten(1)  # (n, pixels)
    correlations = torch.corrcoef(pixels - pixels.mean(0))  # (n, n)
    distances = torch.cdist(sample.transmitters, sample.transmitters)  # (n, n)
    nearest = distances.fill_diagonal_(math.inf).argmin(1, keepdim=True)  # (n, 1)
    return correlations.gather(1, nearest).mean().item()


class Directions:
    """Brightness of spectra towards the transmitters of a sample.

    Attributes:
        grid: Directions of the compared pixels.
        ranks: Rank of each pixel, 0 for the darkest and 1 for the brightest (n, rows, columns).
        places: Number of independent places. Places within a sixth of the room count as one, since
            their spectra are similar.
    """

    def __init__(self, grid: Grid, sample: Sample, pixels: tuple[int, int]):
        row_step = math.ceil(grid.shape[0] / pixels[0])
        column_step = math.ceil(grid.shape[1] / pixels[1])
        self.grid = grid.thin(slice(None, None, row_step), slice(None, None, column_step))
        labels = sample.labels[:, ::row_step, ::column_step]
        order = labels.flatten(1).argsort(1)  # (n, pixels), the darkest pixel first
        ranks = order.argsort(1)  # the inverse permutation
        self.ranks = (ranks / (ranks.shape[1] - 1)).reshape(labels.shape).float()
        places = sample.transmitters - sample.transmitters.amin(0)
        cells = (6 * places / places.amax().clamp_min(1e-9)).floor()  # (n, 3)
        self.places = len(cells.unique(dim=0))

    def scores(self, sample: Sample) -> Float[Tensor, " n"]:
        """The score of each link, as ``check_directions`` describes it.

        Transmitters beyond the grid's elevations count as dark.

        Args:
            sample: Links with the ranks of their pixels as labels.
        """
        azimuths, elevations, _ = to_spherical(sample.local.float())
        # Pixel nearest to each transmitter. The cosine makes azimuths periodic.
        rows = (elevations[:, None] - self.grid.elevations).abs().argmin(1)  # (n,)
        columns = torch.cos(azimuths[:, None] - self.grid.azimuths).argmax(1)  # (n,)
        # Share of brighter pixels, for each spectrum towards all transmitters.
        brighter = 1 - sample.labels[:, rows, columns]  # (spectrum, transmitter)
        # ln(1 / share) as in a likelihood: the top per cent counts more than the top tenth.
        least = 0.02
        rareness = ((brighter + least).log() / math.log(least)).clamp_min(0)
        low, high = self.grid.elevations.aminmax()
        is_seen = (elevations > low - self.grid.pitch) & (elevations < high + self.grid.pitch)
        rareness = rareness * is_seen  # (spectrum, transmitter)
        # Mean towards each transmitter over all spectra of its receiver.
        is_same_receiver = (sample.receivers[:, None] == sample.receivers).float()  # (n, n)
        usual = (rareness * is_same_receiver).sum(0) / is_same_receiver.sum(0)  # (n,)
        return rareness.diagonal() - usual


def both(first: Hypothesis, second: Hypothesis) -> Hypothesis:
    """The hypothesis that two conventions hold at once."""

    def change(sample: Sample) -> Sample:
        return second.change(first.change(sample))

    return Hypothesis(f"{first.name} and {second.name}", change, f"{first.mend}; {second.mend}")


def pixel_changes(sample: Sample) -> list[Hypothesis]:
    """Conventions with another order of the pixels, or inverted amplitudes."""
    changes = [
        ("rows are upside down", lambda labels: labels.flip(1), "spectra = spectra[:, ::-1]"),
        (
            "amplitudes are inverted, as in a grey map",
            lambda labels: 1 - labels,
            "spectra = 1 - spectra",
        ),
    ]
    if sample.labels.shape[1] == sample.labels.shape[2]:
        mend = "spectra = spectra.swapaxes(1, 2)"
        changes.append(("rows and columns are exchanged", lambda labels: labels.mT, mend))
    return [changing(name, ["labels"], move, mend) for name, move, mend in changes]


def column_changes(grid: Grid) -> list[Hypothesis]:
    """Conventions with other azimuths of the spectra's columns."""

    def moved(turn: float, sign: int) -> Callable[[Sample], Sample]:
        """A function that reads a column at azimuth a as if at ``turn`` + ``sign`` * a [rad]."""
        azimuths = sign * (grid.azimuths - turn)  # a for each azimuth of the grid
        source = torch.cos(azimuths[:, None] - grid.azimuths).argmax(1)  # nearest columns
        return lambda read: replace(read, labels=read.labels[:, :, source])

    # Azimuths such as -90..90 degrees are mirrored by the reverse order.
    is_symmetric = torch.allclose(grid.azimuths, -grid.azimuths.flip(0), atol=1e-3)
    columns = "::-1" if is_symmetric else "-np.arange(columns)"
    changes = [
        Hypothesis("azimuths run clockwise", moved(0.0, -1), f"spectra = spectra[:, :, {columns}]"),
        Hypothesis(
            "azimuths run clockwise from the y axis",
            moved(math.pi / 2, -1),
            "spectra = spectra[:, :, columns // 4 - np.arange(columns)]",
        ),
    ]
    for degrees in (-180, 90, -90):
        name = f"the first column is at azimuth {degrees} degrees"
        mend = f"spectra = np.roll(spectra, {degrees} * columns // 360, axis=2)"
        changes.append(Hypothesis(name, moved(math.radians(degrees), 1), mend))
    return changes


def order_changes(links: Any) -> list[Hypothesis]:
    """Conventions with another order of the transmitters."""
    total = len(links)
    # Number of the transmitter of each spectrum.
    orders = {
        "spectra are one row late": [max(k - 1, 0) for k in range(total)],
        "spectra are one row early": [min(k + 1, total - 1) for k in range(total)],
        "spectra are in the reverse order": list(range(total))[::-1],
    }
    for first in (0, 1):
        names = [str(k + first) for k in range(total)]
        by_name = sorted(range(total), key=names.__getitem__)
        orders[f"spectra are sorted by name ({first}, 10, 11, ... 2)"] = by_name
    changes = []
    for name, order in orders.items():
        places = links.query.transmitters[order].double()

        # The default binds the places of this turn of the loop.
        def change(read: Sample, places=places) -> Sample:
            return replace(read, transmitters=places[read.index])

        changes.append(Hypothesis(name, change, "sort spectra and positions alike"))
    return changes


def scaling_changes(sample: Sample, grid: Grid) -> list[Hypothesis]:
    """Conventions under which transmitters are scaled, such as to 0..1.

    Each one has another guess of scale and offset. Places that look unscaled give none.
    """
    scale = scale_of(sample.transmitters)  # in words; empty without a scaling
    if not scale:
        return []
    mend = "undo it, such as tx = middle + half_extent * tx"
    return [Hypothesis(f"tx are {scale}", change, mend) for change in _unscaled(sample, grid)]


def _unscaled(sample: Sample, grid: Grid, draws: int = 200) -> list[Callable[[Sample], Sample]]:
    """Functions that undo a scaling of the transmitters, each for one guess of the scaling.

    A stored place p is at s p + t from the receiver, with a scale s and an offset t for each axis.
    The brightest pixel of the link has the direction u, so (s p + t) x u = 0. These are two
    independent linear equations in the six unknowns (s, t). Three links determine them, up to a
    common factor without effect on directions. Triples are drawn at random, since the brightest
    pixel may be a reflection.

    Args:
        sample: Spectra as ranks; only the receiver with the most links is used.
        draws: Number of triples, each with one guess; only positive scales are returned.
    """
    receiver = int(sample.receivers.bincount().argmax())
    links = (sample.receivers == receiver).nonzero()[:, 0]
    brightest = sample.labels[links].flatten(1).argmax(1)  # (k,)
    pixels = grid.flatten()[brightest]
    local = from_spherical(pixels.azimuths, pixels.elevations).double()
    directions = local @ sample.rotations[receiver].T  # u, world frame (k, 3)
    # Column i is e_i x u with the unit vector e_i, so that the matrix times v is v x u.
    units = torch.eye(3, dtype=torch.float64).expand(len(links), 3, 3)
    crossed = torch.linalg.cross(units, directions[:, None].expand(-1, 3, -1)).mT  # (k, 3, 3)
    of_scales = crossed * sample.transmitters[links, None]  # coefficients of s
    equations = torch.cat((of_scales, crossed), 2)  # (k, 3, 6)
    generator = torch.Generator().manual_seed(0)
    threes = [torch.randperm(len(links), generator=generator)[:3] for _ in range(draws)]
    systems = equations[torch.stack(threes)].flatten(1, 2)  # (draws, 9, 6)
    # The best solution of A x = 0 is the right singular vector of the smallest singular value, the
    # last one. Its sign is free, and the first scale is made positive.
    solutions = torch.linalg.svd(systems).Vh[:, -1]  # (draws, 6)
    solutions = solutions * solutions[:, :1].sgn()
    changes: list[Callable[[Sample], Sample]] = []
    for solution in solutions[(solutions[:, :3] > 0).all(1)]:
        # The defaults bind the solution of this turn of the loop.
        def change(read: Sample, scales=solution[:3], offsets=solution[3:]) -> Sample:
            places = read.positions[receiver] + scales * read.transmitters + offsets
            return replace(read, transmitters=places)

        changes.append(change)
    return changes
