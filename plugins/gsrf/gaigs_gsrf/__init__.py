"""GSRF: complex-valued Gaussians that send by direction and turn the phase of waves that pass
through them.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene, check_one_carrier
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.splatting.gaussians import write_ply
from gaigs_gsrf.gaussians import ComplexGaussians
from gaigs_gsrf.rendering import render


class Gsrf(Model):
    """Radiance towards the transmitter, composited along the rays of a sphere about the receiver,
    then pooled.

    S(u) = sum_i psi_i alpha_i(u) prod_{j<i} (1 - alpha_j(u)) exp(j phi_j w_j(u)), front to back by
    distance to the receiver; ``gaigs_gsrf.rendering`` has the footprint w and alpha,
    ``gaigs_gsrf.gaussians`` the radiance psi.

    The Gaussians on a ray do not depend on the transmitter; they are computed once for each
    receiver.

    Args:
        scene: Receivers and task.
        pooling: Configuration of the pooling of the complex map; None if the task has no pooling.
        degree: L of the radiance's Fourier-Legendre series.
        radius: Radius of the sphere on which footprints are measured [m].
        count, pitch, margin, opacity, signal: Gaussians at the start, see ``ComplexGaussians``.

    Raises:
        ValueError: The links have several carriers; the pooling does not give the task's labels
            from complex maps; an option is out of range.

    Source: GSRF (NeurIPS 2025). There the transmitter moves and a receiver hears spectra; the
        README says what of it we took.
    """

    learning_rates: Mapping[str, float] = {
        **ComplexGaussians.learning_rates,
        **Model.learning_rates,
    }

    def __init__(
        self,
        scene: Scene,
        pooling: dict | None,
        degree: int,
        radius: float,
        count: int,
        pitch: float,
        margin: float,
        opacity: float,
        signal: float,
    ):
        super().__init__(scene)
        check_one_carrier("model 'gsrf'", scene)
        if not 0 < radius < math.inf:
            raise ValueError(f"model.radius must be positive [m], got {radius}")
        if pooling is None:
            raise ValueError(
                f"model 'gsrf' has no pooling for labels of task {scene.task.name!r}; use another "
                "model"
            )
        self.radius = radius
        self.pooling = registry("pooling").build(pooling, scene=scene)
        if self.pooling.channels % 2:
            raise ValueError(
                f"model 'gsrf' renders complex maps, and pooling {pooling['name']!r} takes "
                f"{self.pooling.channels} real channel; take one that takes two"
            )
        grid = self.pooling.grid or scene.task.directions
        if grid is None:
            raise ValueError(
                f"labels of task {scene.task.name!r} have no directions, so the pooling must have "
                f"a grid of its own, and {pooling['name']} has none; take the task's own pooling"
            )
        zone = self.pooling.zone
        if self.pooling.grid is None:
            zone = grid.elevations.min().item(), grid.elevations.max().item()
        self.gaussians = ComplexGaussians(
            scene,
            zone,
            self.pooling.channels,
            degree,
            radius,
            count,
            pitch,
            margin,
            opacity,
            signal,
        )

    def fit(self, links: Links) -> None:
        """Fits the pooling."""
        self.pooling.fit(links)

    def forward(self, batch: Batch) -> Prediction:
        places, which = batch.query.unique(with_receivers=False)
        radiance = self.gaussians.radiance(places.transmitters)
        by_receiver = []
        values = []
        # Without links the first receiver gives an empty value of a label's shape.
        for receiver in batch.query.receivers.unique().tolist() or [0]:
            links = (batch.query.receivers == receiver).nonzero()[:, 0]
            query = batch.query[links]
            image = self._map(radiance[which[links]], receiver, batch)
            value = self.pooling(image, query, batch.directions)
            if self.pooling.grid is None and batch.directions is not None:
                # A list of rays was rendered as one row.
                value = value.reshape(len(query), *batch.directions.shape)
            by_receiver.append(links)
            values.append(value)
        order = torch.cat(by_receiver).argsort()
        return Prediction(torch.cat(values)[order], {})

    def _map(
        self, radiance: Complex[Tensor, "b n s"], receiver: int, batch: Batch
    ) -> Float[Tensor, "b c rows columns"]:
        """The receiver's map: the real parts of all complex channels, then the imaginary ones."""
        directions = self.pooling.grid or batch.directions or self.scene.task.directions
        vectors = directions.flatten().to(self.gaussians.means).vectors()
        pose = self.scene.receivers[receiver].pose
        waves = render(self.gaussians, radiance, pose, vectors, self.radius)  # (b, s, rays)
        shape = directions.shape if len(directions.shape) == 2 else (1, *directions.shape)
        return torch.cat((waves.real, waves.imag), 1).unflatten(2, shape)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {name: [parameter] for name, parameter in self.gaussians.named_parameters()}
        network = list(self.pooling.parameters())
        return groups | ({"network": network} if network else {})

    @property
    def primitives(self) -> ComplexGaussians:
        return self.gaussians

    def rendering(self, batch: Batch) -> Callable[[], object]:
        """The map for the links to the first link's receiver, without their radiance."""
        receiver = int(batch.query.receivers[0])
        query: Query = batch.query[(batch.query.receivers == receiver).nonzero()[:, 0]]
        with torch.no_grad():
            radiance = self.gaussians.radiance(query.transmitters)
        return lambda: self._map(radiance, receiver, batch)

    def export(self, folder: Path) -> None:
        """``gaussians.ply`` for 3-D splatting viewers, with the constant term of the series."""
        values = dict(self.gaussians.named_parameters())
        values["signal"] = values["signal"][..., :1]
        comment = f"gaigs: {self.pooling.channels} signal channels"
        write_ply(folder / "gaussians.ply", values, comment)
