"""The scene mapping network: heads, parameters, initial residuals, and the linear layer in parts."""

from itertools import chain, combinations

import pytest
import torch

from gaigs.core.query import Query
from gaigs.splatting.deformation.two_branch import (
    INITIAL_ATTENUATION,
    LEAST_ATTENUATION,
    TokenLinear,
    TwoBranch,
)
from gaigs.splatting.gaussians import Placed, Tokens

B, N, CHANNELS, WIDTH = 3, 7, 2, 8
WIDTHS = (5, 4, 6)
SUBSETS = [
    list(subset)
    for subset in chain.from_iterable(combinations(TwoBranch.all_heads, size) for size in range(6))
]
SHAPES = dict(
    zip(
        TwoBranch.all_heads,
        ((B, N, 4), (B, N, 3), (B, N, CHANNELS, 1), (B, N), (B, N)),
        strict=True,
    )
)


def make_tokens(widths=WIDTHS, b=B, n=N, scale=1.0):
    scene, gaussian, transmitter = widths
    return Tokens(
        *(
            scale * torch.randn(count, width)
            for count, width in ((b, scene), (n, gaussian), (b, transmitter))
        )
    )


def make_network(heads, widths=WIDTHS):
    return TwoBranch(
        widths, CHANNELS, width=WIDTH, attenuation_layers=2, signal_layers=1, heads=heads
    )


def residuals_of(network, tokens):
    """The network's residuals, which depend on the tokens only."""
    b, n = len(tokens.scene), tokens.gaussians.shape[-2]
    query = Query(torch.full((b, 3), torch.nan), torch.zeros(b, dtype=torch.long))
    return network(tokens, Placed(torch.full((1, n, 3), torch.nan)), query)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("heads", SUBSETS, ids="-".join)
def test_a_head_left_out_does_not_exist_and_costs_nothing(heads):
    network = make_network(heads)
    residuals = dict(zip(TwoBranch.all_heads, residuals_of(network, make_tokens()), strict=True))
    assert {name for name, residual in residuals.items() if residual is not None} == set(heads)
    for name in heads:
        assert residuals[name].shape == SHAPES[name]
    # Zero heads would hide earlier layers.
    for head in network.heads.values():
        torch.nn.init.normal_(head.weight)
    parameters = dict(network.named_parameters())
    if heads:
        total = sum(r.square().sum() for r in residuals_of(network, make_tokens()) if r is not None)
        total.backward()
    assert all(
        parameter.grad is not None and parameter.grad.any() for parameter in parameters.values()
    )
    assert bool(parameters) == bool(heads)


def test_the_number_of_parameters_is_that_of_the_papers_layers():
    scene, gaussian, transmitter = WIDTHS

    def linear(fan_in, fan_out):
        return (fan_in + 1) * fan_out

    attenuation = linear(scene + gaussian + transmitter, WIDTH) + 2 * linear(WIDTH, WIDTH)
    signal = linear(scene + gaussian + transmitter + WIDTH, WIDTH) + linear(WIDTH, WIDTH)
    heads = {name: linear(WIDTH, 1) for name in ("opacity", "attenuation")}
    heads |= {
        name: linear(2 * WIDTH, size)
        for name, size in (("rotation", 4), ("scale", 3), ("signal", CHANNELS))
    }
    for chosen in SUBSETS:
        expected = sum(heads[name] for name in chosen) + attenuation * bool(chosen)
        expected += signal * any(name in chosen for name in ("rotation", "scale", "signal"))
        assert sum(parameter.numel() for parameter in make_network(chosen).parameters()) == expected


def test_residuals_start_at_zero_and_the_attenuation_nearly_clear():
    residuals = residuals_of(make_network(list(TwoBranch.all_heads)), make_tokens(scale=10.0))
    for residual in (residuals.delta_quats, residuals.delta_scales, residuals.delta_opacities):
        assert not residual.any()
    torch.testing.assert_close(residuals.attenuations, torch.full((B, N), INITIAL_ATTENUATION))
    assert (
        residuals.delta_signal.any()
    )  # the signal is where transmitters differ from the first step on


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4, 1e18])
def test_the_attenuation_lies_in_0_1_however_large_the_activations(dtype, scale):
    network = make_network(["attenuation"]).to(dtype)
    tokens = Tokens(*(token.to(dtype) for token in make_tokens(scale=scale)))
    extremes = []
    for sign in (-1, 1):
        torch.nn.init.constant_(network.heads["attenuation"].weight, sign * 3)
        attenuations = residuals_of(network, tokens).attenuations
        assert attenuations.min() > 0
        assert attenuations.max() <= 1
        attenuations.log().sum().backward()
        assert all(parameter.grad.isfinite().all() for parameter in network.parameters())
        extremes += [attenuations.min().item(), attenuations.max().item()]
    if scale == 1e18:
        assert min(extremes) == pytest.approx(LEAST_ATTENUATION)
        assert max(extremes) == pytest.approx(1)


@pytest.mark.parametrize("hidden", [0, 3])
@pytest.mark.parametrize("widths", [WIDTHS, (5, 0, 0), (0, 4, 0), (0, 4, 6), (5, 0, 6), (0, 0, 0)])
def test_the_layer_is_one_linear_layer_on_the_concatenation(widths, hidden):
    layer, tokens = TokenLinear(widths, WIDTH, hidden), make_tokens(widths)
    inner = torch.randn(B, N, hidden) if hidden else None
    scene, gaussians, transmitters = (
        tokens.scene[:, None],
        tokens.gaussians[None],
        tokens.transmitters[:, None],
    )
    parts = [part.expand(B, N, -1) for part in (scene, transmitters, gaussians)] + [inner] * bool(
        hidden
    )
    weights = [
        linear.weight
        for linear in (layer.links, layer.gaussians, layer.hidden)
        if linear is not None
    ]
    weight = torch.cat(weights, 1) if weights else torch.zeros(WIDTH, 0)
    whole = torch.nn.functional.linear(torch.cat(parts, -1), weight, layer.bias)
    torch.testing.assert_close(layer(tokens, inner), whole)


def test_initial_weights_are_those_of_one_linear_layer():
    layer, whole = TokenLinear((30, 300, 70), 200, hidden=100), torch.nn.Linear(500, 200)
    for parameter in layer.parameters():
        assert parameter.abs().max() <= whole.weight.abs().max() * 1.01
        assert parameter.std().item() == pytest.approx(whole.weight.std().item(), rel=0.15)


@pytest.mark.parametrize("hidden", [0, 3])
def test_tokens_of_gaussians_may_differ_between_queries(hidden):
    layer, tokens = TokenLinear(WIDTHS, WIDTH, hidden), make_tokens()
    own = tokens._replace(gaussians=torch.randn(B, N, WIDTHS[1]))
    inner = torch.randn(B, N, hidden) if hidden else None
    alone = [
        Tokens(own.scene[i : i + 1], own.gaussians[i], own.transmitters[i : i + 1])
        for i in range(B)
    ]
    each = [layer(part, inner[i : i + 1] if hidden else None) for i, part in enumerate(alone)]
    torch.testing.assert_close(layer(own, inner), torch.cat(each))
    shared = own._replace(gaussians=tokens.gaussians.expand(B, -1, -1))
    torch.testing.assert_close(layer(shared, inner), layer(tokens, inner))
