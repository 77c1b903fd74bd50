"""Errors of mirrored channels that are written as a scenario of DeepMIMO and read back: python
benchmarks/scenario.py

The model has the faces of the built-in room, 40 random obstacles and no training. Seed 0.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from common import words
from scipy.constants import speed_of_light

import gaigs
from gaigs.core.task.csi import Csi
from gaigs.data import synthetic
from gaigs.model.mirrored import MirroredSplatting

sys.path.append(str(Path(__file__).parents[1] / "plugins/deepmimo"))  # the plug-in
from gaigs_deepmimo.readers import read_channels
from gaigs_deepmimo.scenarios import UPRIGHT

CARRIER, SUBCARRIERS, SIZE = 6.4896e9, 9, (7.0, 5.0, 3.0)


def main() -> None:
    print(
        "| receiver | band [MHz] | NMSE [dB] | with amplitudes as 1 / frequency [dB] "
        "|\n|---|---|---|---|"
    )
    for rows, columns, bandwidth in ((1, 1, 20e6), (1, 1, 499.2e6), (4, 4, 20e6), (1, 8, 20e6)):
        links = gaigs.links(
            "synthetic_csi", transmitters=60, bandwidth=bandwidth, subcarriers=SUBCARRIERS, order=0
        )
        array = gaigs.Array.planar(rows, columns, speed_of_light / CARRIER / 2)
        pose = gaigs.Pose(synthetic.POSE.position, torch.tensor(UPRIGHT))
        task = Csi(len(array), links.task.frequencies, "known")
        model = room(
            replace(links.scene, receivers=(gaigs.Receiver("array", pose, array),), task=task)
        )
        with tempfile.TemporaryDirectory() as folder:
            gaigs.export(model, Path(folder) / "room.deepmimo", links.query.transmitters)
            found = read_channels(
                Path(folder) / "room.deepmimo", [rows, columns], bandwidth, SUBCARRIERS
            )
        expected = model.predict(found.query)
        falling = found.labels * (CARRIER / task.frequencies).to(found.labels)
        errors = [nmse(labels, expected) for labels in (found.labels, falling)]
        print(f"| {rows} x {columns} | {bandwidth / 1e6:g} | {errors[0]:.1f} | {errors[1]:.1f} |")


def room(scene: gaigs.Scene) -> MirroredSplatting:
    """Mirrored Gaussians at the faces of the built-in room, with obstacles of some decibels."""
    torch.manual_seed(0)
    model = MirroredSplatting(scene, {"name": "mirrored", "obstacles": 40})
    placement = model.placement
    placement.enable_phases(speed_of_light / CARRIER)
    for axis, normal in enumerate(torch.eye(3)):
        far = torch.cat((normal, torch.tensor([SIZE[axis]])))  # normal . x = SIZE
        near = torch.cat((-normal, torch.zeros(1)))  # -normal . x = 0
        placement.place(axis, far)
        placement.place(axis + 3, near)
    with torch.no_grad():
        placement.obstacles.log_densities.add_(2.0)
    return model


def nmse(labels: torch.Tensor, expected: torch.Tensor) -> float:
    """Median over the links of the error's power over the channel's [dB]."""
    powers = [part.abs().square().sum((1, 2)) for part in (labels - expected, expected)]
    return 10 * (powers[0] / powers[1]).median().log10().item()


if __name__ == "__main__":
    words(__doc__)
    main()
