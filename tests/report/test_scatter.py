"""Predicted against measured values, read back from their artists."""

import numpy as np
import pytest

from gaigs.report.scatter import BEYOND, CELL_DB, CELLS, predicted_against_measured

NANOSECONDS = {"quantity": "delay spread", "unit": "ns", "error_unit": "ns"}


def panels(figure):
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def counts(ax):
    mesh = ax.collections[0]
    return mesh.get_coordinates()[0, :, 0], mesh.get_array().filled(0)


def test_readings_are_counted_where_they_were_measured_and_predicted():
    labels, predictions = np.array([-61.0, -61, -70, -50, -43]), np.array([-55.0, -55.5, -70, -50.5, -44])
    receiver = np.array([1, 1, 1, 2, 2])
    (figure,) = predicted_against_measured(labels, predictions, receiver, ["silent", "hall", "[attic]"])
    figure.draw_without_rendering()
    hall, attic = panels(figure)
    assert hall.get_title() == "hall, MAE 3.83 dB"  # (6 + 5.5 + 0) / 3
    assert attic.get_title() == "[attic], MAE 0.75 dB"
    edges, count = counts(hall)
    np.testing.assert_allclose(np.diff(edges), CELL_DB)
    cell = lambda value: np.searchsorted(edges, value, side="right") - 1
    assert count[cell(-55.2), cell(-61)] == 2  # predictions upwards, labels to the right
    assert count[cell(-70), cell(-70)] == 1
    assert count.sum() == 3
    assert counts(attic)[1].sum() == 2
    assert hall.collections[0].norm is attic.collections[0].norm


def test_line_of_perfect_predictions_and_axes_are_common():
    rng = np.random.default_rng(4)
    labels = rng.uniform(-90, -40, 700)
    (figure,) = predicted_against_measured(labels, labels + 3, rng.integers(0, 3, 700), "abc")
    for ax in panels(figure):
        (line,) = ax.lines
        assert line.get_slope() == 1
        assert line.get_xy1()[0] == line.get_xy1()[1]
        assert ax.get_xlim() == ax.get_ylim() == panels(figure)[0].get_xlim()
        assert ax.get_aspect() == 1


@pytest.mark.parametrize("labels", [np.full(4, -60.0), np.array([-60.0, -62, -64, -66]), np.arange(4.0)])
def test_every_reading_is_inside(labels):
    (figure,) = predicted_against_measured(labels, labels, np.zeros(4, int), ["a"])
    figure.draw_without_rendering()
    assert counts(panels(figure)[0])[1].sum() == 4


def test_a_wild_prediction_keeps_its_error_and_stays_on_the_page():
    labels = np.array([-60.0, -50])
    (figure,) = predicted_against_measured(labels, np.array([-60.0, 1e9]), np.zeros(2, int), ["a"])
    (ax,) = panels(figure)
    assert ax.get_title() == "a, MAE 500000025.00 dB"
    assert ax.get_xlim()[1] == -50 + (BEYOND + 1) * CELL_DB
    assert counts(ax)[1].sum() == 2


def test_many_receivers_take_several_figures():
    labels = np.linspace(-80, -50, 80)
    drawn = predicted_against_measured(labels, labels, np.arange(80) % 8, [f"g{i}" for i in range(8)])
    assert [len(panels(figure)) for figure in drawn] == [6, 2]
    assert panels(drawn[1])[0].get_title().startswith("g6,")


@pytest.mark.parametrize("scale", [1e-9, 0.03, 1.0, 4e6])
def test_cells_and_margins_follow_from_the_data_in_other_units(scale):
    rng = np.random.default_rng(6)
    labels = scale * rng.gamma(2, 30, 3000)
    predictions = labels + scale * rng.normal(0, 10, 3000)
    predictions[0] = 1e9 * scale
    (figure,) = predicted_against_measured(labels, predictions, np.zeros(3000, int), ["hall"], **NANOSECONDS)
    figure.draw_without_rendering()
    (ax,) = panels(figure)
    edges, count = counts(ax)
    assert count.sum() == 3000
    cell = np.diff(edges).mean()
    np.testing.assert_allclose(np.diff(edges), cell)
    assert CELLS / 2.6 < np.ptp(labels) / cell <= CELLS  # steps of 1, 2 and 5 are up to 2.5 apart
    digit = cell / 10 ** np.floor(np.log10(cell * 1.001))
    assert digit == pytest.approx(1) or digit == pytest.approx(2) or digit == pytest.approx(5)
    assert edges[-1] <= labels.max() + (BEYOND + 2) * cell
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("measured delay spread [ns]", "predicted delay spread [ns]")
    written = float(ax.get_title().removeprefix("hall, MAE ").removesuffix(" ns"))
    assert written == pytest.approx(np.abs(predictions - labels).mean(), rel=6e-3)
    assert f"in {cell:g} ns × {cell:g} ns" in figure.axes[-1].get_ylabel()


@pytest.mark.parametrize("labels", [np.full(4, 7.0), np.zeros(4), np.arange(11) / 10, -np.arange(11) / 10])
def test_every_reading_is_inside_in_other_units(labels):
    (figure,) = predicted_against_measured(labels, labels, np.zeros(len(labels), int), ["a"], **NANOSECONDS)
    figure.draw_without_rendering()
    assert counts(panels(figure)[0])[1].sum() == len(labels)


def test_a_ratio_has_no_brackets():
    labels = np.linspace(0, 1, 30)
    (figure,) = predicted_against_measured(labels, labels, np.zeros(30, int), ["a"], "occupancy", "", "")
    (ax,) = panels(figure)
    assert (ax.get_xlabel(), ax.get_title()) == ("measured occupancy", "a, MAE 0.00")
    assert figure.axes[-1].get_ylabel() == "test readings in 0.05 × 0.05"
