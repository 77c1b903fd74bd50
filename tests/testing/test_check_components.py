"""The checks of the parts of splatting find faults."""

from dataclasses import replace

import pytest
import torch
from faults import broken, fed, field, having
from torch import nn

from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import TwoBranch
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.loss.absolute import Absolute
from gaigs.splatting.loss.l1_ssim import L1Ssim
from gaigs.splatting.loss.relative_error import RelativeError
from gaigs.splatting.loss.squared import Squared
from gaigs.splatting.placement import Placement
from gaigs.splatting.pooling import Pooling, sphere
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.splatting.pooling.spectrum import SpectrumPooling
from gaigs.splatting.projection import Plane
from gaigs.splatting.projection.direction_cosine import DirectionCosine
from gaigs.splatting.projection.equirectangular import Equirectangular
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer.torch import TorchRasterizer
from gaigs.splatting.tokenizer.euclidean import EuclideanTokenizer
from gaigs.testing import (
    check_deformation,
    check_loss,
    check_placement,
    check_pooling,
    check_projection,
    check_rasterizer,
    check_tokenizer,
    example_links,
)

LINKS = {task: example_links(task) for task in ("spectrum", "rssi", "csi")}
SCENE = LINKS["rssi"].scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.mark.parametrize(
    ("tokenizer", "message"),
    [
        (
            broken(EuclideanTokenizer, field("transmitters", lambda token: token - token.mean(0))),
            "transmitters must not depend on the other queries",
        ),
        (
            broken(EuclideanTokenizer, lambda tokens, *_: Tokens(tokens[2], tokens[1], tokens[0])),
            r"the token scene must be of shape \(3, 0\), got \(3, 8\)",
        ),
        (
            fed(
                EuclideanTokenizer,
                lambda p, o, query: (p, o, replace(query, transmitters=0 * query.transmitters)),
            ),
            "tokens of two transmitters must differ",
        ),
        (
            fed(
                EuclideanTokenizer,
                lambda p, o, query: (Placed(p.means + torch.rand_like(p.means)), o, query),
            ),
            "two calls must give the same gaussians",
        ),
        (
            fed(EuclideanTokenizer, lambda placed, o, query: (Placed(placed.means[:1]), o, query)),
            "Gaussians that differ between queries must have own tokens",
        ),
    ],
)
def test_a_faulty_tokenizer_is_found(tokenizer, message):
    options = {"gaussian_octaves": (-1, 1), "transmitter_octaves": (-1, 1), "hidden": 8, "width": 8}
    with pytest.raises(AssertionError, match=message):
        check_tokenizer(tokenizer(SCENE, **options), SCENE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (field("attenuations", lambda part: 0 * part), r"attenuations must lie in \(0, 1\]"),
        (
            field("delta_quats", lambda part: part - part.mean(0)),
            "delta_quats must not depend on the other queries",
        ),
        (
            field("delta_signal", lambda part: part.squeeze(-1)),
            r"delta_signal must be of shape \(3, 7, 2, 1\)",
        ),
        (lambda residuals, *_: [*residuals], "a deformation must give Residuals, got list"),
        (
            field("delta_opacities", lambda part: (0 * part).sqrt()),
            "the gradient of .* must be finite",
        ),
    ],
)
def test_a_faulty_deformation_is_found(change, message):
    heads, sizes = (
        ["rotation", "signal", "opacity", "attenuation"],
        {"attenuation_layers": 1, "signal_layers": 1},
    )
    kind = broken(TwoBranch, change)
    build = lambda tokenizer_widths, channels, scene: kind(
        tokenizer_widths, channels, width=8, heads=heads, **sizes
    )
    with pytest.raises(AssertionError, match=message):
        check_deformation(build, SCENE)


def test_a_deformation_without_tokens_keeps_the_contract():
    class Constant(Deformation):
        reads_tokens = False

        def forward(self, tokens, placed, query):
            assert tokens is None
            return Residuals(
                delta_opacities=placed.means.new_zeros(len(query), placed.means.shape[1])
            )

    check_deformation(lambda **context: Constant(), SCENE)


# --- losses ---


def averaged(kind, mean):
    return having(kind, mean=lambda self, values, labels: mean(values - labels))


def relative_error_of_all(result, values, batch):
    loss = (values - batch.labels).abs().square().sum() / batch.labels.abs().square().sum()
    return loss, {"relative_error": loss}


def summed_where_thinned(result, values, batch):
    return result[0] * (1 + (batch.labels.shape[1] < 18) * (len(values) - 1)), result[1]


def extra_term(result, values, batch):
    return result[0], result[1] | ({"large": result[0]} if result[0] > 5 else {})


ROOT = averaged(Absolute, lambda errors: errors.square().sqrt().mean())
MEAN = "the loss must be the mean over its links"


