"""Seconds of training to reach a score, and the error and time of a prediction, of all systems.

    python benchmarks/accuracy.py python benchmarks/accuracy.py data=synthetic_rssi
    trainer.max_time=00:00:00:40 --systems gaigs mirrored

Trains every system, and the values of some axes, for the same time; look-ups stand beside them.
Overrides are those of each run.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from common import Row, grouped, number, table
from trainings import Axis, Score, Trainings, command_line, sections, written

from gaigs.registry import registry
from gaigs.report.published import read_published
from gaigs.report.scores import monitor_names, task_class

SYSTEMS, LOOK_UPS = "system", "look-up"
"""Axes of all systems, and of the task's baselines, which have no training."""

INTRODUCTION = """# Accuracy against time

All systems train for the same time on the same links. Seconds are those of training with its validations, and of
kriging, which follows. A level is reached at the first validation with at least that score. No other row is both more
accurate and faster in a prediction than those in bold. Steps are those to the last validation.
"""


class Accuracy(Trainings):
    """Rows of look-ups, of systems, and of values of the axes."""

    name = "accuracy"
    trainer = (
        "trainer.max_steps=-1",
        "trainer.max_time=00:00:01:00",
        "trainer.val_check_interval=00:00:00:03",
    )
    axes: ClassVar = {
        "placement": Axis(["model=gaigs"], "model", ["gaigs", "mirrored"]),  # free, mirrored
        "kriging": Axis(["model=mirrored"], "kriging", [False, True]),
        "tokenizer": Axis(["model=gaigs"], "tokenizer", ["euclidean", "ga", "multiview"]),
        "anchors": Axis(["model=gaigs"], "tokenizer.ga.anchors", [1, 4, 16, 64]),
        "Gaussians": Axis(["model=gaigs"], "gaussians.count", [30, 100, 300, 1000]),
        "planes": Axis(["model=mirrored"], "placement.planes", [6, 10, 20]),
    }
    levels: ClassVar = {  # of validation scores, beside those of the look-ups
        "ssim": [0.6, 0.7, 0.8, 0.9, 0.95],
        "mae_db": [8, 6, 5, 4, 3],
        "sinad_db": [4, 6, 8, 10],
    }

    def cells(self, device: str) -> Iterator[list[Row]]:
        self.check_links()
        for config in self.config["baselines"]:
            options = {key: value for key, value in config.items() if key != "name"}
            of = [f"++model.{key}={written(value)}" for key, value in options.items()]
            yield self.cell(of, axis=LOOK_UPS, key="model", value=config["name"])
        systems = self.options.systems
        if systems is None:
            known = registry("model").names()
            systems = [name for name in read_published()["names"] if name in known]
        for name in systems:
            yield self.cell((), axis=SYSTEMS, key="model", value=name)
        yield from self.cells_of_axes(device)

    def tables(self, rows: Sequence[Row]) -> str:
        parts = [INTRODUCTION]
        for heading, score, own in sections(self.name, rows):
            levels = self.all_levels(own, score)
            systems = [row for row in own if row["axis"] in (SYSTEMS, LOOK_UPS)]
            parts += [
                heading,
                _table(sorted(systems, key=lambda row: score.loss(row["test"])), levels, score),
            ]
            for (axis, key, of, default), values in grouped(
                own, "axis", "key", "of", "default"
            ).items():
                if axis not in (SYSTEMS, LOOK_UPS):
                    parts.append(
                        f"**{axis}**: `{key}` of `{of or 'the command line'}`; the default is "
                        f"{default}\n"
                    )
                    parts.append(_table(values, levels, score))
        return "\n".join(parts)

    def all_levels(self, rows: Sequence[Row], score: Score) -> dict[str, float]:
        """Levels by the column's title, the easiest first."""
        found = {
            f"{level:g}": level for level in self.levels.get(monitor_names(rows[0]["task"])[0], ())
        }
        for row in rows:
            if row["axis"] == LOOK_UPS and row["validation"]:
                found[f"`{row['value']}` {number(row['validation'])}"] = float(row["validation"])
        return dict(sorted(found.items(), key=lambda item: -score.loss(item[1])))


def _table(rows: Sequence[Row], levels: Mapping[str, float], score: Score) -> str:
    """Scores, seconds to each level, and costs; in bold the rows that no other one beats in error
    and time.
    """
    ahead: list[Row] = []
    for row in sorted(rows, key=lambda row: (float(row["inference_ms"]), score.loss(row["test"]))):
        if not ahead or score.loss(row["test"]) < score.loss(ahead[-1]["test"]):
            ahead.append(row)
    compared = task_class(rows[0]["task"]).metrics()[score.first].title
    columns = {"": "name", score.title: "test"} | (
        {compared: "compared"} if compared != score.title else {}
    )
    columns |= {
        "validation": "validation",
        "inference [ms]": "inference_ms",
        "rendering [ms]": "render_ms",
    }
    columns |= {"training [s]": "train_seconds", **{f"s to {level}": level for level in levels}}
    columns |= {
        "steps": "steps",
        "parameters": "num_parameters",
        "checkpoint [bytes]": "checkpoint_bytes",
    }
    lines, published = [], read_published()["names"]
    for row in rows:
        name = published.get(row["value"], row["value"]) if row["key"] == "model" else row["value"]
        name = f"`{row['value']}`" if row["axis"] == LOOK_UPS else name
        found = {"name": f"**{name}**" if row in ahead else name}
        curve = [
            tuple(map(float, point.split(":"))) for point in row["curve"].split()
        ]  # seconds, validation score
        for title, level in levels.items():
            found[title] = next(
                (time for time, value in curve if score.loss(value) <= score.loss(level)), ""
            )
        lines.append(row | found)
    return table(lines, columns)


def main(words: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    text = "models; by default all that are installed and have a published name"
    known = registry("model").names()
    parser.add_argument("--systems", nargs="+", choices=known, metavar="MODEL", help=text)
    Accuracy(parser.parse_intermixed_args(words)).run()


if __name__ == "__main__":
    main()
