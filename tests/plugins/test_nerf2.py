"""NeRF²: its sums along rays against float64 transcriptions of the published equations; networks,
tasks, refusals.
"""

import cmath
import functools
import math
import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from splatting import build, composed
from torch import nn

import gaigs
from gaigs.core.geometry import Grid, Rays
from gaigs.core.query import Batch
from gaigs.testing import example_links

SMALL = (
    "model=nerf2",
    "model.samples=4",
    "model.rays=[2,4]",
    "model.octaves=2",
    "model.width=8",
    "model.layers=3",
)
LIGHT = 299792458.0
TASKS = ("spectrum", "rssi", "csi")


@functools.cache
def options():
    return composed(*SMALL)["model"]


def make(scene, **changes):
    return build("model", options() | changes, scene=scene)


@pytest.fixture
def package():
    """The module that has the model."""
    return sys.modules[type(make(example_links().scene)).__module__]


# --- the sums ---


def given(package, scene, links, rays, seed=0, **changes):
    """A model with random numbers at its samples, and the arguments of its last call."""
    asked = SimpleNamespace()

    class Given(package.RayMarching):
        def sample(self, query, points, views):
            asked.points, asked.views = points, views
            return self.samples

    arguments = {"samples": 7, "far": 3.5, "rays": [2, 4], "frequency": 2.4e9} | changes
    model = Given(scene, **arguments)
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    along, sent = (rays, 7), (links, rays, 7, model.reading.channels)
    # Up to opaque within a step, and many turns.
    model.samples = package.Samples(
        20 * random(*along), 40 * random(*along), random(*sent), 7 * random(*sent)
    )
    return model, asked


