"""The coordinate frame of a search: its origin is the middle of the transmitters and receivers."""

from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.splatting.placement.mirrored.reflections import reflection_points, seen_from


class RoomFrame:
    """Coordinates of a search, with the origin in the middle of the transmitters and receivers.

    Near the origin single precision suffices, and a rotated plane moves little. A plane is a row
    (unit normal, offset along it [m]).

    Args:
        points: Transmitters and receivers in the world frame (n, 3) [m].

    Attributes:
        middle: Origin of the frame in the world frame (3,) [m].
        points: Transmitters and receivers in the frame (n, 3) [m].
        diagonal: Diagonal of the box of all points [m].
    """

    def __init__(self, points: Float[Tensor, "n 3"]):
        lower = points.amin(0)
        upper = points.amax(0)
        self.middle = (lower + upper) / 2
        self.diagonal = float((upper - lower).norm())
        self.points = points - self.middle

    @cached_property
    def generator(self) -> torch.Generator:
        """Random numbers of the search, seeded at the first use from the training's generator."""
        return torch.Generator().manual_seed(int(torch.randint(2**31, ())))

    def from_world(self, planes: Float[Tensor, "*w 4"]) -> Float[Tensor, "*w 4"]:
        """Planes converted from the world frame to this frame, float64."""
        return seen_from(planes.double(), self.middle)

    def to_world(self, planes: Float[Tensor, "*w 4"]) -> Float[Tensor, "*w 4"]:
        """Planes converted from this frame to the world frame."""
        return seen_from(planes, -self.middle)

    def describe(self, plane: Float[Tensor, "4"]) -> str:
        """A plane in the world frame, as text for the log."""
        *normal, offset = self.to_world(plane).tolist()
        return "plane ({:.2f}, {:.2f}, {:.2f}) at {:.2f} m".format(*normal, offset)

    def grid(
        self, normals: Float[Tensor, "n 3"], count: int, margin: float
    ) -> Float[Tensor, "n k 4"]:
        """Planes at ``count`` evenly spaced offsets along each normal.

        The offsets cover all points and a ``margin`` [diagonals] on both sides.
        """
        along = self.points @ normals.mT  # (points, n)
        beyond = margin * self.diagonal
        low = along.amin(0) - beyond
        high = along.amax(0) + beyond
        steps = torch.linspace(0, 1, count).to(low)
        offsets = low[:, None] + (high - low)[:, None] * steps  # (n, k)
        normals = normals[:, None].expand(-1, count, -1)  # (n, k, 3)
        return torch.cat((normals, offsets[..., None]), 2)

    def is_like(
        self, planes: Float[Tensor, "k 4"], plane: Float[Tensor, "4"]
    ) -> Bool[Tensor, " k"]:
        """True for planes close to ``plane``: within 16 degrees, and 3 % of the diagonal."""
        cosines = planes[:, :3] @ plane[:3]
        gaps = (planes[:, 3] * cosines.sign() - plane[3]).abs()
        return (cosines.abs() > 0.96) & (gaps < 0.03 * self.diagonal)


def mean_bounces(receivers: list, planes: Float[Tensor, "w 4"]) -> Float[Tensor, "w 3"]:
    """Mean reflection point of each plane over the links of all receivers [m].

    A rotation of the plane about this point changes path lengths least. ``receivers`` are
    ``ReceiverChannels`` or ``ReceiverLags``.
    """
    points = []
    for receiver in receivers:
        ends = receiver.position.expand_as(receiver.places)
        points.append(reflection_points(receiver.places, ends, planes))
    return torch.cat(points).mean(0)
