"""Spectra: scores against scikit-image and numpy, called here on each pair of images; thinning."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from gaigs.core.geometry import Grid, Rays
from gaigs.core.query import Batch, Query
from gaigs.core.task.spectrum import Spectrum

GRID = Grid.degrees(range(5, 90, 10), range(0, 360, 15))
TASK = Spectrum(GRID.elevations, GRID.azimuths)


@pytest.fixture
def pairs():
    generator = torch.Generator().manual_seed(3)
    labels = torch.rand(5, *TASK.shape, generator=generator)
    return labels, labels + 0.2 * torch.randn(5, *TASK.shape, generator=generator)


@pytest.mark.parametrize(
    "shape", [(90, 360), (128, 512), (256, 256), (511, 256), (73, 360), (361, 181), (9, 8)]
)
def test_fingerprints_are_of_many_rows_and_columns(shape):
    rows, columns = shape
    row, column = np.divmod(
        TASK.fingerprint(torch.arange(rows * columns).view(1, *shape))[0].numpy(), columns
    )
    assert 0.8 * min(512, rows * columns) <= len(row) <= 512
    assert len(np.unique(row)) >= min(rows, 64)
    assert len(np.unique(column)) >= columns / 8


# --- scores ---


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_scores_are_those_of_scikit_image(pairs, dtype):
    labels, values = (part.to(dtype) for part in pairs)
    scores = TASK.scores(labels, values)
    for k in range(5):
        a, b = labels[k].double().numpy(), values[k].double().numpy()
        assert scores["ssim"][k].item() == structural_similarity(a, b, data_range=1)
        assert scores["mae"][k].item() == pytest.approx(np.abs(a - b).mean(), rel=1e-12)


def test_summary_is_that_of_numpy():
    ssim, mae = np.random.default_rng(0).random((2, 17))
    summary = TASK.summarise({"ssim": torch.tensor(ssim), "mae": torch.tensor(mae)})
    expected = {
        "ssim_median": np.median(ssim),
        "ssim_mean": ssim.mean(),
        "ssim_p10": np.percentile(ssim, 10),
        "ssim_p90": np.percentile(ssim, 90),
        "mae": mae.mean(),
    }
    assert list(summary) == list(expected) == list(Spectrum.metrics())
    assert summary == pytest.approx(expected, rel=1e-12)
    assert [metric.higher_is_better for metric in Spectrum.metrics().values()] == [True] * 4 + [
        False
    ]


@pytest.mark.parametrize(
    ("labels", "values", "message"),
    [
        (torch.zeros(9, 24), torch.zeros(9, 24), r"must both be \('k', 9, 24\), got \(9, 24\)"),
        (
            torch.zeros(2, 24, 9),
            torch.zeros(2, 24, 9),
            r"must both be \('k', 9, 24\), got \(2, 24, 9\)",
        ),
        (torch.zeros(2, 9, 24), torch.zeros(1, 9, 24), r"got \(2, 9, 24\) and \(1, 9, 24\)"),
        (
            torch.zeros(3, 9, 24),
            torch.zeros(3, 9, 24).index_fill(0, torch.tensor([1]), torch.nan),
            "in number 1",
        ),
        (torch.full((1, 9, 24), torch.inf), torch.zeros(1, 9, 24), "labels must be finite"),
    ],
)
def test_unusable_spectra_are_refused(labels, values, message):
    with pytest.raises(ValueError, match=message):
        TASK.scores(labels, values)


def test_spectra_smaller_than_the_window_are_refused():
    small = Spectrum(GRID.elevations[:6], GRID.azimuths, "none")
    with pytest.raises(ValueError, match=r"at least 7 x 7 pixels, got \(6, 24\)"):
        small.scores(torch.zeros(2, 6, 24), torch.zeros(2, 6, 24))


def test_axes_are_arrays_in_radians():
    axes = GRID.elevations.numpy(), GRID.azimuths.tolist()
    directions = Spectrum(*axes, "none").directions
    assert torch.equal(directions.elevations, GRID.elevations)
    assert torch.equal(directions.azimuths, GRID.azimuths)
    with pytest.raises(
        ValueError, match=r"elevations must be a list of angles .* rad, got 5; Grid.degrees takes"
    ):
        Spectrum(np.rad2deg(axes[0]), axes[1], "none")


def test_nothing_to_summarise_is_refused():
    with pytest.raises(ValueError, match="at least one sample"):
        TASK.summarise(TASK.scores(torch.zeros(0, 9, 24), torch.zeros(0, 9, 24)))


# --- thinning ---


def batch():
    """Two links whose labels are the numbers of the pixels."""
    numbers = torch.arange(9.0 * 24).reshape(9, 24).expand(2, 9, 24)
    return Batch(Query(torch.zeros(2, 3), torch.tensor([0, 1])), GRID, numbers, (0.5, 0.25))


def seeded(seed):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("asked", [1, 2, 3, 4])
def test_a_stride_keeps_every_nth_row_and_column_from_a_random_first(asked):
    """A quarter of nine rows would be too few for the loss."""
    thin, firsts, stride = TASK.thinning(stride=asked), set(), min(asked, 3)
    for seed in range(60):
        part = thin(batch(), seeded(seed))
        row, column = divmod(int(part.labels[0, 0, 0]), 24)
        firsts.add((row, column))
        assert torch.equal(part.labels, batch().labels[:, row::stride, column::stride])
        assert torch.equal(part.directions.elevations, GRID.elevations[row::stride])
        assert torch.equal(part.directions.azimuths, GRID.azimuths[column::stride])
        assert min(part.directions.shape) >= 3
    assert firsts == {(row, column) for row in range(stride) for column in range(stride)}


@pytest.mark.parametrize("rays", [1, 50, 9 * 24])
def test_rays_are_different_random_pixels(rays):
    thin, seen = TASK.thinning(rays=rays), torch.zeros(9 * 24)
    for seed in range(30):
        part = thin(batch(), seeded(seed))
        assert isinstance(part.directions, Rays)
        assert part.labels.shape == (2, rays)
        assert torch.equal(part.labels[0], part.labels[1])
        chosen = part.labels[0].long()
        assert len(chosen.unique()) == rays
        torch.testing.assert_close(part.directions.vectors(), GRID.vectors().flatten(0, 1)[chosen])
        seen[chosen] += 1
    if rays == 50:  # each pixel in 50 of 216 steps, here 6.9 of 30
        assert seen.mean().item() == pytest.approx(30 * 50 / 216)
        assert seen.max() < 20


def test_thinning_depends_on_the_generator_alone():
    for options in ({"stride": 3}, {"rays": 20}):
        thin = TASK.thinning(**options)
        one, same, other = (thin(batch(), seeded(seed)).labels for seed in (4, 4, 5))
        assert torch.equal(one, same)
        assert not torch.equal(one, other)


def test_links_and_shares_stay():
    whole = batch()
    for options in ({}, {"stride": 2}, {"rays": 20}):
        part = TASK.thinning(**options)(whole, seeded(0))
        assert part.query is whole.query
        assert part.shares == (0.5, 0.25)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stride": 0}, r"training\.thinning\.stride must be at least 1, got 0"),
        (
            {"rays": 0},
            r"training\.thinning\.rays must be in 1\.\.216 with stride=1, got 0, stride 1",
        ),
        ({"rays": 217}, r"rays must be in 1\.\.216"),
        ({"rays": 20, "stride": 2}, "with stride=1, got 20, stride 2"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TASK.thinning(**options)
