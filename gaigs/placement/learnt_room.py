"""Planes, obstacles and paths of a room that a model has learnt, as plain numbers for figures."""

from typing import NamedTuple

from jaxtyping import Float
from numpy import ndarray


class LearntPlane(NamedTuple):
    """The part of a learnt plane that is drawn.

    Attributes:
        number: By which ``metrics.json`` calls it.
        corners: Of a convex polygon, counterclockwise as seen from outside the room [m].
        normal: Of unit length, out of the room.
        share: Of the received power, in [0, 1].
    """

    number: int
    corners: Float[ndarray, "c 3"]
    normal: Float[ndarray, "3"]
    share: float


class Matter(NamedTuple):
    """Gaussians that dim what passes through them.

    Attributes:
        centres: World frame [m].
        widths: Standard deviations along the world's axes [m].
        densities: At the centres [dB/m].
    """

    centres: Float[ndarray, "k 3"]
    widths: Float[ndarray, "k 3"]
    densities: Float[ndarray, " k"]


class LearntPath(NamedTuple):
    """One way through the room.

    Attributes:
        points: The transmitter, where it bounces, and the receiver [m].
        power_db: Over that of the strongest path [dB].
    """

    points: Float[ndarray, "p 3"]
    power_db: float


class LearntRoom(NamedTuple):
    """Planes by their share, the strongest first; matter, None where there is none; a transmitter's strongest paths."""

    planes: list[LearntPlane]
    matter: Matter | None
    paths: list[LearntPath]
