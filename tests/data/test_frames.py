"""Links of data frames: the same as those of the files that they would be written to."""

import contextlib
import importlib
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import pyplot

import gaigs

README = Path(__file__).parents[2] / "README.md"

RNG = np.random.default_rng(0)
PLACES = RNG.uniform(0, 20, (60, 2)).round(3)
APS = {"ap-a": [6.0, 5.0, 2.5], "ap-b": [18.0, 15.0, 2.5], "ap-c": [9.0, 19.0, 2.5]}


def make_levels():
    heights = np.ones((len(PLACES), 1))
    apart = np.hstack((PLACES, heights))[:, None] - np.array([*APS.values()])  # (n, k, 3)
    levels = -40 - 25 * np.log10(np.linalg.norm(apart, axis=2)) + RNG.normal(0, 2, apart.shape[:2])
    return np.where(levels < -72, np.nan, levels.round(2))


LEVELS = make_levels()
WIDE = {"x": PLACES[:, 0], "y": PLACES[:, 1], **dict(zip(APS, LEVELS.T, strict=True))}
HEARD = ~np.isnan(LEVELS)
LONG = {
    "x": WIDE["x"].repeat(3)[HEARD.ravel()],
    "y": WIDE["y"].repeat(3)[HEARD.ravel()],
    "bssid": np.tile([*APS], 60)[HEARD.ravel()],
    "rssi": LEVELS.ravel()[HEARD.ravel()],
}


def write_csv(path, columns):
    rows = zip(*columns.values(), strict=True)
    lines = [",".join("" if value != value else str(value) for value in row) for row in rows]
    path.write_text("\n".join((",".join(columns), *lines)) + "\n")


def assert_same(a, b):
    assert torch.equal(a.query.transmitters, b.query.transmitters)
    assert torch.equal(a.query.receivers, b.query.receivers)
    assert torch.equal(a.labels, b.labels)
    assert torch.equal(a.split.test, b.split.test)
    for first, second in zip(a.receivers, b.receivers, strict=True):
        assert first.name == second.name
        assert torch.equal(first.pose.position, second.pose.position)
    assert a.remarks == b.remarks.replace("data.", "").replace("aps.csv", "receivers")


def test_a_frame_has_the_links_of_its_file(tmp_path):
    write_csv(tmp_path / "survey.csv", WIDE)
    stands = np.array([*APS.values()])
    aps = {"name": [*APS], "x": stands[:, 0], "y": stands[:, 1], "z": stands[:, 2]}
    write_csv(tmp_path / "aps.csv", aps)
    file = tmp_path / "survey.csv"
    unknown = gaigs.links("rssi_wide", file=file)
    assert_same(gaigs.links(WIDE), unknown)
    assert "estimated from the training links" in unknown.remarks
    known = gaigs.links("rssi_wide", file=file, gateways=tmp_path / "aps.csv")
    for receivers in (APS, aps, {name: np.array(place) for name, place in APS.items()}):
        assert_same(gaigs.links(WIDE, receivers=receivers), known)


def test_a_reading_a_row_has_the_links_of_its_file(tmp_path):
    write_csv(tmp_path / "readings.csv", LONG)
    options = {"receiver": "bssid", "level": "rssi"}
    filed = gaigs.links("rssi_wide", file=tmp_path / "readings.csv", **options)
    assert_same(gaigs.links(LONG, **options), filed)
    wide = gaigs.links(WIDE)
    assert len(filed) == len(wide)
    assert [receiver.name for receiver in filed.receivers] == [*APS]


def test_eight_lines_of_the_readme_lead_from_a_survey_to_a_map_with_its_uncertainty(tmp_path):
    fenced = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    (code,) = [block for block in fenced if "survey.csv" in block]
    assert len([line for line in code.splitlines() if line]) <= 8
    write_csv(tmp_path / "survey.csv", LONG)
    pyplot.switch_backend("agg")
    names = {}
    with contextlib.chdir(tmp_path):
        exec(code, names)
    pyplot.close("all")
    assert (tmp_path / "floor.png").stat().st_size > 10_000
    assert np.load(tmp_path / "floor.npz")["deviations"].min() > 0
    floor = names["floor"]
    assert np.isfinite(floor.values).all()
    for receiver in names["links"].receivers:
        apart = receiver.pose.position - torch.tensor(APS[receiver.name])
        assert apart[:2].norm() < 3


