"""A search for planes, and the methods that its score needs for each kind of labels."""

from collections.abc import Callable, Iterable
from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gaigs.core import stages
from gaigs.planes.frame import RoomFrame, mean_bounces
from gaigs.splatting.placement.mirrored.reflections import tangents


@runtime_checkable
class SearchedRoom(Protocol):
    """A room in a search: planes, and further fitted quantities such as materials."""

    @property
    def planes(self) -> Float[Tensor, "w 4"]: ...


R = TypeVar("R", bound=SearchedRoom)


class Candidate(NamedTuple):
    """A possible further plane of a room."""

    plane: Float[Tensor, "4"]
    rating: float  # what it explains, as ``Score.rate`` measures it


class GridRatings(NamedTuple):
    """Ratings of a grid of planes (n, k), and a function that rates other planes (c,)."""

    ratings: Float[Tensor, "n k"]
    rate: Callable[[Float[Tensor, "c 4"]], Float[Tensor, " c"]]


class Score(Generic[R]):
    """Quality of planes for labels of one kind.

    ``PlaneSearch`` itself knows nothing of the labels. Labels of a new kind need two classes. The
    first is a NamedTuple for rooms, with ``planes`` and further fitted quantities, such as
    materials. The second is a subclass of this class. It implements the methods for the steps that
    its search uses; no method changes a room:

    * ``PlaneSearch.sweep`` needs ``move``;
    * ``PlaneSearch.extend`` needs ``error``, ``rate`` and ``add``;
    * ``PlaneSearch.prune`` needs ``error``, ``remove`` and ``refine``.

    Planes are rows (unit normal, offset [m]) in the ``RoomFrame``. A search then reads

        search = PlaneSearch(frame, score)
        room = search.sweep(start, range(len(start.planes)))
        room = search.grow(room, most, lambda room: search.extend(room, grid))
        room = search.prune(room, fewest=0)

    ``LagScore`` and ``LagSearch`` are the shortest example.
    """

    def error(self, room: R) -> float:
        """Cost of a room, which the search minimises.

        Usually this is the mean over links of the log of the unexplained fraction of a label's
        power. A penalty for each plane avoids superfluous ones.
        """
        raise NotImplementedError

    def rate(self, room: R, grid: Float[Tensor, "n k 4"]) -> GridRatings:
        """Ratings of planes by the gain of one more reflection at each, given the room.

        Ratings have any unit; 0 means no gain. The grid has thousands of planes, k offsets of each
        of n normals, so its ratings may be rough. The returned function rates a few planes near its
        maxima again.
        """
        raise NotImplementedError

    def add(self, room: R, candidate: Candidate) -> R | None:
        """The room with one more plane at its best position; None if it explains too little."""
        raise NotImplementedError

    def move(self, room: R, number: int) -> R:
        """The room with one plane at its best position nearby, given all others."""
        raise NotImplementedError

    def remove(self, room: R, number: int) -> R:
        """The room without one plane."""
        raise NotImplementedError

    def refine(self, room: R) -> R:
        """The room after gradient descent with all planes."""
        raise NotImplementedError


