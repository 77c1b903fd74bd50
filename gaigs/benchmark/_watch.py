"""Clocks in a training step."""

import contextlib
from collections import Counter, defaultdict
from collections.abc import Iterator

import torch
from lightning.pytorch.callbacks import Callback
from torch.autograd.graph import register_multi_grad_hook

from gaigs.benchmark import clock
from gaigs.rasterizer import Rasterizer
from gaigs.rasterizer import torch as eager

EXCITATION = "placement to deformation"
"""Where the Gaussians stand, the tokens, and what a query changes."""

REST = "backward: loss to projection"

PARTS = (
    "batch and Lightning", EXCITATION, "projection", "depth sort", "tile lists", "compositing", "pooling and loss",
    REST, "backward: rasterizer", f"backward: {EXCITATION}", "optimizer step",
)  # fmt: skip
"""Of a step, in their order."""

WARM_UP = 3
"""Steps of each kind that are not counted."""


class Watch(Callback):
    """Times steps [ms]: ``parts`` by rasterizer and part, ``wholes`` by rasterizer.

    Autograd runs last what was computed first, so the way back is through with a stage when it comes to its inputs.
    """

    def __init__(self, rasterizers: dict[str, Rasterizer], device: str):
        self.now = clock(device)
        self.turns = [(name, divided) for divided in (True, False) for name in rasterizers]
        self.rasterizers, self.divided = rasterizers, False
        self.parts, self.wholes = defaultdict(lambda: defaultdict(list)), defaultdict(list)

    def lap(self, part: str) -> None:
        """Books the time since the last lap on a part of the step."""
        if self.divided:
            now = self.now()
            self.step[part] += now - self.last
            self.last = now

    def lap_back(self, part: str, *tensors: torch.Tensor | None) -> None:
        """Laps once the way back has come to any of these tensors; ``part`` is what it went through before."""
        tensors = [tensor for tensor in tensors if tensor is not None and tensor.requires_grad]
        if tensors:
            register_multi_grad_hook(tensors, lambda _: self.lap(part), mode="any")

    def rasterize(self, splats, *arguments):
        """The rasterizer whose turn it is."""
        self.lap("projection")
        outputs = self.rasterizers[self.name](splats, *arguments)
        self.lap("compositing")
        self.lap_back(REST, *outputs)
        self.lap_back("backward: rasterizer", splats.means2d, splats.factors, *arguments[:-1])
        return outputs

    def deform(self, deformation, inputs, residuals) -> None:
        """The hook behind the deformation."""
        self.lap(EXCITATION)
        self.deforms = any(part is not None and part.requires_grad for part in residuals)
        self.lap_back(REST, *residuals)

    def start_step(self, number: int) -> None:
        """Gives the next rasterizer its turn."""
        self.name, self.divided = self.turns[number % len(self.turns)]
        self.step, self.last = Counter(), self.now()

    def on_train_start(self, trainer, module) -> None:
        module.model.rasterizer = self.rasterize
        module.model.register_forward_pre_hook(lambda *_: self.lap("batch and Lightning"))
        module.model.deformation.register_forward_hook(self.deform)
        module.model.pooling.register_forward_hook(lambda *_: self.lap("pooling and loss"))
        trainer.optimizers[0].register_step_post_hook(lambda *_: self.lap("optimizer step"))
        self.start_step(0)

    def on_before_zero_grad(self, *_) -> None:
        self.lap("pooling and loss")

    def on_before_backward(self, *_) -> None:
        self.lap("batch and Lightning")

    def on_after_backward(self, trainer, module) -> None:
        self.lap(f"backward: {EXCITATION}" if self.deforms else REST)

    def on_before_optimizer_step(self, *_) -> None:
        self.lap("batch and Lightning")

    def on_train_batch_end(self, trainer, *_) -> None:
        self.lap("batch and Lightning")
        if trainer.global_step > WARM_UP * len(self.turns):
            if self.divided:
                for part, seconds in self.step.items():
                    self.parts[self.name][part].append(1e3 * seconds)
            else:
                self.wholes[self.name].append(1e3 * (self.now() - self.last))
        self.start_step(trainer.global_step)


@contextlib.contextmanager
def divided(watch: Watch) -> Iterator[None]:
    """Laps behind depth sort and tile lists, inside the rasterizers; checks and, in torch, conics go with the sort."""
    list_tiles = eager._Tiles.__init__

    def timed_list_tiles(tiles, *arguments):
        watch.lap("depth sort")
        list_tiles(tiles, *arguments)
        watch.lap("tile lists")

    with contextlib.ExitStack() as stack:
        eager._Tiles.__init__ = timed_list_tiles
        stack.callback(setattr, eager._Tiles, "__init__", list_tiles)
        if "opencl" in watch.rasterizers:
            stack.enter_context(_divided_opencl(watch))
        yield


@contextlib.contextmanager
def _divided_opencl(watch: Watch) -> Iterator[None]:
    from gaigs.rasterizer import opencl  # not where there is no driver

    sort, prepare = opencl._front_to_back, opencl._Render.__init__

    def timed_sort(depths):
        order = sort(depths)
        watch.lap("depth sort")
        return order

    def timed_prepare(render, *arguments):
        prepare(render, *arguments)
        if watch.divided:
            render.queue.finish()
        watch.lap("tile lists")

    opencl._front_to_back, opencl._Render.__init__ = timed_sort, timed_prepare
    try:
        yield
    finally:
        opencl._front_to_back, opencl._Render.__init__ = sort, prepare
