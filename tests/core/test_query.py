"""Queries: checks of positions, receivers, carriers and directions; equal links; batches."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.core.geometry import Grid, Rays
from gaigs.core.query import Batch, Query, as_directions

PLACE = [[1.0, 2, 3]]
NONE, ONE, BAND = torch.zeros(0), torch.tensor([2.437123e9]), torch.tensor([1e9, 2e9, 4e9])
QUERY = Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long))


def ask(positions=PLACE, receiver=None, frequency=None, known=NONE):
    receiver = 0 if receiver is None and not isinstance(positions, Query) else receiver
    return Query.from_positions(positions, receiver, frequency, ["west", "east"], known)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([1.0, 2], r"\(..., 3\) positions \[m\], got shape \(2,\)"),
        (3.0, r"got shape \(\)"),
        ([[1.0, 2, 3], [0, math.nan, 1]], r"must be finite, got \[0.0, nan, 1.0\] in row 1"),
        (
            [[1.0, 2, 3], [0, -1e5, 0]],
            r"within 1e5 m of the origin .*, got \[0.0, -100000.0, 0.0\] in row 1",
        ),
        (
            torch.ones(1, 3, dtype=torch.complex64),
            r"must be \(..., 3\) positions \[m\] in real numbers",
        ),
        ([[1.0, 2, 3], [1.0, 2]], r"in real numbers, got \[\[1.0, 2, 3\], \[1.0, 2\]\]"),
        ("west", "in real numbers, got 'west'"),
        (np.ones((1, 3), dtype=bool), "in real numbers"),
        (np.array([[1.0, 2, None]]), r"must be finite, got \[1.0, 2.0, nan\] in row 0"),
        (torch.eye(3).to_sparse(), "got a sparse_coo tensor; give a dense tensor with values"),
        (torch.zeros(1, 3, device="meta"), "got a meta tensor; give a dense tensor"),
        (
            np.ma.array([[1.0, 2, 3]], mask=[[True, False, False]]),
            "in real numbers, got masked_array",
        ),
        (replace(QUERY, transmitters=torch.full((2, 3), math.nan)), "transmitters must be finite"),
        (replace(QUERY, receivers=torch.full((2,), 9)), "receiver must be one of 0 = west"),
        (
            replace(QUERY, frequencies=torch.full((2,), 60.0)),
            r"must be a carrier in Hz, .* got 60; in GHz\?",
        ),
    ],
)
def test_impossible_positions_are_refused(positions, message):
    with pytest.raises(ValueError, match=message) as error:
        ask(positions)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("receiver", "message"),
    [
        (2, "must be one of 0 = west, 1 = east, got 2"),
        (-1, "got -1"),
        (True, "got True"),
        (1.0, "got 1.0"),
        (["up"], "got 'up'"),
        (torch.tensor([0.0]), r"got \(1,\) of torch.float32"),
        (np.array([0, 7, 1]), "got 7"),
        (torch.tensor([0, 1]), r"one for each of the \(1,\) positions, got \(2,\)"),
        (torch.tensor([[0]]), r"one for each of the \(1,\) positions, got \(1, 1\)"),
    ],
)
def test_impossible_receivers_are_refused(receiver, message):
    with pytest.raises(ValueError, match=message) as error:
        ask(receiver=receiver)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("known", [NONE, ONE, BAND])
@pytest.mark.parametrize(
    ("frequency", "message"),
    [
        (0.0, r"^a frequency must be a carrier in Hz, from 10000 to 3e\+11, got 0$"),
        (math.nan, "got nan$"),
        (9e11, r"got 9e\+11$"),
        (0.95, r"got 0\.95; in GHz\?$"),
        (950, r"got 950; in MHz\?$"),
        (torch.tensor([2.4e9, 5.0]), r"got 5; in GHz\?$"),
        ("2 GHz", "must be a carrier in Hz in real numbers, got '2 GHz'"),
        (1e9 + 1j, "must be a carrier in Hz in real numbers, got"),
    ],
)
def test_impossible_frequencies_are_refused(frequency, message, known):
    with pytest.raises(ValueError, match=message):
        ask(frequency=frequency, known=known)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"frequency": 1e9},
            "the training links have no known carrier, so no other can be predicted; leave "
            "frequency",
        ),
        (
            {"frequency": 60e9, "known": ONE},
            r"have one carrier, 2\.437123e\+09 Hz, so no other can be predicted",
        ),
        ({"frequency": float(ONE) * (1 + 2e-6), "known": ONE}, "have one carrier"),
        ({"known": BAND}, r"have 3 carriers, 1e\+09 to 4e\+09 Hz; choose one with frequency="),
        ({"positions": QUERY, "known": BAND}, "have 3 carriers"),
        ({"frequency": BAND, "known": BAND}, r"one for each of the \(1,\) positions, got \(3,\)"),
        ({"positions": QUERY, "receiver": 1}, "a query has its own receivers and frequencies"),
        ({"positions": QUERY, "receiver": "west"}, "a query has its own receivers and frequencies"),
        ({"positions": QUERY, "frequency": 1e9}, "leave receiver and frequency out"),
    ],
)
def test_contradictory_questions_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ask(**arguments)


def test_one_value_or_one_for_each_position():
    query, shape = ask(torch.zeros(2, 2, 3), [[0, 1], [1, 1]], 2e9, BAND)
    assert shape == (2, 2)
    assert query.transmitters.shape == (4, 3)
    assert query.receivers.tolist() == [0, 1, 1, 1]
    assert query.frequencies.tolist() == [2e9] * 4
    for names in (
        ["west", "east", "east"],
        np.array(["west", "east", "east"]),
        {"west": 0, "east": 1}.keys(),
    ):
        assert ask(PLACE * len(names), names)[0].receivers.tolist() == [0, 1, 1][: len(names)]
    query, _ = ask(PLACE * 3, "east", BAND, BAND)
    assert query.receivers.tolist() == [1, 1, 1]
    assert torch.equal(query.frequencies, BAND)
    for index in (np.array([1], dtype=np.uint8), np.int16(1), torch.tensor(1, dtype=torch.int32)):
        assert ask(receiver=index)[0].receivers.tolist() == [1]
    assert ask(QUERY)[0].frequencies is None
    for frequency in (None, float(ONE), 2.437123e9, ONE, float(ONE) * (1 + 5e-7)):
        assert ask(frequency=frequency, known=ONE)[0].frequencies.shape == (1,)


OWN = Grid.degrees(range(10, 90, 10), range(0, 360, 10))


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        (
            Rays(torch.zeros(1), torch.tensor([90.0])),
            "azimuths must be .* rad, got 90; Grid.degrees takes degrees",
        ),
        (
            Rays(torch.tensor([-2.0]), torch.zeros(1)),
            "elevations must be .* -1.5708 to 1.5708 rad, got -2; Grid",
        ),
        (Grid(torch.tensor([math.nan]), torch.zeros(1)), "elevations must be .* rad, got nan"),
    ],
)
def test_impossible_directions_are_refused(directions, message):
    with pytest.raises(ValueError, match=message):
        as_directions(directions, OWN, "spectrum")


def test_rays_of_unlike_lengths_are_refused():
    rays = Rays(torch.zeros(2), torch.zeros(2))
    object.__setattr__(rays, "azimuths", torch.zeros(1))
    with pytest.raises(ValueError, match="as many elevations as azimuths, got 2 and 1"):
        as_directions(rays, OWN, "spectrum")


@pytest.mark.parametrize(
    "view",
    [
        lambda x: x[::-1],
        lambda x: x.astype(">f8"),
        np.asfortranarray,
        lambda x: x.astype(object),
        lambda x: [torch.from_numpy(row) for row in x],
        lambda x: [*np.broadcast_to(x, x.shape)],  # read-only
    ],
)
def test_arrays_of_any_layout_are_positions(view):
    points = view(np.arange(12.0).reshape(4, 3))
    query, shape = Query.from_positions(points, 0, None, ["west"], torch.zeros(0))
    assert query.transmitters.tolist() == [[float(number) for number in row] for row in points]
    assert shape == (4,)


def test_no_positions_are_an_empty_query():
    query, shape = Query.from_positions([], 0, None, ["west"], torch.zeros(0))
    assert (query.transmitters.shape, query.receivers.shape, shape) == ((0, 3), (0,), (0,))


def test_all_receivers_have_a_last_axis():
    query, shape = Query.from_positions(
        torch.arange(6.0).reshape(2, 3), None, BAND[:2], ["west", "east"], BAND
    )
    assert shape == (2, 2)
    assert query.transmitters[:, 0].tolist() == [0, 0, 3, 3]
    assert query.receivers.tolist() == [0, 1, 0, 1]
    assert query.frequencies.tolist() == [1e9, 1e9, 2e9, 2e9]


def test_directions_become_float32():
    assert as_directions(None, OWN, "spectrum") is OWN
    assert as_directions(None, None, "rssi") is None
    with pytest.raises(
        ValueError, match="labels of task 'rssi' have no directions; leave directions out"
    ):
        as_directions(OWN, None, "rssi")

    rays = as_directions(
        Rays(torch.full((3,), math.pi / 2 + 1e-5).double(), torch.arange(3.0)), OWN, "spectrum"
    )
    assert rays.azimuths.dtype == rays.elevations.dtype == torch.float32


both = pytest.mark.parametrize("with_receivers", [False, True])


def make(n=60, dtype=torch.float32, frequencies=True, seed=0):
    """Links between few places, receivers and carriers, so that many are equal."""
    generator = torch.Generator().manual_seed(seed)

    def draw(count):
        return torch.randint(count, (n,), generator=generator)

    places = torch.tensor([[0.1, 2, 3], [0.1, 2, -3], [-1, 7, 1], [0.1, -2, 3]], dtype=dtype)
    carriers = torch.tensor([2.4e9, 5.2e9, 5.200001e9], dtype=dtype)
    return Query(places[draw(4)], draw(3), carriers[draw(3)] if frequencies else None)


def keys(query, with_receivers):
    """Fields by which links differ, as tuples of Python's numbers, in the order of sorting."""
    columns = [query.transmitters.double()]
    columns += [] if query.frequencies is None else [query.frequencies.double()[:, None]]
    columns += [query.receivers.double()[:, None]] if with_receivers else []
    return [tuple(row) for row in torch.cat(columns, 1).tolist()]


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
    for i, receiver in enumerate(different.receivers):
        assert receiver in query.receivers[which == i]


