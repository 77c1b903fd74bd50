"""Traced rooms and scenes as ``gaigs.data.simulation`` takes them."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.data.readings import gateway
from gaigs.data.simulation import PLACES_AT_A_TIME, SimulatedRoom, draw_places, wall_poses
from gaigs.data.synthetic.image_source import respond

from .cache import find_paths
from .meshes import MeshRoom, edges, facing
from .rooms import ROOMS
from .scenes import SceneFile, check_points
from .tracing import frequency_offsets, sample_paths

HEIGHTS = (0.3, 2.0)
"""Smallest and largest height of transmitters [m]."""


def find_room(
    name: str,
    scene: str | None = None,
    option: str = "receivers",
    receivers: int | Sequence[Sequence[float]] | None = None,
    facing: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> SimulatedRoom:
    """The traced room of a name or scene file.

    Args:
        option: Name of the option that has the receivers in a scene, for errors.
        receivers: Positions in a scene [m]; of a room the number along its walls, None for its own.

    Raises:
        ValueError: The name is unknown, or the scene or an option of it has a defect.
    """
    if scene is not None:
        return _find_scene(scene, option, receivers, facing, heights, diffraction)
    is_number = isinstance(receivers, int)
    positions = None if is_number else receivers
    for key, value in ((option, positions), ("facing", facing), ("heights", heights)):
        if value:
            raise ValueError(
                f"data.{key} is an option of data.scene; rooms have their own, "
                "or a number of data.receivers"
            )
    if name not in ROOMS:
        raise ValueError(f"room must be one of {', '.join(ROOMS)}, got {name!r}")
    room = ROOMS[name]
    poses: tuple[Pose, ...] = (room.pose(),)
    gateways = [gateway(name, position) for name, position in room.gateways.items()]
    if is_number:
        poses = wall_poses(room.outline, lambda points: ~room.is_furnished(points), receivers)
        gateways = [gateway(f"gateway{k}", pose.position) for k, pose in enumerate(poses, 1)]

    return SimulatedRoom(
        poses=poses,
        gateways=tuple(gateways),
        edges=edges(room.meshes()),
        place=lambda count, seed: place(room, count, seed),
        frequency_offsets=lambda bandwidth: frequency_offsets(room.meshes(), bandwidth),
        respond=partial(_respond_in_parts, room, diffraction),
    )


def _find_scene(
    file: str,
    option: str,
    receivers: int | Sequence[Sequence[float]] | None,
    target: Sequence[float] | None,
    heights: Sequence[float] | None,
    diffraction: bool,
) -> SimulatedRoom:
    """The room of a scene file; for the options see ``find_room``."""
    positions = check_points(f"data.{option}", receivers)
    if heights is not None and not (len(heights) == 2 and heights[0] < heights[1]):
        raise ValueError(f"data.heights must be the lowest and the highest z [m], got {[*heights]}")
    levels = None if heights is None else (heights[0], heights[1])
    room = SceneFile(Path(file).expanduser(), positions, levels)
    space = room.space
    if target is None:
        faced = ((space.lower + space.upper) / 2).tolist()
    else:
        faced = check_points("data.facing", [target])[0].tolist()
    diagonal = float(np.linalg.norm(space.upper - space.lower))

    return SimulatedRoom(
        poses=tuple(facing(position, faced) for position in positions.tolist()),
        gateways=tuple(gateway(f"rx{k}", position) for k, position in enumerate(positions)),
        edges=room.edges(),
        place=room.place,
        frequency_offsets=lambda bandwidth: sample_paths(bandwidth, diagonal),
        respond=partial(_respond_in_parts, room, diffraction),
    )


def _respond_in_parts(
    room: MeshRoom | SceneFile,
    diffraction: bool,
    places: Tensor,
    receiver: Receiver,
    frequency: float,
    offsets: Tensor,
) -> Sequence[Tensor]:
    """``respond`` for the traced paths, ``PLACES_AT_A_TIME`` places at a time."""
    paths = find_paths(room, receiver.pose.position, places, frequency, diffraction)
    return respond(paths, receiver, frequency, offsets).split(PLACES_AT_A_TIME)


def place(room: MeshRoom, count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in a room [m], uniform over the free part at the transmitters' heights."""
    corners = torch.tensor([*room.floor, *room.ceiling])
    lower = torch.cat((corners.amin(0), torch.tensor(HEIGHTS[:1])))
    upper = torch.cat((corners.amax(0), torch.tensor(HEIGHTS[1:])))
    return draw_places(lower, upper, room.is_free, count, seed)
