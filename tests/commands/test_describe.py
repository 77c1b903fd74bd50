"""A first look at links: each fault is named, and sound links have none."""

import functools
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.commands.describe import figure
from gaigs.core.query import Query
from gaigs.data.readings import gateway
from gaigs.testing import example_links

PLACES = np.random.default_rng(0).uniform([0, 0, 1], [9, 5, 1.5], (60, 3))
GATEWAYS = np.array([[0.0, 0.5, 2.5], [8.5, 4.5, 2.5], [2.0, 5.0, 2.0], [7.0, 0.5, 2.2]])
APART = np.linalg.norm(PLACES[:, None] - GATEWAYS, axis=2)
LEVELS = -40 - 28 * np.log10(APART) + np.random.default_rng(1).normal(0, 2, APART.shape)


@functools.cache
def sound():
    return gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=LEVELS)


def described(places=PLACES, gateways=GATEWAYS, levels=LEVELS):
    numbers = sound().query.receivers
    query = Query(torch.tensor(places).float().repeat_interleave(len(gateways), 0), numbers)
    receivers = tuple(
        gateway(f"rx{k}", torch.tensor(place).float()) for k, place in enumerate(gateways)
    )
    return gaigs.describe(
        replace(
            sound(), query=query, receivers=receivers, labels=torch.tensor(levels).flatten().float()
        )
    )


def changed(column, values):
    levels = LEVELS.copy()
    levels[:, column] = values
    return levels


FAULTS = {
    "sound": ({}, ""),
    "millimetres": (
        {"places": 1e3 * PLACES, "gateways": 1e3 * GATEWAYS},
        "receivers are 5.* m above .* all places; are places in mm",
    ),
    "centimetres": (
        {"gateways": 100 * GATEWAYS},
        "if rx are in cm",
    ),
    "axes": (
        {"gateways": GATEWAYS[:, [1, 0, 2]]},
        "to .* dB instead of .* if rx have x and y exchanged",
    ),
    "far": (
        {"places": PLACES + np.array([5e4, 0, 0])},
        "receivers are .* m from all places",
    ),
    "sign": ({"levels": -LEVELS}, "240 levels are above 0 dBm, .* was a sign lost"),
    "mark": (
        {"levels": np.where(LEVELS < -58, -100, LEVELS)},
        "levels are -100 dBm; does it mean not heard",
    ),
    "constant": ({"levels": changed(2, -50.0)}, "levels are constant at rx2"),
    "twice": ({"levels": changed(2, LEVELS[:, 1])}, "rx1 and rx2 have the same levels"),
    "place": (
        {"gateways": GATEWAYS[[0, 1, 2, 2]]},
        "levels of rx3 follow the distance to .* m off its place",
    ),
    "exchanged": (
        {"levels": LEVELS[:, [1, 0, 2, 3]]},
        "levels of rx0, rx1 follow the distance to .* from the places of rx1, rx0",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named(fault):
    options, words = FAULTS[fault]
    found = described(**options).suspicious
    if words:
        assert any(re.search(words, one) for one in found), found
    else:
        assert found == ()


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_links_of_every_task_are_described(task, tmp_path):
    links = example_links(task)
    text = str(gaigs.describe(links))
    assert "at 2 receivers" in text
    assert text.endswith("nothing suspicious")
    assert text.count("\n") < 40


def test_repeated_readings_are_counted_and_no_fault():
    rows = [0, *range(59)]
    found = described(places=PLACES[rows], levels=LEVELS[rows])
    assert "4 links repeat place and receiver of another" in found.read
    assert found.findings == ()


def test_black_spectra_are_named():
    links = example_links("spectrum")
    links.labels[3] = 0
    assert gaigs.describe(links).suspicious == (
        "1 of 24 spectra are constant, first that of link 3, 0 to 0",
    )


def test_colours_count_receivers_and_not_readings():
    links = sound()
    twice = torch.cat((torch.arange(len(links)), torch.arange(5)))
    repeated = replace(
        links, query=links.query[twice], labels=links.labels[twice], rows=None, split=None
    )
    bars = [axes.get_ylabel() for axes in figure(repeated).axes]
    assert "RSSI [dBm] at rx0" in bars, (
        "all receivers hear every place, so colours are levels at the first"
    )


def test_the_command_writes_text_and_figure(tmp_path, capsys):
    gaigs.run(
        gaigs.compose("command=describe", "data=synthetic_rssi", "data.transmitters=30"),
        tmp_path / "look",
    )
    text = (tmp_path / "look" / "describe.txt").read_text()
    assert capsys.readouterr().out.startswith(text)
    assert (tmp_path / "look" / "describe.png").stat().st_size > 10_000
