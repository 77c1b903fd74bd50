"""Revisions: changes that a model makes to itself between two steps."""

import logging

import torch
from jaxtyping import Int
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from gaigs.data import Links
from gaigs.query import Batch
from gaigs.training import seeded
from gaigs.training.budget import time_share

log = logging.getLogger(__name__)

LINKS = 48
"""Most training links, and validation links, of a revision: a search evaluates them hundreds of times."""


class Revision(Callback):
    """Calls ``Model.revise`` after the shares of the training in ``Model.revisions``.

    Shares are of the training's steps or of its time, whichever comes first. All processes choose the same links by the
    seed, so that they decide alike.
    """

    def __init__(self, links: Links, seed: int):
        self.links, self.seed = links, seed
        self.made: list[int] = []

    def state_dict(self) -> dict:
        return {"made": self.made}

    def load_state_dict(self, state: dict) -> None:
        self.made = state["made"]

    def on_train_batch_start(self, trainer, module, *_) -> None:
        if trainer.global_step == 0:  # after the validation of models that predict untrained
            self._revise(trainer, module)

    def on_train_batch_end(self, trainer, module, *_) -> None:
        self._revise(trainer, module)

    @torch.no_grad()
    def _revise(self, trainer, module) -> None:
        time = time_share(trainer)
        for number, share in enumerate(module.model.revisions):
            by_steps = trainer.max_steps > 0 and trainer.global_step == round(share * trainer.max_steps)
            if number in self.made or not (by_steps or (time is not None and time >= share)):
                continue
            self.made.append(number)
            convert, split = trainer.precision_plugin.convert_input, self.links.split
            parts = (self._batch(module, part, number) for part in (split.train, split.validation))
            train, validation = (None if part is None else convert(part) for part in parts)
            module.eval()  # as for every prediction outside of a training step
            done = module.model.revise(
                number, train, validation, lambda batch: module.loss(module.model(batch).value, batch)[0].item()
            )
            module.train()
            log.info("step %d: %s", trainer.global_step, done)

    def _batch(self, module, index: Int[Tensor, " k"], number: int) -> Batch | None:
        """Some of the links, thinned as those of a step; None for an empty part."""
        if not len(index):
            return None
        generator = seeded(self.seed, number, len(index))
        chosen = index[torch.randperm(len(index), generator=generator)[:LINKS].sort().values]
        return module.thin(self.links.batch(chosen).to(module.device), generator)
