"""What the figure of a radio map shows, read back from its artists."""

import warnings

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.contour import QuadContourSet

from gaigs.radio_maps import RadioMap
from gaigs.report.panels import PANELS
from gaigs.report.radio_map import DOTS, radio_maps

WALLS = np.array(
    [[[0.0, 0, 0], [6, 0, 0]], [[6.0, 0, 0], [6, 3, 0]], [[6.0, 0, 0], [6, 0, 2]], [[1.0, 1, 1], [9, 9, 1]]]
)


def maps(count, x=None, y=None, seed=3, scale=1.0, **words):
    x, y = 0.5 * np.arange(-1, 12) if x is None else x, 0.5 * np.arange(-1, 7) if y is None else y
    values = scale * np.random.default_rng(seed).uniform(-80, -50, (count, len(y), len(x))).astype(np.float32)
    return RadioMap(values, x, y, 1.25, tuple(f"g{i}" for i in range(count)), **words)


def draw(radio_map, readings=None, edges=WALLS, gateways=None, **words):
    names = radio_map.receivers
    readings = {name: np.array([[1.0, 2, -60]]) for name in names} if readings is None else readings
    gateways = {name: np.array([i, 0.5, 2.0]) for i, name in enumerate(names)} if gateways is None else gateways
    figures = radio_maps(radio_map, gateways, readings, edges, **words)
    for figure in figures:
        figure.draw_without_rendering()
    return figures


def panels(figure):
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def dots(ax):
    return next(artist for artist in ax.collections if type(artist) is PathCollection)


def test_each_receiver_has_its_map_gateway_and_readings_in_one_scale_of_colours():
    drawn = maps(2)
    readings = {"g0": np.array([[1.0, 2, -60], [3, 1, -70]]), "g1": np.array([[4.0, 1.5, -55]])}
    (figure,) = draw(drawn, readings)
    for i, ax in enumerate(panels(figure)):
        (image,) = ax.images
        np.testing.assert_array_equal(image.get_array(), drawn.values[i])
        assert ax.get_title() == drawn.receivers[i]
        assert image.get_clim() == dots(ax).get_clim() == panels(figure)[0].images[0].get_clim()
        np.testing.assert_array_equal(dots(ax).get_offsets(), readings[f"g{i}"][:, :2])
        np.testing.assert_array_equal(dots(ax).get_array(), readings[f"g{i}"][:, 2])
        (gateway,) = ax.lines
        assert gateway.get_xydata().tolist() == [[i, 0.5]]
    assert "1.25 m" in figure.get_suptitle()


def test_a_pixel_lies_around_its_point_with_y_upwards_and_metres_alike():
    (figure,) = draw(maps(1))
    (ax,) = panels(figure)
    assert ax.images[0].get_extent() == [-0.75, 5.75, -0.75, 3.25]
    assert ax.images[0].origin == "lower"
    assert ax.get_aspect() == 1
    assert ax.get_xlim()[0] < ax.get_xlim()[1]
    assert ax.get_ylim()[0] < ax.get_ylim()[1]


def test_walls_on_the_floor_are_drawn_and_in_sight():
    (figure,) = draw(maps(1, x=0.5 * np.arange(4)))
    (ax,) = panels(figure)
    (lines,) = (artist for artist in ax.collections if type(artist) is LineCollection)
    assert [segment.tolist() for segment in lines.get_segments()] == [[[0, 0], [6, 0]], [[6, 0], [6, 3]]]
    assert ax.get_xlim()[1] > 6
    draw(maps(1), edges=np.zeros((0, 2, 3)))


def test_few_of_many_readings_are_drawn_from_first_to_last():
    many = np.column_stack((np.linspace(0, 5, 1000), np.ones(1000), np.full(1000, -60.0)))
    (figure,) = draw(maps(1), {"g0": many})
    places = dots(panels(figure)[0]).get_offsets()[:, 0]
    assert DOTS / 2 < len(places) <= DOTS
    np.testing.assert_allclose(np.diff(places), np.diff(places)[0])
    assert places[-1] > 4.9
    draw(maps(1), {"g0": many[:0]})


def test_colours_hold_the_map_and_the_readings_but_not_a_peak():
    drawn = maps(1)
    drawn.values[0, 2, 2] = 20
    (figure,) = draw(drawn, {"g0": np.array([[0.0, 0, -97.0]])})
    low, high = panels(figure)[0].images[0].get_clim()
    assert low <= -97
    assert -52 < high < 0


