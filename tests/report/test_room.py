"""The room and its Gaussians, read back from their artists."""

import numpy as np
import pytest
import torch
from matplotlib.collections import EllipseCollection, LineCollection

from gaigs.geometry import covariances
from gaigs.report.room import DRAWN, Cloud, room


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_gaussians_are_ellipses_of_one_standard_deviation():
    generator = torch.Generator().manual_seed(2)
    sigma = covariances(torch.randn(20, 4, generator=generator), 0.1 + torch.rand(20, 3, generator=generator)).double()
    means, strengths = torch.randn(20, 3, generator=generator), torch.rand(20, generator=generator)
    cloud = Cloud(means.numpy(), sigma.numpy(), strengths.numpy())
    point = np.zeros((1, 3))
    figure = room(point, point, point, np.eye(3)[None], np.zeros((0, 2, 3)), cloud)
    figure.draw_without_rendering()
    order = strengths.argsort()
    for ax, view in zip(figure.axes, ([0, 1], [0, 2]), strict=False):
        (ellipses,) = (artist for artist in ax.collections if isinstance(artist, EllipseCollection))
        np.testing.assert_allclose(ellipses.get_array(), strengths[order])  # the strongest last, so on top
        np.testing.assert_allclose(ellipses.get_offsets(), means[order][:, view])
        for k, index in enumerate(order):
            angle = np.deg2rad(ellipses.get_angles()[k])
            major = ellipses.get_widths()[k] / 2 * np.array([np.cos(angle), np.sin(angle)])
            minor = ellipses.get_heights()[k] / 2 * np.array([-np.sin(angle), np.cos(angle)])
            flat = sigma[index][view][:, view].numpy()
            np.testing.assert_allclose(np.outer(major, major) + np.outer(minor, minor), flat, rtol=1e-6, atol=1e-9)


def test_room_shows_the_strongest_gaussians_and_keeps_everyone_in_sight(rng):
    count = DRAWN + 50
    strengths = rng.permutation(count).astype(float)
    cloud = Cloud(rng.normal(0, 1, (count, 3)), np.tile(0.01 * np.eye(3), (count, 1, 1)), strengths)
    train, test, receiver = np.array([[4.0, 0, 0]]), np.array([[0, -5.0, 0]]), np.array([[0, 0, 6.0]])
    edges = np.array([[[-7.0, 0, 0], [-7.0, 1, 0]]])
    plan, side, bar = room(train, test, receiver, np.eye(3)[None], edges, cloud).axes
    ellipses = next(artist for artist in plan.collections if isinstance(artist, EllipseCollection))
    assert ellipses.get_array().min() == 50
    assert bar.get_ylabel() == f"|signal| × opacity, {DRAWN} strongest of {count} Gaussians"
    assert plan.get_xlim()[0] < -7 < 4 < plan.get_xlim()[1]
    assert plan.get_ylim()[0] < -5
    assert side.get_ylim()[1] > 6
    walls = next(artist for artist in side.collections if isinstance(artist, LineCollection))
    np.testing.assert_array_equal(walls.get_segments()[0], [[-7, 0], [-7, 0]])


def test_room_draws_the_axes_of_arrays_as_seen_from_above_and_aside():
    point, rotation = np.array([[1.0, 2, 3]]), np.array([[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]])
    plan, side = room(point + 4, point, point, rotation, np.zeros((0, 2, 3))).axes
    arrows = {text.get_text(): np.subtract(text.get_position(), text.xy) for text in plan.texts}
    assert set(arrows) == {"x", "z"}  # y points at the reader
    assert arrows["x"][0] == 0 > arrows["x"][1]
    assert arrows["z"][0] < 0 == arrows["z"][1]
    assert {text.get_text() for text in side.texts} == {"y", "z"}
    assert not room(point + 4, point, point, rotation[:0], np.zeros((0, 2, 3))).axes[0].texts
