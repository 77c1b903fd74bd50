"""Usual faults of tables of levels: each is named with its place and its cure, or read rightly."""

import re

import numpy as np
import pytest

import gaigs
from gaigs.data import divide, nerf2_rssi, rssi_csv, rssi_wide
from gaigs.data.readings import marks_of, match_names

PLACES = np.array([[x, y] for x in range(8) for y in range(5)]) + 0.25
STANDS = {"apA": (0.0, 0.0, 2.5), "apB": (7.0, 4.0, 2.5), "apC": (2.0, 4.5, 2.0)}
DEGREES = np.column_stack((11.57360 + PLACES[:, 0] / 74260, 48.13860 + PLACES[:, 1] / 111195))
FEET = PLACES + np.array([985000, 210000])


def levels(places=PLACES):
    """Whole levels at the three gateways [dBm]."""
    points = np.column_stack((places, np.ones(len(places))))
    apart = np.linalg.norm(points[:, None] - np.array([*STANDS.values()]), axis=2)
    return np.round(-40 - 27 * np.log10(apart))


def survey(heading="x,y", columns=PLACES, cells=None, separator=","):
    """The text of a wide table."""
    cells = levels() if cells is None else cells
    lines = [",".join((heading, *STANDS)).replace(",", separator)]
    for place, own in zip(columns, cells, strict=True):
        lines.append(separator.join([*(f"{x:.10g}" for x in place), *map(str, own)]))
    return "\n".join(lines) + "\n"


@pytest.fixture
def wide(tmp_path):
    def read(text, gateways=None, **options):
        (tmp_path / "survey.csv").write_text(text)
        if gateways is not None:
            (tmp_path / "aps.csv").write_text(gateways)
            options["gateways"] = str(tmp_path / "aps.csv")
        return rssi_wide.read(tmp_path / "survey.csv", **options)

    return read


def stations(names=STANDS, heading="name,x,y,z", factor=1.0):
    """The text of a table of gateways."""
    rows = zip(names, STANDS.values(), strict=True)
    return "\n".join(
        (heading, *(",".join((name, *(str(factor * x) for x in place))) for name, place in rows))
    )


# --- marks of "not heard" ---


@pytest.mark.parametrize(
    "marks", [(0, 60, 102, -107), (-107,), (-107, -120), (-99, 99), (20,), (0, 1), (-113, -140)]
)
def test_several_marks_are_found_also_where_they_are_rare(marks):
    draw = np.random.default_rng(0)
    own = np.round(draw.normal(-65, 7, (150, 5))).clip(-85, -30)
    rare = draw.random(own.shape) < 0.03
    assert sorted(marks_of(np.where(rare, draw.choice(marks, own.shape), own))) == sorted(marks)


def test_levels_that_repeat_are_no_marks():
    """The floor of weak receivers, alone or after higher levels; one low level; levels above 0 dBm."""
    draw = np.random.default_rng(0)
    own = np.round(draw.normal(-65, 7, (60, 4))).clip(-85, -30)
    weak = np.where(np.arange(4) > 1, -107.0, own)
    fading = np.where((np.arange(4) == 1) & (draw.random((60, 1)) < 0.04), -107.0, own)
    once = own.copy()
    once[3, 1] = min(own.min() - 6, -105)
    for found in (
        weak,
        fading,
        np.where(own == own.min(), -91, own),
        np.linspace(-30, 20, 60)[:, None] + 0 * own,
    ):
        assert marks_of(found) == []


LONG = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm\n" + "".join(
    f"{k}.5,1.25,1,5,0,2,{-40 - k}.5\n" for k in range(9)
)