def test_a_flat_map_is_drawn_without_a_warning():
    flat = maps(1)
    flat.values[:] = -60
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (figure,) = draw(flat)
    low, high = panels(figure)[0].images[0].get_clim()
    assert low < high


def test_levels_have_lines_every_ten_decibels_and_the_scale_ends_on_fives():
    slope = maps(1)
    slope.values[0] = -77 + 3 * slope.x  # -78.5 to -60.5 dBm along x
    (figure,) = draw(slope)
    (contours,) = (artist for artist in panels(figure)[0].collections if isinstance(artist, QuadContourSet))
    assert contours.levels.tolist() == [-70]
    assert figure.get_suptitle().endswith("at z = 1.25 m, a line every 10 dB")
    assert panels(figure)[0].images[0].get_clim() == (-80, -55)
    assert figure.axes[-1].get_ylabel() == "RSSI [dBm]"


@pytest.mark.parametrize("scale", [-1e-6, -1.0, -1e5])
def test_lines_and_colours_follow_from_the_data_in_other_units(scale):
    drawn = maps(1, scale=scale, quantity="delay spread", unit="ns", frequency=2.45e9)  # 50 to 80 times the scale
    words = {"quantity": "delay spread", "unit": "ns", "error_unit": "ns"}
    (figure,) = draw(drawn, {"g0": np.array([[1.0, 2, -60 * scale]])}, **words)
    (ax,) = panels(figure)
    (contours,) = (artist for artist in ax.collections if isinstance(artist, QuadContourSet))
    step = np.diff(contours.levels).mean()
    assert 3 <= len(contours.levels) <= 8
    np.testing.assert_allclose(contours.levels / step, np.round(contours.levels / step))
    low, high = ax.images[0].get_clim()
    assert -48 * scale < low <= 51 * -scale
    assert -79 * scale <= high < -83 * scale
    assert figure.get_suptitle() == (
        f"Predicted delay spread of a transmitter at z = 1.25 m at 2.45 GHz, a line every {step:g} ns"
    )
    assert figure.axes[-1].get_ylabel() == "delay spread [ns]"


def test_a_flat_map_of_zeros_has_colours():
    flat = maps(1, unit="ns")
    flat.values[:] = 0
    (figure,) = draw(flat, {"g0": np.array([[1.0, 2, 0]])}, unit="ns", error_unit="ns")
    low, high = panels(figure)[0].images[0].get_clim()
    assert low <= 0 < high


def test_a_wild_map_has_no_endless_lines():
    wild = maps(1)
    wild.values[0, 2, 2] = 1e9
    (figure,) = draw(wild)
    (contours,) = (artist for artist in panels(figure)[0].collections if isinstance(artist, QuadContourSet))
    assert len(contours.levels) < 40


def test_a_file_is_drawn_too_and_must_be_in_the_unit_of_the_readings(tmp_path):
    maps(1).save(tmp_path / "map.npz")
    readings, gateways = {"g0": np.array([[1.0, 2, -60]])}, {"g0": np.zeros(3)}
    (figure,) = radio_maps(tmp_path / "map.npz", gateways, readings, WALLS)
    np.testing.assert_array_equal(panels(figure)[0].images[0].get_array(), maps(1).values[0])
    with pytest.raises(ValueError, match="in the unit of the readings, 'ns', got one of RSSI in 'dBm'"):
        radio_maps(tmp_path / "map.npz", gateways, readings, WALLS, "delay spread", "ns", "ns")


@pytest.mark.parametrize("count", [1, 5, PANELS, 2 * PANELS + 1])
def test_no_panel_is_lost_and_the_lowest_tell_their_metres(count):
    figures = draw(maps(count))
    assert [ax.get_title() for figure in figures for ax in panels(figure)] == [f"g{i}" for i in range(count)]
    for figure in figures:
        assert figure.get_figwidth() < 7.2
        assert figure.get_figheight() < 9
        for ax in panels(figure):
            below = [other for other in panels(figure) if other.get_position().y1 < ax.get_position().y0]
            same = [o for o in below if abs(o.get_position().x0 - ax.get_position().x0) < 1e-3]
            assert ax.xaxis.get_tick_params()["labelbottom"] == (ax.get_xlabel() == "x [m]") == (not same)


def test_a_corridor_is_stacked_and_a_tower_stands_side_by_side():
    long, short = 0.5 * np.arange(80), 0.5 * np.arange(8)
    for x, y, stacked in ((long, short, True), (short, long, False)):
        first, second, *_ = panels(draw(maps(3, x, y), edges=WALLS[:0])[0])
        aligned = first.get_position().x0 == pytest.approx(second.get_position().x0)
        assert aligned == stacked
