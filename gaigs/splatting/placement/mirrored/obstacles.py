"""Obstacles that attenuate paths: Gaussians of matter, and boxes."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Inexact
from torch import Tensor, nn


class Obstacles(nn.Module):
    """Obstacles as Gaussians of matter: along a segment they multiply the field by exp(-depth).

    depth = sum_i rho_i integral exp(-|S_i^-1 (x - c_i)|² / 2) dx along the segment, with S_i =
    diag(widths). For a segment from a to b, in units of the widths, let ray = b - a, offset = a -
    c, A = |ray|², B = ray . offset and C = |offset|². Then each obstacle has

        depth = rho length sqrt(pi / (2 A)) exp(-(C - B²/A) / 2) (erf((A + B) / sqrt(2 A)) - erf(B /
        sqrt(2 A)))

    Boxes have sharp edges. A box adds the same depth to all segments through it, for any length
    inside. A search finds boxes (``place_boxes``); gradient descent then trains their depths only.

    Matter also delays waves. With ``has_phases`` each obstacle has a learnt ratio of phase lag to
    attenuation, equal at all frequencies, and the depth is complex. ``lower`` and ``upper`` are
    corners of the box around transmitters and receivers [m].

    Source: Wilson and Patwari, Radio Tomographic Imaging, 2010, for the idea.
    """

    pairs = 2**16
    """Segments times obstacles at a time: a CPU keeps them in its cache, without fresh memory."""
    most_boxes = 20
    """Boxes that a checkpoint has room for."""
    origin: Tensor
    unit: Tensor
    boxes: Tensor
    box_axes: Tensor

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
        # Unit of the learnt places [m]: the same learning rate suits rooms of any size.
        self.register_buffer("unit", torch.tensor(diagonal * 0.12))
        self.places = nn.Parameter((torch.rand(count, 3) - 0.5) * (high - low) / self.unit)
        # As large as furniture; a path through one is attenuated by a fraction of a decibel.
        self.log_widths = nn.Parameter(torch.full((count, 3), math.log(0.05 * diagonal)))
        self.log_densities = nn.Parameter(torch.full((count,), math.log(0.8 / diagonal)))
        self.turns = nn.Parameter(torch.zeros(count)) if has_phases else None
        # Least and largest coordinates of boxes along the axes in the columns [m]; 0 for no box.
        self.register_buffer("boxes", torch.zeros(self.most_boxes, 2, 3))
        self.register_buffer("box_axes", torch.eye(3))
        self.box_depths = nn.Parameter(torch.zeros(self.most_boxes))  # [Np]

    def _load_from_state_dict(self, state_dict, prefix, *args):
        for name in ("boxes", "box_axes", "box_depths"):  # which older checkpoints lack
            state_dict.setdefault(prefix + name, torch.zeros_like(getattr(self, name)))
        super()._load_from_state_dict(state_dict, prefix, *args)

    @torch.no_grad()
    def place_boxes(
        self, axes: Float[Tensor, "3 3"], boxes: Float[Tensor, "k 2 3"], depths: Float[Tensor, " k"]
    ) -> None:
        """Sets boxes with their depths [Np], and resets the Gaussians to their faint densities.

        Args:
            axes: Axes of the boxes, in columns.
            boxes: Least and largest coordinates along these axes [m].
            depths: Attenuation by each box [Np].
        """
        self.box_axes.copy_(axes)
        self.boxes.zero_()
        self.boxes[: len(boxes)] = boxes
        self.box_depths[: len(boxes)] = depths
        self.log_densities.fill_(math.log(0.096 / float(self.unit)))

    def __len__(self) -> int:
        return len(self.places)

    @property
    def centres(self) -> Float[Tensor, "k 3"]:
        """Centres from the middle of the room [m]."""
        return self.origin + self.unit * self.places

    @property
    def widths(self) -> Float[Tensor, "k 3"]:
        """Standard deviations along the world's axes [m]."""
        return self.log_widths.exp()

    @property
    def densities(self) -> Float[Tensor, " k"]:
        """Attenuation at the centres [Np/m]."""
        return self.log_densities.exp()

    @property
    def used(self) -> Bool[Tensor, " k"]:
        """True for each of the k boxes that ``place_boxes`` has set."""
        return self.boxes[:, 1, 0] > self.boxes[:, 0, 0]

    @property
    def box_corners(self) -> Float[Tensor, "k 8 3"]:
        """Corners of the used boxes, from the middle of the room [m]."""
        side = torch.cartesian_prod(*[torch.arange(2, device=self.boxes.device)] * 3)  # (8, 3)
        along = self.boxes[self.used][:, side, torch.arange(3)]  # (k, 8, 3)
        return along @ self.box_axes.T

    def forward(
        self,
        start: Float[Tensor, "*batch 3"],
        end: Float[Tensor, "*batch 3"],
        counts: Bool[Tensor, "*batch k"] | None = None,
    ) -> Inexact[Tensor, "*batch"]:
        """Optical depth along segments [Np]; with phases the imaginary part is the phase lag [rad].

        Args:
            start, end: Ends of the segments [m].
            counts: True where a used box attenuates a segment; None: all boxes attenuate all.
        """
        starts = start.reshape(-1, 3)
        ends = end.reshape(-1, 3)
        size = len(starts) or 1  # segments at a time
        if start.device.type == "cpu":
            size = max(1, self.pairs // len(self))
        columns = [self.densities]
        if self.turns is not None:
            columns = [self.densities, self.densities * self.turns]
        densities = torch.stack(columns, 1)  # (obstacles, 1 or 2)
        parts = []
        for some_starts, some_ends in zip(starts.split(size), ends.split(size), strict=True):
            parts.append(
                _Depth.apply(some_starts, some_ends, self.centres, self.log_widths, densities)
            )
        depths = torch.cat(parts)  # (segments, 1 or 2)
        attenuation = depths[:, :1] + self._box_depths(starts, ends, counts)  # boxes turn no phase
        depths = torch.cat((attenuation, depths[:, 1:]), 1)
        depths = depths[:, 0] if self.turns is None else torch.view_as_complex(depths)
        return depths.view(start.shape[:-1])

    def are_outside(self, sites: Float[Tensor, "b e 3"]) -> Bool[Tensor, "b k"]:
        """True for links (b) and used boxes (k) if no end of the link is inside the box.

        ``sites`` are the e ends of each link [m]. Transmitters and receivers are in the open, so a
        box that holds one is wrong for its links.
        """
        along = (sites @ self.box_axes)[:, :, None]  # (b, e, 1, 3)
        low, high = self.boxes[self.used].unbind(1)  # (k, 3) each
        is_inside = ((along > low) & (along < high)).all(-1)  # (b, e, k)
        return ~is_inside.any(1)

    def _box_depths(
        self,
        start: Float[Tensor, "s 3"],
        end: Float[Tensor, "s 3"],
        counts: Bool[Tensor, "*batch k"] | None,
    ) -> Float[Tensor, "s 1"]:
        """Depths of segments through boxes [Np]; arguments are as for ``forward``."""
        start = start @ self.box_axes
        end = end @ self.box_axes
        depths = self.box_depths[self.used].clamp_min(0)  # boxes never amplify
        hits = depths.new_zeros(len(start), len(depths))  # 1 where a segment meets a box (s, k)
        for number, box in enumerate(self.boxes[self.used]):
            hits[:, number] = passes_box(start, end, box)
        if counts is not None:
            hits = hits * counts.flatten(0, -2)
        return (hits @ depths)[:, None]


def passes_box(
    start: Float[Tensor, "s 3"], end: Float[Tensor, "s 3"], corners: Float[Tensor, "2 3"]
) -> Bool[Tensor, " s"]:
    """True for segments through a box with edges along the axes, by the slab method.

    A box is where three slabs between opposite faces overlap. ``corners`` are its lowest and its
    highest corner [m].
    """
    ray = end - start
    inverse = 1 / torch.where(ray.abs() < 1e-9, 1e-9, ray)  # no division by 0 along a face
    # Fractions of the segment at which it crosses both faces across each axis (s, 3).
    low_faces = (corners[0] - start) * inverse
    high_faces = (corners[1] - start) * inverse
    entry = torch.minimum(low_faces, high_faces).amax(1).clamp_min(0)
    exit_ = torch.maximum(low_faces, high_faces).amin(1).clamp_max(1)
    return entry < exit_


_FAINTEST = -80.0
"""Smallest exponent: float32's exponential takes four times as long at an underflow."""


class _Depth(torch.autograd.Function):
    """Optical depth (segments, columns of densities), with a hand-written, faster gradient.

    A, B and C are the products of ``Obstacles`` for a segment and an obstacle, l is the length of
    the segment, and rho the density of the obstacle. With

        r = sqrt(1 / (2 A)), g = exp(-(C - B²/A) / 2), E = erf((A + B) r) - erf(B r)

    the depth is the sum over obstacles of rho l sqrt(pi) r g E. With e1 = exp(-((A + B) r)²) and e0
    = exp(-(B r)²)

        dE = 2 / sqrt(pi) (e1 d((A + B) r) - e0 d(B r))
    """

    @staticmethod
    def forward(ctx, start, end, centres, log_widths, densities):
        legs = _measure_legs(start, end, centres, log_widths)
        each = legs.near * legs.inside * legs.r  # r g E (segments, obstacles)
        ctx.save_for_backward(start, end, centres, log_widths, densities, *legs)
        return (each @ densities) * (math.sqrt(math.pi) * legs.length)[:, None]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        start, end, centres, log_widths, densities, *legs = ctx.saved_tensors
        a, b, r, near, inside, length = legs  # A, B, r, g and E (segments, obstacles); l
        gradient = gradient * (math.sqrt(math.pi) * length)[:, None]
        # In place where it can be: fresh memory costs more than the sums.
        rate = near * r  # r g
        each = rate * inside  # r g E
        d_densities = each.T @ gradient
        weights = gradient @ densities.T  # gradients of r g E
        rate.mul_(weights)
        each.mul_(weights)
        # e1 and e0 with their factor in the gradient.
        slope = rate.mul_(r).mul_(2 / math.sqrt(math.pi))
        e1 = (a + b).mul_(r).square_().neg_().clamp_min_(_FAINTEST).exp_().mul_(slope)
        e0 = (b * r).square_().neg_().clamp_min_(_FAINTEST).exp_().mul_(slope)
        # By the chain rule: r = (2 A)^-1/2 changes by -r / (2 A) dA, and the exponent of g by
        # -dC / 2 + (B/A) dB - (B/A)² / 2 dA.
        ratio = b / a
        d_b = (e1 - e0).addcmul_(each, ratio)
        d_a = e1.addcmul_(ratio, d_b, value=-1).addcdiv_(each, a, value=-1).mul_(0.5)
        d_c = -0.5 * each
        inverse_squares = (-2 * log_widths).exp()  # w, of the widths
        ray = end - start
        # Over the axes A = sum ray² w, B = sum ray (start - c) w, C = sum (start - c)² w. Sums over
        # obstacles, then over segments, are products of matrices. With the narrow one on the left
        # they take a CPU a third to a sixth of the time.
        narrow = torch.cat((inverse_squares, centres * inverse_squares), 1).T
        row_a, _ = (narrow @ d_a.T).T.split(3, 1)
        row_b, column_b = (narrow @ d_b.T).T.split(3, 1)
        row_c, column_c = (narrow @ d_c.T).T.split(3, 1)
        d_ray = 2 * ray * row_a + start * row_b - column_b
        d_offset = ray * row_b + 2 * (start * row_c - column_c)
        unit = ray / length.clamp_min(1e-30)[:, None]  # 0 for a leg of length 0
        d_length = (each.sum(-1) / length.clamp_min(1e-30))[:, None] * unit
        d_end = d_ray + d_length
        d_start = d_offset - d_end
        by_ray = (ray.T @ d_b).T
        by_start = (start.T @ d_c).T
        ones = d_c.sum(0)[:, None]
        d_centres = -(by_ray + 2 * (by_start - centres * ones)) * inverse_squares
        # d log width: -2 (A's, B's and C's share of the axis).
        squares = (ray.square().T @ d_a + (ray * start).T @ d_b + start.square().T @ d_c).T
        squares = squares - by_ray * centres - 2 * centres * by_start + centres.square() * ones
        return d_start, d_end, d_centres, -2 * squares * inverse_squares, d_densities


class _Legs(NamedTuple):
    """Terms of ``_Depth`` for each segment and obstacle (s, k), and lengths of segments (s,) [m].

    ``near`` is g, the value of an obstacle where the line is closest to it. ``inside`` is E, the
    part of the line's integral between the ends of the segment.
    """

    a: Tensor
    b: Tensor
    r: Tensor
    near: Tensor
    inside: Tensor
    length: Tensor


def _measure_legs(start: Tensor, end: Tensor, centres: Tensor, log_widths: Tensor) -> _Legs:
    """The terms of ``_Depth`` for segments (s, 3) and obstacles (k, 3)."""
    ray = end - start
    # A contiguous row for each axis: a CPU multiplies strided ones in four times the time.
    inverse = (-log_widths).exp().T.contiguous()
    places = centres.T.contiguous()
    starts = start.T.contiguous()
    ways = ray.T.contiguous()
    # C - B²/A, the squared distance of a line from a centre, would be a small difference of large
    # numbers if the centre were not subtracted first.
    # Both lists are in units of the widths (s, k), by axis.
    offsets = [(starts[axis, :, None] - places[axis]).mul_(inverse[axis]) for axis in range(3)]
    rays = [ways[axis, :, None] * inverse[axis] for axis in range(3)]
    # A divides, so a segment shorter than 1e-4 widths, even of length 0, counts as that long.
    a = (ray.square() @ inverse.square()).clamp_min_(1e-8)
    b = (rays[0] * offsets[0]).addcmul_(rays[1], offsets[1]).addcmul_(rays[2], offsets[2])
    c = offsets[0].square_().addcmul_(offsets[1], offsets[1]).addcmul_(offsets[2], offsets[2])
    r = (2 * a).rsqrt_()
    near = (b * b).div_(a).sub_(c).clamp_(2 * _FAINTEST, 0).div_(2).exp_()
    inside = (a + b).mul_(r).erf_().sub_((b * r).erf_())
    return _Legs(a, b, r, near, inside, ray.norm(dim=-1))
