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

from gaigs.core import stages
from gaigs.core.propagation import NEAREST, fit_gain
from gaigs.core.query import Batch, Query, drawn
from gaigs.core.scene import Scene, carriers, direct_gains, direct_waves
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.planes.box_search import BoxSearch, ChannelErrors, LevelErrors
from gaigs.planes.channel_search import ChannelSearch
from gaigs.planes.field_search import FieldSearch
from gaigs.planes.lag_search import LagSearch
from gaigs.planes.learnt_room import LearntRoom, build_room
from gaigs.planes.level_search import LevelSearch
from gaigs.planes.revision import Loss, move_planes, prune
from gaigs.planes.room_files import summarize, write_room
from gaigs.planes.room_paths import LearntPath, list_paths, spread_links, thin_links
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

    For channels and spectra, ``ChannelSearch``, ``FieldSearch`` or ``LagSearch`` locates the planes
    before the training. For signal strengths the training begins with powers, which show the
    obstacles; then ``LevelSearch`` locates planes by phases. If frequencies are unknown, powers of
    paths always add. For other labels planes start at the faces of the box. During the training
    each is turned square to the others, and moved along its normal to the least error.

    Parts are as for ``GaussianSplatting``, with the placement ``mirrored`` and suitable defaults.

    Args:
        search: Start of a training on spectra. True: planes from ``LagSearch``; False: the faces of
            the box; None: both, and validation chooses.
        boxes: Whether boxes are searched in levels of a known carrier. True: always, and single
            paths have no gains, which suits planned receivers best. False: never. None: only if the
            split holds out receivers.

    Source: ours; docs/methods.md.
    """

    name, own_placement = "mirrored", "mirrored"
    revisions = (0.0, 0.06, 0.25, 0.5, 0.75)

    # Largest box whose levels are searched for phases [wavelengths]. A phase needs places and walls
    # to a tenth of a wavelength; surveys know both to about a ten-thousandth of the site.
    widest = 1000.0
    is_wide = False  # True if the box is larger; set by fit

    places: Query | None = None  # set by fit
    levels: LevelSearch | None = None
    shadowed: Batch | None = None  # links in which boxes are searched; set by fit
    proof: Batch | None = None  # levels whose errors boxes must lower; set by fit

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
        search: bool | None = None,
        boxes: bool | None = None,
    ):
        self.search = search
        self.boxes = boxes
        parts = placement, tokenizer, deformation, projection, rasterizer, pooling
        super().__init__(scene, *parts, gaussians, trend)

    @staticmethod
    def own_pooling(scene: Scene) -> str:
        if scene.task.directions is not None:
            return "path_spectrum"
        return "path_csi" if scene.task.dtype.is_complex else "path_rssi"

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the pipeline, and searches planes; in levels ``revise`` does, with obstacles."""
        super().fit(links)
        self.places = thin_links(links.query[links.split.train])
        is_known = links.query.frequencies is not None or len(self.scene.frequencies) == 1
        searches = is_known and self.placement.order > 0 and not self.placement.fixed
        if searches and self.search is not False and isinstance(self.pooling, PathSpectrum):
            self._search_spectra(links, self.pooling)
        if is_known and isinstance(self.pooling, PathRssi):
            wavelength = speed_of_light / carriers(self.scene, links.query).max().item()
            self.is_wide = self.placement.diagonal > self.widest * wavelength
            # A search by phases needs 20 links of each receiver; places of one radio have fewer.
            if searches and not self.is_wide and not self.scene.one_radio:
                self._prepare_levels(links)
        # Boxes lower errors at new receivers, but not at known ones. Without a known carrier (such
        # as Bluetooth beacons), boxes fitted errors of single receivers.
        wants_boxes = links.split.by_receivers if self.boxes is None else self.boxes
        wants_boxes = wants_boxes and not self.scene.one_radio
        if is_known and wants_boxes and not self.is_wide and isinstance(self.pooling, PathRssi):
            self._prepare_boxes(links)
        if self.boxes and self.shadowed is not None:
            # Gains of single paths learn the shadows at the known receivers in place of boxes.
            self.placement.path_gains.requires_grad_(False)
        elif self.boxes and isinstance(self.pooling, PathRssi):
            log.warning(
                "boxes=true searches none: it takes validation links, a known carrier, three "
                "receivers or more, and a room rather than a site"
            )
        # Without phases powers add to the end, and no later revision locates a plane.
        has_phases = is_known and not self.is_wide and not self.scene.one_radio
        self.settles = isinstance(self.pooling, PathRssi) and not has_phases
        task = self.scene.task
        if task.is_channel and isinstance(self.pooling, ChannelPooling) and self.trend is None:
            self._fit_channels(links, task, self.pooling)

    def _search_spectra(self, links: Links, pooling: PathSpectrum) -> None:
        """Moves the planes to where ``LagSearch`` finds them, and keeps only paths at these planes.

        Nothing changes if no receiver's array explains its spectra.
        """
        # A spectrum gives back the covariances (lags) of the array's elements, whose phases the
        # search reads.
        placement = self.placement
        frequencies = carriers(self.scene, links.query)
        search = LagSearch(links, frequencies, pooling.beamformer.lags, placement.order)
        for doubt in search.doubts:
            log.warning("%s", doubt)
        if not search.receivers:
            return
        planes = search.run(self._start(), self.scene.bandwidth, len(placement.origin))
        for number, plane in enumerate(planes):
            placement.place(number, plane)
        placement.kept.copy_(placement.sequences_of(torch.arange(len(planes))))
        placement.most.copy_(placement.kept.sum())
        # Planes stand to fractions of a wavelength, so paths interfere from the first step on.
        placement.enable_phases(search.wavelength)
        if placement.log_bandwidth is not None and self.scene.bandwidth is None:
            placement.log_bandwidth.fill_(math.log(search.bandwidth))
        placement.found.fill_(True)
        log.info("%d planes found in spectra", len(planes))
        # A false plane of the search stays; learnt ones move as strengths become known.
        if self.search is None and placement.is_new:
            self.second_start = {"search": False}

    def _prepare_levels(self, links: Links) -> None:
        """Prepares ``LevelSearch``, for ``revise`` once obstacles are learnt from powers."""
        trend = 0 * links.labels
        if self.trend is not None:
            trend = self.trend(Batch(links.query).to(self.device)).value.cpu()
        self.levels = LevelSearch(
            links,
            carriers(self.scene, links.query),
            trend,
            self._start(),
            self.placement.used.tolist(),
            self.placement.order,
        )

    def _prepare_boxes(self, links: Links) -> None:
        """Draws links for the search of boxes in ``revise``, and links that test its boxes."""
        # With 1500 links a search takes a minute; with 600 it finds a third of the furniture.
        searched, tested = drawn(links.split.train, 1500), drawn(links.split.validation, 1500)
        # Only paths to three receivers or more show where along a path an obstacle stands.
        if len(links.query.receivers[searched].unique()) >= 3 and len(tested):
            self.shadowed = Batch(links.query[searched], labels=links.labels[searched])
            self.proof = Batch(links.query[tested], labels=links.labels[tested])

    def _fit_channels(self, links: Links, task: Task, pooling: ChannelPooling) -> None:
        """Starts the training from free space, and searches the planes for its first revision.

        ``ChannelSearch`` finds the planes. For channels with few values ``FieldSearch`` does, which
        needs a common phase. Without one, the faces of the box stay.
        """
        placement = self.placement
        received = links.labels
        links = replace(links, labels=self.scene.equalised(links.query, links.labels))
        train = links.split.train
        sign = int(pooling.sign)  # of the phase, 2 pi f delay; 0: unknown
        query = links.query[train]
        waves = direct_waves(self.scene, query, task.frequencies, sign)  # (b, e, s)
        waves = direct_gains(self.scene, query)[:, None, None] * waves
        walls = placement.used if placement.walls else placement.used[:0]  # of the user
        start = placement.planes[walls].cpu()  # read before free space has no planes
        gains = self._receiver_gains(links.labels[train], query, waves, pooling)
        placement.start_from_free_space(gains.conj() if sign > 0 else gains)
        placement.enable_phases(speed_of_light / self.scene.middles.max().item())
        if placement.fixed or not placement.order:  # no planes to search
            return
        has_phase = task.phase == "known" and sign != 0
        if placement.has_few_numbers:
            if has_phase:
                self._search_field(links, sign, start, pooling)
            return
        labels = links.labels.clone()
        # An unknown delay of a link shifts all its paths; the search must see them unshifted.
        labels[train] = task.align(labels[train], waves)
        planes, slabs = ChannelSearch(
            replace(links, labels=labels),
            int(pooling.array_sign),
            has_phase,
            placement.order,
            len(placement.origin),
            start,
        ).run()
        self._plan(planes, slabs)
        # Only three receivers or more show where along a path a box stands.
        if has_phase and self.scene.radios >= 3:
            rows = drawn(train, 1200)  # a search with 1200 links takes some seconds
            self.shadowed = Batch(links.query[rows], labels=received[rows])
        placement.step.mul_(0.1)  # the search is exact to millimetres

    def _search_field(
        self, links: Links, sign: int, start: Float[Tensor, "w 4"], pooling: ChannelPooling
    ) -> None:
        """Searches planes with ``FieldSearch``, and starts from the strengths that it fits."""
        placement = self.placement
        search = FieldSearch(links, sign, placement.order, len(placement.origin), start)
        room = search.run()
        planes = search.frame.to_world(room.planes)
        self._plan(planes, room.slabs, search.data.order)
        if placement.obstacles is not None and search.score.fit.count < search.fewest:
            placement.obstacles.requires_grad_(False)  # too few numbers to learn shadows
        if not len(planes):
            return
        # The search has waves exp(-j k L) / L over a path of length L. Those of the pooling are
        # ``strength`` lambda / (4 pi) times as large, so the gains are as much smaller.
        wavelengths = torch.tensor([receiver.wavelength for receiver in search.data.receivers])
        unit = pooling.strength.item() * wavelengths / (4 * math.pi)  # (r,)
        receiver_gains = room.receivers / unit
        if self.scene.one_radio:
            receiver_gains = receiver_gains.mean().expand_as(receiver_gains)
        receivers = torch.tensor(search.data.numbers)  # r indices of the scene's receivers
        plane_gains = room.gains.new_ones(len(placement.bands), len(planes))
        searched_bands = placement.band_numbers[receivers]
        plane_gains[searched_bands] = room.gains[search.score.fit.band_numbers]
        placement.start_strengths(plane_gains, self.scene.radio_of(receivers), receiver_gains)
        placement.step.mul_(0.1)  # the search is exact to fractions of a wavelength

    def _plan(self, planes: Tensor, slabs: Tensor, order: int | float = math.inf) -> None:
        """Places planes with their slabs, and plans paths of at most ``order`` reflections.

        The first revision begins to use these paths.
        """
        placement = self.placement
        for number, (plane, slab) in enumerate(zip(planes, slabs, strict=True)):
            placement.place(number, plane, slab)
        placement.planned.copy_(placement.sequences_of(torch.arange(len(planes))))
        placement.planned[(placement.sequences >= 0).sum(1) > order] = False
        placement.most.copy_(placement.planned.sum())
        placement.found.fill_(True)

    def _receiver_gains(
        self,
        labels: Complex[Tensor, "b e s"],
        query: Query,
        waves: Complex[Tensor, "b e s"],
        pooling: ChannelPooling,
    ) -> Complex[Tensor, " r"]:
        """Gain of each receiver, from its training links and the pooling's waves by ``fit_gain``.

        The gain is 0.1 where phases follow neither sign convention: a strong start with wrong
        phases would be worse than no signal.
        """
        fitted = []
        radios = self.scene.radio_of(query.receivers)
        for radio in range(self.scene.radios):
            rows = radios == radio
            fitted.append(fit_gain(labels[rows], waves[rows]))
        gains = torch.stack(fitted) / pooling.strength.cpu()
        return torch.where((gains != 0) & (int(pooling.sign) != 0), gains, 0.1)

    @property
    def predicts_untrained(self) -> bool:  # type: ignore[override]
        return super().predicts_untrained or bool(self.placement.is_bare)

    def revise(self, number: int, train: Batch, validation: Batch | None, loss: Loss) -> str:
        """Places boxes, lets paths interfere, moves planes to where phases agree, drops paths.

        Planes that a search has found do not move.
        """
        about_boxes = ""
        # The search of boxes needs strengths of the planes, which powers have taught by now.
        if number == 2 and isinstance(self.pooling, PathRssi):
            about_boxes = self._place_boxes()
        return self._revise_planes(number, train, validation, loss) + about_boxes

    def _revise_planes(
        self, number: int, train: Batch, validation: Batch | None, loss: Loss
    ) -> str:
        """The changes of ``revise`` to planes and paths, without the search of boxes in levels."""
        placement = self.placement
        # Channels are sums of waves, so their phases count from the start.
        adds_waves = not isinstance(self.pooling, LagPooling)
        if placement.is_bare:
            placement.enable_reflections()
        # The last revision drops weak paths. If a search has found the planes, the second does so,
        # too: each path costs time in every step.
        if number == len(self.revisions) - 1 or (number == 1 and placement.found):
            batches = [train] if validation is None else [train, validation]
            about_paths = prune(placement, batches, loss)
            is_time_for_boxes = placement.is_complex and number == 1
            return about_paths + (self._place_boxes() if is_time_for_boxes else "")
        if number < 2 and not adds_waves:
            return "planes stay where they are"
        if self.is_wide or (self.scene.one_radio and not adds_waves):
            reason = "the box is too wide" if self.is_wide else "places have too few links"
            return f"{reason} for phases, so powers add to the end"
        try:
            wavelength = speed_of_light / carriers(self.scene, train.query).mean().item()
        except ValueError:
            return "frequencies are unknown, so powers add to the end"
        if not placement.coherent:
            placement.enable_phases(wavelength)
            if self.levels is not None:
                placement.locate()
        if self.levels is not None:
            count = len(self.levels.locate(placement))
            return f"{count} planes located by phases, {int(placement.located.sum())} in all"
        if placement.fixed or placement.found:
            return "phases count"
        before = loss(train)
        # Powers locate distant planes to some decimetres, so the first search has a wider range.
        is_first = number == (0 if adds_waves else 2)
        least_range = 0.03 * placement.diagonal if is_first else 0.0  # [m]
        offsets = move_planes(self, train, wavelength, least_range)
        moves = ", ".join(f"{offset:+.3f}" for offset in offsets)
        return f"phases count; planes moved by {moves} m; loss {before:.4f} -> {loss(train):.4f}"

    def _place_boxes(self) -> str:
        """Replaces learnt obstacles by boxes, if boxes explain the shadows at all receivers.

        Returns a clause for the log, empty if boxes are not searched.
        """
        obstacles = self.placement.obstacles
        if self.shadowed is None or obstacles is None:
            return ""
        search = self._box_search(self.shadowed)
        boxes = search.run()
        if stages.is_up():
            return "; no time for boxes"
        # Boxes may fit errors of single receivers: held-out receivers must gain, too.
        if boxes and self.proof is not None and self._box_search(self.proof).gain(boxes) <= 0:
            return f"; {len(boxes)} boxes found, which held-out receivers do not confirm"
        if boxes:
            depths = search.places.new_tensor([box.loss for box in boxes])
            corners = torch.stack([box.corners for box in boxes])
            obstacles.place_boxes(self.placement.room_axes, corners, depths)
        return f"; {len(boxes)} boxes found"

    def _box_search(self, batch: Batch) -> BoxSearch:
        """The search for boxes in some links, along the axes of the room."""
        query = batch.query.to(self.device)
        errors_of = self._shadow_errors(query, batch.labels.to(self.device))
        axes = self.placement.room_axes  # (3, 3), a column for each axis of the room
        folded = self.placement.folded(query)
        paths = folded.paths._replace(start=folded.paths.start @ axes, end=folded.paths.end @ axes)
        transmitters = folded.seen[0][:, 0]  # starts of the direct paths (b, 3)
        ends = torch.cat((transmitters, folded.receivers)).unique(dim=0) @ axes
        return BoxSearch(paths, errors_of, ends)

    def _shadow_errors(self, query: Query, labels: Tensor) -> ChannelErrors | LevelErrors:
        """The function from losses of paths in obstacles to errors of links, for ``BoxSearch``."""
        placement = self.placement
        if not placement.is_complex:
            links = placement.folded(query)
            amplitudes = placement.strengths(query, links.paths, blocked=False).abs()  # (b, n)
            amplitudes = amplitudes * placement.patterns(query, links.ways)
            lengths = links.ways.norm(dim=-1).clamp_min(NEAREST)  # (b, n) [m]
            powers = (amplitudes / lengths).square()
            if self.trend is not None:
                labels = labels - self.trend(Batch(query)).value
            return LevelErrors(powers, labels, query.receivers)
        products, matches = [], []
        rows = torch.arange(len(query), device=self.device)
        # One link at a time: channels of all its paths take much memory.
        for row, channel in zip(rows.split(1), labels.split(1), strict=True):
            link = query[row]
            folded = placement.folded(link)
            strengths = placement.strengths(link, folded.paths, blocked=False)
            fields = self._separate(link, strengths * placement.patterns(link, folded.ways))
            errors = ChannelErrors.of(fields, channel.to(fields))
            products.append(errors.products)
            matches.append(errors.matches)
        return ChannelErrors(torch.cat(products), torch.cat(matches))

    def _start(self) -> Float[Tensor, "w 4"]:
        """Planes (normal and offset [m]) from which a search starts, in the world's frame.

        They are the user's walls, or learnt planes, or the faces of the box.
        """
        placement = self.placement
        used = placement.used
        if placement.walls or not placement.is_new:
            return placement.planes[used].cpu()
        # Normals of new planes have a small random tilt; rounded in the box's frame they are axes.
        normals = (placement.normals[used] @ placement.turn).round() @ placement.turn.mT
        faces = torch.cat((normals, placement.offsets[used, None]), 1)  # from the box's middle
        return seen_from(faces.double(), -placement.middle).cpu()

    @property
    def has_margins(self) -> bool:
        """True if channels are sums of mirrored paths alone, so that ``margins`` is defined."""
        alone = self.trend is None and self.gaussians is None
        return alone and self.takes_paths and isinstance(self.pooling, ChannelPooling)

    @torch.no_grad()
    def margins(self, query: Query) -> Complex[Tensor, "b n e s"]:
        """Prior standard deviation of the channel of each path, for kriging.

        All links are to one receiver. The paths have the strengths of ``PathFields.margins``.
        """
        return self._separate(query, self.placement.margins(query))

    def _separate(self, query: Query, strengths: Complex[Tensor, "b n"]) -> Tensor:
        """Channel of each path alone (b, n, e, s), if the paths have ``strengths``.

        All links are to one receiver.
        """
        with self.placement.holding():
            self.placement.held = strengths
            which = torch.arange(len(query), device=query.transmitters.device)
            paths = self.paths(self.excite(query), which, int(query.receivers[0]), query)
        count, n = paths.amplitudes.shape

        def separate(values: Tensor) -> Tensor:
            """Reshapes values of paths (b, n, ...) to links of one path each (b n, 1, ...)."""
            return values.expand(count, *values.shape[1:]).flatten(0, 1)[:, None]

        single_paths = replace(
            paths,
            means=separate(paths.means),
            semi_axes=separate(paths.semi_axes),
            amplitudes=separate(paths.amplitudes),
            lengths=separate(paths.lengths),
            coherences=paths.coherences[:1],
            carriers=paths.carriers.repeat_interleave(n),
        )
        links = query[which.repeat_interleave(n)]
        return self.pooling(single_paths, links).unflatten(0, (count, n))

    def facts(self) -> dict[str, object]:
        """Facts of the pipeline, numbers of planes and paths, and tables by ``summarize``."""
        placement = self.placement
        path_count = int(placement.kept.sum())
        free_count = 0 if self.gaussians is None else len(self.gaussians)
        facts = super().facts() | {
            "num_gaussians": path_count + free_count,
            "num_gaussians_start": int(placement.most),
            "planes_kept": len(placement.used),
            "paths_kept": path_count,
            "paths_most": int(placement.most),
        }
        return facts if self.places is None else facts | summarize(placement, self.places)

    def export(self, folder: Path) -> None:
        """Writes ``planes.obj`` and ``obstacles.ply`` beside the trainable Gaussians.

        Planes are drawn as far as paths of the links ``traced`` meet them.
        """
        super().export(folder)
        write_room(self.placement, self.traced, folder)

    @property
    def traced(self) -> Query:
        """Links whose paths outline planes: training links, or spread ones in a loaded model."""
        return spread_links(self.scene) if self.places is None else self.places

    def learnt_room(self, links: Links | None = None) -> LearntRoom:
        """The learnt room: planes, obstacles and paths."""
        return build_room(self.placement, links)

    def learnt_paths(self, query: Query) -> list[LearntPath]:
        """The strongest paths of some links, folded through the room."""
        return list_paths(self.placement, query)
