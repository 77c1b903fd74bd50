"""Checks of tokenizers, deformations and losses find what is broken."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from gaigs.deformation import Deformation, Residuals
from gaigs.deformation.two_branch import TwoBranch
from gaigs.loss.absolute import Absolute
from gaigs.loss.l1_ssim import L1Ssim
from gaigs.loss.relative_error import RelativeError
from gaigs.loss.squared import Squared
from gaigs.placement import Placed
from gaigs.testing import (
    check_deformation,
    check_loss,
    check_tokenizer,
    example_links,
)
from gaigs.tokenizer import Tokens
from gaigs.tokenizer.euclidean import EuclideanTokenizer

LINKS = {task: example_links(task) for task in ("spectrum", "rssi", "csi")}
SCENE = LINKS["rssi"].scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


# --- tokenizers ---


class Normalising(EuclideanTokenizer):
    def forward(self, placed, opacities, query):
        tokens = super().forward(placed, opacities, query)
        return tokens._replace(transmitters=tokens.transmitters - tokens.transmitters.mean(0))


class Deaf(EuclideanTokenizer):
    def forward(self, placed, opacities, query):
        return super().forward(placed, opacities, replace(query, transmitters=0 * query.transmitters))


class Swapped(EuclideanTokenizer):
    def forward(self, placed, opacities, query):
        scene, gaussians, transmitters = super().forward(placed, opacities, query)
        return Tokens(transmitters, gaussians, scene)


class Noisy(EuclideanTokenizer):
    def forward(self, placed, opacities, query):
        return super().forward(Placed(placed.means + torch.rand_like(placed.means)), opacities, query)


class Still(EuclideanTokenizer):
    """Takes Gaussians that stand elsewhere for each query for those of the first."""

    def forward(self, placed, opacities, query):
        return super().forward(Placed(placed.means[:1]), opacities, query)


@pytest.mark.parametrize(
    ("tokenizer", "message"),
    [
        (Normalising, "the token transmitters must not depend on the other queries"),
        (Deaf, "tokens must tell two transmitters apart"),
        (Swapped, r"the token scene must be of shape \(3, 0\), got \(3, 8\)"),
        (Noisy, "two calls must give the same tokens"),
        (Still, "Gaussians that move must have own tokens"),
    ],
)
def test_a_broken_tokenizer_is_found(tokenizer, message):
    options = {"gaussian_octaves": (-1, 1), "transmitter_octaves": (-1, 1), "hidden": 8, "width": 8}
    with pytest.raises(AssertionError, match=message):
        check_tokenizer(tokenizer(SCENE, **options), SCENE)


# --- deformations ---


def two_branch(tokenizer_widths, channels, kind=TwoBranch):
    heads = ["rotation", "signal", "opacity", "attenuation"]
    return kind(tokenizer_widths, channels, width=8, attenuation_layers=1, signal_layers=1, heads=heads)


class Constant(Deformation):
    reads_tokens = False

    def forward(self, tokens, placed, query):
        assert tokens is None
        return Residuals(delta_opacities=placed.means.new_zeros(len(query), placed.means.shape[1]))


class Opaque(TwoBranch):
    def forward(self, tokens, placed, query):
        residuals = super().forward(tokens, placed, query)
        return residuals._replace(attenuations=0 * residuals.attenuations)


class Balanced(TwoBranch):
    def forward(self, tokens, placed, query):
        residuals = super().forward(tokens, placed, query)
        return residuals._replace(delta_quats=residuals.delta_quats - residuals.delta_quats.mean(0))


class Flat(TwoBranch):
    def forward(self, tokens, placed, query):
        residuals = super().forward(tokens, placed, query)
        return residuals._replace(delta_signal=residuals.delta_signal.squeeze(-1))


class Listed(TwoBranch):
    def forward(self, tokens, placed, query):
        return [*super().forward(tokens, placed, query)]


class Rooted(TwoBranch):
    def forward(self, tokens, placed, query):
        residuals = super().forward(tokens, placed, query)
        return residuals._replace(delta_opacities=(0 * residuals.delta_opacities).sqrt())


@pytest.mark.parametrize(
    ("deformation", "message"),
    [
        (Opaque, r"attenuations must lie in \(0, 1\]"),
        (Balanced, "delta_quats must not depend on the other queries"),
        (Flat, r"delta_signal must be of shape \(3, 7, 2, 1\), got \(3, 7, 2\)"),
        (Listed, "a deformation must give Residuals, got list"),
        (Rooted, "the gradient of .* must be finite"),
    ],
)
def test_a_broken_deformation_is_found(deformation, message):
    build = lambda tokenizer_widths, channels, scene, kind=deformation: two_branch(tokenizer_widths, channels, kind)
    with pytest.raises(AssertionError, match=message):
        check_deformation(build, SCENE)


def test_a_deformation_without_tokens_keeps_the_contract():
    check_deformation(lambda **context: Constant(), SCENE)


# --- losses ---


class Summed(Squared):
    def mean(self, values, labels):
        return (values - labels).square().sum()


class Shy(Absolute):
    """Wants predictions above the labels."""

    def mean(self, values, labels):
        return (values - labels - 1).abs().mean()


class Sharp(Absolute):
    def mean(self, values, labels):
        return (values - labels).square().sqrt().mean()


class Deafened(Absolute):
    """Looks at the first link alone, as often as there are links."""

    def mean(self, values, labels):
        return (values - labels)[:1].abs().mean()


class Nested(Absolute):
    def __call__(self, values, batch):
        loss, terms = super().__call__(values, batch)
        return loss, {"errors": terms}


class Changing(Absolute):
    def __call__(self, values, batch):
        loss, terms = super().__call__(values, batch)
        return loss, terms | ({"large": loss} if loss > 5 else {})


class Pooled(RelativeError):
    """The errors of all links over the powers of all."""

    def __call__(self, values, batch):
        loss = (values - batch.labels).abs().square().sum() / batch.labels.abs().square().sum()
        return loss, {"relative_error": loss}


class Strided(L1Ssim):
    """Counts the window in pixels of the whole grid."""

    def __call__(self, values, batch):
        loss, terms = super().__call__(values, batch)
        return loss * (1 + (batch.labels.shape[1] < 18) * (len(values) - 1)), terms


@pytest.mark.parametrize(
    ("build", "task", "message"),
    [
        (Summed, "rssi", "the loss must be the mean of those of its links"),
        (Shy, "rssi", "the loss must be least at the labels"),
        (Sharp, "rssi", "the gradient of the values at the labels must be finite"),
        (Deafened, "rssi", "the loss must be the mean of those of its links"),
        (Nested, "rssi", "terms must be numbers by name"),
        (Changing, "rssi", "terms must be the same wherever the values lie"),
        (Pooled, "csi", "the loss must be the mean of those of its links"),
        (lambda task: Strided(task, 0.2), "spectrum", "the loss must be the mean of those of its links"),
    ],
)
def test_a_broken_loss_is_found(build, task, message):
    with pytest.raises(AssertionError, match=message):
        check_loss(build(LINKS[task].task), LINKS[task])


def test_a_module_may_be_a_loss():
    class Own(nn.Module):
        def forward(self, values, batch):
            loss = (values - batch.labels).square().flatten(1).mean(1).mean()
            return loss, {"own": loss}

    check_loss(Own(), LINKS["spectrum"])
