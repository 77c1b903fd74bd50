"""Parts of made-up trajectories and clouds, checked by set arithmetic and numpy."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gaigs.data.splits import split

N = 400


@pytest.fixture
def transmitters():
    return 3 * torch.rand(N, 3, generator=torch.Generator().manual_seed(1))


PROTOCOLS = [
    {"protocol": "official"},
    {"protocol": "random", "test": 0.25},
    {"protocol": "sparse", "train": 60, "test": 0.25},
    {"protocol": "runs", "length": 10, "test": 0.25},
    {"protocol": "blocks", "edge": 0.5, "test": 0.25},
]


def part(transmitters, **options):
    """A split; the data's own parts are the even links against every fourth of the odd ones, out of order."""
    official = torch.arange(0, N, 2).flip(0), torch.arange(1, N, 4).flip(0)
    return split(transmitters, official=official, **options)


@pytest.mark.parametrize("options", PROTOCOLS, ids=lambda options: options["protocol"])
@pytest.mark.parametrize("validation", [0, 0.2])
def test_parts_are_disjoint_and_ascending(transmitters, options, validation):
    result = part(transmitters, validation=validation, **options)
    parts = [result.train, result.validation, result.test]
    links = torch.cat(parts).tolist()
    assert len(links) == len(set(links))
    assert all(p.tolist() == sorted(p.tolist()) and p.dtype == torch.int64 for p in parts)
    assert len(result.train)
    assert len(result.test)
    kept = {"official": 300, "sparse": 160}.get(options["protocol"], N)
    assert len(links) == kept
    training = len(result.train) + len(result.validation)
    assert len(result.validation) == pytest.approx(validation * training, abs=10)
    assert bool(len(result.validation)) == bool(validation)


@pytest.mark.parametrize("options", PROTOCOLS, ids=lambda options: options["protocol"])
def test_validation_takes_training_links_only(transmitters, options):
    with_validation, without = (part(transmitters, validation=v, **options) for v in (0.2, 0))
    assert torch.equal(with_validation.test, without.test)
    training = torch.cat((with_validation.train, with_validation.validation)).sort().values
    assert torch.equal(training, without.train)


@pytest.mark.parametrize("options", PROTOCOLS, ids=lambda options: options["protocol"])
def test_a_split_repeats_with_its_seed_alone(transmitters, options):
    first, again, other = (part(transmitters, seed=seed, **options) for seed in (3, 3, 4))
    assert torch.equal(first.train, again.train)
    assert torch.equal(first.test, again.test)
    assert not torch.equal(first.train, other.train)
    assert first.name == again.name != other.name


def test_official_parts_are_those_given(transmitters):
    result = part(transmitters, protocol="official", validation=0)
    assert result.train.tolist() == list(range(0, N, 2))
    assert result.test.tolist() == list(range(1, N, 4))
    assert result.name == "official"


@pytest.mark.parametrize("test", [0.1, 0.25, 0.9])
def test_random_holds_out_the_fraction(transmitters, test):
    result = part(transmitters, protocol="random", test=test, validation=0)
    assert len(result.test) == round(test * N)
    assert 0.3 < result.test.double().mean() / N < 0.7  # drawn from everywhere, not the head or the tail


def test_sparse_parts_are_nested_and_share_their_test(transmitters):
    few, more = (part(transmitters, protocol="sparse", train=count, validation=0) for count in (20, 100))
    random = part(transmitters, protocol="random", validation=0)
    assert (len(few.train), len(more.train)) == (20, 100)
    assert set(few.train.tolist()) < set(more.train.tolist()) < set(random.train.tolist())
    assert torch.equal(few.test, random.test)
    assert torch.equal(more.test, random.test)


