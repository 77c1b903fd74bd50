"""The splatting pipeline: GAI-GS, its ablations and variants, from registered parts."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.core.geometry import Directions, magnitudes, semi_axes, spherical_harmonics
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene, carriers
from gaigs.data import Links
from gaigs.model import LookUp, Model, Prediction, build_trend
from gaigs.registry import call, is_built, name_of, register, registry
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.gaussians import SH_DC, Gaussians, Placed
from gaigs.splatting.placement import Placement
from gaigs.splatting.pooling import Pooling
from gaigs.splatting.pooling.channels import ChannelPooling
from gaigs.splatting.pooling.paths import PathPooling, ReceivedPaths
from gaigs.splatting.projection import Projection
from gaigs.splatting.rasterizer import Rasterizer


class Excited(NamedTuple):
    """The Gaussians for a transmitter at each of b places."""

    placed: Placed  # Gaussians before the deformation
    residuals: Residuals  # changes by the deformation
    semi_axes: Float[Tensor, "places n 3 3"]  # semi-axes after it, a column for each axis [m]


class Strengths(NamedTuple):
    """Strengths of n Gaussians for b queries."""

    signal: Float[Tensor, "b n c"]
    opacities: Float[Tensor, "b n"]
    attenuations: Float[Tensor, "b n"] | None


@register("model", "gaigs")
class GaussianSplatting(Model):
    """The paper's splatting pipeline with exchangeable parts.

    A placement provides Gaussians for each query. A tokenizer and a deformation modify them. A
    projection and a rasterizer draw them as a map over directions, and the pooling converts the map
    into the label. A pooling of paths needs no splats and no map.

    Args:
        scene: Receivers and task.
        placement, tokenizer, deformation, projection, rasterizer, pooling: Registered components:
            each the name, the configuration (a mapping with ``name`` and options), or the object
            itself. Pooling None is the default of the label. Projection and rasterizer are None for
            a pooling of paths.
        gaussians: Options of ``gaigs.splatting.gaussians.Gaussians`` [m]; None if all Gaussians
            come from the placement.
        trend: Model whose prediction is added to the pooled map, given like a component; None: 0.

    Raises:
        ValueError: The pooling does not return the task's labels; the projection does not cover the
            map; parts do not match; the trend needs its data or a training.

    Source: GAI-GS, section "Framework"; the trend is ours (docs/methods.md).

    Example:
        >>> from gaigs.model.gaigs import GaussianSplatting
        >>> from gaigs.splatting.tokenizer.euclidean import EuclideanTokenizer
        >>> links = gaigs.links("synthetic", transmitters=20, order=0)
        >>> tokenizer = EuclideanTokenizer(links.scene, width=32)
        >>> parts = {"tokenizer": tokenizer, "rasterizer": "torch", "gaussians": {"count": 50}}
        >>> model = GaussianSplatting(links.scene, **parts)
        >>> model.predict([[1.0, 2.0, 1.5]]).shape  # places, receivers, rows, columns
        torch.Size([1, 1, 90, 360])
    """

    name = "gaigs"
    own_placement: str | None = None  # the only one that makes a model of this name; None: any

    def __init__(
        self,
        scene: Scene,
        placement: str | Mapping | Placement = "free",
        tokenizer: str | Mapping | nn.Module = "multiview",
        deformation: str | Mapping | Deformation = "two_branch",
        projection: str | Mapping | Projection | None = "mercator",
        rasterizer: str | Mapping | Rasterizer | None = "fastest",
        pooling: str | Mapping | Pooling | None = None,
        gaussians: Mapping | None = MappingProxyType({}),
        trend: str | Mapping | Model | None = None,
    ):
        super().__init__(scene)
        # In this order: each part draws random numbers when it is built.
        self.trend = None if trend is None else self._built_trend(trend)
        pooling = self.own_pooling(scene) if pooling is None else pooling
        self.pooling = registry("pooling").build(pooling, scene=scene)
        self.projection: Any = None
        self.rasterizer: Any = None
        zone = self.pooling.zone
        if self.takes_paths:
            self._check_paths(projection, rasterizer)
        else:
            grid = self._build_map(projection, rasterizer)
            if self.pooling.grid is None:
                zone = grid.elevations.min().item(), grid.elevations.max().item()
        channels = self.pooling.channels
        self.placement = registry("placement").build(placement, scene=scene, channels=channels)
        self._check_placement()
        self.gaussians = self._built_gaussians(gaussians, zone)
        deforms: Any = deformation  # the object or its class, either of which has reads_tokens
        if not is_built(deformation):
            name = deformation if isinstance(deformation, str) else deformation["name"]
            deforms = registry("deformation").get(name)
        is_constant = self.gaussians is not None and not self.placement.has_own
        count = len(self.gaussians) if is_constant else None
        context: dict[str, Any] = {"scene": scene, "channels": channels, "count": count}
        self.tokenizer = None
        if deforms.reads_tokens:
            built = self.tokenizer = registry("tokenizer").build(tokenizer, scene=scene)
            widths = built.scene_width, built.gaussian_width, built.transmitter_width
            context["tokenizer_widths"] = widths
        self.deformation = registry("deformation").build(deformation, **context)

    def _built_trend(self, trend: str | Mapping | Model) -> Model:
        """The built trend, which must have no parameters or links; adds the buffer ``level``."""
        built = build_trend(trend, self.scene)
        keeps_links = isinstance(built, LookUp) or not built.state_dict()
        if keeps_links or [*built.parameters()]:
            raise ValueError(
                f"task.trend.name cannot be {name_of(built)}; take mean, path_loss or friis"
            )
        self.register_buffer("level", torch.zeros(()))  # of the untrained map, in the label's unit
        return built

    def _check_paths(self, projection: object, rasterizer: object) -> None:
        """Raises a ``ValueError`` unless parts match a pooling of paths."""
        if projection is not None or rasterizer is not None:
            raise ValueError(
                f"pooling {name_of(self.pooling)!r} takes paths, and no map is projected or "
                "rasterized\n"
                "leave out projection and rasterizer (~projection ~rasterizer, None in Python)"
            )
        paths = ReceivedPaths(
            means=torch.zeros(1, 0, 3),
            semi_axes=torch.zeros(1, 0, 3, 3),
            amplitudes=torch.zeros(1, 0, dtype=torch.complex64),
            lengths=torch.zeros(1, 0),
            coherences=torch.zeros(0),
            bandwidth=None,
            receiver=self.scene.receivers[0],
            carriers=torch.tensor([1e9]),
        )
        self._check_gives(paths)

    def _build_map(
        self,
        projection: str | Mapping | Projection | None,
        rasterizer: str | Mapping | Rasterizer | None,
    ) -> Directions:
        """Builds projection and rasterizer; returns the directions of the map's pixels."""
        if projection is None or rasterizer is None:
            raise ValueError(
                f"pooling {name_of(self.pooling)!r} takes a map, which needs a projection and a "
                "rasterizer\nset projection=mercator rasterizer=fastest, "
                "or pooling=path_spectrum, path_rssi or path_csi"
            )
        task = self.scene.task
        grid = self.pooling.grid or task.directions
        if grid is None:
            raise ValueError(
                f"labels of task {task.name!r} have no directions; take the task's own pooling"
            )
        # What the pooling makes of an empty map shows the shape of its labels.
        self._check_gives(torch.zeros(1, self.pooling.channels, *grid.shape))
        self.projection = registry("projection").build(projection, pixel=grid.pitch)
        self.rasterizer = registry("rasterizer").build(rasterizer)
        self.projection.check_sees(grid)
        return grid

    def _check_placement(self) -> None:
        """Raises a ``ValueError`` unless the placement may be used by a model of this name."""
        name = name_of(self.placement)
        if self.placement.model not in (None, self.name):
            raise ValueError(
                f"placement {name!r} makes another predictor; set model={self.placement.model}"
            )
        if self.own_placement not in (None, name):
            raise ValueError(
                f"model {self.name!r} takes placement={self.own_placement}, got {name}; "
                f"take +experiment={self.name}"
            )

    def _built_gaussians(self, options: Mapping | None, zone: Any) -> Gaussians | None:
        """Trainable Gaussians, which are not the placement's own; None without ``options``.

        ``zone`` has their lowest and highest elevation [rad]. Beside Gaussians of a placement they
        must have a signal that is the same in all directions (degree 0).
        """
        name = name_of(self.placement)
        if options is None:
            if not self.placement.has_own:
                raise ValueError(
                    f"placement {name!r} places free Gaussians alone; set gaussians=lattice"
                )
            return None
        context = {"scene": self.scene, "zone": zone, "channels": self.pooling.channels}
        built = call("gaussians", Gaussians, options, **context)
        if self.placement.has_own and built.degree:
            raise ValueError(f"placement {name!r} needs gaussians.degree=0, got {built.degree}")
        return built

    @property
    def learning_rates(self) -> dict[str, float]:  # type: ignore[override]
        rates = {**Gaussians.learning_rates, **self.placement.learning_rates}
        return rates | {
            "network": self.deformation.learning_rate or super().learning_rates["network"]
        }

    @property
    def penalty_weights(self) -> dict[str, float]:  # type: ignore[override]
        return {"opacity": 0.01, **self.placement.penalty_weights}  # the paper's alpha, as released

    @property
    def takes_paths(self) -> bool:
        """True if the pooling sums paths, and no map is drawn."""
        return isinstance(self.pooling, PathPooling)

    @staticmethod
    def own_pooling(scene: Scene) -> str:
        """The default pooling for the scene's labels."""
        if scene.task.directions is not None:
            return "spectrum"
        return "element_sum" if scene.task.dtype.is_complex else "softmax_attention"

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits placement, pooling and trend.

        ``level`` becomes the mean of the untrained map, so that the training starts at the trend.
        """
        self.placement.fit(links)
        self.pooling.fit(links)
        if self.trend is None:
            return
        of_trend = links
        if links.split.by_receivers:  # the trend must not know the validation receivers
            of_trend = replace(links, split=links.split.only(links.split.train))
        self.trend.fit(of_trend)
        if self.scene.task.dtype.is_complex:
            return  # waves have no level: their phases differ from link to link
        count = len(links.split.train)
        # Evenly spread, but not in equal steps, which might meet one receiver alone.
        rows = torch.linspace(0, count - 1, min(64, count)).long()
        query = links.query[links.split.train[rows]]
        batch = Batch(query, links.task.directions).to(self.level.device)
        self.level += (self(batch).value - self.trend(batch).value).mean()

    @property
    def predicts_untrained(self) -> bool:  # type: ignore[override]
        return self.trend is not None

    def forward(self, batch: Batch) -> Prediction:
        parameter = next(self.parameters())
        is_mixed = torch.is_autocast_enabled(parameter.device.type)
        if is_mixed or torch.finfo(parameter.dtype).bits < 32:
            raise ValueError(
                "angles and phases of Gaussians need float32; "
                "set trainer.precision to 32-true or 64-true"
            )
        query = batch.query
        # Receivers share what a place excites, unless a part looks at the receiver.
        parts = self.placement, self.tokenizer, self.deformation
        sees_receivers = any(getattr(part, "sees_receivers", False) for part in parts)
        places, which = query.unique(with_receivers=sees_receivers)  # which (b,): link to place
        return self.respond(self.excite(places), which, batch)

    def respond(self, excited: Excited, which: Int[Tensor, " b"], batch: Batch) -> Prediction:
        """Values of a batch; ``which`` is the row of ``excited`` for each link."""
        query = batch.query
        indices, values = [], []
        # One receiver at a time, unless the pooling sums paths in the same way for all receivers.
        is_one_group = self.takes_paths and self.pooling.is_same_for_all
        groups = torch.zeros_like(query.receivers) if is_one_group else query.receivers
        for receiver in groups.unique().tolist() or [0]:  # an empty batch needs the label's shape
            index = (groups == receiver).nonzero()[:, 0]
            links = query[index]
            rows = which[index]
            if self.takes_paths:
                received = self.paths(excited, rows, receiver, links)
            else:
                calls = self._splats(excited, rows, receiver, batch.directions)
                received = torch.cat([self.rasterizer(*arguments)[0] for arguments in calls])
            value = self.pooling(received, links, batch.directions)
            if not self.takes_paths and self.pooling.grid is None and batch.directions is not None:
                # A list of rays was rendered as one row.
                value = value.reshape(len(links), *batch.directions.shape)
            indices.append(index)
            values.append(value)
        value = torch.cat(values)[torch.cat(indices).argsort()]  # in the order of the batch
        if self.trend is not None:
            value = self.trend(batch).value + value - self.level
        penalties = {}
        if excited.residuals.delta_opacities is not None:
            penalties["opacity"] = excited.residuals.delta_opacities.square().mean()
        return Prediction(value, penalties | self.placement.penalties())

    @property
    def any_frequency(self) -> bool:  # type: ignore[override]
        return isinstance(self.pooling, ChannelPooling) and (
            self.trend is None or self.trend.any_frequency
        )

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        """True if all parts that depend on receivers have ``take_receivers``."""
        parts = self.placement, self.tokenizer, self.deformation
        dependent = [part for part in parts if getattr(part, "sees_receivers", False)]
        is_movable = all(hasattr(part, "take_receivers") for part in dependent)
        return is_movable and (self.trend is None or self.trend.any_receiver)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """A group for each parameter of the Gaussians, the placement's groups, and all networks."""
        groups = {}
        if self.gaussians is not None:
            groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        groups |= self.placement.parameter_groups()
        network = groups.pop("network", [])
        for part in (self.tokenizer, self.deformation, self.pooling):
            network += [] if part is None else list(part.parameters())
        return groups | ({"network": network} if network else {})

    @property
    def primitives(self) -> Gaussians | None:  # type: ignore[override]
        return self.gaussians

    def facts(self) -> dict[str, object]:
        """The rasterizer that drew the last map, if any."""
        return {} if self.rasterizer is None else {"rasterizer": self.rasterizer.used}

    def rendering(self, batch: Batch) -> Callable[[], object]:
        """A function that only draws the map, or sums the paths, at the first link's receiver."""
        receiver = int(batch.query.receivers[0])
        query = batch.query[(batch.query.receivers == receiver).nonzero()[:, 0]]
        with torch.no_grad():
            which = torch.arange(len(query), device=query.transmitters.device)
            excited = self.excite(query)
            if self.takes_paths:
                return lambda: self.pooling.sum_paths(self.paths(excited, which, receiver, query))
            calls = self._splats(excited, which, receiver, batch.directions)
        return lambda: [self.rasterizer(*arguments) for arguments in calls]

    def export(self, folder: Path) -> None:
        """Writes ``gaussians.ply``, the trainable Gaussians, for 3-D splatting viewers."""
        if self.gaussians is not None:
            self.gaussians.save_ply(folder / "gaussians.ply")

    def excite(self, query: Query) -> Excited:
        """The Gaussians for the transmitter in each row of a query."""
        placed = self.placement(self.gaussians, query)
        if placed.opacities is None:
            trained = self.gaussians  # the placement gave only their centres
            placed = placed._replace(
                quats=trained.unit_quats,
                scales=trained.scales[None],
                opacities=trained.opacities,
                signal=_towards(trained.bands, query.transmitters[:, None] - placed.means),
            )
        # Gradients of the networks must not move the Gaussians.
        constant = Placed(*(None if part is None else part.detach() for part in placed))
        tokens = None
        if self.tokenizer is not None:
            tokens = self.tokenizer(constant, constant.opacities, query)
        residuals = self.deformation(tokens, constant, query)
        quats, scales = placed.quats[None], placed.scales
        if residuals.delta_quats is not None:
            quats = quats + residuals.delta_quats
        if residuals.delta_scales is not None:
            scales = scales + residuals.delta_scales
        return Excited(placed, residuals, semi_axes(quats, scales))

    def paths(
        self, excited: Excited, which: Int[Tensor, " b"], receiver: int, query: Query
    ) -> ReceivedPaths:
        """The paths of links to one receiver; ``which`` is the row of ``excited`` for each link."""
        placed = excited.placed
        means, axes = placed.means, excited.semi_axes
        means = means if len(means) == 1 else means[which]  # (1 or b, n, 3)
        axes = axes if len(axes) == 1 else axes[which]  # (1 or b, n, 3, 3)
        signal, opacities, _ = self._strengths(excited, which)
        amplitudes = torch.complex(signal[..., 0], signal[..., 1]) * opacities  # (b, n)
        b, n = amplitudes.shape
        return ReceivedPaths(
            means.expand(b, -1, -1),
            axes,
            amplitudes,
            amplitudes.real.new_zeros(b, n) if placed.lengths is None else placed.lengths[which],
            amplitudes.real.new_ones(n) if placed.coherences is None else placed.coherences,
            placed.bandwidth,
            self.scene.receivers[receiver],
            self.carriers(query),
        )

    def carriers(self, query: Query) -> Float[Tensor, " b"]:
        """The links' carriers [Hz]; 1 if they are unknown and all antennas are single elements.

        The power at a single element does not depend on the frequency.
        """
        is_known = (
            query.frequencies is not None
            or len(self.scene.frequencies)
            or self.scene.task.dtype.is_complex
        )
        if not is_known and all(len(receiver.array) == 1 for receiver in self.scene.receivers):
            return query.transmitters.new_ones(len(query))
        return carriers(self.scene, query)

    def _splats(
        self,
        excited: Excited,
        which: Int[Tensor, " b"],
        receiver: int,
        directions: Directions | None,
    ) -> list[tuple]:
        """Arguments of each call of the rasterizer, for links to one receiver.

        A call draws one link, or all links if they share the centres of the Gaussians.
        """
        placed, axes = excited.placed, excited.semi_axes
        if self.pooling.grid is not None or directions is None:
            directions = self.pooling.grid or self.scene.task.directions
        plane = self.projection.plane(directions.to(placed.means.device).to(placed.means.dtype))
        means = placed.means
        if not len(means):  # no links: any Gaussians give a map of the right shape
            axes = means.new_ones(1, means.shape[1], 3, 3)
            means = means.new_zeros(1, means.shape[1], 3)
        pose = self.scene.receivers[receiver].pose
        calls = []
        for rows in [which] if len(means) == 1 else which.split(1):
            centres = means[0] if len(means) == 1 else means[rows][0]  # (n, 3)
            axes_of_rows = axes if len(axes) == 1 else axes[rows]  # (1 or rows, n, 3, 3)
            splats = self.projection.project(centres, axes_of_rows, pose)
            calls.append((splats, *self._strengths(excited, rows), plane))
        return calls

    def _strengths(self, excited: Excited, which: Int[Tensor, " b"]) -> Strengths:
        """Strengths of the Gaussians for each row ``which`` of ``excited``."""
        placed, residuals = excited.placed, excited.residuals
        signal, opacities = placed.signal, placed.opacities
        if signal.ndim == 4:  # (places, n, c, 1): it depends on the transmitter
            signal = signal[which]
        if residuals.delta_signal is not None:
            signal = signal + residuals.delta_signal[which]
        if residuals.delta_opacities is not None:
            opacities = (opacities + residuals.delta_opacities[which]).clamp(0, 1)
        attenuations = None if residuals.attenuations is None else residuals.attenuations[which]
        signal = signal.squeeze(-1)  # (n, c) or (b, n, c)
        count = len(which)
        if placed.gains is None:
            signal = SH_DC * signal
        elif signal.shape[-1] == 1:  # a power map has no phase
            signal = signal * magnitudes(placed.gains[which])[..., None]
        else:  # the two channels are the real and imaginary part of a wave
            numbers = torch.complex(*signal.expand(count, -1, -1).unbind(-1))  # (b, n)
            signal = torch.view_as_real(numbers * placed.gains[which])
        return Strengths(signal.expand(count, -1, -1), opacities.expand(count, -1), attenuations)

    def _check_gives(self, received: Tensor | ReceivedPaths) -> None:
        """Raises a ``ValueError`` unless the pooling returns labels of the task's shape."""
        any_carrier = torch.tensor([1e9])
        query = Query(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long), any_carrier)
        shape, task = tuple(self.pooling(received, query).shape[1:]), self.scene.task
        if shape != task.shape:
            raise ValueError(
                f"pooling {name_of(self.pooling)!r} gives {shape}, not labels of task "
                f"{task.name!r}, {task.shape}; take the task's own pooling"
            )


def _towards(
    bands: Float[Tensor, "n c k"], offsets: Float[Tensor, "b n 3"]
) -> Float[Tensor, "*b n c 1"]:
    """Signal of Gaussians for transmitters, in units of the constant harmonic ``SH_DC``.

    Args:
        bands: Coefficients of k spherical harmonics for each channel.
        offsets: Vectors from the Gaussians to the transmitters [m].
    """
    if bands.shape[-1] == 1:
        return bands
    # The direction is undefined at a centre. Nearer than 0.05 m it fades, to bound its gradients.
    incident = -offsets / offsets.norm(dim=-1, keepdim=True).clamp(min=0.05)  # (b, n, 3)
    harmonics = spherical_harmonics(incident, math.isqrt(bands.shape[-1]) - 1)  # (b, n, k)
    return (bands * harmonics[:, :, None]).sum(-1, keepdim=True) / SH_DC
