"""Samples along rays from each receiver into the room, and their sums."""

import math
from abc import abstractmethod
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.geometry import Rays
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.splatting.tokenizer.euclidean import MAX_OCTAVE
from gaigs_nerf2.readings import make_reading

CALIBRATION = 16, 200
"""Training links, and directions of each, that the unit of strength is taken from."""


class Samples(NamedTuple):
    """Properties of the samples i along each ray r, counted from the receiver.

    Attributes:
        attenuations: Decay a of a passing wave's amplitude (r, i) [1/m].
        turns: Rate p of a passing wave's phase (r, i) [rad/m].
        amplitudes: Amplitude s of the wave that a sample sends to the receiver, for each link (b,
            r, i, c).
        phases: Phase phi of this wave (b, r, i, c) [rad].
    """

    attenuations: Float[Tensor, "r i"]
    turns: Float[Tensor, "r i"]
    amplitudes: Float[Tensor, "b r i c"]
    phases: Float[Tensor, "b r i c"]


def render(
    samples: Samples, step: float, gains: Float[Tensor, " i"], shifts: Float[Tensor, "i c"]
) -> Complex[Tensor, "b r c"]:
    """Field along each ray, the sum of its samples' waves.

        S = sum_i g_i s_i exp(j (phi_i + x_i)) prod_{j<i} (1 - alpha_j) exp(j p_j d)

    with 1 - alpha_j = exp(-a_j d). Products are computed as exponentials of sums, since factors of
    almost 0 or 1 would be rounded.

    Args:
        samples: Samples along each ray.
        step: Distance d from one sample to the next [m].
        gains: Factor g of each distance.
        shifts: Phase x of each distance [rad].

    Source: NeRF², 2023, with its 0.025 / t_i of spectra as gains and its 2 pi t_i / lambda of RSSI
    as shifts.
    """
    # Loss and phase of a wave on its way from a sample to the receiver (r, i).
    losses = step * (samples.attenuations.cumsum(1) - samples.attenuations)
    turns = step * (samples.turns.cumsum(1) - samples.turns)
    strengths = (gains * (-losses).exp())[None, ..., None] * samples.amplitudes
    phases = samples.phases + (turns[..., None] + shifts)  # (b, r, i, c)
    real = (strengths * phases.cos()).sum(2)
    imaginary = (strengths * phases.sin()).sum(2)
    return torch.complex(real, imaginary)


def check_octaves(octaves: int) -> None:
    """Raises a ``ValueError`` unless float32 resolves the features sin 2^k x of k < ``octaves``."""
    if not 0 <= octaves <= MAX_OCTAVE:
        raise ValueError(
            f"model.octaves must be at least 0 and at most {MAX_OCTAVE}, got {octaves}"
        )