def test_marks_of_long_tables_are_named_and_may_be_several(tmp_path):
    file = tmp_path / "room.csv"
    file.write_text(
        re.sub(r"-4[1-4]\.5", "60", LONG).replace("-40.5", "0").replace("-45.5", "-107")
    )
    with pytest.raises(
        ValueError,
        match=r'got \'60\' .*\n0 and 60 seem to mean "not heard": list them in data.not_h',
    ):
        rssi_csv.read(file)
    links = rssi_csv.read(file, not_heard=[0, 60, -107])
    assert links.labels.tolist() == [-46.5, -47.5, -48.5]
    assert "6 of -107, 0 and 60 dBm were not heard" in links.remarks


# --- separators and cells ---


@pytest.mark.parametrize(
    ("separator", "point"),
    [(";", ","), (";", "."), ("\t", ","), ("|", "."), (" ", "."), (" ", ",")],
)
def test_every_reader_takes_the_same_separators(tmp_path, wide, rssi_folder, separator, point):
    def other(text):
        return text.replace(",", separator).replace(".", point)

    (tmp_path / "a.csv").write_text(LONG)
    (tmp_path / "b.csv").write_text(other(LONG))
    pairs = [(rssi_csv.read(tmp_path / "a.csv"), rssi_csv.read(tmp_path / "b.csv"))]
    pairs.append((wide(survey()), wide(other(survey()))))
    before = nerf2_rssi.read(rssi_folder)
    for name in ("tx_pos.csv", "gateway_rssi.csv"):
        (rssi_folder / name).write_text(other((rssi_folder / name).read_text()))
    pairs.append((before, nerf2_rssi.read(rssi_folder)))
    for a, b in pairs:
        assert a.labels.tolist() == b.labels.tolist()
        assert a.query.transmitters.tolist() == b.query.transmitters.tolist()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3.5,1.25,1,5,0,2,-43.5", "3.5;1.25;1;5;0;2;-43.5", "got 1: '3.5;1.25;1;5;0;2;-43.5'; columns separated by"),
        ("3.5,1.25,1,5,0,2,-43.5", "3,5,1,1,5,0,2,-43,5", "'3,5,1,1,5,0,2,-43,5'; decimal commas? write points"),
        ("-43.5", "-43 -44", "line 5: expected an RSSI from -200 to 30 dBm (-100 where nothing was heard), got "
         "'-43 -44', several numbers, in column rss_dbm"),
        ("3.5,1.25", '"3,5",1.25', "line 5: expected a finite number, got '3,5', with a decimal comma, in column tx_x"),
        ("3.5,1.25", "[3.5 1.0],1.25", "line 5: expected a finite number, got '[3.5 1.0]', several numbers, in"),
    ],
)  # fmt: skip
def test_cells_with_other_marks_are_named(tmp_path, old, new, message):
    (tmp_path / "room.csv").write_text(LONG.replace(old, new))
    with pytest.raises(ValueError, match=re.escape(message)):
        rssi_csv.read(tmp_path / "room.csv")


def test_levels_with_their_unit_are_read(tmp_path):
    (tmp_path / "room.csv").write_text(LONG.replace(".5\n", ".5 dBm\n"))
    assert rssi_csv.read(tmp_path / "room.csv").labels[0] == -40.5


@pytest.mark.parametrize("second", [";-51", " -51", "/-51", "|-51"])
def test_several_levels_in_a_cell_are_named(wide, second):
    cells = [[f"{level:g}{second}" for level in row] for row in levels()]
    with pytest.raises(
        ValueError,
        match=r"line 2: expected one level \[dBm\] a cell, got '-45.-51', several numbers, in",
    ):
        wide(survey(cells=cells))


def test_one_column_for_x_and_y_is_named(wide):
    with pytest.raises(ValueError, match="column pos holds several numbers: give each its column"):
        wide(
            "pos,apA,apB\n"
            + "".join(f"{x} {y},-5{k % 10},-6{k % 9}\n" for k, (x, y) in enumerate(PLACES))
        )


# --- forms of tables, powers ---


