"""Reading the NeRF² layout of signal strengths; the folder is written by hand."""

import re
from itertools import pairwise

import numpy as np
import pytest
import torch

from gaigs.data import load
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}


def read(folder, split=OFFICIAL):
    return load({"name": "nerf2_rssi", "root": str(folder)}, split)


@pytest.fixture
def folder(rssi_folder):
    return rssi_folder


def replace(folder, file, old, new):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))


def named(links, index=slice(None)):
    """Links as (x of the transmitter, gateway, label)."""
    names = [links.receivers[k].name for k in links.query.receivers[index].tolist()]
    return [*zip(links.query.transmitters[index, 0].tolist(), names, links.labels[index].tolist(), strict=True)]


def test_every_reading_that_was_heard_is_a_link(folder):
    links = read(folder)
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
    assert links.query.transmitters[6].tolist() == [4.5, -4, 0.25]
    positions = {r.name: r.pose.position.tolist() for r in links.receivers}
    assert positions == {"west": [0.5, 1, 2], "east": [5, 1, 2], "attic": [3, 1, 4.5]}
    assert all(torch.equal(r.pose.rotation, torch.eye(3)) for r in links.receivers)
    assert all(len(r.array) == 1 for r in links.receivers)
    assert (links.task.name, links.task.unit, links.query.frequencies) == ("rssi", "dBm", None)
    assert links.rows.tolist() == [0, 0, 1, 1, 2, 2, 4, 4, 4, 5, 5, 5]
    assert links.edges.shape == (0, 2, 3)
    check_data(links)


def test_the_official_parts_are_those_of_the_index_files(folder):
    split = read(folder).split
    assert split.train.tolist() == [0, 1, 2, 3, 6, 7, 8]
    assert split.test.tolist() == [4, 5, 9, 10, 11]


def test_the_remarks_count_what_is_left_out(folder):
    assert read(folder).remarks == "12 readings of 6 rows at 3 gateways; 6 of -100 dBm were not heard and are left out"


def test_readings_in_no_index_file_are_in_no_part(folder):
    (folder / "train_index.txt").write_text("0\n1\n")
    split = read(folder).split
    assert split.train.tolist() == [0, 1, 2, 3]
    assert split.test.tolist() == [4, 5, 9, 10, 11]


def test_a_gateway_that_heard_nothing_is_left_out(folder):
    file = folder / "gateway_rssi.csv"
    file.write_text(re.sub(r",-6[159]|,-71", ",-100", file.read_text()))
    links = read(folder)
    assert [r.name for r in links.receivers] == ["west", "attic"]
    assert named(links)[-1] == (5.5, "attic", -90)
    assert links.remarks.endswith("10 of -100 dBm were not heard and are left out, and so are the gateways that heard "
                                  "nothing: east")  # fmt: skip
    (folder / "train_index.txt").write_text("0 west\n1 east\n1 attic\n")
    (folder / "test_index.txt").write_text("5 attic\n")
    again = read(folder)
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
    links = read(folder)
    assert named(links, links.split.train) == [(0.5, "west", -50.5), (0.5, "east", -61), (5.5, "attic", -90)]
    assert named(links, links.split.test) == [(2.5, "east", -65), (5.5, "west", -60)]


def test_gateways_named_by_numbers_are_never_taken_for_columns(folder):
    for old, new in (("west", "1"), ("east", "2"), ("attic", "010")):
        replace(folder, "gateway_rssi.csv", old, new)
        replace(folder, "gateway_position.yml", old, new)
    (folder / "train_index.txt").write_text("0 1\n4 010\n")
    (folder / "test_index.txt").write_text("0 2\n")
    links = read(folder)
    assert named(links, links.split.train) == [(0.5, "1", -50.5), (4.5, "010", -88)]
    assert named(links, links.split.test) == [(0.5, "2", -61)]
    (folder / "test_index.txt").write_text("0 0\n")
    with pytest.raises(ValueError, match="line 1: expected a gateway by name or column from 0, got '0'"):
        read(folder)


