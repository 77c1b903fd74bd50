"""Reading the NeRF² layout of signal strengths; folders are written here by hand."""

import os
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from gaigs.configuration import conf_dir
from gaigs.data.nerf2_rssi import read
from gaigs.registry import registry
from gaigs.testing import check_data

OFFICIAL = {"protocol": "official", "validation": 0}

READINGS = """\
west,east,attic
-50.5,-61,-100
-52,-100,-80
-54,-65,-100
-100,-100,-100
-58.25,-69,-88
-60,-71,-90
"""
"""Twelve readings that were heard, and six that were not."""


@pytest.fixture
def folder(tmp_path):
    """Six rows at three gateways, which stand in another order than the columns."""
    root = tmp_path / "flat"
    root.mkdir()
    (root / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k}.5,{-k},0.25\n" for k in range(6)))
    (root / "gateway_rssi.csv").write_text(READINGS)
    (root / "gateway_position.yml").write_text("east: [5.0, 1, 2]\nwest:\n- 0.5\n- 1\n- 2\nattic: [3, 1, 4.5]\n")
    (root / "train_index.txt").write_text("4\n0\n1\n")
    (root / "test_index.txt").write_text("5\n2\n")
    return root


def replace(folder, file, old, new):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))


def named(links, index=slice(None)):
    """Links as (x of the transmitter, gateway, label)."""
    names = [links.receivers[k].name for k in links.receiver_index[index].tolist()]
    return [*zip(links.transmitters[index, 0].tolist(), names, links.labels[index].tolist(), strict=True)]


def test_every_reading_that_was_heard_is_a_link(folder):
    links = read(folder, OFFICIAL)
    assert named(links) == [
        (0.5, "west", -50.5),
        (0.5, "east", -61),
        (1.5, "west", -52),
        (1.5, "attic", -80),
        (2.5, "west", -54),
        (2.5, "east", -65),
        (4.5, "west", -58.25),
        (4.5, "east", -69),
        (4.5, "attic", -88),
        (5.5, "west", -60),
        (5.5, "east", -71),
        (5.5, "attic", -90),
    ]
    assert links.transmitters[6].tolist() == [4.5, -4, 0.25]
    positions = {r.name: r.pose.position.tolist() for r in links.receivers}
    assert positions == {"west": [0.5, 1, 2], "east": [5, 1, 2], "attic": [3, 1, 4.5]}
    assert all(torch.equal(r.pose.rotation, torch.eye(3)) for r in links.receivers)
    assert (links.grid, links.normalisation) == (None, "dBm")
    assert links.edges.shape == (0, 2, 3)
    check_data(links)


def test_the_official_parts_are_those_of_the_index_files(folder):
    split = read(folder, OFFICIAL).split
    assert split.train.tolist() == [0, 1, 2, 3, 6, 7, 8]
    assert split.test.tolist() == [4, 5, 9, 10, 11]


def test_the_remarks_count_what_is_left_out(folder):
    assert read(folder, OFFICIAL).remarks == (
        "12 readings of 6 rows at 3 gateways; 6 of -100 dBm were not heard and are left out"
    )
    (folder / "train_index.txt").write_text("0\n1\n")
    assert read(folder, OFFICIAL).remarks.endswith("left out; 3 readings stand in no index file")


def test_a_gateway_that_heard_nothing_is_left_out(folder):
    text = re.sub(r",-6[159]|,-71", ",-100", READINGS)
    (folder / "gateway_rssi.csv").write_text(text)
    links = read(folder, OFFICIAL)
    assert [r.name for r in links.receivers] == ["west", "attic"]
    assert named(links)[-1] == (5.5, "attic", -90)
    assert links.remarks.endswith("10 of -100 dBm were not heard and are left out, and so are the gateways that heard "
                                  "nothing: east")  # fmt: skip
    (folder / "train_index.txt").write_text("0 west\n1 east\n1 attic\n")
    (folder / "test_index.txt").write_text("5 attic\n")
    again = read(folder, OFFICIAL)
    assert named(again, again.split.train) == [(0.5, "west", -50.5), (1.5, "attic", -80)]


