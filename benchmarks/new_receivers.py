"""Shares of labels within intervals at held-out receivers: python benchmarks/new_receivers.py
FOLDER... of runs with split=receivers.

Intervals are calibrated anew, so runs of an earlier version show what the present one makes of
their models. Prints a table in Markdown: receivers that train, validate and test, median SNR of
channels [dB] or mean absolute error of levels [dB], shares within intervals of 50 % and 90 %, and
the share of 90 % at each test receiver. docs/results.md has the numbers.
"""

import sys
from dataclasses import replace
from pathlib import Path

import gaigs
from gaigs import runs
from gaigs.calibration.conformal import thinned, usual_deviations
from gaigs.calibration.scores import holds
from gaigs.model.answers import at_new_receivers, predicted
from gaigs.report.table import markdown


def rate(folder: str) -> list[str]:
    """A row of the table."""
    links = runs.links_of(folder, True)
    model = gaigs.load(folder)
    split, of_links = links.split, links.query.receivers
    known = of_links[split.known].bincount(minlength=len(links.receivers))
    elsewhere = at_new_receivers(model, links)
    calibration = replace(elsewhere, widths=(known == 0).double(), elsewhere=elsewhere)
    query = links.query[split.test]
    labels = links.labels[split.test]
    values = predicted(model, links, split.test)
    error = links.task.summarise(links.task.scores(labels, values))
    numbers = thinned(links.task, labels, values, usual_deviations(values))
    shares = []
    for level in (0.5, 0.9):
        found = calibration.estimate(numbers.values, numbers.deviations, query, level)
        held = holds(found, numbers.labels).double().mean(1)  # (k,)
        shares.append(f"{held.mean():.2f}")
    receivers = query.receivers.unique()
    each = [f"{held[query.receivers == receiver].mean():.2f}" for receiver in receivers]
    parts = (split.train, split.validation, split.test)
    counts = "/".join(str(len(of_links[part].unique())) for part in parts)
    score = error[links.task.monitor if links.task.is_scalar else "snr_db_median"]
    return [Path(folder).name, counts, f"{score:.2f}", *shares, ", ".join(each)]


def main(folders: list[str]) -> None:
    rows = [["run", "receivers", "score", "50 %", "90 %", "90 % at each"]]
    print(markdown(rows + [rate(folder) for folder in folders]))


if __name__ == "__main__":
    main(sys.argv[1:])
