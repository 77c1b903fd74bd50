"""What the figures show, read back from their artists."""

import csv

import numpy as np
import pytest
import torch
from matplotlib import image
from matplotlib.collections import EllipseCollection, LineCollection
from scipy.stats import ecdf

from gaigs.data import Grid, Links, Receiver, Split
from gaigs.gaussians import Gaussians
from gaigs.geometry import Pose, covariances
from gaigs.report import figures
from gaigs.report.curves import cdf, loss_curves, read_curves, speed_against_error
from gaigs.report.figures import write_figures
from gaigs.report.room import DRAWN, Cloud, room
from gaigs.report.spectra import spectra

ELEVATIONS, AZIMUTHS = np.arange(10.0, 91, 10), np.arange(0.0, 360, 15)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def meshes(figure):
    """The coloured panels, row by row."""
    return [ax.collections[0] for ax in figure.axes if ax.get_label() != "<colorbar>"]


def corners_of_pixel(mesh, row, column):
    return mesh.get_coordinates()[row : row + 2, column : column + 2].reshape(4, 2)


def lines(ax):
    return {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}


@pytest.mark.parametrize("polar", [False, True])
def test_spectra_show_label_prediction_and_error(rng, polar):
    labels, predictions = rng.random((2, 2, 9, 24)).astype(np.float16)
    figure = spectra(labels, predictions, np.array([0.25, 0.875]), ["worst", "best"], ELEVATIONS, AZIMUTHS, polar)
    figure.draw_without_rendering()
    panels = [mesh.get_array().reshape(9, 24) for mesh in meshes(figure)]
    for row in range(2):
        label, prediction, error = panels[3 * row : 3 * row + 3]
        np.testing.assert_array_equal(label, labels[row])
        np.testing.assert_array_equal(prediction, predictions[row])
        np.testing.assert_allclose(error, predictions[row].astype(float) - labels[row], atol=1e-7)
    titles = [ax.get_title() for ax in figure.axes[:6]]
    assert titles[:2] == ["Label, worst", "Prediction, SSIM 0.250"]
    assert titles[3:5] == ["Label, best", "Prediction, SSIM 0.875"]
    assert titles[2] == f"Error, MAE {np.abs(panels[2]).mean():.3f}"


def test_colours_of_errors_are_the_same_both_ways_and_in_all_rows():
    labels, predictions = np.full((2, 9, 24), 0.5), np.full((2, 9, 24), 0.6)
    predictions[1, 4, 4] = 0.1
    figure = spectra(labels, predictions, np.zeros(2), ["a", "b"], ELEVATIONS, AZIMUTHS)
    assert [mesh.get_clim() for mesh in meshes(figure)[2::3]] == [pytest.approx((-0.4, 0.4))] * 2
    perfect = spectra(labels, labels, np.ones(2), ["a", "b"], ELEVATIONS, AZIMUTHS)
    perfect.draw_without_rendering()
    assert meshes(perfect)[2].norm(0.0) == 0.5


def test_pixels_lie_where_their_directions_are():
    values = np.zeros((1, 9, 24))
    plane, sky = (
        meshes(spectra(values, values, np.ones(1), ["a"], ELEVATIONS, AZIMUTHS, polar))[0] for polar in (False, True)
    )
    np.testing.assert_allclose(corners_of_pixel(plane, 2, 6).mean(0), (90, 30))
    np.testing.assert_allclose(corners_of_pixel(sky, 2, 6).mean(0), (np.pi / 2, 60))
    radii = corners_of_pixel(sky, 8, 0)[:, 1]
    assert radii.min() == 0  # the zenith's pixels end in the middle instead of running through it
    assert radii.max() == 5


def test_cdf_is_the_empirical_one(rng):
    scores = {"gaigs": rng.random(40), "mean": rng.random(41), "knn": rng.random(40)}
    figure = cdf(scores, "SSIM", "spectra", "runs of 20", (None, 1))
    ax = figure.axes[0]
    steps = [line for line in ax.lines if line.get_drawstyle().startswith("steps")]
    dots = [line for line in ax.lines if line.get_marker() == "o"]
    assert len(steps) == len(dots) == 3
    for (name, ssim), step, dot in zip(scores.items(), steps, dots, strict=True):
        truth = ecdf(ssim).cdf
        x, y = step.get_data()
        np.testing.assert_allclose(x[1:], truth.quantiles)
        np.testing.assert_allclose(y[1:], truth.probabilities)
        assert dot.get_xydata()[0] == pytest.approx((np.median(ssim), 0.5))
        assert step.get_label() == f"{name} {np.median(ssim):.3f}"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("SSIM, split runs of 20", "share of test spectra")
    assert ax.get_xlim()[1] == 1
    assert figure.legends[0].get_title().get_text() == "median SSIM"


