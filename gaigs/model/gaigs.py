"""The splatting pipeline: GAI-GS, its ablations and its neighbours, put together from registered parts."""

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.data import Scene
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

    Source: GAI-GS, section "Framework".
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
    ):
        super().__init__(scene)
        self.pooling = registry("pooling").build(pooling)
        self.projection = registry("projection").build(projection, pixel=scene.grid.pitch)
        self.rasterizer = registry("rasterizer").build(rasterizer)
        self.gaussians = call("gaussians", Gaussians, gaussians, scene=scene, channels=self.pooling.channels)
        self.tokenizer = registry("tokenizer").build(tokenizer, scene=scene)
        widths = (self.tokenizer.scene_width, self.tokenizer.gaussian_width, self.tokenizer.transmitter_width)
        context = {"tokenizer_widths": widths, "channels": self.pooling.channels}
        self.mapping = call("mapping", SceneMapping, mapping, **context)

    def forward(self, batch: Batch) -> Prediction:
        residuals = self._residuals(batch.transmitters)
        image, _ = self.rasterizer(*self._excite(residuals, batch))
        penalties = {}
        if residuals.delta_opacities is not None:
            penalties["opacity"] = residuals.delta_opacities.square().mean()
        return Prediction(self.pooling(image), penalties)

    def render_arguments(self, batch: Batch) -> tuple:
        """What the rasterizer is called with for a batch; to time it alone."""
        return self._excite(self._residuals(batch.transmitters), batch)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        return groups | {"network": [*self.tokenizer.parameters(), *self.mapping.parameters()]}

    def _residuals(self, transmitters: Float[Tensor, "b 3"]) -> Residuals:
        # The network says how a place responds to a transmitter; where the Gaussians go is learnt from the image alone.
        means, opacities = self.gaussians.means.detach(), self.gaussians.opacities.detach()
        return self.mapping(self.tokenizer(means, opacities, transmitters))

    def _excite(self, residuals: Residuals, batch: Batch) -> tuple:
        """The rasterizer's arguments: the Gaussians as each transmitter excites them, on the receiver's plane."""
        gaussians, b = self.gaussians, len(batch.transmitters)
        signal, opacities = gaussians.signal, gaussians.opacities
        if residuals.delta_signal is not None:
            signal = signal + residuals.delta_signal
        if residuals.delta_opacities is not None:
            opacities = (opacities + residuals.delta_opacities).clamp(0, 1)
        splats = self._splats(residuals, self.scene.receivers[batch.receiver].pose)
        plane = self.projection.plane(batch.grid.elevations, batch.grid.azimuths)
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
