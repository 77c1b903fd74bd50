"""Receivers that no measurement has."""

import math

import pytest
import torch

import gaigs
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.model.friis import Friis
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mirrored import MirroredSplatting
from gaigs.model.path_loss import PathLoss

PLACES = torch.tensor([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]])


@pytest.fixture(scope="module")
def links():
    return gaigs.links("synthetic_rssi", transmitters=60)


@pytest.fixture(scope="module")
def path_loss(links):
    model = PathLoss(links.scene)
    model.fit(links)
    return model


def test_a_new_receiver_has_the_mean_law(path_loss):
    distances = (PLACES - torch.tensor([3.0, 2.0, 2.0])).norm(dim=1)
    law = path_loss.levels.mean() - 10 * path_loss.exponents.mean() * distances.log10()
    for receiver in (
        [3, 2, 2],
        [3.0, 2.0, 2.0],
        Pose.at([3.0, 2.0, 2.0]),
        Receiver("door", Pose.at([3.0, 2.0, 2.0])),
    ):
        torch.testing.assert_close(path_loss.predict(PLACES, receiver=receiver), law)


def test_whole_numbers_beside_as_many_transmitters_are_indices(path_loss):
    places = PLACES[[0, 1, 0]]
    indices = path_loss.predict(places, receiver=[3, 2, 2])
    every = path_loss.predict(places)
    torch.testing.assert_close(indices, torch.stack((every[0, 3], every[1, 2], every[2, 2])))


def test_a_receiver_of_the_scene_is_known(path_loss, links):
    own = path_loss.predict(PLACES, receiver=links.receivers[1])
    assert torch.equal(own, path_loss.predict(PLACES, receiver="south"))


def test_batches_and_models_at_receivers_agree(path_loss):
    door = Receiver("door", Pose.at([3.0, 2.0, 2.0]))
    moved = path_loss.at_receivers([door, path_loss.scene.receivers[0]])
    values = moved.predict(PLACES)
    assert values.shape == (2, 2)
    assert torch.equal(values[:, 0], path_loss.predict(PLACES, receiver=door))
    assert torch.equal(values[:, 0], torch.cat([*path_loss.predict_batches(PLACES, door)]))
    own = path_loss.predict(PLACES, receiver=0)
    assert not torch.allclose(values[:, 1], own)  # of a receiver in general


def test_errors_say_what_to_do(path_loss, links):
    with pytest.raises(ValueError, match="receiver must be"):
        path_loss.predict(PLACES, receiver=[3.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        path_loss.predict(PLACES, receiver=[math.nan, 2.0, 2.0])
    knn = KNearestNeighbours(links.scene)
    knn.fit(links)
    with pytest.raises(ValueError, match="own receivers alone; for others take"):
        knn.predict(PLACES, receiver=[3.0, 2.0, 2.0])
    channels = gaigs.links("synthetic_csi", transmitters=20, order=0)
    friis = Friis(channels.scene)
    friis.fit(channels)
    with pytest.raises(ValueError, match="orientation"):
        friis.predict(PLACES, receiver=[3.0, 2.0, 2.0])


def test_free_space_reaches_a_new_array(links):
    channels = gaigs.links("synthetic_csi", transmitters=30, order=0)
    friis = Friis(channels.scene)
    friis.fit(channels)
    pose = channels.receivers[0].pose
    moved = Pose(pose.position + 0.5, pose.rotation)
    there = friis.predict(PLACES + 0.5, receiver=moved)
    torch.testing.assert_close(there, friis.predict(PLACES, receiver=0), atol=1e-6, rtol=1e-3)


def test_mirrored_gaussians_share_the_room(links, tmp_path):
    model = MirroredSplatting(links.scene, trend="mean")
    model.fit(links)
    with torch.no_grad():
        model.placement.receiver_gains.copy_(torch.tensor([0.0, 0.2, 0.4, 0.6]))
    model.eval()
    own = links.receivers[2]
    other = model.at_receivers([own])
    # The same room seen from the same place: gains differ alone.
    gain = 20 / math.log(10) * (0.3 - 0.4) + model.trend.means.mean() - model.trend.means[2]
    expected = model.predict(PLACES, receiver=2) + gain
    torch.testing.assert_close(other.predict(PLACES)[:, 0], expected, atol=1e-3, rtol=0)
    far = model.at_receivers([Receiver("far", Pose.at([20.0, 2.0, 2.0]))])
    far.save(tmp_path / "far.ckpt")  # the room does not move with the receivers
    assert torch.equal(gaigs.load(tmp_path / "far.ckpt").predict(PLACES), far.predict(PLACES))
