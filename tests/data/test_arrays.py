"""Links of arrays in memory."""

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.task.csi import Csi
from gaigs.data.readings import gateway

PLACES = np.random.default_rng(0).uniform(0, 4, (12, 3))
GATEWAYS = [[0.0, 0.0, 2.0], [4.0, 4.0, 2.0]]


def test_readings_of_all_gateways_become_links():
    readings = np.arange(24.0).reshape(12, 2) - 90
    readings[3, 1] = np.nan
    links = gaigs.links(
        task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=readings, frequency=2.4e9
    )
    assert len(links) == 23
    heard = ~np.isnan(readings.ravel())
    assert torch.equal(links.labels, torch.tensor(readings.ravel()[heard], dtype=torch.float32))
    assert torch.equal(links.query.receivers, torch.arange(2).repeat(12)[torch.tensor(heard)])
    assert torch.equal(links.rows, torch.arange(12).repeat_interleave(2)[torch.tensor(heard)])
    long = gaigs.links(
        task="rssi",
        transmitters=PLACES.repeat(2, 0),
        receivers=GATEWAYS,
        labels=readings.ravel(),
        index=[0, 1] * 12,
    )
    assert torch.equal(long.rows, links.rows), "links of one place are never parted"
    assert links.query.frequencies.unique().tolist() == [2.4e9]
    assert "1 links were not heard" in links.remarks


def test_each_link_has_a_receiver_of_its_own():
    index = torch.arange(12) % 2
    given = gaigs.links(
        task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=np.zeros(12) - 50, index=index
    )
    stands = np.array(GATEWAYS)[index.numpy()]
    placed = gaigs.links(
        task="rssi", transmitters=PLACES, receivers=stands, labels=np.zeros(12) - 50
    )
    assert torch.equal(given.query.receivers, placed.query.receivers)
    turned = gaigs.links(
        task="rssi", transmitters=PLACES, receivers=stands[::-1], labels=np.zeros(12) - 50
    )
    for links, first in ((placed, stands[0]), (turned, stands[-1])):  # in the order of their links
        assert [receiver.name for receiver in links.receivers] == ["rx0", "rx1"]
        assert links.receivers[0].pose.position.tolist() == first.tolist()
    alone = {
        "task": "rssi",
        "transmitters": PLACES,
        "receivers": [0, 0, 2],
        "labels": np.zeros(12) - 50,
        "test": 0.5,
    }
    for links in (gaigs.links(**alone), gaigs.links(**alone, index=np.int64(0))):
        assert len(links.receivers) == 1
        assert len(links.split.test) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"labels": np.zeros((12, 3))},
            r"labels of task 'rssi' must be \(12,\) .* or \(12, 2\).*, got \(12, 3\)",
        ),
        ({"labels": np.zeros((12, 2)) + np.inf}, "labels must be finite where something was heard"),
        (
            {"labels": np.full((12, 2), 100.0)},
            "from -200 to 30 dBm, nan where .*; those of number 0 are from 100 to 100",
        ),
        ({"labels": np.zeros(12), "index": [5] * 12}, "index must be 12 whole numbers from 0 to 1"),
        (
            {"transmitters": PLACES[:, :1]},
            r"transmitters must be \(..., 3\) positions \[m\], got shape \(12, 1\)",
        ),
        ({"transmitters": PLACES * np.nan}, "transmitters must be finite"),
        (
            {"frequency": 2.4},
            "frequency must be a carrier in Hz, from 10000 to 3e.11, got 2.4; in GHz?",
        ),
        (
            {"receivers": [gateway("gw", place) for place in GATEWAYS]},
            "must have different names, got 'gw' more than",
        ),
        (
            {"test_rows": [0, 12]},
            r"test_rows must be numbers of rows from 0 to 11, or a mask of 12, got \[0, 12\]",
        ),
        ({"test_rows": [0.5]}, "test_rows must be numbers of rows"),
        (
            {"test_rows": [0, 1] * 6},
            r"test_rows must hold each row once, got \[0, 1, .*; a mask must be boolean",
        ),
        ({"test_rows": [3], "train_rows": [1] * 12}, "train_rows must hold each row once"),
        ({"test_rows": [2, 3], "train_rows": [0, 3]}, "must have no row in common, got 3 in both"),
        ({"test_rows": [0], "split": "random"}, "are for split='official'"),
        ({"train_rows": [0]}, "give test_rows"),
        ({"bandwidth": -1.0}, "bandwidth must be 0 Hz or more, and finite, got -1.0"),
        ({"tset": 0.5}, r"arrays have no option 'tset' \(did you mean 'test'\?\)"),
        ({"task": "rsi"}, r"unknown task 'rsi' \(did you mean 'rssi'\?\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes, message):
    arrays = {
        "task": "rssi",
        "transmitters": PLACES,
        "receivers": GATEWAYS,
        "labels": np.zeros((12, 2)) - 50,
    }
    with pytest.raises(ValueError, match=message):
        gaigs.links(**(arrays | changes))


def test_channels_of_any_layout_are_labels():
    task = Csi(1, torch.tensor([2.40e9, 2.41e9]))
    rng = np.random.default_rng(0)
    channels = rng.normal(size=(12, 1, 2)) + 1j
    read_only = np.broadcast_to(channels, channels.shape)
    arrays = {"task": task, "transmitters": PLACES, "receivers": GATEWAYS[0]}
    for given in (
        channels[::-1][::-1],
        channels.astype(">c16"),
        channels.astype(object),
        read_only,
        [*read_only],
    ):
        labels = gaigs.links(**arrays, labels=given).labels
        assert torch.equal(labels, torch.from_numpy(channels).to(torch.complex64))
    with pytest.raises(
        ValueError,
        match="labels must be those of task 'csi', got a sparse_coo tensor; give a dense",
    ):
        gaigs.links(**arrays, labels=torch.from_numpy(channels).to_sparse())


def test_readings_that_may_mean_not_heard_are_counted(caplog):
    readings = np.arange(24.0).reshape(12, 2) - 80
    readings[:6, 0] = -127
    links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=readings)
    assert "6 readings of -127 dBm are taken for levels" in links.remarks
    assert (
        "6 readings of -127 dBm are taken for levels\ngive nan where nothing was heard"
        in caplog.text
    )


