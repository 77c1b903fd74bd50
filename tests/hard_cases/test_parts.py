"""Tokenizers, deformations, placements, poolings and losses at the ends of what they may be asked.

Each gives finite values and gradients, and in float32 what it gives in float64. Plug-ins are among them.
"""

import copy
import functools
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians
from gaigs.tokenizer import Tokens

sys.path.append(str(Path(__file__).parents[1]))
from test_contracts import MADE_FOR, TASKS, configured

TOLERANCE = 1e-3
"""Between float32 and float64, of the largest value or of 1."""

LINKS = example_links("rssi")
SCENE = LINKS.scene
every = lambda kind: pytest.mark.parametrize("name", registry(kind).names())


def require_same(single, double, leaves):
    """Finite values that agree, with finite gradients."""
    for one, two in zip(single, double, strict=True):
        assert (one is None) == (two is None)
        if one is not None:
            assert one.isfinite().all()
            scale = max(1.0, two.abs().max().item()) if two.numel() else 1.0
            assert (one - two).abs().max() < TOLERANCE * scale if one.numel() else True
    outputs = [value for value in single if value is not None and value.requires_grad and value.numel()]
    real = [torch.view_as_real(value) if value.is_complex() else value for value in outputs]
    if real:
        total = sum((value / max(1.0, value.detach().abs().max().item())).mean() for value in real)
        gradients = torch.autograd.grad(total, leaves, allow_unused=True)
        assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)


def in_both(module):
    """A module, and its like of float64."""
    module = copy.deepcopy(module).eval()
    return module, copy.deepcopy(module).double()


# --- where transmitters may stand ---

receiver = SCENE.receivers[0].pose.position
PLACES = {
    "on the receiver": receiver.expand(3, 3),
    "beside the receiver": receiver + torch.tensor([[1e-6, 0, 0], [0, 1e-4, 0], [0, 0, 1e-7]]),
    "at corners of the box": torch.stack((SCENE.lower, SCENE.upper, (SCENE.lower + SCENE.upper) / 2)),
    "all at one place": SCENE.lower.expand(3, 3) + 0.5,
    "outside": SCENE.upper + torch.tensor([[10.0, 0, 0], [0, 100, 0], [0, 0, -50]]),
    "on a Gaussian": example_gaussians(SCENE, 7).means.detach()[:3],
}
LINE = replace(SCENE, upper=SCENE.lower + torch.tensor([1.0, 0, 0]))


def query_at(places, scene=SCENE):
    return Query(places.float(), torch.arange(3) % len(scene.receivers))


def doubled(query):
    return replace(query, transmitters=query.transmitters.detach().double())


@every("tokenizer")
@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("scene", [SCENE, LINE], ids=["room", "line"])
def test_tokens(name, places, scene):
    query = query_at(PLACES[places])
    query.transmitters.requires_grad_()
    module, double = in_both(registry("tokenizer").build(configured("tokenizer", name), scene=scene))
    gaussians = example_gaussians(SCENE, 7)
    means, opacities = gaussians.means.detach()[None], torch.tensor([0.0, 1.0, 0.5, 1e-38, 1 - 1e-7, 0.3, 0.9])
    single = module(Placed(means), opacities, query)
    exact = double(Placed(means.double()), opacities.double(), doubled(query))
    require_same(single, exact, [query.transmitters, *module.parameters()])


@every("deformation")
@pytest.mark.parametrize("size", [0.0, 1e-38, 1.0, 1e4])
def test_residuals(name, size):
    widths, b, n = (5, 4, 6), 3, 7
    generator = torch.Generator().manual_seed(0)
    random = lambda *shape: size * torch.randn(*shape, generator=generator)
    build = functools.partial(registry("deformation").build, configured("deformation", name))
    module, double = in_both(build(scene=SCENE, channels=2, tokenizer_widths=widths))
    tokens = Tokens(random(b, widths[0]), random(n, widths[1]), random(b, widths[2]))
    means = example_gaussians(SCENE, n).means.detach()[None].clone()
    means[0, 0] = receiver
    query = query_at(PLACES["on the receiver"])
    single = module(tokens if module.reads_tokens else None, Placed(means), query)
    wide = Tokens(*(token.double() for token in tokens))
    exact = double(wide if module.reads_tokens else None, Placed(means.double()), doubled(query))
    require_same(single, exact, [*module.parameters()])
    if single.attenuations is not None:
        assert single.attenuations.gt(0).all()
        assert single.attenuations.le(1).all()


# --- planes ---


def lay(placement, *planes):
    """Puts planes there, each given by its normal and by where it cuts that [m]; returns the placement."""
    for number, (normal, offset) in enumerate(planes):
        placement.place(number, torch.tensor(normal, dtype=torch.float32), torch.tensor(float(offset)))
    return placement


# --- what is read from a map ---

MAPS = {
    "silent": lambda shape: torch.zeros(shape),
    "tiny": lambda shape: torch.full(shape, 1e-15),
    "constant": lambda shape: torch.full(shape, 0.7),
    "of 1e4": lambda shape: 1e4 * torch.linspace(-1, 1, math.prod(shape)).reshape(shape),
    "a single bright pixel": lambda shape: torch.cat(
        (torch.full((1,), 1e6), torch.zeros(math.prod(shape) - 1))
    ).reshape(shape),
}
POOLED = [(name, task) for name, tasks in MADE_FOR["pooling"].items() for task in tasks]


@pytest.mark.parametrize("what", MAPS)
@pytest.mark.parametrize(("name", "task"), POOLED)
def test_values(name, task, what):
    links = example_links(task, 5e9 if name == "array_response" else None)
    pooling = registry("pooling").build(configured("pooling", name), scene=links.scene)
    pooling.fit(links)
    module, double = in_both(pooling)
    grid = links.task.directions if pooling.grid is None else pooling.grid
    image = MAPS[what]((2, pooling.channels, *grid.shape)).requires_grad_()
    query = links.query[:2]
    exact = double(image.detach().double(), doubled(query))
    require_same([module(image, query)], [exact], [image, *module.parameters()])


# --- what is compared ---

LABELS = {
    "nothing": lambda labels: 0 * labels,
    "constant": lambda labels: 0 * labels + 1,
    "tiny": lambda labels: 0 * labels + 1e-30,
    "as they are": lambda labels: labels,
}
VALUES = {"nothing": 0.0, "the labels": 1.0, "opposite": -1.0, "far too much": 1e4, "denormal": 1e-42}


@pytest.mark.parametrize("values", VALUES)
@pytest.mark.parametrize("labels", LABELS)
@pytest.mark.parametrize(
    ("name", "task"), [(name, task) for name in registry("loss").names() for task in MADE_FOR["loss"].get(name, TASKS)]
)
def test_losses(name, task, labels, values):
    if task == "csi" and labels == "nothing":
        pytest.skip("the task refuses channels that are zero throughout")
    links = example_links(task)
    loss = registry("loss").build(configured("loss", name), task=links.task)
    batch = links.batch(links.split.train[:3])
    batch = replace(batch, labels=LABELS[labels](batch.labels))
    given = (VALUES[values] * batch.labels).requires_grad_()
    wide = torch.complex128 if given.is_complex() else torch.float64
    found, _ = loss(given, batch)
    exact, _ = loss(given.detach().to(wide), replace(batch, labels=batch.labels.to(wide)))
    require_same([found], [exact], [given])