def along(samples, b, r, c, factor):
    """sum_i s_i e^{j phi_i} T_i phase_i factor(t_i), sample by sample from the receiver."""
    attenuations, turns, amplitudes, phases = (part.double() for part in samples)
    d = 0.5
    total, passed, turned = 0j, 1.0, 1 + 0j
    for i in range(7):
        t = (i + 0.5) * d
        sent = amplitudes[b, r, i, c].item() * cmath.exp(1j * phases[b, r, i, c].item())
        total += sent * passed * turned * factor(t)
        alpha = 1 - math.exp(-attenuations[r, i].item() * d)
        passed *= 1 - alpha
        turned *= cmath.exp(1j * turns[r, i].item() * d)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_spectra_are_the_published_sum(package, seed):
    links = example_links()
    batch = Batch(links.query[torch.tensor([0, 2, 4])], Rays(torch.rand(5), 6 * torch.rand(5)))
    model, _ = given(package, links.scene, 3, 5, seed)
    expected = [
        [abs(along(model.samples, b, r, 0, lambda t: 0.025 / t)) for r in range(5)]
        for b in range(3)
    ]
    torch.testing.assert_close(
        model(batch).value.double(), torch.tensor(expected).double(), rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("carrier", [None, 5e9])
def test_levels_are_the_published_sum(package, seed, carrier):
    links = example_links("rssi", carrier)
    batch = Batch(links.query[torch.tensor([0, 2, 4])])
    model, _ = given(package, links.scene, 3, 8, seed)
    length = LIGHT / (carrier or 2.4e9)

    def factor(t):
        return cmath.exp(2j * math.pi * t / length)

    sums = [sum(along(model.samples, b, r, 0, factor) for r in range(8)) for b in range(3)]
    expected = torch.tensor([100 * (abs(total) - 1) for total in sums])
    torch.testing.assert_close(model(batch).value, expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_channels_are_the_sum_at_each_element(package, sign):
    links = example_links("csi")
    query = links.query[torch.tensor([1, 3, 5])]  # of the second receiver
    model, _ = given(package, links.scene, 3, 8)
    model.reading.sign.fill_(sign)
    model.reading.array_sign.fill_(sign or 1)
    receiver, grid = links.receivers[1], Grid.sphere(2, 4).flatten()
    views, elements = grid.vectors().double(), receiver.array.elements.double()
    expected = torch.zeros(3, 4, 5, dtype=torch.complex128)
    for b in range(3):
        distance = (query.transmitters[b] - receiver.pose.position).double().norm().item()
        for c, frequency in enumerate(links.task.frequencies.tolist()):
            k = 2 * math.pi * frequency / LIGHT
            sums = [
                along(model.samples, b, r, c, lambda t, k=k: cmath.exp(1j * k * t))
                for r in range(8)
            ]
            direct = cmath.exp(1j * sign * k * distance) / (2 * k * distance)
            for e in range(4):
                steered = (
                    cmath.exp(-1j * k * (elements[e] @ views[r]).item()) * sums[r] for r in range(8)
                )
                total = sum(steered)
                expected[b, e, c] = direct * (total if (sign or 1) > 0 else total.conjugate())
    torch.testing.assert_close(
        model(Batch(query)).value, expected.to(torch.complex64), rtol=0, atol=1e-5
    )


def test_samples_stand_in_the_middles_of_steps_along_the_rays(package):
    links = example_links()
    model, asked = given(package, links.scene, 1, 2)
    model(Batch(links.query[:1], Rays(torch.tensor([0.3, 1.0]), torch.tensor([2.0, 5.0]))))
    pose = links.receivers[0].pose
    for r, (elevation, azimuth) in enumerate([(0.3, 2.0), (1.0, 5.0)]):
        horizontal = math.cos(elevation)
        own = [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)]
        view = pose.rotation @ torch.tensor(own)
        torch.testing.assert_close(asked.views[r], view)
        for i in range(7):
            place = pose.position + 0.5 * (i + 0.5) * view
            torch.testing.assert_close(
                asked.points[r, i] + (links.scene.lower + links.scene.upper) / 2, place
            )


def test_rays_end_at_the_farthest_corner(package):
    scene = example_links().scene
    model, _ = given(package, scene, 1, 1, far=None)
    places = torch.cat((scene.positions(scene.lower), scene.lower[None], scene.upper[None]))
    corners = torch.cartesian_prod(*torch.stack((places.amin(0), places.amax(0)), 1))
    expected = torch.cdist(scene.positions(scene.lower), corners).max().item()
    assert 7 * model.step == pytest.approx(expected, rel=1e-6)


def test_gradients_are_finite_where_nothing_is_sent(package):
    for task in TASKS:
        links = example_links(task)
        model = make(links.scene)
        with torch.no_grad():
            for parameter in model.send[-1].parameters():
                parameter.zero_()
        model(links.batch(torch.arange(4))).value.abs().square().sum().backward()
        assert all(
            parameter.grad.isfinite().all()
            for parameter in model.parameters()
            if parameter.grad is not None
        )


# --- the networks ---


def test_the_networks_are_the_published_ones(package):
    scene = example_links().scene
    model = make(scene, octaves=3, width=6, layers=8).double()
    query = example_links().query[:2]
    query = replace(query, transmitters=query.transmitters.double())
    points, views = (
        torch.randn(4, 5, 3).double(),
        nn.functional.normalize(torch.randn(4, 3).double(), dim=-1),
    )

    def encode(x):
        waves = [
            [f(2**k * x[..., a]) for a in range(3) for k in range(3)]
            for f in (torch.sin, torch.cos)
        ]
        return torch.cat((x, *(torch.stack(each, -1) for each in waves)), -1)

    found = model.sample(query, points, views)
    u = encode(points)
    h = u
    for number, layer in enumerate(model.layers):
        h = torch.relu(layer(torch.cat((u, h), -1) if number == 4 else h))
    a, p = model.attenuate(h).unbind(-1)
    torch.testing.assert_close(found.attenuations, torch.where(a > 0, a, -0.01 * a))
    torch.testing.assert_close(found.turns, 2 * math.pi / (1 + torch.exp(-p)))
    for b in range(2):
        tx = encode(query.transmitters[b] - (scene.lower + scene.upper).double() / 2)
        joint = torch.cat(
            (model.feature(h), encode(views)[:, None].expand(-1, 5, -1), tx.expand(4, 5, -1)), -1
        )
        s, phi = model.send(torch.relu(model.join(joint))).unbind(-1)
        torch.testing.assert_close(found.amplitudes[b, ..., 0], torch.where(s > 0, s, -0.01 * s))
        torch.testing.assert_close(found.phases[b, ..., 0], 2 * math.pi / (1 + torch.exp(-phi)))


def test_published_sizes():
    model = make(example_links().scene, octaves=10, width=256, layers=8)

    def count(*sizes):
        return sum(a * b + b for a, b in pairwise(sizes))

    first = (
        count(63, 256, 256, 256, 256)
        + count(63 + 256, 256, 256, 256, 256)
        + count(256, 2)
        + count(256, 256)
    )
    second = count(256 + 63 + 63, 256, 128, 2)
    assert sum(parameter.numel() for parameter in model.parameters()) == first + second


# --- training and memory ---


@pytest.mark.parametrize("task", TASKS)
def test_it_starts_at_the_mean_amplitude(task):
    links = example_links(task)
    links = replace(links, labels=5 * links.labels if task == "csi" else links.labels)
    model = make(links.scene)
    model.fit(links)
    batch = links.batch(links.split.train)  # 16 of them, as many as it looks at

    def amplitudes(values):
        return model.reading.amplitudes(values, batch.query).mean()

    with torch.no_grad():
        torch.testing.assert_close(
            amplitudes(model(batch).value), amplitudes(batch.labels), rtol=0.1, atol=0
        )


@pytest.mark.parametrize("task", TASKS)
def test_little_is_evaluated_at_a_time(task, monkeypatch):
    links = example_links(task)
    model = make(links.scene)
    batch = links.batch(torch.arange(11))
    whole, pairs = model.evaluate(batch), []
    sample = model.sample

    def spied(query, points, views):
        pairs.append(len(query) * len(views))
        return sample(query, points, views)

    monkeypatch.setattr(model, "sample", spied)
    model.chunk = 50
    torch.testing.assert_close(model.evaluate(batch), whole, rtol=1e-4, atol=1e-4)
    assert 8 <= max(pairs) <= 50


def test_any_receiver_is_at_the_start_of_its_rays(tmp_path):
    links = example_links("rssi")
    model = make(links.scene)
    model.fit(links)
    known = links.receivers[1]
    other = model.at_receivers([replace(known, name="new")])
    places = links.query.transmitters[:3]
    torch.testing.assert_close(other.predict(places)[:, 0], model.predict(places, receiver=1))
    other.save(tmp_path / "moved.ckpt")  # rays are as long as those of the training
    torch.testing.assert_close(
        gaigs.load(tmp_path / "moved.ckpt").predict(places), other.predict(places)
    )
