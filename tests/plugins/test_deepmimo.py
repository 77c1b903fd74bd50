"""Scenarios of DeepMIMO v4, written here by numpy: channels by hand, written paths, phases, and
defects.
"""

import cmath
import json
import math
import sys

import numpy as np
import pytest
import scipy.io
import torch
from gaigs_deepmimo.readers import read_channels, read_strengths
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.data import synthetic
from gaigs.data.__main__ import main
from gaigs.io.deepmimo import Station, write_scenario
from gaigs.testing import check_data

CARRIER = 3.5e9
NAN = math.nan


def params(**changes):
    sets = {f"txrx_set_{k}": {"id": k, "is_tx": k == 0, "is_rx": True} for k in (0, 1)}
    return {
        "rt_params": {"frequency": CARRIER, "raytracer_name": "other"},
        "txrx_sets": sets,
    } | changes


def matrices():
    """One station; a user with two paths, one without any, one with a path."""
    nowhere = [NAN, NAN]
    return {
        "rx_pos": [[10.0, 0, 1], [20, 0, 1], [30, 5, 1]],
        "tx_pos": [[0.0, 0, 9]],
        "power": [[-60.0, -66], nowhere, [-80, NAN]],
        "phase": [[30.0, -100], nowhere, [170, NAN]],
        "delay": [[4e-8, 9e-8], nowhere, [1.1e-7, NAN]],
        "aod_az": [[0.0, 70], nowhere, [10, NAN]],
        "aod_el": [[129.0, 80], nowhere, [104, NAN]],
        "inter": [[0.0, 1], nowhere, [11, NAN]],
    }


def save(folder, content, code="t000_tx000_r001", suffix=".npz"):
    for name, array in content.items():
        file = folder / f"{name}_{code}{suffix}"
        if suffix == ".mat":
            scipy.io.savemat(file, {name: np.float32(array)})
        else:
            np.savez(file, **{name: np.asarray(array)})


@pytest.fixture
def folder(tmp_path):
    save(tmp_path, matrices())
    (tmp_path / "params.json").write_text(json.dumps(params()))
    return tmp_path


def test_channels_are_the_sum_of_the_paths_by_hand(folder):
    """Rows of the array run upwards, columns along y, half a wavelength apart about the station."""
    links = read_channels(folder, elements=[2, 3], bandwidth=20e6, subcarriers=5)
    check_data(links)
    content = matrices()
    places = [(y / 2, z / 2) for y in (-1, 0, 1) for z in (-0.5, 0.5)]  # [wavelengths]
    for link, user in enumerate((0, 2)):
        for element, (y, z) in enumerate(places):
            for number, offset in enumerate((-10e6, -5e6, 0, 5e6, 10e6)):
                total = 0
                for p in range(2 if user == 0 else 1):
                    power, phase, delay, azimuth, zenith = (
                        content[key][user][p]
                        for key in ("power", "phase", "delay", "aod_az", "aod_el")
                    )
                    a, t = math.radians(azimuth), math.radians(zenith)
                    turn = y * math.sin(t) * math.sin(a) + z * math.cos(t)
                    angle = math.radians(phase) - 2 * math.pi * offset * delay + 2 * math.pi * turn
                    total += 10 ** (power / 20) * cmath.exp(1j * angle)
                assert abs(links.labels[link, element, number].item() - total) < 1e-6 * abs(total)
    assert links.query.transmitters.tolist() == [[10, 0, 1], [30, 5, 1]]
    (receiver,) = links.receivers
    assert (receiver.name, receiver.pose.position.tolist()) == ("t000_tx000", [0, 0, 9])
    wavelength = speed_of_light / CARRIER
    local = receiver.array.elements @ receiver.pose.rotation.double().T / wavelength
    np.testing.assert_allclose(local, [(0, y, z) for y, z in places], atol=1e-7)
    assert "2 of 3 users" in links.remarks


