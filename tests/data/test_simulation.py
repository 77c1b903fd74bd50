"""Simulated rooms, built-in and traced: options out of range, seeds, and the command that writes
them.
"""

import sys

import numpy as np
import pytest
import torch
from gaigs_sionna.rooms import ROOMS

from gaigs.data import load, synthetic
from gaigs.data.__main__ import main
from gaigs.io.meshes import wavefront_obj

OFFICIAL = {"name": "official", "validation": 0}
ROOMS_OF = {"synthetic": {"order": 1}, "sionna": {"room": "slanted"}}
SPECTRA, READINGS, CHANNELS = "", "_rssi", "_csi"


def simulate(data, **options):
    return load({"name": data, "transmitters": 4, **options}, OFFICIAL)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (
            "synthetic",
            {"transmitters": 1},
            "transmitters must be at least 2, one to train and one to test on, got 1",
        ),
        ("synthetic", {"spectrum": "lobes"}, "spectrum must be 'band' or 'carrier', got 'lobes'"),
        ("synthetic", {"bandwidth": 0}, "bandwidth must be positive"),
        (
            "synthetic",
            {"frequency": []},
            r"frequency must be a carrier or several different ones \[Hz\], got \[\]",
        ),
        ("synthetic", {"frequency": [5e9, -1.0]}, "frequency must be a carrier in Hz, .* got -1$"),
        ("synthetic", {"frequency": [6e9, "5e9"]}, "frequency'.* must be a number"),
        ("synthetic", {"frequency": [5e9, 50e9]}, r"frequency must lie in 1e9\.\.40e9 Hz"),
        ("synthetic", {"order": -1}, "order must be the largest number of reflections"),
        (
            "synthetic_rssi",
            {"noise": -1.0},
            r"noise must be a standard deviation, 0 or more \[dB\], got -1",
        ),
        (
            "synthetic_rssi",
            {"sensitivity": 0.0},
            "sensitivity must let each .* 'west' hears none of 4 at 0 dBm; lower",
        ),
        ("synthetic_csi", {"subcarriers": 0}, "subcarriers must be at least 1, got 0"),
        ("synthetic_csi", {"bandwidth": 0.0}, r"bandwidth must be positive \[Hz\], got 0.0"),
        ("synthetic_csi", {"bandwidth": 14e9}, "must have positive, finite frequencies"),
        (
            "sionna",
            {"room": "round"},
            "room must be one of l_shape, slanted, furnished, got 'round'",
        ),
        ("sionna", {"transmitters": 1}, "transmitters must be at least 2"),
    ],
)
def test_options_out_of_range_are_refused(data, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        simulate(data, **options)


@pytest.mark.parametrize("labels", [SPECTRA, READINGS, CHANNELS])
def test_the_built_in_room_repeats_with_its_seed_alone(labels):
    first, again, other = (simulate(f"synthetic{labels}", seed=seed, order=1) for seed in (5, 5, 6))
    assert torch.equal(first.query.transmitters, again.query.transmitters)
    assert torch.equal(first.labels, again.labels)
    assert not torch.equal(first.query.transmitters, other.query.transmitters)
    assert not torch.equal(first.labels, other.labels)


# --- the command ---


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["data", *map(str, arguments)])
    main()


def check_same(found, expected):
    torch.testing.assert_close(found.query.transmitters, expected.query.transmitters)
    torch.testing.assert_close(
        found.receivers[0].pose.position, expected.receivers[0].pose.position
    )
    assert found.query.receivers.tolist() == expected.query.receivers.tolist()
    index = torch.arange(len(expected))
    tolerance = 0.5 / 255 + 1e-6 if expected.task.name == "spectrum" else 0
    torch.testing.assert_close(found.labels[index], expected.labels[index], rtol=0, atol=tolerance)


@pytest.mark.parametrize("room", ROOMS_OF)
def test_the_command_writes_each_label_in_its_layout(request, tmp_path, monkeypatch, capsys, room):
    if room == "sionna":
        request.getfixturevalue("tracer")
    options = ROOMS_OF[room]
    meshes = synthetic.meshes(synthetic.ROOM) if room == "synthetic" else ROOMS["slanted"].meshes()
    for labels in (SPECTRA, READINGS, CHANNELS):
        words = [f"{key}={value}" for key, value in {"transmitters": 5, **options}.items()]
        command(monkeypatch, tmp_path / f"room{labels}", f"{room}{labels}", *words)
        assert (tmp_path / f"room{labels}" / "geometry.obj").read_text() == wavefront_obj(meshes)
    assert "room: 4 training and 1 test labels" in capsys.readouterr().out
    simulated = [
        simulate(f"{room}{labels}", transmitters=5, **options)
        for labels in (SPECTRA, READINGS, CHANNELS)
    ]
    spectra = load({"name": "nerf2_spectrum", "root": str(tmp_path / "room")}, OFFICIAL)
    check_same(spectra, simulated[0])
    torch.testing.assert_close(
        spectra.receivers[0].pose.rotation, simulated[0].receivers[0].pose.rotation
    )
    assert torch.equal(spectra.split.test, simulated[0].split.test)
    everything = {"name": "random", "validation": 0}
    check_same(
        load({"name": "rssi_csv", "file": str(tmp_path / "room_rssi" / "room.csv")}, everything),
        simulated[1],
    )
    channels = load(
        {"name": "csi_npz", "file": str(tmp_path / "room_csi" / "room.npz")}, everything
    )
    check_same(channels, simulated[2])
    places = [
        each.receivers[0].pose.world(each.receivers[0].array.elements.float())
        for each in (channels, simulated[2])
    ]
    np.testing.assert_allclose(*places, atol=1e-5)


def test_random_phases_follow_from_the_seed_on_any_machine():
    known, *others = (
        load(
            {"name": "synthetic_csi", "transmitters": 4, "order": 0, "phase": phase, "seed": seed},
            OFFICIAL,
        ).labels
        for phase, seed in (("known", 0), ("per_link", 0), ("per_link", -1))
    )
    assert (others[0] / known)[:3, 0, 0].angle().tolist() == pytest.approx(
        [1.0502, 0.4209, -1.8601], abs=1e-4
    )
    assert not torch.equal(*others), "any seed that torch takes"


def test_the_command_writes_several_carriers(tmp_path, monkeypatch, capsys):
    command(
        monkeypatch,
        tmp_path / "room",
        "synthetic",
        "frequency=[5e9,3.1e9]",
        "transmitters=3",
        "order=0",
    )
    assert "4 training and 2 test labels" in capsys.readouterr().out
    assert (tmp_path / "room" / "freq.txt").read_text().split() == ["5", "3.1"] * 3


@pytest.mark.parametrize(
    ("folder", "words", "message"),
    [
        (".", ["synthetic", "transmitters=5"], "must be an empty folder or missing"),
        ("room", ["synthetic", "wavelength=3"], "data 'synthetic' has no option 'wavelength'"),
        ("room", ["nerf2_rssi"], "invalid choice: 'nerf2_rssi'"),
    ],
)
def test_the_command_refuses_and_writes_nothing(
    tmp_path, monkeypatch, capsys, folder, words, message
):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SystemExit) as caught:
        command(monkeypatch, tmp_path / folder, *words)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
