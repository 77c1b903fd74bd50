"""A scene token from geometric-algebra attention between transmitter and opaque Gaussians."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.algebra import PROJECTIVE, SPACETIME
from gaigs.algebra.embedding import embed_event, embed_point
from gaigs.algebra.layers import EquivariantLinear, GATrBlock
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.gaussians import Placed, Tokens


@register("tokenizer", "ga")
class GATokenizer(nn.Module):
    """CLS of a Geometric Algebra Transformer (GATr) over CLS, transmitter and anchors.

    Tokens are [TX, CLS, anchors]. CLS is a learnable point. Anchors are the centres of the most
    opaque Gaussians, chosen at every call, without a gradient. Each token is a multivector with two
    scalars for its type. For data with several carriers a third scalar is the carrier's position in
    the band. There are no position embeddings.

    Positions are relative to the middle of the box around transmitters and receivers, in units of
    half its longest edge. They are of order one, and rigid motions stay rigid motions.

    Args:
        scene: Its box and receivers set middle and unit.
        anchors: Number of anchors, at most all Gaussians; the paper's M, 16 as released.
        blocks: GATr blocks; 1 as released.
        multivectors: Multivector channels within the blocks, even and a multiple of ``heads``; 16
            as released.
        scalars: Scalar channels within the blocks, a multiple of ``heads``; 4 as released.
        heads: Attention heads of a block; the number is ours.
        width: Width of the scene token; 16 as released.
        algebra: ``projective``, G(3,0,1) with rotations, translations and mirrors (as in GATr); or
            ``spacetime``, G(3,1,0) with rotations, boosts and mirrors about the middle (the paper's
            preliminaries), with points as events at time zero.

    Raises:
        ValueError: An option is out of range, or all transmitters and receivers are at one point.

    Source: GAI-GS, "Multi-view Tokenizer", eq. (8) and (10); Brehmer et al., Geometric Algebra
    Transformer, 2023.
    """

    gaussian_width = 0
    transmitter_width = 0
    middle: Tensor
    scale: Tensor

    def __init__(
        self,
        scene: Scene,
        anchors: int = 16,
        blocks: int = 1,
        multivectors: int = 16,
        scalars: int = 4,
        heads: int = 4,
        width: int = 16,
        algebra: str = "projective",
    ):
        super().__init__()
        algebras = {"projective": (PROJECTIVE, embed_point), "spacetime": (SPACETIME, embed_event)}
        if algebra not in algebras:
            raise ValueError(
                f"tokenizer option algebra must be one of {', '.join(algebras)}, got {algebra!r}"
            )
        counts = {
            "anchors": anchors,
            "blocks": blocks,
            "multivectors": multivectors,
            "scalars": scalars,
            "heads": heads,
            "width": width,
        }
        for option, count in counts.items():
            if count < 1:
                raise ValueError(f"tokenizer option {option} must be at least 1, got {count}")
        lower, upper = scene.box
        scale = (upper - lower).max() / 2  # [m]
        if not scale > 0:
            raise ValueError(
                f"transmitters and receivers must not all be at one point, got {lower.tolist()}"
            )
        self.register_buffer("middle", (lower + upper) / 2)
        self.register_buffer("scale", scale)
        self.anchors = anchors
        self.scene_width = width
        self.algebra, self.embed = algebras[algebra]
        self.cls = nn.Parameter(torch.zeros(3))
        self.types = nn.Parameter(torch.randn(3, 2))  # of CLS, transmitter and anchors
        self.scene = scene
        type_width = 2 + scene.has_band
        self.first = EquivariantLinear(self.algebra, (1, multivectors), (type_width, scalars))
        self.blocks = nn.ModuleList(
            GATrBlock(self.algebra, multivectors, scalars, heads) for _ in range(blocks)
        )
        self.last = EquivariantLinear(self.algebra, (multivectors, 1), (scalars, 2))
        self.read_out = nn.Linear(self.algebra.size + 2, width)

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        """CLS for every query; only the order of the opacities matters."""
        means = placed.means.detach()  # (1 or b, n, 3)
        b = len(query)
        # "Selecting the top-M highest-opacity primitives as anchors".
        m = min(self.anchors, means.shape[1])
        anchors = means[:, opacities.topk(m).indices]  # (1 or b, m, 3)
        anchors = (anchors - self.middle) / self.scale
        transmitters = (query.transmitters - self.middle) / self.scale  # (b, 3)
        *blocks, final = self.blocks
        # With a single block CLS and anchors are equal for all queries until the block's attention.
        is_shared = len(anchors) == 1 and not blocks and not self.scene.has_band
        points, types = self._tokens(query, transmitters, anchors, is_shared)
        count = b if is_shared else 1  # transmitters in a set of tokens, which come first

        points = self.embed(points)  # (b + 1 + m, k), or (b, 2 + m, k)
        multivectors, scalars = self.first(points[..., None, :], types)
        # The transmitter moves with the room, as the reference of ``GeometricBilinear`` has to.
        reference = points[:b] if is_shared else points[:, 0]  # (b, k)
        for block in blocks:
            multivectors, scalars = block(multivectors, scalars, reference)
        # Only CLS is read, so the final block computes CLS alone, eq. (8).
        multivectors, scalars = final.look(multivectors, scalars, count)
        multivectors = multivectors.reshape(b, 1, *multivectors.shape[-2:])  # (b, 1, channels, k)
        scalars = scalars.reshape(b, 1, scalars.shape[-1])
        multivectors, scalars = final.transform(multivectors, scalars, reference)
        multivectors, scalars = self.last(multivectors, scalars)  # (b, 1, 1, k), (b, 1, 2)
        read = torch.cat((multivectors.flatten(1), scalars.flatten(1)), -1)  # (b, k + 2)
        no_gaussians = means.new_zeros(means.shape[1], 0)
        no_transmitters = query.transmitters.new_zeros(b, 0)
        return Tokens(self.read_out(read), no_gaussians, no_transmitters)

    def _tokens(
        self,
        query: Query,
        transmitters: Float[Tensor, "b 3"],
        anchors: Float[Tensor, "sets m 3"],
        is_shared: bool,
    ) -> tuple[Float[Tensor, "*b tokens 3"], Float[Tensor, "*b tokens d"]]:
        """Points and type scalars of the tokens: transmitter, CLS and anchors, in this order.

        Args:
            query: The links.
            transmitters, anchors: Positions relative to the box, of order one.
            is_shared: True if links share CLS and anchors. The tokens are then (b + 1 + m),
                otherwise (b, 2 + m).
        """
        b, m = len(query), anchors.shape[1]
        cls, transmitter, anchor = self.types.split(1)  # (1, 2) each
        if is_shared:
            types = torch.cat((transmitter.expand(b, 2), cls, anchor.expand(m, 2)))
            return torch.cat((transmitters, self.cls[None], anchors[0])), types
        points = (transmitters[:, None], self.cls.expand(b, 1, 3), anchors.expand(b, m, 3))
        types = torch.cat((transmitter, cls, anchor.expand(m, 2))).expand(b, -1, 2)
        if self.scene.has_band:
            band = self.scene.band_positions(query)[:, None, None]  # (b, 1, 1)
            types = torch.cat((types, band.expand(b, 2 + m, 1)), -1)  # (b, 2 + m, 3)
        return torch.cat(points, 1), types