@pytest.mark.parametrize("length", [1, 7, 20])
def test_runs_stay_whole(transmitters, length):
    result = part(transmitters, protocol="runs", length=length, validation=0.2)
    home = {link: name for name in ("train", "validation", "test") for link in getattr(result, name).tolist()}
    for start in range(0, N, length):
        assert len({home[link] for link in range(start, min(start + length, N))}) == 1
    assert len(result.test) == pytest.approx(0.2 * N, abs=length)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), edge=st.floats(0.2, 1.4), far=st.sampled_from([0.0, -50.0, 1000.0]))
def test_cubes_stay_whole(seed, edge, far):
    points = 3 * torch.rand(200, 3, generator=torch.Generator().manual_seed(seed)) + far
    result = split(points, "blocks", edge=edge, seed=seed, validation=0.2)
    cubes = np.floor((points.double().numpy() - points.double().numpy().min(0)) / edge).astype(int)
    parts = [{tuple(cubes[i]) for i in p.tolist()} for p in (result.train, result.validation, result.test)]
    assert all(parts)
    assert sum(map(len, parts)) == len(set.union(*parts))


def test_cubes_hold_out_about_the_fraction(transmitters):
    result = part(transmitters, protocol="blocks", edge=0.5, test=0.2, validation=0)
    largest = torch.unique((transmitters / 0.5).floor(), dim=0, return_counts=True)[1].max()
    assert len(result.test) == pytest.approx(0.2 * N, abs=2 * int(largest))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"protocol": "official", "validation": 0.1}, "official, validation 0.1, seed 0"),
        ({"protocol": "official", "length": 8}, "official, validation 0.1 in runs of 8, seed 0"),
        ({"protocol": "official", "length": 8, "validation": 0}, "official"),
        ({"protocol": "random", "validation": 0, "seed": 2}, "random, test 0.2, seed 2"),
        ({"protocol": "sparse", "train": 60}, "sparse 60, test 0.2, validation 0.1, seed 0"),
        ({"protocol": "runs", "length": 20, "test": 0.3}, "runs of 20, test 0.3, validation 0.1, seed 0"),
        ({"protocol": "blocks", "edge": 0.25, "validation": 0}, "blocks 0.25 m, test 0.2, seed 0"),
    ],
)
def test_names_say_the_numbers(transmitters, options, name):
    assert part(transmitters, **options).name == name


def test_an_option_at_none_is_not_given(transmitters):
    given_, plain = (part(transmitters, protocol="random", **o) for o in ({"edge": None, "test": None}, {}))
    assert torch.equal(given_.test, plain.test)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"protocol": "cubes"}, "unknown split protocol 'cubes'; there are: official, random"),
        (
            {"protocol": "random", "edge": 0.5, "length": 3},
            "'random' has no option edge, length; it has: test, validation, seed; set others to null",
        ),
        ({"protocol": "runs", "lenght": 5}, "has no option lenght; it has: length, test, validation, seed"),
        ({"protocl": "runs"}, "'official' has no option protocl"),
        ({"protocol": "official", "test": 0.2}, "'official' has no option test"),
        ({"protocol": "blocks"}, "'blocks' needs option 'edge'"),
        ({"protocol": "runs"}, "'runs' needs option 'length'"),
        ({"protocol": "sparse"}, "'sparse' needs option 'train'"),
        ({"protocol": "random", "test": 0}, r"'test' must be in \(0, 1\), got 0"),
        ({"protocol": "random", "test": 1.0}, r"'test' must be in \(0, 1\), got 1.0"),
        ({"protocol": "random", "validation": 1}, r"'validation' must be in \[0, 1\), got 1"),
        ({"protocol": "random", "validation": -0.1}, "'validation' must be"),
        ({"protocol": "official", "length": 0}, "'length' must be a whole number of rows"),
        ({"protocol": "official", "length": N}, "takes two groups of them or more, got 1"),
        ({"protocol": "runs", "length": 0}, "'length' must be a whole number of rows"),
        ({"protocol": "runs", "length": 2.5}, "'length' must be a whole number of rows"),
        ({"protocol": "blocks", "edge": 0}, r"'edge' must be positive \[m\], got 0"),
        ({"protocol": "blocks", "edge": float("nan")}, "'edge' must be positive"),
        ({"protocol": "sparse", "train": 321}, r"'train' must be in 1\.\.320"),
        ({"protocol": "blocks", "edge": 50.0}, "takes two groups of them or more, got 1"),
        ({"protocol": "runs", "length": 250, "validation": 0.1}, "takes two groups"),
    ],
)
def test_unusable_options_are_refused(transmitters, options, message):
    with pytest.raises(ValueError, match=message):
        part(transmitters, **options)


