"""Curves, read back from their artists."""

import csv

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from scipy.spatial.distance import pdist
from scipy.stats import ecdf
from skimage.color import rgb2lab

from gaigs.core.task import Metric
from gaigs.registry import registry
from gaigs.report.curves import cdf, learning_curves, loss_curves, speed_against_error
from gaigs.report.style import LINES, looks
from gaigs.report.training_log import read_curves


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def lines(ax):
    return {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}


def test_cdf_is_the_empirical_one(rng):
    scores = {"gaigs": rng.random(40), "mean": rng.random(41), "knn": rng.random(40)}
    figure = cdf(scores, "SSIM", "spectra", "runs of 20", (None, 1), True)
    ax = figure.axes[0]
    steps = [line for line in ax.lines if line.get_drawstyle().startswith("steps")]
    dots = [line for line in ax.lines if line.get_marker() == "o"]
    assert len(steps) == len(dots) == 3
    best_first = sorted(scores.items(), key=lambda item: -np.median(item[1]))
    for (name, ssim), step, dot in zip(best_first, steps, dots, strict=True):
        truth = ecdf(ssim).cdf
        x, y = step.get_data()
        np.testing.assert_allclose(x[1:], truth.quantiles)
        np.testing.assert_allclose(y[1:], truth.probabilities)
        assert dot.get_xydata()[0] == pytest.approx((np.median(ssim), 0.5))
        assert step.get_label() == f"{name} {np.median(ssim):.3f}"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("SSIM", "share of 40 test spectra")
    assert ax.get_xlim()[1] == 1
    assert figure.legends[0].get_title().get_text() == "median SSIM, best first\nsplit runs of 20"


