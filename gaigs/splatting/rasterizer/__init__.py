"""Rasterizers composite splats front to back into a map over directions."""

import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, cat

from gaigs.core.geometry import Directions, Rays
from gaigs.registry import registry
from gaigs.splatting.projection import Plane, Projection, Splats, project

ALPHA_MIN = 1 / 255
"""A splat acts on a pixel where its opacity a G is at least this, the customary bound (one grey
level).
"""

ALPHA_MAX = 0.99
"""Largest opacity a G of one splat at a pixel, the customary bound: log(1 - a G) stays finite."""

OPAQUE = -(2.0**18)
"""The logarithm of an attenuation of 0: G times this is in effect minus infinity, and its products
stay finite.
"""

STEEPEST = 1e-30
"""Below this attenuation the logarithm's gradient is divided by this value, lest float32 overflows;
at 0 it is 0.
"""


@runtime_checkable
class Rasterizer(Protocol):
    """The contract of kind ``rasterizer``.

    Front to back by ``depths`` (ties by index), with a_i the opacity and d_i the attenuation in [0,
    1], G_i the footprint exp(-x' C^-1 x / 2) at the pixel, A_i = min(a_i G_i, ALPHA_MAX), or 0
    below ALPHA_MIN:

        map = sum_i signal_i A_i T_i        T_i = prod_{j<i} (1 - A_j) d_j^{G_j}

    x is the pixel minus the splat's centre, u taken to the nearest image where the plane is
    periodic. Splats that are not ``visible`` do nothing. Every input but depths and visible is
    differentiable.

    ``used`` names the rasterizer of the last map, and its device where there is a choice, for a
    run's metrics.

    Source: GAI-GS, "Mapping, Projection and Render Module"; the area over which d_j acts is ours
    (docs/methods.md).
    """

    used: str | None

    def __call__(
        self,
        splats: Splats,
        signal: Float[Tensor, "b n c"],
        opacities: Float[Tensor, "b n"],
        attenuations: Float[Tensor, "b n"] | None,
        plane: Plane,
    ) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
        """The map, and the transmittance left behind the last splat."""
        ...


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    signal: Tensor,
    attenuations: Tensor | None = None,
    *,
    receiver: Any,
    grid: Directions,
    projection: str | Mapping | Projection = "mercator",
    rasterizer: str | Mapping | Rasterizer = "fastest",
    pixel: float | None = None,
) -> tuple[Tensor, Tensor]:
    """The map that Gaussians make at a receiver. Quaternions are (w, x, y, z) of any length, in the
    world frame.

    Gaussians are composited front to back by their distance to the receiver; ``Rasterizer`` has the
    equation.

    Args:
        means: Centres, world frame (n, 3) [m].
        quats: Orientations (n, 4). Columns of their rotation matrices are the Gaussians' axes in
            the world frame.
        scales: Standard deviations along these axes (n, 3) [m].
        opacities: In [0, 1] (n,).
        signal: Of each Gaussian, any number of real channels (n, c); a complex channel is two, real
            and imaginary part.
        attenuations: Share of the field from behind that each lets through, in [0, 1] (n,). None:
            1.
        receiver, grid, projection, pixel: As for ``gaigs.splatting.projection.project``.
        rasterizer: Name, configuration or object.

    Returns:
        The map (c, rows, columns), and the share that passes all Gaussians (rows, columns); of k
        rays (c, k) and (k,). Where an input has a leading axis b of transmitters, both have it.
        Differentiable in all tensors. ``opencl`` and ``torch`` agree to 2e-6 of the map's maximum
        in float32.

    Raises:
        TypeError, ValueError: An input is no tensor of its shape and dtype, or is out of range.

    Source: GAI-GS, "Projection and Render Module"; Zwicker et al., EWA Splatting, 2002.

    Example:
        >>> means = torch.tensor([[2.0, 0.0, 1.0], [0.0, 3.0, 1.0]], requires_grad=True)
        >>> quats, scales = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4), torch.full((2, 3), 0.3)
        >>> opacities, signal = torch.tensor([0.9, 0.8]), torch.tensor([[1.0], [0.5]])
        >>> pose = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])  # of the receiver, scipy's order
        >>> image, transmittance = gaigs.rasterize(
        ...     means, quats, scales, opacities, signal, receiver=pose, grid=gaigs.Grid.degrees(), rasterizer="torch"
        ... )
        >>> image.shape, transmittance.shape
        (torch.Size([1, 90, 360]), torch.Size([90, 360]))
        >>> image.sum().backward()
        >>> means.grad.shape
        torch.Size([2, 3])
    """
    given = (means, quats, scales, opacities, signal) + (
        () if attenuations is None else (attenuations,)
    )
    if not all(isinstance(values, Tensor) and values.ndim for values in given):
        raise TypeError(
            "means, quats, scales, opacities, signal and attenuations must be torch tensors with axes"
        )
    n, c = means.shape[-2] if means.ndim > 1 else 0, signal.shape[-1]
    inputs = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "signal": (signal, (n, c)),
    }
    rest = {"opacities": opacities} | (
        {} if attenuations is None else {"attenuations": attenuations}
    )
    inputs |= {name: (values[..., None], (n, 1)) for name, values in rest.items()}
    sizes = {1}
    for name, (values, shape) in inputs.items():
        if values.ndim not in (2, 3) or tuple(values.shape[-2:]) != shape:
            raise ValueError(f"{name} must have {n} rows of {shape[1]}, got {tuple(values.shape)}")
        if values.dtype != means.dtype or not values.is_floating_point():
            raise ValueError(
                f"{name} must be real numbers of means' {means.dtype}, got {values.dtype}"
            )
        sizes |= set(values.shape[:-2])
    for name, values in {"scales": scales, **rest}.items():
        most, advice = (
            (math.inf, "take their exp")
            if name == "scales"
            else (1.0, "pass them through a sigmoid")
        )
        if len(wrong := values[(values < 0) | (values > most)]):  # NaN passes, and shows in the map
            raise ValueError(
                f"{name} must lie in [0, {most:g}], got {wrong[0]:.3g}; {advice} first"
            )
    if len(sizes) > 2:
        raise ValueError(
            f"inputs must have one number of transmitters, got {', '.join(map(str, sorted(sizes - {1})))}"
        )
    chosen = registry("rasterizer").build(rasterizer)
    is_batch = any(values.ndim == 3 for values, _ in inputs.values())
    b = max(sizes)
    signal, opacities = signal.expand(b, n, c), opacities.expand(b, n)
    attenuations = None if attenuations is None else attenuations.expand(b, n)
    rows = [slice(k, k + 1) for k in range(b)] if means.ndim == 3 else [slice(None)]
    maps = []
    for row in rows:
        geometry = [means[row.start if len(means) > 1 else 0] if means.ndim == 3 else means]
        geometry += [
            values[row] if values.ndim == 3 and len(values) > 1 else values
            for values in (quats, scales)
        ]
        splats, plane = project(
            *geometry, receiver=receiver, grid=grid, projection=projection, pixel=pixel
        )
        own = None if attenuations is None else attenuations[row]
        maps.append(chosen(splats, signal[row], opacities[row], own, plane))
    image, left = (cat(parts) for parts in zip(*maps, strict=True))
    if isinstance(grid, Rays):
        image, left = image[..., 0, :], left[..., 0, :]
    return (image, left) if is_batch else (image[0], left[0])
