"""Rasterizers composite splats front to back into a map over directions, or sum up what an array hears of them."""

from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from gaigs.projection import Plane, Splats

ALPHA_MIN = 1 / 255
"""A splat acts on a pixel where its opacity a G is at least this, the field's customary bound (one grey level)."""

ALPHA_MAX = 0.99
"""Largest opacity a G of one splat at a pixel, the field's customary bound: log(1 - a G) stays finite, and dividing by
(1 - a G) in a gradient costs two of float32's seven digits at the most."""


OPAQUE = -(2.0**18)
"""The logarithm of an attenuation of 0: wherever a footprint acts, G times this is as good as minus infinity in float64
too, and products with it stay finite."""

STEEPEST = 1e-30
"""The gradient by an attenuation below this is that at this, as its own would overflow float32."""


class Rasterizer(Protocol):
    """The contract of kind ``rasterizer``.

    Front to back by ``depths`` (ties by index), with a_i the effective opacity in [0, 1], d_i the attenuation in
    [0, 1], G_i the footprint exp(-x' C^-1 x / 2) at the pixel, A_i = min(a_i G_i, ALPHA_MAX) where that is at least
    ALPHA_MIN (elsewhere splat i does nothing at this pixel):

        map = sum_i signal_i A_i T_i        T_i = prod_{j<i} (1 - A_j) d_j^{G_j}

    x is the pixel minus the splat's centre, u taken to the nearest image where the plane is periodic. Splats that are
    not ``visible`` do nothing. Every input but depths is differentiable: means2d, factors, signal, opacities,
    attenuations. A signal may have any number of channels.

    A rasterizer with ``draws_map = False`` is not called. It has two methods instead, with complex amplitudes (b, n)
    and path lengths (b, n) [m]; ``aperture`` says their arguments. ``fields`` is what each element of an array hears of
    Gaussians at each frequency (b, e, s), ``lags`` the mean covariance of elements at each of ``array.lags`` (b, l), of
    splats of the plane of direction cosines. ``Pooling.takes`` says which of them is asked for.

    Attributes:
        used: What drew the last map, as a run's metrics have it: the name, and the device where there is a choice.
            None where that shows with the first map only.
        draws_map: Whether it is called for maps; may be left out, and then it is.

    Source: GAI-GS, "Mapping, Projection and Render Module"; the area over which d_j acts is ours (docs/methods.md).
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
