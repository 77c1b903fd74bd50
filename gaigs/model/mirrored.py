"""Mirrored Gaussians: our own predictor, which learns the walls of the room."""

from collections.abc import Mapping
from pathlib import Path

import torch
from scipy.constants import speed_of_light
from torch import nn

from gaigs.data import Links
from gaigs.deformation import Deformation
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.placement import Placement
from gaigs.placement.learnt_room import LearntRoom
from gaigs.placement.mirrored import export
from gaigs.placement.mirrored.search import Loss, choose_bandwidth, find_planes, move_planes, prune, thinned
from gaigs.pooling import Pooling
from gaigs.pooling.channels import ChannelPooling
from gaigs.pooling.paths import LagPooling
from gaigs.projection import Projection
from gaigs.propagation import fit_gain
from gaigs.query import Batch, Query
from gaigs.rasterizer import Rasterizer
from gaigs.registry import register
from gaigs.scene import Scene, carriers, direct_gains, direct_waves
from gaigs.task.csi import Csi


@register("model", "mirrored")
class MirroredSplatting(GaussianSplatting):
    """The splatting pipeline with Gaussians at mirror images, learnt from coarse to fine.

    Powers come first: they locate planes to some centimetres. Then phases count too: each plane moves along its normal
    to the least loss, by steps of a fraction of the wavelength, and descent goes on.

    Parts are as for ``GaussianSplatting``, with a placement ``mirrored``; each defaults to one that suits it.

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
        projection: str | Mapping | Projection | None = None,
        rasterizer: str | Mapping | Rasterizer | None = None,
        pooling: str | Mapping | Pooling | None = None,
        gaussians: Mapping | None = None,
        trend: str | Mapping | Model | None = None,
    ):
        super().__init__(scene, placement, tokenizer, deformation, projection, rasterizer, pooling, gaussians, trend)

    @staticmethod
    def own_pooling(scene: Scene) -> str:
        if scene.task.directions is not None:
            return "path_spectrum"
        return "path_csi" if scene.task.dtype.is_complex else "path_rssi"

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the pipeline, and keeps some links for the report of the paths' powers.

        Channels without a trend start from free space with each receiver's gain over its training links, as of
        ``friis``, or 0.1 where phases say nothing: a louder start would be worse than nothing.
        """
        super().fit(links)
        self.places = export.some(links.query[links.split.train])
        task = self.scene.task
        if not (isinstance(task, Csi) and isinstance(self.pooling, ChannelPooling)) or self.trend is not None:
            return
        train, sign, frequencies = links.split.train, int(self.pooling.sign), task.frequencies
        labels, query = links.labels[train], links.query[train]
        waves = direct_gains(self.scene, query)[:, None, None] * direct_waves(self.scene, query, frequencies, sign)
        own = [query.receivers == receiver for receiver in range(len(self.scene.receivers))]
        gains = torch.stack([fit_gain(labels[some], waves[some]) for some in own]) / self.pooling.strength
        gains = torch.where((gains != 0) & (sign != 0), gains, 0.1)
        self.placement.start_from_free_space(gains.conj() if sign > 0 else gains)
        self.placement.enable_phases(speed_of_light / frequencies.mean().item())

    @property
    def predicts_untrained(self) -> bool:  # type: ignore[override]
        return super().predicts_untrained or bool(self.placement.is_bare)

    def revise(self, number: int, train: Batch, validation: Batch | None, loss: Loss) -> str:
        """Adds planes twice, then moves them by their phases; drops what does not help at the end."""
        placement = self.placement
        # The labels are sums of waves: powers say nothing alone, and phases count from the start.
        adds_waves = not isinstance(self.pooling, LagPooling)
        if placement.is_bare:
            placement.enable_reflections()
        if number < 2 and placement.fixed:
            return "planes stay where they were put"
        if number < 2 and not adds_waves:
            found = find_planes(self, train, validation, loss)
            placement.most.fill_(placement.kept.sum())
            return found
        if number == len(self.revisions) - 1:
            return prune(placement, [batch for batch in (train, validation) if batch is not None], loss)
        try:
            wavelength = speed_of_light / carriers(self.scene, train.query).mean().item()
        except ValueError:
            return "frequencies are unknown, so powers add to the end"
        if not placement.coherent:
            placement.enable_phases(wavelength)
            if self.scene.bandwidth is None and placement.log_bandwidth is not None:
                choose_bandwidth(placement, wavelength, thinned(train), loss)
        if placement.fixed:
            return "phases count"
        before = loss(train)
        # Powers locate distant planes to some decimetres: the first search reaches farther.
        least = 0.03 * placement.diagonal if number == (0 if adds_waves else 2) else 0.0
        moves = ", ".join(f"{move:+.3f}" for move in move_planes(placement, train, wavelength, least, loss))
        return f"phases count; planes moved by {moves} m; loss {before:.4f} -> {loss(train):.4f}"

    def facts(self) -> dict[str, object]:
        """Numbers of planes and paths, and the part of each plane, beside the rasterizer."""
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
        """Writes ``planes.obj`` and ``obstacles.ply`` beside the free Gaussians.

        Planes end where the paths of the training links meet them; of a loaded model, the paths of links all over the
        training transmitters' box.
        """
        super().export(folder)
        places = export.all_over(self.scene) if self.places is None else self.places
        export.export(self.placement, places, folder)

    def learnt_room(self, links: Links) -> LearntRoom:
        """Planes, obstacles and paths for figures."""
        return export.learnt_room(self.placement, links)
