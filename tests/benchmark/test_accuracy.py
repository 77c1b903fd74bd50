"""Whole trainings as cells: of two tiny systems end to end; tables and figures of rows that were made up."""

import csv
import re
import sys
import time

import numpy as np
import pytest
from matplotlib.text import Text

from gaigs import __main__ as command_line
from gaigs import evaluation, runs
from gaigs.benchmark import Context
from gaigs.benchmark._accuracy_page import LOOK_UPS, SYSTEMS, figures, highlights, tables
from gaigs.benchmark._scale import scale_of
from gaigs.benchmark._trainings import COSTS, facts, overrides, scene, written
from gaigs.benchmark.accuracy import Accuracy, installed

TINY = (
    "data.transmitters=20",
    "tokenizer=euclidean",
    "rasterizer=torch",
    "gaussians.count=10",
    "training.batch_size=8",
    "training.thinning.stride=8",
    "trainer.max_steps=4",
    "trainer.val_check_interval=2",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}]",
)
COUNTS = {"Gaussians": {"of": ["model=gaigs"], "key": "gaussians.count", "values": [5]}}


def benchmark(axes=COUNTS, systems=("gaigs", "friis"), **options):
    return Accuracy({"max_time": "00:00:01:00"}, axes, {"ssim": [0.01, 0.99]}, [*systems], **options)


def read(folder):
    with open(folder / "accuracy.csv", newline="") as file:
        return {(row["axis"], row["value"]): row for row in csv.DictReader(file)}


