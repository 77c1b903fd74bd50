"""Channels of an invented room: free space, wall images and noise."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

import gaigs
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.task.csi import Csi

SIZE = np.array([9.0, 6.0, 3.0])
CARRIER = 3.5e9
WAVELENGTH = speed_of_light / CARRIER


@dataclass
class Room:
    """What a user's arrays hold; a fault changes one of them."""

    tx: np.ndarray  # (n, 3) [m]
    rx: np.ndarray  # (k, 3) [m]
    elements: np.ndarray  # (e, 3) [m]
    quaternions: np.ndarray  # (k, 4), x, y, z, w
    frequencies: np.ndarray  # (s,) [Hz]
    h: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (n, k, e, s)

    def lengths(self):
        """Lengths of the direct path and of those by four walls (paths, n, k, e) [m], with their
        reflections.
        """
        turn = Rotation.from_quat(self.quaternions).as_matrix()
        places = self.rx[:, None] + np.einsum("kwa,ea->kew", turn, self.elements)
        images = [self.tx]
        for axis in (0, 1):
            for wall in (0.0, SIZE[axis]):
                image = self.tx.copy()
                image[:, axis] = 2 * wall - image[:, axis]
                images.append(image)
        return np.linalg.norm(np.stack(images)[:, :, None, None] - places, axis=-1)

    def links(self, phase="known", **options):
        array = Array(torch.tensor(self.elements))
        poses = [Pose.from_xyzw(*parts) for parts in zip(self.rx, self.quaternions, strict=True)]
        receivers = [Receiver(f"rx{k}", pose, array) for k, pose in enumerate(poses)]
        task = Csi(len(array), self.frequencies, phase)
        return gaigs.links(
            task=task, transmitters=self.tx, receivers=receivers, labels=self.h.copy(), **options
        )


def room(
    elements=4,
    subcarriers=16,
    receivers=1,
    count=110,
    seed=0,
    reflection=-0.6,
    noise=0.05,
    turned=False,
) -> Room:
    """A random room; elements stand half a wavelength apart, sixteen of them in a square."""
    rng = np.random.default_rng(seed)
    tx = rng.uniform([0.5, 0.5, 0.8], SIZE - [0.5, 0.5, 0.8], (count, 3))
    rx = np.array([[0.3, 0.4, 2.5], [8.6, 1.0, 2.2], [4.0, 5.7, 2.7]])[:receivers]
    rows = math.isqrt(elements) if elements == 16 else 1
    z, y = np.divmod(np.arange(elements), elements // rows)
    places = np.stack((0 * y, y - y.mean(), z - z.mean()), 1) * WAVELENGTH / 2
    quaternions = np.tile([0.0, 0, 0, 1], (receivers, 1))
    if turned:
        quaternions = Rotation.random(receivers, random_state=seed).as_quat()
    offsets = (np.arange(subcarriers) - subcarriers // 2) * (80e6 / subcarriers)
    own = Room(tx, rx, places, quaternions, CARRIER + offsets)
    own.h = channels(own, reflection)
    parts = rng.normal(size=(2, *own.h.shape))
    own.h += noise * np.sqrt(np.mean(np.abs(own.h) ** 2)) * (parts[0] + 1j * parts[1])
    return own


def channels(own: Room, reflection=-0.6, has_carrier=True):
    """Sums of the paths, (n, k, e, s); without the carrier only delays turn phases."""
    lengths = own.lengths()
    gains = np.full(len(lengths), reflection + 0j)
    gains[1:] *= np.exp(0.4j * np.arange(4))  # walls of several materials
    gains[0] = 1
    frequencies = own.frequencies - (0 if has_carrier else CARRIER)
    waves = np.exp(-2j * np.pi / speed_of_light * frequencies * lengths[..., None])
    return 0.01 * np.einsum("p,pnke,pnkes->nkes", gains, 1 / lengths, waves)
