"""The contract of benchmarks: rows are kept as they are measured, a stopped command goes on, and time is limited."""

import csv
import importlib.util
import time
from pathlib import Path

import pytest

import gaigs
from gaigs.benchmark import UNAVAILABLE, Benchmark, Context, median_and_spread, now, number, table
from gaigs.registry import registry

SCRIPTS = sorted((Path(__file__).parents[2] / "benchmarks").glob("*.py"))


class Squares(Benchmark):
    """Squares of numbers, which take time."""

    name, keys, values = "squares", ("device", "kind", "side"), ("area",)

    def __init__(self, sides, seconds=0.0, fails_at=None):
        self.sides, self.seconds, self.fails_at, self.measured = sides, seconds, fails_at, []

    def cells(self, context: Context):
        return [[{"kind": "square", "side": str(side)}] for side in self.sides]

    def measure(self, cell, context):
        side = int(cell[0]["side"])
        if side == self.fails_at:
            raise KeyboardInterrupt
        time.sleep(self.seconds)
        self.measured.append(side)
        return [cell[0] | ({"area": float(side**2)} if side else {"status": f"{UNAVAILABLE}it has no side"})]

    def tables(self, rows):
        return table(rows, {"side": "side", "area": "area"})


@pytest.fixture(autouse=True)
def named(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("gaigs.benchmark.device_name", lambda device: f"a {device}")


def test_rows_table_and_unavailable_rows(tmp_path):
    Squares([0, 2]).run(tmp_path)
    assert (tmp_path / "squares.csv").read_text().splitlines() == [
        "device,kind,side,area,status", "a cpu,square,0,,unavailable: it has no side", "a cpu,square,2,4,measured"
    ]  # fmt: skip
    assert (tmp_path / "squares.md").read_text() == (
        "| side | area |\n| --- | --- |\n| 2 | 4 |\n\n- square, 0: unavailable: it has no side\n"
    )


def test_names_that_a_spreadsheet_takes_for_formulas_are_read_as_they_were(tmp_path):
    class Named(Squares):
        def cells(self, context):
            return [[{"kind": "=1+1", "side": "2"}]]

    Named([]).run(tmp_path)
    assert "a cpu,'=1+1,2,4,measured" in (tmp_path / "squares.csv").read_text()
    again = Named([])
    again.run(tmp_path)
    assert not again.measured


def test_a_stopped_benchmark_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Squares([1, 2, 3], fails_at=3).run(tmp_path)
    again = Squares([1, 2, 3, 4])
    again.run(tmp_path)
    assert again.measured == [3, 4]
    with open(tmp_path / "squares.csv", newline="") as file:
        assert [row["side"] for row in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_nothing_begins_that_would_end_too_late(tmp_path, caplog):
    short = Squares([1, 2, 3], seconds=0.05)
    short.run(tmp_path, minutes=0.09 / 60)
    assert short.measured == [1]
    assert "squares: time is up, 2 measurements are missing" in caplog.text
    (tmp_path / "squares.md").unlink()
    none = Squares([1, 2])
    none.run(tmp_path, minutes=0)
    assert none.measured == []
    assert "| 1 | 1 |" in (tmp_path / "squares.md").read_text()


def test_each_device_has_its_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    both = Squares([1])
    both.run(tmp_path)
    assert both.measured == [1, 1]
    one = Squares([1])
    one.run(tmp_path, device="cuda")
    assert one.measured == []


@pytest.mark.parametrize("content", [b"a,b\n1,2\n", b"device,kind,side,area,status\nhere,1\n", b""], ids=str)
def test_a_foreign_or_damaged_file_is_kept(tmp_path, content):
    file = tmp_path / "squares.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"squares\.csv must be CSV with the columns device, kind, side, area, status"):
        Squares([1]).run(tmp_path)
    assert file.read_bytes() == content


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"minutes": -1}, r"benchmark\.minutes must be at least 0, or null for no limit, got -1"),
        ({"device": "cuda"}, r"benchmark\.device must be null or one of cpu, got 'cuda'"),
    ],
)
def test_bad_options(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Squares([1]).run(tmp_path, **options)


def test_the_clock_waits_for_the_accelerator(monkeypatch):
    waited = []
    monkeypatch.setattr("torch.cuda.synchronize", lambda: waited.append(True))
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    now()
    assert waited


def test_numbers_are_short():
    texts = ["", "0", "0.00012345", "3.14159", "123.456", "1234567", "2.5e-07", "90 x 360", "1e+08"]
    shown = ["", "0", "1.2e-4", "3.14", "123", "1,234,567", "2.5e-7", "90 x 360", "1.0e8"]
    assert [number(text) for text in texts] == shown
    assert median_and_spread([3.0]) == (3, 0)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["benchmark=step"], "benchmark=step needs command=benchmark"),
        (["command=benchmark", "benchmark=step", "benchmark.repeats=0"], "benchmark.repeats must be at least 1, got 0"),
        (["command=benchmark"], "command=benchmark needs a benchmark; add benchmark=accuracy, budgets, rasterizer"),
        (["command=bench"], "command must be train, benchmark, agreement, describe, survey, locate"),
    ],
)
def test_bad_commands(overrides, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        gaigs.run(gaigs.compose(*overrides), tmp_path)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_can_be_imported(script, monkeypatch):
    if script.stem in ("limits", "guard"):
        pytest.importorskip("pyopencl")
    monkeypatch.syspath_prepend(script.parent)
    spec = importlib.util.spec_from_file_location(script.stem, script)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    registered = registry("tokenizer")._registered
    for name in [name for name, part in registered.items() if part.__module__ == script.stem]:
        del registered[name]  # other tests list the names
