"""The base class of a posterior of residuals, used by kriging."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from gaigs.core.query import Batch
from gaigs.data import Links
from gaigs.kriging.kernel import Process


class Posterior(nn.Module):
    """Residuals of a trend as Gaussian processes over places, given known links.

    ``fit`` finds hyperparameters, ``solve`` takes known residuals, ``mean`` and ``deviations``
    predict. The state dict has everything that predictions need.

    Attributes:
        chooses_weight: True if validation links choose the weight of kriging; otherwise it is 1.
        by_paths: True if strengths of paths are kriged, not labels.
        start: Result of an earlier fit to similar links, from which the next fit starts; or None.
        seen: Known links that the fit held out to choose hyperparameters; None: all known links.
        has_features: True if predictions need the trend's spectra at the asked links.
        is_lazy: True if only few places will be predicted. With many known links only those near
            these places are then solved for.
    """

    chooses_weight = False
    by_paths = False
    start: Any = None
    seen: Tensor | None = None
    is_lazy = False
    has_features = False

    def cleaned(self, links: Links) -> Links:
        """The links without gross errors, which would spoil the fit; by default all links."""
        return links

    def fit(self, links: Links, candidates: Mapping[float, Tensor]) -> float:
        """Finds hyperparameters, and returns the trend weight.

        Args:
            links: Links with a split.
            candidates: Residuals of the known links (k, m), thinned by ``thin_labels``, for each
                candidate weight of the trend.
        """
        raise NotImplementedError

    def solve(self, links: Links, residuals: Callable[[Int[Tensor, " j"]], Tensor]) -> None:
        """Computes everything that ``mean`` needs from the residuals of the known links.

        Args:
            links: Links with a split.
            residuals: Function from rows of the known links (j,) to residuals (j, *shape).
        """
        raise NotImplementedError

    def start_from(self, other: Any) -> None:
        """Saves time: the next fit starts at another posterior's hyperparameters.

        By default nothing happens.
        """

    @abstractmethod
    def mean(self, batch: Batch, like: Tensor) -> Tensor:
        """Mean of the residuals, shaped as the values ``like`` of the batch."""

    def knows(self, receivers: Int[Tensor, " b"]) -> Bool[Tensor, " b"]:
        """True for receivers with known links."""
        counts = [len(field.places) for field in self.fields]  # type: ignore[union-attr, arg-type]
        return (torch.tensor(counts, device=receivers.device) > 0)[receivers]

    @abstractmethod
    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations of labels (b, *shape), or their means over a label's values (b,)."""

    @abstractmethod
    def facts(self) -> Mapping[str, float]:
        """Hyperparameters and sizes for ``metrics.json``."""

    def process_at(self, receiver: int) -> Process | None:
        """The process of one receiver's labels; None if other quantities are kriged."""
        return None

    def take_hyperparameters(self, other: Any) -> None:
        """Copies hyperparameters of ``deviations`` from another posterior; by default nothing."""