@pytest.fixture(scope="module", autouse=True)
def no_figures_of_runs():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "write_figures", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The folder of a benchmark that has ended, of which one system does not suit the task."""
    folder = tmp_path_factory.mktemp("done")
    benchmark().run(folder, Context(TINY))
    return folder


def refuse(*_):
    raise AssertionError("no run is to be begun")


def test_systems_train_and_one_that_fails_says_why(done):
    rows = read(done)
    assert [*rows] == [
        (LOOK_UPS, "mean"),
        (SYSTEMS, "gaigs"),
        (SYSTEMS, "friis"),
        ("Gaussians", "5"),
        ("Gaussians", "10"),
    ]
    assert rows[SYSTEMS, "friis"]["status"].startswith("unavailable: ")
    assert {row["status"] for key, row in rows.items() if key[1] != "friis"} == {"measured"}
    own = rows[SYSTEMS, "gaigs"]
    points = [point.split(":") for point in own["curve"].split()]
    assert len(points) == 2
    assert float(points[0][0]) <= float(points[1][0]) <= float(own["train_seconds"]) + 0.1
    assert (own["steps"], own["task"], rows[LOOK_UPS, "mean"]["curve"]) == ("4", "spectrum", "")
    assert rows["Gaussians", "10"] == own | {"axis": "Gaussians", "of": "model=gaigs"} | {
        "key": "gaussians.count", "value": "10", "default": "10"
    }, "the default is the reference itself, which is trained once"  # fmt: skip
    text = (done / "accuracy.md").read_text()
    assert "unavailable: friis, system: " in text
    assert "GAI-GS" in text
    for figure in ("time", "inference", "axes"):
        assert f"](accuracy_{figure}.png)" in text
        assert (done / f"accuracy_{figure}.png").is_file()


def test_what_is_done_is_not_done_again(done, monkeypatch):
    monkeypatch.setattr(runs, "run", refuse)
    before = (done / "accuracy.csv").read_text()
    benchmark().run(done, Context(TINY))
    assert (done / "accuracy.csv").read_text() == before
    (done / "accuracy.csv").write_text(before.partition("\n")[0] + "\n")  # the runs are there still
    benchmark(systems=["gaigs"]).run(done, Context(TINY))
    assert [row["status"] for row in read(done).values()] == ["measured"] * 4
    (done / "accuracy.csv").write_text(before)


def test_the_run_of_another_command_is_not_taken_over(done, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "run", refuse)
    (file,) = done.glob("accuracy/*/*/model=gaigs/config.yaml")
    before, rows = file.read_text(), (done / "accuracy.csv").read_text()
    file.write_text(before.replace("transmitters: 20", "transmitters: 21"))
    (done / "accuracy.csv").unlink()
    with pytest.raises(ValueError, match=r"must be free or hold a run of the same configuration.*transmitters"):
        benchmark().run(done, Context(TINY))
    file.write_text(before)
    (done / "accuracy.csv").write_text(rows)


def test_nothing_is_begun_that_does_not_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "run", refuse)
    benchmark().run(tmp_path, Context(TINY, deadline=time.monotonic() + 30))
    assert {row["status"] for key, row in read(tmp_path).items() if key[1] != "friis"} == {"not measured"}
    assert "not measured, as time was up: mean, look-up" in (tmp_path / "accuracy.md").read_text()


def test_a_benchmark_that_was_stopped_goes_on(tmp_path, monkeypatch):
    begun, run = [], runs.run

    def stopped(config, folder):
        begun.append(config["model"]["name"])
        if len(begun) == 2:
            raise KeyboardInterrupt
        return run(config, folder)

    monkeypatch.setattr(runs, "run", stopped)
    small = benchmark({}, ["mean", "knn"])
    with pytest.raises(KeyboardInterrupt):
        small.run(tmp_path, Context(TINY))
    assert [*read(tmp_path)] == [(LOOK_UPS, "mean"), (SYSTEMS, "mean")], "which are one run"
    small.run(tmp_path, Context(TINY))
    assert begun == ["mean", "knn", "knn"]
    assert {row["status"] for row in read(tmp_path).values()} == {"measured"}


def test_a_defect_of_a_strangers_system_stops_no_other(tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(runs, "run", broken)
    benchmark({}, ["knn"]).run(tmp_path, Context(TINY))
    statuses = {row["status"] for row in read(tmp_path).values()}
    assert statuses == {"unavailable: ZeroDivisionError: division by zero"}


def test_a_full_disk_ends_it(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(runs, "run", full)
    with pytest.raises(OSError, match="No space left"):
        benchmark({}, ["knn"]).run(tmp_path, Context(TINY))


def test_data_that_are_not_there_end_it_at_once(tmp_path):
    with pytest.raises(FileNotFoundError):
        benchmark().run(tmp_path, Context(("data=nerf2_spectrum", f"data.root={tmp_path / 'none'}")))


def test_data_of_another_task_end_it_at_once(tmp_path):
    with pytest.raises(ValueError, match=r"labels of data 'synthetic' are of task 'spectrum'.*; add task=spectrum"):
        benchmark().run(tmp_path, Context(("data.transmitters=20", "data.order=0", "task=rssi")))


def test_a_split_without_validation_links_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"benchmark=accuracy compares validation scores.* set split.validation"):
        benchmark().run(tmp_path, Context((*TINY, "split.validation=0")))


def test_the_command_line_says_how_long():
    trainings = benchmark()
    assert trainings.options(Context()) == ["trainer.max_time=00:00:01:00"]
    assert trainings.options(Context(("trainer.max_time=00:00:00:05",))) == []


def test_all_that_train_are_found():
    names = installed()
    assert names.index("gaigs") < names.index("mirrored")
    assert not {"mean", "knn", "path_loss", "friis", "gaussian_process", "kriging"} & {*names}


@pytest.mark.parametrize(
    ("axes", "error", "told"),
    [
        ({"a": 3}, TypeError, "benchmark.axes.a must be a mapping"),
        (
            {"a": {"key": "seed", "values": [1]}},
            ValueError,
            "benchmark.axes.a must have key, of and values, got key, values",
        ),
        ({"a": {"key": "seed", "of": "model=gaigs", "values": [1]}}, TypeError, "benchmark.axes.a.of must be a list"),
        ({"a": {"key": "seed", "of": [], "values": 3}}, TypeError, "benchmark.axes.a.values must be a list"),
        ({"a": {"key": "seed", "of": []}}, ValueError, "benchmark.axes.a needs values"),
        (
            {"a": {"key": "training.learning_rates", "of": [], "values": [1]}},
            ValueError,
            "benchmark.axes.a.key must be one option or a component, and training.learning_rates has options",
        ),
    ],
)
def test_axes_without_their_form_are_refused(axes, error, told):
    with pytest.raises(error, match=told):
        list(benchmark(axes).cells(Context(TINY)))


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "null"), (True, "true"), (3, "3"), (0.5, "0.5"), ([4, 8], "[4,8]"), ("00:01", "00:01"), ("a b", "'a b'"),
     ({"name": "path_loss"}, "{name: path_loss}")],
)  # fmt: skip
def test_values_are_written_as_hydra_reads_them(value, text):
    assert written(value) == text


def test_a_row_says_what_its_run_has():
    row = {"of": "model=gaigs kriging=true", "key": "model", "value": "mirrored", "default": "gaigs"}
    assert overrides(row) == ["kriging=true", "model=mirrored"]
    assert overrides(row | {"value": "gaigs"}) == ["model=gaigs", "kriging=true"]


def test_kriging_is_the_last_point_of_a_curve(tmp_path):
    (tmp_path / "log/version_0").mkdir(parents=True)
    log = "step,seconds,validation/ssim\n9,2.0,\n9,,0.5\n19,4.0,\n19,,0.6\n29,,0.61\n"
    (tmp_path / "log/version_0/metrics.csv").write_text(log)
    scores = {"ssim_median": 0.8, "ssim_mean": 0.7}
    metrics = dict.fromkeys(COSTS) | {"task": "spectrum", "split": "official", "seed": 0, "train_seconds": 5.0}
    metrics |= {
        "models": {"mirrored": scores, "mean": scores},
        "validation": {"mirrored": scores | {"ssim_mean": 0.75}},
    }
    assert facts(metrics, tmp_path)["curve"] == "2.0:0.5 4.0:0.6", "a point without its time is left out"
    found = facts(metrics | {"kriging": {"seconds": 3.0}}, tmp_path)
    assert found["curve"] == "2.0:0.5 4.0:0.6 8.0:0.75"
    assert (found["train_seconds"], found["steps"], found["test"], found["compared"]) == (8.0, 30, 0.7, 0.8)


def test_pages_show_no_places():
    shown = scene(["data=nerf2_rssi", "data.root=/a/b/flat", "data.file=~/x.csv"])
    assert re.fullmatch(r"data=nerf2_rssi data\.root=flat#[0-9a-f]{6} data\.file=x\.csv#[0-9a-f]{6}", shown)
    assert scene(["data.root=/a/b/flat"]) != scene(["data.root=/a/c/flat"])


def test_the_command_line_composes_runs(tmp_path, monkeypatch, capsys):
    axes = ("placement", "kriging", "tokenizer", "anchors", "Gaussians", "planes")
    words = [
        "benchmark.systems=[]",
        "baselines=[]",
        "data.transmitters=20",
        *(f"~benchmark.axes.{axis}" for axis in axes),
    ]
    folder = [f"hydra.run.dir={tmp_path}", "hydra/job_logging=none"]
    monkeypatch.setattr(sys, "argv", ["gaigs", "command=benchmark", "benchmark=accuracy", *words, *folder])
    command_line.main()
    assert capsys.readouterr().err == ""
    assert (tmp_path / "accuracy.md").read_text().startswith("## Accuracy against time")


# --- pages of rows that were made up ---

COMMON = dict.fromkeys(("scene", "trainer", "of", "default", "render_ms", "checkpoint_bytes", "num_gaussians"), "")
COMMON |= {
    "device": "cpu",
    "task": "spectrum",
    "split": "official",
    "seed": "0",
    "num_parameters": "7",
    "status": "measured",
}


def row(axis, value, validation, test, ms, curve="", **facts):
    seconds = curve.split()[-1].partition(":")[0] if curve else ""
    own = {"axis": axis, "key": "model", "value": value, "validation": str(validation), "test": str(test)}
    own |= {"compared": str(test), "inference_ms": str(ms), "curve": curve, "train_seconds": seconds, "steps": ""}
    return COMMON | own | facts


ROWS = [
    row(LOOK_UPS, "knn", 0.7, 0.72, 1.0),
    row(SYSTEMS, "gaigs", 0.9, 0.85, 8.0, "1.0:0.3 4.0:0.75 9.0:0.9", checkpoint_bytes="2e6"),
    row(SYSTEMS, "nerf2", 0.6, 0.55, 9.0, "1.5:0.5 3.0:0.6 8.0:0.55"),
    row("planes", "6", 0.8, 0.79, 2.0, "2:0.5 5:0.8", key="placement.planes", default="10", of="model=mirrored"),
    row("planes", "10", 0.82, 0.8, 3.0, "2:0.4 6:0.82", key="placement.planes", default="10", of="model=mirrored"),
    row(SYSTEMS, "friis", "", "", "", status="unavailable: it is of another task"),
]


def lines(text, begin):
    return [
        line for line in text.splitlines() if line.startswith(f"| {begin} |") or line.startswith(f"| **{begin}** |")
    ]


def test_seconds_to_levels_are_those_of_the_first_validation_that_reaches_them():
    text = tables(ROWS, {"ssim": [0.6, 0.95], "mae_db": [3]})
    assert "| system | 0.6 | `knn` 0.700 | 0.95 | in the end |" in text
    assert lines(text, "GAI-GS")[0] == "| GAI-GS | 4.00 | 4.00 | – | 0.900 |"
    assert lines(text, "NeRF²")[0] == "| NeRF² | 3.00 | – | – | 0.600 |"
    assert "| value | mean SSIM, validation | test | s to 0.6 | s to `knn` 0.700 | inference [ms]" in text
    assert lines(text, "6") == ["| 6 | 0.800 | 0.790 | 5.00 | 5.00 | 2.00 | 5.00 |  | 7 |"]
    assert "unavailable: friis, system: it is of another task" in text


def test_leaders_and_those_whom_nobody_beats_are_told():
    text = tables(ROWS, {})
    assert "| 1.00 | 0.300 | GAI-GS |\n| 1.50 | 0.600 | NeRF² |\n| 4.00 | 0.900 | GAI-GS |" in text
    assert len(lines(text, "GAI-GS")) == 2
    assert "| **GAI-GS** | 0.850 | 0.850 | 8.00 |" in text
    assert "| **`knn`** | 0.720 |" in text
    assert "| NeRF² | 0.550 |" in text


def test_the_glance_tells_who_reaches_the_look_up_first():
    first, *front = highlights(ROWS)
    assert first[:2] == ("GAI-GS", "spectrum, built-in room, split official")
    assert first.time == "4.00 s of training to `knn`'s 0.700"
    assert first.error == "0.850 mean SSIM after 9.00 s"
    assert [line.choice for line in front] == ["knn", "GAI-GS"]


def test_places_have_tables_and_figures_of_their_own():
    rows = [*ROWS, *(own | {"device": "an accelerator"} for own in ROWS)]
    assert "](accuracy_time_2.png)" in tables(rows, {})
    assert [*figures(rows)] == [f"accuracy_{name}{end}" for end in ("", "_2") for name in ("time", "axes", "inference")]


@pytest.mark.parametrize(
    ("task", "score", "title", "error"),
    [("spectrum", 0.9, "1 - mean SSIM", 0.1), ("rssi", 4.0, "MAE [dB]", 4.0),
     ("csi", 10.0, "squared error over power, at the mean SINAD [dB]", 0.1)],
)  # fmt: skip
def test_errors_are_above_zero_and_fall_as_scores_get_better(task, score, title, error):
    scale = scale_of(task)
    assert scale.error(score) == pytest.approx(error)
    assert scale.error_title == title
    assert scale.reaches(score, score)
    assert not scale.reaches(score, score + (0.1 if scale.higher_is_better else -0.1))


def test_curves_fall_on_logarithmic_axes_and_their_names_keep_apart():
    curves = " ".join(f"{t}:{0.5 + 0.01 * t}" for t in range(1, 30))
    rows = [row(SYSTEMS, name, 0.79, 0.8, 3.0, curves) for name in installed()] + ROWS[:1]
    figure = figures(rows)["accuracy_time"]
    figure.draw_without_rendering()
    (ax,) = figure.axes
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    boxes = [Text.get_window_extent(text) for text in ax.texts]  # without their arrows
    assert len(boxes) == len(rows)
    assert np.diff(sorted(box.y0 for box in boxes)).min() >= 0.95 * boxes[0].height
    assert len({(line.get_color(), line.get_linestyle()) for line in ax.lines}) >= len(installed())
    for line in ax.lines:
        assert (np.diff(line.get_ydata()) <= 0).all(), "what is shown is the best so far"


def test_points_that_nobody_beats_are_filled():
    ax = figures(ROWS)["accuracy_inference"].axes[0]
    filled = {float(line.get_xdata()[0]) for line in ax.lines if line.get_markerfacecolor() == "0.15"}
    assert filled == {1.0, 8.0}
    assert [text.get_text() for text in ax.texts] == ["1", "2", "3"]
    (legend,) = ax.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["1 GAI-GS", "2 NeRF²", "3 knn"]
