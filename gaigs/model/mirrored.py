"""Mirrored Gaussians: our own predictor, which learns the walls of the room."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from scipy.constants import speed_of_light
from torch import Tensor, nn

from gaigs.data import Links
from gaigs.deformation import Deformation
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.placement import Placement
from gaigs.placement.mirrored import export
from gaigs.placement.mirrored.search import fewer, find_planes
from gaigs.pooling import Pooling
from gaigs.pooling.element_sum import ElementSum
from gaigs.projection import Projection
from gaigs.propagation import carriers, direct_gains, direct_waves, fit_gain
from gaigs.query import Batch, Query
from gaigs.rasterizer import Rasterizer
from gaigs.registry import register
from gaigs.report.shapes import LearntRoom
from gaigs.scene import Scene

REACH, ROOM = 4.0, 0.03
"""How far a plane is looked for on either side of where it is: in wavelengths, and the first time at least in diagonals
of the room, since powers tell distant planes to some decimetres."""

FINDS = 2
"""Revisions that look for planes; phases count from the next one on."""

TOLERANCE = 1e-3
"""By how much more of the loss a part may be dropped: a tenth of what a plane must bring to be taken in."""

BANDWIDTHS = (0.01, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Tried where the data say none, times the speed of light over the room's diagonal: from a carrier, where all paths
interfere, to a band in which hardly two do."""

QUIET = 0.1
"""Amplitude of the start over the channels' where free space has no gain: louder it would be worse than nothing."""

STEPS = 10
"""Steps of that search a wavelength: a reflected path changes by twice of it."""


