"""The conventional beamformer: from covariances of an array's elements to a spectrum label."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array
from gaigs.core.geometry import FAINTEST, Directions, Grid
from gaigs.core.query import Query
from gaigs.core.scene import Scene, carriers
from gaigs.core.task.spectrum import MIN_MAX


class LagFit(NamedTuple):
    """Covariances at an array's lags, fitted to labels."""

    # Covariance at each of ``array.lags``, up to a factor for each label.
    lags: Complex[Tensor, "b l"]
    unexplained: Float[Tensor, " b"]  # share of each label's squared norm that the fit leaves


class Beamformer:
    """The amplitude of the conventional beamformer, scaled like the labels.

        s(u) = sqrt(sum_D n_D R(D) exp(-j 2 pi D . u / lambda))
        label = (s - min s) / (max s - min s)

    u are the direction cosines of a pixel. D is a lag, a vector between two elements. R(D) is the
    mean covariance of the n_D pairs of elements with this vector. s is the root of the paper's |a^H
    y|², eq. (4).

    Args:
        owner: Component named in errors.
        scene: Scene with directions and normalisation of the task, and the receivers' arrays.

    Source: GAI-GS, eq. (4); Bartlett, Smoothing periodograms from time series with continuous
    spectra, 1948; the spectra of NeRF².
    """

    def __init__(self, owner: str, scene: Scene):
        task = scene.task
        if task.directions is None:
            raise ValueError(
                f"{owner} gives spectra, not labels of task {task.name!r}\n"
                "take a pooling of that task, such as mean_power for RSSI or element_sum for "
                "channels"
            )
        if task.normalisation != MIN_MAX:
            raise ValueError(
                f"{owner} takes labels scaled by {MIN_MAX}, got {task.normalisation!r}; "
                "take pooling=spectrum"
            )
        for receiver in scene.receivers:
            count = len(receiver.array)
            if count < 2:
                raise ValueError(
                    f"{owner} takes arrays of at least 2 elements, got {count} of {receiver.name}; "
                    "set elements and frequency of the data"
                )
        self.scene = scene
        is_cosine = all(receiver.array.pattern == "cosine" for receiver in scene.receivers)
        self.zone = 0.0 if is_cosine else -math.pi / 2, math.pi / 2
        # 16 rows, 6 degrees apart in a hemisphere, show the label's extremes: 16 elements resolve a
        # quarter of that.
        step = max(1, task.directions.shape[0] // 16)
        self.coarse = task.directions.thin(slice(None, None, step), slice(None, None, step))
        self._bases: dict[tuple, Tensor] = {}

    def __call__(
        self, lags: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        """Computes spectra from covariances at the lags of the receiver's array.

        Args:
            lags: Mean covariance of the pairs of elements at each of ``array.lags``.
            query: The link of each row. All links are to one receiver.
            directions: Requested directions; None: the task's.
        """
        grid = self.scene.task.directions
        asked = grid if directions is None else directions
        # Labels are scaled by the least and largest amplitude over the task's grid: where only some
        # of its directions are asked, the coarse grid shows these extremes.
        has_extremes = asked is grid or grid.matches(asked)
        # The lags are symmetric: the middle one is the power, the second half determines the first.
        middle = lags.shape[1] // 2
        power = lags[:, middle].real  # (b,)
        # Relative to the power, so that no scale of the fields overflows; silence has the spectrum
        # 0.
        relative = lags[:, middle:] / torch.where(power < FAINTEST, 1, power)[:, None]
        parts = torch.cat((relative.real, relative.imag), 1)  # (b, m)
        # Spectra and the numbers of their links, carrier by carrier; the empty ones serve a query
        # without links.
        spectra = [parts.new_zeros(0, math.prod(asked.shape))]
        order = [torch.zeros(0).long().to(parts.device)]
        for carrier, links in self.by_carrier(query):
            amplitudes = self._amplitudes(parts[links], carrier, query, asked)  # (b, k)
            reference = amplitudes
            if not has_extremes:
                coarse = self._amplitudes(parts[links], carrier, query, self.coarse)
                reference = torch.cat((amplitudes, coarse), 1)
            spectra.append(_scaled(amplitudes, reference))
            order.append(links)
        if len(spectra) == 2:  # a single carrier, whose links are in order
            values = spectra[1]
        else:
            values = torch.cat(spectra)[torch.cat(order).argsort()]
        return values.unflatten(1, asked.shape)

    def lags(self, labels: Float[Tensor, "b rows columns"], query: Query) -> LagFit:
        """Fits covariances to labels by least squares, in float64; the inverse of ``__call__``.

        The scale of a label is unknown. A label of zeros has covariances of 0.

        Up to a factor a label is y = s - m, with m the lowest amplitude. The power s² = y² + 2 m y
        + m² is linear in the covariances, which are fitted together with m. Combinations of lags
        with hardly any effect on the spectrum are set to 0 (``rtol``). Closely spaced elements have
        many such combinations, and a fit would fill them with noise.
        """
        grid = self.scene.task.directions
        # At least 40 x 40 pixels.
        rows, columns = (slice(None, None, max(1, size // 40)) for size in grid.shape)
        thin = grid.thin(rows, columns)
        labels = labels[:, rows, columns].flatten(1).double()  # (b, k)
        count = len(self.array(query).lags[0])
        lags = torch.zeros(len(labels), count, dtype=torch.complex128)
        unexplained = torch.zeros(len(labels), dtype=torch.float64)
        for carrier, links in self.by_carrier(query):
            basis = self._basis(carrier, query, thin)  # (m, k)
            half = len(basis) // 2
            basis = torch.cat((basis[:half], basis[half + 1 :]))  # the lag 0 is real
            inverse = torch.linalg.pinv(basis, rtol=1e-3)  # (k, m)
            squares = labels[links].square()  # y²
            doubles = 2 * labels[links]  # 2 y
            # The residual of y² + 2 m y after the fit of covariances is linear in m. Its norm is
            # least at this m, which cannot be negative.
            square_residual = squares - squares @ inverse @ basis
            double_residual = doubles - doubles @ inverse @ basis
            product = (square_residual * double_residual).sum(1)  # (b,)
            lowest = -product / double_residual.square().sum(1).clamp_min(1e-30)
            lowest = lowest.clamp_min(0)[:, None]  # m, (b, 1)
            powers = squares + lowest * doubles + lowest.square()  # s², (b, k)
            parts = powers @ inverse  # (b, m)
            residual = (powers - parts @ basis).square().sum(1)
            unexplained[links] = residual / powers.square().sum(1).clamp_min(1e-30)
            # Complex covariances of the second half of the lags; the first half is their conjugate.
            imaginary = torch.cat((0 * parts[:, :1], parts[:, half:]), 1)
            later = torch.complex(parts[:, :half], imaginary)  # (b, half)
            lags[links] = torch.cat((later[:, 1:].conj().flip(1), later), 1)
        return LagFit(lags, unexplained)

    def array(self, query: Query) -> Array:
        """The array of a query's receiver."""
        return self.scene.receivers[int(query.receivers[0]) if len(query) else 0].array

    def by_carrier(self, query: Query) -> Iterator[tuple[float, Int[Tensor, " k"]]]:
        """Yields the distinct carriers [Hz], and the links of each."""
        frequencies = carriers(self.scene, query)
        for carrier in frequencies.unique().tolist():
            yield carrier, (frequencies == carrier).nonzero()[:, 0]

    def _amplitudes(
        self, parts: Float[Tensor, "b m"], carrier: float, query: Query, directions: Directions
    ) -> Float[Tensor, "b k"]:
        """Amplitudes of the beamformer in k directions.

        ``parts`` are covariances as m real numbers, in the order of the rows of ``_basis``.
        """
        power = parts @ self._stored_basis(parts, carrier, query, directions)  # (b, k)
        least = 1e-6  # of the mean power: sums of tens of float32 terms round at this
        if torch.is_grad_enabled():
            return power.clamp_min(least).sqrt()
        return power.clamp_min_(least).sqrt_()

    def _stored_basis(
        self, parts: Tensor, carrier: float, query: Query, directions: Directions
    ) -> Float[Tensor, "m k"]:
        """The matrix ``_basis`` in the dtype and on the device of ``parts``, cached for grids.

        A training uses the same few thinned grids repeatedly. Lists of rays rarely repeat.
        """
        if not isinstance(directions, Grid):
            return self._basis(carrier, query, directions).to(parts)
        elevations = directions.elevations.cpu().numpy().tobytes()
        azimuths = directions.azimuths.cpu().numpy().tobytes()
        receiver = int(query.receivers[0])
        key = receiver, carrier, parts.dtype, parts.device, elevations, azimuths
        if key not in self._bases:
            if len(self._bases) >= 64:  # thinning by a stride of 4 has 16 grids
                self._bases.clear()
            self._bases[key] = self._basis(carrier, query, directions).to(parts)
        return self._bases[key]

    def _basis(self, carrier: float, query: Query, directions: Directions) -> Float[Tensor, "m k"]:
        """Matrix from covariances (m real numbers) to the power in k directions, float64.

        Rows are the real, then the imaginary parts of the second half of the lags. The first half
        is their conjugate.
        """
        array = self.array(query)
        steps, _, counts = array.lags  # D [m], and n_D
        middle = len(steps) // 2
        # Opposite lags are conjugates of each other, so one of them counts twice.
        twice = torch.where(torch.arange(len(steps) - middle) > 0, 2, 1)
        weights = (counts[middle:] / len(array) * twice)[:, None]  # (half, 1)
        vectors = directions.to(steps).flatten().vectors()  # (k, 3)
        phases = 2 * math.pi * carrier / speed_of_light * (steps[middle:] @ vectors.T)  # (half, k)
        return torch.cat((phases.cos() * weights, phases.sin() * weights))


def _scaled(
    amplitudes: Float[Tensor, "b k"], reference: Float[Tensor, "b j"]
) -> Float[Tensor, "b k"]:
    """Amplitudes scaled so that the range of ``reference`` becomes [0, 1].

    Without gradients the result overwrites ``amplitudes``.

    One read of all pixels takes as long as the beamformer. The gradients of ``amin`` and ``amax``
    read all pixels four times, so training uses ``min`` and ``max``. Without gradients ``amin`` and
    ``amax`` are faster.
    """
    if reference.requires_grad:
        low = reference.min(1, keepdim=True).values  # (b, 1)
        high = reference.max(1, keepdim=True).values
        return (amplitudes - low) / torch.where(high > low, high - low, 1)
    low = reference.amin(1, keepdim=True)
    high = reference.amax(1, keepdim=True)
    return amplitudes.sub_(low).div_(torch.where(high > low, high - low, 1))
