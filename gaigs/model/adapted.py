"""A model at receivers without links, corrected by a few readings there.

Errors of a model at two places of a receiver without links have the covariance

    level + field exp(-distance / length) + [same place] noise

``gaigs.calibration.new_receivers.fit_law`` fits its four parameters: level, noise and field
[label's unit squared], and length [m].
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from gaigs.core.antenna import Receiver
from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.kernel import Process, kernel, resize
from gaigs.model import Model, Prediction, Wrapper
from gaigs.registry import register, registry


@register("model", "adapted")
class Adapted(Wrapper):
    """A model whose errors at a receiver are predicted from a few readings there, and removed.

    The prediction at x is y(x) + c(x)' (C + N)^-1 e, the best linear one. y is the prediction of
    ``base``. e has the ``errors`` of ``base`` at the readings. C and c are error covariances among
    readings and with x. N is the diagonal matrix of ``noises``.

    Args:
        base: The model at these receivers, or its configuration if a state is to be loaded.

    Source: Robinson, That BLUP is a good thing: the estimation of random effects, 1991.
    """

    law: Tensor  # level, noise, field, length (4,), see the module
    places: Tensor  # transmitters of the readings [m], and numbers of their receivers (k, 4)
    noises: Tensor  # noise over the number of averaged readings (k,)
    errors: Tensor  # reading minus prediction of ``base`` (k,)

    def __init__(self, scene: Scene, base: dict | Model):
        super().__init__(scene)
        if not isinstance(base, Model):
            base = registry("model").build(base, scene=scene)
        self.base: Model = base
        self.chunk = self.base.chunk
        shapes = {"law": (4,), "places": (0, 4), "noises": (0,), "errors": (0,)}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    @torch.no_grad()
    def take(self, links: Links, law: Float[Tensor, " n"], most: int = 2000) -> None:
        """Stores at most ``most`` readings, and the parameters ``law`` of the error covariance."""
        # Checkpoints of earlier versions have level and noise alone.
        self.law = functional.pad(law.double(), (0, 4 - len(law))).clamp_min(1e-9)
        rows = evenly(torch.arange(len(links)), most)
        query = links.query[rows]
        self.places = _coordinates(query)
        _, noise, _, _ = self.law
        self.noises = noise / links.query.votes[rows]
        self.errors = (links.labels[rows] - self.base.predict(query).cpu()).double()
        self.to(self.base.device)

    def forward(self, batch: Batch) -> Prediction:
        # With C + N = L L', the correction is (L^-1 c)' (L^-1 e).
        white_covariances, factor = self._process.whitened(_coordinates(batch.query))  # (k, b), L
        white_errors = torch.linalg.solve_triangular(factor, self.errors[:, None], upper=False)
        corrections = (white_covariances.T @ white_errors)[:, 0]  # (b,)
        value = self.base(batch).value
        return Prediction(value + corrections.to(value), {})

    def deviations(self, batch: Batch) -> Float[Tensor, " b"]:
        """Standard deviations of the errors, relative to those without readings."""
        white_covariances, _ = self._process.whitened(_coordinates(batch.query))  # (k, b)
        variance = self.law[:3].sum()  # level + noise + field, without readings
        return (1 - white_covariances.square().sum(0) / variance).sqrt().float()

    @property
    def _process(self) -> Process:
        """The Gaussian process of the errors; receivers are independent of each other."""
        level, noise, field, length = self.law

        def covariances(a: Float[Tensor, "m 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, "m n"]:
            is_same_receiver = a[:, None, 3] == b[:, 3]
            return is_same_receiver * (level + field * kernel(a[:, :3], b[:, :3], length))

        return Process(covariances, self.places, self.noises, noise.item())

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return self.base.any_receiver

    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Model:
        return self.base.at_receivers(receivers, known)  # the readings are of other receivers

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
    """Places of transmitters [m] in three columns, and the number of the receiver in a fourth."""
    return torch.cat((query.transmitters, query.receivers[:, None]), 1).double()
