"""Predicted against measured values and radio maps, read back from their artists."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.contour import QuadContourSet

from gaigs.core.radio_maps import RadioMap
from gaigs.core.task.rssi import Rssi
from gaigs.data import Split
from gaigs.report import scalar
from gaigs.report.radio_maps import map_pages, radio_maps
from gaigs.report.scalar import predicted_against_measured
from gaigs.report.style import round_step
from gaigs.testing import example_links


def task(quantity, unit, error_unit):
    made = Rssi()
    made.quantity, made.unit, made.error_unit = quantity, unit, error_unit
    return made


NANOSECONDS = task("delay spread", "ns", "ns")


def panels(figure):
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def note(figure):
    """The note at the foot, in the legend if there is one."""
    head = [legend.get_title().get_text() for legend in figure.legends]
    return "".join(head) or figure.get_supxlabel()


def counts(ax):
    mesh = ax.collections[0]
    return mesh.get_coordinates()[0, :, 0], mesh.get_array().filled(0)


def counted(*readings):
    """Readings are counted, however few they are."""
    return predicted_against_measured(*readings, max_dots=0)


def test_few_readings_are_dots_and_many_are_counted():
    labels = np.linspace(-80, -50, 2 * 400 + 1)

    def draw(count):
        return predicted_against_measured(
            labels[:count], labels[:count] + 1, np.arange(count) % 2, ["west", "east"], Rssi()
        )

    (few,), (many,) = draw(2 * 400), draw(2 * 400 + 1)
    assert len(few.axes) == 2, "no bar of colours"
    np.testing.assert_array_equal(
        few.axes[1].lines[0].get_xydata(), np.stack((labels, labels + 1), 1)[1:-1:2]
    )
    assert counts(many.axes[0])[1].sum() == 400 + 1


def test_readings_are_counted_where_they_were_measured_and_predicted():
    labels, predictions = (
        np.array([-61.0, -61, -70, -50, -43]),
        np.array([-55.0, -55.5, -70, -50.5, -44]),
    )
    receiver = np.array([1, 1, 1, 2, 2])
    (figure,) = counted(labels, predictions, receiver, ["silent", "hall", "[attic]"], Rssi())
    hall, attic = panels(figure)
    assert hall.get_title() == "hall, MAE 3.83 dB"  # (6 + 5.5 + 0) / 3
    assert attic.get_title() == "[attic], MAE 0.75 dB"
    edges, count = counts(hall)
    np.testing.assert_allclose(np.diff(edges), 2)

    def cell(value):
        return np.searchsorted(edges, value, side="right") - 1

    assert count[cell(-55.2), cell(-61)] == 2  # predictions upwards, labels to the right
    assert count[cell(-70), cell(-70)] == 1
    assert count.sum() == 3
    assert counts(attic)[1].sum() == 2
    assert hall.collections[0].norm is attic.collections[0].norm


def test_many_receivers_take_several_figures():
    labels = np.linspace(-80, -50, 80)
    drawn = predicted_against_measured(
        labels, labels, np.arange(80) % 8, [f"g{i}" for i in range(8)], Rssi(), max_panels=6
    )
    assert [len(panels(figure)) for figure in drawn] == [4, 4], "pages are of one size"
    assert panels(drawn[1])[0].get_title().startswith("g4,")
    assert len({tuple(figure.get_size_inches()) for figure in drawn}) == 1


@pytest.mark.parametrize("scale", [1e-9, 0.03, 1.0, 4e6])
def test_cells_and_margins_follow_from_the_data_in_other_units(scale):
    rng = np.random.default_rng(6)
    labels = scale * rng.gamma(2, 30, 3000)
    predictions = labels + scale * rng.normal(0, 10, 3000)
    predictions[0] = 1e9 * scale
    (figure,) = counted(labels, predictions, np.zeros(3000, int), ["hall"], NANOSECONDS)
    (ax,) = panels(figure)
    edges, count = counts(ax)
    assert count.sum() == 3000
    cell = np.diff(edges).mean()
    np.testing.assert_allclose(np.diff(edges), cell)
    assert 40 / 2.6 < np.ptp(labels) / cell <= 40  # steps of 1, 2 and 5 are up to 2.5 apart
    digit = cell / 10 ** np.floor(np.log10(cell * 1.001))
    assert digit == pytest.approx(1) or digit == pytest.approx(2) or digit == pytest.approx(5)
    assert edges[-1] <= labels.max() + (20 + 2) * cell
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        "label, delay spread [ns]",
        "prediction, delay spread [ns]",
    )
    written = float(ax.get_title().removeprefix("hall, MAE ").removesuffix(" ns"))
    assert written == pytest.approx(np.abs(predictions - labels).mean(), rel=6e-3)
    assert f"in {cell:g} ns × {cell:g} ns" in figure.axes[-1].get_ylabel()


@pytest.mark.parametrize("task", [NANOSECONDS, Rssi()])
@pytest.mark.parametrize(
    "labels", [np.full(4, 7.0), np.zeros(4), np.arange(11) / 10, -60 - 2.0 * np.arange(4)]
)
def test_every_reading_is_inside(labels, task):
    (figure,) = counted(labels, labels, np.zeros(len(labels), int), ["a"], task)
    (ax,) = panels(figure)
    assert counts(ax)[1].sum() == len(labels)
    assert ax.get_xlim() == ax.get_ylim()


# --- radio maps ---

WALLS = np.array(
    [
        [[0.0, 0, 0], [6, 0, 0]],
        [[6.0, 0, 0], [6, 3, 0]],
        [[6.0, 0, 0], [6, 0, 2]],
        [[1.0, 1, 1], [9, 9, 1]],
    ]
)


def maps(count, x=None, y=None, seed=3, scale=1.0, **words):
    x, y = 0.5 * np.arange(-1, 12) if x is None else x, 0.5 * np.arange(-1, 7) if y is None else y
    values = scale * np.random.default_rng(seed).uniform(-80, -50, (count, len(y), len(x))).astype(
        np.float32
    )
    return RadioMap(values, x, y, 1.25, tuple(f"g{i}" for i in range(count)), **words)


def draw(radio_map, readings=None, edges=WALLS, gateways=None):
    names = radio_map.receivers
    readings = {name: np.array([[1.0, 2, -60]]) for name in names} if readings is None else readings
    gateways = (
        {name: np.array([i, 0.5, 2.0]) for i, name in enumerate(names)}
        if gateways is None
        else gateways
    )
    return radio_maps(radio_map, gateways, readings, edges)


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
    assert "1.25 m" in note(figure)


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
    assert [segment.tolist() for segment in lines.get_segments()] == [
        [[0, 0], [6, 0]],
        [[6, 0], [6, 3]],
    ]
    assert ax.get_xlim()[1] > 6
    draw(maps(1), edges=np.zeros((0, 2, 3)))


def test_few_of_many_readings_are_drawn_from_first_to_last():
    many = np.column_stack((np.linspace(0, 5, 1000), np.ones(1000), np.full(1000, -60.0)))
    (figure,) = draw(maps(1), {"g0": many})
    places = dots(panels(figure)[0]).get_offsets()[:, 0]
    assert 100 / 2 < len(places) <= 100
    np.testing.assert_allclose(np.diff(places), np.diff(places)[0])
    assert places[-1] > 4.9
    draw(maps(1), {"g0": many[:0]})


def test_levels_have_lines_every_ten_decibels_and_the_scale_ends_on_fives():
    slope = maps(1)
    slope.values[0] = -77 + 3 * slope.x  # -78.5 to -60.5 dBm along x
    (figure,) = draw(slope)
    (contours,) = (
        artist for artist in panels(figure)[0].collections if isinstance(artist, QuadContourSet)
    )
    assert contours.levels.tolist() == [-70]
    assert note(figure).endswith("at z = 1.25 m, a line every 10 dB")
    assert panels(figure)[0].images[0].get_clim() == (-80, -55)
    assert figure.axes[-1].get_ylabel() == "RSSI [dBm]"


def test_a_constant_deviation_is_a_sentence_and_no_map():
    drawn = maps(3)
    deviations = np.full(drawn.values.shape, 3.25, np.float32)
    deviations[2] += np.linspace(0, 2, deviations[2].size).reshape(deviations[2].shape)
    pages = map_pages(replace(drawn, deviations=deviations), {}, {}, WALLS)
    assert [*pages] == ["radio_map", "deviation_map"]
    titles = [ax.get_title() for ax in panels(pages["radio_map"])]
    assert titles == ["g0, ± 3.25 dB everywhere", "g1, ± 3.25 dB everywhere", "g2"]
    assert [ax.get_title() for ax in panels(pages["deviation_map"])] == ["g2"]
    assert "standard deviation of RSSI" in note(pages["deviation_map"])
    pages = map_pages(replace(drawn.only(np.arange(2)), deviations=deviations[:2]), {}, {}, WALLS)
    assert [*pages] == ["radio_map"]


@pytest.mark.parametrize("scale", [-1e-6, -1.0, -1e5])
def test_lines_and_colours_follow_from_the_data_in_other_units(scale):
    drawn = maps(
        1, scale=scale, quantity="delay spread", unit="ns", frequency=2.45e9
    )  # 50 to 80 times the scale
    (figure,) = draw(drawn, {"g0": np.array([[1.0, 2, -60 * scale]])})
    (ax,) = panels(figure)
    (contours,) = (artist for artist in ax.collections if isinstance(artist, QuadContourSet))
    step = np.diff(contours.levels).mean()
    assert 3 <= len(contours.levels) <= 8
    np.testing.assert_allclose(contours.levels / step, np.round(contours.levels / step))
    low, high = ax.images[0].get_clim()
    assert -48 * scale < low <= 51 * -scale
    assert -79 * scale <= high < -83 * scale
    assert note(figure) == (
        f"Predicted delay spread of a transmitter at z = 1.25 m at 2.45 GHz, a line every {step:g} "
        "ns"
    )
    assert figure.axes[-1].get_ylabel() == "delay spread [ns]"


def test_a_flat_map_of_zeros_has_colours():
    flat = maps(1, unit="ns")
    flat.values[:] = 0
    (figure,) = draw(flat, {"g0": np.array([[1.0, 2, 0]])})
    low, high = panels(figure)[0].images[0].get_clim()
    assert low <= 0 < high


def test_a_wild_map_has_no_endless_lines():
    wild = maps(1)
    wild.values[0, 2, 2] = 1e9
    (figure,) = draw(wild)
    (contours,) = (
        artist for artist in panels(figure)[0].collections if isinstance(artist, QuadContourSet)
    )
    assert len(contours.levels) < 40


@pytest.mark.parametrize("count", [1, 8, 10])
def test_no_panel_is_lost_and_the_lowest_tell_their_metres(count):
    figures = draw(maps(count))
    for figure in figures:
        figure.draw_without_rendering()  # which places the panels
    assert [ax.get_title() for figure in figures for ax in panels(figure)] == [
        f"g{i}" for i in range(count)
    ]
    for figure in figures:
        assert figure.get_figwidth() < 7.2
        assert figure.get_figheight() < 9
        for ax in panels(figure):
            below = [
                other for other in panels(figure) if other.get_position().y1 < ax.get_position().y0
            ]
            same = [o for o in below if abs(o.get_position().x0 - ax.get_position().x0) < 1e-3]
            assert (
                ax.xaxis.get_tick_params()["labelbottom"]
                == (ax.get_xlabel() == "x [m]")
                == (not same)
            )


@pytest.mark.parametrize(
    ("span", "most", "step"),
    [(40, 40, 1), (41, 40, 2), (81, 40, 5), (201, 40, 10), (3e-9, 10, 5e-10), (7e8, 7, 1e8)],
)
def test_steps_are_round(span, most, step):
    assert round_step(span, most) == pytest.approx(step)


def test_colours_hold_the_map_and_the_readings_but_not_a_peak():
    drawn = maps(1)
    drawn.values[0, 2, 2] = 20
    (figure,) = draw(drawn, {"g0": np.array([[0.0, 0, -97.0]])})
    low, high = panels(figure)[0].images[0].get_clim()
    assert low <= -97
    assert -52 < high < 0


def test_a_run_draws_the_receivers_with_most_readings(tmp_path):
    receiver = np.repeat(np.arange(20), np.where(np.arange(20) % 2, 3, 5))
    links = example_links("rssi")
    receivers = tuple(replace(links.receivers[0], name=f"g{i}") for i in range(20))
    places, labels = np.zeros((len(receiver), 3)), -60 - np.arange(len(receiver)) / 9
    arrays = {"transmitters": places, "receiver": receiver, "labels": labels, "prediction": labels}
    np.savez(tmp_path / "predictions.npz", **arrays, error_knn=labels)
    maps(20).save(tmp_path / "radio_map.npz")
    links = replace(
        links, receivers=receivers, split=Split("random", *torch.zeros(3, 0, dtype=torch.long))
    )
    drawn = scalar.ScalarFigures().of_run(Rssi(), tmp_path, links)
    assert {*drawn} == {"error_cdf", "radio_map", "predicted_against_measured"}
    titles = [ax.get_title() for ax in panels(drawn["radio_map"])]
    assert titles == [f"g{i}" for i in range(0, 18, 2)]
    assert "9 of 20 receivers" in note(drawn["radio_map"])
    assert note(drawn["predicted_against_measured"]) == "9 of 20 receivers"
