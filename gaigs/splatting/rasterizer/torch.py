"""The rasterizer in eager torch: any device, float32 and float64."""

import math
import operator
from bisect import bisect_right
from typing import NamedTuple

import torch
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN, OPAQUE, STEEPEST


@register("rasterizer", "torch")
class TorchRasterizer:
    """A rasterizer by tiles of 16 x 16 pixels, each drawn from the splats that reach it.

    Splats are sorted by depth once, for all transmitters. The list of a tile has the splats whose
    bounding box meets it, at the opacity ``ALPHA_MIN`` and for any transmitter. Tiles with lists of
    similar length are composited together, in small chunks. The backward pass, written by hand,
    recomputes chunks, so memory does not grow with the number of (splat, pixel) pairs.

    Attributes:
        chunk: (transmitter, splat, pixel) triples processed at a time on the CPU. A float32 array
            of them has 4 MiB, which fits a core's cache. About sixteen arrays exist at a time.
        large_chunk: Triples on other devices, 64 MiB: a GPU starts an operation in the time of
            computing a million triples.

    Source: tiles of Kerbl et al., 3D Gaussian Splatting, 2023, section 6; GAI-GS, "Projection and
    Render Module", eq. (13) and (14).
    """

    used = "torch"
    chunk = 2**20
    large_chunk = 2**24

    def __call__(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> tuple[Tensor, Tensor]:
        # "Primitives are sorted in depth to preserve physically consistent signal accumulation."
        order = torch.argsort(splats.depths, stable=True)
        order = order[splats.visible[order]]
        means = splats.means2d[order]  # (n, 2)
        factors = splats.factors[:, order]  # (1 or b, n, 3)
        opacities = opacities[:, order]  # (b, n)
        triples = self.chunk if means.device.type == "cpu" else self.large_chunk
        with torch.no_grad():
            tiles = _Tiles(plane, means, factors, opacities, triples)
        transmitted = None if attenuations is None else attenuations[:, order]
        return _Composite.apply(tiles, means, factors, signal[:, order], opacities, transmitted)


class _Period(NamedTuple):
    """A period as the sum of two floats, for exact subtraction."""

    rounded: float  # the nearest number of the tensors' dtype
    rest: float  # what the rounding leaves


class _Tiles:
    """Tiles of a plane, with the list of the splats that reach each tile.

    Tiles with lists of similar lengths are in one chunk.

    Args:
        plane: The pixels.
        means, factors, opacities: Splats front to back.
        triples: Number of (transmitter, splat, pixel) triples of a chunk.

    Attributes:
        edge: Edge of a tile [pixels].
        u, v: Coordinates of the tiles' pixels (t, y or 1, x or 1).
        chunks: For each chunk the numbers of its tiles (t,), and of their splats (t, k). Shorter
            lists of splats are padded with n, the number of a splat without effect.
    """

    edge = 16

    def __init__(
        self, plane: Plane, means: Tensor, factors: Tensor, opacities: Tensor, triples: int
    ):
        self.shape = plane.shape
        self.period = None
        if plane.period is not None:
            rounded = torch.tensor(plane.period, dtype=plane.u.dtype).item()
            self.period = _Period(rounded, plane.period - rounded)
        self.down, self.across = (math.ceil(size / self.edge) for size in self.shape)
        self.u = self._cut(plane.u)
        self.v = self._cut(plane.v)
        self.chunks: list[tuple[Tensor, Tensor]] = []
        if len(opacities):
            touches = self._find_touched(means, factors, opacities)
            self.chunks = self._chunks(touches, triples // (len(opacities) * self.edge**2))

    def _find_touched(self, means: Tensor, factors: Tensor, opacities: Tensor) -> Tensor:
        """True where a splat reaches a tile (tiles, n).

        NaN also gives True, so that the fault shows in the map.
        """
        # A splat of opacity a falls to ALPHA_MIN on the ellipse x' C^-1 x = reach². Half the edges
        # of its bounding box are reach sqrt(diag C), with C = F F' and F = [[p, 0], [q, r]].
        reach = (2 * (opacities / ALPHA_MIN).log().clamp_min(0)).sqrt()  # (b, n)
        p, q, r = factors.unbind(-1)
        boxes = torch.stack((p, torch.hypot(q, r)), -1)  # (1 or b, n, 2)
        halves = (reach[..., None] * boxes).amax(0)  # (n, 2)
        touches = ~(opacities.amax(0) < ALPHA_MIN).expand(self.down * self.across, -1)
        axes = ((self.u, self.period), (self.v, None))
        for axis, (coordinate, period) in enumerate(axes):
            coordinate = coordinate.flatten(1)  # (tiles, pixels)
            low = coordinate.amin(1, keepdim=True)  # (tiles, 1)
            high = coordinate.amax(1, keepdim=True)
            offset = _nearest(means[:, axis], (low + high) / 2, period).abs()  # (tiles, n)
            # A few roundings' slack: splats listed needlessly are dropped pixel by pixel.
            most = (halves[:, axis] + (high - low) / 2) * (1 + 1e-5) + 1e-6
            touches = touches & ~(offset > most)
        return touches

    def _cut(self, coordinate: Tensor) -> Tensor:
        """Cuts a plane coordinate (rows or 1, columns or 1) into tiles (t, y or 1, x or 1).

        Tiles beyond the plane's edge are padded with its last row or column.
        """
        for axis, tiles in enumerate((self.down, self.across)):
            size = self.shape[axis]
            if coordinate.shape[axis] == size:
                pixels = torch.arange(tiles * self.edge, device=coordinate.device)
                coordinate = coordinate.index_select(axis, pixels.clamp_max(size - 1))
        # An axis of length 1 stays so, since the coordinate does not depend on it.
        y, x = (self.edge if size > 1 else 1 for size in coordinate.shape)
        cut = coordinate.unflatten(1, (-1, x)).unflatten(0, (-1, y))  # (down, y, across, x)
        cut = cut.transpose(1, 2)  # (down, across, y, x)
        return cut.expand(self.down, self.across, y, x).reshape(-1, y, x)

    def _chunks(self, touches: Tensor, pairs: int) -> list[tuple[Tensor, Tensor]]:
        """``chunks``, each of about ``pairs`` (tile, splat) pairs, longest lists first.

        ``touches`` is True where a splat reaches a tile (tiles, n).
        """
        counts = touches.sum(1)  # (tiles,)
        n = touches.shape[1]
        # The numbers of the splats that touch a tile, front to back, followed by n for the others.
        splats = torch.where(touches, torch.arange(n, device=counts.device), n).sort(1).values
        sorted_counts, tiles = counts.sort(descending=True)
        lengths = sorted_counts.tolist()
        chunks = []
        start = 0
        while start < len(lengths) and lengths[start]:
            longest = lengths[start]
            # Lists down to half the longest: fillings at most double the work. Lengths descend,
            # so bisection sees their negatives.
            end = bisect_right(lengths, -longest / 2, key=operator.neg)
            size = min(max(1, pairs // longest), end - start)
            chosen = tiles[start : start + size]
            chunks.append((chosen, splats[chosen, :longest]))
            start += size
        return chunks

    def join(self, tiled: Tensor) -> Tensor:
        """Joins tiles (..., t, y x) to an image (..., rows, columns)."""
        rows, columns = self.shape
        image = tiled.unflatten(-1, (self.edge, self.edge))  # (..., t, y, x)
        image = image.unflatten(-3, (self.down, self.across))  # (..., down, across, y, x)
        image = image.transpose(-3, -2)  # (..., down, y, across, x)
        return image.flatten(-4, -3).flatten(-2)[..., :rows, :columns]

    def split(self, image: Tensor) -> Tensor:
        """Splits an image into tiles, the inverse of ``join``; pixels outside the image are 0."""
        rows, columns = self.shape
        margins = (0, self.across * self.edge - columns, 0, self.down * self.edge - rows)
        image = torch.nn.functional.pad(image, margins)
        tiled = image.unflatten(-1, (self.across, self.edge))
        tiled = tiled.unflatten(-3, (self.down, self.edge))  # (..., down, y, across, x)
        tiled = tiled.transpose(-3, -2)  # (..., down, across, y, x)
        return tiled.flatten(-2).flatten(-3, -2)


def _nearest(a: Tensor, b: Tensor, period: _Period | None) -> Tensor:
    """a - b, minus the number of whole periods that brings it nearest to 0.

    The period is subtracted from the exact a - b = offset + rest (Knuth's two-sum), so no digit is
    lost at the seam.
    """
    offset = a - b
    if period is None:
        return offset
    minus_b = offset - a  # -b as far as the rounded offset has it
    rest = (a - (offset - minus_b)) - (b + minus_b)  # errors of a and of b by this rounding
    turns = (offset / period.rounded).round_()
    return (offset - turns * period.rounded) + (rest - turns * period.rest)


class _SplatParts(NamedTuple):
    """Tensors of n splats front to back, or their gradients."""

    means: Tensor  # (n, 2)
    factors: Tensor  # (1 or b, n, 3)
    signal: Tensor  # (b, n, c)
    opacities: Tensor  # (b, n)
    logs: Tensor | None  # (b, n), logarithms of the attenuations

    @classmethod
    def filled(
        cls, means: Tensor, factors: Tensor, signal: Tensor, opacities: Tensor, logs: Tensor | None
    ) -> "_SplatParts":
        """Adds a splat without effect behind all others, which fills up the tiles' lists."""
        pad = torch.nn.functional.pad
        row = (0, 0, 0, 1)
        return cls(
            pad(means, row),
            pad(factors, row, value=1.0),
            pad(signal, row),
            pad(opacities, (0, 1)),
            None if logs is None else pad(logs, (0, 1)),
        )


class _Weights(NamedTuple):
    """Weights of splats in a chunk: b transmitters, t tiles, k splats and y x pixels a tile."""

    # (s, y) = L^-1 (du, dv), with (du, dv) from the splat's centre to the pixel and the splat's
    # factor L = [[p, 0], [q, r]] (1 or b, t, k, y or 1, x or 1).
    s: Tensor
    y: Tensor
    footprint: Tensor  # G (b, t, k, y x)
    alpha: Tensor  # A = a G within its bounds (b, t, k, y x)
    live: Tensor  # True where a splat acts (b, t, k, y x)
    transmittance: Tensor  # T, in front of each splat (b, t, k, y x)
    remaining: Tensor  # transmittance behind the last splat (b, t, y x)


def _weigh(tiles: _Tiles, chosen: Tensor, k: Tensor, inputs: _SplatParts) -> _Weights:
    """Footprints, opacities and transmittances of a chunk.

    Args:
        tiles: All tiles.
        chosen: Tiles of the chunk (t,).
        k: Splats of each tile (t, k).
        inputs: All splats.
    """
    centres = inputs.means[k][..., None, None]  # (t, k, 2, 1, 1)
    u, v = centres.unbind(-3)
    du = _nearest(tiles.u[chosen][:, None], u, tiles.period)  # (t, k, y or 1, x)
    dv = tiles.v[chosen][:, None] - v
    factors = inputs.factors[:, k, :, None, None]  # (1 or b, t, k, 3, 1, 1)
    p, q, r = factors.unbind(-3)
    # With (s, y) = L^-1 (du, dv) the exponent loses the fewest digits where a splat is long and
    # thin.
    s = du / p
    y = dv / r - (q / r) * s
    exponent = torch.addcmul(-0.5 * s * s, y, y, value=-0.5)  # -(s² + y²) / 2
    footprint = exponent.exp_().flatten(-2)  # G
    alpha = footprint * inputs.opacities[:, k, None]
    live = alpha >= ALPHA_MIN
    alpha = alpha.clamp_max(ALPHA_MAX).mul_(live)
    # eq. (13) and (14): log T_i = sum_{j<i} log(1 - A_j) + G_j log d_j.
    log_passed = torch.log1p(-alpha)  # of each splat
    if inputs.logs is not None:
        log_passed.addcmul_(footprint * live, inputs.logs[:, k, None])
    total = log_passed.cumsum(-2)  # up to and with each splat
    remaining = total[..., -1, :].exp()
    before = torch.nn.functional.pad(total[..., :-1, :], (0, 0, 1, 0))
    return _Weights(s, y, footprint, alpha, live, before.exp_(), remaining)


class _Composite(torch.autograd.Function):
    """Composites sorted splats, with a gradient written by hand.

    Let R be the transmittance behind all splats, D_i = signal_i . image gradient and S_i =
    sum_{j>i} D_j A_j T_j + R (gradient of R). A_i and T_i are as in ``Rasterizer``. The derivative
    of the loss by A_i is T_i D_i - S_i / (1 - A_i). The derivative by log T behind splat i is S_i.
    """

    @staticmethod
    def forward(ctx, tiles, means, factors, signal, opacities, attenuations):
        ctx.tiles = tiles
        logs = None
        if attenuations is not None:
            logs = torch.where(attenuations == 0, OPAQUE, attenuations.log())
        ctx.save_for_backward(means, factors, signal, opacities, logs)
        b, _, c = signal.shape
        count, pixels = tiles.down * tiles.across, tiles.edge**2
        image = signal.new_zeros(b, c, count, pixels)
        remaining = signal.new_ones(b, count, pixels)
        inputs = _SplatParts.filled(means, factors, signal, opacities, logs)
        for chosen, k in tiles.chunks:
            w = _weigh(tiles, chosen, k, inputs)
            # eq. (14): the sum of signal_i A_i T_i over the splats.
            drawn = inputs.signal[:, k].mT @ w.transmittance.mul_(w.alpha)  # (b, t, c, y x)
            image[:, :, chosen] = drawn.transpose(1, 2)
            remaining[:, chosen] = w.remaining
        return tiles.join(image), tiles.join(remaining)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient, remaining_gradient):
        tiles = ctx.tiles
        inputs = _SplatParts.filled(*ctx.saved_tensors)
        gradients = [None if tensor is None else torch.zeros_like(tensor) for tensor in inputs]
        image_gradient = tiles.split(image_gradient)  # (b, c, t, y x)
        remaining_gradient = tiles.split(remaining_gradient)  # (b, t, y x)
        for chosen, k in tiles.chunks:
            w = _weigh(tiles, chosen, k, inputs)
            towards = image_gradient[:, :, chosen].transpose(1, 2)  # (b, t, c, y x)
            parts = _differentiate(w, k, inputs, towards, remaining_gradient[:, chosen], tiles.edge)
            # A splat may be in several tiles. Centres have no axis of transmitters.
            for gradient, part, axis in zip(gradients, parts, (0, 1, 1, 1, 1), strict=True):
                if gradient is not None:
                    gradient.index_add_(axis, k.flatten(), part.flatten(axis, axis + 1))
        if inputs.logs is not None:
            # The inputs are logarithms of attenuations a: d / d log a = a d / da. STEEPEST keeps
            # the gradient finite at a = 0.
            gradients[-1] /= inputs.logs.exp().clamp_min(STEEPEST)
        # The last splat fills the lists of tiles, and is no input.
        means, *others = gradients
        return (
            None,
            means[:-1],
            *(None if other is None else other[:, :-1] for other in others),
        )


def _differentiate(
    w: _Weights,  # the chunk composited; used up
    k: Tensor,  # splats of each tile (t, k)
    inputs: _SplatParts,  # all splats
    towards: Tensor,  # gradient of the map's pixels (b, t, c, y x)
    remaining_gradient: Tensor,  # gradient of the remaining transmittance (b, t, y x)
    edge: int,  # edge of a tile [pixels]
) -> _SplatParts:
    """Gradients of a chunk's splats (t, k)."""
    blend = w.alpha * w.transmittance  # A T
    d_signal = blend @ towards.mT  # (b, t, k, c)
    d = inputs.signal[:, k] @ towards  # D, (b, t, k, y x)
    drawn = blend.mul_(d)  # D A T
    behind = drawn.flip(-2).cumsum(-2).flip(-2).sub_(drawn)  # sums over the splats behind
    behind += (w.remaining * remaining_gradient)[..., None, :]  # S
    # Gradient by the opacity itself, 0 where the splat does nothing or is clamped.
    d_alpha = d.mul_(w.transmittance) - behind / (1 - w.alpha)
    d_alpha = d_alpha.mul_(w.live & (w.alpha < ALPHA_MAX))
    d_opacity = (d_alpha * w.footprint).sum(-1)  # (b, t, k)
    d_exponent = d_alpha.mul_(w.alpha)
    d_logs = None
    if inputs.logs is not None:
        # log T behind a splat has the term G log d.
        d_log = behind.mul_(w.footprint).mul_(w.live)  # S G
        d_logs = d_log.sum(-1)  # (b, t, k)
        d_exponent = d_exponent + d_log * inputs.logs[:, k][..., None]
    factors = inputs.factors[:, k]
    d_exponent = d_exponent.unflatten(-1, (edge, edge))  # (b, t, k, y, x)
    d_means, d_factors = _moments(d_exponent, w.s, w.y, factors)
    d_factors = d_factors.sum_to_size(factors.shape)
    return _SplatParts(d_means.sum(0), d_factors, d_signal, d_opacity, d_logs)


def _moments(d_exponent: Tensor, s: Tensor, y: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of centres (b, t, k, 2) and factors (b, t, k, 3) from the exponents' gradients.

    Sums over pixels run over s and y, as the exponent is -(s² + y²) / 2. Sums over du and dv would
    cancel for a long, thin splat.

    Args:
        d_exponent: Gradients of the exponents (b, t, k, y, x).
        s, y: As in ``_Weights``.
        factors: Factors of the covariances (1 or b, t, k, 3).
    """
    d_y = d_exponent * y
    yy = (d_y * y).sum((-2, -1))  # (b, t, k)
    # Sums over the pixels of g s, g s², g y s and g y, with g the gradients (b, t, k).
    if s.shape[-2] == 1:  # the same in all rows: contract the columns first
        powers = torch.cat((s, s * s), -2).mT  # (1 or b, t, k, x, 2)
        d_s, ss = (d_exponent @ powers).sum(-2).unbind(-1)
        powers = torch.cat((torch.ones_like(s), s), -2).mT
        d_y, sy = (d_y @ powers).sum(-2).unbind(-1)
    else:
        weighed = d_exponent * s
        d_s = weighed.sum((-2, -1))
        ss = (weighed * s).sum((-2, -1))
        sy = (d_y * s).sum((-2, -1))
        d_y = d_y.sum((-2, -1))
    p, q, r = factors.unbind(-1)
    d_means = torch.stack(((d_s - q / r * d_y) / p, d_y / r), -1)
    d_factors = torch.stack(((ss - q / r * sy) / p, sy / r, yy / r), -1)
    return d_means, d_factors
