"""A rival for Gaussian splatting: the field at each array element is learnt, the spectrum follows from the array."""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.data import Grid, Scene
from gaigs.model import Batch, Model, Prediction
from gaigs.tokenizer.euclidean import fourier_features


class ArrayResponse(Model):
    """Transmitter position -> complex field at every element -> min-max normalised Bartlett spectrum.

    With y_n the field at element n, which stands at (x_n, y_n) in the array's plane, in wavelengths,

        s(az, el) = | sum_n y_n exp(-j 2 pi (x_n cos az cos el + y_n sin az cos el)) |
        label = (s - min s) / (max s - min s)

    with the extremes over the scene's whole grid, whatever directions a batch asks for: they are searched without a
    gradient and then computed anew with one, which is what a minimum and a maximum pass back.

    Args:
        scene: Receivers and grid; positions are taken relative to the middle of the transmitters' box.
        rows, columns: Elements along the array's y and x axis.
        pitch: Distance between neighbouring elements [wavelengths].
        snapshots: Fields whose powers add, as a wide band or a moving transmitter brings them about.
        octaves: Lowest and highest octave k of the Fourier features, 2^k cycles a metre.
        width, layers: Of the network's hidden layers.
    """

    def __init__(self, scene: Scene, rows: int, columns: int, pitch: float, snapshots: int, octaves: list[int], width: int, layers: int, random: float = 0., m: int = 64, dropout: float = 0.0):
        super().__init__(scene)
        x = pitch * (torch.arange(columns) - (columns - 1) / 2)
        y = pitch * (torch.arange(rows) - (rows - 1) / 2)
        self.register_buffer("elements", torch.cartesian_prod(x, y), persistent=False)
        self.register_buffer("steering", self.steer(scene.grid), persistent=False)
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        self.register_buffer("frequencies", 2 * math.pi * 2.0 ** torch.arange(octaves[0], octaves[1] + 1))
        self.random = random
        if random:
            self.register_buffer("B", 2 * math.pi * random * torch.randn(3, m))
            last = 2 * m + 3
        else:
            last = 3 * (1 + 2 * len(self.frequencies))
        hidden = []
        for _ in range(layers):
            hidden += [nn.Linear(last, width), nn.GELU()]
            if dropout: hidden.append(nn.Dropout(dropout))
            last = width
        self.shape = (len(scene.receivers), snapshots, rows * columns, 2)
        self.network = nn.Sequential(*hidden, nn.Linear(last, math.prod(self.shape)))

    def forward(self, batch: Batch) -> Prediction:
        p = batch.transmitters - self.middle
        if self.random:
            z = p @ self.B
            f = torch.cat((p, z.sin(), z.cos()), -1)
        else:
            f = fourier_features(p, self.frequencies)
        fields = torch.view_as_complex(self.network(f).unflatten(-1, self.shape)[:, batch.receiver].contiguous())
        with torch.no_grad():
            everywhere = amplitudes(fields, self.steering)
            extremes = torch.stack((everywhere.argmin(1), everywhere.argmax(1)), 1)
        low, high = amplitudes(fields, self.steering[:, extremes].movedim(0, 1)).unbind(1)
        spectra = amplitudes(fields, self.steer(batch.grid)).unflatten(1, batch.grid.shape)
        low, high = low[:, None, None], high[:, None, None]
        return Prediction((spectra - low) / (high - low), {})

    def steer(self, grid: Grid) -> Complex[Tensor, "elements pixels"]:
        elevations, azimuths = torch.meshgrid(grid.elevations, grid.azimuths, indexing="ij")
        cosines = torch.stack((azimuths.cos() * elevations.cos(), azimuths.sin() * elevations.cos()))
        phases = -2 * math.pi * self.elements @ cosines.flatten(1)
        return torch.polar(torch.ones_like(phases), phases)


def amplitudes(fields, steering):
    return torch.view_as_real(fields @ steering).square().sum((1, -1)).add(0).sqrt() if False else torch.linalg.vector_norm(torch.view_as_real(fields @ steering), dim=(1, -1))
