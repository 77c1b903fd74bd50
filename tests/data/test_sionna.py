"""Spectra of the ray tracer's rooms: where lobes point, what repeats, and the same from the folder."""

import runpy
import sys

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree

from gaigs.data import load, nerf2_spectrum
from gaigs.data.sionna import patch_array, place
from gaigs.data.sionna.meshes import FURNITURE_MARGIN, HEIGHTS, edges, wavefront_obj
from gaigs.data.sionna.rooms import ROOMS
from gaigs.directions import Grid
from gaigs.geometry import from_spherical
from gaigs.propagation import bartlett, min_max
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
SMALL = {"room": "slanted", "transmitters": 10}

every_room = pytest.mark.parametrize("name", ROOMS)


def traced_room(split=OFFICIAL, **options):
    return load({"name": "sionna", **SMALL, **options}, split)


@pytest.fixture(scope="module")
def links(tracer):
    return traced_room()


# --- places and array ---


@every_room
def test_transmitters_stand_free_and_everywhere(name):
    room = ROOMS[name]
    places = place(room, 400, 0)
    assert room.is_free(places).all()
    assert len(torch.unique(places, dim=0)) == 400
    low, high = HEIGHTS
    assert low <= places[:, 2].min() < low + 0.05
    assert high - 0.05 < places[:, 2].max() <= high
    level = (torch.tensor(room.floor) + torch.tensor(room.ceiling)) / 2
    assert (places[:, :2].amax(0) - places[:, :2].amin(0) > level.amax(0) - level.amin(0) - 1.2).all()
    assert not any(cuboid.contains(places, FURNITURE_MARGIN).any() for cuboid in room.furniture)
    assert torch.equal(places, place(room, 400, 0))
    assert not torch.equal(places, place(room, 400, 1))


def test_transmitters_are_uniform_over_what_is_free():
    """As many in the long arm of the L as it has of the free volume, by a fine lattice."""
    room = ROOMS["l_shape"]
    axes = [torch.arange(0.05, 8, 0.1), torch.arange(0.05, 6.6, 0.1), torch.arange(0.35, 2.0, 0.1)]
    lattice = torch.cartesian_prod(*axes)
    lattice = lattice[room.is_free(lattice)]
    places = place(room, 3000, 0)
    long_arm = lambda points: (points[:, 0] > 3.8).double().mean().item()
    assert long_arm(places) == pytest.approx(long_arm(lattice), abs=3 * 0.5 / 3000**0.5)


@every_room
def test_every_transmitter_is_in_front_of_the_array(name):
    places, pose = place(ROOMS[name], 400, 0), patch_array(ROOMS[name], 6e9).pose
    assert (pose.local(places)[:, 2] > 0).all()


def test_the_array_is_square_and_half_a_wavelength_apart():
    array = patch_array(ROOMS["slanted"], 6e9).array
    assert (len(array), array.pattern) == (16, "cosine")
    distances, _ = cKDTree(array.elements.numpy()).query(array.elements.numpy(), k=2)
    np.testing.assert_allclose(distances[:, 1], speed_of_light / 6e9 / 2, rtol=1e-6)


# --- labels ---


def test_the_room_keeps_the_contract(links):
    check_data(links)
    assert links.labels.shape == (10, 90, 360)
    assert links.labels.dtype == torch.float32
    assert links.labels.amin((1, 2)).tolist() == [0] * 10
    assert links.labels.amax((1, 2)).tolist() == [1] * 10
    assert links.task.normalisation == nerf2_spectrum.NORMALISATION
    assert links.query.frequencies.tolist() == [6.4896e9] * 10
    assert links.split.test.tolist() == [8, 9]
    assert links.bandwidth == 499.2e6
    assert torch.equal(links.edges, edges(ROOMS["slanted"].meshes()))


def test_lobes_point_at_transmitters_in_line_of_sight(links):
    """The highest pixel against the direction, of those that nothing stands before."""
    (receiver,) = links.receivers
    places = links.query.transmitters
    steps = torch.linspace(0.02, 0.98, 400)[:, None, None]
    between = (receiver.pose.position + steps * (places - receiver.pose.position)).flatten(0, 1)
    blocked = [c.contains(between, 0.0).unflatten(0, (400, -1)).any(0) for c in ROOMS["slanted"].furniture]
    clear = ~torch.stack(blocked).any(0)
    assert clear.sum() >= 7
    rows, columns = links.labels.flatten(1).argmax(1) // 360, links.labels.flatten(1).argmax(1) % 360
    peaks = from_spherical(torch.deg2rad(columns.float()), torch.deg2rad(rows + 1.0))
    local = receiver.pose.local(places)
    angles = torch.rad2deg(torch.acos((peaks * local / local.norm(dim=1, keepdim=True)).sum(1).clamp(-1, 1)))
    assert angles[clear].median() < 2
    assert (angles[clear] < 8).double().mean() > 0.8


def test_band_and_carrier_differ_and_are_told(links):
    carrier = traced_room(spectrum="carrier")
    assert carrier.bandwidth == 0
    assert torch.equal(carrier.query.transmitters, links.query.transmitters)
    assert (carrier.labels - links.labels).abs().max() > 0.05


