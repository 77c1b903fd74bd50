"""The steps of a search for planes, with a score of a kind of labels that gaigs does not know."""

from typing import NamedTuple

import pytest
import torch

from gaigs.core import stages
from gaigs.planes.frame import RoomFrame
from gaigs.planes.search import GridRatings, PlaneSearch, Score

TRUE = torch.tensor([[1.0, 0, 0, 2.03], [0, 1.0, 0, -1.52], [0, 0, 1.0, 1.21]])


class Room(NamedTuple):
    planes: torch.Tensor


class Distances(Score[Room]):
    """Labels that say how far planes are from true ones, and a price of each plane."""

    def error(self, room):
        gaps = torch.cdist(TRUE, room.planes) if len(room.planes) else torch.full((3, 1), 5.0)
        return gaps.amin(1).sum().item() + 0.1 * len(room.planes)

    def rate(self, room, grid):
        missing = [plane for plane in TRUE if not near(room.planes, plane)]

        def rate(planes):
            total = planes.new_zeros(len(planes))
            for plane in missing:
                total += (-(planes - plane).square().sum(1) / 0.1).exp()
            return total

        return GridRatings(rate(grid.flatten(0, 1)).view(grid.shape[:2]), rate)

    def add(self, room, candidate):
        larger = Room(torch.cat((room.planes, candidate.plane[None])))
        return larger if self.error(larger) < self.error(room) else None

    def move(self, room, number):
        planes = room.planes.clone()
        planes[number] = TRUE[torch.cdist(planes[number, None], TRUE)[0].argmin()]
        return Room(planes)

    def remove(self, room, number):
        return Room(torch.cat((room.planes[:number], room.planes[number + 1 :])))

    def refine(self, room):
        return room


def near(planes, plane):
    return len(planes) > 0 and bool((planes - plane).abs().amax(1).min() < 0.2)


@pytest.fixture
def search():
    torch.manual_seed(0)
    corners = torch.tensor([[-2.0, -1.5, -1.2], [2.0, 1.5, 1.2]])
    return PlaneSearch(RoomFrame(corners), Distances())


@pytest.fixture
def grid(search):
    return search.frame.grid(torch.eye(3), 40, 0.2)


def test_a_new_kind_of_labels_needs_a_score_alone(search, grid):
    room = search.grow(Room(TRUE[:0]), 5, lambda room: search.extend(room, grid))
    assert len(room.planes) == 3
    assert all(near(room.planes, plane) for plane in TRUE)
    room = search.sweep(room, range(3))
    order = room.planes[:, :3].argmax(1).argsort()
    torch.testing.assert_close(room.planes[order], TRUE, rtol=0, atol=0)


def test_planes_that_explain_nothing_are_dropped_but_known_ones(search):
    false = torch.tensor([[0.6, 0.8, 0.0, 3.0]])
    room = search.prune(Room(torch.cat((false, TRUE, false))), 1)
    torch.testing.assert_close(room.planes, torch.cat((false, TRUE)), rtol=0, atol=0)


def test_candidates_are_sharpened_and_apart(search, grid):
    planes = [candidate.plane for candidate in search.propose(Room(TRUE[:1]), grid)]
    assert len(planes) == 2
    for plane in planes:
        assert (TRUE[1:] - plane).abs().amax(1).min() < 0.03


def test_a_search_ends_when_the_time_is_up(search, grid):
    with stages.watched(1e-9):
        assert len(search.grow(Room(TRUE[:1]), 5, lambda room: search.extend(room, grid))[0]) == 1
        assert search.sweep(Room(TRUE[:1] + 1), [0]).planes[0, 3] > 3
