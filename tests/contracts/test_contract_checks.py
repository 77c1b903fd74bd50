"""The checks of built-in parts and splits find faults."""

from dataclasses import replace

import pytest
import torch
from contracts.deformation import check_deformation
from contracts.faults import broken, fed, field, having
from contracts.loss import check_loss
from contracts.projection import check_projection
from contracts.rasterizer import check_rasterizer
from contracts.split import check_split
from contracts.tokenizer import check_tokenizer
from torch import nn

from gaigs.data import Split
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import TwoBranch
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.loss.absolute import Absolute
from gaigs.splatting.loss.l1_ssim import L1Ssim
from gaigs.splatting.loss.relative_error import RelativeError
from gaigs.splatting.loss.squared import Squared
from gaigs.splatting.projection import Plane
from gaigs.splatting.projection.direction_cosine import DirectionCosine
from gaigs.splatting.projection.equirectangular import Equirectangular
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer.torch import TorchRasterizer
from gaigs.splatting.tokenizer.euclidean import EuclideanTokenizer
from gaigs.testing import example_links

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

    def build(tokenizer_widths, channels, **_):
        return kind(tokenizer_widths, channels, width=8, heads=heads, **sizes)

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
            r"random: map must be torch\.float64, got torch\.float32; convert it by",
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


# --- splits ---


def taking(choose):
    """A split of the LINKS["rssi"]'s links by a function of a generator, and the name of the seed."""

    def build(seed):
        test = choose(torch.Generator().manual_seed(seed))
        rest = torch.tensor(sorted({*range(24)} - {*test.tolist()}))
        return Split(f"by row, seed {seed}", rest, rest[:0], test)

    return build


def by_row(generator):
    rows = torch.randperm(12, generator=generator)[:3].sort().values
    return (2 * rows[:, None] + torch.arange(2)).flatten()


def overlapping(seed):
    split = taking(by_row)(seed)
    return replace(split, validation=split.train[:2])


BY_LINK = taking(lambda generator: torch.randperm(24, generator=generator)[:6].sort().values)
GLOBAL = taking(lambda _: by_row(torch.Generator().manual_seed(int(torch.randint(1000, ())))))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (BY_LINK, "links of one row must be in one"),
        (taking(lambda generator: by_row(generator).flip(0)), "test must ascend"),
        (taking(lambda generator: torch.arange(4)), "another seed must give another split"),
        (overlapping, "no link may stand twice in train, validation, test"),
        (
            lambda seed: replace(taking(by_row)(seed), name="by row"),
            "a split's name must differ between seeds",
        ),
        (GLOBAL, "the same seed must give the same split in any random state"),
    ],
)
def test_a_faulty_split_is_found(build, message):
    check_split(taking(by_row), LINKS["rssi"])
    check_split(BY_LINK, LINKS["rssi"], parts_rows=True)
    with pytest.raises(AssertionError, match=message):
        check_split(build, LINKS["rssi"])