@pytest.mark.parametrize(
    ("train", "test"),
    [
        ("0 0\n0 1\n5 2\n", "5 0\n2 1\n"),
        ("0,0\n0, 1\n5\t2\n", "5 ,0\r\n  2   1  \n\n"),
        ("0 west\n0 east\n5 attic\n", "5,west\n2 , east\n"),
    ],
    ids=["columns", "separators", "names"],
)
def test_index_files_of_rows_and_gateways(folder, train, test):
    (folder / "train_index.txt").write_text(train)
    (folder / "test_index.txt").write_text(test)
    links = read(folder, OFFICIAL)
    assert named(links, links.split.train) == [(0.5, "west", -50.5), (0.5, "east", -61), (5.5, "attic", -90)]
    assert named(links, links.split.test) == [(2.5, "east", -65), (5.5, "west", -60)]


def test_gateways_named_by_numbers_are_never_taken_for_columns(folder):
    for old, new in (("west", "1"), ("east", "2"), ("attic", "010")):
        replace(folder, "gateway_rssi.csv", old, new)
        replace(folder, "gateway_position.yml", old, new)
    (folder / "train_index.txt").write_text("0 1\n4 010\n")
    (folder / "test_index.txt").write_text("0 2\n")
    links = read(folder, OFFICIAL)
    assert named(links, links.split.train) == [(0.5, "1", -50.5), (4.5, "010", -88)]
    assert named(links, links.split.test) == [(0.5, "2", -61)]
    (folder / "test_index.txt").write_text("0 0\n")
    with pytest.raises(ValueError, match="line 1: expected a gateway by name or column from 0, got '0'"):
        read(folder, OFFICIAL)


def test_without_a_header_columns_are_in_the_order_of_the_gateways(folder):
    (folder / "gateway_rssi.csv").write_text(READINGS.removeprefix("west,east,attic\n"))
    replace(folder, "tx_pos.csv", "x,y,z\n", "")
    links = read(folder, OFFICIAL)
    assert named(links)[:2] == [(0.5, "east", -50.5), (0.5, "west", -61)]
    assert len(links.labels) == 12


def test_numbers_that_yaml_takes_for_strings_and_quoted_names_are_read(folder):
    replace(folder, "gateway_position.yml", "[5.0, 1, 2]", '[1e-3, "1", 2]')
    replace(folder, "gateway_rssi.csv", "west,east", '"west", "east"')
    receiver = read(folder, OFFICIAL).receivers[1]
    assert receiver.name == "east"
    assert receiver.pose.position.tolist() == pytest.approx([1e-3, 1, 2])


@pytest.mark.parametrize("header", ["x,y\n", ""])
def test_walls_run_from_each_vertex_to_the_next(folder, header):
    (folder / "layout.csv").write_text(f"{header}0,0\n4,0\n4,3.5\n0,0\n")
    edges = read(folder, OFFICIAL).edges
    corners = [[0, 0, 0], [4, 0, 0], [4, 3.5, 0], [0, 0, 0]]
    assert edges.tolist() == [[*ends] for ends in pairwise(corners)]


def test_readings_of_a_row_stay_together_off_the_official_split(folder):
    for seed in range(5):
        links = read(folder, {"protocol": "random", "test": 0.3, "validation": 0.3, "seed": seed})
        rows = [set(links.transmitters[part, 0].tolist()) for part in links.split.parts().values()]
        assert all(rows)
        assert sum(map(len, rows)) == len(set.union(*rows)) == 5


def test_index_files_are_needed_for_the_official_split_only(folder):
    (folder / "train_index.txt").unlink()
    (folder / "test_index.txt").write_text("99\n")
    assert len(read(folder, {"protocol": "runs", "length": 2, "validation": 0}).split.test) > 0


def test_the_registry_builds_it_and_the_folder_stays_as_it_is(folder):
    state = lambda: {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.iterdir()}
    before = state()
    links = registry("data").build({"name": "nerf2_rssi", "root": str(folder), "split": OFFICIAL})
    assert links.split.name == "official"
    assert state() == before


