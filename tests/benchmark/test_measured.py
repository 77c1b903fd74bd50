"""Rows of a benchmark are written as they are measured, a stopped one goes on, and time is kept."""

import csv
import time

import pytest

from gaigs.benchmark import NOT_MEASURED, UNAVAILABLE, Context, Glance, Measured, Rows, check_names, clock, device_of
from gaigs.benchmark._page import best, load_now, load_of, number, remarks, table


class Squares(Measured):
    """Squares of numbers, which take time."""

    name, keys, values = "squares", ("device", "side"), ("area",)

    def __init__(self, sides, seconds=0.0, fails_at=None, **options):
        super().__init__(**options)
        self.sides, self.seconds, self.fails_at, self.measured = sides, seconds, fails_at, []

    def cells(self, context):
        return [[{"device": "here", "side": str(side)}] for side in self.sides]

    def measure(self, cell, context):
        side = int(cell[0]["side"])
        if side == self.fails_at:
            raise KeyboardInterrupt
        time.sleep(self.seconds)
        self.measured.append(side)
        yield cell[0] | ({"area": float(side**2)} if side else {"status": f"{UNAVAILABLE}it has no side"})

    def tables(self, rows):
        lines = [[row["side"], number(row["area"])] for row in rows if row["area"]]
        return "## Squares\n\n" + table(["side", "area"], lines) + "\n" + remarks(rows, ("side",))

    def highlights(self, rows):
        return [Glance("a square", row["side"], "0 ms", "none", "here") for row in rows]


def test_rows_tables_and_what_is_unavailable(tmp_path):
    Squares([0, 2]).run(tmp_path, Context())
    assert (tmp_path / "squares.csv").read_text().splitlines() == [
        "device,side,area,status", "here,0,,unavailable: it has no side", "here,2,4,measured"
    ]  # fmt: skip
    assert (tmp_path / "squares.md").read_text() == (
        "## Squares\n\n| side | area |\n| --- | --- |\n| 2 | 4.00 |\n\n- unavailable: 0: it has no side\n"
    )
    assert Squares([9]).section(tmp_path) == (tmp_path / "squares.md").read_text()
    assert [line.where for line in Squares([9]).glance(tmp_path)] == ["0", "2"]


def test_what_is_measured_is_not_measured_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Squares([1, 2, 3], fails_at=3).run(tmp_path, Context())
    again = Squares([1, 2, 3, 4])
    again.run(tmp_path, Context())
    assert again.measured == [3, 4]
    with open(tmp_path / "squares.csv", newline="") as file:
        assert [row["side"] for row in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_a_line_that_a_kill_left_half_written_is_measured_again(tmp_path):
    Squares([1, 2]).run(tmp_path, Context())
    file = tmp_path / "squares.csv"
    file.write_bytes(file.read_bytes()[:-6])
    again = Squares([1, 2])
    again.run(tmp_path, Context())
    assert again.measured == [2]


def test_time_is_up(tmp_path):
    Squares([1, 2, 3], seconds=0.05, minutes=0.06 / 60).run(tmp_path, Context())
    rows = Rows(tmp_path / "squares.csv", Squares.keys, Squares.values).all()
    assert [row["status"] for row in rows] == ["measured", NOT_MEASURED, NOT_MEASURED]
    assert "- not measured, as time was up: 2; 3\n" in (tmp_path / "squares.md").read_text()
    again = Squares([1, 2, 3])
    again.run(tmp_path, Context())
    assert again.measured == [2, 3]


def test_without_a_minute_the_page_is_of_what_is_there(tmp_path):
    Squares([1]).run(tmp_path, Context())
    (tmp_path / "squares.md").unlink()
    again = Squares([1, 2], minutes=0)
    again.run(tmp_path, Context())
    assert again.measured == []
    assert "- not measured, as time was up: 2\n" in (tmp_path / "squares.md").read_text()


def test_a_part_has_no_more_time_than_the_whole():
    whole = Context(deadline=time.monotonic() + 60)
    assert whole.within(minutes=5).seconds_left() <= 60 < Context().within(minutes=5).seconds_left()
    assert whole.within(device="cuda").devices == ("cuda",)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"a,b\n1,2\n", "must have the columns device, side, area, status, got a, b"),
        (b"device,side,area,status\nhere,1\nhere,2,4,measured\n", "line 2, must have 4 values"),
        (b"", "must have the columns device, side, area, status, got nothing"),
        (b"\xff\xfe\x00", "is no text"),
    ],
)
def test_a_file_of_something_else_is_told_and_kept(tmp_path, content, told):
    file = tmp_path / "squares.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=told):
        Squares([1]).run(tmp_path, Context())
    assert file.read_bytes() == content


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"minutes": -1}, r"benchmark\.minutes must be at least 0, or null for no limit, got -1"),
        ({"device": "tpu"}, r"benchmark\.device must be cpu, cuda, or null for each that there is, got 'tpu'"),
    ],
)
def test_options_that_do_not_suit(options, told):
    with pytest.raises(ValueError, match=told):
        Squares([1], **options)


def test_a_device_that_is_not_there(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match=r"benchmark\.device=cuda needs a CUDA device, and torch finds none"):
        Squares([1], device="cuda")


def test_devices_are_told_by_their_names(monkeypatch):
    monkeypatch.setattr("torch.cuda.get_device_name", lambda device: "a graphics card")
    assert device_of({"device": "a graphics card"}, Context(devices=("cpu", "cuda"))) == "cuda"


def test_a_clock_waits_for_the_device(monkeypatch):
    waited = []
    monkeypatch.setattr("torch.cuda.synchronize", lambda: waited.append(True))
    clock("cpu")()
    assert not waited
    clock("cuda")()
    assert waited


def test_the_load_of_the_machine(monkeypatch):
    monkeypatch.setattr("os.getloadavg", lambda: (2.5, 1.0, 1.0))
    assert load_now() == 2.5
    monkeypatch.delattr("os.getloadavg")
    assert load_now() is None
    assert load_of([{"load": "2.51"}, {"load": ""}, {"load": "0.3"}]) == "0.3 to 2.5"
    assert (load_of([{"load": "1"}]), load_of([{"load": ""}])) == ("1.0", "unknown")


def test_names_of_an_option():
    check_names("colours", ["red"], ["red", "green"])
    with pytest.raises(
        ValueError, match=r"benchmark\.colours has 'rad' \(did you mean 'red'\?\), and there are: red, "
    ):
        check_names("colours", ["rad"], ["red", "green"])
    with pytest.raises(ValueError, match=r"benchmark\.colours must have at least one of red, green, got none"):
        check_names("colours", [], ["red", "green"])


def test_numbers_are_short():
    texts = ["", "0", "0.00012345", "3.14159", "123.456", "1234567", "2.5e-07"]
    assert [number(text) for text in texts] == ["", "0.00", "1.2e-4", "3.14", "123", "1.2e6", "2.5e-7"]


def test_what_none_beats_in_both():
    assert best([(3, 1), (1, 9), (2, 9), (2, 4), (4, 1)]) == [(1, 9), (2, 4), (3, 1)]
