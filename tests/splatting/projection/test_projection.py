"""All projections: the receiver's frame, footprints against samples, the seam, the pole, gradients."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from gaigs.core.geometry import Grid, Pose, from_spherical
from gaigs.splatting.projection.direction_cosine import DirectionCosine
from gaigs.splatting.projection.equirectangular import Equirectangular
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer.torch import TorchRasterizer

PIXEL = math.radians(1)
HERE = Pose(torch.zeros(3), torch.eye(3))
every = pytest.mark.parametrize("kind", [Mercator, Equirectangular, DirectionCosine])
with_a_seam = pytest.mark.parametrize("kind", [Mercator, Equirectangular])


def ball(n, radius, dtype=torch.float32):
    """Semi-axes of round Gaussians."""
    return (radius * torch.eye(3, dtype=dtype)).expand(1, n, 3, 3)


def direction(azimuth, elevation, dtype=torch.float32):
    return from_spherical(*torch.tensor([azimuth, elevation], dtype=dtype).deg2rad())


def draw(projection, means, semi_axes, pose=HERE, grid=None):
    """The map of Gaussians of signal 1 and opacity 0.5."""
    grid = grid or Grid.degrees()
    n = len(means)
    plane = projection.plane(grid)
    splats = projection.project(means, semi_axes, pose)
    image, _ = TorchRasterizer()(splats, torch.ones(1, n, 1), torch.full((1, n), 0.5), None, plane)
    return image[0, 0]


@every
@pytest.mark.parametrize(
    ("azimuth", "elevation"), [(0, 45), (37, 12), (180, 60), (251, 80), (359, 30)]
)
def test_a_gaussian_peaks_at_the_pixel_of_its_direction_in_the_receivers_frame(
    kind, azimuth, elevation
):
    turn = Rotation.from_euler("zyx", [110, -35, 70], degrees=True)
    pose = Pose.from_xyzw((3.0, -1.0, 2.0), turn.as_quat())
    seen = torch.from_numpy(turn.apply(direction(azimuth, elevation, torch.float64))).float()
    image = draw(kind(PIXEL), torch.tensor([[3.0, -1.0, 2.0]]) + 4 * seen, ball(1, 0.1), pose)
    row, column = divmod(int(image.argmax()), 360)
    assert (row + 1, column) == (elevation, azimuth)
    assert image.max() > 0.49


@every
@pytest.mark.parametrize("sets", [1, 3])
def test_means_may_differ_between_transmitters(kind, sets):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(3, 5, 3, generator=generator)
    means[1, 2] = 0  # on the receiver
    half = torch.randn(sets, 5, 3, 3, generator=generator)
    together = kind(PIXEL).project(means, half, HERE)
    assert not together.visible[1, 2]
    assert together.visible.sum() == 14
    for k in range(3):
        alone = kind(PIXEL).project(means[k], half[k % sets][None], HERE)
        torch.testing.assert_close(together.means2d[k], alone.means2d)
        torch.testing.assert_close(together.factors[k], alone.factors[0])
        torch.testing.assert_close(together.depths[k], alone.depths)
        assert torch.equal(together.visible[k], alone.visible)


@every
@pytest.mark.parametrize("place", [(0, 10), (60, 0), (-130, 45), (179, 70), (20, -30)])
def test_footprints_are_the_covariances_of_projected_samples(kind, place):
    generator = torch.Generator().manual_seed(0)
    mean = 3 * direction(*place, torch.float64)
    axes = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    half = axes * torch.tensor([0.01, 0.03, 0.005], dtype=torch.float64)
    samples = mean + torch.randn(100_000, 3, generator=generator, dtype=torch.float64) @ half.mT
    projection = kind(1e-9)
    turn = Rotation.from_euler("zyx", [110, -35, 70], degrees=True)
    pose = Pose(torch.tensor([3.0, -1, 2], dtype=torch.float64), torch.from_numpy(turn.as_matrix()))
    splats = projection.project(pose.world(mean[None]), (pose.rotation @ half)[None, None], pose)
    off = projection.coordinates(samples) - splats.means2d
    if kind is not DirectionCosine:
        off[:, 0] = (off[:, 0] + math.pi).remainder(math.tau) - math.pi
    expected = off.mT @ off / len(off)
    footprint = splats.covariances2d[0, 0]
    torch.testing.assert_close(
        footprint, expected, rtol=0, atol=0.02 * expected.diagonal().max().item()
    )


@every
def test_a_pixels_variance_is_added(kind):
    means, semi_axes = 3 * torch.randn(9, 3, dtype=torch.float64), ball(9, 0.1, torch.float64)
    narrow, wide = (
        kind(pixel).project(means, semi_axes, HERE).covariances2d for pixel in (1e-9, 0.3)
    )
    square = torch.full((1, 9, 2, 2), 0.3**2 / 12, dtype=torch.float64) * torch.eye(2)
    torch.testing.assert_close(wide - narrow, square)


@with_a_seam
def test_a_gaussian_at_the_seam_is_seen_on_both_sides(kind):
    image = draw(kind(PIXEL), 3 * direction(0, 20)[None], ball(1, 0.2))
    torch.testing.assert_close(image[:, 1:20], image[:, -19:].flip(1), rtol=0, atol=1e-4)
    assert image[19, 359] > 0.4


@every
def test_a_gaussian_at_the_pole_is_seen_at_all_azimuths(kind):
    image = draw(kind(PIXEL), torch.tensor([[0.0, 0.0, 3.0]]), ball(1, 0.8))
    assert image[84:].min() > 0.2
    assert image[84:].max() <= 0.5
    beside = draw(kind(PIXEL), 3 * direction(0, 86)[None], ball(1, 0.8))
    assert (beside[84:] - image[84:]).abs().max() < 0.2


@every
def test_a_centre_that_is_nan_is_not_hidden(kind):
    means = torch.tensor([[1.0, 2.0, math.nan], [1.0, 2.0, 3.0]])
    assert kind(PIXEL).project(means, ball(2, 0.2), HERE).visible.all()
    assert draw(kind(PIXEL), means, ball(2, 0.2)).isnan().all()


@every
def test_gradients_of_a_projected_gaussian_are_those_of_finite_differences(kind):
    pose = replace(HERE, position=torch.tensor([0.1, 0.2, 0.3]))
    means = torch.tensor(
        [[1.0, 2, 3], [-2, 0.1, 0.5], [-0.3, -2, 2]], dtype=torch.float64, requires_grad=True
    )
    half = torch.randn(
        2, 3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ).requires_grad_()

    def project(means, half):
        splats = kind(PIXEL).project(means, half, pose)
        return splats.means2d, splats.factors

    assert torch.autograd.gradcheck(project, (means, half))


def test_pixels_of_no_width_and_limits_at_the_pole_are_refused():
    for pixel in (0.0, math.nan):
        with pytest.raises(ValueError, match=f"wider than 0 rad, got {pixel}"):
            DirectionCosine(pixel)
    for limit in (0.0, 90.0, math.nan):
        with pytest.raises(ValueError, match=f"between 0 and 90 degrees, got {limit}"):
            Mercator(PIXEL, limit)
