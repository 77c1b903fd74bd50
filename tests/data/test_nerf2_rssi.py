"""Reading the NeRF² layout of signal strengths; the folder is written by hand."""

import re
from itertools import pairwise

import pytest
import torch
from damages import replace

from gaigs.data import load, nerf2_rssi
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}


def read(folder, split=OFFICIAL, **options):
    return load({"name": "nerf2_rssi", "root": str(folder), **options}, split)


def named(links, index=slice(None)):
    """Links as (x of the transmitter, gateway, label)."""
    names = [links.receivers[k].name for k in links.query.receivers[index].tolist()]
    return [
        *zip(
            links.query.transmitters[index, 0].tolist(),
            names,
            links.labels[index].tolist(),
            strict=True,
        )
    ]


def test_every_reading_that_was_heard_is_a_link(rssi_folder):
    links = read(rssi_folder)
    rows = [
        map(float, line.split(",")) for line in (rssi_folder / RSSI).read_text().splitlines()[1:]
    ]
    cells = [
        (k + 0.5, *cell)
        for k, row in enumerate(rows)
        for cell in zip(("west", "east", "attic"), row, strict=True)
    ]
    assert named(links) == [cell for cell in cells if cell[2] > -100]
    assert links.query.transmitters[6].tolist() == [4.5, -4, 0.25]
    positions = {r.name: r.pose.position.tolist() for r in links.receivers}
    assert positions == {"west": [0.5, 1, 2], "east": [5, 1, 2], "attic": [3, 1, 4.5]}
    assert all(torch.equal(r.pose.rotation, torch.eye(3)) for r in links.receivers)
    assert all(len(r.array) == 1 for r in links.receivers)
    assert (links.task.name, links.task.unit, links.query.frequencies) == ("rssi", "dBm", None)
    assert links.rows.tolist() == [0, 0, 1, 1, 2, 2, 4, 4, 4, 5, 5, 5]
    assert links.split.train.tolist() == [0, 1, 2, 3, 6, 7, 8]
    assert links.split.test.tolist() == [4, 5, 9, 10, 11]
    assert links.edges.shape == (0, 2, 3)
    assert (
        links.remarks
        == "12 readings of 6 rows at 3 gateways; 6 of -100 dBm were not heard and are left out"
    )
    check_data(links)


def test_a_carrier_is_that_of_all_readings(rssi_folder):
    assert read(rssi_folder, frequency=2.44e9).query.frequencies.unique().tolist() == [2.44e9]


def test_a_gateway_that_heard_nothing_is_left_out(rssi_folder):
    file = rssi_folder / "gateway_rssi.csv"
    file.write_text(re.sub(r",-6[159]|,-71", ",-100", file.read_text()))
    links = read(rssi_folder)
    assert [r.name for r in links.receivers] == ["west", "attic"]
    assert named(links)[-1] == (5.5, "attic", -90)
    assert links.remarks.endswith("10 of -100 dBm were not heard and are left out, and so are the gateways that heard "
                                  "nothing: east")  # fmt: skip
    (rssi_folder / "train_index.txt").write_text("0 west\n1 east\n1 attic\n")
    (rssi_folder / "test_index.txt").write_text("5 attic\n")
    again = read(rssi_folder)
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
def test_index_files_of_rows_and_gateways(rssi_folder, train, test):
    (rssi_folder / "train_index.txt").write_text(train)
    (rssi_folder / "test_index.txt").write_text(test)
    links = read(rssi_folder)
    assert named(links, links.split.train) == [
        (0.5, "west", -50.5),
        (0.5, "east", -61),
        (5.5, "attic", -90),
    ]
    assert named(links, links.split.test) == [(2.5, "east", -65), (5.5, "west", -60)]


def test_gateways_named_by_numbers_are_never_taken_for_columns(rssi_folder):
    for old, new in (("west", "1"), ("east", "2"), ("attic", "010")):
        replace(rssi_folder / "gateway_rssi.csv", old, new)
        replace(rssi_folder / "gateway_position.yml", old, new)
    (rssi_folder / "train_index.txt").write_text("0 1\n4 010\n")
    (rssi_folder / "test_index.txt").write_text("0 2\n")
    links = read(rssi_folder)
    assert named(links, links.split.train) == [(0.5, "1", -50.5), (4.5, "010", -88)]
    assert named(links, links.split.test) == [(0.5, "2", -61)]
    (rssi_folder / "test_index.txt").write_text("0 0\n")
    with pytest.raises(
        ValueError, match=r"line 1: expected a row in 0\.\.5, or a row and a gateway, got '0 0'"
    ):
        read(rssi_folder)


