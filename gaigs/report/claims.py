"""Claims of the paper on its parts, tested by runs of variants: differences by seed, with an interval."""

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
from gaigs.registry import check_type
from gaigs.report.runs import Run
from gaigs.report.table import latex, markdown, metrics_of, terminal, tex, write_csv, written

CONFIDENCE = 0.95
"""Of the intervals."""

NOTE = (
    "Positive gains are in favour of the claim, of errors where they fall. Ours: mean over seeds of the differences of "
    f"runs with the same seed, and its {CONFIDENCE:.0%} interval by Student's t. Confirmed: the interval lies above 0; "
    "contradicted: below; not seen: it has 0 in it."
)
"""Legend of the table."""


class Claim(NamedTuple):
    """A claim of the paper.

    Attributes:
        claim: In a few words.
        better, than: Two variants, files of ``conf/variant``; by the claim the first is ahead.
        source: Place in the paper.
        published: Published ``gain`` and its ``source``, by task.
    """

    claim: str
    better: str
    than: str
    source: str
    published: dict[str, dict]


def read_claims(file: Path | None = None) -> list[Claim]:
    """Contents of ``claims.yaml``, by default that of the configuration folder.

    Raises:
        ValueError: It does not have the form of gaigs's own.
    """
    file = file or conf_dir() / "claims.yaml"
    try:
        claims = [Claim(**({"published": {}} | parts)) for parts in yaml.safe_load(file.read_text())["claims"]]
        for claim in claims:
            for name, kind in zip(Claim._fields, (str, str, str, str, dict[str, dict]), strict=True):
                check_type(f"{name!r} of a claim", getattr(claim, name), kind)
            for task, part in claim.published.items():
                check_type(f"'gain' of {claim.claim!r} for {task}", part["gain"], float)
                check_type(f"'source' of {claim.claim!r} for {task}", part["source"], str)
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{file} must have the form of conf/claims.yaml: {error!r}") from error
    return claims


def interval(gains: Sequence[float]) -> tuple[float, float] | None:
    """Ends of the interval of Student's t around the mean of gains; None for a single one."""
    if len(gains) < 2:
        return None
    half = t.ppf((1 + CONFIDENCE) / 2, len(gains) - 1) * statistics.stdev(gains) / math.sqrt(len(gains))
    mean = statistics.mean(gains)
    return mean - half, mean + half


def compare(runs: Sequence[Run], claims: Sequence[Claim]) -> list[dict]:
    """Rows of ``claims.csv``, in the order of the claims; a claim of which a variant has no run is left out.

    Runs are of one setting if they differ only in variant, seed and what changes no result. A seed that was run twice
    counts once.
    """
    keys = dict.fromkeys(key for run in runs for key in run.overrides if key not in ("variant", "seed", *HARMLESS))
    varied = [key for key in keys if len({run.overrides.get(key) for run in runs}) > 1]
    settings: dict[str, dict[str, dict[int, Run]]] = {}
    for run in runs:
        if run.metrics is not None and "variant" in run.overrides:
            setting = " ".join(f"{key}={run.overrides[key]}" for key in varied if key in run.overrides)
            seeds = settings.setdefault(setting, {}).setdefault(run.overrides["variant"], {})
            seeds.setdefault(run.metrics["seed"], run)
    rows = []
    for claim in claims:
        for setting, variants in settings.items():
            better, than = (variants.get(name, {}) for name in (claim.better, claim.than))
            if seeds := sorted(better.keys() & than.keys()):
                rows.append(_row(claim, setting, [(better[seed].metrics, than[seed].metrics) for seed in seeds]))
    return rows


def _row(claim: Claim, setting: str, pairs: Sequence[tuple[Mapping, Mapping]]) -> dict:
    task = pairs[0][0]["task"]
    name, metric = next(iter(metrics_of(pairs[0][0]).items()))
    better, than = ([next(iter(one["models"].values()))[name] for one in side] for side in zip(*pairs, strict=True))
    sign = 1 if metric.higher_is_better else -1
    gains = [sign * (a - b) for a, b in zip(better, than, strict=True)]
    low, high = interval(gains) or (None, None)
    if low is None:
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
    """Writes ``claims.md``, ``claims.csv`` and ``claims.tex``.

    Args:
        folder: Gets the files.
        runs: Of a multirun, or of several, of one task or several.

    Returns:
        A table for a terminal; None, and no files, where no claim has runs of both its variants.
    """
    claims = read_claims()
    rows = compare(runs, claims)
    if not rows:
        return None
    shown = [_shown(row) for row in rows]
    if len({row["setting"] for row in rows}) == 1:
        shown = [{title: text for title, text in line.items() if title != "setting"} for line in shown]
    lines = [[*shown[0]], *([*line.values()] for line in shown)]
    published = {claim.claim: claim.published for claim in claims}
    sources = {}  # each once
    for row in rows:
        sources[f"{row['claim']}: {row['source']}"] = None
        if (gain := row["published gain"]) is not None:
            sources[f"published gain {_signed(gain)}: {published[row['claim']][row['task']]['source']}"] = None
    failed = [f"{run.name}: {run.failure or 'unfinished'}" for run in runs if run.metrics is None]
    notes = [NOTE, "", *(f"- {text}" for text in sources), *(f"- without a result: {text}" for text in failed)]
    write_text(folder / "claims.md", f"{markdown(lines)}\n" + "".join(f"{note}\n" for note in notes))
    write_text(folder / "claims.tex", latex([[tex(cell) for cell in line] for line in lines]))
    write_csv(folder / "claims.csv", rows)
    heads = dict.fromkeys((head for head in ("claim", "setting", "ours", "seeds", "says") if head in shown[0]), False)
    caption = "".join(f"{failure}\n" for failure in failed) + "all columns in claims.md"
    return terminal("Claims of the paper", heads, [[escape(line[head]) for head in heads] for line in shown], caption)


def _shown(row: Mapping) -> dict[str, str]:
    """A row of the tables for readers."""
    ends = "" if row["low"] is None else f" ({_signed(row['low'])}, {_signed(row['high'])})"
    return {
        "claim": row["claim"],
        "setting": row["setting"],
        "compared": f"{row['better']}, {row['than']}",
        "score": row["score"],
        "published gain": "none" if row["published gain"] is None else _signed(row["published gain"]),
        "with": written(row["better's score"]),
        "without": written(row["than's score"]),
        "ours": f"{_signed(row['gain'])}{ends}",
        "seeds": str(row["seeds"]),
        "says": row["says"],
    }


def _signed(gain: float) -> str:
    return f"{'+' if gain >= 0 else ''}{written(float(gain))}"
