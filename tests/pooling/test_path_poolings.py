"""Sums of paths at an array against plain sums, plane and spherical waves, and averages."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from gaigs.antenna import Array, Receiver
from gaigs.geometry import Pose
from gaigs.pooling.path_rssi import PathRssi
from gaigs.pooling.paths import LagPooling, ReceivedPaths, element_fields
from gaigs.projection import Splats
from gaigs.projection.direction_cosine import DirectionCosine
from gaigs.propagation import NEAREST, free_space
from gaigs.testing import example_links
from gaigs.testing.checks import PRECISION, fixed_sum, require_close

CARRIER = 5e9
ARRAY = Array.planar(3, 4, 0.03)
SCATTERED = Array(torch.tensor([[0, 0, 0], [42, -12, 0], [-24, 54, 0], [6, 78, 0]]).double() / 1000)
BENT = Array(torch.tensor([[0, 0, 0], [42, -12, 900], [-240, 540, 30], [6, 0, -78]]).double() / 1000)
HERE = Pose(torch.zeros(3), torch.eye(3))


def fields_of(points, axes, amplitudes, lengths, array, carriers, offsets):
    """Fields of Gaussians in the array's frame."""
    ones = torch.ones_like(lengths[0]) if len(lengths) else lengths.new_ones(points.shape[1])
    paths = ReceivedPaths(points, axes, amplitudes, lengths, ones, None, Receiver("here", HERE, array), carriers)
    return element_fields(paths, offsets)


def sum_fields(points, semi_axes, amplitudes, lengths, array, carriers, offsets):
    """One spherical wave a path at each element and frequency, each with its own phase."""
    covariances = (semi_axes @ semi_axes.mT).expand(len(points), -1, -1, -1)
    wavenumbers = 2 * math.pi / speed_of_light * carriers[:, None]
    ways = points.norm(dim=-1).clamp_min(NEAREST)
    units = points / ways[..., None]
    heard = []
    for element in array.elements.to(points):
        own = (points - element).norm(dim=-1).clamp_min(NEAREST)
        aside = element - (units @ element)[..., None] * units
        spread = torch.einsum("bni,bnij,bnj->bn", aside, covariances, aside) / ways.square()
        strengths = amplitudes * ways / own * torch.exp(-wavenumbers.square() * spread / 2)
        delays = (lengths + own - ways) / speed_of_light
        phases = (wavenumbers * (own - ways))[..., None] + 2 * math.pi * delays[..., None] * offsets[:, None]
        heard.append((strengths[..., None] * torch.exp(-1j * phases)).sum(1))
    return torch.stack(heard, 1)


def sum_lags(means2d, factors, visible, amplitudes, lengths, coherences, bandwidth, array, carriers):
    """The covariance of each pair of elements over all pairs of paths; its mean over the pairs of each lag."""
    splats = Splats(means2d, factors, visible.double(), visible)
    elements, amplitudes = array.elements.to(lengths), torch.where(visible, amplitudes, 0)
    apart = (lengths[:, :, None] - lengths[:, None]) / speed_of_light
    likeness = torch.ones_like(apart) if bandwidth is None else torch.sinc(bandwidth * apart)
    steering, waves = footprints(splats, elements[:, :2], carriers), amplitudes * coherences
    powers = amplitudes.abs().square() * (1 - coherences.square())
    steps, pairs, counts = array.lags
    covariances = []
    for i in range(len(array)):
        for j in range(len(array)):
            both = waves * steering[..., i], (waves * steering[..., j]).conj()
            alone = footprints(splats, (elements[i] - elements[j])[None, :2], carriers)[..., 0]
            covariances.append(torch.einsum("bn,bm,bnm->b", *both, likeness.to(waves)) + (powers * alone).sum(1))
    sums = torch.zeros(len(lengths), len(steps), dtype=amplitudes.dtype)
    return sums.index_add(1, pairs, torch.stack(covariances, 1)) / counts.to(lengths)


