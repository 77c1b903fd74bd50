"""Checks of levels by the law of distance: each fault is named with its numbers, and sound surveys
have none.
"""

import re

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.checks import check
from gaigs.data.readings import gateway

RANDOM = np.random.default_rng(0)
PLACES = RANDOM.uniform([0, 0, 1], [18, 11, 1.5], (120, 3))
GATEWAYS = np.array([[1.0, 2.0, 2.5], [16.0, 9.5, 2.5], [4.0, 10.0, 2.0], [13.0, 1.5, 2.2]])
NOISE = RANDOM.normal(0, 3, (120, 4))


def levels_of(places, gateways):
    apart = np.linalg.norm(places[:, None] - gateways, axis=2)
    return -40 - 28 * np.log10(apart) + NOISE[: len(places), : len(gateways)]


LEVELS = levels_of(PLACES, GATEWAYS)


def links_of(places=PLACES, gateways=GATEWAYS, levels=LEVELS, frequency=None, uncertainties=None):
    rows, columns = np.nonzero(~np.isnan(levels))
    receivers = tuple(
        gateway(f"ap{k}", torch.tensor(place).float()) for k, place in enumerate(gateways)
    )
    carriers = (
        None if frequency is None else torch.full((len(rows),), frequency, dtype=torch.float64)
    )
    return Links(
        query=Query(torch.tensor(places).float()[rows], torch.tensor(columns), carriers),
        receivers=receivers,
        labels=torch.tensor(levels[rows, columns]).float(),
        task=Rssi(),
        rows=torch.tensor(rows),
        uncertainties=uncertainties,
    )


def found_in(**options):
    return [str(finding) for finding in check(links_of(**options))]


def changed(row, column, value):
    levels = LEVELS.copy()
    levels[row, column] = value
    return levels


POWERS = 10 ** (LEVELS / 10)
UNITS = {
    "watts": (1e-3 * POWERS, "are they watts.; levels = 10 . np.log10.levels / 1e-3., or .* of mW"),
    "milliwatts": (1e4 * POWERS, "are they mW.; levels = 10 . np.log10.levels.$"),
    "microwatts": (
        1e7 * POWERS,
        "are they microwatts or less.; levels = 10 . np.log10.levels . 1e-3. of microwatts",
    ),
    "volts": (
        10 ** ((LEVELS - 13) / 20),
        "are they volts.; levels = 20 . np.log10.levels. . 13 at 50 ohm",
    ),
    "watts, 0 for silence": (
        np.where(LEVELS < -70, 0, 1e-3 * POWERS),
        "are they watts.; levels = 10",
    ),
    "sign": (
        -LEVELS,
        "480 levels are above 0 dBm, .* to 8.*; was a sign lost, or are they path losses. levels = "
        "-l",
    ),
    "dBuV": (
        LEVELS + 107,
        "480 levels are above 0 dBm, .*, and fall with the distance; percent, .* dBuV",
    ),
    "signs of a row": (
        np.where(np.arange(120)[:, None] == 7, -LEVELS, LEVELS),
        "^4 levels are above 0 dBm, and usual",
    ),
}


@pytest.mark.parametrize("unit", UNITS)
def test_another_unit_of_levels_is_named(unit):
    levels, words = UNITS[unit]
    found = found_in(levels=levels)
    assert re.search(words, found[0]), found


@pytest.mark.parametrize(
    ("value", "is_named"), [(12.0, True), (-20.0, False), (-165.0, True), (-100.0, False)]
)
def test_a_level_far_from_those_of_near_places_is_named_by_its_row(value, is_named):
    place = int(np.argsort(LEVELS[:, 3])[40])
    found = found_in(levels=changed(place, 3, value))
    at = ", ".join(f"{x:.4g}" for x in PLACES[place])
    words = rf"row {place} \({at}\) at ap3: {value:g} dBm, its neighbours -\d\d.* dBm; correct"
    assert any(re.search(words, one) for one in found) == is_named
    assert len(found) == is_named


def test_further_levels_far_from_near_places_are_counted():
    levels = LEVELS.copy()
    levels[::20, 2] = -185 - np.arange(6)
    (found,) = [one for one in found_in(levels=levels) if "near places" in one]
    assert found.count("row") == 3
    assert " and 3 more;" in found


CONVENTIONS = {
    "receivers in mm": (1, 1e3, "rx are in mm; rx = rx . 0.001"),
    "receivers in cm": (1, 100, "rx are in cm; rx = rx . 0.01"),
    "receivers in inches": (1, 1 / 0.0254, "rx are in inches; rx = rx . 0.0254"),
    "receivers in feet": (1, 1 / 0.3048, "rx are in feet; rx = rx . 0.3048"),
    "places in cm": (100, 1, "tx are in cm; tx = tx . 0.01"),
    "exchanged axes": (1, [1, 0, 2], r"rx have x and y exchanged; rx = rx\[:, \[1, 0, 2\]\]"),
}


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_another_convention_of_places_is_named_by_one_receiver_too(convention, count):
    factor, change, words = CONVENTIONS[convention]
    gateways = GATEWAYS[1 : count + 1]
    moved = gateways[:, change] if isinstance(change, list) else change * gateways
    found = found_in(places=factor * PLACES, gateways=moved, levels=LEVELS[:, 1 : count + 1])
    assert any(
        re.search(rf"distance to 2.* dB instead of .* dB if {words}", one) for one in found
    ), found