@register("model", "mirrored")
class Mirrored(GaussianSplatting):
    """The splatting pipeline with Gaussians at mirror images, learnt from coarse to fine.

    Powers alone are looked at first: they tell planes to some centimetres. Then phases count too: each plane is moved
    along its normal to where the loss is least, by steps of a fraction of the wavelength, and descent goes on.

    Args:
        As for ``GaussianSplatting``, with a placement ``mirrored``; each part is by default what suits it.

    Source: ours; docs/methods.md.
    """

    name, own_placement = "mirrored", "mirrored"
    revisions = (0.0, 0.06, 0.25, 0.5, 0.75)

    places: Query | None = None  # set by fit

    def __init__(
        self,
        scene: Scene,
        placement: str | Mapping | Placement = "mirrored",
        tokenizer: str | Mapping | nn.Module = "multiview",
        deformation: str | Mapping | Deformation = "none",
        projection: str | Mapping | Projection = "direction_cosine",
        rasterizer: str | Mapping | Rasterizer = "aperture",
        pooling: str | Mapping | Pooling | None = None,
        gaussians: Mapping | None = None,
        trend: str | Mapping | Model | None = None,
    ):
        super().__init__(scene, placement, tokenizer, deformation, projection, rasterizer, pooling, gaussians, trend)

    @staticmethod
    def own_pooling(scene: Scene) -> str | dict:
        if scene.task.directions is not None:
            return "array_response"
        return "element_sum" if scene.task.dtype.is_complex else {"name": "mean_power", "floor_db": -120.0}

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """As the pipeline's; and keeps some places, at which the paths' powers are reported.

        Channels without a trend start from free space with each receiver's gain over its training links, as ``friis``
        has it. Where phases say nothing, they start ``QUIET``.
        """
        super().fit(links)
        self.places = export.some(links.query[links.split.train])
        if not isinstance(self.pooling, ElementSum) or self.trend is not None:
            return
        train, sign, frequencies = links.split.train, int(self.pooling.sign), self.scene.task.frequencies
        labels, query = links.labels[train], links.query[train]
        waves = direct_gains(self.scene, query)[:, None, None] * direct_waves(self.scene, query, frequencies, sign)
        own = [query.receivers == receiver for receiver in range(len(self.scene.receivers))]
        gains = torch.stack([fit_gain(labels[some], waves[some]) for some in own]) / self.pooling.strength
        gains = torch.where((gains != 0) & (sign != 0), gains, QUIET)
        self.placement.strip(gains.conj() if sign > 0 else gains)
        self.placement.sharpen(speed_of_light / self.scene.task.frequencies.mean().item())

    @property
    def predicts_untrained(self) -> bool:
        return super().predicts_untrained or bool(self.placement.is_bare)

    def revise(self, number: int, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]) -> str:
        """Looks for more planes; has phases count; searches planes by them; drops what does not help."""
        if self.placement.is_bare:
            self.placement.furnish()
        if number < FINDS and self.placement.fixed:
            return "planes stay where they were put"
        if number < FINDS and not self._adds_waves:
            told = find_planes(self, train, validation, loss)
            self.placement.most.fill_(self.placement.kept.sum())
            return told
        if number == len(self.revisions) - 1:
            return self._prune([batch for batch in (train, validation) if batch is not None], loss)
        placement = self.placement
        try:
            wavelength = speed_of_light / carriers(self.scene, train.query).mean().item()
        except ValueError:
            return "frequencies are unknown, so powers add to the end"
        if not placement.coherent:
            placement.sharpen(wavelength)
            if self.scene.bandwidth is None and placement.log_bandwidth is not None:
                self._choose_bandwidth(wavelength, fewer(train), loss)
        if placement.fixed:
            return "phases count"
        before, some = loss(train), fewer(train)
        reach = REACH * wavelength
        if number == (0 if self._adds_waves else FINDS):
            reach = max(reach, ROOM * placement.diagonal)
        moved = [self._search(plane, reach, wavelength / STEPS, some, loss) for plane in self._by_strength(train)]
        told = ", ".join(f"{move:+.3f}" for move in moved)
        return f"phases count; planes moved by {told} m; loss {before:.4f} -> {loss(train):.4f}"

    @property
    def _adds_waves(self) -> bool:
        """Whether labels take the sum of waves, so that powers alone tell nothing and phases count from the start."""
        return self.draws_map or self.pooling.takes == "fields"

    # --- what a run reports of it ---

    def facts(self) -> dict[str, object]:
        """Beside the rasterizer: how many planes and paths there are and were, and what each plane does."""
        placement = self.placement
        facts = super().facts() | {
            "num_gaussians": int(placement.kept.sum()) + (0 if self.gaussians is None else len(self.gaussians)),
            "num_gaussians_start": int(placement.most),
            "planes_kept": len(placement.used),
            "paths_kept": int(placement.kept.sum()),
            "paths_most": int(placement.most),
        }
        return facts if self.places is None else facts | export.facts(placement, self.places)

    def export(self, folder: Path) -> None:
        """``planes.obj`` and ``obstacles.ply`` beside the free Gaussians.

        Planes end where the training links' paths meet them; of a model that was loaded, those of places all over the
        training transmitters' box.
        """
        super().export(folder)
        places = export.all_over(self.scene) if self.places is None else self.places
        export.export(self.placement, places, folder)

    def learnt_room(self, links: Links) -> LearntRoom:
        """Planes, obstacles and paths for figures."""
        return export.learnt_room(self.placement, links)

    # --- which planes ---

    def _prune(self, batches: list[Batch], loss: Callable[[Batch], float]) -> str:
        """Drops planes, then paths, weakest first, without which the loss is next to no higher on any batch."""
        placement = self.placement
        planes, paths = len(placement.used), int(placement.kept.sum())
        before = [loss(batch) for batch in batches]

        def is_good(kept: Bool[Tensor, "n"]) -> bool:
            placement.kept.copy_(kept)
            return all(loss(batch) <= old * (1 + TOLERANCE) for batch, old in zip(batches, before, strict=True))

        best = placement.kept.clone()
        for plane in reversed(self._by_strength(batches[0])):
            without = best & ~(placement.words == plane).any(1)
            best = without if is_good(without) else best
        placement.kept.copy_(best)
        weakest = best.nonzero()[:, 0][self._shares(batches[0]).argsort()]
        low, high = 0, len(weakest) - 1
        while low < high:  # the largest number of them that may go, by bisection
            middle = (low + high + 1) // 2
            without = best.index_fill(0, weakest[:middle], False)
            low, high = (middle, high) if is_good(without) else (low, middle - 1)
        placement.kept.copy_(best.index_fill(0, weakest[:low], False))
        return (
            f"{planes - len(placement.used)} of {planes} planes and {paths - int(placement.kept.sum())} of {paths} "
            f"paths dropped; loss {before[0]:.4f} -> {loss(batches[0]):.4f}"
        )

    # --- where planes are ---

    def _choose_bandwidth(self, wavelength: float, batch: Batch, loss: Callable[[Batch], float]) -> None:
        """Takes the bandwidth with which moving the two strongest planes lowers the loss most.

        Without a bandwidth no plane is right, and without planes no bandwidth is: so both are tried together.
        """
        placement = self.placement
        used = self._by_strength(batch)
        origin, losses = placement.origin.clone(), {}
        for rooms in BANDWIDTHS:
            placement.log_bandwidth.fill_(math.log(rooms * speed_of_light / placement.diagonal))
            for plane in used[:2]:
                self._search(plane, REACH * wavelength, wavelength / STEPS, batch, loss)
            losses[rooms] = loss(batch)
            placement.origin.copy_(origin)
        best = min(losses, key=losses.__getitem__)
        placement.log_bandwidth.fill_(math.log(best * speed_of_light / placement.diagonal))

    def _by_strength(self, batch: Batch) -> list[int]:
        """The planes in use, that by way of which most power comes first: the others' phases count against it."""
        placement, shares = self.placement, self._shares(batch)
        words = placement.words[placement.kept]
        return sorted(placement.used.tolist(), key=lambda plane: -shares[(words == plane).any(1)].sum().item())

    def _shares(self, batch: Batch) -> Float[Tensor, "n"]:
        """Of the power that arrives, by the kept paths' order; a link that hears nothing has none."""
        query, _ = batch.query.unique(with_receivers=True)
        powers = self.placement(None, query).gains.abs().square()
        total = powers.sum(1, keepdim=True)
        return (powers / torch.where(total > 0, total, 1)).mean(0)

    def _search(self, plane: int, reach: float, step: float, batch: Batch, loss: Callable[[Batch], float]) -> float:
        """Moves a plane along its normal to where the loss is least; by how much [m]."""
        origin = self.placement.origin[plane]
        start = origin[3].item()
        count = round(reach / step)
        moves = [step * k for k in range(-count, count + 1)]
        losses = []
        with self.placement.holding():
            loss(batch)
            for move in moves:
                origin[3] = start + move
                losses.append(loss(batch))
        best = moves[min(range(len(moves)), key=losses.__getitem__)]
        origin[3] = start + best
        return best
