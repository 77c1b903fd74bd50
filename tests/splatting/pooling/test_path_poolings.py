"""Sums of paths at an array against plain sums, plane and spherical waves, and averages."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.propagation import NEAREST, free_space
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.splatting.pooling.paths import LagPooling, ReceivedPaths, element_fields
from gaigs.testing import example_links
from gaigs.testing.checks import PRECISION, fixed_sum, require_close

CARRIER = 5e9
ARRAY = Array.planar(3, 4, 0.03)
SCATTERED = Array(torch.tensor([[0, 0, 0], [42, -12, 0], [-24, 54, 0], [6, 78, 0]]).double() / 1000)
BENT = Array(
    torch.tensor([[0, 0, 0], [42, -12, 900], [-240, 540, 30], [6, 0, -78]]).double() / 1000
)
HERE = Pose(torch.zeros(3), torch.eye(3))


def fields_of(points, axes, amplitudes, lengths, array, carriers, offsets):
    """Fields of Gaussians in the array's frame."""
    ones = torch.ones_like(lengths[0]) if len(lengths) else lengths.new_ones(points.shape[1])
    paths = ReceivedPaths(
        points, axes, amplitudes, lengths, ones, None, Receiver("here", HERE, array), carriers
    )
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
        phases = (wavenumbers * (own - ways))[..., None] + 2 * math.pi * delays[
            ..., None
        ] * offsets[:, None]
        heard.append((strengths[..., None] * torch.exp(-1j * phases)).sum(1))
    return torch.stack(heard, 1)


def lags_of(points, axes, amplitudes, lengths, coherences, bandwidth, array, carriers, pose=HERE):
    """Covariances of Gaussians in the array's frame."""
    receiver = Receiver("here", pose, array)
    paths = ReceivedPaths(
        points, axes, amplitudes, lengths, coherences, bandwidth, receiver, carriers
    )
    return PathRssi(replace(example_links("rssi", CARRIER).scene, receivers=(receiver,))).sum_paths(
        paths
    )


def sum_lags(points, semi_axes, amplitudes, lengths, coherences, bandwidth, array, carriers):
    """The covariance of each pair of elements over all pairs of paths; its mean over the pairs of
    each lag.
    """
    elements, seen = array.elements.to(lengths), (points, semi_axes, LagPooling.least_spread)
    apart = (lengths[:, :, None] - lengths[:, None]) / speed_of_light
    likeness = torch.ones_like(apart) if bandwidth is None else torch.sinc(bandwidth * apart)
    steering, waves = footprints(*seen, elements, carriers), amplitudes * coherences
    powers = amplitudes.abs().square() * (1 - coherences.square())
    steps, pairs, counts = array.lags
    covariances = []
    for i in range(len(array)):
        for j in range(len(array)):
            both = waves * steering[..., i], (waves * steering[..., j]).conj()
            alone = footprints(*seen, (elements[i] - elements[j])[None], carriers)[..., 0]
            covariances.append(
                torch.einsum("bn,bm,bnm->b", *both, likeness.to(waves)) + (powers * alone).sum(1)
            )
    sums = torch.zeros(len(lengths), len(steps), dtype=amplitudes.dtype)
    return sums.index_add(1, pairs, torch.stack(covariances, 1)) / counts.to(lengths)


def footprints(points, semi_axes, least, steps, carriers):
    """exp(-(k D)' (S + least² I) (k D) / 2 + j k D . u) of each path at each step D, k being the
    wavenumber.
    """
    turned = (2 * math.pi / speed_of_light * carriers)[:, None, None] * steps
    ways = points.norm(dim=-1).clamp_min(NEAREST)
    units, covariances = points / ways[..., None], semi_axes @ semi_axes.mT
    across = (torch.eye(3).double() - units[..., None] * units[..., None, :]) / ways[
        ..., None, None
    ]
    spreads = across @ covariances @ across.mT + least**2 * torch.eye(3).double()
    spread = torch.einsum("bki,bnij,bkj->bnk", turned, spreads, turned)
    return torch.exp(-spread / 2 + 1j * torch.einsum("bki,bni->bnk", turned, units))


def scene(
    n=9,
    b=2,
    array=SCATTERED,
    spread=(1e-3, 0.3),
    coherence=(0, 1),
    bandwidth=4e8,
    own=True,
    planar=True,
):
    """Paths in float64; some of them sit on the array's middle."""
    generator = torch.Generator().manual_seed(0)

    def random(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator).double()

    sets = b if own else 1
    points = torch.randn(b, n, 3, generator=generator).double()
    points = points + 0.5 * torch.nn.functional.normalize(
        points, dim=-1
    )  # none nearer than some decimetres
    amplitudes, lengths = (
        torch.randn(b, n, dtype=torch.complex128, generator=generator),
        random(0.5, 20, b, n),
    )
    paths = (
        points * (random(0, 1, b, n, 1) > 0.1),
        random(*spread, sets, n, 3, 3),
        amplitudes,
        lengths,
    )
    band, carriers = (
        None if bandwidth is None else torch.tensor(bandwidth).double(),
        random(4.5e9, 5.5e9, b),
    )
    fields = paths, (array, carriers, random(-1e8, 1e8, b, 3))
    lags = (*paths, random(*coherence, n), band), (array, carriers)
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


