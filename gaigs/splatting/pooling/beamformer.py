"""The conventional beamformer: from the covariance of an array's elements to the label of a
spectrum.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array
from gaigs.core.geometry import FAINTEST, Directions, Grid
from gaigs.core.query import Query
from gaigs.core.scene import Scene, carriers
from gaigs.core.task.spectrum import MIN_MAX


class Beamformer:
    """The amplitude of the conventional beamformer, scaled as the labels are.

        s(u) = sqrt(sum_D n_D R(D) exp(-j 2 pi D . u / lambda)),   label = (s - min s) / (max s -
        min s)

    with R(D) the mean covariance of the n_D pairs of elements that are D apart.

    Args:
        owner: Component named in errors.
        scene: Its task has the directions and the normalisation, its receivers the arrays.

    Source: Bartlett, Smoothing periodograms from time series with continuous spectra, 1948; the
    spectra of NeRF².
    """

    def __init__(self, owner: str, scene: Scene):
        task = scene.task
        if task.directions is None:
            raise ValueError(
                f"{owner} gives spectra, not labels of task {task.name!r}\n"
                "take a pooling of that task, such as mean_power for RSSI or element_sum for channels"
            )
        if task.normalisation != MIN_MAX:
            raise ValueError(
                f"{owner} takes labels scaled by {MIN_MAX}, got {task.normalisation!r}; take pooling=spectrum"
            )
        for receiver in scene.receivers:
            if len(receiver.array) < 2:
                raise ValueError(
                    f"{owner} takes arrays of at least 2 elements, got {len(receiver.array)} of {receiver.name}; set "
                    "elements and frequency of the data"
                )
        self.scene = scene
        is_cosine = all(receiver.array.pattern == "cosine" for receiver in scene.receivers)
        self.zone = 0.0 if is_cosine else -math.pi / 2, math.pi / 2
        # 16 rows, 6 degrees apart in a hemisphere, show the label's extremes: 16 elements resolve a
        # quarter of that.
        step = max(1, task.directions.shape[0] // 16)
        self.coarse = task.directions.thin(slice(None, None, step), slice(None, None, step))
        self._kept: dict[tuple, Tensor] = {}

    def __call__(
        self, lags: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        """Spectra from covariances at the lags of the receiver's array.

        Args:
            lags: Mean covariance of the pairs of elements at each of ``array.lags``.
            query: The link of each row; all to one receiver.
            directions: Wanted directions; None: the task's.
        """
        own = self.scene.task.directions
        asked = own if directions is None else directions
        half = lags.shape[1] // 2
        power = lags[:, half].real
        # Relative to the power, so that no scale of the fields overflows; silence has no spectrum,
        # and 0 stands for it.
        relative = lags[:, half:] / torch.where(power < FAINTEST, 1, power)[:, None]
        parts = torch.cat((relative.real, relative.imag), 1)
        is_whole = asked is own or own.matches(asked)
        spectra, order = (
            [parts.new_zeros(0, math.prod(asked.shape))],
            [torch.zeros(0).long().to(parts.device)],
        )
        for carrier, links in self.by_carrier(query):
            amplitudes = self._look(parts[links], carrier, query, asked)
            shown = amplitudes
            if not is_whole:
                shown = torch.cat(
                    (amplitudes, self._look(parts[links], carrier, query, self.coarse)), 1
                )
            # Pixels are many, and each pass over them in memory costs as much as the beamformer
            # itself. Gradients of amin and amax take four, those of min and max hardly one; without
            # gradients amin and amax are faster.
            if shown.requires_grad:
                low, high = shown.min(1, keepdim=True).values, shown.max(1, keepdim=True).values
                scaled = (amplitudes - low) / torch.where(high > low, high - low, 1)
            else:
                low, high = shown.amin(1, keepdim=True), shown.amax(1, keepdim=True)
                scaled = amplitudes.sub_(low).div_(torch.where(high > low, high - low, 1))
            spectra.append(scaled)
            order.append(links)
        whole = spectra[1] if len(spectra) == 2 else torch.cat(spectra)[torch.cat(order).argsort()]
        return whole.unflatten(1, asked.shape)

    def lags(
        self, labels: Float[Tensor, "b rows columns"], query: Query
    ) -> tuple[Complex[Tensor, "b l"], Float[Tensor, " b"]]:
        """Covariances of which labels are the spectra, and the share of each label that is no such
        spectrum; float64.

        The covariances are the inverse of a call, but for each label's scale. The share is that of
        the squared norm.

        A label y is s - m but for a scale, with the least amplitude m. So y² + 2 m y + m² is linear
        in the covariances, and they and m are the solution of least squares. What the directions
        hardly show is left out: of an array of closely spaced elements the noise of the labels
        would swamp it. A label of zeros has covariances of 0.
        """
        own = self.scene.task.directions
        rows, columns = (
            slice(None, None, max(1, size // 40)) for size in own.shape
        )  # at least 40 x 40 pixels
        thin, labels = own.thin(rows, columns), labels[:, rows, columns].flatten(1).double()
        found = torch.zeros(len(labels), len(self.array(query).lags[0]), dtype=torch.complex128)
        left = torch.zeros(len(labels), dtype=torch.float64)
        for carrier, links in self.by_carrier(query):
            basis = self._basis(carrier, query, thin)
            half = len(basis) // 2
            basis = torch.cat((basis[:half], basis[half + 1 :]))  # the lag 0 is real
            inverse = torch.linalg.pinv(basis, rtol=1e-3)
            squares, doubles = labels[links].square(), 2 * labels[links]
            rests = [part - part @ inverse @ basis for part in (squares, doubles)]
            least = -(rests[0] * rests[1]).sum(1) / rests[1].square().sum(1).clamp_min(1e-30)
            least = least.clamp_min(0)[:, None]
            powers = squares + least * doubles + least.square()
            parts = powers @ inverse
            rest = (powers - parts @ basis).square().sum(1)
            left[links] = rest / powers.square().sum(1).clamp_min(1e-30)
            later = torch.complex(
                parts[:, :half], torch.cat((0 * parts[:, :1], parts[:, half:]), 1)
            )
            found[links] = torch.cat((later[:, 1:].conj().flip(1), later), 1)
        return found, left

    def array(self, query: Query) -> Array:
        """The array of a query's receiver."""
        return self.scene.receivers[int(query.receivers[0]) if len(query) else 0].array

    def by_carrier(self, query: Query) -> Iterator[tuple[float, Int[Tensor, " k"]]]:
        """The different carriers [Hz], and the links of each."""
        frequencies = carriers(self.scene, query)
        for carrier in frequencies.unique().tolist():
            yield carrier, (frequencies == carrier).nonzero()[:, 0]

    def _look(self, parts: Tensor, carrier: float, query: Query, directions: Directions) -> Tensor:
        """Amplitudes of the beamformer in some directions (b, k)."""
        key, basis = None, None
        if isinstance(
            directions, Grid
        ):  # training thins one grid in a few ways; rays hardly come back
            axes = (
                axis.cpu().numpy().tobytes()
                for axis in (directions.elevations, directions.azimuths)
            )
            key = int(query.receivers[0]), carrier, parts.dtype, parts.device, *axes
            basis = self._kept.get(key)
        if basis is None:
            basis = self._basis(carrier, query, directions).to(parts)
            if key is not None:
                if len(self._kept) >= 64:  # thinning by a stride of 4 has 16 grids
                    self._kept.clear()
                self._kept[key] = basis
        power = parts @ basis
        least = 1e-6  # of the mean power: sums of tens of float32 terms round at this
        return (
            power.clamp_min(least).sqrt()
            if torch.is_grad_enabled()
            else power.clamp_min_(least).sqrt_()
        )

    def _basis(self, carrier: float, query: Query, directions: Directions) -> Float[Tensor, "m k"]:
        """Contribution of the real and then the imaginary part of each lag to the power in each
        direction, float64.
        """
        array = self.array(query)
        steps, _, counts = array.lags
        half = len(steps) // 2
        # Of two opposite lags, which are each other's conjugates, one stands for both.
        weights = (
            counts[half:] / len(array) * torch.where(torch.arange(len(steps) - half) > 0, 2, 1)
        )
        vectors = directions.to(steps).flatten().vectors()
        phases = 2 * math.pi * carrier / speed_of_light * (steps[half:] @ vectors.T)
        return torch.cat((phases.cos() * weights[:, None], phases.sin() * weights[:, None]))
