"""Models predict a label from who sends, who hears and, for spectra, into which directions."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.data import Grid, Links, Scene


@dataclass(frozen=True)
class Batch:
    """Links of several transmitters to one receiver.

    Attributes:
        transmitters: Positions, world frame (b, 3) [m].
        receiver: Index into the scene's receivers.
        grid: Directions to predict; None where the label is no spectrum.
        labels: What was measured, (b, rows, columns) or (b,); None when predicting.
    """

    transmitters: Float[Tensor, "b 3"]
    receiver: int
    grid: Grid | None
    labels: Tensor | None = None

    def thin(self, rows: slice, columns: slice) -> "Batch":
        """The same links seen in fewer directions."""
        return replace(self, grid=self.grid.thin(rows, columns), labels=self.labels[:, rows, columns])

    def to(self, device: torch.device) -> "Batch":
        """The same batch on another device."""
        grid = self.grid and Grid(self.grid.elevations.to(device), self.grid.azimuths.to(device))
        labels = None if self.labels is None else self.labels.to(device)
        return Batch(self.transmitters.to(device), self.receiver, grid, labels)


class Prediction(NamedTuple):
    """What a model gives for a batch.

    Attributes:
        label: (b, rows, columns) spectra or (b,) RSSI [dBm].
        penalties: Scalars to be added to the loss, by name.
    """

    label: Tensor
    penalties: dict[str, Tensor]


class Model(nn.Module):
    """The contract of kind ``model``: ``forward`` takes a ``Batch`` and gives a ``Prediction``.

    A model with parameters is trained by gradient descent, and all that ``predict`` needs is in its state dict. One
    without parameters, a look-up, learns in ``fit`` alone and is not stored.

    Args:
        scene: Receivers, grid and normalisation of the labels.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene

    def fit(self, links: Links) -> None:
        """Takes what can be computed from the training links at once; by default nothing."""

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the name of the learning rate they follow."""
        return {"network": list(self.parameters())}

    @torch.no_grad()
    def predict(self, transmitters: Float[Tensor, "n 3"], receiver: int = 0, batch_size: int = 16) -> Tensor:
        """Labels for transmitters anywhere.

        Args:
            transmitters: Positions, world frame [m]; anything that becomes a float tensor.
            receiver: Index into the scene's receivers.
            batch_size: Transmitters worked on at a time.

        Returns:
            Spectra (n, rows, columns), scaled as the training labels were (``model.scene.normalisation``).

        Raises:
            ValueError: The positions are not (n, 3) or not finite, or there is no such receiver.
        """
        device = next((tensor.device for tensor in self.state_dict().values()), None)
        transmitters = torch.as_tensor(transmitters, dtype=torch.float32, device=device)
        if transmitters.ndim != 2 or transmitters.shape[1] != 3:
            raise ValueError(f"transmitters must be (n, 3) positions in metres, got shape {tuple(transmitters.shape)}")
        if not torch.isfinite(transmitters).all():
            row = int((~torch.isfinite(transmitters)).any(1).nonzero()[0])
            raise ValueError(f"transmitters must be finite, got {transmitters[row].tolist()} in row {row}")
        if not 0 <= receiver < len(self.scene.receivers):
            names = ", ".join(f"{i} = {r.name}" for i, r in enumerate(self.scene.receivers))
            raise ValueError(f"receiver must be one of {names}, got {receiver}")
        training = self.training
        self.eval()
        batches = (Batch(part, receiver, self.scene.grid).to(part.device) for part in transmitters.split(batch_size))
        labels = torch.cat([self(batch).label for batch in batches])
        self.train(training)
        return labels
