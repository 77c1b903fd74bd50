"""FIRE: a variational auto-encoder of labels, conditioned on the transmitter's position."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.model import Prediction
from gaigs_networks.network import Network, check_widths, linear_layers


class Fire(Network):
    """A conditional variational auto-encoder: an encoder maps the label to a latent code, and a
    decoder draws the label from the code.

    With y the label's image and c the link's features, a training step draws z ~ N(mu(y, c),
    exp(lambda(y, c))), predicts the decoder's image of (z, c), and adds a penalty on the
    information in z,

        KL = sum_i (mu_i² + exp(lambda_i) - lambda_i - 1) / 2   [nat]

    A prediction has no label, and takes the mean of the prior, z = 0.

    The penalty ``kl`` is KL over the count of numbers in an image, times the variance of the
    labels, so that it has the unit of a mean squared error; for complex labels times 1, as their
    loss has no unit. With the weight 2 s, loss and penalty bound the likelihood of labels with
    independent noise of s times their variance.

    Args:
        scene: Receivers, task, box of the training transmitters.
        widths: Widths of the encoder's layers; the decoder has them in reverse before its last
            layer.
        latent: Length of z.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None: those that the training transmitters can teach.
        pixel: Pixel of the images in which spectra are drawn [deg].

    Raises:
        ValueError: An option is out of range.

    Source: Liu et al., FIRE, 2021; conditioned as in Sohn et al., Learning Structured Output
        Representation using Deep Conditional Generative Models, 2015.
    """

    learning_rates: Mapping[str, float] = {"network": 1e-3}
    # Twice the share of the labels' variance that counts as noise.
    penalty_weights: Mapping[str, float] = {"kl": 0.2}

    def __init__(
        self,
        scene: Scene,
        widths: list[int],
        latent: int,
        octaves: tuple[int, int] | None,
        pixel: float,
    ):
        super().__init__(scene, octaves, pixel)
        check_widths(widths=widths, latent=latent)
        numbers = math.prod(self.label.shape)
        features = self.question.width
        self.latent = latent
        self.encoder = linear_layers([numbers + features, *widths], nn.LeakyReLU())
        self.posterior = nn.Linear(widths[-1], 2 * latent)
        decoder = linear_layers([latent + features, *reversed(widths)], nn.LeakyReLU())
        self.decoder = nn.Sequential(
            decoder, nn.Linear(widths[0], numbers), nn.Unflatten(1, self.label.shape)
        )

    def forward(self, batch: Batch) -> Prediction:
        features = self.question(batch.query)
        z = features.new_zeros(len(features), self.latent)
        penalties = {}
        if self.training and batch.labels is not None:
            z, kl = self.encode(self.label.own_images(batch.labels, batch.directions), features)
            unit = 1.0 if batch.labels.is_complex() else self.label.scale.square()
            penalties["kl"] = unit * kl.mean() / math.prod(self.label.shape)
        images = self.decoder(torch.cat((z, features), 1))
        return Prediction(self.label.values(images, batch.directions), penalties)

    def encode(
        self, images: Float[Tensor, "b channels rows columns"], features: Float[Tensor, "b width"]
    ) -> tuple[Float[Tensor, "b latent"], Float[Tensor, " b"]]:
        """A random code z of each label, and the information KL in it [nat]."""
        hidden = self.encoder(torch.cat((images.flatten(1), features), 1))
        mean, log_variance = self.posterior(hidden).chunk(2, 1)
        kl = (mean.square() + log_variance.exp() - log_variance - 1).sum(1) / 2
        z = mean + (log_variance / 2).exp() * torch.randn_like(mean)
        return z, kl
