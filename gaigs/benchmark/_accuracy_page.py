"""Tables and figures of error against time, from the rows of trainings."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gaigs.benchmark import MEASURED, Glance, Row
from gaigs.benchmark._page import best, number, remarks, table
from gaigs.benchmark._scale import Scale, scale_of
from gaigs.report.systems import read_published

SYSTEMS, LOOK_UPS = "system", "look-up"
"""Axes: of all systems, and of the models without a training that the task names as its baselines."""

INTRODUCTION = """## Accuracy against time

Here you find how many seconds of training each system takes to reach a given accuracy, and what a prediction takes
at which error. All train for the same time on the same links. A second is one of training with its validations, and of
kriging, which follows it. Levels are mean scores of the validation links, and count from the first validation that
reaches them. All other scores are of the test links. Steps are those to the last validation.
"""

NEVER = "–"
"""In place of a time to a level that was not reached."""

HARDEST = 4
"""Levels that the tables of axes have columns for."""


class Place(NamedTuple):
    """What rows have to have in common for their figures to be compared."""

    scene: str
    trainer: str
    device: str
    task: str
    split: str

    @property
    def overrides(self) -> str:
        """The scene as a command has it: a folder by its name, without the digest of where it lies."""
        return re.sub(r"#[0-9a-f]{6}\b", "", self.scene)

    @property
    def title(self) -> str:
        """Of the section."""
        return ", ".join(filter(None, (self.task, self.overrides, f"split {self.split}")))


def places(rows: Sequence[Row]) -> dict[Place, list[Row]]:
    """Measured rows by what they have in common."""
    found: dict[Place, list[Row]] = {}
    for row in rows:
        if row["status"] == MEASURED:
            found.setdefault(Place(*(row[key] for key in Place._fields)), []).append(row)
    return found


def curve_of(row: Row) -> list[tuple[float, float]]:
    """Seconds of training and validation scores."""
    return [tuple(map(float, point.split(":"))) for point in row["curve"].split()]


def name_of(row: Row) -> str:
    """What a reader calls a variant: a model as publications do, a value of another axis as it is."""
    is_model = row["key"] == "model" and row["axis"] != LOOK_UPS
    return published_names().get(row["value"], row["value"]) if is_model else row["value"]


@functools.cache
def published_names() -> dict[str, str]:
    """What publications call models, read once."""
    return read_published().names


def seconds_to(row: Row, level: float, scale: Scale) -> float | None:
    """Seconds of training to the first validation that reaches a level; None where none does."""
    return next((time for time, score in curve_of(row) if scale.reaches(score, level)), None)


def all_levels(rows: Sequence[Row], fixed: Mapping[str, Sequence[float]], scale: Scale) -> dict[str, float]:
    """Scores whose time is told, by the column's head, the easiest first."""
    found = {f"{level:g}": float(level) for level in fixed.get(scale.monitor, ())}
    for row in rows:
        if row["axis"] == LOOK_UPS and row["validation"]:
            found[f"`{row['value']}` {number(row['validation'])}"] = float(row["validation"])
    return dict(sorted(found.items(), key=lambda item: item[1], reverse=not scale.higher_is_better))


def tables(rows: Sequence[Row], fixed: Mapping[str, Sequence[float]]) -> str:
    """All tables.

    Args:
        rows: Of the benchmark.
        fixed: Levels by the score's name.
    """
    parts = [INTRODUCTION]
    for index, (place, own) in enumerate(places(rows).items(), 1):
        parts += _part(place, own, fixed, suffix(index))
    return "\n".join([*parts, remarks(rows, ("value", "axis", "scene", "device"))]).rstrip() + "\n"


def suffix(index: int) -> str:
    """What the file names of a place's figures end in."""
    return "" if index == 1 else f"_{index}"


