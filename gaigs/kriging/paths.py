"""Kriging of path strengths: a complex Gaussian process over places for each propagation path."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.core.stages import track
from gaigs.kriging.kernel import kernel, resize
from gaigs.kriging.links import distances
from gaigs.kriging.posterior import Posterior


class PathProcess(NamedTuple):
    """Hyperparameters of the processes of path strengths."""

    length: float  # correlation length of the kernel [m]
    nugget: float  # variance of the noise, see ``Equations``
    deviation: float  # standard deviation of the processes

    @classmethod
    def usual(cls, spacing: float) -> "PathProcess":
        """The default process if neighbouring places are ``spacing`` apart [m].

        A longer correlation length raises the mean score further, but may lower the median.
        """
        return cls(spacing / 2, 1.0, 0.2)

    def facts(self) -> dict[str, float]:
        """Entries of ``metrics.json``."""
        return {"length_m": self.length, "nugget": self.nugget, "deviation": self.deviation}


@dataclass(frozen=True)
class Equations:
    """Coefficients of the likelihood of the strengths u of n paths, from k links.

    The channel of a link is predicted as h + sum_i u_i m_i, with m_i the prior standard deviation
    of path i's field. With the residual r and noise of variance ``nugget`` p, the log likelihood is
    -|r - sum_i u_i m_i|² / (nugget p), quadratic in u. The noise power p is the mean power of the
    residual's values plus a ten-thousandth of the label's. So links with large residuals, as in
    shadow, have less weight.
    """

    places: Float[Tensor, "k 3"]  # [m]
    grams: Complex[Tensor, "k n n"]  # products of the m_i over p
    sides: Complex[Tensor, "k n"]  # products of the m_i with r over p

    @classmethod
    def of(
        cls,
        places: Float[Tensor, "k 3"],
        margins: Callable[[slice], Complex[Tensor, "b n e s"]],
        labels: Complex[Tensor, "k e s"],
        residuals: Complex[Tensor, "k e s"],
        least: float = 1e-4,
    ) -> "Equations":
        """Coefficients from links, in parts, since all fields together may take gigabytes.

        Args:
            places: Places of the links [m].
            margins: Function from a slice of the links to their fields m_i.
            labels: Channels of the links.
            residuals: Labels minus predictions.
            least: Fraction of the label's power that is added to the noise power p.
        """
        if not len(places):  # a receiver without links
            empty = torch.zeros(0, 0, 0, dtype=torch.complex128)
            return cls(places.double(), empty, empty.sum(2))
        grams, sides = [], []
        size = max(1, min(64, 300_000 // labels[0].numel()))
        for start in track(range(0, len(places), size), "kriging"):
            part = slice(start, start + size)
            fields = margins(part).flatten(2).to(torch.complex128)  # (b, n, m)
            residual_power = residuals[part].abs().double().square().mean((1, 2))  # (b,)
            label_power = labels[part].abs().double().square().mean((1, 2))  # (b,)
            noise_power = (residual_power + least * label_power)[:, None, None]  # p
            grams.append(fields.conj() @ fields.mT / noise_power)  # (b, n, n)
            r = residuals[part].flatten(1)[..., None].to(fields)  # (b, m, 1)
            sides.append((fields.conj() @ r / noise_power)[..., 0])
        return cls(places.double(), torch.cat(grams), torch.cat(sides))

    def __getitem__(self, index: object) -> "Equations":
        return Equations(self.places[index], self.grams[index], self.sides[index])


class PathField(nn.Module):
    """Kriged strengths of the n paths to one receiver, from k known links."""

    places: Tensor  # places of the known links (k, 3) [m]
    # Weights of the links (k, n). The mean strengths at a place are the kernel between it and
    # ``places``, times these weights.
    weights: Tensor
    precisions: Tensor  # precision of each path's strength from each link alone (k, n)

    def __init__(self):
        super().__init__()
        self.register_buffer("places", torch.zeros(0, 3, dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(0, 0, dtype=torch.complex128))
        self.register_buffer("precisions", torch.zeros(0, 0, dtype=torch.float64))

    def solve(self, equations: Equations, process: PathProcess, jitter: float = 1e-6) -> None:
        """Solves for the strengths of all paths at all known places, by conjugate gradients.

        ``jitter`` is added to the diagonal of the kernel, since places may be measured twice.
        """
        identity = torch.eye(len(equations.places), dtype=torch.float64)
        between = kernel(equations.places, equations.places, process.length) + jitter * identity
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(between))
        grams = equations.grams * (process.deviation**2 / process.nugget)  # (k, n, n)
        sides = equations.sides / process.nugget  # (k, n)
        # The most probable strengths u solve (K^-1 + G) u = deviation² s, with the kernel K between
        # places, G = ``grams`` and s = ``sides``. The (n, n) blocks of single places are the
        # preconditioner.
        of_paths = torch.eye(grams.shape[1], dtype=torch.float64)
        blocks = grams + inverse.diagonal()[:, None, None] * of_paths  # (k, n, n)
        inverse_blocks = torch.linalg.inv(blocks)
        inverse = inverse.to(sides.dtype)  # K^-1

        def times(strengths: Tensor) -> Tensor:
            """(K^-1 + G) times strengths (k, n)."""
            return inverse @ strengths + (grams @ strengths[..., None])[..., 0]

        def preconditioned(residual: Tensor) -> Tensor:
            return (inverse_blocks @ residual[..., None])[..., 0]

        solution = conjugate_gradients(times, preconditioned, sides * process.deviation**2)
        self.places = equations.places.clone()
        self.weights = inverse @ solution
        self.precisions = equations.grams.diagonal(dim1=1, dim2=2).real / process.nugget

    def forward(self, places: Float[Tensor, "b d"], process: PathProcess) -> Complex[Tensor, "b n"]:
        """Mean strength of each path at b places."""
        return kernel(places, self.places, process.length).to(self.weights) @ self.weights

    def variances(
        self, places: Float[Tensor, "b d"], process: PathProcess, most: int = 64
    ) -> Float[Tensor, "b n"]:
        """Variance of each path's strength at b places, as if the elements resolved all paths.

        Only the ``most`` known links nearest to a place are used; farther ones are nearly
        irrelevant.
        """
        apart = distances(places, self.places)
        near = apart.topk(min(most, len(self.places)), largest=False).indices  # (b, j)
        around = self.places[near]  # (b, j, 3)
        between = kernel(around, around, process.length)  # (b, j, j)
        towards = kernel(around, places[:, None], process.length)  # (b, j, 1)
        variances = []
        for precisions in self.precisions.unbind(1):  # of one path
            # In units of the prior variance: 1 - c' (C + P^-1)^-1 c = 1 - b' (I + R C R)^-1 b. C is
            # ``between``, c is ``towards``, P has the precisions, R their roots, and b = R c.
            roots = (precisions[near] * process.deviation**2).sqrt()[..., None]
            matrix = roots * between * roots.mT
            matrix.diagonal(dim1=1, dim2=2).add_(1)
            factor = torch.linalg.cholesky(matrix)
            whitened = torch.linalg.solve_triangular(factor, roots * towards, upper=False)
            variances.append(1 - whitened.square().sum((1, 2)))
        return process.deviation**2 * torch.stack(variances, 1)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        resize(self, state_dict, prefix, "places", "weights", "precisions")
        super()._load_from_state_dict(state_dict, prefix, *args)


class PathPosterior(Posterior):
    """Kriged strengths of paths, a ``PathField`` for each receiver.

    Phases of paths follow from geometry. Hyperparameters follow from the places' spacing.

    Args:
        scene: Receivers and task.
        margins: Function from links to one receiver to the prior standard deviation of each path's
            channel (b, n, e, s).
    """

    by_paths = True
    hyperparameters: Tensor

    def __init__(self, scene: Scene, margins: Callable[[Query], Tensor]):
        super().__init__()
        self.margins = margins
        process = torch.full((3,), math.nan, dtype=torch.float64)
        self.register_buffer("hyperparameters", process)
        self.fields = nn.ModuleList(PathField() for _ in scene.receivers)
        self.scene = scene

    @property
    def process(self) -> PathProcess:
        """The hyperparameters by name."""
        return PathProcess(*self.hyperparameters.tolist())

    def fit_process(self) -> None:
        """Sets the default hyperparameters for the scene's spacing of places."""
        process = PathProcess.usual(self.scene.spacing)
        self.hyperparameters.copy_(torch.tensor(process, dtype=torch.float64))

    def equations(
        self,
        query: Query,
        labels: Complex[Tensor, "k e s"],
        residuals: Complex[Tensor, "k e s"],
        device: torch.device,
    ) -> list[Equations]:
        """Equations of each receiver, from links with aligned labels and residuals."""
        equations = []
        for receiver in range(len(self.fields)):
            rows = (query.receivers == receiver).nonzero()[:, 0]

            def margins(part: slice, rows: Tensor = rows) -> Tensor:
                """Margins of a part of this receiver's links; a default binds its ``rows``."""
                return self.margins(query[rows[part]].to(device)).cpu()

            places = query.transmitters[rows]
            equations.append(Equations.of(places, margins, labels[rows], residuals[rows]))
        return equations

    def solve_equations(self, equations: Sequence[Equations]) -> None:
        """Solves for the path strengths at the known links of each receiver."""
        device = self.hyperparameters.device
        for field, known in zip(self.fields, equations, strict=True):
            if len(known.places):
                field.solve(known, self.process)
        self.fields.to(device)

    def mean_at(self, query: Query, device: torch.device) -> Complex[Tensor, "e s"]:
        """Mean residual of one link, on the CPU; fields of paths are computed on ``device``."""
        field: Any = self.fields[int(query.receivers)]
        if not len(field.places):
            return torch.zeros(self.scene.task.shape, dtype=self.scene.task.dtype)
        strengths = field(query.transmitters.double(), self.process)[0]  # (n,)
        margins = self.margins(query.to(device)).cpu()[0]  # (n, e, s)
        return torch.tensordot(strengths.to(margins), margins, 1)

    def mean(self, batch: Batch, like: Tensor) -> Tensor:
        query, mean = batch.query, torch.zeros_like(like)
        for receiver in query.receivers.unique().tolist():
            is_asked = query.receivers == receiver
            if not len(self.fields[receiver].places):  # type: ignore[arg-type]
                continue
            strengths = self.fields[receiver](query.transmitters[is_asked].double(), self.process)
            margins = self.margins(query[is_asked])  # (b, n, e, s)
            mean[is_asked] = (strengths.to(like)[..., None, None] * margins).sum(1)
        return mean

    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations (b, e, s) without noise, as if the elements resolved all paths."""
        query, places = batch.query, batch.query.transmitters
        squares = places.new_zeros(len(query), *self.scene.task.shape)
        for receiver in query.receivers.unique().tolist():
            is_asked = query.receivers == receiver
            field: Any = self.fields[receiver]
            if not len(field.places):
                continue
            variances = field.variances(places[is_asked].double(), self.process)  # (b, n)
            powers = self.margins(query[is_asked]).abs().square()  # (b, n, e, s)
            parts = variances.to(powers)[..., None, None] * powers
            squares[is_asked] = parts.sum(1).to(squares)
        return squares.sqrt()

    def facts(self) -> Mapping[str, float]:
        places = [len(field.places) for field in self.fields]  # type: ignore[arg-type]
        return {**self.process.facts(), "links": sum(places)}


def conjugate_gradients(
    times: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    most: int = 300,
) -> Tensor:
    """The solution x of times(x) = right, to a relative residual of 1e-6 or after ``most`` steps.

    Source: Hestenes and Stiefel, Methods of Conjugate Gradients for Solving Linear Systems, 1952.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a.conj() * b).sum().real

    x = torch.zeros_like(right)
    residual = right.clone()
    direction = precondition(residual)
    slope = dot(residual, direction)
    for _ in range(most):
        if residual.norm() <= 1e-6 * right.norm():
            break
        change = times(direction)
        step = slope / dot(direction, change)
        x = x + step * direction
        residual = residual - step * change
        conditioned = precondition(residual)
        last_slope, slope = slope, dot(residual, conditioned)
        # Directions are conjugate: ``times`` of each is orthogonal to all others.
        direction = conditioned + slope / last_slope * direction
    return x
