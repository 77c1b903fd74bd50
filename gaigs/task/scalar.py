"""What tasks share whose label is one real number a link."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.report.style import with_unit
from gaigs.task import Metric, Task, check_values, need_samples, stored_scores


class Scalar(Task):
    """One real number a link, with a unit; a subclass gives ``name``, ``quantity``, ``unit`` and ``error_unit``.

    Attributes:
        error_unit: Of a difference of labels; its lower case ends the names of scores and metrics.
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

    def scores(self, labels: Float[Tensor, "k"], values: Float[Tensor, "k"]) -> dict[str, Tensor]:
        """The absolute error of each prediction."""
        check_values(labels, values, (), "readings")
        return {self.monitor: (values.detach().cpu().double() - labels.detach().cpu().double()).abs()}

    @property
    def pair_score(self) -> str:
        return with_unit("|difference|", self.error_unit)

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """Errors less by the root of 2."""
        return {name: score / math.sqrt(2) for name, score in scores.items()}

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Mean, median and root of the mean square of the absolute error."""
        errors = scores[self.monitor]
        need_samples(errors)
        numbers = errors.mean(), torch.quantile(errors, 0.5), errors.square().mean().sqrt()
        return dict(zip(self.metrics(), (number.item() for number in numbers), strict=True))

    def stored(self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """``error``: prediction less label."""
        return {"error": (values - labels).numpy()}

    def keep(self, folder: Path, model) -> None:
        """``radio_map.npz``: what each receiver would report from everywhere on a plane."""
        from gaigs.radio_maps import radio_map  # which itself asks a model

        radio_map(model).save(folder / "radio_map.npz")

    def figures(self, folder: Path, links) -> dict:
        """How the error is distributed, predicted against measured values, and the radio map."""
        from gaigs.report.curves import cdf  # matplotlib is slow to import
        from gaigs.report.panels import numbered
        from gaigs.report.radio_map import radio_maps
        from gaigs.report.scatter import predicted_against_measured

        with np.load(folder / "predictions.npz") as run:
            errors = {name.removeprefix("error_"): abs(run[name]) for name in run.files if name.startswith("error_")}
            transmitters, receiver, labels, predictions = (
                run[name] for name in ("transmitters", "receiver", "labels", "prediction")
            )
        names = [receiver.name for receiver in links.receivers]
        readings = np.column_stack((transmitters[:, :2], labels))
        words = {"quantity": self.quantity, "unit": self.unit, "error_unit": self.error_unit}
        paged = {
            "predicted_against_measured": predicted_against_measured(labels, predictions, receiver, names, **words),
            "radio_map": radio_maps(
                folder / "radio_map.npz",
                {receiver.name: receiver.pose.position.numpy() for receiver in links.receivers},
                {name: readings[receiver == index] for index, name in enumerate(names)},
                links.edges.numpy(),
                **words,
            ),
        }
        # The last hundredth would squeeze all others.
        furthest = max(np.quantile(error, 0.99) for error in errors.values()) or None
        title = f"|error| [{self.error_unit}]"
        figures = {"error_cdf": cdf(errors, title, "readings", links.split.name, (0, furthest))}
        return figures | numbered(paged)

    @classmethod
    def compared(cls, files: Mapping[str, Path], split: str) -> dict:
        """How the error is distributed."""
        from gaigs.report.curves import cdf  # matplotlib is slow to import

        errors = {name: abs(values) for name, values in stored_scores(files, "error").items()}
        # Of all readings and systems: a single system that failed would squeeze all others.
        furthest = np.quantile(np.concatenate([*errors.values()]), 0.98) or None
        return {"cdf": cdf(errors, f"|error| [{cls.error_unit}]", "readings", split, (0, furthest))}