SUMS = {"fields": (fields_of, sum_fields), "lags": (lags_of, sum_lags)}


def graded(function, leaves, constants):
    """A value, and the gradients of a fixed sum of it, each times the largest value of its leaf."""

    def made(leaf):
        return leaf is not None and leaf.dtype != torch.bool

    leaves = [leaf.detach().clone().requires_grad_() if made(leaf) else leaf for leaf in leaves]
    value, inputs = function(*leaves, *constants), [leaf for leaf in leaves if made(leaf)]
    gradients = torch.autograd.grad(fixed_sum(value), inputs, allow_unused=True)
    sizes = [leaf.detach().abs().amax() if leaf.numel() else 1 for leaf in inputs]
    pairs = zip(inputs, gradients, sizes, strict=True)
    return [
        value.detach(),
        *(torch.zeros_like(i) if g is None else g * size for i, g, size in pairs),
    ]


@pytest.mark.parametrize("dtype", PRECISION)
@pytest.mark.parametrize("title", SCENES)
def test_sums_and_gradients_are_those_of_plain_sums(title, dtype):
    for what, (leaves, constants) in SCENES[title].items():
        function, plain = SUMS[what]

        def to(part):
            return (
                part.to(dtype.to_complex() if part.is_complex() else dtype)
                if isinstance(part, torch.Tensor) and part.dtype != torch.bool
                else part
            )

        found = graded(function, map(to, leaves), [*map(to, constants)])
        expected = graded(
            plain, (leaf if leaf is None else leaf.clone() for leaf in leaves), constants
        )
        for one, true in zip(found, expected, strict=True):
            assert one.dtype == to(true).dtype
            require_close(one, true, PRECISION[dtype], f"{title}: {what}")


@pytest.mark.parametrize(
    ("what", "broken"), [("fields", 0), ("fields", 1), ("fields", 2), ("lags", 0), ("lags", 2)]
)
def test_nan_shows(what, broken):
    leaves, constants = SCENES["random"][what]
    leaves = [leaf.clone() for leaf in leaves]
    leaves[broken][:, int(leaves[0][0].norm(dim=-1).argmax())] = torch.nan
    assert SUMS[what][0](*leaves, *constants).isnan().any()