DEFECTS = {
    "row of nan": (
        lambda f: replace(f, "gateway_rssi.csv", "-54,-65,-100", "nan,nan,nan"),
        "gateway_rssi.csv, line 4, columns west, east, attic: expected an RSSI from -100 to below 0 dBm "
        "(-100 where nothing was heard), got 'nan', 'nan', 'nan'",
    ),
    "empty cell": (
        lambda f: replace(f, "gateway_rssi.csv", "-65", ""),
        "gateway_rssi.csv, line 4, column east: expected an RSSI from -100 to below 0 dBm "
        "(-100 where nothing was heard), got ''",
    ),
    "loud": (
        lambda f: replace(f, "gateway_rssi.csv", "-60", "+20"),
        "gateway_rssi.csv, line 7, column west: expected an RSSI from -100 to below 0 dBm "
        "(-100 where nothing was heard), got '+20'",
    ),
    "zero": (
        lambda f: replace(f, "gateway_rssi.csv", "-60", "0"),
        "gateway_rssi.csv, line 7, column west: expected an RSSI from -100 to below 0 dBm",
    ),
    "below": (
        lambda f: replace(f, "gateway_rssi.csv", "-60", "-100.5"),
        "line 7, column west: expected an RSSI from -100 to below 0 dBm (-100 where nothing was heard), got '-100.5'",
    ),
    "line number without header": (
        lambda f: replace(f, "gateway_rssi.csv", "west,east,attic\n-50.5", "120"),
        "gateway_rssi.csv, line 1, column east: expected an RSSI",
    ),
    "row too short": (
        lambda f: replace(f, "gateway_rssi.csv", "-52,-100,-80", "-52,-100"),
        "gateway_rssi.csv, line 3: expected 3 columns west,east,attic, got 2: '-52,-100'",
    ),
    "column without a position": (
        lambda f: replace(f, "gateway_position.yml", "attic: [3, 1, 4.5]\n", ""),
        "gateway_rssi.csv, line 1: column 'attic' has no position in gateway_position.yml, which has east, west",
    ),
    "index column of pandas": (
        lambda f: (f / "gateway_rssi.csv").write_text(",west,east,attic\n0,-50,-60,-70\n"),
        "gateway_rssi.csv, line 1: column '' has no position in gateway_position.yml",
    ),
    "position without a column": (
        lambda f: replace(f, "gateway_position.yml", "attic", "cellar: [3, 1, -2]\nattic"),
        "gateway_position.yml, line 6: cellar has no column in gateway_rssi.csv",
    ),
    "position without a column, no header": (
        lambda f: (
            replace(f, "gateway_rssi.csv", "west,east,attic\n", ""),
            replace(f, "gateway_position.yml", "attic", "cellar: [3, 1, -2]\nattic"),
        ),
        "gateway_rssi.csv, line 1: expected 4 columns east,west,cellar,attic, got 3: '-50.5,-61,-100'",
    ),
    "column twice": (
        lambda f: replace(f, "gateway_rssi.csv", "attic", "east"),
        "gateway_rssi.csv, line 1: column 'east' stands there twice",
    ),
    "rows too few": (
        lambda f: replace(f, "gateway_rssi.csv", "-54,-65,-100\n", ""),
        "gateway_rssi.csv: expected 6 rows of readings as in tx_pos.csv, got 5",
    ),
    "nothing heard": (
        lambda f: (f / "gateway_rssi.csv").write_text("west,east,attic\n" + 6 * "-100,-100,-100.0\n"),
        "gateway_rssi.csv: expected readings above -100 dBm, got none; no gateway heard anything",
    ),
    "no readings": (lambda f: (f / "gateway_rssi.csv").unlink(), "gateway_rssi.csv: missing; expected an RSSI [dBm]"),
    "readings empty": (lambda f: (f / "gateway_rssi.csv").write_text("\n"), "gateway_rssi.csv: empty; expected an"),
    "readings only a header": (
        lambda f: (f / "gateway_rssi.csv").write_text("west,east,attic\n"),
        "gateway_rssi.csv: no readings below the header",
    ),
    "position nan": (
        lambda f: replace(f, "tx_pos.csv", "2.5,-2,0.25", "nan,-2,inf"),
        "tx_pos.csv, line 4, columns x, z: expected a finite number, got 'nan', 'inf'",
    ),
    "gateway of two numbers": (
        lambda f: replace(f, "gateway_position.yml", "[5.0, 1, 2]", "[5.0, 1]"),
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, got '[5.0, 1]'",
    ),
    "gateway of words": (
        lambda f: replace(f, "gateway_position.yml", "- 1", "- high"),
        "gateway_position.yml, line 2: west: position must be 3 finite numbers x, y, z, got '- 0.5 - high - 2'",
    ),
    "gateway far": (
        lambda f: replace(f, "gateway_position.yml", "5.0, 1, 2", "5.0, -100000, 2"),
        "gateway_position.yml, line 1: east: expected positions within 1e5 m of the origin on "
        "each axis (subtract a common origin from all), got '[5.0, -100000, 2]'",
    ),
    "row far": (
        lambda f: replace(f, "tx_pos.csv", "2.5,-2", "1e5,-2"),
        "tx_pos.csv, line 4, column x: expected positions within 1e5 m of the origin on "
        "each axis (subtract a common origin from all), got '1e5'",
    ),
    "gateway infinite": (
        lambda f: replace(f, "gateway_position.yml", "5.0", ".inf"),
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, got '[.inf, 1, 2]'",
    ),
    "gateway nested": (
        lambda f: replace(f, "gateway_position.yml", "[5.0, 1, 2]", "[[5.0, 1, 2], 1, 2]"),
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, got '[[5.0, 1, 2], 1, 2]'",
    ),
    "gateway twice": (
        lambda f: replace(f, "gateway_position.yml", "attic", "east"),
        "gateway_position.yml, line 6: east has a position in line 1 already",
    ),
    "gateways a list": (
        lambda f: (f / "gateway_position.yml").write_text("- [1, 2, 3]\n"),
        "gateway_position.yml: expected each gateway's name: [x, y, z], got '- [1, 2, 3]'",
    ),
    "gateways no YAML": (
        lambda f: replace(f, "gateway_position.yml", "[5.0", "[[5.0"),
        "gateway_position.yml: no YAML: while parsing",
    ),
    "gateways empty": (
        lambda f: (f / "gateway_position.yml").write_text(""),
        "gateway_position.yml: empty; expected each gateway's name",
    ),
    "gateways only a comment": (
        lambda f: (f / "gateway_position.yml").write_text("# none\n"),
        "gateway_position.yml: expected each gateway's name: [x, y, z], got '# none'",
    ),
    "gateways none": (
        lambda f: (f / "gateway_position.yml").write_text("{}\n"),
        "gateway_position.yml: expected each gateway's name: [x, y, z], got '{}'",
    ),
    "gateways missing": (
        lambda f: (f / "gateway_position.yml").unlink(),
        "gateway_position.yml: missing; expected each gateway's name",
    ),
    "index empty": (
        lambda f: (f / "test_index.txt").write_text("\n\n"),
        "test_index.txt: empty; expected a row from 0, or a row and a gateway, on each line",
    ),
    "index missing": (lambda f: (f / "train_index.txt").unlink(), "train_index.txt: missing; expected a row from 0"),
    "index from 1": (
        lambda f: replace(f, "test_index.txt", "5", "6"),
        "test_index.txt, line 1: expected a row in 0..5, got 6",
    ),
    "index negative": (
        lambda f: replace(f, "train_index.txt", "4", "-4"),
        "train_index.txt, line 1: expected a row from 0, or a row and a gateway, got '-4'",
    ),
    "index a fraction": (
        lambda f: replace(f, "train_index.txt", "0", "0.0"),
        "train_index.txt, line 2: expected one row from 0, got '0.0'",
    ),
    "index blank between": (
        lambda f: replace(f, "train_index.txt", "0", ""),
        "train_index.txt, line 2: expected one row from 0, got ''",
    ),
    "index twice": (
        lambda f: replace(f, "train_index.txt", "1", "4"),
        "train_index.txt, line 3: '4' stands in train_index.txt, line 1 already",
    ),
    "index in both": (
        lambda f: replace(f, "test_index.txt", "2", "0"),
        "test_index.txt, line 2: '0' stands in train_index.txt, line 2 already",
    ),
    "pair in both": (
        lambda f: (
            (f / "train_index.txt").write_text("0 west\n"),
            (f / "test_index.txt").write_text("1 west\n0 0\n"),
        ),
        "test_index.txt, line 2: '0 0' stands in train_index.txt, line 1 already",
    ),
    "rows and pairs": (
        lambda f: replace(f, "test_index.txt", "2", "2 east"),
        "test_index.txt, line 2: expected one row from 0, got '2 east'",
    ),
    "several indices on one line": (
        lambda f: (f / "train_index.txt").write_text("0 1 4\n"),
        "train_index.txt, line 1: expected a gateway by name or column from 0, got '1 4'",
    ),
    "pair of no gateway": (
        lambda f: (
            (f / "train_index.txt").write_text("0 west\n1 3\n"),
            (f / "test_index.txt").write_text("2 west\n"),
        ),
        "train_index.txt, line 2: expected a gateway by name or column from 0, got '3'",
    ),
    "part that nobody heard": (
        lambda f: (f / "test_index.txt").write_text("3\n"),
        "test_index.txt: expected a reading that was heard, got none but -100 in gateway_rssi.csv",
    ),
    "one wall vertex": (
        lambda f: (f / "layout.csv").write_text("x,y\n1,2\n"),
        "layout.csv: expected two wall vertices or more, got 1",
    ),
    "wall of nan": (
        lambda f: (f / "layout.csv").write_text("1,2\n3,\n"),
        "layout.csv, line 2, column y: expected a finite number, got ''",
    ),
    "layout empty": (
        lambda f: (f / "layout.csv").write_text(""),
        "layout.csv: empty; expected consecutive wall vertices",
    ),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_named_with_its_place(folder, name):
    damage, message = DEFECTS[name]
    damage(folder)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read(folder, OFFICIAL)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize("name", ["row of nan", "column without a position", "loud", "index empty"])
def test_one_mistake_is_one_defect(folder, name):
    DEFECTS[name][0](folder)
    with pytest.raises(ValueError, match="has 1 defect:"):
        read(folder, OFFICIAL)


def test_all_files_are_reported_at_once(folder):
    replace(folder, "tx_pos.csv", "-2,", "nan,")
    replace(folder, "gateway_position.yml", "5.0", "five")
    replace(folder, "gateway_rssi.csv", "-80", "80")
    (folder / "layout.csv").write_text("1\n2,3\n")
    replace(folder, "train_index.txt", "4", "40")
    with pytest.raises(ValueError, match="has 5 defects") as caught:
        read(folder, OFFICIAL)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(",")[0].strip() for line in lines] == [
        "tx_pos.csv",
        "gateway_position.yml",
        "gateway_rssi.csv",
        "layout.csv",
        "train_index.txt",
    ]


