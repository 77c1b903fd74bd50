"""Means of a process with very many readings, in tiles that are solved with nearby readings."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gaigs.kriging.kernel import resize
from gaigs.kriging.links import nearest_places


class Merged(NamedTuple):
    """Readings of a receiver, in which repeated readings at a place and carrier may be one."""

    rows: Int[Tensor, " m"]  # row of the first reading at each place
    values: Float[Tensor, " m"]  # means of the readings, weighted by 1 / variance
    variances: Float[Tensor, " m"]  # noise variances of these means


class Tiles(nn.Module):
    """Division of a receiver's readings, if they are too many for one covariance matrix.

    Each reading belongs to one tile, and at most ``core`` readings to a tile. A tile is solved with
    ``size`` readings: those that belong to it, then the neighbours of each of these, then the
    readings nearest to the tile's centre. A place is predicted by the tile of its nearest reading.
    A tile is solved at the first prediction in it.
    """

    core = 64
    """Largest number of readings that belong to a tile."""
    size = 256
    """Number of readings with which a tile is solved; docs/methods.md has the error of fewer."""
    neighbours = 32
    """Number of neighbours of each reading that belongs to a tile; at even density they fill it."""

    stored = "readings", "values", "variances", "owners", "rows"

    readings: Tensor  # rows of the divided readings among all known ones, one for each place (n,)
    # Values of the divided readings, and their noise variances, see ``Merged`` (n,).
    values: Tensor
    variances: Tensor
    owners: Tensor  # tile to which each divided reading belongs (n,)
    rows: Tensor  # rows of ``readings`` with which each tile is solved (t, j)
    # Inverse covariance matrix of a tile's readings times their values (t, j); NaN until solved,
    # and not stored.
    weights: Tensor

    def __init__(self) -> None:
        super().__init__()
        empty = torch.zeros(0, dtype=torch.int32)
        self.register_buffer("readings", empty)
        self.register_buffer("owners", empty.clone())
        for name in ("values", "variances"):
            self.register_buffer(name, empty.double())
        self.register_buffer("rows", empty.new_zeros(0, self.size))
        self.register_buffer("weights", self.rows.double(), persistent=False)

    def __len__(self) -> int:
        return len(self.rows)

    def clear(self) -> None:
        """Removes all tiles."""
        for name in self.stored[:-1]:
            setattr(self, name, getattr(self, name)[:0])
        self.rows = self.rows.new_zeros(0, self.size)

    def add(self, places: Float[Tensor, "m d"], readings: Merged) -> None:
        """Divides the readings of one more receiver, at ``places``, into tiles."""
        members = halves(places, self.core)  # rows that belong to each tile
        centres = torch.stack([places[rows].mean(0) for rows in members])
        near = nearest_places(centres, places, self.size).rows  # (t, j)
        around = nearest_places(places, places, self.neighbours).rows  # (m, n)
        tiles = []
        for own, nearest in zip(members, near, strict=True):
            neighbours = around[own].mT.flatten()  # nearest neighbours of all first
            order = torch.cat((own, neighbours, nearest)).tolist()
            without_repetition = [*dict.fromkeys(order)]
            tiles.append(without_repetition[: near.shape[1]])
        owners = torch.empty_like(readings.rows)
        for number, own in enumerate(members, len(self)):
            owners[own] = number
        rows = near.new_tensor(tiles) + len(self.readings)
        for name, added in zip(self.stored, (*readings, owners, rows), strict=True):
            old = getattr(self, name)
            setattr(self, name, torch.cat((old, added.to(old.dtype))))
        self.weights = torch.full_like(self.rows, math.nan, dtype=torch.float64)

    def numbers(
        self, asked: Float[Tensor, "b d"], places: Float[Tensor, "k d"], known: Bool[Tensor, " k"]
    ) -> Int[Tensor, " _"]:
        """Tile of each asked place, by its nearest reading; empty if the receiver has no tiles.

        ``places`` are the places of all readings; ``known`` marks the readings of the receiver.
        """
        is_own = known[self.readings]
        rows, owners = self.readings[is_own], self.owners[is_own]
        if not len(rows):
            return owners
        return owners[nearest_places(asked, places[rows], 1).rows[:, 0]]

    def mean(
        self,
        asked: Float[Tensor, "b d"],
        tiles: Int[Tensor, " b"],
        places: Float[Tensor, "k d"],
        covariances: Callable[[Tensor, Tensor], Tensor],
        solve: Callable[[Merged], Tensor],
    ) -> Float[Tensor, " b"]:
        """Means of the process at ``asked`` places, each by its tile.

        Args:
            asked: Places, see ``coordinates``.
            tiles: Tile of each asked place.
            places: Places of all known readings.
            covariances: Function from two sets of places to their covariances.
            solve: Function from readings to their weights.
        """
        means = asked.new_zeros(len(asked))
        order = tiles.argsort()
        numbers, counts = tiles[order].unique_consecutive(return_counts=True)
        for tile, part in zip(numbers.tolist(), order.split(counts.tolist()), strict=True):
            rows = self.rows[tile]
            readings = Merged(self.readings[rows].long(), self.values[rows], self.variances[rows])
            if self.weights[tile, 0].isnan():
                self.weights[tile] = solve(readings)
            means[part] = covariances(asked[part], places[readings.rows]) @ self.weights[tile]
        return means

    def _load_from_state_dict(self, state_dict, prefix, *args):
        if not len(state_dict.get(f"{prefix}rows", ())):  # also in checkpoints without tiles
            state_dict.clear()
            for name in self.stored:
                state_dict[f"{prefix}{name}"] = getattr(self, name)[:0]
        resize(self, state_dict, prefix, *self.stored)
        self.weights = torch.full_like(self.rows, math.nan, dtype=torch.float64)
        super()._load_from_state_dict(state_dict, prefix, *args)


def merged(
    places: Float[Tensor, "k d"], values: Float[Tensor, " k"], variances: Float[Tensor, " k"]
) -> Merged:
    """Readings merged to one for each place, with the same posterior of the process."""
    unique, numbers = places.unique(dim=0, return_inverse=True)  # place of each reading (k,)
    rows = torch.arange(len(places), device=places.device)
    first = rows.new_full((len(unique),), len(rows)).scatter_reduce(0, numbers, rows, "amin")
    precisions = values.new_zeros(len(unique)).index_add(0, numbers, 1 / variances)
    sums = values.new_zeros(len(unique)).index_add(0, numbers, values / variances)
    return Merged(first, sums / precisions, 1 / precisions)


def halves(places: Float[Tensor, "k d"], most: int) -> list[Int[Tensor, " _"]]:
    """Rows of the places in each box; boxes are halved across their longest edge.

    Halving ends when no box has more than ``most`` places.
    """
    pending = [torch.arange(len(places), device=places.device)]
    small = []
    while pending:
        rows = pending.pop()
        if len(rows) <= most:
            small.append(rows)
            continue
        inside = places[rows]
        axis = int((inside.amax(0) - inside.amin(0)).argmax())  # the longest edge
        order = inside[:, axis].argsort()
        middle = len(rows) // 2
        pending += [rows[order[:middle]], rows[order[middle:]]]
    return small
