"""Fingerprints: labels of a transmission at all receivers, which identify its place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.commands.locate.candidates import Candidates
from gaigs.commands.locate.tracks import track, walk
from gaigs.core.geometry import Frame
from gaigs.core.query import ROUNDING
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.split import rows_of


class LocatedFold(NamedTuple):
    """Held-out fingerprints of a fold, located in the map of a model trained without them."""

    candidates: Candidates  # candidates of this map
    # Log likelihoods of the candidates, with known and with unknown power. Their degrees and temper
    # are chosen without these fingerprints.
    likelihoods: Float[Tensor, "2 n g"]
    truth: Float[Tensor, "n 3"]  # places of the fingerprints [m]


@dataclass(frozen=True, repr=False)
class Fingerprints:
    """The map of ``locate``: predicted fingerprints at candidate places.

    ``locate`` compares received fingerprints with the predictions.

    Attributes:
        task: Task of the labels.
        frequency: Carrier [Hz]; None if unknown.
        receivers: Names of the r receivers.
        candidates: The g places of the predictions, with their prior.
        axes: Axes (m, k) along which the errors of a label's m values are independent, with equal
            variances.
        values: Predictions at the candidates along these axes (g, r, k).
        deviations: Standard deviations of scalar labels (g, r); 1 for other labels.
        reception_probabilities: Probability that each receiver receives a transmission from each
            candidate (g, r); 0.5 without links.
        degrees, temper: Degrees of freedom and exponent of Student's t in ``log_likelihood``.
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
    reception_probabilities: Float[Tensor, "g r"]
    degrees: float = 4.0
    temper: float = 1.0
    held: tuple[LocatedFold, ...] = ()
    frame: Frame | None = None
    _drops: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        places, receivers, _ = self.values.shape
        size = f"{places} candidates, {receivers} receivers"
        return f"<fingerprints of task {self.task.name!r}: {size}>"

    @property
    def held_out_count(self) -> int:
        """Number of held-out fingerprints."""
        return sum(len(fold.truth) for fold in self.held)

    def drops(self, unknown_power: bool = False, step: float | None = None) -> Float[Tensor, " h"]:
        """Log ratios of the highest posterior density to that at the true place, ascending (h,).

        Each held-out fingerprint gives one ratio. With a ``step`` [m] the fingerprints are sorted
        into a ``walk`` and located as a track. Results are cached, since a track takes long.
        """
        if (unknown_power, step) not in self._drops:
            drops = [torch.zeros(0, dtype=torch.float64)]
            for candidates, likelihoods, truth in self.held:
                logarithms = likelihoods[int(unknown_power)] + candidates.prior.double()
                if step is not None:
                    order = walk(truth, step)
                    is_received = torch.ones(len(order), dtype=torch.bool)
                    candidates, logarithms = track(candidates, logarithms[order], step, is_received)
                    truth = truth[order]
                # Posterior density = likelihood times prior density. ``prior`` is the probability
                # of a candidate, which is no density: candidates are a sample of the prior.
                log_densities = logarithms - candidates.prior + candidates.density  # (n, g)
                nearest = candidates.nearest(truth)[:, None]
                at_truth = log_densities.gather(1, nearest)[:, 0]  # (n,)
                drops.append(log_densities.amax(1) - at_truth)
            self._drops[unknown_power, step] = torch.cat(drops).sort().values
        return self._drops[unknown_power, step]


class Transmissions(NamedTuple):
    """Fingerprints of transmissions, and the places of their transmitters."""

    # Labels as ``Task.fingerprint`` gives them, NaN where a receiver has none.
    values: Float[Tensor, "n r m"]
    places: Float[Tensor, "n 3"]  # [m]


def at_carrier(links: Links, frequency: float | None, *parts: str) -> Int[Tensor, " k"]:
    """Indices of the links at a carrier [Hz] in the given ``parts`` of the split."""
    index = torch.cat([getattr(links.split, part) for part in parts])
    if frequency is None or links.query.frequencies is None:
        return index
    return index[(links.query.frequencies[index] / frequency - 1).abs() < ROUNDING]


def transmissions(links: Links, index: Int[Tensor, " k"]) -> Transmissions:
    """The transmissions of the links ``index``, with the labels of these links only."""
    rows, transmission_of_link = rows_of(links)[index].unique(return_inverse=True)
    # ``rows``: numbers of the transmissions. Blocks, as labels may be read from a file.
    blocks = [links.task.fingerprint(links.labels[block]) for block in index.split(256)]
    labels = torch.cat(blocks)  # (k, m)
    values = labels.new_full((len(rows), len(links.receivers), labels.shape[1]), math.nan)
    values[transmission_of_link, links.query.receivers[index]] = labels
    places = torch.zeros(len(rows), 3)
    places[transmission_of_link] = links.query.transmitters[index]
    return Transmissions(values, places)


def receptions(
    links: Links, index: Int[Tensor, " k"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n r"]]:
    """Places of n transmissions [m], and for each receiver 1 if it has a link ``index``, else 0."""
    rows, transmission_of_link = rows_of(links)[index].unique(return_inverse=True)
    places = torch.zeros(len(rows), 3)
    places[transmission_of_link] = links.query.transmitters[index]
    is_received = torch.zeros(len(rows), len(links.receivers))
    is_received[transmission_of_link, links.query.receivers[index]] = 1
    return places, is_received
