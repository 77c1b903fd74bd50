"""Spectra of an array, from a map and from paths, against beamforming in numpy and the simulated
room.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Rays
from gaigs.core.query import Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Split
from gaigs.data.synthetic import ROOM, furnished_room, respond_in_parts
from gaigs.data.synthetic.image_source import frequency_offsets
from gaigs.splatting.pooling.array_response import ArrayResponsePooling
from gaigs.splatting.pooling.path_spectrum import PathSpectrum
from gaigs.testing import example_links

CARRIER = 5e9
GRID = [8, 16]


@pytest.fixture
def scene():
    """Two turned 3 x 3 arrays, and labels of 18 x 36 pixels."""
    return example_links("spectrum", CARRIER).scene


def ask(count, carrier=CARRIER):
    return Query(
        torch.zeros(count, 3), torch.zeros(count, dtype=torch.long), torch.full((count,), carrier)
    )


def draw(scene, count=3, seed=0):
    """Random fields of the array's elements, and the lags of their covariance; float64."""
    array = scene.receivers[0].array
    generator = torch.Generator().manual_seed(seed)
    fields = torch.randn(count, len(array), dtype=torch.complex128, generator=generator)
    return fields, lags_of(fields[:, :, None], array)


def lags_of(responses, array):
    """Mean products of pairs of elements, of (b, elements, frequencies)."""
    _, pairs, counts = array.lags
    covariances = (responses @ responses.mH / responses.shape[-1]).flatten(1)
    return (
        covariances.new_zeros(len(responses), len(counts)).index_add(1, pairs, covariances) / counts
    )


def beamformed(fields, array, directions, carrier=CARRIER):
    """|sum_n y_n exp(-j 2 pi / lambda r_n . u)| in each direction."""
    vectors = directions.flatten().vectors().double().numpy()
    phases = 2 * math.pi * carrier / speed_of_light * array.elements.double().numpy() @ vectors.T
    return np.abs(fields.numpy() @ np.exp(-1j * phases))


def min_max(spectra):
    low, high = spectra.min(1, keepdims=True), spectra.max(1, keepdims=True)
    return (spectra - low) / (high - low)


def test_spectra_are_those_of_the_beamformer(scene):
    fields, lags = draw(scene)
    found = PathSpectrum(scene).read(lags, ask(3))
    expected = min_max(beamformed(fields, scene.receivers[0].array, scene.task.directions))
    np.testing.assert_allclose(found.flatten(1).numpy(), expected, atol=2e-3)
    assert found.shape == (3, 18, 36)
    assert found.amin((1, 2)).tolist() == [0] * 3
    assert found.amax((1, 2)).tolist() == pytest.approx([1] * 3)


@pytest.mark.parametrize("spectrum", ["band", "carrier"])
def test_the_labels_of_the_simulated_room_follow_from_its_paths(spectrum):
    links = furnished_room(spectrum=spectrum, transmitters=6, order=1)
    receiver, carrier = links.receivers[0], links.query.frequencies[0].item()
    offsets = frequency_offsets(ROOM, 499.2e6, 1) if spectrum == "band" else torch.zeros(1)
    (responses,) = respond_in_parts(ROOM, links.query.transmitters, receiver, carrier, offsets, 1)
    lags = lags_of(responses, receiver.array).to(torch.complex64)
    everything = torch.arange(6)
    scene = replace(links, split=Split("all", everything, everything[:0], everything)).scene
    found = PathSpectrum(scene).read(lags, links.query)
    labels = links.labels[torch.arange(6)]
    # In single precision, near nulls the root of a power is that of its roundings.
    assert (found - labels).abs().mean() < 1e-4
    assert (found - labels).abs().max() < 5e-3


def test_a_map_is_summed_into_the_elements(scene):
    """A map with two bright pixels is two plane waves, each as strong as the pixel's solid angle
    and pattern say.
    """
    pooling = ArrayResponsePooling(scene, GRID)
    array, grid = scene.receivers[0].array, pooling.grid
    image = torch.zeros(1, 2, 8, 16).double()
    image[0, :, 6, 3], image[0, :, 5, 11] = torch.tensor([1.0, 0.5]), torch.tensor([-0.2, 0.7])
    vectors = grid.flatten().vectors().double().view(8, 16, 3)
    fields = torch.zeros(1, 9, dtype=torch.complex128)
    for row, column, wave in ((6, 3, 1 + 0.5j), (5, 11, -0.2 + 0.7j)):
        vector = vectors[row, column]
        phases = 2 * math.pi * CARRIER / speed_of_light * array.elements.double() @ vector
        strength = (
            grid.solid_angles[row, column].double() * vector[2]
        )  # a patch hears as the cosine
        fields += wave * strength * torch.polar(torch.ones_like(phases), phases)
    expected = min_max(beamformed(fields, array, scene.task.directions))
    np.testing.assert_allclose(pooling(image, ask(1)).flatten(1).numpy(), expected, atol=2e-3)


