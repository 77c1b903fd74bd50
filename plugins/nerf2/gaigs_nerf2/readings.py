"""Labels of a receiver from the rays that reach it: a spectrum, a level or a channel."""

import math

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor, nn

from gaigs.core.geometry import Directions, Grid, magnitudes
from gaigs.core.phases import array_sign
from gaigs.core.query import Query, check_carrier
from gaigs.core.scene import Scene, check_elements, check_one_carrier, direct_waves
from gaigs.data import Links

REACH = 0.025
"""A sample's part of a spectrum falls with the distance as 0.025 m / t, as published: lambda / (4
pi) at about 920 MHz."""


class Reading(nn.Module):
    """How labels follow from S, the fields along rays.

    Attributes:
        channels: Number of waves that a sample sends, each with an amplitude and a phase.
        grid: Rays for labels without directions; None for labels with directions.
        carriers: Carriers whose phase turns along the rays (channels,) [Hz]; None where the phase
            is learnt.
    """

    channels = 1
    grid: Grid | None = None
    carriers: Tensor | None = None

    def fit(self, links: Links) -> None:
        """Fits constants to the training links; by default none."""

    def gains(self, distances: Float[Tensor, " i"]) -> Float[Tensor, " i"]:
        """Factor of a wave that arrives from a distance [m]."""
        return torch.ones_like(distances)

    def shifts(self, distances: Float[Tensor, " i"]) -> Float[Tensor, "i c"]:
        """Phase 2 pi t / lambda over a distance t [rad]; 0 where the phase is learnt."""
        if self.carriers is None:
            return torch.zeros_like(distances[:, None])
        return 2 * math.pi / speed_of_light * distances[:, None] * self.carriers.to(distances)

    def amplitudes(self, labels: Tensor, query: Query) -> Tensor:
        """Magnitudes of S, or of its sum over the rays, that would give these labels."""
        raise NotImplementedError

    def forward(
        self, sums: Complex[Tensor, "b r c"], query: Query, directions: Directions
    ) -> Tensor:
        """Values of links to one receiver (b, ...)."""
        raise NotImplementedError


class Spectrum(Reading):
    """|S(u)| in each direction u."""

    def gains(self, distances: Float[Tensor, " i"]) -> Float[Tensor, " i"]:
        return REACH / distances

    def amplitudes(self, labels: Tensor, query: Query) -> Tensor:
        return labels

    def forward(
        self, sums: Complex[Tensor, "b r 1"], query: Query, directions: Directions
    ) -> Tensor:
        return magnitudes(sums[..., 0]).unflatten(1, directions.shape)


class Level(Reading):
    """100 (|sum_u S(u)| - 1) [dBm]: the sum's magnitude is 0 for -100 dBm and 1 for 0 dBm.

    Args:
        grid: Directions of the rays.
        frequency: Carrier [Hz].
    """

    def __init__(self, grid: Grid, frequency: float):
        super().__init__()
        self.grid = grid
        self.carriers = torch.tensor([frequency], dtype=torch.float64)

    def fit(self, links: Links) -> None:
        """Checks that the training labels can be predicted.

        Raises:
            ValueError: A label is at -100 dBm or below, where no amplitude is.
        """
        least = links.labels[links.split.train].min().item()
        if least <= -100:
            raise ValueError(
                "a radiance field gives levels above -100 dBm, and a training label is "
                f"{least:.6g} dBm; leave such readings out, or take another model"
            )

    def amplitudes(self, labels: Tensor, query: Query) -> Tensor:
        return 1 + labels / 100

    def forward(
        self, sums: Complex[Tensor, "b r 1"], query: Query, directions: Directions
    ) -> Tensor:
        return 100 * (magnitudes(sums.sum((1, 2))) - 1)


class Channel(Reading):
    """F(f) sum_u a(u) exp(-j 2 pi f x_e . u / c) S(u, f) at the element e and the subcarrier f.

    a is the elements' pattern and x_e an element's place. F is the wave of free space over the
    direct distance. Where the training channels' phases fall with the distance, as for the time
    dependence exp(+j omega t), the sum over u is conjugated. Where they follow the distance with
    neither sign, F is an amplitude without a phase.

    Args:
        grid: Directions of the rays.
        scene: Its task has the subcarriers, its receivers the elements.

    Raises:
        ValueError: An array has another number of elements than the labels.
    """

    def __init__(self, grid: Grid, scene: Scene):
        super().__init__()
        check_elements("marching along rays", scene)
        self.scene = scene
        self.grid = grid
        self.carriers = scene.task.frequencies
        self.channels = len(self.carriers)
        self.register_buffer("sign", torch.tensor(-1))  # of F; 0: its amplitude alone
        self.register_buffer("array_sign", torch.tensor(-1))

    def fit(self, links: Links) -> None:
        """Takes the signs of phases from the training channels."""
        train = links.split.train
        labels = links.labels[train].to(torch.complex128)
        query = links.query[train]
        waves = direct_waves(self.scene, query, self.carriers)
        self.sign.fill_(self.scene.task.phase_sign(labels, waves, query.receivers))
        self.array_sign.copy_(self.sign if self.sign else torch.tensor(array_sign(labels, waves)))

    def amplitudes(self, labels: Tensor, query: Query) -> Tensor:
        return (labels / self._direct(query)).abs()

    def forward(
        self, sums: Complex[Tensor, "b r c"], query: Query, directions: Directions
    ) -> Tensor:
        receiver = int(query.receivers[0]) if len(query) else 0
        array = self.scene.receivers[receiver].array
        vectors = directions.flatten().vectors().double()  # (r, 3)
        # A wave from the direction u reaches an element at x earlier by x . u / c than the middle.
        delays = vectors @ array.elements.to(vectors).T / speed_of_light  # (r, e)
        phases = -2 * math.pi * self.carriers.to(vectors)[:, None, None] * delays  # (c, r, e)
        gains = array.gain(vectors)[:, None].expand_as(phases)
        steering = torch.polar(gains, phases).to(sums)
        received = (sums.permute(2, 0, 1) @ steering).permute(1, 2, 0)  # (b, e, c)
        if self.array_sign < 0:
            received = received.conj()
        return received * self._direct(query).to(sums)

    def _direct(self, query: Query) -> Complex[Tensor, "b 1 c"]:
        """The wave F of free space at the middle of the receiver's array."""
        return direct_waves(self.scene, query, self.carriers, int(self.sign), at_elements=False)


def make_reading(scene: Scene, rays: list[int], frequency: float) -> Reading:
    """The reading of a scene's labels.

    Args:
        scene: Receivers and task.
        rays: Rows and columns of the rays over the sphere, where labels have no directions.
        frequency: Carrier of levels whose data say none [Hz].

    Raises:
        ValueError: The labels are no spectra, levels or channels, or of several carriers; an option
            is out of range.
    """
    task = scene.task
    check_one_carrier("a radiance field", scene)
    if len(rays) != 2:
        raise ValueError(f"model.rays must be [rows, columns], got {rays}")
    check_carrier("model.frequency", frequency)
    match task.name:
        case "spectrum":
            return Spectrum()
        case "rssi":
            return Level(
                Grid.sphere(*rays),
                scene.frequencies[0].item() if len(scene.frequencies) else frequency,
            )
        case "csi":
            return Channel(Grid.sphere(*rays), scene)
    raise ValueError(
        "a radiance field is marched for spectrum, rssi and csi, and these labels are of task "
        f"{task.name!r}; take another model"
    )
