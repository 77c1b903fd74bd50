"""RSSI by attention: the brightest directions of the map have the most weight."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.pooling import Pooling, sphere


@register("pooling", "softmax_attention")
class SoftmaxAttention(Pooling):
    """The attention-weighted mean of a map of levels [bel]; the label in dB is ten times this mean.

    The weight of a pixel is (1 - prior) softmax((m - mean m) / temperature) + prior / pixels. The
    prior is uniform over pixels. On ``Grid.sphere`` it is also uniform over the sphere.

    Args:
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.
        temperature: Depth below the brightest pixel within which pixels count [bel], between 1e-6
            and 1e6. Far below the map's range the result is the maximum, far above it the mean.
        prior: Weight of the uniform part, between 0 and 1; with 1 the result is the plain mean.
        learn: True to train both, as logarithm and logit, so that both stay in range.

    Raises:
        ValueError: An option is out of range.

    Source: GAI-GS, section "Mapping, Projection and Render Module", "RSSI map construction".
    """

    channels = 1
    log_temperature: Tensor
    prior_logit: Tensor

    def __init__(
        self,
        grid: Sequence[int] = (4, 8),
        temperature: float = 0.434,
        prior: float = 0.1,
        learn: bool = False,
    ):
        super().__init__()
        if not 1e-6 <= temperature <= 1e6:
            raise ValueError(
                f"pooling option temperature must lie between 1e-6 and 1e6 bels, got {temperature}"
            )
        if not 0 <= prior <= 1:
            raise ValueError(f"pooling option prior must lie between 0 and 1, got {prior}")
        if learn and prior in (0, 1):
            raise ValueError(f"a learnt prior must start between 0 and 1, got {prior}; e.g. 0.1")
        self.grid = sphere("pooling.grid", grid)
        values = {
            "log_temperature": torch.tensor(math.log(temperature)),
            "prior_logit": torch.tensor(float(prior)).logit(),
        }
        for name, value in values.items():
            if learn:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    @property
    def temperature(self) -> Float[Tensor, ""]:
        """Temperature of the attention [bel]."""
        return self.log_temperature.exp()

    @property
    def prior(self) -> Float[Tensor, ""]:
        """Weight of the uniform part."""
        return self.prior_logit.sigmoid()

    def forward(
        self,
        image: Float[Tensor, "b 1 rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, " b"]:
        """Level relative to the model's trend [dB]; float32 for a map of half precision."""
        bels = image.to(torch.promote_types(image.dtype, torch.float32)).flatten(1)  # (b, pixels)
        # The paper subtracts the mean m, but a softmax does not change with a common constant. The
        # maximum in its place is exact for the brightest pixels, even if one value is huge.
        below = bels - bels.amax(1, keepdim=True).detach()
        attention = (below / self.temperature).softmax(1)  # (b, pixels)
        # "Attention weights blended with a uniform prior to ensure coverage."
        attended = (attention * bels).sum(1)  # (b,)
        return 10 * ((1 - self.prior) * attended + self.prior * bels.mean(1))
