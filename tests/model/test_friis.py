"""Friis' formula against the simulator in an empty room, in both conventions of time, with gains and random phases."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.data import Links, Split
from gaigs.data.synthetic.image_source import Room, respond
from gaigs.geometry import Pose
from gaigs.model.friis import Friis
from gaigs.query import Query
from gaigs.scene import Array, Receiver
from gaigs.task.csi import Csi
from gaigs.testing import check_model, example_links

EMPTY = Room((7.0, 5.0, 3.0), ("concrete",) * 6)
CARRIER = 6.4896e9
OFFSETS = torch.linspace(-2e8, 2e8, 4, dtype=torch.float64)
POSES = (
    Pose.from_xyzw((0.2, 0.2, 2.5), (-0.15403, 0.87354, 0.23087, 0.39989)),
    Pose.from_xyzw((6, 4, 1), (0, 0.6, 0.8, 0)),
)


def empty_room(pattern="isotropic", order=0):
    """Channels at two turned arrays, by the image-source method; the last ten links test."""
    places = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 4.0, 2.0]) + 0.4
    array = Array.planar(2, 3, 0.023, pattern)
    receivers = tuple(Receiver(f"gateway{i}", pose, array) for i, pose in enumerate(POSES))
    heard_by = torch.arange(60) % 2
    each = torch.stack([respond(EMPTY, places, receiver, CARRIER, OFFSETS, order) for receiver in receivers])
    return Links(
        query=Query(places, heard_by),
        receivers=receivers,
        labels=each[heard_by, torch.arange(60)].to(torch.complex64),
        task=Csi(len(array), CARRIER + OFFSETS),
        split=Split("empty room", *torch.arange(60).split((44, 6, 10))),
    )


def fitted(links):
    model = Friis(links.scene)
    model.fit(links)
    return model


def relative_error(found, labels):
    """The largest of all links."""
    return ((found - labels).abs().square().sum((1, 2)) / labels.abs().square().sum((1, 2))).sqrt().max().item()


@pytest.mark.parametrize("pattern", ["isotropic", "cosine"])
@pytest.mark.parametrize("conjugated", [False, True])
def test_an_empty_rooms_channels_are_its_formula(pattern, conjugated):
    links = empty_room(pattern)
    links = replace(links, labels=links.labels.conj().resolve_conj() if conjugated else links.labels)
    # A transmitter behind the array is not heard.
    heard = links.labels.abs().amax((1, 2)) > 0
    assert heard.all() == (pattern == "isotropic")
    index = torch.arange(60)[heard]
    parts = [part[heard[part]] for part in links.split.parts().values()]
    links = replace(links, split=Split("heard", *parts))
    model = fitted(links)
    assert model.sign == (1 if conjugated else -1)
    torch.testing.assert_close(model.gains, torch.ones(2, dtype=torch.complex64), rtol=0, atol=1e-4)
    assert relative_error(model.predict(links.query[index]), links.labels[index]) < 1e-4
    assert not model.predict(links.query[~heard]).any()


def test_each_receivers_gain_is_found():
    links, gains = empty_room(), torch.tensor([3e-3 * cmath.exp(1.1j), 50 * cmath.exp(-2j)], dtype=torch.complex64)
    links = replace(links, labels=links.labels * gains[links.query.receivers][:, None, None])
    model = fitted(links)
    torch.testing.assert_close(model.gains, gains, rtol=1e-4, atol=0)
    assert relative_error(model.predict(links.query), links.labels) < 1e-4


def test_with_random_phases_there_is_no_gain():
    links = empty_room()
    phases = 2 * math.pi * torch.rand(60, 1, 1, generator=torch.Generator().manual_seed(1))
    model = fitted(replace(links, labels=links.labels * torch.polar(torch.ones_like(phases), phases)))
    assert model.sign == -1
    assert not model.gains.any()


def test_the_gain_is_that_of_the_median_link():
    links = empty_room(order=2)
    model = fitted(links)
    known = torch.cat((links.split.train, links.split.validation))
    for receiver in (0, 1):
        index = known[links.query.receivers[known] == receiver]
        labels = links.labels[index].to(torch.complex128).flatten(1).numpy()
        waves = empty_room().labels[index].to(torch.complex128).flatten(1).numpy()
        sizes, strengths = (np.linalg.norm(part, axis=1) for part in (labels, waves))
        turned = ((waves.conj() * labels).sum(1) / sizes / strengths).sum()
        expected = np.median(sizes / strengths) * turned / abs(turned)
        assert abs(model.gains[receiver].item() - expected) < 1e-4


@pytest.mark.parametrize(("count", "factor"), [(1, 1e-6), (4, 1e-3), (1, 1e3)])
def test_a_few_links_in_deep_shadow_or_far_too_loud_hardly_change_the_gain(count, factor):
    links = empty_room(order=2)
    labels = links.labels.clone()
    labels[links.split.train[:count]] *= factor
    change = fitted(replace(links, labels=labels)).gains / fitted(links).gains
    assert (20 * change.abs().log10()).abs().max() < 0.5
    assert change.angle().abs().max() < 0.1


def test_an_array_that_faces_away_hears_nothing():
    links = empty_room("cosine")
    away = Pose(torch.tensor([3.0, 2.0, 0.1]), torch.diag(torch.tensor([1.0, -1.0, -1.0])))  # down, below all
    labels = torch.randn(links.labels.shape, dtype=torch.complex64)
    receivers = links.receivers[0], replace(links.receivers[1], pose=away)
    links = replace(links, receivers=receivers, labels=labels)
    model = fitted(links)
    assert model.gains[1] == 0
    assert not model.predict(links.query.transmitters, 1).any()


def test_a_single_antenna_and_subcarrier_will_do():
    links = empty_room()
    one = Array.single()
    receivers = tuple(replace(receiver, array=one) for receiver in links.receivers)
    each = torch.stack([respond(EMPTY, links.query.transmitters, r, CARRIER, torch.zeros(1), 0) for r in receivers])
    labels = each[links.query.receivers, torch.arange(60)].to(torch.complex64)
    task = Csi(1, torch.tensor([CARRIER], dtype=torch.float64))
    links = replace(links, receivers=receivers, labels=labels, task=task)
    assert relative_error(fitted(links).predict(links.query), labels) < 1e-4


def test_it_keeps_the_contract_of_models():
    check_model(Friis, example_links("csi"))


def test_the_state_dict_has_it_all():
    links = empty_room()
    links = replace(links, labels=links.labels.conj().resolve_conj())
    model, twin = fitted(links), Friis(links.scene)
    assert twin.predict(links.query).isnan().all()  # no numbers before there are any
    assert not list(model.parameters())
    twin.load_state_dict(model.state_dict())
    assert torch.equal(model.predict(links.query), twin.predict(links.query))


def test_no_test_label_is_looked_at():
    links = empty_room(order=1)
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    asked = links.query[links.split.test]
    assert torch.equal(fitted(links).predict(asked), fitted(replace(links, labels=labels)).predict(asked))


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_labels_that_are_no_channels_are_refused(task):
    with pytest.raises(ValueError, match=f"model 'friis' gives complex channels, and labels of task '{task}' are none"):
        Friis(example_links(task).scene)


def test_an_array_of_another_size_is_refused():
    links = example_links("csi")
    receivers = tuple(replace(receiver, array=Array.single()) for receiver in links.receivers)
    with pytest.raises(ValueError, match="labels have 4 elements, and the array of gateway0 1; give the data's"):
        Friis(replace(links, receivers=receivers).scene)


def test_a_receiver_without_known_links_is_refused():
    links = example_links("csi")
    links.query.receivers[:20] = 0  # the other is heard in the test alone
    with pytest.raises(ValueError, match="on split 'example' there are none of gateway1; choose another split"):
        fitted(links)
