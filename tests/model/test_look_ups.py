"""kNN and mean against their formulas in numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.testing import example_links


@pytest.fixture
def links():
    return example_links()


def known(links, receiver):
    """Positions and labels that a look-up may use."""
    index = torch.cat((links.split.train, links.split.validation))
    index = index[links.receiver_index[index] == receiver]
    return links.transmitters[index].numpy().astype(np.float64), links.labels[index].numpy().astype(np.float64)


@pytest.mark.parametrize("receiver", [0, 1])
@pytest.mark.parametrize("k", [1, 3, 100])
def test_knn_weighs_the_nearest_by_the_inverse_squared_distance(links, receiver, k):
    model = KNearestNeighbours(links.scene, k)
    model.fit(links)
    asked = np.random.default_rng(0).random((4, 3)) * [6, 4, 2]
    positions, labels = known(links, receiver)
    predictions = model.predict(asked, receiver)
    for prediction, place in zip(predictions, asked, strict=True):
        distances = np.linalg.norm(positions - place.astype(np.float32), axis=1)
        nearest = np.argsort(distances)[:k]
        weights = distances[nearest] ** -2
        expected = np.tensordot(weights / weights.sum(), labels[nearest], 1)
        np.testing.assert_allclose(prediction, expected, atol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 2e3])
def test_where_a_training_link_stands_its_label_comes_back(links, shift):
    links = replace(links, transmitters=links.transmitters + shift)
    model = KNearestNeighbours(links.scene, 3)
    model.fit(links)
    predictions = model.predict(links.transmitters[:4:2])
    torch.testing.assert_close(predictions, links.labels[:4:2], rtol=0, atol=1e-5)


def test_two_labels_at_one_place_are_averaged(links):
    links.transmitters[2] = links.transmitters[0]
    model = KNearestNeighbours(links.scene, 3)
    model.fit(links)
    (prediction,) = model.predict(links.transmitters[:1])
    torch.testing.assert_close(prediction, (links.labels[0] + links.labels[2]) / 2, rtol=0, atol=1e-5)


@pytest.mark.parametrize("k", [0, -2])
def test_fewer_than_one_neighbour_is_refused(links, k):
    with pytest.raises(ValueError, match=f"model.k must be at least 1, got {k}"):
        KNearestNeighbours(links.scene, k)


@pytest.mark.parametrize("receiver", [0, 1])
def test_the_mean_is_each_receivers(links, receiver):
    model = Mean(links.scene)
    model.fit(links)
    predictions = model.predict(torch.rand(3, 3), receiver)
    expected = known(links, receiver)[1].mean(0)
    for prediction in predictions:
        np.testing.assert_allclose(prediction, expected, atol=1e-6)


@pytest.mark.parametrize("build", [Mean, lambda scene: KNearestNeighbours(scene, 3)], ids=["mean", "knn"])
def test_no_test_label_is_looked_at(links, build):
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    models = build(links.scene), build(links.scene)
    models[0].fit(links)
    models[1].fit(replace(links, labels=labels))
    asked = links.transmitters[links.split.test]
    assert torch.equal(models[0].predict(asked), models[1].predict(asked))
