"""Models of levels as regressors of scikit-learn, for its pipelines and searches."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gaigs.core.antenna import Receiver
from gaigs.data.links import links
from gaigs.runs.training import train

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
    from sklearn.metrics import r2_score
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError:
    raise ImportError("scikit-learn is missing: pip install 'gaigs[sklearn]'") from None


class Regressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """A model of levels [dBm] with the interface of scikit-learn.

    Args:
        model: Name of a registered model.
        receivers: Positions of the receivers, as for arrays in ``gaigs.links``; None: estimated
            from the training links.
        height: Height of positions x, y [m].
        seed: Seed of the training and of the choice of validation links.
        options: Options of ``gaigs.train``, such as ``max_steps``; a grid search may set them.

    Attributes:
        model_: The trained ``gaigs.Model``.
        n_features_in_: Number of coordinates, 2 or 3.

    Example:
        >>> from sklearn.model_selection import cross_val_score
        >>> links = gaigs.links("synthetic_rssi", transmitters=40)
        >>> near_west = links.query.receivers == 0
        >>> places, levels = links.query.transmitters[near_west], links.labels[near_west]
        >>> len(cross_val_score(Regressor("path_loss"), places, levels, cv=3))
        3
    """

    def __init__(
        self,
        model: Any = "gaussian_process",
        receivers: Any = None,
        height: Any = 1.0,
        seed: Any = 0,
        **options: Any,
    ):
        self.model = model
        self.receivers = receivers
        self.height = height
        self.seed = seed
        self.options = options

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        return super().get_params(deep) | self.options

    def set_params(self, **params: Any) -> "Regressor":
        named = self._get_param_names()
        self.options |= {key: value for key, value in params.items() if key not in named}
        super().set_params(**{key: value for key, value in params.items() if key in named})
        return self

    def fit(self, X: Any, y: Any) -> "Regressor":
        """Trains on levels at places.

        Args:
            X: Positions (n, 3) [m], or (n, 2) with a common height.
            y: Levels (n,) or (n, receivers) [dBm]; NaN where nothing was received.

        Raises:
            ValueError: Shapes or numbers are wrong, or the model does not fit the task.
        """
        checks_of_y = {"ensure_all_finite": "allow-nan", "ensure_2d": False, "dtype": np.float64}
        checks = ({"ensure_min_samples": 2}, checks_of_y)
        X, y = validate_data(self, X, y, validate_separately=checks)
        if X.shape[1] not in (2, 3):
            count = f"{X.shape[1]} feature(s)"
            raise ValueError(f"X must be positions (n, 2) or (n, 3) [m], got {count}")
        known = links(
            task="rssi",
            transmitters=X,
            receivers=self.receivers,
            labels=y.reshape(len(y), -1),
            height=self.height,
            split={"name": "random", "test": 0.0, "seed": self.seed},
        )
        quiet = {"enable_progress_bar": False, "enable_model_summary": False}
        self.model_ = train(self.model, known, seed=self.seed, **{**quiet, **self.options})
        # The model lacks receivers without training links; their predictions are NaN.
        names = _names_of(self.receivers) or [f"rx{number}" for number in range(y[0].size)]
        self.columns_ = [names.index(receiver.name) for receiver in self.model_.scene.receivers]
        self.shape_ = y.shape[1:]
        return self

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Levels (n,) or (n, receivers) [dBm], and with ``return_std`` their deviations [dB].

        Raises:
            ValueError: The number of coordinates differs from ``fit``, or the model had too few
                places for deviations.
        """
        check_is_fitted(self)
        X = validate_data(self, X, reset=False)
        places = np.column_stack((X, np.full(len(X), self.height))) if X.shape[1] == 2 else X
        if not return_std:
            return self._arranged(self.model_.predict(places))
        # Any interval comes with standard deviations.
        levels, deviations, *_ = self.model_.predict(places, interval=0.9)
        return self._arranged(levels), self._arranged(deviations)

    def _arranged(self, values: Any) -> np.ndarray:
        """Values in the shape of the training levels; NaN for receivers that the model lacks."""
        levels = np.full((len(values), *(self.shape_ or (1,))), np.nan)
        levels[:, self.columns_] = values.double().numpy()
        return levels if self.shape_ else levels[:, 0]

    def score(self, X: Any, y: Any, sample_weight: Any = None) -> float:
        """Mean coefficient of determination over the receivers, each over its received levels.

        Raises:
            ValueError: No receiver has two levels.
        """
        truth = np.asarray(y, float).reshape(len(y), -1)
        levels = self.predict(X).reshape(truth.shape)
        weights = np.ones(len(truth)) if sample_weight is None else np.asarray(sample_weight)
        scores = []
        for column, predicted in zip(truth.T, levels.T, strict=True):
            has_both = ~(np.isnan(column) | np.isnan(predicted))
            if has_both.sum() > 1:
                weight = weights[has_both]
                scores.append(r2_score(column[has_both], predicted[has_both], sample_weight=weight))
        if not scores:
            raise ValueError("a score takes two levels of a receiver or more, got none")
        return float(np.mean(scores))


def _names_of(receivers: Any) -> list[str]:
    """Names of receivers if given; empty for positions and for None."""
    if isinstance(receivers, Mapping):
        return [*receivers]
    entries = [receivers] if isinstance(receivers, Receiver) else receivers
    if not isinstance(entries, Sequence):
        return []
    is_named = all(isinstance(entry, Receiver) for entry in entries)
    return [entry.name for entry in entries] if is_named else []
