"""Base of the networks: a link's numbers go in, its label's image comes out."""

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import batch_norm

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs_networks.label import LabelImage
from gaigs_networks.question import Question


class Network(Model):
    """A network that gives whole labels; a subclass has ``draw``.

    Args:
        scene: Receivers, task, box of the training transmitters.
        octaves: See ``Question``.
        pixel: See ``LabelImage`` [deg].

    Raises:
        ValueError: An option is out of range.
    """

    def __init__(self, scene: Scene, octaves: tuple[int, int] | None, pixel: float):
        super().__init__(scene)
        self.question = Question(scene, octaves)
        self.label = LabelImage(scene, pixel)

    def fit(self, links: Links) -> None:
        """Takes mean and scale of the training links' labels."""
        self.label.fit(links)

    def forward(self, batch: Batch) -> Prediction:
        images = self.draw(self.question(batch.query))
        return Prediction(self.label.values(images, batch.directions), {})

    def draw(self, features: Float[Tensor, "b width"]) -> Float[Tensor, "b channels rows columns"]:
        """Images of links, from the features of the links."""
        raise NotImplementedError


class BatchNorm(nn.BatchNorm1d):
    """Batch normalisation of vectors and images.

    A channel with a single number has no spread, as in a batch of one link: it is normalised by the
    running statistics.

    Source: Ioffe and Szegedy, Batch Normalization, 2015.
    """

    def forward(
        self, x: Float[Tensor, "b channels *pixels"]
    ) -> Float[Tensor, "b channels *pixels"]:
        if self.training and x.numel() == self.num_features:
            return batch_norm(
                x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        return super().forward(x.flatten(2) if x.ndim > 2 else x).view_as(x)


def linear_layers(widths: Sequence[int], activation: nn.Module) -> nn.Sequential:
    """Linear layers from each width to the next one, an activation behind each."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), activation]
    return nn.Sequential(*layers)


def check_widths(**options: int | Sequence[int]) -> None:
    """Raises a ``ValueError`` unless options are whole numbers from 1 on, or lists of such."""
    for option, given in options.items():
        widths = given if isinstance(given, Sequence) else [given]
        if not widths or not all(isinstance(width, int) and width >= 1 for width in widths):
            raise ValueError(f"model.{option} must be of at least 1, got {given}")
