"""Batches of links: shuffled and resumable for training; in order for scores."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor, distributed

from gaigs.core.query import Batch
from gaigs.data import Links
from gaigs.training import seeded


def process() -> tuple[int, int]:
    """The number of this process, from 0, and the number of processes."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


class Batches:
    """Batches of a fixed number of places with all their links, in an order fixed by seed and step.

    A place is a transmitter's position and frequency. Its excitation is computed once for all
    receivers. Every pass visits all places once, in a new order. Each process gets every
    ``world_size``-th place of the batch. The weights ``Batch.shares`` make the mean over processes
    equal to the mean over the batch.

    Args:
        index: Indices of the links to draw from.
        size: Number of places in a batch, over all processes; a pass may end with a smaller one.
        seed: Seed of the order.
        steps: Number of batches.
    """

    def __init__(self, links: Links, index: Int[Tensor, " k"], size: int, seed: int, steps: int):
        for option, value in (("training.batch_size", size), ("trainer.max_steps", steps)):
            if value < 1:
                raise ValueError(f"{option} must be at least 1, got {value}")
        self.links = links
        self.size = size
        self.seed = seed
        self.steps = steps
        _, place = links.query[index].unique(with_receivers=False)  # number of each place (k,)
        by_place = index[place.argsort(stable=True)]
        self.places = by_place.split(place.bincount().tolist())  # links of each place
        self.position = 0  # batches so far

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Batch]:
        batches_per_pass = -(-len(self.places) // self.size)  # rounded up
        while self.position < self.steps:
            # The order follows from seed and pass: a resumed training needs only its position.
            passes, first = divmod(self.position, batches_per_pass)
            order = torch.randperm(len(self.places), generator=seeded(self.seed, passes))
            remaining = self.steps - self.position
            for numbers in order.split(self.size)[first : first + remaining]:
                self.position += 1
                yield self._batch_of_process([self.places[i] for i in numbers.tolist()])

    def _batch_of_process(self, places: list[Tensor]) -> Batch:
        """The batch of this process, from the links of each place in the step."""
        rank, processes = process()
        own_places = places[rank::processes]
        # Every process has to take part in the step: without a place it takes one with weight 0.
        taken = own_places or places[:1]
        batch = self.links.batch(torch.cat(taken))
        if processes == 1:
            return batch
        # Each process weights its mean so that the mean over processes is the mean over the step.
        weight = processes if own_places else 0
        weight_of_links = weight * len(batch) / sum(map(len, places))
        weight_of_places = weight * len(taken) / len(places)
        return replace(batch, shares=(weight_of_links, weight_of_places))

    def state_dict(self) -> dict:
        return {"position": self.position}

    def load_state_dict(self, state: dict) -> None:
        self.position = state["position"]


class InOrder:
    """One pass over links in order; processes get every ``world_size``-th link of each batch."""

    def __init__(self, links: Links, index: Int[Tensor, " k"], size: int):
        self.links = links
        self.parts = index.split(size) if len(index) else ()

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[Batch]:
        rank, processes = process()
        for part in self.parts:
            own_links = part[rank::processes]
            # All processes need the same number of batches: without a link a process takes one with
            # weight 0.
            weight = float(len(own_links) > 0)
            batch = self.links.batch(own_links if weight else part[:1])
            yield replace(batch, shares=(weight, weight))
