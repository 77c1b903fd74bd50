"""A guard against parts that have become slower or less exact: ratios and errors beside a committed baseline."""

import functools
import importlib.metadata
import json
import logging
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import torch

from gaigs.benchmark import MEASURED, UNAVAILABLE, Context, Glance, Measured, Row, named
from gaigs.benchmark._limits import WAYS, Ceiling
from gaigs.benchmark._page import number, remarks, table
from gaigs.benchmark._passes import CAUSES, Passes, compositor, start
from gaigs.benchmark._scenes import SCENES, Scene, cast
from gaigs.benchmark._truth import Truth, errors_of, errors_of_gradients, sum_densely
from gaigs.io.files import write_text
from gaigs.registry import register

log = logging.getLogger(__name__)

KEPT, WORSE = 0.7, 10.0
"""A ratio may fall to this share of its baseline, and an error rise to this many times its own."""

LEAST = 1e-15
"""Errors below this are none."""

ATTEMPTS = 3
"""A ratio counts as lost once so many measurements in a row have shown it."""

TIMED = {
    ("opencl", "common"): (5000, 90, 360),
    ("opencl", "training"): (200, 45, 180),
    ("torch", "common"): (200, 23, 90),
    ("torch", "training"): (8, 23, 45),
    ("aperture", "aperture"): (1000, 23, 90),
}
"""Gaussians, rows and columns by rasterizer and scene, where times are taken: passes of a few milliseconds, which other
work seldom cuts, and most of which is compositing."""

CHECKED = {"common": (300, 23, 90), "training": (50, 23, 90), "aperture": (1000, 23, 90)}
"""The same by scene, where errors are: few pairs, as all are summed. All is in float32, with torch in float64, too."""


@register("benchmark", "guard")
class Guard(Measured):
    """Fails where a ratio of speeds has fallen by more than 30 %, or an error has grown more than ten times.

    Times are those that the processor has worked, of all threads of this process, the least of some repeats in turns:
    other work on the machine hardly touches them. They count as ratios: of ``opencl`` to the bare arithmetic of its
    kernels, of ``torch`` and ``aperture`` to exponentials of as many numbers as a cache holds, and of a way back to the
    way there. Baselines are kept by processor, torch and OpenCL driver; elsewhere nothing fails.

    Args:
        baseline: The file of baselines, JSON.
        record: Whether to write this machine's into it, in place of a comparison.
        repeats: Of each pass, at the first attempt.
        minutes, device: As of every benchmark.

    Raises:
        ValueError: An option is out of range.
    """

    name = "guard"
    keys = ("device", "quantity")
    values = ("found", "baseline", "kind")

    def __init__(
        self,
        baseline: str,
        record: bool = False,
        repeats: int = 20,
        minutes: float | None = None,
        device: str | None = None,
    ):
        super().__init__(minutes, device)
        if repeats < 1:
            raise ValueError(f"benchmark.repeats must be at least 1, got {repeats}")
        if device not in (None, "cpu"):
            raise ValueError(f"benchmark.device must be cpu or null, as the guard knows no other, got {device!r}")
        self.baseline, self.record, self.repeats = Path(baseline), record, repeats

    def run(self, folder: Path, context: Context) -> None:
        """Measures, writes ``guard.csv`` and ``guard.md``, and then fails where something is lost.

        Raises:
            ValueError: A ratio or an error is worse than its baseline allows; or the file of baselines is damaged.
        """
        (folder / "guard.csv").unlink(missing_ok=True)  # each run of it is one anew
        super().run(folder, context)
        rows = [row for row in self._rows(folder).all() if row["status"] == MEASURED]
        if self.record:
            known = read_baselines(self.baseline)
            known[machine()] = {row["quantity"]: float(row["found"]) for row in rows}
            write_text(self.baseline, json.dumps(known, indent=2, sort_keys=True) + "\n")
            log.info("recorded for %s: %s", machine(), self.baseline)
        elif losses := [text for row in rows if (text := told(row))]:
            raise ValueError(
                f"benchmark=guard: {'; '.join(losses)}; find what has changed it, or, where that is meant, record new "
                "baselines with benchmark.record=true"
            )

    def cells(self, context: Context) -> Iterator[list[Row]]:
        yield [{"device": named("cpu"), "quantity": quantity} for quantity in (*RATIOS, *ERRORS)]

    def measure(self, cell: Sequence[Row], context: Context) -> Iterator[Row]:
        known = {} if self.record else read_baselines(self.baseline).get(machine(), {})
        if not known and not self.record:
            log.warning(
                "%s has no baseline of this machine (%s), so nothing is compared; benchmark.record=true writes one",
                self.baseline, machine(),
            )  # fmt: skip
        found, causes = watch(known, self.repeats)
        for row in cell:
            quantity = row["quantity"]
            kind = "ratio" if quantity in RATIOS else "error"
            if quantity in found:
                yield row | {"found": found[quantity], "baseline": known.get(quantity), "kind": kind}
            else:
                yield row | {"kind": kind, "status": UNAVAILABLE + causes[quantity.split(",")[0]]}

    def tables(self, rows: Sequence[Row]) -> str:
        parts = ["## Guard\n"]
        for kind, limit in (("ratio", KEPT), ("error", WORSE)):
            own = [row for row in rows if row["kind"] == kind and row["status"] == MEASURED]
            lines = [[row["quantity"], number(row["found"]), number(row["baseline"])] for row in own]
            parts.append(table([kind, "found", f"baseline, of which {limit:g} times are allowed"], lines))
        return "\n".join(parts) + remarks(rows, ("device", "quantity"))

    def highlights(self, rows: Sequence[Row]) -> list[Glance]:
        return []