def test_readers_of_long_and_wide_tables_name_each_other(tmp_path, wide):
    (tmp_path / "room.csv").write_text(survey())
    with pytest.raises(ValueError, match="a gateway a column takes data=rssi_wide"):
        rssi_csv.read(tmp_path / "room.csv")
    with pytest.raises(
        ValueError, match=r"line 1: a table of a reading a line, .*; take data=rssi_csv"
    ):
        wide(LONG)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_powers_are_no_levels(wide, unit):
    powers = unit * 10 ** (levels() / 10)
    with pytest.raises(
        ValueError, match=r"got powers in W or mW in apA, apB, apC\nwrite 10 log10\(P / 1 mW\)"
    ):
        wide(survey(cells=powers))
    cells = [
        [f"{row[0]}", *map(str, power[1:])] for row, power in zip(levels(), powers, strict=True)
    ]
    assert (
        "columns ignored: apB (powers in W or mW?), apC (powers"
        in wide(survey(cells=cells)).remarks
    )


# --- coordinates ---


@pytest.mark.parametrize(
    ("heading", "columns", "options"),
    [
        ("x,y", DEGREES, {}),
        ("x,y", DEGREES[:, ::-1], {}),
        ("x,y", PLACES * 0.02137 + np.array([4.4, 51.2]), {}),
        ("easting,northing", DEGREES, {"epsg": 32632}),
    ],
)
def test_degrees_among_metres_are_named(wide, heading, columns, options):
    names = heading.replace(",", " and ")
    message = (
        rf"columns {names}: expected metres, got .*, which look like degrees\nset data.epsg=4326 "
        r"and data.coord"
    )
    with pytest.raises(ValueError, match=message):
        wide(survey(heading, columns), **options)


def test_degrees_of_gateways_and_arrays_are_named(wide):
    rows = [
        f"{name},{x:.7f},{y:.7f},2\n" for name, (x, y) in zip(STANDS, DEGREES[::16], strict=True)
    ]
    with pytest.raises(
        ValueError, match=r"aps\.csv: expected metres, got such as \(11\.573\d*, 48"
    ):
        wide(survey(), "name,x,y,z\n" + "".join(rows))
    places = np.column_stack((DEGREES, np.ones(40)))
    with pytest.raises(
        ValueError, match=r"transmitters: expected metres, .* look like degrees\nconvert them"
    ):
        gaigs.links(
            task="rssi", transmitters=places, receivers=places[:1] + 1e-6, labels=levels()[:, :1]
        )


@pytest.mark.parametrize("span", [0.04, 1.0, 30.0, 1000.0])
def test_metres_far_from_the_origin_are_no_degrees(wide, span):
    """Grids of a positioner, random places, and a small room beside its survey's origin."""
    draw = np.random.default_rng(0)
    grid = (span * PLACES / 8 + np.array([11.0, 48.0])).round(4)
    spread = span * draw.random((40, 2)) + np.array([2.0, 1.0]) * (1 if span < 1 else 48)
    for columns in (grid, spread):
        assert len(wide(survey(columns=columns))) == 120


@pytest.mark.parametrize(
    ("heading", "columns"), [("lat,lon", PLACES), ("lon,lat", PLACES * 5), ("lon,lat", PLACES * 12)]
)
def test_metres_among_degrees_are_named(wide, heading, columns):
    with pytest.raises(
        ValueError,
        match=r"span .* and .* degrees, beyond 100 km; if they are metres, name them x and y",
    ):
        wide(survey(heading, columns))
    with pytest.raises(
        ValueError, match=r"columns x and y span 7 and 4 degrees, .* without data\.epsg"
    ):
        wide(survey(), epsg=4326)
    assert wide(survey("lon [m],lat [m]", PLACES)).frame is None


def test_coordinates_in_feet_are_scaled_once(wide):
    pytest.importorskip("pyproj")
    plain, named = (
        wide(survey("x,y", FEET), epsg=2263),
        wide(survey("x [ft],y [ft]", FEET), epsg=2263),
    )
    assert plain.frame == named.frame
    assert plain.query.transmitters.tolist() == named.query.transmitters.tolist()
    metres = FEET[:, ::-1] * 0.3048 + np.array([5e5, 4e6])
    utm = wide(survey("x [ft],y [ft]", metres / 0.3048), epsg=32632)
    assert utm.frame.x == np.floor(metres[:, 0].min())