class PlaneSearch(Generic[R]):
    """Steps of a search for planes: candidates, growth, sweeps and pruning.

    Args:
        frame: Transmitters and receivers.
        score: Quality of planes for the labels.
        turn, shift: First steps around a maximum, of normals [rad] and of offsets [diagonals].

    Source: Hough, Method and means for recognizing complex patterns, 1962, for the candidates.
    """

    def __init__(
        self,
        frame: RoomFrame,
        score: Score[R],
        turn: float = 0.06,
        shift: float = 0.02,
    ):
        self.frame = frame
        self.score = score
        self.turn = turn
        self.shift = shift

    def propose(self, room: R, lines: Float[Tensor, "n k 4"]) -> list[Candidate]:
        """At most three candidates: the highest maxima of a grid, refined by a random search.

        Planes close to a plane of the room, or to a better candidate, are dropped.
        """
        rough = self.score.rate(room, lines)
        grid = lines.flatten(0, 1)  # (n k, 4)
        ratings = rough.ratings.flatten().clone()
        for plane in room.planes:
            ratings[self.frame.is_like(grid, plane)] = 0
        starts: list[Tensor] = []
        while len(starts) < 8 and ratings.max() > 0:
            starts.append(grid[ratings.argmax()])
            ratings[self.frame.is_like(grid, starts[-1])] = 0
        if not starts:
            return []
        planes = torch.stack(starts)
        # A random search around each maximum. Each round halves the distance of the last one.
        turn, shift = self.turn, self.shift * self.frame.diagonal
        for _ in range(4):
            noise = torch.randn(len(planes), 24, 4, generator=self.frame.generator).to(planes)
            noise[:, 0] = 0  # the plane itself
            normals = planes[:, None, :3] + turn * noise[..., :3]
            turned = functional.normalize(normals, dim=-1)
            offsets = planes[:, None, 3:] + shift * noise[..., 3:]
            near = torch.cat((turned, offsets), 2)  # (starts, 24, 4)
            near_ratings = rough.rate(near.flatten(0, 1)).view(near.shape[:2])  # (starts, 24)
            highest, best = near_ratings.max(1)
            planes = near[torch.arange(len(planes)), best]  # (starts, 4)
            turn, shift = turn / 2, shift / 2
        candidates: list[Candidate] = []
        known = [*room.planes]
        for number in highest.argsort(descending=True).tolist():
            is_known = any(self.frame.is_like(planes[number, None], plane) for plane in known)
            if len(candidates) < 3 and not is_known:
                candidates.append(Candidate(planes[number], highest[number].item()))
                known.append(planes[number])
        return candidates

    def list_extensions(self, room: R, grid: Float[Tensor, "n k 4"]) -> list[R]:
        """Larger rooms, each with one candidate that ``Score.add`` accepts."""
        larger = [self.score.add(room, candidate) for candidate in self.propose(room, grid)]
        return [trial for trial in larger if trial is not None]

    def extend(self, room: R, grid: Float[Tensor, "n k 4"]) -> R | None:
        """The room with one more plane, the candidate with the lowest error.

        None if ``Score.add`` accepts no candidate.
        """
        return min(self.list_extensions(room, grid), key=self.score.error, default=None)

    def grow(self, room: R, most: int, extend: Callable[[R], R | None]) -> R:
        """The room after repeated ``extend``, with at most ``most`` planes.

        ``extend`` returns the room with one more plane, or None to end.
        """
        for _ in stages.track(range(most - len(room.planes)), "search of planes"):
            if stages.is_up():
                break
            larger = extend(room)
            if larger is None:
                break
            room = larger
        return room

    def sweep(
        self,
        room: R,
        numbers: Iterable[int],
        title: str = "",
        move: Callable[[R, int], R] | None = None,
    ) -> R:
        """The room with planes ``numbers`` moved one after the other.

        ``move`` is a function of the room after all earlier moves and a number; None:
        ``Score.move``. ``title`` names the progress bar.
        """
        for number in stages.track(numbers, title):
            if stages.is_up():
                break
            room = (move or self.score.move)(room, number)
        return room

    def prune(self, room: R, fewest: int) -> R:
        """The room without planes whose removal lowers the error; the first ``fewest`` stay."""
        while len(room.planes) > fewest and not stages.is_up():
            numbers = range(fewest, len(room.planes))
            smaller_rooms = [self.score.remove(room, number) for number in numbers]
            best = min(smaller_rooms, key=self.score.error)
            if self.score.error(best) > self.score.error(room):
                break
            room = self.score.refine(best)
        return room


@torch.enable_grad()
def descend(
    loss: Callable[..., Tensor],
    receivers: list,
    planes: Float[Tensor, "w 4"],
    others: list[Tensor],
    steps: int,
    rate: float,
    turns: float = 0.4,
) -> list[Tensor]:
    """Planes and further arguments of a loss after gradient descent by Adam, in one list.

    Args:
        loss: Function of planes and further arguments to minimise.
        receivers: Receivers whose ``mean_bounces`` are the pivots of rotations.
        planes: Initial planes.
        others: Initial values of the further arguments.
        steps: Number of steps, whose size falls to 3 % of the first.
        rate: First step of a plane along its normal [m].
        turns: First rotation of a plane over ``rate`` [rad/m]; 0 for none.
    """
    if not len(planes):
        return [planes, *others]
    pivots = mean_bounces(receivers, planes)  # (w, 3)
    heights = planes[:, 3] - (planes[:, :3] * pivots).sum(1)  # of the planes over their pivots
    axes = torch.stack([torch.stack(tangents(normal)) for normal in planes[:, :3]])  # (w, 2, 3)
    # A shift along the normal [m], and two turns [1 / ``turns`` rad] (w, 3).
    shifts = (0 * planes[:, :3]).clone().requires_grad_()
    others = [part.clone().requires_grad_() for part in others]

    def moved() -> Float[Tensor, "w 4"]:
        """The planes after their shifts and turns."""
        # Path lengths change by about twice a shift [m], but by some metres times a turn [rad].
        turned = planes[:, :3] + turns * (shifts[:, 1:, None] * axes).sum(1)  # (w, 3)
        normals = functional.normalize(turned, dim=1)
        offsets = (normals * pivots).sum(1) + heights + shifts[:, 0]
        return torch.cat((normals, offsets[:, None]), 1)

    optimizer = torch.optim.Adam([{"params": [shifts]}, {"params": others}])
    for step in stages.track(range(steps)):
        if stages.is_up():
            break
        for group, first_rate in zip(optimizer.param_groups, (rate, 2e-2), strict=True):
            group["lr"] = first_rate * 0.03 ** (step / steps)
        optimizer.zero_grad()
        loss(moved(), *others).backward()
        optimizer.step()
    return [part.detach() for part in (moved(), *others)]
