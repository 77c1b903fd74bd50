"""Batches of links: shuffled for training, such that a run can stop anywhere and go on there; in order for scores."""

from collections.abc import Iterator

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links
from gaigs.model import Batch


class Batches:
    """Batches of a fixed number of transmitters with all their links, in an order that seed and step alone decide.

    What a transmitter excites is the same for all receivers, and is computed once where its links come together. Every
    pass goes through all transmitters once, anew shuffled. The batch of step k is the same whether or not the run was
    interrupted before it, so a resumed training sees what an uninterrupted one would have.

    Args:
        links: The data set.
        index: The links to draw from.
        size: Transmitter positions a batch; the last batch of a pass may hold fewer.
        seed: Of the order.
        steps: How many batches there are in all.

    Raises:
        ValueError: The size or the number of steps is less than 1.
    """

    def __init__(self, links: Links, index: Int[Tensor, "k"], size: int, seed: int, steps: int):
        for option, value in (("training.batch_size", size), ("trainer.max_steps", steps)):
            if value < 1:
                raise ValueError(f"{option} must be at least 1, got {value}")
        self.links, self.size, self.seed, self.steps = links, size, seed, steps
        _, place, counts = links.transmitters[index].unique(dim=0, return_inverse=True, return_counts=True)
        self.places = index[place.argsort(stable=True)].split(counts.tolist())
        self.position = 0

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Batch]:
        length = -(-len(self.places) // self.size)
        while self.position < self.steps:
            passed, within = divmod(self.position, length)
            generator = torch.Generator().manual_seed(hash((self.seed, passed)) % 2**63)
            parts = torch.randperm(len(self.places), generator=generator).split(self.size)
            for chosen in parts[within : within + self.steps - self.position]:
                self.position += 1
                yield take(self.links, torch.cat([self.places[i] for i in chosen]))

    def state_dict(self) -> dict:
        """How far the training has come."""
        return {"position": self.position}

    def load_state_dict(self, state: dict) -> None:
        """Goes on from there."""
        self.position = state["position"]


class Pass:
    """One pass over links in their order.

    Args:
        links: The data set.
        index: The links to go over.
        size: Links a batch; the last one may hold fewer.
    """

    def __init__(self, links: Links, index: Int[Tensor, "k"], size: int):
        self.links = links
        self.parts = index.split(size) if len(index) else ()

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[Batch]:
        return (take(self.links, part) for part in self.parts)


def take(links: Links, index: Int[Tensor, "b"]) -> Batch:
    """Links as a batch with labels."""
    return Batch(links.transmitters[index], links.receiver_index[index], links.grid, links.labels[index])