def draw(n=6, b=2, spread=0.0, far=10.0, seed=0):
    """Points and semi-axes, amplitudes and path lengths, float64."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    centres = random(b, n, 2) - 0.5
    ahead = (1 - centres.square().sum(-1, keepdim=True)).sqrt()
    seen = far * torch.cat((centres, ahead), -1), far * spread * (random(b, n, 3, 3) - 0.5)
    return (
        *seen,
        torch.randn(b, n, dtype=torch.complex128, generator=generator),
        2 + 10 * random(b, n),
    )


def carriers(b=2):
    return torch.full((b,), CARRIER, dtype=torch.float64)


def mean_products(fields, array):
    """The mean of y_i y_j* over the pairs of elements with each difference of places."""
    elements = array.elements.numpy()
    differences = elements[:, None] - elements
    products = fields[:, :, None] * fields[:, None].conj()
    steps, _, _ = array.lags
    return np.stack(
        [
            products[:, (np.abs(differences - step) < 1e-6).all(-1)].mean(1)
            for step in steps.numpy()
        ],
        1,
    )


def plane_waves(points, axes, amplitudes, lengths, array, offsets, least=0.0):
    """Plane waves at each element, frequency by frequency, far from all of them (b, e, s)."""
    seen = footprints(points, axes, least, array.elements.double(), carriers(len(lengths)))
    waves = amplitudes[..., None] * seen
    turns = torch.exp(-2j * math.pi / speed_of_light * lengths[..., None] * offsets[:, None])
    return torch.einsum("bne,bns->bes", waves, turns)


def test_far_away_fields_are_plane_waves():
    """Of Gaussians a kilometre away."""
    points, axes, amplitudes, _ = draw(spread=0.1, far=1e3)
    # So narrow a band that it turns hardly from one element to the next.
    lengths, offsets = (
        1e3 + torch.zeros(2, 6).double(),
        torch.tensor([[0.0, 1e6], [-2e6, 3e5]]).double(),
    )
    expected = plane_waves(points, axes, amplitudes, lengths, SCATTERED, offsets)
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
    given = (
        points.to(dtype),
        torch.zeros(1, 1, 3, 3, dtype=dtype),
        amplitudes.to(dtype.to_complex()),
        lengths.to(dtype),
    )
    found = fields_of(*given, Array(elements), carriers(5), offsets.expand(5, -1))
    found = found * speed_of_light / (4 * math.pi * (CARRIER + offsets))
    torch.testing.assert_close(
        found.to(expected), expected, rtol=0, atol=2e-4 * expected.abs().max().item()
    )


def test_sums_do_not_change_when_receiver_and_paths_move_together():
    points, axes, amplitudes, lengths = draw(spread=0.2)
    rotation = torch.from_numpy(Rotation.from_quat((0.3, -0.5, 0.2, 0.7)).as_matrix())
    poses = (
        Pose(torch.zeros(3).double(), torch.eye(3).double()),
        Pose(torch.tensor([1.0, -2, 3]).double(), rotation),
    )
    fields, lags, shares = [], [], torch.linspace(0, 1, 6).double()
    for pose in poses:
        moved = pose.world(points), pose.rotation @ axes, amplitudes, lengths
        paths = ReceivedPaths(*moved, shares, None, Receiver("here", pose, ARRAY), carriers())
        fields.append(element_fields(paths, torch.tensor([[0.0, 1e8], [-2e8, 3e7]]).double()))
        lags.append(lags_of(*moved, shares, None, ARRAY, carriers(), pose))
    torch.testing.assert_close(*fields)
    torch.testing.assert_close(*lags)


@pytest.mark.parametrize("bandwidth", [1e7, 5e8, 4e9])
def test_lags_of_a_band_are_averages_over_its_frequencies(bandwidth):
    seen = draw(spread=0.2)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    offsets = torch.from_numpy(nodes * bandwidth / 2).expand(2, -1)
    fields = plane_waves(*seen, ARRAY, offsets, LagPooling.least_spread).numpy()
    each = mean_products(np.moveaxis(fields, 2, 1).reshape(-1, len(ARRAY)), ARRAY).reshape(
        2, 400, -1
    )
    expected = np.einsum("s,bsl->bl", weights / 2, each)
    found = lags_of(
        *seen, torch.ones(6).double(), torch.tensor(bandwidth).double(), ARRAY, carriers()
    )
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_where_powers_add_lags_are_averages_over_phases(monkeypatch):
    """Over phases k j 2 pi / 7 of path k, the interference of any two paths cancels."""
    points, axes, amplitudes, lengths = draw()
    monkeypatch.setattr("gaigs.splatting.pooling.paths.LagPooling.least_spread", 0.0)
    average = 0
    for j in range(7):
        turned = amplitudes * torch.exp(2j * math.pi * j / 7 * torch.arange(6, dtype=torch.float64))
        fields = plane_waves(points, axes, turned, lengths, ARRAY, torch.zeros(2, 1))[..., 0]
        average = average + mean_products(fields.numpy(), ARRAY) / 7
    found = lags_of(
        points, axes, amplitudes, lengths, torch.zeros(6).double(), None, ARRAY, carriers()
    )
    np.testing.assert_allclose(found.numpy(), average, atol=1e-6)


def test_coherence_is_the_share_of_interference(monkeypatch):
    """The interference of two paths is in proportion to the product of their coherences."""
    seen = draw(n=2)
    monkeypatch.setattr(
        "gaigs.splatting.pooling.paths.LagPooling.least_spread", 0.0
    )  # the spread of a path weakens its own coherent part

    def lags(*shares):
        return lags_of(*seen, torch.tensor(shares).double(), None, ARRAY, carriers())

    powers, whole = lags(0, 0), lags(1, 1)
    torch.testing.assert_close(lags(0.5, 0.4) - powers, 0.2 * (whole - powers))
    torch.testing.assert_close(lags(1, 0), powers)


def test_a_path_on_the_receiver_has_no_direction_and_is_heard_alike_everywhere():
    points = torch.zeros(1, 1, 3).requires_grad_()
    path = points, torch.zeros(1, 1, 3, 3), torch.tensor([[2.0 + 0j]]), torch.zeros(1, 1)
    lags = lags_of(*path, torch.ones(1), None, ARRAY, torch.tensor([CARRIER]))
    assert lags.angle().abs().max() < 1e-6
    assert lags[0, lags.shape[1] // 2].item() == pytest.approx(4, rel=0.03)
    lags.abs().sum().backward()
    assert points.grad.isfinite().all()


def test_powers_at_an_array_that_is_not_planar_are_refused():
    scene = example_links("rssi", CARRIER).scene
    bent = Receiver("hook", HERE, Array(torch.tensor([[0.0, 0, 0], [0.03, 0, 0.01]])))
    with pytest.raises(
        ValueError, match=r"takes planar arrays, got z up to 0\.01 m in hook\ntake proj"
    ):
        PathRssi(replace(scene, receivers=(*scene.receivers, bent)))
