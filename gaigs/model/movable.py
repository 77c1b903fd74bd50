"""Copies of a model for other subcarriers, or for receivers without measurements."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.core.antenna import Receiver
from gaigs.core.propagation import common_gain
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.registry import name_of, registry


class Movable(nn.Module):
    """Base of models whose subcarriers and receivers may be exchanged.

    Attributes:
        any_frequency: True if channels are a function of frequency, read from
            ``scene.task.frequencies``.
        any_receiver: True if the model predicts for receivers without links. In ``of_receivers`` a
            module names its buffers with a row for each receiver; a new receiver gets the mean row.
            A module's method ``take_receivers`` makes all other changes.
    """

    scene: Scene
    links: Any
    calibration: Any
    any_frequency: bool = False
    any_receiver: bool = False

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> Any:
        """A copy of a model with ``any_frequency`` whose labels have other subcarriers [Hz]."""
        scene = self.scene.at_frequencies(frequencies)
        other = self._copied()
        for part in other.modules():
            if hasattr(part, "scene"):
                part.scene = scene
        return other

    @torch.no_grad()
    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Any:
        """A copy of a model with ``any_receiver`` for other receivers, without measurements there.

        Quantities learnt for each receiver, such as a gain, become means over known receivers.

        Args:
            receivers: Receivers of the copy, in place of the model's own.
            known: Numbers of the receivers over which means are taken; None: all.

        Raises:
            ValueError: The model predicts for its own receivers alone, or there are no receivers.

        Example:
            >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
            >>> door = gaigs.Receiver("door", gaigs.Pose.at([3.0, 0.2, 2.0]))
            >>> model.at_receivers([door]).predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape
            torch.Size([2, 1])
        """
        if not self.any_receiver:
            raise ValueError(
                f"model {name_of(self)!r} predicts for its own receivers alone; for others take "
                "mirrored, gaigs, nerf2, friis, path_loss, mean, gaussian_process of levels, or "
                "knn where both ends move"
            )
        receivers = [receivers] if isinstance(receivers, Receiver) else [*receivers]
        for receiver in receivers:
            if not isinstance(receiver, Receiver):
                raise TypeError(
                    f"at_receivers takes gaigs.Receiver objects, got {receiver!r:.100}; "
                    'gaigs.Receiver("door", gaigs.Pose.at([x, y, z])) is one'
                )
        if not receivers or len({receiver.name for receiver in receivers}) < len(receivers):
            names = [receiver.name for receiver in receivers]
            raise ValueError(
                f"at_receivers takes one receiver or more, each with a name of its own, got {names}"
            )
        room = torch.stack(self.scene.box)
        # The front end of a new receiver is unknown.
        scene = replace(self.scene, receivers=tuple(receivers), room=room, responses=None)
        other = self._copied()
        for part in other.modules():
            if hasattr(part, "scene"):
                part.scene = scene
            # With one radio at all places, the radio's only row stays.
            buffers = () if scene.one_radio else getattr(part, "of_receivers", ())
            for name in buffers:
                values = getattr(part, name)  # (receivers, ...)
                mean = common_gain(values if known is None else values[known])
                repeats = (len(receivers), *[1] * mean.ndim)
                setattr(part, name, mean.repeat(repeats))
            if hasattr(part, "take_receivers"):
                part.take_receivers(scene, known)
        other.take_calibration(self)
        return other

    def _copied(self) -> Any:
        """A copy that shares the known links, which are large, the scenes and the calibration."""
        memo = {id(self.links): self.links, id(self.calibration): self.calibration}
        for part in self.modules():
            if hasattr(part, "scene"):
                memo[id(part.scene)] = part.scene
        return copy.deepcopy(self, memo)

    @torch.no_grad()
    def adapt(self, links: Links) -> Any:
        """A copy for new receivers, corrected by a few readings there.

        The error at a receiver is a constant, plus a field over places, plus noise. Their variances
        come from known receivers, predicted as if they were new. See ``gaigs.model.adapted``.

        Args:
            links: Readings at one or several receivers without training links; a split is not used.

        Raises:
            TypeError: The links are not ``gaigs.Links``.
            ValueError: The labels are not levels or are of another task, too few receivers show how
                receivers differ, or the model is already adapted.

        Example:
            >>> levels = gaigs.links("synthetic_rssi", transmitters=100)
            >>> model = gaigs.train("path_loss", levels)
            >>> door = gaigs.Receiver("door", gaigs.Pose.at([3.0, 0.2, 2.0]))
            >>> places = [[1.0, 2.0, 1.5], [2.0, 1.0, 1.5], [4.0, 2.5, 1.0]]
            >>> few = {"transmitters": places, "receivers": [door], "labels": [-50.0, -43.0, -47.0]}
            >>> model.adapt(gaigs.links(task="rssi", **few)).predict([1.0, 1.0, 1.0]).shape
            torch.Size([1])
        """
        if self.scene.one_radio:
            raise ValueError(
                "adapt learns the level of a new receiver, and the model's receivers are places of "
                "one radio, whose level it knows; train with all readings"
            )
        if not isinstance(links, Links):
            raise TypeError(f"adapt takes links, got {type(links).__name__}")
        if links.task.name != self.scene.task.name:
            raise ValueError(
                f"adapt takes links of the model's task, {self.scene.task.name!r}, got "
                f"{links.task.name!r}"
            )
        moved = self.at_receivers(links.receivers)
        new = moved.calibration
        if new is None or new.scatter is None:
            raise ValueError(
                "adapt takes a model of levels, calibrated with links of three receivers or more, "
                "such as path_loss or mirrored"
            )
        adapted = registry("model").get("adapted")(moved.scene, moved).eval()
        adapted.take(links, new.scatter)
        # ``Adapted.deviations`` scale the intervals of the model without readings.
        adapted.calibration = replace(new, widths=None, elsewhere=None)
        return adapted

    def take_calibration(self, other: "Movable") -> None:
        """Copies another model's calibration for receivers without links.

        If receivers are places of one radio, all have links, and the usual calibration is copied.
        """
        self.calibration = other.calibration
        if other.calibration is not None and not self.scene.one_radio:
            self.calibration = other.calibration.at_receivers(len(self.scene.receivers))