def quantities(case: tuple[str, str]) -> tuple[tuple[str, str], tuple[str, str]]:
    """The names of a case's ratios and errors, forward and backward."""
    there, back = (f"{case[0]}, {case[1]}, {way}" for way in WAYS)
    return (there, back), (f"{there}, error", f"{back}, error")


def compositing(scene: str) -> str:
    """The name of the ratio of the kernel alone that composites, without sorting and listing."""
    return f"opencl, {scene}, compositing"


RATIOS = (*(quantity for case in TIMED for quantity in quantities(case)[0]), *map(compositing, ("common", "training")))

DOUBLE = tuple((f"torch, {scene}, forward, error in float64", scene) for scene in ("common", "training"))

ERRORS = (*(quantity for case in TIMED for quantity in quantities(case)[1]), *(quantity for quantity, _ in DOUBLE))


def told(row: Row) -> str | None:
    """What a row has lost, in words; None where it has not, or has no baseline."""
    if not row["baseline"]:
        return None
    found, baseline = float(row["found"]), float(row["baseline"])
    if row["kind"] == "ratio" and found < KEPT * baseline:
        return f"the speed of {row['quantity']} is {found:.3g} of its reference and was {baseline:.3g}"
    if row["kind"] == "error" and not found <= WORSE * max(baseline, LEAST):
        return f"the {row['quantity']} is {found:.2g} and was {baseline:.2g}"
    return None


def watch(known: Mapping[str, float], repeats: int) -> tuple[dict[str, float], dict[str, str]]:
    """Ratios and errors, and why rasterizers have none.

    Args:
        known: Baselines. Where a ratio has fallen all are measured again, up to ``ATTEMPTS`` times in all, and the best
            counts; without a baseline the least of so many, so that a new one promises no more than there is.
        repeats: Of each pass; twice and four times as many where it is measured again.
    """
    runs, found, causes = {}, {}, {}
    for (name, scene), place in TIMED.items():
        try:
            runs[name, scene] = start(name, cast(SCENES[scene](*place), "cpu", torch.float32))
        except CAUSES as error:
            causes[name] = " ".join(str(error).split())
        else:
            double, truth = _checked(scene)
            errors = _errors(start(name, cast(double, "cpu", torch.float32)), truth)
            found |= dict(zip(quantities((name, scene))[1], errors, strict=True))
    for quantity, scene in DOUBLE:
        double, truth = _checked(scene)
        found[quantity], _ = _errors(start("torch", double), truth)
    ratios: dict[str, list[float]] = {}
    for attempt in range(ATTEMPTS):
        for quantity, ratio in _ratios(runs, repeats * 2**attempt).items():
            ratios.setdefault(quantity, []).append(ratio)
        if known and all(max(own) >= KEPT * known.get(quantity, 0) for quantity, own in ratios.items()):
            break
    for quantity, own in ratios.items():
        found[quantity] = max(own) if quantity in known else min(own)
    return found, causes


