"""Free space and reflection against numpy, signs against known phases."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.phases import array_sign, phase_sign
from gaigs.core.propagation import free_space, fresnel, slab
from gaigs.core.query import Query
from gaigs.core.scene import carriers, check_elements, direct_gains, direct_waves
from gaigs.testing import example_links

FREQUENCIES = torch.tensor([2.40e9, 2.44e9, 2.48e9], dtype=torch.float64)
POSES = (
    Pose.from_xyzw((0.2, 0.2, 2.5), (-0.6, 0, 0, 0.8)),
    Pose.from_xyzw((5.0, 4.0, 1.0), (0, 0.6, 0.8, 0)),
)


def scene(array):
    """Two turned receivers with that array."""
    receivers = tuple(Receiver(f"gateway{i}", pose, array) for i, pose in enumerate(POSES))
    return replace(example_links("csi").scene, receivers=receivers)


def ask(count, seed=0):
    places = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor(
        [6.0, 4.0, 2.0]
    )
    return Query(places, torch.arange(count) % 2)


def friis(distance, frequency, sign):
    wavelength = speed_of_light / frequency
    return (
        wavelength
        / (4 * math.pi * distance)
        * cmath.exp(sign * 2j * math.pi * distance / wavelength)
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_free_space_is_friis_formula(sign):
    distances, frequencies = torch.tensor([0.5, 3.0, 1234.5]), torch.tensor([9e8, 6.4896e9])
    found = free_space(distances[:, None], frequencies, sign)
    assert found.dtype == torch.complex128
    for i, distance in enumerate(distances.tolist()):
        for j, frequency in enumerate(frequencies.double().tolist()):
            expected = friis(distance, frequency, sign)
            assert abs(found[i, j].item() - expected) < 1e-9 * abs(expected)


def test_sign_0_gives_the_amplitude_alone_and_near_waves_are_those_of_a_centimetre():
    found = free_space(torch.tensor([2.0]), torch.tensor([1e9]), 0)
    assert found.item() == pytest.approx(abs(friis(2.0, 1e9, -1)))
    assert found.imag.item() == 0

    near = free_space(torch.tensor([0.0, 1e-3, 1e-2]), torch.tensor([1e9]))
    assert near[0] == near[1] == near[2]
    assert near[0].item() == pytest.approx(friis(1e-2, 1e9, -1))


@pytest.mark.parametrize("at_elements", [True, False])
@pytest.mark.parametrize("sign", [-1, 1])
def test_direct_waves_go_to_each_element(at_elements, sign):
    array = Array.planar(2, 3, 0.06)
    query = ask(5)
    found = direct_waves(scene(array), query, FREQUENCIES, sign, at_elements)
    elements = array.elements.double().numpy() if at_elements else np.zeros((1, 3))
    assert found.shape == (5, len(elements), 3)
    for i in range(5):
        pose = POSES[i % 2]
        places = elements @ pose.rotation.double().numpy().T + pose.position.double().numpy()
        for e, place in enumerate(places):
            distance = float(np.linalg.norm(query.transmitters[i].double().numpy() - place))
            for s, frequency in enumerate(FREQUENCIES.tolist()):
                expected = friis(distance, frequency, sign)
                assert abs(found[i, e, s].item() - expected) < 1e-7 * abs(expected)


def test_the_pattern_is_that_towards_the_transmitter():
    query = ask(40)
    gains = direct_gains(scene(Array.planar(2, 2, 0.06, "cosine")), query)
    for i, gain in enumerate(gains.tolist()):
        ray = (query.transmitters[i] - POSES[i % 2].position).double().numpy()
        normal = POSES[i % 2].rotation.double().numpy()[:, 2]
        assert gain == pytest.approx(max(0, ray @ normal / np.linalg.norm(ray)), abs=1e-6)
    assert (gains == 0).any()
    assert (gains > 0.1).any()
    assert torch.equal(
        direct_gains(scene(Array.planar(2, 2, 0.06)), query), torch.ones(40, dtype=torch.float64)
    )
    on_top = Query(POSES[0].position[None], torch.tensor([0]))
    assert direct_gains(scene(Array.planar(2, 2, 0.06, "cosine")), on_top).item() == 1


SURFACES = {"glass": 6.31 - 0.05j, "wet_brick": 12 - 4j, "metal": 1 - 3.6e7j, "foam": 1.05 + 0j}
"""Relative permittivities."""


@pytest.mark.parametrize("surface", SURFACES)
def test_reflection_follows_snells_law(surface):
    """Against the form with both angles and both impedances."""
    angles = np.linspace(0, 1.5, 40)
    n = np.sqrt(SURFACES[surface])
    inside = np.sqrt(1 - (np.sin(angles) / n) ** 2 + 0j)  # cosine of the angle of refraction
    te = (np.cos(angles) - n * inside) / (np.cos(angles) + n * inside)
    tm = (n * np.cos(angles) - inside) / (n * np.cos(angles) + inside)
    for found, expected in zip(
        fresnel(SURFACES[surface], torch.from_numpy(np.cos(angles))), (te, tm), strict=True
    ):
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9, atol=1e-12)


def test_each_surface_may_have_its_own_permittivity_and_learns_it():
    permittivities = torch.tensor([*SURFACES.values()], dtype=torch.complex128, requires_grad=True)
    cosines = torch.linspace(0.05, 1, 7, dtype=torch.float64)[:, None].requires_grad_()
    together = fresnel(permittivities, cosines)
    for i, surface in enumerate(SURFACES.values()):
        for whole, alone in zip(together, fresnel(surface, cosines[:, 0]), strict=True):
            torch.testing.assert_close(whole[:, i], alone)
    torch.autograd.gradcheck(fresnel, (permittivities[[0, 1]], cosines))


@pytest.mark.parametrize("surface", ["glass", "wet_brick", "foam"])
def test_a_slab_adds_its_inner_reflections(surface):
    cosines, thickness = np.linspace(0.05, 1, 12), 0.43
    root = np.sqrt(SURFACES[surface] - 1 + cosines**2)
    there_and_back = np.exp(-4j * np.pi * thickness * root)
    found = slab(SURFACES[surface], torch.from_numpy(cosines), thickness)
    for reflected, one in zip(
        found, fresnel(SURFACES[surface], torch.from_numpy(cosines)), strict=True
    ):
        r = one.numpy()
        inner = sum(
            (1 - r**2) * -r * there_and_back * (r**2 * there_and_back) ** k for k in range(400)
        )
        np.testing.assert_allclose(reflected.numpy(), r + inner, rtol=0, atol=1e-9)
        assert (reflected.abs() <= 1).all(), "no slab gains power"


def test_a_thick_slab_is_a_half_space_and_none_reflects_nothing():
    cosines = torch.linspace(0.05, 1, 7).double()
    for surface in ("wet_brick", "metal"):
        for found, expected in zip(
            slab(SURFACES[surface], cosines, 30.0), fresnel(SURFACES[surface], cosines), strict=True
        ):
            torch.testing.assert_close(found, expected)
    assert not any(part.any() for part in slab(SURFACES["glass"], cosines, 0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_thin_slabs_and_grazing_waves_have_finite_gradients(dtype):
    cosines = torch.tensor([0.0, 1e-4, 1.0], dtype=dtype).requires_grad_()
    thickness = torch.tensor([[1e-6], [1e-3], [0.5], [1e3]], dtype=dtype).requires_grad_()
    permittivity = torch.tensor(4 - 0.3j, dtype=dtype.to_complex()).requires_grad_()
    sum(part.abs().square().sum() for part in slab(permittivity, cosines, thickness)).backward()
    for part in (cosines, thickness, permittivity):
        assert part.grad.isfinite().all()


def test_the_carrier_of_a_link_is_its_own_or_the_datas_only_one():
    spectra, band = example_links().scene, torch.tensor([2.4e9, 5e9])
    own = Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long), band)
    silent = replace(own, frequencies=None)
    assert carriers(replace(spectra, frequencies=band), own).tolist() == band.tolist()
    assert carriers(replace(spectra, frequencies=band[1:]), silent).tolist() == [5e9, 5e9]
    middle = carriers(example_links("csi").scene, silent)
    assert middle.tolist() == pytest.approx([2.44e9] * 2)
    assert middle.dtype == torch.float32
    for known in (band, band[:0]):
        with pytest.raises(ValueError, match=r"each link must have a frequency \[Hz\]"):
            carriers(replace(spectra, frequencies=known), silent)


def made(count=40, gains=(1.0, 1.0), clutter=0.0, seed=0):
    """Channels of the direct wave, times a gain of each receiver, and waves of random phase beside
    it.
    """
    query = ask(count)
    waves = direct_waves(scene(Array.planar(2, 2, 0.06)), query, FREQUENCIES)
    random = torch.randn(
        waves.shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed)
    )
    return (
        query,
        waves,
        waves * torch.tensor(gains)[query.receivers][:, None, None]
        + clutter * waves.abs() * random,
    )


@pytest.mark.parametrize("clutter", [0.0, 1.0])
def test_the_sign_follows_the_phases_of_the_direct_path(clutter):
    gains = 3e4 * cmath.exp(1j), 2e4 * cmath.exp(-2j)  # clocks of their own
    query, waves, channels = made(gains=gains, clutter=2e4 * clutter)
    assert phase_sign(channels, waves, query.receivers) == -1
    assert phase_sign(channels.conj(), waves, query.receivers) == 1


@pytest.mark.parametrize("seed", range(5))
def test_random_phases_show_no_sign(seed):
    query, waves, _ = made(count=100)
    phases = (
        2
        * math.pi
        * torch.rand(100, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    )
    turned = waves * torch.polar(torch.ones_like(phases), phases)
    assert phase_sign(turned, waves, query.receivers) == 0
    assert array_sign(turned, waves) == -1
    assert array_sign(turned.conj(), waves) == 1


def test_few_links_show_no_sign_and_single_numbers_no_sign_between_elements():
    query, waves, channels = made(count=4)
    assert phase_sign(channels, waves, query.receivers) == 0
    waves = direct_waves(scene(Array.single()), query, FREQUENCIES[:1])
    assert array_sign(waves.abs().to(waves.dtype), waves) == -1


def test_arrays_must_fit_the_labels():
    links = example_links("csi")
    check_elements("model 'm'", links.scene)
    with pytest.raises(ValueError, match="gateway0"):
        check_elements("model 'm'", scene(Array.planar(3, 3, 0.06)))
    with pytest.raises(ValueError, match="model 'm' gives complex channels"):
        check_elements("model 'm'", example_links("rssi").scene)
