"""NeRF-APT: its U-Net against plain convolutions, its grid of rays, its tasks and refusals; and
that it finds NeRF².
"""

import functools
import itertools
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from splatting import build, composed
from torch import nn

from gaigs.core.geometry import Grid, Rays
from gaigs.core.query import Batch
from gaigs.core.task.spectrum import Spectrum
from gaigs.testing import example_links

SMALL = (
    "model=nerf_apt",
    "model.samples=4",
    "model.rays=[3,8]",
    "model.octaves=2",
    "model.widths=[2,3,4]",
)
LINKS = example_links()


@functools.cache
def options():
    return composed(*SMALL)["model"]


def make(scene=LINKS.scene, **changes):
    return build("model", options() | changes, scene=scene)


@pytest.fixture
def package():
    """The module that has the model."""
    return sys.modules[type(make()).__module__]


# --- the U-Net ---


def convolved(image, weight, bias):
    """3 x 3 over (rays, samples), place by place: rays close a circle, beyond the samples there is
    nothing.
    """
    _, rays, samples = image.shape
    result = np.zeros((len(weight), rays, samples))
    for out, r, i in itertools.product(range(len(weight)), range(rays), range(samples)):
        result[out, r, i] = bias[out]
        for dr, di in itertools.product((-1, 0, 1), repeat=2):
            if 0 <= i + di < samples:
                result[out, r, i] += (
                    weight[out, :, dr + 1, di + 1] @ image[:, (r + dr) % rays, i + di]
                )
    return result


def test_convolutions_go_around_the_circle(package):
    convolution = sys.modules["gaigs_nerf_apt.unet"].Convolution(2, 3).double()
    image = torch.randn(2, 5, 4, dtype=torch.float64)
    weight, bias = (parameter.detach().numpy() for parameter in convolution.parameters())
    found = convolution(image[None])[0].detach().numpy()
    np.testing.assert_allclose(found, convolved(image.numpy(), weight, bias), atol=1e-12)


def test_the_parts_of_the_u_net_are_the_published_ones(package):
    unet = sys.modules["gaigs_nerf_apt.unet"]
    image = torch.randn(2, 4, 8, 4, dtype=torch.float64)
    pyramid = unet.Pyramid(4).double()
    whole, quarters = (
        image.mean((2, 3), keepdim=True),
        image.unflatten(3, (2, 2)).unflatten(2, (2, 4)).mean((3, 5)),
    )
    levels = [
        nn.functional.interpolate(level(means), (8, 4), mode="bilinear")
        for level, means in zip(pyramid.levels, (whole, quarters), strict=True)
    ]
    expected = pyramid.join(torch.cat((image, *levels), 1))
    torch.testing.assert_close(pyramid(image), expected)
    gate, asked = unet.Gate(4).double().eval(), torch.randn(2, 4, 8, 4, dtype=torch.float64)
    weights = gate.weigh[1](torch.relu(gate.ask(asked) + gate.offer(image)))
    weights = 1 / (
        1 + torch.exp(-weights / math.sqrt(1 + 1e-5))
    )  # of an untrained batch normalisation
    torch.testing.assert_close(gate(asked, image), image * weights)


def test_every_place_sees_a_change_at_any_other(package):
    """By the pyramid's mean over the whole image."""
    net = sys.modules["gaigs_nerf_apt.unet"].UNet(2, 3, [4, 4, 4]).double().eval()
    image = torch.randn(1, 2, 40, 40, dtype=torch.float64)
    changed = image.clone()
    changed[0, :, 0, 0] += 10
    assert ((net(changed) - net(image)).abs().amax(1) > 0).all()


def test_inputs_alike_all_over_an_image_shift_the_first_convolution(package):
    net = sys.modules["gaigs_nerf_apt.unet"].UNet(2, 3, [4, 5, 6]).eval()
    images, shifts = torch.randn(3, 2, 8, 4), torch.randn(2, 4)
    found = net(images, shifts).unflatten(0, (2, 3))
    for b in range(2):
        with torch.no_grad():
            net.first.bias.add_(shifts[b])
        torch.testing.assert_close(found[b], net(images))
        with torch.no_grad():
            net.first.bias.sub_(shifts[b])