def test_missing_readings_are_none_or_nan():
    readings = np.arange(24.0).reshape(12, 2) - 90
    readings[3, 1] = np.nan
    given = [[None if np.isnan(level) else level for level in row] for row in readings]
    NAType = type("NAType", (), {})  # that of pandas, which is no dependency
    nullable = np.array(
        [[NAType() if level is None else level for level in row] for row in given], dtype=object
    )
    for labels in (given, nullable):
        links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=labels)
        assert len(links) == 23


def test_receivers_that_nothing_is_known_of_are_left_out():
    readings = np.arange(36.0).reshape(12, 3) - 90
    readings[:, 1] = np.nan
    links = gaigs.links(
        task="rssi", transmitters=PLACES, receivers=[*GATEWAYS, [0, 4, 2]], labels=readings
    )
    assert [receiver.name for receiver in links.receivers] == ["rx0", "rx2"]
    assert links.labels.tolist() == readings[:, [0, 2]].ravel().tolist()
    assert "receivers without a training link are left out, with 0 links: rx1" in links.remarks


def test_rows_to_test_on_are_those_of_the_arrays():
    """Row 3 has one link, and rows 4 and 5 one place."""
    readings = np.arange(24.0).reshape(12, 2) - 90
    readings[3, 1] = np.nan
    places = PLACES.copy()
    places[5] = places[4]
    arrays = {
        "task": "rssi",
        "transmitters": places,
        "receivers": GATEWAYS,
        "labels": readings,
        "validation": 0.0,
    }
    mask = np.isin(np.arange(12), [3, 5])
    for test_rows in ([5, 3], mask, torch.tensor(mask)):
        split = gaigs.links(**arrays, test_rows=test_rows).split
        assert split.test.tolist() == [6, 9, 10]
        assert split.train.tolist() == [0, 1, 2, 3, 4, 5, 7, 8, *range(11, 23)]
    links = gaigs.links(**arrays, test_rows=[3], train_rows=[0, 5], bandwidth=2e7)
    assert [links.split.test.tolist(), links.split.train.tolist()] == [[6], [0, 1, 9, 10]]
    assert links.scene.bandwidth == 2e7
    assert "at places" not in links.remarks
    assert (
        "2 test links stand at places of training links"
        in gaigs.links(**arrays, test_rows=[5]).remarks
    )
    with pytest.raises(ValueError, match="test_rows leave no row to train on, got all 12"):
        gaigs.links(**arrays, test_rows=range(12))


def test_channels_have_the_elements_of_their_arrays():
    task = Csi(4, [2.40e9, 2.41e9])
    pose = gaigs.Pose.from_xyzw([0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])
    receivers = [
        gaigs.Receiver(f"a{k}", pose, gaigs.Array.planar(2, k, pitch=0.06)) for k in (1, 2)
    ]
    channels = np.ones((12, 2, 4, 2)) + 1j
    channels[:, 0, 2:] = 0
    arrays = {"task": task, "transmitters": PLACES, "receivers": receivers}
    channels[5, 0] = np.nan
    assert len(gaigs.links(**arrays, labels=channels)) == 23
    channels[3, 0, 2] = 1
    message = "that of link 6 is not at element 2 and subcarrier 0, and a1 has 2 elements"
    with pytest.raises(ValueError, match=message):
        gaigs.links(**arrays, labels=channels)
    with pytest.raises(
        ValueError, match="the task has 4 elements, and the largest array of the receivers 2"
    ):
        gaigs.links(**arrays | {"receivers": receivers[0]}, labels=channels[:, 1])
    placed = gaigs.links(**arrays | {"receivers": GATEWAYS[0]}, labels=channels[:, 1])
    assert placed.receivers[0].array.elements.tolist() == [[0.0, 0.0, 0.0]] * 4
    assert "positions of the 4 elements are unknown" in placed.remarks


def test_channels_are_complex_and_those_of_nan_are_left_out():
    task = Csi(1, np.array([2.40e9, 2.41e9]))
    channels = np.ones((12, 1, 2)) + 1j
    channels[3] = np.nan
    arrays = {"task": task, "transmitters": PLACES, "receivers": GATEWAYS[0]}
    assert len(gaigs.links(**arrays, labels=channels)) == 11
    channels[4, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"must be finite .*; link 4 is not"):
        gaigs.links(**arrays, labels=channels)
    with pytest.raises(
        ValueError, match=r"labels of task 'csi' must be complex, got torch.float64"
    ):
        gaigs.links(**arrays, labels=np.abs(channels))


def test_moving_ends_are_transmitters():
    moving = np.random.default_rng(0).uniform(0, 9, (20, 3))
    levels = np.linspace(-40, -70, 20)
    assert (
        len(
            gaigs.links(
                task="rssi", transmitters=moving, receivers=[[1.0, 2.0, 3.0]], labels=levels
            )
        )
        == 20
    )
    both = {"task": "rssi", "transmitters": moving + 1, "receivers": moving, "labels": levels}
    assert gaigs.links(**both).one_radio
    with pytest.raises(
        ValueError, match="20 receivers have 20 links, and those with test links none to train on"
    ):
        gaigs.links(**both, one_radio=False)