def footprints(splats, steps, carriers):
    """exp(-(k D)' S (k D) / 2 + j k D . u) of each path at each step D, k being the wavenumber."""
    turned = (2 * math.pi / speed_of_light * carriers)[:, None, None] * steps
    spreads = splats.covariances2d.expand(len(carriers), -1, -1, -1)
    centres = splats.means2d.expand(len(carriers), -1, -1)
    spread = torch.einsum("bki,bnij,bkj->bnk", turned, spreads, turned)
    return torch.exp(-spread / 2 + 1j * torch.einsum("bki,bni->bnk", turned, centres))


def scene(n=9, b=2, array=SCATTERED, spread=(1e-3, 0.3), coherence=(0, 1), bandwidth=4e8, own=True, planar=True):
    """Paths as points with axes and as splats, in float64; some of them sit on the array's middle."""
    generator = torch.Generator().manual_seed(0)
    random = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator).double()
    rows, sets = (b,) if own else (1,), b if own else 1
    visible = random(0, 1, *rows, n) > 0.1
    points = torch.randn(b, n, 3, generator=generator).double()
    points = points + 0.5 * torch.nn.functional.normalize(points, dim=-1)  # none nearer than some decimetres
    amplitudes, lengths = torch.randn(b, n, dtype=torch.complex128, generator=generator), random(0.5, 20, b, n)
    carriers, factors = random(4.5e9, 5.5e9, b), random(*spread, sets, n, 3) * torch.tensor([1, -1, 1])
    axes, centres = random(*spread, sets, n, 3, 3), random(-0.7, 0.7, *rows, n, 2)
    fields = (points * visible[..., None], axes, amplitudes, lengths), (array, carriers, random(-1e8, 1e8, b, 3))
    band = None if bandwidth is None else torch.tensor(bandwidth).double()
    lags = (centres, factors, visible, amplitudes, lengths, random(*coherence, n), band), (array, carriers)
    return {"fields": fields, "lags": lags} if planar else {"fields": fields}


SCENES = {
    "random": scene(),
    "Gaussians that all queries share": scene(own=False),
    "a regular array": scene(array=Array.planar(3, 2, 0.03, "cosine")),
    "a bent array": scene(array=BENT, planar=False),
    "a single element": scene(array=Array.single()),
    "one carrier": scene(bandwidth=None),
    "powers add": scene(coherence=(0, 0)),
    "a wide band": scene(coherence=(1, 1), bandwidth=3e9),
    "zero paths": scene(n=0),
    "zero queries": scene(b=0),
    "points": scene(spread=(0, 0)),
    "wider than the plane": scene(spread=(1, 5)),
}


def lags_of_parts(means2d, factors, visible, *others):
    return LagPooling.covariances(Splats(means2d, factors, visible.double(), visible), *others)


SUMS = {"fields": (fields_of, sum_fields), "lags": (lags_of_parts, sum_lags)}


def graded(function, leaves, constants):
    """A value, and the gradients of a fixed sum of it, each times the largest value of its leaf."""
    made = lambda leaf: leaf is not None and leaf.dtype != torch.bool
    leaves = [leaf.detach().clone().requires_grad_() if made(leaf) else leaf for leaf in leaves]
    value, inputs = function(*leaves, *constants), [leaf for leaf in leaves if made(leaf)]
    gradients = torch.autograd.grad(fixed_sum(value), inputs, allow_unused=True)
    sizes = [leaf.detach().abs().amax() if leaf.numel() else 1 for leaf in inputs]
    pairs = zip(inputs, gradients, sizes, strict=True)
    return [value.detach(), *(torch.zeros_like(i) if g is None else g * size for i, g, size in pairs)]


@pytest.mark.parametrize("dtype", PRECISION)
@pytest.mark.parametrize("title", SCENES)
def test_sums_and_gradients_are_those_of_plain_sums(title, dtype):
    for what, (leaves, constants) in SCENES[title].items():
        function, plain = SUMS[what]
        to = lambda part: (
            part.to(dtype.to_complex() if part.is_complex() else dtype)
            if isinstance(part, torch.Tensor) and part.dtype != torch.bool
            else part
        )
        found = graded(function, map(to, leaves), [*map(to, constants)])
        expected = graded(plain, (leaf if leaf is None else leaf.clone() for leaf in leaves), constants)
        for one, true in zip(found, expected, strict=True):
            assert one.dtype == to(true).dtype
            require_close(one, true, PRECISION[dtype], f"{title}: {what}")


