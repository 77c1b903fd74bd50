"""Curves, read back from their artists."""

import csv

import numpy as np
import pytest
from scipy.stats import ecdf

from gaigs.report.curves import cdf, loss_curves, read_curves, speed_against_error
from gaigs.report.style import LINES


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_what_a_killed_run_leaves_of_its_log_is_read(tmp_path):
    """Nothing in one file, and a last row that is cut in another: it is done anew behind."""
    texts = ["step,train/loss\n1,0.5\n2,0.25\n3,0.1", "", "step,train/loss\n3,0.125\n"]
    paths = [tmp_path / f"{number}.csv" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    steps, losses = read_curves(paths)["train/loss"]
    assert (steps.tolist(), losses.tolist()) == ([1, 2, 3], [0.5, 0.25, 0.125])
    assert read_curves(paths[1:2]) == {}


def lines(ax):
    return {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}


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


def test_six_models_are_told_apart_in_grey_print_and_their_key_fits(rng):
    names = ("gaigs", "mean", "knn", "friis", "path_loss", "gaussian_process")
    figure = cdf({name: rng.normal(0, 9, 40) for name in names}, "SNR [dB]", "channels", "official", (None, None))
    figure.draw_without_rendering()
    assert len({dash for _, dash in LINES}) >= len(names)
    assert len({line.get_color() for line in lines(figure.axes[0]).values()}) == len(names)
    (legend,) = figure.legends
    assert [text.get_text().split()[0] for text in legend.get_texts()] == list(names)
    box = legend.get_window_extent()
    assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
    assert figure.axes[0].get_position().height > 0.4


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


def test_a_part_that_was_lost_with_a_killed_run_is_left_out(tmp_path):
    (tmp_path / "0.csv").write_text("step,seconds\n99,60\n149,90\n199,120\n")
    (tmp_path / "1.csv").write_text("step,seconds\n139,130\n189,160\n")
    steps, seconds = read_curves([tmp_path / "0.csv", tmp_path / "1.csv"])["seconds"]
    assert steps.tolist() == [99, 139, 189]
    assert seconds.tolist() == [60, 130, 160]


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


def test_the_name_of_a_long_split_is_broken_into_lines():
    figure = cdf(
        {"gaigs": np.arange(3.0)}, "|error| [dB]", "readings", "official, validation 0.1 in runs of 100, seed 0", (0, 1)
    )
    label = figure.axes[0].get_xlabel()
    assert label.split() == "|error| [dB], split official, validation 0.1 in runs of 100, seed 0".split()
    assert max(map(len, label.splitlines())) <= 48
