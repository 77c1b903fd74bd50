"""Reading one table of signal strengths; tables are written here by hand."""

import re

import pytest
import torch

from gaigs.data import load
from gaigs.testing import check_data

RANDOM = {"name": "random", "test": 0.4, "validation": 0}

FORTH = """\
tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm
1.5,1,1,5,0,2,-40
1.5,1,1,0,0,2.5,-50.25
2.5,1,1,5,0,2,-41
2.5,1,1,0,0,2.5,-100
3.5,1,1,5,0,2,-42
2.5,1,1,5,0,2,-43
3.5,1,1,0,0,2.5,-100.0
4.5,1,1,0,0,2.5,-53
"""
"""A transmitter at four places, heard at two: six readings that were heard, two of them repeated, and two not."""

BACK = FORTH.replace("tx_x,tx_y,tx_z,rx_x,rx_y,rx_z", "rx_x,rx_y,rx_z,tx_x,tx_y,tx_z")
"""The same, but the one that moves is the receiver."""


def read(file, split=RANDOM, **options):
    return load({"name": "rssi_csv", "file": str(file), **options}, split)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "room.csv"
    path.write_text(FORTH)
    return path


def named(links):
    """Links as (x of the moving end, fixed end, label)."""
    names = [links.receivers[k].name for k in links.query.receivers.tolist()]
    return [*zip(links.query.transmitters[:, 0].tolist(), names, links.labels.tolist(), strict=True)]


HEARD = [(1.5, 1, -40), (1.5, 2, -50.25), (2.5, 1, -41), (3.5, 1, -42), (2.5, 1, -43), (4.5, 2, -53)]


@pytest.mark.parametrize(("text", "end", "moving"), [(FORTH, "rx", "transmitter"), (BACK, "tx", "receiver")])
def test_the_end_with_fewer_places_is_the_fixed_one(file, text, end, moving):
    file.write_text(text)
    links = read(file)
    assert named(links) == [(x, f"{end}{k}", dbm) for x, k, dbm in HEARD]
    assert [r.name for r in links.receivers] == [f"{end}1", f"{end}2"]
    assert [r.pose.position.tolist() for r in links.receivers] == [[5, 0, 2], [0, 0, 2.5]]
    assert all(torch.equal(r.pose.rotation, torch.eye(3)) for r in links.receivers)
    assert all(len(r.array) == 1 for r in links.receivers)
    assert (links.task.name, links.task.unit, links.query.frequencies) == ("rssi", "dBm", None)
    assert links.rows.tolist() == [0, 0, 1, 2, 1, 3]
    fixed = {"rx": "receiver", "tx": "transmitter"}[end]
    assert links.remarks == (
        f"6 readings of a moving {moving} at 2 places of a fixed {fixed}; 2 of -100 dBm were not heard and are left out"
    )
    check_data(links)


def test_in_a_tie_the_receiver_is_the_fixed_one(file):
    file.write_text(f"{BACK.splitlines()[0]}\n1,2,3,4,5,6,-50\n2,2,3,5,5,6,-51\n")
    assert [receiver.name for receiver in read(file, split={**RANDOM, "test": 0.5}).receivers] == ["rx1", "rx2"]


def test_the_fixed_end_can_be_told(file):
    links = read(file, fixed="tx")
    assert [r.name for r in links.receivers] == ["tx1", "tx2", "tx3", "tx4"]
    assert [r.pose.position.tolist() for r in links.receivers] == [[x, 1, 1] for x in (1.5, 2.5, 3.5, 4.5)]
    assert links.query.transmitters[:2].tolist() == [[5, 0, 2], [0, 0, 2.5]]
    assert links.remarks.startswith("6 readings of a moving receiver at 4 places of a fixed transmitter;")
    assert read(file, fixed="rx").remarks == read(file).remarks
    with pytest.raises(ValueError, match="fixed must be tx or rx, or null for the end with fewer places, got 'both'"):
        read(file, fixed="both")


def test_the_end_that_was_told_may_not_move(file):
    file.write_text(FORTH.splitlines()[0] + "\n" + "".join(f"{k},1,1,5,0,2,-40\n" for k in range(65)))
    assert len(read(file).receivers) == 1
    with pytest.raises(ValueError, match=r"fixed=tx this end must stand at 64 places at most, got 65 .* set fixed=rx"):
        read(file, fixed="tx")