@pytest.mark.parametrize(
    ("gateways", "words"),
    [
        (
            GATEWAYS - [9, 5.5, 0],
            r"the origin of rx is the middle of tx; rx\[:, :2\] \+= \(\(tx.min\(0\) \+ tx.max",
        ),
        (GATEWAYS * [1, -1, 1], "if rx have y negated; rx = rx . .1, -1, 1."),
        (
            GATEWAYS * [1, -1, 1] + [0, 11, 0],
            "rx have (x|y) from the other end; rx.* = .* as rows of a picture",
        ),
        (
            np.add(GATEWAYS, [9, 5, 0]),
            r"if all receivers stand \(-[89].*, -[45].*\) m elsewhere; rx = rx \+ \[",
        ),
        (
            GATEWAYS[[1, 0, 2, 3]],
            "levels of ap0, ap1 follow .* from the places of ap1, ap0; are names or places exch",
        ),
        (np.roll(GATEWAYS, 1, 0), r"are receivers counted from 1. rx = np.roll\(rx, -1, axis=0\)"),
        (np.roll(GATEWAYS, -1, 0), r"are receivers counted from 1. rx = np.roll\(rx, 1, axis=0\)"),
        (
            np.vstack((GATEWAYS[:3], [[2.0, 10.0, 2.0]])),
            r"levels of ap3 follow .* from \(1.*, .*\) m, 1\d.* m off its",
        ),
    ],
)
def test_receivers_at_places_that_levels_contradict_are_named(gateways, words):
    found = found_in(gateways=gateways)
    assert any(re.search(words, one) for one in found), found


def test_rows_of_places_in_another_order_are_doubted():
    found = found_in(places=RANDOM.permutation(PLACES))
    assert any(
        "near places do not agree; are places and levels in the same order" in one for one in found
    ), found


@pytest.mark.parametrize(
    ("factor", "shift", "words"),
    [
        (1e3, 30, "take a transmitter of .* dBm in free space; are places in mm or cm"),
        (1e3, 0, "receivers are .* m above or below all places; are places in mm"),
        (1e-3, -30, "take a transmitter of -.* dBm in free space; are places in km"),
    ],
)
def test_a_unit_of_all_places_is_doubted_by_what_free_space_allows(factor, shift, words):
    frequency = None if shift == 0 else 2.4e9
    found = found_in(
        places=factor * PLACES,
        gateways=factor * GATEWAYS,
        levels=LEVELS + shift,
        frequency=frequency,
    )
    assert any(re.search(words, one) for one in found), found


def test_places_that_were_scaled_are_doubted():
    size = np.array([18.0, 11.0, 3.0])
    (found,) = found_in(places=PLACES / size, gateways=GATEWAYS / size)
    assert re.match(
        "places span 0.98.* m, as if scaled to 0..1 along each axis; give them in metres", found
    )


def test_degrees_in_place_of_metres_are_named():
    scale, origin = [1e-5, 1e-5, 1], [8.5, 47.3, 0]
    found = found_in(places=PLACES * scale + origin, gateways=GATEWAYS * scale + origin)
    assert found[0].startswith(
        "x and y of places span 0.00018 m around (8.500097, 47.30006); are they degrees?"
    )


@pytest.mark.parametrize("kind", ["open", "walls", "sectors"])
@pytest.mark.parametrize("span", [10.0, 300.0, 10_000.0])
@pytest.mark.parametrize("count", [1, 5])
def test_sound_surveys_from_10_m_to_10_km_have_no_remark(kind, span, count):
    for seed in range(2):
        random = np.random.default_rng(seed)
        places = random.uniform(0, span, (150, 3)) * [1, 0.7, 0] + [0, 0, 1.5]
        gateways = random.uniform(0, span, (count, 3)) * [1, 0.7, 0] + [
            0,
            0,
            2.5 if span < 100 else 20,
        ]
        offsets = places[:, None] - gateways
        levels = (
            -10 - 32 * np.log10(np.linalg.norm(offsets, axis=2)) + random.normal(0, 6, (150, count))
        )
        if kind == "walls":
            levels -= 12 * ((places[:, None, 0] > span / 2) != (gateways[:, 0] > span / 2))
        if kind == "sectors":
            azimuths = np.arctan2(offsets[..., 1], offsets[..., 0]) - random.uniform(-3, 3, count)
            levels -= np.minimum(12 * (np.degrees(np.angle(np.exp(1j * azimuths))) / 65) ** 2, 25)
        assert found_in(places=places, gateways=gateways, levels=levels) == []


def test_receivers_without_a_given_place_are_not_compared_with_the_distance():
    assert found_in(gateways=GATEWAYS[[1, 0, 2, 3]], uncertainties=torch.full((4,), 2.0)) == []


@pytest.mark.parametrize("seed", range(3))
def test_levels_of_the_built_in_room_have_no_remark(seed):
    links = gaigs.links("synthetic_rssi", transmitters=60, **{"data.seed": seed})
    assert [*check(links)] == []


def test_watts_in_arrays_are_named_when_they_are_loaded(caplog):
    links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=1e-3 * POWERS)
    assert "are they watts?; levels = 10 * np.log10(levels / 1e-3)" in links.remarks
