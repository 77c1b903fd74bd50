"""What is wrong with a folder of signal strengths is named with its file, line and value."""

import re

import pytest

from gaigs.data import load


def read(folder):
    return load({"name": "nerf2_rssi", "root": str(folder)}, {"name": "official"})


@pytest.fixture
def folder(rssi_folder):
    return rssi_folder


def replace(folder, file, old, new):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))


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
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, "
        "got '[5.0, 1]'",
    ),
    "gateway of words": (
        lambda f: replace(f, "gateway_position.yml", "- 1", "- high"),
        "gateway_position.yml, line 2: west: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, "
        "got '- 0.5 - high - 2'",
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
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, "
        "got '[.inf, 1, 2]'",
    ),
    "gateway nested": (
        lambda f: replace(f, "gateway_position.yml", "[5.0, 1, 2]", "[[5.0, 1, 2], 1, 2]"),
        "gateway_position.yml, line 1: east: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, "
        "got '[[5.0, 1, 2], 1, 2]'",
    ),
    "gateway twice": (
        lambda f: replace(f, "gateway_position.yml", "attic", "east"),
        "gateway_position.yml, line 6: east stands in line 1 already",
    ),
    "gateways a list": (
        lambda f: (f / "gateway_position.yml").write_text("- [1, 2, 3]\n"),
        "gateway_position.yml: expected each gateway's name: [x, y, z] [m], got '- [1, 2, 3]'",
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
        "gateway_position.yml: expected each gateway's name: [x, y, z] [m], got '# none'",
    ),
    "gateways none": (
        lambda f: (f / "gateway_position.yml").write_text("{}\n"),
        "gateway_position.yml: expected each gateway's name: [x, y, z] [m], got '{}'",
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
        read(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize("name", ["row of nan", "column without a position", "loud", "index empty"])
def test_one_mistake_is_one_defect(folder, name):
    DEFECTS[name][0](folder)
    with pytest.raises(ValueError, match="has 1 defect:"):
        read(folder)


def test_all_files_are_reported_at_once(folder):
    replace(folder, "tx_pos.csv", "-2,", "nan,")
    replace(folder, "gateway_position.yml", "5.0", "five")
    replace(folder, "gateway_rssi.csv", "-80", "80")
    (folder / "layout.csv").write_text("1\n2,3\n")
    with pytest.raises(ValueError, match="has 4 defects") as caught:
        read(folder)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(",")[0].strip() for line in lines] == [
        "tx_pos.csv",
        "gateway_position.yml",
        "gateway_rssi.csv",
        "layout.csv",
    ]


def test_both_index_files_are_reported_at_once(folder):
    replace(folder, "train_index.txt", "4", "40")
    replace(folder, "test_index.txt", "5", "five")
    with pytest.raises(ValueError, match="has 2 defects") as caught:
        read(folder)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(",")[0].strip() for line in lines] == ["train_index.txt", "test_index.txt"]


def test_a_missing_folder_is_no_file(folder):
    with pytest.raises(FileNotFoundError, match="elsewhere must be the folder of a data set"):
        read(folder / "elsewhere")
