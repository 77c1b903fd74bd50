"""Exported paths as the reader of DeepMIMO's scenarios sees them."""

from dataclasses import replace

import pytest
import torch
from gaigs_deepmimo.readers import read_channels
from scipy.constants import speed_of_light

import gaigs
from gaigs.processes import only_run


def test_a_scenario_gives_the_channels_of_the_model(tmp_path):
    """At single elements all but the rounding remains: amplitudes fall as 1 / f, which a path's
    gain does not.
    """
    links = gaigs.links("synthetic_csi", transmitters=12, bandwidth=20e6, subcarriers=5, order=0)
    door, window = (
        gaigs.Receiver(name, gaigs.Pose(torch.tensor(place), torch.eye(3)))
        for name, place in (("door", [1.0, 2.0, 2.5]), ("window", [6.0, 4.0, 1.0]))
    )
    task = type(links.task)(1, links.task.frequencies, "known")
    scene = replace(links.scene, receivers=(door, window), task=task)
    torch.manual_seed(0)
    model = gaigs.registries["model"].build(
        {"name": "mirrored", "placement": {"name": "mirrored"}}, scene=scene
    )
    model.placement.enable_phases(speed_of_light / 6.4896e9)
    with torch.no_grad():
        model.placement.receiver_phases.copy_(torch.tensor([0.7, -1.0]))
        model.placement.obstacles.log_densities.add_(2.0)
        model.pooling.strength.fill_(1.3)
    kriging = gaigs.registries["model"].build({"name": "kriging", "trend": model}, scene=scene)
    users = links.query.transmitters
    (tmp_path / "room.deepmimo").mkdir()
    with (
        pytest.raises(ValueError, match="another run is at work"),
        only_run(tmp_path / "room.deepmimo"),
    ):
        gaigs.export(kriging, tmp_path / "room.deepmimo", users)
    (folder,) = gaigs.export(kriging, tmp_path / "room.deepmimo", torch.cat((users, users[:2])))
    found = read_channels(folder, elements=[1, 1], bandwidth=20e6, subcarriers=5)
    assert len(found) == 24
    expected = model.predict(found.query) * (task.frequencies / task.frequencies.mean())
    torch.testing.assert_close(
        found.labels, expected.to(found.labels), rtol=0, atol=1e-4 * float(expected.abs().max())
    )
    with pytest.raises(FileExistsError, match="must be an empty folder"):
        gaigs.export(model, folder, users)


def test_labels_without_phases_are_no_scenario(tmp_path):
    scene = gaigs.links("synthetic_rssi", transmitters=10, order=0).scene
    rssi = gaigs.registries["model"].build("mirrored", scene=scene)
    with pytest.raises(
        ValueError, match="a scenario takes channels that are sums of mirrored paths"
    ):
        gaigs.export(rssi, tmp_path / "room.deepmimo", [[1.0, 2.0, 1.5]])
