"""How far two labels agree, by the distance of their places and by how far apart in the order they were measured."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from numpy import ndarray
from rich.console import Console
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from gaigs import evaluation
from gaigs.data import Links, load, median_spacing
from gaigs.report.agreement import Cell, write
from gaigs.report.style import round_step
from gaigs.split import rows_of

log = logging.getLogger(__name__)

COUNTED = 50_000_000
"""Most pairs whose distance is computed; of more, those of a random part of the links with all others."""

BLOCK = 1_000_000
"""Distances that are in memory at a time."""

COMPARED = 2_000
"""Most pairs of a cell whose labels are compared."""

FEWEST = 30
"""So many pairs of a cell are compared, however large a label is."""

NUMBERS = 400_000_000
"""Labels compared in all cells together have about so many numbers: SSIM of them takes half a minute of one core."""

NEAREST_ORDER, PARTS = 3, 10
"""The first bin of separations ends at so many measurements, each further one at ten times that; the last edge is at
most a tenth of all measurements, so that nine tenths and more of them are further off."""

DRAWS = 20_000
"""Pairs that stand for the split's test links, about."""

LOOKED_UP = 30_000_000
"""Numbers in the labels of known and test links up to which the baselines are fitted too, in seconds to a minute."""


@dataclass(frozen=True)
class Agreement:
    """Scores of pairs of labels, in cells of distance (rows) and separation (columns).

    Attributes:
        distances: Upper edges of the rows [m]; the first row holds pairs at one place, and its edge is next to 0.
        separations: Last separations of the columns but the last, ascending; in measurements.
        pairs: How many there are in each cell.
        share: Of the pairs that were counted; 1 for all.
        scores: Those of the pairs compared by cell, row times columns plus column; by the score's name.
        step: Median distance from a measurement to the next [m].
        apart: Median distance of two measurements at random [m].
    """

    distances: ndarray
    separations: ndarray
    pairs: Int[ndarray, "rows columns"]
    share: float
    scores: dict[int, dict[str, Tensor]]
    step: float
    apart: float

    @property
    def has_order(self) -> bool:
        """Whether places follow each other, so that separations tell of time: else steps are as long as any."""
        return self.step < self.apart / 2

    def cell(self, distance: ndarray, separation: ndarray) -> ndarray:
        """The cell of each pair, from its distance [m] and its separation."""
        row = np.searchsorted(self.distances, distance, side="right")
        return row * (len(self.separations) + 1) + np.searchsorted(self.separations, separation)

    def cells(self, monitor: str) -> list[Cell]:
        """Cells with pairs, by rows, as tables and figures show them."""
        lows, highs = [0.0, *self.distances], [0.0, *self.distances[1:]]
        firsts, lasts = [0, *(self.separations + 1)], [*self.separations, math.inf]
        found = []
        for number in sorted(self.scores):
            row, column = divmod(number, len(lasts))
            low, median, high = np.quantile(self.scores[number][monitor].numpy(), (0.1, 0.5, 0.9))
            found.append(
                Cell(
                    (0.0 if row == 1 else float(lows[row]), float(highs[row])),
                    (int(firsts[column]), lasts[column] if column == len(lasts) - 1 else int(lasts[column])),
                    int(self.pairs[row, column]),
                    len(self.scores[number][monitor]),
                    (float(low), float(median), float(high)),
                )
            )
        return found


def run(config: dict, folder: Path) -> None:
    """Compares the labels of a data set, prints the table, and writes it with its figure.

    Args:
        config: The resolved configuration, of which data, split, baselines and seed count.
        folder: Gets ``agreement.md``, ``agreement.csv`` and ``agreement.png``.

    Raises:
        ValueError: A configuration that does not fit the data, or labels that cannot be compared; see ``measure``.
        FileNotFoundError: Data that are not there.
        OSError: A file cannot be written.
    """
    links = load(config["data"], config["split"], config["task"]["name"])
    name = config["data"]["name"]
    log.info("data: %s, %s links%s", name, f"{len(links):,}", links.remarks and f"; {links.remarks}")
    random = np.random.default_rng(config["seed"])
    agreement = measure(links, random)
    rows, remarks = on_split(agreement, links, random, config["baselines"])
    lines = [f"data {name}, {len(links):,} links, seed {config['seed']}", *_remarks(agreement), *remarks]
    folder.mkdir(parents=True, exist_ok=True)
    console = Console()
    titles = {name: metric.title for name, metric in links.task.metrics().items()}
    cells = agreement.cells(links.task.compared_by)
    console.print(write(folder, links.task.pair_score, titles, cells, rows, links.split.name, lines))
    console.print(f"results: {folder}", soft_wrap=True)


