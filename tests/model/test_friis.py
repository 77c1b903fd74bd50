"""Friis' formula against the simulator in an empty room, in both conventions of time, and with
random phases.
"""

import math
from dataclasses import replace

import pytest
import torch

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Links, Split
from gaigs.data.synthetic import respond_in_parts
from gaigs.data.synthetic.image_source import Room
from gaigs.model.friis import Friis
from gaigs.testing import example_links

EMPTY = Room((7.0, 5.0, 3.0), ("concrete",) * 6)
CARRIER = 6.4896e9
OFFSETS = torch.linspace(-2e8, 2e8, 4, dtype=torch.float64)
POSES = (
    Pose.from_xyzw((0.2, 0.2, 2.5), (-0.15403, 0.87354, 0.23087, 0.39989)),
    Pose.from_xyzw((6, 4, 1), (0, 0.6, 0.8, 0)),
)


def empty_room(pattern="isotropic"):
    """Channels at two turned arrays, by the image-source method; the last ten links test."""
    places = (
        torch.rand(60, 3, generator=torch.Generator().manual_seed(0))
        * torch.tensor([6.0, 4.0, 2.0])
        + 0.4
    )
    array = Array.planar(2, 3, 0.023, pattern)
    receivers = tuple(Receiver(f"gateway{i}", pose, array) for i, pose in enumerate(POSES))
    heard_by = torch.arange(60) % 2
    each = torch.stack(
        [next(respond_in_parts(EMPTY, places, one, CARRIER, OFFSETS, 0)) for one in receivers]
    )
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
    return (
        ((found - labels).abs().square().sum((1, 2)) / labels.abs().square().sum((1, 2)))
        .sqrt()
        .max()
        .item()
    )


@pytest.mark.parametrize(("pattern", "conjugated"), [("isotropic", False), ("cosine", True)])
def test_an_empty_rooms_channels_are_its_formula(pattern, conjugated):
    links = empty_room(pattern)
    links = replace(
        links, labels=links.labels.conj().resolve_conj() if conjugated else links.labels
    )
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


def test_with_random_phases_there_is_no_gain():
    links = empty_room()
    phases = 2 * math.pi * torch.rand(60, 1, 1, generator=torch.Generator().manual_seed(1))
    model = fitted(
        replace(links, labels=links.labels * torch.polar(torch.ones_like(phases), phases))
    )
    assert model.sign == -1
    assert not model.gains.any()


def test_an_array_that_faces_away_hears_nothing():
    links = empty_room("cosine")
    away = Pose(
        torch.tensor([3.0, 2.0, 0.1]), torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    )  # down, below all
    labels = torch.randn(links.labels.shape, dtype=torch.complex64)
    receivers = links.receivers[0], replace(links.receivers[1], pose=away)
    links = replace(links, receivers=receivers, labels=labels)
    model = fitted(links)
    assert model.gains[1] == 0
    assert not model.predict(links.query.transmitters, 1).any()


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_labels_that_are_no_channels_are_refused(task):
    with pytest.raises(
        ValueError, match=f"model 'friis' gives complex channels, not labels of task '{task}'"
    ):
        Friis(example_links(task).scene)
