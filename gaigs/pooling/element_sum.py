"""Complex channels: the map's waves summed up at each element of the receiver's array."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.data import Links
from gaigs.directions import Directions
from gaigs.pooling import Pooling, sphere
from gaigs.propagation import array_sign, check_elements, direct_waves, phase_sign, strength
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Scene


@register("pooling", "element_sum")
class ElementSum(Pooling):
    """h(e, f) = g F(d, f) sum_u w(u) a(u) m_f(u) exp(-s j 2 pi f / c x_e . u) over the map's directions u.

    m_f is the map at subcarrier f, complex: its real parts are the map's channels before all imaginary ones. x_e is an
    element's place, a its pattern, w the share of the direction's solid angle. F is the wave of free space over the
    direct distance d, and g the channels' ``strength`` over it: the map holds what is relative to them, so that a
    direct path is the same in it from everywhere.

    The sign s of phases, -1 as for the time dependence exp(+j omega t), or +1, is what the training channels show.
    Where their phases follow the distance with neither sign, as without a common clock, F is its amplitude alone, and s
    is how phases differ between the elements and subcarriers of a link.

    Args:
        scene: Its task has the subcarriers, its receivers the elements.
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.

    Raises:
        ValueError: The labels are no channels, or an array has another number of elements than they.
    """

    takes = "fields"

    def __init__(self, scene: Scene, grid: Sequence[int] = (8, 16)):
        super().__init__()
        check_elements("pooling 'element_sum'", scene)
        self.scene = scene
        self.channels = 2 * len(scene.task.frequencies)
        self.grid = sphere("pooling.grid", grid)
        if all(receiver.array.pattern == "cosine" for receiver in scene.receivers):
            self.zone = (0.0, math.pi / 2)
        self.register_buffer("strength", torch.ones(()))
        self.register_buffer("sign", torch.tensor(-1))  # of F, or 0
        self.register_buffer("array_sign", torch.tensor(-1))

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Takes the strength relative to free space and the signs of phases from the training channels."""
        train = links.split.train
        labels, query = links.labels[train].to(torch.complex128), links.query[train]
        waves = direct_waves(self.scene, query, self.scene.task.frequencies)
        self.strength.fill_(strength(labels, waves, query.receivers))
        self.sign.fill_(phase_sign(labels, waves, query.receivers))
        self.array_sign.copy_(self.sign if self.sign else torch.tensor(array_sign(labels, waves)))

    def forward(
        self, image: Float[Tensor, "b c rows columns"], query: Query, directions: Directions | None = None
    ) -> Complex[Tensor, "b e s"]:
        """Channels at the elements of the receiver of these links."""
        if not len(query):
            return torch.zeros(0, *self.scene.task.shape, dtype=image.dtype.to_complex(), device=image.device)
        waves = torch.complex(*image.flatten(2).unflatten(1, (2, -1)).unbind(1))
        steering = self._steering(int(query.receivers[0]), int(self.array_sign)).to(waves)
        # One product of matrices a subcarrier; a link's row is its map.
        channels = (waves.permute(1, 0, 2) @ steering).permute(1, 2, 0)
        frequencies = self.scene.task.frequencies
        direct = direct_waves(self.scene, query, frequencies, int(self.sign), at_elements=False)
        return channels * (self.strength.double() * direct).to(waves)

    def hear(
        self, heard: Complex[Tensor, "b e s"], query: Query, directions: Directions | None = None
    ) -> Complex[Tensor, "b e s"]:
        """Channels of fields over the unit of 1 / distance; free space has lambda / (4 pi) of it."""
        frequencies = self.scene.task.frequencies.to(heard.real)
        value = heard * (self.strength.to(frequencies) * speed_of_light / (4 * math.pi * frequencies))
        if self.sign == 0:  # phases are told between elements and subcarriers alone: the direct path's are taken off
            value = value * direct_waves(self.scene, query, frequencies, 1, at_elements=False).sgn().to(value)
        return value.conj() if self.array_sign > 0 else value

    def _steering(self, receiver: int, sign: int) -> Complex[Tensor, "s p e"]:
        """What a wave from each direction of the map adds at each element, float64."""
        array, directions = self.scene.receivers[receiver].array, self.grid.flatten().vectors().double()
        # A wave from the direction u reaches an element at x earlier by x . u / c than the middle.
        delays = directions @ array.elements.double().T / speed_of_light
        phases = -sign * 2 * math.pi * self.scene.task.frequencies[:, None, None] * delays
        weights = self.grid.solid_angles.flatten().double() * array.gain(directions)
        return torch.polar(weights[:, None].expand_as(phases), phases)