def test_formats_and_sets_of_users_are_read_alike(folder):
    """A second set of users, in MATLAB's format; paths between stations are not links."""
    first = read_channels(folder)
    save(
        folder,
        matrices() | {"rx_pos": [[10.0, 0, 2], [20, 0, 2], [30, 5, 2]]},
        "t000_tx000_r002",
        ".mat",
    )
    save(folder, matrices(), "t000_tx000_r000")
    both = read_channels(folder)
    assert len(both.receivers) == 1
    assert both.query.transmitters[:, 2].tolist() == [1, 1, 2, 2]
    torch.testing.assert_close(both.labels[2:], first.labels, rtol=1e-3, atol=0)
    some = read_channels(folder, transmitters=3)
    assert len(some) == len(some.rows.unique()) == 3


def write_example(folder, seed=0):
    """Twelve users in free space and their mirror images in the floor; the gains without the
    floor's are known.
    """
    users = np.random.default_rng(seed).uniform((1, -5, 0.5), (9, 5, 2), (12, 3))
    station = np.array([0.0, 0.0, 2.5])
    images = np.stack((users, users * (1, 1, -1)), 1)
    lengths = np.linalg.norm(images - station, axis=-1)
    gains = np.array([1, -0.5]) * speed_of_light / (4 * np.pi * CARRIER * lengths)
    share = station[2] / (station[2] + users[:, 2:])
    points = np.full((12, 2, 1, 3), NAN)
    points[:, 1, 0] = station + share * (images[:, 1] - station)
    fields = gains * np.exp(-2j * np.pi * CARRIER / speed_of_light * lengths)
    write_scenario(folder, CARRIER, users, [Station(station, fields, points)])
    return users, station, fields, points[:, 1, 0]


def test_written_paths_have_their_geometry(tmp_path):
    users, station, fields, points = write_example(tmp_path)

    def matrix(name):
        return np.load(tmp_path / f"{name}_t000_tx000_r001.npz")[name]

    ways = {"aod": (station, users, points), "aoa": (users, station, points)}
    for end, (start, direct, bounce) in ways.items():
        expected = np.stack((direct - start, bounce - start), 1)
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        azimuth, zenith = np.deg2rad(matrix(f"{end}_az")), np.deg2rad(matrix(f"{end}_el"))
        level = np.sin(zenith)
        found = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.cos(zenith)), -1)
        np.testing.assert_allclose(found, expected, atol=1e-5)
    assert matrix("inter").tolist() == [[0, 1]] * 12
    np.testing.assert_allclose(matrix("inter_pos")[:, 1, 0], points, rtol=1e-5)
    links = read_channels(tmp_path, elements=[1, 1], subcarriers=1)
    np.testing.assert_allclose(links.labels[:, 0, 0], fields.sum(1), rtol=1e-3)
    strengths = 20 * np.log10(np.abs(fields.sum(1)))
    np.testing.assert_allclose(read_strengths(tmp_path, bandwidth=1.0).labels, strengths, atol=1e-2)


def test_phases_without_the_carriers_get_it(tmp_path):
    """As of Sionna RT: the phase of a line of sight is 0 at all distances."""
    *_, fields, _ = write_example(tmp_path)
    expected = read_channels(tmp_path)
    file = tmp_path / "phase_t000_tx000_r001.npz"
    np.savez(file, phase=np.where(np.arange(2) == 1, 180.0, np.zeros(fields.shape)))
    links = read_channels(tmp_path)
    torch.testing.assert_close(links.labels, expected.labels, rtol=1e-3, atol=1e-6)
    assert "it is added" in links.remarks
    assert "it is added" not in expected.remarks


