"""The check of kind ``rasterizer``, against the formula over all pairs of splat and pixel."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN, Rasterizer
from gaigs.testing.checks import PRECISION, fixed_sum, require, require_close, require_tensor


def check_rasterizer(rasterizer: Rasterizer, device: torch.device | str = "cpu") -> None:
    """Checks a rasterizer: map, transmittance and gradients against ``rasterize_densely``, on easy
    and hard scenes.

    float64 may be refused by a ``TypeError``. The contract is that of
    ``gaigs.splatting.rasterizer.Rasterizer``.
    """
    for title, arguments in _scenes():
        # Where A meets one of its bounds to within rounding, the two may rightly decide
        # differently.
        away = distance_to_jumps(*arguments) > 1e-4
        truth = render_with_gradients(
            rasterize_densely, cast_scene(arguments, "cpu", torch.float64), away
        )
        for dtype, tolerance in PRECISION.items():
            moved = cast_scene(arguments, device, dtype)
            try:
                found = render_with_gradients(rasterizer, moved, away.to(device))
            except TypeError:
                require(dtype != torch.float32, "float32 must be supported")
                continue
            for name, true in truth.items():
                require_tensor(f"{title}: {name}", found[name], true.shape, dtype, device)
                require_close(
                    found[name].cpu(),
                    true,
                    tolerance,
                    f"{title}: {name} must be that of the formula",
                )
            again = render_with_gradients(rasterizer, moved, away.to(device))
            for name in ("map", "transmittance"):
                require(
                    torch.equal(found[name], again[name]),
                    f"{title}: two runs must give the same {name}",
                )
            require(
                isinstance(rasterizer.used, str),
                f"used must name the rasterizer, got {rasterizer.used!r}",
            )
            splats, *per_query, plane = moved
            last = [None if part is None else part[-1:] for part in per_query]
            alone_splats = replace(splats, factors=splats.factors[-1:])
            alone = render_with_gradients(
                rasterizer, (alone_splats, *last, plane), away[-1:].to(device)
            )
            rule = f"{title}: a map must not depend on other transmitters"
            require_close(alone["map"], found["map"][-1:], tolerance, rule)
    _check_nan_shows(rasterizer, device)


def rasterize_densely(
    splats: Splats,
    signal: Float[Tensor, "b n c"],
    opacities: Float[Tensor, "b n"],
    attenuations: Float[Tensor, "b n"] | None,
    plane: Plane,
) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
    """The formula of ``Rasterizer`` over all pairs of splat and pixel, in float64: slow, but plain."""
    order, footprints = footprints_of(splats, plane)
    product = opacities[:, order, None, None].double() * footprints
    acts = product >= ALPHA_MIN
    alpha = torch.where(acts, product.clamp(max=ALPHA_MAX), 0)
    passed = 1 - alpha
    if attenuations is not None:
        passed = passed * torch.where(
            acts, attenuations[:, order, None, None].double() ** footprints, 1
        )
    reached = (
        torch.cat((torch.ones_like(passed[:, :1]), passed), 1).cumprod(1) if len(order) else passed
    )
    image = torch.einsum(
        "bnc,bnrs->bcrs", signal[:, order].double(), alpha * reached[:, : len(order)]
    )
    return image, passed.prod(1)


def footprints_of(splats: Splats, plane: Plane) -> tuple[Tensor, Float[Tensor, "b n rows columns"]]:
    """Indices of visible splats front to back, and exp(-x' C^-1 x / 2) of each at every pixel,
    float64.
    """
    order = splats.depths.argsort(stable=True)
    order = order[splats.visible[order]]
    u, v = splats.means2d[order].double()[..., None, None].unbind(1)
    du, dv = plane.u.double() - u, plane.v.double() - v
    if plane.period is not None:
        du = torch.remainder(du + plane.period / 2, plane.period) - plane.period / 2
    p, q, r = splats.factors[:, order].double()[..., None, None].unbind(2)
    s = du / p
    return order, torch.exp(-0.5 * (s.square() + ((dv - q * s) / r).square()))


@torch.no_grad()
def distance_to_jumps(
    splats, signal, opacities, attenuations, plane
) -> Float[Tensor, "b rows columns"]:
    """How far, relatively, each pixel is from the nearest jump of value or gradient, a G =
    ALPHA_MIN or ALPHA_MAX.
    """
    order, footprints = footprints_of(splats, plane)
    product = opacities[:, order, None, None].double() * footprints
    bounds = product.new_tensor([ALPHA_MIN, ALPHA_MAX])[:, None, None, None, None]
    distances = (product / bounds - 1).abs().amin(0)
    return torch.cat((distances, torch.full_like(product.sum(1, keepdim=True), torch.inf)), 1).amin(
        1
    )


def _scenes() -> Iterator[tuple[str, tuple]]:
    """Arguments of a rasterizer, each with a title."""
    generator = torch.Generator().manual_seed(0)
    azimuths, elevations = (
        torch.arange(-180.0, 180, 9).deg2rad()[None],
        torch.linspace(0.02, 1.5, 21)[:, None],
    )
    cylinder = Plane(azimuths, elevations, 2 * math.pi)

    def scene(
        n=50,
        b=2,
        c=2,
        own=False,
        attenuations=False,
        plane=cylinder,
        spread=(0.05, 0.6),
        opacity=(0, 0.99),
    ):
        def random(low, high, *shape):
            return low + (high - low) * torch.rand(*shape, generator=generator)

        low, high = (
            torch.stack([getattr(axis, end)() for axis in (plane.u, plane.v)])
            for end in ("min", "max")
        )
        turns = random(0, math.pi, b if own else 1, n)
        axes = torch.stack((turns.cos(), -turns.sin(), turns.sin(), turns.cos()), -1).unflatten(
            -1, (2, 2)
        )
        half = (
            axes
            * random(math.log(spread[0]), math.log(spread[1]), len(turns), n, 2).exp()[..., None, :]
        )
        factors = torch.linalg.cholesky(half @ half.mT)[..., [0, 1, 1], [0, 0, 1]]
        splats = Splats(random(low, high, n, 2), factors, random(0.5, 5, n), random(0, 1, n) > 0.1)
        signal = torch.randn(b, n, c, generator=generator)
        return (
            splats,
            signal,
            random(*opacity, b, n),
            random(0.3, 1, b, n) if attenuations else None,
            plane,
        )

    yield "random", scene()
    yield "attenuations", scene(attenuations=True)
    yield "own covariances", scene(own=True, attenuations=True)
    yield "one channel", scene(c=1)
    yield "many channels", scene(c=19, own=True, attenuations=True)
    yield "no splat", scene(n=0)
    yield "no transmitter", scene(b=0)
    yield "one splat, one transmitter", scene(n=1, b=1)
    yield "opaque", scene(opacity=(1, 1), spread=(0.2, 1))
    yield "silent", scene(opacity=(0, 0))
    yield "wider than the plane", scene(n=12, spread=(5, 20))
    yield "narrower than a pixel", scene(spread=(0.01, 0.02), opacity=(0.9, 1))
    yield (
        "one pixel",
        scene(plane=Plane(azimuths[:, :1], elevations[:1], 2 * math.pi), spread=(0.5, 1)),
    )
    yield "one row", scene(plane=Plane(azimuths, elevations[:1], 2 * math.pi))
    yield "one column", scene(plane=Plane(azimuths[:, :1], elevations, 2 * math.pi))
    disc = elevations.cos() * azimuths.cos(), elevations.cos() * azimuths.sin()
    yield "rows and columns mixed", scene(plane=Plane(*disc, None), own=True, attenuations=True)
    yield "columns mixed", scene(plane=Plane(azimuths * elevations.cos(), elevations, None))
    u, v = (
        6.28 * torch.rand(1, 30, generator=generator) - 3.14,
        1.5 * torch.rand(1, 30, generator=generator),
    )
    yield "rays in a single row", scene(plane=Plane(u, v, 2 * math.pi), attenuations=True)
    splats, *rest = scene()
    splats.depths.round_()
    yield "equal depths", (splats, *rest)
    splats, *rest = scene()
    splats.factors[:, ~splats.visible], splats.means2d[~splats.visible] = torch.nan, torch.inf
    yield "invisible splats with NaN", (splats, *rest)


def render_with_gradients(
    rasterizer: Callable, arguments: tuple, pixels: Bool[Tensor, "b rows columns"]
) -> dict[str, Tensor]:
    """Map and transmittance at ``pixels``, and the gradients of a fixed function of both."""
    splats, signal, opacities, attenuations, plane = arguments
    leaves = {"means2d": splats.means2d, "factors": splats.factors}
    leaves |= {"signal": signal, "opacities": opacities, "attenuations": attenuations}
    leaves = {
        name: leaf.detach().clone().requires_grad_()
        for name, leaf in leaves.items()
        if leaf is not None
    }
    changed = replace(splats, means2d=leaves["means2d"], factors=leaves["factors"])
    image, left = rasterizer(
        changed, leaves["signal"], leaves["opacities"], leaves.get("attenuations"), plane
    )
    image, left = image * pixels[:, None], left * pixels
    (fixed_sum(image) + fixed_sum(left)).backward()
    results = {"map": image.detach(), "transmittance": left.detach()}
    for name, leaf in leaves.items():
        results[f"gradient of {name}"] = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
    return results


def cast_scene(arguments: tuple, device: torch.device | str, dtype: torch.dtype) -> tuple:
    """Arguments of a rasterizer on another device and in another precision."""
    splats, signal, opacities, attenuations, plane = arguments

    def to(tensor):
        return None if tensor is None else tensor.to(device, dtype)

    splats = Splats(
        to(splats.means2d), to(splats.factors), to(splats.depths), splats.visible.to(device)
    )
    return (
        splats,
        to(signal),
        to(opacities),
        to(attenuations),
        Plane(to(plane.u), to(plane.v), plane.period),
    )


def _check_nan_shows(rasterizer: Rasterizer, device: torch.device | str) -> None:
    """NaN in an input must show in the map."""
    for name in ("means2d", "factors", "signal", "opacities"):
        splats, signal, opacities, attenuations, plane = cast_scene(
            next(_scenes())[1], device, torch.float32
        )
        broken = {"means2d": splats.means2d[None], "factors": splats.factors, "signal": signal}
        front = torch.where(splats.visible, splats.depths, torch.inf).argmin()
        broken.get(name, opacities)[:, front] = torch.nan
        image, _ = rasterizer(splats, signal, opacities, attenuations, plane)
        require(image.isnan().any(), f"NaN in {name} must show as NaN in the map")
