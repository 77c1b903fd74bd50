"""Spectra of an invented room: direct path, first reflections and a share of blocked links."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import gaigs
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.task.spectrum import Spectrum

SIZE = np.array([8.0, 6.0, 3.0])
QUATERNION = np.array(
    [-0.15403, 0.87354, 0.23087, 0.39989]
)  # x, y, z, w: from a corner down into the room


@dataclass
class Room:
    """What a user's arrays hold; a fault changes one of them."""

    transmitters: np.ndarray  # (n, 3) [m]
    position: np.ndarray  # (3,) [m]
    quaternion: np.ndarray  # x, y, z, w
    spectra: np.ndarray  # (n, 30, 60), rows 3..90 degrees, columns 0..354 degrees

    def links(self, **options):
        pose = Pose.from_xyzw(self.position, self.quaternion)
        grid = Grid.degrees(range(3, 91, 3), range(0, 360, 6))
        task = Spectrum(grid.elevations, grid.azimuths)
        return gaigs.links(
            task=task,
            transmitters=self.transmitters,
            receivers=Receiver("array", pose),
            labels=self.spectra,
            **options,
        )


def room(count=100, seed=0, blocked=0.3, edge=4, noise=0.1) -> Room:
    """Spectra of an edge x edge array at half a wavelength, each scaled to 0..1."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([0.5, 0.5, 0.3], SIZE - [0.5, 0.5, 1.0], (count, 3))
    position = np.array([0.2, 0.2, 2.5])
    local = Rotation.from_quat(QUATERNION)
    offsets = (np.arange(edge) - (edge - 1) / 2) / 2  # wavelengths
    elements = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    el, az = np.deg2rad(np.meshgrid(range(3, 91, 3), range(0, 360, 6), indexing="ij"))
    level = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az)], -1).reshape(-1, 2)
    steering = np.exp(-2j * np.pi * level @ elements.T)  # (pixels, e)
    spectra = []
    for place in places:
        images = [place]
        for axis in range(3):
            for wall in (0.0, SIZE[axis]):
                image = place.copy()
                image[axis] = 2 * wall - image[axis]
                images.append(image)
        gains = np.array([0.0 if rng.random() < blocked else 1.0] + [0.5] * 6)
        ways = np.array(images) - position
        lengths = np.linalg.norm(ways, axis=1)
        towards = local.inv().apply(ways / lengths[:, None])[:, :2]
        phases = np.exp(2j * np.pi * rng.random(7))
        fields = (gains / lengths * phases) @ np.exp(2j * np.pi * towards @ elements.T)
        fields = fields + noise * np.abs(fields).mean() * rng.normal(size=(2, len(fields))).T @ [
            1,
            1j,
        ]
        power = np.abs(steering @ fields).reshape(30, 60)
        spectra.append((power - power.min()) / np.ptp(power))
    return Room(places, position, QUATERNION.copy(), np.array(spectra, np.float32))