def test_without_a_header_columns_are_in_the_order_of_the_gateways(folder):
    replace(folder, "gateway_rssi.csv", "west,east,attic\n", "")
    replace(folder, "tx_pos.csv", "x,y,z\n", "")
    links = read(folder)
    assert named(links)[:2] == [(0.5, "east", -50.5), (0.5, "west", -61)]
    assert len(links.labels) == 12


def test_numbers_that_yaml_takes_for_strings_and_quoted_names_are_read(folder):
    replace(folder, "gateway_position.yml", "[5.0, 1, 2]", '[1e-3, "1", 2]')
    replace(folder, "gateway_rssi.csv", "west,east", '"west", "east"')
    receiver = read(folder).receivers[1]
    assert receiver.name == "east"
    assert receiver.pose.position.tolist() == pytest.approx([1e-3, 1, 2])


@pytest.mark.parametrize("header", ["x,y\n", ""])
def test_walls_run_from_each_vertex_to_the_next(folder, header):
    (folder / "layout.csv").write_text(f"{header}0,0\n4,0\n4,3.5\n0,0\n")
    edges = read(folder).edges
    corners = [[0, 0, 0], [4, 0, 0], [4, 3.5, 0], [0, 0, 0]]
    assert edges.tolist() == [[*ends] for ends in pairwise(corners)]


def test_readings_of_a_row_stay_together_off_the_official_split(folder):
    for seed in range(5):
        links = read(folder, {"name": "random", "test": 0.3, "validation": 0.3, "seed": seed})
        rows = [set(links.query.transmitters[part, 0].tolist()) for part in links.split.parts().values()]
        assert all(rows)
        assert sum(map(len, rows)) == len(set.union(*rows)) == 5


def test_index_files_are_read_for_the_official_split_only(folder):
    (folder / "train_index.txt").unlink()
    (folder / "test_index.txt").write_text("99\n")
    assert len(read(folder, {"name": "runs", "length": 2, "validation": 0}).split.test) > 0
    with pytest.raises(ValueError, match="has 2 defects:"):
        read(folder)


def test_the_folder_stays_as_it_is(folder):
    state = lambda: {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.iterdir()}
    before = state()
    assert read(folder).split.name == "official"
    assert state() == before


@pytest.fixture(scope="module")
def flat(measured, configured):
    """The measured flat, read as its configuration file says."""
    config = configured("data=nerf2_rssi", f"data.root={measured('ble-flat')}")
    return load(config.data, config.split)


def test_measured_flat_scores_as_known(flat):
    """The mean of each gateway and its 20 nearest readings err by 6.28 and 4.16 dB on the robot's own test run."""
    check_data(flat)
    assert flat.split.name == "official, validation 0.1 in runs of 100, seed 0"
    assert len(flat.split.test) == 6 * 719
    assert flat.remarks.startswith("26591 readings of 4823 rows at 6 gateways; 2347 of -100 dBm")
    assert len(flat.edges) == 37
    test, known = flat.split.test, torch.cat((flat.split.train, flat.split.validation))
    errors = {"mean": [], "knn": []}
    for k in range(6):
        near, far = (part[flat.query.receivers[part] == k] for part in (known, test))
        labels = flat.labels[near]
        distances, nearest = torch.cdist(flat.query.transmitters[far], flat.query.transmitters[near]).topk(
            20, largest=False
        )
        weights = 1 / distances.clamp(min=1e-6)
        errors["knn"].append(((weights * labels[nearest]).sum(1) / weights.sum(1) - flat.labels[far]).abs())
        errors["mean"].append((labels.mean() - flat.labels[far]).abs())
    assert torch.cat(errors["mean"]).mean().item() == pytest.approx(6.28, abs=0.01)
    assert torch.cat(errors["knn"]).mean().item() == pytest.approx(4.16, abs=0.01)


def test_measured_flat_validates_on_runs(flat):
    rows = lambda part: {tuple(p) for p in flat.query.transmitters[part].tolist()}
    apart = torch.cdist(flat.query.transmitters[flat.split.validation], flat.query.transmitters[flat.split.train]).amin(
        1
    )
    assert len(flat.split.validation) == pytest.approx(0.1 * 22277, abs=600)
    assert np.quantile(apart, 0.5) > 0.02  # one by one it would be the robot's step of some millimetres
    assert rows(flat.split.test).isdisjoint(rows(flat.split.train))
