"""Rooms of any shape, simulated by the independent ray tracer Sionna RT."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.data import Links
from gaigs.data.readings import gateway
from gaigs.data.simulation import PART, SimulatedRoom, draw_places, simulate_spectra
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import MeshRoom, edges, facing
from gaigs.data.sionna.rooms import ROOMS
from gaigs.data.sionna.scenes import SceneFile, check_points
from gaigs.data.sionna.tracing import frequency_offsets, sample_paths
from gaigs.data.synthetic.image_source import respond
from gaigs.registry import register

HEIGHTS = 0.3, 2.0
"""Smallest and largest height of transmitters [m]."""


@register("data", "sionna")
def traced_room(
    room: str = "furnished",
    spectrum: str = "band",
    transmitters: int = 300,
    frequency: float | Sequence[float] = 6.4896e9,
    bandwidth: float = 499.2e6,
    seed: int = 0,
    scene: str | None = None,
    receiver: Sequence[float] | None = None,
    facing: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> Links:
    """Spectra of transmitters at random places in a room; the official split tests on the last
    fifth of them.

    Paths are traced the first time, which takes a minute, and stored. The other options are those
    of ``synthetic``.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        scene: File of one's own surfaces, as ``sionna.rt.load_scene`` loads it (Mitsuba XML); None
            for the room.
        receiver: Position of the array in the scene [m].
        facing: Point in the scene that the array faces [m]; None for the middle of all surfaces.
        heights: Lowest and highest z of transmitters in the scene [m]; None for 0.3 to 2 m above
            the lowest surface.
        diffraction: False if edges bend no waves, the default of Sionna RT itself.

    Raises:
        FileNotFoundError: There is no such scene.
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range, or the scene cannot be loaded.
    """
    receivers = None if receiver is None else [receiver]
    simulated = find_room(room, scene, "receiver", receivers, facing, heights, diffraction)
    return simulate_spectra(simulated, spectrum, transmitters, frequency, bandwidth, seed)


def find_room(
    name: str,
    scene: str | None = None,
    option: str = "receivers",
    receivers: Sequence[Sequence[float]] | None = None,
    facing: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> SimulatedRoom:
    """The traced room of a name or scene file, and receivers in the scene by the option of a name.

    Raises:
        ValueError: The name is unknown, or the scene or an option of it has a defect.
    """
    if scene is not None:
        return find_scene(scene, option, receivers, facing, heights, diffraction)
    if given := [
        key
        for key, value in ((option, receivers), ("facing", facing), ("heights", heights))
        if value
    ]:
        raise ValueError(f"data.{given[0]} is an option of data.scene; rooms have their own")
    if name not in ROOMS:
        raise ValueError(f"room must be one of {', '.join(ROOMS)}, got {name!r}")
    room = ROOMS[name]

    return SimulatedRoom(
        pose=room.pose(),
        gateways=tuple(gateway(name, position) for name, position in room.gateways.items()),
        edges=edges(room.meshes()),
        place=lambda count, seed: place(room, count, seed),
        frequency_offsets=lambda bandwidth: frequency_offsets(room.meshes(), bandwidth),
        respond=partial(respond_in_parts, room, diffraction),
    )


def find_scene(
    file: str,
    option: str,
    receivers: Sequence[Sequence[float]] | None,
    target: Sequence[float] | None,
    heights: Sequence[float] | None,
    diffraction: bool,
) -> SimulatedRoom:
    """The room of a scene file; options are those of ``find_room``."""
    positions = check_points(f"data.{option}", receivers)
    if heights is not None and not (len(heights) == 2 and heights[0] < heights[1]):
        raise ValueError(f"data.heights must be the lowest and the highest z [m], got {[*heights]}")
    room = SceneFile(
        Path(file).expanduser(), positions, None if heights is None else (heights[0], heights[1])
    )
    space = room.space
    middle = (
        (space.lower + space.upper) / 2
        if target is None
        else check_points("data.facing", [target])[0].tolist()
    )

    return SimulatedRoom(
        pose=facing(positions[0].tolist(), [*middle]),
        gateways=tuple(gateway(f"rx{k}", position) for k, position in enumerate(positions)),
        edges=room.edges(),
        place=room.place,
        frequency_offsets=lambda bandwidth: sample_paths(
            bandwidth, float(np.linalg.norm(space.upper - space.lower))
        ),
        respond=partial(respond_in_parts, room, diffraction),
    )


def respond_in_parts(
    room: MeshRoom | SceneFile,
    diffraction: bool,
    places: Tensor,
    receiver: Receiver,
    frequency: float,
    offsets: Tensor,
) -> Sequence[Tensor]:
    """``respond`` for the traced paths, ``PART`` places at a time."""
    paths = find_paths(room, receiver.pose.position, places, frequency, diffraction)
    return respond(paths, receiver, frequency, offsets).split(PART)


def place(room: MeshRoom, count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in a room [m], uniform over the free part at the transmitters' heights."""
    corners = torch.tensor([*room.floor, *room.ceiling])
    lower = torch.cat((corners.amin(0), torch.tensor(HEIGHTS[:1])))
    upper = torch.cat((corners.amax(0), torch.tensor(HEIGHTS[1:])))
    return draw_places(lower, upper, room.is_free, count, seed)