def test_a_missing_folder_is_no_file(folder):
    with pytest.raises(FileNotFoundError, match="elsewhere must be the folder of a data set"):
        read(folder / "elsewhere", OFFICIAL)


@pytest.fixture(scope="module")
def flat():
    """The measured flat, read as its configuration file says."""
    root = Path(os.environ.get("GAIGS_DATA", Path(__file__).parents[3] / "shared" / "data")) / "ble-flat"
    if not root.is_dir():
        pytest.skip("needs the measured data set ble-flat; set GAIGS_DATA to the folder that holds it")
    config = OmegaConf.load(conf_dir() / "data" / "nerf2_rssi.yaml")
    config.root = str(root)
    return registry("data").build(config)


def test_measured_flat_scores_as_known(flat):
    """The mean of each gateway and its 20 nearest readings err by 6.28 and 4.16 dB on the robot's own test run."""
    check_data(flat)
    assert len(flat.split.test) == 6 * 719
    assert flat.remarks.startswith("26591 readings of 4823 rows at 6 gateways; 2347 of -100 dBm")
    assert len(flat.edges) == 37
    test, known = flat.split.test, torch.cat((flat.split.train, flat.split.validation))
    errors = {"mean": [], "knn": []}
    for k in range(6):
        near, far = (part[flat.receiver_index[part] == k] for part in (known, test))
        labels = flat.labels[near]
        distances, nearest = torch.cdist(flat.transmitters[far], flat.transmitters[near]).topk(20, largest=False)
        weights = 1 / distances.clamp(min=1e-6)
        errors["knn"].append(((weights * labels[nearest]).sum(1) / weights.sum(1) - flat.labels[far]).abs())
        errors["mean"].append((labels.mean() - flat.labels[far]).abs())
    assert torch.cat(errors["mean"]).mean().item() == pytest.approx(6.28, abs=0.01)
    assert torch.cat(errors["knn"]).mean().item() == pytest.approx(4.16, abs=0.01)


def test_measured_flat_validates_on_runs(flat):
    rows = lambda part: {tuple(p) for p in flat.transmitters[part].tolist()}
    apart = torch.cdist(flat.transmitters[flat.split.validation], flat.transmitters[flat.split.train]).amin(1)
    assert len(flat.split.validation) == pytest.approx(0.1 * 22277, abs=600)
    assert np.quantile(apart, 0.5) > 0.02  # one by one it would be the robot's step of some millimetres
    assert rows(flat.split.test).isdisjoint(rows(flat.split.train))
