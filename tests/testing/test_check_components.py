"""The checks of tokenizers, deformations, losses, placements and models find what is broken."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from gaigs.deformation import Deformation, Residuals
from gaigs.deformation.two_branch import TwoBranch
from gaigs.gaussians import Placed, Tokens
from gaigs.loss.absolute import Absolute
from gaigs.loss.l1_ssim import L1Ssim
from gaigs.loss.relative_error import RelativeError
from gaigs.loss.squared import Squared
from gaigs.model import Model, Prediction
from gaigs.placement import Placement
from gaigs.query import Query
from gaigs.testing import (
    check_deformation,
    check_loss,
    check_model,
    check_placement,
    check_tokenizer,
    example_links,
)
from gaigs.tokenizer.euclidean import EuclideanTokenizer

LINKS = {task: example_links(task) for task in ("spectrum", "rssi", "csi")}
SCENE = LINKS["rssi"].scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def broken(kind, change, method="forward"):
    """A class whose method's result is changed by a function of the result and the arguments."""
    return type("Broken", (kind,), {method: lambda self, *given: change(getattr(kind, method)(self, *given), *given)})


def field(name, change):
    """Changes one field of a named tuple."""
    return lambda result, *given: result._replace(**{name: change(getattr(result, name))})


def fed(kind, change):
    """A class whose ``forward`` gets changed arguments."""
    return type("Fed", (kind,), {"forward": lambda self, *given: kind.forward(self, *change(*given))})


# --- tokenizers ---

DEAF = fed(
    EuclideanTokenizer, lambda placed, o, query: (placed, o, replace(query, transmitters=0 * query.transmitters))
)
NOISY = fed(EuclideanTokenizer, lambda p, o, query: (Placed(p.means + torch.rand_like(p.means)), o, query))
STILL = fed(EuclideanTokenizer, lambda placed, o, query: (Placed(placed.means[:1]), o, query))


@pytest.mark.parametrize(
    ("tokenizer", "message"),
    [
        (
            broken(EuclideanTokenizer, field("transmitters", lambda token: token - token.mean(0))),
            "the token transmitters must not depend on the other queries",
        ),
        (
            broken(EuclideanTokenizer, lambda tokens, *_: Tokens(tokens[2], tokens[1], tokens[0])),
            r"the token scene must be of shape \(3, 0\), got \(3, 8\)",
        ),
        (DEAF, "tokens of two transmitters must differ"),
        (NOISY, "two calls must give the same tokens"),
        (STILL, "Gaussians that differ between queries must have own tokens"),
    ],
)
def test_a_broken_tokenizer_is_found(tokenizer, message):
    options = {"gaussian_octaves": (-1, 1), "transmitter_octaves": (-1, 1), "hidden": 8, "width": 8}
    with pytest.raises(AssertionError, match=message):
        check_tokenizer(tokenizer(SCENE, **options), SCENE)


# --- deformations ---


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (field("attenuations", lambda part: 0 * part), r"attenuations must lie in \(0, 1\]"),
        (field("delta_quats", lambda part: part - part.mean(0)), "delta_quats must not depend on the other queries"),
        (
            field("delta_signal", lambda part: part.squeeze(-1)),
            r"delta_signal must be of shape \(3, 7, 2, 1\), got \(3, 7, 2\)",
        ),
        (lambda residuals, *_: [*residuals], "a deformation must give Residuals, got list"),
        (field("delta_opacities", lambda part: (0 * part).sqrt()), "the gradient of .* must be finite"),
    ],
)
def test_a_broken_deformation_is_found(change, message):
    heads, sizes = ["rotation", "signal", "opacity", "attenuation"], {"attenuation_layers": 1, "signal_layers": 1}
    kind = broken(TwoBranch, change)
    build = lambda tokenizer_widths, channels, scene: kind(tokenizer_widths, channels, width=8, heads=heads, **sizes)
    with pytest.raises(AssertionError, match=message):
        check_deformation(build, SCENE)


def test_a_deformation_without_tokens_keeps_the_contract():
    class Constant(Deformation):
        reads_tokens = False

        def forward(self, tokens, placed, query):
            assert tokens is None
            return Residuals(delta_opacities=placed.means.new_zeros(len(query), placed.means.shape[1]))

    check_deformation(lambda **context: Constant(), SCENE)


# --- losses ---


def averaged(kind, mean):
    return type("Averaged", (kind,), {"mean": lambda self, values, labels: mean(values - labels)})


def relative_error_of_all(result, values, batch):
    loss = (values - batch.labels).abs().square().sum() / batch.labels.abs().square().sum()
    return loss, {"relative_error": loss}


def summed_where_thinned(result, values, batch):
    return result[0] * (1 + (batch.labels.shape[1] < 18) * (len(values) - 1)), result[1]


MEAN = "the loss must be the mean over its links"


