"""Gateways in YAML: what is no plain number or stands there twice is refused by both readers in the same words."""

import re

import pytest
import torch

from gaigs.data import nerf2_rssi, nerf2_spectrum

READERS = {
    "rssi": (nerf2_rssi.read, "gateway_position.yml", "{}: {}\nwest: [0.5, 1, 2]\nattic: [3, 1, 4.5]\n"),
    "spectrum": (
        nerf2_spectrum.read,
        "gateway_info.yml",
        "{}:\n  position: {}\n  orientation: [0.5, -0.5, -0.5, 0.5]\n",
    ),
}


@pytest.fixture(params=READERS)
def read(request):
    """Reads a folder whose gateway has such a name and position, or whose file is such a text."""
    reader, name, form = READERS[request.param]
    folder = request.getfixturevalue(f"{request.param}_folder")

    def run(position="[5, 1, 2]", key="east", text=None):
        (folder / name).write_text(form.format(key, position) if text is None else text)
        return reader(folder)

    return run


def refusal(read, **changes):
    with pytest.raises(ValueError, match=r"has \d+ defects?:\n  gateway_\w+\.yml") as caught:
        read(**changes)
    return str(caught.value)


@pytest.mark.parametrize("position", ["[5, 1e-3, -.5]", "[+5, '1e-3', \"-0.5\"]", "[5.e0, 1.0E-3, !!float -00.5]"])
def test_numbers_are_read_as_they_are_written(read, position):
    positions = torch.stack([receiver.pose.position for receiver in read(position).receivers])
    assert torch.tensor([5, 1e-3, -0.5]) in positions


@pytest.mark.parametrize(
    "position",
    [
        '"123"',
        "123",
        "{5: x, 1: y, 2: z}",
        "!!set {5, 1, 2}",
        "!place [5, 1, 2]",
        "2024-01-01",
        "[2024-01-01, 1, 2]",
        "[true, 1, 2]",
        "[null, 1, 2]",
        "[010, 1, 2]",
        "[-010, 1, 2]",
        "[0x10, 1, 2]",
        "[0b1, 1, 2]",
        "[1_0, 1, 2]",
        "[1:30, 1, 2]",
        "[!feet 5, 1, 2]",
        "[.inf, 1, 2]",
        "[1e400, 1, 2]",
        f"[{'9' * 400}, 1, 2]",
        "[５, 1, 2]",
        "[[5], 1, 2]",
        "&a [*a, 1, 2]",
        "[5, 1]",
        "[5, 1, 2, 3]",
        "",
    ],
)
def test_what_is_no_list_of_three_plain_numbers_is_refused(read, position):
    message = refusal(read, position=position)
    assert re.search(
        r"line 1: east: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, got '", message
    )
    assert position[:60] in message


@pytest.mark.parametrize("number", ["1e6", "-1e5", "1e300", "9" * 300])
def test_what_is_too_far_for_float32_is_refused(read, number):
    message = refusal(read, position=f"[5, {number}, 2]")
    assert "line 1: east: expected positions within 1e5 m of the origin on each axis" in message
    assert f"got '[5, {number[:60]}" in message


@pytest.mark.parametrize(
    ("key", "got"),
    [
        ("? [5, 1]\n", "'[5, 1]'"),
        ("''", "\"''\""),
        ('"ea\\tst"', "'\"ea\\\\tst\"'"),
        ('"\\uD800"', "'\"\\\\uD800\"'"),
    ],
)
def test_a_name_is_one_line_of_visible_letters(read, key, got):
    assert f"line 1: expected a name in front of a colon, got {got}" in refusal(read, key=key)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("east: " + 1000 * "[", "no YAML: brackets are nested too deeply; expected"),
        ("east: " + 1000 * "{", "no YAML: brackets are nested too deeply; expected"),
        ('"\\UFFFFFFFF": 1', "no YAML: "),
        ("east: !<tag:%E9> 1", "no YAML: "),
        ("east: [5, 1, 2]\n---\nwest: [5, 1, 2]\n", "no YAML: expected a single document"),
        ("east: [*west, 1, 2]", "no YAML: found undefined alias"),
        ("east: [5, 1, 2]\n" * 2, "line 2: east stands in line 1 already"),
        ("east:\n  position: 1\n  position: 2\nwest: 1\neast: 2\n", "line 5: east stands in line 1 already"),
    ],
)
def test_a_file_that_is_no_mapping_of_different_names_is_refused(read, text, message):
    assert message in refusal(read, text=text)


@pytest.mark.parametrize("again", ["position: [9, 9, 9]", "orientation: [0, 0, 0, 1]"])
def test_a_pose_says_each_thing_once(spectrum_folder, again):
    file = spectrum_folder / "gateway_info.yml"
    file.write_text(f"{file.read_text()}\n  {again}\n")
    with pytest.raises(ValueError, match=rf"line 6: {again.split(':')[0]} stands in line \d already"):
        nerf2_spectrum.read(spectrum_folder)
