"""WRF-GS+: its network and its rendering against plain float64 transcriptions."""

import functools

import numpy as np
import pytest
import torch
from contracts.deformation import check_deformation
from contracts.rasterizer import rasterize_densely
from contracts.tokenizer import check_tokenizer
from splatting import build, composed
from torch.nn.functional import normalize

from gaigs.core.geometry import semi_axes
from gaigs.splatting.gaussians import Placed
from gaigs.testing import example_links

LINKS = example_links()
SMALL = ("model=wrf_gs_plus", "gaussians.count=40", "deformation.width=16", "rasterizer=torch")
SOME = torch.tensor([0, 2, 4])
"""Links to the first receiver."""


@pytest.fixture
def model():
    """The model of spectra, its network as after some training."""
    model = build("model", composed(*SMALL)["model"], scene=LINKS.scene)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.deformation.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
        model.gaussians.log_scales.add_(0.5 * torch.randn(40, 3, generator=generator))
    return model


def ask(model):
    """Arguments of the deformation."""
    query = LINKS.query[SOME]
    placed = Placed(model.gaussians.means.detach()[None])
    return model.tokenizer(placed, model.gaussians.opacities.detach(), query), placed, query


# --- the contracts ---


def test_its_parts_keep_theirs():
    config = composed(*SMALL)
    check_deformation(functools.partial(build, "deformation", config["deformation"]), LINKS.scene)
    check_tokenizer(build("tokenizer", config["tokenizer"], scene=LINKS.scene), LINKS.scene)


# --- the network ---


def transcribed(network, tokens, channels):
    """Rotation, scale and signal of each pair, in numpy."""
    values = {
        name: parameter.detach().double().numpy() for name, parameter in network.named_parameters()
    }

    def linear(name, x):
        return values[f"{name}.weight"] @ x + values[f"{name}.bias"]

    def relu(x):
        return np.maximum(x, 0)

    def mixed(name, transmitter, gaussian):
        return (
            values[f"{name}.links.weight"] @ transmitter
            + values[f"{name}.gaussians.weight"] @ gaussian
            + values[f"{name}.bias"]
        )

    rows = []
    for transmitter in tokens.transmitters.detach().double().numpy():
        for gaussian in tokens.gaussians.double().numpy():
            h = relu(mixed("first", transmitter, gaussian))
            for k in range(3):
                h = relu(linear(f"before.{k}", h))
            h = relu(mixed("again", transmitter, gaussian) + values["again.hidden.weight"] @ h)
            for k in range(3):
                h = relu(linear(f"behind.{k}", h))
            waves = linear("amplitude", h) * np.exp(1j * linear("phase", h))
            signal = np.concatenate((waves.real, waves.imag)) if channels % 2 == 0 else waves.real
            rows.append(np.concatenate((linear("rotation", h), linear("scale", h), signal)))
    shape = len(tokens.transmitters), len(tokens.gaussians), -1
    return np.split(np.reshape(rows, shape), [4, 7], axis=-1)


@pytest.mark.parametrize("channels", [1, 2, 6])
def test_the_network_has_eight_layers_and_heads_of_shape_and_wave(channels):
    widths = 0, 5, 4
    network = build(
        "deformation", composed(*SMALL)["deformation"], channels=channels, tokenizer_widths=widths
    )
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    tokens = build("tokenizer", composed(*SMALL)["tokenizer"], scene=LINKS.scene)(
        Placed(torch.rand(1, 7, 3)), torch.rand(7), LINKS.query[:3]
    )
    tokens = tokens._replace(
        gaussians=tokens.gaussians[:, :5], transmitters=tokens.transmitters[:, :4]
    )
    residuals = network(tokens, Placed(torch.rand(1, 7, 3)), LINKS.query[:3])
    quats, scales, signal = transcribed(network, tokens, channels)
    np.testing.assert_allclose(residuals.delta_quats.detach(), quats, atol=1e-6)
    np.testing.assert_allclose(residuals.delta_scales.detach(), scales, atol=1e-6)
    np.testing.assert_allclose(residuals.delta_signal.detach()[..., 0], signal, atol=1e-6)
    assert signal.shape == (3, 7, channels)
    assert residuals.delta_opacities is residuals.attenuations is None


def test_shapes_start_as_they_are_and_signals_differ_from_the_first_step_on():
    model = build("model", composed(*SMALL)["model"], scene=LINKS.scene)
    residuals = model.deformation(*ask(model))
    assert not residuals.delta_quats.any()
    assert not residuals.delta_scales.any()
    assert (residuals.delta_signal[0] - residuals.delta_signal[1]).abs().max() > 1e-4


# --- the rendering ---


def test_its_rendering_is_the_dense_reference(model):
    gaussians, tokens = model.gaussians, ask(model)[0]
    quats, scales, signal = map(
        torch.from_numpy, transcribed(model.deformation, tokens, channels=2)
    )
    with torch.no_grad():
        axes = semi_axes(normalize(gaussians.quats) + quats, gaussians.log_scales.exp() + scales)
        splats = model.projection.project(gaussians.means.double(), axes, LINKS.receivers[0].pose)
        opacities = gaussians.opacity_logits.sigmoid().expand(3, -1)
        # Static signal and residual, times the constant spherical harmonic.
        signal = 0.28209479 * (gaussians.signal[..., 0] + signal)
        plane = model.projection.plane(LINKS.task.directions)
        image, _ = rasterize_densely(splats, signal, opacities, None, plane)
    value = model(LINKS.batch(SOME)).value
    # A handful of pixels may stand where a splat is just cut off.
    assert ((value - torch.complex(*image.unbind(1)).abs()).abs() < 1e-4).double().mean() > 0.998
