"""The log of a training, read from the files of Lightning's CSVLogger."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy import ndarray

Curve = tuple[ndarray, ndarray]
"""Steps and values of a quantity."""


class Validation(NamedTuple):
    """The score of a validation."""

    step: int
    seconds: float  # time since the start of the training [s]; NaN if unknown
    score: float  # mean over the validation links


def read_curves(paths: Sequence[Path]) -> dict[str, Curve]:
    """Steps and values of every quantity, without empty cells.

    A killed run may leave an empty file or a truncated last row. Both are skipped; the next start
    logs them again.

    Args:
        paths: One file for each start of the run. A later file replaces earlier ones from its first
            step on.
    """
    curves: dict[str, dict[float, float]] = {}
    for path in paths:
        with open(path, newline="", encoding="utf-8") as file:
            reader = csv.DictReader(line for line in file if line.endswith("\n"))
            names = [name for name in reader.fieldnames or () if name not in ("step", "epoch")]
            rows = list(reader)
        # A start goes on from a checkpoint, before the last steps of the start before it.
        begin = min((float(row["step"]) for row in rows), default=math.inf)
        for points in curves.values():
            repeated = [step for step in points if step >= begin]
            for step in repeated:
                del points[step]
        for row in rows:
            step = float(row["step"])
            for name in names:
                if row[name]:
                    curves.setdefault(name, {})[step] = float(row[name])
    return {
        name: tuple(np.array(sorted(points.items())).T) for name, points in curves.items() if points
    }


def read_log(folder: Path) -> dict[str, Curve]:
    """The curves in the log of a run's folder, of all its starts; empty without a training."""
    files = folder.glob("log/*/metrics.csv")
    return read_curves(sorted(files, key=lambda file: file.stat().st_mtime))


def read_validations(folder: Path, score: str) -> list[Validation]:
    """The validations in a run's log, with the mean of a score."""
    curves = read_log(folder)
    if f"validation/{score}" not in curves:
        return []
    timed_steps, times = curves.get("seconds", ((), ()))
    seconds_at = dict(zip(timed_steps, times, strict=True))
    validations = []
    for step, value in zip(*curves[f"validation/{score}"], strict=True):
        seconds = float(seconds_at.get(step, math.nan))
        validations.append(Validation(int(step), seconds, float(value)))
    return validations