def _ratios(runs: Mapping[tuple[str, str], Passes], repeats: int) -> dict[str, float]:
    """Speeds relative to what suffers alike from the machine, at this moment."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # others spin while they wait, and count as work
    try:
        return _least_ratios(runs, repeats)
    finally:
        torch.set_num_threads(threads)


def _least_ratios(runs: Mapping[tuple[str, str], Passes], repeats: int) -> dict[str, float]:
    numbers = torch.full((2**18,), -1.0)
    works: dict[str, Callable] = {"numbers": lambda: [numbers.exp() for _ in range(8)]}
    for (name, scene), run in runs.items():
        there, back = quantities((name, scene))[0]
        works |= {there: run.forward, back: run.backward}
        if name == "opencl":
            ceiling = _ceiling(run.scene.signal.shape[-1], run.scene.attenuations is not None)
            works[compositing(scene)] = compositor(run)
            for way in WAYS:
                works[f"ceiling, {scene}, {way}"] = functools.partial(ceiling.measure, way, 60)
    least = dict.fromkeys(works, float("inf"))
    for _ in range(repeats + 1):
        for quantity, work in works.items():
            begin = time.process_time()
            work()
            least[quantity] = min(least[quantity], time.process_time() - begin)
    ratios = {}
    for name, scene in runs:
        there, back = quantities((name, scene))[0]
        if name == "opencl":
            ratios |= {
                quantity: least[f"ceiling, {scene}, {way}"] / least[quantity]
                for quantity, way in zip((there, back, compositing(scene)), (*WAYS, "forward"), strict=True)
            }
        else:
            ratios |= {there: least["numbers"] / least[there], back: least[there] / least[back]}
    return ratios


def _errors(run: Passes, truth: Truth) -> tuple[float, float]:
    """The largest of the map or the fields, and of the gradients."""
    run.forward()
    run.backward(truth.clear if truth.outputs.ndim == 4 else None)
    return errors_of(run.result(), truth)[0], errors_of_gradients(run.gradients(), truth)[0]


@functools.cache
def _checked(name: str) -> tuple[Scene, Truth]:
    scene = SCENES[name](*CHECKED[name])
    return scene, sum_densely(scene, "cpu")


_ceiling = functools.cache(Ceiling)


def machine() -> str:
    """What baselines are kept by: the processor, torch, and the OpenCL driver."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    figures = [next((line.split(":")[1].strip() for line in lines if re.match(rf"{key}\s*:", line)), "")
               for key in ("cpu family", "model")]  # fmt: skip
    drivers = [
        f"{d.metadata['Name']} {d.version}" for d in importlib.metadata.distributions() if "pocl" in d.metadata["Name"]
    ]
    name = re.sub(r", \d+ threads?$", "", named("cpu"))
    return ", ".join(
        [name, f"family {figures[0]} model {figures[1]}", f"torch {torch.__version__}", *sorted(set(drivers))]
    )


def read_baselines(file: Path) -> dict[str, dict[str, float]]:
    """Ratios and errors by machine; none where there is no file.

    Raises:
        ValueError: The file is damaged.
    """
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return {key: {name: float(value) for name, value in own.items()} for key, own in content.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{file} must be JSON with ratios and errors by machine, and is not ({error}); mend it, or move it "
            "elsewhere and record it with benchmark=guard benchmark.record=true"
        ) from error
