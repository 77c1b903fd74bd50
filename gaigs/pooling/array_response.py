"""The spatial spectrum as an array sees it: beamforming with what its elements hear."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.directions import Directions, Grid
from gaigs.geometry import FAINTEST
from gaigs.pooling import Pooling, sphere
from gaigs.propagation import carriers
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Scene

NORMALISATIONS = ("min-max of each spectrum's amplitude",)
"""Of labels, in the words of their task: those that are reproduced here."""

COARSE = 16
"""At least so many rows, and columns in proportion, of the label's directions show its extremes: 6 degrees apart in a
hemisphere, a quarter of what 16 elements resolve."""

KEPT = 64
"""Most grids, carriers and receivers whose sines and cosines are kept: thinning by a stride of 4 has 16 grids."""

SILENT = 1e-6
"""Smallest power over the mean over all pixels: sums of tens of float32 terms round at this, and below it the slope of
the root has no bound."""


@register("pooling", "array_response")
class ArrayResponse(Pooling):
    """The amplitude of the conventional beamformer, scaled as the labels are.

        s(u) = sqrt(sum_D n_D R(D) exp(-j 2 pi D . u / lambda)),   label = (s - min s) / (max s - min s)

    with R(D) the mean covariance of the n_D pairs of elements that are D apart. ``aperture`` gives it at once; of a
    complex map, each element's signal is the map summed over the solid angle, times the element's pattern.

    Args:
        scene: Its task has the directions and the normalisation, its receivers the arrays.
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``; for map rasterizers.

    Raises:
        ValueError: The labels are no spectra, are normalised otherwise, or an array has a single element.

    Source: Bartlett, Smoothing periodograms from time series with continuous spectra, 1948; the spectra of NeRF².
    """

    channels = 2
    takes = "lags"

    def __init__(self, scene: Scene, grid: Sequence[int] = (24, 48)):
        super().__init__()
        task = scene.task
        if task.directions is None:
            raise ValueError(
                f"pooling 'array_response' gives spectra, and labels of task {task.name!r} are none; take mean_power "
                "for RSSI, element_sum for channels"
            )
        if task.normalisation not in NORMALISATIONS:
            raise ValueError(
                f"pooling 'array_response' takes labels scaled by {' or '.join(NORMALISATIONS)}, got "
                f"{task.normalisation!r}; take pooling=spectrum"
            )
        for receiver in scene.receivers:
            if len(receiver.array) < 2:
                raise ValueError(
                    f"pooling 'array_response' takes arrays of at least 2 elements, got {len(receiver.array)} of "
                    f"{receiver.name}; give the data's elements and frequency"
                )
        self.scene = scene
        self.grid = sphere("pooling.grid", grid)
        if all(receiver.array.pattern == "cosine" for receiver in scene.receivers):
            self.zone = (0.0, math.pi / 2)
        step = max(1, task.directions.shape[0] // COARSE)
        self.coarse = task.directions.thin(slice(None, None, step), slice(None, None, step))
        self._kept: dict[tuple, Tensor] = {}

    def forward(
        self, image: Float[Tensor, "b c rows columns"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        """Spectra of complex maps."""
        waves = torch.complex(*image.flatten(2).unbind(1))
        array = self._array(query)
        vectors = self.grid.flatten().vectors().to(image)
        weights = self.grid.solid_angles.flatten().to(image) * array.gain(vectors)
        _, pairs, counts = (part.to(image.device) for part in array.lags)
        lags = waves.new_zeros(len(query), len(counts))
        for carrier, own in self._by_carrier(query):
            phases = 2 * math.pi * carrier / speed_of_light * (vectors @ array.elements.to(image).T)
            fields = waves[own] @ torch.polar(weights[:, None].expand_as(phases), phases)
            covariance = fields[:, :, None] * fields[:, None].conj()
            summed = waves.new_zeros(len(fields), lags.shape[1]).index_add(1, pairs, covariance.flatten(1))
            lags = lags.index_add(0, own, summed / counts.to(image))
        return self.hear(lags, query, directions)

    def hear(
        self, heard: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        """Spectra of covariances at the lags of the receiver's array."""
        own = self.scene.task.directions
        asked = own if directions is None else directions
        half = heard.shape[1] // 2
        power = heard[:, half].real
        # Relative to the power, so that no scale of the fields overflows; silence has no spectrum, and 0 stands for it.
        relative = heard[:, half:] / torch.where(power < FAINTEST, 1, power)[:, None]
        parts = torch.cat((relative.real, relative.imag), 1)
        is_whole = _are_same(asked, own)
        spectra, order = [parts.new_zeros(0, math.prod(asked.shape))], [torch.zeros(0).long().to(parts.device)]
        for carrier, links in self._by_carrier(query):
            amplitudes = self._look(parts[links], carrier, query, asked)
            shown = amplitudes
            if not is_whole:
                shown = torch.cat((amplitudes, self._look(parts[links], carrier, query, self.coarse)), 1)
            low, high = shown.amin(1, keepdim=True), shown.amax(1, keepdim=True)
            spread = torch.where(high > low, high - low, 1)
            # Pixels are many, and each pass over them in memory costs as much as the beamformer itself.
            scaled = (amplitudes - low) / spread if torch.is_grad_enabled() else amplitudes.sub_(low).div_(spread)
            spectra.append(scaled)
            order.append(links)
        whole = spectra[1] if len(spectra) == 2 else torch.cat(spectra)[torch.cat(order).argsort()]
        return whole.unflatten(1, asked.shape)

    def _look(self, parts: Tensor, carrier: float, query: Query, directions: Directions) -> Tensor:
        """Amplitudes of the beamformer in some directions (b, k)."""
        key, basis = None, None
        if isinstance(directions, Grid):  # training thins one grid in a few ways, time and again; rays hardly come back
            axes = (axis.cpu().numpy().tobytes() for axis in (directions.elevations, directions.azimuths))
            key = int(query.receivers[0]), carrier, parts.dtype, parts.device, *axes
            basis = self._kept.get(key)
        if basis is None:
            # Kept beyond this call: made in inference mode it could not be saved for a later backward pass.
            with torch.inference_mode(False):
                basis = self._basis(carrier, query, directions).to(parts)
            if key is not None:
                if len(self._kept) >= KEPT:
                    self._kept.clear()
                self._kept[key] = basis
        power = parts @ basis
        return power.clamp_min(SILENT).sqrt() if torch.is_grad_enabled() else power.clamp_min_(SILENT).sqrt_()

    def _basis(self, carrier: float, query: Query, directions: Directions) -> Float[Tensor, "2l k"]:
        """What real and imaginary parts of the lags add to the power in each direction, float64."""
        array = self._array(query)
        steps, _, counts = array.lags
        half = len(steps) // 2
        # Of two opposite lags, which are each other's conjugates, one stands for both.
        weights = counts[half:] / len(array) * torch.where(torch.arange(len(steps) - half) > 0, 2, 1)
        vectors = directions.to(steps).flatten().vectors()
        phases = 2 * math.pi * carrier / speed_of_light * (steps[half:] @ vectors.T)
        return torch.cat((phases.cos() * weights[:, None], phases.sin() * weights[:, None]))

    def _array(self, query: Query):
        return self.scene.receivers[int(query.receivers[0]) if len(query) else 0].array

    def _by_carrier(self, query: Query):
        """The different carriers [Hz], and the links of each."""
        frequencies = carriers(self.scene, query)
        for carrier in frequencies.unique().tolist():
            yield carrier, (frequencies == carrier).nonzero()[:, 0]


def _are_same(asked: Directions, own: Directions) -> bool:
    if asked is own:
        return True
    pairs = (asked.elevations, own.elevations), (asked.azimuths, own.azimuths)
    return asked.shape == own.shape and all(torch.equal(a, b.to(a)) for a, b in pairs)
