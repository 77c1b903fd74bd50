"""Kriged strengths of propagation paths: complex Gaussian processes of the place, one for each
path.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.core.stages import track
from gaigs.kriging.fit import AROUND
from gaigs.kriging.kernel import kernel, resize
from gaigs.kriging.links import distances

JITTER = 1e-6
"""Variance of the processes that is not shared by places, over their variance: for places that are
measured twice.
"""

LEAST = 1e-4
"""Power of a link's noise over the link's, where the fit leaves nothing."""


class PathProcess(NamedTuple):
    """Hyperparameters of the processes of path strengths."""

    length: float  # correlation length of the kernel [m]
    nugget: float  # variance of the noise, see ``Equations``
    deviation: float  # standard deviation of the processes

    @classmethod
    def usual(cls, spacing: float) -> "PathProcess":
        """Where neighbouring places are ``spacing`` apart [m].

        A longer length raises the mean score further, but may lower the median.
        """
        return cls(spacing / 2, 1.0, 0.2)

    def facts(self) -> dict[str, float]:
        """Entries of ``metrics.json``."""
        return {"length_m": self.length, "nugget": self.nugget, "deviation": self.deviation}


@dataclass(frozen=True)
class Equations:
    """Knowledge of k links about the processes u of their n paths.

    The channel of a link is predicted as h + sum_i u_i m_i, with the field m_i of path i per unit
    of its process. With the residual r, and noise of ``nugget`` times p, the log likelihood is -|r
    - sum_i u_i m_i|² / (nugget p): a quadratic form. p is the mean power of the residual's numbers,
    plus ``LEAST`` times that of the label's, which has the gain of the prediction: links in shadow
    have far larger residuals than others.

    Attributes:
        places: (k, 3) [m].
        grams: Products of the m_i over p (k, n, n).
        sides: Products of the m_i with r over p (k, n).
    """

    places: Float[Tensor, "k 3"]
    grams: Complex[Tensor, "k n n"]
    sides: Complex[Tensor, "k n"]

    @classmethod
    def of(
        cls,
        places: Float[Tensor, "k 3"],
        margins: Callable[[slice], Complex[Tensor, "b n e s"]],
        labels: Complex[Tensor, "k e s"],
        residuals: Complex[Tensor, "k e s"],
    ) -> "Equations":
        """From the fields m_i of each ``slice`` of the links, one after the other: all together may
        take gigabytes.
        """
        grams, sides = [], []
        size = max(1, min(64, 300_000 // labels[0].numel()))
        for start in track(range(0, len(places), size), "kriging"):
            part = slice(start, start + size)
            fields = margins(part).flatten(2).to(torch.complex128)
            left, whole = (
                channels[part].abs().double().square().mean((1, 2))
                for channels in (residuals, labels)
            )
            powers = (left + LEAST * whole)[:, None, None]
            grams.append(fields.conj() @ fields.mT / powers)
            sides.append(
                (fields.conj() @ residuals[part].flatten(1)[..., None].to(fields) / powers)[..., 0]
            )
        return cls(places.double(), torch.cat(grams), torch.cat(sides))

    def __getitem__(self, index: object) -> "Equations":
        return Equations(self.places[index], self.grams[index], self.sides[index])


class PathField(nn.Module):
    """Kriged strengths of the n paths to one receiver, from k known links.

    Attributes:
        places: Of the known links (k, 3) [m].
        weights: The mean of the processes at x are the covariances of x with the places times these
            (k, n).
        precisions: Of each path's strength from each link alone (k, n).
    """

    places: Tensor
    weights: Tensor
    precisions: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("places", torch.zeros(0, 3, dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(0, 0, dtype=torch.complex128))
        self.register_buffer("precisions", torch.zeros(0, 0, dtype=torch.float64))

    def solve(self, equations: Equations, process: PathProcess) -> None:
        """Solves the strengths of all paths at all places together, by conjugate gradients."""
        identity = torch.eye(len(equations.places), dtype=torch.float64)
        covariances = kernel(equations.places, equations.places, process.length) + JITTER * identity
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(covariances))
        grams, sides = (
            equations.grams * (process.deviation**2 / process.nugget),
            equations.sides / process.nugget,
        )
        own = inverse.diagonal()[:, None, None] * torch.eye(grams.shape[1], dtype=torch.float64)
        precondition, inverse = torch.linalg.inv(grams + own), inverse.to(sides.dtype)
        times = lambda u: inverse @ u + (grams @ u[..., None])[..., 0]
        solution = conjugate_gradients(
            times, lambda r: (precondition @ r[..., None])[..., 0], sides * process.deviation**2
        )
        self.places, self.weights = equations.places.clone(), inverse @ solution
        self.precisions = equations.grams.diagonal(dim1=1, dim2=2).real / process.nugget

    def forward(self, places: Float[Tensor, "b d"], process: PathProcess) -> Complex[Tensor, "b n"]:
        """Mean of the processes at some places."""
        return kernel(places, self.places, process.length).to(self.weights) @ self.weights

    def variances(self, places: Float[Tensor, "b d"], process: PathProcess) -> Float[Tensor, "b n"]:
        """Variances of the processes at some places, as if the elements resolved all paths.

        The ``AROUND`` nearest known links of each place count: this kernel hides those behind them.
        """
        near = (
            distances(places, self.places)
            .topk(min(AROUND, len(self.places)), largest=False)
            .indices
        )
        around = self.places[near]
        own, towards = (
            kernel(around, other, process.length) for other in (around, places[:, None])
        )
        found = []
        for precisions in self.precisions.unbind(1):
            roots = (precisions[near] * process.deviation**2).sqrt()[..., None]
            matrix = roots * own * roots.mT
            matrix.diagonal(dim1=1, dim2=2).add_(1)
            factor = torch.linalg.cholesky(matrix)
            known = torch.linalg.solve_triangular(factor, roots * towards, upper=False)
            found.append(1 - known.square().sum((1, 2)))
        return process.deviation**2 * torch.stack(found, 1)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        resize(self, state_dict, prefix, "places", "weights", "precisions")
        super()._load_from_state_dict(state_dict, prefix, *args)


def conjugate_gradients(
    times: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    most: int = 300,
) -> Tensor:
    """The x of times(x) = right for a Hermitian positive map, to a relative residual of 1e-6.

    Source: Hestenes and Stiefel, Methods of Conjugate Gradients for Solving Linear Systems, 1952.
    """
    dot = lambda a, b: (a.conj() * b).sum().real
    x, rest = torch.zeros_like(right), right.clone()
    way = near = precondition(rest)
    slope = dot(rest, near)
    for _ in range(most):
        if rest.norm() <= 1e-6 * right.norm():
            break
        ahead = times(way)
        step = slope / dot(way, ahead)
        x, rest = x + step * way, rest - step * ahead
        near = precondition(rest)
        slope, before = dot(rest, near), slope
        way = near + slope / before * way
    return x
