"""The rooms that are simulated: an L, one with a leaning wall, one full of furniture."""

from .meshes import Cuboid, MeshRoom


def _table(name: str, x: float, y: float, length: float, width: float) -> tuple[Cuboid, ...]:
    """A wooden table about (x, y) with a leg at each corner [m]."""
    half = length / 2, width / 2
    legs = [
        (f"{name}, leg {k}", x + side * (half[0] - 0.06), y + end * (half[1] - 0.06))
        for k, (side, end) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1)), 1)
    ]
    return (
        Cuboid(name, "wood", (x - half[0], y - half[1], 0.7), (x + half[0], y + half[1], 0.74)),
        *(
            Cuboid(leg, "wood", (u - 0.03, v - 0.03, 0.0), (u + 0.03, v + 0.03, 0.69))
            for leg, u, v in legs
        ),
    )


def _stool(name: str, x: float, y: float, turn: float) -> tuple[Cuboid, ...]:
    """A stool about (x, y) on a metal foot [m], turned [deg]."""
    return (
        Cuboid(
            f"{name}, seat", "wood", (x - 0.22, y - 0.22, 0.43), (x + 0.22, y + 0.22, 0.47), turn
        ),
        Cuboid(
            f"{name}, foot", "metal", (x - 0.04, y - 0.04, 0.0), (x + 0.04, y + 0.04, 0.42), turn
        ),
    )


def _shelves(
    name: str, lower: tuple[float, float], upper: tuple[float, float], heights: tuple[float, ...]
) -> tuple:
    """An open bookcase: boards between two sides at its ends along y [m]."""
    (x0, y0), (x1, y1) = lower, upper
    parts = [
        Cuboid(f"{name}, board {k}", "wood", (x0, y0 + 0.03, z - 0.03), (x1, y1 - 0.03, z))
        for k, z in enumerate(heights, 1)
    ]
    parts += [
        Cuboid(f"{name}, side {k}", "wood", (x0, y, 0.0), (x1, y + 0.025, heights[-1]))
        for k, y in enumerate((y0, y1 - 0.025), 1)
    ]
    return tuple(parts)


L_SHAPE = MeshRoom(
    floor=((0, 0), (8, 0), (8, 3.4), (3.8, 3.4), (3.8, 6.6), (0, 6.6)),
    ceiling=((0, 0), (8, 0), (8, 3.4), (3.8, 3.4), (3.8, 6.6), (0, 6.6)),
    height=2.8,
    convex=((0, 1, 2, 3), (0, 3, 4, 5)),
    walls=("concrete", "glass", "brick", "brick", "plasterboard", "concrete"),
    slabs=("concrete", "concrete"),
    furniture=(
        Cuboid("cupboard", "wood", (4.6, 0.05, 0.0), (6.2, 0.6, 2.1)),
        Cuboid("locker", "metal", (0.05, 4.6, 0.0), (0.5, 5.6, 1.8)),
        Cuboid("desk", "wood", (1.6, 1.9, 0.68), (3.0, 2.6, 0.74), 25.0),
        Cuboid("sofa", "wood", (2.7, 4.4, 0.0), (3.6, 6.0, 0.75)),
    ),
    antenna=((7.75, 3.15, 2.5), (2.4, 2.0, 0.4), 30.0),
    gateways={
        "east": (7.9, 0.9, 2.2),
        "south": (3.0, 0.1, 1.4),
        "corner": (3.7, 6.2, 2.3),
        "west": (0.1, 2.6, 1.8),
    },
)
"""An L of 8 x 6.6 m: waves from one arm arrive around the corner alone."""

