"""Radio maps: where their points lie, whose they are, and that they survive a file."""

import numpy as np
import pytest
import torch

import gaigs
from gaigs.data import Grid, Receiver, Scene
from gaigs.geometry import Pose
from gaigs.model import Model, Prediction
from gaigs.radio_map import POINTS, RadioMap, radio_map


class Slope(Model):
    """An RSSI that tells where its transmitter stands and who hears it."""

    def forward(self, batch):
        weights = batch.transmitters.new_tensor([1, 10, 100])
        return Prediction(batch.transmitters @ weights - 1000 * torch.as_tensor(batch.receivers), {})


def scene(upper=(4.0, 2.0, 1.5), grid=None, far=(5.0, 1.0, 2.5)):
    gateways = {"door": (0.0, -0.2, 2.0), "window": far}
    receivers = tuple(Receiver(name, Pose(torch.tensor(p), torch.eye(3))) for name, p in gateways.items())
    return Scene(receivers, torch.tensor([1.0, 0.5, 0.5]), torch.tensor(upper), 0.3, grid, "dBm")


def test_each_value_is_that_of_its_place_and_receiver():
    drawn = radio_map(Slope(scene()), pitch=0.25)
    assert drawn.receivers == ("door", "window")
    assert drawn.height == 1.0
    assert drawn.values.shape == (2, len(drawn.y), len(drawn.x))
    truth = drawn.x + 10 * drawn.y[:, None] + 100 * drawn.height - 1000 * np.arange(2)[:, None, None]
    np.testing.assert_allclose(drawn.values, truth, atol=1e-3)


def test_map_covers_transmitters_gateways_and_the_margin_with_multiples_of_the_pitch():
    drawn = radio_map(Slope(scene()), pitch=0.25, margin=0.35)
    for axis, lower, upper in ((drawn.x, -0.35, 5.35), (drawn.y, -0.55, 2.35)):
        assert lower - 0.25 < axis[0] <= lower < upper <= axis[-1] <= upper + 0.25
        np.testing.assert_allclose(axis, 0.25 * np.round(axis / 0.25), atol=1e-12)
        np.testing.assert_allclose(np.diff(axis), 0.25)


def test_pitch_is_a_decimetre_unless_the_room_is_large():
    drawn = radio_map(Slope(scene()))
    np.testing.assert_allclose(np.diff(drawn.x), 0.1)
    hall = radio_map(Slope(scene(upper=(300.0, 40.0, 1.5))))
    assert POINTS <= len(hall.x) <= POINTS + 2
    np.testing.assert_allclose(np.diff(hall.y), np.diff(hall.x)[0])


def test_a_row_of_transmitters_still_makes_a_plane():
    receivers = (Receiver("end", Pose(torch.zeros(3), torch.eye(3))),)
    row = Scene(receivers, torch.tensor([0.0, 0, 1]), torch.tensor([2.0, 0, 1]), 0.3, None, "dBm")
    assert radio_map(Slope(row), pitch=0.5, margin=0).values.shape == (1, 2, 6)


def test_height_and_receivers_may_be_chosen():
    drawn = radio_map(Slope(scene()), pitch=0.5, height=2, receivers=["window"])
    assert (drawn.height, drawn.receivers) == (2.0, ("window",))
    assert drawn.values[0, 0, 0] == pytest.approx(drawn.x[0] + 10 * drawn.y[0] + 200 - 1000, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pitch": 0}, "pitch above 0.*got pitch 0,"),
        ({"pitch": float("nan")}, "got pitch nan,"),
        ({"margin": -1.0}, "margin of at least 0.*margin -1.0"),
        ({"height": float("inf")}, "finite height.*height inf"),
        ({"receivers": []}, "at least one receiver"),
        ({"receivers": ["roof"]}, "receivers must be among door, window, got 'roof'"),
    ],
)
def test_what_makes_no_map_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        radio_map(Slope(scene()), **options)


def test_spectra_make_no_map():
    with pytest.raises(ValueError, match="takes a model of RSSI, got one of spectra"):
        radio_map(Slope(scene(grid=Grid.degrees())))


def test_file_holds_the_map_and_its_axes(tmp_path):
    drawn = radio_map(Slope(scene()), pitch=0.5)
    drawn.save(tmp_path / "floor")
    with np.load(tmp_path / "floor", allow_pickle=False) as file:
        assert set(file.files) == {"values_dbm", "x", "y", "height", "receivers"}
        assert file["values_dbm"].dtype == np.float32
    loaded = RadioMap.load(tmp_path / "floor")
    for name in ("values", "x", "y"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(drawn, name))
    assert (loaded.height, loaded.receivers) == (drawn.height, drawn.receivers)


def test_public_name_is_the_function_though_its_module_bears_it_too():
    assert gaigs.radio_map is radio_map
