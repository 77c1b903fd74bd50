"""Base of models that store their known links."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gaigs.core.query import Batch, Query
from gaigs.data import Links
from gaigs.kriging.links import PART
from gaigs.model.base import Model
from gaigs.registry import name_of


class LookUp(Model):
    """Base of models whose state is their known links and the attributes named in ``learnt``.

    Such a model stays on the CPU.

    Attributes:
        links: Links, or a batch of the known links; None before the fit.
        known: Numbers of each receiver's known links.
        learnt: Names of attributes with plain values that ``fit`` sets.
    """

    links: Links | Batch | None = None
    known: Sequence[Tensor] = ()
    learnt: tuple[str, ...] = ()

    def _apply(self, *_: Any) -> "LookUp":
        """Ignores moves to another device or dtype."""
        return self

    def get_extra_state(self) -> dict:
        """Known links and ``learnt``; labels of 8-bit images are stored as bytes."""
        if self.links is None:
            raise ValueError(f"model {name_of(self)!r} has no links to save; fit it first")
        index = torch.cat([*self.known])
        labels = []
        for rows in index.split(PART):
            values = self.links.labels[rows]
            pixels = (255 * values.real).round().clamp(0, 255).to(torch.uint8)
            is_image = (pixels / 255 == values).all()  # bytes lose nothing
            labels.append(pixels if is_image else values)
        learnt = {name: getattr(self, name) for name in self.learnt}
        return {"query": vars(self.links.query[index]), "labels": labels, **learnt}

    def set_extra_state(self, state: dict) -> None:
        """Sets the state of a fitted look-up."""
        labels = [part / 255 if part.dtype == torch.uint8 else part for part in state["labels"]]
        self.links = Batch(Query(**state["query"]), None, torch.cat(labels))
        radios = self.scene.radio_of(self.links.query.receivers)
        self.known = [(radios == number).nonzero()[:, 0] for number in range(self.scene.radios)]
        for name in self.learnt:
            setattr(self, name, state[name])