class RayMarching(Model):
    """A model that sums samples along rays from the receivers; a subclass has ``sample``.

    Samples stand in the middles of equal steps. ``gaigs_nerf2.readings`` turns the sums along the
    rays into spectra, RSSI and channels. The unit of strength is such that the untrained model
    gives the training labels' mean amplitude.

    Args:
        scene: Receivers, task, carrier.
        samples: Number of samples along a ray.
        far: Length of the rays [m]; None: the largest distance from a receiver to a corner of the
            box that holds the training transmitters and the receivers.
        rays: Rows and columns of the rays over the sphere, where labels have no directions.
        frequency: Carrier of RSSI where the data have none [Hz].

    Attributes:
        grid: Rays for all labels; None: rays in the directions of each label.

    Raises:
        ValueError: The labels are no spectra, RSSI or channels, or of several carriers; an option
            is out of range.

    Source: NeRF², 2023.
    """

    chunk = 2**12
    any_receiver = True  # networks see places and directions in the world, not receivers

    def __init__(
        self, scene: Scene, samples: int, far: float | None, rays: list[int], frequency: float
    ):
        super().__init__(scene)
        if samples < 2:
            raise ValueError(f"model.samples must be at least 2 a ray, got {samples}")
        if far is not None and not 0 < far < math.inf:
            raise ValueError(f"model.far must be positive [m] or null, got {far}")
        self.reading = make_reading(scene, rays, frequency)
        self.grid = self.reading.grid
        self.samples = samples
        self._divide(farthest(scene) if far is None else far)
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        self.register_buffer("unit", torch.ones(()))

    def _divide(self, far: float) -> None:
        """Divides rays of length ``far`` [m] into steps, each with a sample in its middle.

        It sets the step, and the distances of the samples with their gains and phases. It is called
        at the start, and when a state with another length is loaded.
        """
        self.register_buffer("far", torch.tensor(far, dtype=torch.float64))
        self.step = far / self.samples
        distances = self.step * (torch.arange(self.samples, dtype=torch.float64) + 0.5)
        gains = self.reading.gains(distances)
        # Phases of many turns would lose their digits in float32.
        shifts = self.reading.shifts(distances).remainder(2 * math.pi)
        self.register_buffer("distances", distances.float(), persistent=False)
        self.register_buffer("gains", gains.float(), persistent=False)
        self.register_buffer("shifts", shifts.float(), persistent=False)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # A copy for other receivers keeps the length of the rays; old checkpoints have none.
        far = state_dict.setdefault(f"{prefix}far", self.far)
        if far != self.far:
            self._divide(far.item())
        super()._load_from_state_dict(state_dict, prefix, *args)

    @abstractmethod
    def sample(
        self, query: Query, points: Float[Tensor, "r i 3"], views: Float[Tensor, "r 3"]
    ) -> Samples:
        """Properties of the samples for links to one receiver.

        Args:
            query: The links.
            points: Samples relative to ``middle``, the middle of the transmitters' box [m].
            views: Unit vectors of the rays, world frame.
        """

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the reading, and the unit of strength by a few training links."""
        self.reading.fit(links)
        train = links.split.train
        count, most = CALIBRATION
        chosen = train[torch.linspace(0, len(train) - 1, min(count, len(train))).long()]
        batch = links.batch(chosen).to(self.unit.device)
        if batch.directions is not None:
            stride = -(-batch.labels[0].numel() // most)
            batch = replace(
                batch,
                directions=batch.directions.flatten()[::stride],
                labels=batch.labels.flatten(1)[:, ::stride],
            )
        self.unit.fill_(1.0)
        wanted = self.reading.amplitudes(batch.labels, batch.query)
        given = self.reading.amplitudes(self(batch).value, batch.query)
        if batch.labels.is_complex():  # each link has a vote, however weak or loud it is
            wanted = self.reading.amplitudes(links.labels[train], links.query[train])
            wanted = wanted.flatten(1).mean(1).quantile(0.5)
            given = given.flatten(1).mean(1).quantile(0.5)
        self.unit.copy_(wanted.mean() / given.mean())

    def forward(self, batch: Batch) -> Prediction:
        directions = (self.grid or batch.directions or self.scene.task.directions).to(self.middle)
        query = batch.query
        rays = directions.flatten()
        by_receiver = []
        values = []
        # Without links the first receiver gives an empty value of a label's shape.
        for receiver in query.receivers.unique().tolist() or [0]:
            links = (query.receivers == receiver).nonzero()[:, 0]
            fields = self.march(query[links], receiver, rays)
            values.append(self.reading(fields, query[links], directions))
            by_receiver.append(links)
        order = torch.cat(by_receiver).argsort()
        return Prediction(torch.cat(values)[order], {})

    def march(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """Fields along rays at one receiver, for links to it.

        Without gradients, at most ``chunk`` pairs of a link and a ray are computed at a time. All
        links share the attenuation and phase along a ray, so rays are split, not links.
        """
        if torch.is_grad_enabled() or not len(query):
            return self.march_at_once(query, receiver, rays)
        size = max(1, self.chunk // len(query))
        parts = (rays[start : start + size] for start in range(0, len(rays.azimuths), size))
        return torch.cat([self.march_at_once(query, receiver, part) for part in parts], 1)

    def march_at_once(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """Fields as ``march`` gives them, for all pairs of a link and a ray together."""
        pose = self.scene.receivers[receiver].pose.to(self.middle)
        views = rays.vectors() @ pose.rotation.mT  # (r, 3)
        points = pose.position - self.middle + self.distances[:, None] * views[:, None]  # (r, i, 3)
        samples = self.sample(query, points, views)
        return self.unit * render(samples, self.step, self.gains, self.shifts)

    @torch.no_grad()
    def evaluate(self, batch: Batch) -> Tensor:
        """Values of a batch, at most ``chunk`` links at a time; ``march`` splits further."""
        parts = batch.query.parts(self.chunk)
        return torch.cat([self(Batch(part, batch.directions)).value for part in parts])


def farthest(scene: Scene) -> float:
    """Largest distance from a receiver to a corner of the box of transmitters and receivers [m]."""
    places = scene.positions(scene.lower)
    lower, upper = scene.box
    return torch.maximum(places - lower, upper - places).norm(dim=1).max().item()