def measure(links: Links, random: np.random.Generator) -> Agreement:
    """Counts the pairs of labels of one receiver and carrier by cell, and compares random ones of each.

    The later label of a pair is scored with the earlier as its prediction.

    Args:
        links: All of them, in the order of the files, which counts as that of measurement.
        random: Draws the pairs.

    Raises:
        ValueError: There are no two links of one receiver and carrier, or all transmitters stand at one point.
    """
    places, order, groups = links.query.transmitters.double().numpy(), visits(links), _groups(links)
    if not groups:
        raise ValueError(
            f"labels are compared where one receiver has two or more at one carrier, and none of {len(links)} links "
            "has another like it; add measurements"
        )
    if not np.ptp(places, 0).any():
        raise ValueError(
            f"labels are compared by the distance of their places, and all {len(links)} links have their transmitter "
            f"at {', '.join(f'{value:g}' for value in places[0])} m; check the positions"
        )
    extent = float(np.linalg.norm(np.ptp(places, 0)))
    edges = [np.nextafter(0, 1), round_step(median_spacing(links.query.transmitters.unique(dim=0)), 1)]
    while edges[-1] < 1.01 * extent:  # rounding takes no distance beyond
        edges.append(round_step(1.5 * edges[-1], 1))
    limits, count = [], int(order.max()) + 1
    while NEAREST_ORDER * 10 ** len(limits) <= count / PARTS:
        limits.append(NEAREST_ORDER * 10 ** len(limits))
    shape = len(edges), len(limits) + 1  # nothing lies beyond the last edge
    share = min(1.0, COUNTED / sum(len(group) ** 2 for group in groups))
    first = np.unique(order, return_index=True)[1]
    steps = np.linalg.norm(np.diff(places[first], axis=0), axis=1)
    other = first[random.permutation(len(first))]
    apart = np.linalg.norm(places[first] - places[other], axis=1)
    medians = [float(np.median(values)) if len(values) else 0.0 for values in (steps, apart)]
    empty = Agreement(np.array(edges), np.array(limits, int), np.zeros(shape, int), share, {}, *medians)
    most = int(np.clip(NUMBERS / math.prod((*shape, *links.task.shape)), FEWEST, COMPARED))
    pairs, drawn = _draw(empty, places, order, groups, most, random)
    scores = {cell: _compare(links, *ends) for cell, ends in drawn.items()}
    return Agreement(empty.distances, empty.separations, pairs.reshape(shape), share, scores, *medians)


def visits(links: Links) -> Int[ndarray, "n"]:
    """Number of each link's measurement: one more wherever a link's row is another than that of the link before it.

    A place that was measured again counts anew, which its row may not.
    """
    rows = rows_of(links)
    return np.concatenate(([0], (rows.diff() != 0).numpy().cumsum()))


def _groups(links: Links) -> list[Int[ndarray, "k"]]:
    """Links of one receiver and carrier, ascending, where there are two or more."""
    query = links.query
    keys = [query.receivers.double(), *([] if query.frequencies is None else [query.frequencies.double()])]
    _, which = torch.stack(keys, 1).unique(dim=0, return_inverse=True)
    order = which.argsort(stable=True).numpy()
    return [group for group in np.split(order, which.bincount().cumsum(0)[:-1].numpy()) if len(group) > 1]


