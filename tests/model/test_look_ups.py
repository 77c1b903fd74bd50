"""Look-ups, kNN in particular; test_baselines_by_hand.py has their formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.geometry import ExtrapolationWarning, Grid, Rays
from gaigs.core.query import Batch, Query
from gaigs.data import Split
from gaigs.kriging.links import Near, distances, nearest_places
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.registry import registry
from gaigs.testing import example_links


@pytest.fixture(params=["spectrum", "rssi", "csi"])
def links(request):
    links = example_links(request.param)
    places = example_links().query.transmitters  # each link's own, of whatever task
    return replace(links, query=replace(links.query, transmitters=places), rows=None)


BOTH = pytest.mark.parametrize(
    "build", [Mean, lambda scene: KNearestNeighbours(scene, 3)], ids=["mean", "knn"]
)


@pytest.mark.parametrize("shift", [0.0, 2e3])
@pytest.mark.parametrize("power", [1.0, 2.0, 100.0])
def test_where_a_training_link_stands_its_label_comes_back(links, shift, power):
    links = replace(
        links, query=replace(links.query, transmitters=links.query.transmitters + shift)
    )
    model = KNearestNeighbours(links.scene, 3, power)
    model.fit(links)
    predictions = model.predict(links.query.transmitters[:4:2], 0)
    torch.testing.assert_close(predictions, links.labels[:4:2], rtol=1e-5, atol=1e-5)


def test_distances_far_from_the_origin_are_exact():
    """torch's matrix product for more than 25 places rounds, and gives copies of a place different
    distances.
    """
    a, b = 1e5 + 0.01 * torch.rand(2, 40, 3, dtype=torch.float64)
    torch.testing.assert_close(distances(a, b), (a[:, None] - b).norm(dim=-1), rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("name", "task"),
    [("mean", "spectrum"), ("knn", "rssi"), ("path_loss", "rssi"), ("friis", "csi")],
)
def test_known_links_are_needed_at_each_receiver(name, task):
    links = example_links(task)
    model = registry("model").build({"name": name}, scene=links.scene)
    if name != "knn":
        assert model.predict(torch.rand(3, 3)).isnan().all(), "no numbers before the fit"
    links.query.receivers[:20] = 0  # the other is heard in the test alone
    with pytest.raises(
        ValueError, match="split 'example' has no known links of gateway1; choose another split"
    ):
        model.fit(links)


@pytest.mark.parametrize(
    ("k", "power"), [(0, 2.0), (-2, 2.0), (3, -1.0), (3, float("inf")), (3, float("nan"))]
)
def test_a_neighbourhood_out_of_range_is_refused(k, power):
    with pytest.raises(
        ValueError, match=r"model\.(k must be at least 1 or|power must be 0 or more, and finite)"
    ):
        KNearestNeighbours(example_links().scene, k, power)


def test_the_number_of_neighbours_follows_from_held_out_groups():
    """Readings of one run are equal, and those of others pure noise: within runs one neighbour
    would do.
    """
    links = gaigs.links("synthetic_rssi", transmitters=200)
    query = replace(links.query, receivers=torch.zeros_like(links.query.receivers))
    group = torch.arange(len(links)) // 20
    places = torch.stack(
        (group.float(), torch.arange(len(links)) % 20 / 1e3, torch.zeros(len(links))), 1
    )
    labels = torch.randn(len(links), generator=torch.Generator().manual_seed(0))[group]
    split = Split("runs", *torch.arange(len(links)).split((600, 100, len(links) - 700)), group)
    query = replace(query, transmitters=places)
    links = replace(
        links, query=query, labels=labels, split=split, receivers=links.receivers[:1], rows=None
    )
    chosen = []
    for each in (links, replace(links, split=replace(split, groups=None))):
        model = KNearestNeighbours(links.scene, None)
        model.fit(each)
        chosen.append(model.chosen)
    assert chosen[0] > 1
    assert chosen[1] == 1


def test_many_readings_of_one_place_are_sought_for_those_near_it_alone(monkeypatch):
    links = gaigs.links("synthetic_rssi", transmitters=200)
    links.query.transmitters[:300] = links.query.transmitters[0]
    model = KNearestNeighbours(links.scene, 3)
    model.fit(links)
    asked = links.query[torch.arange(0, len(links), 7)]
    expected = []
    for query in (asked[row : row + 1] for row in range(len(asked))):
        index = model.known[query.receivers[0]]
        apart = model._distances(query, index, model.scale)
        expected.append(model._mean(Near(apart, torch.arange(len(index))[None]), index))
    searches = []

    def search(asked, known, count):
        searches.append((len(asked), count))
        return nearest_places(asked, known, count)

    monkeypatch.setattr("gaigs.model.knn.nearest_places", search)
    torch.testing.assert_close(model(Batch(asked)).value, torch.cat(expected))
    first, last = searches[0], max(searches, key=lambda pair: pair[1])
    assert last[1] > 100
    assert last[0] < first[0]
    searches.clear()
    model._levels(asked[asked.receivers == 0], model.known[0], 4, size=100)
    assert len(searches) > 2
    assert all(many == 1 or many * count <= 100 for many, count in searches[1:]), "in pieces"


@pytest.mark.parametrize("receivers", [1, 2])
def test_all_receivers_answer_unless_one_is_named(receivers):
    """The shape does not depend on their number: a single one has its axis too."""
    links = gaigs.links(
        task="rssi",
        transmitters=[[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [2.0, 2.0, 1.0]],
        receivers=[[0.0, 0.0, 2.0], [3.0, 3.0, 2.0]][:receivers],
        labels=torch.tensor([[-40.0, -50.0], [-45.0, -55.0], [-50.0, -60.0], [-47.0, -58.0]])[
            :, :receivers
        ],
        test_rows=[3],
    )
    model = KNearestNeighbours(links.scene, 2)
    model.fit(links)
    places = torch.tensor([[1.0, 1.5, 1.0], [2.0, 1.2, 1.0], [90.0, 1.2, 1.0]])
    with pytest.warns(ExtrapolationWarning, match="1 of 3 positions"):
        found = model.predict(places, batch_size=1)
    assert found.shape == (3, receivers)
    assert model.predict(places[0]).shape == (receivers,)
    assert [part.shape for part in model.predict_batches(places[:2], batch_size=receivers)] == [
        (1, receivers)
    ] * 2
    for number in range(receivers):
        assert torch.equal(found[:2, number], model.predict(places[:2], f"rx{number}"))
        assert torch.equal(found[:, number], model.predict(Query(places, torch.full((3,), number))))


# --- directions ---


@BOTH
def test_each_direction_gets_the_nearest_row_and_column(build):
    links = example_links()  # elevations 4, 9 .. 89 deg, azimuths 0, 10 .. 350 deg
    model = build(links.scene)
    model.fit(links)
    whole, grid = model.predict(torch.zeros(2, 3), 0), links.task.directions
    elevations, azimuths = torch.tensor(
        [[6, 7, 60, 90, 0.0], [4, 356, -11, 724.9, 125.1]]
    ).deg2rad()
    assert not torch.isin(elevations, grid.elevations).any()
    found = model.predict(torch.zeros(2, 3), 0, directions=Rays(elevations, azimuths))
    assert torch.equal(found, whole[:, [0, 1, 11, 17, 0], [0, 0, 35, 0, 13]])
    coarse = Grid(elevations[:3], azimuths[:4])
    found = model.predict(torch.zeros(2, 3), 0, directions=coarse)
    assert torch.equal(found, whole[:, [0, 1, 11]][:, :, [0, 0, 35, 0]])


# --- state ---


@pytest.mark.parametrize(("most", "dtype"), [(255, torch.uint8), (256, torch.float32)])
def test_images_of_eight_bits_are_stored_in_bytes(most, dtype):
    links = example_links()
    links = replace(links, labels=torch.randint(most + 1, links.labels.shape).float() / most)
    model, twin = (KNearestNeighbours(links.scene, 3) for _ in range(2))
    model.fit(links)
    state = model.state_dict()
    assert {part.dtype for part in state["_extra_state"]["labels"]} == {dtype}
    twin.load_state_dict(state)
    assert torch.equal(twin.predict(links.query), model.predict(links.query))


# --- several carriers ---


def several_carriers(label, seed=0, places=60, carriers=(1e9, 1.5e9, 2.2e9, 3.3e9)):
    """RSSI at one receiver from random places at each carrier; the last tenth of the places tests."""
    links = example_links("rssi")
    positions = torch.rand(places, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor(
        [6.0, 4.0, 2.0]
    )
    rows = torch.arange(places).repeat_interleave(len(carriers))
    frequencies = torch.tensor(carriers).repeat(places)
    cut = len(carriers) * (places * 9 // 10)
    split = Split("made up", torch.arange(cut), torch.arange(0), torch.arange(cut, len(rows)))
    return replace(
        links,
        query=Query(positions[rows], torch.zeros_like(rows), frequencies),
        receivers=links.receivers[:1],
        labels=label(positions[rows], frequencies.log()),
        rows=rows,
        split=split,
    )


def test_a_carrier_that_matters_is_kept_apart_from_others():
    def waves(places, phase):
        return 10 * torch.sin(places[:, 0] + phase)

    alike = several_carriers(lambda places, logs: waves(places, 0))
    apart = several_carriers(
        lambda places, logs: waves(places, 3 * (logs * 1e3).round())
    )  # another phase at each
    models = [KNearestNeighbours(links.scene, 3) for links in (alike, apart)]
    for model, links in zip(models, (alike, apart), strict=True):
        model.fit(links)
    assert models[1].facts()["frequency_scale_m"] > 2 * models[0].facts()["frequency_scale_m"]
    query, labels = apart.query[apart.split.test], apart.labels[apart.split.test]
    error = (models[1].predict(query) - labels).abs().mean()
    models[1].scale = 1e-6  # as if all carriers were one
    assert error < 0.75 * (models[1].predict(query) - labels).abs().mean()


def test_distances_count_place_and_log_frequency():
    links = several_carriers(lambda places, logs: places[:, 0] + 5 * logs)
    model = KNearestNeighbours(links.scene, 5, 2.0)
    model.fit(links)
    query, asked, frequency = links.query[links.split.train], torch.tensor([2.0, 3.0, 1.0]), 1.8e9
    prediction = model.predict(asked, frequency=frequency)
    steps = model.scale * np.log(query.frequencies.double().numpy() / frequency)
    squares = ((query.transmitters - asked).double().numpy() ** 2).sum(1) + steps**2
    nearest = np.argsort(squares)[:5]
    weights = 1 / squares[nearest]
    expected = weights @ links.labels[links.split.train].double().numpy()[nearest] / weights.sum()
    assert prediction.item() == pytest.approx(expected, abs=1e-3)


def test_places_measured_twice_do_not_predict_themselves():
    """Were a link's copy not left out with it, k = 1 would be exact with every scale."""
    links = several_carriers(
        lambda places, logs: 10 * torch.sin(places[:, 0] + 3 * (logs * 1e3).round())
    )
    n = len(links)
    double = replace(
        links,
        query=links.query[torch.arange(2 * n) % n],
        labels=links.labels.repeat(2),
        rows=None,
        split=Split(
            "twice",
            torch.cat((links.split.train, links.split.train + n)),
            torch.arange(0),
            links.split.test,
        ),
    )
    models = [KNearestNeighbours(part.scene, 1) for part in (links, double)]
    for model, part in zip(models, (links, double), strict=True):
        model.fit(part)
    assert models[0].scale == pytest.approx(models[1].scale)


def test_what_a_run_asks_for_is_empty_by_default(links):
    model = Mean(links.scene)
    model.fit(links)
    batch = links.batch(links.split.test[:1])
    assert model.facts() == {}
    assert model.learnt_paths(batch.query) == []
    answers = model.rendering(batch), model.learnt_room(links), model.process_at(0)
    assert answers == (None, None, None)
    assert model.deviations(batch) is None
    assert not model.has_margins
