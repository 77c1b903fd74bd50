"""Features of a link, the input of the networks."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import one_hot

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.tokenizer.euclidean import (
    BAND_FREQUENCIES,
    fourier_features,
    learnable_octaves,
)
from gaigs.splatting.tokenizer.euclidean import octaves as angular_frequencies


class Question(nn.Module):
    """Features of a link, of size 1 or so: the transmitter's place, the receiver and, in data of
    several carriers, the carrier.

    The place gives [x, sin(w x), cos(w x)], with x counted from the middle of the training
    transmitters' box in halves of its longest edge, along all axes, as a box may be flat.

    Args:
        scene: Receivers, carriers and the box.
        octaves: Lowest and highest octave k of the angular frequencies w, 2^k cycles a metre; None
            takes those that the training transmitters can teach, as the ``euclidean`` tokenizer
            does.

    Attributes:
        width: Count of features.

    Raises:
        ValueError: The range of octaves is empty.

    Source: Tancik et al., Fourier Features, 2020.
    """

    def __init__(self, scene: Scene, octaves: tuple[int, int] | None):
        super().__init__()
        frequencies = angular_frequencies("model.octaves", *(octaves or learnable_octaves(scene)))
        self.scene = scene
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        self.register_buffer("half_edge", (scene.upper - scene.lower).max() / 2)
        # In radians per half an edge.
        self.register_buffer("frequencies", self.half_edge * frequencies)
        self.width = 3 * (1 + 2 * len(self.frequencies))
        if len(scene.receivers) > 1:
            self.width += len(scene.receivers)
        if scene.has_band:
            self.width += 1 + 2 * len(BAND_FREQUENCIES)

    def forward(self, query: Query) -> Float[Tensor, "b width"]:
        """The features of each link.

        Raises:
            ValueError: The training links have several carriers, and the query says none.
        """
        places = (query.transmitters - self.middle) / self.half_edge
        parts = [fourier_features(places, self.frequencies)]
        if len(self.scene.receivers) > 1:
            parts.append(one_hot(query.receivers, len(self.scene.receivers)).to(places))
        if self.scene.has_band:
            band = self.scene.band_positions(query)[:, None]
            parts.append(fourier_features(band, BAND_FREQUENCIES.to(places)))
        return torch.cat(parts, 1)