def _draw(
    agreement: Agreement,
    places: ndarray,
    order: ndarray,
    groups: list[ndarray],
    most: int,
    random: np.random.Generator,
) -> tuple[ndarray, dict[int, tuple[ndarray, ndarray]]]:
    """How many pairs each cell has, and so many random ones of it at most: the earlier links and the later ones.

    Each pair has a random key, and those with the smallest are drawn.
    """
    size = agreement.pairs.size
    counts, bounds = np.zeros(size + 1, int), np.ones(size + 1)
    bounds[size] = 0  # the cell of what is no pair
    kept = {cell: (np.zeros(0), np.zeros((0, 2), int)) for cell in range(size)}
    for group in groups:
        number = math.ceil(agreement.share * len(group))
        chosen = np.sort(random.choice(len(group), number, replace=False))
        is_chosen = np.isin(np.arange(len(group)), chosen)
        for block in np.array_split(chosen, math.ceil(number * len(group) / BLOCK)):
            distance = cdist(places[group[block]], places[group])
            cells = agreement.cell(distance, np.abs(order[group[block], None] - order[group]))
            cells[is_chosen & (np.arange(len(group)) <= block[:, None])] = size
            cells = cells.ravel()
            counts += np.bincount(cells, minlength=size + 1)
            keys = random.random(len(cells))
            small = np.flatnonzero(keys < bounds[cells])
            for cell in np.unique(cells[small]):
                here = small[cells[small] == cell]
                ends = np.stack((group[block[here // len(group)]], group[here % len(group)]), 1)
                old_keys, old_ends = kept[cell]
                merged, ends = np.concatenate((old_keys, keys[here])), np.concatenate((old_ends, ends))
                best = np.argsort(merged)[:most]
                kept[cell] = merged[best], ends[best]
                if len(best) == most:
                    bounds[cell] = merged[best[-1]]
    ends = {cell: np.sort(pair, 1) for cell, (_, pair) in kept.items() if len(pair)}
    return counts[:size], {cell: (pair[:, 0], pair[:, 1]) for cell, pair in ends.items()}


def _compare(links: Links, earlier: ndarray, later: ndarray) -> dict[str, Tensor]:
    """Scores of labels with others as their predictions."""
    parts = [
        links.task.scores(links.labels[label], links.labels[other])
        for label, other in zip(
            torch.from_numpy(later).split(evaluation.BATCH),
            torch.from_numpy(earlier).split(evaluation.BATCH),
            strict=True,
        )
    ]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def on_split(
    agreement: Agreement, links: Links, random: np.random.Generator, baselines: list[Mapping]
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """What the agreement lets expect on the split's test links, beside the baselines.

    Each test link is looked up in the cell of its nearest known link of the same receiver and carrier, and stands for
    the pairs compared there.

    Args:
        agreement: Of all links.
        links: With a split.
        random: Draws the pairs.
        baselines: Their configurations.

    Returns:
        The task's metrics by row, none where no test link can be looked up; and remarks.
    """
    distance, separation, alone = _nearest(links)
    known = torch.cat((links.split.train, links.split.validation))
    rows, remarks = {}, []
    if alone:
        remarks.append(f"{alone:,} test links have no known link of their receiver and carrier, and are left out")
    cells = agreement.cell(distance, separation)
    cells = cells[np.isin(cells, [*agreement.scores])]  # a part of the links may have no such pair
    if len(cells):
        low, median, high = np.quantile(distance, (0.1, 0.5, 0.9))
        remarks.append(
            f"from a test link to the nearest known one of its receiver and carrier it is {median:.3g} m (median; 10th "
            f"to 90th percentile {low:.3g} to {high:.3g} m), and in the order {np.median(separation):,.0f} (median)"
        )
        many = random.choice(cells, max(DRAWS, len(cells)))
        drawn: dict[str, list[Tensor]] = {}
        for cell, count in zip(*np.unique(many, return_counts=True), strict=True):
            scores = agreement.scores[int(cell)]
            which = torch.from_numpy(random.integers(len(scores[links.task.compared_by]), size=count))
            for name, values in scores.items():
                drawn.setdefault(name, []).append(values[which])
        mixed = {name: torch.cat(parts) for name, parts in drawn.items()}
        rows["one label as near"] = links.task.summarise(mixed)
        remarks.append("one label as near: random pairs of the cell that a test link and its nearest known one are in")
        averaged = links.task.averaged(mixed)
        if averaged is not None:
            rows["mean of many as near"] = links.task.summarise(averaged)
            remarks.append("mean of many as near: the same with half of the squared difference")
    if not baselines:
        return rows, remarks
    numbers = (len(known) + len(links.split.test)) * math.prod(links.task.shape)
    if numbers > LOOKED_UP:
        remarks.append("the baselines are left out, as labels are large and many; command=train model=mean has them")
        return rows, remarks
    labels = torch.cat([links.labels[part] for part in links.split.test.split(evaluation.BATCH)])
    for name, config in evaluation.baseline_configurations(baselines, "", links.scene).items():
        values = evaluation.predict(evaluation.fit(config, links), links, links.split.test)
        rows[f"`{name}`"] = links.task.summarise(links.task.scores(labels, values))
    return rows, remarks


def _nearest(links: Links) -> tuple[ndarray, ndarray, int]:
    """Distance [m] and separation of test links to the nearest known link, and how many have none."""
    places, order, test = links.query.transmitters.double().numpy(), visits(links), links.split.test.numpy()
    known = torch.cat((links.split.train, links.split.validation)).numpy()
    distances, separations = [], []
    for group in _groups(links):
        asked, there = np.intersect1d(group, test), np.intersect1d(group, known)
        if len(asked) and len(there):
            distance, nearest = cKDTree(places[there]).query(places[asked])
            distances.append(distance)
            separations.append(np.abs(order[asked] - order[there[nearest]]))
    found = sum(map(len, distances))
    empty = np.zeros(0)
    return np.concatenate([*distances, empty]), np.concatenate([*separations, empty]), len(test) - found


def _remarks(agreement: Agreement) -> list[str]:
    """What the table's columns mean, and of which pairs it is."""
    step = f"consecutive ones are {agreement.step:.2g} m apart (median), any two {agreement.apart:.2g} m"
    words = "in the order of the files, which counts as that of measurement"
    if not agreement.has_order:
        words = "in the order of the files, in which no place is near the one before: columns tell nothing of time"
    remarks = [f"columns: how many measurements apart, {words}; {step}"]
    if agreement.share < 1:
        remarks.append(f"pairs are those of {agreement.share:.2g} of the links, drawn at random, with all others")
    return remarks
