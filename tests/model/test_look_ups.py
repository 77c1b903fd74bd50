"""kNN and mean against their formulas in numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.data import Split
from gaigs.directions import Grid, Rays
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.query import Query
from gaigs.testing import check_model, example_links


@pytest.fixture(params=["spectrum", "rssi", "csi"])
def links(request):
    links = example_links(request.param)
    places = example_links().query.transmitters  # each link's own, of whatever task
    return replace(links, query=replace(links.query, transmitters=places), rows=None)


BOTH = pytest.mark.parametrize("build", [Mean, lambda scene: KNearestNeighbours(scene, 3)], ids=["mean", "knn"])


def moved(links, transmitters):
    return replace(links, query=replace(links.query, transmitters=transmitters))


def known(links, receiver):
    """Positions and labels that a look-up may use."""
    index = torch.cat((links.split.train, links.split.validation))
    index = index[links.query.receivers[index] == receiver]
    labels = links.labels[index]
    wide = torch.complex128 if labels.is_complex() else torch.float64
    return links.query.transmitters[index].double().numpy(), labels.to(wide).numpy()


@BOTH
def test_they_keep_the_contract_of_models(links, build):
    check_model(build, links)


@pytest.mark.parametrize("receiver", [0, 1])
@pytest.mark.parametrize(("k", "options"), [(1, {}), (3, {}), (100, {}), (3, {"power": 1.0}), (5, {"power": 0})])
def test_knn_weighs_the_nearest_by_an_inverse_power_of_the_distance(links, receiver, k, options):
    model = KNearestNeighbours(links.scene, k, **options)
    model.fit(links)
    asked = np.random.default_rng(0).random((4, 3)) * [6, 4, 2]
    positions, labels = known(links, receiver)
    predictions = model.predict(asked, receiver)
    assert predictions.dtype == links.task.dtype
    for prediction, place in zip(predictions, asked, strict=True):
        distances = np.linalg.norm(positions - place.astype(np.float32), axis=1)
        nearest = np.argsort(distances)[:k]
        weights = distances[nearest] ** -options.get("power", 2.0)
        expected = np.tensordot(weights / weights.sum(), labels[nearest], 1)
        np.testing.assert_allclose(prediction, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 2e3])
@pytest.mark.parametrize("power", [1.0, 2.0, 100.0])
def test_where_a_training_link_stands_its_label_comes_back(links, shift, power):
    links = moved(links, links.query.transmitters + shift)
    model = KNearestNeighbours(links.scene, 3, power)
    model.fit(links)
    predictions = model.predict(links.query.transmitters[:4:2])
    torch.testing.assert_close(predictions, links.labels[:4:2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("aside", [0.0, 1e-4])
def test_labels_at_one_place_are_averaged(links, k, aside):
    same = torch.tensor([0, 2, 6, 12])
    places = links.query.transmitters
    places[same] = places[0].clone()
    model = KNearestNeighbours(links.scene, k)
    model.fit(links)
    (prediction,) = model.predict(places[:1] + aside)
    torch.testing.assert_close(prediction, links.labels[same].mean(0), rtol=1e-5, atol=1e-5)


def test_labels_at_one_place_far_from_the_origin_are_averaged(links):
    """The matrix product, by which torch takes distances from 26 places on, gives copies of a place different ones."""
    places = links.query.transmitters[:11] + torch.tensor([1e4, 0.0, 0.0])
    links = replace(
        links,
        query=Query(places.repeat(3, 1), torch.zeros(33, dtype=torch.long)),
        labels=torch.cat([links.labels[:11] + i for i in range(3)]),
        receivers=links.receivers[:1],
        split=Split("all", torch.arange(33), torch.arange(0), torch.arange(0)),
    )
    model = KNearestNeighbours(links.scene, 1)
    model.fit(links)
    torch.testing.assert_close(model.predict(places + 0.01), links.labels[:11] + 1, rtol=1e-5, atol=1e-5)


def test_neighbours_at_equal_distances_count_alike(links):
    places = links.query.transmitters
    places[:8] = torch.tensor([[9.0, 9.0, 9.0]])  # two receivers hear each corner in turn
    places[:8:2, :2] += torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    model = KNearestNeighbours(links.scene, 3)
    model.fit(links)
    (prediction,) = model.predict(torch.tensor([[9.0, 9.0, 9.0]]))
    torch.testing.assert_close(prediction, links.labels[:8:2].mean(0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("k", [0, -2])
def test_fewer_than_one_neighbour_is_refused(links, k):
    with pytest.raises(ValueError, match=f"model.k must be at least 1, got {k}"):
        KNearestNeighbours(links.scene, k)


@pytest.mark.parametrize("power", [-1.0, float("inf"), float("nan")])
def test_a_power_that_prefers_the_far_is_refused(links, power):
    with pytest.raises(ValueError, match=r"model\.power must be 0 or more, and finite"):
        KNearestNeighbours(links.scene, 3, power)


@pytest.mark.parametrize("receiver", [0, 1])
def test_the_mean_is_each_receivers(links, receiver):
    model = Mean(links.scene)
    model.fit(links)
    predictions = model.predict(torch.rand(3, 3), receiver)
    assert predictions.dtype == links.task.dtype
    expected = known(links, receiver)[1].mean(0)
    for prediction in predictions:
        np.testing.assert_allclose(prediction, expected, rtol=1e-6, atol=1e-6)


def test_the_mean_comes_back_from_its_state(links):
    model, twin = Mean(links.scene), Mean(links.scene)
    assert twin.predict(torch.rand(3, 3)).isnan().all()  # no numbers before there are any
    model.fit(links)
    twin.load_state_dict(model.state_dict())
    assert torch.equal(twin.predict(torch.rand(3, 3), 1), model.predict(torch.rand(3, 3), 1))


@BOTH
def test_a_receiver_without_known_links_is_refused(links, build):
    links.query.receivers[:20] = 0  # the other is heard in the test alone
    with pytest.raises(ValueError, match="on split 'example' there are none of gateway1; choose another split"):
        build(links.scene).fit(links)


@BOTH
def test_no_test_label_is_looked_at(links, build):
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    models = build(links.scene), build(links.scene)
    models[0].fit(links)
    models[1].fit(replace(links, labels=labels))
    asked = links.query.transmitters[links.split.test]
    assert torch.equal(models[0].predict(asked), models[1].predict(asked))


# --- directions ---


@BOTH
def test_each_direction_gets_the_nearest_row_and_column(build):
    links = example_links()  # elevations 4, 9 .. 89 deg, azimuths 0, 10 .. 350 deg
    model = build(links.scene)
    model.fit(links)
    whole, grid = model.predict(torch.zeros(2, 3)), links.task.directions
    elevations, azimuths = torch.tensor([[6, 7, 60, 90, 0.0], [4, 356, -11, 724.9, 125.1]]).deg2rad()
    assert not torch.isin(elevations, grid.elevations).any()
    found = model.predict(torch.zeros(2, 3), directions=Rays(elevations, azimuths))
    assert torch.equal(found, whole[:, [0, 1, 11, 17, 0], [0, 0, 35, 0, 13]])
    coarse = Grid(elevations[:3], azimuths[:4])
    found = model.predict(torch.zeros(2, 3), directions=coarse)
    assert torch.equal(found, whole[:, [0, 1, 11]][:, :, [0, 0, 35, 0]])


# --- several carriers ---


def several_carriers(label, seed=0, places=60, carriers=(1e9, 1.5e9, 2.2e9, 3.3e9)):
    """RSSI at one receiver from random places at each carrier; the last tenth of the places tests."""
    links = example_links("rssi")
    positions = torch.rand(places, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([6.0, 4.0, 2.0])
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
    waves = lambda places, phase: 10 * torch.sin(places[:, 0] + phase)
    alike = several_carriers(lambda places, logs: waves(places, 0))
    apart = several_carriers(lambda places, logs: waves(places, 3 * (logs * 1e3).round()))  # another phase at each
    models = [KNearestNeighbours(links.scene, 3) for links in (alike, apart)]
    for model, links in zip(models, (alike, apart), strict=True):
        model.fit(links)
    assert models[1].facts()["frequency_scale_m"] > 2 * models[0].facts()["frequency_scale_m"]
    query, labels = apart.query[apart.split.test], apart.labels[apart.split.test]
    error = (models[1].predict(query) - labels).abs().mean()
    models[1].scale = 1e-6  # as if all carriers were one
    assert error < 0.75 * (models[1].predict(query) - labels).abs().mean()


def test_the_distance_is_over_place_and_log_frequency():
    links = several_carriers(lambda places, logs: places[:, 0] + 5 * logs)
    model = KNearestNeighbours(links.scene, 5)
    model.fit(links)
    query, asked, frequency = links.query[links.split.train], torch.tensor([2.0, 3.0, 1.0]), 1.8e9
    prediction = model.predict(asked, frequency=frequency)
    steps = model.scale * np.log(query.frequencies.double().numpy() / frequency)
    squares = ((query.transmitters - asked).double().numpy() ** 2).sum(1) + steps**2
    nearest = np.argsort(squares)[:5]
    weights = 1 / squares[nearest]
    expected = weights @ links.labels[links.split.train].double().numpy()[nearest] / weights.sum()
    assert prediction.item() == pytest.approx(expected, abs=1e-3)


def test_a_single_carrier_changes_nothing():
    links = example_links("rssi")
    named = replace(links, query=replace(links.query, frequencies=torch.full((24,), 2.4e9)))
    models = [KNearestNeighbours(part.scene, 3) for part in (links, named)]
    for model, part in zip(models, (links, named), strict=True):
        model.fit(part)
        assert model.facts() == {}
    asked = torch.rand(5, 3)
    assert torch.equal(models[0].predict(asked), models[1].predict(asked))
    assert torch.equal(models[1].predict(asked, frequency=2.4e9), models[0].predict(asked))


def test_places_measured_twice_do_not_predict_themselves():
    """Were a link's copy not left out with it, k = 1 would be exact with every scale."""
    links = several_carriers(lambda places, logs: 10 * torch.sin(places[:, 0] + 3 * (logs * 1e3).round()))
    n = len(links)
    double = replace(
        links,
        query=links.query[torch.arange(2 * n) % n],
        labels=links.labels.repeat(2),
        rows=None,
        split=Split("twice", torch.cat((links.split.train, links.split.train + n)), torch.arange(0), links.split.test),
    )
    models = [KNearestNeighbours(part.scene, 1) for part in (links, double)]
    for model, part in zip(models, (links, double), strict=True):
        model.fit(part)
    assert models[0].scale == pytest.approx(models[1].scale)


@BOTH
def test_a_missing_frequency_is_refused(build):
    links = several_carriers(lambda places, logs: places[:, 0])
    model = build(links.scene)
    model.fit(links)
    with pytest.raises(ValueError, match=r"4 carriers, 1e\+09 to 3.3e\+09 Hz"):
        model.predict(torch.zeros(2, 3))
    with pytest.raises(ValueError, match="4 carriers"):
        model.predict(Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long)))
