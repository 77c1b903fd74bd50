import pytest
import torch
from fitting import make_links

from gaigs.training import MeanScores, batches, seeded
from gaigs.training.batches import InOrder


class Sum:
    """A strategy that adds up the tensors of several processes."""

    root_device = torch.device("cpu")

    def __init__(self):
        self.given = []

    def reduce(self, tensor, reduce_op):
        assert reduce_op == "sum"
        self.given.append(tensor)
        return torch.stack(self.given).sum(0)


@pytest.mark.parametrize("processes", [1, 3])
@pytest.mark.parametrize("size", [1, 2, 3])  # of 3 links, so that some processes have none
def test_links_count_alike_in_any_process(monkeypatch, processes, size):
    links, strategy = make_links(), Sum()
    index = links.split.validation
    values = torch.rand(len(links), 24, 30, generator=torch.Generator().manual_seed(1))
    for rank in range(processes):
        monkeypatch.setattr(batches, "process", lambda rank=rank: (rank, processes))
        scores = MeanScores(links.task)
        for batch in InOrder(links, index, size):
            held = [
                (links.query.transmitters == place).all(1).nonzero().item()
                for place in batch.query.transmitters
            ]
            scores.add(batch, values[held])
        means = scores.over_processes(strategy)
    expected = links.task.scores(links.labels[index], values[index])
    assert means == pytest.approx(
        {name: score.mean().item() for name, score in expected.items()}, rel=1e-12
    )
    assert MeanScores(links.task).over_processes(Sum()) == {}, "without links there is no mean"


def test_random_numbers_follow_from_the_given_numbers():
    def draw(*numbers):
        return torch.rand(3, generator=seeded(*numbers)).tolist()

    torch.manual_seed(5)
    first = draw(0, 7)
    torch.manual_seed(6)
    assert draw(0, 7) == first
    assert len({tuple(draw(seed, step)) for seed in range(5) for step in range(5)}) == 25
