"""Obstacles: Gaussians of matter in the room that attenuate paths."""

import math

import torch
from jaxtyping import Float, Inexact
from torch import Tensor, nn


class Obstacles(nn.Module):
    """Gaussians of matter: along a segment the field is multiplied by exp(-depth).

    depth = sum_i rho_i integral exp(-|S_i^-1 (x - c_i)|² / 2) dx along the segment, S_i =
    diag(widths), a closed form: with the ray a + t (b - a) in units of the widths, A = |ray|², B =
    ray . offset, C = |offset|²,

        depth = rho length sqrt(pi / (2 A)) exp(-(C - B²/A) / 2) (erf((A + B) / sqrt(2 A)) - erf(B /
        sqrt(2 A)))

    Matter also slows waves. With ``has_phases`` each obstacle has a learnt ratio of phase lag to
    attenuation, its turn at all frequencies, and the depth is complex. ``lower`` and ``upper`` are
    corners of the box around transmitters and receivers [m].

    Source: Wilson and Patwari, Radio Tomographic Imaging, 2010, for the idea.
    """

    origin: Tensor
    unit: Tensor

    def __init__(
        self,
        count: int,
        lower: Float[Tensor, "3"],
        upper: Float[Tensor, "3"],
        has_phases: bool = False,
    ):
        super().__init__()
        edges = upper - lower
        diagonal = float(edges.norm())
        low, high = lower - 0.05 * edges, upper + 0.05 * edges
        self.register_buffer("origin", (low + high) / 2)
        self.register_buffer(
            "unit", torch.tensor(diagonal * 0.12)
        )  # so that learning rates suit rooms of any size
        self.places = nn.Parameter((torch.rand(count, 3) - 0.5) * (high - low) / self.unit)
        # As large as furniture; a path through one is attenuated by a fraction of a decibel.
        self.log_widths = nn.Parameter(torch.full((count, 3), math.log(0.05 * diagonal)))
        self.log_densities = nn.Parameter(torch.full((count,), math.log(0.8 / diagonal)))
        self.turns = nn.Parameter(torch.zeros(count)) if has_phases else None

    def __len__(self) -> int:
        return len(self.places)

    @property
    def centres(self) -> Float[Tensor, "k 3"]:
        return self.origin + self.unit * self.places

    @property
    def widths(self) -> Float[Tensor, "k 3"]:
        """Standard deviations along the world's axes [m]."""
        return self.log_widths.exp()

    @property
    def densities(self) -> Float[Tensor, " k"]:
        """At the centres [Np/m]."""
        return self.log_densities.exp()

    def forward(
        self, start: Float[Tensor, "*batch 3"], end: Float[Tensor, "*batch 3"]
    ) -> Inexact[Tensor, "*batch"]:
        """Optical depth along segments [Np]; with phases their lag is the imaginary part [rad]."""
        legs = start.reshape(-1, 3), end.reshape(-1, 3)
        size = max(1, PAIRS // len(self)) if start.device.type == "cpu" else len(legs[0]) or 1
        columns = (
            [self.densities]
            if self.turns is None
            else [self.densities, self.densities * self.turns]
        )
        own = self.centres, self.log_widths, torch.stack(columns, 1)
        parts = [
            _Depth.apply(*part, *own)
            for part in zip(*(ends.split(size) for ends in legs), strict=True)
        ]
        depths = torch.cat(parts)
        return (depths[:, 0] if self.turns is None else torch.view_as_complex(depths)).view(
            start.shape[:-1]
        )


PAIRS = 2**16
"""Pairs of a segment and an obstacle at a time: a CPU keeps them in its cache, and asks for no
fresh memory.
"""


class _Depth(torch.autograd.Function):
    """The depth with its gradient in closed form, in half of autograd's time.

    With r = sqrt(1 / (2 A)), g = exp(-(C - B²/A) / 2), E = erf((A + B) r) - erf(B r), depth = rho l
    sqrt(pi) r g E, and d E = 2 / sqrt(pi) (e1 d((A + B) r) - e0 d(B r)) with e1 = exp(-((A + B)
    r)²), e0 = exp(-(B r)²).
    """

    @staticmethod
    def forward(ctx, start, end, centres, log_widths, densities):
        parts = *_, r, near, inside, length = _parts(start, end, centres, log_widths)
        each = near * inside * r
        ctx.save_for_backward(start, end, centres, log_widths, densities, *parts)
        return (each @ densities) * (math.sqrt(math.pi) * length)[:, None]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        start, end, centres, log_widths, densities, a, b, r, near, inside, length = (
            ctx.saved_tensors
        )
        gradient = gradient * (math.sqrt(math.pi) * length)[:, None]
        # In place where it can be: fresh memory costs more than the sums.
        rate = near * r  # of E
        each = rate * inside
        d_densities = each.T @ gradient
        weights = gradient @ densities.T
        rate.mul_(weights)
        each.mul_(weights)
        slope = rate.mul_(r).mul_(2 / math.sqrt(math.pi))
        e1 = (a + b).mul_(r).square_().neg_().clamp_min_(FAINTEST).exp_().mul_(slope)
        e0 = (b * r).square_().neg_().clamp_min_(FAINTEST).exp_().mul_(slope)
        # r = (2 A)^-1/2, so d r = -r / (2 A) dA; d of the exponent: -dC/2 + (B/A) dB - (B/A)²/2 dA.
        ratio = b / a
        d_b = (e1 - e0).addcmul_(each, ratio)
        d_a = e1.addcmul_(ratio, d_b, value=-1).addcdiv_(each, a, value=-1).mul_(0.5)
        d_c = -0.5 * each
        widths = (-2 * log_widths).exp()  # inverse squares
        ray = end - start
        # A = sum ray² w, B = sum ray (start - c) w, C = sum (start - c)² w: sums are products of
        # matrices. With the narrow one on the left they take a CPU a third to a sixth of the time.
        narrow = torch.cat((widths, centres * widths), 1).T
        rows, columns = zip(
            *((narrow @ part.T).T.split(3, 1) for part in (d_a, d_b, d_c)), strict=True
        )
        d_ray = 2 * ray * rows[0] + start * rows[1] - columns[1]
        d_offset = ray * rows[1] + 2 * (start * rows[2] - columns[2])
        unit = ray / length.clamp_min(1e-30)[:, None]  # 0 for a leg of length 0
        d_length = (each.sum(-1) / length.clamp_min(1e-30))[:, None] * unit
        d_end = d_ray + d_length
        d_start = d_offset - d_end
        by_ray, by_start, ones = (ray.T @ d_b).T, (start.T @ d_c).T, d_c.sum(0)[:, None]
        d_centres = -(by_ray + 2 * (by_start - centres * ones)) * widths
        # d log width: -2 (A's, B's and C's share of the axis)
        squares = (ray.square().T @ d_a + (ray * start).T @ d_b + start.square().T @ d_c).T
        squares = squares - by_ray * centres - 2 * centres * by_start + centres.square() * ones
        return d_start, d_end, d_centres, -2 * squares * widths, d_densities


SHORTEST = 1e-8
"""Smallest squared length of a ray [squared widths]: within 1e-4 of a width nothing changes."""

FAINTEST = -80.0
"""Smallest exponent: exp(-80) is negligible, and float32's exponential takes four times as long at
an underflow.
"""


def _parts(start, end, centres, log_widths):
    """A, B, r, g, E of each segment and obstacle (s, k), and the segments' lengths (s,)."""
    # Contiguous columns: an outer product of others takes a CPU four times as long.
    columns = lambda values: values.T.contiguous()
    ray = end - start
    inverse, places, starts, ways = (
        columns(values) for values in ((-log_widths).exp(), centres, start, ray)
    )
    # C - B²/A is the squared distance of a line from a centre: small differences of large numbers
    # unless about centres.
    offsets = [(starts[axis, :, None] - places[axis]).mul_(inverse[axis]) for axis in range(3)]
    rays = [ways[axis, :, None] * inverse[axis] for axis in range(3)]
    a = (ray.square() @ inverse.square()).clamp_min_(SHORTEST)
    b = (rays[0] * offsets[0]).addcmul_(rays[1], offsets[1]).addcmul_(rays[2], offsets[2])
    c = offsets[0].square_().addcmul_(offsets[1], offsets[1]).addcmul_(offsets[2], offsets[2])
    r = (2 * a).rsqrt_()
    near = (b * b).div_(a).sub_(c).clamp_(2 * FAINTEST, 0).div_(2).exp_()
    inside = (a + b).mul_(r).erf_().sub_((b * r).erf_())
    return a, b, r, near, inside, ray.norm(dim=-1)
