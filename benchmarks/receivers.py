"""Errors and 90 % intervals at held-out receivers, with 0, 1, 3 and 10 readings there.

    python benchmarks/receivers.py FOLDER...    runs of signal strength with split=receivers, such as all folds

Readings are five random draws of each receiver's links; the score is of every third link of the rest. Prints
a table in Markdown: mean absolute error [dB], share of links in intervals, and their width [dB]. docs/results.md
has the numbers.
"""

import sys
from dataclasses import replace

import torch

import gaigs
from gaigs import runs
from gaigs.model.answers import at_new_receivers
from gaigs.report.table import markdown

DRAWS = 5


def main(folders: list[str]) -> None:
    scores: dict[int, list] = {count: [] for count in (0, 1, 3, 10)}
    for folder in folders:
        rate(folder, scores)
    rows = [["readings", "MAE [dB]", "share", "width [dB]"]]
    for count, parts in scores.items():
        means = torch.stack(parts).mean(0).tolist()
        rows.append([str(count), *[f"{mean:.2f}" for mean in means]])
    print(markdown(rows))


def rate(folder: str, scores: dict[int, list]) -> None:
    """Adds error, share and width at each receiver and draw to the scores."""
    links = runs.links_of(folder, True)
    model = gaigs.load(folder)
    # Runs of an earlier version show what the present one makes of their models.
    new = at_new_receivers(model, links)
    model.calibration = replace(new, widths=torch.zeros(len(links.receivers)), elsewhere=new)
    generator = torch.Generator().manual_seed(0)
    test = links.split.test
    for receiver in links.query.receivers[test].unique().tolist():
        index = test[links.query.receivers[test] == receiver]
        for count, parts in scores.items():
            for _ in range(DRAWS if count else 1):
                order = torch.randperm(len(index), generator=generator)
                few = index[order[: max(count, 1)]]
                query = links.query[few]
                query.receivers = torch.zeros_like(query.receivers)
                receivers = (links.receivers[receiver],)
                labels = links.labels[few]
                some = replace(links, query=query, receivers=receivers, labels=labels, split=None)
                moved = model.adapt(some) if count else model.at_receivers(receivers)
                rest = index[~torch.isin(index, few)][::3]
                found = moved.predict(links.query.transmitters[rest], receiver=0, interval=0.9)
                asked = links.labels[rest]
                holds = (found.lower <= asked) & (asked <= found.upper)
                error = (found.value - asked).abs().mean()
                width = (found.upper - found.lower).mean()
                parts.append(torch.stack((error, holds.float().mean(), width)))


if __name__ == "__main__":
    main(sys.argv[1:])
