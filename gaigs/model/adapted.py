"""A model at receivers without links, corrected by a few readings there.

Errors of a model at two places of a receiver without links have the covariance

    level + field exp(-distance / length) + [same place] noise

Four numbers hold this law: level, noise, field [label's unit squared] and length [m].
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.nn import functional

from gaigs.core.antenna import Receiver
from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.kernel import Process, kernel, resize
from gaigs.kriging.links import distances
from gaigs.model import Model, Prediction, Wrapper
from gaigs.registry import register, registry


@register("model", "adapted")
class Adapted(Wrapper):
    """y(x) + c(x)' (C + N)^-1 e: the best linear prediction of a receiver's errors from a few.

    y is the model at receivers without links, and e are its errors at the readings. C are the
    covariances among the readings of a receiver, c those with the place x, and N is the noise, of
    which repeated readings of a place have one draw. ``Model.adapt`` makes it.

    Args:
        base: The model at these receivers, or its configuration if a state is to be loaded.

    Source: Robinson, That BLUP is a good thing: the estimation of random effects, 1991.
    """

    law: Tensor  # (4,)
    places: Tensor  # transmitters of the readings [m], and numbers of their receivers (k, 4)
    noises: Tensor  # variances (k,)
    errors: Tensor  # (k,)

    def __init__(self, scene: Scene, base: dict | Model):
        super().__init__(scene)
        is_built = isinstance(base, Model)
        self.base: Model = base if is_built else registry("model").build(base, scene=scene)
        self.chunk = self.base.chunk
        shapes = {"law": (4,), "places": (0, 4), "noises": (0,), "errors": (0,)}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    @torch.no_grad()
    def take(self, links: Links, law: Float[Tensor, " n"], most: int = 2000) -> None:
        """Takes readings, at most ``most``, and the law of errors."""
        # Checkpoints of earlier versions have level and noise alone.
        self.law = functional.pad(law.double(), (0, 4 - len(law))).clamp_min(1e-9)
        rows = evenly(torch.arange(len(links)), most)
        query = links.query[rows]
        self.places = _coordinates(query)
        self.noises = self.law[1] / links.query.votes[rows]
        self.errors = (links.labels[rows] - self.base.predict(query).cpu()).double()
        self.to(self.base.device)

    def forward(self, batch: Batch) -> Prediction:
        towards, factor = self._process.whitened(_coordinates(batch.query))  # (k, b), (k, k)
        white = torch.linalg.solve_triangular(factor, self.errors[:, None], upper=False)
        value = self.base(batch).value
        return Prediction(value + (towards.T @ white)[:, 0].to(value), {})

    def deviations(self, batch: Batch) -> Float[Tensor, " b"]:
        """Deviations of the errors over those without readings."""
        towards, _ = self._process.whitened(_coordinates(batch.query))
        total = self.law[:3].sum()
        return (1 - towards.square().sum(0) / total).sqrt().float()

    @property
    def _process(self) -> Process:
        level, noise, field, length = self.law

        def covariances(a: Float[Tensor, "m 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, "m n"]:
            is_same = a[:, None, 3] == b[:, 3]
            return is_same * (level + field * kernel(a[:, :3], b[:, :3], length))

        return Process(covariances, self.places, self.noises, noise.item())

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return self.base.any_receiver

    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Model:
        return self.base.at_receivers(receivers, known)  # readings say nothing of others

    def adapt(self, links: Links) -> Any:
        raise ValueError(
            "adapt takes a model without readings at new receivers; give the trained model all "
            "readings together"
        )

    @property
    def underlying(self) -> Model:
        return self.base

    def facts(self) -> dict[str, Any]:
        return self.base.facts()

    def _load_from_state_dict(self, state_dict, prefix, *args):
        resize(self, state_dict, prefix, "places", "noises", "errors")
        super()._load_from_state_dict(state_dict, prefix, *args)


def _coordinates(query: Query) -> Float[Tensor, "b 4"]:
    """Places of transmitters [m], with the number of the receiver behind."""
    return torch.cat((query.transmitters, query.receivers[:, None]), 1).double()


def fit_law(
    errors: Sequence[Float[Tensor, " k"]], places: Sequence[Float[Tensor, "k 3"]], most: int = 100
) -> Float[Tensor, "4"]:
    """The most likely law of errors at receivers, each of which a model predicted as new.

    Args:
        errors: Errors of each receiver's links.
        places: Their transmitters [m].
        most: Largest number of links of a receiver.
    """
    parts = []
    for own, there in zip(errors, places, strict=True):
        rows = evenly(torch.arange(len(own)), most)
        parts.append((own[rows].double(), distances(there[rows].double(), there[rows].double())))
    mean = torch.cat([own for own, _ in parts]).square().mean().clamp_min(1e-9)
    size = torch.stack([apart.max() for _, apart in parts]).median().clamp_min(1e-6)
    units = torch.stack((mean, mean, mean, size))

    def cost(logarithms: np.ndarray) -> float:
        """Negative log likelihood."""
        level, noise, field, length = torch.from_numpy(logarithms).exp() * units
        total = 0.0
        for own, apart in parts:
            covariances = level + field * (-apart / length).exp() + noise * torch.eye(len(own))
            total -= MultivariateNormal(torch.zeros_like(own), covariances).log_prob(own).item()
        return total / sum(len(own) for own, _ in parts)

    # Variances from 1e-4 to 20 mean squares, lengths from 0.1 % to 3 sizes of the site.
    bounds = [(-9.0, 3.0)] * 3 + [(-7.0, 1.0)]
    found = minimize(cost, np.log([0.25, 0.3, 0.3, 0.05]), method="L-BFGS-B", bounds=bounds)
    return torch.from_numpy(np.exp(found.x)) * units
