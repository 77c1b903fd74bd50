"""Text files of numbers: files that cannot be read, defects with their lines, and numbers in plain
decimals only.
"""

import csv
import os

import pytest

from gaigs.io.tables import (
    check_empty,
    find_file,
    find_folder,
    inert,
    original,
    read_lines,
    read_parts,
    read_points,
    to_index,
    write_table,
)


def write(folder, text):
    file = folder / "points.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


@pytest.mark.parametrize(
    "text",
    ["1,2\n3,4", "x,y\n1,2\n3,4\n\n \n", "\ufeffX , Y\r\n 1 ,2\r\n3,4\r\n", '"1", "2"\n3,"4"'],
)
def test_points_are_read(tmp_path, text):
    assert read_points(write(tmp_path, text), "xy", "points") == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    "cell", ["1_0", "１", "0x1", "1d3", "1e", '"1"0', '"1" 0', "1 0", '"1', "nan", "inf", "one", ""]
)
def test_a_cell_without_a_plain_number_is_refused(tmp_path, cell):
    with pytest.raises(ValueError, match=r"points\.csv, line 2: expected .*, got "):
        read_points(write(tmp_path, f"0,0\n1,{cell}\n"), "xy", "points")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "points.csv: empty; expected points"),
        ("x,y\n", "points.csv: no positions below the header"),
        ("1,2\n3\n", "points.csv, line 2: expected 2 columns 'x,y', got 1: '3'"),
        (
            "1,2\n" + 14 * "nan,2\n",
            "line 2 and 13 other lines: expected a finite number, got 'nan' in column x",
        ),
        (
            "1,2\n3,1e5\n-1e5,0\n",
            "line 2 and 1 other line: expected positions within 1e5 m of the origin on each axis",
        ),
        ("1,\x1b[31m\u202e\n", "got '\\x1b[31m\\u202e' in column y"),
        (
            "x,y\n1,2\nZürich,3\n".encode("latin-1"),
            ", line 3: expected a finite number, got 'Zürich' in column x",
        ),
    ],
)
def test_a_defect_is_named_with_its_line(tmp_path, text, message):
    file = write(tmp_path, text)
    with pytest.raises(ValueError, match=r"\w") as caught:
        read_points(file, "xy", "points")
    assert message in str(caught.value).replace(
        str(file), "FILE" if "FILE" in message else "points.csv"
    )
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_usual_encodings_are_read(tmp_path, coding):
    assert read_lines(write(tmp_path, "Höhe,x\n1,2\n".encode(coding)), "points") == [
        "Höhe,x",
        "1,2",
    ]


@pytest.mark.parametrize(
    "make", [lambda file: file.symlink_to("elsewhere"), os.mkfifo, lambda file: None]
)
def test_a_path_that_is_no_file_is_named(tmp_path, make):
    make(tmp_path / "points.csv")
    with pytest.raises(
        ValueError, match=r"points\.csv: (no file, .* or a broken link|missing); expected points"
    ):
        read_lines(tmp_path / "points.csv", "points")


@pytest.mark.parametrize("root", ["x" * 300, "~nobody-of-this-name/room", "a\0b"])
def test_an_impossible_path_is_no_folder_and_no_file(root):
    for find in (find_folder, lambda path: find_file(path, "a table")):
        with pytest.raises(
            FileNotFoundError, match=r"and is no (folder|file); set the data's (root|file)"
        ):
            find(root)


def test_a_folder_to_write_is_empty_or_missing(tmp_path):
    check_empty(tmp_path / "new")
    check_empty(tmp_path)
    file = write(tmp_path, "1,2")
    for place in (tmp_path, file):
        with pytest.raises(FileExistsError, match="must be an empty folder or missing"):
            check_empty(place)


def test_no_text_of_a_written_table_is_a_formula_and_numbers_stay(tmp_path):
    texts = ['=HYPERLINK("http://example.com")', "+1-2", "-a", "@sum", "\tx", "'=1+1", "''-x"]
    plain = ["hall", "", "'hall", "a=b", "-70.5", "+3e-2", "-inf"]
    write_table(tmp_path / "names.csv", [["name", *texts], [-1.5, *plain]])
    with open(tmp_path / "names.csv", newline="") as file:
        (_, *written), (number, *others) = csv.reader(file)
    assert written == [f"'{text}" for text in texts]
    assert (number, others) == ("-1.5", plain)
    assert [original(text) for text in written + others] == texts + plain
    assert inert("\rx") == "'\rx"


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("0", 0),
        ("007", 7),
        (f"{'0' * 5000}1", 1),
        ("-1", None),
        ("1.0", None),
        ("", None),
        ("٣", None),
        ("1 2", None),
    ],
)
def test_an_index_is_a_whole_number_in_decimals(text, index):
    assert to_index(text) == index
    assert to_index("9" * 5000) >= 2**62


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (
            "1\n2\n",
            "3\n2\n",
            r"test_index\.txt, line 2: .* once, got '2', .* in train_index.txt, line 2",
        ),
        ("1\n01\n1\n", "3", r"train_index\.txt, line 2 and 1 other line: expected each entry once"),
        ("1\n\n2\n", "3", r"train_index\.txt, line 2: expected an index, got ''"),
    ],
)
def test_index_files_hold_each_entry_once(tmp_path, train, test, message):
    (tmp_path / "train_index.txt").write_text(train)
    (tmp_path / "test_index.txt").write_text(test)
    with pytest.raises(ValueError, match=message):
        read_parts(tmp_path, to_index, "an index")
    (tmp_path / "train_index.txt").write_text("4\r\n 1\n")
    (tmp_path / "test_index.txt").write_text("2 \n\n")
    assert read_parts(tmp_path, to_index, "an index") == ([4, 1], [2])