def write_losses(path, steps=30):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(
            file, ["epoch", "step", "train/loss", "train/l1", "validation/ssim"]
        )
        writer.writeheader()
        for step in range(steps):
            loss = 1 / (step + 1)
            writer.writerow(
                {"epoch": step // 10, "step": step, "train/loss": loss, "train/l1": loss / 2}
            )
            if step % 10 == 9:
                writer.writerow({"epoch": step // 10, "step": step, "validation/ssim": step / 100})


def test_curves_leave_out_the_gaps_of_the_log(tmp_path):
    write_losses(tmp_path / "metrics.csv")
    curves = read_curves([tmp_path / "metrics.csv"])
    assert list(curves) == ["train/loss", "train/l1", "validation/ssim"]
    np.testing.assert_array_equal(curves["validation/ssim"], [[9, 19, 29], [0.09, 0.19, 0.29]])
    train, validation = loss_curves(curves).axes
    assert validation.get_title() == "validation SSIM"
    assert set(lines(train)) == {"loss", "l1"}
    np.testing.assert_allclose(
        lines(train)["loss"].get_xydata(), [(k, 1 / (k + 1)) for k in range(30)]
    )
    np.testing.assert_allclose(lines(validation)["ssim"].get_xdata(), [9, 19, 29])


def test_penalties_have_an_axis_of_their_own():
    steps = np.arange(9.0)
    figure = loss_curves(
        {
            "train/l1": (steps, steps),
            "train/loss": (steps, steps),
            "penalty/opacity": (steps, steps),
        }
    )
    assert [[*lines(ax)] for ax in figure.axes] == [["loss", "l1"], ["opacity"]]


def test_a_system_has_one_look_in_all_figures(rng):
    known = registry("model").names()
    found = looks(known)
    assert len({*found.values()}) == len(known)
    assert found["gaigs"][1] == found["mirrored"][1] == "-"
    assert looks(["GAI-GS", "knn (baseline)", "gaigs_trend"]) == {
        "GAI-GS": found["gaigs"], "knn (baseline)": found["knn"], "gaigs_trend": (found["gaigs"][0], ":")
    }  # fmt: skip
    variants = looks(["GAI-GS split=a", "GAI-GS split=b"])
    assert variants["GAI-GS split=a"] == found["gaigs"] != variants["GAI-GS split=b"]
    names = [f"a system of mine {k}" for k in range(20)]
    assert len({*looks([*known[:10], *names]).values()}) == 30
    assert looks(["gaigs", "knn", names[0]])[names[0]] == looks(names[:1])[names[0]]
    scores = {name: rng.random(9) for name in ("mirrored", "knn", "mean")}
    drawn = cdf(scores, "SSIM", "spectra", "random", (None, 1)).axes[0]
    steps = [line.get_color() for line in drawn.lines if line.get_drawstyle().startswith("steps")]
    assert {*steps} == {found[name][0] for name in scores}
    two = [((1.0, 2.0), (0.5, 0.6))] * 2
    curves = learning_curves(
        dict(zip(("mirrored Gaussians", "GAI-GS"), two, strict=True)),
        {"knn": 0.7},
        Metric("SSIM", True),
    )
    assert [line.get_color() for line in curves.axes[0].lines] == [
        found[name][0] for name in ("mirrored", "gaigs", "knn")
    ]
    times = {"inference": np.array([1.0, 2.0, 3.0])}
    models = ["mirrored", "gaigs", "mirrored"]
    (ax,) = speed_against_error(
        ["a", "b", "c"], np.ones(3), times, "SSIM", {"knn official": 0.8}, models
    ).axes
    assert [line.get_color() for line in ax.lines] == [found[name][0] for name in (*models, "knn")]


def test_each_score_has_an_axis_of_its_own():
    steps = np.arange(9.0)
    names = [f"validation/{name}" for name in ("ssim", "mae", "snr_aligned_db")]
    figure = loss_curves(dict.fromkeys(names, (steps, steps)))
    titles = [ax.get_title().removeprefix("validation ") for ax in figure.axes]
    assert titles == ["SSIM", "MAE", "SNR aligned [dB]"]


def test_many_steps_are_smoothed_in_place():
    steps = np.arange(1000.0)
    (ax,) = loss_curves({"train/loss": (steps, 5 + steps)}).axes
    x, y = lines(ax)["loss"].get_data()
    assert len(x) < 1000
    np.testing.assert_allclose(
        y, 5 + x, atol=0.5
    )  # a straight line stays where it is, to half a step


def test_a_diverged_loss_still_makes_a_figure():
    steps = np.arange(9.0)
    figure = loss_curves(
        {"train/loss": (steps, np.full(9, np.nan)), "train/l1": (steps, np.zeros(9))}
    )
    figure.draw_without_rendering()


@pytest.mark.parametrize(("longest", "scale"), [(20.0, "linear"), (500.0, "log")])
def test_speed_against_error(longest, scale):
    times = {"inference": np.array([np.nan, 5, longest]), "training": np.full(3, np.nan)}
    figure = speed_against_error(
        ["a", "b", "c"], np.array([0.7, 0.8, 0.9]), times, "median SSIM", {"knn": 0.85}
    )
    figure.draw_without_rendering()
    (ax,) = figure.axes
    points = {line.get_label(): line for line in ax.lines}
    assert points["b"].get_xydata().tolist() == [[5, 0.8]]
    assert points["c"].get_xydata().tolist() == [[longest, 0.9]]
    assert set(points["knn"].get_ydata()) == {0.85}
    assert (ax.get_xscale(), ax.get_ylabel()) == (scale, "median SSIM")


# What deuteranopes, protanopes and tritanopes see, for linear RGB (Machado, Oliveira and Fernandes,
# A physiologically-based model for simulation of color vision deficiency, 2009, severity 1).
READERS = {
    "all cones": np.eye(3),
    "no green cones": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "no red cones": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "no blue cones": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


@pytest.mark.parametrize("reader", READERS)
def test_colours_differ_for_every_reader(reader):
    colours = [to_rgb(colour) for colour, _ in LINES[:6]]
    seen = np.array(colours) ** 2.2 @ np.transpose(READERS[reader])
    points = rgb2lab(seen.clip(0, 1) ** (1 / 2.2))
    apart = pdist(points)  # a just noticeable difference is 2.3
    assert apart.min() > 15, f"{apart.min():.1f} in CIELAB"


def test_only_six_lines_have_colours(rng):
    scores = {f"s{k}": k + rng.random(9) for k in range(12)}
    figure = cdf({"own": 20 + rng.random(9)} | scores, "error", "links", "random", (0, None))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label.split()[0] for label in labels] == ["s0", "s1", "s2", "s3", "s4", "own", "7"]
    assert labels[-1].startswith("7 others 5.")
    steps = [line for line in figure.axes[0].lines if line.get_drawstyle().startswith("steps")]
    assert len({line.get_color() for line in steps if line.get_color() != "0.75"}) == 6
    assert len([line for line in figure.axes[0].lines if line.get_color() == "0.75"]) == 1 + 7 + 1
