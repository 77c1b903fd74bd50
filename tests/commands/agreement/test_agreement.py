"""The agreement of labels by distance and order, on sets with known answers."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.commands.agreement import run
from gaigs.commands.agreement.expectation import on_split
from gaigs.commands.agreement.pairs import measure, visits
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Split
from gaigs.testing import example_links

TASKS = ("spectrum", "rssi", "csi")
PERFECT = {"spectrum": 1.0, "rssi": 0.0, "csi": 140.0}
SIMULATED = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
MORE = {"rssi": ["data.sensitivity=-300"], "csi": ["data.subcarriers=3"]}
STEP, SLOPE, JUMP, LENGTH = 0.008, 20.0, 5.0, 200
"""Of a transmitter's way [m]; of labels along it [dB/m]; between its passes [dB]; measurements of a
pass.
"""


def seeded():
    return np.random.default_rng(0)


def of_readings(places, labels, receivers=None):
    """Links of RSSI; the last fifth tests."""
    n = len(places)
    links = example_links("rssi")
    train, test = torch.arange(n).split((n - n // 5, n // 5))
    receivers = torch.zeros(n, dtype=torch.long) if receivers is None else receivers
    split = Split("made", train, test[:0], test)
    query = Query(torch.as_tensor(places).float(), receivers)
    kept = {"receivers": links.receivers[: int(receivers.max()) + 1], "rows": None, "split": split}
    return replace(links, query=query, labels=torch.as_tensor(labels).float(), task=Rssi(), **kept)


def two_passes():
    """The same way twice; labels follow the place, and are by a jump larger on the second pass."""
    x = STEP * torch.arange(LENGTH).repeat(2)
    return of_readings(
        torch.stack((x, 0 * x, 0 * x), 1), SLOPE * x + JUMP * (torch.arange(2 * LENGTH) >= LENGTH)
    )


def by_bounds(found, monitor="mae_db"):
    return {(cell.distance, cell.separation): cell for cell in found.cells(monitor)}


# --- cells ---


def test_a_jump_between_passes_is_seen_apart_from_the_slope_along_them():
    found = measure(two_passes(), seeded())
    assert found.has_order
    assert found.separations.tolist() == [3, 30]
    cells = by_bounds(found)
    same, near = cells[(0.0, 0.0), (31, math.inf)], cells[(0.0, 0.01), (0, 3)]
    assert same.pairs == LENGTH
    assert same.quantiles == pytest.approx((JUMP,) * 3, abs=1e-4)
    assert near.pairs == 2 * (LENGTH - 1)
    assert near.quantiles == pytest.approx((SLOPE * STEP,) * 3, abs=1e-4)
    again = cells[(0.0, 0.01), (31, math.inf)]
    assert again.pairs == 2 * (LENGTH - 1)
    assert again.quantiles == pytest.approx(
        (JUMP - SLOPE * STEP, JUMP, JUMP + SLOPE * STEP), abs=0.2
    )


def test_expected_scores_on_a_split():
    """The second pass tests: the nearest known label is always of the same place, and by the jump
    off.
    """
    links = two_passes()
    train, test = torch.arange(2 * LENGTH).split(LENGTH)
    links = replace(links, split=Split("second pass", train, test[:0], test))
    rows, remarks = on_split(
        measure(links, seeded()), links, seeded(), [{"name": "knn", "k": 1, "power": 1.0}]
    )
    assert rows["one label as near"]["mae_db"] == pytest.approx(JUMP, abs=1e-4)
    assert rows["mean of many as near"]["mae_db"] == pytest.approx(JUMP / math.sqrt(2), abs=1e-4)
    assert rows["`knn`"]["mae_db"] == pytest.approx(JUMP, abs=1e-4)
    assert "it is 0 m (median" in remarks[0]
    assert f"and in the order {LENGTH} (median)" in remarks[0]


@pytest.mark.parametrize("task", TASKS)
def test_repeated_places_without_noise_agree_fully(task):
    links = example_links(task)
    twice = torch.arange(24).repeat(2)
    links = replace(links, query=links.query[twice], labels=links.labels[twice], rows=None)
    found = measure(links, seeded())
    (same,) = [cell for cell in found.cells(links.task.monitor) if cell.distance == (0.0, 0.0)]
    assert same.pairs == 24
    assert same.quantiles == pytest.approx((PERFECT[task],) * 3, abs=1e-6)


@pytest.mark.parametrize("counted", [10**9, 3_000])
def test_pairs_are_those_of_one_receiver_and_carrier_each_once(counted):
    random = torch.Generator().manual_seed(0)
    places = torch.rand(90, 3, generator=random)
    receivers, carriers = torch.arange(90) % 2, 1e9 + (torch.arange(90) // 2 % 2).float()
    links = of_readings(places, torch.arange(90), receivers)
    links = replace(links, query=Query(links.query.transmitters, receivers, carriers))
    found, groups = measure(links, seeded(), counted, block=500), receivers + 2 * (carriers > 1e9)
    i, j = torch.combinations(torch.arange(90)).T
    i, j = (ends[groups[i] == groups[j]] for ends in (i, j))
    cells = found.cell((places[i] - places[j]).double().norm(dim=1).numpy(), (j - i).numpy())
    true = np.bincount(cells, minlength=found.pairs.size)
    if counted > 9_000:
        assert found.share == 1
        assert found.pairs.ravel().tolist() == true.tolist()
    else:
        assert found.share < 1
        assert "drawn at random, with all others" in found.remarks()[1]
        assert (found.pairs.ravel() <= true).all()
        assert found.pairs.sum() > found.share * true.sum()
    for (
        cell,
        scores,
    ) in found.scores.items():  # labels are the links' numbers: differences are the separations
        row, column = divmod(cell, len(found.separations) + 1)
        compared = scores["mae_db"].numpy()
        assert len(compared) == found.pairs[row, column]
        assert (np.searchsorted(found.separations, compared) == column).all()
        if counted > 9_000:
            assert sorted(compared) == sorted((j - i).numpy()[cells == cell])


def test_of_many_pairs_random_ones_are_compared():
    links, whole = two_passes(), measure(two_passes(), seeded())
    found, again, other = (
        measure(links, np.random.default_rng(seed), block=10_000, most=30) for seed in (0, 0, 1)
    )
    assert np.array_equal(found.pairs, whole.pairs)
    scores = [
        [values["mae_db"].tolist() for values in drawn.scores.values()]
        for drawn in (found, again, other)
    ]
    assert [len(values) for values in scores[0]] == [
        min(30, count) for count in found.pairs.ravel() if count
    ]
    assert scores[0] == scores[1] != scores[2]
    (remark,) = found.remarks()
    assert "which counts as that of measurement" in remark


def test_files_in_no_order_are_noted():
    links = two_passes()
    shuffled = torch.randperm(len(links), generator=torch.Generator().manual_seed(0))
    links = replace(links, query=links.query[shuffled], labels=links.labels[shuffled])
    found = measure(links, seeded())
    assert not found.has_order
    assert "columns tell nothing of time" in found.remarks()[0]
    cells = by_bounds(found)
    medians = [
        cells[(0.5, 1.0), column].quantiles[1] for column in ((0, 3), (4, 30), (31, math.inf))
    ]
    assert max(medians) - min(medians) < 2


# --- the split ---


def test_test_links_without_a_known_link_are_left_out_and_counted():
    links = two_passes()
    receivers = torch.zeros(len(links), dtype=torch.long)
    receivers[-3:] = 1
    links = replace(links, query=Query(links.query.transmitters, receivers))
    rows, remarks = on_split(measure(links, seeded()), links, seeded(), [])
    assert (
        remarks[0]
        == "3 test links have no known link of their receiver and carrier, and are left out"
    )
    assert [*rows] == ["one label as near", "mean of many as near"]


def test_nothing_is_expected_where_no_test_link_has_a_known_one():
    links = two_passes()
    receivers = torch.zeros(len(links), dtype=torch.long)
    receivers[links.split.test] = 1
    links = replace(links, query=Query(links.query.transmitters, receivers))
    assert on_split(measure(links, seeded()), links, seeded(), [])[0] == {}


def test_baselines_of_large_labels_are_left_out():
    links = two_passes()
    rows, remarks = on_split(
        measure(links, seeded()), links, seeded(), [{"name": "mean"}], looked_up=0
    )
    assert [*rows] == ["one label as near", "mean of many as near"]
    assert remarks[-1].startswith("the baselines are left out")


# --- refused links ---


def test_labels_at_one_place_are_refused():
    with pytest.raises(
        ValueError, match=r"all 10 links have their transmitter at 1, 2, 3 m; check the positions"
    ):
        measure(
            of_readings(torch.tensor([[1.0, 2.0, 3.0]]).expand(10, 3), torch.zeros(10)), seeded()
        )


@pytest.mark.parametrize("n", [1, 2])
def test_links_without_a_pair_are_refused(n):
    links = of_readings(torch.rand(n, 3), torch.zeros(n), torch.arange(n))
    with pytest.raises(ValueError, match=f"no two of {n} links have the same receiver and carrier"):
        measure(links, seeded())


# --- the whole ---


@pytest.mark.parametrize("task", TASKS)
def test_any_task(task, tmp_path, capsys):
    small = ["data.transmitters=40", "data.order=1", *MORE.get(task, [])]
    config = gaigs.compose(f"data={SIMULATED[task]}", *small, "baselines=[{name: mean}]")
    score = example_links(task).task.pair_score
    run(config, tmp_path / "run")
    folder = tmp_path / "run"
    assert {path.name for path in folder.iterdir()} == {"agreement.md", "agreement.png"}
    page, said = (folder / "agreement.md").read_text(), capsys.readouterr().out
    assert page.startswith(f"Median {score} of two labels")
    for row in ("one label as near", "mean of many as near", "mean"):
        assert f"| {row} | " in page.replace("`", "")
        assert row in said
    assert "columns tell nothing of time" in page
    first, *cells = re.findall(r"\), ([\d,]+) ", page)
    pairs = sum(int(count.replace(",", "")) for count in (first, *cells))
    assert pairs == 40 * 39 // 2 * (4 if task == "rssi" else 1)


def test_a_place_that_is_measured_again_counts_anew():
    links = replace(two_passes(), rows=torch.tensor([0, 0, 1, 0, 2]))
    links = replace(links, query=links.query[torch.arange(5)])
    assert visits(links).tolist() == [0, 0, 1, 2, 3]
