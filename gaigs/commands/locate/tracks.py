"""Tracks: places of consecutive transmissions of a slowly moving transmitter."""

import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs.commands.locate.candidates import Candidates
from gaigs.kriging.links import distances


def walk(places: Float[Tensor, "n 3"], step: float, most: int = 10) -> Int[Tensor, " k"]:
    """Numbers of the places in the order of a walk, which always goes to the nearest new place.

    All numbers are repeated equally often: as often as a transmitter with moves of ``step`` would
    transmit on the way to the next place. Repeats have equal errors, as fingerprints at nearby
    places do.

    Args:
        places: Places to visit, beginning with the first [m].
        step: Standard deviation of a move along each axis [m].
        most: Largest number of repetitions.
    """
    pair_distances = distances(places, places)
    is_new = torch.ones(len(places), dtype=torch.bool)
    is_new[0] = False
    order = [0]
    walked = []  # distance of each move [m]
    while is_new.any():
        to_new = pair_distances[order[-1]].masked_fill(~is_new, math.inf)
        distance, following = to_new.min(0)
        is_new[following] = False
        order.append(int(following))
        walked.append(distance)
    repeats = 1
    if walked:
        typical_move = step * math.sqrt(3)  # root mean square over three axes
        repeats = round(float(torch.stack(walked).median()) / typical_move)
    return torch.tensor(order).repeat_interleave(min(max(1, repeats), most))


def track(
    candidates: Candidates,
    logarithms: Float[Tensor, "n g"],
    step: float,
    is_received: Bool[Tensor, " n"],
    spread: int = 75,
) -> tuple[Candidates, Float[Tensor, "n j"]]:
    """The posterior of a track by ``smoothed``, over every m-th candidate to save time.

    Args:
        candidates: The g candidate places of a transmission.
        logarithms: Log posterior of each transmission alone.
        step, is_received: See ``smoothed``.
        spread: Number of the remaining candidates over which the posterior of one transmission
            spreads; it sets m. Regions of tracks reach far beyond the likeliest candidates.

    Returns:
        The j candidates, and the log posterior of the track at them.
    """
    # Number of likely candidates, by the inverse sum of squared probabilities: among c equally
    # likely candidates it is c.
    posteriors = torch.softmax(logarithms[is_received], 1)
    likely_count = posteriors.square().sum(1).reciprocal().median()
    stride = max(1, int(likely_count / spread))
    remaining = torch.arange(0, len(candidates.places), stride)  # (j,)
    thinned = Candidates(*(column[remaining] for column in candidates))
    # Single precision halves the time; across a room it moves the mean by less than a micrometre.
    # Logarithms below a maximum of 0 and places about their mean keep their digits.
    log_posteriors = logarithms[:, remaining]  # (n, j)
    log_posteriors = (log_posteriors - log_posteriors.amax(1, keepdim=True)).float()
    places = (thinned.places - thinned.places.mean(0)).float()
    return thinned, smoothed(log_posteriors, places, step, is_received).to(logarithms)


class Moves:
    """Moves of a transmitter between candidates of consecutive transmissions.

    Args:
        places, step, jump: As for ``smoothed``.
    """

    def __init__(self, places: Float[Tensor, "g 3"], step: float, jump: float):
        self.places = places
        self.step = step
        self.jump = jump
        self._last: tuple[Tensor, Tensor, Tensor] | None = None

    def take(
        self,
        log_probabilities: Float[Tensor, " k"],
        start: Int[Tensor, " k"],
        end: Int[Tensor, " k"],
    ) -> Float[Tensor, " k"]:
        """Log probabilities of the candidates ``end`` after one move, up to a constant.

        Args:
            log_probabilities: Log probabilities of the candidates ``start`` before the move.
            start, end: Numbers of candidates.
        """
        probabilities = (log_probabilities - log_probabilities.max()).exp()
        # All sums are above 0, as each move may be a jump.
        return (self._densities(start, end) @ probabilities).log()

    def _densities(self, start: Int[Tensor, " k"], end: Int[Tensor, " k"]) -> Float[Tensor, "k k"]:
        """Densities of moves from candidates ``start`` (columns) to ``end`` (rows).

        The unit is the density of not moving: exp(-distance² / (2 step²)) + jump. The last result
        is cached, since repeated transmissions of a walk have equal candidates.
        """
        if self._last is not None:
            first, second, densities = self._last
            if torch.equal(first, start) and torch.equal(second, end):
                return densities
        squares = (distances(self.places[end], self.places[start]) / self.step).square_()
        exponents = squares.div_(-2)
        # Less than exp(-30) is nothing beside the jump, and slow to compute.
        densities = exponents.clamp_min_(-30).exp_().add_(self.jump)
        self._last = start, end, densities
        return densities