def _part(place: Place, rows: Sequence[Row], fixed: Mapping, end: str) -> list[str]:
    scale = scale_of(place.task)
    levels = all_levels(rows, fixed, scale)
    axes: dict[str, list[Row]] = {}
    for row in rows:
        axes.setdefault(row["axis"], []).append(row)
    look_ups, systems = axes.pop(LOOK_UPS, []), axes.pop(SYSTEMS, [])
    told = f"### {place.title}\n\n{_conditions(place, rows)}\n"
    command = " ".join(filter(None, ("python -m gaigs command=benchmark benchmark=accuracy", place.overrides)))
    parts = [f"{told}\n```\n{command}\n```\n"]
    if systems:
        parts.append(f"Seconds to reach a {scale.title} of the validation links:\n\n{_times(systems, levels, scale)}")
        parts.append(f"![Error over training](accuracy_time{end}.png)\n")
        parts.append(f"Who had the best {scale.title} by then:\n\n{_leaders(systems, scale)}")
    parts.append(f"What it costs, the best first; no other is both faster and better than those in bold:\n\n"
                 f"{_costs([*systems, *look_ups], scale)}")  # fmt: skip
    parts.append(f"![Error against the time of a prediction](accuracy_inference{end}.png)\n")
    for axis, own in axes.items():
        told = f"`{own[0]['key']}` of `{own[0]['of'] or 'the command line'}`; the default is {own[0]['default']}"
        parts.append(f"**{axis}**: {told}\n\n{_axis(own, levels, scale)}")
    if axes:
        parts.append(f"![Error over training by axis](accuracy_axes{end}.png)\n")
    return parts


def _conditions(place: Place, rows: Sequence[Row]) -> str:
    return "; ".join(filter(None, (place.device, f"runs with seed {rows[0]['seed']}", place.trainer)))


def _times(rows: Sequence[Row], levels: Mapping[str, float], scale: Scale) -> str:
    lines = []
    for row in _ranked(rows, "validation", scale):
        times = (seconds_to(row, level, scale) for level in levels.values())
        lines.append(
            [name_of(row), *(NEVER if t is None else number(str(t)) for t in times), number(row["validation"])]
        )
    return table(["system", *levels, "in the end"], lines)


def _told(seconds: float | None) -> str:
    return NEVER if seconds is None else number(str(seconds))


def _leaders(rows: Sequence[Row], scale: Scale) -> str:
    """Changes of the leader over the time of training, and its score when the next one took over."""
    points = {(time, scale.error(score)): (name_of(row), score) for row in rows for time, score in curve_of(row)}
    lines: list[list[str]] = []
    for point in best([*points]):
        name, score = points[point]
        if not lines or lines[-1][2] != name:
            lines.append([number(str(point[0])), "", name])
        lines[-1][1] = number(str(score))
    return table(["from [s]", f"best {scale.title} of its time", "system"], lines)


def _costs(rows: Sequence[Row], scale: Scale) -> str:
    ahead = on_front(rows, scale)
    more = [scale.compared] if scale.compared else []
    head = ["system", scale.title, *more, "inference [ms]", "rendering [ms]", "training [s]"]
    head += ["steps", "parameters", "checkpoint [MB]"]
    lines = []
    for row in _ranked(rows, "test", scale):
        size = number(str(float(row["checkpoint_bytes"]) / 1e6)) if row["checkpoint_bytes"] else ""
        name = f"`{name_of(row)}`" if row["axis"] == LOOK_UPS else name_of(row)
        numbers = [number(row["test"]), *(number(row["compared"]) for _ in more)]
        numbers += [number(row[key]) for key in ("inference_ms", "render_ms", "train_seconds")]
        counts = [f"{int(float(row[key])):,}" if row[key] else "" for key in ("steps", "num_parameters")]
        lines.append([f"**{name}**" if row in ahead else name, *numbers, *counts, size])
    return table(head, lines)


def on_front(rows: Sequence[Row], scale: Scale) -> list[Row]:
    """Rows than which no other is both faster in a prediction and better on the test links, fastest first."""
    points = {(float(row["inference_ms"]), scale.error(float(row["test"]))): row for row in rows}
    return [points[point] for point in best([*points])]


