"""Radio maps: where their points lie, whose they are, and that they survive a file."""

import re
import time

import numpy as np
import pytest
import torch

from gaigs.core import stages
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import ExtrapolationWarning, Grid, Pose
from gaigs.core.radio_maps import RadioMap, radio_map
from gaigs.core.scene import Scene
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.scalar import Scalar
from gaigs.core.task.spectrum import Spectrum
from gaigs.model import Model, Prediction


class DelaySpread(Scalar):
    name, quantity, unit, error_unit = "delay_spread", "delay spread", "ns", "ns"


class Narrow(Csi):
    """One complex number a link, without axes."""

    shape = ()


class Slope(Model):
    """An RSSI that tells where its transmitter stands and who hears it."""

    def forward(self, batch):
        query = batch.query
        value = query.transmitters @ torch.tensor([1.0, 10, 100]) - 1000 * query.receivers
        return Prediction(
            value if query.frequencies is None else value + query.frequencies / 1e9, {}
        )


def scene(upper=(4.0, 2.0, 1.5), task=None, far=(5.0, 1.0, 2.5), frequencies=()):
    gateways = {"door": (0.0, -0.2, 2.0), "window": far}
    receivers = tuple(
        Receiver(name, Pose(torch.tensor(p), torch.eye(3))) for name, p in gateways.items()
    )
    corners = torch.tensor([1.0, 0.5, 0.5]), torch.tensor(upper)
    return Scene(receivers, *corners, 0.3, task or Rssi(), torch.tensor(frequencies))


def test_each_value_is_that_of_its_place_and_receiver():
    drawn = radio_map(Slope(scene()), pitch=0.25)
    assert drawn.receivers == ("door", "window")
    assert drawn.height == 1.0
    assert drawn.values.shape == (2, len(drawn.y), len(drawn.x))
    truth = (
        drawn.x + 10 * drawn.y[:, None] + 100 * drawn.height - 1000 * np.arange(2)[:, None, None]
    )
    np.testing.assert_allclose(drawn.values, truth, atol=1e-3)


def test_a_slow_model_draws_a_coarser_map_of_the_same_points():
    fine = radio_map(Slope(scene()))
    with stages.watched(limit=1e-9, shown=False):  # no time is left: any model is too slow
        coarse = radio_map(Slope(scene()))
    doublings = np.log2((coarse.x[1] - coarse.x[0]) / (fine.x[1] - fine.x[0]))
    assert doublings >= 1
    assert doublings == pytest.approx(round(doublings))
    assert 40 < len(coarse.x) * len(coarse.y) <= 200
    rows, columns = (
        np.isclose(a[:, None], b, atol=1e-9).any(1)
        for a, b in ((fine.y, coarse.y), (fine.x, coarse.x))
    )
    rows_there, columns_there = (
        np.isclose(b[:, None], a, atol=1e-9).any(1)
        for a, b in ((fine.y, coarse.y), (fine.x, coarse.x))
    )
    np.testing.assert_allclose(
        coarse.values[:, rows_there][..., columns_there],
        fine.values[:, rows][..., columns],
        atol=1e-3,
    )


def test_a_slow_first_prediction_makes_no_map_coarser(monkeypatch):
    class Loading(Slope):
        """A model whose first prediction takes a minute, by a clock that it winds on itself."""

        seconds = 0.0

        def forward(self, batch):
            self.seconds += 0 if self.seconds else 60
            return super().forward(batch)

    model = Loading(scene())
    monkeypatch.setattr(time, "perf_counter", lambda: model.seconds + 1e-3 * next(ticks))
    ticks = iter(range(10**6))
    assert len(radio_map(model).x) == len(radio_map(Slope(scene())).x)


def test_map_covers_transmitters_gateways_and_the_margin_with_multiples_of_the_pitch():
    drawn = radio_map(Slope(scene()), pitch=0.25, margin=0.35)
    for axis, lower, upper in ((drawn.x, -0.35, 5.35), (drawn.y, -0.55, 2.35)):
        assert lower - 0.25 < axis[0] <= lower < upper <= axis[-1] <= upper + 0.25
        np.testing.assert_allclose(axis, 0.25 * np.round(axis / 0.25), atol=1e-12)
        np.testing.assert_allclose(np.diff(axis), 0.25)


