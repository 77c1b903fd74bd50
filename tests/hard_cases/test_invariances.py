"""Invariances: a turned array, a moved world, scaled distances.

Positions are multiples of an eighth of a metre, so that float32 moves them by a million metres
without rounding.
"""

import math
from dataclasses import replace

import pytest
import torch
from precision import DTYPES, build, widen
from test_contracts import composed

from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.registry import registry
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians

FAR = torch.tensor([2.0**20, -(2.0**19), 2.0**18])
COLUMNS = 36
"""Of the label's grid."""

both = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])


def require_close(found, expected, tolerance):
    assert found.isfinite().all()
    assert (found - expected).abs().max() <= tolerance * max(1.0, expected.abs().max().item())


def turned(pose, columns):
    """The pose turned about the array's axis by some columns of the grid."""
    angle = 2 * math.pi * columns / COLUMNS
    cos, sin = math.cos(angle), math.sin(angle)
    about = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    return Pose(pose.position, (pose.rotation.double() @ about).to(pose.rotation))


def eighths(points):
    return (8 * points).round() / 8


MIRRORED = (
    "model=mirrored", "placement=mirrored", "placement.planes=6", "placement.order=2", "placement.obstacles=2",
    "deformation=none", "~projection", "~rasterizer",
)  # fmt: skip
GAIGS = "model=gaigs", "rasterizer=torch", "gaussians.count=40", "deformation.width=16"
DATA = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
CARRIER = 5e9


def links_of(task, mirrored, shift=0.0, columns=0):
    """Made-up links on eighths of a metre, moved and with turned arrays."""
    links = example_links(task, CARRIER if mirrored and task != "csi" else None)
    places = eighths(links.query.transmitters) + shift
    receivers = []
    for one in links.receivers:
        pose = turned(Pose((2 * one.pose.position).round() / 2 + shift, one.pose.rotation), columns)
        receivers.append(replace(one, pose=pose))
    return replace(
        links, query=replace(links.query, transmitters=places), receivers=tuple(receivers)
    )


def model_of(links, overrides, dtype, state=None):
    config = composed(f"data={DATA[links.task.name]}", *overrides)["model"]
    torch.manual_seed(0)
    model = registry("model").build(config, scene=links.scene)
    model.fit(links)
    if state is not None:
        model.load_state_dict(state)
    return widen(model, dtype)


def answer(model, links, dtype):
    batch = links.batch(links.split.test)
    with torch.no_grad():
        return model(replace(batch, query=widen(batch.query, dtype))).value


@pytest.mark.parametrize("projection", registry("projection").names())
def test_spectra_of_gaigs_roll_where_the_array_turns(projection):
    """In float64: float32 may see a Gaussian on the other side of a jump."""
    columns = 13
    overrides = (*GAIGS, f"projection={projection}")
    links, other = links_of("spectrum", False), links_of("spectrum", False, columns=columns)
    model = model_of(links, overrides, torch.float64)
    still = answer(model, links, torch.float64)
    rolled = answer(
        model_of(other, overrides, torch.float64, model.state_dict()), other, torch.float64
    )
    assert still.std() > 1e-3
    off = (rolled - still.roll(-columns, -1)).abs() > 1e-4 * still.abs().max()
    assert off.double().mean() < 0.01


@both
def test_spectra_of_mirrored_gaussians_roll_where_the_array_turns(dtype):
    """By a quarter turn, which maps the square array onto itself."""
    overrides = (*MIRRORED, "pooling=path_spectrum")
    links, other = links_of("spectrum", True), links_of("spectrum", True, columns=9)
    model = model_of(links, overrides, dtype)
    still = answer(model, links, dtype)
    rolled = answer(model_of(other, overrides, dtype, model.state_dict()), other, dtype)
    assert still.std() > 1e-3
    require_close(rolled, still.roll(-9, -1), 2e-3)


def move_gaussians(model, shift):
    with torch.no_grad():
        model.gaussians.means.copy_(eighths(model.gaussians.means) + shift)


