"""A training step: the time of its parts, and of the whole of it, with each rasterizer."""

import statistics
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence

import lightning
import torch
from lightning.pytorch.callbacks import Timer

from gaigs.benchmark import MEASURED, UNAVAILABLE, Context, Glance, Measured, Row, check_names, device_of, named
from gaigs.benchmark._page import load_now, load_of, number, remarks, table
from gaigs.benchmark._passes import CAUSES, start
from gaigs.benchmark._scenes import cast, common
from gaigs.benchmark._watch import PARTS, WARM_UP, Watch, divided
from gaigs.data import load
from gaigs.registry import call, register, registry
from gaigs.runs.training import check_trainer, count_gaussians
from gaigs.training.batches import Batches
from gaigs.training.budget import make_budget

WHOLE = "whole step"
"""The part that is not divided."""


@register("benchmark", "step")
class StepBenchmark(Measured):
    """Trains what the command line says, and divides every other step into its parts.

    It is the training of a run without density control, validation, logs and checkpoints; the rasterizers take turns in
    it. At the end of each part the clock is read, so that parts leave nothing out. The steps between are not divided;
    they show what the reading costs.

    Args:
        rasterizers: Names; each draws maps.
        repeats: Steps of each rasterizer, divided and not.
        minutes, device: As of every benchmark.

    Raises:
        ValueError: An option is out of range, or names what there is not.
    """

    name = "step"
    keys = ("device", "rasterizer", "overrides", "part")
    values = ("ms", "spread_ms", "share", "repeats", "gaussians", "places", "load")

    def __init__(
        self, rasterizers: list[str], repeats: int = 30, minutes: float | None = None, device: str | None = None
    ):
        super().__init__(minutes, device)
        check_names("rasterizers", rasterizers, registry("rasterizer").names())
        if repeats < 1:
            raise ValueError(f"benchmark.repeats must be at least 1, got {repeats}")
        self.rasterizers, self.repeats = rasterizers, repeats

    def cells(self, context: Context) -> Iterator[list[Row]]:
        overrides = " ".join(context.overrides)
        for device in context.devices:
            own = {"device": named(device), "overrides": overrides}
            yield [own | {"rasterizer": name, "part": part} for name in self.rasterizers for part in (*PARTS, WHOLE)]

    def measure(self, cell: Sequence[Row], context: Context) -> Iterator[Row]:
        device = device_of(cell[0], context)
        config = context.compose()
        rasterizers, causes = {}, {}
        for name in dict.fromkeys(row["rasterizer"] for row in cell):
            try:
                rasterizers[name] = start(name, cast(common(8, 8, 8), device, torch.float32)).rasterizer
            except CAUSES as error:
                causes[name] = " ".join(str(error).split())
        watch = Watch(rasterizers, device)
        sizes = train(config, watch, self.repeats, device) if rasterizers else {}
        for row in cell:
            name, part = row["rasterizer"], row["part"]
            if name in causes:
                yield row | {"status": UNAVAILABLE + causes[name]}
                continue
            whole = statistics.median(watch.wholes[name])
            times = watch.wholes[name] if part == WHOLE else watch.parts[name].get(part, [0.0])
            low, _, high = statistics.quantiles(times, n=4) if len(times) > 1 else times * 3
            median = statistics.median(times)
            figures = {
                "ms": median,
                "spread_ms": high - low,
                "share": median / whole,
                "repeats": len(times),
                "load": load_now(),
            }
            yield row | figures | sizes

    def tables(self, rows: Sequence[Row]) -> str:
        parts = [f"## A training step\n\n{ABOUT}\n"]
        for overrides in dict.fromkeys(row["overrides"] for row in rows):
            own = [row for row in rows if row["overrides"] == overrides]
            done = [row for row in own if row["status"] == MEASURED]
            command = " ".join(filter(None, ("python -m gaigs command=benchmark benchmark=step", overrides)))
            parts.append(f"```\n{command}\n```\n")
            for device in dict.fromkeys(row["device"] for row in done):
                here = [row for row in done if row["device"] == device]
                columns = defaultdict(dict)
                for row in here:
                    columns[row["rasterizer"]][row["part"]] = row
                lines = []
                for part in (*PARTS, WHOLE):
                    cells = (column[part] for column in columns.values())
                    lines.append([part, *(text for cell in cells for text in _cells(cell))])
                head = ["part", *(text for name in columns for text in (f"`{name}` [ms]", "spread", "share"))]
                size = f"{here[0]['places']} places a step, {here[0]['gaussians']} Gaussians"
                size += f"; load of the machine {load_of(here)}; medians of"
                parts.append(f"{device}; {size} {here[0]['repeats']} steps:\n\n{table(head, lines)}")
        return "\n".join(parts) + remarks(rows, ("rasterizer",))

    def highlights(self, rows: Sequence[Row]) -> list[Glance]:
        wholes = defaultdict(dict)
        for row in rows:
            if row["part"] == WHOLE and row["status"] == MEASURED:
                wholes[row["device"], row["overrides"]][row["rasterizer"]] = row
        found = []
        for (device, overrides), own in wholes.items():
            slow, fast = (pick(own.values(), key=lambda row: float(row["ms"])) for pick in (max, min))
            if len(own) > 1:
                times = float(slow["ms"]) / float(fast["ms"])
                choice = f"`rasterizer={fast['rasterizer']}` for `{slow['rasterizer']}`"
                where = f"a training step, {overrides or 'GAI-GS on the built-in room'}"
                told = f"{number(fast['ms'])} ms, {times:.1f} times as fast"
                found.append(Glance(choice, where, told, "see the rasterizers", device))
        return found


