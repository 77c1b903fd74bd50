"""Tasks say what a label is: its shape, unit and scores, how it is drawn, and what a run keeps of it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaigs.directions import Grid
from gaigs.query import Batch

Thinning = Callable[[Batch, torch.Generator], Batch]
"""A batch of whole labels -> the part of it that a training step looks at."""


class Metric(NamedTuple):
    """A number of a table.

    Attributes:
        title: What a reader calls it, with its unit in brackets.
        higher_is_better: Whether it is a similarity; else it is an error.
        is_brief: Whether a terminal's table shows it too, which has little room.

    Example:
        >>> gaigs.registries["task"].get("rssi").metrics()["mae_db"]
        Metric(title='MAE [dB]', higher_is_better=False, is_brief=True)
    """

    title: str
    higher_is_better: bool
    is_brief: bool = True


class Task(ABC):
    """The contract of kind ``task``. A data set makes its task, and a checkpoint stores it with the scene.

    Attributes:
        name: The registered name.
        quantity: What a label is, in a word or two.
        unit: Of a label; empty for a ratio.
        monitor: The score by whose mean over the validation links the best checkpoint is chosen.
        higher_is_better: Whether that is a similarity; else it is an error.
        dtype: Of labels and predictions.
        is_noisy: Whether labels scatter however near to each other they were taken, so that fine detail is not learnt.
        directions: Those of a label's pixels; None where a label has none.
    """

    name: str
    quantity: str
    unit: str = ""
    monitor: str
    higher_is_better: bool
    dtype: torch.dtype = torch.float32
    is_noisy: bool = False
    directions: Grid | None = None

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Of one label."""

    @property
    def normalisation(self) -> str:
        """How labels were scaled, in words of docs/data.md; by default their unit."""
        return self.unit

    @property
    def pair_score(self) -> str:
        """What a reader calls ``compared_by``, with its unit in brackets; by default its name."""
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
        """The numbers of a table, the names of ``metrics`` in their order, from what ``scores`` gives.

        Raises:
            ValueError: There is no sample.
        """

    def logged(self, means: dict[str, float]) -> dict[str, float]:
        """What the log has of a validation, by name, from the mean of each score over its links; by default these."""
        return means

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor] | None:
        """What becomes of scores of one label as the prediction of another where the mean of many takes its place.

        Where labels scatter alike and independently, half of the squared difference is left. By default None: unknown.
        """
        return None

    @classmethod
    @abstractmethod
    def metrics(cls) -> dict[str, Metric]:
        """What ``summarise`` gives; the first is what runs are compared by."""

    def options(self) -> dict:
        """What the constructor takes, in plain tensors, lists, numbers and strings; by default nothing."""
        return {}

    def state(self) -> dict:
        """The task as a checkpoint stores it: ``registry("task").build(state)`` makes it anew."""
        return {"name": self.name, **self.options()}

    def thinning(self) -> Thinning:
        """What a training step looks at; parameters are options of ``training.thinning``. By default: whole labels."""
        return lambda batch, generator: batch

    def packed(self, values: Tensor) -> np.ndarray:
        """Labels or predictions as ``predictions.npz`` holds them; by default as they are."""
        return values.numpy()

    def stored(self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """What ``predictions.npz`` holds of each model, by the key before ``_<model>``; by default all scores."""
        return {name: score.numpy() for name, score in scores.items()}

    def keep(self, folder: Path, model) -> None:  # noqa: B027
        """Writes what a run keeps of the trained model beside its predictions; by default nothing."""

    def figures(self, folder: Path, links) -> dict:
        """Figures of a run by file name, from what is in its folder; by default none."""
        return {}

    @classmethod
    def compared(cls, files: Mapping[str, Path], split: str) -> dict:
        """Figures of several systems by file name; by default none.

        Args:
            files: ``predictions.npz`` of each, by what to call it; all of the same test links.
            split: Name of the split.
        """
        return {}


def stored_scores(files: Mapping[str, Path], kind: str) -> dict[str, np.ndarray]:
    """What ``predictions.npz`` of several systems hold of each, ``<kind>_<model>``; the first one's baselines last.

    A baseline that is called as a system is, and scores otherwise, is told apart from it.
    """
    from gaigs.report.runs import as_baseline

    own, baselines = {}, {}
    for name, file in files.items():
        with np.load(file) as run:
            found = {key.removeprefix(f"{kind}_"): run[key] for key in run.files if key.startswith(f"{kind}_")}
        (model, own[name]), *others = found.items()
        baselines = baselines or {other: scores for other, scores in others if other != f"{model}_trend"}
    others = {name: scores for name, scores in baselines.items() if not np.array_equal(own.get(name), scores)}
    return own | {as_baseline(name) if name in own else name: scores for name, scores in others.items()}


def need_samples(scores: Tensor) -> None:
    """Raises a ``ValueError`` where there is no sample to summarise."""
    if not len(scores):
        raise ValueError("a summary needs at least one sample, got none; the split leaves nothing to test on")


def check_values(labels: Tensor, values: Tensor, shape: tuple[int, ...], samples: str) -> None:
    """Sees to it that labels and values are (k, *shape) and finite.

    Raises:
        ValueError: They are not.
    """
    if labels.shape != values.shape or labels.ndim < 1 or tuple(labels.shape[1:]) != tuple(shape):
        wanted = ", ".join(("k", *map(str, shape))) + ("," if not shape else "")
        raise ValueError(
            f"labels and predictions must both be ({wanted}), got {tuple(labels.shape)} and {tuple(values.shape)}"
        )
    for name, tensor in (("labels", labels), ("predictions", values)):
        broken = ~tensor.isfinite()[..., None].flatten(1).all(1)
        if broken.any():
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in {int(broken.sum())} of {len(tensor)} {samples}, first "
                f"in number {int(broken.int().argmax())}; see whether the training diverged or the file is damaged"
            )
