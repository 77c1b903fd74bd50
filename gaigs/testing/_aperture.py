"""The check of rasterizers that draw no map, against sums over all pairs of elements and of splats."""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Complex
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.projection import Splats
from gaigs.propagation import NEAREST
from gaigs.scene import Array
from gaigs.testing.checks import PRECISION, fixed_sum, require, require_close, require_tensor


def check_aperture(rasterizer, device: torch.device | str) -> None:
    """Fields and lags, and their gradients, against the formulas in float64, on easy scenes and hard ones."""
    both = (("fields", sum_fields), ("lags", sum_lags))
    for title, scene, functions in (*((*named, both) for named in _scenes()), ("a bent array", _bent(), both[:1])):
        for what, truth in functions:
            true = _sum(truth, what, _cast(scene, "cpu", torch.float64))
            for dtype, tolerance in PRECISION.items():
                moved = _cast(scene, device, dtype)
                found = _sum(getattr(rasterizer, what), what, moved)
                for name, expected in true.items():
                    wanted = dtype.to_complex() if expected.is_complex() else dtype
                    require_tensor(f"{title}: {name}", found[name], expected.shape, wanted, device)
                    rule = f"{title}: {name} must be that of the formula"
                    require_close(found[name].cpu(), expected, tolerance, rule)
                again = _sum(getattr(rasterizer, what), what, moved)
                require(torch.equal(found[what], again[what]), f"{title}: two runs must give the same {what}")
                if len(scene["amplitudes"]):
                    alone = _sum(getattr(rasterizer, what), what, _only_last(moved))
                    rule = f"{title}: {what} must not depend on other queries"
                    require_close(alone[what], found[what][-1:], tolerance, rule)
    require(isinstance(rasterizer.used, str), f"used must say what sums, got {rasterizer.used!r}")
    _check_nan_shows(rasterizer, device)


def sum_fields(
    points: Tensor,
    semi_axes: Tensor,
    amplitudes: Tensor,
    lengths: Tensor,
    array: Array,
    carriers: Tensor,
    offsets: Tensor,
) -> Complex[Tensor, "b e s"]:
    """What each element hears at each frequency: one spherical wave a path, each with its own phase."""
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


def sum_lags(
    splats: Splats,
    amplitudes: Tensor,
    lengths: Tensor,
    coherences: Tensor,
    bandwidth: Tensor | None,
    array: Array,
    carriers: Tensor,
) -> Complex[Tensor, "b l"]:
    """The covariance of each pair of elements, summed over all pairs of splats; its mean over pairs of one lag."""
    elements = array.elements.to(lengths)
    amplitudes = torch.where(splats.visible, amplitudes, 0)
    delays = lengths / speed_of_light
    likeness = torch.ones_like(delays[:, :, None] - delays[:, None])
    if bandwidth is not None:
        likeness = torch.sinc(bandwidth * (delays[:, :, None] - delays[:, None]))
    steering = _footprints(splats, elements[:, :2], carriers)
    waves = amplitudes * coherences
    steps, pairs, counts = array.lags
    covariances = []
    for i in range(len(array)):
        for j in range(len(array)):
            together = torch.einsum(
                "bn,bm,bnm->b", waves * steering[..., i], (waves * steering[..., j]).conj(), likeness.to(waves)
            )
            apart = _footprints(splats, (elements[i] - elements[j])[None, :2], carriers)[..., 0]
            powers = amplitudes.abs().square() * (1 - coherences.square())
            covariances.append(together + (powers * apart).sum(1))
    sums = torch.zeros(len(lengths), len(steps), dtype=amplitudes.dtype)
    return sums.index_add(1, pairs, torch.stack(covariances, 1)) / counts.to(lengths)


def _footprints(splats: Splats, steps: Tensor, carriers: Tensor) -> Complex[Tensor, "b n k"]:
    """exp(-(k D)' S (k D) / 2 + j k D . u) of each splat at each step D, k the wavenumber."""
    turned = (2 * math.pi / speed_of_light * carriers)[:, None, None] * steps
    spread = torch.einsum("bki,bnij,bkj->bnk", turned, splats.covariances2d.expand(len(carriers), -1, -1, -1), turned)
    centres = splats.means2d.expand(len(carriers), -1, -1)
    return torch.exp(-spread / 2 + 1j * torch.einsum("bki,bni->bnk", turned, centres))