def test_ends_of_the_cdf_are_those_asked_for(rng):
    errors = {"gaigs": 10 * rng.random(40)}
    (ax,) = cdf(errors, "|error| [dB]", "readings", "official", (0, 7.5)).axes
    assert ax.get_xlim() == (0, 7.5)
    (line,) = (line for line in ax.lines if line.get_label().startswith("gaigs"))
    assert line.get_label() == f"gaigs {np.median(errors['gaigs']):.2f}"


def write_losses(path, steps=30):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, ["epoch", "step", "train/loss", "train/l1", "validation/ssim"])
        writer.writeheader()
        for step in range(steps):
            loss = 1 / (step + 1)
            writer.writerow({"epoch": step // 10, "step": step, "train/loss": loss, "train/l1": loss / 2})
            if step % 10 == 9:
                writer.writerow({"epoch": step // 10, "step": step, "validation/ssim": step / 100})


def test_curves_leave_out_the_gaps_of_the_log(tmp_path):
    write_losses(tmp_path / "metrics.csv")
    curves = read_curves([tmp_path / "metrics.csv"])
    assert list(curves) == ["train/loss", "train/l1", "validation/ssim"]
    np.testing.assert_array_equal(curves["validation/ssim"], [[9, 19, 29], [0.09, 0.19, 0.29]])
    train, validation = loss_curves(curves).axes
    assert set(lines(train)) == {"loss", "l1"}
    np.testing.assert_allclose(lines(train)["loss"].get_xydata(), [(k, 1 / (k + 1)) for k in range(30)])
    np.testing.assert_allclose(lines(validation)["ssim"].get_xdata(), [9, 19, 29])


def test_many_steps_are_smoothed_in_place():
    steps = np.arange(1000.0)
    (ax,) = loss_curves({"train/loss": (steps, 5 + steps)}).axes
    x, y = lines(ax)["loss"].get_data()
    assert len(x) < 1000
    np.testing.assert_allclose(y, 5 + x, atol=0.5)  # a straight line stays where it is, to half a step


def test_a_diverged_loss_still_makes_a_figure():
    steps = np.arange(9.0)
    figure = loss_curves({"train/loss": (steps, np.full(9, np.nan)), "train/l1": (steps, np.zeros(9))})
    figure.draw_without_rendering()


def test_curves_of_other_files_are_refused(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="must have a column 'step'"):
        read_curves([tmp_path / "other.csv"])
    with pytest.raises(ValueError, match="train/"):
        loss_curves({"lr": (np.zeros(1), np.zeros(1))})


@pytest.mark.parametrize(("longest", "scale"), [(30.0, "linear"), (3000.0, "log")])
def test_speed_against_error(longest, scale):
    times = {"inference": np.array([np.nan, 5, longest])}
    figure = speed_against_error(["a", "b", "c"], np.array([0.7, 0.8, 0.9]), times, "median SSIM", {"knn": 0.85})
    figure.draw_without_rendering()
    (ax,) = figure.axes
    points = lines(ax)
    assert points["b"].get_xydata().tolist() == [[5, 0.8]]
    assert points["c"].get_xydata().tolist() == [[longest, 0.9]]
    assert set(points["knn"].get_ydata()) == {0.85}
    assert (ax.get_xscale(), ax.get_ylabel()) == (scale, "median SSIM")


def test_gaussians_are_ellipses_of_one_standard_deviation():
    generator = torch.Generator().manual_seed(2)
    sigma = covariances(torch.randn(20, 4, generator=generator), 0.1 + torch.rand(20, 3, generator=generator)).double()
    means, strengths = torch.randn(20, 3, generator=generator), torch.rand(20, generator=generator)
    cloud = Cloud(means.numpy(), sigma.numpy(), strengths.numpy())
    point = np.zeros((1, 3))
    figure = room(point, point, point, np.eye(3)[None], np.zeros((0, 2, 3)), cloud)
    figure.draw_without_rendering()
    order = strengths.argsort()
    for ax, view in zip(figure.axes, ([0, 1], [0, 2]), strict=False):
        (ellipses,) = (artist for artist in ax.collections if isinstance(artist, EllipseCollection))
        np.testing.assert_allclose(ellipses.get_array(), strengths[order])  # the strongest last, so on top
        np.testing.assert_allclose(ellipses.get_offsets(), means[order][:, view])
        for k, index in enumerate(order):
            angle = np.deg2rad(ellipses.get_angles()[k])
            major = ellipses.get_widths()[k] / 2 * np.array([np.cos(angle), np.sin(angle)])
            minor = ellipses.get_heights()[k] / 2 * np.array([-np.sin(angle), np.cos(angle)])
            flat = sigma[index][view][:, view].numpy()
            np.testing.assert_allclose(np.outer(major, major) + np.outer(minor, minor), flat, rtol=1e-6, atol=1e-9)


def test_room_shows_the_strongest_gaussians_and_keeps_everyone_in_sight(rng):
    count = DRAWN + 50
    strengths = rng.permutation(count).astype(float)
    cloud = Cloud(rng.normal(0, 1, (count, 3)), np.tile(0.01 * np.eye(3), (count, 1, 1)), strengths)
    train, test, receiver = np.array([[4.0, 0, 0]]), np.array([[0, -5.0, 0]]), np.array([[0, 0, 6.0]])
    edges = np.array([[[-7.0, 0, 0], [-7.0, 1, 0]]])
    plan, side, bar = room(train, test, receiver, np.eye(3)[None], edges, cloud).axes
    ellipses = next(artist for artist in plan.collections if isinstance(artist, EllipseCollection))
    assert ellipses.get_array().min() == 50
    assert bar.get_ylabel() == f"|signal| × opacity, {DRAWN} strongest of {count} Gaussians"
    assert plan.get_xlim()[0] < -7 < 4 < plan.get_xlim()[1]
    assert plan.get_ylim()[0] < -5
    assert side.get_ylim()[1] > 6
    walls = next(artist for artist in side.collections if isinstance(artist, LineCollection))
    np.testing.assert_array_equal(walls.get_segments()[0], [[-7, 0], [-7, 0]])


def test_room_draws_the_axes_of_arrays_as_seen_from_above_and_aside():
    point, rotation = np.array([[1.0, 2, 3]]), np.array([[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]])
    plan, side = room(point + 4, point, point, rotation, np.zeros((0, 2, 3))).axes
    arrows = {text.get_text(): np.subtract(text.get_position(), text.xy) for text in plan.texts}
    assert set(arrows) == {"x", "z"}  # y points at the reader
    assert arrows["x"][0] == 0 > arrows["x"][1]
    assert arrows["z"][0] < 0 == arrows["z"][1]
    assert {text.get_text() for text in side.texts} == {"y", "z"}
    assert not room(point + 4, point, point, rotation[:0], np.zeros((0, 2, 3))).axes[0].texts


@pytest.fixture
def links():
    generator = torch.Generator().manual_seed(1)
    pose = Pose.from_xyzw([3.0, 0, 1], [0.0, 0, 0, 1])
    split = Split("runs of 4", torch.arange(8), torch.tensor([], dtype=torch.long), torch.arange(8, 12))
    grid = Grid.degrees(ELEVATIONS, AZIMUTHS)
    transmitters = torch.rand(12, 3, generator=generator)
    labels = torch.rand(12, *grid.shape, generator=generator)
    return Links(transmitters, (Receiver("array", pose),), torch.zeros(12).long(), labels, split, grid, "min-max")


def test_a_run_is_drawn_into_its_folder(links, tmp_path, rng):
    test = links.split.test
    labels = links.labels[test].numpy().astype(np.float16)
    ssim = {f"ssim_{model}": rng.random(4) for model in ("gaigs", "mean", "knn")}
    np.savez(tmp_path / "predictions.npz", labels=labels, prediction=labels[::-1], link=test, **ssim)
    (tmp_path / "log" / "version_0").mkdir(parents=True)
    write_losses(tmp_path / "log" / "version_0" / "metrics.csv")
    torch.manual_seed(0)
    gaussians = Gaussians(links.scene, channels=2, count=30, near=0.5, far=3, spread=1, opacity=0.5, signal=0.1)
    files = write_figures(tmp_path, links, gaussians)
    assert {file.stem for file in files} == {"room", "loss", "spectra", "spectra_polar", "ssim_cdf"}
    for file in files:
        pixels = image.imread(file)
        assert file.parent == tmp_path / "figures"
        assert pixels[..., :3].std() > 0.02  # something is drawn on the white
        assert pixels.shape[1] >= 600  # a column at 200 dpi


def test_examples_are_at_their_percentiles_of_the_own_model(links, tmp_path, rng, monkeypatch):
    labels = rng.random((41, 9, 24)).astype(np.float16)
    own = rng.permutation(np.linspace(0, 0.8, 41))
    np.savez(tmp_path / "predictions.npz", labels=labels, prediction=1 - labels, ssim_gaigs=own, ssim_knn=own[::-1])
    shown = []
    monkeypatch.setattr(figures, "spectra", lambda *args, **options: shown.append(args) or spectra(*args, **options))
    write_figures(tmp_path, links, None)
    drawn_labels, drawn_predictions, ssim, names = shown[0][:4]
    assert dict(zip(names, ssim, strict=True)) == pytest.approx(
        {"10th percentile": 0.08, "median": 0.4, "90th percentile": 0.72}
    )
    np.testing.assert_array_equal(drawn_labels[1], labels[np.argsort(own)[20]])
    np.testing.assert_array_equal(drawn_predictions, 1 - drawn_labels)


def test_a_look_up_has_neither_losses_nor_gaussians(links, tmp_path):
    labels = links.labels[links.split.test].numpy().astype(np.float16)
    np.savez(tmp_path / "predictions.npz", labels=labels[:1], prediction=labels[:1], ssim_knn=np.ones(1))
    names = {file.stem for file in write_figures(tmp_path, links, None)}
    assert names == {"room", "spectra", "spectra_polar", "ssim_cdf"}