@pytest.mark.parametrize(
    ("kind", "task", "message"),
    [
        (averaged(Squared, lambda errors: errors.square().sum()), "rssi", MEAN),
        (averaged(Absolute, lambda errors: errors[:1].abs().mean()), "rssi", MEAN),
        (averaged(Absolute, lambda errors: (errors - 1).abs().mean()), "rssi", "the loss must be least at the labels"),
        (
            averaged(Absolute, lambda errors: errors.square().sqrt().mean()),
            "rssi",
            "the gradient of the values at the labels must be finite",
        ),
        (
            broken(Absolute, lambda result, *_: (result[0], {"errors": result[1]}), "__call__"),
            "rssi",
            "terms must be numbers by name",
        ),
        (
            broken(Absolute, lambda r, *_: (r[0], r[1] | ({"large": r[0]} if r[0] > 5 else {})), "__call__"),
            "rssi",
            "terms must be the same for all values",
        ),
        (broken(RelativeError, relative_error_of_all, "__call__"), "csi", MEAN),
        (broken(L1Ssim, summed_where_thinned, "__call__"), "spectrum", MEAN),
    ],
)
def test_a_broken_loss_is_found(kind, task, message):
    with pytest.raises(AssertionError, match=message):
        check_loss(kind(LINKS[task].task), LINKS[task])


def test_a_module_may_be_a_loss():
    class Own(nn.Module):
        def forward(self, values, batch):
            loss = (values - batch.labels).square().flatten(1).mean(1).mean()
            return loss, {"own": loss}

    check_loss(Own(), LINKS["spectrum"])


# --- placements ---


class Halfway(Placement):
    """Between the Gaussian and each transmitter, along a path of known length."""

    def forward(self, gaussians, query):
        means = (gaussians.means + query.transmitters[:, None]) / 2
        return Placed(means, 2 * (means - query.transmitters[:, None]).norm(dim=-1))


class Mirror(Placement):
    """A Gaussian of its own at the image of each transmitter in the floor, before any free ones."""

    has_own = True
    keeps_free = True

    def __init__(self):
        super().__init__()
        self.log_loss = nn.Parameter(torch.zeros(()))

    def forward(self, gaussians, query):
        b, count = len(query), 0 if gaussians is None or not self.keeps_free else len(gaussians)
        images = query.transmitters[:, None] * query.transmitters.new_tensor([1, 1, -1])
        ones, own = images.new_ones(b, 1 + count), images.new_ones(1)
        free = gaussians if count else None
        beside = lambda mine, theirs, axis: mine if free is None else torch.cat((mine, theirs()), axis)
        return Placed(
            means=beside(images, lambda: free.means.expand(b, -1, -1), 1),
            lengths=beside(images.norm(dim=-1), lambda: ones[:, 1:], 1),
            quats=beside(images.new_tensor([[1.0, 0, 0, 0]]), lambda: free.unit_quats, 0),
            scales=beside(images.new_ones(b, 1, 3), lambda: free.scales.expand(b, -1, -1), 1),
            opacities=beside(own, lambda: free.opacities, 0),
            signal=beside(images.new_tensor([[[1.0], [0.0]]]), lambda: free.signal, 0),
            gains=torch.complex(self.log_loss.exp() * ones, ones),
            coherences=images.new_ones(1 + count) / 2,
            bandwidth=own[0] * 1e8,
        )


OF_RECEIVER = broken(
    Mirror, lambda placed, _, query: placed._replace(gains=placed.gains * (1 + query.receivers[:, None]))
)
OF_ALL = broken(Mirror, lambda placed, _, query: placed._replace(coherences=placed.coherences / (1 + len(query))))


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (broken(Halfway, lambda placed, *_: placed.means), "a placement must give a Placed, got Tensor"),
        (broken(Halfway, field("means", lambda part: part[0])), r"means must be \(1 or 3, 40, 3\), got \(40, 3\)"),
        (
            broken(Halfway, lambda placed, _, query: placed._replace(means=placed.means + 0.1 * len(query))),
            "means must not depend on the other queries",
        ),
        (broken(Halfway, field("lengths", lambda part: -part)), "lengths must not be negative"),
        (
            broken(Halfway, field("lengths", lambda part: (0 * part).sqrt())),
            r"the gradient of gaussians\.means must be finite",
        ),
        (type("Alone", (Mirror,), {"keeps_free": False}), "the free Gaussians, 40, must be among .*, got 1"),
        (type("Ungrouped", (Mirror,), {"parameter_groups": lambda self: {}}), "must be in one of parameter_groups"),
        (broken(Mirror, field("signal", lambda part: None)), "must be given together, and signal is missing"),
        (broken(Mirror, field("quats", lambda part: 2 * part)), "quats must be of length 1"),
        (broken(Mirror, field("scales", lambda part: 0 * part)), "scales must be positive"),
        (broken(Mirror, field("opacities", lambda part: 2 * part)), r"opacities must lie in \[0, 1\]"),
        (broken(Mirror, field("gains", lambda part: part.real)), "gains must be torch.complex64 as its input"),
        (OF_RECEIVER, "gains must not depend on the receiver unless sees_receivers says so"),
        (OF_ALL, "coherences must not depend on the other queries"),
        (broken(Mirror, field("coherences", lambda part: -part)), r"coherences must lie in \[0, 1\]"),
        (
            broken(Mirror, field("bandwidth", lambda part: part.expand(41))),
            r"bandwidth must be of shape \(\), got \(41,",
        ),
        (broken(Mirror, field("bandwidth", lambda part: -part)), "bandwidth must not be negative"),
    ],
)
def test_a_broken_placement_is_found(placement, message):
    with pytest.raises(AssertionError, match=message):
        check_placement(placement(), SCENE)


