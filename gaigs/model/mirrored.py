"""Mirrored Gaussians: our own predictor, which learns the walls of the room."""

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor, nn

from gaigs.core.propagation import fit_gain
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene, carriers, direct_gains, direct_waves
from gaigs.data import Links
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.planes import export
from gaigs.planes.channel_search import FEWEST, ChannelSearch
from gaigs.planes.lag_search import LagSearch
from gaigs.planes.learnt_room import LearntPath, LearntRoom
from gaigs.planes.level_search import LevelSearch
from gaigs.planes.search import Loss, move_planes, prune
from gaigs.registry import register
from gaigs.splatting.deformation import Deformation
from gaigs.splatting.placement import Placement
from gaigs.splatting.placement.mirrored.reflections import seen_from
from gaigs.splatting.pooling import Pooling
from gaigs.splatting.pooling.channels import ChannelPooling
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.splatting.pooling.path_spectrum import PathSpectrum
from gaigs.splatting.pooling.paths import LagPooling
from gaigs.splatting.projection import Projection
from gaigs.splatting.rasterizer import Rasterizer

log = logging.getLogger(__name__)


@register("model", "mirrored")
class MirroredSplatting(GaussianSplatting):
    """The splatting pipeline with Gaussians at mirror images, learnt from coarse to fine.

    ``ChannelSearch`` locates planes of channels before the training, ``LagSearch`` those of
    spectra. Of signal strength powers come first, which teach obstacles; then ``LevelSearch``
    locates planes by phases. Where frequencies are unknown, powers add to the end. Labels that none
    of them can read start from the faces of the box; each plane is then turned square to the others
    and moved along its normal to the least error.

    Parts are as for ``GaussianSplatting``, with a placement ``mirrored``; each defaults to one that
    suits it.

    Source: ours; docs/methods.md.
    """

    name, own_placement = "mirrored", "mirrored"
    revisions = (0.0, 0.06, 0.25, 0.5, 0.75)

    places: Query | None = None  # set by fit
    levels: LevelSearch | None = None

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
        super().__init__(
            scene,
            placement,
            tokenizer,
            deformation,
            projection,
            rasterizer,
            pooling,
            gaussians,
            trend,
        )

    @staticmethod
    def own_pooling(scene: Scene) -> str:
        if scene.task.directions is not None:
            return "path_spectrum"
        return "path_csi" if scene.task.dtype.is_complex else "path_rssi"

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the pipeline, and keeps some links for the report of the paths' powers.

        Spectra start from planes that ``LagSearch`` finds in them, channels without a trend from
        those of ``ChannelSearch``; channels of fewer than ``FEWEST`` numbers from free space, and
        then the faces of the box. Each receiver's gain is that over its training links, as of
        ``friis``, or 0.1 where phases say nothing: a louder start would be worse than nothing.
        """
        super().fit(links)
        self.places = export.some(links.query[links.split.train])
        task = self.scene.task
        is_known = links.query.frequencies is not None or len(self.scene.frequencies) == 1
        searches = is_known and self.placement.order > 0 and not self.placement.fixed
        if searches and isinstance(self.pooling, PathSpectrum):
            search = LagSearch(
                links,
                carriers(self.scene, links.query),
                self.pooling.beamformer.lags,
                self.placement.order,
            )
            for doubt in search.doubts:
                log.warning("%s", doubt)
            if search.receivers:
                self._find_planes(search)
        if searches and isinstance(self.pooling, PathRssi):
            batch = Batch(links.query).to(self.device)
            trend = 0 * links.labels if self.trend is None else self.trend(batch).value.cpu()
            own = trend, self._start(), self.placement.used.tolist(), self.placement.order
            self.levels = LevelSearch(links, carriers(self.scene, links.query), *own)
        if (
            not (task.is_channel and isinstance(self.pooling, ChannelPooling))
            or self.trend is not None
        ):
            return
        train, sign, frequencies = links.split.train, int(self.pooling.sign), task.frequencies
        labels, query = links.labels[train], links.query[train]
        waves = direct_gains(self.scene, query)[:, None, None] * direct_waves(
            self.scene, query, frequencies, sign
        )
        own = [query.receivers == receiver for receiver in range(len(self.scene.receivers))]
        gains = (
            torch.stack([fit_gain(labels[some], waves[some]) for some in own])
            / self.pooling.strength.cpu()
        )
        gains = torch.where((gains != 0) & (sign != 0), gains, 0.1)
        placement = self.placement
        start = placement.planes[placement.used if placement.walls else placement.used[:0]].cpu()
        placement.start_from_free_space(gains.conj() if sign > 0 else gains)
        placement.enable_phases(speed_of_light / frequencies.mean().item())
        if placement.fixed or not placement.order or labels[0].numel() < FEWEST:
            return
        common = task.phase == "known" and sign != 0
        options = int(self.pooling.array_sign), common, placement.order, len(placement.origin)
        aligned = links.labels.clone()
        aligned[train] = task.align(labels, waves)  # takes off delays that are not those of paths
        planes, slabs = ChannelSearch(replace(links, labels=aligned), *options, start).run()
        for number, (plane, slab) in enumerate(zip(planes, slabs, strict=True)):
            placement.place(number, plane, slab)
        placement.planned.copy_(placement.sequences_of(torch.arange(len(planes))))
        placement.most.copy_(placement.planned.sum())
        placement.step.mul_(0.1)  # the search is exact to millimetres
        placement.found.fill_(True)

    @property
    def predicts_untrained(self) -> bool:  # type: ignore[override]
        return super().predicts_untrained or bool(self.placement.is_bare)

    def revise(self, number: int, train: Batch, validation: Batch | None, loss: Loss) -> str:
        """Lets phases count, and locates planes by them, unless a search has found them; drops what
        does not help.
        """
        placement = self.placement
        # The labels are sums of waves: powers say nothing alone, and phases count from the start.
        adds_waves = not isinstance(self.pooling, LagPooling)
        if placement.is_bare:
            placement.enable_reflections()
        # Of planes that a search has found early, too: each path costs time in every step.
        if number == len(self.revisions) - 1 or (number == 1 and placement.found):
            return prune(
                placement, [batch for batch in (train, validation) if batch is not None], loss
            )
        if number < 2 and not adds_waves:
            return "planes stay where they are"
        try:
            wavelength = speed_of_light / carriers(self.scene, train.query).mean().item()
        except ValueError:
            return "frequencies are unknown, so powers add to the end"
        if not placement.coherent:
            placement.enable_phases(wavelength)
            if self.levels is not None:
                placement.locate()
        if self.levels is not None:
            return f"{len(self.levels.locate(placement))} planes located by phases, {int(placement.located.sum())} in all"
        if placement.fixed or placement.found:
            return "phases count"
        before = loss(train)
        # Powers locate distant planes to some decimetres: the first search reaches farther.
        least = 0.03 * placement.diagonal if number == (0 if adds_waves else 2) else 0.0
        moves = ", ".join(f"{move:+.3f}" for move in move_planes(self, train, wavelength, least))
        return f"phases count; planes moved by {moves} m; loss {before:.4f} -> {loss(train):.4f}"

    def _start(self) -> Float[Tensor, "w 4"]:
        """The user's walls or planes that are learnt, or the faces of the box without their tilt."""
        placement, used = self.placement, self.placement.used
        if placement.walls or not placement.is_new:
            return placement.planes[used].cpu()
        normals = (placement.normals[used] @ placement.turn).round() @ placement.turn.mT
        straight = torch.cat((normals, placement.offsets[used, None]), 1)
        return seen_from(straight.double(), -placement.middle).cpu()

    def _find_planes(self, search: LagSearch) -> None:
        """Puts planes where ``LagSearch`` finds them."""
        placement = self.placement
        planes = search.run(self._start(), self.scene.bandwidth, len(placement.origin))
        for number, plane in enumerate(planes):
            placement.place(number, plane)
        placement.kept.copy_(placement.sequences_of(torch.arange(len(planes))))
        placement.most.copy_(placement.kept.sum())
        placement.enable_phases(search.wavelength)
        if placement.log_bandwidth is not None and self.scene.bandwidth is None:
            placement.log_bandwidth.fill_(math.log(search.bandwidth))
        placement.found.fill_(True)
        log.info("%d planes found in spectra", len(planes))

    @property
    def has_margins(self) -> bool:
        """True for ``margins``: channels are sums of mirrored paths alone."""
        alone = self.trend is None and self.gaussians is None
        return alone and self.takes_paths and isinstance(self.pooling, ChannelPooling)

    @torch.no_grad()
    def margins(self, query: Query) -> Complex[Tensor, "b n e s"]:
        """Channels by which each path of links to one receiver may deviate, for kriging; see
        ``Mirrored.margins``.
        """
        with self.placement.holding():
            self.placement.held = self.placement.margins(query)
            which = torch.arange(len(query), device=query.transmitters.device)
            paths = self.paths(self.excite(query), which, int(query.receivers[0]), query)
        count, n = paths.amplitudes.shape
        apart = lambda values: values.expand(count, *values.shape[1:]).flatten(0, 1)[:, None]
        each = replace(
            paths,
            means=apart(paths.means),
            semi_axes=apart(paths.semi_axes),
            amplitudes=apart(paths.amplitudes),
            lengths=apart(paths.lengths),
            coherences=paths.coherences[:1],
            carriers=paths.carriers.repeat_interleave(n),
        )
        return self.pooling(each, query[which.repeat_interleave(n)]).unflatten(0, (count, n))

    def facts(self) -> dict[str, object]:
        """Numbers of planes and paths, and the part of each plane, beside the rasterizer."""
        placement = self.placement
        facts = super().facts() | {
            "num_gaussians": int(placement.kept.sum())
            + (0 if self.gaussians is None else len(self.gaussians)),
            "num_gaussians_start": int(placement.most),
            "planes_kept": len(placement.used),
            "paths_kept": int(placement.kept.sum()),
            "paths_most": int(placement.most),
        }
        return facts if self.places is None else facts | export.facts(placement, self.places)

    def export(self, folder: Path) -> None:
        """Writes ``planes.obj`` and ``obstacles.ply`` beside the free Gaussians.

        Planes end where the paths of the training links meet them; of a loaded model, the paths of
        links all over the training transmitters' box.
        """
        super().export(folder)
        export.export(self.placement, self.traced, folder)

    @property
    def traced(self) -> Query:
        """Links whose paths show where planes end."""
        return export.all_over(self.scene) if self.places is None else self.places

    def learnt_room(self, links: Links | None = None) -> LearntRoom:
        """Planes, obstacles and paths for figures."""
        return export.learnt_room(self.placement, links)

    def learnt_paths(self, query: Query) -> list[LearntPath]:
        """The strongest paths of some links, folded through the room."""
        return export.learnt_paths(self.placement, query)
