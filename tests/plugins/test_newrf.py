"""NeWRF: its sum against a float64 transcription of the published equation, the arrivals it finds,
and its refusals.
"""

import cmath
import functools
import itertools
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from splatting import build, composed

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Batch, Query
from gaigs.core.task.csi import Csi
from gaigs.data.synthetic import respond_in_parts
from gaigs.data.synthetic.image_source import Room
from gaigs.testing import example_links

SMALL = (
    "model=newrf",
    "model.arrivals=3",
    "model.samples=4",
    "model.octaves=2",
    "model.width=8",
    "model.layers=5",
)
LIGHT = 299792458.0
LINKS = example_links("csi")


@functools.cache
def options():
    return composed("data=synthetic_csi", *SMALL)["model"]


def make(scene=LINKS.scene, **changes):
    return build("model", options() | changes, scene=scene)


@pytest.fixture
def package():
    """The module that has the model."""
    return sys.modules[type(make()).__module__]


# --- the sum ---


@pytest.mark.parametrize("sign", [-1, 1])
def test_channels_are_the_published_sum(package, sign):
    generator = torch.Generator().manual_seed(sign + 1)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    fields = torch.complex(2 * random(2, 3, 6, 4) - 1, 2 * random(2, 3, 6, 4) - 1)
    depths, frequencies = (
        3 * random(2, 3, 6) ** 3,
        torch.tensor([2.4e9, 2.41e9, 2.45e9], dtype=torch.float64),
    )
    depths[0, :, -1] = torch.inf
    distances = random(2, 3, 6).double().add(0.1).cumsum(-1)
    expected = torch.zeros(2, 4, 3, dtype=torch.complex128)
    for b, e, (s, f) in itertools.product(range(2), range(4), enumerate(frequencies.tolist())):
        for k in range(3):
            passed = 1.0
            for i in range(6):
                z, alpha = distances[b, k, i].item(), 1 - math.exp(-depths[b, k, i].item())
                loss = LIGHT / (4 * math.pi * f * z)
                way = cmath.exp(sign * 2j * math.pi * f * z / LIGHT)
                expected[b, e, s] += fields[b, k, i, e].item() * loss * alpha * passed * way
                passed *= 1 - alpha
    found = package.render(fields, depths, distances, frequencies, sign)
    torch.testing.assert_close(
        found, expected.to(torch.complex64), rtol=0, atol=1e-4 * expected.abs().max().item()
    )


def test_opaque_and_empty_samples_have_finite_gradients(package):
    depths = torch.tensor([[[0.0, 1e-9, 200.0, 0.0, 50.0, torch.inf]]], requires_grad=True)
    fields = torch.ones(1, 1, 6, 1, dtype=torch.complex64, requires_grad=True)
    distances = torch.tensor([[[0.0, 0.1, 0.2, 0.3, 0.4, 0.5]]], dtype=torch.float64)
    channels = package.render(fields, depths, distances, torch.tensor([1e9]).double())
    channels.abs().square().sum().backward()
    assert channels.isfinite().all()
    assert depths.grad.isfinite().all()
    assert fields.grad.isfinite().all()


def test_samples_lie_evenly_from_the_antenna_to_where_waves_arrive_from(package):
    model, seen = make(), []
    model.origins.add_(torch.arange(6).reshape(2, 3, 1))
    field = model.fields[1]
    field.register_forward_pre_hook(lambda module, inputs: seen.append(inputs))
    query = LINKS.query[torch.tensor([1, 3])]
    model(Batch(query))
    ((places, views),) = seen
    for b, k, i in itertools.product(range(2), range(3), range(4)):
        way = model.origins[1, k] - query.transmitters[b]
        place = (
            query.transmitters[b] + way * (i + 1) / 4 - (LINKS.scene.lower + LINKS.scene.upper) / 2
        )
        torch.testing.assert_close(places[b, k, i, :3], place, rtol=0, atol=1e-5)
        torch.testing.assert_close(views[b, k, i, :3], way / way.norm(), rtol=0, atol=1e-5)


def test_all_fields_have_gradients_whoever_hears():
    model = make().train()
    model(LINKS.batch((LINKS.query.receivers == 0).nonzero()[:3, 0])).value.abs().sum().backward()
    assert all(parameter.grad is not None for parameter in model.parameters())
    assert not any(parameter.grad.any() for parameter in model.fields[1].parameters())