SLANTED = MeshRoom(
    floor=((0, 0), (6.8, 0), (6.0, 5.2), (0, 5.2)),
    ceiling=((0, 0), (5.2, 0), (4.4, 5.2), (0, 5.2)),
    height=2.9,
    convex=((0, 1, 2, 3),),
    walls=("brick", "wood", "plasterboard", "concrete"),
    slabs=("wood", "plasterboard"),
    furniture=(
        Cuboid("bed", "wood", (3.6, 3.3, 0.25), (5.4, 4.7, 0.55), -8.75),
        Cuboid("wardrobe", "wood", (1.2, 4.55, 0.0), (2.8, 5.15, 2.0)),
        Cuboid("desk", "wood", (3.2, 0.4, 0.68), (4.8, 1.1, 0.74)),
        Cuboid("stove", "metal", (0.3, 2.3, 0.0), (0.8, 2.8, 1.1), 20.0),
        Cuboid("screen", "glass", (2.9, 2.0, 0.0), (2.96, 3.2, 1.7), -30.0),
    ),
    antenna=((0.25, 0.25, 2.6), (4.3, 3.2, 0.5), -50.0),
    gateways={
        "west": (0.1, 4.2, 2.3),
        "south": (2.4, 0.1, 1.5),
        "north": (3.6, 5.1, 2.2),
        "slope": (5.3, 1.4, 1.9),
    },
)
"""A room under a roof of 6.8 x 5.2 m: its east wall leans inwards by 29 degrees and is oblique in
plan by 9.
"""

FURNISHED = MeshRoom(
    floor=((0, 0), (7.6, 0), (7.6, 5.6), (0, 5.6)),
    ceiling=((0, 0), (7.6, 0), (7.6, 5.6), (0, 5.6)),
    height=2.7,
    convex=((0, 1, 2, 3),),
    walls=("concrete", "glass", "brick", "plasterboard"),
    slabs=("concrete", "concrete"),
    furniture=(
        Cuboid("partition", "plasterboard", (3.0, 3.7, 0.0), (3.1, 5.59, 2.69)),
        Cuboid("refrigerator", "metal", (0.02, 0.02, 0.0), (0.65, 0.65, 1.8)),
        Cuboid("counter", "wood", (0.7, 0.02, 0.0), (2.6, 0.62, 0.9)),
        Cuboid("oven", "metal", (2.62, 0.02, 0.0), (3.2, 0.62, 0.9)),
        Cuboid("wall cupboard", "wood", (0.7, 0.02, 1.45), (2.6, 0.37, 2.1)),
        Cuboid("wardrobe", "wood", (0.02, 3.9, 0.0), (0.62, 5.5, 2.2)),
        Cuboid("bed", "wood", (1.1, 3.9, 0.2), (2.6, 5.55, 0.5)),
        Cuboid("sofa, seat", "wood", (5.0, 4.6, 0.1), (7.0, 5.4, 0.42)),
        Cuboid("sofa, back", "wood", (5.0, 5.41, 0.1), (7.0, 5.57, 0.85)),
        Cuboid("low table", "glass", (5.5, 3.6, 0.38), (6.5, 4.1, 0.4), 12.0),
        Cuboid("television", "metal", (3.12, 4.3, 0.9), (3.16, 5.3, 1.5)),
        Cuboid("column", "concrete", (3.9, 2.5, 0.0), (4.25, 2.85, 2.69)),
        Cuboid("radiator", "metal", (7.45, 1.0, 0.12), (7.55, 2.4, 0.7)),
        Cuboid("blackboard", "metal", (4.4, 0.02, 0.9), (6.2, 0.05, 1.9)),
        Cuboid("cabinet", "metal", (6.2, 2.6, 0.0), (6.7, 3.1, 1.3), 40.0),
        *_shelves("bookcase", (4.55, 3.3), (4.85, 5.5), (0.08, 0.45, 0.82, 1.19, 1.56, 1.9)),
        *_table("dining table", 1.9, 2.3, 1.6, 0.9),
        *_table("desk", 5.9, 1.2, 1.5, 0.8),
        *_stool("stool 1", 1.5, 1.5, 10.0),
        *_stool("stool 2", 2.4, 1.55, -15.0),
        *_stool("stool 3", 1.4, 3.1, 30.0),
        *_stool("stool 4", 2.35, 3.15, 5.0),
        *_stool("stool 5", 5.8, 2.0, -35.0),
    ),
    antenna=((7.35, 0.3, 2.45), (2.2, 3.3, 0.4), 70.0),
    gateways={
        "west": (0.1, 2.2, 2.2),
        "south": (3.6, 0.1, 1.6),
        "east": (7.5, 3.6, 2.4),
        "north": (3.7, 5.5, 2.0),
    },
)
"""A flat of one room, 7.6 x 5.6 m, with 22 pieces of furniture that block many paths."""

ROOMS = {"l_shape": L_SHAPE, "slanted": SLANTED, "furnished": FURNISHED}