@pytest.mark.parametrize(
    ("kind", "task", "message"),
    [
        (averaged(Squared, lambda errors: errors.square().sum()), "rssi", MEAN),
        (averaged(Absolute, lambda errors: errors[:1].abs().mean()), "rssi", MEAN),
        (
            averaged(Absolute, lambda errors: (errors - 1).abs().mean()),
            "rssi",
            "the loss must be least at the labels",
        ),
        (ROOT, "rssi", "the gradient of the values at the labels must be finite"),
        (broken(Absolute, extra_term, "__call__"), "rssi", "terms must be the same for all values"),
        (broken(RelativeError, relative_error_of_all, "__call__"), "csi", MEAN),
        (broken(L1Ssim, summed_where_thinned, "__call__"), "spectrum", MEAN),
    ],
)
def test_a_faulty_loss_is_found(kind, task, message):
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
        beside = lambda mine, theirs, axis: (
            mine if free is None else torch.cat((mine, theirs()), axis)
        )
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


def shifted(placed, _, query):
    return placed._replace(means=placed.means + 0.1 * len(query))


def weighted_by_receiver(placed, _, query):
    return placed._replace(gains=placed.gains * (1 + query.receivers[:, None]))


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (
            broken(Halfway, lambda placed, *_: placed.means),
            "a placement must give a Placed, got Tensor",
        ),
        (
            broken(Halfway, field("means", lambda part: part[0])),
            r"means must be of shape \(3, 40, 3\), got \(40, 3\)",
        ),
        (broken(Halfway, shifted), "means must not depend on the other queries"),
        (broken(Halfway, field("lengths", lambda part: -part)), r"lengths must lie in \[0, inf\]"),
        (
            broken(Halfway, field("lengths", lambda part: (0 * part).sqrt())),
            "the gradient of transmitters must be fin",
        ),
        (having(Mirror, keeps_free=False), "the free Gaussians, 40, must be among .*, got 1"),
        (having(Mirror, parameter_groups=lambda self: {}), "must be in one of parameter_groups"),
        (
            broken(Mirror, field("signal", lambda part: None)),
            "must be given together, and signal is missing",
        ),
        (broken(Mirror, field("quats", lambda part: 2 * part)), "quats must be of length 1"),
        (broken(Mirror, field("scales", lambda part: 0 * part)), "scales must be positive"),
        (
            broken(Mirror, field("opacities", lambda part: 2 * part)),
            r"opacities must lie in \[0, 1\]",
        ),
        (
            broken(Mirror, field("gains", lambda part: part.real)),
            "gains must be torch.complex64 as its input",
        ),
        (
            broken(Mirror, weighted_by_receiver),
            "gains must not depend on the receiver unless sees_receivers",
        ),
        (
            broken(Mirror, field("bandwidth", lambda part: part.expand(41))),
            r"bandwidth must be of shape \(\), got",
        ),
    ],
)
def test_a_faulty_placement_is_found(placement, message):
    with pytest.raises(AssertionError, match=message):
        check_placement(placement(), SCENE)


@pytest.mark.parametrize("kind", [Halfway, Mirror])
def test_sound_placements_keep_the_contract(kind):
    check_placement(kind(), SCENE)


# --- poolings ---


class Power(Pooling):
    """Mean power of a map in dB, over a floor."""

    floor = 1e-2

    def __init__(self, scene):
        super().__init__()
        self.scene, self.grid = scene, sphere("pooling.grid", [4, 8])

    def forward(self, image, query, directions=None):
        image = image.to(torch.promote_types(image.dtype, torch.float32))
        return 10 * (image.square().sum(1).mean((1, 2)) + self.floor).log10()


class Beamed(Power):
    """The power of a map of its own, spread over the directions of a spectrum."""

    def forward(self, image, query, directions=None):
        level = image.square().mean((1, 2, 3))
        heights = (directions or self.scene.task.directions).vectors()[..., 2].to(level)
        return level.reshape(-1, *[1] * heights.ndim) * heights


class OfMap(SpectrumPooling):
    def __init__(self, scene):
        super().__init__(2)


def windowed(value, image, query):
    return value * torch.linspace(1, 2, image.shape[2]).to(image)[:, None]


def clamped(value, image, query):
    return 20 * image.to(value.dtype).square().sum(1).mean((1, 2)).sqrt().clamp(min=1e-3).log10()


def narrow(value, image, query):
    return 10 * (image.square().sum(1).mean((1, 2)) + 1e-2).log10().to(value.dtype)


