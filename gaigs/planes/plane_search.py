"""What searches for planes in all kinds of labels share: a Hough transform over normals and
offsets.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from gaigs.core.stages import is_up, track
from gaigs.splatting.placement.mirrored.reflections import reflection_points, seen_from, tangents


class PlaneSearch:
    """Planes of a room about its middle: there single precision suffices, and a plane that turns
    stays near.

    Args:
        points: Transmitters and receivers (n, 3) [m].

    Attributes:
        receivers: Each with its ``position`` and the ``places`` of its transmitters, about the
            middle [m].
        middle: Of the points (3,) [m].
        points: The same about the middle.
        diagonal: Of their box [m].

    Source: Hough, Method and means for recognizing complex patterns, 1962.
    """

    receivers: list[Any]

    def __init__(self, points: Float[Tensor, "n 3"]):
        lower, upper = points.amin(0), points.amax(0)
        self.middle, self.diagonal = (lower + upper) / 2, float((upper - lower).norm())
        self.points = points - self.middle

    @cached_property
    def generator(self) -> torch.Generator:
        """Made when it is first used: a search that draws nothing leaves the training's random
        numbers alone.
        """
        return torch.Generator().manual_seed(int(torch.randint(2**31, ())))

    def words(self, plane: Float[Tensor, "4"]) -> str:
        """A plane in the world's frame, for the log."""
        *normal, offset = seen_from(plane, -self.middle).tolist()
        return "plane ({:.2f}, {:.2f}, {:.2f}) at {:.2f} m".format(*normal, offset)

    def grid(
        self, normals: Float[Tensor, "n 3"], count: int, margin: float
    ) -> Float[Tensor, "n k 4"]:
        """Planes at ``count`` offsets of each normal, up to a margin [diagonals] beyond all points."""
        along, beyond = self.points @ normals.mT, margin * self.diagonal
        low, high = along.amin(0) - beyond, along.amax(0) + beyond
        offsets = low[:, None] + (high - low)[:, None] * torch.linspace(0, 1, count).to(low)
        return torch.cat((normals[:, None].expand(-1, count, -1), offsets[..., None]), 2)

    def alike(self, planes: Float[Tensor, "k 4"], plane: Float[Tensor, "4"]) -> Bool[Tensor, " k"]:
        """True for planes within 16 degrees and three hundredths of the room of one."""
        cosines = planes[:, :3] @ plane[:3]
        return (cosines.abs() > 0.96) & (
            (planes[:, 3] * cosines.sign() - plane[3]).abs() < 0.03 * self.diagonal
        )

    def best(
        self,
        grid: Float[Tensor, "k 4"],
        scores: Float[Tensor, " k"],
        score: Callable[[Float[Tensor, "c 4"]], Float[Tensor, " c"]],
        known: Float[Tensor, "w 4"],
    ) -> list[tuple[Float[Tensor, "4"], float]]:
        """At most three planes apart from known ones, with their scores: the highest maxima of a
        grid, sharpened.
        """
        scores = scores.clone()
        for plane in known:
            scores[self.alike(grid, plane)] = 0
        starts: list[Tensor] = []
        while len(starts) < 8 and scores.max() > 0:
            starts.append(grid[scores.argmax()])
            scores[self.alike(grid, starts[-1])] = 0
        if not starts:
            return []
        tried, turn, shift = torch.stack(starts), 0.06, 0.02 * self.diagonal
        for _ in range(4):
            noise = torch.randn(len(tried), 24, 4, generator=self.generator).to(tried)
            noise[:, 0] = 0
            turned = functional.normalize(tried[:, None, :3] + turn * noise[..., :3], dim=-1)
            near = torch.cat((turned, tried[:, None, 3:] + shift * noise[..., 3:]), 2)
            highest, at = score(near.flatten(0, 1)).view(near.shape[:2]).max(1)
            tried = near[torch.arange(len(tried)), at]
            turn, shift = turn / 2, shift / 2
        found: list[tuple[Tensor, float]] = []
        for number in highest.argsort(descending=True).tolist():
            others = [*known, *(plane for plane, _ in found)]
            if len(found) < 3 and not any(
                self.alike(tried[number, None], plane) for plane in others
            ):
                found.append((tried[number], highest[number].item()))
        return found

    def pivots(self, planes: Float[Tensor, "w 4"]) -> Float[Tensor, "w 3"]:
        """Mean point at which each plane reflects [m]: turned about it, a plane changes the lengths
        least.
        """
        ends = [(part.places, part.position.expand_as(part.places)) for part in self.receivers]
        return torch.cat([reflection_points(*pair, planes) for pair in ends]).mean(0)

    @torch.enable_grad()
    def descend(
        self,
        loss: Callable[..., Tensor],
        planes: Float[Tensor, "w 4"],
        others: list[Tensor],
        steps: int,
        rate: float,
    ) -> list[Tensor]:
        """Adam on planes, which turn about their pivots, and on other parameters of a loss;
        ``rate`` in [m] a step.
        """
        if not len(planes):
            return [planes, *others]
        pivots = self.pivots(planes)
        heights = planes[:, 3] - (planes[:, :3] * pivots).sum(1)
        axes = torch.stack([torch.stack(tangents(normal)) for normal in planes[:, :3]])
        shifts, *others = (part.clone().requires_grad_() for part in (0 * planes[:, :3], *others))

        def now() -> Float[Tensor, "w 4"]:
            # Lengths change by about twice a shift [m], and by some metres times a turn [rad].
            normals = functional.normalize(
                planes[:, :3] + 0.4 * (shifts[:, 1:, None] * axes).sum(1), dim=1
            )
            return torch.cat(
                (normals, ((normals * pivots).sum(1) + heights + shifts[:, 0])[:, None]), 1
            )

        optimizer = torch.optim.Adam([{"params": [shifts]}, {"params": others}])
        for step in track(range(steps)):
            if is_up():
                break
            for group, highest in zip(optimizer.param_groups, (rate, 2e-2), strict=True):
                group["lr"] = highest * 0.03 ** (step / steps)
            optimizer.zero_grad()
            loss(now(), *others).backward()
            optimizer.step()
        return [part.detach() for part in (now(), *others)]
