"""Times the parts of a training step, and in the same run the whole of it.

    python benchmarks/training_step.py +experiment=spectrum
    python benchmarks/training_step.py +experiment=spectrum rasterizer=opencl --repeats 100

Overrides are those of ``python -m gaigs``; without one for the rasterizer, opencl and torch take turns. The training is
that of a run, but without density control, validation, logs and checkpoints. Every other step is divided: at the end of
each part the clock is read, so parts leave nothing out. The steps between are not; they show what the reading costs.
Times are medians; judge them by their ratios within one run, as other work on the machine slows all of them.
"""

import argparse
import logging
import statistics
import time
import warnings
from collections import Counter, defaultdict

import lightning
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.callbacks import Callback
from omegaconf import OmegaConf
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch.autograd.graph import register_multi_grad_hook

from gaigs import configuration
from gaigs.data import load
from gaigs.evaluation import device_name, device_of
from gaigs.experiment import count_gaussians
from gaigs.rasterizer import Rasterizer, opencl
from gaigs.rasterizer import torch as eager
from gaigs.registry import call, registry
from gaigs.training.batches import Batches

EXCITATION = "placement to deformation"
"""Where the Gaussians stand, the tokens, and what a query changes."""

REST = "backward: loss to projection"

WARM_UP = 3
"""Steps of each kind that are not counted."""


class Watch(Callback):
    """Times steps [ms]: ``parts`` by rasterizer and part, ``wholes`` by rasterizer.

    Autograd runs last what was computed first, so the way back is through with a stage when it comes to its inputs.
    """

    def __init__(self, rasterizers: dict[str, Rasterizer]):
        self.turns = [(name, divided) for divided in (True, False) for name in rasterizers]
        self.rasterizers, self.divided = rasterizers, False
        self.parts, self.wholes = defaultdict(lambda: defaultdict(list)), defaultdict(list)

    def lap(self, part: str) -> None:
        """Books the time since the last lap on a part of the step."""
        if self.divided:
            now = _now()
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
        self.step, self.last = Counter(), _now()

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
                self.wholes[self.name].append(1e3 * (_now() - self.last))
        self.start_step(trainer.global_step)


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def divide_rasterizers(watch: Watch) -> None:
    """Laps behind depth sort and tile lists, inside the rasterizers; checks and, in torch, conics go with the sort."""
    sort, prepare, list_tiles = opencl._front_to_back, opencl._Render.__init__, eager._Tiles.__init__

    def timed_sort(depths):
        order = sort(depths)
        watch.lap("depth sort")
        return order

    def timed_prepare(render, *arguments):
        prepare(render, *arguments)
        if watch.divided:
            render.queue.finish()
        watch.lap("tile lists")

    def timed_list_tiles(tiles, *arguments):
        watch.lap("depth sort")
        list_tiles(tiles, *arguments)
        watch.lap("tile lists")

    opencl._front_to_back, opencl._Render.__init__ = timed_sort, timed_prepare
    eager._Tiles.__init__ = timed_list_tiles


def train(config: dict, watch: Watch, steps: int) -> str:
    """Trains under watch.

    Returns:
        What was trained on what.
    """
    lightning.seed_everything(config["seed"], verbose=False)
    links = load(config["data"], config["split"])
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    context = {"model": model, "loss": registry("loss").build(config["loss"], task=links.task)}
    module = registry("training").build(config["training"], **context, identity={}, seed=config["seed"])
    options = config["trainer"] | {"max_steps": steps, "enable_progress_bar": False}
    context = {"callbacks": [watch], "logger": False, "enable_checkpointing": False}
    trainer = call("trainer", lightning.Trainer, options, **context)
    batches = Batches(links, links.split.train, module.batch_size, config["seed"], steps)
    with warnings.catch_warnings():
        for message in (".*LeafSpec", "You defined a `validation_step` but have no `val_dataloader`"):
            warnings.filterwarnings("ignore", message)
        trainer.fit(module, batches)
    return f"{module.batch_size} places a step, {count_gaussians(model)} Gaussians; {device_name(device_of(model))}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--repeats", type=int, default=30, help="steps of each rasterizer, divided and not")
    options = parser.parse_intermixed_args()
    if options.repeats < 1:
        parser.error(f"--repeats must be at least 1, got {options.repeats}")
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    configuration.install()
    chosen = any(override.startswith("rasterizer=") for override in options.overrides)
    rasterizers = {}
    for added in [[]] if chosen else [["rasterizer=opencl"], ["rasterizer=torch"]]:
        with initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
            config = compose("config", options.overrides + added)
        config = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        if "rasterizer" not in config["model"]:
            parser.error(f"the model must have a rasterizer, got model={config['model']['name']}")
        rasterizers[config["rasterizer"]["name"]] = registry("rasterizer").build(config["rasterizer"])
    watch = Watch(rasterizers)
    divide_rasterizers(watch)
    what = train(config, watch, (WARM_UP + options.repeats) * len(watch.turns))

    table = Table("part of a step", title=what, box=SIMPLE_HEAD)
    rows = defaultdict(list)
    for name, parts in watch.parts.items():
        table.add_column(escape(f"{name} [ms]"), justify="right")
        table.add_column("share", justify="right")
        medians = {part: statistics.median(times) for part, times in parts.items()}
        medians["sum of the parts"] = sum(medians.values())
        medians["whole step, undivided"] = whole = statistics.median(watch.wholes[name])
        for part, milliseconds in medians.items():
            rows[part] += [f"{milliseconds:.2f}", f"{milliseconds / whole:.0%}"]
    for part, cells in rows.items():
        table.add_row(part, *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
