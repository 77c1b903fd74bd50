"""Models predict a label from who sends, who hears and, for spectra, into which directions."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.data import Grid, Links, Scene


@dataclass(frozen=True)
class Batch:
    """Links, each of one transmitter to one receiver.

    Attributes:
        transmitters: Positions, world frame (b, 3) [m].
        receivers: Indices into the scene's receivers (b,).
        grid: Directions to predict; None where the label is no spectrum.
        labels: What was measured, (b, rows, columns) or (b,); None when predicting.
    """

    transmitters: Float[Tensor, "b 3"]
    receivers: Int[Tensor, "b"]
    grid: Grid | None
    labels: Tensor | None = None

    def thin(self, rows: slice, columns: slice) -> "Batch":
        """The same links seen in fewer directions."""
        return replace(self, grid=self.grid.thin(rows, columns), labels=self.labels[:, rows, columns])

    def to(self, device: torch.device) -> "Batch":
        """The same batch on another device."""
        move = lambda part: None if part is None else part.to(device)
        return Batch(*map(move, (self.transmitters, self.receivers, self.grid, self.labels)))


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
    def predict(
        self,
        transmitters: Float[Tensor, "*points 3"],
        receiver: int | str | Int[Tensor, "*points"] = 0,
        batch_size: int = 16,
    ) -> Tensor:
        """Labels for transmitters anywhere: a point, a list of them, or a grid.

        Args:
            transmitters: Positions, world frame [m]; anything that becomes a float tensor.
            receiver: Name, or index into the scene's receivers; or the index of each position's receiver.
            batch_size: Transmitters worked on at a time.

        Returns:
            For each position a spectrum (rows, columns), scaled as the training labels were
            (``model.scene.normalisation``), or an RSSI [dBm]; on the device of the model.

        Raises:
            ValueError: The positions are not (..., 3) or not finite, or there is no such receiver.
        """
        device = next((tensor.device for tensor in self.state_dict().values()), None)
        transmitters = torch.as_tensor(transmitters, dtype=torch.float32, device=device)
        if not transmitters.ndim or transmitters.shape[-1] != 3:
            raise ValueError(f"transmitters must be (..., 3) positions [m], got shape {tuple(transmitters.shape)}")
        points = transmitters.reshape(-1, 3)
        if not torch.isfinite(points).all():
            row = int((~torch.isfinite(points)).any(1).nonzero()[0])
            raise ValueError(f"transmitters must be finite, got {points[row].tolist()} in row {row}")
        receivers = self._index(receiver, transmitters)
        training = self.training
        self.eval()
        parts = zip(points.split(batch_size), receivers.split(batch_size), strict=True)
        batches = (Batch(*part, self.scene.grid).to(points.device) for part in parts)
        labels = torch.cat([self(batch).label for batch in batches])
        self.train(training)
        return labels.reshape(transmitters.shape[:-1] + labels.shape[1:])

    def _index(self, receiver: int | str | Tensor, transmitters: Float[Tensor, "*points 3"]) -> Int[Tensor, "n"]:
        """The index of each position's receiver."""
        names = [receiver.name for receiver in self.scene.receivers]
        listed = ", ".join(f"{i} = {name}" for i, name in enumerate(names))
        try:
            index = torch.as_tensor(names.index(receiver) if isinstance(receiver, str) else receiver)
        except (ValueError, TypeError):  # no such name, or names where numbers must be
            index = torch.tensor(-1)
        if index.dtype not in (torch.int64, torch.int32) or ((index < 0) | (index >= len(names))).any():
            raise ValueError(f"receiver must be one of {listed}, got {receiver!r}")
        if index.ndim and index.shape != transmitters.shape[:-1]:
            raise ValueError(
                f"receivers must be one, or one for each of the {tuple(transmitters.shape[:-1])} positions, got "
                f"{tuple(index.shape)}"
            )
        return index.to(transmitters.device).expand(transmitters.shape[:-1]).reshape(-1)