def test_behind_patches_nothing_is_heard(scene):
    pooling = ArrayResponsePooling(scene, GRID)
    assert pooling.zone == (0, math.pi / 2)
    image = torch.randn(1, 2, 8, 16, generator=torch.Generator().manual_seed(0))
    above = image * (pooling.grid.elevations > 0)[:, None]
    torch.testing.assert_close(pooling(image, ask(1)), pooling(above, ask(1)))
    isotropic = tuple(
        replace(r, array=replace(r.array, pattern="isotropic")) for r in scene.receivers
    )
    assert ArrayResponsePooling(replace(scene, receivers=isotropic), GRID).zone == (
        -math.pi / 2,
        math.pi / 2,
    )


def test_thinned_directions_have_the_values_of_the_whole():
    """A label of 90 x 360 pixels, whose extremes are those of the wanted directions and of coarse
    ones.
    """
    links = example_links("spectrum", CARRIER)
    grid = Grid.degrees()
    array = Array.planar(4, 4, 0.03, "cosine")
    receivers = tuple(replace(receiver, array=array) for receiver in links.receivers)
    task = Spectrum(grid.elevations, grid.azimuths, links.task.normalisation)
    scene = replace(links.scene, receivers=receivers, task=task)
    pooling = PathSpectrum(scene)
    _, lags = draw(scene, count=20)
    whole = pooling.read(lags, ask(20))
    rays = torch.randperm(90 * 360, generator=torch.Generator().manual_seed(0))[:300]
    for asked, expected in (
        (grid.thin(slice(1, None, 4), slice(2, None, 4)), whole[:, 1::4, 2::4]),
        (grid.flatten()[rays], whole.flatten(1)[:, rays]),
    ):
        found = pooling.read(lags, ask(20), asked)
        assert found.shape == expected.shape
        assert (
            found - expected
        ).abs().max() < 0.05  # the deepest null lies between the coarse ones
        assert (found - expected).abs().mean() < 0.01


def test_other_directions_of_the_labels_shape_are_other_directions(scene):
    fields, lags = draw(scene)
    pooling = PathSpectrum(scene)
    pooling.read(lags, ask(3))
    own = scene.task.directions
    other = Grid(own.elevations, own.azimuths + math.radians(5))
    found = pooling.read(lags, ask(3), other)
    array = scene.receivers[0].array
    whole, expected = (beamformed(fields, array, directions) for directions in (own, other))
    low = np.minimum(whole.min(1), expected.min(1))[:, None]
    high = np.maximum(whole.max(1), expected.max(1))[:, None]
    np.testing.assert_allclose(found.flatten(1).numpy(), (expected - low) / (high - low), atol=2e-3)


def test_each_link_is_seen_at_its_own_carrier(scene):
    fields, lags = draw(scene, count=4)
    query = replace(ask(4), frequencies=torch.tensor([CARRIER, 4.2e9, CARRIER, 5.5e9]))
    found = PathSpectrum(scene).read(lags, query)
    for k, carrier in enumerate(query.frequencies.tolist()):
        expected = min_max(
            beamformed(fields[k : k + 1], scene.receivers[0].array, scene.task.directions, carrier)
        )
        np.testing.assert_allclose(found[k].flatten()[None].numpy(), expected, atol=2e-3)


def test_the_spectrum_of_silence_is_0(scene):
    pooling = PathSpectrum(scene)
    _, lags = draw(scene)
    heard = lags.to(torch.complex64)
    heard[1] = 0
    heard.requires_grad_()
    found = pooling.read(heard, ask(3))
    assert torch.equal(found[1], torch.zeros(18, 36))
    (gradient,) = torch.autograd.grad(found.square().sum(), heard)
    assert gradient.isfinite().all()
    assert gradient[0].any()
    assert not gradient[1].any()
    image = torch.zeros(2, 2, 8, 16, requires_grad=True)
    quiet = ArrayResponsePooling(scene, GRID)(image, ask(2))
    assert not quiet.any()
    quiet.sum().backward()
    assert image.grad.isfinite().all()


def test_gradients_are_the_derivatives(scene):
    _, lags = draw(scene, count=1)
    rays = Rays(torch.tensor([0.5, 0.9]), torch.tensor([0.3, 2.0]))
    heard = torch.view_as_real(lags).requires_grad_()
    pooling = PathSpectrum(scene)

    def small(heard):
        return pooling.read(torch.view_as_complex(heard), ask(1), rays)

    assert torch.autograd.gradcheck(small, heard, atol=1e-5)


def test_other_labels_arrays_and_grids_are_refused(scene):
    single = replace(scene, receivers=(Receiver("hook", scene.receivers[0].pose),))
    cases = [
        (example_links("rssi").scene, GRID, "gives spectra, not labels of task 'rssi'"),
        (example_links("spectrum").scene, GRID, "takes labels scaled by min-max .*, got 'none'"),
        (single, GRID, "arrays of at least 2 elements, got 1 of hook"),
        (scene, [16], r"pooling\.grid must be \[rows, columns\]"),
    ]
    for own, grid, message in cases:
        with pytest.raises(ValueError, match=message):
            ArrayResponsePooling(own, grid)
    unknown = PathSpectrum(replace(scene, frequencies=torch.zeros(0)))
    with pytest.raises(ValueError, match=r"each link must have a frequency \[Hz\]"):
        unknown.read(draw(scene)[1], replace(ask(3), frequencies=None))