ABOUT = """Every other step is divided into its parts, and the rasterizers take turns in one training; the last line is
of the steps between, which are not divided. A spread is the range of the middle half. Overrides are those of a run, so
any configuration can be looked at."""


def _cells(row: Row) -> tuple[str, str, str]:
    return number(row["ms"]), number(row["spread_ms"]), f"{float(row['share']):.0%}"


def train(config: dict, watch: Watch, repeats: int, device: str) -> dict[str, int]:
    """Trains under watch.

    Returns:
        How many Gaussians there were, and places a step.

    Raises:
        ValueError: The model has no rasterizer that draws maps.
    """
    rasterizer = config["model"].get("rasterizer")
    draws = rasterizer and getattr(registry("rasterizer").get(rasterizer["name"]), "draws_map", True)
    if not draws or "deformation" not in config["model"]:
        own = f" with rasterizer={rasterizer['name']}" if rasterizer else ""
        raise ValueError(
            f"benchmark=step needs a model with a deformation and a rasterizer that draws maps, got "
            f"model={config['model']['name']}{own}; take model=gaigs, or for mirrored Gaussians add "
            "rasterizer=fastest projection=mercator"
        )
    lightning.seed_everything(config["seed"], verbose=False)
    links = load(config["data"], config["split"], config["task"]["name"])
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    context = {"model": model, "loss": registry("loss").build(config["loss"], task=links.task)}
    module = registry("training").build(config["training"], **context, identity={}, seed=config["seed"])
    steps = (WARM_UP + repeats) * len(watch.turns)
    options = config["trainer"] | {"max_steps": steps, "max_time": None, "enable_progress_bar": False}
    options["accelerator"] = "gpu" if device == "cuda" else "cpu"
    context = {"callbacks": [watch], "logger": False, "enable_checkpointing": False}
    trainer = call("trainer", lightning.Trainer, make_budget(options, Timer())[0], **context)
    check_trainer(trainer)
    batches = Batches(links, links.split.train, module.batch_size, config["seed"], steps)
    with warnings.catch_warnings(), divided(watch):
        for message in (".*LeafSpec", "You defined a `validation_step` but have no `val_dataloader`"):
            warnings.filterwarnings("ignore", message)
        trainer.fit(module, batches)
    return {"gaussians": count_gaussians(model), "places": module.batch_size}
