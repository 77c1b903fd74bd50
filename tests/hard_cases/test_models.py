"""Models, also of plug-ins, for transmitters at impossible places."""

from dataclasses import replace

import pytest
import torch
from precision import DTYPES, TASKS, require_finite, widen
from test_contracts import composed

from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.registry import registry
from gaigs.testing import example_links

DATA = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
OWN = {
    "gaigs": ("gaussians.count=30", "deformation=two_branch", "deformation.width=16"),
    "mirrored": ("placement=mirrored", "deformation=none", "~projection", "~rasterizer"),
}
"""Further options of a model."""

CARRIER = 5e9
WITHOUT_SETTINGS = {
    "kriging": "is made of a trained model",
    "ensemble": "is made of trained models",
    "adapted": "is made of a trained model",
    "sklearn": "is made of a regressor",
    "site": "needs a file of buildings",
    "ray_tracing": "needs a mesh of the room",
}
NAMES = [name for name in registry("model").names() if name not in WITHOUT_SETTINGS]
FAR = torch.tensor([2.0**20, -(2.0**19), 2.0**18])


def places_of(links):
    receiver, own = links.receivers[0].pose.position, links.query.transmitters
    beside, below = receiver + torch.tensor([1e-6, 0, 0]), receiver - torch.tensor([0, 0, 1e-3])
    places = (
        receiver,
        beside,
        below,
        own[0],
        own[0] + 1e-6,
        own.amin(0),
        own.amax(0) + 100,
        receiver + 99_000,
    )
    return torch.stack(places)


def links_of(task, carrier, shift=0.0):
    links = example_links(task, None if task == "csi" else carrier)
    receivers = [
        replace(one, pose=Pose(one.pose.position + shift, one.pose.rotation))
        for one in links.receivers
    ]
    query = replace(links.query, transmitters=links.query.transmitters + shift)
    return replace(links, query=query, receivers=tuple(receivers))


def build(name, links):
    task = links.task.name
    own = (*OWN.get(name, ()), *([f"pooling=path_{task}"] if name == "mirrored" else ()))
    config = composed(f"data={DATA[task]}", f"model={name}", *own)["model"]
    torch.manual_seed(0)
    model = registry("model").build(config, scene=links.scene)
    model.fit(links)
    return model.eval()


def ask(model, links, places):
    """Requires finite values and gradients in both precisions."""
    n = len(places)
    frequencies = None if links.query.frequencies is None else torch.full((n,), CARRIER)
    batch = replace(links.batch(links.split.test[:1]), labels=None)
    for dtype in DTYPES if [*model.parameters()] else DTYPES[:1]:
        query = Query(places.to(dtype), torch.arange(n) % 2, frequencies)
        batch = replace(batch, query=query)
        part = widen(model, dtype)
        directions = (
            None
            if batch.directions is None
            else batch.directions.thin(slice(1, 18, 6), slice(0, 36, 9))
        )
        prediction = part(replace(batch, directions=directions))
        require_finite([prediction.value, *prediction.penalties.values()], [*part.parameters()])


@pytest.mark.parametrize("name", NAMES)
def test_values_and_gradients_are_finite(name):
    """For each task of ``gaigs`` and ``mirrored``, else for the first task that the model takes."""
    refusals = []
    for task in TASKS:
        links = links_of(task, CARRIER if name == "mirrored" else None)
        try:
            model = build(name, links)
        except ValueError as error:
            refusals.append(str(error))
            continue
        ask(model, links, places_of(links))
        if name not in OWN:
            break
    assert len(refusals) < len(TASKS), refusals


@pytest.mark.parametrize("name", ["gaigs", "mirrored"])
@pytest.mark.parametrize("task", TASKS)
def test_models_a_million_metres_from_the_origin(name, task):
    links = links_of(task, CARRIER if name == "mirrored" else None, FAR)
    ask(build(name, links), links, links.query.transmitters[:4])


@pytest.mark.parametrize("push", [-1.5, 1.5])
@pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
def test_opacities_that_a_residual_pushes_outside_stay_in_their_range(push, dtype):
    links = links_of("spectrum", None)
    model = widen(build("gaigs", links), dtype)
    batch = links.batch(links.split.test)
    values = []
    for factor in (1, 1e4):
        torch.nn.init.constant_(model.deformation.heads["opacity"].bias, factor * push)
        prediction = model(
            replace(
                batch, query=replace(batch.query, transmitters=batch.query.transmitters.to(dtype))
            )
        )
        require_finite([prediction.value, *prediction.penalties.values()], [*model.parameters()])
        values.append(prediction.value)
    assert torch.equal(*values)
    assert bool((values[0] > 0).any()) == (push > 0)
