"""Path loss with further terms: a break point, antenna lobes and heights."""

import torch

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.path_terms import PathTerms
from gaigs.model import Prediction
from gaigs.model.path_loss import PathLoss
from gaigs.registry import register


@register("model", "shaped_path_loss")
class ShapedPathLoss(PathLoss):
    """``path_loss`` with the terms of ``PathTerms``: a break point, lobes and heights.

    Held-out links choose the terms. Sources are in ``PathTerms``.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.terms = PathTerms(scene)

    def fit(self, links: Links) -> None:
        self._fit_terms(links, chooses=True)

    def refit(self, links: Links) -> None:
        """Fits level, exponent and the terms that ``fit`` chose to fewer known links."""
        self._fit_terms(links, chooses=False)

    def _fit_terms(self, links: Links, chooses: bool) -> None:
        links = without_gross_errors(links)
        self._fit_lines(links)
        index = links.split.known
        law = super().forward(Batch(links.query[index])).value
        self.terms.fit(links, (links.labels[index] - law).double(), chooses)

    def forward(self, batch: Batch) -> Prediction:
        terms = self.terms(batch.query.transmitters, batch.query.receivers)
        return Prediction(super().forward(batch).value + terms, {})

    def facts(self) -> dict[str, object]:
        """``terms``, and ``break_m`` if there are break points."""
        return {**self.terms.facts()}

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # Processes of older checkpoints have ``path_loss``: no terms.
        for name, buffer in self.terms.state_dict().items():
            state_dict.setdefault(f"{prefix}terms.{name}", torch.zeros_like(buffer))
        super()._load_from_state_dict(state_dict, prefix, *args)
