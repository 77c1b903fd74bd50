"""The search for planes, in labels of a room with walls."""

import math
from dataclasses import replace

import pytest
import torch
from test_mirrored_model import MIRRORED, build, room_spectra, walled

from gaigs.antenna import Array
from gaigs.placement.mirrored.search import find_planes

WALLS = {0: [1.0, 0, 0, 0], 2: [0, 1.0, 0, 0], 3: [0, 1.0, 0, 5.0]}
"""Normal and offset [m] of walls that these labels determine, by their number in ``walled``."""


def loss_on(model):
    return lambda batch: (model(batch).value - batch.labels).abs().mean().item()


def is_found(placement, wall):
    """To 5 degrees and 0.25 m, from which descent goes on; a plane has two normals."""
    *normal, offset = WALLS[wall]
    along = placement.normals[wall] @ torch.tensor(normal)
    found = placement.offsets[wall] + placement.normals[wall] @ placement.middle
    return abs(along) > math.cos(math.radians(5)) and abs(found * along.sign() - offset) < 0.25


def without(model, wall):
    """The model with no path by way of a wall."""
    placement = model.placement
    placement.kept &= ~(placement.sequences == wall).any(1)
    return model


@pytest.fixture(scope="module")
def links():
    return room_spectra("band", 40)


@torch.no_grad()
@pytest.mark.parametrize("wall", [0, 3])
def test_a_missing_wall_is_found(links, wall):
    model = without(walled(build(links)), wall)
    batch = links.batch(links.split.train)
    before = loss_on(model)(batch)
    message = find_planes(model, batch, None, loss_on(model))
    placement = model.placement
    assert message.startswith("plane (")
    assert message.count("plane") == 1
    assert placement.used.tolist() == [*range(6)]
    assert is_found(placement, wall)
    assert loss_on(model)(batch) < 0.95 * before


@torch.no_grad()
def test_receivers_need_not_have_the_same_array(links):
    """Labels by the model itself, which the image source method has been held against."""
    one = links.receivers[0]
    array = Array(one.array.elements[:6], one.array.pattern)
    links = replace(
        links,
        receivers=(one, replace(one, name="another", array=array)),
        query=replace(links.query, receivers=torch.arange(len(links)) % 2),
    )
    whole = walled(build(links))
    batch = links.batch(links.split.train)
    batch = replace(batch, labels=whole(batch).value)
    model = without(whole, 2)
    find_planes(model, batch, None, loss_on(model))
    assert is_found(model.placement, 2)


@torch.no_grad()
def test_no_plane_is_added_to_a_complete_room(links):
    model = walled(build(links, placement=MIRRORED | {"planes": 8}))
    kept = model.placement.kept.clone()
    assert find_planes(model, links.batch(links.split.train), None, loss_on(model)).startswith("no plane found")
    assert torch.equal(model.placement.kept, kept)
