"""Claims of the paper on its parts, tested by runs of variants with several seeds.

    python -m gaigs -m +experiment=claims
    python benchmarks/claims.py runs/claims

The folder is that of a multirun over ``+variant`` and ``seed``, or one above several; multiruns
with other options, or of other tasks, get rows of their own. It gets ``claims.md`` and
``claims.csv``. The claims are in ``claims.yaml`` beside this script. docs/results/claims.md has the
results.
"""

import argparse
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.stats import t

from gaigs.configuration import HARMLESS
from gaigs.io.files import write_text
from gaigs.report.run_folders import Run, read_runs
from gaigs.report.scores import headline
from gaigs.report.table import columns_of, markdown, terminal, write_csv, written


class Claim(NamedTuple):
    """A claim of the paper.

    Attributes:
        claim: The claim in a few words.
        better, than: Two variants, files of ``conf/variant``; the claim says that the first is
            better.
        source: Place in the paper.
        published: Published ``gain`` and its ``source``, by task.
    """

    claim: str
    better: str
    than: str
    source: str
    published: dict[str, dict]


def read_claims() -> list[Claim]:
    """Contents of ``claims.yaml``."""
    content = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
    return [Claim(**({"published": {}} | entries)) for entries in content["claims"]]


def interval(gains: Sequence[float], confidence: float = 0.95) -> tuple[float, float] | None:
    """Ends of the interval of Student's t around the mean of gains; None for a single one."""
    if len(gains) < 2:
        return None
    quantile = t.ppf((1 + confidence) / 2, len(gains) - 1)
    half = quantile * statistics.stdev(gains) / math.sqrt(len(gains))
    mean = statistics.mean(gains)
    return mean - half, mean + half


def compare(runs: Sequence[Run], claims: Sequence[Claim]) -> list[dict]:
    """Rows of ``claims.csv``, in the order of the claims.

    A claim is left out if one of its variants has no run. Runs are of one setting if they differ
    only in variant, seed and options that change no result. A seed that was run twice counts once.
    """
    varied = _varied(runs)
    settings: dict[str, dict[str, dict[int, dict]]] = {}  # metrics by setting, variant and seed
    for run in runs:
        if run.metrics is not None and "variant" in run.overrides:
            keys = [key for key in varied if key in run.overrides]
            setting = " ".join(f"{key}={run.overrides[key]}" for key in keys)
            seeds = settings.setdefault(setting, {}).setdefault(run.overrides["variant"], {})
            seeds.setdefault(run.metrics["seed"], run.metrics)
    rows = []
    for claim in claims:
        for setting, variants in settings.items():
            better = variants.get(claim.better, {})
            than = variants.get(claim.than, {})
            pairs = [(better[seed], than[seed]) for seed in sorted(better.keys() & than.keys())]
            if pairs:
                rows.append(_row(claim, setting, pairs))
    return rows


def _varied(runs: Sequence[Run]) -> list[str]:
    """Overrides other than variant and seed that change results and differ between runs."""
    varied = []
    for key in columns_of([run.overrides for run in runs]):
        values = {run.overrides.get(key) for run in runs}
        if key not in ("variant", "seed", *HARMLESS) and len(values) > 1:
            varied.append(key)
    return varied


def _row(claim: Claim, setting: str, pairs: Sequence[tuple[Mapping, Mapping]]) -> dict:
    """A claim in one setting, by the metrics of both variants with each seed."""
    first, _ = pairs[0]
    task = first["task"]
    name, metric = headline(task, first["models"])
    better = [_score(metrics, name) for metrics, _ in pairs]
    than = [_score(metrics, name) for _, metrics in pairs]
    sign = 1 if metric.higher_is_better else -1
    # Differences by seed: the spread over seeds is larger than a variant's effect.
    gains = [sign * (a - b) for a, b in zip(better, than, strict=True)]
    ends = interval(gains)
    low, high = ends or (None, None)
    return {
        "claim": claim.claim,
        "setting": setting,
        "better": claim.better,
        "than": claim.than,
        "task": task,
        "score": metric.title,
        "published gain": claim.published.get(task, {}).get("gain"),
        "better's score": statistics.mean(better),
        "than's score": statistics.mean(than),
        "gain": statistics.mean(gains),
        "low": low,
        "high": high,
        "seeds": len(gains),
        "says": _verdict(ends),
        "source": claim.source,
    }


