"""Path loss with terms beyond the logarithm of the distance."""

import logging

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.links import folds_of
from gaigs.kriging.path_terms import PathTerms
from gaigs.model import Model, Prediction
from gaigs.model.path_loss import PathLoss
from gaigs.registry import register

log = logging.getLogger(__name__)


@register("model", "shaped_path_loss")
class ShapedPathLoss(PathLoss):
    """The law of ``path_loss`` with a break point, lobes of the receivers' antennas, and the
    transmitter's height, each where held-out links are clearly better with it.

    ``PathTerms`` has the terms. Where no term helps this is ``path_loss``.

    Source: as of ``PathTerms``.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.terms = PathTerms(scene)
        self.unseen: Tensor | None = None  # errors of the links of ``fit``, see unseen_errors
        self.added: str | None = None  # what ``fit`` has added, for ``report_terms``

    def fit(self, links: Links) -> None:
        self._fit_terms(links, chooses=True)

    def refit(self, links: Links) -> None:
        """As ``fit``, for some of the known links: the choice of terms stays."""
        self._fit_terms(links, chooses=False)

    def _fit_terms(self, links: Links, chooses: bool) -> None:
        super().fit(links)
        links = without_gross_errors(links)
        index = links.split.known
        query = links.query[index]
        law = super().forward(Batch(query)).value
        errors = (links.labels[index] - law).double()
        folds = folds_of(links, index)
        added = self.terms.fit(query.transmitters, query.receivers, errors, folds, chooses)
        if chooses:
            self.added = added
            self.unseen = errors.new_zeros(len(links)).index_copy(0, index, self.terms.unseen)

    def unseen_errors(self, links: Links, index: Int[Tensor, " k"]) -> Float[Tensor, " k"]:
        """Labels of some of the links of ``fit`` less the trend, its terms fitted without a link's
        fold: errors of links that terms have seen are too small.
        """
        if self.unseen is None:
            return (links.labels[index] - self(Batch(links.query[index])).value).double()
        return self.unseen[index]

    def forward(self, batch: Batch) -> Prediction:
        terms = self.terms(batch.query.transmitters, batch.query.receivers)
        return Prediction(super().forward(batch).value + terms, {})

    def facts(self) -> dict[str, object]:
        """``terms``, and ``break_m`` where there are break points."""
        return {**self.terms.facts()}

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # A process of before had ``path_loss``: no terms.
        for name, buffer in self.terms.state_dict().items():
            state_dict.setdefault(f"{prefix}terms.{name}", torch.zeros_like(buffer))
        super()._load_from_state_dict(state_dict, prefix, *args)


def report_terms(trend: Model) -> None:
    """Logs the terms that a ``ShapedPathLoss`` has added: folds, which fit it again, do not."""
    if isinstance(trend, ShapedPathLoss) and trend.added:
        log.info("trend beyond path loss: %s %s", trend.added, trend.scene.task.error_unit)
