"""Kriged residuals of labels with many values: places, weights, and principal components."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Inexact, Int
from torch import Tensor, nn

from gaigs.core import stages
from gaigs.core.query import Batch, Query, thin_labels
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.fit import Hyperparameters, damping, fit_hyperparameters, local_deviations
from gaigs.kriging.kernel import LIMIT, Process, cholesky_factor, covariance, kernel, resize
from gaigs.kriging.links import at_directions, coordinates, scaled
from gaigs.kriging.posterior import Posterior


class Field(nn.Module):
    """Kriging of one receiver's residuals from k known links.

    Labels have many values, so residuals are stored as scores of q principal components.
    """

    places: Tensor  # places of the links (k, d) [m], see ``coordinates``
    weights: Tensor  # inverse covariance matrix of the links times their scores (k, q)
    # Components in half precision (q, *shape), complex ones as real and imaginary part in the last
    # dimension.
    components: Tensor
    widened: Tensor  # the components in the task's precision, in which products are fast

    def __init__(self, scene: Scene):
        super().__init__()
        task = scene.task
        self.scene = scene
        self.signal: Tensor | None = None
        parts = (2,) if task.dtype.is_complex else ()
        self.register_buffer("places", torch.zeros(0, 3 + scene.has_band, dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(0, 0, dtype=task.dtype))
        self.register_buffer("components", torch.zeros(0, *task.shape, *parts, dtype=torch.float16))
        self.register_buffer(
            "widened", torch.zeros(0, *task.shape, dtype=task.dtype), persistent=False
        )

    def solve(
        self,
        places: Float[Tensor, "k d"],
        residuals: Tensor,
        process: Hyperparameters,
        share: float = 2e-4,
    ) -> None:
        """Computes components and weights from residuals (k, *shape) at known places.

        The components omit at most the fraction ``share`` of the residuals' energy.
        """
        residuals = residuals.reshape(len(residuals), -1)  # (k, m)
        components = principal_components(residuals, share)  # (q, m)
        if components.is_complex():
            components = torch.view_as_real(components)
        shape = (len(components), *self.components.shape[1:])
        self.components = _like_loaded(self.components, components.reshape(shape))
        self._widen()
        # Scores are fitted to the components as rounded to half precision, by least squares of
        # residuals = scores @ rounded. So each component corrects the rounding of the others.
        rounded = self.widened.cpu().flatten(1)  # (q, m)
        wide = torch.promote_types(rounded.dtype, torch.float64)
        gram = (rounded @ rounded.mH).to(wide)
        cross = (residuals @ rounded.mH).to(wide)
        scores = torch.linalg.solve(gram, cross, left=False)  # (k, q)
        factor = cholesky_factor(places, process.length, process.nugget)
        self.weights = _like_loaded(self.weights, torch.cholesky_solve(scores, factor.to(wide)))
        self.places = _like_loaded(self.places, places)
        self.signal = None

    def forward(self, places: Float[Tensor, "b d"], length: float, batch: Batch) -> Tensor:
        """Kriged residuals (b, *shape) at b places, in the directions of a batch."""
        covariances = kernel(places, self.places, length)
        components = at_directions(self.widened, batch, self.scene)
        return torch.tensordot(covariances.to(self.weights) @ self.weights, components, 1)

    def deviations(
        self, places: Float[Tensor, "b d"], process: Hyperparameters
    ) -> Float[Tensor, " b"]:
        """Standard deviations of noisy labels at b places, averaged over the values of a label."""
        return self.size(process) * local_deviations(places, self.places, process)

    def size(self, process: Hyperparameters) -> Tensor:
        """Maximum-likelihood standard deviation of the process, averaged over a label's values."""
        if self.signal is None:
            # The mean of r' K^-1 r over label values and links, with r the residuals of one value.
            covariances = covariance(self.places, process.length, process.nugget)
            components = self.widened.flatten(1)  # (q, m)
            products = self.weights.mH @ covariances.to(self.weights) @ self.weights  # (q, q)
            gram = (components @ components.mH).to(products)  # (q, q)
            count = len(self.places) * components.shape[1]
            squares = (products.mT * gram).sum().real / count
            self.signal = squares.clamp_min(0).sqrt()
        return self.signal

    def _widen(self) -> None:
        components = self.components.float()
        self.widened = (
            torch.view_as_complex(components) if self.weights.is_complex() else components
        )

    def _load_from_state_dict(self, state_dict, prefix, *args):
        resize(self, state_dict, prefix, "places", "weights", "components")
        super()._load_from_state_dict(state_dict, prefix, *args)
        self.signal = None
        self._widen()


