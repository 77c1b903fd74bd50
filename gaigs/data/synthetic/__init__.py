"""The built-in scene: a furnished room, simulated by the image-source method."""

import itertools
from collections.abc import Iterator, Sequence
from functools import partial

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.data import Links
from gaigs.data.readings import gateway
from gaigs.data.simulation import (
    PLACES_AT_A_TIME,
    SimulatedRoom,
    draw_places,
    simulate_spectra,
    spectrum_offsets,
    to_spectra,
    wall_poses,
)
from gaigs.data.synthetic.image_source import Box, Room, frequency_offsets, is_free, respond, trace
from gaigs.io.meshes import Mesh
from gaigs.registry import register

ROOM = Room(
    size=(7.0, 5.0, 3.0),
    walls=("concrete", "glass", "concrete", "brick", "concrete", "concrete"),
    furniture=(
        Box("partition", (2.6, 0.0, 0.0), (2.7, 1.9, 2.0), loss_db=20),
        Box("wardrobe", (3.6, 4.4, 0.0), (5.4, 5.0, 2.2), loss_db=18),
        Box("bookshelf", (4.6, 1.6, 0.0), (5.0, 3.2, 1.9), loss_db=15),
        Box("desk", (0.9, 3.6, 0.68), (2.3, 4.4, 0.74), loss_db=6),
        Box("sofa", (5.2, 0.2, 0.0), (6.8, 1.1, 0.8), loss_db=8),
        Box("refrigerator", (6.3, 3.6, 0.0), (7.0, 4.3, 1.8), loss_db=40),
        Box("column", (2.9, 2.9, 0.0), (3.3, 3.3, 3.0), loss_db=35),
    ),
)
"""The default room; its corner is the world's origin, z points up."""

POSE = Pose.from_xyzw((0.2, 0.2, 2.5), (-0.15403, 0.87354, 0.23087, 0.39989))
"""Pose of the array: high in the corner at the origin, facing down, turned about its normal."""

GATEWAYS = {
    "west": (0.1, 2.6, 2.4),
    "south": (1.7, 0.1, 1.2),  # the partition stands between it and most of the room
    "east": (6.9, 1.4, 1.6),
    "north": (2.4, 4.9, 2.0),
}
"""Positions by the wall that the gateway hangs on, world frame [m]."""

REGION = (0.3, 0.3, 0.3), (6.7, 4.7, 2.0)
"""Corners of the box in which transmitters stand [m]."""


@register("data", "synthetic", task="spectrum", split="official")
def furnished_room(
    spectrum: str = "band",
    transmitters: int = 500,
    frequency: float | Sequence[float] = 6.4896e9,
    bandwidth: float = 499.2e6,
    order: int = 2,
    seed: int = 0,
    receivers: int | None = None,
) -> Links:
    """Spectra of transmitters at random places in the default room.

    The official split tests on the last fifth of the places. Each place sends at each carrier, and
    these links share a row.

    Args:
        spectrum: ``band``: power averaged over the band, as a channel sounder reports it; paths
            whose lengths differ by more than speed of light / bandwidth do not interfere.
            ``carrier``: one frequency, with small-scale fading.
        transmitters: Number of places.
        frequency: One carrier or several [Hz]. The elements are half a wavelength of the highest
            apart.
        bandwidth: Width of the band around each carrier [Hz].
        order: Largest number of reflections of a path.
        seed: Seed of the places.
        receivers: Arrays on the walls, see ``gaigs.data.simulation.wall_poses``; None: one in a
            corner.

    Raises:
        TypeError: A frequency is no number.
        ValueError: An option is out of range.

    Source: frequency and bandwidth are by default channel 5 of IEEE 802.15.4
    (ultra-wideband).
    """
    room = default_room(order, receivers)
    return simulate_spectra(room, spectrum, transmitters, frequency, bandwidth, seed)


