"""Tokenizers, deformations, poolings and losses, also of plug-ins, at extremes of their inputs."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from precision import TASKS, build, require_same, widen

from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.registry import registry
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.pooling.paths import LagPooling, PathPooling
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians
from gaigs.testing.pooling import example_paths

SCENE = example_links("rssi").scene


def every(kind):
    return pytest.mark.parametrize("name", registry(kind).names())


receiver = SCENE.receivers[0].pose.position
means = example_gaussians(SCENE, 20).means.detach()
PLACES = {
    "on the receiver": receiver.expand(3, 3),
    "beside the receiver": receiver + torch.tensor([[1e-6, 0, 0], [0, 1e-4, 0], [0, 0, 1e-7]]),
    "at corners of the box": torch.stack(
        (SCENE.lower, SCENE.upper, (SCENE.lower + SCENE.upper) / 2)
    ),
    "all at one place": SCENE.lower.expand(3, 3) + 0.5,
    "outside": SCENE.upper + torch.tensor([[10.0, 0, 0], [0, 100, 0], [0, 0, -50]]),
    "on an anchor": means[:3],
    "beside each other": SCENE.lower
    + torch.tensor([[1, 1, 1], [1 + 1e-6, 1, 1], [1, 1, 1 - 1e-6]]),
}
GAUSSIANS = {
    "about": means,
    "all at one place": means[:1].expand(20, 3),
    "on the receiver": receiver.expand(20, 3),
    "far": 1e4 * means,
    "one": means[:1],
    "none": means[:0],
}
FAR = torch.tensor([2.0**20, -(2.0**19), 2.0**18])


def moved(scene, shift):
    receivers = [
        replace(one, pose=Pose(one.pose.position + shift, one.pose.rotation))
        for one in scene.receivers
    ]
    return replace(
        scene, receivers=tuple(receivers), lower=scene.lower + shift, upper=scene.upper + shift
    )


SCENES = {
    "room": SCENE,
    "line": replace(SCENE, upper=SCENE.lower + torch.tensor([1.0, 0, 0])),
    "far from the origin": moved(SCENE, FAR),
    "large": replace(SCENE, upper=SCENE.lower + 1e5),
    "of two bands": replace(SCENE, frequencies=torch.tensor([2.4e9, 5e9])),
}
TOKENS = [(place, "about", "room") for place in PLACES]
TOKENS += [("on an anchor", gaussians, "room") for gaussians in GAUSSIANS if gaussians != "about"]
TOKENS += [("on an anchor", "about", scene) for scene in SCENES if scene != "room"]


def query_at(places, scene=SCENE):
    carriers = scene.frequencies[torch.arange(3) % 2] if scene.has_band else None
    return Query(places, torch.arange(3) % len(scene.receivers), carriers)


def ask_tokens(scene, opacities):
    def ask(module, transmitters, stands):
        return module(
            Placed(stands[None]),
            widen(opacities[: len(stands)], stands.dtype),
            query_at(transmitters, scene),
        )

    return ask


OPACITIES = torch.tensor([0.0, 1.0, 0.5, 1e-38, 1 - 1e-7]).repeat(4)


@every("tokenizer")
@pytest.mark.parametrize(("places", "gaussians", "scene"), TOKENS)
def test_tokens(name, places, gaussians, scene):
    shift = FAR if scene == "far from the origin" else 0
    own = SCENES[scene]
    module = build("tokenizer", name, scene=own)
    require_same(
        ask_tokens(own, OPACITIES), module, PLACES[places] + shift, GAUSSIANS[gaussians] + shift
    )


@every("tokenizer")
@pytest.mark.parametrize("size", [100.0, 0.0, 1e-20])
def test_tokens_of_attention_with_huge_logits_or_none(name, size):
    module = build("tokenizer", name, scene=SCENE)
    attending = [part for part in module.modules() if "Attention" in type(part).__name__]
    with torch.no_grad():
        for parameter in [
            parameter for part in attending for parameter in part.project.parameters()
        ]:
            parameter.mul_(size)
    require_same(
        ask_tokens(SCENE, OPACITIES), module, PLACES["at corners of the box"], means, tolerance=1e-2
    )


@every("deformation")
@pytest.mark.parametrize(
    ("size", "n"), [*((size, 7) for size in (0.0, 1e-42, 1e-38, 1.0, 1e4)), (1.0, 1), (1.0, 0)]
)
def test_residuals(name, size, n):
    widths, b = (5, 4, 6), 3
    generator = torch.Generator().manual_seed(0)
    tokens = [size * torch.randn(*shape, generator=generator) for shape in ((b, 5), (n, 4), (b, 6))]
    stands = means[None, :n].clone()
    stands[0, :1] = receiver
    context = {"scene": SCENE, "channels": 2, "tokenizer_widths": widths, "count": n}
    module = build("deformation", name, **context)

    def ask(module, transmitters, stands, *tokens):
        return module(
            Tokens(*tokens) if module.reads_tokens else None, Placed(stands), query_at(transmitters)
        )

    *_, attenuations = require_same(ask, module, PLACES["on the receiver"], stands, *tokens)
    if attenuations is not None and attenuations.numel():
        assert attenuations.gt(0).all()
        assert attenuations.le(1).all()


MAPS = {
    "silent": lambda shape: torch.zeros(shape),
    "denormal": lambda shape: torch.full(shape, 1e-42),
    "tiny": lambda shape: torch.full(shape, 1e-15),
    "constant": lambda shape: torch.full(shape, 0.7),
    "of 1e4": lambda shape: 1e4 * torch.linspace(-1, 1, math.prod(shape)).reshape(shape),
    "of 1e10": lambda shape: 1e10 * torch.arange(math.prod(shape)).cos().reshape(shape),
    "a single bright pixel": lambda shape: torch.cat(
        (torch.full((1,), 1e6), torch.zeros(math.prod(shape) - 1))
    ).reshape(shape),
}
CARRIER = 5e9


@functools.cache
def poolings_of(name):
    """A pooling for each task that it suits, with links."""
    found = []
    for task in TASKS:
        links = example_links(task, None if task == "csi" else CARRIER)
        try:
            pooling = build("pooling", name, scene=links.scene)
        except ValueError:
            continue
        if isinstance(pooling, PathPooling):
            paths, grid = example_paths(links.receivers[0], links.query[:1], torch.float32), None
            value = pooling(paths, links.query[:1])
        elif (grid := pooling.grid or links.task.directions) is not None:
            value = pooling(torch.zeros(1, pooling.channels, *grid.shape), links.query[:1])
        else:
            continue
        if value.shape[1:] == links.task.shape and value.dtype == links.task.dtype:
            pooling.fit(links)
            found.append((pooling, links, grid))
    assert found, f"pooling {name!r} gives the labels of none of the tasks {', '.join(TASKS)}"
    return found


@every("pooling")
@pytest.mark.parametrize("image", MAPS)
def test_values_of_maps(name, image):
    for pooling, links, grid in poolings_of(name):
        if grid is not None:
            query = links.query[:2]

            def ask(module, own, query=query):
                return module(own, widen(query, own.dtype))

            require_same(ask, pooling, MAPS[image]((2, pooling.channels, *grid.shape)))


@every("pooling")
@pytest.mark.parametrize("size", [0.0, 1e-42, 1e-15, 1.0, 1e10])
@pytest.mark.parametrize("alike", [True, False])
def test_values_of_paths(name, size, alike):
    """Fields or lags of a silent, faint or loud wave, equal at all elements where ``alike``."""
    for pooling, links, grid in poolings_of(name):
        if grid is not None:
            continue
        array = links.receivers[0].array
        if isinstance(pooling, LagPooling):
            steps = array.lags[0].float()
            turns = 0 * steps[:, 0] if alike else 60 * steps[:, 0] + 30 * steps[:, 1]
            waves = torch.polar(torch.ones_like(turns), turns).expand(2, -1)
        else:
            shape = 2, *links.task.shape
            waves = torch.polar(
                torch.ones(shape), torch.zeros(shape) if alike else torch.arange(40.0).view(shape)
            )
        query = links.query[:2]

        def ask(module, received, query=query):
            return module.read(received, widen(query, received.real.dtype))

        require_same(ask, pooling, size * waves)


LABELS = {
    "nothing": lambda labels: 0 * labels,
    "constant": lambda labels: 0 * labels + 1,
    "tiny": lambda labels: 0 * labels + 1e-30,
    "denormal": lambda labels: 0 * labels + 1e-42,
    "as they are": lambda labels: labels,
}
VALUES = {
    "nothing": 0.0,
    "the labels": 1.0,
    "opposite": -1.0,
    "far too much": 1e4,
    "denormal": 1e-42,
}


@functools.cache
def losses_of(name):
    """A loss for each task that it takes, with links."""
    found = []
    for task in TASKS:
        links = example_links(task)
        try:
            found.append((build("loss", name, task=links.task, scene=links.scene), links))
        except ValueError:
            continue
    assert found, f"loss {name!r} takes the labels of none of the tasks {', '.join(TASKS)}"
    return found


@every("loss")
@pytest.mark.parametrize(
    ("labels", "values"),
    [("nothing", "nothing")]
    + [(labels, values) for labels in LABELS if labels != "nothing" for values in VALUES],
)
def test_losses(name, labels, values):
    for loss, links in losses_of(name):
        if links.task.dtype.is_complex and labels == "nothing":
            continue  # the task refuses channels that are zero throughout
        batch = links.batch(links.split.train[:3])
        given = LABELS[labels](batch.labels)
        is_beyond = links.task.dtype.is_complex and labels == "denormal"

        def ask(_, values, loss=loss, batch=batch, given=given, is_beyond=is_beyond):
            real = values.real.dtype if values.is_complex() else values.dtype
            found, _ = loss(values, replace(batch, labels=widen(given, real)))
            return (
                found.detach() if is_beyond else found
            )  # float32 does not reach one over such a channel

        require_same(ask, None, VALUES[values] * given)