@pytest.mark.parametrize(
    ("pooling", "task", "message"),
    [
        (
            broken(OfMap, lambda value, image, _: image.square().sum(1).sqrt()),
            "spectrum",
            "of silent maps must be fin",
        ),
        (
            broken(OfMap, lambda v, image, _: v / image.abs().max()),
            "spectrum",
            "must not depend on the other maps",
        ),
        (
            broken(OfMap, lambda v, *_: v.flatten(1)),
            "spectrum",
            r"the value must be of shape \(3, 18, 36\), got",
        ),
        (
            broken(OfMap, windowed),
            "spectrum",
            "a list of rays must have the values of their pixels",
        ),
        (having(OfMap, zone=(1.0, -1.0)), "spectrum", "zone must be two elevations"),
        (OfMap, "rssi", "labels of task 'rssi' need a pooling with a grid"),
        (having(Power, floor=0.0), "rssi", "the value of silence must be finite"),
        (broken(Power, clamped), "rssi", "the gradient of silent maps must be finite"),
        (broken(Power, narrow), "rssi", "the value of 12 decades in float16 must be finite"),
        (
            broken(Power, lambda v, image, _: v.to(image.dtype)),
            "rssi",
            "a silent map in float16 must be torch.float32",
        ),
        (
            having(Power, fit=lambda self, links: setattr(self, "floor", 2.0)),
            "rssi",
            "state dict must restore it",
        ),
        (Power, "csi", r"the value must be of shape \(3, 4, 5\), got \(3,\)"),
        (
            fed(PathRssi, lambda heard, *_: (heard / heard.abs().max(), *_), "read"),
            "rssi",
            "depend on the other paths",
        ),
        (
            broken(PathRssi, lambda v, *_: v[:, None], "read"),
            "rssi",
            r"the value must be of shape \(3,\), got \(3, 1\)",
        ),
        (having(PathRssi, channels=1), "rssi", "paths have 2 channels, got channels 1"),
        (
            broken(Beamed, lambda v, *_: v[:, None] if v.ndim == 2 else v),
            "spectrum",
            "fewer directions must get",
        ),
    ],
)
def test_a_faulty_pooling_is_found(pooling, task, message):
    with pytest.raises(AssertionError, match=message):
        check_pooling(pooling, LINKS[task])


@pytest.mark.parametrize(("pooling", "task"), [(Beamed, "spectrum"), (Power, "rssi")])
def test_sound_poolings_keep_the_contract(pooling, task):
    check_pooling(pooling, LINKS[task])


# --- projections and rasterizers ---


def without_bound(jacobian, points):
    azimuth, elevation = jacobian.unbind(-2)
    azimuth = nn.functional.normalize(azimuth, dim=-1) / points[..., :2].norm(dim=-1, keepdim=True)
    return torch.stack((azimuth, elevation), -2)


SKEW = torch.tensor([[1.0], [1.001]])


@pytest.mark.parametrize(
    ("projection", "message"),
    [
        (
            broken(Mercator, lambda j, points: j * SKEW.to(points), "jacobian"),
            "jacobian must be the derivative of",
        ),
        (
            broken(Equirectangular, without_bound, "jacobian"),
            "factors at hard places must be finite",
        ),
        (
            broken(Equirectangular, lambda p, _: replace(p, v=p.v + 1e-6), "plane"),
            "plane.v must be coordinates' v",
        ),
        (
            broken(Equirectangular, lambda p, _: replace(p, period=None), "plane"),
            "a plane must have the projection's",
        ),
        (
            broken(Mercator, lambda p, _: replace(p, v=p.v.reshape(-1, 1)), "plane"),
            r"plane.v of a list of rays must be of shape \(1, 1\) or \(1, 108\), got \(108, 1\)",
        ),
        (
            broken(DirectionCosine, lambda p, _: Plane(p.u.float(), p.v.float(), None), "plane"),
            "directions' dtype",
        ),
        (
            broken(
                Mercator, lambda splats, *_: replace(splats, visible=splats.depths < 100), "project"
            ),
            "a Gaussian must be hidden if it sits on the receiver",
        ),
    ],
)
def test_a_faulty_projection_is_found(projection, message):
    with pytest.raises(AssertionError, match=message):
        check_projection(projection(0.02))


def changed(change):
    return fed(TorchRasterizer, change, "__call__")


def mixed(result, *_):
    return result[0] + 1e-2 * (len(result[0]) - 2), result[1]


def eight_channels(splats, signal, *others):
    """Draws eight channels, and repeats the first beyond."""
    return (
        splats,
        torch.cat((signal[..., :8], signal[..., :1].expand_as(signal)[..., 8:]), -1),
        *others,
    )


@pytest.mark.parametrize(
    ("rasterizer", "message"),
    [
        (
            changed(lambda *given: (*given[:4], replace(given[4], period=None))),
            "random: map must be that",
        ),
        (
            changed(lambda s, *given: (replace(s, depths=0 * s.depths), *given)),
            "random: map must be that",
        ),
        (
            changed(lambda s, g, o, a, plane: (s, g, o, None, plane)),
            "attenuations: map must be that",
        ),
        (
            changed(lambda s, *given: (replace(s, means2d=s.means2d.detach()), *given)),
            "random: gradient of means2d must be that of the formula",
        ),
        (
            changed(lambda s, signal, *given: (s, signal.nan_to_num(), *given)),
            "NaN in signal must show as NaN in the",
        ),
        (
            broken(
                TorchRasterizer, lambda result, *_: [part.float() for part in result], "__call__"
            ),
            r"random: map must be torch\.float64 as its input, got torch\.float32",
        ),
        (
            broken(TorchRasterizer, mixed, "__call__"),
            "random: a map must not depend on other transmitters",
        ),
        (changed(eight_channels), "many channels: map must be that"),
        (having(TorchRasterizer, used=None), "used must name the rasterizer, got None"),
    ],
)
def test_a_faulty_rasterizer_is_found(rasterizer, message):
    with pytest.raises(AssertionError, match=message):
        check_rasterizer(rasterizer())
