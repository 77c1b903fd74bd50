"""Links of arrays in memory."""

import numpy as np
import pytest
import torch

import gaigs
from gaigs.data.readings import gateway
from gaigs.task.csi import Csi

PLACES = np.random.default_rng(0).uniform(0, 4, (12, 3))
GATEWAYS = [[0.0, 0.0, 2.0], [4.0, 4.0, 2.0]]


def test_readings_of_all_gateways_become_links():
    readings = np.arange(24.0).reshape(12, 2) - 90
    readings[3, 1] = np.nan
    links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=readings, frequency=2.4e9)
    assert len(links) == 23
    heard = ~np.isnan(readings.ravel())
    assert torch.equal(links.labels, torch.tensor(readings.ravel()[heard], dtype=torch.float32))
    assert torch.equal(links.query.receivers, torch.arange(2).repeat(12)[torch.tensor(heard)])
    assert torch.equal(links.rows, torch.arange(12).repeat_interleave(2)[torch.tensor(heard)])
    long = gaigs.links(
        task="rssi", transmitters=PLACES.repeat(2, 0), receivers=GATEWAYS, labels=readings.ravel(), index=[0, 1] * 12
    )
    assert torch.equal(long.rows, links.rows), "links of one place are never parted"
    assert links.query.frequencies.unique().tolist() == [2.4e9]
    assert "1 links were not heard" in links.remarks


def test_each_link_has_a_receiver_of_its_own():
    index = torch.arange(12) % 2
    given = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=np.zeros(12) - 50, index=index)
    stands = np.array(GATEWAYS)[index.numpy()]
    placed = gaigs.links(task="rssi", transmitters=PLACES, receivers=stands, labels=np.zeros(12) - 50)
    assert torch.equal(given.query.receivers, placed.query.receivers)
    assert len(placed.receivers) == 2
    alone = {"task": "rssi", "transmitters": PLACES, "receivers": [0, 0, 2], "labels": np.zeros(12) - 50, "test": 0.5}
    for links in (gaigs.links(**alone), gaigs.links(**alone, index=np.int64(0))):
        assert len(links.receivers) == 1
        assert len(links.split.test) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": np.zeros((12, 3))}, r"labels of task 'rssi' must be \(12,\) .* or \(12, 2\).*, got \(12, 3\)"),
        ({"labels": np.zeros((12, 2)) + np.inf}, "labels must be finite where something was heard"),
        ({"labels": np.full((12, 2), 100.0)}, "from -200 to 30 dBm, nan where .*; those of link 0 are from 100 to 100"),
        ({"labels": np.zeros(12), "index": [5] * 12}, "index must be 12 whole numbers from 0 to 1"),
        ({"transmitters": PLACES[:, :2]}, r"transmitters must be \(..., 3\) positions \[m\], got shape \(12, 2\)"),
        ({"transmitters": PLACES * np.nan}, "transmitters must be finite"),
        ({"frequency": 2.4}, "frequency must be a carrier in Hz, from 10000 to 3e.11, got 2.4; in GHz?"),
        ({"receivers": [gateway("gw", place) for place in GATEWAYS]}, "must have different names, got 'gw' more than"),
        ({"tset": 0.5}, r"there is no option 'tset' \(did you mean 'test'\?\) of split 'random'"),
        ({"task": "rsi"}, r"unknown task 'rsi' \(did you mean 'rssi'\?\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes, message):
    arrays = {"task": "rssi", "transmitters": PLACES, "receivers": GATEWAYS, "labels": np.zeros((12, 2)) - 50}
    with pytest.raises(ValueError, match=message):
        gaigs.links(**(arrays | changes))


def test_channels_of_any_layout_are_labels():
    task = Csi(1, torch.tensor([2.40e9, 2.41e9]))
    rng = np.random.default_rng(0)
    channels = rng.normal(size=(12, 1, 2)) + 1j
    read_only = np.broadcast_to(channels, channels.shape)
    arrays = {"task": task, "transmitters": PLACES, "receivers": GATEWAYS[0]}
    for given in (channels[::-1][::-1], channels.astype(">c16"), channels.astype(object), read_only, [*read_only]):
        labels = gaigs.links(**arrays, labels=given).labels
        assert torch.equal(labels, torch.from_numpy(channels).to(torch.complex64))
    with pytest.raises(ValueError, match="labels must be those of task 'csi', got a sparse_coo tensor; give a dense"):
        gaigs.links(**arrays, labels=torch.from_numpy(channels).to_sparse())


def test_readings_that_may_mean_not_heard_are_counted():
    readings = np.arange(24.0).reshape(12, 2) - 80
    readings[:6, 0] = -127
    links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=readings)
    assert "6 readings of -127 dBm are taken for levels" in links.remarks


def test_channels_are_complex_and_those_of_nan_are_left_out():
    task = Csi(1, np.array([2.40e9, 2.41e9]))
    channels = np.ones((12, 1, 2)) + 1j
    channels[3] = np.nan
    arrays = {"task": task, "transmitters": PLACES, "receivers": GATEWAYS[0]}
    assert len(gaigs.links(**arrays, labels=channels)) == 11
    channels[4, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"must be finite .*; link 4 is not"):
        gaigs.links(**arrays, labels=channels)
    with pytest.raises(ValueError, match=r"labels of task 'csi' must be complex, got torch.float64"):
        gaigs.links(**arrays, labels=np.abs(channels))
