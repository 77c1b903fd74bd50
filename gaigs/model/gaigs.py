"""The splatting pipeline: GAI-GS, its ablations and its neighbours, put together from registered parts."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.data import Grid, Links, Scene
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.geometry import Pose, covariances
from gaigs.mapping import Residuals, SceneMapping
from gaigs.model import Batch, Model, Prediction
from gaigs.projection import Splats
from gaigs.registry import call, register, registry


@register("model", "gaigs")
class GaussianSplatting(Model):
    """Tokens -> residuals -> Gaussians as the transmitter excites them -> splats -> map -> label.

    Args:
        scene: Receivers and grid.
        tokenizer, projection, rasterizer, pooling: Configurations of registered components.
        gaussians: Options of ``gaigs.gaussians.Gaussians``.
        mapping: Options of ``gaigs.mapping.SceneMapping``.
        grid: Rows and columns of the map over the full sphere that the pooling makes an RSSI of; None for spectra,
            whose grid is the label's.
        reference: Configuration of a model whose RSSI the pooled map is added to [dB]; None for spectra.

    Raises:
        ValueError: ``grid`` or ``reference`` is given for spectra, or lacking for RSSI; the pooling does not give such
            labels; the reference is a look-up.

    Source: GAI-GS, section "Framework"; the reference is ours (docs/methods.md).
    """

    def __init__(
        self,
        scene: Scene,
        tokenizer: dict,
        projection: dict,
        rasterizer: dict,
        pooling: dict,
        gaussians: dict,
        mapping: dict,
        grid: list[int] | None = None,
        reference: dict | None = None,
    ):
        super().__init__(scene)
        for option, value in (("grid", grid), ("reference", reference)):
            if (value is None) == (scene.grid is None):
                kind, there = ("RSSI", "lacking") if value is None else ("spectra", f"{value}")
                raise ValueError(
                    f"model.{option} must be given for RSSI and null for spectra, and for {kind} it is {there}; take "
                    "+experiment=rssi or +experiment=spectrum, whichever suits the data"
                )
        if grid is not None and (len(grid) != 2 or not all(type(size) is int for size in grid)):
            raise ValueError(f"model.grid must be [rows, columns], two whole numbers, got {grid}")
        self.grid = scene.grid or Grid.sphere(*grid)
        self.reference = None
        if reference is not None:
            self.reference = registry("model").build(reference, scene=scene)
            if not self.reference.state_dict():
                raise ValueError(
                    f"model.reference must be a model that a checkpoint can store, and {reference['name']} is a "
                    "look-up that needs its data; take path_loss or mean"
                )
            self.register_buffer("level", torch.zeros(()))  # of the untrained map [dB]
        self.pooling = registry("pooling").build(pooling, grid=self.grid)
        gives = self.pooling(torch.zeros(1, self.pooling.channels, *self.grid.shape)).ndim
        if gives != (1 if scene.grid is None else 3):
            labels, kind = ("RSSI", "numbers") if scene.grid is None else ("spectra", "maps")
            raise ValueError(
                f"the labels are {labels}, so the pooling must give {kind}, and {pooling['name']} does not; take "
                "spectrum for spectra, softmax_attention or mean_power for RSSI"
            )
        self.projection = registry("projection").build(projection, pixel=self.grid.pitch)
        if self.grid.elevations.min() < 0 and not self.projection.sees_below:
            raise ValueError(
                f"the map's grid reaches below the array's plane, which {projection['name']} folds onto what is above; "
                "take mercator or equirectangular"
            )
        self.rasterizer = registry("rasterizer").build(rasterizer)
        self.gaussians = call("gaussians", Gaussians, gaussians, scene=scene, channels=self.pooling.channels)
        self.tokenizer = registry("tokenizer").build(tokenizer, scene=scene)
        widths = (self.tokenizer.scene_width, self.tokenizer.gaussian_width, self.tokenizer.transmitter_width)
        context = {"tokenizer_widths": widths, "channels": self.pooling.channels}
        self.mapping = call("mapping", SceneMapping, mapping, **context)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """For RSSI fits the reference, and has the training start from there: the map's mean level is taken off."""
        if self.reference is not None:
            self.reference.fit(links)
            count = len(links.split.train)
            # Evenly spread, though not at whole steps, which might meet the same receiver time and again.
            some = links.split.train[torch.linspace(0, count - 1, min(64, count)).long()]
            batch = Batch(links.transmitters[some], links.receiver_index[some], None).to(self.level.device)
            self.level += (self(batch).label - self.reference(batch).label).mean()

    def forward(self, batch: Batch) -> Prediction:
        # What a transmitter excites is the same for all who hear it.
        transmitters, which = batch.transmitters.unique(dim=0, return_inverse=True)
        residuals = self._residuals(transmitters)
        links, labels = [], []
        for receiver in batch.receivers.unique().tolist() or [0]:  # no links have a label's shape too
            links.append((batch.receivers == receiver).nonzero()[:, 0])
            image, _ = self.rasterizer(*self._excite(residuals, which[links[-1]], receiver, batch.grid))
            labels.append(self.pooling(image))
        label = torch.cat(labels)[torch.cat(links).argsort()]
        if self.reference is not None:
            label = self.reference(batch).label + label - self.level
        penalties = {}
        if residuals.delta_opacities is not None:
            penalties["opacity"] = residuals.delta_opacities.square().mean()
        return Prediction(label, penalties)

    def render_arguments(self, batch: Batch) -> tuple:
        """What the rasterizer is called with for the first link's receiver; to time it alone."""
        transmitters = batch.transmitters[batch.receivers == batch.receivers[0]]
        which = torch.arange(len(transmitters), device=transmitters.device)
        return self._excite(self._residuals(transmitters), which, int(batch.receivers[0]), batch.grid)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        network = [*self.tokenizer.parameters(), *self.mapping.parameters(), *self.pooling.parameters()]
        return groups | {"network": network}

    def _residuals(self, transmitters: Float[Tensor, "b 3"]) -> Residuals:
        # The network says how a place responds to a transmitter; where the Gaussians go is learnt from the image alone.
        means, opacities = self.gaussians.means.detach(), self.gaussians.opacities.detach()
        return self.mapping(self.tokenizer(means, opacities, transmitters))

    def _excite(self, residuals: Residuals, which: Int[Tensor, "b"], receiver: int, grid: Grid | None) -> tuple:
        """The rasterizer's arguments: the Gaussians as some transmitters excite them, on the receiver's plane."""
        gaussians, b = self.gaussians, len(which)
        residuals = Residuals(*(None if values is None else values[which] for values in residuals))
        signal, opacities = gaussians.signal, gaussians.opacities
        if residuals.delta_signal is not None:
            signal = signal + residuals.delta_signal
        if residuals.delta_opacities is not None:
            opacities = (opacities + residuals.delta_opacities).clamp(0, 1)
        splats = self._splats(residuals, self.scene.receivers[receiver].pose)
        grid = (grid or self.grid).to(signal.device)
        plane = self.projection.plane(grid.elevations, grid.azimuths)
        signal = SH_DC * signal.squeeze(-1)
        return splats, signal.expand(b, -1, -1), opacities.expand(b, -1), residuals.attenuations, plane

    def _splats(self, residuals: Residuals, receiver: Pose) -> Splats:
        gaussians = self.gaussians
        quats, scales = gaussians.unit_quats[None], gaussians.scales[None]
        if residuals.delta_quats is not None:
            quats = quats + residuals.delta_quats
        if residuals.delta_scales is not None:
            scales = scales + residuals.delta_scales
        return self.projection.project(gaussians.means, covariances(quats, scales), receiver)
