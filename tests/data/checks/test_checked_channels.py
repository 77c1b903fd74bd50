"""Faults of channels: units, axes, orders, signs, and subcarriers that are none; each is named with
what mends it.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from invented_channels import WAVELENGTH, channels, room
from scipy.spatial.transform import Rotation

import gaigs
from gaigs.core.task.csi import Csi
from gaigs.data import divide
from gaigs.testing import example_links

SIZES = [(1, 1, 1), (1, 16, 3), (4, 1, 3), (4, 16, 1), (16, 1, 1), (16, 8, 3)]
"""Elements, subcarriers and receivers."""


def moved(name, change):
    """The room with another value of an array."""
    return lambda own: replace(own, **{name: change(getattr(own, name))})


def places(change):
    return lambda own: replace(own, tx=change(own.tx), rx=change(own.rx))


def from_angles(change):
    """Transmitters whose azimuth and elevation about the first receiver are taken for others."""

    def fault(own):
        x, y, z = (own.tx - own.rx[0]).T
        distance = np.linalg.norm(own.tx - own.rx[0], axis=1)
        azimuth, elevation = change(np.arctan2(y, x), np.arcsin(z / distance))
        level = np.cos(elevation)
        unit = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), 1)
        return replace(own, tx=own.rx[0] + distance[:, None] * unit)

    return fault


FAULTS = {
    "tx x y": (moved("tx", lambda tx: tx[:, [1, 0, 2]]), "tx have x and y exchanged", (1, 1, 1)),
    "tx z x y": (moved("tx", lambda tx: tx[:, [2, 0, 1]]), "tx have the order z, x, y", (1, 1, 1)),
    "rx z": (moved("rx", lambda rx: rx * [1, 1, -1]), "rx have z negated", (1, 1, 1)),
    "tx cm": (moved("tx", lambda tx: 100 * tx), "tx are in cm", (1, 1, 1)),
    "rx mm": (moved("rx", lambda rx: 1000 * rx), "rx are in mm", (1, 1, 1)),
    "feet": (places(lambda points: points / 0.3048), "tx and rx are in feet", (1, 1, 1)),
    "elements cm": (moved("elements", lambda points: 100 * points), "elements are in cm", (4, 1, 1)),
    "half wavelengths": (
        moved("elements", lambda points: 2 * points / WAVELENGTH),
        "elements are in half wavelengths",
        (4, 1, 1),
    ),
    "kHz": (moved("frequencies", lambda f: f / 1000), "frequencies are in kHz", (1, 1, 1)),
    "elements x y": (
        moved("elements", lambda points: points[:, [1, 0, 2]]),
        "elements have x and y exchanged",
        (4, 1, 1),
    ),
    "elements reversed": (moved("h", lambda h: h[:, :, ::-1]), "elements are in reversed order", (4, 1, 1)),
    "columns": (
        moved("h", lambda h: h.reshape(*h.shape[:2], 4, 4, -1).swapaxes(2, 3).reshape(h.shape)),
        "elements are in another order of rows and columns",
        (16, 1, 1),
    ),
    "rx exchanged": (moved("rx", lambda rx: rx[[1, 0, 2]]), r"rx are exchanged; rx = rx\[\[1, 0, 2\]\]", (1, 1, 3)),
    "rx from 1": (moved("rx", lambda rx: rx[[2, 0, 1]]), r"as by numbers from 1; rx = rx\[\[1, 2, 0\]\]", (1, 1, 3)),
    "compass": (from_angles(lambda az, el: (np.pi / 2 - az, el)), "tx are of azimuths clockwise from north", (4, 1, 1)),
    "polar": (from_angles(lambda az, el: (az, np.pi / 2 - el)), "elevations taken for polar angles", (4, 1, 1)),
    "degrees": (from_angles(lambda az, el: (np.deg2rad(az), np.deg2rad(el))), "radians taken for degrees", (4, 1, 1)),
    "carrier": (
        lambda own: replace(own, h=channels(own, has_carrier=False)),
        r"the carrier's phase over the delay is missing; multiply each path",
        (1, 1, 1),
    ),
    "subcarriers": (moved("h", lambda h: h[..., ::-1]), "subcarriers are in reversed order", (1, 16, 1)),
    "coefficients": (moved("h", lambda h: h.conj()[..., ::-1]), "path coefficients are conjugate", (1, 16, 1)),
}  # fmt: skip
"""Of each fault: how it changes the arrays, what is said, and fewest elements, subcarriers and
receivers.
"""


def cases():
    """Each fault at one size that shows it: the smallest and the largest by turns."""
    for number, (fault, (*_, least)) in enumerate(FAULTS.items()):
        suitable = []
        for size in SIZES:
            is_large = all(a >= b for a, b in zip(size, least, strict=True))
            if is_large and not (least[0] == 4 and size[2] == 3):
                suitable.append(size)
        size = suitable[-(number % 2)]
        yield pytest.param(fault, size, id=f"{fault} {size}")


@pytest.mark.parametrize(("fault", "size"), list(cases()))
def test_the_convention_that_fits_is_named(fault, size):
    change, words, _ = FAULTS[fault]
    remarks = change(room(*size, seed=sum(size))).links().remarks
    assert re.search(
        f"the direct wave explains [0-9]+% of the channels in place of [0-9]+% if .*{words}",
        remarks,
    )


@pytest.mark.usefixtures("checked_when_described")
@pytest.mark.parametrize(
    ("size", "phase", "reflection"),
    [
        ((1, 1, 1), "known", -0.9),
        ((4, 1, 3), "known", 0.0),
        ((16, 1, 1), "known", -0.9),
        ((1, 16, 3), "conjugate", 0.0),
        ((4, 16, 1), "conjugate", -0.9),
        ((16, 8, 3), "conjugate", 0.0),
        ((1, 1, 1), "per_link", 0.0),
        ((4, 1, 3), "per_link", -0.9),
        ((16, 1, 1), "per_link", 0.0),
        ((1, 16, 3), "per_link_and_delay", -0.9),
        ((4, 16, 1), "per_link_and_delay", 0.0),
        ((16, 8, 3), "per_link_and_delay", -0.9),
    ],
)
def test_sound_channels_have_no_finding(size, phase, reflection):
    """Each size with two phases, each phase with three sizes, with and without strong reflections."""
    own = room(*size, seed=1, reflection=reflection, turned=True)
    rng = np.random.default_rng(0)
    if phase == "conjugate":
        own.h, phase = own.h.conj(), "known"
    angles = 2 * np.pi * rng.random((2, *own.h.shape[:2], 1, 1))
    if phase != "known":
        own.h = own.h * np.exp(1j * angles[0])
    if phase == "per_link_and_delay":
        own.h = own.h * np.exp(1j * angles[1] * (own.frequencies - own.frequencies.mean()) / 80e6)
    assert gaigs.describe(own.links(phase)).findings == ()


@pytest.mark.parametrize(
    ("roll", "words"),
    [
        (1, "quaternions have the order w, x, y, z; quaternion = np.roll\\(quaternion, -1\\)"),
        (-1, "quaternions have the order x, y, z, w; quaternion = np.roll\\(quaternion, 1\\)"),
        (0, "rotations lead from the world to the array; rotation = rotation.T"),
    ],
)
def test_orientations_are_named(roll, words):
    own = room(16, 1, 2, turned=True)
    if roll:
        own.quaternions = np.roll(own.quaternions, roll, axis=1)
    else:
        own.quaternions = Rotation.from_quat(own.quaternions).inv().as_quat()
    assert re.search(words, own.links().remarks)


def test_conventions_show_within_links_of_unknown_phase_and_in_levels():
    rng = np.random.default_rng(0)
    own = room(4, 16, 3)
    own.h = own.h * np.exp(2j * np.pi * rng.random((*own.h.shape[:2], 1, 1)))
    swapped = replace(own, rx=own.rx[[1, 0, 2]]).links("per_link").remarks
    assert re.search(
        r"explains \d+% of each channel in place of \d+% if rows of rx are exchanged", swapped
    )
    single = room(1, 1, 3, reflection=-0.1)
    single.h = single.h * np.exp(2j * np.pi * rng.random((*single.h.shape[:2], 1, 1)))
    remarks = replace(single, tx=100 * single.tx).links("per_link").remarks
    assert re.search(
        r"distance explains \d+% of the levels' spread in place of \d+% if tx are in cm", remarks
    )


@pytest.mark.parametrize(
    ("count", "phase"), [(16, "known"), (17, "per_link_and_delay"), (32, "per_link_and_delay")]
)
def test_the_fft_order_is_named(count, phase):
    own = room(1, count, 1)
    fft = replace(own, h=np.fft.ifftshift(own.h, axes=-1)).links(phase).remarks
    assert re.search(r"FFT order\?; h = np.fft.fftshift\(h, axes=-1\)", fft)
    other = replace(own, frequencies=np.fft.ifftshift(own.frequencies)).links(phase).remarks
    assert re.search(r"FFT order\?; frequencies = np.sort\(frequencies\)", other)
    both = replace(
        own, h=np.fft.ifftshift(own.h, axes=-1), frequencies=np.fft.ifftshift(own.frequencies)
    )
    assert "FFT order" not in both.links(phase).remarks


@pytest.mark.parametrize(
    "change", [lambda h: h.real + 0j, lambda h: np.abs(h) + 1j * np.angle(h) / np.pi]
)
def test_channels_without_their_parts_are_named(change):
    own = room(1, 16, 3)
    remarks = replace(own, h=change(own.h)).links().remarks
    words = (
        "(real parts are 0 or more|imaginary parts are 0) at all links, .* of amplitudes a and "
        "phases p"
    )
    assert re.search(words, remarks)


def test_transmitters_in_the_frame_of_their_receiver_are_named():
    own = room(4, 16, 1)
    remarks = replace(own, tx=own.tx - own.rx[0]).links().remarks
    assert "if tx are relative to rx or rx are in mm; tx = tx + rx or" in remarks


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_noise_in_guard_subcarriers_is_named(factor):
    own = room(4, 16, 2)
    own.h[..., :2] *= factor * np.exp(
        2j * np.pi * np.random.default_rng(0).random(own.h[..., :2].shape)
    )
    words = (
        "2 of 16 subcarriers are 30 dB or more from the usual one in power: 3.46, 3.465 GHz; leave "
        "them out if"
    )
    assert words in own.links().remarks


@pytest.mark.parametrize("value", [0.0, 0.3 + 0.4j, 1e-12])
def test_guard_and_null_subcarriers_are_left_out(value, caplog):
    own = room(4, 16, 2)
    nulls = [0, 1, 8, 15]
    own.h[..., nulls] = value
    if value == 1e-12:  # rounding of a Fourier transform
        own.h[..., nulls] *= np.random.default_rng(0).normal(size=own.h[..., nulls].shape)
    links = own.links()
    assert links.task.shape == (4, 12)
    assert links.labels.shape == (220, 4, 12)
    kept = np.delete(np.arange(16), nulls)
    torch.testing.assert_close(links.task.frequencies, torch.from_numpy(own.frequencies[kept]))
    words = (
        "4 of 16 subcarriers have one value in every link, and are left out: 3.46, 3.465, 3.5, "
        "3.535 GHz"
    )
    assert links.remarks == words
    assert words in caplog.text
    assert gaigs.describe(links).findings == ()


def test_null_subcarriers_of_arrays_of_several_sizes_and_of_held_out_bands():
    links = example_links("csi")
    small = replace(links.receivers[1], array=gaigs.Array(links.receivers[1].array.elements[:2]))
    labels = links.labels.clone()
    labels[1::2, 2:] = 0
    labels[..., 3] = 2.0
    labels[1::2, 2:] = 0
    labels[4, :, [0, 1, 2, 4]] = 0  # silent but for the null subcarrier
    held_out = replace(
        links, labels=links.labels[..., :3].clone(), task=Csi(4, links.task.frequencies[:3] + 1e8)
    )
    held_out.labels[..., 1] = 0
    links = replace(links, receivers=(links.receivers[0], small), labels=labels, held_out=held_out)
    divided = divide(links, {"name": "official"})
    assert divided.labels.shape == (23, 4, 4)
    assert divided.held_out.labels.shape == (23, 4, 2)
    torch.testing.assert_close(
        divided.query.transmitters, links.query.transmitters[torch.arange(24) != 4]
    )
    assert divided.split.test.tolist() == [19, 20, 21, 22]
    assert "1 of 5 subcarriers have one value in every link" in divided.remarks
    assert "1 of 3 subcarriers have one value in every link" in divided.remarks
    assert "1 links with no other subcarrier are left out" in divided.remarks
    held_out.labels[:] = 1.0
    with pytest.raises(ValueError, match="all subcarriers to test on have one value in every link"):
        divide(replace(links, held_out=held_out), {"name": "official"})
