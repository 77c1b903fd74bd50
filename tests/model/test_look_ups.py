"""kNN and mean against their formulas in numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.data import Split
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.testing import example_links


@pytest.fixture(params=["spectra", "RSSI"])
def links(request):
    links = example_links()
    if request.param == "RSSI":
        links = replace(links, labels=-100 * links.labels[:, 0, 0], grid=None, normalisation="dBm")
    return links


BOTH = pytest.mark.parametrize("build", [Mean, lambda scene: KNearestNeighbours(scene, 3)], ids=["mean", "knn"])


def known(links, receiver):
    """Positions and labels that a look-up may use."""
    index = torch.cat((links.split.train, links.split.validation))
    index = index[links.receiver_index[index] == receiver]
    return links.transmitters[index].numpy().astype(np.float64), links.labels[index].numpy().astype(np.float64)


@pytest.mark.parametrize("receiver", [0, 1])
@pytest.mark.parametrize(("k", "options"), [(1, {}), (3, {}), (100, {}), (3, {"power": 1.0}), (5, {"power": 0})])
def test_knn_weighs_the_nearest_by_an_inverse_power_of_the_distance(links, receiver, k, options):
    model = KNearestNeighbours(links.scene, k, **options)
    model.fit(links)
    asked = np.random.default_rng(0).random((4, 3)) * [6, 4, 2]
    positions, labels = known(links, receiver)
    predictions = model.predict(asked, receiver)
    for prediction, place in zip(predictions, asked, strict=True):
        distances = np.linalg.norm(positions - place.astype(np.float32), axis=1)
        nearest = np.argsort(distances)[:k]
        weights = distances[nearest] ** -options.get("power", 2.0)
        expected = np.tensordot(weights / weights.sum(), labels[nearest], 1)
        np.testing.assert_allclose(prediction, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 2e3])
@pytest.mark.parametrize("power", [1.0, 2.0, 100.0])
def test_where_a_training_link_stands_its_label_comes_back(links, shift, power):
    links = replace(links, transmitters=links.transmitters + shift)
    model = KNearestNeighbours(links.scene, 3, power)
    model.fit(links)
    predictions = model.predict(links.transmitters[:4:2])
    torch.testing.assert_close(predictions, links.labels[:4:2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("aside", [0.0, 1e-4])
def test_labels_at_one_place_are_averaged(links, k, aside):
    same = torch.tensor([0, 2, 6, 12])
    links.transmitters[same] = links.transmitters[0].clone()
    model = KNearestNeighbours(links.scene, k)
    model.fit(links)
    (prediction,) = model.predict(links.transmitters[:1] + aside)
    torch.testing.assert_close(prediction, links.labels[same].mean(0), rtol=1e-5, atol=1e-5)


def test_labels_at_one_place_far_from_the_origin_are_averaged(links):
    """The matrix product, by which torch takes distances from 26 places on, gives copies of a place different ones."""
    places = links.transmitters[:11] + torch.tensor([1e4, 0.0, 0.0])
    links = replace(
        links,
        transmitters=places.repeat(3, 1),
        labels=torch.cat([links.labels[:11] + i for i in range(3)]),
        receiver_index=torch.zeros(33, dtype=torch.long),
        receivers=links.receivers[:1],
        split=Split("all", torch.arange(33), torch.arange(0), torch.arange(0)),
    )
    model = KNearestNeighbours(links.scene, 1)
    model.fit(links)
    torch.testing.assert_close(model.predict(places + 0.01), links.labels[:11] + 1, rtol=1e-5, atol=1e-5)


def test_neighbours_at_equal_distances_count_alike(links):
    links.transmitters[:8] = torch.tensor([[9.0, 9.0, 9.0]])  # two receivers hear each corner in turn
    links.transmitters[:8:2, :2] += torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
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
    links.receiver_index[:20] = 0  # the other is heard in the test alone
    with pytest.raises(ValueError, match="on split 'example' there are none of gateway1; choose another split"):
        build(links.scene).fit(links)


@BOTH
def test_no_test_label_is_looked_at(links, build):
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    models = build(links.scene), build(links.scene)
    models[0].fit(links)
    models[1].fit(replace(links, labels=labels))
    asked = links.transmitters[links.split.test]
    assert torch.equal(models[0].predict(asked), models[1].predict(asked))
