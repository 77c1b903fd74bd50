"""Revisions: what a model changes in itself between two steps."""

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
"""Links that a revision looks at, of those that train and of those that validate: a search takes hundreds of looks."""


class Revision(Callback):
    """Calls ``Model.revise`` after the shares of the training that the model asks for: of its steps or of its time,
    whichever comes first.

    All processes look at the same links, so that they decide alike.

    Args:
        links: What is trained on.
        seed: Says which of them.
    """

    def __init__(self, links: Links, seed: int):
        self.links, self.seed = links, seed
        self.made: list[int] = []

    def state_dict(self) -> dict:
        return {"made": self.made}

    def load_state_dict(self, state: dict) -> None:
        self.made = state["made"]

    def on_train_batch_start(self, trainer, module, *_) -> None:
        if trainer.global_step == 0:  # behind the validation of models that predict untrained
            self._revise(trainer, module)

    def on_train_batch_end(self, trainer, module, *_) -> None:
        self._revise(trainer, module)

    @torch.no_grad()
    def _revise(self, trainer, module) -> None:
        for number, share in enumerate(module.model.revisions):
            if number in self.made or not _is_due(trainer, share):
                continue
            self.made.append(number)
            split = self.links.split
            convert = trainer.precision_plugin.convert_input
            parts = (self._batch(module, part, number) for part in (split.train, split.validation))
            train, validation = (None if part is None else convert(part) for part in parts)
            # As for every prediction that is no training step.
            module.eval()
            told = module.model.revise(number, train, validation, lambda batch: loss_of(module, batch))
            module.train()
            log.info("step %d: %s", trainer.global_step, told)

    def _batch(self, module, index: Int[Tensor, "k"], number: int) -> Batch | None:
        if not len(index):
            return None
        generator = seeded(self.seed, number, len(index))
        chosen = index[torch.randperm(len(index), generator=generator)[:LINKS].sort().values]
        return module.thin(self.links.batch(chosen).to(module.device), generator)


def _is_due(trainer, share: float) -> bool:
    """Whether so much of a training is done."""
    time = time_share(trainer)
    by_steps = trainer.max_steps > 0 and trainer.global_step == round(share * trainer.max_steps)
    return by_steps or (time is not None and time >= share)


def loss_of(module, batch: Batch) -> float:
    """The loss of a module's model as it stands, without penalties."""
    return module.loss(module.model(batch).value, batch)[0].item()
