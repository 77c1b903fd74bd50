"""Links of objects of Sionna RT, by objects with the same attributes and lines of sight alone."""

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

import gaigs

CARRIER = 3.5e9
OFFSETS = np.arange(4) * 1e6  # [Hz]
PLACES = np.random.default_rng(0).uniform([1, 1, 1], [6, 5, 2], (40, 3))
STAND = np.array([[0.0, 0.0, 2.0]])
ELEMENTS = 0.02 * np.array([[0, 1, 1], [0, -1, 1], [0, 1, -1], [0, -1, -1]])  # (e, 3) [m]


class Array:
    """As ``sionna.rt.PlanarArray``, in metres at the carrier."""

    def __init__(self, elements):
        self.elements = elements

    def positions(self, wavelength):
        assert wavelength == pytest.approx(speed_of_light / CARRIER)
        return self.elements.T


class Paths:
    """As ``sionna.rt.Paths``: moving receivers, one transmitter with an array."""

    def __init__(self, elements=((0, 0, 0),), synthetic_array=False, carrier=CARRIER):
        self.synthetic_array = synthetic_array
        self._frequency = carrier
        self.rx_array, self.tx_array = Array(np.zeros((1, 3))), Array(np.array(elements))
        self.ends = STAND[:, None] + np.array(elements)  # (n, m, 3)
        self.num_rx, self.num_tx = len(PLACES), 1

    @property
    def targets(self):
        return PLACES.T

    @property
    def sources(self):
        return (STAND if self.synthetic_array else self.ends.reshape(-1, 3)).T

    def lengths(self):
        return np.linalg.norm(PLACES[:, None, None] - self.ends, axis=-1)  # (k, n, m)

    def cir(self, normalize_delays, out_type):
        assert (normalize_delays, out_type) == (False, "numpy")
        delays = self.lengths() / speed_of_light
        fields = speed_of_light / CARRIER / (4 * np.pi * self.lengths())
        fields = fields * np.exp(-2j * np.pi * CARRIER * delays)
        if self.synthetic_array:
            delays = delays.mean(-1)  # (k, n)
            return fields[:, None, :, :, None, None], delays[..., None]
        return fields[:, None, :, :, None, None], delays[:, None, ..., None]


class RadioMap:
    """As ``sionna.rt.PlanarRadioMap``."""

    def __init__(self):
        x, y = np.meshgrid(np.arange(8.0), np.arange(6.0))
        self.centers = np.stack((x, y, np.ones_like(x)), -1)  # (rows, columns, 3)
        self._tx_positions, self._tx_names = STAND.T, ["mast"]

    @property
    def cell_centers(self):
        return self.centers

    @property
    def rss(self):  # [W]
        gains = 1e-3 / np.linalg.norm(self.centers - STAND[0], axis=-1) ** 2
        gains[0, 1] = 0
        return gains[None]


def friis_snr(links):
    return gaigs.evaluate(gaigs.train("friis", links), links).models["friis"]["snr_db_median"]


@pytest.mark.parametrize("synthetic", [False, True])
def test_paths_are_channels_of_the_fixed_end(synthetic):
    paths = Paths(ELEMENTS, synthetic)
    links = gaigs.links(paths, frequencies=OFFSETS)
    (receiver,) = links.receivers
    torch.testing.assert_close(receiver.pose.position, torch.tensor(STAND[0]).float())
    torch.testing.assert_close(receiver.array.elements, torch.tensor(ELEMENTS).float())
    np.testing.assert_allclose(links.task.frequencies, CARRIER + OFFSETS)
    lengths = paths.lengths()[:, 0, :, None]  # (k, m, 1)
    waves = np.exp(-2j * np.pi * (CARRIER * lengths + OFFSETS * lengths) / speed_of_light)
    fields = waves * speed_of_light / CARRIER / (4 * np.pi * lengths)
    np.testing.assert_allclose(links.labels, fields, rtol=1e-2 if synthetic else 1e-4)
    assert ("without an orientation" in links.remarks) == synthetic
    assert friis_snr(links) > 30


def test_given_elements_are_those_of_the_array():
    links = gaigs.links(Paths(ELEMENTS, True), frequencies=OFFSETS, elements=ELEMENTS[:, [1, 0, 2]])
    elements = torch.tensor(ELEMENTS[:, [1, 0, 2]]).float()
    torch.testing.assert_close(links.receivers[0].array.elements, elements)
    assert "without an orientation" not in links.remarks


def test_paths_without_frequencies_are_levels():
    links = gaigs.links(Paths(), test=0.25)
    apart = np.linalg.norm(PLACES - STAND, axis=1)
    friis = 20 * np.log10(speed_of_light / CARRIER / (4 * np.pi * apart))
    np.testing.assert_allclose(links.labels, friis, rtol=1e-5)
    assert len(links.split.test) == 10


def test_radio_maps_are_levels_of_their_cells():
    links = gaigs.links(RadioMap())
    assert len(links) == 47, "no path reaches one cell"
    assert links.receivers[0].name == "mast"
    apart = (links.query.transmitters - links.receivers[0].pose.position).norm(dim=1)
    torch.testing.assert_close(links.labels, -20 * apart.log10(), rtol=1e-4, atol=1e-4)
    moved = gaigs.links(RadioMap(), receivers={"tower": [1.0, 1.0, 3.0]})
    assert moved.receivers[0].name == "tower"


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (RadioMap(), {"frequencies": OFFSETS}, "a radio map has levels and no channels; leave"),
        (Paths(), {"receivers": STAND}, "paths know the places of both ends"),
        (Paths(), {"freq": 1e9}, r"have no option 'freq' \(did you mean 'frequency'"),
        (Paths(), {"frequencies": [1.0, np.nan]}, r"paths: frequencies\[1\]: expected a number"),
        (Paths(carrier=None), {}, "keep no carrier; set frequency=scene.frequency"),
    ],
)
def test_mistakes_end_in_two_lines_that_help(source, options, message):
    with pytest.raises(ValueError, match=message):
        gaigs.links(source, **options)