def test_without_a_header_columns_are_in_the_order_of_the_gateways(rssi_folder):
    replace(rssi_folder / "gateway_rssi.csv", "west,east,attic\n", "")
    replace(rssi_folder / "tx_pos.csv", "x,y,z\n", "")
    links = read(rssi_folder)
    assert named(links)[:2] == [(0.5, "east", -50.5), (0.5, "west", -61)]
    assert len(links.labels) == 12


@pytest.mark.parametrize("header", ["x,y\n", ""])
def test_walls_run_from_each_vertex_to_the_next(rssi_folder, header):
    (rssi_folder / "layout.csv").write_text(f"{header}0,0\n4,0\n4,3.5\n0,0\n")
    edges = read(rssi_folder).edges
    corners = [[0, 0, 0], [4, 0, 0], [4, 3.5, 0], [0, 0, 0]]
    assert edges.tolist() == [[*ends] for ends in pairwise(corners)]


TX, RSSI, YML = "tx_pos.csv", "gateway_rssi.csv", "gateway_position.yml"
TRAIN, TEST = "train_index.txt", "test_index.txt"

DEFECTS = [
    (RSSI, "-54,-65,-100", "nan,nan,nan", ", line 4: expected an RSSI from -100 to 30 dBm (-100 where nothing was "
     "heard), got 'nan' in column west"),
    (RSSI, "-60", "31", ", line 7: expected an RSSI from -100 to 30 dBm"),
    (RSSI, "-60", "-100.5", ", line 7: expected an RSSI from -100 to 30 dBm"),
    (RSSI, "-52,-100,-80", "-52,-100", ", line 3: expected 3 columns 'west,east,attic', got 2: '-52,-100'"),
    (RSSI, None, ",west,east,attic\n0,-50,-60,-70\n", ", line 1: column '' has no position in gateway_position.yml"),
    (RSSI, "attic", "east", ", line 1: expected one column 'east', got 2"),
    (RSSI, "-54,-65,-100\n", "", ": tx_pos.csv has 6 positions, gateway_rssi.csv 5 rows"),
    (RSSI, None, "west,east,attic\n" + 6 * "-100,-100,-100.0\n", ": expected readings above -100 dBm, got none"),
    (YML, "attic: [3, 1, 4.5]\n", "", "gateway_rssi.csv, line 1: column 'attic' has no position in gateway_position"),
    (YML, "attic", "cellar: [3, 1, -2]\nattic", "gateway_rssi.csv, line 1: expected one column 'cellar', got 0"),
    (TRAIN, None, None, ": missing; expected a row in 0..5"),
    (TEST, "5", "6", ", line 1: expected a row in 0..5, or a row and a gateway, got '6'"),
    (TRAIN, "1", "4", ", line 3: expected each entry once, got '4', which is in train_index.txt, line 1 already"),
    (TEST, "2", "0", ", line 2: expected each entry once, got '0', which is in train_index.txt, line 2 already"),
    (TEST, "2", "2 east", ": index files must list rows, or pairs of row and gateway, got both"),
    (TRAIN, None, "0 west\n1 3\n", ", line 2: expected a row in 0..5, or a row and a gateway, got '1 3'"),
    (TEST, None, "3\n", ": expected a reading that was heard, got none"),
    ("layout.csv", None, "x,y\n1,2\n", ": expected two wall vertices or more, got 1"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "message"), DEFECTS)
def test_a_defect_is_named_with_its_place(rssi_folder, file, old, new, message):
    replace(rssi_folder / file, old, new)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        nerf2_rssi.read(rssi_folder).official()
    assert str(rssi_folder) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def flat(measured, configured):
    """The measured flat, read as its configuration file says."""
    config = configured("data=nerf2_rssi", f"data.root={measured('ble-flat')}")
    return load(config.data, config.split)


def test_measured_flat_scores_as_known(flat):
    """The mean of each gateway and its 20 nearest readings err by 6.28 and 4.16 dB on the robot's
    own test run.
    """
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
        distances, nearest = torch.cdist(
            flat.query.transmitters[far], flat.query.transmitters[near]
        ).topk(20, largest=False)
        weights = 1 / distances.clamp(min=1e-6)
        errors["knn"].append(
            ((weights * labels[nearest]).sum(1) / weights.sum(1) - flat.labels[far]).abs()
        )
        errors["mean"].append((labels.mean() - flat.labels[far]).abs())
    assert torch.cat(errors["mean"]).mean().item() == pytest.approx(6.28, abs=0.01)
    assert torch.cat(errors["knn"]).mean().item() == pytest.approx(4.16, abs=0.01)