def test_only_the_mark_is_not_heard(file):
    file.write_text(FORTH.replace("-53", "-120.5").replace("-43", "-200"))
    links = read(file)
    assert links.labels.tolist() == [-40, -50.25, -41, -42, -200, -120.5]
    assert links.remarks.endswith(
        "2 of -100 dBm were not heard and are left out; 2 readings below -100 dBm are taken for levels"
    )
    links = read(file, not_heard=-200)
    assert links.labels.tolist() == [-40, -50.25, -41, -100, -42, -100, -120.5]
    assert links.remarks.endswith("; 1 of -200 dBm were not heard and are left out")


@pytest.mark.parametrize("mark", [127, 0, -999])
def test_the_mark_need_not_be_a_level(file, mark):
    file.write_text(FORTH.replace("-100.0", str(mark)).replace("-100", str(mark)))
    links = read(file, not_heard=mark)
    assert named(links) == [(x, f"rx{k}", dbm) for x, k, dbm in HEARD]
    assert links.remarks.endswith(f"; 2 of {mark} dBm were not heard and are left out")


@pytest.mark.parametrize("mark", [float("nan"), float("inf"), None, "none"])
def test_the_mark_is_a_number(file, mark):
    with pytest.raises((ValueError, TypeError), match=r"not_heard'? must be a (finite )?number"):
        read(file, not_heard=mark)


def test_columns_are_found_by_name_and_others_named(file):
    rows = [line.split(",") for line in FORTH.splitlines()]
    heading, *rows = [["time", row[6], *row[3:6][::-1], "note", *row[:3]] for row in rows]
    heading[5], heading[0], heading[1] = '"Remark"', "\ufefftime", "RSS_dBm"
    file.write_text("\r\n".join(" , ".join(row) for row in [heading, *rows]) + "\r\n\r\n")
    links = read(file)
    assert named(links) == [(x, f"rx{k}", dbm) for x, k, dbm in HEARD]
    assert links.receivers[0].pose.position.tolist() == [5, 0, 2]
    assert links.remarks.endswith("left out; columns ignored: time, Remark")


def test_a_fixed_place_that_nothing_was_heard_at_is_left_out(file):
    file.write_text(re.sub(r"(5,0,2),-\d+", r"\1,-100", FORTH))
    links = read(file)
    assert named(links) == [(1.5, "rx2", -50.25), (4.5, "rx2", -53)]
    assert "6 of -100 dBm" in links.remarks
    assert links.remarks.endswith("and so are the places that nothing was heard at: rx1")


@pytest.mark.parametrize("text", [FORTH, BACK])
def test_readings_of_one_place_of_the_moving_end_stay_together(file, text):
    file.write_text(text)
    for seed in range(6):
        links = read(file, split={**RANDOM, "seed": seed})
        places = [set(links.query.transmitters[part, 0].tolist()) for part in (links.split.train, links.split.test)]
        assert all(places)
        assert places[0].isdisjoint(places[1])


def test_walls_come_from_a_file_where_one_is_given(file, tmp_path):
    (tmp_path / "walls.csv").write_text("x,y\n0,0\n5,0\n5,4\n")
    assert read(file).edges.shape == (0, 2, 3)
    edges = read(file, layout=str(tmp_path / "walls.csv")).edges
    assert edges.tolist() == [[[0, 0, 0], [5, 0, 0]], [[5, 0, 0], [5, 4, 0]]]
    with pytest.raises(ValueError, match=r"no\.csv: missing; expected consecutive wall vertices x,y \[m\]"):
        read(file, layout=str(tmp_path / "no.csv"))


def test_the_configuration_reads_a_small_room(file, configured):
    config = configured("data=rssi_csv", f"data.file={file}")
    before = file.stat().st_mtime_ns
    links = load(config.data, config.split)
    assert links.split.name == "random, test 0.2, validation 0.1, seed 0"
    check_data(links)
    assert file.stat().st_mtime_ns == before


def test_there_is_no_official_split(file):
    with pytest.raises(ValueError, match="no official split; choose split=random"):
        read(file, {"name": "official"})


def test_quoted_cells_may_hold_commas(file):
    heading, *rows = FORTH.splitlines()
    file.write_text("\n".join([f'{heading},"note, if any"', *(f'{row}, "desk, left"' for row in rows)]))
    links = read(file)
    assert named(links) == [(x, f"rx{k}", dbm) for x, k, dbm in HEARD]
    assert links.remarks.endswith("left out; columns ignored: note, if any")