def test_published_sizes():
    model = make(octaves=10, widths=[64, 128, 256])

    def double(inputs, width):
        return 9 * inputs * width + width + 9 * width**2 + width + 4 * width

    def gate(c):
        return 2 * (c * (c // 2) + c // 2 + 2 * (c // 2)) + c // 2 + 1 + 2

    def up(inputs, outputs):
        return 4 * inputs * outputs + outputs

    pyramid = 2 * (256 * 128 + 128) + 512 * 256 + 256

    def count(inputs, outputs):
        down = double(inputs, 64) + double(64, 128) + double(128, 256) + pyramid
        back = (
            up(256, 128) + gate(128) + double(256, 128) + up(128, 64) + gate(64) + double(128, 64)
        )
        return down + back + 64 * outputs + outputs

    expected = count(63, 66) + count(64 + 63, 2) + 63 * 64
    assert sum(parameter.numel() for parameter in model.parameters()) == expected


# --- rays ---


def test_images_are_the_rays_of_one_elevation(package):
    values = torch.arange(3 * 8 * 4 * 2).reshape(24, 4, 2)
    images = package.as_images(values, 3)
    assert images.shape == (3, 2, 8, 4)
    assert torch.equal(images[1, :, 5, 2], values[1 * 8 + 5, 2])
    assert torch.equal(
        package.as_samples(torch.cat((images, -images)), 3), torch.stack((values, -values))
    )


def test_the_grid_spans_the_labels_directions(package):
    grid = make().grid
    torch.testing.assert_close(grid.elevations.rad2deg(), torch.tensor([4.0, 46.5, 89.0]))
    torch.testing.assert_close(grid.azimuths.rad2deg(), 45.0 * torch.arange(8))
    assert make(example_links("rssi").scene).grid.shape == (3, 8)


def test_spectra_are_interpolated_from_the_grid(package):
    model, generator = make().eval(), torch.Generator().manual_seed(0)
    azimuths = 8 * torch.rand(50, generator=generator) - 1  # the circle, and beyond its seam
    elevations = torch.deg2rad(4 + 85 * torch.rand(50, generator=generator))
    batch = Batch(LINKS.query[torch.tensor([0, 2])], Rays(elevations, azimuths))
    with torch.no_grad():
        found, marched = model(batch).value, model(Batch(batch.query, model.grid)).value
    periodic = np.pad(marched.numpy(), ((0, 0), (0, 0), (0, 1)), mode="wrap")
    places = np.stack((elevations.numpy(), azimuths.numpy() % (2 * math.pi)), -1)
    for value, image in zip(found.numpy(), periodic, strict=True):
        axes = model.grid.elevations.numpy(), np.linspace(0, 2 * math.pi, 9)
        expected = RegularGridInterpolator(axes, image, bounds_error=False, fill_value=None)(places)
        np.testing.assert_allclose(value, expected, rtol=1e-3, atol=1e-5)


def test_directions_beyond_the_labels_get_the_nearest_ones():
    model = make().eval()

    def values(degrees):
        return model.predict(
            LINKS.query.transmitters[:1], directions=Grid.degrees([degrees], [10, 100])
        )

    torch.testing.assert_close(values(-20), values(4))
    torch.testing.assert_close(values(90), values(89))


def test_a_label_of_one_elevation():
    task = Spectrum(torch.tensor([0.5]), 2 * math.pi / 36 * torch.arange(36), "none")
    links = replace(LINKS, task=task, labels=LINKS.labels[:, :1])
    model = make(links.scene)
    model.fit(links)
    assert model.predict(links.query.transmitters[:3]).isfinite().all()


# --- training ---


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_a_trained_models_links_do_not_depend_on_each_other(task):
    links = example_links(task)
    model, batch = make(links.scene), links.batch(torch.arange(8))
    alone = replace(batch, query=batch.query[:1])
    model.train()
    together, lonely = model(batch).value[:1], model(alone).value
    assert (together - lonely).abs().max() > 1e-3 * lonely.abs().max(), "batch normalisation"
    model.eval()
    torch.testing.assert_close(model(batch).value[:1], model(alone).value, rtol=1e-4, atol=1e-5)
