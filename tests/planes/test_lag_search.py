"""The search for planes in spectra: in spectra of a room with known walls, and against sums by
hand.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from gaigs.core import stages
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.propagation import fresnel
from gaigs.core.query import Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Split
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.lag_score import LagRoom
from gaigs.planes.lag_search import LagSearch, list_bandwidths
from gaigs.planes.lags import MATERIAL
from gaigs.planes.periodogram import periodogram
from gaigs.splatting.placement.mirrored.reflections import all_sequences, seen_from
from gaigs.testing import example_links

WALLS = torch.tensor([(1.0, 0, 0, 6.5), (0, 1.0, 0, -0.4), (0, 0, 1.0, -0.3)])


@pytest.fixture
def search():
    """A search in covariances of a room of three walls, and its links."""
    torch.manual_seed(0)  # the search draws its seed
    links = example_links("spectrum")
    pose = Pose.from_xyzw([0.5, 1.0, 1.5], [0.0, 0.0, 0.0, 1.0])
    receiver = Receiver("array", pose, Array.planar(4, 4, pitch=0.0625))
    places = torch.tensor([6.0, 4.0, 2.0]) * torch.rand(
        150, 3, generator=torch.Generator().manual_seed(0)
    )
    query = Query(places, torch.zeros(150, dtype=torch.long), torch.full((150,), 2.4e9))
    split = Split("made up", *torch.arange(150).split((150, 0, 0)))
    links = replace(
        links, query=query, receivers=(receiver,), labels=torch.ones(150, 2), rows=None, split=split
    )
    count = len(receiver.array.lags[0])

    def ones(labels, query):
        return (
            torch.ones(len(labels), count, dtype=torch.complex128),
            torch.zeros(len(labels)),
        )

    made = LagSearch(links, query.frequencies, ones, 2)
    own = made.receivers[0]
    walls = seen_from(WALLS, made.frame.middle)
    lags = own.covariances(own.paths(walls, all_sequences(3, 2)), 0.0)
    made.use([replace(own, lags=7 * lags)], 2)
    return made


def test_planes_off_by_decimetres_and_degrees_are_found(search):
    start = WALLS + 0.03 * torch.randn(3, 4, generator=torch.Generator().manual_seed(1))
    start[:, :3] = functional.normalize(start[:, :3], dim=1)
    start[:, 3] += torch.tensor([0.15, -0.2, 0.1])
    assert (start - WALLS)[:, 3].abs().min() > 0.05
    off = (search.run(start, 0.0, 3) - WALLS).abs()
    assert off[:, :3].max() < 0.01, "the faintest counts least"
    assert off[1:, 3].max() < 0.005
    assert off[0, 3] < 0.3, "the faintest may be two wavelengths off: its error hardly counts"


def test_a_search_whose_time_is_up_leaves_planes_near_their_start(search):
    start = WALLS + torch.tensor([0.0, 0.0, 0.0, 0.3])
    with stages.watched(1e-9):
        found = search.run(start, 0.0, 4)
    torch.testing.assert_close(found, start.double(), rtol=0, atol=1e-5)


def test_an_unknown_band_is_a_carrier_where_waves_of_all_planes_interfere(search):
    """Six walls, which all start in wrong places: hardly any move of one alone shows that paths
    interfere.
    """
    walls = torch.cat(
        (WALLS, torch.tensor([(-1.0, 0, 0, 0.2), (0, -1.0, 0, -4.6), (0, 0, -1.0, -2.9)]))
    )
    own = search.receivers[0]
    paths = own.paths(search.frame.from_world(walls).float(), all_sequences(6, 2))
    search.use([replace(own, lags=own.covariances(paths, 0.0))], 2)
    off = torch.tensor([0.3, -0.3, 0.25, 0.35, -0.4, 0.3])
    found = search.run(walls + off[:, None] * torch.tensor([0.0, 0, 0, 1]), None, 6)
    assert search.bandwidth == min(list_bandwidths(None, search.frame, search.options))
    assert (found - walls)[:, 3].abs().max() < 0.1


def test_a_missing_plane_is_found_though_half_of_the_links_lack_it(search):
    own = search.receivers[0]
    paths = own.paths(seen_from(WALLS[:2], search.frame.middle), all_sequences(2, 2))
    without = own.covariances(paths, 0.0)
    search.use([replace(own, lags=torch.cat((own.lags[:75], 7 * without[75:])))], 2)
    found = search.run(WALLS[:2], 0.0, 3)
    assert len(found) == 3
    assert (found[2] * found[2, 2].sign() - WALLS[2]).abs().max() < 0.01


def test_a_plane_stays_where_nothing_shows_it(search):
    """A wall without power: the covariances are those of the direct path alone."""
    own = search.receivers[0]
    lags = own.covariances(own.paths(WALLS[:0], all_sequences(0, 2)), 0.0)
    noise = torch.randn(lags.shape, dtype=lags.dtype, generator=torch.Generator().manual_seed(0))
    search.use([replace(own, lags=lags + 0.3 * lags.abs() * noise)], 2)
    far, count = torch.tensor([[0.0, 0.0, 1.0, 40.0]]), len(own.places)
    room = LagRoom(far, torch.ones(count, 2).bool(), torch.zeros(count))
    assert search.score.move(room, 0).planes is far


@pytest.mark.parametrize(
    ("turn", "flip", "words"),
    [
        (0, 1, None),
        (0, -1, "azimuths were counted clockwise"),
        (1, 1, "turned by 90 degrees\n"),
        (3, -1, "and counted"),
    ],
)
def test_azimuths_that_the_direct_path_contradicts_are_named(search, turn, flip, words):
    own = search.receivers[0]
    frame = torch.eye(3)
    frame[:2, :2] = torch.linalg.matrix_power(torch.tensor([[0.0, -1.0], [1.0, 0.0]]), turn)
    frame[1] *= flip
    paths = own.paths(WALLS[:0], all_sequences(0, 2))
    ways, _ = own.look_at(own.places[:, None])
    lags = own.covariances(paths._replace(steering=own.steer(ways @ frame.T)), 0.0)
    lags = lags / lags[:, lags.shape[1] // 2, None].real
    found = replace(own, lags=lags).describe_doubts("door")
    assert [words in doubt for doubt in found] == [True] * (words is not None)


def test_no_plane_and_no_power_move_nothing(search):
    assert len(search.run(WALLS[:0], 0.0, 3)) == 0
    search.use([], 2)
    torch.testing.assert_close(search.run(WALLS, 0.0, 3), WALLS, rtol=0, atol=0)


@pytest.mark.parametrize("bandwidth", [0.0, 2e8])
def test_the_covariances_are_the_sums_of_waves_over_the_band(search, bandwidth):
    own = search.receivers[0].at(slice(4))
    fields, _, lengths = (part.numpy() for part in own.paths(WALLS, all_sequences(3, 1)))
    found = own.covariances(own.paths(WALLS, all_sequences(3, 1)), bandwidth).numpy()
    position, rotation = own.pose.position.numpy(), own.pose.rotation.numpy()
    places, elements, frequency = (
        own.places.double().numpy(),
        own.array.elements.double().numpy(),
        own.frequency,
    )
    images = np.stack(
        [places, *(places - 2 * ((places @ n) - d)[:, None] * n for *n, d in _rows())], 1
    )
    ways = (images - position) @ rotation
    distances = np.linalg.norm(ways, axis=-1)
    np.testing.assert_allclose(lengths, distances, rtol=1e-6)
    te, tm = (part.numpy() for part in fresnel(MATERIAL, torch.tensor(_cosines(images, position))))
    level = np.array([0, 0, 0, 1.0])
    gains = np.where(np.arange(4) > 0, (1 - level) * te + level * tm, 1) * (np.abs(fields) > 0)
    total = 0
    bands = (np.arange(2000) + 0.5) / 2000 - 0.5 if bandwidth else np.zeros(1)
    wavenumber = 2 * np.pi * frequency / 299792458
    steering = np.exp(1j * wavenumber * (ways / distances[..., None])[..., :2] @ elements[:, :2].T)
    for share in bands:
        phases = -wavenumber * distances - 2 * np.pi * share * bandwidth / 299792458 * distances
        waves = ((gains / distances * np.exp(1j * phases))[..., None] * steering).sum(1)
        total = total + waves[:, :, None] * waves[:, None].conj() / len(bands)
    _, pairs, counts = own.array.lags
    for lag in range(len(counts)):
        expected = total.reshape(4, -1)[:, (pairs == lag).numpy()].mean(1)
        np.testing.assert_allclose(found[:, lag], expected, rtol=0, atol=1e-4 * np.abs(total).max())


def _rows():
    return [(*row[:3], row[3]) for row in WALLS.numpy()]


def _cosines(images, position):
    units = (images - position) / np.linalg.norm(images - position, axis=-1, keepdims=True)
    normals = np.concatenate((np.zeros((1, 3)), WALLS[:, :3].numpy()))
    return np.abs((units * normals).sum(-1)).clip(1e-3)


def test_spectra_give_back_the_covariances_of_their_elements():
    """Up to a scale, though labels have lost their least amplitude."""
    links = example_links("spectrum")
    grid = links.task.directions
    task = Spectrum(grid.elevations, grid.azimuths)
    receiver = replace(links.receivers[0], array=Array.planar(3, 4, pitch=0.05))
    links = replace(links, task=task, receivers=(receiver, receiver))
    pooling = MirroredSplatting(links.scene).pooling
    elements = links.receivers[0].array
    waves = torch.randn(
        5, 3, len(elements), dtype=torch.complex128, generator=torch.Generator().manual_seed(0)
    )
    covariances = (waves.mT @ waves.conj()).flatten(1)
    _, pairs, counts = elements.lags
    lags = covariances.new_zeros(5, len(counts)).index_add(1, pairs, covariances) / counts
    query = Query(torch.zeros(5, 3), torch.zeros(5, dtype=torch.long), torch.full((5,), 2.4e9))
    labels = pooling.beamformer(lags.to(torch.complex64), query)
    found, left = pooling.beamformer.lags(labels, query)
    assert left.max() < 1e-6
    assert pooling.beamformer.lags(labels.flip(1), query)[1].min() > 0.01, (
        "no spectra of this array"
    )
    half = len(counts) // 2
    torch.testing.assert_close(
        found / found[:, half, None], lags / lags[:, half, None], rtol=0, atol=1e-3
    )
    assert not pooling.beamformer.lags(torch.zeros(5, *links.task.shape), query)[0].any()


def test_a_periodogram_sums_the_waves_at_moved_and_turned_planes():
    generator = torch.Generator().manual_seed(0)
    heard = torch.randn(7, dtype=torch.complex64, generator=generator)
    rates = 30 * torch.randn(7, 3, generator=generator)
    moves, turns = torch.linspace(-0.1, 0.1, 5), torch.linspace(0, 0.02, 3)
    tile = periodogram(heard, rates, moves, turns)
    every = torch.cat((-turns[1:].flip(0), turns))
    for i, j, k in itertools.product(range(5), range(5), range(5)):
        phases = rates.double() @ torch.stack((moves[i], every[j], every[k])).double()
        assert tile[i, j, k].item() == pytest.approx(
            (heard * torch.exp(1j * phases)).real.sum().item(), abs=1e-4
        )