def _scenes() -> Iterator[tuple[str, dict]]:
    """Gaussians as points with axes and as splats, paths and arrays, each with a title."""
    generator = torch.Generator().manual_seed(0)
    # Whole millimetres, since lags are told to nine decimals of a metre.
    places = [[0, 0, 0], [42, -12, 0], [-24, 54, 0], [6, 78, 0]]
    scattered = Array(torch.tensor(places, dtype=torch.float64) / 1000)

    def scene(n=9, b=2, array=scattered, spread=(1e-3, 0.3), coherence=(0, 1), bandwidth=4e8, own=True):
        random = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator)
        rows = (b,) if own else ()
        factors = random(*spread, b if own else 1, n, 3) * torch.tensor([1, -1, 1])
        visible = random(0, 1, *rows, n) > 0.1
        splats = Splats(random(-0.7, 0.7, *rows, n, 2), factors, random(1, 9, *rows, n), visible)
        # All around, none nearer than some decimetres but those on the array's middle.
        points = torch.randn(b, n, 3, generator=generator)
        points = points + 0.5 * torch.nn.functional.normalize(points, dim=-1)
        return {
            "splats": splats,
            "points": points * visible[..., None],
            "semi_axes": random(*spread, b if own else 1, n, 3, 3),
            "amplitudes": torch.randn(b, n, dtype=torch.complex64, generator=generator),
            "lengths": random(0.5, 20, b, n),
            "coherences": random(*coherence, n),
            "bandwidth": None if bandwidth is None else torch.tensor(bandwidth),
            "array": array,
            "carriers": random(4.5e9, 5.5e9, b),
            "offsets": random(-1e8, 1e8, b, 3),
        }

    yield "random", scene()
    yield "Gaussians that all queries share", scene(own=False)
    yield "a regular array", scene(array=Array.planar(3, 2, 0.03, "cosine"))
    yield "a single element", scene(array=Array.single())
    yield "one carrier", scene(bandwidth=None)
    yield "powers add", scene(coherence=(0, 0))
    yield "fields add", scene(coherence=(1, 1), bandwidth=None)
    yield "a wide band", scene(coherence=(1, 1), bandwidth=3e9)
    yield "no splat", scene(n=0)
    yield "no query", scene(b=0)
    yield "one splat, one query", scene(n=1, b=1)
    yield "points", scene(spread=(0, 0))
    yield "wider than the plane", scene(spread=(1, 5))
    silent = scene()
    silent["amplitudes"] *= 0
    yield "silence", silent
    stacked = scene()
    for part in (stacked["splats"].means2d, stacked["lengths"], stacked["points"]):
        part[:] = part[:, :1].clone()
    yield "one on top of the other", stacked
    hidden = scene()
    hidden["splats"].visible[:] = False
    hidden["points"][:] = 0
    yield "nothing visible", hidden


def _bent() -> dict:
    """A scene of fields alone: an array that leaves its plane, larger than some paths are long."""
    places = torch.tensor([[0, 0, 0], [42, -12, 900], [-240, 540, 30], [6, 0, -78]], dtype=torch.float64) / 1000
    return next(_scenes())[1] | {"array": Array(places)}


LEAVES = {
    "fields": ("points", "semi_axes", "amplitudes", "lengths"),
    "lags": ("amplitudes", "lengths", "coherences", "bandwidth"),
}
"""What each is differentiable by; lags by their splats, too."""

ARGUMENTS = {
    "fields": ("points", "semi_axes", "amplitudes", "lengths", "array", "carriers", "offsets"),
    "lags": ("splats", "amplitudes", "lengths", "coherences", "bandwidth", "array", "carriers"),
}


def _sum(function, what: str, scene: dict) -> dict[str, Tensor]:
    """What a function gives, and the gradients of a fixed sum of it, each times the size of what it is by."""
    leaves = {name: scene[name] for name in LEAVES[what] if scene[name] is not None}
    if what == "lags":
        leaves |= {"means2d": scene["splats"].means2d, "factors": scene["splats"].factors}
    leaves = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    inputs = scene | leaves
    if what == "lags":
        inputs["splats"] = replace(scene["splats"], means2d=leaves["means2d"], factors=leaves["factors"])
    value = function(*(inputs[name] for name in ARGUMENTS[what]))
    gradients = torch.autograd.grad(fixed_sum(value), [*leaves.values()], allow_unused=True)
    results = {what: value.detach()}
    for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True):
        size = leaf.detach().abs().amax() if leaf.numel() else 1
        results[f"gradient of {what} by {name}"] = torch.zeros_like(leaf) if gradient is None else gradient * size
    return results


def _cast(scene: dict, device: torch.device | str, dtype: torch.dtype) -> dict:
    def to(part):
        if isinstance(part, Splats):
            return Splats(*map(to, (part.means2d, part.factors, part.depths)), part.visible.to(device))
        if isinstance(part, Tensor):
            return part.to(device, dtype.to_complex() if part.is_complex() else dtype)
        return part

    return {name: to(part) for name, part in scene.items()}


def _only_last(scene: dict) -> dict:
    """The last query by itself."""
    splats = scene["splats"]
    if splats.means2d.ndim == 3:
        parts = splats.means2d[-1:], splats.factors[-1:], splats.depths[-1:], splats.visible[-1:]
        splats = Splats(*parts)
    rows = ("points", "semi_axes", "amplitudes", "lengths", "carriers", "offsets")
    return scene | {name: scene[name][-1:] for name in rows} | {"splats": splats}


def _check_nan_shows(rasterizer, device: torch.device | str) -> None:
    """What is broken must not vanish."""
    broken = {"fields": ("points", "semi_axes", "amplitudes"), "lags": ("means2d", "factors", "amplitudes")}
    for what, names in broken.items():
        for name in names:
            scene = _cast(next(_scenes())[1], device, torch.float32)
            splats = scene["splats"]
            part = {"means2d": splats.means2d, "factors": splats.factors}.get(name, scene.get(name))
            part[:, int(splats.visible[0].int().argmax())] = torch.nan
            value = getattr(rasterizer, what)(*(scene[argument] for argument in ARGUMENTS[what]))
            require(bool(value.isnan().any()), f"NaN in {name} must show as NaN in the {what}")
