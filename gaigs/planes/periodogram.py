"""The periodogram of a further reflection over the offset and two tilts of its plane."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn import functional

from gaigs.core.geometry import sinc
from gaigs.planes.frame import mean_bounces
from gaigs.planes.lags import FurtherWave, ReceiverLags
from gaigs.splatting.placement.mirrored.reflections import reflect, tangents


class WaveProducts(NamedTuple):
    """Products of the reflections at c planes with a further wave, at b links."""

    values: Complex[Tensor, "c b"]  # products of both waves, of about the same size at all links
    # Change of their phases if the plane moves [rad/m], or turns about its pivot towards two axes
    # [1].
    rates: Float[Tensor, "c b 3"]


class TilePeak(NamedTuple):
    """Maximum of a periodogram."""

    height: float
    plane: Float[Tensor, "4"]  # normal and offset [m]
    pivot: Float[Tensor, "3"]  # point about which the plane turns [m]


class PlanePeriodogram:
    """Search near a known plane for the plane whose reflections best match a further wave.

    The further wave is the wave by which one more path lowers the error most (``FurtherWave``). The
    phase of a reflection follows from the path's length. Within a small range of offsets and tilts,
    a tile, lengths are nearly linear. The match, summed over links, is then a Fourier sum.

    Args:
        receivers: Training links.
        wavelength: Shortest wavelength of the links [m].
        diagonal: Diagonal of the room [m].
        reach: Largest distance by which a plane is moved on either side [diagonals].
        widest: Largest such distance [wavelengths], which limits the number of trials.
        tile: Half the width of a tile [rad]. Over some metres, lengths are linear within it.
        turn: Step of a rotation [wavelengths over the places' mean distance from the pivot]: about
            2 rad of phase.
    """

    def __init__(
        self,
        receivers: list[ReceiverLags],
        wavelength: float,
        diagonal: float,
        reach: float = 0.08,
        widest: float = 50.0,
        tile: float = 0.025,
        turn: float = 0.16,
    ):
        self.receivers = receivers
        self.wavelength = wavelength
        self.reach = min(reach * diagonal, widest * wavelength)
        self.tile = tile
        self.turn = turn

    def find_peaks(
        self,
        waves: list[FurtherWave],
        bandwidth: float,
        normal: Float[Tensor, "3"],
        plane: Float[Tensor, "4"],
    ) -> list[TilePeak]:
        """At most six maxima near a normal and a known plane's offset.

        Args:
            waves: Further wave of each receiver's links.
            bandwidth: Band over which powers are averaged [Hz].
            normal: Normal about which planes are tilted.
            plane: The known plane, which a maximum may replace.
        """
        (bounce,) = mean_bounces(self.receivers, plane[None])
        # Tiles lie in a row along the normal; each reaches this far on either side [m].
        half = min(self.wavelength, self.reach)
        moves = torch.linspace(-half, half, 19)
        turns = self._turns(bounce)
        signed_turns = torch.cat((-turns.flip(0)[:-1], turns))
        axes = torch.stack(tangents(normal))
        count = 2 * math.ceil(self.reach / half / 2) + 1
        offsets = normal @ bounce + torch.linspace(-self.reach, self.reach, count)
        centres = torch.cat((normal.expand(count, 3), offsets[:, None]), 1)  # (tiles, 4)
        pivots = mean_bounces(self.receivers, centres)
        values = []
        rates = []
        for receiver, wave in zip(self.receivers, waves, strict=True):
            products = compare_with_wave(receiver, wave, bandwidth, centres, pivots, axes)
            values.append(products.values)
            rates.append(products.rates)
        peaks = []
        tiles = zip(pivots, torch.cat(values, 1), torch.cat(rates, 1), strict=True)
        for pivot, tile_values, tile_rates in tiles:
            sums = periodogram(tile_values, tile_rates, moves, turns)
            best = sums.flatten().topk(2)
            indices = torch.unravel_index(best.indices, sums.shape)
            for height, move, first, second in zip(best.values.tolist(), *indices, strict=True):
                turned = normal + signed_turns[first] * axes[0] + signed_turns[second] * axes[1]
                turned = functional.normalize(turned, dim=0)
                offset = turned @ pivot + moves[move]
                peaks.append(TilePeak(height, torch.cat((turned, offset[None])), pivot))
        peaks.sort(key=lambda peak: -peak.height)
        return self._distinct(peaks)

    def _turns(self, bounce: Float[Tensor, "3"]) -> Float[Tensor, " t"]:
        """Rotations from 0 to half a tile [rad]; a step changes phases by about 2 rad."""
        gaps = torch.cat([receiver.places - bounce for receiver in self.receivers])
        spread = gaps.norm(dim=1).mean().item()  # [m]
        step = max(min(self.tile / 5, self.turn * self.wavelength / spread), self.tile / 20)
        return torch.linspace(0, self.tile, math.ceil(self.tile / step) + 1)

    def _distinct(self, peaks: list[TilePeak]) -> list[TilePeak]:
        """The first six peaks that are above 0 and not in the main lobe of an earlier one."""
        distinct: list[TilePeak] = []
        for peak in peaks:
            if peak.height <= 0 or len(distinct) == 6:
                break
            if all(self._is_apart(peak, other) for other in distinct):
                distinct.append(peak)
        return distinct

    def _is_apart(self, peak: TilePeak, other: TilePeak) -> bool:
        """True if two peaks have different lobes.

        Their normals differ by a quarter of ``tile``, or at the pivot the planes are a quarter
        wavelength apart.
        """
        difference = peak.plane - other.plane
        normal, offset = difference[:3], difference[3]
        distance = (offset - normal @ peak.pivot).abs()
        return bool(normal.norm() > self.tile / 4 or distance > self.wavelength / 4)


def compare_with_wave(
    receiver: ReceiverLags,  # links of one receiver
    wave: FurtherWave,  # the further wave; its weights are on each known path and element
    bandwidth: float,  # bandwidth of the covariances [Hz]
    planes: Float[Tensor, "c 4"],  # planes (normal, offset [m])
    pivots: Float[Tensor, "c 3"],  # points about which the planes turn [m]
    axes: Float[Tensor, "2 3"],  # unit vectors towards which the normals turn
) -> WaveProducts:
    """Products of the reflection at each plane with a further wave, at each link."""
    single = receiver.reflect_once(planes)
    directions = single.directions.transpose(0, 1)  # (c, b, 3)
    lengths = single.lengths.transpose(0, 1)  # (c, b)
    gains = single.gains.transpose(0, 1)
    cosines = single.cosines.transpose(0, 1)
    # Over the band, paths with a difference of length d are coherent by sinc(bandwidth d / c).
    coherence = sinc(bandwidth / speed_of_light * (wave.lengths - lengths[..., None]))  # (c, b, n)
    weights = torch.einsum("cbn,bne->cbe", coherence.to(wave.weights), wave.weights)
    # The product with the reflection's field: steering vector, gain, and phase of its length.
    values = (receiver.steer(directions).conj() * weights).sum(2) * gains.conj()  # (c, b)
    values = values * torch.polar(torch.ones_like(lengths), receiver.wavenumber * lengths)
    # Magnitudes saturate at the median, so that no link dominates.
    sizes = values.abs()
    medians = torch.where(sizes > 0, sizes, math.nan).nanmedian(1, keepdim=True).values  # (c, 1)
    values = values / (sizes + medians.nan_to_num(1.0))
    # A path's length changes by 2 cos(theta) per metre that the plane moves along its normal. Per
    # radian that it turns, it changes by this times the bounce's distance from the pivot.
    normals, offsets = planes[:, None, :3], planes[:, None, 3]
    heights = (receiver.places * normals).sum(-1) - offsets  # (c, b)
    to_images = reflect(receiver.places, normals, offsets) - receiver.pose.position
    units = functional.normalize(to_images, dim=2)  # (c, b, 3)
    # From place to bounce the path is height / cos(theta) long. So the bounce's distance from the
    # pivot times cos(theta) is the place's (``aside``) times cos(theta), plus the height times the
    # path's direction.
    aside = (receiver.places - pivots[:, None]) @ axes.T  # (c, b, 2)
    bounces = aside * cosines[..., None] + heights[..., None] * (units @ axes.T)
    rates = 2 * receiver.wavenumber * torch.cat((cosines[..., None], -bounces), 2)
    return WaveProducts(values, rates)


def periodogram(
    values: Complex[Tensor, " b"],
    rates: Float[Tensor, "b 3"],
    moves: Float[Tensor, " m"],
    turns: Float[Tensor, " t"],
) -> Float[Tensor, "m 2*t-1 2*t-1"]:
    """Sums of ``WaveProducts`` over links, for one plane at each move and rotation.

    Sums are Re sum_b v_b exp(j (r_b0 move + r_b1 turn + r_b2 turn')).

    Args:
        values, rates: From ``WaveProducts``, for one plane.
        moves: Moves of the plane along the normal [m].
        turns: Rotations towards two axes [rad], from 0 up; the result starts with their negatives.
    """
    phases = rates[:, :1] * moves
    moved = values[:, None] * torch.polar(torch.ones_like(phases), phases)  # (b, m)
    # With v exp(j r0 move) = x + j y and the angles a = r1 turn and b = r2 turn',
    # Re((x + j y) exp(j (a + b))) is
    # x cos a cos b - x sin a sin b - y sin a cos b - y cos a sin b.
    # Negative turns have the same four products but for signs.
    angles = rates[:, 1:, None] * turns  # (b, 2, t)
    cos_a, cos_b = angles.cos().unbind(1)
    sin_a, sin_b = angles.sin().unbind(1)
    shape = (len(turns), len(moves), len(turns))

    def sum_links(
        part: Float[Tensor, "b m"], first: Float[Tensor, "b t"], second: Float[Tensor, "b t"]
    ) -> Float[Tensor, "m t t"]:
        """The sum over links of the products of three factors, for all moves and turns."""
        products = (part[:, :, None] * first[:, None]).flatten(1)  # (b, m t)
        return (second.T @ products).view(shape).movedim(0, 2)

    x_cos_cos = sum_links(moved.real, cos_a, cos_b)
    x_sin_sin = sum_links(moved.real, sin_a, sin_b)
    y_sin_cos = sum_links(moved.imag, sin_a, cos_b)
    y_cos_sin = sum_links(moved.imag, cos_a, sin_b)
    halves = []
    for sign in (-1, 1):  # of the first turn
        even = x_cos_cos - sign * y_sin_cos  # in the second turn
        odd = sign * x_sin_sin + y_cos_sin
        negative = (even + odd).flip(2)[..., :-1]  # second turns in ascending order, without 0
        halves.append(torch.cat((negative, even - odd), 2))
    return torch.cat((halves[0].flip(1)[:, :-1], halves[1]), 1)
