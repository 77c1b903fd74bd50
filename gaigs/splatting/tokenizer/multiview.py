"""The paper's tokenizer: geometric algebra and Euclidean embeddings together."""

from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register, registry
from gaigs.splatting.gaussians import Placed, Tokens


@register("tokenizer", "multiview")
class MultiviewTokenizer(nn.Module):
    """The scene token of ``ga`` together with the position embeddings of ``euclidean``.

    Args:
        ga: Tokenizer of the scene token: its name, configuration or the object.
        euclidean: Tokenizer of the position embeddings, in the same forms.

    Source: GAI-GS, "Multi-view Tokenizer", eq. (10).
    """

    def __init__(
        self,
        scene: Scene,
        ga: str | Mapping | nn.Module = "ga",
        euclidean: str | Mapping | nn.Module = "euclidean",
    ):
        super().__init__()
        self.ga = registry("tokenizer").build(ga, scene=scene)
        self.euclidean = registry("tokenizer").build(euclidean, scene=scene)
        self.scene_width = self.ga.scene_width
        self.gaussian_width = self.euclidean.gaussian_width
        self.transmitter_width = self.euclidean.transmitter_width

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        # eq. (10): CLS, E(P_x), E(P_TX) = F_mv(P_x, P_TX).
        _, gaussians, transmitters = self.euclidean(placed, opacities, query)
        scene = self.ga(placed, opacities, query).scene
        return Tokens(scene, gaussians, transmitters)
