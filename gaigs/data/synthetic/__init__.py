"""The built-in scene: a furnished room, simulated by the image-source method."""

import itertools
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.data import Links, Parts
from gaigs.data.nerf2_spectrum import NORMALISATION
from gaigs.data.synthetic.image_source import Box, Room, frequency_offsets, is_free, respond
from gaigs.directions import Grid
from gaigs.geometry import Pose
from gaigs.propagation import bartlett, min_max
from gaigs.query import Query, check_carrier
from gaigs.registry import check_type, register
from gaigs.scene import Array, Receiver
from gaigs.task.spectrum import Spectrum

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
"""Of the receiver: high in the corner at the origin, facing down into the room, and turned about its normal."""

SIDE = 4
"""Elements along each side of its square array, as in the NeRF² spectra."""

REGION = (0.3, 0.3, 0.3), (6.7, 4.7, 2.0)
"""Corners of the box in which transmitters stand [m]."""


@register("data", "synthetic")
def furnished_room(
    spectrum: str = "band",
    transmitters: int = 500,
    frequency: float | Sequence[float] = 6.4896e9,
    bandwidth: float = 499.2e6,
    order: int = 2,
    seed: int = 0,
) -> Links:
    """Spectra of transmitters at random places in the default room; the official split tests on the last fifth of them.

    Each place sends at each carrier, and these links share a row.

    Args:
        spectrum: ``band`` or ``carrier``, see ``spectra``.
        transmitters: How many places.
        frequency: Of the carrier, or of several [Hz]. The array is that of the highest, see ``patch_array``.
        bandwidth: Of the band around each carrier [Hz].
        order: Largest number of reflections of a path.
        seed: Of the transmitters' places.

    Raises:
        TypeError: A frequency is no number.
        ValueError: An option is out of range.

    Source: the defaults for frequency and bandwidth are those of channel 5 of IEEE 802.15.4 (ultra-wideband).
    """
    carriers = list(frequency) if isinstance(frequency, list | tuple) else [frequency]
    for carrier in carriers:
        check_type("frequency", carrier, float)
        check_carrier("frequency", carrier)
    if not carriers or len(set(carriers)) < len(carriers):
        raise ValueError(f"frequency must be a carrier or several different ones [Hz], got {frequency}")
    positions = place(transmitters, seed)
    receiver = patch_array(max(carriers))
    grid = Grid.degrees()
    labels = [spectra(ROOM, positions, receiver, grid, spectrum, carrier, bandwidth, order) for carrier in carriers]
    rows = torch.arange(transmitters).repeat_interleave(len(carriers))
    frequencies = torch.tensor(carriers, dtype=torch.float32).repeat(transmitters)
    return Links(
        query=Query(positions[rows], torch.zeros_like(rows), frequencies),
        receivers=(receiver,),
        labels=torch.stack(labels, 1).flatten(0, 1),
        task=Spectrum(grid.elevations, grid.azimuths, NORMALISATION),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        bandwidth=bandwidth if spectrum == "band" else 0.0,
        edges=edges(ROOM),
    )


def patch_array(frequency: float) -> Receiver:
    """The default room's receiver: a square array of patches, half a wavelength of the frequency [Hz] apart.

    Raises:
        ValueError: The frequency is out of range.
    """
    check_carrier("frequency", frequency)
    return Receiver("gateway1", POSE, Array.planar(SIDE, SIDE, speed_of_light / frequency / 2, "cosine"))


def last_fifth(transmitters: int, rows: Int[Tensor, "n"]) -> Parts:
    """The official parts of links from so many transmitters, given that of each: the last fifth of them tests."""
    training = transmitters - max(1, round(transmitters / 5))
    return (rows < training).nonzero()[:, 0], (rows >= training).nonzero()[:, 0]


def place(count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in the default room [m], uniform over what the furniture leaves free of ``REGION``.

    Raises:
        ValueError: There are fewer than 2.
    """
    if count < 2:
        raise ValueError(f"transmitters must be at least 2, one to train and one to test on, got {count}")
    lower, upper = torch.tensor(REGION)
    generator = torch.Generator().manual_seed(seed)
    positions = torch.zeros(0, 3)
    while len(positions) < count:
        tries = lower + (upper - lower) * torch.rand(count, 3, generator=generator)
        positions = torch.cat((positions, tries[is_free(ROOM, tries)]))
    return positions[:count]


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
    """Labels of transmitters in any room, float32 in [0, 1].

    Args:
        room: Walls and furniture.
        transmitters: Positions [m].
        receiver: Pose and array.
        grid: Directions of the pixels.
        spectrum: ``band``: power averaged over the band, as a channel sounder reports it; paths whose lengths differ by
            more than speed of light / bandwidth do not interfere, so lobes follow the room's geometry. ``carrier``: one
            frequency, with all of the small-scale fading.
        frequency: Of the carrier [Hz].
        bandwidth: Of the band around the carrier [Hz].
        order: Largest number of reflections of a path.

    Raises:
        ValueError: An option is out of range, or a transmitter does not stand free in the room.
    """
    if spectrum not in ("band", "carrier"):
        raise ValueError(f"spectrum must be 'band' or 'carrier', got {spectrum!r}")
    offsets = frequency_offsets(room, bandwidth, order) if spectrum == "band" else torch.zeros(1)
    # In parts, because the float64 spectra of all transmitters would need several times the memory of the labels.
    return torch.cat(
        [
            min_max(
                bartlett(respond(room, part, receiver, frequency, offsets, order), grid, receiver.array, frequency)
            ).float()
            for part in transmitters.split(64)
        ]
    )


def edges(room: Room) -> Float[Tensor, "k 2 3"]:
    """Edges of the room and its furniture [m], 12 of each cuboid."""
    corners = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))
    pairs = torch.combinations(torch.arange(8))
    pairs = pairs[(corners[pairs[:, 0]] - corners[pairs[:, 1]]).abs().sum(-1) == 1]
    lower = torch.tensor([(0.0, 0.0, 0.0), *(box.lower for box in room.furniture)])
    upper = torch.tensor([room.size, *(box.upper for box in room.furniture)])
    return (lower[:, None] + (upper - lower)[:, None] * corners)[:, pairs].flatten(0, 1)


def wavefront_obj(room: Room) -> str:
    """The room as a Wavefront OBJ file [m]: one object a cuboid, with each wall's material."""
    lines = []
    cuboids = [("room", (0.0, 0.0, 0.0), room.size, room.walls)]
    cuboids += [(box.name, box.lower, box.upper, (f"loss_{box.loss_db:g}_db",) * 6) for box in room.furniture]
    for number, (name, lower, upper, materials) in enumerate(cuboids):
        lines.append(f"o {name}")
        corners = itertools.product(*zip(lower, upper, strict=True))
        lines += [f"v {x:g} {y:g} {z:g}" for x, y, z in corners]
        for face, material in zip(FACES, materials, strict=True):
            lines += [f"usemtl {material}", "f " + " ".join(str(8 * number + corner) for corner in face)]
    return "\n".join(lines) + "\n"


FACES = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
"""Corners of a cuboid's faces, counted as OBJ files count them, in the order of ``Room.walls``; seen from outside they
run counterclockwise."""
