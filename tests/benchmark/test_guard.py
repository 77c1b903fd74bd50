"""No part has become slower or less exact than its committed baseline says; and the guard sees it where one has."""

import functools
import json
import time
from pathlib import Path

import pytest
import torch

from gaigs.benchmark import Context, guard
from gaigs.benchmark.guard import Guard, machine, read_baselines, told
from gaigs.registry import registry

BASELINE = Path(__file__).with_name("baseline.json")


def test_nothing_has_become_slower_or_less_exact(tmp_path):
    if machine() not in read_baselines(BASELINE):
        pytest.skip(
            f"no baseline for {machine()}; python -m gaigs command=benchmark benchmark=guard benchmark.record=true "
            "records one"
        )
    Guard(str(BASELINE)).run(tmp_path, Context())


@pytest.mark.parametrize(
    ("kind", "found", "baseline", "is_lost"),
    [
        ("ratio", 0.71, 1.0, False),
        ("ratio", 0.69, 1.0, True),
        ("ratio", 5.0, 1.0, False),
        ("error", 9e-7, 1e-7, False),
        ("error", 1.1e-6, 1e-7, True),
        ("error", 5e-15, 1e-17, False),
        ("error", float("nan"), 1e-7, True),
        ("ratio", 0.1, "", False),
    ],
)
def test_what_counts_as_lost(kind, found, baseline, is_lost):
    row = {"quantity": "torch, common, forward", "kind": kind, "found": str(found), "baseline": str(baseline)}
    assert bool(told(row)) is is_lost


@pytest.fixture
def torch_alone(monkeypatch):
    """One pair of ratios, of a rasterizer that needs no driver."""
    monkeypatch.setattr(guard, "TIMED", {("torch", "common"): (40, 16, 24)})
    monkeypatch.setattr(guard, "CHECKED", {"common": (40, 16, 24)})
    monkeypatch.setattr(guard, "RATIOS", guard.quantities(("torch", "common"))[0])
    monkeypatch.setattr(guard, "ERRORS", guard.quantities(("torch", "common"))[1])
    monkeypatch.setattr(guard, "DOUBLE", ())
    guard._checked.cache_clear()
    yield
    guard._checked.cache_clear()


def twice(function):
    """A function that does its work twice, and some more."""

    @functools.wraps(function)
    def slowed(*arguments):
        function(*arguments)
        begin = time.process_time()
        while time.process_time() - begin < 0.02:
            pass
        return function(*arguments)

    return slowed


def test_a_baseline_is_recorded_and_a_slower_or_wrong_kernel_is_seen(tmp_path, monkeypatch, torch_alone):
    file = tmp_path / "baseline.json"
    Guard(str(file), record=True, repeats=3).run(tmp_path, Context())
    assert json.loads(file.read_text())[machine()].keys() == {*guard.RATIOS, *guard.ERRORS}
    assert "torch, common, backward" in (tmp_path / "guard.md").read_text()

    rasterizer = registry("rasterizer").get("torch")
    draw, compare = rasterizer.__call__, Guard(str(file), repeats=3)
    monkeypatch.setattr(rasterizer, "__call__", twice(draw))
    with pytest.raises(ValueError, match=r"the speed of torch, common, forward is 0\.0"):
        compare.run(tmp_path, Context())
    monkeypatch.setattr(rasterizer, "__call__", lambda *given: tuple(part + 1e-3 for part in draw(*given)))
    with pytest.raises(ValueError, match=r"torch, common, forward, error is 0\.00"):
        compare.run(tmp_path, Context())


def test_elsewhere_nothing_fails_and_that_is_told(tmp_path, torch_alone, caplog):
    Guard(str(tmp_path / "none.json"), repeats=1).run(tmp_path, Context())
    assert "none.json has no baseline of this machine" in caplog.text


@pytest.mark.parametrize("content", ["{", "[]", '{"a": 1}', '{"a": {"b": "c"}}'])
def test_a_damaged_file_of_baselines_is_told(tmp_path, content):
    file = tmp_path / "baseline.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"baseline\.json must be JSON with ratios and errors by machine"):
        read_baselines(file)


def test_a_guard_repeats(tmp_path):
    with pytest.raises(ValueError, match=r"benchmark\.repeats must be at least 1, got 0"):
        Guard("file", repeats=0)


def test_threads_are_as_before(torch_alone):
    threads = torch.get_num_threads()
    guard.watch({}, 1)
    assert torch.get_num_threads() == threads