def smoothed(
    logarithms: Float[Tensor, "n g"],
    places: Float[Tensor, "g 3"],
    step: float,
    is_received: Bool[Tensor, " n"],
    most: int = 1500,
    jump: float = 1e-4,
) -> Float[Tensor, "n g"]:
    """Log posterior of each place of a track given all transmissions.

    Args:
        logarithms: Log posterior of each place given each transmission alone.
        places: The g candidates [m].
        step: Standard deviation of a move along each axis [m].
        is_received: True for transmissions that a receiver has received. Other transmissions are
            near ``straight_lines`` between them.
        most: Largest number of candidates of a transmission that have moves to the next one.
        jump: Density of a move to any place over the density of not moving: a track may jump.

    Source: Rabiner, A tutorial on hidden Markov models, 1989, the forward-backward algorithm.
    """
    # Each transmission keeps its k likeliest candidates, a missed one the nearest to its line.
    line_distances = distances(straight_lines(logarithms, places, is_received), places)  # (n, g)
    preference = torch.where(is_received[:, None], logarithms, -line_distances)
    indices = preference.topk(min(most, len(places)), dim=1).indices  # (n, k)
    alone = logarithms.gather(1, indices)  # (n, k), log posterior given each transmission alone

    # Moves are at least as wide as the candidates are apart.
    first = places[indices[0]]
    spacing = distances(first, first).fill_diagonal_(math.inf).amin(1).median()
    moves = Moves(places, math.hypot(step, spacing.item()), jump)

    # forward: log posterior given the transmissions up to each one; backward: given later ones.
    forward = [alone[0]]  # n of (k,)
    for current, (before, here) in zip(alone[1:], itertools.pairwise(indices), strict=True):
        forward.append(current + moves.take(forward[-1], before, here))
    backward = [torch.zeros_like(alone[0])]  # from the last transmission to the first
    reversed_pairs = itertools.pairwise(indices.flip(0))
    # The first transmission has none before it to move to.
    for current, (here, before) in zip(alone.flip(0), reversed_pairs, strict=False):
        backward.append(moves.take(current + backward[-1], here, before))
    posterior = torch.stack(forward) + torch.stack(backward[::-1])
    return torch.full_like(logarithms, -math.inf).scatter(1, indices, posterior)


def straight_lines(
    logarithms: Float[Tensor, "n g"],
    places: Float[Tensor, "g 3"],
    is_received: Bool[Tensor, " n"],
) -> Float[Tensor, "n 3"]:
    """Places of all transmissions on straight lines between the received ones [m].

    A received transmission is at its likeliest candidate. Missed transmissions divide the line
    between the two received ones around them into equal parts.
    """
    received = is_received.nonzero()[:, 0]  # (r,), ascending
    numbers = torch.arange(len(is_received))
    # Positions in ``received`` of the next and the last received transmission (n,). They are equal
    # for a received one, and for those before the first or after the last.
    after = torch.searchsorted(received, numbers).clamp_max(len(received) - 1)
    before = (torch.searchsorted(received, numbers, right=True) - 1).clamp_min(0)
    likeliest = places[logarithms[received].argmax(1)]  # (r, 3)
    gaps = (received[after] - received[before]).clamp_min(1)
    shares = ((numbers - received[before]) / gaps).clamp(0, 1)[:, None]  # (n, 1) of the way
    return torch.lerp(likeliest[before], likeliest[after], shares.to(places))
