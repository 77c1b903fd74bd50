"""Rooms that are drawn for spectra: of several shapes, with furniture off walls and array."""

import pytest
import torch
from spectrum_rooms import draw_room


@pytest.mark.parametrize("number", range(4))
def test_furniture_of_a_drawn_room_is_within_it_and_leaves_the_array_free(number):
    room = draw_room(number)
    corners = torch.tensor([room.floor, room.ceiling])
    array = torch.tensor([room.antenna[0]])
    assert len(room.furniture) >= 3
    for piece in room.furniture:
        places = torch.tensor(piece.mesh().vertices)[:, :2]
        assert (places > corners.amin((0, 1))).all()
        assert (places < corners.amax((0, 1))).all()
        assert not piece.contains(array, 0.15).any()


def test_drawn_rooms_are_the_same_each_time_and_differ_in_shape():
    assert draw_room(5) == draw_room(5)
    assert [len(draw_room(number).floor) for number in range(4)] == [4, 6, 4, 5]
    assert draw_room(2).ceiling != draw_room(2).floor
