"""GSRF: its rendering against a plain float64 transcription, its harmonics against scipy's; how
Gaussians start.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from contracts.loss import check_loss
from scipy.constants import speed_of_light
from scipy.special import factorial, lpmv, sph_harm_y
from splatting import build, composed, repository

from gaigs.core.geometry import Rays, from_spherical, to_spherical
from gaigs.core.query import Batch, Query
from gaigs.splatting import density
from gaigs.splatting.gaussians import Gaussians
from gaigs.testing import check_pooling, example_links

with repository():
    from gaigs.registry import registry

    registry("model").get("gsrf")  # which puts the package in reach
    from gaigs_gsrf.gaussians import cubic_grid, fourier_legendre
    from gaigs_gsrf.rendering import render

LINKS = example_links()
SMALL = ("model=gsrf", "model.count=60")


def model_of(task="spectrum", scene=None, pooling=None, **options):
    """The model as it is configured for a task, with other options."""
    data = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}[task]
    config = composed(f"data={data}", *SMALL)["model"] | options
    if pooling is not None:
        config["pooling"] = pooling
    return build("model", config, scene=scene or example_links(task).scene)


def as_trained(model):
    """The model with Gaussians of many shapes, strengths and phases, in float64."""
    generator = torch.Generator().manual_seed(1)
    gaussians = model.double().gaussians
    with torch.no_grad():
        for name, size in {"log_scales": 0.5, "opacity_logits": 4.0, "phases": 2.0}.items():
            parameter = getattr(gaussians, name)
            parameter.add_(
                size * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            )
    return model


# --- the contracts ---


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_its_loss_keeps_the_contract_of_losses(task):
    links = example_links(task)
    check_loss(build("loss", {"name": "gsrf"}, task=links.task), links)


def test_its_loss_refuses_channels():
    with pytest.raises(ValueError, match="loss 'gsrf' takes spectra or levels, got complex labels"):
        build("loss", {"name": "gsrf"}, task=example_links("csi").task)


def test_its_pooling_keeps_the_contract_of_poolings():
    check_pooling(
        lambda scene: build("pooling", {"name": "mean_amplitude", "grid": [3, 8]}),
        example_links("rssi"),
    )


# --- the series ---


def directions(count):
    """Unit vectors, the poles among them."""
    vectors = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vectors[:2] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_the_series_is_of_normalised_legendre_functions():
    vectors, degree = directions(30), 15
    found = fourier_legendre(vectors, degree).numpy()
    azimuths, elevations, _ = (angle.numpy() for angle in to_spherical(vectors))
    for l in range(degree + 1):  # noqa: E741
        for m in range(-l, l + 1):
            expected = sph_harm_y(l, m, math.pi / 2 - elevations, azimuths)
            np.testing.assert_allclose(found[:, l**2 + l + m], expected, rtol=0, atol=1e-12)


def test_the_series_has_finite_gradients_at_the_poles():
    def series(vectors):
        return torch.view_as_real(fourier_legendre(vectors, 3))

    assert torch.autograd.gradcheck(series, directions(4).requires_grad_())


# --- the rendering ---


def transcribed_radiance(gaussians, transmitter, degree):
    """psi_i on each complex channel, Gaussian by Gaussian."""
    radiance = []
    for mean, signal in zip(gaussians.means.numpy(), gaussians.signal.numpy(), strict=True):
        x, y, z = (transmitter - mean) / np.linalg.norm(transmitter - mean)
        azimuth, half = math.atan2(y, x), len(signal) // 2
        coefficients = signal[:half] + 1j * signal[half:]
        total, number = 0, 0
        for l in range(degree + 1):  # noqa: E741
            for m in range(-l, l + 1):
                k = abs(m)
                norm = math.sqrt((2 * l + 1) / (4 * math.pi) * factorial(l - k) / factorial(l + k))
                sign = (-1) ** k if m < 0 else 1
                term = sign * norm * lpmv(k, l, z) * np.exp(1j * m * azimuth)
                total = total + coefficients[:, number] * term
                number += 1
        radiance.append(total)
    return np.array(radiance)


def transcribed_map(gaussians, radiance, pose, rays, radius):
    """The complex map, ray by ray, front to back."""
    receiver, turn = pose.position.double().numpy(), pose.rotation.double().numpy()
    covariances = gaussians.covariances.numpy()
    offsets = gaussians.means.numpy() - receiver
    distances = np.linalg.norm(offsets, axis=1)
    found = np.zeros((radiance.shape[1], len(rays)), complex)
    for r, ray in enumerate(rays):
        transmittance = 1
        for i in np.argsort(distances):
            d = radius * (turn @ ray) - radius * offsets[i] / distances[i]
            w = math.exp(-d @ np.linalg.inv(covariances[i]) @ d / 2)
            alpha = min(0.99, w / (1 + math.exp(-gaussians.opacity_logits[i])))
            found[:, r] += radiance[i] * alpha * transmittance
            transmittance *= (1 - alpha) * np.exp(1j * gaussians.phases[i].item() * w)
    return found


@pytest.mark.parametrize(("task", "degree"), [("spectrum", 3), ("spectrum", 5), ("csi", 2)])
@torch.no_grad()
def test_the_rendering_equation_is_the_published_one(task, degree):
    model = as_trained(model_of(task, degree=degree))
    gaussians, place = model.gaussians, torch.tensor([[2.0, 1.5, 0.7]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    angles = torch.rand(2, 9, generator=generator, dtype=torch.float64) * torch.tensor(
        [[math.tau], [1.5]]
    )
    rays = from_spherical(*angles)
    radiance = gaussians.radiance(place)
    expected = transcribed_radiance(gaussians, place[0].numpy(), degree)
    np.testing.assert_allclose(radiance[0].numpy(), expected, rtol=0, atol=1e-12)
    for receiver in model.scene.receivers:
        pose = receiver.pose.to(place)
        found = render(gaussians, radiance, pose, rays, 0.307)[0].numpy()
        by_hand = transcribed_map(gaussians, expected, pose, rays.numpy(), 0.307)
        np.testing.assert_allclose(found, by_hand, rtol=0, atol=1e-10)
        assert np.abs(by_hand).max() > 0.1


@torch.no_grad()
def test_a_spectrum_is_the_magnitude_of_the_map():
    model = as_trained(model_of())
    elevations, azimuths = (
        torch.tensor([0.2, 1.1, 0.9]).double(),
        torch.tensor([0.1, 3.0, 6.1]).double(),
    )
    query = Query(torch.tensor([[2.0, 1.5, 0.7]]).double(), torch.tensor([1]))
    (value,) = model(Batch(query, Rays(elevations, azimuths))).value
    radiance = transcribed_radiance(model.gaussians, query.transmitters[0].numpy(), 3)
    rays, pose = (
        from_spherical(azimuths, elevations).numpy(),
        LINKS.receivers[1].pose.to(elevations),
    )
    expected = np.abs(transcribed_map(model.gaussians, radiance, pose, rays, 0.307)[0])
    np.testing.assert_allclose(value.numpy(), expected, rtol=0, atol=1e-10)


@torch.no_grad()
def test_a_level_is_that_of_the_mean_amplitude():
    model = as_trained(model_of("rssi"))
    query = Query(torch.tensor([[2.0, 1.5, 0.7]]).double(), torch.tensor([0]))
    radiance = model.gaussians.radiance(query.transmitters)
    vectors = model.pooling.grid.flatten().to(radiance.real).vectors()
    waves = render(model.gaussians, radiance, model.scene.receivers[0].pose, vectors, 0.307)
    expected = 100 * (waves.abs().mean() - 1)  # an amplitude of 0 is -100 dBm, one of 1 is 0 dBm
    torch.testing.assert_close(model(Batch(query)).value[0], expected)


@torch.no_grad()
def test_a_channel_has_a_wave_for_each_subcarrier():
    model = model_of("csi")
    subcarriers = len(model.scene.task.frequencies)
    assert model.gaussians.signal.shape[1:] == (2 * subcarriers, 16)
    query = example_links("csi").query[:1]
    first = model(Batch(query)).value
    model.gaussians.signal[:, 2] += 1.0  # the real part of the third subcarrier
    changed = (model(Batch(query)).value - first).abs().amax((0, 1)) > 1e-6
    assert changed.tolist() == [k == 2 for k in range(subcarriers)]


# --- edges ---


def require_finite_gradients(model, query):
    value = model(Batch(query, model.scene.task.directions)).value
    gradients = torch.autograd.grad(value.sum(), [*model.parameters()])
    assert value.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_gaussians_on_receiver_and_transmitter_do_no_harm():
    model, query = model_of(), LINKS.query[:2]
    with torch.no_grad():
        model.gaussians.means[0] = LINKS.receivers[0].pose.position
        model.gaussians.means[1] = query.transmitters[0]
    require_finite_gradients(model, query)


@pytest.mark.parametrize("log_scale", [-300.0, -12.0, 300.0])
def test_footprints_of_any_width_do_no_harm(log_scale):
    model = model_of()
    with torch.no_grad():
        model.gaussians.log_scales[::3] = log_scale
        model.gaussians.opacity_logits[::2] = 50.0
    require_finite_gradients(model, LINKS.query[:2])


# --- where they start ---


def test_the_grid_has_the_published_pitch_over_the_room():
    scene = example_links(carrier=1e9).scene
    points = cubic_grid(scene, 50_000, 1.85, 0.25)
    corners = torch.cat((scene.lower[None], scene.upper[None], scene.positions(scene.lower)))
    lower, upper = corners.amin(0), corners.amax(0)
    margin = 0.25 * (upper - lower).max()
    pitch = 1.85 * speed_of_light / 1e9
    for axis in range(3):
        places = points[:, axis].unique()
        torch.testing.assert_close(places.diff(), torch.full_like(places[1:], pitch))
        assert lower[axis] - margin <= places[0] <= lower[axis] - margin + pitch / 2
        assert upper[axis] + margin >= places[-1] >= upper[axis] + margin - pitch / 2
    assert len(cubic_grid(scene, 100, 1.85, 0.25)) in range(50, 101)


@pytest.mark.parametrize("frequencies", [torch.zeros(0), torch.tensor([1e12])])
def test_the_count_bounds_a_grid_of_unknown_or_short_wavelengths(frequencies):
    scene = replace(LINKS.scene, frequencies=frequencies)
    assert len(cubic_grid(scene, 1000, 1.85, 0.25)) in range(600, 1001)


def test_all_of_the_grid_that_labels_show_is_there_and_nothing_else():
    model = model_of(count=400)
    grid, low = cubic_grid(LINKS.scene, 400, 1.85, 0.25), LINKS.task.directions.elevations[0]
    is_seen = torch.stack(
        [to_spherical(r.pose.local(grid))[1] >= low for r in LINKS.receivers]
    ).any(0)
    assert 0 < len(model.gaussians) == is_seen.sum() < len(grid)
    assert len(model_of("rssi", count=400).gaussians) == len(
        cubic_grid(LINKS.scene, 400, 1.85, 0.25)
    )


def test_density_control_keeps_each_phase_with_its_gaussian():
    gaussians = model_of().gaussians
    with torch.no_grad():
        gaussians.phases.copy_(gaussians.means[:, 0])
    optimizer = torch.optim.Adam(gaussians.parameters())
    count, chosen = len(gaussians), torch.arange(len(gaussians)) < 5
    density.clone(gaussians, optimizer, chosen)
    density.prune(gaussians, optimizer, torch.arange(count + 5) % 7 == 0)
    assert len(gaussians.phases) == len(gaussians) < count + 5
    torch.testing.assert_close(gaussians.phases, gaussians.means[:, 0])
    assert set(gaussians.PARAMETERS) - set(Gaussians.PARAMETERS) == {"phases"}


# --- the loss ---


def test_spectra_have_the_three_published_terms():
    batch = LINKS.batch(torch.tensor([0, 1, 2]))
    values = torch.rand(batch.labels.shape, generator=torch.Generator().manual_seed(0))
    loss, terms = build("loss", {"name": "gsrf"}, task=LINKS.task)(values, batch)
    errors = values - batch.labels
    fourier = torch.fft.fft2(errors.double(), norm="ortho").abs().square().mean().float()
    torch.testing.assert_close(terms["fourier"], fourier)
    torch.testing.assert_close(terms["l1"], errors.abs().mean())
    windows = [
        part.unfold(1, 11, 1).unfold(2, 11, 1).flatten(3).double()
        for part in (values, batch.labels)
    ]
    (mx, vx), (my, vy) = ((part.mean(-1), part.var(-1)) for part in windows)
    covariance = ((windows[0] - mx[..., None]) * (windows[1] - my[..., None])).sum(-1) / 120
    similarity = (
        (2 * mx * my + 1e-4) * (2 * covariance + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    )
    torch.testing.assert_close(terms["ssim"], 1 - similarity.mean().float(), rtol=0, atol=1e-5)
    torch.testing.assert_close(
        loss, 0.44 * terms["l1"] + 0.37 * terms["ssim"] + 0.19 * terms["fourier"]
    )


def test_levels_have_the_squared_error_of_amplitudes():
    links = example_links("rssi")
    batch = links.batch(torch.arange(4))
    loss, _ = build("loss", {"name": "gsrf"}, task=links.task)(
        batch.labels + torch.tensor([10.0, 0, -10, 0]), batch
    )
    torch.testing.assert_close(loss, torch.tensor(0.005))


def test_single_directions_have_no_window():
    batch = LINKS.batch(torch.arange(2))
    rays = replace(
        batch, directions=batch.directions.flatten()[:5], labels=batch.labels.flatten(1)[:, :5]
    )
    with pytest.raises(ValueError, match="'gsrf' needs rows and columns"):
        build("loss", {"name": "gsrf"}, task=LINKS.task)(rays.labels, rays)
