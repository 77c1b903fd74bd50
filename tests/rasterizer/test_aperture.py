"""Sums in the aperture against plane and spherical waves, averages over frequencies and phases, and maps."""

import math

import numpy as np
import pytest
import torch
from reference import factors_of
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from gaigs.geometry import Pose
from gaigs.projection import Plane, Splats
from gaigs.projection.direction_cosine import DirectionCosine
from gaigs.propagation import free_space
from gaigs.rasterizer.aperture import Aperture
from gaigs.rasterizer.torch import TorchRasterizer
from gaigs.scene import Array

CARRIER = 5e9
ARRAY = Array.planar(3, 4, 0.03)
SCATTERED = Array(torch.tensor([[0, 0, 0], [0.042, -0.012, 0], [-0.024, 0.054, 0], [0.006, 0.078, 0]]).double())
arrays = pytest.mark.parametrize("array", [ARRAY, SCATTERED, Array.single()], ids=["planar", "scattered", "single"])


def draw(n=6, b=2, spread=0.2, seed=0):
    """Splats, amplitudes and path lengths, float64."""
    generator = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    factors = spread * (random(b, n, 3) - 0.5)
    splats = Splats(random(b, n, 2) - 0.5, factors, random(b, n), torch.ones(b, n, dtype=torch.bool))
    return splats, torch.randn(b, n, dtype=torch.complex128, generator=generator), 2 + 10 * random(b, n)


def carriers(b=2):
    return torch.full((b,), CARRIER, dtype=torch.float64)


def lags_of(fields, array):
    """The mean of y_i y_j* over the pairs of elements with each difference of places."""
    elements = array.elements.numpy()
    differences = elements[:, None] - elements
    products = fields[:, :, None] * fields[:, None].conj()
    steps, _, _ = array.lags
    return np.stack([products[:, (np.abs(differences - step) < 1e-6).all(-1)].mean(1) for step in steps.numpy()], 1)


def plane_waves(splats, amplitudes, lengths, array, offsets):
    """What each element hears of plane waves from splats, frequency by frequency, far from all of them (b, e, s)."""
    wavenumber = 2 * math.pi * CARRIER / speed_of_light
    steps = wavenumber * array.elements[:, :2].double()
    spread = torch.einsum("ei,bnij,ej->bne", steps, splats.covariances2d.expand(len(lengths), -1, -1, -1), steps)
    centres = splats.means2d.expand(len(lengths), -1, -1)
    waves = amplitudes[..., None] * torch.exp(1j * torch.einsum("ei,bni->bne", steps, centres) - spread / 2)
    turns = torch.exp(-2j * math.pi / speed_of_light * lengths[..., None] * offsets[:, None])
    return torch.einsum("bne,bns->bes", waves, turns)


def turned(array, quaternion):
    """An array in another orientation."""
    rotation = torch.from_numpy(Rotation.from_quat(quaternion).as_matrix())
    return Array(array.elements.double() @ rotation.mT), rotation


