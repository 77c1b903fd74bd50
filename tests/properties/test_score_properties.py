"""Scores and losses of arbitrary labels and predictions."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import seeds, unit

from gaigs.geometry import Grid
from gaigs.loss.l1_ssim import structural_similarity
from gaigs.task.csi import HIGHEST, Csi
from gaigs.task.rssi import Rssi
from gaigs.task.spectrum import Spectrum

GRID = Grid.degrees(range(4, 90, 8), range(0, 360, 30))
SPECTRUM = Spectrum(GRID.elevations, GRID.azimuths, "none")


@st.composite
def spectra(draw):
    """Constant ones, black and white ones, and any others."""
    generator = torch.Generator().manual_seed(draw(seeds))
    noise = torch.rand(3, *GRID.shape, generator=generator)
    return draw(
        st.sampled_from([noise, noise.round(), 0 * noise, 0 * noise + 1, 1e-30 * noise])
        | unit.map(lambda level: 0 * noise + level)
    )


@given(spectra(), spectra())
def test_ssim_lies_between_its_bounds_and_is_1_of_what_is_the_same(labels, values):
    scores = SPECTRUM.scores(labels, values)
    assert scores["ssim"].abs().le(1 + 1e-9).all()
    assert scores["mae"].ge(0).all()
    assert scores["mae"].le(1).all()
    same = SPECTRUM.scores(labels, labels)
    assert same["ssim"].sub(1).abs().max() < 1e-9
    assert not same["mae"].any()
    assert torch.equal(SPECTRUM.scores(values, labels)["ssim"], scores["ssim"]) or torch.allclose(
        SPECTRUM.scores(values, labels)["ssim"], scores["ssim"], atol=1e-12
    )


@given(spectra(), spectra(), st.sampled_from([3, 5, 7]))
def test_the_ssim_that_is_trained_has_the_same_bounds(labels, values, window):
    """And with a window of 7 it is the one that is reported."""
    trained = structural_similarity(values.double(), labels.double(), window).item()
    assert abs(trained) <= 1 + 1e-9
    assert structural_similarity(labels.double(), labels.double(), window).item() == pytest.approx(1, abs=1e-9)
    if window == 7:
        assert trained == pytest.approx(SPECTRUM.scores(labels, values)["ssim"].mean().item(), abs=1e-6)


CHANNELS = Csi(2, 2.4e9 + 1e6 * torch.arange(3, dtype=torch.float64))


@given(seeds, st.floats(-120, 60), st.floats(-60, 100), st.floats(-math.pi, math.pi))
def test_snr_is_the_error_in_decibels_whatever_the_scale(seed, level_db, snr_db, phase):
    generator = torch.Generator().manual_seed(seed)
    label, error = (torch.randn(1, 2, 3, dtype=torch.complex128, generator=generator) for _ in range(2))
    label = label / label.abs().square().sum().sqrt() * 10 ** (level_db / 20)
    error = error / error.abs().square().sum().sqrt() * 10 ** ((level_db - snr_db) / 20)
    scores = CHANNELS.scores(label, label + error)
    assert scores["snr_db"].item() == pytest.approx(snr_db, abs=1e-3)
    assert scores["snr_aligned_db"].item() >= scores["snr_db"].item() - 1e-6
    turned = CHANNELS.scores(label, torch.polar(torch.ones(()).double(), torch.tensor(phase).double()) * label)
    assert turned["snr_aligned_db"].item() == pytest.approx(HIGHEST)
    assert CHANNELS.scores(label, label)["snr_db"].item() == pytest.approx(HIGHEST)
    assert CHANNELS.scores(label, 0 * label)["snr_db"].item() == pytest.approx(0)


@given(st.lists(st.floats(-150, 50, width=32), min_size=1, max_size=9), st.floats(-60, 60, width=32))
def test_an_error_of_levels_is_what_they_are_apart(levels, shift):
    task, labels = Rssi(), torch.tensor(levels, dtype=torch.float64)
    scores = task.scores(labels, labels + shift)
    torch.testing.assert_close(scores["mae_db"], torch.full_like(labels, abs(shift)), rtol=0, atol=1e-9)
    summary = task.summarise(scores)
    assert all(value == pytest.approx(abs(shift), abs=1e-6) for value in summary.values())
