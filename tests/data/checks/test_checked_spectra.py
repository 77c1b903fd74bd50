"""Bright directions tell the convention of positions, orientations and pixels; sound spectra have
no remark.
"""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from invented_spectra import SIZE, room

import gaigs
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.task.spectrum import Spectrum
from gaigs.data.checks.spectra import column_changes

pytestmark = pytest.mark.usefixtures("checked_when_described")


@functools.cache
def sound():
    return room(120)


def scaled(made):
    low, high = made.transmitters.min(0), made.transmitters.max(0)
    return 2 * (made.transmitters - low) / (high - low) - 1


def standardised(places):
    return (places - places.mean(0)) / places.std(0)


FAULTS = {
    "tx are in cm": lambda own: {"transmitters": 100 * own.transmitters},
    "tx are in mm": lambda own: {"transmitters": 1000 * own.transmitters},
    "tx are in feet": lambda own: {"transmitters": own.transmitters / 0.3048},
    "rx are in cm": lambda own: {"position": 100 * own.position},
    "tx are scaled to -1..1 along each axis": lambda own: {"transmitters": scaled(own)},
    "tx are scaled to 0..1 along each axis": lambda own: {"transmitters": own.transmitters / SIZE},
    "tx have x and y exchanged": lambda own: {"transmitters": own.transmitters[:, [1, 0, 2]]},
    "tx have y and z exchanged": lambda own: {"transmitters": own.transmitters[:, [0, 2, 1]]},
    "quaternions have the order w, x, y, z": lambda own: {"quaternion": np.roll(own.quaternion, 1)},
    "rotations lead from the world to the array": lambda own: {
        "quaternion": own.quaternion * [-1, -1, -1, 1]
    },
    "rows are upside down": lambda own: {"spectra": own.spectra[:, ::-1].copy()},
    "the first column is at azimuth -180 degrees": lambda own: {
        "spectra": np.roll(own.spectra, 30, 2)
    },
    "azimuths run clockwise": lambda own: {"spectra": own.spectra[:, :, -np.arange(60)]},
    "azimuths run clockwise from the y axis": lambda own: {
        "spectra": own.spectra[:, :, 15 - np.arange(60)]
    },
    "tx are relative to rx": lambda own: {"transmitters": own.transmitters - own.position},
    "rx are in mm": lambda own: {"position": 1000 * own.position},
    "tx are scaled to -0.5..0.5 along each axis": lambda own: {
        "transmitters": own.transmitters / SIZE - 0.5
    },
    "tx are standardised along each axis": lambda own: {
        "transmitters": standardised(own.transmitters)
    },
    "amplitudes are inverted": lambda own: {"spectra": 1 - own.spectra},
    "spectra are sorted by name (0, 10": lambda own: {
        "spectra": own.spectra[np.argsort([*map(str, range(120))])]
    },
    "spectra are one row late": lambda own: {"spectra": np.roll(own.spectra, 1, 0)},
    "spectra are sorted by name": lambda own: {
        "spectra": own.spectra[np.argsort([*map(str, range(1, 121))])]
    },
    "tx are in cm and quaternions have the order w, x, y, z": lambda own: {
        "transmitters": 100 * own.transmitters,
        "quaternion": np.roll(own.quaternion, 1),
    },
    "are upside down and the first column is at azimuth -180": lambda own: {
        "spectra": np.roll(own.spectra[:, ::-1], 30, 2)
    },
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_convention_of_spectra_is_named(fault):
    made = replace(sound(), **FAULTS[fault](sound()))
    (finding,) = (
        one for one in gaigs.describe(made.links()).findings if one.fault == "directions of spectra"
    )
    assert fault in finding.text
    assert finding.fits > finding.read + 0.08
    assert finding.mend


def test_exchanged_rows_and_columns_of_a_square_grid_are_named():
    made = sound()
    grid = Grid.degrees(range(3, 91, 3), range(0, 360, 12))
    pose = Pose.from_xyzw(made.position, made.quaternion)
    links = gaigs.links(
        task=Spectrum(grid.elevations, grid.azimuths),
        transmitters=made.transmitters,
        receivers=Receiver("array", pose),
        labels=made.spectra[..., ::2].swapaxes(1, 2).copy(),
    )
    said = "; ".join(gaigs.describe(links).suspicious)
    assert "if rows and columns are exchanged; spectra = spectra.swapaxes(1, 2)" in said


@pytest.mark.parametrize("azimuths", [range(0, 360, 4), range(-90, 91, 5), range(-178, 180, 4)])
def test_the_line_that_mends_clockwise_azimuths_mirrors_them(azimuths):
    grid = Grid.degrees(range(0, 91, 10), azimuths)
    (change, *_) = column_changes(grid)
    given = torch.cos(grid.azimuths + 0.3).expand(1, *grid.shape).numpy()
    names = {"np": np, "spectra": given, "columns": len(azimuths)}
    mended = eval(change.mend.removeprefix("spectra = "), names)
    np.testing.assert_allclose(mended[0, 0], torch.cos(-grid.azimuths + 0.3), atol=1e-5)


def test_spectra_in_no_order_are_doubted():
    made = replace(sound(), spectra=np.random.default_rng(0).permutation(sound().spectra))
    (found,) = gaigs.describe(made.links()).suspicious
    assert found.startswith(
        "spectra are not bright towards their transmitters, and near places have a correlation of "
    )
    assert found.endswith("are places and spectra in the same order?")


@pytest.mark.parametrize(
    "options", [{}, {"blocked": 0.0}, {"blocked": 1.0}, {"count": 40}, {"edge": 2}]
)
def test_sound_spectra_have_no_remark(options):
    assert gaigs.describe(room(**options).links()).findings == ()


@pytest.mark.parametrize("order", [0, 2])
def test_simulated_spectra_have_no_remark(order):
    assert gaigs.describe(gaigs.links("synthetic", transmitters=60, order=order)).findings == ()


def test_measured_spectra_have_no_remark(measured):
    links = gaigs.links("nerf2_spectrum", root=str(measured("rfid-s23-200")))
    assert gaigs.describe(links).findings == ()
