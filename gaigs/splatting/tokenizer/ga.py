"""A scene token by geometric-algebra attention between the transmitter and the most opaque
Gaussians.
"""

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

ALGEBRAS = {"projective": (PROJECTIVE, embed_point), "spacetime": (SPACETIME, embed_event)}


@register("tokenizer", "ga")
class GATokenizer(nn.Module):
    """CLS of a Geometric Algebra Transformer (GATr) over CLS, the transmitter and anchors; no
    position embeddings.

    Tokens are [CLS, TX, anchors]: CLS is a learnable point; anchors are the centres of the most
    opaque Gaussians, chosen at every call, without a gradient. Each is a multivector with two
    scalars for its type; for data with several carriers a third scalar has the carrier's position
    in the band.

    Positions are relative to the middle of the box around transmitters and receivers, and divided
    by half its longest edge, so that they are of order one and motions remain motions.

    Args:
        scene: Its box and receivers set that middle and scale.
        anchors: Number of anchors, at most all Gaussians; the paper's M, 16 as released.
        blocks: GATr blocks; one as released.
        multivectors: Multivector channels within the blocks, even and a multiple of ``heads``; 16
            as released.
        scalars: Scalar channels within the blocks, a multiple of ``heads``; 4 as released.
        heads: Attention heads of a block; ours.
        width: Width of the scene token; 16 as released.
        algebra: ``projective``, G(3,0,1) with rotations, translations and mirrors (GATr's); or
            ``spacetime``, G(3,1,0) with rotations, boosts and mirrors about the middle (the paper's
            preliminaries), whose points are events at time zero.

    Source: GAI-GS, "Multi-view Tokenizer"; Brehmer et al., Geometric Algebra Transformer, 2023.
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
        if algebra not in ALGEBRAS:
            raise ValueError(
                f"tokenizer option algebra must be one of {', '.join(ALGEBRAS)}, got {algebra!r}"
            )
        counts = {
            "anchors": anchors,
            "blocks": blocks,
            "scalars": scalars,
            "heads": heads,
            "width": width,
        }
        for option, count in (counts | {"multivectors": multivectors}).items():
            if count < 1:
                raise ValueError(f"tokenizer option {option} must be at least 1, got {count}")
        lower, upper = scene.box
        scale = (upper - lower).max() / 2
        if not scale > 0:
            raise ValueError(
                f"transmitters and receivers must not all be at one point, got {lower.tolist()}"
            )
        self.register_buffer("middle", (lower + upper) / 2)
        self.register_buffer("scale", scale)
        self.anchors = anchors
        self.scene_width = width
        self.algebra, self.embed = ALGEBRAS[algebra]
        self.cls = nn.Parameter(torch.zeros(3))
        self.types = nn.Parameter(torch.randn(3, 2))
        self.scene = scene
        self.first = EquivariantLinear(
            self.algebra, (1, multivectors), (2 + scene.has_band, scalars)
        )
        self.blocks = nn.ModuleList(
            GATrBlock(self.algebra, multivectors, scalars, heads) for _ in range(blocks)
        )
        self.last = EquivariantLinear(self.algebra, (multivectors, 1), (scalars, 2))
        self.read_out = nn.Linear(self.algebra.size + 2, width)

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        """CLS for every query; of the opacities only the order matters."""
        means, transmitters = placed.means.detach(), query.transmitters
        b, m = len(query), min(self.anchors, means.shape[1])
        anchors = means[:, opacities.topk(m).indices]
        tx, anchors = (
            (positions - self.middle) / self.scale for positions in (transmitters, anchors)
        )
        parts = [self.cls.expand(b, 1, 3), tx[:, None]]
        *blocks, final = self.blocks
        # With a single block anchors stay the same for all queries: their outputs are not read.
        alike = len(anchors) == 1 and not blocks and not self.scene.has_band
        if not alike:
            parts.append(anchors.expand(b, m, 3))
        tokens = torch.cat(parts, 1)
        groups = (b, tokens.shape[1])
        types = torch.cat((self.types[:2], self.types[2:].expand(m, 2)))
        types = types[: groups[1]].expand(*groups, 2).flatten(0, 1)
        tokens = tokens.flatten(0, 1)
        if alike:
            tokens, types = (
                torch.cat((tokens, anchors[0])),
                torch.cat((types, self.types[2:].expand(m, 2))),
            )
        if self.scene.has_band:
            band = self.scene.band_positions(query).repeat_interleave(groups[1])
            types = torch.cat((types, band[:, None]), 1)

        points = self.embed(tokens)
        multivectors, scalars = self.first(points[:, None], types)
        reference = points[: b * groups[1]].unflatten(0, groups)[
            :, 1
        ]  # the transmitter moves with the room
        if blocks:
            multivectors, scalars = multivectors.unflatten(0, groups), scalars.unflatten(0, groups)
            for block in blocks:
                multivectors, scalars = block(multivectors, scalars, reference)
            multivectors, scalars = multivectors.flatten(0, 1), scalars.flatten(0, 1)
        # Only CLS is read, so the final block computes CLS alone.
        multivectors, scalars = final.transform(
            *final.look(multivectors, scalars, groups), reference
        )
        multivectors, scalars = self.last(multivectors, scalars)
        scene = self.read_out(torch.cat((multivectors.flatten(1), scalars.flatten(1)), -1))
        return Tokens(scene, means.new_zeros(means.shape[1], 0), transmitters.new_zeros(b, 0))
