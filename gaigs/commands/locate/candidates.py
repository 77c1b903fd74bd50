"""Candidate places of a transmitter, with their prior probability."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs.core.geometry import even_places
from gaigs.core.query import evenly
from gaigs.data import Links
from gaigs.kriging.links import distances, folds_of


class Candidates(NamedTuple):
    """Candidate places and their prior."""

    places: Float[Tensor, "g 3"]  # [m]
    prior: Float[Tensor, " g"]  # logarithm of each candidate's probability
    density: Float[Tensor, " g"]  # logarithm of the prior density there, but for a constant

    def nearest(self, places: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
        """Number of the candidate nearest to each place."""
        return distances(places.double(), self.places.double()).argmin(1)


def even_candidates(
    box: Float[Tensor, "2 3"], points: int, floors: Sequence[float] | Float[Tensor, " f"] = ()
) -> Candidates:
    """A grid of equally likely places in the box, or on separate floors."""
    places = even_places(box[0], box[1], points, floors)
    prior = torch.full((len(places),), -math.log(len(places)))
    return Candidates(places, prior, torch.zeros(len(places)))


@dataclass(frozen=True)
class PlaceDensity:
    """Prior density of transmitters: normal about each known place, plus uniform in their box."""

    places: Float[Tensor, "k 3"]  # known places [m]
    folds: Int[Tensor, " k"]  # fold of each of them
    edges: Float[Tensor, "3"]  # edges of the box [m]; 0 across separate floors
    floors: Float[Tensor, " f"]  # heights of separate floors [m]; empty for one floor
    # Prior probability that a transmitter is not near a known place but anywhere in the box.
    elsewhere: float = 0.1

    @property
    def has_extent(self) -> Bool[Tensor, "3"]:
        """True for axes along which places differ."""
        return self.edges > 1e-3 * self.edges.max()

    def logarithm(
        self,
        places: Float[Tensor, "g 3"],
        width: float,
        folds: Int[Tensor, " g"] | None = None,
    ) -> Float[Tensor, " g"]:
        """Logarithm of the prior density at places.

        Args:
            width: Standard deviation of the normal density about each known place [m].
            folds: Fold of each of ``places``, if they are known places. Known places of the same
                fold are then excluded. None: all known places count.
        """
        axes = self.has_extent
        squares = distances(places[:, axes], self.places[:, axes]).square_()  # (g, k)
        if len(self.floors):
            is_other = self._floor(places)[:, None] != self._floor(self.places)
            squares = squares.masked_fill(is_other, math.inf)
        if folds is not None:
            squares = squares.masked_fill(folds[:, None] == self.folds, math.inf)
        # The density is (1 - e) / k * sum of N(place; known place, width) + e / volume, with k
        # known places and e = ``elsewhere``. A normal density of d axes is
        # exp(-square / (2 width²)) / (width sqrt(2 pi))^d.
        log_share = math.log(1 - self.elsewhere) - math.log(len(self.places))
        log_peak = log_share - int(axes.sum()) * math.log(width * math.sqrt(2 * math.pi))
        log_near = torch.logsumexp(squares / (-2 * width**2), 1) + log_peak  # (g,)
        volume = self.edges[axes].prod() * max(1, len(self.floors))  # [m^d] over all floors
        return torch.logaddexp(log_near, (self.elsewhere / volume).log())

    def likeliest_width(self, spacing: float, most: int = 1000, tried: int = 24) -> float:
        """The width [m] with the highest likelihood of known places, each given the other folds.

        Args:
            spacing: Median distance from a known place to the next [m].
            most: Largest number of places in the likelihood.
            tried: Number of widths, from a quarter of the spacing to the diagonal of the box.
        """
        rows = evenly(torch.arange(len(self.places)), most)
        widths = torch.logspace(math.log10(spacing / 4), math.log10(self.edges.norm()), tried)

        def mean_logarithm(width: float) -> float:
            """Mean log density at known places, each by the places of the other folds."""
            return self.logarithm(self.places[rows], width, self.folds[rows]).mean().item()

        return max(widths.tolist(), key=mean_logarithm)

    def _floor(self, places: Float[Tensor, "g 3"]) -> Int[Tensor, " g"]:
        """Number of the floor nearest to each place."""
        return (places[:, 2:] - self.floors).abs().argmin(1)


def near_candidates(
    box: Float[Tensor, "2 3"],
    points: int,
    floors: Float[Tensor, " f"],
    links: Links,
    known: Int[Tensor, " k"],
) -> Candidates:
    """Candidates with ``PlaceDensity`` as their prior.

    A quarter of the candidates is on a grid, the others are near known places. The places of
    validation and training links are known, at the carrier of the map.

    Args:
        box: Corners of the box of the grid [m].
        points: Number of candidates.
        floors: Heights of separate floors [m]; empty for a single floor.
        known: Numbers of the known links, whose transmitters are the known places.
    """
    transmitters = links.query.transmitters[known].double()
    places, place_of_link = transmitters.unique(dim=0, return_inverse=True)  # (k, 3)
    folds = torch.zeros(len(places), dtype=torch.long)
    folds = folds.index_copy(0, place_of_link, folds_of(links, known))
    edges = (box[1] - box[0]).double()
    if len(floors):  # heights between the floors have no candidates
        edges[2] = 0
    density = PlaceDensity(places, folds, edges, floors)
    width = density.likeliest_width(links.scene.spacing)

    even = even_places(box[0], box[1], max(1, points // 4), floors)
    count = points - points // 4
    steps = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    steps = width * density.has_extent * steps
    centres = torch.arange(count) * len(places) // count  # each known place equally often
    around = places[centres] + steps
    chosen = torch.cat((even, around.float()))  # (g, 3)

    # The grid samples the uniform part of the prior, the others its normal part. The samples of a
    # part share its probability evenly.
    shares = torch.tensor([density.elsewhere / len(even), (1 - density.elsewhere) / count]).log()
    prior = shares.repeat_interleave(torch.tensor([len(even), count]))
    logarithms = [density.logarithm(block.double(), width) for block in chosen.split(1024)]
    return Candidates(chosen, prior, torch.cat(logarithms).float())
