"""Measured places: their effect on the error, and superfluous ones."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs.commands.survey.processes import mean_of_received, reception_chances
from gaigs.core.query import evenly
from gaigs.core.stages import track
from gaigs.kriging.kernel import Process
from gaigs.kriging.links import distances


class Measured(NamedTuple):
    """Measured places and their effect on the error."""

    places: Float[Tensor, "k 3"]  # [m]
    error: float  # mean error with all of them, in the label's unit
    losses: Float[Tensor, " k"]  # rise of the error without each of them
    superfluous: Bool[Tensor, " k"]  # places without which the error rises by little in all


class ReceiverReadings(NamedTuple):
    """Readings of one receiver, and its process at the g places of the mean error."""

    process: Process
    rows: Int[Tensor, " n"]  # numbers of the readings
    places: Int[Tensor, " n"]  # number of each reading's measured place
    variances: Float[Tensor, " g"]  # variances at the places without any reading
    chances: Float[Tensor, " g"]  # probability that the receiver receives each place

    def deviations(self, whitened: Float[Tensor, "n g"]) -> Float[Tensor, " g"]:
        """Standard deviations of new readings, given the ``Process.whitened`` of known readings."""
        variances = (self.variances - whitened.square().sum(0)).clamp_min(0)
        return (variances + self.process.noise).sqrt()

    def rises(self, places: Float[Tensor, "g d"]) -> Iterator[tuple[int, Float[Tensor, ""]]]:
        """For each measured place, its number and the rise of the summed deviations without it.

        The sum is over the evaluated ``places``, weighted by the probability of reception. With
        K = L L' of the readings and k between readings and places, the weights of kriging are
        w = K^-1 k. Without the readings R of a place, block inversion raises the variances by
        w_R' ((K^-1)_RR)^-1 w_R.
        """
        whitened, factor = self.process.whitened(places, self.rows)  # L^-1 k (n, g), and L
        deviations = self.deviations(whitened)
        weights = torch.linalg.solve_triangular(factor.mT, whitened, upper=True)  # w, (n, g)
        inverse = torch.cholesky_inverse(factor)  # K^-1, (n, n)
        for number in self.places.unique().tolist():  # all readings of a place go together
            removed = (self.places == number).nonzero()[:, 0]  # R
            removed_weights = weights[removed]  # w_R
            block = inverse[removed[:, None], removed]  # (K^-1)_RR
            solved = torch.linalg.solve(block, removed_weights)
            variance_rises = (removed_weights * solved).sum(0)  # (g,)
            # To first order the root of v rises by dv / (2 sqrt(v)).
            yield number, self.chances @ (variance_rises / (2 * deviations))


def measured_places(
    processes: Sequence[Process],
    evaluated: Float[Tensor, "g d"],
    factor: float,
    most: int = 1500,
    tolerated: float = 1.05,
) -> Measured:
    """The measured places, and how much each of them lowers the mean error.

    Args:
        processes: Process of each receiver, with its readings.
        evaluated: Coordinates of the places over which the error is averaged.
        factor: Ratio of a label's mean absolute error to its standard deviation.
        most: Largest number of readings of a receiver, evenly chosen.
        tolerated: Largest ratio of the mean error without the superfluous places to the error with
            all. The places with the smallest effect on the error are superfluous.
    """
    rows = []
    places = []
    for process in processes:
        index = evenly(torch.arange(len(process.places)), most).to(evaluated.device)
        rows.append(index)
        places.append(process.places[index, :3])
    known = torch.cat(places).unique(dim=0)  # (k, 3)
    chances = reception_chances(processes, evaluated)  # (r, g)
    readings = []
    for process, index, measured, chance in zip(processes, rows, places, chances, strict=True):
        place_of_reading = distances(measured, known).argmin(1)
        # In blocks: only the diagonal of the covariances is needed.
        blocks = evaluated.split(16)
        variances = torch.cat([process.covariances(block, block).diagonal() for block in blocks])
        readings.append(ReceiverReadings(process, index, place_of_reading, variances, chance))

    def error(is_kept: Bool[Tensor, " k"]) -> float:
        """Mean standard deviation with readings of the kept places only."""
        deviations = []
        for receiver in readings:
            rows = receiver.rows[is_kept[receiver.places]]
            whitened, _ = receiver.process.whitened(evaluated, rows)
            deviations.append(receiver.deviations(whitened))
        return mean_of_received(torch.stack(deviations), chances)

    losses = known.new_zeros(len(known))
    for receiver in track(readings, "places to leave out"):
        for number, rise in receiver.rises(evaluated):
            losses[number] += rise / chances.sum()

    # Bisection: the largest number of places with the smallest losses that may be left out
    # together, to about 3 % of all places.
    is_kept = torch.ones(len(known), dtype=torch.bool, device=known.device)
    error_of_all = error(is_kept)
    order = losses.argsort()
    possible = 0
    impossible = len(known) - 1
    while impossible - possible > max(1, len(known) // 32):
        middle = (possible + impossible) // 2
        is_kept.fill_(True)
        is_kept[order[:middle]] = False
        if error(is_kept) <= tolerated * error_of_all:
            possible = middle
        else:
            impossible = middle
    superfluous = torch.zeros(len(known), dtype=torch.bool)
    superfluous[order[:possible].cpu()] = True
    return Measured(known.float().cpu(), factor * error_of_all, factor * losses.cpu(), superfluous)
