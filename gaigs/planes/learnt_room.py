"""Planes, obstacles and paths of a learnt room, for figures."""

from typing import NamedTuple

from jaxtyping import Float
from numpy import ndarray


class LearntPlane(NamedTuple):
    """The drawn part of a learnt plane: its number in ``metrics.json``, its share of the received
    power.

    ``corners`` are a convex polygon, counterclockwise as seen from outside the room [m]; the unit
    normal points out.
    """

    number: int
    corners: Float[ndarray, "c 3"]
    normal: Float[ndarray, "3"]
    share: float


class Matter(NamedTuple):
    """Obstacles: centres [m], standard deviations along the world's axes [m], densities at the
    centres [dB/m].
    """

    centres: Float[ndarray, "k 3"]
    widths: Float[ndarray, "k 3"]
    densities: Float[ndarray, " k"]


class LearntPath(NamedTuple):
    """Transmitter, bounces and receiver of a path [m], and its power relative to the strongest path
    [dB].
    """

    points: Float[ndarray, "p 3"]
    power_db: float


class LearntRoom(NamedTuple):
    """Planes, strongest first; matter, None without obstacles; a transmitter's strongest paths."""

    planes: list[LearntPlane]
    matter: Matter | None
    paths: list[LearntPath]
