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

    Each number is repeated as often as a transmitter with moves of ``step`` would transmit on its
    way to the next place. Repeats have equal errors, as fingerprints at nearby places do.

    Args:
        step: Standard deviation of a move along each axis [m].
        most: Largest number of repetitions.
    """
    apart = distances(places, places)
    is_free = torch.ones(len(places), dtype=torch.bool)
    is_free[0] = False
    order = [0]
    moves = []
    while is_free.any():
        move, following = apart[order[-1]].masked_fill(~is_free, math.inf).min(0)
        is_free[following] = False
        order.append(int(following))
        moves.append(move)
    stays = round(float(torch.stack(moves).median()) / (step * math.sqrt(3))) if moves else 1
    return torch.tensor(order).repeat_interleave(min(max(1, stays), most))


def track(
    candidates: Candidates,
    logarithms: Float[Tensor, "n g"],
    step: float,
    is_received: Bool[Tensor, " n"],
    spread: int = 75,
) -> tuple[Candidates, Float[Tensor, "n j"]]:
    """The posterior of a track by ``smoothed``, over every m-th candidate to save time.

    Args:
        logarithms: Log posterior of each transmission alone.
        step, is_received: See ``smoothed``.
        spread: Number of the remaining candidates over which the posterior of one transmission
            spreads; it sets m. Regions of tracks reach far beyond the likeliest candidates.

    Returns:
        The j candidates, and the log posterior of the track at them.
    """
    # The inverse sum of squared probabilities: among c equally likely candidates it is c.
    posteriors = torch.softmax(logarithms[is_received], 1)
    count = posteriors.square().sum(1).reciprocal().median()
    even = torch.arange(0, len(candidates.places), max(1, int(count / spread)))
    part = Candidates(*(column[even] for column in candidates))
    # Single precision halves the time; across a room it moves the mean by less than a micrometre.
    single = logarithms[:, even]  # (n, j)
    single = (single - single.amax(1, keepdim=True)).float()
    places = (part.places - part.places.mean(0)).float()
    return part, smoothed(single, places, step, is_received).to(logarithms)


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
        logarithm: Float[Tensor, " k"],
        start: Int[Tensor, " k"],
        end: Int[Tensor, " k"],
    ) -> Float[Tensor, " k"]:
        """Logarithms of probabilities after one move, at candidates ``end`` from ``start``."""
        # The logarithm is of a number above 0, as each move may be a jump.
        return (self._densities(start, end) @ (logarithm - logarithm.max()).exp()).log()

    def _densities(self, start: Int[Tensor, " k"], end: Int[Tensor, " k"]) -> Float[Tensor, "k k"]:
        """Densities of moves from candidates ``start`` (columns) to ``end`` (rows).

        The unit is the density of not moving.
        """
        if self._last is not None:  # a walk may stay
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
    apart = distances(straight_lines(logarithms, places, is_received), places)  # (n, g)
    preference = torch.where(is_received[:, None], logarithms, -apart)
    indices = preference.topk(min(most, len(places)), dim=1).indices  # (n, k)
    single = logarithms.gather(1, indices)  # (n, k)

    # Moves are at least as wide as the candidates are apart.
    first = places[indices[0]]
    spacing = distances(first, first).fill_diagonal_(math.inf).amin(1).median()
    moves = Moves(places, math.hypot(step, spacing.item()), jump)

    # forward: log posterior given the transmissions up to each one; backward: given later ones.
    forward = [single[0]]  # n of (k,)
    for value, pair in zip(single[1:], itertools.pairwise(indices), strict=True):
        forward.append(value + moves.take(forward[-1], *pair))
    backward = [torch.zeros_like(single[0])]
    reversed_pairs = itertools.pairwise(indices.flip(0))
    for value, pair in zip(single.flip(0), reversed_pairs, strict=False):
        backward.append(moves.take(value + backward[-1], *pair))
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
    received = is_received.nonzero()[:, 0]
    numbers = torch.arange(len(is_received))
    after = torch.searchsorted(received, numbers).clamp_max(len(received) - 1)
    before = (torch.searchsorted(received, numbers, right=True) - 1).clamp_min(0)
    likeliest = places[logarithms[received].argmax(1)]
    gaps = (received[after] - received[before]).clamp_min(1)
    shares = ((numbers - received[before]) / gaps).clamp(0, 1)[:, None]
    return torch.lerp(likeliest[before], likeliest[after], shares.to(places))
