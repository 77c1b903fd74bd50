"""The rasterizer in eager torch: any device, float32 and float64."""

import operator
from bisect import bisect_right
from typing import NamedTuple

import torch
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN, OPAQUE, STEEPEST

TILE = 16
"""Edge of a tile [pixels]."""

CHUNK, LARGE_CHUNK = 2**20, 2**24
"""(transmitter, splat, pixel) triples worked on at a time, on the CPU and on others: an array of
float32 then has 4 MiB, which a core's cache holds, or 64 MiB, since a GPU starts an operation as
slowly as it does a million triples. Some sixteen arrays live at a time."""


@register("rasterizer", "torch")
class TorchRasterizer:
    """Tiles of 16 x 16 pixels, each against the splats that reach it; the gradient is written by
    hand.

    Splats are sorted by depth once, for all transmitters. A tile keeps those whose bounding box, at
    the opacity ``ALPHA_MIN`` and over all transmitters, meets it. Tiles with lists of similar
    length are composited together, in small chunks that the backward pass computes anew: memory
    does not grow with the number of (splat, pixel) pairs.
    """

    used = "torch"

    def __call__(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> tuple[Tensor, Tensor]:
        order = torch.argsort(splats.depths, stable=True)
        order = order[splats.visible[order]]
        factors = splats.factors[:, order]
        with torch.no_grad():
            tiles = _Tiles(plane, splats.means2d[order], factors, opacities[:, order])
        own = None if attenuations is None else attenuations[:, order]
        return _Composite.apply(
            tiles, splats.means2d[order], factors, signal[:, order], opacities[:, order], own
        )


class _Tiles:
    """Which splats reach which tile, in chunks of tiles whose lists have similar lengths."""

    def __init__(self, plane: Plane, means: Tensor, factors: Tensor, opacities: Tensor):
        self.shape = plane.shape
        self.period = None
        if plane.period is not None:  # rounded to the dtype, and the remainder
            rounded = torch.tensor(plane.period, dtype=plane.u.dtype).item()
            self.period = rounded, plane.period - rounded
        self.down, self.across = (-(-edge // TILE) for edge in self.shape)
        self.u, self.v = self._cut(plane.u), self._cut(plane.v)
        self.chunks: list[tuple[Tensor, Tensor]] = []
        if not len(opacities):
            return
        # The footprint is ALPHA_MIN / a at x' C^-1 x = 2 ln(a / ALPHA_MIN): an ellipse whose box
        # has these halves. Comparisons with NaN keep the splat, so that NaN shows in the map.
        reach = (2 * (opacities / ALPHA_MIN).log().clamp_min(0)).sqrt()
        p, q, r = factors.unbind(-1)
        halves = (reach[..., None] * torch.stack((p, torch.hypot(q, r)), -1)).amax(0)
        touches = ~(opacities.amax(0) < ALPHA_MIN).expand(self.down * self.across, -1)
        for axis, (coordinate, period) in enumerate(((self.u, self.period), (self.v, None))):
            coordinate = coordinate.flatten(1)
            low, high = coordinate.amin(1, keepdim=True), coordinate.amax(1, keepdim=True)
            offset = _nearest(means[:, axis], (low + high) / 2, period).abs()
            # A few roundings' slack: splats listed needlessly are dropped pixel by pixel.
            touches = touches & ~(offset > (halves[:, axis] + (high - low) / 2) * (1 + 1e-5) + 1e-6)
        self.chunks = self._chunks(touches, len(opacities))

    def _cut(self, coordinate: Tensor) -> Tensor:
        """A plane coordinate (rows or 1, columns or 1) as tiles (t, y or 1, x or 1), filled up by
        repetition.
        """
        for axis, (size, tiles) in enumerate(
            zip(self.shape, (self.down, self.across), strict=True)
        ):
            if coordinate.shape[axis] == size:
                filled = torch.arange(tiles * TILE, device=coordinate.device).clamp_max(size - 1)
                coordinate = coordinate.index_select(axis, filled)
        y, x = (TILE if edge > 1 else 1 for edge in coordinate.shape)
        cut = coordinate.unflatten(1, (-1, x)).unflatten(0, (-1, y)).transpose(1, 2)
        return cut.expand(self.down, self.across, y, x).reshape(-1, y, x)

    def _chunks(self, touches: Tensor, transmitters: int) -> list[tuple[Tensor, Tensor]]:
        """(tiles, splats of each (t, k) with n as the filling) a chunk, longest lists first."""
        counts = touches.sum(1)
        n = touches.shape[1]
        # Sorting the indices with "not touched" pushed behind keeps the depth order in front.
        splats = torch.where(touches, torch.arange(n, device=counts.device), n).sort(1).values
        lengths, tiles = counts.sort(descending=True)
        lengths, chunks, start = lengths.tolist(), [], 0
        triples = (CHUNK if counts.device.type == "cpu" else LARGE_CHUNK) // (
            transmitters * TILE * TILE
        )
        while start < len(lengths) and lengths[start]:
            shortest = bisect_right(
                lengths, -lengths[start] / 2, key=operator.neg
            )  # fillings at most double the work
            size = min(max(1, triples // lengths[start]), shortest - start)
            chosen = tiles[start : start + size]
            chunks.append((chosen, splats[chosen, : lengths[start]]))
            start += size
        return chunks

    def join(self, tiled: Tensor) -> Tensor:
        """Tiles (..., t, y x) as an image (..., rows, columns)."""
        image = tiled.unflatten(-1, (TILE, TILE)).unflatten(-3, (self.down, self.across))
        return (
            image.transpose(-3, -2)
            .flatten(-4, -3)
            .flatten(-2)[..., : self.shape[0], : self.shape[1]]
        )

    def split(self, image: Tensor) -> Tensor:
        """The inverse of ``join``; pixels outside the image are 0."""
        rows, columns = self.shape
        image = torch.nn.functional.pad(
            image, (0, self.across * TILE - columns, 0, self.down * TILE - rows)
        )
        tiled = (
            image.unflatten(-1, (self.across, TILE))
            .unflatten(-3, (self.down, TILE))
            .transpose(-3, -2)
        )
        return tiled.flatten(-2).flatten(-3, -2)


def _nearest(a: Tensor, b: Tensor, period: tuple[float, float] | None) -> Tensor:
    """a - b taken to the nearest image, by a rounded period and its remainder.

    The period is subtracted from the exact a - b = offset + rest (Knuth's two-sum), so no digit is
    lost at the seam.
    """
    offset = a - b
    if period is None:
        return offset
    back = offset - a
    rest = (a - (offset - back)) - (b + back)
    turns = (offset / period[0]).round_()
    return (offset - turns * period[0]) + (rest - turns * period[1])


class _Weights(NamedTuple):
    """One chunk composited: all is (b, t, k, y x) but ``left`` (b, t, y x), and ``s`` and ``y`` of
    ``_weigh``.
    """

    s: Tensor
    y: Tensor
    footprint: Tensor
    alpha: Tensor
    live: Tensor
    transmittance: Tensor
    left: Tensor


def _weigh(
    tiles: _Tiles,
    chosen: Tensor,
    k: Tensor,
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    logs: Tensor | None,
) -> _Weights:
    """Footprints, opacities and transmittances of one chunk: tiles ``chosen`` (t,) and their splats
    (t, k).
    """
    u, v = means[k][..., None, None].unbind(-3)
    du = _nearest(tiles.u[chosen][:, None], u, tiles.period)
    dv = tiles.v[chosen][:, None] - v
    p, q, r = (part[..., None, None] for part in factors[:, k].unbind(-1))
    # With (s, y) = L^-1 (du, dv) the exponent loses the fewest digits where a splat is long and
    # thin.
    s = du / p
    y = dv / r - (q / r) * s
    exponent = torch.addcmul(-0.5 * s * s, y, y, value=-0.5)
    footprint = exponent.exp_().flatten(-2)
    alpha = footprint * opacities[:, k, None]
    live = alpha >= ALPHA_MIN
    alpha = alpha.clamp_max(ALPHA_MAX).mul_(live)
    passed = torch.log1p(-alpha)
    if logs is not None:
        passed.addcmul_(footprint * live, logs[:, k, None])
    total = passed.cumsum(-2)
    left = total[..., -1, :].exp()
    before = torch.nn.functional.pad(total[..., :-1, :], (0, 0, 1, 0))
    return _Weights(s, y, footprint, alpha, live, before.exp_(), left)


class _Composite(torch.autograd.Function):
    """Composites sorted splats. Below, D_i = signal_i . gradient and S_i = sum_{j>i} D_j A_j T_j +
    left gradient_left: d/dA_i = T_i D_i - S_i / (1 - A_i), and a change of log T behind splat i
    acts with S_i."""

    @staticmethod
    def forward(ctx, tiles, means, factors, signal, opacities, attenuations):
        ctx.tiles = tiles
        logs = (
            None
            if attenuations is None
            else torch.where(attenuations == 0, OPAQUE, attenuations.log())
        )
        ctx.save_for_backward(means, factors, signal, opacities, logs)
        b, _, c = signal.shape
        image = signal.new_zeros(b, c, tiles.down * tiles.across, TILE * TILE)
        left = signal.new_ones(b, tiles.down * tiles.across, TILE * TILE)
        means, factors, signal, opacities, logs = _filled(means, factors, signal, opacities, logs)
        for chosen, k in tiles.chunks:
            w = _weigh(tiles, chosen, k, means, factors, opacities, logs)
            image[:, :, chosen] = (signal[:, k].mT @ w.transmittance.mul_(w.alpha)).transpose(1, 2)
            left[:, chosen] = w.left
        return tiles.join(image), tiles.join(left)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient, left_gradient):
        tiles = ctx.tiles
        inputs = _filled(*ctx.saved_tensors)
        means, factors, signal, opacities, logs = inputs
        gradients = [None if tensor is None else torch.zeros_like(tensor) for tensor in inputs]
        image_gradient = tiles.split(image_gradient)
        left_gradient = tiles.split(left_gradient)
        for chosen, k in tiles.chunks:
            w = _weigh(tiles, chosen, k, means, factors, opacities, logs)
            towards = image_gradient[:, :, chosen].transpose(1, 2)
            blend = w.alpha * w.transmittance
            d_signal = blend @ towards.mT
            d = signal[:, k] @ towards
            flow = blend.mul_(d)
            behind = flow.flip(-2).cumsum(-2).flip(-2).sub_(flow)
            behind += (w.left * left_gradient[:, chosen])[..., None, :]
            # Gradient by the opacity itself, 0 where the splat does nothing or is clamped.
            d_alpha = (d.mul_(w.transmittance) - behind / (1 - w.alpha)).mul_(
                w.live & (w.alpha < ALPHA_MAX)
            )
            d_opacity = (d_alpha * w.footprint).sum(-1)
            d_exponent = d_alpha.mul_(w.alpha)
            d_logs = None
            if logs is not None:
                covered = behind.mul_(w.footprint).mul_(w.live)
                d_logs = covered.sum(-1)
                d_exponent = d_exponent + covered * logs[:, k][..., None]
            d_means, d_factors = _moments(
                d_exponent.unflatten(-1, (TILE, TILE)), w.s, w.y, factors[:, k]
            )
            found = (
                d_means.sum(0),
                d_factors.sum_to_size(factors[:, k].shape),
                d_signal,
                d_opacity,
                d_logs,
            )
            for gradient, part, axis in zip(gradients, found, (0, 1, 1, 1, 1), strict=True):
                if gradient is not None:
                    gradient.index_add_(axis, k.flatten(), part.flatten(axis, axis + 1))
        if logs is not None:
            gradients[-1] /= logs.exp().clamp_min(STEEPEST)
        means, factors, *others = gradients  # the last splat is the filling
        return (
            None,
            means[:-1],
            factors[:, :-1],
            *(None if other is None else other[:, :-1] for other in others),
        )


def _filled(means, factors, signal, opacities, logs):
    """The splats and, behind them, one that does nothing: it fills the tiles' lists up."""
    pad, row = torch.nn.functional.pad, (0, 0, 0, 1)
    logs = None if logs is None else pad(logs, (0, 1))
    return (
        pad(means, row),
        pad(factors, row, value=1.0),
        pad(signal, row),
        pad(opacities, (0, 1)),
        logs,
    )


def _moments(d_exponent: Tensor, s: Tensor, y: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of centres (b, t, k, 2) and factors (b, t, k, 3) from that of the exponents (b, t,
    k, y, x).

    Sums run over s and y themselves: those over du and dv would cancel where a splat is long and
    thin.
    """
    d_y = d_exponent * y
    yy = (d_y * y).sum((-2, -1))
    if s.shape[-2] == 1:  # the same in all rows: contract the columns first
        d_s, ss = (d_exponent @ torch.cat((s, s * s), -2).mT).sum(-2).unbind(-1)
        d_y, sy = (d_y @ torch.cat((torch.ones_like(s), s), -2).mT).sum(-2).unbind(-1)
    else:
        weighed = d_exponent * s
        d_s, ss = weighed.sum((-2, -1)), (weighed * s).sum((-2, -1))
        d_y, sy = d_y.sum((-2, -1)), (d_y * s).sum((-2, -1))
    p, q, r = factors.unbind(-1)
    d_means = torch.stack(((d_s - q / r * d_y) / p, d_y / r), -1)
    return d_means, torch.stack(((ss - q / r * sy) / p, sy / r, yy / r), -1)
