"""Expected scores on a split, from the agreement of labels at similar distances."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.commands.agreement.pairs import Agreement, groups_of, joined_scores, visits
from gaigs.data import Links
from gaigs.runs import evaluation


def on_split(
    agreement: Agreement,
    links: Links,
    random: np.random.Generator,
    baselines: list[Mapping],
    looked_up: int = 30_000_000,
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Expected metrics of the split's test links, the baselines' metrics, and remarks.

    The expected metrics are those of a look-up of the nearest known link of the same receiver and
    carrier. Each test link belongs, by its distance and separation from this link, to a cell of
    ``agreement``. Its expected score is that of pairs in this cell. Cells without compared pairs
    are skipped.

    Args:
        random: Draws the pairs.
        baselines: Configurations of the baselines to fit.
        looked_up: Largest number of values in all labels together for which baselines are fitted.
    """
    rows: dict[str, dict[str, float]] = {}
    remarks = []
    nearest = nearest_known(links)
    if nearest.missing:
        remarks.append(
            f"{nearest.missing:,} test links have no known link of their receiver and carrier, "
            "and are left out"
        )
    cells = agreement.cell(nearest.distances, nearest.separations)  # of each test link
    cells = cells[np.isin(cells, [*agreement.scores])]  # only cells with compared pairs
    if len(cells):
        low, median, high = np.quantile(nearest.distances, (0.1, 0.5, 0.9))
        remarks.append(
            "from a test link to the nearest known one of its receiver and carrier it is "
            f"{median:.3g} m (median; 10th to 90th percentile {low:.3g} to {high:.3g} m), "
            f"and in the order {np.median(nearest.separations):,.0f} (median)"
        )
        scores = drawn_scores(agreement, cells, links.task.compared_by, random)
        rows["one label as near"] = links.task.summarise(scores)
        remarks.append(
            "one label as near: random pairs of the cell that a test link and its nearest known "
            "one are in"
        )
        # With noise of variance s², two labels differ by 2 s² and a label from the mean by s².
        averaged = links.task.averaged(scores)
        if averaged is not None:
            rows["mean of many as near"] = links.task.summarise(averaged)
            remarks.append("mean of many as near: the same with half of the squared difference")
    count = sum(map(len, links.split.parts().values()))
    if baselines and count * math.prod(links.task.shape) > looked_up:
        remarks.append(
            "the baselines are left out, as labels are large and many; "
            "command=train model=mean has them"
        )
    elif baselines:
        rows |= baseline_rows(links, baselines)
    return rows, remarks


class NearestLinks(NamedTuple):
    """The nearest known link of each test link."""

    distances: Float[ndarray, " k"]  # to the nearest known link of its receiver and carrier [m]
    separations: ndarray  # (k,), number of measurements from one of the two links to the other
    missing: int  # number of test links without a known link of their receiver and carrier


def nearest_known(links: Links) -> NearestLinks:
    """For each test link, the nearest known link of its receiver and carrier."""
    places = links.query.transmitters.double().numpy()
    order = visits(links)  # number of each link's measurement
    test = links.split.test.numpy()
    known = links.split.known.numpy()
    distances = [np.zeros(0)]  # at least one array to concatenate
    separations = [np.zeros(0)]
    for group in groups_of(links):
        tested = np.intersect1d(group, test)
        candidates = np.intersect1d(group, known)
        if len(tested) and len(candidates):
            distance, nearest = cKDTree(places[candidates]).query(places[tested])
            distances.append(distance)
            separations.append(np.abs(order[tested] - order[candidates[nearest]]))
    all_distances = np.concatenate(distances)
    missing = len(test) - len(all_distances)
    return NearestLinks(all_distances, np.concatenate(separations), missing)


def drawn_scores(
    agreement: Agreement,
    cells: ndarray,
    score: str,
    random: np.random.Generator,
    fewest: int = 20_000,
) -> dict[str, Tensor]:
    """Scores of random compared pairs, with the test links' distribution over cells.

    The number of pairs is ``fewest``, or the number of test links if larger.

    Args:
        cells: Cell of each test link; cells are drawn from them with replacement.
        score: Name of the score by which pairs were compared.
        random: Draws a cell, then a pair of this cell.
    """
    drawn_cells = random.choice(cells, max(fewest, len(cells)))
    numbers, counts = np.unique(drawn_cells, return_counts=True)
    by_cell = []
    for cell, count in zip(numbers, counts, strict=True):
        scores = agreement.scores[int(cell)]
        pairs = torch.from_numpy(random.integers(len(scores[score]), size=count))
        by_cell.append({name: values[pairs] for name, values in scores.items()})
    return joined_scores(by_cell)


def baseline_rows(links: Links, baselines: list[Mapping]) -> dict[str, dict[str, float]]:
    """Metrics of the baselines on the test links, by the baseline's name in backquotes."""
    test = links.split.test
    labels = torch.cat([links.labels[block] for block in test.split(evaluation.BATCH)])
    rows = {}
    for name, look_up in evaluation.build_baselines(baselines, "", links.scene).items():
        values = evaluation.predicted(evaluation.fitted(look_up, links), links, test)
        rows[f"`{name}`"] = links.task.summarise(links.task.scores(labels, values))
    return rows
