"""What rasterizers are held against: the formula over all pairs in float64, on all pixels or on a band of columns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from gaigs.benchmark._scenes import ApertureScene, MapScene, Scene, cast, with_leaves
from gaigs.projection import Plane
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN
from gaigs.testing._aperture import sum_fields
from gaigs.testing.rasterizer import footprints_of, rasterize_densely

STOP = 1e-4
"""Transmittance below which the rasterizer of 3D Gaussian Splatting (Kerbl et al., 2023) stops at a pixel."""

MOST, AT_A_TIME = 4e7, 1e6
"""Most pairs of the dense sum, and of a part of it that is in memory at a time."""

NARROWEST = 8
"""Columns that a structural similarity with a window of seven pixels needs at least."""


@dataclass(frozen=True)
class Truth:
    """What a scene gives in float64.

    Attributes:
        outputs: Map and transmittance (b, c + 1, rows, columns of the band), or fields (b, e).
        gradients: Of the sum of the outputs, over ``clear`` pixels where they are maps, by each leaf of the scene.
        band: Columns of the map that were summed densely.
        clear: Pixels (b, rows, columns of the band) where no pair is within 1e-4 of a bound, so that rounding decides
            nothing.
        pairs: Pairs of a splat and a pixel, or an element, and a transmitter that act; where the band is not the whole
            map, those of the band times the share of the map.
        live: Those of them in front of which the transmittance is at least ``STOP``.
    """

    outputs: Tensor
    gradients: list[Tensor]
    band: slice
    clear: Tensor
    pairs: int
    live: int

    @property
    def checked(self) -> int:
        """Pixels of the band, or elements."""
        return math.prod(self.outputs.shape[2:]) if self.outputs.ndim == 4 else self.outputs.shape[1]


def sum_densely(scene: Scene, device: str) -> Truth:
    """The truth of a scene."""
    scene = with_leaves(cast(scene, device, torch.float64))
    return _aperture(scene) if isinstance(scene, ApertureScene) else _map(scene)


def _aperture(scene: ApertureScene) -> Truth:
    heard = sum_fields(*scene)[..., 0]
    (heard.real.sum() + heard.imag.sum()).backward()
    pairs = scene.amplitudes.numel() * len(scene.array)
    gradients = [leaf.grad for leaf in scene.leaves()]
    return Truth(heard.detach(), gradients, slice(None), torch.ones(()), pairs, pairs)


def _map(scene: MapScene) -> Truth:
    splats, signal, opacities, attenuations, plane = scene
    (b, n, channels), (rows, columns) = signal.shape, plane.shape
    width = min(columns, max(NARROWEST, int(MOST / (b * n * rows))))
    begin = (columns - width) // 2
    band = slice(begin, begin + width)
    u, v = (part.expand(rows, columns)[:, band].reshape(1, -1) for part in (plane.u, plane.v))
    outputs, clear, pairs, live = [], [], 0, 0
    for k in torch.arange(rows * width).split(max(1, int(AT_A_TIME / (b * n)))):
        rays = Plane(u[:, k], v[:, k], plane.period)
        with torch.no_grad():
            order, shape = footprints_of(splats, rays)
            product = opacities[:, order, None, None] * shape
            acts = product >= ALPHA_MIN
            near = [((product / bound - 1).abs() > 1e-4).all(1) for bound in (ALPHA_MIN, ALPHA_MAX)]
            clear.append(near[0] & near[1])
            passed = torch.where(acts, 1 - product.clamp_max(ALPHA_MAX), 1)
            if attenuations is not None:
                passed = torch.where(acts, passed * attenuations[:, order, None, None] ** shape, 1)
            before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1].cumprod(1)), 1)
            pairs, live = pairs + int(acts.sum()), live + int((acts & (before >= STOP)).sum())
        image, left = rasterize_densely(*scene[:4], rays)
        whole = torch.cat((image, left[:, None]), 1)
        (whole * clear[-1][:, None]).sum().backward()
        outputs.append(whole.detach())
    outputs = torch.cat(outputs, -1).reshape(b, channels + 1, rows, width)
    share = columns / width
    gradients = [leaf.grad for leaf in scene.leaves()]
    shown = torch.cat(clear, -1).reshape(b, rows, width)
    return Truth(outputs, gradients, band, shown, round(pairs * share), round(live * share))


def errors_of(found: Tensor, truth: Truth) -> tuple[float, float]:
    """The largest and the mean deviation of outputs, relative to the largest value of the map or the fields."""
    if found.ndim == 4:
        found = found[..., truth.band]
    deviation = (found - truth.outputs).abs()
    values = truth.outputs
    if found.ndim == 4:
        deviation, values = deviation[:, :-1], values[:, :-1]
        deviation = deviation * truth.clear[:, None]
    largest = values.abs().max()
    return float(deviation.max() / largest), float(deviation.mean() / largest)


def errors_of_gradients(found: Sequence[Tensor], truth: Truth) -> tuple[float, float]:
    """The same of the gradients, each relative to its own largest value; the worst of them."""
    largest = [true.abs().max() for true in truth.gradients]
    deviations = [(own - true).abs() for own, true in zip(found, truth.gradients, strict=True)]
    pairs = [*zip(deviations, largest, strict=True)]
    return max(float(d.max() / size) for d, size in pairs), max(float(d.mean() / size) for d, size in pairs)


def pooled(outputs: Tensor, shape: tuple[int, int], band: slice) -> np.ndarray:
    """Spectra (b, rows, columns): of maps the amplitude of the first two channels as a complex number, of fields that
    of the conventional beamformer over a square of direction cosines."""
    if outputs.ndim == 4:
        real, imaginary = outputs[:, 0, :, band], outputs[:, 1, :, band]
        return torch.hypot(real.double(), imaginary.double()).cpu().numpy()
    rows, columns = shape
    across, along = torch.linspace(-0.7, 0.7, columns).double(), torch.linspace(-0.7, 0.7, rows).double()
    edge = math.isqrt(outputs.shape[1])
    places = (torch.arange(edge).double() - (edge - 1) / 2) / 2  # in wavelengths
    x, y = places.repeat_interleave(edge), places.repeat(edge)
    phases = -2 * math.pi * (along[:, None, None] * y + across[None, :, None] * x)
    beams = torch.polar(torch.ones_like(phases), phases)
    return torch.einsum("rce,be->brc", beams, outputs.cpu().to(beams)).abs().numpy()


def errors_of_pooled(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Mean SSIM of spectra, scaled by the true one's largest value; mean error of their power [dB], without sign."""
    scores, levels = [], []
    for own, other in zip(found, true, strict=True):
        size = other.max()
        scores.append(structural_similarity(other / size, own / size, data_range=1.0))
        levels.append(abs(10 * math.log10(np.square(own).mean() / np.square(other).mean())))
    return float(np.mean(scores)), float(np.mean(levels))
