"""WRF-GS: its network and its rendering against plain float64 transcriptions."""

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
from gaigs.core.query import Query
from gaigs.splatting.deformation.two_branch import INITIAL_ATTENUATION, LEAST_ATTENUATION
from gaigs.splatting.gaussians import Placed
from gaigs.testing import check_pooling, example_links

LINKS = example_links()
SMALL = ("model=wrf_gs", "gaussians.count=40", "deformation.width=16", "rasterizer=torch")


@pytest.fixture
def model():
    """The model of spectra, its network as after some training."""
    model = build("model", composed(*SMALL)["model"], scene=LINKS.scene)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.deformation.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
        model.deformation.attenuation.weight.mul_(50)
        model.deformation.signal.bias.add_(1.0)
        model.gaussians.log_scales.add_(0.5 * torch.randn(40, 3, generator=generator))
    return model


# --- the contracts ---


def test_its_parts_keep_theirs():
    config = composed(*SMALL)
    check_deformation(functools.partial(build, "deformation", config["deformation"]), LINKS.scene)
    check_tokenizer(build("tokenizer", config["tokenizer"], scene=LINKS.scene), LINKS.scene)
    for channels in (1, 2):

        def make(scene, channels=channels):
            return build("pooling", config["pooling"] | {"channels": channels})

        check_pooling(make, LINKS)


# --- the network ---


def features(x, octaves):
    """PE: x, and sine and cosine of 2^k x."""
    phases = [2.0**k * coordinate for coordinate in x for k in range(octaves)]
    return np.concatenate((x, np.sin(phases), np.cos(phases)))


def transcribed(network, tokens, placed, query):
    """NeRF²'s two networks, pair by pair, in numpy: signal (b, n, c), attenuations (b, n)."""
    values = {
        name: parameter.detach().double().numpy() for name, parameter in network.named_parameters()
    }

    def linear(name, x):
        return values[f"{name}.weight"] @ x + values[f"{name}.bias"]

    def relu(x):
        return np.maximum(x, 0)

    positions = [receiver.pose.position.double().numpy() for receiver in network.scene.receivers]
    signal, attenuations = [], []
    for q in range(len(query)):
        for i, mean in enumerate(placed.means[0].double().numpy()):
            u = tokens.gaussians[i].double().numpy()
            h = relu(values["first.gaussians.weight"] @ u + values["first.bias"])
            for k in range(3):
                h = relu(linear(f"before.{k}", h))
            h = (
                values["again.gaussians.weight"] @ u
                + values["again.hidden.weight"] @ h
                + values["again.bias"]
            )
            h = relu(h)
            for k in range(3):
                h = relu(linear(f"behind.{k}", h))
            opaque = 1 / (1 + np.exp(-linear("attenuation", h)[0]))
            attenuations.append(LEAST_ATTENUATION + (1 - LEAST_ATTENUATION) * opaque)
            offset = mean - positions[int(query.receivers[q])]
            view = features(offset / np.linalg.norm(offset), 10)
            parts = {
                "links": tokens.transmitters[q].double().numpy(),
                "gaussians": linear("feature", h),
                "hidden": view,
            }
            h = sum(values[f"signal_first.{name}.weight"] @ part for name, part in parts.items())
            h = relu(linear("signal_second", relu(h + values["signal_first.bias"])))
            signal.append(linear("signal", h))
    shape = len(query), placed.means.shape[1]
    return np.reshape(signal, (*shape, -1)), np.reshape(attenuations, shape)


def test_the_network_is_nerf2s(model):
    query = LINKS.query[torch.tensor([0, 1, 4])]
    placed = Placed(model.gaussians.means.detach()[None])
    tokens = model.tokenizer(placed, model.gaussians.opacities.detach(), query)
    signal, attenuations = transcribed(model.deformation, tokens, placed, query)
    residuals = model.deformation(tokens, placed, query)
    np.testing.assert_allclose(residuals.delta_signal.detach()[..., 0], signal, atol=1e-5)
    np.testing.assert_allclose(residuals.attenuations.detach(), attenuations, atol=1e-6)
    assert np.ptp(attenuations) > 0.01
    assert [part for part, value in residuals._asdict().items() if value is None] == [
        "delta_quats", "delta_scales", "delta_opacities"
    ]  # fmt: skip


