"""Kriged residuals of one receiver in a compact form: places, weights, and principal components."""

import torch
from jaxtyping import Float, Inexact
from torch import Tensor, nn

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.kriging.fit import Hyperparameters, local_deviations
from gaigs.kriging.kernel import cholesky_factor, covariance, kernel, resize
from gaigs.kriging.links import at_directions


class Field(nn.Module):
    """The kriged residual at one receiver, from k known links and q principal components of their
    residuals.

    Attributes:
        places: Of the links (k, d) [m], see ``coordinates``.
        weights: The components' scores over the covariances of the links (k, q).
        components: In half precision (q, *shape), complex ones as real and imaginary part in the
            last dimension.
        widened: The components in the task's precision, in which products are fast.
    """

    places: Tensor
    weights: Tensor
    components: Tensor
    widened: Tensor

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
        self, places: Float[Tensor, "k d"], residuals: Tensor, process: Hyperparameters
    ) -> None:
        """Takes residuals (k, *shape) at their places."""
        residuals = residuals.reshape(len(residuals), -1)
        components = principal_components(residuals)
        if components.is_complex():
            components = torch.view_as_real(components)
        shape = (len(components), *self.components.shape[1:])
        # All buffers have the strides of a loaded state: other layouts round products differently.
        like_loaded = lambda own, values: own.new_empty(values.shape).copy_(values)
        self.components = like_loaded(self.components, components.reshape(shape))
        self._widen()
        # Scores of the rounded components, so that each component corrects the rounding of the
        # others.
        kept = self.widened.cpu().flatten(1)
        wide = torch.promote_types(kept.dtype, torch.float64)
        gram, cross = (kept @ kept.mH).to(wide), (residuals @ kept.mH).to(wide)
        scores = torch.linalg.solve(gram, cross, left=False)
        factor = cholesky_factor(places, process.length, process.nugget)
        self.weights = like_loaded(self.weights, torch.cholesky_solve(scores, factor.to(wide)))
        self.places, self.signal = like_loaded(self.places, places), None

    def forward(self, places: Float[Tensor, "b d"], length: float, batch: Batch) -> Tensor:
        """Kriged residuals (b, *shape) at some places, in the directions of a batch."""
        covariances = kernel(places, self.places, length)
        components = at_directions(self.widened, batch, self.scene)
        return torch.tensordot(covariances.to(self.weights) @ self.weights, components, 1)

    def deviations(
        self, places: Float[Tensor, "b d"], process: Hyperparameters
    ) -> Float[Tensor, " b"]:
        """Standard deviations of noisy labels at some places, means over a label's numbers."""
        return self.size(process) * local_deviations(places, self.places, process)

    def size(self, process: Hyperparameters) -> Tensor:
        """Most likely standard deviation of the process, a mean over a label's numbers."""
        if self.signal is None:
            covariances = covariance(self.places, process.length, process.nugget)
            kept = self.widened.flatten(1)
            products = self.weights.mH @ covariances.to(self.weights) @ self.weights
            squares = (products.mT * (kept @ kept.mH).to(products)).sum().real / (
                len(self.places) * kept.shape[1]
            )
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


LEFT, MOST = 5e-4, 256
"""Largest share of the residuals' energy that the components leave out, and their largest number;
SSIM changes visibly at ten times the share."""

EXACT = 512
"""Links or numbers of a label up to which components are exact; beyond it random projections are
faster.
"""


def principal_components(residuals: Inexact[Tensor, "k m"]) -> Inexact[Tensor, "q m"]:
    """The fewest principal components that leave out at most ``LEFT`` of the energy, each scaled to
    a maximum of 1.

    Residuals of 0 have none.
    """
    if min(residuals.shape) <= EXACT:
        # By the smaller matrix of products: a decomposition of the residuals themselves takes ten
        # times as long.
        is_flat = len(residuals) <= residuals.shape[1]
        gram = residuals @ residuals.mH if is_flat else residuals.mH @ residuals
        squares, vectors = torch.linalg.eigh(
            gram.to(torch.promote_types(gram.dtype, torch.float64))
        )
        squares, vectors = squares.flip(0).clamp_min(0), vectors.flip(1).mH.to(residuals)[:MOST]
        components = vectors @ residuals if is_flat else vectors
    else:
        with torch.random.fork_rng(
            devices=[]
        ):  # a resumed run must continue as an uninterrupted one
            torch.manual_seed(0)
            _, values, columns = torch.svd_lowrank(residuals, q=MOST + 16)
        squares, components = values.square().double(), columns.mH
    energy = residuals.norm(dim=1).double().square().sum()
    left = energy - squares.cumsum(0)
    components = components[: min(int((left > LEFT * energy).sum()) + 1, MOST) if energy > 0 else 0]
    return components / components.abs().amax(1, keepdim=True)
