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
"""Least opacity a G of a splat that acts on a pixel, the customary bound (one grey level)."""

ALPHA_MAX = 0.99
"""Largest opacity a G of one splat at a pixel, the customary bound: log(1 - a G) stays finite."""

OPAQUE = -(2.0**18)
"""Logarithm of an attenuation of 0.

G times this is in effect minus infinity, and its products stay finite.
"""

STEEPEST = 1e-30
"""Attenuation below which the logarithm's gradient is divided by this value.

Without it float32 would overflow; at an attenuation of 0 the gradient is 0.
"""


@runtime_checkable
class Rasterizer(Protocol):
    """Base class of components of kind ``rasterizer``.

    A rasterizer computes eq. (13) and (14) at each pixel,

        map = sum_i signal_i A_i T_i        T_i = prod_{j<i} (1 - A_j) d_j^{G_j}

    over splats i front to back by ``depths`` (ties by index), with

    * G_i = exp(-x' C^-1 x / 2), the footprint: x leads from the splat's centre to the pixel, on a
      periodic plane from the nearest image of the centre;
    * A_i = min(a_i G_i, ALPHA_MAX), or 0 below ALPHA_MIN, with the opacity a_i;
    * d_i, the attenuation in [0, 1].

    Splats that are not ``visible`` have no effect. The map is differentiable in every input except
    depths and visible.

    Attributes:
        used: Name of the rasterizer that drew the last map, with its device if there are several,
            for a run's metrics.

    Source: GAI-GS, "Mapping, Projection and Render Module", eq. (13) and (14); the area over which
    d_j acts is ours (docs/methods.md).
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
        """Draws the map, and the transmittance behind the last splat.

        Splats have c channels of ``signal``, opacities a_i, and attenuations d_i; None: d_i = 1.
        """
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
    """Draws the map that Gaussians make at a receiver.

    Gaussians are composited front to back by their distance to the receiver; ``Rasterizer`` has the
    equation. Quaternions are (w, x, y, z) of any length, in the world frame.

    Args:
        means: Centres, world frame (n, 3) [m].
        quats: Orientations (n, 4). The columns of their rotation matrices are the Gaussians' axes
            in the world frame.
        scales: Standard deviations along these axes (n, 3) [m].
        opacities: In [0, 1] (n,).
        signal: Any number of real channels of each Gaussian (n, c). A complex channel is two real
            channels, real and imaginary part.
        attenuations: Fraction of the field from behind that each Gaussian transmits, in [0, 1]
            (n,). None: 1.
        receiver, grid, projection, pixel: As for ``gaigs.splatting.projection.project``.
        rasterizer: Name, configuration or object.

    Returns:
        The map (c, rows, columns) and the fraction transmitted by all Gaussians (rows, columns);
        for k rays (c, k) and (k,). If an input has a leading axis b of transmitters, both have it.
        They are differentiable in all tensors. ``opencl`` and ``torch`` agree to 2e-6 of the map's
        maximum in float32.

    Raises:
        TypeError, ValueError: An input is not a tensor of the right shape and dtype, or out of
            range.

    Source: GAI-GS, "Projection and Render Module", eq. (13) and (14); Zwicker et al., EWA
    Splatting, 2002.

    Example:
        >>> means = torch.tensor([[2.0, 0.0, 1.0], [0.0, 3.0, 1.0]], requires_grad=True)
        >>> quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4)
        >>> scales, opacities = torch.full((2, 3), 0.3), torch.tensor([0.9, 0.8])
        >>> signal = torch.tensor([[1.0], [0.5]])
        >>> pose = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])  # scipy's order
        >>> view = {"receiver": pose, "grid": gaigs.Grid.degrees(), "rasterizer": "torch"}
        >>> image, transmittance = gaigs.rasterize(
        ...     means, quats, scales, opacities, signal, **view
        ... )
        >>> image.shape, transmittance.shape
        (torch.Size([1, 90, 360]), torch.Size([90, 360]))
        >>> image.sum().backward()
        >>> means.grad.shape
        torch.Size([2, 3])
    """
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "signal": signal,
        "opacities": opacities,
    }
    if attenuations is not None:
        tensors["attenuations"] = attenuations
    leading = _check_shapes(tensors)
    _check_range("scales", scales, math.inf, "take their exp")
    for name in ("opacities", "attenuations"):
        if name in tensors:
            _check_range(name, tensors[name], 1.0, "pass them through a sigmoid")
    chosen = registry("rasterizer").build(rasterizer)
    b = max(leading, default=1)
    n, c = means.shape[-2], signal.shape[-1]
    signal = signal.expand(b, n, c)
    opacities = opacities.expand(b, n)
    if attenuations is not None:
        attenuations = attenuations.expand(b, n)
    # Gaussians that do not move with the transmitter are drawn for all transmitters at once, others
    # for one transmitter after the other.
    moves = means.ndim == 3
    maps = []
    transmittances = []
    rows = [slice(k, k + 1) for k in range(b)] if moves else [slice(None)]
    for row in rows:
        splats, plane = project(
            _rows(means, row)[0] if moves else means,  # (n, 3)
            _rows(quats, row),
            _rows(scales, row),
            receiver=receiver,
            grid=grid,
            projection=projection,
            pixel=pixel,
        )
        transmitted = None if attenuations is None else attenuations[row]
        image, transmittance = chosen(splats, signal[row], opacities[row], transmitted, plane)
        maps.append(image)
        transmittances.append(transmittance)
    image = cat(maps)  # (b, c, rows, columns)
    transmittance = cat(transmittances)  # (b, rows, columns)
    if isinstance(grid, Rays):
        image = image[..., 0, :]
        transmittance = transmittance[..., 0, :]
    return (image, transmittance) if leading else (image[0], transmittance[0])


def _rows(values: Tensor, row: slice) -> Tensor:
    """Values of the transmitters in a slice; all values if transmitters share them.

    Values have a leading axis of transmitters, of length 1 if they are shared, or no such axis.
    """
    return values[row] if values.ndim == 3 and len(values) > 1 else values


def _check_shapes(tensors: Mapping[str, Tensor]) -> set[int]:
    """Checks types and shapes of the inputs of ``rasterize``, given by name.

    Returns:
        The different lengths of leading axes, which count transmitters; empty if no input has such
        an axis.
    """
    if not all(isinstance(values, Tensor) and values.ndim for values in tensors.values()):
        raise TypeError(
            "means, quats, scales, opacities, signal and attenuations must be torch tensors "
            "with axes"
        )
    means = tensors["means"]
    n = means.shape[-2] if means.ndim > 1 else 0
    columns = {"means": 3, "quats": 4, "scales": 3, "signal": tensors["signal"].shape[-1]}
    leading: set[int] = set()
    for name, values in tensors.items():
        # Opacities and attenuations have one number a Gaussian.
        rows = values if name in columns else values[..., None]  # (n, k) or (b, n, k)
        size = columns.get(name, 1)
        if rows.ndim not in (2, 3) or tuple(rows.shape[-2:]) != (n, size):
            raise ValueError(f"{name} must have {n} rows of {size}, got {tuple(rows.shape)}")
        if values.dtype != means.dtype or not values.is_floating_point():
            raise ValueError(
                f"{name} must be real numbers of means' {means.dtype}, got {values.dtype}"
            )
        leading |= set(rows.shape[:-2])
    several = sorted(leading - {1})
    if len(several) > 1:
        numbers = ", ".join(map(str, several))
        raise ValueError(f"inputs must have one number of transmitters, got {numbers}")
    return leading


def _check_range(name: str, values: Tensor, most: float, advice: str) -> None:
    """Raises a ``ValueError`` for values outside [0, most]; NaN passes, to show in the map."""
    wrong = values[(values < 0) | (values > most)]
    if len(wrong):
        raise ValueError(f"{name} must lie in [0, {most:g}], got {wrong[0]:.3g}; {advice} first")
