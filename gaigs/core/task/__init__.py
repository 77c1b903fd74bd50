"""Tasks: shape, unit and scores of a label, and the part of a batch that a training step reads."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, thin_labels

Thinning = Callable[[Batch, torch.Generator], Batch]
"""A batch of whole labels -> the part of it that a training step reads."""


NUMBERS = 512
"""Most numbers of a label by which places are told apart; arrays resolve fewer."""


class Metric(NamedTuple):
    """A number of a table.

    Attributes:
        title: Name for a reader, with the unit in brackets.
        higher_is_better: True for a similarity, False for an error.
        is_brief: True if a terminal's table shows it too.

    Example:
        >>> gaigs.registries["task"].get("rssi").metrics()["mae_db"]
        Metric(title='MAE [dB]', higher_is_better=False, is_brief=True)
    """

    title: str
    higher_is_better: bool
    is_brief: bool = True


class Task(ABC):
    """The contract of kind ``task``. A data set makes its task, and a checkpoint stores it with the
    scene.

    Attributes:
        name: The registered name.
        quantity: Name of the labelled quantity.
        unit: Of a label; empty for a ratio.
        higher_is_better: True if ``monitor`` is a similarity, False for an error.
        dtype: Of labels and predictions.
        is_noisy: True if labels of one place scatter, so that fine detail cannot be learnt.
        directions: Directions of a label's pixels; None for a label without.
        lowest: Least possible number of a real label.
        limits: Bounds of the numbers of labels that are read: others are of another unit, or marks.
        beyond: What errors add on numbers beyond these bounds.
    """

    name: str
    quantity: str
    unit: str = ""
    higher_is_better: bool
    dtype: torch.dtype = torch.float32
    is_noisy: bool = False
    directions: Grid | None = None
    lowest: float = -math.inf
    limits: tuple[float, float] = (-math.inf, math.inf)
    beyond: str = ""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Of one label."""

    @property
    def is_scalar(self) -> bool:
        """True if a label is one real number."""
        return self.shape == () and not self.dtype.is_complex

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
        """The score of two labels of one data set; by default ``monitor``."""
        return self.monitor

    @abstractmethod
    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """Scores of every sample (k,) by name, float64 on the CPU; ``monitor`` among them.

        Raises:
            ValueError: Labels or values are not (k, *shape), or not finite.
        """

    @abstractmethod
    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """The numbers of a table by name, in the order of ``metrics``, from the result of
        ``scores``.

        Raises:
            ValueError: There is no sample.
        """

    def logged(self, means: dict[str, float]) -> dict[str, float]:
        """Values logged after a validation, from the mean of each score over its links; by default
        these means.
        """
        return means

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor] | None:
        """Scores of a mean of many labels as the prediction, from scores of one label as that of
        another.

        Labels that scatter alike and independently leave half of the squared difference. By default
        None: unknown.
        """
        return None

    @classmethod
    @abstractmethod
    def metrics(cls) -> dict[str, Metric]:
        """The numbers that ``summarise`` may give; runs are compared by the first that it gives."""

    def options(self) -> dict:
        """Arguments of the constructor, as plain tensors, lists, numbers and strings; by default
        none.
        """
        return {}

    def state(self) -> dict:
        """The task as a checkpoint stores it: ``registry("task").build(state)`` makes it anew."""
        return {"name": self.name, **self.options()}

    def align(self, labels: Tensor, values: Tensor) -> Tensor:
        """Labels turned onto predictions by all that is unknown of each link; by default as they
        are.

        Losses, kriging and look-ups compare the result with the predictions. Shapes are (k,
        *shape); either k may be 1.
        """
        return labels

    def fingerprint(self, values: Tensor) -> Tensor:
        """Real numbers (k, m) of labels or predictions that change steadily with the place; by
        default at most ``NUMBERS`` of their own, evenly spread."""
        return thin_labels(values, NUMBERS).float()

    def thinning(self) -> Thinning:
        """The part of a batch that a step reads, by default all; parameters are options of
        ``training.thinning``.
        """
        return lambda batch, generator: batch

    def packed(self, values: Tensor) -> np.ndarray:
        """Labels or predictions for ``predictions.npz``; by default as they are."""
        return values.numpy()

    def stored(
        self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]
    ) -> dict[str, np.ndarray]:
        """Arrays of a model for ``predictions.npz``, by the key before ``_<model>``; by default all
        scores.
        """
        return {name: score.numpy() for name, score in scores.items()}


def need_samples(scores: Tensor) -> None:
    if not len(scores):
        raise ValueError(
            "a summary needs at least one sample, got none; the split leaves nothing to test on"
        )


def check_range(task: Task, labels: Tensor, name: str) -> None:
    """Raises a ``ValueError`` unless real labels are NaN or within the task's limits."""
    if task.dtype.is_complex:
        return
    flat, (lowest, highest) = labels.reshape(len(labels), -1), task.limits
    wrong = ((flat < lowest) | (flat > highest + 1e-6)).any(1)
    if wrong.any():
        row = int(wrong.int().argmax())
        low, high = flat[row][~flat[row].isnan()].aminmax()
        bounds = f"from {lowest:g} to {highest:g} {task.unit}".rstrip()
        raise ValueError(
            f"{name} of task {task.name!r} must be {bounds}, nan where nothing was heard; "
            f"those of number {row} are from {low:g} to {high:g}{task.beyond}"
        )


def check_values(labels: Tensor, values: Tensor, shape: tuple[int, ...], samples: str) -> None:
    """Raises a ``ValueError`` unless labels and values are (k, *shape) and finite."""
    if labels.shape != values.shape or labels.ndim < 1 or tuple(labels.shape[1:]) != tuple(shape):
        given = f"{tuple(labels.shape)} and {tuple(values.shape)}"
        raise ValueError(f"labels and predictions must both be {('k', *shape)}, got {given}")
    for name, tensor in (("labels", labels), ("predictions", values)):
        broken = ~tensor.isfinite()[..., None].flatten(1).all(1)
        if broken.any():
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in {int(broken.sum())} of "
                f"{len(tensor)} {samples}, first "
                f"in number {int(broken.int().argmax())}; the training diverged or the file is "
                "damaged"
            )
