"""Agreement of labels with each other, by the distance of their places and their order of
measurement.
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from numpy import ndarray
from rich.console import Console
from rich.markdown import Markdown
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from gaigs.data import Links, load, median_spacing
from gaigs.report.agreement import Cell, write
from gaigs.report.style import round_step
from gaigs.runs import evaluation
from gaigs.split import rows_of

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Agreement:
    """Scores of pairs of labels, in cells of distance (rows) and separation (columns).

    Attributes:
        distances: Upper edges of the rows [m]; the first row holds pairs at one place, and its edge
            is next to 0.
        separations: Last separations of the columns but the last, ascending; in measurements.
        pairs: Number of pairs in each cell.
        share: Share of the pairs that were counted.
        scores: Scores of the compared pairs by cell (row times columns plus column) and by the
            score's name.
        step: Median distance from a measurement to the next [m].
        apart: Median distance of two random measurements [m].
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
        """True if consecutive places are close together, so that separations measure time."""
        return self.step < self.apart / 2

    def cell(self, distance: ndarray, separation: ndarray) -> ndarray:
        """The cell of each pair, from its distance [m] and its separation."""
        row = np.searchsorted(self.distances, distance, side="right")
        return row * (len(self.separations) + 1) + np.searchsorted(self.separations, separation)

    def cells(self, score: str) -> list[Cell]:
        """Cells with pairs, by rows, as tables and figures show them."""
        lows, highs = [0.0, 0.0, *self.distances[1:]], [0.0, *self.distances[1:]]
        firsts, lasts = (
            [0, *(self.separations + 1).tolist()],
            [*self.separations.tolist(), math.inf],
        )
        found = []
        for number, scores in sorted(self.scores.items()):
            row, column = divmod(number, len(lasts))
            quantiles = tuple(np.quantile(scores[score].numpy(), (0.1, 0.5, 0.9)).tolist())
            bounds = (float(lows[row]), float(highs[row])), (firsts[column], lasts[column])
            found.append(Cell(*bounds, int(self.pairs[row, column]), len(scores[score]), quantiles))
        return found


def run(config: dict, folder: Path) -> None:
    """Compares the labels of a data set, prints the table, and writes it with its figure into a
    folder.
    """
    links = load(config["data"], config["split"], config["task"]["name"])
    name, task = config["data"]["name"], links.task
    log.info(
        "data: %s, %s links%s", name, f"{len(links):,}", links.remarks and f"; {links.remarks}"
    )
    random = np.random.default_rng(config["seed"])
    agreement = measure(links, random)
    rows, remarks = on_split(agreement, links, random, config["baselines"])
    remarks = [
        f"data {name}, {len(links):,} links, seed {config['seed']}",
        *_remarks(agreement),
        *remarks,
    ]
    folder.mkdir(parents=True, exist_ok=True)
    cells = agreement.cells(task.compared_by)
    Console().print(Markdown(write(folder, task, cells, rows, links.split.name, remarks)))
    print(f"results: {folder}")


