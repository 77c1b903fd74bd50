"""The time of a training step and of its parts.

    python benchmarks/step.py
    python benchmarks/step.py rasterizer=torch --repeats 50

Overrides are those of a run. The training has no density control, validation, logs or checkpoints.
Parts follow each other without gaps.
"""

import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import lightning
import torch
from common import Benchmark, Row, command_line, grouped, median_and_spread, now, positive, table
from lightning.pytorch.callbacks import Callback
from torch.autograd.graph import register_multi_grad_hook

from gaigs.data import load
from gaigs.registry import registry
from gaigs.runs.descent import make_trainer
from gaigs.runs.fitting import count_gaussians
from gaigs.training.batches import Batches
from gaigs.training.budget import make_budget

EXCITATION = "placement to deformation"
REST = "backward: loss to projection"
PARTS = (
    "batch and Lightning", EXCITATION, "projection", "rasterizer", "pooling and loss", REST, "backward: rasterizer",
    f"backward: {EXCITATION}", "optimizer step", "whole step",
)  # fmt: skip
"""Parts of a step in their order; the whole step is measured undivided."""

INTRODUCTION = """# A training step

Every other step is divided; the last line shows the undivided steps. A spread is the range of the middle half.
"""


class Step(Benchmark):
    """Trains the configuration of the command line, and divides every other step into its parts."""

    name = "step"
    keys = ("device", "overrides", "part")
    values = ("ms", "spread_ms", "share", "repeats", "rasterizer", "gaussians", "places")

    def cells(self, device: str) -> Iterator[list[Row]]:
        overrides = " ".join(self.options.overrides)
        yield [{"overrides": overrides, "part": part} for part in PARTS]

    def measure(self, cell: Sequence[Row], device: str) -> Iterator[dict]:
        times, sizes = train(self.config, self.options.repeats, device)
        whole, _ = median_and_spread(times["whole step"])
        for row in cell:
            seconds = times[row["part"]] or [0.0]
            median, spread = (1e3 * value for value in median_and_spread(seconds))
            share = median / (1e3 * whole)
            yield (
                row
                | sizes
                | {"ms": median, "spread_ms": spread, "share": share, "repeats": len(seconds)}
            )

    def tables(self, rows: Sequence[Row]) -> str:
        parts = [INTRODUCTION]
        for (overrides, device), own in grouped(rows, "overrides", "device").items():
            command = f"python benchmarks/step.py {overrides}".rstrip()
            about = (
                "{rasterizer}, {gaussians} Gaussians, {places} places a step, medians of {repeats} "
                "steps"
            )
            columns = {"part": "part", "ms": "ms", "spread": "spread_ms", "share": "share"}
            parts.append(
                f"```\n{command}\n```\n\n{device}; "
                f"{about.format(**own[0])}:\n\n{table(own, columns)}"
            )
        return "\n".join(parts)


class Watch(Callback):
    """Times of steps [s] by part.

    Autograd differentiates in the reverse order of computation: a stage's backward pass is over
    when the gradients of its inputs are there.
    """

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = defaultdict(list)
        self.step: dict[str, float] = Counter()
        self.divided, self.last = False, 0.0

    def lap(self, part: str) -> None:
        """Adds the time since the last lap to a part of the step."""
        if self.divided:
            time = now()
            self.step[part] += time - self.last
            self.last = time

    def lap_back(self, part: str, *tensors: torch.Tensor | None) -> None:
        """Laps when the backward pass first reaches one of these tensors; ``part`` lies behind
        them.
        """
        tensors = [tensor for tensor in tensors if tensor is not None and tensor.requires_grad]
        if tensors:
            register_multi_grad_hook(tensors, lambda _: self.lap(part), mode="any")

    def on_train_start(self, trainer, module) -> None:
        model = module.model
        rasterizer = model.rasterizer

        def rasterize(splats, *arguments):
            self.lap("projection")
            outputs = rasterizer(splats, *arguments)
            self.lap("rasterizer")
            self.lap_back(REST, *outputs)
            self.lap_back("backward: rasterizer", splats.means2d, splats.factors, *arguments[:-1])
            return outputs

        def deformed(deformation, inputs, residuals) -> None:
            self.lap(EXCITATION)
            self.deforms = any(part is not None and part.requires_grad for part in residuals)
            self.lap_back(REST, *residuals)

        model.rasterizer = rasterize
        model.register_forward_pre_hook(lambda *_: self.lap("batch and Lightning"))
        model.deformation.register_forward_hook(deformed)
        model.pooling.register_forward_hook(lambda *_: self.lap("pooling and loss"))
        trainer.optimizers[0].register_step_post_hook(lambda *_: self.lap("optimizer step"))
        self.step, self.last = Counter(), now()

    def on_before_zero_grad(self, *_) -> None:
        self.lap("pooling and loss")

    def on_before_backward(self, *_) -> None:
        self.lap("batch and Lightning")

    def on_after_backward(self, *_) -> None:
        self.lap(f"backward: {EXCITATION}" if self.deforms else REST)

    def on_before_optimizer_step(self, *_) -> None:
        self.lap("batch and Lightning")

    def on_train_batch_end(self, trainer, *_) -> None:
        self.lap("batch and Lightning")
        if trainer.global_step > 6:  # for warm-up
            if not self.divided:
                self.step["whole step"] = now() - self.last
            for part, seconds in self.step.items():
                self.times[part].append(seconds)
        self.divided = not self.divided
        self.step, self.last = Counter(), now()


def train(config: dict, repeats: int, device: str) -> tuple[dict[str, list[float]], dict]:
    """Seconds of each step by part; and the rasterizer, the number of Gaussians and that of places
    a step.
    """
    if not config["model"].get("rasterizer") or "deformation" not in config["model"]:
        raise ValueError(
            "a step needs a model with a deformation and a rasterizer, got "
            f"model={config['model']['name']}; "
            "take model=gaigs, or for mirrored Gaussians add rasterizer=fastest projection=mercator"
        )
    lightning.seed_everything(config["seed"], verbose=False)
    links = load(config["data"], config["split"], config["task"]["name"])
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    parts = {"model": model, "loss": registry("loss").build(config["loss"], task=links.task)}
    module = registry("training").build(
        config["training"], **parts, identity={}, seed=config["seed"]
    )
    watch, steps = Watch(), 6 + 2 * repeats
    options = config["trainer"] | {
        "max_steps": steps,
        "max_time": None,
        "enable_progress_bar": False,
    }
    options |= {"accelerator": "gpu" if device == "cuda" else "cpu", "enable_checkpointing": False}
    trainer = make_trainer(make_budget(options)[0], callbacks=[watch], logger=False)
    rasterizer = model.rasterizer
    with warnings.catch_warnings():
        for message in (
            ".*LeafSpec",
            "You defined a `validation_step` but have no `val_dataloader`",
        ):
            warnings.filterwarnings("ignore", message)
        trainer.fit(
            module, Batches(links, links.split.train, module.batch_size, config["seed"], steps)
        )
    sizes = {"gaussians": count_gaussians(model), "places": module.batch_size}
    return watch.times, sizes | {"rasterizer": rasterizer.used}


def main(words: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    text = "divided steps, and as many undivided ones"
    parser.add_argument("--repeats", type=positive, default=30, help=text)
    Step(parser.parse_intermixed_args(words)).run()


if __name__ == "__main__":
    main()