def test_repeated_readings_of_a_row_each_are_averaged():
    twice = {name: np.concatenate((column, column)) for name, column in LONG.items()}
    twice["rssi"][len(LONG["rssi"]) :] += 2.0
    once = gaigs.links(LONG, receiver="bssid", level="rssi")
    links = gaigs.links(twice, receiver="bssid", level="rssi")
    torch.testing.assert_close(links.labels, once.labels + 1.0)
    assert "scatter by 1.4 dB" in links.remarks


def test_strong_receivers_count_where_they_are_named():
    loud = {**LONG, "rssi": LONG["rssi"] + 45}
    links = gaigs.links(loud, receiver="bssid", level="rssi")
    assert len(links) == len(LONG["rssi"])
    wide = {name: column + 45 if name in APS else column for name, column in WIDE.items()}
    assert len(gaigs.links(wide, receivers=[*APS])) == len(LONG["rssi"])


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_frames_of_any_library_are_the_same_links(library):
    module = pytest.importorskip(library)
    frame = module.table(WIDE) if library == "pyarrow" else module.DataFrame(WIDE)
    assert_same(gaigs.links(frame), gaigs.links(WIDE))


@pytest.mark.parametrize("protocol", ["__arrow_c_stream__", "__dataframe__"])
def test_frames_of_either_protocol_are_the_same_links(protocol):
    table = pytest.importorskip("pyarrow").table(WIDE)
    other = type("Other", (), {protocol: lambda self, *a, **k: getattr(table, protocol)(*a, **k)})
    assert_same(gaigs.links(other()), gaigs.links(WIDE))


def test_a_protocol_without_pyarrow_names_the_package(monkeypatch):
    monkeypatch.setitem(importlib.sys.modules, "pyarrow", None)
    other = type("Other", (), {"__arrow_c_stream__": None})
    with pytest.raises(ImportError, match="are read by pyarrow: pip install pyarrow"):
        gaigs.links(other())


def test_a_pivoted_frame_has_its_places_in_the_index():
    pandas = pytest.importorskip("pandas")
    pivoted = pandas.DataFrame(LONG).pivot_table(index=["x", "y"], columns="bssid", values="rssi")
    links = gaigs.links(pivoted, receivers=APS)
    assert len(links) == len(LONG["rssi"])


def test_missing_values_of_any_kind_are_not_heard():
    levels = {
        "x": [1, 2, 1, 2],
        "y": [1, 1, 2, 2],
        "door": [-40.5, None, "NA", -45],
        "hall": [float("-inf"), -41, -42, float("nan")],
    }
    links = gaigs.links(levels, receivers={"door": [0, 0, 2], "hall": [3, 3]})
    assert sorted(links.labels.tolist()) == [-45, -42, -41, -40.5]
    assert links.receivers[1].pose.position.tolist() == [3, 3, 1]
    assert "all places are 1 m high (height)" in links.remarks
    assert links.query.transmitters[:, 2].unique().tolist() == [1]


def test_some_receivers_may_have_no_place():
    links = gaigs.links(WIDE, receivers={**APS, "ap-b": None})
    assert (links.uncertainties > 0).tolist() == [False, True, False]
    found = links.receivers[1].pose.position
    assert (found - torch.tensor(APS["ap-b"])).norm() < 3