def _score(metrics: Mapping, name: str) -> float:
    """A score of the run's model, which is the first one."""
    return next(iter(metrics["models"].values()))[name]


def _verdict(ends: tuple[float, float] | None) -> str:
    if ends is None:
        return "one seed"
    low, high = ends
    if low > 0:
        return "confirmed"
    return "contradicted" if high < 0 else "not seen"


def write_claims(folder: Path, runs: Sequence[Run]) -> Table | None:
    """Writes ``claims.md`` and ``claims.csv``.

    The result is None, and there are no files, if no claim has runs of both its variants.
    """
    claims = read_claims()
    rows = compare(runs, claims)
    if not rows:
        return None
    lines = [_line(row) for row in rows]
    if len({row["setting"] for row in rows}) == 1:
        for line in lines:
            del line["setting"]
    failed = [f"{run.name}: {run.failure or 'unfinished'}\n" for run in runs if run.metrics is None]
    page = markdown([[*lines[0]], *([*line.values()] for line in lines)])
    page += (
        "\nPositive gains are in favour of the claim, of errors where they fall. Ours: mean over "
        "seeds of the differences of runs with the same seed, and its 95% interval by Student's t. "
        "Confirmed: the interval lies above 0; contradicted: below; not seen: it has 0 in it.\n\n"
    )
    page += "".join(_notes(rows, claims))
    page += "".join(f"- without a result: {failure}" for failure in failed)
    write_text(folder / "claims.md", page)
    write_csv(folder / "claims.csv", rows)
    heads = [head for head in ("claim", "setting", "ours", "seeds", "says") if head in lines[0]]
    cells = []
    for line in lines:
        cells.append([escape(line[head]) for head in heads])
    caption = "".join(failed) + "all columns in claims.md"
    return terminal("Claims of the paper", dict.fromkeys(heads, False), cells, caption)


def _notes(rows: Sequence[Mapping], claims: Sequence[Claim]) -> list[str]:
    """Sources of claims and published gains, each once."""
    published = {claim.claim: claim.published for claim in claims}
    notes = []
    for row in rows:
        notes.append(f"- {row['claim']}: {row['source']}\n")
        gain = row["published gain"]
        if gain is not None:
            source = published[row["claim"]][row["task"]]["source"]
            notes.append(f"- published gain {_signed(gain)}: {source}\n")
    return [*dict.fromkeys(notes)]


def _line(row: Mapping) -> dict[str, str]:
    """A row of the tables for readers."""
    published = row["published gain"]
    ends = "" if row["low"] is None else f" ({_signed(row['low'])}, {_signed(row['high'])})"
    return {
        "claim": row["claim"],
        "setting": row["setting"],
        "compared": f"{row['better']}, {row['than']}",
        "score": row["score"],
        "published gain": "none" if published is None else _signed(published),
        "with": written(row["better's score"]),
        "without": written(row["than's score"]),
        "ours": f"{_signed(row['gain'])}{ends}",
        "seeds": str(row["seeds"]),
        "says": row["says"],
    }


def _signed(gain: float) -> str:
    return f"{'+' if gain >= 0 else ''}{written(float(gain))}"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of the runs")
    folder = parser.parse_args(words).folder
    try:
        table = write_claims(folder, read_runs(folder))
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    if table is None:
        parser.error(f"{folder} must hold runs of two variants that a claim compares")
    Console(emoji=False).print(table)


if __name__ == "__main__":
    main()