def test_the_field_is_the_published_network(package):
    torch.manual_seed(0)
    field = package.Field((9, 5), width=8, layers=6, elements=2).double()
    places, views = torch.randn(3, 9).double(), torch.randn(3, 5).double()
    weights = {name: values.numpy() for name, values in field.state_dict().items()}

    def apply(name, x):
        return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]

    densities, sent = field(places, views)
    for i in range(3):
        place, view = places[i].numpy(), views[i].numpy()
        hidden = place
        for layer in range(6):
            hidden = apply(
                f"layers.{layer}", np.concatenate((place, hidden)) if layer == 4 else hidden
            ).clip(0)
        out = np.tanh(apply("send.2", apply("send.0", np.concatenate((hidden, view))).clip(0)))
        np.testing.assert_allclose(
            densities[i].item(), np.log1p(np.exp(apply("density", hidden)[0]))
        )
        np.testing.assert_allclose(sent[i].detach().numpy(), out[:2] + 1j * out[2:])


def test_published_sizes():
    options = composed("data=synthetic_csi", "model=newrf")["model"]
    assert (options["width"], options["layers"], options["octaves"], options["view_octaves"]) == (
        128,
        6,
        10,
        4,
    )
    field = build("model", options | {"samples": 2, "arrivals": 1}, scene=LINKS.scene).fields[0]
    inputs = [63, 128, 128, 128, 63 + 128, 128]
    network = sum(128 * (size + 1) for size in inputs) + 129
    sending = 128 * (128 + 27 + 1) + 2 * LINKS.task.elements * 129
    assert sum(parameter.numel() for parameter in field.parameters()) == network + sending


# --- arrivals ---

ROOM = Room(size=(6.0, 5.0, 3.0), walls=("metal",) * 6)
POSE = Pose.from_xyzw((1.5, 1.0, 1.2), (0, 0, 0, 1))


def room_links(count, sign=-1, strength=1.0):
    """Channels at two elements in a box of metal, single reflections alone; the receiver is well
    within the room.
    """
    generator = torch.Generator().manual_seed(0)
    places = torch.tensor([1.0, 1.0, 0.5]) + torch.rand(
        count, 3, generator=generator
    ) * torch.tensor([4.0, 3.0, 2.0])
    array, carrier = Array.planar(1, 2, 0.03), 5e9
    offsets = torch.linspace(-5e8, 5e8, 41, dtype=torch.float64)
    receiver = Receiver("middle", POSE, array)
    channels = strength * torch.cat(
        [*respond_in_parts(ROOM, places, receiver, carrier, offsets, 1)]
    )
    channels = channels.conj() if sign > 0 else channels
    links = replace(
        LINKS,
        query=Query(places, torch.zeros(count, dtype=torch.long)),
        receivers=(receiver,),
        labels=channels.to(torch.complex64),
        task=Csi(2, carrier + offsets),
        rows=None,
    )
    parts = torch.arange(count).split((count - 8, 4, 4))
    return replace(
        links, split=replace(links.split, train=parts[0], validation=parts[1], test=parts[2])
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_arrivals_are_the_receiver_and_its_images_in_the_walls(sign):
    links = room_links(60, sign, strength=7.0)
    model = make(links.scene, arrivals=7)
    model.fit(links)
    (x, y, z), (a, b, c) = POSE.position.tolist(), ROOM.size
    images = [
        [x, y, z],
        [-x, y, z],
        [2 * a - x, y, z],
        [x, -y, z],
        [x, 2 * b - y, z],
        [x, y, -z],
        [x, y, 2 * c - z],
    ]
    found = model.origins[0]
    torch.testing.assert_close(found[0], POSE.position)
    apart = torch.cdist(torch.tensor(images), found).amin(1)
    assert apart.max() < 0.1, f"images {apart.tolist()} m from what is found"
    assert model.sign == sign
    assert 5 < model.unit < 15


def test_more_links_than_it_looks_at_and_receivers_that_nobody_trains():
    links = room_links(300)
    links = replace(links, receivers=(*links.receivers, replace(links.receivers[0], name="deaf")))
    model = make(links.scene, arrivals=2)
    model.fit(links)
    assert (model.origins[0, 1] - POSE.position).norm() > 1
    torch.testing.assert_close(model.origins[1], POSE.position.expand(2, 3))