def test_a_narrow_band_is_the_carrier(tracer):
    narrow, carrier = traced_room(bandwidth=1e3), traced_room(spectrum="carrier")
    torch.testing.assert_close(narrow.labels, carrier.labels, rtol=0, atol=1e-3)


def test_each_place_sends_at_each_carrier(tracer):
    carriers = [5e9, 6.4896e9]
    both, high = traced_room(frequency=carriers), traced_room()
    assert both.query.frequencies.tolist() == pytest.approx(carriers * 10)
    assert both.rows.tolist() == [k // 2 for k in range(20)]
    assert torch.equal(both.query.transmitters[::2], high.query.transmitters)
    assert torch.equal(both.labels[1::2], high.labels), "the array is that of the highest carrier"
    check_data(both)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"room": "round"}, "room must be one of l_shape, slanted, furnished, got 'round'"),
        ({"spectrum": "lobes"}, "spectrum must be 'band' or 'carrier', got 'lobes'"),
        ({"transmitters": 1}, "transmitters must be at least 2"),
        ({"bandwidth": 0}, "bandwidth must be positive"),
        ({"frequency": []}, "frequency must be a carrier or several different ones"),
        ({"frequency": [5e9, 5e9]}, "frequency must be a carrier or several different ones"),
        ({"frequency": -5e9}, "frequency must be a carrier in Hz"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        traced_room(**options)


def test_frequencies_are_numbers():
    with pytest.raises(TypeError, match="'frequency' must be a number or a list, got '5e9'"):
        traced_room(frequency="5e9")


# --- channels ---


def test_spectra_of_the_channels_are_those_of_the_room(links):
    """With one subcarrier, steering the channels gives the carrier's spectra."""
    channels = load({"name": "sionna_csi", **SMALL, "subcarriers": 1}, OFFICIAL)
    carrier = traced_room(spectrum="carrier")
    array = channels.receivers[0].array
    steered = bartlett(channels.labels.to(torch.complex128), Grid.degrees(), array, 6.4896e9)
    assert (min_max(steered) - carrier.labels).abs().max() < 1e-4
    assert torch.equal(channels.query.transmitters, links.query.transmitters)


# --- files ---


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["sionna", *map(str, arguments)])
    runpy.run_module("gaigs.data.sionna", run_name="__main__")


def same(first, second):
    torch.testing.assert_close(first.query.transmitters, second.query.transmitters)
    torch.testing.assert_close(first.receivers[0].pose.position, second.receivers[0].pose.position)


def test_the_command_writes_each_task_in_its_layout(links, tmp_path, monkeypatch, capsys):
    options = ["--room", "slanted", "--transmitters", 10]
    for task in ("spectrum", "rssi", "csi"):
        command(monkeypatch, tmp_path / task, "--task", task, *options)
        assert (tmp_path / task / "geometry.obj").read_text() == wavefront_obj(ROOMS["slanted"].meshes())
    assert "spectrum: 8 training and 2 test labels" in capsys.readouterr().out

    spectra = load({"name": "nerf2_spectrum", "root": str(tmp_path / "spectrum")}, OFFICIAL)
    same(spectra, links)
    assert (spectra.labels[torch.arange(10)] - links.labels).abs().max() <= 0.5 / 255 + 1e-6
    torch.testing.assert_close(spectra.receivers[0].pose.rotation, links.receivers[0].pose.rotation)

    everything = {"name": "random", "validation": 0}
    readings = load({"name": "rssi_csv", "file": str(tmp_path / "rssi" / "room.csv")}, everything)
    simulated = load({"name": "sionna_rssi", **SMALL}, OFFICIAL)
    same(readings, simulated)
    assert torch.equal(readings.labels, simulated.labels)

    channels = load({"name": "csi_npz", "file": str(tmp_path / "csi" / "room.npz")}, everything)
    simulated = load({"name": "sionna_csi", **SMALL}, OFFICIAL)
    same(channels, simulated)
    assert torch.equal(channels.labels, simulated.labels)
    (found,), (expected,) = channels.receivers, simulated.receivers
    places = lambda receiver: receiver.pose.world(receiver.array.elements.float())
    torch.testing.assert_close(places(found), places(expected), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--transmitters", 5], "must be an empty folder or none"),
        (["--spectrum", "lobes"], "invalid choice: 'lobes'"),
        (["--wavelength", 3], "unrecognized arguments: --wavelength 3"),
    ],
)
def test_the_command_refuses(tmp_path, monkeypatch, capsys, arguments, message):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SystemExit) as caught:
        command(monkeypatch, tmp_path, *arguments)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--transmitters", 1], "transmitters must be at least 2"),
        (["--room", "round"], "room must be one of"),
        (["--noise", 1], "data 'sionna' has no option 'noise'"),
        (["--task", "rssi", "--frequency", 5e9], "data 'sionna_rssi' has no option 'frequency'"),
    ],
)
def test_the_command_writes_nothing_where_an_option_is_wrong(tmp_path, monkeypatch, capsys, arguments, message):
    with pytest.raises(SystemExit):
        command(monkeypatch, tmp_path / "room", *arguments)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "room").exists()
