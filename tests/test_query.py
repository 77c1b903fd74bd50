"""Queries: what makes two alike, checked against Python's own sets, and batches of them."""

import pytest
import torch

from gaigs.directions import Grid
from gaigs.query import Batch, Query

both = pytest.mark.parametrize("with_receivers", [False, True])


def make(n=60, dtype=torch.float32, frequencies=True, seed=0):
    """Links between few places, receivers and carriers, so that many are alike."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda count: torch.randint(count, (n,), generator=generator)
    places = torch.tensor([[0.1, 2, 3], [0.1, 2, -3], [-1, 7, 1], [0.1, -2, 3]], dtype=dtype)
    carriers = torch.tensor([2.4e9, 5.2e9, 5.200001e9], dtype=dtype)
    return Query(places[draw(4)], draw(3), carriers[draw(3)] if frequencies else None)


def keys(query, with_receivers):
    """What two links differ by, as tuples of Python's numbers, in the order that they are sorted by."""
    rows = query.transmitters.tolist()
    if query.frequencies is not None:
        rows = [[*row, frequency] for row, frequency in zip(rows, query.frequencies.tolist(), strict=True)]
    if with_receivers:
        rows = [[*row, receiver] for row, receiver in zip(rows, query.receivers.tolist(), strict=True)]
    return [tuple(row) for row in rows]


@both
@pytest.mark.parametrize("frequencies", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_different_links_are_those_of_a_set(with_receivers, frequencies, dtype):
    query = make(dtype=dtype, frequencies=frequencies)
    different, which = query.unique(with_receivers)
    assert keys(different, with_receivers) == sorted(set(keys(query, with_receivers)))
    assert [keys(different, with_receivers)[i] for i in which] == keys(query, with_receivers)
    assert different.transmitters.dtype == dtype
    assert which.dtype == different.receivers.dtype == torch.long


def test_each_field_alone_tells_links_apart():
    query = Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long), torch.full((2,), 1e9))
    assert len(query.unique(True)[0]) == 1
    for axis in range(3):
        moved = Query(query.transmitters.clone(), query.receivers, query.frequencies)
        moved.transmitters[1, axis] = 1e-30
        assert len(moved.unique(False)[0]) == 2
    other = Query(query.transmitters, torch.arange(2), query.frequencies)
    assert [len(other.unique(seen)[0]) for seen in (False, True)] == [1, 2]
    other = Query(query.transmitters, query.receivers, torch.tensor([1e9, 1e9 + 64]))
    assert len(other.unique(False)[0]) == 2


@both
def test_a_place_at_minus_zero_is_the_place_at_zero(with_receivers):
    query = Query(torch.tensor([[0.0, 1, 2], [-0.0, 1, 2], [0.0, 1, -0.0]]), torch.zeros(3, dtype=torch.long))
    _, which = query.unique(with_receivers)
    assert which[0] == which[1] != which[2]


@both
@pytest.mark.parametrize("frequencies", [None, torch.zeros(0)])
def test_no_links_are_no_different_links(with_receivers, frequencies):
    query = Query(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), frequencies)
    different, which = query.unique(with_receivers)
    assert len(different) == len(which) == 0
    assert different.transmitters.shape == (0, 3)
    assert (different.frequencies is None) == (frequencies is None)


def test_where_receivers_do_not_count_each_place_keeps_one_of_its_own():
    query = make()
    different, which = query.unique(with_receivers=False)
    for i, receiver in enumerate(different.receivers):
        assert receiver in query.receivers[which == i]


@pytest.mark.parametrize(
    "index", [slice(1, 20, 3), torch.tensor([4, 4, 0]), torch.zeros(0).long(), torch.arange(60) > 40]
)
def test_some_links_have_all_their_fields(index):
    query = make()
    some = query[index]
    for field in ("transmitters", "receivers", "frequencies"):
        assert torch.equal(getattr(some, field), getattr(query, field)[index])
    assert make(frequencies=False)[index].frequencies is None


@pytest.mark.parametrize("size", [1, 7, 60, 100])
def test_parts_are_the_links_in_their_order(size):
    query = make()
    parts = [*query.parts(size)]
    assert [len(part) for part in parts[:-1]] == [size] * (len(parts) - 1)
    assert 1 <= len(parts[-1]) <= size
    assert torch.equal(torch.cat([part.transmitters for part in parts]), query.transmitters)
    assert torch.equal(torch.cat([part.frequencies for part in parts]), query.frequencies)
    assert not [*query[:0].parts(size)]


def test_a_batch_goes_to_another_device_as_a_whole():
    grid = Grid.degrees(range(1, 4), range(5))
    batch = Batch(make(), grid, torch.zeros(60, 3, 5), (0.5, 0.25)).to("meta")
    tensors = [batch.query.transmitters, batch.query.receivers, batch.query.frequencies, batch.labels]
    tensors += [batch.directions.elevations, batch.directions.azimuths]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert batch.shares == (0.5, 0.25)
    assert len(batch) == 60


def test_a_batch_without_labels_or_directions_goes_too():
    batch = Batch(make(frequencies=False)).to("meta")
    assert batch.labels is batch.directions is batch.query.frequencies is None
    assert batch.shares == (1.0, 1.0)