def test_the_built_in_room_is_written_and_read(tmp_path, monkeypatch):
    monkeypatch.setattr(
        sys,
        "argv",
        ["gaigs.data", str(tmp_path / "room"), "synthetic_csi", "--deepmimo", "transmitters=20"],
    )
    main()
    links = read_channels(tmp_path / "room", elements=[1, 1], subcarriers=1)
    receiver = Receiver("point", links.receivers[0].pose, Array.single())
    places = links.query.transmitters
    (expected,) = synthetic.respond_in_parts(
        synthetic.ROOM, places, receiver, 6.4896e9, torch.zeros(1), 2
    )
    torch.testing.assert_close(links.labels, expected.to(torch.complex64), rtol=1e-3, atol=1e-7)
    arrays = {
        key: np.load(tmp_path / "room" / f"{key}_t000_tx000_r001.npz")[key]
        for key in ("delay", "inter_pos", "rx_pos")
    }
    ends = [
        np.broadcast_to(end, (20, 25, 1, 3))
        for end in (arrays["rx_pos"][:, None, None], synthetic.POSE.position)
    ]
    points = np.where(np.isnan(arrays["inter_pos"]), ends[0], arrays["inter_pos"])
    legs = np.diff(np.concatenate((ends[1], points, ends[0]), 2), axis=2)
    np.testing.assert_allclose(
        np.linalg.norm(legs, axis=-1).sum(2), arrays["delay"] * speed_of_light, rtol=1e-4
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"delay": np.full((3, 2), 40.0)},
            r"delay\[0, 0\]: expected a delay of 0 to 1 ms in seconds, got 40",
        ),
        (
            {"aod_el": np.full((3, 2), -20.0)},
            r"aod_el\[0, 0\]: expected an angle from the z axis.*got -20",
        ),
        (
            {"phase": np.zeros((3, 1))},
            r"expected the shape \(3, 2\) to power_t000.* of \(3, 2\), got \(3, 1\)",
        ),
        (
            {"power": np.full((3, 2), NAN)},
            "expected a path to a user in power_t000_tx000_r001.npz, got none",
        ),
        (
            {"power": 1e-9 - 0 * np.array(matrices()["power"])},
            "expected gains in dB, got 1e-09 to 1e-09 for all paths",
        ),
        (
            {"power": np.full((3, 2), "x")},
            "cannot parse .*power_t000.*; expected an array 'power' of real numbers",
        ),
        ({"rx_pos": np.full((3, 3), 5e6)}, r"rx_pos\[0, 0\]: expected positions within 1e5 m"),
    ],
)
def test_defects_are_named(folder, changes, message):
    save(folder, changes)
    with pytest.raises(ValueError, match=message):
        read_channels(folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"cannot parse .*params\.json: FileNotFoundError"),
        ("{", r"cannot parse .*params\.json: JSONDecodeError"),
        (
            json.dumps({"rt_params": {}}),
            "KeyError: 'frequency'; expected rt_params.frequency and txrx_sets",
        ),
        (
            json.dumps(params(rt_params={"frequency": 3.5})),
            r"rt_params.frequency must be a carrier in Hz.*in GHz\?",
        ),
    ],
)
def test_defects_of_the_parameters_are_named(folder, content, message):
    (folder / "params.json").unlink()
    if content is not None:
        (folder / "params.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_channels(folder)


@pytest.mark.parametrize(
    "names",
    [
        ("params.mat", "BS1_BS.mat", "BS1_UE_0-1024.mat"),
        ("O1_60.params.mat", "O1_60.1.CIR.mat", "O1_60.1.DoA.mat"),
    ],
)
def test_scenarios_of_earlier_versions_are_named(tmp_path, names):
    scene = tmp_path / "scene_0"
    scene.mkdir()
    for name in names:
        scipy.io.savemat(scene / name, {"tx_loc": np.zeros(3)})
    message = r"a scenario of DeepMIMO v3 or before, as .*\nby the package deepmimo: deepmimo"
    for root in (scene, tmp_path):
        with pytest.raises(ValueError, match=message):
            read_channels(root)


def test_a_folder_without_paths_and_options_out_of_range_are_refused(folder):
    for options, message in (
        ({"elements": [4]}, "elements must be the array's rows and columns"),
        ({"bandwidth": 0.0}, "bandwidth must be positive"),
        ({"subcarriers": 0}, "subcarriers must be at least 1"),
        ({"transmitters": 3}, "transmitters must be 2 to 2, the users with a path, got 3"),
    ):
        with pytest.raises(ValueError, match=message):
            read_channels(folder, **options)
    (folder / "power_t000_tx000_r001.npz").unlink()
    with pytest.raises(ValueError, match="expected paths from base stations to users"):
        read_channels(folder)
