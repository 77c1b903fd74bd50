"""SwiftWRF: its sum and its network against plain float64 transcriptions."""

import math
import sys

import numpy as np
import pytest
import torch
from splatting import build, composed

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, Query
from gaigs.testing import example_links

LINKS = example_links()
SCENE = LINKS.scene
SMALL = ("model=swift_wrf", "model.count=40", "model.width=16", "model.layers=3")
SOME = torch.tensor([0, 1, 2, 5])


def make(scene=SCENE, seed=0, **options):
    return build("model", composed(*SMALL)["model"] | options, seed, scene=scene)


@pytest.fixture
def model():
    """The model as after some training."""
    model = make()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return model


# --- the sum ---


def added_up(gaussians, directions):
    """The sum, direction by direction and Gaussian by Gaussian, in numpy."""
    grid = directions.flatten()
    pixel = np.eye(2) * SCENE.task.directions.pitch**2 / 12
    spectra = []
    for means, factors, amplitudes in zip(
        *(part.detach().double().numpy() for part in gaussians), strict=True
    ):
        for azimuth, elevation in zip(
            grid.azimuths.double().numpy(), grid.elevations.double().numpy(), strict=True
        ):
            value = 0.0
            for mean, (p, q, r), amplitude in zip(means, factors, amplitudes, strict=True):
                factor = np.array([[p, 0], [q, r]])
                turns = np.round((azimuth - mean[0]) / (2 * np.pi))
                x = np.array([azimuth - mean[0] - 2 * np.pi * turns, elevation - mean[1]])
                value += amplitude * np.exp(-x @ np.linalg.inv(factor @ factor.T + pixel) @ x / 2)
            spectra.append(value)
    return np.reshape(spectra, (-1, *directions.shape))


def test_the_value_is_the_plain_sum(model):
    grid = Grid.degrees(range(4, 90, 17), range(0, 360, 30))
    batch = Batch(LINKS.query[SOME], grid)
    expected = added_up(model.deform(batch.query), grid)
    np.testing.assert_allclose(model(batch).value.detach(), expected, atol=1e-5)
    assert np.ptp(expected) > 0.1
    rays = grid.flatten()[torch.tensor([31, 7, 12])]
    found = model(Batch(batch.query, rays)).value.detach()
    np.testing.assert_allclose(found, expected.reshape(4, -1)[:, [31, 7, 12]], atol=1e-5)


def test_azimuth_wraps(model):
    grid, gaussians = (
        Grid.degrees(range(4, 90, 17), range(0, 360, 30)),
        model.deform(LINKS.query[SOME]),
    )
    turned = gaussians._replace(means=gaussians.means - torch.tensor([6 * math.pi, 0.0]))
    add_up = sys.modules[type(model).__module__].add_up
    here, there = (add_up(each, grid, model.pixel_variance) for each in (gaussians, turned))
    torch.testing.assert_close(there, here, rtol=0, atol=1e-4)


def test_gaussians_without_extent_have_the_pixels_and_finite_gradients(model):
    with torch.no_grad():
        model.factors.zero_()
        for parameter in model.heads["factors"].parameters():
            parameter.zero_()
    value = model(LINKS.batch(SOME)).value
    value.square().sum().backward()
    assert value.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())


# --- the network ---


def features(x, frequencies):
    phases = [frequency * coordinate for coordinate in x for frequency in frequencies]
    return np.concatenate((x, np.sin(phases), np.cos(phases)))


def test_the_network_moves_stretches_and_weighs_each_receivers_own_gaussians(model):
    query = LINKS.query[SOME]
    found = model.deform(query)
    values = {
        name: parameter.detach().double().numpy() for name, parameter in model.named_parameters()
    }

    def linear(name, x):
        return values[f"{name}.weight"] @ x + values[f"{name}.bias"]

    middle = ((SCENE.lower + SCENE.upper) / 2).double().numpy()
    for k, (place, receiver) in enumerate(
        zip(query.transmitters.double().numpy(), query.receivers, strict=True)
    ):
        sends = features(place - middle, model.frequencies.double().numpy())
        link = np.concatenate((np.eye(2)[receiver], sends))
        for i in range(0, 40, 7):
            mean = values["means"][receiver, i]
            h = values["first.links.weight"] @ link
            h = (
                h
                + values["first.gaussians.weight"] @ features(mean, 2.0 ** np.arange(5))
                + values["first.bias"]
            )
            for layer in range(2):
                h = linear(f"rest.{layer}", np.maximum(h, 0))
            h = np.maximum(h, 0)
            for name in ("means", "factors", "amplitudes"):
                own, moved = values[name][receiver, i], getattr(found, name)[k, i].detach()
                np.testing.assert_allclose(
                    np.atleast_1d(moved), np.atleast_1d(own) + linear(f"heads.{name}", h), atol=1e-5
                )


def test_gaussians_start_undeformed_over_the_labels_directions_and_meet():
    model = make(count=200)
    here, there = (
        model.deform(Query(SCENE.lower[None], torch.tensor([0]))),
        model.deform(LINKS.query[:1]),
    )
    assert torch.equal(here.means, there.means)
    assert torch.equal(here.factors, there.factors)
    assert (here.amplitudes - there.amplitudes).abs().max() > 1e-3
    grid = SCENE.task.directions
    assert here.means[..., 1].min() >= grid.elevations.min() - 1e-5
    assert here.means[..., 1].max() <= grid.elevations.max() + 1e-5
    with torch.no_grad():
        model.heads["amplitudes"].weight.zero_()
        model.heads["amplitudes"].bias.fill_(1.0)
    covered = model(Batch(LINKS.query[:1], grid)).value
    assert covered.min() > 1.0  # each direction is within reach of several


# --- timing ---


def test_the_timed_rendering_is_the_sum(model):
    batch = LINKS.batch(SOME)
    torch.testing.assert_close(model.rendering(batch)(), model(batch).value)