def measure(
    links: Links,
    random: np.random.Generator,
    counted: int = 50_000_000,
    block: int = 1_000_000,
    most: int = 2_000,
) -> Agreement:
    """Counts the pairs of labels of one receiver and carrier by cell, and compares random pairs of
    each cell.

    The later label of a pair is scored with the earlier as its prediction.

    Args:
        links: All links in the order of the files, which counts as that of measurement.
        random: Draws the pairs.
        counted: Largest number of computed distances; of more pairs, those of random links with all
            others count.
        block: Number of distances in memory at a time.
        most: Largest number of pairs of a cell whose labels are compared; at least 30 of large
            labels.

    Raises:
        ValueError: No two links share receiver and carrier, or all transmitters stand at one point.
    """
    places, order, groups = links.query.transmitters.double().numpy(), visits(links), _groups(links)
    if not groups:
        raise ValueError(
            f"no two of {len(links)} links have the same receiver and carrier; add measurements"
        )
    if not np.ptp(places, 0).any():
        point = ", ".join(f"{value:g}" for value in places[0])
        raise ValueError(
            f"all {len(links)} links have their transmitter at {point} m; check the positions"
        )
    extent = float(np.linalg.norm(np.ptp(places, 0)))
    edges = [
        np.nextafter(0, 1),
        round_step(median_spacing(links.query.transmitters.unique(dim=0)), 1),
    ]
    while edges[-1] < 1.01 * extent:  # rounding takes no distance beyond
        edges.append(round_step(1.5 * edges[-1], 1))
    limits = 3 * 10 ** np.arange(18)
    limits = limits[
        limits <= (int(order.max()) + 1) / 10
    ]  # nine tenths of all measurements are further apart
    shape = len(edges), len(limits) + 1
    first = np.unique(order, return_index=True)[1]
    steps = np.linalg.norm(np.diff(places[first], axis=0), axis=1)
    apart = np.linalg.norm(places[first] - places[first[random.permutation(len(first))]], axis=1)
    medians = [float(np.median(values)) if len(values) else 0.0 for values in (steps, apart)]
    share = min(1.0, counted / sum(len(group) ** 2 for group in groups))
    empty = Agreement(np.array(edges), limits, np.zeros(shape, int), share, {}, *medians)
    # SSIM of 4e8 numbers takes half a minute of one core.
    most = min(most, max(30, int(400_000_000 / math.prod((*shape, *links.task.shape)))))
    pairs, drawn = _draw(empty, places, order, groups, most, block, random)
    scores = {cell: _compare(links, *ends.T) for cell, ends in drawn.items()}
    return replace(empty, pairs=pairs.reshape(shape), scores=scores)


def visits(links: Links) -> Int[ndarray, " n"]:
    """Number of each link's measurement: one more at each change of the row, so a place measured
    again counts anew.
    """
    return np.concatenate(([0], (rows_of(links).diff() != 0).numpy().cumsum()))


def _groups(links: Links) -> list[Int[ndarray, " k"]]:
    """Links of one receiver and carrier, ascending, where there are two or more."""
    query = links.query
    keys = [
        query.receivers.double(),
        *([] if query.frequencies is None else [query.frequencies.double()]),
    ]
    _, which = torch.stack(keys, 1).unique(dim=0, return_inverse=True)
    order = which.argsort(stable=True).numpy()
    return [
        group
        for group in np.split(order, which.bincount().cumsum(0)[:-1].numpy())
        if len(group) > 1
    ]