def test_far_away_fields_are_plane_waves():
    """Of Gaussians a kilometre away in the directions of splats, as wide as these."""
    splats, amplitudes, _ = draw(spread=0)
    ahead = (1 - splats.means2d.square().sum(-1, keepdim=True)).sqrt()
    points = 1e3 * torch.cat((splats.means2d, ahead), -1)
    axes = 100 * (torch.rand(2, 6, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5)
    # So narrow a band that it turns hardly from one element to the next.
    lengths, offsets = 1e3 + torch.zeros(2, 6).double(), torch.tensor([[0.0, 1e6], [-2e6, 3e5]]).double()
    seen = DirectionCosine(1e-9).project(points, axes, Pose(torch.zeros(3), torch.eye(3)))
    expected = plane_waves(seen, amplitudes, lengths, SCATTERED, offsets)
    found = Aperture().fields(points, axes, amplitudes, lengths, SCATTERED, carriers(), offsets)
    torch.testing.assert_close(found, expected, rtol=0, atol=0.01 * expected.abs().max().item())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_array_of_any_shape_hears_free_space(dtype):
    """One path, the direct one: Friis' formula at each element, some of which are a metre from the others."""
    generator = torch.Generator().manual_seed(0)
    elements = 0.5 * torch.randn(7, 3, generator=generator, dtype=torch.float64)
    points = 3 * torch.randn(5, 1, 3, generator=generator, dtype=torch.float64)
    offsets = torch.linspace(-2e8, 2e8, 4, dtype=torch.float64)
    expected = free_space((points - elements).norm(dim=-1)[..., None], CARRIER + offsets)
    lengths = points.norm(dim=-1)
    amplitudes = torch.polar(1 / lengths, -2 * math.pi * CARRIER / speed_of_light * lengths)
    given = points.to(dtype), torch.zeros(1, 1, 3, 3, dtype=dtype), amplitudes.to(dtype.to_complex()), lengths.to(dtype)
    found = Aperture().fields(*given, Array(elements), carriers(5), offsets.expand(5, -1))
    assert found.dtype == dtype.to_complex()
    found = found * speed_of_light / (4 * math.pi * (CARRIER + offsets))
    torch.testing.assert_close(found.to(expected), expected, rtol=0, atol=2e-4 * expected.abs().max().item())


def test_an_array_may_be_turned_with_all_it_hears():
    _, amplitudes, lengths = draw()
    points, axes = torch.randn(2, 6, 3).double() + 2, 0.1 * torch.randn(2, 6, 3, 3).double()
    offsets = torch.tensor([[0.0, 1e8], [-2e8, 3e7]]).double()
    upright, rotation = turned(ARRAY, (0.3, -0.5, 0.2, 0.7))
    found = [
        Aperture().fields(points @ by.mT, by @ axes, amplitudes, lengths, array, carriers(), offsets)
        for array, by in ((ARRAY, torch.eye(3).double()), (upright, rotation))
    ]
    torch.testing.assert_close(*found)


@arrays
def test_lags_of_one_carrier_are_those_of_the_fields(array):
    splats, amplitudes, lengths = draw()
    fields = plane_waves(splats, amplitudes, lengths, array, torch.zeros(2, 1))[..., 0]
    ones = torch.ones(6, dtype=torch.float64)
    found = Aperture().lags(splats, amplitudes, lengths, ones, None, array, carriers())
    np.testing.assert_allclose(found.numpy(), lags_of(fields.numpy(), array), atol=1e-6)


@pytest.mark.parametrize("bandwidth", [1e7, 5e8, 4e9])
def test_lags_of_a_band_are_averages_over_its_frequencies(bandwidth):
    splats, amplitudes, lengths = draw()
    nodes, weights = np.polynomial.legendre.leggauss(400)
    offsets = torch.from_numpy(nodes * bandwidth / 2).expand(2, -1)
    fields = plane_waves(splats, amplitudes, lengths, ARRAY, offsets).numpy()
    each = lags_of(np.moveaxis(fields, 2, 1).reshape(-1, len(ARRAY)), ARRAY).reshape(2, 400, -1)
    expected = np.einsum("s,bsl->bl", weights / 2, each)
    ones = torch.ones(6, dtype=torch.float64)
    found = Aperture().lags(splats, amplitudes, lengths, ones, torch.tensor(bandwidth).double(), ARRAY, carriers())
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_where_powers_add_lags_are_averages_over_phases():
    """Over phases k j 2 pi / 7 of path k: what any two paths have in common cancels, without any chance."""
    splats, amplitudes, lengths = draw(spread=0)
    average = 0
    for j in range(7):
        turned = amplitudes * torch.exp(2j * math.pi * j / 7 * torch.arange(6, dtype=torch.float64))
        fields = plane_waves(splats, turned, lengths, ARRAY, torch.zeros(2, 1))[..., 0]
        average = average + lags_of(fields.numpy(), ARRAY) / 7
    found = Aperture().lags(splats, amplitudes, lengths, torch.zeros(6).double(), None, ARRAY, carriers())
    np.testing.assert_allclose(found.numpy(), average, atol=1e-6)


def test_spread_power_decorrelates_elements():
    """A splat whose directions add as powers: the average over directions that are drawn from it."""
    splats, amplitudes, lengths = draw(n=1, spread=0.5)
    random = np.random.default_rng(0)
    expected = 0
    count = 4000
    for b in range(2):
        centre, covariance = splats.means2d[b, 0].numpy(), splats.covariances2d[b, 0].numpy()
        directions = torch.from_numpy(random.multivariate_normal(centre, covariance, count))
        visible = torch.ones(1, count, dtype=torch.bool)
        points = Splats(directions[None], torch.zeros(1, count, 3).double(), torch.ones(1, count), visible)
        equal = amplitudes[b : b + 1].expand(1, count) / math.sqrt(count)
        nothing = torch.zeros(count).double()
        expected = Aperture().lags(points, equal, equal.abs(), nothing, None, ARRAY, carriers(1))
        found = Aperture().lags(splats, amplitudes, lengths, torch.zeros(1).double(), None, ARRAY, carriers())[b]
        power = amplitudes[b, 0].abs().square().item()
        assert found[len(found) // 2].item() == pytest.approx(power)
        np.testing.assert_allclose(found.numpy(), expected[0].numpy(), atol=0.06 * power)


def test_coherence_is_the_share_of_interference():
    """What two splats have beyond their powers is in proportion to the product of their coherences."""
    splats, amplitudes, lengths = draw(n=2, spread=0)

    def lags(*coherences):
        coherences = torch.tensor(coherences, dtype=torch.float64)
        return Aperture().lags(splats, amplitudes, lengths, coherences, None, ARRAY, carriers())

    powers, whole = lags(0, 0), lags(1, 1)
    torch.testing.assert_close(lags(0.5, 0.4) - powers, 0.2 * (whole - powers))
    torch.testing.assert_close(lags(1, 0), powers)


def test_opposite_lags_are_conjugates_and_the_middle_one_is_the_power():
    splats, amplitudes, lengths = draw()
    some = torch.linspace(0, 1, 6).double()
    for bandwidth in (None, torch.tensor(5e8).double()):
        found = Aperture().lags(splats, amplitudes, lengths, some, bandwidth, SCATTERED, carriers())
        torch.testing.assert_close(found, found.flip(1).conj())
    powers = Aperture().lags(splats, amplitudes, lengths, 0 * some, None, SCATTERED, carriers())
    middle = powers[:, powers.shape[1] // 2]
    torch.testing.assert_close(middle, amplitudes.abs().square().sum(1).to(middle))


def test_it_is_a_map_of_faint_splats_on_a_fine_grid():
    """Without occlusion a map summed over direction cosines is the aperture's sum, once a splat's peak is its whole.

    The map has the amplitude's density at the peak as its signal; the aperture has the integral over the plane, which
    is 2 pi sqrt(det S) times that. The opacities are as small as maps allow, so that nothing is hidden.
    """
    splats, amplitudes, _ = draw(b=1, n=5, spread=0.3)
    covariances = splats.covariances2d + 0.004 * torch.eye(2).double()
    shared = Splats(splats.means2d[0] * 0.6, factors_of(covariances), splats.depths[0], splats.visible[0])
    step = 0.01
    axis = torch.arange(-1.5, 1.5, step, dtype=torch.float64)
    plane = Plane(axis[None], axis[:, None], None)
    # Footprints are cut off at an opacity of 1/255: an opacity of 0.9 a splat, one at a time, reaches out to 3.3 sigma.
    fields = 0
    wavenumber = 2 * math.pi * CARRIER / speed_of_light
    x, y, _ = ARRAY.elements.T
    steering = torch.exp(1j * wavenumber * (axis[None, :, None] * x + axis[:, None, None] * y))
    opacity = torch.full((1, 1), 0.9).double()
    for k in range(5):
        one = Splats(
            shared.means2d[k : k + 1],
            shared.factors[:, k : k + 1],
            *(t[k : k + 1] for t in (shared.depths, shared.visible)),
        )
        image, _ = TorchRasterizer()(one, torch.view_as_real(amplitudes[:, k : k + 1]), opacity, None, plane)
        waves = torch.complex(*image[0]) / 0.9
        fields = fields + torch.einsum("vu,vue->e", waves, steering) * step**2
    wholes = 2 * math.pi * torch.linalg.det(shared.covariances2d).sqrt()
    found = plane_waves(shared, amplitudes * wholes, torch.zeros(1, 5).double(), ARRAY, torch.zeros(1, 1))
    scale = found.abs().max().item()
    torch.testing.assert_close(found[0, :, 0], fields, rtol=0, atol=0.01 * scale)


def test_what_hides_what_is_all_that_a_map_has_beyond():
    """Faint splats one behind the other in one map: what is missing is of the order of their opacities."""
    splats, amplitudes, _ = draw(b=1, n=4, spread=0.2)
    covariances = splats.covariances2d + 0.01 * torch.eye(2).double()
    shared = Splats(0 * splats.means2d[0], factors_of(covariances), splats.depths[0], splats.visible[0])
    step = 0.02
    axis = torch.arange(-1, 1, step, dtype=torch.float64)
    plane = Plane(axis[None], axis[:, None], None)
    wholes = 2 * math.pi * torch.linalg.det(shared.covariances2d).sqrt()
    missing = {}
    for opacity in (0.05, 0.8):
        opacities = torch.full((1, 4), opacity).double()
        image, _ = TorchRasterizer()(shared, torch.view_as_real(amplitudes), opacities, None, plane)
        total = torch.complex(*image[0]).sum() * step**2
        dimmed = amplitudes * opacities * wholes
        true = plane_waves(shared, dimmed, torch.zeros(1, 4).double(), Array.single(), torch.zeros(1, 1))
        missing[opacity] = ((total - true[0, 0, 0]) / true[0, 0, 0]).abs().item()
    assert missing[0.05] < 0.2
    assert missing[0.8] > 2 * missing[0.05]


def test_lags_of_an_array_that_is_not_planar_are_refused():
    splats, amplitudes, lengths = draw()
    bent = Array(torch.tensor([[0.0, 0, 0], [0.03, 0, 0.01]]))
    message = r"takes planar arrays, whose elements have z = 0 .* got z up to 0\.01 m; for spectra take raster"
    for coherence in (0.0, 1.0):
        with pytest.raises(ValueError, match=message):
            Aperture().lags(splats, amplitudes, lengths, torch.full((6,), coherence).double(), None, bent, carriers())
