"""Pairs of labels of one receiver and carrier, counted and compared in cells."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.distance import cdist
from torch import Tensor

from gaigs.commands.agreement.page import Cell
from gaigs.data import Links, median_spacing
from gaigs.report.style import round_step
from gaigs.runs import evaluation
from gaigs.split import rows_of


@dataclass(frozen=True)
class Agreement:
    """Scores of pairs of labels, in cells of distance (rows) and separation (columns).

    The separation of a pair is the number of measurements from one of its labels to the other.
    """

    # Upper edges of the rows [m]. The first row holds pairs at one place: its edge is the smallest
    # number above 0.
    distances: ndarray
    # Largest separation in each column but the last, ascending [measurements].
    separations: ndarray
    pairs: Int[ndarray, "rows columns"]  # number of pairs in each cell
    share: float  # fraction of the links whose pairs with all links were counted
    # Scores of the compared pairs by cell (row times columns plus column) and by the score's name.
    scores: dict[int, dict[str, Tensor]]
    step: float  # median distance from a measurement to the next [m]
    apart: float  # median distance of two random measurements [m]

    @property
    def has_order(self) -> bool:
        """True if consecutive places are close together, so that separations measure time."""
        return self.step < self.apart / 2

    def cell(self, distance: ndarray, separation: ndarray) -> ndarray:
        """The cell of each pair, from its distance [m] and its separation."""
        row = np.searchsorted(self.distances, distance, side="right")
        column = np.searchsorted(self.separations, separation)
        return row * (len(self.separations) + 1) + column

    def cells(self, score: str) -> list[Cell]:
        """Cells with pairs, row by row, as tables and figures show them.

        Args:
            score: Name of the score whose quantiles are shown.
        """
        lows = [0.0, 0.0, *self.distances[1:]]  # of each row [m]
        highs = [0.0, *self.distances[1:]]
        firsts = [0, *(self.separations + 1).tolist()]  # smallest separation of each column
        lasts = [*self.separations.tolist(), math.inf]
        cells = []
        for number, scores in sorted(self.scores.items()):
            row, column = divmod(number, len(lasts))
            low, median, high = np.quantile(scores[score].numpy(), (0.1, 0.5, 0.9)).tolist()
            cell = Cell(
                distance=(float(lows[row]), float(highs[row])),
                separation=(firsts[column], lasts[column]),
                pairs=int(self.pairs[row, column]),
                compared=len(scores[score]),
                quantiles=(low, median, high),
            )
            cells.append(cell)
        return cells

    def remarks(self) -> list[str]:
        """Sentences on the columns and the counted pairs."""
        order = "in the order of the files, which counts as that of measurement"
        if not self.has_order:
            order = (
                "in the order of the files, in which no place is near the one before: "
                "columns tell nothing of time"
            )
        remarks = [
            f"columns: how many measurements apart, {order}; consecutive ones are "
            f"{self.step:.2g} m apart (median), any two {self.apart:.2g} m"
        ]
        if self.share < 1:
            remarks.append(
                f"pairs are those of {self.share:.2g} of the links, drawn at random, "
                "with all others"
            )
        return remarks


def measure(
    links: Links,
    random: np.random.Generator,
    counted: int = 50_000_000,
    block: int = 1_000_000,
    most: int = 2_000,
) -> Agreement:
    """Counts the pairs of labels of one receiver and carrier by cell, and compares random ones.

    The later label of a pair is scored with the earlier as its prediction.

    Args:
        links: All links in the order of the files, which counts as the order of measurement.
        random: Draws the pairs.
        counted: Largest number of computed distances. If there are more pairs, links are drawn at
            random, and only their pairs with all other links are counted.
        block: Number of distances in memory at a time.
        most: Largest number of compared pairs in a cell; fewer for large labels, at least 30.
    """
    places = links.query.transmitters.double().numpy()
    groups = groups_of(links)
    if not groups:
        raise ValueError(
            f"no two of {len(links)} links have the same receiver and carrier; add measurements"
        )
    if not np.ptp(places, 0).any():
        point = ", ".join(f"{value:g}" for value in places[0])
        raise ValueError(
            f"all {len(links)} links have their transmitter at {point} m; check the positions"
        )
    order = visits(links)
    edges = distance_edges(links, places)
    # Largest separations of the columns: 3, 30, 300, ... up to a tenth of all measurements.
    limits = 3 * 10 ** np.arange(18)
    limits = limits[limits <= (int(order.max()) + 1) / 10]

    _, first_links = np.unique(order, return_index=True)
    visited = places[first_links]  # the place of each measurement
    steps = np.linalg.norm(np.diff(visited, axis=0), axis=1)
    apart = np.linalg.norm(visited - visited[random.permutation(len(visited))], axis=1)

    shape = len(edges), len(limits) + 1
    empty = Agreement(
        distances=edges,
        separations=limits,
        pairs=np.zeros(shape, int),
        share=min(1.0, counted / sum(len(group) ** 2 for group in groups)),
        scores={},
        step=float(np.median(steps)) if len(steps) else 0.0,
        apart=float(np.median(apart)),
    )
    # SSIM of 4e8 numbers takes half a minute of one core.
    most = min(most, max(30, int(400_000_000 / math.prod((*shape, *links.task.shape)))))
    counts, drawn = draw(empty, places, order, groups, most, block, random)
    scores = {cell: compare(links, *ends.T) for cell, ends in drawn.items()}
    return replace(empty, pairs=counts.reshape(shape), scores=scores)


def distance_edges(links: Links, places: Float[ndarray, "n 3"]) -> Float[ndarray, " rows"]:
    """Upper edges [m] of the rows of a table by distance, up to the extent of the places."""
    extent = float(np.linalg.norm(np.ptp(places, 0)))
    spacing = median_spacing(links.query.transmitters.unique(dim=0))
    edges = [np.nextafter(0, 1), round_step(spacing, 1)]  # 1, 2 or 5 times a power of ten
    while edges[-1] < 1.01 * extent:  # 1 % for rounding errors of distances
        edges.append(round_step(1.5 * edges[-1], 1))
    return np.array(edges)


def visits(links: Links) -> Int[ndarray, " n"]:
    """Number of the measurement to which each link belongs, ascending from 0.

    Links are in the order of the files. Consecutive links of one row (one transmission to all
    receivers) are one measurement. Later links of the same row are another measurement.
    """
    is_new = (rows_of(links).diff() != 0).numpy()  # of each link but the first
    return np.concatenate(([0], is_new.cumsum()))


def groups_of(links: Links) -> list[Int[ndarray, " k"]]:
    """Groups of two or more links with the same receiver and carrier; ascending indices."""
    keys = [links.query.receivers.double()]
    if links.query.frequencies is not None:
        keys.append(links.query.frequencies.double())
    _, group_of_link = torch.stack(keys, 1).unique(dim=0, return_inverse=True)
    by_group = group_of_link.argsort(stable=True).numpy()
    ends = group_of_link.bincount().cumsum(0).numpy()
    groups = np.split(by_group, ends[:-1])
    return [group for group in groups if len(group) > 1]


class Reservoir:
    """A random sample of the pairs of each cell: those with the smallest random keys.

    Pairs arrive in parts, so the number of all pairs need not be known in advance.

    Args:
        cells: Number of cells. Pairs of a further cell are never kept.
        most: Largest number of pairs that a cell keeps.
    """

    def __init__(self, cells: int, most: int):
        self.most = most
        self.bounds = np.ones(cells + 1)  # by cell: a pair with this key or a larger one is refused
        self.bounds[cells] = 0
        self.keys = {cell: np.zeros(0) for cell in range(cells)}  # of the kept pairs
        self.ends = {cell: np.zeros((0, 2), int) for cell in range(cells)}  # their two links

    def add(self, cells: ndarray, keys: ndarray, rows: ndarray, columns: ndarray) -> None:
        """Offers all pairs of a link of ``rows`` with a link of ``columns``.

        Each cell keeps the pairs with its smallest keys.

        Args:
            cells: Cell of each pair, row by row.
            keys: Random number of each pair in [0, 1).
        """
        candidates = np.flatnonzero(keys < self.bounds[cells])
        for cell in np.unique(cells[candidates]):
            pairs = candidates[cells[candidates] == cell]
            row, column = np.divmod(pairs, len(columns))
            ends = np.stack((rows[row], columns[column]), 1)
            all_keys = np.concatenate((self.keys[cell], keys[pairs]))
            all_ends = np.concatenate((self.ends[cell], ends))
            smallest = np.argsort(all_keys)[: self.most]
            self.keys[cell] = all_keys[smallest]
            self.ends[cell] = all_ends[smallest]
            if len(smallest) == self.most:
                self.bounds[cell] = all_keys[smallest[-1]]


def draw(
    agreement: Agreement,
    places: Float[ndarray, "n 3"],
    order: Int[ndarray, " n"],  # measurement of each link, see ``visits``
    groups: Sequence[ndarray],  # links of one receiver and carrier, see ``groups_of``
    most: int,
    block: int,
    random: np.random.Generator,
) -> tuple[Int[ndarray, " cells"], dict[int, Int[ndarray, "k 2"]]]:
    """Counts the pairs of each cell, and draws up to ``most`` of them.

    Args:
        agreement: Edges of the cells, and the fraction of links whose pairs are counted.
        places: Transmitter of each link [m].
        most, block, random: As for ``measure``.

    Returns:
        The number of pairs in each cell; and the drawn pairs by cell, as earlier and later link.
    """
    size = agreement.pairs.size
    counts = np.zeros(size + 1, int)  # the last cell holds links that are not a pair
    reservoir = Reservoir(size, most)
    for group in groups:
        chosen_count = math.ceil(agreement.share * len(group))
        chosen = np.sort(random.choice(len(group), chosen_count, replace=False))
        numbers = np.arange(len(group))
        is_chosen = np.isin(numbers, chosen)
        # Chosen links (rows) by all links of the group (columns), in blocks of rows.
        block_count = math.ceil(chosen_count * len(group) / block)
        for chosen_block in np.array_split(chosen, block_count):
            rows = group[chosen_block]
            separations = np.abs(order[rows, None] - order[group])
            cells = agreement.cell(cdist(places[rows], places[group]), separations)
            # Two chosen links meet twice, and each link meets itself.
            cells[is_chosen & (numbers <= chosen_block[:, None])] = size
            cells = cells.ravel()
            counts += np.bincount(cells, minlength=size + 1)
            reservoir.add(cells, random.random(len(cells)), rows, group)
    ends = {cell: np.sort(pairs, 1) for cell, pairs in reservoir.ends.items() if len(pairs)}
    return counts[:size], ends


def compare(links: Links, earlier: ndarray, later: ndarray) -> dict[str, Tensor]:
    """Scores of the later links' labels, with the earlier links' labels as the predictions."""
    label_batches = torch.from_numpy(later).split(evaluation.BATCH)
    prediction_batches = torch.from_numpy(earlier).split(evaluation.BATCH)
    scores = []
    for labels, predictions in zip(label_batches, prediction_batches, strict=True):
        scores.append(links.task.scores(links.labels[labels], links.labels[predictions]))
    return joined_scores(scores)


def joined_scores(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Scores by name, each joined over several sets of scores."""
    scores = {}
    for name in parts[0]:
        scores[name] = torch.cat([part[name] for part in parts])
    return scores