def test_data_without_official_parts_says_so(transmitters):
    with pytest.raises(ValueError, match="no official split; choose of random, sparse, runs, blocks"):
        split(transmitters, "official")


# --- several links a row ---


@pytest.fixture
def heard():
    """Places of 120 rows, and the rows of the links by which up to six receivers heard them; row 7 was not heard."""
    generator = torch.Generator().manual_seed(5)
    heard = torch.rand(120, 6, generator=generator) < 0.6
    heard[7] = False
    return 3 * torch.rand(120, 3, generator=generator), heard.nonzero()[:, 0]


@pytest.mark.parametrize("options", PROTOCOLS, ids=lambda options: options["protocol"])
@pytest.mark.parametrize("seed", range(3))
def test_links_of_a_row_are_never_parted(heard, options, seed):
    places, rows = heard
    early = rows < 90
    official = early.nonzero()[:, 0], (~early).nonzero()[:, 0]
    result = split(places[rows], rows=rows, official=official, seed=seed, validation=0.2, **options)
    parts = [set(rows[part].tolist()) for part in result.parts().values()]
    assert all(parts)
    assert sum(map(len, parts)) == len(set.union(*parts))
    training = len(result.train) + len(result.validation)
    if options["protocol"] != "blocks":
        assert len(result.validation) == pytest.approx(0.2 * training, abs=40)
    if options["protocol"] != "sparse":
        assert training + len(result.test) == len(rows)


def test_sparse_counts_rows(heard):
    places, rows = heard
    few, more = (split(places[rows], "sparse", rows=rows, train=count, validation=0) for count in (5, 40))
    assert (len(rows[few.train].unique()), len(rows[more.train].unique())) == (5, 40)
    assert set(few.train.tolist()) < set(more.train.tolist())
    assert len(few.train) > 5
    with pytest.raises(ValueError, match=r"'train' must be in 1\.\.\d\d, the rows that do not test"):
        split(places[rows], "sparse", rows=rows, train=119)


def test_runs_count_rows(heard):
    places, rows = heard
    result = split(places[rows], "runs", rows=rows, length=10, validation=0)
    runs = [set((rows[part] // 10).tolist()) for part in (result.train, result.test)]
    assert runs[0].isdisjoint(runs[1])
    assert runs[0] | runs[1] == set(range(12))
    assert len(result.test) == pytest.approx(0.2 * len(rows), abs=30)


def test_official_validation_in_runs_of_rows(heard):
    places, rows = heard
    official = (rows < 100).nonzero()[:, 0], (rows >= 100).nonzero()[:, 0]
    result = split(places[rows], rows=rows, official=official, length=10, validation=0.3)
    validating = rows[result.validation].unique()
    assert {(row // 10).item() for row in validating}.isdisjoint((rows[result.train] // 10).tolist())
    assert len(validating) == pytest.approx(30, abs=10)
    assert torch.equal(result.test, official[1])


def test_each_link_is_a_row_of_its_own_unless_given(transmitters):
    for options in PROTOCOLS[1:]:
        plain, numbered = (split(transmitters, **options, **o) for o in ({}, {"rows": torch.arange(N)}))
        assert all(torch.equal(a, b) for a, b in zip(plain.parts().values(), numbered.parts().values(), strict=True))