@pytest.mark.parametrize(("what", "broken"), [("fields", 0), ("fields", 1), ("fields", 2), ("lags", 0), ("lags", 3)])
def test_nan_shows(what, broken):
    leaves, constants = SCENES["random"][what]
    leaves = [leaf.clone() for leaf in leaves]
    leaves[broken][:, int(SCENES["random"]["lags"][0][2][0].int().argmax())] = torch.nan
    assert SUMS[what][0](*leaves, *constants).isnan().any()


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
    """Plane waves from splats at each element, frequency by frequency, far from all of them (b, e, s)."""
    waves = amplitudes[..., None] * footprints(splats, array.elements[:, :2].double(), carriers(len(lengths)))
    turns = torch.exp(-2j * math.pi / speed_of_light * lengths[..., None] * offsets[:, None])
    return torch.einsum("bne,bns->bes", waves, turns)


def test_far_away_fields_are_plane_waves():
    """Of Gaussians a kilometre away in the directions of splats, as wide as these."""
    splats, amplitudes, _ = draw(spread=0)
    ahead = (1 - splats.means2d.square().sum(-1, keepdim=True)).sqrt()
    points = 1e3 * torch.cat((splats.means2d, ahead), -1)
    axes = 100 * (torch.rand(2, 6, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5)
    # So narrow a band that it turns hardly from one element to the next.
    lengths, offsets = 1e3 + torch.zeros(2, 6).double(), torch.tensor([[0.0, 1e6], [-2e6, 3e5]]).double()
    seen = DirectionCosine(1e-9).project(points, axes, HERE)
    expected = plane_waves(seen, amplitudes, lengths, SCATTERED, offsets)
    found = fields_of(points, axes, amplitudes, lengths, SCATTERED, carriers(), offsets)
    torch.testing.assert_close(found, expected, rtol=0, atol=0.01 * expected.abs().max().item())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_array_of_any_shape_hears_free_space(dtype):
    """Friis' formula for the direct path at elements up to a metre apart."""
    generator = torch.Generator().manual_seed(0)
    elements = 0.5 * torch.randn(7, 3, generator=generator, dtype=torch.float64)
    points = 3 * torch.randn(5, 1, 3, generator=generator, dtype=torch.float64)
    offsets = torch.linspace(-2e8, 2e8, 4, dtype=torch.float64)
    expected = free_space((points - elements).norm(dim=-1)[..., None], CARRIER + offsets)
    lengths = points.norm(dim=-1)
    amplitudes = torch.polar(1 / lengths, -2 * math.pi * CARRIER / speed_of_light * lengths)
    given = points.to(dtype), torch.zeros(1, 1, 3, 3, dtype=dtype), amplitudes.to(dtype.to_complex()), lengths.to(dtype)
    found = fields_of(*given, Array(elements), carriers(5), offsets.expand(5, -1))
    found = found * speed_of_light / (4 * math.pi * (CARRIER + offsets))
    torch.testing.assert_close(found.to(expected), expected, rtol=0, atol=2e-4 * expected.abs().max().item())


def test_sums_do_not_change_when_receiver_and_paths_move_together():
    _, amplitudes, lengths = draw()
    points, axes = torch.randn(2, 6, 3).double() + 2, 0.1 * torch.randn(2, 6, 3, 3).double()
    rotation = torch.from_numpy(Rotation.from_quat((0.3, -0.5, 0.2, 0.7)).as_matrix())
    poses = Pose(torch.zeros(3).double(), torch.eye(3).double()), Pose(torch.tensor([1.0, -2, 3]).double(), rotation)
    links = example_links("rssi", CARRIER)
    fields, lags = [], []
    for pose in poses:
        receiver = Receiver("here", pose, ARRAY)
        paths = ReceivedPaths(
            pose.world(points), pose.rotation @ axes, amplitudes, lengths, torch.linspace(0, 1, 6).double(), None,
            receiver, carriers(),
        )  # fmt: skip
        fields.append(element_fields(paths, torch.tensor([[0.0, 1e8], [-2e8, 3e7]]).double()))
        lags.append(PathRssi(replace(links.scene, receivers=(receiver,))).sum_paths(paths))
    torch.testing.assert_close(*fields)
    torch.testing.assert_close(*lags)


@pytest.mark.parametrize("bandwidth", [1e7, 5e8, 4e9])
def test_lags_of_a_band_are_averages_over_its_frequencies(bandwidth):
    splats, amplitudes, lengths = draw()
    nodes, weights = np.polynomial.legendre.leggauss(400)
    offsets = torch.from_numpy(nodes * bandwidth / 2).expand(2, -1)
    fields = plane_waves(splats, amplitudes, lengths, ARRAY, offsets).numpy()
    each = lags_of(np.moveaxis(fields, 2, 1).reshape(-1, len(ARRAY)), ARRAY).reshape(2, 400, -1)
    expected = np.einsum("s,bsl->bl", weights / 2, each)
    ones = torch.ones(6, dtype=torch.float64)
    found = LagPooling.covariances(
        splats, amplitudes, lengths, ones, torch.tensor(bandwidth).double(), ARRAY, carriers()
    )
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_where_powers_add_lags_are_averages_over_phases():
    """Over phases k j 2 pi / 7 of path k, the interference of any two paths cancels."""
    splats, amplitudes, lengths = draw(spread=0)
    average = 0
    for j in range(7):
        turned = amplitudes * torch.exp(2j * math.pi * j / 7 * torch.arange(6, dtype=torch.float64))
        fields = plane_waves(splats, turned, lengths, ARRAY, torch.zeros(2, 1))[..., 0]
        average = average + lags_of(fields.numpy(), ARRAY) / 7
    found = LagPooling.covariances(splats, amplitudes, lengths, torch.zeros(6).double(), None, ARRAY, carriers())
    np.testing.assert_allclose(found.numpy(), average, atol=1e-6)


def test_coherence_is_the_share_of_interference():
    """The interference of two paths is in proportion to the product of their coherences."""
    splats, amplitudes, lengths = draw(n=2, spread=0)

    def lags(*coherences):
        coherences = torch.tensor(coherences, dtype=torch.float64)
        return LagPooling.covariances(splats, amplitudes, lengths, coherences, None, ARRAY, carriers())

    powers, whole = lags(0, 0), lags(1, 1)
    torch.testing.assert_close(lags(0.5, 0.4) - powers, 0.2 * (whole - powers))
    torch.testing.assert_close(lags(1, 0), powers)


def test_a_path_on_the_receiver_has_no_direction_and_is_left_out():
    links = example_links("rssi", CARRIER)
    receiver = Receiver("here", Pose(torch.tensor([1.0, 2, 3]), torch.eye(3)), ARRAY)
    means = torch.tensor([[[1.0, 2, 3], [4.0, 2, 5]]]).requires_grad_()
    amplitudes, lengths = torch.tensor([[5.0 + 0j, 2.0]]), torch.tensor([[0.0, 4]])
    paths = ReceivedPaths(
        means, torch.zeros(1, 2, 3, 3), amplitudes, lengths, torch.ones(2), None, receiver, torch.tensor([CARRIER])
    )
    lags = PathRssi(replace(links.scene, receivers=(receiver,))).sum_paths(paths)
    assert lags[0, lags.shape[1] // 2].item() == pytest.approx(4, rel=0.03)
    lags.abs().sum().backward()
    assert means.grad.isfinite().all()


def test_powers_at_an_array_that_is_not_planar_are_refused():
    scene = example_links("rssi", CARRIER).scene
    bent = Receiver("hook", HERE, Array(torch.tensor([[0.0, 0, 0], [0.03, 0, 0.01]])))
    with pytest.raises(ValueError, match=r"takes planar arrays, got z up to 0\.01 m in hook\ntake proj"):
        PathRssi(replace(scene, receivers=(*scene.receivers, bent)))
