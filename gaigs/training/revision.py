"""Calls of ``Model.revise``, by which a model changes itself between two training steps."""

import contextlib
import functools
import logging
from collections.abc import Iterator

import torch
from jaxtyping import Int
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from gaigs.core import stages
from gaigs.core.query import Batch
from gaigs.data import Links
from gaigs.training import seeded
from gaigs.training.budget import is_time_up, time_share

log = logging.getLogger(__name__)


class _TimeUp(Exception):
    """The time of a training is up."""


@contextlib.contextmanager
def _stopping_when_time_is_up(trainer, model: nn.Module) -> Iterator[None]:
    """Raises ``_TimeUp`` at the first call of a submodule after the training's time is up.

    Searches that call no submodule ask ``stages.is_up``.
    """

    def check_time(*_) -> None:
        if is_time_up(trainer):
            raise _TimeUp

    hooks = [part.register_forward_pre_hook(check_time) for part in model.modules()]
    keeper = stages.current()
    keeper.ends = functools.partial(is_time_up, trainer)
    try:
        yield
    finally:
        keeper.ends = None
        for hook in hooks:
            hook.remove()


class Revision(Callback):
    """Calls ``Model.revise`` after the fractions of the training in ``Model.revisions``.

    A fraction is of the training's steps or of its time, whichever comes first. If the time ends
    during a revision, the model stays as before the revision. All processes draw the same links
    from the seed, so their decisions are equal.

    Args:
        links: Links with a split.
        seed: Seed of the choice of links.
        max_links: Largest number of training links, and of validation links, in a revision: a
            search evaluates them hundreds of times.
    """

    def __init__(self, links: Links, seed: int, max_links: int = 48):
        self.links = links
        self.seed = seed
        self.max_links = max_links
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
        """Makes the revisions whose fraction of the training is over."""
        for number, share in enumerate(module.model.revisions):
            if number in self.made or not _is_due(trainer, share):
                continue
            if is_time_up(trainer):
                return
            self.made.append(number)
            train = self._batch(trainer, module, self.links.split.train, number)
            validation = self._batch(trainer, module, self.links.split.validation, number)
            module.eval()  # as for every prediction outside of a training step
            before = {name: value.clone() for name, value in module.model.state_dict().items()}

            def loss(batch: Batch) -> float:
                value, _ = module.loss(module.model(batch).value, batch)
                return value.item()

            try:
                with _stopping_when_time_is_up(trainer, module.model):
                    outcome = module.model.revise(number, train, validation, loss)
            except _TimeUp:
                module.model.load_state_dict(before)
                outcome = "the time is up within a revision, which is not made"
            module.train()
            log.info("step %d: %s", trainer.global_step, outcome)

    def _batch(self, trainer, module, index: Int[Tensor, " k"], number: int) -> Batch | None:
        """Up to ``max_links`` random links of ``index``, thinned as in a step; None if empty."""
        if not len(index):
            return None
        generator = seeded(self.seed, number, len(index))
        order = torch.randperm(len(index), generator=generator)  # (k,)
        chosen = index[order[: self.max_links].sort().values]
        batch = module.thin(self.links.batch(chosen).to(module.device), generator)
        return trainer.precision_plugin.convert_input(batch)


def _is_due(trainer, share: float) -> bool:
    """True once a fraction of the training is over, in steps or in time."""
    if trainer.max_steps > 0 and trainer.global_step == round(share * trainer.max_steps):
        return True
    spent = time_share(trainer)
    return spent is not None and spent >= share
