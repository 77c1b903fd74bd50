"""Channels of the ray tracer's rooms: the array's subcarriers, the direct wave's phase, and options."""

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.data import load
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
CARRIER, BANDWIDTH = 6.4896e9, 499.2e6


def channels(**options):
    return load({"name": "sionna_csi", "room": "slanted", "transmitters": 10, **options}, OFFICIAL)


@pytest.fixture(scope="module")
def links(tracer):
    return channels()


def test_channels_keep_the_contract(links):
    check_data(links)
    assert links.labels.dtype == torch.complex64
    assert links.labels.shape == (10, 16, 26)
    assert (links.task.name, links.task.shape) == ("csi", (16, 26))
    assert links.split.test.tolist() == [8, 9]
    expected = np.linspace(CARRIER - BANDWIDTH / 2, CARRIER + BANDWIDTH / 2, 26)
    np.testing.assert_allclose(links.task.frequencies, expected, rtol=1e-12)


def test_the_direct_wave_dominates_with_its_phase(links):
    """Averaged over elements and subcarriers, channels are free-space waves, time dependence exp(+j omega t)."""
    (receiver,) = links.receivers
    turned = receiver.array.elements.double() @ receiver.pose.rotation.double().T
    elements = (receiver.pose.position.double() + turned).numpy()
    distances = np.linalg.norm(links.query.transmitters.double().numpy()[:, None] - elements, axis=-1)
    frequencies = links.task.frequencies.numpy()
    waves = np.exp(-2j * np.pi * frequencies * distances[..., None] / speed_of_light)
    wavelengths = speed_of_light / frequencies / (4 * np.pi * distances[..., None])
    rays = links.query.transmitters - receiver.pose.position
    cosines = (rays @ receiver.pose.rotation[:, 2] / rays.norm(dim=1)).numpy()
    shares = (links.labels.numpy() / (waves * wavelengths * cosines[:, None, None])).mean((1, 2))
    assert np.median(np.abs(shares - 1)) < 0.1


def test_a_single_subcarrier_is_the_carrier(links):
    alone, three = channels(subcarriers=1), channels(subcarriers=3)
    assert alone.task.frequencies.tolist() == [CARRIER]
    torch.testing.assert_close(alone.labels[..., 0], three.labels[..., 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"room": "round"}, "room must be one of"),
        ({"subcarriers": 0}, "subcarriers must be at least 1, got 0"),
        ({"bandwidth": 0.0}, r"bandwidth must be positive \[Hz\], got 0.0"),
        ({"frequency": 0.0}, "frequency must be a carrier in Hz"),
        ({"transmitters": 1}, "transmitters must be at least 2"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        channels(**options)
