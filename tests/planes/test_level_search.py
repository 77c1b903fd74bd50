"""The search for planes in received levels, in levels of a room with known walls, made by numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from torch.nn import functional

from gaigs.core import stages
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.propagation import fresnel
from gaigs.core.query import Query
from gaigs.data import Split
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.lags import MATERIAL
from gaigs.planes.level_search import LevelSearch
from gaigs.testing import example_links

WALLS = torch.tensor([(1.0, 0, 0, 6.5), (0, 1.0, 0, -0.4), (-1.0, 0, 0, 0.5)])
PLACES, CARRIER, BANDWIDTH = 300, 2.4e9, 8e7


def levels(places, position):
    """Of the direct path and of single reflections, over the band [dB]."""
    places, position = places.double().numpy(), np.array(position)
    powers = 0
    for share in (np.arange(40) + 0.5) / 40 - 0.5:
        wavenumber = 2 * np.pi * (CARRIER + share * BANDWIDTH) / speed_of_light
        lengths = np.linalg.norm(places - position, axis=1)
        wave = np.exp(-1j * wavenumber * lengths) / lengths
        for *normal, offset in WALLS.double().tolist():
            image = places - 2 * ((places @ normal) - offset)[:, None] * np.array(normal)
            lengths = np.linalg.norm(image - position, axis=1)
            cosines = np.abs((image - position) @ normal) / lengths
            wave = (
                wave
                + fresnel(MATERIAL, torch.tensor(cosines))[0].numpy()
                * np.exp(-1j * wavenumber * lengths)
                / lengths
            )
        powers = powers + np.abs(wave) ** 2
    return 10 * np.log10(powers)


def room(bandwidth, noise=1.0, is_silent=False, seed=0):
    """A search that starts decimetres and degrees off, and the placement of an untrained model."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.tensor([6.0, 4.0, 2.0]) * torch.rand(PLACES, 3, generator=generator)
    positions = [(0.9, 1.0, 1.5), (5.0, 3.0, 1.0)]
    receivers = tuple(
        Receiver(f"gateway{k}", Pose.from_xyzw(position, (0.0, 0, 0, 1)), Array.single())
        for k, position in enumerate(positions)
    )
    labels = torch.from_numpy(
        np.concatenate([levels(places, position) + 7 * k for k, position in enumerate(positions)])
    )
    labels = (0 if is_silent else labels) + noise * torch.randn(
        2 * PLACES, dtype=torch.float64, generator=generator
    )
    rows = torch.arange(2).repeat_interleave(PLACES)
    query = Query(places.repeat(2, 1), rows, torch.full((2 * PLACES,), CARRIER))
    split = Split("made up", *torch.arange(2 * PLACES).split((2 * PLACES, 0, 0)))
    links = replace(
        example_links("rssi"), query=query, receivers=receivers, labels=labels.float(), rows=None
    )
    links = replace(links, split=split, bandwidth=bandwidth)
    start = WALLS + torch.tensor(
        [(0.0, 0.02, 0.01, 0.15), (0.02, 0.0, -0.01, -0.1), (0.0, 0.01, 0.0, 0.12)]
    )
    start[:, :3] = functional.normalize(start[:, :3], dim=1)
    torch.manual_seed(0)
    placement = MirroredSplatting(
        links.scene, placement={"name": "mirrored", "obstacles": 0}
    ).placement
    for k, plane in enumerate(start):
        placement.place(k, plane)
    placement.kept.copy_(placement.sequences_of(torch.arange(3)))
    search = LevelSearch(links, query.frequencies, 0 * links.labels, start, [0, 1, 2], 2)
    placement.enable_phases(search.wavelength)
    placement.locate()
    return search, placement


def planes(placement):
    normals = placement.normals[:3]
    return torch.cat(
        (normals, (placement.offsets[:3] + normals @ placement.middle)[:, None]), 1
    ).detach()


@pytest.mark.parametrize("bandwidth", [BANDWIDTH, None])
def test_planes_off_by_decimetres_are_located(bandwidth):
    search, placement = room(bandwidth)
    assert sorted(search.locate(placement)) == [0, 1, 2]
    off = (planes(placement) - WALLS).abs()
    assert off[:, :3].max() < 0.01
    assert off[:, 3].max() < 0.02
    if bandwidth is None:
        assert 1 / 4 < placement.log_bandwidth.exp() / BANDWIDTH < 4


def test_a_search_whose_time_is_up_locates_no_more():
    search, placement = room(BANDWIDTH)
    with stages.watched(1e-9):
        assert search.locate(placement) == []
    assert not placement.located.any()


@pytest.mark.parametrize("seed", [0, 7])
def test_no_plane_is_located_in_noise(seed):
    search, placement = room(BANDWIDTH, noise=6.0, is_silent=True, seed=seed)
    before = planes(placement)
    assert search.locate(placement) == []
    assert not placement.located.any()
    torch.testing.assert_close(planes(placement), before, rtol=0, atol=0)


def test_waves_interfere_at_located_planes_alone():
    search, placement = room(BANDWIDTH)
    assert not placement.located.any()
    query = search.queries[0]
    unknown = placement(None, query)
    placement.locate(1)
    placement.locate(2)
    assert placement.located.nonzero()[:, 0].tolist() == [1, 2]
    sequences, coherences = placement.sequences[placement.kept], placement(None, query).coherences
    assert ((coherences > 0.9) == (sequences != 0).all(1)).all()
    assert ((unknown.coherences > 0) == (sequences < 0).all(1)).all()
    assert (coherences[(sequences == 0).any(1)] == 0).all(), "and cost no sum of waves"