def _axis(rows: Sequence[Row], levels: Mapping[str, float], scale: Scale) -> str:
    times = {head: [seconds_to(row, level, scale) for row in rows] for head, level in levels.items()}
    times = dict([(head, found) for head, found in times.items() if any(found)][-HARDEST:])
    lines = []
    for index, row in enumerate(rows):
        numbers = [number(row[key]) for key in ("validation", "test")]
        costs = [number(row[key]) for key in ("inference_ms", "train_seconds")]
        counts = [f"{int(float(row[key])):,}" if row[key] else "" for key in ("steps", "num_parameters")]
        lines.append([name_of(row), *numbers, *(_told(found[index]) for found in times.values()), *costs, *counts])
    head = [f"{scale.title}, validation", "test", *(f"s to {level}" for level in times), "inference [ms]"]
    return table(["value", *head, "training [s]", "steps", "parameters"], lines)


def _ranked(rows: Sequence[Row], key: str, scale: Scale) -> list[Row]:
    """Best first; rows without a score last."""
    return sorted(rows, key=lambda row: scale.error(float(row[key])) if row[key] else float("inf"))


def figures(rows: Sequence[Row]) -> dict:
    """Error over the time of training of all systems and of each axis, and against the time of a prediction."""
    from gaigs.benchmark import _figures  # matplotlib is slow to import

    found = {}
    for index, (place, own) in enumerate(places(rows).items(), 1):
        scale, end = scale_of(place.task), suffix(index)
        panels: dict[str, dict] = {}
        for row in own:
            if points := curve_of(row):
                times, scores = zip(*points, strict=True)
                panels.setdefault(row["axis"], {})[name_of(row)] = times, [scale.error(score) for score in scores]
        look_ups = {
            r["value"]: scale.error(float(r["validation"])) for r in own if r["axis"] == LOOK_UPS and r["validation"]
        }
        if SYSTEMS in panels:
            found[f"accuracy_time{end}"] = _figures.errors_over_time(
                {"": panels.pop(SYSTEMS)}, scale.error_title, look_ups
            )
        if panels:
            found[f"accuracy_axes{end}"] = _figures.errors_over_time(panels, scale.error_title, look_ups)
        groups = {axis: [row for row in own if row["axis"] == axis] for axis in (SYSTEMS, LOOK_UPS)}
        names = {axis: [name_of(row) for row in group] for axis, group in groups.items() if group}
        shown = [row for group in groups.values() for row in group]
        errors = {name_of(row): scale.error(float(row["test"])) for row in shown}
        costs = {"inference [ms a transmitter]": {name_of(row): float(row["inference_ms"]) for row in shown}}
        sizes = {name_of(row): float(row["checkpoint_bytes"]) / 1e6 for row in shown if row["checkpoint_bytes"]}
        if sizes:
            costs["checkpoint [MB]"] = sizes
        if shown:
            figure = _figures.errors_against_costs(names, errors, costs, scale.error_title)
            found[f"accuracy_inference{end}"] = figure
    return found


def highlights(rows: Sequence[Row]) -> list[Glance]:
    """Of each place the quickest to train to what the best look-up reaches, and the front of prediction times."""
    found = []
    for place, own in places(rows).items():
        scale = scale_of(place.task)
        systems = [row for row in own if row["axis"] == SYSTEMS]
        look_ups = _ranked([row for row in own if row["axis"] == LOOK_UPS and row["validation"]], "validation", scale)
        where = f"{place.task}, {place.overrides or 'built-in room'}, split {place.split}"
        if look_ups:
            level, known = float(look_ups[0]["validation"]), look_ups[0]["value"]
            times = {seconds_to(row, level, scale): row for row in reversed(systems)}
            if soonest := min((time for time in times if time is not None), default=None):
                row = times[soonest]
                time = f"{_told(soonest)} s of training to `{known}`'s {number(look_ups[0]['validation'])}"
                score = f"{number(row['test'])} {scale.title} after {number(row['train_seconds'])} s"
                found.append(Glance(name_of(row), where, time, score, place.device))
        for row in on_front([*systems, *look_ups], scale):
            time = f"{number(row['inference_ms'])} ms a prediction"
            found.append(Glance(name_of(row), where, time, f"{number(row['test'])} {scale.title}", place.device))
    return found
