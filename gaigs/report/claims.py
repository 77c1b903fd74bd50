"""What the paper says its parts are worth, and what runs of variants say: differences by seed, with an interval."""

import csv
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from scipy.stats import t

from gaigs.configuration import HARMLESS, conf_dir
from gaigs.io.files import atomic_write, write_text
from gaigs.registry import check_type
from gaigs.report.runs import Run
from gaigs.report.table import latex, markdown, metrics_of, tex, written

CONFIDENCE = 0.95
"""Of the intervals."""

NOTE = (
    "Positive gains are in favour of the claim, of errors where they fall. Ours: mean over seeds of the differences of "
    f"runs with the same seed, and its {CONFIDENCE:.0%} interval by Student's t. Confirmed: the interval lies above 0; "
    "contradicted: below; not seen: it has 0 in it."
)
"""What the table shows."""


class Claim(NamedTuple):
    """What the paper says.

    Attributes:
        claim: In a few words.
        better, than: Variants of which the first is said to be ahead, files of ``conf/variant``.
        source: Where the paper says it.
        published: By task what publications have for it: ``gain``, and its ``source``.
    """

    claim: str
    better: str
    than: str
    source: str
    published: dict[str, dict]


class Finding(NamedTuple):
    """What runs say to a claim.

    Attributes:
        claim: The claim.
        setting: What tells these runs from others of the table, beside variant and seed.
        task: Of these runs.
        score: What it is compared in.
        better, than: Mean score of the two variants over the seeds that both have.
        gains: By how much the first is ahead, one a seed.
        interval: Ends of the interval around their mean; None of one seed.
    """

    claim: Claim
    setting: str
    task: str
    score: str
    better: float
    than: float
    gains: list[float]
    interval: tuple[float, float] | None

    @property
    def word(self) -> str:
        """What follows from the interval."""
        if self.interval is None:
            return "one seed"
        low, high = self.interval
        return "confirmed" if low > 0 else "contradicted" if high < 0 else "not seen"


def read_claims(file: Path | None = None) -> list[Claim]:
    """What ``claims.yaml`` holds, by default that of the configuration folder.

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
    """Ends of the interval of Student's t around the mean of some gains; None of a single one."""
    if len(gains) < 2:
        return None
    half = t.ppf((1 + CONFIDENCE) / 2, len(gains) - 1) * statistics.stdev(gains) / math.sqrt(len(gains))
    mean = statistics.mean(gains)
    return mean - half, mean + half


def compare(runs: Sequence[Run], claims: Sequence[Claim]) -> list[Finding]:
    """What runs say to claims, in the order of the claims; those of which a variant has no run are left out.

    Runs are of one setting where all was asked for alike but variant, seed and what changes no result. A seed that was
    run twice counts once.
    """
    keys = dict.fromkeys(key for run in runs for key in run.overrides if key not in ("variant", "seed", *HARMLESS))
    varied = [key for key in keys if len({run.overrides.get(key) for run in runs}) > 1]
    settings: dict[str, dict[str, dict[int, Run]]] = {}
    for run in runs:
        if run.metrics is not None and "variant" in run.overrides:
            setting = " ".join(f"{key}={run.overrides[key]}" for key in varied if key in run.overrides)
            seeds = settings.setdefault(setting, {}).setdefault(run.overrides["variant"], {})
            seeds.setdefault(run.metrics["seed"], run)
    found = []
    for claim in claims:
        for setting, variants in settings.items():
            better, than = (variants.get(name, {}) for name in (claim.better, claim.than))
            if seeds := sorted(better.keys() & than.keys()):
                pairs = [(better[seed].metrics, than[seed].metrics) for seed in seeds]
                found.append(_finding(claim, setting, pairs))
    return found


