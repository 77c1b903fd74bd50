"""Tasks: shape, unit and scores of a label, and the part of a batch that a step uses."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, thin_labels

Thinning = Callable[[Batch, torch.Generator], Batch]
"""A batch of whole labels -> the part of it that a training step reads."""


class Metric(NamedTuple):
    """A column of a table of scores.

    Attributes:
        title: Name in tables and figures, with the unit in brackets.
        higher_is_better: True for a similarity, False for an error.
        is_brief: True if the terminal's table shows the column, too.

    Example:
        >>> gaigs.registries["task"].get("rssi").metrics()["mae_db"]
        Metric(title='MAE [dB]', higher_is_better=False, is_brief=True)
    """

    title: str
    higher_is_better: bool
    is_brief: bool = True


class Axis(NamedTuple):
    """An axis of a label: its values, and their unit or an empty text."""

    values: np.ndarray
    unit: str = ""


class Task(ABC):
    """Base class of components of kind ``task``.

    A data set makes its task, and a checkpoint stores it with the scene.

    Attributes:
        name: The registered name.
        quantity: Name of the labelled quantity.
        unit: Unit of a label; empty for a ratio.
        higher_is_better: True if ``monitor`` is a similarity, False for an error.
        dtype: Type of labels and predictions.
        is_noisy: True if labels at one place scatter, so that fine detail cannot be learnt.
        directions: Directions of a label's pixels; None if labels have none.
        elements: Elements of an array, the first axis of channels; 1 for other labels.
        frequencies: Subcarriers [Hz], the last axis of channels; None for other labels.
        phase: Unknown part of a channel's phase, see ``Csi``.
        lowest: Least possible value of a real label.
        limits: Bounds of labels in files. Values beyond them have another unit, or mean "not
            received".
        beyond: Advice in errors about values beyond these bounds.
    """

    name: str
    quantity: str
    unit: str = ""
    higher_is_better: bool
    dtype: torch.dtype = torch.float32
    is_noisy: bool = False
    directions: Grid | None = None
    elements: int = 1
    frequencies: Any = None
    phase: str = "known"
    lowest: float = -math.inf
    limits: tuple[float, float] = (-math.inf, math.inf)
    beyond: str = ""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of one label."""

    @property
    def is_scalar(self) -> bool:
        """True if a label is one real number."""
        return self.shape == () and not self.dtype.is_complex

    @property
    def is_channel(self) -> bool:
        """True if a label is a channel (elements, subcarriers)."""
        return self.frequencies is not None

    @property
    def error_unit(self) -> str:
        """Unit of a difference of labels; by default ``unit``."""
        return self.unit

    @property
    def trends(self) -> tuple[str, ...]:
        """Names of the look-ups among which a Gaussian process chooses its trend."""
        return ("mean", "shaped_path_loss") if self.is_scalar else ("mean",)

    @property
    @abstractmethod
    def monitor(self) -> str:
        """Score whose mean over the validation links picks the best checkpoint."""

    @property
    def normalisation(self) -> str:
        """Scale of the labels, in words of docs/data.md; by default their unit."""
        return self.unit

    @property
    def pair_score(self) -> str:
        """Title of ``compared_by``, with its unit in brackets; by default its name."""
        return self.compared_by

    @property
    def compared_by(self) -> str:
        """Name of the score that compares two labels of a data set; by default ``monitor``."""
        return self.monitor

    @abstractmethod
    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """Scores of every sample (k,) by name, float64 on the CPU; ``monitor`` among them.

        Raises:
            ValueError: Labels or values are not (k, *shape), or not finite.
        """

    @abstractmethod
    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """The numbers of a table by name, in the order of ``metrics``.

        Raises:
            ValueError: There is no sample.
        """

    def logged(self, means: dict[str, float]) -> dict[str, float]:
        """Values logged after a validation.

        Args:
            means: Mean of each score over the validation links, which is logged by default.
        """
        return means

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor] | None:
        """Scores of the mean of many labels at a place as the prediction of each of them.

        Two labels with independent noise of variance s² have a mean square difference of 2 s²; a
        label and the mean of many labels have s².

        Args:
            scores: Scores of one label as the prediction of another at the same place.

        Returns:
            The scores; by default None, for a task without such a rule.
        """
        return None

    @classmethod
    @abstractmethod
    def metrics(cls) -> dict[str, Metric]:
        """Possible columns of ``summarise``; runs are compared by the first one present."""

    def axes(self) -> dict[str, Axis]:
        """The axes of a label by name: its directions, or by default numbered entries."""
        if self.directions is not None:
            elevations = np.degrees(self.directions.elevations.double().numpy()).round(6)
            azimuths = np.degrees(self.directions.azimuths.double().numpy()).round(6)
            return {"elevation": Axis(elevations, "degree"), "azimuth": Axis(azimuths, "degree")}
        return {
            f"axis_{axis}": Axis(np.arange(size, dtype=np.int32))
            for axis, size in enumerate(self.shape)
        }

    def at_frequencies(self, frequencies: Tensor) -> "Task":
        """The task of the same labels at other subcarriers [Hz].

        Raises:
            ValueError: Labels have no subcarriers.
        """
        raise ValueError(f"labels of task {self.name!r} have no subcarriers")

    def options(self) -> dict:
        """Arguments of the constructor, as plain tensors, lists, numbers and strings."""
        return {}

    def state(self) -> dict:
        """The task in a checkpoint's form; ``registry("task").build(state)`` rebuilds it."""
        return {"name": self.name, **self.options()}

    def align(self, labels: Tensor, values: Tensor) -> Tensor:
        """Labels with their unknown part, such as a phase for each link, fitted to predictions.

        By default labels are unchanged. Losses, kriging and look-ups compare the result with the
        predictions. Shapes are (k, *shape); either k may be 1.
        """
        return labels

    def phase_sign(self, labels: Tensor, waves: Tensor, receivers: Tensor) -> int:
        """The sign with which phases of labels follow path lengths, see ``Csi.phase_sign``.

        It is 0 for labels without phases, as by default.
        """
        return 0

    def fingerprint(self, values: Tensor) -> Tensor:
        """Real numbers (k, m) of labels or predictions that change smoothly with the place.

        By default these are at most 512 evenly spread values of the label, more than an array
        resolves.
        """
        return thin_labels(values, 512).float()

    def thinning(self) -> Thinning:
        """The part of a batch that a training step uses; by default all of it.

        Parameters of a subclass's method are the options of ``training.thinning``.
        """
        return lambda batch, generator: batch

    def packed(self, values: Tensor) -> np.ndarray:
        """Labels or predictions for ``predictions.npz``; by default unchanged."""
        return values.numpy()

    def stored(
        self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]
    ) -> dict[str, np.ndarray]:
        """Arrays for ``predictions.npz``, by default all scores; the model's name is appended."""
        return {name: score.numpy() for name, score in scores.items()}


