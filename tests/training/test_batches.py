from dataclasses import replace

import pytest
import torch

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Split
from gaigs.training import batches as module
from gaigs.training.batches import Batches, InOrder, process

PLACES = 22
"""Training places; links 22 to 25 test."""

PASS = -(-PLACES // 5)
"""Batches of 5 in a pass."""


@pytest.fixture(scope="module")
def links():
    """Links of three receivers, mixed, whose labels and positions say which link they are."""
    n = PLACES + 4
    numbers = torch.arange(n, dtype=torch.float32)
    pose = Pose.from_xyzw((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    grid = Grid.degrees(range(4), range(6))
    receivers = torch.randint(3, (n,), generator=torch.Generator().manual_seed(0))
    return Links(
        query=Query(numbers[:, None].expand(n, 3), receivers),
        receivers=tuple(Receiver(f"gateway{i}", pose) for i in range(3)),
        labels=numbers[:, None, None].expand(n, 4, 6),
        task=Spectrum(grid.elevations, grid.azimuths, "none"),
        split=Split("all but four", torch.arange(n - 4), torch.arange(0), torch.arange(n - 4, n)),
    )


def at(links, places, frequencies=None):
    """The links moved to numbered places."""
    transmitters = places.float()[:, None].expand(len(links), 3)
    return replace(
        links, query=replace(links.query, transmitters=transmitters, frequencies=frequencies)
    )


def numbers(batch):
    """Which links a batch holds, as their labels say."""
    return batch.labels[:, 0, 0].long().tolist()


def draw(links, steps, size=5, seed=0, start=0):
    batches = Batches(links, links.split.train, size, seed, steps)
    batches.load_state_dict({"position": start})
    drawn = list(batches)
    assert (len(batches), batches.state_dict()) == (steps, {"position": steps})
    return drawn


def test_a_pass_goes_through_every_link_once(links):
    for passed in range(3):
        drawn = draw(links, (passed + 1) * PASS)[passed * PASS :]
        assert sorted(n for batch in drawn for n in numbers(batch)) == links.split.train.tolist()
    first, second, other = (
        draw(links, PASS),
        draw(links, 2 * PASS)[PASS:],
        draw(links, PASS, seed=1),
    )
    assert len({str([numbers(batch) for batch in own]) for own in (first, second, other)}) == 3


def test_receivers_and_labels_belong_to_their_transmitters(links):
    for batch in draw(links, 2 * PASS):
        held = numbers(batch)
        assert batch.query.transmitters[:, 0].tolist() == held
        assert torch.equal(batch.query.receivers, links.query.receivers[held])
        assert batch.query.frequencies is None
        assert batch.labels.shape == (len(held), 4, 6)
        assert batch.directions.shape == (4, 6)
        assert batch.shares == (1.0, 1.0)
        assert len(held) <= 5


def test_a_place_is_a_position_and_a_frequency(links):
    """Four links share a position, two of them a carrier: a batch counts carriers apart."""
    carrier = torch.arange(len(links)) // 2 % 2
    several = at(links, torch.arange(len(links)) // 4, 1e9 + 1e8 * carrier)
    drawn = draw(several, 3)
    assert [len(batch) for batch in drawn] == [10, 10, 2], "11 pairs of a position and a carrier"
    for batch in drawn:
        held = numbers(batch)
        assert torch.equal(batch.query.frequencies, several.query.frequencies[held])
        pairs = {n // 2 for n in held}
        assert sorted(held) == [n for n in range(PLACES) if n // 2 in pairs]
    apart = [{n // 4 for n in numbers(batch)} for batch in drawn]
    assert any(a & b for a in apart for b in apart if a is not b), (
        "carriers of one position need not come together"
    )


@pytest.mark.parametrize("start", [1, PASS, 2 * PASS + 1])
def test_a_batch_depends_on_its_step_alone(links, start):
    torch.manual_seed(start)  # the global generator has no say
    whole, rest = draw(links, 2 * PASS + 1), draw(links, 2 * PASS + 1, start=start)
    assert [numbers(batch) for batch in rest] == [numbers(batch) for batch in whole[start:]]


def test_a_pass_for_scores_keeps_the_order(links):
    batches = InOrder(links, links.split.train, 5)
    assert len(batches) == PASS
    drawn = list(batches)
    assert [len(batch) for batch in drawn] == [5, 5, 5, 5, 2]
    assert [n for batch in drawn for n in numbers(batch)] == links.split.train.tolist()
    assert all(batch.shares == (1.0, 1.0) for batch in drawn)
    none = InOrder(links, links.split.validation, 5)
    assert len(none) == len(list(none)) == 0
    assert process() == (0, 1)


@pytest.mark.parametrize(
    ("size", "steps", "option"), [(0, 1, "training.batch_size"), (1, -1, "trainer.max_steps")]
)
def test_sizes_below_one_are_refused(links, size, steps, option):
    with pytest.raises(ValueError, match=f"{option} must be at least 1, got"):
        Batches(links, links.split.train, size, 0, steps)


# --- several processes ---


def on_each(monkeypatch, processes, work):
    """The results of several pretended processes."""
    results = []
    for rank in range(processes):
        monkeypatch.setattr(module, "process", lambda rank=rank: (rank, processes))
        results.append(work())
    return results


PLACED = {
    "a place a link": torch.arange(PLACES + 4),
    "places of 1, 2, 3 ... links": torch.repeat_interleave(torch.arange(1, 8), torch.arange(1, 8))[
        : PLACES + 4
    ],
}
"""Numbers of the links' places."""


@pytest.mark.parametrize("processes", [2, 3])
@pytest.mark.parametrize("size", [1, 5, 100])  # 1: fewer places than processes, 5: an uneven rest
@pytest.mark.parametrize("places", PLACED)
def test_processes_share_each_batch_and_their_mean_is_that_of_the_batch(
    links, monkeypatch, processes, size, places
):
    links = at(links, PLACED[places])
    steps = 2 * -(-len(links.query.transmitters[:PLACES].unique(dim=0)) // size)
    whole = draw(links, steps, size)
    shared = on_each(monkeypatch, processes, lambda: draw(links, steps, size))
    # A value of each link, and of each place, as a loss and a penalty are means of them.
    of_link = torch.randn(
        PLACES + 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    of_place = torch.randn(
        PLACES + 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )

    def of_places(batch):
        return of_place[batch.query.transmitters[:, 0].unique().long()].mean()

    assert {len(batches) for batches in shared} == {steps}
    for batch, *parts in zip(whole, *shared, strict=True):
        held = [part for part in parts if part.shares != (0, 0)]
        assert sorted(n for part in held for n in numbers(part)) == sorted(numbers(batch))
        where = [
            place for part in held for place in part.query.transmitters[:, 0].unique().tolist()
        ]
        assert len(where) == len({*where}), "no place is parted"
        assert len(held) == min(processes, len(where))
        assert all(len(part) > 0 for part in parts), "each process has a loss to take part with"
        mean = sum(part.shares[0] * of_link[numbers(part)].mean() for part in parts) / processes
        torch.testing.assert_close(mean, of_link[numbers(batch)].mean())
        mean = sum(part.shares[1] * of_places(part) for part in parts) / processes
        torch.testing.assert_close(mean, of_places(batch))


@pytest.mark.parametrize("processes", [2, 3])
@pytest.mark.parametrize("size", [1, 5, 100])
def test_processes_share_what_is_scored(links, monkeypatch, processes, size):
    """Every link counts once, and all processes go through as many batches, none of them empty."""
    drawn = on_each(monkeypatch, processes, lambda: list(InOrder(links, links.split.train, size)))
    length = on_each(monkeypatch, processes, lambda: len(InOrder(links, links.split.train, size)))
    assert [len(batches) for batches in drawn] == length == [-(-PLACES // size)] * processes
    assert all(len(batch) > 0 and len(batch) <= size for batches in drawn for batch in batches)
    assert {share for batches in drawn for batch in batches for share in batch.shares} <= {0.0, 1.0}
    counted = [
        n for batches in drawn for batch in batches if batch.shares[0] for n in numbers(batch)
    ]
    assert sorted(counted) == links.split.train.tolist()
