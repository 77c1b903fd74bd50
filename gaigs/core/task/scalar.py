"""The base of tasks with scalar labels: one real number for each link."""

import math

import numpy as np
from torch import Tensor

from gaigs.core.task import Metric, Task, check_values, need_samples


class Scalar(Task):
    """One real number a link, with a unit.

    A subclass sets ``name``, ``quantity``, ``unit`` and ``error_unit``, the unit of a difference of
    labels. Names of scores and metrics end in ``error_unit`` in lower case.
    """

    error_unit: str
    higher_is_better = False
    is_noisy = True

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    @property
    def monitor(self) -> str:
        return f"mae_{self.error_unit.lower()}"

    @classmethod
    def metrics(cls) -> dict[str, Metric]:
        suffix = cls.error_unit.lower()
        return {
            f"mae_{suffix}": Metric(f"MAE [{cls.error_unit}]", False),
            f"median_ae_{suffix}": Metric(f"median AE [{cls.error_unit}]", False, is_brief=False),
            f"rmse_{suffix}": Metric(f"RMSE [{cls.error_unit}]", False, is_brief=False),
        }

    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """The absolute error of each prediction, by the name of ``monitor``."""
        check_values(labels, values, (), "readings")
        errors = values.detach().cpu().double() - labels.detach().cpu().double()
        return {self.monitor: errors.abs()}

    @property
    def pair_score(self) -> str:
        return with_unit("|difference|", self.error_unit)

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """Errors divided by the root of 2."""
        return {name: score / math.sqrt(2) for name, score in scores.items()}

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Mean, median and root of the mean square of the absolute error."""
        errors = scores[self.monitor]
        need_samples(errors)
        # A resampled test has thousands of medians: numpy's takes a tenth of the time of torch's.
        median = np.median(errors.numpy())
        numbers = (errors.mean(), median, errors.square().mean().sqrt())
        return dict(zip(self.metrics(), (number.item() for number in numbers), strict=True))

    def stored(
        self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]
    ) -> dict[str, np.ndarray]:
        """The array ``error``, predictions minus labels."""
        return {"error": (values - labels).numpy()}


def with_unit(quantity: str, unit: str) -> str:
    """A quantity with its unit in brackets; a ratio has none."""
    return f"{quantity} [{unit}]" if unit else quantity
