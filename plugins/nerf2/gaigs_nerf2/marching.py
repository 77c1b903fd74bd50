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
        attenuations: a, decay of a passing wave's amplitude (r, i) [1/m].
        turns: p, rate of its phase (r, i) [rad/m].
        amplitudes: s, of the wave that a sample sends towards the receiver for each link (b, r, i,
            c).
        phases: phi, of the same (b, r, i, c) [rad].
    """

    attenuations: Float[Tensor, "r i"]
    turns: Float[Tensor, "r i"]
    amplitudes: Float[Tensor, "b r i c"]
    phases: Float[Tensor, "b r i c"]


def render(
    samples: Samples, step: float, gains: Float[Tensor, " i"], shifts: Float[Tensor, "i c"]
) -> Complex[Tensor, "b r c"]:
    """S = sum_i g_i s_i exp(j (phi_i + x_i)) prod_{j<i} (1 - alpha_j) exp(j p_j d), alpha_j = 1 -
    exp(-a_j d).

    As 1 - alpha_j is exp(-a_j d), the products are exponentials of sums: none is rounded to 0
    within, nor to 1.

    Args:
        samples: Along each ray.
        step: d, from one sample to the next [m].
        gains: g, factor of the distance.
        shifts: x, phase of the distance [rad].

    Source: NeRF², 2023, with its 0.025 / t_i of spectra as gains and its 2 pi t_i / lambda of RSSI
    as shifts.
    """
    passed, turned = (
        step * (values.cumsum(1) - values) for values in (samples.attenuations, samples.turns)
    )
    strengths = (gains * (-passed).exp())[None, ..., None] * samples.amplitudes
    phases = samples.phases + (turned[..., None] + shifts)
    return torch.complex((strengths * phases.cos()).sum(2), (strengths * phases.sin()).sum(2))


def check_octaves(octaves: int) -> None:
    """Sees to it that float32 holds the features sin 2^k x for all k below ``octaves``.

    Raises:
        ValueError: It does not.
    """
    if not 0 <= octaves <= MAX_OCTAVE:
        raise ValueError(
            f"model.octaves must be at least 0 and at most {MAX_OCTAVE}, got {octaves}"
        )


class RayMarching(Model):
    """A model of values at samples along rays from the receivers; a subclass defines them in
    ``sample``.

    Samples stand in the middles of equal steps. ``gaigs_nerf2.readings`` turns the sums along the
    rays into spectra, RSSI and channels. The unit of strength is such that the untrained model
    gives the training labels' mean amplitude.

    Args:
        scene: Receivers, task, carrier.
        samples: Along a ray.
        far: Where rays end [m]; None: at the corner farthest from any receiver of the box that
            holds the training transmitters and the receivers.
        rays: Rows and columns of the rays over the sphere, where labels have no directions.
        frequency: Carrier of RSSI whose data say none [Hz].

    Attributes:
        grid: Rays that are marched whatever directions are asked for; None: those asked for.

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
        """Puts samples evenly along the rays, up to a distance [m]."""
        self.register_buffer("far", torch.tensor(far, dtype=torch.float64))
        self.step = far / self.samples
        distances = self.step * (torch.arange(self.samples, dtype=torch.float64) + 0.5)
        shifts = self.reading.shifts(distances).remainder(
            2 * math.pi
        )  # which float32 then resolves
        for name, values in (
            ("distances", distances),
            ("gains", self.reading.gains(distances)),
            ("shifts", shifts),
        ):
            self.register_buffer(name, values.float(), persistent=False)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # Of a copy at other receivers the rays are as long as they were; checkpoints of before
        # have no length.
        far = state_dict.setdefault(f"{prefix}far", self.far)
        if far != self.far:
            self._divide(far.item())
        super()._load_from_state_dict(state_dict, prefix, *args)

    @abstractmethod
    def sample(
        self, query: Query, points: Float[Tensor, "r i 3"], views: Float[Tensor, "r 3"]
    ) -> Samples:
        """Properties of points, for links to one receiver.

        Args:
            query: The links.
            points: Relative to the middle of the transmitters' box, ``middle`` [m].
            views: Unit vectors along which the rays go, world frame.
        """

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Takes the unit of strength from some training links, and of channels the sign of their
        phases.
        """
        self.reading.fit(links)
        train, (count, most) = links.split.train, CALIBRATION
        some = train[torch.linspace(0, len(train) - 1, min(count, len(train))).long()]
        batch = links.batch(some).to(self.unit.device)
        if batch.directions is not None:
            stride = -(-batch.labels[0].numel() // most)
            batch = replace(
                batch,
                directions=batch.directions.flatten()[::stride],
                labels=batch.labels.flatten(1)[:, ::stride],
            )
        self.unit.fill_(1.0)
        wanted, given = (
            self.reading.amplitudes(values, batch.query)
            for values in (batch.labels, self(batch).value)
        )
        if batch.labels.is_complex():  # each link has a vote, however weak or loud it is
            wanted = self.reading.amplitudes(links.labels[train], links.query[train])
            wanted, given = (part.flatten(1).mean(1).quantile(0.5) for part in (wanted, given))
        self.unit.copy_(wanted.mean() / given.mean())

    def forward(self, batch: Batch) -> Prediction:
        directions = (self.grid or batch.directions or self.scene.task.directions).to(self.middle)
        query, rays = batch.query, directions.flatten()
        links, values = [], []
        for receiver in query.receivers.unique().tolist() or [
            0
        ]:  # no links have a label's shape too
            links.append((query.receivers == receiver).nonzero()[:, 0])
            own = query[links[-1]]
            values.append(self.reading(self.march(own, receiver, rays), own, directions))
        return Prediction(torch.cat(values)[torch.cat(links).argsort()], {})

    def march(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """Fields along rays at one receiver, for links to it.

        Without gradients at most ``chunk`` pairs of a link and a ray at a time. All links share the
        attenuation and phase along a ray, so rays are parted, not links.
        """
        if torch.is_grad_enabled() or not len(query):
            return self.march_at_once(query, receiver, rays)
        size = max(1, self.chunk // len(query))
        parts = (rays[start : start + size] for start in range(0, len(rays.azimuths), size))
        return torch.cat([self.march_at_once(query, receiver, part) for part in parts], 1)

    def march_at_once(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """``march`` for all pairs of a link and a ray together."""
        pose = self.scene.receivers[receiver].pose.to(self.middle)
        views = rays.vectors() @ pose.rotation.mT
        points = pose.position - self.middle + self.distances[:, None] * views[:, None]
        return self.unit * render(
            self.sample(query, points, views), self.step, self.gains, self.shifts
        )

    @torch.no_grad()
    def evaluate(self, batch: Batch) -> Tensor:
        """Values of a batch, at most ``chunk`` links at a time; ``march`` splits further."""
        parts = batch.query.parts(self.chunk)
        return torch.cat([self(Batch(part, batch.directions)).value for part in parts])


def farthest(scene: Scene) -> float:
    """From any receiver to the farthest corner of the box that holds the training transmitters and
    receivers [m].
    """
    places = scene.positions(scene.lower)
    lower, upper = scene.box
    return torch.maximum(places - lower, upper - places).norm(dim=1).max().item()