def _draw(
    agreement: Agreement,
    places: ndarray,
    order: ndarray,
    groups: list[ndarray],
    most: int,
    block: int,
    random,
) -> tuple[ndarray, dict[int, ndarray]]:
    """Number of pairs of each cell, and the ``most`` pairs with the smallest random keys: earlier
    and later links.
    """
    size = agreement.pairs.size
    counts, bounds = np.zeros(size + 1, int), np.ones(size + 1)
    bounds[size] = 0  # the last cell holds links that are not a pair
    kept = {cell: (np.zeros(0), np.zeros((0, 2), int)) for cell in range(size)}
    for group in groups:
        number = math.ceil(agreement.share * len(group))
        chosen = np.sort(random.choice(len(group), number, replace=False))
        is_chosen = np.isin(np.arange(len(group)), chosen)
        for part in np.array_split(chosen, math.ceil(number * len(group) / block)):
            distance = cdist(places[group[part]], places[group])
            cells = agreement.cell(distance, np.abs(order[group[part], None] - order[group]))
            cells[is_chosen & (np.arange(len(group)) <= part[:, None])] = size
            cells = cells.ravel()
            counts += np.bincount(cells, minlength=size + 1)
            keys = random.random(len(cells))
            small = np.flatnonzero(keys < bounds[cells])
            for cell in np.unique(cells[small]):
                here = small[cells[small] == cell]
                ends = np.stack((group[part[here // len(group)]], group[here % len(group)]), 1)
                merged, ends = (
                    np.concatenate(pair)
                    for pair in zip(kept[cell], (keys[here], ends), strict=True)
                )
                best = np.argsort(merged)[:most]
                kept[cell] = merged[best], ends[best]
                if len(best) == most:
                    bounds[cell] = merged[best[-1]]
    return counts[:size], {cell: np.sort(ends, 1) for cell, (_, ends) in kept.items() if len(ends)}


def _compare(links: Links, earlier: ndarray, later: ndarray) -> dict[str, Tensor]:
    """Scores of labels with others as their predictions."""
    ends = (torch.from_numpy(index).split(evaluation.BATCH) for index in (later, earlier))
    parts = [
        links.task.scores(links.labels[label], links.labels[other])
        for label, other in zip(*ends, strict=True)
    ]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def on_split(
    agreement: Agreement,
    links: Links,
    random: np.random.Generator,
    baselines: list[Mapping],
    looked_up: int = 30_000_000,
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Expected metrics on the split's test links, beside those of the baselines, by row; and
    remarks.

    Each test link is looked up in the cell of its nearest known link of the same receiver and
    carrier, and stands for the pairs compared there. The rows are empty if no test link can be
    looked up. Baselines are fitted if labels have at most ``looked_up`` numbers.
    """
    rows: dict[str, dict[str, float]] = {}
    remarks, task = [], links.task
    distance, separation, alone = _nearest(links)
    if alone:
        remarks.append(
            f"{alone:,} test links have no known link of their receiver and carrier, and are left out"
        )
    cells = agreement.cell(distance, separation)
    cells = cells[np.isin(cells, [*agreement.scores])]  # a part of the links may have no such pair
    if len(cells):
        low, median, high = np.quantile(distance, (0.1, 0.5, 0.9))
        remarks.append(
            f"from a test link to the nearest known one of its receiver and carrier it is {median:.3g} m (median; 10th "
            f"to 90th percentile {low:.3g} to {high:.3g} m), and in the order {np.median(separation):,.0f} (median)"
        )
        many = random.choice(cells, max(20_000, len(cells)))
        parts = []
        for cell, count in zip(*np.unique(many, return_counts=True), strict=True):
            scores = agreement.scores[int(cell)]
            which = torch.from_numpy(random.integers(len(scores[task.compared_by]), size=count))
            parts.append({name: values[which] for name, values in scores.items()})
        mixed = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        rows["one label as near"] = task.summarise(mixed)
        remarks.append(
            "one label as near: random pairs of the cell that a test link and its nearest known one are in"
        )
        averaged = task.averaged(mixed)
        if averaged is not None:
            rows["mean of many as near"] = task.summarise(averaged)
            remarks.append("mean of many as near: the same with half of the squared difference")
    numbers = sum(
        map(len, (links.split.train, links.split.validation, links.split.test))
    ) * math.prod(task.shape)
    if baselines and numbers > looked_up:
        remarks.append(
            "the baselines are left out, as labels are large and many; command=train model=mean has them"
        )
    elif baselines:
        labels = torch.cat(
            [links.labels[part] for part in links.split.test.split(evaluation.BATCH)]
        )
        for name, look_up in evaluation.build_baselines(baselines, "", links.scene).items():
            values = evaluation.predicted(
                evaluation.fitted(look_up, links), links, links.split.test
            )
            rows[f"`{name}`"] = task.summarise(task.scores(labels, values))
    return rows, remarks


def _nearest(links: Links) -> tuple[ndarray, ndarray, int]:
    """Distance [m] and separation of test links to the nearest known link, and the number of those
    without one.
    """
    places, order, test = (
        links.query.transmitters.double().numpy(),
        visits(links),
        links.split.test.numpy(),
    )
    known = links.split.known.numpy()
    found = [(np.zeros(0), np.zeros(0))]
    for group in _groups(links):
        asked, there = np.intersect1d(group, test), np.intersect1d(group, known)
        if len(asked) and len(there):
            distance, nearest = cKDTree(places[there]).query(places[asked])
            found.append((distance, np.abs(order[asked] - order[there[nearest]])))
    distances, separations = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return distances, separations, len(test) - len(distances)


def _remarks(agreement: Agreement) -> list[str]:
    words = "in the order of the files, which counts as that of measurement"
    if not agreement.has_order:
        words = "in the order of the files, in which no place is near the one before: columns tell nothing of time"
    step = f"consecutive ones are {agreement.step:.2g} m apart (median), any two {agreement.apart:.2g} m"
    remarks = [f"columns: how many measurements apart, {words}; {step}"]
    if agreement.share < 1:
        remarks.append(
            f"pairs are those of {agreement.share:.2g} of the links, drawn at random, with all others"
        )
    return remarks