def need_samples(scores: Tensor) -> None:
    """Raises a ``ValueError`` if there is no sample."""
    if not len(scores):
        raise ValueError(
            "a summary needs at least one sample, got none; the split leaves nothing to test on"
        )


def check_range(task: Task, labels: Tensor, name: str) -> None:
    """Raises a ``ValueError`` unless real labels are NaN or within the task's limits.

    ``name`` is the labels' name in the error. Complex labels have no limits.
    """
    if task.dtype.is_complex:
        return
    lowest, highest = task.limits
    flat = labels.reshape(len(labels), -1)  # (k, numbers)
    wrong = ((flat < lowest) | (flat > highest + 1e-6)).any(1)  # 1e-6 for rounding
    if wrong.any():
        row = int(wrong.int().argmax())  # the first wrong one
        low, high = flat[row][~flat[row].isnan()].aminmax()
        bounds = f"from {lowest:g} to {highest:g} {task.unit}".rstrip()
        raise ValueError(
            f"{name} of task {task.name!r} must be {bounds}, nan where nothing was heard; "
            f"those of number {row} are from {low:g} to {high:g}{task.beyond}"
        )


def check_values(labels: Tensor, values: Tensor, shape: tuple[int, ...], samples: str) -> None:
    """Raises a ``ValueError`` unless labels and values are (k, *shape) and finite.

    ``samples`` is the noun for k samples in errors, such as ``spectra``.
    """
    if labels.shape != values.shape or labels.ndim < 1 or tuple(labels.shape[1:]) != tuple(shape):
        given = f"{tuple(labels.shape)} and {tuple(values.shape)}"
        raise ValueError(f"labels and predictions must both be {('k', *shape)}, got {given}")
    for name, tensor in (("labels", labels), ("predictions", values)):
        broken = ~tensor.isfinite()[..., None].flatten(1).all(1)  # (k,); scalars get an axis
        if broken.any():
            count = f"{int(broken.sum())} of {len(tensor)} {samples}"
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in {count}, first in number "
                f"{int(broken.int().argmax())}; the training diverged or the file is damaged"
            )
