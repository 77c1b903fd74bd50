"""Run folders as a multirun leaves them."""

import csv
import json
from io import StringIO

import yaml
from rich.console import Console

FACTS = {
    "split": "official", "seed": 0, "device": "cpu", "train_seconds": 180.0, "inference_ms": 17.25, "render_ms": None,
    "num_parameters": 1234, "num_gaussians": 0, "checkpoint_bytes": 2_500_000,
}  # fmt: skip


def write_run(folder, overrides, models=None, task="spectrum", log="", **facts):
    """A run with scores by model, or one that has logged something and has no result."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (folder / "gaigs.log").write_text(log)
    if models is not None:
        (folder / "metrics.json").write_text(
            json.dumps(FACTS | {"task": task, "models": models} | facts)
        )
    return folder


def read(file):
    with open(file, newline="") as opened:
        return list(csv.DictReader(opened))


def terminal(tables):
    """Lines of tables on a terminal of 80 columns."""
    console = Console(width=80, file=StringIO())
    console.print(tables)
    return console.file.getvalue().splitlines()
