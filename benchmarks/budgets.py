"""The smallest sizes that cost no accuracy on given data: one key at a time, by validation scores.

    python benchmarks/budgets.py
    python benchmarks/budgets.py +experiment=rssi trainer.max_steps=300 --values paths=[0,1,2]

Trains each value of each axis, and marks the smallest that suffices. Overrides are those of each
run.
"""

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar

import yaml
from common import Row, grouped, number
from trainings import Axis, Score, Trainings, command_line, sections

from gaigs.report.table import markdown

INTRODUCTION = """# Budgets

The smallest value of each part whose mean validation score is within the tolerance of the best value's. One key changes
at a time, all others are those of the reference. Test links have no say. Where scores scatter over seeds by more than
the tolerance, a difference of that size says nothing. If the largest value is the smallest that suffices, a larger one
may be better still. Times are of one run each.
"""


class Budgets(Trainings):
    """Rows of values of the axes; an axis of seeds shows how much scores scatter."""

    name = "budgets"
    axes: ClassVar = {
        "seeds_gaigs": Axis(["model=gaigs"], "seed", [0, 1, 2]),
        "Gaussians": Axis(["model=gaigs"], "gaussians.count"),
        "anchors": Axis(["model=gaigs"], "tokenizer.ga.anchors"),
        "width": Axis(["model=gaigs"], "deformation.width"),
        "grid": Axis(["model=gaigs"], "pooling.grid"),
        "seeds_mirrored": Axis(["model=mirrored", "kriging=false"], "seed", [0, 1, 2]),
        "planes": Axis(["model=mirrored", "kriging=false"], "placement.planes", [6, 8, 10, 14, 20]),
        "paths": Axis(["model=mirrored", "kriging=false"], "placement.order", [0, 1, 2, 3]),
        "obstacles": Axis(["model=mirrored", "kriging=false"], "placement.obstacles"),
    }
    tolerance: ClassVar = {
        "ratio": 0.005,
        "dB": 0.05,
    }  # below the best validation score, by its unit

    def cells(self, device: str) -> Iterator[list[Row]]:
        self.check_links()
        unit = Score.of(self.config["task"]["name"]).unit or "ratio"
        if unit not in self.tolerance:
            raise ValueError(f"Budgets.tolerance in {__file__} needs the unit {unit!r}")
        for cell in self.cells_of_axes(device):
            size(cell[0]["value"]), size(cell[0]["default"])  # raises before any training
            yield cell

    def tables(self, rows: Sequence[Row]) -> str:
        parts = [INTRODUCTION]
        for heading, score, own in sections(self.name, rows):
            parts.append(heading)
            tolerance, unit = self.tolerance[score.unit or "ratio"], f" {score.unit}".rstrip()
            head = ["part", "key", f"{score.title} of the validation links by value"]
            head += [f"smallest within {tolerance:g}{unit}", "default now"]
            head += ["inference [ms], smallest, default", "training [s], smallest, default"]
            for (of,), values in grouped(own, "of").items():
                sentences, lines = [f"Reference: `{of or 'the command line'}`."], []
                for (axis, key), found in grouped(values, "axis", "key").items():
                    if key == "seed":
                        sentences.append(_scatter(found, tolerance, unit))
                    else:
                        lines.append([axis, f"`{key}`", *_smallest(found, tolerance, score)])
                parts += [" ".join(sentences) + "\n", markdown([head, *lines])]
        return "\n".join(parts)


def smallest_within(rows: Sequence[Row], tolerance: float, score: Score) -> Row:
    """The row of the smallest value whose validation score is within the tolerance of the best."""
    losses = [score.loss(row["validation"]) for row in rows]
    # Scores are stored with six digits: a score at the bound counts.
    within = [
        row
        for row, loss in zip(rows, losses, strict=True)
        if loss <= min(losses) + tolerance * (1 + 1e-9)
    ]
    return min(within, key=lambda row: size(row["value"]))


def size(value: str) -> float:
    """The size of a value: its number, or the product of a list of numbers; a ValueError or
    TypeError for neither.
    """
    found = yaml.safe_load(value)
    return float(math.prod(found) if isinstance(found, list) else found)


def _smallest(rows: Sequence[Row], tolerance: float, score: Score) -> list[str]:
    """Scores by value, the smallest value that suffices, the default, and the costs of both."""
    rows = sorted(rows, key=lambda row: size(row["value"]))
    smallest = smallest_within(rows, tolerance, score)
    scores = ", ".join(f"{row['value']}: {number(row['validation'])}" for row in rows)
    default = next((row for row in rows if row["value"] == row["default"]), None)

    def pair(key):
        return ", ".join(number(row[key]) if row else "not measured" for row in (smallest, default))

    remark = ", the largest tried" if smallest is rows[-1] else ""
    return [
        scores,
        f"**{smallest['value']}**{remark}",
        rows[0]["default"],
        pair("inference_ms"),
        pair("train_seconds"),
    ]


def _scatter(rows: Sequence[Row], tolerance: float, unit: str) -> str:
    """A sentence on the scores of several seeds."""
    scores = [float(row["validation"]) for row in rows]
    spread = max(scores) - min(scores)
    seeds, texts = (
        ", ".join(parts)
        for parts in ([r["value"] for r in rows], [number(r["validation"]) for r in rows])
    )
    side = "within" if spread <= tolerance else "beyond"
    return (
        f"Seeds {seeds} score {texts}: they scatter by {number(spread)}{unit}, {side} the "
        "tolerance."
    )


def main(words: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    text = "values of an axis without values, in multiples of its default"
    parser.add_argument(
        "--factors", nargs="+", type=float, default=[0.125, 0.25, 0.5, 1, 2], help=text
    )
    Budgets(parser.parse_intermixed_args(words)).run()


if __name__ == "__main__":
    main()
