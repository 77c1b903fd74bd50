"""The search for planes in fields of one number a place, of an invented room made by numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Links, Split
from gaigs.planes.field_room import FieldFit, Variation
from gaigs.planes.field_search import FieldSearch

pytestmark = pytest.mark.usefixtures("half_the_steps", "unchecked")

FREQUENCY = 2.4e9
WALLS = np.array([[0.8, 0.6, 0, -0.9], [-0.6, 0.8, 0, 2.8], [0, 0, 1.0, -0.2]])
"""Normals and offsets [m] of walls that stand at 37 degrees to the axes, and of the floor."""


def field(places, receiver, frequency=FREQUENCY, reflection=-0.5):
    """Direct wave and images of the first order (b,), each reflected by half."""

    def wave(points):
        lengths = np.linalg.norm(points - receiver, axis=1)
        return np.exp(-2j * np.pi * frequency / speed_of_light * lengths) / lengths

    total = wave(places)
    for *normal, offset in WALLS:
        images = places - 2 * (places @ normal - offset)[:, None] * normal
        total = total + reflection * wave(images)
    return total


def room(count=170, receivers=1, is_noise=False):
    """Links of a room with one antenna and one carrier."""
    generator = np.random.default_rng(0)
    along = generator.uniform((-0.5, 0.3, 0.1), (2.4, 2.5, 1.8), (count, 3))
    places = np.float32(along @ [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])
    poses = [Pose.from_xyzw(at, (0, 0, 0, 1)) for at in ((0.9, 1.2, 1.9), (-0.4, 1.5, 0.7))]
    which = np.arange(count) % receivers
    labels = np.zeros(count, complex)
    for number in range(receivers):
        own = which == number
        labels[own] = field(np.float64(places[own]), poses[number].position.double().numpy())
    if is_noise:
        labels = generator.standard_normal((count, 2)) @ [1, 1j]
    return Links(
        query=Query(torch.from_numpy(places), torch.from_numpy(which)),
        receivers=tuple(
            Receiver(f"r{k}", poses[k], Array(torch.zeros(1, 3))) for k in range(receivers)
        ),
        labels=torch.from_numpy(labels)[:, None, None].to(torch.complex64),
        task=Csi(1, torch.tensor([FREQUENCY]).double()),
        split=Split("all", torch.arange(count), torch.arange(0), torch.arange(0)),
    )


@pytest.fixture(params=[1, 2], ids=["one receiver", "two"])
def links(request):
    return room(120, receivers=request.param)


def search_walls(links, most, count=4):
    """The room that a search of so many planes finds, each wall within ``most`` of a plane."""
    torch.manual_seed(0)
    search = FieldSearch(links, -1, 1, count, torch.zeros(0, 4))
    found = search.run()
    planes = search.frame.to_world(found.planes).numpy()
    for wall in WALLS:
        gaps = np.abs(planes * np.sign(planes[:, :3] @ wall[:3])[:, None] - wall).max(1)
        assert gaps.min() < most
    return found


def test_places_together_show_planes_of_a_turned_room(links):
    found = search_walls(links, 0.03)
    assert len(found.planes) == len(WALLS)


@pytest.mark.parametrize("tilt", [0.0, 0.05], ids=["square", "leaning"])
def test_planes_are_turned_square_where_walls_are(tilt, monkeypatch):
    walls = WALLS.copy()
    walls[2] = [tilt, 0, np.sqrt(1 - tilt**2), -0.2]
    monkeypatch.setitem(globals(), "WALLS", walls)
    slant = torch.tensor([0.004, 0.003, 0.005, 0.0])
    search = FieldSearch(room(), -1, 1, 4, torch.from_numpy(walls) + slant)
    score = search.score
    found = score.refine(score.fit.start(search.start))
    turned = score.square(found)
    normals = turned.planes[:, :3].abs().numpy()
    assert (normals[2, 2] == 1) == (tilt == 0)
    assert (normals[:2, 2] == 0).all() == (tilt == 0)


def test_noise_has_no_planes():
    torch.manual_seed(0)
    found = FieldSearch(room(100, is_noise=True), -1, 2, 4, torch.zeros(0, 4)).run()
    assert not len(found.planes)


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_a_room_without_planes_is_searched_once_more_with_the_largest_variation(noise, monkeypatch):
    search = FieldSearch(room(), -1, 1, 4, torch.zeros(0, 4))
    fit = search.score.fit
    walls = fit.start(search.frame.from_world(torch.from_numpy(WALLS)))
    monkeypatch.setattr(fit, "choose_variation", lambda room: None)
    fit.variations = [Variation(0.0, 1.0, noise)]

    def grow(alone, grids):
        return walls if fit.variations == [Variation(0.5, 2.0, 0.1)] else alone

    monkeypatch.setattr(search, "_grow", grow)
    errors = {0: -1.0, 3: -1.0 - (0.2 - noise)}  # by the number of planes
    monkeypatch.setattr(search.score, "error", lambda room: errors[len(room.planes)])
    monkeypatch.setattr(search.score, "square", lambda room: room)
    assert len(search.run().planes) == (3 if noise == 0.1 else 0)


@pytest.mark.usefixtures("unchecked")
def test_few_places_tell_no_planes(caplog):
    caplog.set_level("INFO")
    found = FieldSearch(room(40), -1, 2, 4, torch.zeros(0, 4)).run()
    assert not len(found.planes)
    assert "40 numbers tell no planes; a search takes 60" in caplog.text


def test_kriging_leaves_what_other_places_do_not_explain(links):
    search = FieldSearch(links, -1, 1, 4, torch.from_numpy(WALLS))
    fit = FieldFit(search.data, largest=1000)
    fit.variations = [Variation(0.5, 1.0, 0.3)]
    start = fit.start(search.start)
    waves = fit.waves(start.planes, start)
    rest = fit.residual(start, waves)
    found = fit.krige(start, waves).leave_out(rest)
    # Without the first number, as kriging from the others of its receiver predicts it.
    own = fit.owner == 0
    gaps = torch.cdist(search.data.receivers[0].places, search.data.receivers[0].places)
    gains = torch.cat((start.gains[0], torch.ones(1)))
    order = torch.tensor([-1, 0, 1, 2])
    fields = waves[own] * gains[order] * start.receivers[0]
    covariance = 0.25 * (-gaps).exp() * (fields @ fields.mH) + 0.09 * torch.eye(int(own.sum()))
    weights = torch.linalg.solve(covariance[1:, 1:], covariance[1:, :1]).mH
    expected = rest[own][0] - weights[0] @ rest[own][1:]
    torch.testing.assert_close(found[0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.usefixtures("unchecked")
def test_bands_share_planes_and_have_gains_of_their_own():
    """One receiver at two bands; places of both bands differ."""
    low = room(100)
    high = room(200)
    both = low.query.transmitters, high.query.transmitters[100:]
    receiver = low.receivers[0]
    radios = [replace(receiver, name="low", band=(0.0, 3e9)), replace(receiver, band=(3e9, 9e9))]
    labels = torch.zeros(200, 1, 2, dtype=torch.complex64)
    labels[:100, 0, 0] = low.labels[:, 0, 0]
    at = receiver.pose.position.double().numpy()
    labels[100:, 0, 1] = torch.from_numpy(field(np.float64(both[1]), at, 3.6e9, -0.2))
    links = Links(
        query=Query(torch.cat(both), torch.arange(2).repeat_interleave(100)),
        receivers=tuple(radios),
        labels=labels,
        task=Csi(1, torch.tensor([FREQUENCY, 3.6e9]).double()),
        split=Split("all", torch.arange(200), torch.arange(0), torch.arange(0)),
    )
    found = search_walls(links, 0.02, len(WALLS))
    # Wavelengths ascend: the first gains are the high band's, whose reflections are weaker.
    shown = found.uses.all(0)
    assert shown.sum() >= 2
    assert (found.gains[0].abs() < 0.7 * found.gains[1].abs())[shown].all()
