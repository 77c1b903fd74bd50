"""Channels of the built-in room: free space, the power and the spectra of the same room, and the
phases' sign.
"""

import math

import numpy as np
import torch
from scipy.constants import speed_of_light

from gaigs.core.geometry import Grid
from gaigs.core.propagation import bartlett, min_max
from gaigs.data import load
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
CARRIER, BANDWIDTH = 6.4896e9, 499.2e6


def channels(**options):
    return load({"name": "synthetic_csi", **options}, OFFICIAL)


def distances(links):
    """From each transmitter to each element [m]; world frame, float64."""
    (receiver,) = links.receivers
    turned = receiver.array.elements.double() @ receiver.pose.rotation.double().T
    elements = (receiver.pose.position.double() + turned).numpy()
    return np.linalg.norm(links.query.transmitters.double().numpy()[:, None] - elements, axis=-1)


def test_the_default_channels_keep_the_contract():
    links = load({"name": "synthetic_csi"}, {"name": "official"})
    check_data(links)
    assert links.labels.dtype == torch.complex64
    assert links.labels.shape == (500, 16, 26)
    assert (links.task.name, links.task.shape) == ("csi", (16, 26))
    assert links.split.name == "official, validation 0.1, seed 0"
    assert links.split.test.tolist() == list(range(400, 500))
    assert links.query.frequencies.tolist() == [CARRIER] * 500
    assert (links.labels != 0).flatten(1).any(1).all()


def test_spectra_of_the_channels_are_those_of_the_room():
    """With as many subcarriers as sample the band of a spectrum, steering the channels gives that
    spectrum.
    """
    longest = 3 * math.hypot(7, 5, 3)
    links = channels(
        transmitters=8, seed=3, subcarriers=math.ceil(BANDWIDTH * longest / speed_of_light) + 1
    )
    spectra = load({"name": "synthetic", "transmitters": 8, "seed": 3}, OFFICIAL)
    steered = bartlett(
        links.labels.to(torch.complex128), Grid.degrees(), links.receivers[0].array, CARRIER
    )
    assert (min_max(steered) - spectra.labels).abs().max() < 1e-5


def test_without_reflections_channels_are_friis_waves_that_furniture_dims():
    free = channels(transmitters=40, order=0)
    frequencies = np.linspace(CARRIER - BANDWIDTH / 2, CARRIER + BANDWIDTH / 2, 26)
    apart = distances(free)[..., None]
    waves = (
        speed_of_light
        / (4 * np.pi * frequencies * apart)
        * np.exp(-2j * np.pi * frequencies * apart / speed_of_light)
    )
    ratios = free.labels.numpy() / waves
    assert np.abs(np.angle(ratios)).max() < 1e-3
    (receiver,) = free.receivers
    rays = free.query.transmitters - receiver.pose.position
    cosines = (rays @ receiver.pose.rotation[:, 2] / rays.norm(dim=1)).numpy()
    losses_db = -20 * np.log10(np.abs(ratios) / cosines[:, None, None])
    assert (
        np.ptp(losses_db, axis=(1, 2)).max() < 1e-2
    )  # for all of a link's elements and subcarriers the same
    assert (
        np.abs(losses_db.mean((1, 2)) - losses_db.mean((1, 2)).round()).max() < 1e-2
    )  # furniture's are whole numbers
    assert 0.3 < (losses_db.mean((1, 2)) < 1e-2).mean() < 0.95