@both
def test_a_place_at_minus_zero_is_the_place_at_zero(with_receivers):
    query = Query(
        torch.tensor([[0.0, 1, 2], [-0.0, 1, 2], [1e-30, 1, -0.0]]),
        torch.zeros(3, dtype=torch.long),
    )
    _, which = query.unique(with_receivers)
    assert which[0] == which[1] != which[2]


@both
@pytest.mark.parametrize("frequencies", [None, torch.zeros(0)])
def test_an_empty_query_has_no_different_links(with_receivers, frequencies):
    query = Query(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), frequencies)
    different, which = query.unique(with_receivers)
    assert len(different) == len(which) == 0
    assert different.transmitters.shape == (0, 3)
    assert (different.frequencies is None) == (frequencies is None)


@pytest.mark.parametrize("size", [1, 7, 60, 100])
def test_parts_are_the_links_in_their_order(size):
    query = make()
    parts = [*query.parts(size)]
    assert [len(part) for part in parts[:-1]] == [size] * (len(parts) - 1)
    assert 1 <= len(parts[-1]) <= size
    for field in ("transmitters", "receivers", "frequencies"):
        assert torch.equal(
            torch.cat([getattr(part, field) for part in parts]), getattr(query, field)
        )
    assert [len(part) for part in query[:0].parts(size)] == [0]
    assert make(frequencies=False)[torch.tensor([4, 4, 0])].frequencies is None


def test_a_batch_goes_to_another_device_as_a_whole():
    batch = Batch(
        make(), Grid.degrees(range(1, 4), range(5)), torch.zeros(60, 3, 5), (0.5, 0.25)
    ).to("meta")
    tensors = [
        batch.query.transmitters,
        batch.query.receivers,
        batch.query.frequencies,
        batch.labels,
    ]
    tensors += [batch.directions.elevations, batch.directions.azimuths]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert batch.shares == (0.5, 0.25)
    assert len(batch) == 60
    bare = Batch(make(frequencies=False)).to("meta")
    assert bare.labels is bare.directions is bare.query.frequencies is None