def test_height_and_receivers_may_be_chosen():
    for receivers in ({"window": 1}.keys(), "window", 1):
        drawn = radio_map(Slope(scene()), pitch=0.5, height=2, receivers=receivers)
        assert (drawn.height, drawn.receivers) == (2.0, ("window",))
    assert repr(drawn) == (
        "<radio map of RSSI [dBm]: window; 9 x 14 points, x -0.50 to 6.00 and y -1.00 to 3.00, z "
        "2.00 m>"
    )
    assert drawn.values[0, 0, 0] == pytest.approx(
        drawn.x[0] + 10 * drawn.y[0] + 200 - 1000, abs=1e-3
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"pitch": pitch}, "pitch must be above 0, .* give at most")
            for pitch in (0, float("nan"), 1e9, 1e-9)
        ),
        ({"margin": -1.0}, "margin at least 0 .m., got height 1.0 and margin -1.0"),
        ({"height": float("inf")}, "height must be finite .* got height inf"),
        (
            {"receivers": []},
            r"receiver must be one of 0 = door, 1 = window, got \(0,\) of torch.float64",
        ),
        ({"receivers": ["roof"]}, "receiver must be one of 0 = door, 1 = window, got 'roof'"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        radio_map(Slope(scene()), **options)
    with pytest.raises(
        TypeError, match=r"model must be one that gaigs\.load gives, got 'best\.ckpt'"
    ):
        radio_map("best.ckpt")


@pytest.mark.parametrize("content", [b"", b"{}", b"PK", "another"])
def test_another_file_is_no_map(content, tmp_path):
    file = tmp_path / "map.npz"
    np.savez(file, y=3) if content == "another" else file.write_bytes(content)
    with pytest.raises(ValueError, match=r"map\.npz is damaged or not a file of RadioMap\.save"):
        RadioMap.load(file)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            Spectrum(*vars(Grid.degrees()).values(), ""),
            r"'spectrum', whose labels are \(90, 360\) of torch.float32",
        ),
        (Narrow(1, torch.tensor([2.4e9])), r"'csi', whose labels are \(\) of torch.complex64"),
    ],
)
def test_a_task_without_one_real_number_a_link_is_refused(task, message):
    with pytest.raises(
        ValueError, match=f"takes a model of one real number a link, got one of task {message}"
    ):
        radio_map(Slope(scene(task=task)))


def test_carrier_is_the_training_links_of_several_the_middle_one_or_the_one_asked_for():
    pitch = {"pitch": 0.5}
    unknown = radio_map(Slope(scene()), **pitch)
    assert unknown.frequency is None
    for carriers, asked, used in (
        ((7e9,), None, 7e9),
        ((5e9, 7e9, 12e9), None, 7e9),
        ((5e9, 12e9), 9e9, 9e9),
        ((7e9,), 7e9, 7e9),
    ):
        drawn = radio_map(Slope(scene(frequencies=carriers)), frequency=asked, **pitch)
        assert drawn.frequency == used
        np.testing.assert_allclose(drawn.values, unknown.values + used / 1e9, atol=1e-3)
    with pytest.raises(ValueError, match="frequency must be a carrier in Hz"):
        radio_map(Slope(scene()), frequency=-1.0)
    with pytest.raises(
        ValueError, match=r"have one carrier, 7e\+09 Hz, so no other can be predicted"
    ):
        radio_map(Slope(scene(frequencies=(7e9,))), frequency=9e9)


@pytest.mark.parametrize("pitch", [None, 0.5])
def test_a_band_is_left_with_one_warning(pitch):
    with pytest.warns(ExtrapolationWarning) as warned:
        radio_map(Slope(scene(frequencies=(5e9, 12e9))), pitch, margin=50.0, frequency=60e9)
    (only,) = warned
    assert re.search(
        r"at 6e\+10 Hz, outside the training links' band of 5e\+09 to 1\.2e\+10 Hz",
        str(only.message),
    )


@pytest.mark.parametrize("options", [{"height": 1200.0}, {"margin": 500.0}])
def test_sizes_in_millimetres_warn(options):
    ((name, value),) = options.items()
    with pytest.warns(
        ExtrapolationWarning,
        match=rf"^{name} puts transmitters .* is 5\.\d+ m across; is it in m\?$",
    ):
        radio_map(Slope(scene()), 50.0 if name == "margin" else 2.0, **{name: value})


def test_file_holds_the_map_and_its_axes(tmp_path):
    drawn = radio_map(Slope(scene()), pitch=0.5)
    drawn.save(tmp_path / "floor")
    with np.load(tmp_path / "floor", allow_pickle=False) as file:
        assert set(file.files) == {
            "values_dbm",
            "x",
            "y",
            "height",
            "receivers",
            "quantity",
            "unit",
        }
        assert file["values_dbm"].dtype == np.float32
        assert (str(file["quantity"]), str(file["unit"])) == ("RSSI", "dBm")
    same(RadioMap.load(tmp_path / "floor"), drawn)


@pytest.mark.parametrize(
    ("unit", "key"), [("ns", "values_ns"), ("dB", "values_db"), ("dB/m", "values"), ("", "values")]
)
def test_file_names_the_values_by_their_unit(tmp_path, unit, key):
    task = DelaySpread()
    task.unit = unit
    drawn = radio_map(Slope(scene(task=task, frequencies=(2.5e9,))), pitch=0.5)
    assert (drawn.quantity, drawn.unit) == ("delay spread", unit)
    drawn.save(tmp_path / "floor.npz")
    with np.load(tmp_path / "floor.npz") as file:
        assert key in file.files
        assert float(file["frequency"]) == 2.5e9
    same(RadioMap.load(tmp_path / "floor.npz"), drawn)


def same(one, other):
    for name in ("values", "x", "y"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("height", "receivers", "quantity", "unit", "frequency"):
        assert getattr(one, name) == getattr(other, name)
