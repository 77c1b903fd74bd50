"""Rows are kept as they are measured, a stopped command goes on, and time is limited."""

import csv
import importlib.util
import time
from pathlib import Path

import pytest
from common import UNAVAILABLE, Benchmark, command_line, median_and_spread, now, number, table

from gaigs.registry import registry

SCRIPTS = sorted((Path(__file__).parents[2] / "benchmarks").glob("*.py"))


class Squares(Benchmark):
    """Squares of numbers, which take time."""

    name, keys, values = "squares", ("device", "kind", "side"), ("area",)

    def __init__(self, folder, sides, *words, seconds=0.0, fails_at=None):
        parser = command_line("", takes_overrides=False)
        super().__init__(parser.parse_args(["--folder", str(folder), *words]))
        self.sides, self.seconds, self.fails_at, self.measured = sides, seconds, fails_at, []

    def cells(self, device):
        return [[{"kind": "square", "side": str(side)}] for side in self.sides]

    def measure(self, cell, device):
        side = int(cell[0]["side"])
        if side == self.fails_at:
            raise KeyboardInterrupt
        time.sleep(self.seconds)
        self.measured.append(side)
        return [
            cell[0]
            | ({"area": float(side**2)} if side else {"status": f"{UNAVAILABLE}it has no side"})
        ]

    def tables(self, rows):
        return table(rows, {"side": "side", "area": "area"})


@pytest.fixture(autouse=True)
def named(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("common.device_name", lambda device: f"a {device}")


def test_rows_table_and_unavailable_rows(tmp_path):
    Squares(tmp_path, [0, 2]).run()
    assert (tmp_path / "squares.csv").read_text().splitlines() == [
        "device,kind,side,area,status", "a cpu,square,0,,unavailable: it has no side", "a cpu,square,2,4,measured"
    ]  # fmt: skip
    assert (tmp_path / "squares.md").read_text() == (
        "| side | area |\n| --- | --- |\n| 2 | 4 |\n\n- square, 0: unavailable: it has no side\n"
    )


def test_names_that_a_spreadsheet_takes_for_formulas_are_read_as_they_were(tmp_path):
    class Named(Squares):
        def cells(self, device):
            return [[{"kind": "=1+1", "side": "2"}]]

    Named(tmp_path, []).run()
    assert "a cpu,'=1+1,2,4,measured" in (tmp_path / "squares.csv").read_text()
    again = Named(tmp_path, [])
    again.run()
    assert not again.measured


def test_a_stopped_benchmark_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Squares(tmp_path, [1, 2, 3], fails_at=3).run()
    again = Squares(tmp_path, [1, 2, 3, 4])
    again.run()
    assert again.measured == [3, 4]
    with open(tmp_path / "squares.csv", newline="") as file:
        assert [row["side"] for row in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_nothing_begins_that_would_end_too_late(tmp_path, caplog):
    short = Squares(tmp_path, [1, 2, 3], "--minutes", str(0.09 / 60), seconds=0.05)
    short.run()
    assert short.measured == [1]
    assert "squares: time is up, 2 measurements are missing" in caplog.text
    (tmp_path / "squares.md").unlink()
    none = Squares(tmp_path, [1, 2], "--minutes", "0")
    none.run()
    assert none.measured == []
    assert "| 1 | 1 |" in (tmp_path / "squares.md").read_text()


def test_each_device_has_its_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    both = Squares(tmp_path, [1])
    both.run()
    assert both.measured == [1, 1]
    one = Squares(tmp_path, [1], "--devices", "cuda")
    one.run()
    assert one.measured == []


@pytest.mark.parametrize(
    "content", [b"a,b\n1,2\n", b"device,kind,side,area,status\nhere,1\n", b""], ids=str
)
def test_a_foreign_or_damaged_file_is_kept(tmp_path, content):
    file = tmp_path / "squares.csv"
    file.write_bytes(content)
    with pytest.raises(
        ValueError,
        match=r"squares\.csv must be CSV with the columns device, kind, side, area, status",
    ):
        Squares(tmp_path, [1]).run()
    assert file.read_bytes() == content


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