# --- models ---


class Grey(Model):
    """The same grey in all directions, learnt."""

    level = 1.0

    def __init__(self, scene):
        super().__init__(scene)
        self.grey = nn.Parameter(torch.full((), 0.5))

    def forward(self, batch):
        return Prediction(self.level * self.grey * self.grey.new_ones(len(batch), *batch.directions.shape), {})


class Level(Model):
    """One level for each receiver and carrier, learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        self.levels = nn.Parameter(-60.0 - torch.arange(len(scene.receivers)))

    def forward(self, batch):
        levels = self.levels[batch.query.receivers]
        if batch.query.frequencies is not None:
            levels = levels - batch.query.frequencies / 1e9
        return Prediction(levels, {})


@pytest.mark.parametrize("kept", [Halfway, Mirror, Grey, Level])
def test_sound_ones_keep_the_contract(kept):
    if issubclass(kept, Placement):
        check_placement(kept(), SCENE)
        return
    check_model(kept, LINKS["spectrum" if kept is Grey else "rssi"])
    if kept is Level:  # asked at its carriers
        links = LINKS["rssi"]
        frequencies = torch.tensor([2.4e9, 5.0e9])[torch.arange(24) // 2 % 2]
        check_model(Level, replace(links, query=replace(links.query, frequencies=frequencies)))


def changed(change, kind=Grey):
    """A model whose value is changed by a function of the value and the batch."""
    return broken(kind, lambda prediction, batch: prediction._replace(value=change(prediction.value, batch)))


def shaded(value, batch):
    """A gradient by the number of the row."""
    shades = torch.linspace(0, 1, batch.directions.shape[0])
    return value * shades.reshape(-1, *[1] * (value.ndim - 2))


def without_nan(self, transmitters, *others, **options):
    if not isinstance(transmitters, Query):
        transmitters = torch.as_tensor(transmitters).nan_to_num()
    return Model.predict(self, transmitters, *others, **options)


def without_the_last(value, model):
    return value if model.chunk is None else value * (torch.arange(value.shape[-1]) < value.shape[-1] - 1)


def with_methods(**methods):
    return type("Own", (Grey,), methods)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (with_methods(parameter_groups=lambda self: {"network": []}), "must be in one of parameter_groups"),
        (
            changed(lambda value, batch: value.mean() * value.new_ones(len(batch), 18, 36)),
            "predict must give the directions asked for",
        ),
        (
            with_methods(fit=lambda self, links: setattr(self, "level", links.labels.mean())),
            "all that predict needs must be in the state dict",
        ),
        (changed(lambda value, batch: value * len(batch)), "the batch size must not change predictions"),
        (changed(lambda value, batch: (value * 0).sqrt()), "the gradient of grey must be finite"),
        (
            with_methods(predict=lambda self, places, *_, **options: torch.full((len(places), 18, 36), 0.5)),
            "a grid of positions must give a grid of predictions",
        ),
        (with_methods(predict=without_nan), "transmitters with NaN must be a ValueError"),
        (changed(shaded), "predict must give the directions asked for"),
        (
            changed(lambda value, batch: value * (1 + batch.query.receivers[:1].sum())),
            "links to several receivers must get the values of single links",
        ),
        (with_methods(facts=lambda self: {"mean": torch.zeros(())}), "facts must be plain values"),
        (with_methods(trained_by="osmosis"), "trained_by must be one of .*'descent'.*, got 'osmosis'"),
        (
            broken(Grey, lambda result, batch: result._replace(penalties={"each": result.value.flatten(1)[:, 0]})),
            r"the penalty each must be of shape \(\), got \(5,\)",
        ),
        (
            with_methods(evaluate=lambda self, batch: without_the_last(Model.evaluate(self, batch), self)),
            "chunk must not change values",
        ),
        (
            changed(lambda value, batch: value.sort().values, Level),
            "links to several receivers must get the values of single links|the order of links must not matter",
        ),
        (changed(lambda value, batch: value.double(), Level), "predictions must be torch.float32"),
    ],
)
def test_a_broken_model_is_found(model, message):
    with pytest.raises(AssertionError, match=message):
        check_model(model, LINKS["rssi" if issubclass(model, Level) else "spectrum"])
