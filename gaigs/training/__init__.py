"""Gradient descent of a model on links: its steps, batches, and callbacks between the steps."""

import torch

from gaigs.core.query import Batch
from gaigs.core.task import Task


def seeded(*numbers: int) -> torch.Generator:
    """A random generator seeded by all ``numbers``, such as a seed and a step."""
    return torch.Generator().manual_seed(hash(numbers) % 2**63)


class MeanScores:
    """Means of a task's scores over links, which may be spread over several processes."""

    def __init__(self, task: Task):
        self.task = task
        self.sums: dict[str, float] = {}
        self.count = 0

    def add(self, batch: Batch, values: torch.Tensor) -> None:
        """Adds the scores of the predictions ``values`` of a batch, weighted by its ``shares``."""
        weight, _ = batch.shares
        self.count += weight * len(batch)
        for name, scores in self.task.scores(batch.labels, values).items():
            self.sums[name] = self.sums.get(name, 0.0) + weight * scores.sum().item()

    def over_processes(self, strategy) -> dict[str, float]:
        """Mean scores over the links of all processes, in the form of ``Task.logged``.

        Every process must call this method, since processes wait for each other in it.
        """
        numbers = [self.count, *self.sums.values()]
        totals = torch.tensor(numbers, dtype=torch.float64, device=strategy.root_device)
        count, *sums = strategy.reduce(totals, reduce_op="sum").tolist()
        pairs = zip(self.sums, sums, strict=True)
        return self.task.logged({name: total / count for name, total in pairs})
