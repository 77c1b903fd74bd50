"""Means of a process of many readings: tiles of the floor, each solved with the readings around."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.kriging.kernel import resize
from gaigs.kriging.links import nearest_places


class Tiles(nn.Module):
    """Parts of the readings of receivers that have too many for one covariance matrix.

    A tile has ``size`` readings, the nearest to its centre. The tile of a place is that with the
    nearest centre, so that ``size`` / ``core`` - 1 readings lie around each of its own: they screen
    those behind them. Tiles are solved when a place in them is first asked for.

    Attributes:
        centres: Centres of the tiles (t, d), see ``coordinates``.
        receivers: Receivers of the tiles (t,).
        rows: Rows of the readings of each tile (t, j).
        weights: Values over the covariances of the tile's readings (t, j); NaN until asked for.
    """

    core = 128
    """Readings nearest to a tile's centre among all centres, about."""
    size = 512
    """Readings of a tile; see docs/methods.md for the error that more would take away."""

    centres: Tensor
    receivers: Tensor
    rows: Tensor
    weights: Tensor

    def __init__(self, dimensions: int):
        super().__init__()
        empty = torch.zeros(0, dtype=torch.float64)
        self.register_buffer("centres", empty.new_zeros(0, dimensions))
        self.register_buffer("receivers", empty.long())
        self.register_buffer("rows", empty.new_zeros(0, self.size, dtype=torch.int32))
        self.register_buffer("weights", empty.new_zeros(0, self.size))

    def __len__(self) -> int:
        return len(self.centres)

    def clear(self) -> None:
        """Takes all tiles away."""
        self.centres, self.receivers = self.centres[:0], self.receivers[:0]
        self.rows = self.rows.new_zeros(0, self.size)
        self.weights = self.weights.new_zeros(0, self.size)

    def add(self, places: Float[Tensor, "k d"], rows: Int[Tensor, " k"], receiver: int) -> None:
        """Divides the readings of a receiver, whose rows among all readings are given."""
        centres = torch.stack([places[part].mean(0) for part in halves(places, self.core)])
        near = nearest_places(centres, places, self.size).rows  # (t, j)
        self.centres = torch.cat((self.centres, centres))
        self.receivers = torch.cat((self.receivers, rows.new_full((len(centres),), receiver)))
        self.rows = torch.cat((self.rows, rows[near].int()))
        self.weights = torch.cat(
            (self.weights, torch.full_like(near, math.nan, dtype=torch.float64))
        )

    def numbers(self, places: Float[Tensor, "b d"], receiver: int) -> Int[Tensor, " b"]:
        """Tiles of some places of a receiver; none if it has no tiles."""
        own = (self.receivers == receiver).nonzero()[:, 0]
        return own[nearest_places(places, self.centres[own], 1).rows[:, 0]] if len(own) else own

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
        resize(self, state_dict, prefix, "centres", "receivers", "rows", "weights")
        # Checkpoints of before have no tiles.
        for name in ("centres", "receivers", "rows", "weights"):
            state_dict.setdefault(f"{prefix}{name}", getattr(self, name)[:0])
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