class FieldPosterior(Posterior):
    """Kriged residuals of labels with many values, a ``Field`` for each receiver.

    All receivers and label values share hyperparameters. The trend's weight is the candidate with
    the largest likelihood. Residuals of channels are limited, see ``damping``.

    Spectra have ``features``, the trend's spectra on a coarse grid (``coarse``). The correlation of
    places falls with the difference of features, as at the edge of a shadow. Source: Wilson et al.,
    Deep kernel learning, 2016.
    """

    chooses_weight = True
    hyperparameters: Tensor
    share = 2e-4
    """Largest share of the residuals' energy that components leave out; 5e-4 lowers the median SSIM
    of thousands of measured spectra by 0.001."""

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        self.register_buffer("hyperparameters", torch.full((3,), math.nan, dtype=torch.float64))
        self.fields = nn.ModuleList(Field(scene) for _ in range(scene.radios))

    @property
    def process(self) -> Hyperparameters:
        """The hyperparameters by name."""
        return Hyperparameters(*self.hyperparameters.tolist())

    @property
    def has_features(self) -> bool:  # type: ignore[override]
        return not self.scene.has_band and not math.isnan(self.process.scale)

    def fit(
        self,
        links: Links,
        candidates: Mapping[float, Tensor],
        features: Float[Tensor, "k c"] | None = None,
    ) -> float:
        index = links.split.known
        # Row of each link among the known links, as in ``candidates`` and ``features``.
        rows = index.new_zeros(len(links)).index_copy(0, index, torch.arange(len(index)))

        def fitted(
            weight: float, most: int = 300, has_features: bool = False, length: float | None = None
        ) -> tuple[Hyperparameters, float]:
            """Hyperparameters for a weight of the trend, and their negative log likelihood."""
            residuals = candidates[weight]
            if residuals.is_complex():
                labels = thin_labels(links.labels[index])
                radios = self.scene.radio_of(links.query.receivers[index])
                factors = damping(residuals, labels, radios)
                residuals = residuals * factors[:, None]
            return fit_hyperparameters(
                self.scene,
                links,
                lambda part: residuals[rows[part]],
                most=most,
                features=(lambda part: features[rows[part]]) if has_features else None,
                length=length,
            )

        fits = {weight: fitted(weight) for weight in stages.track([*candidates], "kriging")}
        best = min(candidates, key=lambda weight: fits[weight][1])
        process, _ = fits[best]
        if best:  # residuals of a good trend correlate weakly with position: few links overfit
            process, _ = fitted(best, most=1000)
        if features is not None:
            lengths = {weight: fit.length for weight, (fit, _) in fits.items()}
            fits = {weight: fitted(weight, 300, True, lengths[weight]) for weight in candidates}
            with_features = min(candidates, key=lambda weight: fits[weight][1])
            # A further hyperparameter must lower the cost by 2 (Akaike, 1974).
            _, cost_without = fitted(best, length=lengths[best])
            if fits[with_features][1] + 2 < cost_without:
                best = with_features
                process, _ = fitted(best, 1000, True, lengths[best])
        self.hyperparameters.copy_(torch.tensor(process, dtype=torch.float64))
        return best

    def solve(
        self,
        links: Links,
        residuals: Callable[[Int[Tensor, " j"]], Tensor],
        features: Float[Tensor, "k c"] | None = None,
    ) -> None:
        index = links.split.known
        query, process = links.query[index], self.process
        radios = self.scene.radio_of(query.receivers)
        for radio, field in enumerate(stages.track(self.fields, "kriging")):
            rows = (radios == radio).nonzero()[:, 0]
            if not len(rows):
                continue
            values = residuals(rows)  # (k, *shape)
            if values.is_complex():
                labels = links.labels[index[rows]]
                values = values * damping(values, labels, radios[rows])[:, None, None]
            field.solve(self._places(query, features)[rows], values, process, self.share)

    def mean(
        self, batch: Batch, like: Tensor, features: Float[Tensor, "b c"] | None = None
    ) -> Tensor:
        all_places = self._places(batch.query, features)
        mean = torch.zeros_like(like)
        radios = self.scene.radio_of(batch.query.receivers)
        for radio in radios.unique().tolist():
            is_asked = radios == radio
            field = self.fields[radio]
            mean[is_asked] = field(all_places[is_asked], self.process.length, batch).to(mean)
        return mean

    def deviations(self, batch: Batch, features: Float[Tensor, "b c"] | None = None) -> Tensor:
        query, process = batch.query, self.process
        places = self._places(query, features)
        squares = places.new_zeros(len(query))
        radios = self.scene.radio_of(query.receivers)
        for radio in radios.unique().tolist():
            is_asked = radios == radio
            field: Any = self.fields[radio]
            if not len(field.places):
                continue
            squares[is_asked] = field.deviations(places[is_asked], process).square()
        return squares.sqrt()

    def process_at(self, receiver: int) -> Process:
        field, process = self.fields[receiver], self.process
        # Without features, since callers have no predicted spectra.
        known = field.places if not self.has_features else field.places[:, :3]
        places = scaled(known, 1 / process.scale)  # of scale 1
        of_labels = process.at(places, field.size(process).item() ** 2)
        return replace(of_labels, is_part=len(places) >= LIMIT)

    def facts(self) -> Mapping[str, float]:
        places = [len(field.places) for field in self.fields]  # type: ignore[arg-type]
        components = [len(field.components) for field in self.fields]  # type: ignore[arg-type]
        sizes = {"links": sum(places), "components": max(components)}
        facts = self.process.facts()
        if self.has_features:
            facts["spectrum_scale_m"] = facts.pop("frequency_scale_m")
        return {**facts, **sizes}

    def _places(self, query: Query, features: Float[Tensor, "b c"] | None) -> Float[Tensor, "b d"]:
        return coordinates(self.scene, query, self.process.scale, features)


