"""Forward and backward passes of rasterizers, and times that are taken in turns."""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping

import torch
from torch import Tensor

from gaigs.benchmark._scenes import ApertureScene, Scene, with_leaves
from gaigs.registry import registry

BRIEF, LONG, FEWEST = 0.5, 10.0, 3
"""What takes less than ``BRIEF`` [s] is repeated as often as asked for; all else for ``LONG`` [s], but ``FEWEST`` times
at the least."""


class Passes:
    """One rasterizer on one scene, of any device and precision."""

    def __init__(self, rasterizer, scene: Scene):
        self.rasterizer, self.scene = rasterizer, with_leaves(scene)
        self.outputs: tuple[Tensor, ...] = ()

    def forward(self) -> None:
        """Draws the map and the transmittance, or sums the fields."""
        if isinstance(self.scene, ApertureScene):
            self.outputs = (self.rasterizer.fields(*self.scene),)
        else:
            self.outputs = self.rasterizer(*self.scene)

    def backward(self, pixels: Tensor | None = None) -> None:
        """Differentiates a sum of the last outputs, of fields that of their real and imaginary parts.

        Args:
            pixels: (b, rows, columns) weights of a map's; None: all 1.
        """
        for leaf in self.scene.leaves():
            leaf.grad = None
        ones = [torch.ones_like(output) for output in self.outputs]
        if isinstance(self.scene, ApertureScene):
            ones = [one * (1 + 1j) for one in ones]
        elif pixels is not None:
            ones = [ones[0] * pixels[:, None], pixels.to(ones[1])]
        torch.autograd.backward(self.outputs, ones)

    def result(self) -> Tensor:
        """Map and transmittance in one (b, c + 1, rows, columns), or fields (b, e)."""
        if isinstance(self.scene, ApertureScene):
            return self.outputs[0][..., 0].detach()
        image, left = self.outputs
        return torch.cat((image, left[:, None]), 1).detach()

    def gradients(self) -> list[Tensor]:
        """Of the last backward pass, by each leaf of the scene."""
        return [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in self.scene.leaves()]


CAUSES = (TypeError, ValueError, RuntimeError, ImportError)
"""What says that a rasterizer does not do a scene."""


def start(name: str, scene: Scene) -> Passes:
    """A rasterizer that has done its first passes on a scene.

    Raises:
        TypeError, ValueError, RuntimeError, ImportError: It does not do that.
    """
    rasterizer = registry("rasterizer").build({"name": name})
    draws = getattr(rasterizer, "draws_map", True)
    if draws == isinstance(scene, ApertureScene):
        told = "draws maps, and sums nothing in an aperture" if draws else "draws no map; see the scene aperture"
        raise ValueError(f"{name} {told}")
    run = Passes(rasterizer, scene)
    run.forward()
    run.backward()
    return run


def compositor(run: Passes) -> Callable[[], object]:
    """Of a run of ``opencl`` the forward pass without sorting and listing, which are done here."""
    from gaigs.rasterizer import opencl  # not where there is no driver

    with torch.no_grad():
        splats, *others = run.scene
        render = opencl._Render(opencl.open_queue(run.rasterizer.device), splats, *others)
    return lambda: render.forward(differentiate=True)


Times = dict[str, list[float]]
"""Seconds, or whatever a turn gives, by part."""


def in_turns(turns: Mapping[Hashable, Callable[[], Mapping[str, float]]], repeats: int) -> dict[Hashable, Times]:
    """Does each thing once to warm up, and then all of them in turns, so that other work slows all alike.

    Args:
        turns: By name; a call does the thing once, and gives the seconds of its parts.
        repeats: Of what takes less than ``BRIEF``.
    """
    counts = {}
    for name, turn in turns.items():
        turn()
        slowest = max(turn().values())
        counts[name] = repeats if slowest < BRIEF else min(repeats, max(FEWEST, math.ceil(LONG / slowest)))
    found = {name: defaultdict(list) for name in turns}
    rounds = max(counts.values(), default=0)
    for number in range(rounds):
        for name, turn in turns.items():
            # So many of the rounds, evenly spread.
            if (number + 1) * counts[name] // rounds > number * counts[name] // rounds:
                for part, seconds in turn().items():
                    found[name][part].append(seconds)
    return found