@pytest.mark.parametrize(
    ("heading", "epsg", "kind"),
    [
        ("x [m],y [m]", 2263, "units of 0.304801 m"),
        ("x,y [cm]", 2263, "units of 0.3"),
        ("x [m],y [m]", 4326, "degrees"),
    ],
)
def test_a_heading_against_its_system_is_refused(wide, heading, epsg, kind):
    pytest.importorskip("pyproj")
    with pytest.raises(
        ValueError, match=rf"line 1: column . \[c?m\] is in units of .*{kind}.*\nmend the heading"
    ):
        wide(survey(heading, FEET), epsg=epsg)


# --- gateways ---


@pytest.mark.parametrize(
    "names", [("ap A", "AP_B", "ap-c"), ("APA", "ap b", "ap:C"), ("apA", "apB", "ap C")]
)
def test_names_are_matched_without_blanks_and_case(wide, names):
    links = wide(survey(), stations(names))
    assert [receiver.pose.position.tolist() for receiver in links.receivers] == [
        [*place] for place in STANDS.values()
    ]


def test_ambiguous_and_other_names_are_not_matched(wide):
    assert match_names(["ap 1", "ap_1", "AP2"], ["ap1", "ap2", "Ap2"]) == {}
    assert match_names(["ap1", "ap 1"], ["ap1", "ap-1"]) == {"ap1": "ap1"}
    remarks = wide(survey(), stations(("apA", "apB", "appC"))).remarks
    assert "gateways of aps.csv without a column: 'appC' (did you mean 'apC'?)" in remarks
    with pytest.raises(
        ValueError,
        match=r"none of its gateways is a column of survey.csv: x, y, z\nthe columns are apA",
    ):
        wide(survey(), stations(("x", "y", "z")))


def test_columns_of_the_folder_layout_are_matched_alike(rssi_folder):
    before = nerf2_rssi.read(rssi_folder)
    file = rssi_folder / "gateway_rssi.csv"
    text = file.read_text()
    file.write_text(text.replace("west,east,attic", "West, ea st,at-tic"))
    after = nerf2_rssi.read(rssi_folder)
    assert [each.name for each in after.receivers] == [each.name for each in before.receivers]
    file.write_text(text.replace("attic", "atic"))
    with pytest.raises(
        ValueError, match=r"column 'atic' \(did you mean 'attic'\?\) has no position in"
    ):
        nerf2_rssi.read(rssi_folder)


@pytest.mark.parametrize(
    ("unit", "factor", "doubt"), [("cm", 100, "if rx are in cm"), ("mm", 1000, "are places in mm?")]
)
def test_gateways_in_another_unit_are_converted_or_doubted(wide, unit, factor, doubt):
    heading = f"name,x [{unit}],y [{unit}],z [{unit}]"
    links = wide(survey(), stations(heading=heading, factor=factor))
    np.testing.assert_allclose(links.receivers[1].pose.position, STANDS["apB"])
    split = {"name": "random", "test": 0.2, "validation": 0.1, "seed": 0}
    assert doubt not in divide(links, split).remarks
    assert doubt in divide(wide(survey(), stations(factor=factor)), split).remarks


def test_gateways_of_a_campus_around_a_small_survey_are_in_metres(wide):
    draw = np.random.default_rng(0)
    apart = np.linalg.norm(PLACES[:, None] - 100 * np.array([*STANDS.values()])[:, :2], axis=2)
    cells = np.round(-20 - 30 * np.log10(apart + 1) + draw.normal(0, 4, apart.shape))
    split = {"name": "random", "test": 0.2, "validation": 0.1, "seed": 0}
    remarks = divide(wide(survey(cells=cells), stations(factor=100)), split).remarks
    assert "are in cm" not in remarks
