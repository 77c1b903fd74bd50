"""Batches of links: shuffled for training, such that a run can stop anywhere and go on there; in order for scores."""

from collections.abc import Iterator

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links
from gaigs.model import Batch


class Batches:
    """Batches of a fixed number of links, each of one receiver, in an order that the seed and the step alone decide.

    Every pass goes through all links once, anew shuffled. The batch of step k is the same whether or not the run was
    interrupted before it, so a resumed training sees what an uninterrupted one would have.

    Args:
        links: The data set.
        index: The links to draw from.
        size: Links a batch; the last ones of a receiver may be fewer.
        seed: Of the order.
        steps: How many batches there are in all.

    Raises:
        ValueError: The size or the number of steps is less than 1.
    """

    def __init__(self, links: Links, index: Int[Tensor, "k"], size: int, seed: int, steps: int):
        for option, value in (("training.batch_size", size), ("trainer.max_steps", steps)):
            if value < 1:
                raise ValueError(f"{option} must be at least 1, got {value}")
        self.links, self.index, self.size, self.seed, self.steps = links, index, size, seed, steps
        self.position = 0

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Batch]:
        length = len(_by_receiver(self.links, self.index, self.size))
        while self.position < self.steps:
            passed, within = divmod(self.position, length)
            for chosen in self._shuffled(passed)[within : within + self.steps - self.position]:
                self.position += 1
                yield take(self.links, chosen)

    def state_dict(self) -> dict:
        """How far the training has come."""
        return {"position": self.position}

    def load_state_dict(self, state: dict) -> None:
        """Goes on from there."""
        self.position = state["position"]

    def _shuffled(self, passed: int) -> list[Tensor]:
        generator = torch.Generator().manual_seed(hash((self.seed, passed)) % 2**63)
        order = self.index[torch.randperm(len(self.index), generator=generator)]
        parts = _by_receiver(self.links, order, self.size)
        return [parts[i] for i in torch.randperm(len(parts), generator=generator)]


class Pass:
    """One pass over links in their order, in batches of one receiver each.

    Args:
        links: The data set.
        index: The links to go over.
        size: Links a batch; the last ones of a receiver may be fewer.
    """

    def __init__(self, links: Links, index: Int[Tensor, "k"], size: int):
        self.links = links
        self.parts = _by_receiver(links, index, size)

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[Batch]:
        return (take(self.links, part) for part in self.parts)


def take(links: Links, index: Int[Tensor, "b"]) -> Batch:
    """Links of one receiver as a batch with labels."""
    receiver = int(links.receiver_index[index[0]])
    return Batch(links.transmitters[index], receiver, links.grid, links.labels[index])


def _by_receiver(links: Links, index: Int[Tensor, "k"], size: int) -> list[Int[Tensor, "b"]]:
    """Links in parts of at most a size, each of one receiver, in the order in which they come."""
    receivers = links.receiver_index[index]
    return [part for receiver in receivers.unique() for part in index[receivers == receiver].split(size)]
