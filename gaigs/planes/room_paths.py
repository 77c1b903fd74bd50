"""Paths in a learnt room: their powers, and the points where planes reflect them."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.placement.mirrored.paths import Mirrored


class TracedPaths(NamedTuple):
    """Powers and bounces of the kept paths of some links."""

    sequences: Int[ndarray, "n order"]  # numbers of the planes of each path, -1 for a missing plane
    powers: Float[ndarray, "b n"]  # received powers; 0 for a path that does not exist
    # Points on the planes of each sequence, NaN for a missing plane [m].
    bounces: Float[ndarray, "b n order 3"]
    # Ends of the links [m].
    transmitters: Float[ndarray, "b 3"]
    receivers: Float[ndarray, "b 3"]

    @property
    def shares(self) -> Float[ndarray, "b n"]:
        """Share of each path in its link's power; 0 for a link without power."""
        total = self.powers.sum(1, keepdims=True)
        return self.powers / np.where(total > 0, total, 1)

    @property
    def ends(self) -> Float[ndarray, "k 3"]:
        """Transmitters and receivers [m]."""
        return np.concatenate((self.transmitters, self.receivers))

    @property
    def plane_shares(self) -> dict[int, float]:
        """Share of the received power that paths at each used plane carry, largest first.

        Keys are numbers of planes. Shares are averages over links. A path with two planes counts
        for both.
        """
        means = self.shares.mean(0)  # (n,)
        shares = {}
        for number in np.unique(self.sequences[self.sequences >= 0]).tolist():
            has_plane = (self.sequences == number).any(1)
            shares[number] = means[has_plane].sum().item()
        return dict(sorted(shares.items(), key=lambda item: -item[1]))


class LearntPath(NamedTuple):
    """A path through the room."""

    points: Float[ndarray, "p 3"]  # transmitter, bounces, receiver [m]
    power_db: float  # over the strongest listed path


def thin_links(query: Query) -> Query:
    """At most 256 of the links, evenly spread."""
    count = len(query)
    return query[torch.linspace(0, count - 1, min(256, count)).long()]


def spread_links(scene: Scene) -> Query:
    """256 links spread over the training transmitters' box, the receivers and the carriers."""
    number = torch.arange(256)
    shares = torch.quasirandom.SobolEngine(3).draw(len(number)).to(scene.lower)
    places = scene.lower + (scene.upper - scene.lower) * shares
    carriers = None
    if len(scene.frequencies):
        carriers = scene.frequencies[number % len(scene.frequencies)]
    return Query(places, number % len(scene.receivers), carriers)


@torch.no_grad()
def trace_paths(placement: Mirrored, query: Query) -> TracedPaths:
    """Powers and bounces of the kept paths of some links."""
    device = placement.sequences.device
    sequences = placement.sequences[placement.kept]
    powers = []
    bounces = []
    receivers = []
    for links in query.parts(64):  # links at a time
        links = links.to(device)
        powers.append(placement(None, links).gains.abs().square())
        _, positions, folded = placement.folded(links)
        receivers.append(placement.scene.positions(positions)[links.receivers])
        points = positions.new_full((len(links), *sequences.shape, 3), torch.nan)
        # Folding begins at the receiver, that is at the last plane of a sequence. Only paths from
        # number ``first`` on have a plane at this place.
        for from_end, (first, reflected) in enumerate(folded.parts(folded.bounces), 1):
            points[:, first:, -from_end] = reflected + placement.middle
        bounces.append(points)
    return TracedPaths(
        sequences.cpu().numpy(),
        torch.cat(powers).double().cpu().numpy(),
        torch.cat(bounces).cpu().numpy(),
        query.transmitters.cpu().numpy(),
        torch.cat(receivers).cpu().numpy(),
    )


def list_paths(placement: Mirrored, query: Query) -> list[LearntPath]:
    """The strongest paths of all links together, strongest first.

    At most 20 paths are listed, within 30 dB of the strongest.
    """
    traced = trace_paths(placement, query)
    powers = traced.powers / traced.powers.max(initial=np.finfo(float).tiny)
    strongest = np.argsort(-powers, axis=None)[:20]
    paths = []
    for link, path in zip(*np.unravel_index(strongest, powers.shape), strict=True):
        if powers[link, path] < 1e-3:
            continue
        bounces = traced.bounces[link, path][traced.sequences[path] >= 0]
        transmitter, receiver = traced.transmitters[link, None], traced.receivers[link, None]
        points = np.concatenate((transmitter, bounces, receiver))  # (p, 3)
        paths.append(LearntPath(points, 10 * math.log10(powers[link, path])))
    return paths
