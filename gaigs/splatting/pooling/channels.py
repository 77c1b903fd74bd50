"""Base class of poolings to complex channels; it fits their strength and phase signs."""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.phases import array_sign
from gaigs.core.propagation import strength
from gaigs.core.query import Query
from gaigs.core.scene import Scene, check_elements, direct_waves
from gaigs.data import Links
from gaigs.splatting.pooling import Pooling


class ChannelPooling(Pooling):
    """Base of poolings to channels; fits strength and phase convention of the training channels.

    Args:
        scene: Scene with the task's subcarriers and the receivers' elements.
        name: Registered name, for errors.
    """

    strength: Tensor  # amplitude of the channels relative to free space
    # Sign with which phases follow the direct distance, -1 for the time dependence exp(+j omega t)
    # or 1; 0 for neither, as without a common clock that the data do not declare.
    sign: Tensor
    array_sign: Tensor  # sign between the elements and subcarriers of a link, -1 or 1

    def __init__(self, scene: Scene, name: str):
        super().__init__()
        self.task = check_elements(f"pooling {name!r}", scene, pads=True)
        self.scene = scene
        if all(receiver.array.pattern == "cosine" for receiver in scene.receivers):
            self.zone = (0.0, math.pi / 2)
        self.register_buffer("strength", torch.ones(()))
        self.register_buffer("sign", torch.tensor(-1))
        self.register_buffer("array_sign", torch.tensor(-1))

    @property
    def frequencies(self) -> Float[Tensor, " s"]:
        """The subcarriers of the present scene [Hz]; ``Model.at_frequencies`` replaces it."""
        return self.scene.task.frequencies

    def received(
        self, query: Query, channels: Complex[Tensor, "b e s"]
    ) -> Complex[Tensor, "b most s"]:
        """Channels after the receivers' front ends, padded to the largest array.

        Channels are 0 at missing elements of a smaller array, and outside the receiver's band.
        """
        missing = self.task.elements - channels.shape[1]
        channels = torch.nn.functional.pad(channels, (0, 0, 0, missing))
        hears = torch.stack([receiver.hears(self.frequencies) for receiver in self.scene.receivers])
        in_band = hears.to(query.receivers.device)[query.receivers, None]  # (b, 1, s)
        return self.scene.received(query, channels * in_band)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        train = links.split.train
        query = links.query[train]
        labels = links.labels[train].to(torch.complex128)  # (b, e, s)
        labels = self.scene.equalised(query, labels)
        waves = direct_waves(self.scene, query, self.frequencies)  # (b, e, s)
        self.strength.fill_(strength(labels, waves, query.receivers))
        self.sign.fill_(self.task.phase_sign(labels, waves, query.receivers))
        # Without a common clock the phases within a link still show the convention.
        within_link = torch.tensor(array_sign(labels, waves)) if self.sign == 0 else self.sign
        self.array_sign.copy_(within_link)
