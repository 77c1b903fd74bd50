"""The splatting pipeline: GAI-GS, its ablations and its neighbours, put together from registered parts."""

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor, nn

from gaigs.data import Links
from gaigs.deformation import Residuals
from gaigs.directions import Directions
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.geometry import covariances
from gaigs.model import Model, Prediction
from gaigs.placement import Placed
from gaigs.projection import Splats
from gaigs.query import Batch, Query
from gaigs.registry import call, register, registry
from gaigs.scene import Scene


@register("model", "gaigs")
class GaussianSplatting(Model):
    """Placement -> tokens -> residuals -> Gaussians as the query excites them -> splats -> map -> value.

    Args:
        scene: Receivers and task.
        gaussians: Options of ``gaigs.gaussians.Gaussians``.
        placement, tokenizer, deformation, projection, rasterizer, pooling: Configurations of registered components.
        trend: Configuration of a model whose value the pooled map is added to; None for none.

    Raises:
        ValueError: The pooling does not give the task's labels; the projection does not see all of the map; the trend
            needs its data or a training of its own.

    Source: GAI-GS, section "Framework"; the trend is ours (docs/methods.md).
    """

    def __init__(
        self,
        scene: Scene,
        gaussians: dict,
        placement: dict,
        tokenizer: dict,
        deformation: dict,
        projection: dict,
        rasterizer: dict,
        pooling: dict,
        trend: dict | None = None,
    ):
        super().__init__(scene)
        self.trend = None
        if trend is not None:
            self.trend = registry("model").build(trend, scene=scene)
            if not self.trend.state_dict() or [*self.trend.parameters()]:
                kind = "needs its data" if not self.trend.state_dict() else "has to be trained itself"
                raise ValueError(
                    f"the trend must be fitted at once and stored in a checkpoint, and {trend['name']} {kind}; take "
                    "path_loss, friis or mean with task.trend.name"
                )
            self.register_buffer("level", torch.zeros(()))  # of the untrained map, in the label's unit
        self.pooling = registry("pooling").build(pooling, scene=scene)
        grid = self.pooling.grid or scene.task.directions
        if grid is None:
            raise ValueError(
                f"labels of task {scene.task.name!r} have no directions, so the pooling must have a grid of its own, "
                f"and {pooling['name']} has none; take the task's own pooling"
            )
        nothing = Query(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long))
        gives = tuple(self.pooling(torch.zeros(1, self.pooling.channels, *grid.shape), nothing).shape[1:])
        if gives != scene.task.shape:
            raise ValueError(
                f"the pooling must give labels of task {scene.task.name!r}, {scene.task.shape}, and {pooling['name']} "
                f"gives {gives}; take the task's own pooling"
            )
        self.projection = registry("projection").build(projection, pixel=grid.pitch)
        if grid.elevations.min() < 0 and not self.projection.sees_below:
            raise ValueError(
                f"the map's grid reaches below the array's plane, which {projection['name']} folds onto what is above; "
                "take mercator or equirectangular"
            )
        self.rasterizer = registry("rasterizer").build(rasterizer)
        zone = self.pooling.zone
        if self.pooling.grid is None:
            zone = grid.elevations.min().item(), grid.elevations.max().item()
        channels = self.pooling.channels
        self.gaussians = call("gaussians", Gaussians, gaussians, scene=scene, zone=zone, channels=channels)
        self.placement = registry("placement").build(placement, scene=scene)
        reads_tokens = registry("deformation").get(deformation["name"]).reads_tokens
        self.tokenizer = registry("tokenizer").build(tokenizer, scene=scene) if reads_tokens else None
        context = {"scene": scene, "channels": channels}
        if reads_tokens:
            parts = self.tokenizer
            context["tokenizer_widths"] = parts.scene_width, parts.gaussian_width, parts.transmitter_width
        self.deformation = registry("deformation").build(deformation, **context)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits pooling and trend, and has the training start from the trend: the map's mean level is taken off."""
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
        query = batch.query
        # What a place excites is the same for all who hear it, unless a part looks at the receiver.
        places, which = query.unique(with_receivers=self._sees_receivers)
        placed, residuals = self._excite(places)
        links, values = [], []
        for receiver in query.receivers.unique().tolist() or [0]:  # no links have a label's shape too
            links.append((query.receivers == receiver).nonzero()[:, 0])
            own = query[links[-1]]
            maps = [
                self.rasterizer(*arguments)[0]
                for arguments in self._arguments(placed, residuals, which[links[-1]], receiver, batch.directions)
            ]
            value = self.pooling(torch.cat(maps), own)
            if self.pooling.grid is None and batch.directions is not None:
                value = value.reshape(len(own), *batch.directions.shape)  # a list of rays was rendered as one row
            values.append(value)
        value = torch.cat(values)[torch.cat(links).argsort()]
        if self.trend is not None:
            value = self.trend(batch).value + value - self.level
        penalties = {}
        if residuals.delta_opacities is not None:
            penalties["opacity"] = residuals.delta_opacities.square().mean()
        return Prediction(value, penalties)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        network = [
            parameter
            for part in (self.placement, self.tokenizer, self.deformation, self.pooling)
            if part is not None
            for parameter in part.parameters()
        ]
        return groups | {"network": network}

    @property
    def primitives(self) -> Gaussians:
        return self.gaussians

    def facts(self) -> dict[str, object]:
        """The rasterizer that the last map was rendered with."""
        return {"rasterizer": self.rasterizer.used}

    def rendering(self, batch: Batch) -> Callable[[], object]:
        """The rasterizer alone, for the links to the first link's receiver."""
        receiver = int(batch.query.receivers[0])
        query = batch.query[(batch.query.receivers == receiver).nonzero()[:, 0]]
        with torch.no_grad():
            which = torch.arange(len(query), device=query.transmitters.device)
            calls = self._arguments(*self._excite(query), which, receiver, batch.directions)
        return lambda: [self.rasterizer(*arguments) for arguments in calls]

    def export(self, folder: Path) -> None:
        """``gaussians.ply``, for 3-D splatting viewers."""
        self.gaussians.save_ply(folder / "gaussians.ply")

    @property
    def _sees_receivers(self) -> bool:
        parts = self.placement, self.tokenizer, self.deformation
        return any(getattr(part, "sees_receivers", False) for part in parts)

    def _excite(self, query: Query) -> tuple[Placed, Residuals]:
        """Where the Gaussians stand for each query, and what it changes in them."""
        placed, opacities = self.placement(self.gaussians, query), self.gaussians.opacities
        # The network says how a place responds to a transmitter; where the Gaussians go is learnt from the image alone.
        seen = Placed(*(None if part is None else part.detach() for part in placed))
        tokens = None if self.tokenizer is None else self.tokenizer(seen, opacities.detach(), query)
        return placed, self.deformation(tokens, seen, query)

    def _arguments(
        self,
        placed: Placed,
        residuals: Residuals,
        which: Int[Tensor, "b"],
        receiver: int,
        directions: Directions | None,
    ) -> list[tuple]:
        """The rasterizer's arguments: the Gaussians as some queries excite them, on the receiver's plane.

        One call does for all where the Gaussians stand still, else there is one for each query.
        """
        if not len(placed.means):  # nobody asks: where Gaussians stand that follow the query does not matter
            placed = Placed(self.gaussians.means[None])
        if len(placed.means) > 1:
            return [
                self._call(Placed(placed.means[i : i + 1]), residuals, which[k : k + 1], receiver, directions)
                for k, i in enumerate(which.tolist())
            ]
        return [self._call(placed, residuals, which, receiver, directions)]

    def _call(self, placed, residuals, which, receiver, directions) -> tuple:
        gaussians, b = self.gaussians, len(which)
        residuals = Residuals(*(None if values is None else values[which] for values in residuals))
        signal, opacities = gaussians.signal, gaussians.opacities
        if residuals.delta_signal is not None:
            signal = signal + residuals.delta_signal
        if residuals.delta_opacities is not None:
            opacities = (opacities + residuals.delta_opacities).clamp(0, 1)
        splats = self._splats(placed, residuals, receiver)
        if self.pooling.grid is not None or directions is None:
            directions = self.pooling.grid or self.scene.task.directions
        plane = self.projection.plane(directions.to(signal.device).to(signal.dtype))
        signal = SH_DC * signal.squeeze(-1)
        return splats, signal.expand(b, -1, -1), opacities.expand(b, -1), residuals.attenuations, plane

    def _splats(self, placed: Placed, residuals: Residuals, receiver: int) -> Splats:
        gaussians = self.gaussians
        quats, scales = gaussians.unit_quats[None], gaussians.scales[None]
        if residuals.delta_quats is not None:
            quats = quats + residuals.delta_quats
        if residuals.delta_scales is not None:
            scales = scales + residuals.delta_scales
        pose = self.scene.receivers[receiver].pose
        return self.projection.project(placed.means[0], covariances(quats, scales), pose)
