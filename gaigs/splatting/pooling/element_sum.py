"""Complex channels: the waves of a map summed at each element of the receiver's array."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.core.scene import Scene, direct_waves
from gaigs.registry import register
from gaigs.splatting.pooling import sphere
from gaigs.splatting.pooling.channels import ChannelPooling


@register("pooling", "element_sum")
class ElementSum(ChannelPooling):
    """Sums the waves of a map, from all of its directions u, at each element.

        h(e, f) = g F(d, f) sum_u w(u) a(u) m_f(u) exp(-s j 2 pi f / c x_e . u)

    m_f is the complex map at subcarrier f; the map's channels are first all real parts, then all
    imaginary parts. x_e is the position of an element and a its pattern. w is the direction's
    fraction of the solid angle. F is the wave of free space over the direct distance d; without a
    common clock only its amplitude. g is the channels' ``strength`` relative to F, and s is
    ``array_sign``. For other subcarriers than the labels' the map of the nearest subcarrier is
    used.

    Args:
        scene: Scene with the task's subcarriers and the receivers' elements.
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.

    Raises:
        ValueError: The labels are not channels.

    Source: ours; Van Trees, Optimum Array Processing, 2002, section 2.2, for the phases.
    """

    def __init__(self, scene: Scene, grid: Sequence[int] = (8, 16)):
        super().__init__(scene, "element_sum")
        self.learnt = self.frequencies
        self.channels = 2 * len(self.learnt)
        self.grid = sphere("pooling.grid", grid)

    def forward(
        self,
        image: Float[Tensor, "b c rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Complex[Tensor, "b e s"]:
        """Channels at the elements of the receiver of these links."""
        if not len(query):
            shape = (0, *self.scene.task.shape)
            return torch.zeros(shape, dtype=image.dtype.to_complex(), device=image.device)
        # Number of the learnt subcarrier nearest to each requested one (s,).
        nearest = (self.learnt - self.frequencies[:, None]).abs().argmin(1)
        pixels = image.flatten(2)  # (b, c, p)
        real, imaginary = pixels.unflatten(1, (2, -1)).unbind(1)  # (b, learnt, p) each
        waves = torch.complex(real, imaginary)[:, nearest]  # m_f, (b, s, p)
        steering = self._steering(int(query.receivers[0]), int(self.array_sign)).to(waves)
        channels = waves.permute(1, 0, 2) @ steering  # (s, b, e)
        channels = channels.permute(1, 2, 0)  # (b, e, s)
        direct = direct_waves(
            self.scene, query, self.frequencies, int(self.sign), at_elements=False
        )  # F, (b, 1, s)
        return self.received(query, channels * (self.strength.double() * direct).to(waves))

    def _steering(self, receiver: int, sign: int) -> Complex[Tensor, "s p e"]:
        """Field at e elements of a unit wave from p directions, at s subcarriers; complex128.

        Weights w(u) and patterns a(u) of the directions are included.
        """
        array = self.scene.receivers[receiver].array
        directions = self.grid.flatten().vectors().double()  # (p, 3)
        # A wave from the direction u reaches an element at x earlier by x . u / c than the middle.
        delays = directions @ array.elements.double().T / speed_of_light  # (p, e) [s]
        phases = -sign * 2 * math.pi * self.frequencies[:, None, None] * delays  # (s, p, e) [rad]
        weights = self.grid.solid_angles.flatten().double() * array.gain(directions)  # (p,)
        return torch.polar(weights[:, None].expand_as(phases), phases)
