"""Checks of places, walls, arrays and the range of spectra, each once and with its numbers."""

import re
from dataclasses import replace

import pytest
import torch

import gaigs
from gaigs.core.antenna import Array
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import divide
from gaigs.testing import example_links

SPLIT = {"name": "random", "validation": 0.1, "test": 0.2, "seed": 0}
SQUARE = torch.tensor([[0.0, 0, 0], [6, 0, 0], [6, 4, 0], [0, 4, 0], [0, 0, 0]])
PLAN = torch.stack((SQUARE[:-1], SQUARE[1:]), 1)


@pytest.mark.parametrize(
    ("walls", "doubt"),
    [
        (PLAN, ""),
        (PLAN[:1] - torch.tensor([0.0, 0.3, 0.0]), ""),  # one wall
        (8 * PLAN, ""),  # the building
        (
            1000 * PLAN,
            "the walls are 7.21e+03 m across, transmitters and receivers 6.57 m; are both in m?",
        ),
        (
            0.001 * PLAN,
            "the walls are 0.00721 m across, transmitters and receivers 6.57 m; are both in m?",
        ),
        (
            PLAN + 100,
            "the walls are 135 m from all transmitters and receivers; are both in one frame?",
        ),
    ],
)
def test_walls_are_of_the_size_and_at_the_place_of_the_links(caplog, walls, doubt):
    links = divide(replace(example_links("rssi"), edges=walls, remarks="read"), SPLIT)
    assert links.remarks == "; ".join(filter(None, ("read", doubt)))
    assert caplog.messages == [doubt] * bool(doubt)


def test_an_array_in_millimetres_is_doubted():
    links = example_links("csi")
    wide = Array(1000 * links.receivers[0].array.elements)
    links = replace(links, receivers=(replace(links.receivers[0], array=wide), links.receivers[1]))
    name = links.receivers[0].name
    assert (
        f"the array of {name} is 86.9 m across, transmitters and receivers "
        in divide(links, SPLIT).remarks
    )


def test_spectra_without_a_direction_are_counted_or_refused():
    links = example_links("spectrum", 2.44e9)
    labels = torch.rand(len(links), *links.task.shape)
    labels[:, 0, 0], labels[:, 1, 1] = 0, 1
    assert divide(replace(links, labels=labels), SPLIT).remarks == ""
    labels[3], labels[5], labels[7:9] = 0, 0.25, 0.2 + 0.5 * labels[7:9]
    remarks = divide(replace(links, labels=labels), SPLIT).remarks
    assert "2 of 24 spectra are constant, first that of link 3, 0 to 0" in remarks
    assert "2 of 24 spectra lack a pixel of 0 or of 1, first that of link 7, 0.2 to 0.7" in remarks
    free = Spectrum(*vars(links.task.directions).values(), "amplitudes")
    assert "lack" not in divide(replace(links, labels=labels, task=free), SPLIT).remarks
    with pytest.raises(
        ValueError, match="a spectrum must have pixels of different values; all 24 are constant"
    ):
        divide(replace(links, labels=0 * labels), SPLIT)


def test_simulated_rooms_are_beyond_doubt():
    assert gaigs.links("synthetic", transmitters=20, order=0).remarks == ""


@pytest.mark.parametrize(
    ("changes", "doubt"),
    [
        (
            {"elements": lambda elements: elements + 3},
            "are 5.2 m from its position; elements are relative to it",
        ),
        ({"elements": lambda elements: elements / 0.06}, "m apart, .* wavelengths; are they in m"),
        (
            {"places": lambda places: places + 3e4},
            "positions are rounded by up to 0.0018 m, .* subtract a common origin",
        ),
        (
            {"places": lambda places: places / 1e5},
            "receivers are .* m from all places, which span .* m; are units",
        ),
    ],
)
def test_positions_in_another_unit_or_frame_are_doubted(changes, doubt):
    links = example_links("csi", 5e9)
    elements, places = (changes.get(name, lambda values: values) for name in ("elements", "places"))
    receivers = tuple(
        replace(each, array=Array(elements(each.array.elements))) for each in links.receivers
    )
    query = replace(links.query, transmitters=places(links.query.transmitters))
    assert re.search(doubt, divide(replace(links, receivers=receivers, query=query), SPLIT).remarks)