def test_matter_is_the_same_for_all_and_the_signal_depends_on_the_view(model):
    places = LINKS.query.transmitters[:1].expand(2, 3)
    query = Query(places, torch.tensor([0, 1]))
    placed = Placed(model.gaussians.means.detach()[None])
    residuals = model.deformation(
        model.tokenizer(placed, model.gaussians.opacities, query), placed, query
    )
    assert torch.equal(residuals.attenuations[0], residuals.attenuations[1])
    assert (residuals.delta_signal[0] - residuals.delta_signal[1]).abs().max() > 0.01


def test_it_starts_nearly_transparent():
    model = build("model", composed(*SMALL)["model"], scene=LINKS.scene)
    placed, query = Placed(model.gaussians.means.detach()[None]), LINKS.query[:3]
    residuals = model.deformation(
        model.tokenizer(placed, model.gaussians.opacities, query), placed, query
    )
    torch.testing.assert_close(residuals.attenuations, torch.full((3, 40), INITIAL_ATTENUATION))


def test_a_gaussian_on_the_receiver_has_finite_gradients(model):
    with torch.no_grad():
        model.gaussians.means[3] = LINKS.receivers[0].pose.position
    value = model(LINKS.batch(torch.tensor([0, 2]))).value
    value.square().sum().backward()
    assert value.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


# --- the rendering ---


def test_its_rendering_is_the_dense_reference(model):
    gaussians, pose, query = (
        model.gaussians,
        LINKS.receivers[0].pose,
        LINKS.query[torch.tensor([0, 2, 4])],
    )
    placed = Placed(gaussians.means.detach()[None])
    tokens = model.tokenizer(placed, gaussians.opacities.detach(), query)
    signal, attenuations = map(
        torch.from_numpy, transcribed(model.deformation, tokens, placed, query)
    )
    with torch.no_grad():
        axes = semi_axes(normalize(gaussians.quats), gaussians.log_scales.exp())[None]
        splats = model.projection.project(gaussians.means, axes, pose)
        opacities = gaussians.opacity_logits.sigmoid().expand(3, -1)
        plane = model.projection.plane(LINKS.task.directions)
        # The network's signal in place of the constant spherical harmonic's coefficient.
        image, _ = rasterize_densely(splats, 0.28209479 * signal, opacities, attenuations, plane)
    expected = image[:, 0].clamp(0, 1)
    value = model(LINKS.batch(torch.tensor([0, 2, 4]))).value
    # A handful of pixels may stand where a splat is just cut off.
    assert ((value - expected).abs() < 1e-4).double().mean() > 0.998
    assert 0.1 < expected.mean() < 0.9


def test_spectra_are_clamped_to_the_range_of_labels():
    pooling = build("pooling", {"name": "clamped", "channels": 1})
    image = torch.tensor([-0.5, 0.0, 0.25, 1.0, 3.0]).expand(1, 1, 2, 5)
    assert pooling(image, LINKS.query[:1])[0, 0].tolist() == [0, 0, 0.25, 1, 1]
    pooling = build("pooling", {"name": "clamped", "channels": 2})
    image = torch.tensor([[-0.3, 0.0, 3.0], [0.4, 0.0, 4.0]])[None, :, None]
    torch.testing.assert_close(pooling(image, LINKS.query[:1])[0, 0], torch.tensor([0.5, 0.0, 1.0]))


def test_a_map_that_is_silent_everywhere_is_led_back():
    pooling = build("pooling", {"name": "clamped", "channels": 1})
    image = torch.tensor([-0.5, -0.5, 0.25, 3.0, 3.0]).expand(1, 1, 1, 5).clone().requires_grad_()
    pooling(image, LINKS.query[:1]).backward(
        torch.tensor([-1.0, 1.0, 1.0, 1.0, -1.0]).expand(1, 1, 5)
    )
    assert image.grad.flatten().tolist() == [-1, 0, 1, 1, 0]


# --- how it is chosen ---


def test_the_command_line_wins():
    chosen = {"deformation": "none", "tokenizer": "ga", "pooling": "array_response"}
    overrides = [f"{kind}={name}" for kind, name in chosen.items()]
    config = composed("model=wrf_gs", *overrides, "gaussians.signal=1.0")["model"]
    assert {kind: config[kind]["name"] for kind in chosen} == chosen
    assert config["gaussians"]["signal"] == 1
