from dataclasses import replace

import pytest
import torch

from gaigs.data import Grid, Links, Receiver, Split
from gaigs.geometry import Pose
from gaigs.training.batches import Batches, Pass, take

PLACES = 22
"""Where transmitters train; links 22 to 25 test."""


@pytest.fixture(scope="module")
def links():
    """Links of three receivers, mixed, whose labels and positions say which link they are."""
    n = PLACES + 4
    numbers = torch.arange(n, dtype=torch.float32)
    pose = Pose.from_xyzw((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    return Links(
        transmitters=numbers[:, None].expand(n, 3),
        receivers=tuple(Receiver(f"gateway{i}", pose) for i in range(3)),
        receiver_index=torch.randint(3, (n,), generator=torch.Generator().manual_seed(0)),
        labels=numbers[:, None, None].expand(n, 4, 6),
        split=Split("all but four", torch.arange(n - 4), torch.arange(0), torch.arange(n - 4, n)),
        grid=Grid.degrees(range(4), range(6)),
        normalisation="none",
    )


def numbers(batch):
    """Which links a batch holds, where positions are numbers of links."""
    return batch.transmitters[:, 0].long().tolist()


def draw(links, steps, size=5, seed=0, start=0):
    batches = Batches(links, links.split.train, size, seed, steps)
    batches.load_state_dict({"position": start})
    return list(batches)


PASS = -(-PLACES // 5)
"""Batches of 5 that a pass takes."""


def test_a_pass_goes_through_every_link_once(links):
    for passed in range(3):
        drawn = draw(links, (passed + 1) * PASS)[passed * PASS :]
        assert sorted(n for batch in drawn for n in numbers(batch)) == links.split.train.tolist()


def test_receivers_and_labels_belong_to_their_transmitters(links):
    for batch in draw(links, 2 * PASS):
        assert (links.receiver_index[numbers(batch)] == batch.receivers).all()
        assert batch.labels.shape == (len(numbers(batch)), 4, 6)
        assert batch.labels[:, 0, 0].long().tolist() == numbers(batch)
        assert len(numbers(batch)) <= 5


def test_links_of_one_transmitter_come_together(links):
    """Each place is heard three times; the labels still say which link it is."""
    shared = replace(links, transmitters=(links.transmitters // 3).clone())
    drawn = draw(shared, 2)
    assert [len(batch.transmitters) for batch in drawn] == [13, 9] or [len(b.transmitters) for b in drawn] == [15, 7]
    for batch in drawn:
        assert len(batch.transmitters.unique(dim=0)) <= 5
        held = batch.labels[:, 0, 0].long()
        places = set((held // 3).tolist())
        assert sorted(held.tolist()) == [n for n in range(PLACES) if n // 3 in places]


def test_passes_differ_and_so_do_seeds(links):
    both, other = ([numbers(batch) for batch in draw(links, 2 * PASS, seed=seed)] for seed in (0, 1))
    assert both[:PASS] != both[PASS:]
    assert both != other


@pytest.mark.parametrize("start", range(2 * PASS + 2))
def test_a_batch_depends_on_its_step_alone(links, start):
    torch.manual_seed(start)  # the global generator has no say
    whole, rest = draw(links, 2 * PASS + 1), draw(links, 2 * PASS + 1, start=start)
    assert [numbers(batch) for batch in rest] == [numbers(batch) for batch in whole[start:]]


def test_the_position_counts_the_batches_handed_out(links):
    batches = Batches(links, links.split.train, 5, 0, PASS + 3)
    assert len(batches) == PASS + 3
    iterator = iter(batches)
    for step in range(PASS + 2):
        assert batches.state_dict() == {"position": step}
        next(iterator)


def test_one_batch_may_hold_all(links):
    for batch in draw(links, 2, size=100):
        assert sorted(numbers(batch)) == links.split.train.tolist()


def test_a_pass_for_scores_keeps_the_order(links):
    batches = Pass(links, links.split.train, 5)
    assert len(batches) == PASS
    drawn = [numbers(batch) for batch in batches]
    assert drawn == [part.tolist() for part in batches.parts]
    assert [n for part in drawn for n in part] == links.split.train.tolist()
    assert len(list(Pass(links, links.split.validation, 5))) == 0


def test_take(links):
    batch = take(links, torch.tensor([22, 24]))
    assert (numbers(batch), batch.grid.shape) == ([22, 24], (4, 6))
    assert torch.equal(batch.receivers, links.receiver_index[[22, 24]])


@pytest.mark.parametrize(("size", "steps", "option"), [(0, 1, "training.batch_size"), (1, -1, "trainer.max_steps")])
def test_refuses(links, size, steps, option):
    with pytest.raises(ValueError, match=f"{option} must be at least 1, got"):
        Batches(links, links.split.train, size, 0, steps)