@both
@pytest.mark.parametrize(
    ("task", "tokenizer"),
    [
        *(("spectrum", name) for name in registry("tokenizer").names()),
        ("rssi", "multiview"),
        ("csi", "multiview"),
    ],
)
def test_nothing_changes_for_gaigs_where_all_is_moved(dtype, task, tokenizer):
    overrides = (*GAIGS, f"tokenizer={tokenizer}")
    links = links_of(task, False)
    model = model_of(links, overrides, torch.float32)
    move_gaussians(model, 0)
    state = {
        name: part for name, part in model.state_dict().items() if name.startswith("gaussians.")
    }
    far = links_of(task, False, FAR)
    there = model_of(far, overrides, torch.float32)
    state["gaussians.means"] = state["gaussians.means"] + FAR
    assert not there.load_state_dict(state, strict=False).unexpected_keys
    values = [
        answer(widen(part, dtype), own, dtype) for part, own in ((model, links), (there, far))
    ]
    require_close(values[1], values[0], 1e-3)


@pytest.mark.parametrize("task", DATA)
@pytest.mark.parametrize("is_coherent", [False, True])
def test_nothing_changes_for_mirrored_gaussians_where_all_is_moved(task, is_coherent):
    """In float64: float32 rounds an image 1e6 m from the origin to a tenth of a metre."""
    overrides = (*MIRRORED, f"pooling=path_{task}")
    links, far = links_of(task, True), links_of(task, True, FAR)
    model = model_of(links, overrides, torch.float64)
    there = model_of(far, overrides, torch.float64)
    there.load_state_dict(model.state_dict())
    if is_coherent:
        model.placement.enable_phases(0.06)
        there.placement.enable_phases(0.06)
    with torch.no_grad():
        values = [answer(part, own, torch.float64) for part, own in ((model, links), (there, far))]
    assert (values[0].abs() > 0).any()
    require_close(values[1], values[0], 1e-4)


@pytest.mark.parametrize("task", DATA)
def test_mirrored_gaussians_learn_alike_wherever_the_worlds_origin_is(task):
    """In float32: a turn of a plane moves it as far, and no image is rounded."""
    losses = []
    for shift in (0.0, 16.0, 5000.0):
        links = links_of(task, True, torch.tensor([shift, -shift, 0.0]))
        model = model_of(links, (*MIRRORED, f"pooling=path_{task}"), torch.float32)
        model.placement.enable_phases(0.06)
        if task == "csi":
            model.placement.enable_reflections()
        batch, losses = links.batch(links.split.train), [*losses, []]
        optimizer = torch.optim.Adam(model.parameters(), 1e-2)
        for _ in range(12):
            loss = (model(batch).value - batch.labels).abs().mean() / batch.labels.abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses[-1].append(loss.item())
    here, *there = torch.tensor(losses)
    assert here[-1] < 0.99 * here[0]
    for far in there:
        torch.testing.assert_close(far, here, rtol=0, atol=1e-3)


@pytest.mark.parametrize("placement", registry("placement").names())
@both
@pytest.mark.parametrize("scale", [2.0**-6, 2.0**10])
def test_directions_stay_where_all_distances_are_scaled(placement, dtype, scale):
    scene = links_of("spectrum", True).scene
    receivers = [
        replace(one, pose=Pose(scale * one.pose.position, one.pose.rotation))
        for one in scene.receivers
    ]
    far = replace(
        scene, lower=scale * scene.lower, upper=scale * scene.upper, receivers=tuple(receivers)
    )
    seen = []
    for own, factor in ((scene, 1.0), (far, scale)):
        part = widen(build("placement", placement, scene=own, channels=2), dtype)
        gaussians = example_gaussians(scene, 6).to(dtype)
        with torch.no_grad():
            gaussians.means.mul_(factor)
        places = factor * links_of("spectrum", True).query.transmitters[:4].to(dtype)
        query = Query(places, torch.arange(4) % 2, torch.full((4,), CARRIER))
        placed = part(gaussians, query)
        stands = placed.means.expand(4, -1, -1) - own.positions(places)[query.receivers][:, None]
        seen.append(
            (stands.detach() / factor, None if placed.lengths is None else placed.lengths / factor)
        )
    (here, lengths), (there, longer) = seen
    require_close(there, here, {torch.float32: 2e-3, torch.float64: 1e-8}[dtype])
    if lengths is not None:
        n = lengths.shape[1] - 6  # free ones have none
        require_close(
            longer[:, :n], lengths[:, :n], {torch.float32: 2e-3, torch.float64: 1e-8}[dtype]
        )
