"""A rival for Gaussian splatting: the field at each array element is learnt, the spectrum follows
from the array.
"""

import math
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core import geometry
from gaigs.core.geometry import Directions
from gaigs.core.query import Batch
from gaigs.core.scene import Scene, check_one_carrier
from gaigs.model import Model, Prediction
from gaigs.splatting.tokenizer.euclidean import fourier_features, learnable_octaves
from gaigs.splatting.tokenizer.euclidean import octaves as angular_frequencies


class ArrayResponse(Model):
    """Transmitter position -> complex field at every element -> min-max normalised Bartlett
    spectrum.

    With f_n the field at element n, which stands at (x_n, y_n) in the array's plane,

        s(az, el) = | sum_n f_n exp(-j 2 pi (x_n cos az cos el + y_n sin az cos el)) |
        label = (s - min s) / (max s - min s)

    The extremes are those over the label's whole grid, whatever directions a batch asks for, so
    that a direction's value does not depend on which others are asked for.

    Args:
        scene: Receivers and task; positions are taken relative to the middle of the transmitters'
            box.
        rows, columns: Elements along the array's y and x axis.
        pitch: Distance between neighbouring elements [wavelengths].
        octaves: Lowest and highest octave k of the Fourier features, 2^k cycles a metre; None takes
            those that the training transmitters can teach, as the ``euclidean`` tokenizer does.
        width: Width of the network's hidden layers.
        layers: Number of hidden layers.

    Raises:
        ValueError: The labels are no spectra or of several carriers, or an option is out of range.

    Source: Bartlett, Smoothing periodograms from time series with continuous spectra, 1948; the
    spectra of NeRF².
    """

    def __init__(
        self,
        scene: Scene,
        rows: int,
        columns: int,
        pitch: float,
        octaves: tuple[int, int] | None,
        width: int,
        layers: int,
    ):
        super().__init__(scene)
        if scene.task.name != "spectrum":
            raise ValueError(
                f"model 'array_response' predicts spectra, not labels of task {scene.task.name!r}; "
                "use another model"
            )
        check_one_carrier("model 'array_response'", scene)
        if rows < 1 or columns < 1 or rows * columns < 2:
            raise ValueError(
                f"an array must have at least 2 elements, got model.rows={rows}, "
                f"model.columns={columns}"
            )
        if not 0 < pitch < math.inf:
            raise ValueError(f"model.pitch must be positive [wavelengths], got {pitch}")
        for option, count, least in (("width", width, 1), ("layers", layers, 0)):
            if count < least:
                raise ValueError(f"model.{option} must be at least {least}, got {count}")
        frequencies = angular_frequencies("model.octaves", *(octaves or learnable_octaves(scene)))
        x = pitch * (torch.arange(columns) - (columns - 1) / 2)
        y = pitch * (torch.arange(rows) - (rows - 1) / 2)
        self.register_buffer("elements", torch.cartesian_prod(x, y), persistent=False)
        self.register_buffer("steering", self.steer(scene.task.directions), persistent=False)
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        self.register_buffer("frequencies", frequencies)
        self.fields = (len(scene.receivers), 2 * len(self.elements))
        widths = [3 * (1 + 2 * len(self.frequencies)), *[width] * layers]
        hidden = [layer for sizes in pairwise(widths) for layer in (nn.Linear(*sizes), nn.GELU())]
        self.network = nn.Sequential(*hidden, nn.Linear(widths[-1], math.prod(self.fields)))

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        directions = batch.directions or self.scene.task.directions
        features = fourier_features(query.transmitters - self.middle, self.frequencies)
        fields = self.network(features).unflatten(-1, self.fields)  # (b, receivers, 2 elements)
        rows = torch.arange(len(fields), device=fields.device)
        fields = fields[rows, query.receivers]  # (b, 2 elements)
        # An extreme's gradient is that of its pixel alone: the pixel is found without gradients.
        with torch.no_grad():
            powers = torch.einsum("bf,fcp->bcp", fields, self.steering).square().sum(1)
            extremes = torch.stack((powers.argmin(1), powers.argmax(1)), 1)  # (b, 2)
        sums = torch.einsum("bf,fcbp->bcp", fields, self.steering[..., extremes])
        low, high = magnitudes(sums).split(1, 1)  # (b, 1) each
        spectra = magnitudes(torch.einsum("bf,fcp->bcp", fields, self.steer(directions)))
        scaled = (spectra - low) / (high - low)  # (b, pixels)
        return Prediction(scaled.unflatten(1, directions.shape), {})

    def steer(self, directions: Directions) -> Float[Tensor, "fields 2 pixels"]:
        """The matrix from fields to the real and imaginary part of their sum in each direction.

        Fields are the real parts at all elements, then the imaginary ones.
        """
        vectors = directions.to(self.elements).flatten().vectors()
        phases = 2 * math.pi * self.elements @ vectors[:, :2].T  # (elements, pixels)
        cos = phases.cos()
        sin = phases.sin()
        # (x + j y) exp(-j p) = x cos p + y sin p + j (y cos p - x sin p)
        return torch.cat((torch.stack((cos, -sin), 1), torch.stack((sin, cos), 1)))


def magnitudes(parts: Float[Tensor, "b 2 pixels"]) -> Float[Tensor, "b pixels"]:
    """Magnitudes of complex numbers, given by their parts; the gradient at 0 is 0.

    ``norm(dim=1)`` takes ten times as long on a CPU.
    """
    # torch has no complex numbers of bfloat16 (trainer.precision=bf16-mixed).
    parts = parts.to(torch.promote_types(parts.dtype, torch.float32))
    return geometry.magnitudes(torch.complex(*parts.unbind(1)))