def _like_loaded(buffer: Tensor, values: Tensor) -> Tensor:
    """A copy of ``values`` with the memory layout of a buffer, which affects rounding.

    A solved and a loaded model then give the same predictions to the last digit.
    """
    return buffer.new_empty(values.shape).copy_(values)


def principal_components(
    residuals: Inexact[Tensor, "k m"], share: float = 2e-4, most: int = 512, exact: int = 512
) -> Inexact[Tensor, "q m"]:
    """Principal components, as many as needed for all but the fraction ``share`` of the energy.

    Each is scaled to a largest magnitude of 1. Residuals of 0 have no components.

    Args:
        residuals: Residuals of links.
        share: Largest fraction of the energy that the components omit.
        most: Largest number of components.
        exact: Number of links, or of values in a label, up to which components are exact; beyond
            it random projections are faster.
    """
    if min(residuals.shape) <= exact:
        # Eigenvectors of the smaller Gram matrix: a singular value decomposition of the residuals
        # takes ten times as long.
        is_flat = len(residuals) <= residuals.shape[1]
        gram = residuals @ residuals.mH if is_flat else residuals.mH @ residuals
        wide = torch.promote_types(gram.dtype, torch.float64)
        squares, vectors = torch.linalg.eigh(gram.to(wide))  # ascending
        squares = squares.flip(0).clamp_min(0)  # energy of each component, largest first
        vectors = vectors.flip(1).mH.to(residuals)[:most]
        # Vectors of the smaller side: links (k), or values of a label (m).
        components = vectors @ residuals if is_flat else vectors  # (q, m)
    else:
        # The random state stays: a resumed run must continue as an uninterrupted one.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            _, values, columns = torch.svd_lowrank(residuals, q=most + 16)
        squares = values.square().double()
        components = columns.mH
    energy = residuals.norm(dim=1).double().square().sum()
    missing = energy - squares.cumsum(0)  # with 1, 2, ... components
    count = int((missing > share * energy).sum()) + 1
    components = components[: min(count, most) if energy > 0 else 0]
    return components / components.abs().amax(1, keepdim=True)
