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
        octaves: As ``Question`` takes them.
        pixel: As ``LabelImage`` takes it [deg].

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
    """Batch normalisation of vectors and images; where a channel has one number in all, by the
    running statistics.

    A single number has no spread, and the last batch of a pass may hold a single link.

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
    return nn.Sequential(
        *(part for pair in pairwise(widths) for part in (nn.Linear(*pair), activation))
    )


def check_widths(**options: int | Sequence[int]) -> None:
    """Sees to it that widths are whole numbers from 1 on.

    Raises:
        ValueError: One is not; or a list of them is empty.
    """
    for option, given in options.items():
        widths = given if isinstance(given, Sequence) else [given]
        if not widths or not all(isinstance(width, int) and width >= 1 for width in widths):
            raise ValueError(f"model.{option} must be of at least 1, got {given}")