@pytest.mark.parametrize(
    ("frame", "options", "message"),
    [
        (WIDE, {"x": "xx"}, r"data frame: expected a column 'xx', got x, y, ap-a.*\(did you mean 'x'"),
        (WIDE, {"x": "x", "y": "x"}, "x=, y= and z= must be different columns"),
        (LONG, {"receiver": "bssid", "level": "x"}, "level='x' must differ from each other and from the coord"),
        (WIDE, {"receivers": ["ap-d"]}, r"expected a column 'ap-d', got .*did you mean 'ap-"),
        (WIDE, {"receivers": {"bridge": [0, 0, 2]}}, "none of its gateways is a column of data frame"),
        (WIDE, {"receivers": {"ap-a": 3.0}}, "receivers: ap-a must be 3 finite numbers"),
        (WIDE, {"receivers": {"ap-a": [0]}}, "receivers: ap-a must be 3 finite numbers"),
        (WIDE, {"recievers": APS}, r"have no option 'recievers' \(did you mean 'receivers'"),
        (dict(zip(APS, LEVELS.T, strict=True)), {}, "data frame: expected columns x and y, .* name them by x=, y= and z="),
        ({"x": WIDE["x"], "y": WIDE["y"]}, {}, "expected columns of levels .* or name gateways by receivers"),
        (LONG, {}, "column bssid seems to name .* set receiver='bssid' and level='rssi', or ignore='bssid'"),
        (LONG, {"receiver": "bssid"}, "a reading a row takes receiver and level; set level, one of"),
        (LONG, {"receiver": "bsid", "level": "rssi"}, "expected a column 'bsid', .*did you mean 'bssid'"),
        (LONG, {"receiver": "bssid", "level": "rssi", "receivers": ["ap-a"]}, "choose rows in the frame"),
        ({**WIDE, "x": ["far", *WIDE["x"][1:]]}, {}, "data frame, row 0: expected a finite number, got 'far' in column x"),
        ({**WIDE, "ap-a": [-3000.0, *LEVELS[1:, 0]]}, {}, "row 0: expected a level .* got '-3000.0' in column ap-a"),
        ({**WIDE, "ap-a": [-60.0]}, {}, r"expected rows and columns of one length, got \[1, 60\]"),
        ({}, {}, "expected rows and columns of one length"),
    ],
)  # fmt: skip
def test_mistakes_end_in_two_lines_that_help(frame, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        gaigs.links(frame, **options)
    assert str(caught.value).count("\n") <= 1
    assert "data." not in str(caught.value)


def test_columns_may_have_numbers_and_line_breaks_for_names():
    numbered = dict(enumerate(LONG.values()))
    links = gaigs.links(numbered, x=0, y=1, receiver=2, level=3)
    assert_same(links, gaigs.links(LONG, receiver="bssid", level="rssi"))
    renamed = {name.replace("ap-a", "ap\na"): column for name, column in WIDE.items()}
    assert gaigs.links(renamed).receivers[0].name == "ap\na"


def test_options_of_a_wrong_type_are_named():
    with pytest.raises(TypeError, match="height must be a number, got '1'"):
        gaigs.links(WIDE, height="1")
    with pytest.raises(TypeError, match="height must be a number, got '1'"):
        gaigs.links(task="rssi", transmitters=PLACES, labels=LEVELS, height="1")


def test_an_array_alone_is_refused():
    with pytest.raises(TypeError, match="got ndarray; name arrays: task=, transmitters="):
        gaigs.links(PLACES)


# --- arrays ---


def test_arrays_may_have_receivers_of_unknown_place():
    arrays = {"task": "rssi", "transmitters": PLACES, "labels": LEVELS}
    places = np.array([*APS.values()])
    for receivers in (None, [None] * 3, np.full((3, 3), np.nan), dict.fromkeys(APS)):
        links = gaigs.links(**arrays, receivers=receivers)
        found = torch.stack([receiver.pose.position for receiver in links.receivers]).numpy()
        assert np.linalg.norm(found - places, axis=1).max() < 3
        assert "places of 3 receivers are estimated" in links.remarks
    some = gaigs.links(**arrays, receivers=[None, *places[1:].tolist()])
    assert (some.uncertainties > 0).tolist() == [True, False, False]
    assert "all places are 1 m high (height)" in some.remarks


def test_frames_of_labels_name_the_receivers():
    labels = dict(zip(APS, LEVELS.T, strict=True))
    backwards = dict(reversed(APS.items()))
    links = gaigs.links(task="rssi", transmitters=PLACES, labels=labels, receivers=backwards)
    assert [receiver.name for receiver in links.receivers] == [*APS]
    assert links.receivers[1].pose.position.tolist() == APS["ap-b"]
    with pytest.raises(ValueError, match=r"no column 'ap-x' \(did you mean 'ap-"):
        gaigs.links(task="rssi", transmitters=PLACES, labels=labels, receivers={"ap-x": [0, 0, 0]})
    with pytest.raises(ValueError, match="must be one a column of labels, ap-a, ap-b, ap-c, got 1"):
        gaigs.links(task="rssi", transmitters=PLACES, labels=labels, receivers=[[0, 0, 0]])


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_single_column_is_an_array(library):
    column = pytest.importorskip(library).Series(LEVELS[:, 0])
    arrays = {"task": "rssi", "transmitters": PLACES, "receivers": APS["ap-a"]}
    links = gaigs.links(**arrays, labels=column)
    assert torch.equal(links.labels, gaigs.links(**arrays, labels=LEVELS[:, 0]).labels)
    with pytest.raises(TypeError, match="got Series"):
        gaigs.links(column)


def test_spectra_need_receivers_with_a_place():
    task = gaigs.links("synthetic", transmitters=10, order=0).task
    labels = np.zeros((60, *task.shape))
    with pytest.raises(ValueError, match="receivers must have positions for task 'spectrum'; only"):
        gaigs.links(task=task, transmitters=PLACES, labels=labels)
