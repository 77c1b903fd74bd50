"""Results as plots and data sets: each answers its question with units, on axes of the caller too."""

import sys

import numpy as np
import pytest
import torch
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import gaigs
from gaigs.core.task.spectrum import Spectrum
from gaigs.planes.learnt_room import LearntPlane, LearntRoom

PLACES = [[1.0, 2.0, 1.5], [2.0, 1.0, 1.0], [3.0, 2.5, 1.2]]


@pytest.fixture(autouse=True)
def pyplot_is_clean():
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def rssi():
    links = gaigs.links("synthetic_rssi", transmitters=60)
    return gaigs.train("gaussian_process", links), links


@pytest.fixture(scope="module")
def results(rssi):
    model, links = rssi
    floor = LearntPlane(
        0, np.array([[0.0, 0, 0], [4, 0, 0], [4, 3, 0]]), np.array([0.0, 0, -1]), 0.5
    )
    wall = LearntPlane(
        1, np.array([[0.0, 0, 0], [0, 3, 0], [0, 3, 2]]), np.array([-1.0, 0, 0]), 0.3
    )
    return {
        "map": gaigs.radio_map(model, pitch=1.0),
        "estimate": model.predict(PLACES, interval=0.9),
        "scores": gaigs.evaluate(model, links, baselines=["mean"]),
        "location": gaigs.locate(model, [-50.0, -48.0, -55.0, -61.0]),
        "plan": gaigs.survey(model, count=3),
        "room": LearntRoom([floor, wall], None, []),
    }


LABELS = {
    "map": ("x [m]", "y [m]"),
    "estimate": ("number of the place", "RSSI [dBm]"),
    "scores": ("MAE [dB]", "share of 48 test links"),
    "location": ("x [m]", "y [m]"),
    "plan": ("x [m]", "y [m]"),
    "room": ("x [m]", "y [m]"),
}


@pytest.mark.parametrize("name", LABELS)
def test_each_result_is_drawn_with_units_on_axes_of_the_caller(results, name):
    options = {"receiver": "west"} if name == "map" else {}
    pyplot.close("all")
    ax = Figure().subplots()
    assert results[name].plot(ax, **options) is ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == LABELS[name]
    ax.figure.draw_without_rendering()
    assert not pyplot.get_fignums(), "no other figure is made"


@pytest.mark.parametrize("name", LABELS)
def test_without_axes_a_figure_asks_its_question(results, name):
    axes = gaigs.plot(results[name])
    (first, *_) = np.ravel(axes)
    assert isinstance(first, Axes)
    assert first.figure.get_suptitle().endswith("?")
    assert len(pyplot.get_fignums()) == 1, "a notebook shows the figures of pyplot"
    panels = {"map": 4, "room": 2}  # the plan's curve is flat
    assert np.size(axes) == panels.get(name, 1)


def test_a_map_is_drawn_with_what_links_know(results, rssi):
    ax = results["map"].plot(receiver="south", links=rssi[1])
    assert ax.get_title() == "south"
    (gateway,) = ax.lines
    assert gateway.get_xydata().tolist() == [rssi[1].receivers[1].pose.position[:2].tolist()]
    deviations = results["map"].plot(receiver=1, deviation=True)
    np.testing.assert_array_equal(deviations.images[0].get_array(), results["map"].deviations[1])


def test_intervals_are_the_bars(results):
    ax = results["estimate"].plot(receiver="east")
    (bars,) = ax.collections
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])  # (places, 2)
    found = results["estimate"]
    np.testing.assert_allclose(ends, np.stack((found.lower[:, 2], found.upper[:, 2]), 1), rtol=1e-5)


def two_lines(error):
    lines = str(error.value).splitlines()
    assert len(lines) == 2
    return lines


