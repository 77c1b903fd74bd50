"""A regressor of scikit-learn as a model: transmitters' positions to labels."""

import importlib
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.links import at_directions, coordinates, known_links
from gaigs.model.base import Prediction
from gaigs.model.look_up import LookUp
from gaigs.registry import register, suggest


@register("model", "sklearn")
class SklearnRegressor(LookUp):
    """A regressor of scikit-learn for each receiver, on x, y and z of the transmitter [m].

    With several carriers a fourth input is the logarithm of the carrier relative to the middle of
    the band. Labels of several numbers need a regressor with several outputs. Checkpoints store the
    links and the estimator's options. Loading fits again, by default with ``random_state`` 0. If
    ``predict`` of the regressor has ``return_std``, this gives the deviations of intervals.

    Args:
        estimator: Name of a class, such as ``sklearn.ensemble.RandomForestRegressor``; or a mapping
            of ``_target_``, the name, and options, which may contain estimators.

    Raises:
        ImportError: scikit-learn is not installed.
        ValueError: The estimator is not a regressor of scikit-learn, or an option is unknown.

    Source: Pedregosa et al., Scikit-learn: Machine Learning in Python, JMLR 12, 2011.
    """

    def __init__(self, scene: Scene, estimator: str | dict | None = None):
        super().__init__(scene)
        if estimator is None:
            raise ValueError(
                "model 'sklearn' needs a regressor: set "
                "model.estimator=sklearn.ensemble.RandomForestRegressor, or another one"
            )
        self.estimator = build_estimator(estimator)
        from sklearn.base import BaseEstimator, is_regressor

        if not isinstance(self.estimator, BaseEstimator) or not is_regressor(self.estimator):
            raise ValueError(
                "model.estimator must be a regressor of scikit-learn with its module, such as "
                f"sklearn.svm.SVR, got {estimator!r}"
            )
        seeds = [name for name in self.estimator.get_params() if name.endswith("random_state")]
        unset = [name for name in seeds if self.estimator.get_params()[name] is None]
        self.estimator.set_params(**dict.fromkeys(unset, 0))
        self.fitted: list[Any] = []

    def set_extra_state(self, state: dict) -> None:
        super().set_extra_state(state)
        self._fit()

    def fit(self, links: Links) -> None:
        """Stores the links, and fits the regressor of each receiver to its known links."""
        self.links, self.known = links, known_links(links)
        self._fit()

    def _fit(self) -> None:
        """Fits a clone of the estimator to the known links of each receiver."""
        from sklearn.base import clone

        self.fitted = []
        for index in self.known:
            labels = self.links.labels[index]
            if labels.is_complex():
                labels = torch.view_as_real(labels)
            numbers = labels.reshape(len(index), -1).double().numpy()  # (k, outputs)
            if numbers.shape[1] == 1:
                numbers = numbers[:, 0]
            try:
                self.fitted.append(clone(self.estimator).fit(self._inputs(index), numbers))
            except ValueError as error:
                cause = " ".join(str(error).split())
                several = "; for several numbers a link, sklearn.multioutput.MultiOutputRegressor"
                raise ValueError(
                    f"model.estimator cannot be fitted to {len(numbers)} labels of "
                    f"{numbers[0].size} numbers: {cause}{several if numbers.ndim > 1 else ''}"
                ) from error

    def _inputs(self, asked: Tensor | Query) -> Float[ndarray, "k d"]:
        """Inputs of the regressors, for a query or for known links by their indices."""
        query = asked if isinstance(asked, Query) else self.links.query[asked]
        return coordinates(self.scene, query, 1.0).numpy()

    def _predictions(self, query: Query, **options: bool) -> Iterator[tuple[Tensor, Any]]:
        """Yields, for each receiver, a mask of its links and its regressor's predictions there."""
        for receiver in query.receivers.unique().tolist() if self.fitted else ():
            is_asked = query.receivers == receiver
            inputs = self._inputs(query[is_asked])
            yield is_asked, self.fitted[receiver].predict(inputs, **options)

    def forward(self, batch: Batch) -> Prediction:
        task = self.scene.task
        labels = torch.full((len(batch.query), *task.shape), torch.nan, dtype=task.dtype)
        for is_asked, outputs in self._predictions(batch.query):
            values = torch.from_numpy(outputs)  # (links, outputs)
            if task.dtype.is_complex:  # outputs are real and imaginary parts
                values = torch.view_as_complex(values.reshape(-1, *task.shape, 2).contiguous())
            labels[is_asked] = values.reshape(-1, *task.shape).to(task.dtype)
        return Prediction(at_directions(labels, batch, self.scene), {})

    def deviations(self, batch: Batch) -> Tensor | None:
        has_std = "return_std" in inspect.signature(self.estimator.predict).parameters
        if not has_std or not self.scene.task.is_scalar:
            return None
        deviations = torch.ones(len(batch.query))
        for is_asked, (_, stated) in self._predictions(batch.query, return_std=True):
            deviations[is_asked] = torch.from_numpy(stated).float()
        return deviations


def build_estimator(given: Any) -> Any:
    """Builds estimators from names and mappings, also within lists and options.

    Other values are unchanged.

    Raises:
        ImportError: scikit-learn is not installed.
        ValueError: A name is not in scikit-learn, or an option is unknown.
    """
    if isinstance(given, list | tuple):
        return [build_estimator(entry) for entry in given]
    if isinstance(given, str) and given.startswith("sklearn."):
        given = {"_target_": given}
    if not isinstance(given, Mapping) or "_target_" not in given:
        return given
    kind = find_class(str(given["_target_"]))
    options = {key: build_estimator(value) for key, value in given.items() if key != "_target_"}
    known = inspect.signature(kind).parameters
    for key in options:
        if key not in known:
            raise ValueError(f"{kind.__name__} has no option {suggest(key, known)}; see its help")
    return kind(**options)


def find_class(target: str) -> type:
    """The class of scikit-learn with the name ``target``, which includes its module.

    Other classes are refused: a checkpoint from a stranger may name any class.

    Raises:
        ImportError: scikit-learn is not installed.
        ValueError: The name is not of a class of scikit-learn.
    """
    try:
        from sklearn.base import BaseEstimator
        from sklearn.gaussian_process.kernels import Kernel
    except ImportError:
        raise ImportError("scikit-learn is missing: pip install 'gaigs[sklearn]'") from None
    path, _, name = target.rpartition(".")
    kind = None
    hint = ""
    if path.partition(".")[0] == "sklearn":
        try:
            module = importlib.import_module(path)
        except ImportError:
            hint = f"; there is no module {path}"
        else:
            kind = getattr(module, name, None)
            hint = f"; {path} has no {suggest(name, vars(module))}"
    if not (isinstance(kind, type) and issubclass(kind, BaseEstimator | Kernel)):
        raise ValueError(
            "an estimator must be a class of scikit-learn, such as sklearn.svm.SVR, got "
            f"{target!r}{hint if kind is None else ''}"
        )
    return kind
