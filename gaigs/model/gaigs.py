"""The splatting pipeline: GAI-GS, its ablations and its neighbours, put together from registered parts."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.data import Links
from gaigs.deformation import Deformation, Residuals
from gaigs.directions import Directions
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.geometry import magnitudes, semi_axes, spherical_harmonics
from gaigs.model import Model, Prediction, build_trend
from gaigs.placement import Placed, Placement
from gaigs.pooling import Pooling
from gaigs.projection import Projection, Splats
from gaigs.propagation import carriers
from gaigs.query import Batch, Query
from gaigs.rasterizer import Rasterizer
from gaigs.registry import call, is_built, name_of, register, registry
from gaigs.scene import Scene

BESIDE = 0.05
"""Nearer to a Gaussian's centre than this a transmitter sees it in less and less of a direction [m]."""


@register("model", "gaigs")
class GaussianSplatting(Model):
    """Placement -> tokens -> residuals -> Gaussians as the query excites them -> splats -> map -> value.

    Args:
        scene: Receivers and task.
        placement, tokenizer, deformation, projection, rasterizer, pooling: Registered components: each the name, the
            configuration (a mapping with ``name`` and options), or the object itself. Pooling None is the label's own.
        gaussians: Options of ``gaigs.gaussians.Gaussians`` [m]; None for none, where the placement brings its own.
        trend: Model whose value the pooled map is added to, likewise; None for none.

    Raises:
        ValueError: The pooling does not give the task's labels; the projection does not see all of the map; parts do
            not go together; the trend needs its data or a training of its own.

    Source: GAI-GS, section "Framework"; the trend is ours (docs/methods.md).

    Example:
        >>> from gaigs.model.gaigs import GaussianSplatting
        >>> from gaigs.tokenizer.euclidean import EuclideanTokenizer
        >>> links = gaigs.links("synthetic", transmitters=20, order=0)
        >>> tokenizer = EuclideanTokenizer(links.scene, width=32)
        >>> model = GaussianSplatting(links.scene, tokenizer=tokenizer, rasterizer="torch", gaussians={"count": 50})
        >>> model.predict([[1.0, 2.0, 1.5]]).shape
        torch.Size([1, 90, 360])
    """

    name = "gaigs"
    own_placement: str | None = None  # the only one that makes a model of this name; None: any

    def __init__(
        self,
        scene: Scene,
        placement: str | Mapping | Placement = "free",
        tokenizer: str | Mapping | nn.Module = "multiview",
        deformation: str | Mapping | Deformation = "two_branch",
        projection: str | Mapping | Projection = "mercator",
        rasterizer: str | Mapping | Rasterizer = "fastest",
        pooling: str | Mapping | Pooling | None = None,
        gaussians: Mapping | None = MappingProxyType({}),
        trend: str | Mapping | Model | None = None,
    ):
        super().__init__(scene)
        self.trend = None
        if trend is not None:
            self.trend = build_trend(trend, scene)
            if not self.trend.state_dict() or [*self.trend.parameters()]:
                kind = "needs its data" if not self.trend.state_dict() else "has to be trained itself"
                raise ValueError(
                    f"the trend must be fitted at once and stored in a checkpoint, and {name_of(self.trend)} {kind}; "
                    "take path_loss, friis or mean with task.trend.name"
                )
            self.register_buffer("level", torch.zeros(()))  # of the untrained map, in the label's unit
        self.pooling = registry("pooling").build(self.own_pooling(scene) if pooling is None else pooling, scene=scene)
        grid = self.pooling.grid or scene.task.directions
        if grid is None:
            raise ValueError(
                f"labels of task {scene.task.name!r} have no directions, so the pooling must have a grid of its own, "
                f"and {name_of(self.pooling)} has none; take the task's own pooling"
            )
        carrier = torch.tensor([1e9])  # whichever
        nothing = Query(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long), carrier)
        gives = tuple(self.pooling(torch.zeros(1, self.pooling.channels, *grid.shape), nothing).shape[1:])
        if gives != scene.task.shape:
            raise ValueError(
                f"the pooling must give labels of task {scene.task.name!r}, {scene.task.shape}, and "
                f"{name_of(self.pooling)} gives {gives}; take the task's own pooling"
            )
        self.projection = registry("projection").build(projection, pixel=grid.pitch)
        self.rasterizer = registry("rasterizer").build(rasterizer)
        self.draws_map = getattr(self.rasterizer, "draws_map", True)
        plane = name_of(self.projection)
        if not self.draws_map and (self.pooling.takes is None or plane != "direction_cosine"):
            raise ValueError(
                f"rasterizer {name_of(self.rasterizer)!r} draws no map; it takes projection=direction_cosine and a "
                f"pooling for it (array_response, mean_power or element_sum), got {plane} and {name_of(self.pooling)}"
            )
        if self.draws_map and grid.elevations.min() < 0 and not self.projection.sees_below:
            raise ValueError(
                f"the map's grid reaches below the array's plane, which {plane} folds onto what is above; take "
                "mercator or equirectangular"
            )
        zone = self.pooling.zone
        if self.pooling.grid is None:
            zone = grid.elevations.min().item(), grid.elevations.max().item()
        channels = self.pooling.channels if self.draws_map else 2  # real and imaginary part of an amplitude
        self.placement = registry("placement").build(placement, scene=scene, channels=channels)
        if self.placement.model not in (None, self.name):
            raise ValueError(
                f"placement {name_of(self.placement)!r} makes another predictor, whose results have a name of their "
                f"own; set model={self.placement.model}"
            )
        if self.own_placement not in (None, name_of(self.placement)):
            raise ValueError(
                f"model {self.name!r} takes placement={self.own_placement}, got {name_of(self.placement)}; take "
                f"+experiment={self.name}, which has all its parts"
            )
        if gaussians is None and not self.placement.has_own:
            raise ValueError(
                f"placement {name_of(self.placement)!r} places free Gaussians alone; set gaussians=lattice"
            )
        self.gaussians = None
        if gaussians is not None:
            self.gaussians = call("gaussians", Gaussians, gaussians, scene=scene, zone=zone, channels=channels)
            if self.placement.has_own and self.gaussians.degree:
                raise ValueError(
                    f"Gaussians beside those of placement {name_of(self.placement)!r} must have gaussians.degree=0, "
                    f"got {self.gaussians.degree}"
                )
        kind = deformation
        if not is_built(deformation):
            name = deformation if isinstance(deformation, str) else deformation["name"]
            kind = registry("deformation").get(name)
        reads_tokens = kind.reads_tokens
        self.tokenizer = registry("tokenizer").build(tokenizer, scene=scene) if reads_tokens else None
        context = {"scene": scene, "channels": channels}
        if reads_tokens:
            parts = self.tokenizer
            context["tokenizer_widths"] = parts.scene_width, parts.gaussian_width, parts.transmitter_width
        self.deformation = registry("deformation").build(deformation, **context)

    @staticmethod
    def own_pooling(scene: Scene) -> str | dict:
        """The pooling that suits the scene's labels."""
        if scene.task.directions is not None:
            return "spectrum"
        return "element_sum" if scene.task.dtype.is_complex else "softmax_attention"

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits placement, pooling and trend.

        The training starts from the trend: the map's mean level is taken off.
        """
        self.placement.fit(links)
        self.pooling.fit(links)
        if self.trend is None:
            return
        self.trend.fit(links)
        if self.scene.task.dtype.is_complex:
            return  # waves have no level: their phases differ from link to link
        count = len(links.split.train)
        # Evenly spread, though not at whole steps, which might meet the same receiver time and again.
        some = links.split.train[torch.linspace(0, count - 1, min(64, count)).long()]
        batch = Batch(links.query[some], links.task.directions).to(self.level.device)
        self.level += (self(batch).value - self.trend(batch).value).mean()

    @property
    def predicts_untrained(self) -> bool:
        return self.trend is not None

    def forward(self, batch: Batch) -> Prediction:
        """As of every model.

        Raises:
            ValueError: In half precision.
        """
        own = next(self.parameters())
        if torch.is_autocast_enabled(own.device.type) or torch.finfo(own.dtype).bits < 32:
            raise ValueError(
                "angles and phases of Gaussians need the digits of float32; set trainer.precision to 32-true or 64-true"
            )
        query = batch.query
        # What a place excites is the same for all who hear it, unless a part looks at the receiver.
        places, which = query.unique(with_receivers=self._sees_receivers)
        _, residuals, _ = excited = self._excite(places)
        links, values = [], []
        for receiver in query.receivers.unique().tolist() or [0]:  # no links have a label's shape too
            links.append((query.receivers == receiver).nonzero()[:, 0])
            own = query[links[-1]]
            if self.draws_map:
                maps = [
                    self.rasterizer(*arguments)[0]
                    for arguments in self._arguments(*excited, which[links[-1]], receiver, batch.directions)
                ]
                value = self.pooling(torch.cat(maps), own, batch.directions)
            else:
                heard = self._sum(*excited, which[links[-1]], receiver, own)
                value = self.pooling.hear(heard, own, batch.directions)
            if self.pooling.grid is None and batch.directions is not None:
                value = value.reshape(len(own), *batch.directions.shape)  # a list of rays was rendered as one row
            values.append(value)
        value = self._on_trend(torch.cat(values)[torch.cat(links).argsort()], batch)
        penalties = {}
        if residuals.delta_opacities is not None:
            penalties["opacity"] = residuals.delta_opacities.square().mean()
        penalties |= self.placement.penalties()
        return Prediction(value, penalties)

    def _on_trend(self, value: Tensor, batch: Batch) -> Tensor:
        return value if self.trend is None else self.trend(batch).value + value - self.level

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {}
        if self.gaussians is not None:
            groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        placing = self.placement.parameter_groups()
        network = placing.pop("network", [])
        for part in (self.tokenizer, self.deformation, self.pooling):
            network += [] if part is None else list(part.parameters())
        return groups | placing | ({"network": network} if network else {})

    @property
    def primitives(self) -> Gaussians | None:
        return self.gaussians

    def facts(self) -> dict[str, object]:
        """The rasterizer that the last map was rendered with."""
        return {"rasterizer": self.rasterizer.used}

    def rendering(self, batch: Batch) -> Callable[[], object]:
        """The rasterizer alone, for the links to the first link's receiver; of ``aperture`` with the projection."""
        receiver = int(batch.query.receivers[0])
        query = batch.query[(batch.query.receivers == receiver).nonzero()[:, 0]]
        with torch.no_grad():
            which = torch.arange(len(query), device=query.transmitters.device)
            excited = self._excite(query)
            if not self.draws_map:
                return lambda: self._sum(*excited, which, receiver, query)
            calls = self._arguments(*excited, which, receiver, batch.directions)
        return lambda: [self.rasterizer(*arguments) for arguments in calls]

    def export(self, folder: Path) -> None:
        """``gaussians.ply`` of the free Gaussians, for 3-D splatting viewers."""
        if self.gaussians is not None:
            self.gaussians.save_ply(folder / "gaussians.ply")

    @property
    def _sees_receivers(self) -> bool:
        parts = self.placement, self.tokenizer, self.deformation
        return any(getattr(part, "sees_receivers", False) for part in parts)

    def _excite(self, query: Query) -> tuple[Placed, Residuals, Float[Tensor, "places n 3 3"]]:
        """The Gaussians for each query, what it changes in them, and their semi-axes then (1 or b, n, 3, 3) [m]."""
        placed = self.placement(self.gaussians, query)
        if placed.opacities is None:
            own = self.gaussians
            placed = placed._replace(
                quats=own.unit_quats,
                scales=own.scales[None],
                opacities=own.opacities,
                signal=_towards(own.bands, query.transmitters[:, None] - placed.means),
            )
        # The network says how a place responds to a transmitter; where the Gaussians go is learnt from the image alone.
        seen = Placed(*(None if part is None else part.detach() for part in placed))
        tokens = None if self.tokenizer is None else self.tokenizer(seen, seen.opacities, query)
        residuals = self.deformation(tokens, seen, query)
        quats, scales = placed.quats[None], placed.scales
        if residuals.delta_quats is not None:
            quats = quats + residuals.delta_quats
        if residuals.delta_scales is not None:
            scales = scales + residuals.delta_scales
        return placed, residuals, semi_axes(quats, scales)

    def _arguments(
        self,
        placed: Placed,
        residuals: Residuals,
        axes: Float[Tensor, "places n 3 3"],
        which: Int[Tensor, "b"],
        receiver: int,
        directions: Directions | None,
    ) -> list[tuple]:
        """A map rasterizer's arguments: the Gaussians as some queries excite them, on the receiver's plane.

        One call does for all where the Gaussians stand still, else there is one for each query.
        """
        if self.pooling.grid is not None or directions is None:
            directions = self.pooling.grid or self.scene.task.directions
        plane = self.projection.plane(directions.to(placed.means.device).to(placed.means.dtype))
        # Where nobody asks, it does not matter where Gaussians stand that follow the query.
        rows = [which] if len(placed.means) == 1 or not len(which) else which.split(1)
        calls = []
        for row in rows:
            if not len(placed.means):
                n = placed.means.shape[1]
                placed = placed._replace(means=placed.means.new_zeros(1, n, 3))
                axes = placed.means.new_ones(1, n, 3, 3)
            stands = placed.means if len(placed.means) == 1 else placed.means[row]
            splats = self._splats(stands, axes, row, receiver)
            signal, opacities, attenuations = self._strengths(placed, residuals, row)
            calls.append((splats, signal, opacities, attenuations, plane))
        return calls

    def _sum(
        self,
        placed: Placed,
        residuals: Residuals,
        axes: Float[Tensor, "places n 3 3"],
        which: Int[Tensor, "b"],
        receiver: int,
        query: Query,
    ) -> Tensor:
        """What the receiver's elements hear, summed without a map."""
        stands = placed.means.expand(len(which), -1, -1) if len(placed.means) == 1 else placed.means[which]
        signal, opacities, _ = self._strengths(placed, residuals, which)
        amplitudes = torch.complex(signal[..., 0], signal[..., 1]) * opacities
        n = amplitudes.shape[1]
        lengths = amplitudes.real.new_zeros(len(which), n) if placed.lengths is None else placed.lengths[which]
        antenna, frequencies = self.scene.receivers[receiver], self._carriers(query)
        if self.pooling.takes == "fields":
            pose = antenna.pose.to(stands)
            axes = pose.rotation.mT @ (axes if len(axes) == 1 else axes[which])
            offsets = self.scene.task.frequencies.to(frequencies)[None] - frequencies[:, None]
            heard = pose.local(stands), axes, amplitudes, lengths, antenna.array, frequencies, offsets
            return self.rasterizer.fields(*heard)
        splats = self._splats(stands, axes, which, receiver)
        coherences = lengths.new_ones(n) if placed.coherences is None else placed.coherences
        heard = splats, amplitudes, lengths, coherences, placed.bandwidth, antenna.array, frequencies
        return self.rasterizer.lags(*heard)

    def _carriers(self, query: Query) -> Float[Tensor, "b"]:
        """The links' frequencies [Hz]; single antennas hear powers alike at any, so they need none."""
        is_known = query.frequencies is not None or len(self.scene.frequencies) or self.scene.task.dtype.is_complex
        if not is_known and all(len(receiver.array) == 1 for receiver in self.scene.receivers):
            return query.transmitters.new_ones(len(query))
        return carriers(self.scene, query)

    def _strengths(self, placed: Placed, residuals: Residuals, which: Int[Tensor, "b"]) -> tuple:
        """Signal (b, n, c), opacities (b, n) and attenuations of some queries."""
        signal, opacities = placed.signal, placed.opacities
        if signal.ndim == 4:  # another for each query
            signal = signal[which]
        if residuals.delta_signal is not None:
            signal = signal + residuals.delta_signal[which]
        if residuals.delta_opacities is not None:
            opacities = (opacities + residuals.delta_opacities[which]).clamp(0, 1)
        attenuations = None if residuals.attenuations is None else residuals.attenuations[which]
        signal = signal.squeeze(-1)
        if placed.gains is None:
            signal = SH_DC * signal
        elif signal.shape[-1] == 1:
            signal = signal * magnitudes(placed.gains[which])[..., None]
        else:
            signal = torch.view_as_real(
                torch.complex(*signal.expand(len(which), -1, -1).unbind(-1)) * placed.gains[which]
            )
        return signal.expand(len(which), -1, -1), opacities.expand(len(which), -1), attenuations

    def _splats(
        self, means: Tensor, axes: Float[Tensor, "places n 3 3"], which: Int[Tensor, "b"], receiver: int
    ) -> Splats:
        """Some queries' Gaussians on the receiver's plane."""
        axes, pose = axes if len(axes) == 1 else axes[which], self.scene.receivers[receiver].pose
        return self.projection.project(means if not self.draws_map else means[0], axes, pose)


def _towards(bands: Float[Tensor, "n c k"], offsets: Float[Tensor, "b n 3"]) -> Float[Tensor, "*b n c 1"]:
    """What Gaussians send for transmitters so far away from them [m], before the factor of the constant harmonic.

    Without harmonics it is the same for all transmitters.
    """
    if bands.shape[-1] == 1:
        return bands
    # On a centre there is no direction: towards it the harmonics fade, and gradients stay moderate.
    seen = -offsets / offsets.norm(dim=-1, keepdim=True).clamp(min=BESIDE)
    harmonics = spherical_harmonics(seen, math.isqrt(bands.shape[-1]) - 1)
    return (bands * harmonics[:, :, None]).sum(-1, keepdim=True) / SH_DC
