"""YAML files: numbers are read as they are written; a file or value that is ambiguous is refused."""

import pytest

from gaigs.io.yaml import read_mapping, to_position

ALIASES = "".join(
    f"b{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 8)
)  # each twice as long when written out


@pytest.fixture
def read(tmp_path):
    """The mapping of a text."""

    def run(text):
        file = tmp_path / "gateways.yml"
        file.write_text(text)
        return read_mapping(file, "each gateway's name: [x, y, z]")

    return run


@pytest.mark.parametrize(
    "position",
    ["[5, 1e-3, -.5]", "[+5, '1e-3', \"-0.5\"]", "[5.e0, 1.0E-3, -00.5]", "\n- 5\n- 0.001\n- -0.5"],
)
def test_numbers_are_read_as_they_are_written(read, position):
    content = read(f"dataset: 010\neast: {position}\n")
    assert content["dataset"] == "010"
    assert to_position("east", content["east"]) == [5, 1e-3, -0.5]


@pytest.mark.parametrize(
    "position",
    [
        '"123"', "123", "{5: x, 1: y, 2: z}", "!!set {5, 1, 2}", "2024-01-01", "[2024-01-01, 1, 2]", "[true, 1, 2]",
        "[null, 1, 2]", "[010, 1, 2]", "[-010, 1, 2]", "[0x10, 1, 2]", "[0b1, 1, 2]", "[1_0, 1, 2]", "[1:30, 1, 2]",
        "[.inf, 1, 2]", "[1e400, 1, 2]", f"[{'9' * 400}, 1, 2]", "[５, 1, 2]", "[[5], 1, 2]", "[5, 1]", "[5, 1, 2, 3]",
        "", "[!!int 010, 1, 2]", "[high, 1, 2]",
    ],
)  # fmt: skip
def test_a_position_is_a_list_of_three_plain_numbers(read, position):
    value = read(f"east: {position}\n")["east"]
    with pytest.raises(
        ValueError, match=r"east must be 3 finite numbers x, y, z, .* got"
    ) as caught:
        to_position("east", value)
    assert len(str(caught.value)) < 200


def test_a_position_too_far_for_float32_is_refused():
    with pytest.raises(
        ValueError, match="east: expected positions within 1e5 m of the origin on each axis"
    ):
        to_position("east", ["5", "-1e5", "2"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- [1, 2, 3]\n", "expected each gateway's name: [x, y, z], got '- [1, 2, 3]'"),
        (
            "east: " + 1000 * "[",
            "cannot parse FILE: maximum recursion depth exceeded; expected each gateway's",
        ),
        ("east: [[5, 1, 2]\n", "cannot parse FILE: while parsing a flow sequence"),
        ("east: !<tag:%E9> 1", "cannot parse FILE: "),
        (
            "east: [!feet 5, 1, 2]",
            "cannot parse FILE: could not determine a constructor for the tag '!feet'",
        ),
        ("east: &a [*a, 1, 2]", "east must be 3 finite"),
        (f"a: &a0 [5]\n{ALIASES}east: *a7", "got [[[[[[[...], [...]], "),
        (
            "east: [5, 1, 2]\n---\nwest: [5, 1, 2]\n",
            "cannot parse FILE: expected a single document",
        ),
        ("east: [5, 1, 2]\n" * 2, "cannot parse FILE: the key 'east' is there twice"),
        ('"ea\\tst": 1', "expected a name in front of a colon, got 'ea\\tst'"),
    ],
)
def test_a_file_that_is_no_mapping_of_different_names_is_refused(read, tmp_path, text, message):
    with pytest.raises(ValueError, match=r"\w") as caught:
        to_position("east", read(text)["east"])
    error = str(caught.value).replace(str(tmp_path / "gateways.yml"), "FILE")
    assert message in error
    assert "\n" not in error
    assert len(error) < 500
