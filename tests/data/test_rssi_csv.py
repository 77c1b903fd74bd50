"""Reading one table of signal strengths; tables are written here by hand."""

import math
import re

import pytest
import torch
from damages import replace

import gaigs
from gaigs.data import load, rssi_csv
from gaigs.registry import registry
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
"""A transmitter at four places, heard at two: six readings that were heard, two of them repeated,
and two not.
"""

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
    return [
        *zip(links.query.transmitters[:, 0].tolist(), names, links.labels.tolist(), strict=True)
    ]


HEARD = [
    (1.5, 1, -40),
    (1.5, 2, -50.25),
    (2.5, 1, -41),
    (3.5, 1, -42),
    (2.5, 1, -43),
    (4.5, 2, -53),
]


@pytest.mark.parametrize(
    ("text", "end", "moving"), [(FORTH, "rx", "transmitter"), (BACK, "tx", "receiver")]
)
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
        f"6 readings of a moving {moving} at 2 places of a fixed {fixed}; 2 of -100 dBm were not "
        "heard and are left out"
    )
    check_data(links)


def test_the_fixed_end_can_be_chosen(file):
    links = read(file, fixed="tx")
    assert [r.name for r in links.receivers] == ["tx1", "tx2", "tx3", "tx4"]
    assert [r.pose.position.tolist() for r in links.receivers] == [
        [x, 1, 1] for x in (1.5, 2.5, 3.5, 4.5)
    ]
    assert links.query.transmitters[:2].tolist() == [[5, 0, 2], [0, 0, 2.5]]
    assert links.remarks.startswith(
        "6 readings of a moving receiver at 4 places of a fixed transmitter;"
    )
    assert read(file, fixed="rx").remarks == read(file).remarks
    with pytest.raises(
        ValueError,
        match="fixed must be tx or rx, or null for the end with fewer places, got 'both'",
    ):
        read(file, fixed="both")
    with pytest.raises(TypeError, match="'not_heard' must be a finite number or a list, got nan"):
        read(file, not_heard=math.nan)
    file.write_text(f"{BACK.splitlines()[0]}\n1,2,3,4,5,6,-50\n2,2,3,5,5,6,-51\n")
    tie = read(file, split=RANDOM | {"test": 0.5})
    assert [receiver.name for receiver in tie.receivers] == ["rx1", "rx2"]


def test_a_carrier_is_that_of_all_readings(file):
    assert read(file, frequency=2.44e9).query.frequencies.tolist() == [2.44e9] * 6
    with pytest.raises(ValueError, match="frequency must be a carrier in Hz"):
        read(file, frequency=2.44)


def test_only_the_mark_is_not_heard(file):
    file.write_text(FORTH.replace("-53", "-120.5").replace("-43", "-200"))
    links = read(file)
    assert links.labels.tolist() == [-40, -50.25, -41, -42, -200, -120.5]
    counts = (
        "2 of -100 dBm were not heard and are left out; 2 readings below -100 dBm are taken for "
        "levels"
    )
    assert counts in links.remarks
    links = read(file, not_heard=-200)
    assert links.labels.tolist() == [-40, -50.25, -41, -100, -42, -100, -120.5]
    assert links.remarks.endswith("; 1 of -200 dBm were not heard and are left out")
    file.write_text(FORTH.replace("-100.0", "127").replace("-100", "127"))
    assert named(read(file, not_heard=127)) == [(x, f"rx{k}", dbm) for x, k, dbm in HEARD]


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


def test_walls_come_from_a_file_where_one_is_given(file, tmp_path):
    (tmp_path / "walls.csv").write_text("x,y\n0,0\n5,0\n5,4\n")
    edges = read(file, layout=str(tmp_path / "walls.csv")).edges
    assert edges.tolist() == [[[0, 0, 0], [5, 0, 0]], [[5, 0, 0], [5, 4, 0]]]


def test_levels_of_0_dbm_and_more_are_taken_and_counted(file):
    replace(file, "-41", "0")
    replace(file, "-42", "12.5")
    links = read(file)
    assert links.labels.tolist() == [-40, -50.25, 0, 12.5, -43, -53]
    assert "; 2 readings of 0 dBm or more are taken for levels" in links.remarks


def test_seventy_gateways_are_more_than_the_usual_gaussians(file):
    row = "{1},{0},1,{0},0,2,-{0}\n"
    rows = "".join(row.format(30 + k, x) for k in range(70) for x in (1, 2, 3, 4))
    file.write_text(f"{FORTH.splitlines()[0]}\n{rows}")
    links = read(file, fixed="rx")
    model = registry("model").build(gaigs.compose("+experiment=rssi")["model"], scene=links.scene)
    assert len(model.gaussians) == len(links.receivers) == 70


DEFECTS = [
    ("2.5,1,1,5,0,2,-41", "2.5,-1e5,1,5,5400000,2,-41", ", line 4: expected positions within 1e5 m of the origin on "
     "each axis (subtract a common origin from all), got '-1e5' in column tx_y"),
    (",-41", ",nan", ", line 4: expected an RSSI from -200 to 30 dBm (-100 where nothing was heard), got 'nan'"),
    (",-41", ",-200.5", ", line 4: expected an RSSI from -200"),
    (",-41", ",-41,9", ", line 4: expected 7 columns 'tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm', got 8: '2.5"),
    ("rss_dbm", "rssi", ", line 1: expected one column rss_dbm, got 0 in 'tx_x,tx_y,tx_z,rx_x"),
    (FORTH, FORTH.splitlines()[0] + "\n1,2,3,4,5,6,-100\n2,2,3,4,5,6,-100.0\n", ": expected a reading that was heard"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), DEFECTS)
def test_a_defect_is_named_with_its_place(file, old, new, message):
    replace(file, old, new)
    with pytest.raises(ValueError, match=re.escape(f"{file}{message}")):
        rssi_csv.read(file)


def test_written_links_read_back(file, tmp_path):
    links = read(file)
    rssi_csv.write(tmp_path, links)
    again = read(tmp_path / "room.csv", fixed="rx")
    assert named(again) == named(links)
    assert torch.equal(again.query.transmitters, links.query.transmitters)
