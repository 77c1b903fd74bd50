"""Claims of the paper on its parts, tested by runs of variants: differences by seed, with an
interval.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from rich.markup import escape
from rich.table import Table
from scipy.stats import t

from gaigs.configuration import HARMLESS, conf_dir
from gaigs.io.files import write_text
from gaigs.report.runs import Run
from gaigs.report.table import headline, markdown, terminal, write_csv, written

CONFIDENCE = 0.95
"""Of the intervals."""

NOTE = (
    "Positive gains are in favour of the claim, of errors where they fall. Ours: mean over seeds of the differences of "
    f"runs with the same seed, and its {CONFIDENCE:.0%} interval by Student's t. Confirmed: the interval lies above 0; "
    "contradicted: below; not seen: it has 0 in it.\n"
)


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


def read_claims(file: Path | None = None) -> list[Claim]:
    """Contents of ``claims.yaml``, by default that of gaigs; a ValueError for a file of another
    form.
    """
    file = file or conf_dir() / "claims.yaml"
    try:
        return [
            Claim(**({"published": {}} | parts))
            for parts in yaml.safe_load(file.read_text())["claims"]
        ]
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{file} must have the form of conf/claims.yaml: {error!r}") from error


def interval(gains: Sequence[float]) -> tuple[float, float] | None:
    """Ends of the interval of Student's t around the mean of gains; None for a single one."""
    if len(gains) < 2:
        return None
    half = (
        t.ppf((1 + CONFIDENCE) / 2, len(gains) - 1)
        * statistics.stdev(gains)
        / math.sqrt(len(gains))
    )
    mean = statistics.mean(gains)
    return mean - half, mean + half


def compare(runs: Sequence[Run], claims: Sequence[Claim]) -> list[dict]:
    """Rows of ``claims.csv``, in the order of the claims; a claim is left out if one of its
    variants has no run.

    Runs are of one setting if they differ only in variant, seed and options that change no result.
    A seed that was run twice counts once.
    """
    keys = dict.fromkeys(
        key for run in runs for key in run.overrides if key not in ("variant", "seed", *HARMLESS)
    )
    varied = [key for key in keys if len({run.overrides.get(key) for run in runs}) > 1]
    settings: dict[str, dict[str, dict[int, dict]]] = {}  # metrics by setting, variant and seed
    for run in runs:
        if run.metrics is not None and "variant" in run.overrides:
            setting = " ".join(
                f"{key}={run.overrides[key]}" for key in varied if key in run.overrides
            )
            seeds = settings.setdefault(setting, {}).setdefault(run.overrides["variant"], {})
            seeds.setdefault(run.metrics["seed"], run.metrics)
    rows = []
    for claim in claims:
        for setting, variants in settings.items():
            better, than = (variants.get(name, {}) for name in (claim.better, claim.than))
            if seeds := sorted(better.keys() & than.keys()):
                rows.append(
                    _row(
                        claim, setting, *([side[seed] for seed in seeds] for side in (better, than))
                    )
                )
    return rows


def _row(claim: Claim, setting: str, *sides: Sequence[Mapping]) -> dict:
    task = sides[0][0]["task"]
    name, metric = headline(task, sides[0][0]["models"])
    better, than = (
        [next(iter(metrics["models"].values()))[name] for metrics in side] for side in sides
    )
    sign = 1 if metric.higher_is_better else -1
    gains = [sign * (a - b) for a, b in zip(better, than, strict=True)]
    low, high = interval(gains) or (None, None)
    if low is None or high is None:
        word = "one seed"
    else:
        word = "confirmed" if low > 0 else "contradicted" if high < 0 else "not seen"
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
        "says": word,
        "source": claim.source,
    }


def write_claims(folder: Path, runs: Sequence[Run]) -> Table | None:
    """Writes ``claims.md`` and ``claims.csv``; None, and no files, if no claim has runs of both its
    variants.
    """
    claims = read_claims()
    rows = compare(runs, claims)
    if not rows:
        return None
    lines = [_line(row) for row in rows]
    if len({row["setting"] for row in rows}) == 1:
        for line in lines:
            del line["setting"]
    published = {claim.claim: claim.published for claim in claims}
    notes: dict[str, None] = {}  # each once
    for row in rows:
        notes[f"- {row['claim']}: {row['source']}\n"] = None
        if (gain := row["published gain"]) is not None:
            notes[
                f"- published gain {_signed(gain)}: {published[row['claim']][row['task']]['source']}\n"
            ] = None
    failed = [f"{run.name}: {run.failure or 'unfinished'}\n" for run in runs if run.metrics is None]
    table = markdown([[*lines[0]], *([*line.values()] for line in lines)])
    remarks = "".join([*notes, *(f"- without a result: {failure}" for failure in failed)])
    write_text(folder / "claims.md", f"{table}\n{NOTE}\n{remarks}")
    write_csv(folder / "claims.csv", rows)
    heads = [head for head in ("claim", "setting", "ours", "seeds", "says") if head in lines[0]]
    cells = [[escape(line[head]) for head in heads] for line in lines]
    caption = "".join(failed) + "all columns in claims.md"
    return terminal("Claims of the paper", dict.fromkeys(heads, False), cells, caption)


def _line(row: Mapping) -> dict[str, str]:
    """A row of the tables for readers."""
    ends = "" if row["low"] is None else f" ({_signed(row['low'])}, {_signed(row['high'])})"
    return {
        "claim": row["claim"],
        "setting": row["setting"],
        "compared": f"{row['better']}, {row['than']}",
        "score": row["score"],
        "published gain": "none"
        if row["published gain"] is None
        else _signed(row["published gain"]),
        "with": written(row["better's score"]),
        "without": written(row["than's score"]),
        "ours": f"{_signed(row['gain'])}{ends}",
        "seeds": str(row["seeds"]),
        "says": row["says"],
    }


def _signed(gain: float) -> str:
    return f"{'+' if gain >= 0 else ''}{written(float(gain))}"
