"""Means of a process of many readings: tiles of the floor, each solved with the readings around."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gaigs.kriging.kernel import resize
from gaigs.kriging.links import nearest_places


class Tiles(nn.Module):
    """Parts of the readings of receivers that have too many for one covariance matrix.

    A tile is solved with ``size`` readings: its own, ``core`` at most, then those around each of
    its own, which screen those behind them, then those nearest to its centre. The tile of a place
    is that of the nearest reading. Tiles are solved when a place in them is first asked for.

    Attributes:
        readings: Rows of the divided readings among all known readings (n,).
        owners: Tiles whose own these readings are (n,).
        rows: Rows of the readings with which each tile is solved (t, j).
        weights: Values over the covariances of a tile's readings (t, j); NaN until asked for, and
            not stored.
    """

    core = 128
    """Most readings of a tile's own."""
    size = 512
    """Readings of a tile; see docs/methods.md for the error that more would take away."""
    neighbours = 64
    """Readings around each of a tile's own: as many as fill a tile where density is even."""

    readings: Tensor
    owners: Tensor
    rows: Tensor
    weights: Tensor

    def __init__(self) -> None:
        super().__init__()
        empty = torch.zeros(0, dtype=torch.int32)
        self.register_buffer("readings", empty)
        self.register_buffer("owners", empty.clone())
        self.register_buffer("rows", empty.new_zeros(0, self.size))
        weights = torch.zeros(0, self.size, dtype=torch.float64)
        self.register_buffer("weights", weights, persistent=False)

    def __len__(self) -> int:
        return len(self.rows)

    def clear(self) -> None:
        """Takes all tiles away."""
        self.readings, self.owners = self.readings[:0], self.owners[:0]
        self.rows = self.rows.new_zeros(0, self.size)

    def add(self, places: Float[Tensor, "k d"], rows: Int[Tensor, " k"]) -> None:
        """Divides the readings of a receiver, whose rows among all readings are given."""
        parts = halves(places, self.core)
        centres = torch.stack([places[part].mean(0) for part in parts])
        near = nearest_places(centres, places, self.size).rows  # (t, j)
        around = nearest_places(places, places, self.neighbours).rows  # (k, n)
        tiles = []
        for part, nearest in zip(parts, near, strict=True):
            order = torch.cat((part, around[part].mT.flatten(), nearest))  # nearest ranks first
            tiles.append([*dict.fromkeys(order.tolist())][: near.shape[1]])
        sizes = torch.tensor([len(part) for part in parts], device=rows.device)
        owners = torch.repeat_interleave(sizes) + len(self)
        self.readings = torch.cat((self.readings, rows[torch.cat(parts)].int()))
        self.owners = torch.cat((self.owners, owners.int()))
        self.rows = torch.cat((self.rows, rows[torch.tensor(tiles, device=rows.device)].int()))
        self.weights = torch.full_like(self.rows, math.nan, dtype=torch.float64)

    def numbers(
        self, asked: Float[Tensor, "b d"], places: Float[Tensor, "k d"], known: Bool[Tensor, " k"]
    ) -> Int[Tensor, " _"]:
        """Tiles of places, by the ``places`` of all readings and which of them are ``known`` to a
        receiver; none if it has no tiles.
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
        solve: Callable[[Int[Tensor, " j"]], Float[Tensor, " j"]],
    ) -> Float[Tensor, " b"]:
        """Means at places in their ``tiles``: ``covariances`` with the ``places`` of all readings,
        times weights from ``solve`` of a tile's rows.
        """
        means = asked.new_zeros(len(asked))
        order = tiles.argsort()
        numbers, counts = tiles[order].unique_consecutive(return_counts=True)
        for tile, part in zip(numbers.tolist(), order.split(counts.tolist()), strict=True):
            rows = self.rows[tile].long()
            if self.weights[tile, 0].isnan():
                self.weights[tile] = solve(rows)
            means[part] = covariances(asked[part], places[rows]) @ self.weights[tile]
        return means

    def _load_from_state_dict(self, state_dict, prefix, *args):
        if not len(state_dict.get(f"{prefix}rows", ())):  # also one of before
            state_dict.clear()
            for name in ("readings", "owners", "rows"):
                state_dict[f"{prefix}{name}"] = getattr(self, name)[:0]
        resize(self, state_dict, prefix, "readings", "owners", "rows")
        self.weights = torch.full_like(self.rows, math.nan, dtype=torch.float64)
        super()._load_from_state_dict(state_dict, prefix, *args)


def halves(places: Float[Tensor, "k d"], most: int) -> list[Int[Tensor, " _"]]:
    """Rows of places in boxes of at most ``most``: a box is halved across its longest edge."""
    parts = [torch.arange(len(places), device=places.device)]
    done = []
    while parts:
        part = parts.pop()
        if len(part) <= most:
            done.append(part)
            continue
        inside = places[part]
        axis = int((inside.amax(0) - inside.amin(0)).argmax())
        order = inside[:, axis].argsort()
        middle = len(part) // 2
        parts += [part[order[:middle]], part[order[middle:]]]
    return done