def _finding(claim: Claim, setting: str, pairs: Sequence[tuple[Mapping, Mapping]]) -> Finding:
    name, metric = next(iter(metrics_of(pairs[0][0]).items()))
    better, than = ([next(iter(one["models"].values()))[name] for one in side] for side in zip(*pairs, strict=True))
    sign = 1 if metric.higher_is_better else -1
    gains = [sign * (a - b) for a, b in zip(better, than, strict=True)]
    means = statistics.mean(better), statistics.mean(than)
    return Finding(claim, setting, pairs[0][0]["task"], metric.title, *means, gains, interval(gains))


def write_claims(folder: Path, runs: Sequence[Run]) -> Table | None:
    """Writes ``claims.md``, ``claims.csv`` and ``claims.tex``.

    Args:
        folder: Gets the files.
        runs: Of a multirun, or of several, of one task or several.

    Returns:
        A table for a terminal; None, and no files, where no claim has runs of both its variants.
    """
    found = compare(runs, read_claims())
    if not found:
        return None
    head, *lines = _cells(found)
    failed = [f"{run.name}: {run.failure or 'unfinished'}" for run in runs if run.metrics is None]
    notes = [NOTE, "", *(f"- {text}" for text in _sources(found)), *(f"- without a result: {text}" for text in failed)]
    write_text(folder / "claims.md", f"{markdown([head, *lines])}\n" + "".join(f"{note}\n" for note in notes))
    write_text(folder / "claims.tex", latex([[tex(cell) for cell in line] for line in (head, *lines)]))
    _csv(folder / "claims.csv", found)

    missing = "".join(f"{failure}\n" for failure in failed)
    table = Table(title="Claims of the paper", caption=escape(f"{missing}all columns in claims.md"), box=SIMPLE_HEAD)
    shown = [head.index(title) for title in head if title in ("claim", "setting", "ours", "seeds", "says")]
    for column in shown:
        table.add_column(escape(head[column]), overflow="fold")
    for line in lines:
        table.add_row(*(escape(line[column]) for column in shown))
    return table


def _cells(found: Sequence[Finding]) -> list[list[str]]:
    """Head and rows; what is the same for all, and a setting that is the only one, has no column."""
    lines = [["claim", "setting", "compared", "score", "published gain", "with", "without", "ours", "seeds", "says"]]
    for one in found:
        published = one.claim.published.get(one.task)
        ends = "" if one.interval is None else f" ({', '.join(_signed(end) for end in one.interval)})"
        lines.append(
            [
                one.claim.claim, one.setting, f"{one.claim.better}, {one.claim.than}", one.score,
                _signed(published["gain"]) if published else "none", written(one.better), written(one.than),
                f"{_signed(statistics.mean(one.gains))}{ends}", str(len(one.gains)), one.word,
            ]
        )  # fmt: skip
    if len({one.setting for one in found}) == 1:
        lines = [[cell for cell, title in zip(line, lines[0], strict=True) if title != "setting"] for line in lines]
    return lines


def _signed(gain: float) -> str:
    return f"{'+' if gain >= 0 else ''}{written(float(gain))}"


def _sources(found: Sequence[Finding]) -> list[str]:
    """Where the claims and the published gains stand, each once."""
    texts = []
    for one in found:
        texts.append(f"{one.claim.claim}: {one.claim.source}")
        if published := one.claim.published.get(one.task):
            texts.append(f"published gain {_signed(published['gain'])}: {published['source']}")
    return [*dict.fromkeys(texts)]


def _csv(file: Path, found: Sequence[Finding]) -> None:
    with atomic_write(file) as part, open(part, "w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(
            [
                "claim", "setting", "better", "than", "task", "score", "published gain", "better's score",
                "than's score", "gain", "low", "high", "seeds", "says", "source",
            ]
        )  # fmt: skip
        for one in found:
            published = one.claim.published.get(one.task, {})
            row = [one.claim.claim, one.setting, one.claim.better, one.claim.than, one.task, one.score]
            row += [published.get("gain"), one.better, one.than, statistics.mean(one.gains)]
            row += [*(one.interval or (None, None)), len(one.gains), one.word, one.claim.source]
            writer.writerow(row)
