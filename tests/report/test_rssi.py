"""Predicted against measured RSSI, and all figures of an RSSI run."""

import numpy as np
import pytest
import torch
from matplotlib import image
from matplotlib.figure import Figure

from gaigs.data import Links, Receiver, Split
from gaigs.geometry import Pose
from gaigs.radio_map import RadioMap
from gaigs.report import figures
from gaigs.report.figures import write_figures
from gaigs.report.rssi import BEYOND, CELL, predicted_against_measured


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
    np.testing.assert_allclose(np.diff(edges), CELL)
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
    assert ax.get_xlim()[1] <= -50 + BEYOND + 2 * CELL
    assert counts(ax)[1].sum() == 2


def test_many_receivers_take_several_figures():
    labels = np.linspace(-80, -50, 80)
    drawn = predicted_against_measured(labels, labels, np.arange(80) % 8, [f"g{i}" for i in range(8)])
    assert [len(panels(figure)) for figure in drawn] == [6, 2]
    assert panels(drawn[1])[0].get_title().startswith("g6,")


@pytest.fixture
def run(tmp_path):
    """Links of eight gateways and the folder of a run on them."""
    rng = np.random.default_rng(8)
    count = 8
    receivers = tuple(
        Receiver(f"g{i}", Pose(torch.tensor([float(i), 0, 2]), torch.eye(3, dtype=torch.float32))) for i in range(count)
    )
    transmitters = torch.rand(160, 3) * torch.tensor([8.0, 4, 1])
    labels = torch.linspace(-80, -50, 160)
    split = Split("random", torch.arange(80), torch.zeros(0, dtype=torch.long), torch.arange(80, 160))
    links = Links(transmitters, receivers, torch.arange(160) % count, labels, split, None, "dBm")
    test = split.test.numpy()
    errors = {name: rng.normal(0, scale, 80) for name, scale in (("gaigs", 2), ("mean", 6), ("knn", 3))}
    np.savez(
        tmp_path / "predictions.npz",
        link=test,
        transmitters=transmitters[test].numpy(),
        receiver=test % count,
        labels=labels[test].numpy(),
        prediction=labels[test].numpy() + errors["gaigs"],
        **{f"error_{name}": error for name, error in errors.items()},
    )
    names = tuple(receiver.name for receiver in receivers)
    maps = RadioMap(rng.uniform(-80, -50, (count, 9, 17)), 0.5 * np.arange(17), 0.5 * np.arange(9), 0.5, names)
    maps.save(tmp_path / "radio_map.npz")
    return links, tmp_path, errors


def test_an_rssi_run_is_drawn_into_its_folder(run, monkeypatch):
    links, folder, _ = run
    monkeypatch.setattr(figures, "DPI", 50)  # small ones are written sooner
    files = write_figures(folder, links, None)
    paged = ("predicted_against_measured", "radio_map")
    assert {file.stem for file in files} == {"room", "error_cdf", *paged, *(f"{name}_2" for name in paged)}
    for file in files:
        assert file.parent == folder / "figures"
        assert image.imread(file)[..., :3].std() > 0.02  # something is drawn on the white


def test_figures_show_the_run(run, monkeypatch):
    links, folder, errors = run
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)
    shown = {}
    for name in ("cdf", "radio_maps", "room"):
        original = getattr(figures, name)
        spy = lambda *args, name=name, original=original: shown.setdefault(name, (args, original(*args)))[1]
        monkeypatch.setattr(figures, name, spy)
    write_figures(folder, links, None)
    (absolute, *_), drawn = shown["cdf"]
    assert list(absolute) == ["gaigs", "mean", "knn"]
    np.testing.assert_allclose(absolute["mean"], np.abs(errors["mean"]))
    (ax,) = drawn.axes
    assert ax.get_xlim() == (0, pytest.approx(np.quantile(np.abs(errors["mean"]), 0.99)))
    assert ax.get_xlabel() == "|error| [dB], split random"
    assert ax.get_ylabel() == "share of test readings"
    _, gateways, readings, _ = shown["radio_maps"][0]
    assert gateways["g3"].tolist() == [3, 0, 2]
    third = links.split.test[links.split.test % 8 == 3]
    np.testing.assert_allclose(readings["g3"][:, :2], links.transmitters[third, :2])
    np.testing.assert_allclose(readings["g3"][:, 2], links.labels[third])
    plan = shown["room"][1].axes[0]
    assert not plan.texts  # gateways have no axes to show
    assert len(plan.lines[2].get_xdata()) == 8


def test_a_missing_map_is_told(run):
    links, folder, _ = run
    (folder / "radio_map.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"radio_map\.npz"):
        write_figures(folder, links, None)