def test_mistakes_end_in_two_lines(results, monkeypatch):
    with pytest.raises(ValueError, match="receiver") as error:
        results["map"].plot(Figure().subplots())
    assert "west" in two_lines(error)[0]
    with pytest.raises(ValueError, match="no option 'reciever'"):
        results["map"].plot(reciever="west")
    with pytest.raises(ValueError, match="receiver must be one of 0 = west"):
        results["map"].plot(receiver="attic")
    with pytest.raises(TypeError, match="one axes of matplotlib, got ndarray"):
        results["map"].plot(Figure().subplots(2))
    with pytest.raises(TypeError, match="got list") as error:
        gaigs.plot([1.0])
    assert "RadioMap" in two_lines(error)[0]
    with pytest.raises(ValueError, match="links") as error:
        results["room"].plot(show_paths=True)
    two_lines(error)
    for name, show in (("matplotlib", results["map"].plot), ("xarray", results["map"].to_xarray)):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ImportError) as error:
            show()
        assert two_lines(error)[1] == f"pip install {name}"


def test_spectra_and_channels_show_one_place():
    links = gaigs.links("synthetic", transmitters=60, order=0)
    spectra = gaigs.train("knn", links).predict(PLACES, interval=0.5)
    ax = spectra.plot(place=1)
    np.testing.assert_array_equal(ax.collections[0].get_array(), spectra.value[1, 0])
    links = gaigs.links("synthetic_csi", transmitters=60, order=0)
    channels = gaigs.train("gaussian_process", links).predict(PLACES, interval=0.5)
    with pytest.raises(ValueError, match="place must be from 0 to"):
        channels.plot(place=99)
    (line,) = channels.plot(place=2).lines
    strongest = channels.value[2, 0].abs().square().sum(1).argmax()
    truth = 20 * channels.value[2, 0, strongest].abs().log10()
    np.testing.assert_allclose(line.get_ydata(), truth, rtol=1e-4)


# --- xarray ---


def test_predictions_have_coordinates(rssi, results):
    pytest.importorskip("xarray")
    found = results["estimate"].to_xarray()
    assert found.value.dims == ("place", "receiver")
    assert found.receiver.values.tolist() == ["west", "south", "east", "north"]
    assert found.y.values.tolist() == [2.0, 1.0, 2.5]
    assert (found.value.units, found.x.units) == ("dBm", "m")
    south = results["estimate"].upper[0, 1].item()
    assert found.upper.sel(receiver="south").values[0] == pytest.approx(south)
    model, _ = rssi
    values = model.to_xarray(torch.rand(2, 3, 3), receiver="east")
    assert values.value.dims == ("place_0", "place_1")
    assert [*values.data_vars] == ["value"]
    assert {*values.receiver.values.ravel()} == {"east"}
    floor = results["map"].to_xarray()
    x, y = floor.x.values[1], floor.y.values[2]
    assert floor.value.sel(receiver="west", x=x, y=y) == results["map"].values[0, 2, 1]


def test_labels_have_their_own_axes():
    pytest.importorskip("xarray")
    links = gaigs.links("synthetic", transmitters=20, order=0)
    model = gaigs.train("mean", links)
    found = model.to_xarray(PLACES)
    assert found.value.dims == ("place", "receiver", "elevation", "azimuth")
    assert isinstance(links.task, Spectrum)
    assert found.elevation.values[:2].tolist() == [1.0, 2.0]
    few = gaigs.Grid.degrees(elevations=[10, 20], azimuths=[0, 90, 180])
    found = model.to_xarray(PLACES[0], directions=few)
    np.testing.assert_allclose(found.azimuth.values, [0, 90, 180], atol=1e-5)
    links = gaigs.links("synthetic_csi", transmitters=20, order=0)
    model = gaigs.train("friis", links)
    found = model.to_xarray(PLACES, frequencies=links.task.frequencies[3:5])
    np.testing.assert_allclose(found.subcarrier.values, links.task.frequencies[3:5].double())
    assert found.value.dtype.kind == "c"