def default_room(order: int, receivers: int | None = None) -> SimulatedRoom:
    """The default room, with paths of at most ``order`` reflections.

    Args:
        receivers: Number of receivers along the walls; None: the array and gateways of the room.
    """
    poses: tuple[Pose, ...] = (POSE,)
    gateways = [gateway(name, position) for name, position in GATEWAYS.items()]
    if receivers is not None:
        size = torch.tensor(ROOM.size[:2], dtype=torch.float64)
        corners = size * torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
        poses = wall_poses(lambda height: corners, partial(is_free, ROOM), receivers)
        gateways = [gateway(f"gateway{k}", pose.position) for k, pose in enumerate(poses, 1)]
    return SimulatedRoom(
        poses=poses,
        gateways=tuple(gateways),
        edges=edges(ROOM),
        place=place,
        frequency_offsets=lambda bandwidth: frequency_offsets(ROOM, bandwidth, order),
        respond=partial(respond_in_parts, ROOM, order=order),
    )


def respond_in_parts(
    room: Room,
    transmitters: Float[Tensor, "n 3"],
    receiver: Receiver,
    frequency: float,
    offsets: Float[Tensor, " f"],
    order: int,
) -> Iterator[Complex[Tensor, "part elements f"]]:
    """Responses of a receiver's elements, ``PLACES_AT_A_TIME`` transmitters at a time.

    Args:
        frequency: Carrier [Hz].
        offsets: Frequencies relative to the carrier [Hz].
        order: Largest number of reflections of a path.
    """
    for part in transmitters.split(PLACES_AT_A_TIME):
        paths = trace(room, part, receiver.pose.position, frequency, order)
        yield respond(paths, receiver, frequency, offsets)


def place(count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in the default room [m], uniform over the free part of ``REGION``."""
    lower, upper = torch.tensor(REGION)
    return draw_places(lower, upper, lambda points: is_free(ROOM, points), count, seed)


def spectra(
    room: Room,
    transmitters: Float[Tensor, "n 3"],
    receiver: Receiver,
    grid: Grid,
    spectrum: str,
    frequency: float,
    bandwidth: float,
    order: int,
) -> Float[Tensor, "n rows columns"]:
    """Spectra of transmitters [m] in any room, float32 in [0, 1].

    ``furnished_room`` describes the options.

    Raises:
        ValueError: An option is out of range, or a transmitter does not stand free in the room.
    """
    offsets = spectrum_offsets(
        spectrum, lambda width: frequency_offsets(room, width, order), bandwidth
    )
    responses = respond_in_parts(room, transmitters, receiver, frequency, offsets, order)
    return to_spectra(responses, grid, receiver.array, frequency)


def edges(room: Room) -> Float[Tensor, "k 2 3"]:
    """Edges of the room and its furniture as line segments [m], 12 for each cuboid."""
    corners = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))  # of the unit cube
    pairs = torch.combinations(torch.arange(8))
    # An edge joins corners that differ along a single axis.
    differing_axes = (corners[pairs[:, 0]] - corners[pairs[:, 1]]).abs().sum(-1)
    pairs = pairs[differing_axes == 1]  # (12, 2)
    lower = torch.tensor([(0.0, 0.0, 0.0), *(box.lower for box in room.furniture)])
    upper = torch.tensor([room.size, *(box.upper for box in room.furniture)])
    points = lower[:, None] + (upper - lower)[:, None] * corners  # (cuboids, 8, 3)
    return points[:, pairs].flatten(0, 1)


def meshes(room: Room) -> list[Mesh]:
    """The room and its furniture: a mesh for each material of a cuboid."""
    # Corners of the faces in the order of ``Room.walls``, counterclockwise as seen from outside.
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    # Name, opposite corners, and material of each face.
    cuboids = [("room", (0.0, 0.0, 0.0), room.size, room.walls)]
    for box in room.furniture:
        material = f"loss_{box.loss_db:g}_db"
        cuboids.append((box.name, box.lower, box.upper, (material,) * 6))
    parts = []
    for name, lower, upper, materials in cuboids:
        corners = tuple(itertools.product(*zip(lower, upper, strict=True)))
        faces: dict[str, list[tuple[int, ...]]] = {}
        for side, material in zip(sides, materials, strict=True):
            faces.setdefault(material, []).append(side)
        for material, of_material in faces.items():
            parts.append(Mesh(name, material, corners, tuple(of_material)).compact())
    return parts
