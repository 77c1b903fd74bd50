"""Fourier features against numpy, their origins and octaves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.splatting.gaussians import Placed
from gaigs.splatting.tokenizer.euclidean import (
    BAND_FREQUENCIES,
    EuclideanTokenizer,
    fourier_features,
    learnable_octaves,
    octaves,
)
from gaigs.testing import example_links

OPTIONS = {"gaussian_octaves": (-3, 2), "transmitter_octaves": (-2, 4), "hidden": 16, "width": 8}


def ask(places, frequencies=None):
    return Query(places, torch.zeros(len(places), dtype=torch.long), frequencies)


@pytest.fixture
def scene():
    return example_links().scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def test_features_are_position_sine_and_cosine_of_whole_octaves():
    points = torch.randn(5, 3, dtype=torch.float64)
    features = fourier_features(points, octaves("gaussian_octaves", -1, 2).double())
    x = points.numpy()
    for i, cycles in enumerate((0.5, 1, 2, 4)):
        np.testing.assert_allclose(
            features[:, 3 + i : 15 : 4], np.sin(2 * np.pi * cycles * x), atol=1e-5
        )
        np.testing.assert_allclose(
            features[:, 15 + i : 27 : 4], np.cos(2 * np.pi * cycles * x), atol=1e-5
        )
    np.testing.assert_array_equal(features[:, :3], x)
    assert features.shape == (5, 27)


def test_a_gaussians_token_is_its_features_about_the_receivers_middle(scene):
    tokenizer = EuclideanTokenizer(scene, **OPTIONS)
    means = torch.randn(7, 3)
    tokens = tokenizer(Placed(means[None]), torch.rand(7), ask(torch.rand(2, 3)))
    middle = (scene.receivers[0].pose.position + scene.receivers[1].pose.position) / 2
    assert torch.equal(
        tokens.gaussians, fourier_features(means - middle, octaves("gaussian_octaves", -3, 2))
    )
    assert tokens.gaussians.shape == (7, tokenizer.gaussian_width) == (7, 39)
    assert tokens.transmitters.shape == (2, tokenizer.transmitter_width) == (2, 8)


def test_without_a_network_the_transmitters_token_is_its_features(scene):
    tokenizer = EuclideanTokenizer(scene, **(OPTIONS | {"hidden": None, "width": None}))
    places = torch.rand(2, 3)
    tokens = tokenizer(Placed(torch.randn(1, 7, 3)), torch.rand(7), ask(places))
    middle = (scene.lower + scene.upper) / 2
    assert torch.equal(
        tokens.transmitters,
        fourier_features(places - middle, octaves("transmitter_octaves", -2, 4)),
    )
    assert tokenizer.transmitter_width == 45
    assert not [*tokenizer.parameters()]


@pytest.mark.parametrize("spacing", [0.001, 0.03, 0.2, 5.0])
@pytest.mark.parametrize("edge", [0.5, 3.0, 40.0])
def test_octaves_span_the_box_and_stop_well_above_the_spacing(scene, spacing, edge):
    upper = scene.lower + torch.tensor([0.3, 1.0, 0.2]) * edge
    lowest, highest = learnable_octaves(replace(scene, upper=upper, spacing=spacing))
    shortest, longest = 2.0**-highest, 2.0**-lowest
    assert 0.7 < shortest / (16 * spacing) < 1.42
    assert longest == shortest or 2 * edge <= longest < 4 * edge + 1e-3
    assert longest >= 2 * edge * (1 - 1e-6)


@pytest.mark.parametrize(
    ("spacing", "edge", "expected"),
    [(0.02, 9.0, (-5, -4)), (0.02, 4.0, (-4, -4)), (5.0, 90.0, (-8, -6))],
)
def test_noisy_labels_get_periods_of_16_m_or_more(scene, spacing, edge, expected):
    upper = scene.lower + torch.tensor([0.3, 1.0, 0.2]) * edge
    assert learnable_octaves(replace(scene, upper=upper, spacing=spacing, task=Rssi())) == expected


def test_carriers_have_features_of_their_logarithm(scene):
    scene = replace(scene, frequencies=torch.tensor([2e9, 4e9, 8e9]))
    tokenizer = EuclideanTokenizer(scene, **OPTIONS)
    seen = []
    tokenizer.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    places = torch.rand(1, 3).expand(3, 3)
    tokenizer(
        Placed(torch.randn(1, 7, 3)), torch.rand(7), ask(places, torch.tensor([2e9, 4e9, 8e9]))
    )
    x = np.array([-1.0, 0.0, 1.0])[:, None]  # an octave each
    phases = x * BAND_FREQUENCIES.numpy()
    expected = np.concatenate((x, np.sin(phases), np.cos(phases)), 1)
    np.testing.assert_allclose(seen[0][:, -expected.shape[1] :], expected, atol=1e-5)
    assert seen[0].shape == (3, 3 * 15 + expected.shape[1])


def test_a_band_needs_a_frequency(scene):
    tokenizer = EuclideanTokenizer(
        replace(scene, frequencies=torch.tensor([2.4e9, 5e9])), **OPTIONS
    )
    with pytest.raises(ValueError, match="a frequency must be given"):
        tokenizer(Placed(torch.randn(1, 7, 3)), torch.rand(7), ask(torch.rand(2, 3)))