def test_both_ends_may_not_move(file):
    row = "{0},1,1,{0},0,2,-40\n"
    file.write_text(FORTH.splitlines()[0] + "\n" + "".join(map(row.format, range(64))) + "99,1,1,1,0,2,-40\n")
    assert len(read(file).receivers) == 64
    file.write_text(FORTH.splitlines()[0] + "\n" + "".join(map(row.format, range(65))) + "99,1,1,1,0,2,-40\n")
    with pytest.raises(ValueError, match="64 places at most, got 66 of the transmitter and 65 of the receiver: both"):
        read(file)


DEFECTS = {
    "row of nan": (
        ("2.5,1,1,5,0,2,-41", "nan,nan,nan,5,0,2,-41"),
        "room.csv, line 4, columns tx_x, tx_y, tx_z: expected a finite number, got 'nan', 'nan', 'nan'",
    ),
    "far": (
        ("2.5,1,1,5,0,2,-41", "2.5,-1e5,1,5,5400000,2,-41"),
        "room.csv, line 4, columns tx_y, rx_y: expected positions within 1e5 m of the origin on "
        "each axis (subtract a common origin from all), got '-1e5', '5400000'",
    ),
    "reading nan": (
        (",-41", ",nan"),
        "room.csv, line 4, column rss_dbm: expected an RSSI from -200 to below 0 dBm "
        "(-100 where nothing was heard), got 'nan'",
    ),
    "loud": ((",-41", ",20"), "room.csv, line 4, column rss_dbm: expected an RSSI from -200 to below 0 dBm"),
    "quiet": ((",-41", ",-200.5"), "room.csv, line 4, column rss_dbm: expected an RSSI from -200"),
    "zero": ((",-41", ",0"), "room.csv, line 4, column rss_dbm: expected an RSSI"),
    "word": (("1.5,1,1,0", "1.5,one,1,0"), "room.csv, line 3, column tx_y: expected a finite number, got 'one'"),
    "row too long": ((",-41", ",-41,9"), "line 4: expected 7 columns tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm, got 8"),
    "blank line between": (("2.5,", "\n2.5,"), "room.csv, line 4: expected 7 columns"),
    "no column": (("rss_dbm", "rssi"), "room.csv, line 1: expected one column rss_dbm, got 0 in 'tx_x,tx_y,tx_z,rx_x"),
    "column twice": (("tx_y", "tx_x"), "room.csv, line 1: expected one column tx_x, got 2 in 'tx_x,tx_x,"),
    "other case twice": (("tx_y", "TX_X"), "room.csv, line 1: expected one column tx_x, got 2 in 'tx_x,TX_X,"),
    "other delimiter": (
        (FORTH, FORTH.replace(",", ";")),
        "has 1 defect:\n  room.csv, line 1: columns are separated by commas, got semicolons in 'tx_x;tx_y;",
    ),
    "no heading": (
        (FORTH.splitlines()[0] + "\n", ""),
        "room.csv, line 1: expected one column tx_x, got 0 in '1.5,1,1,5,0,2,-40'",
    ),
    "only a heading": ((FORTH, FORTH.splitlines()[0]), "room.csv: no readings below the heading"),
    "empty": ((FORTH, "\n"), "room.csv: empty; expected a heading with tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm"),
    "nothing heard": (
        (FORTH, FORTH.splitlines()[0] + "\n1,2,3,4,5,6,-100\n2,2,3,4,5,6,-100.0\n"),
        "room.csv: expected a reading that was heard, got none but -100 dBm",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_named_with_its_place(file, name):
    (old, new), message = DEFECTS[name]
    assert old in FORTH
    file.write_text(FORTH.replace(old, new, 1))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read(file)
    assert str(file) in str(caught.value)


def test_defects_are_reported_at_once(file, tmp_path):
    file.write_text(FORTH.replace("-41", "41").replace("-53", "").replace("3.5,1,1,5", "3.5,inf,1,5"))
    (tmp_path / "walls.csv").write_text("0,zero\n1,1\n")
    with pytest.raises(ValueError, match="has 4 defects:"):
        read(file, layout=str(tmp_path / "walls.csv"))


def test_a_missing_file_is_named(file):
    with pytest.raises(FileNotFoundError, match=r"none\.csv must be a table of readings, and is no file"):
        read(file.with_name("none.csv"))
