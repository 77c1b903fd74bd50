"""Parts of made-up trajectories and clouds, checked by set arithmetic and numpy."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from gaigs.configuration import conf_dir
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.registry import registry

N = 400

SPLITS = [
    {"name": "official"},
    {"name": "random", "test": 0.25},
    {"name": "sparse", "train": 60, "test": 0.25},
    {"name": "runs", "length": 10, "test": 0.25},
    {"name": "blocks", "edge": 0.5, "test": 0.25},
]
each_split = pytest.mark.parametrize("options", SPLITS, ids=lambda options: options["name"])


def links_at(places, rows=None, official=None):
    """Links from places, by default each of its own row, to one receiver."""
    return Links(
        query=Query(places, torch.zeros(len(places), dtype=torch.long)),
        receivers=(Receiver("gateway1", Pose(torch.zeros(3), torch.eye(3))),),
        labels=torch.linspace(-80, -40, len(places)),
        task=Rssi(),
        rows=rows,
        official=official,
    )


def part(links, **options):
    return registry("split").build(options, links=links)


@pytest.fixture
def links():
    """A cloud; the data's own parts are the even links against every fourth of the odd ones, out of
    order.
    """
    places = 3 * torch.rand(N, 3, generator=torch.Generator().manual_seed(1))
    return links_at(
        places, official=lambda: (torch.arange(0, N, 2).flip(0), torch.arange(1, N, 4).flip(0))
    )


@each_split
def test_validation_takes_training_links_only(links, options):
    with_validation, without = (part(links, validation=v, **options) for v in (0.2, 0))
    assert torch.equal(with_validation.test, without.test)
    training = torch.cat((with_validation.train, with_validation.validation)).sort().values
    assert torch.equal(training, without.train)


def test_official_parts_are_those_given(links):
    result = part(links, name="official", validation=0)
    assert result.train.tolist() == list(range(0, N, 2))
    assert result.test.tolist() == list(range(1, N, 4))


@each_split
def test_official_parts_are_asked_for_by_the_official_split_alone(links, options):
    asked = []
    spied = replace(links, official=lambda: asked.append(1) or links.official())
    part(spied, **options)
    assert bool(asked) == (options["name"] == "official")


@pytest.mark.parametrize("test", [0.1, 0.25, 0.9])
def test_random_holds_out_the_fraction(links, test):
    result = part(links, name="random", test=test, validation=0)
    assert len(result.test) == round(test * N)
    assert (
        0.3 < result.test.double().mean() / N < 0.7
    )  # drawn from everywhere, not the head or the tail


def test_sparse_parts_are_nested_and_share_their_test(links):
    few, more = (part(links, name="sparse", train=count, validation=0) for count in (20, 100))
    random = part(links, name="random", validation=0)
    assert (len(few.train), len(more.train)) == (20, 100)
    assert set(few.train.tolist()) < set(more.train.tolist()) < set(random.train.tolist())
    assert torch.equal(few.test, random.test)
    assert torch.equal(more.test, random.test)


@given(
    seed=st.integers(0, 10**6), edge=st.floats(0.2, 1.4), far=st.sampled_from([0.0, -50.0, 1000.0])
)
def test_cubes_stay_whole(seed, edge, far):
    points = 3 * torch.rand(200, 3, generator=torch.Generator().manual_seed(seed)) + far
    result = part(links_at(points), name="blocks", edge=edge, seed=seed, validation=0.2)
    cubes = np.floor((points.double().numpy() - points.double().numpy().min(0)) / edge).astype(int)
    parts = [
        {tuple(cubes[i]) for i in p.tolist()}
        for p in (result.train, result.validation, result.test)
    ]
    assert all(parts)
    assert sum(map(len, parts)) == len(set.union(*parts))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"name": "official", "validation": 0.1}, "official, validation 0.1, seed 0"),
        ({"name": "official", "length": 4}, "official, validation 0.1 in runs of 4, seed 0"),
        ({"name": "sparse", "train": 60}, "sparse 60, test 0.2, validation 0.15, seed 0"),
        (
            {"name": "runs", "length": 20, "test": 0.3},
            "runs of 20, test 0.3, validation 0.1, seed 0",
        ),
        ({"name": "blocks", "edge": 0.25, "validation": 0}, "blocks 0.25 m, test 0.2, seed 0"),
    ],
)
def test_names_say_the_numbers(links, options, name):
    assert part(links, **options).name == name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "cubes"}, "unknown split 'cubes'.*; there are: blocks, .*official"),
        (
            {"name": "random", "edge": 0.5, "length": 3},
            "'random' has no option 'edge' .*or 'length'.*; it has: test",
        ),
        ({"name": "blocks"}, "'blocks' needs option edge"),
        ({"name": "random", "test": 1.0}, r"split.test must be in \[0, 1\), got 1"),
        ({"name": "random", "validation": 1}, r"split.validation must be in \[0, 1\), got 1"),
        ({"name": "official", "validation": 1.5}, "split.validation must be"),
        ({"name": "official", "length": 0}, "split.length must be a whole number of rows"),
        ({"name": "blocks", "edge": 0}, r"split.edge must be from 1e-06 to 1e\+06 m, got 0"),
        *(
            (options | {"seed": -1}, "split.seed must be a whole number from 0 to")
            for options in SPLITS
        ),
        ({"name": "sparse", "train": 321}, r"split.train must be in 1\.\.320"),
        (
            {"name": "blocks", "edge": 50.0},
            r"split.test=0\.2 holds out whole .* two of them or more, got 1 with 400",
        ),
    ],
)
def test_unusable_options_are_refused(links, options, message):
    with pytest.raises(ValueError, match=message):
        part(links, **options)


def test_data_without_official_parts_says_so(links):
    with pytest.raises(
        ValueError, match="no official split; choose split=random, sparse, runs or blocks"
    ):
        part(replace(links, official=None), name="official")


# --- several links a row ---


@pytest.fixture
def heard():
    """Links by which up to six receivers heard 120 rows; the first 90 rows are for training. Row 7
    was not heard.
    """
    generator = torch.Generator().manual_seed(5)
    heard = torch.rand(120, 6, generator=generator) < 0.6
    heard[7] = False
    rows = heard.nonzero()[:, 0]
    early = rows < 90

    def official():
        return (early.nonzero()[:, 0], (~early).nonzero()[:, 0])

    return links_at(3 * torch.rand(120, 3, generator=generator)[rows], rows, official)


def test_runs_count_rows(heard):
    rows = heard.rows
    result = part(heard, name="runs", length=10, validation=0)
    runs = [set((rows[part] // 10).tolist()) for part in (result.train, result.test)]
    assert runs[0].isdisjoint(runs[1])
    assert runs[0] | runs[1] == set(range(12))
    assert len(result.test) == pytest.approx(0.2 * len(rows), abs=30)


def test_official_validation_in_runs_of_rows(heard):
    rows = heard.rows
    official = (rows < 100).nonzero()[:, 0], (rows >= 100).nonzero()[:, 0]
    result = part(
        replace(heard, official=lambda: official), name="official", length=10, validation=0.45
    )
    validating = rows[result.validation].unique()
    assert {(row // 10).item() for row in validating}.isdisjoint(
        (rows[result.train] // 10).tolist()
    )
    assert len(validating) == pytest.approx(45, abs=10)
    assert torch.equal(result.test, official[1])


@pytest.mark.parametrize(
    ("rows", "length", "expected"), [(126, 100, 3), (4000, 100, 100), (30, 100, 1), (126, 2, 2)]
)
def test_official_runs_are_short_enough_for_four_to_validate(rows, length, expected):
    """Of 126 rows one run of 100 would be most of the training."""
    links = links_at(
        torch.rand(rows + 9, 3), official=lambda: torch.arange(rows + 9).split((rows, 9))
    )
    result = part(links, name="official", length=length, validation=0.1)
    assert 0.05 * rows < len(result.validation) <= 0.1 * rows
    assert len(result.validation) % expected == 0
    assert (
        len((result.validation // expected).unique())
        == len(result.validation) / expected
        >= min(4, 0.1 * rows)
    )
    assert (f"runs of {expected}" in result.name) == (expected > 1)


# --- repeated readings ---


@pytest.mark.parametrize("has_rows", [True, False])
@pytest.mark.parametrize("options", [{"name": "random"}, {"name": "sparse", "train": 40}])
def test_fractions_count_places_not_readings(options, has_rows):
    """A robot stands at one of 60 places for half of its readings."""
    readings = torch.ones(60, dtype=torch.long).index_fill(0, torch.tensor(17), 60)
    place = torch.arange(60).repeat_interleave(readings)
    links = links_at(torch.rand(60, 3)[place], place if has_rows else None)
    for seed in range(10):
        split = part(links, validation=0.1, seed=seed, **options)
        places = [set(place[some].tolist()) for some in split.parts().values()]
        train = 43 if options["name"] == "random" else 36
        assert [len(own) for own in places] == [train, 48 - train if train == 43 else 4, 12]
        assert len(set.union(*places)) == sum(map(len, places))


@each_split
def test_a_place_that_is_read_again_changes_no_other_draw(links, options):
    if options["name"] in ("runs", "blocks"):
        pytest.skip("runs and cubes are drawn as such")
    again = replace(
        links, query=replace(links.query, transmitters=links.query.transmitters.clone())
    )
    again.query.transmitters[200] = again.query.transmitters[100]
    for before, after in zip(
        part(links, **options).parts().values(),
        part(again, **options).parts().values(),
        strict=True,
    ):
        assert len(set(before.tolist()) ^ set(after.tolist())) <= 2


@pytest.mark.parametrize(
    ("count", "validating", "name"),
    [(20, 2, 0.1), (36, 3, 0.1), (40, 9, 0.28), (100, 9, 0.11), (400, 32, 0.1)],
)
def test_few_links_leave_enough_for_intervals(count, validating, name):
    split = part(links_at(torch.rand(count, 3)), name="random")
    assert len(split.validation) == validating
    assert split.name == f"random, test 0.2, validation {name}, seed 0"
    asked = part(links_at(torch.rand(count, 3)), name="random", validation=0.1)
    assert len(asked.validation) == round(0.1 * round(0.8 * count))


# --- configuration ---


@pytest.mark.parametrize(
    "file", sorted((conf_dir() / "split").glob("*.yaml")), ids=lambda file: file.stem
)
def test_a_configuration_has_every_option_with_its_default(file):
    config = OmegaConf.load(file)
    mandatory = OmegaConf.missing_keys(config)
    options = {key: config[key] for key in config.keys() - mandatory - {"name"}}
    parameters = inspect.signature(registry("split").get(config.name)).parameters
    assert {*options, *mandatory} == parameters.keys() - {"links"}
    assert mandatory == {name for name, p in parameters.items() if p.default is p.empty} - {"links"}
    defaults = {name: parameters[name].default for name in options}
    assert options == defaults | ({"length": 100} if file.stem == "official_runs" else {})


def test_receivers_are_held_out_whole():
    rng = torch.Generator().manual_seed(0)
    places = torch.rand(40, 3, generator=rng)
    base = links_at(places[torch.arange(40).repeat_interleave(6)])
    pose = Pose(torch.zeros(3), torch.eye(3))
    many = replace(
        base,
        query=replace(base.query, receivers=torch.arange(6).repeat(40)),
        receivers=tuple(Receiver(f"ap{number}", pose) for number in range(6)),
    )

    def heard(part_of):
        return set(many.query.receivers[part_of].tolist())

    folds = [part(many, name="receivers", fold=f"{number}/3") for number in (1, 2, 3)]
    assert sorted(receiver for split in folds for receiver in heard(split.test)) == [*range(6)]
    for split in folds:
        parts = [heard(one) for one in split.parts().values()]
        assert len(parts[1]) == 1
        assert not set.intersection(*parts)
        assert sum(map(len, parts)) == 6
        assert len(torch.cat([*split.parts().values()])) == 240
        assert split.by_receivers
    named = part(many, name="receivers", hold=["ap4", "ap1"])
    assert heard(named.test) == {1, 4}
    assert named.name.startswith("receivers ap4, ap1")
    few = part(many, name="receivers", hold=["ap0", "ap1", "ap2", "ap3"])
    assert heard(few.train) == heard(few.validation) == {4, 5}  # of two, places validate
    assert not len(part(many, name="receivers", validation=0.0).validation)
    assert len(heard(part(many, name="receivers", validation=0.9).train)) == 2
    lost = replace(many, uncertainties=torch.full((6,), torch.inf))
    with pytest.raises(ValueError, match="receivers of known places"):
        part(lost, name="receivers")
    for options, words in (
        ({"hold": ["cellar"]}, "got 'cellar'"),
        ({"hold": "ap1", "fold": "1/3"}, "leave one out"),
        ({"fold": "4/3"}, "split.fold must be a fold such as 1/3"),
        ({"fold": "x"}, "split.fold must be a fold"),
        ({"test": 0.9}, "two receivers or more to train on"),
        ({"test": 1.5}, "split.test must be"),
    ):
        with pytest.raises(ValueError, match=words):
            part(many, name="receivers", **options)
