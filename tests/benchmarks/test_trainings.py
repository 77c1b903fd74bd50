"""Benchmarks of whole trainings: one of a tiny system end to end, all others of trainings that are
made up.
"""

import csv

import accuracy
import budgets
import pytest
from accuracy import Accuracy
from budgets import Budgets, smallest_within
from trainings import COSTS, Axis, Score, command_line, multiples, overrides_of, results, written

TINY = (
    "data.transmitters=20", "data.order=0", "tokenizer=euclidean", "rasterizer=torch", "gaussians.count=10",
    "training.batch_size=8", "training.thinning.stride=8", "trainer.max_steps=2", "trainer.val_check_interval=1",
    "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false", "baselines=[{name: mean}]",
)  # fmt: skip
NO_AXES = [f"--values={name}=[]" for name in Accuracy.axes]


def run_accuracy(folder, *words, systems=("gaigs",)):
    accuracy.main([*TINY, *words, *NO_AXES, "--folder", str(folder), "--systems", *systems])


def run_budgets(folder, *words):
    budgets.main([*TINY, *words, "--folder", str(folder), "--factors", "0.5", "1", "2"])


@pytest.fixture
def options(tmp_path):
    return command_line("").parse_args(["--folder", str(tmp_path)])


def read(folder, name="accuracy"):
    with open(folder / f"{name}.csv", newline="") as file:
        return {(row["axis"], row["value"]): row for row in csv.DictReader(file)}


@pytest.fixture
def fake(monkeypatch):
    """Trainings are made up: they have a score, by their configuration, or an error. Their models
    are noted.

    Each is made once, on any machine: a benchmark trains on its GPU too.
    """
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    trained = []

    def install(score=lambda config: 0.5):
        def run(config, folder):
            trained.append(config["model"]["name"])
            if isinstance(score, BaseException):
                raise score
            scores = {"ssim_median": score(config), "ssim_mean": score(config)}
            metrics = dict.fromkeys(COSTS, 1.0) | {
                "task": "spectrum",
                "split": "official",
                "seed": config["seed"],
            }
            return metrics | {"models": {"own": scores}, "validation": {"own": scores}}

        monkeypatch.setattr("gaigs.run", run)
        return trained

    return install


def test_a_system_is_trained_once_and_its_run_is_read_again(tmp_path, monkeypatch):
    run_accuracy(tmp_path, systems=["gaigs", "friis"])
    rows = read(tmp_path)
    assert [*rows] == [("look-up", "mean"), ("system", "gaigs"), ("system", "friis")]
    own = rows["system", "gaigs"]
    assert (own["status"], own["task"], own["steps"]) == ("measured", "spectrum", "2")
    assert (
        "trainer.max_steps=2 trainer.max_time=00:00:01:00 trainer.val_check_interval=1 "
        in own["trainer"]
    )
    assert own["scene"] == " ".join(word for word in TINY if not word.startswith("trainer."))
    assert rows["look-up", "mean"]["curve"] == ""
    times = [float(point.partition(":")[0]) for point in own["curve"].split()]
    assert len(times) == 2
    assert times[0] <= times[1] <= float(own["train_seconds"]) + 0.1
    assert rows["system", "friis"]["status"].startswith("unavailable: ValueError: ")
    page = (tmp_path / "accuracy.md").read_text()
    assert "- system, friis: unavailable: " in page
    assert "GAI-GS" in page
    monkeypatch.setattr("gaigs.runs.train_and_test", None)  # no other training
    (tmp_path / "accuracy.csv").unlink()
    run_accuracy(tmp_path)
    assert read(tmp_path)["system", "gaigs"] == own


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("by zero"), FileNotFoundError("no weights")], ids=repr
)
def test_a_defect_stops_no_other_system(tmp_path, fake, error):
    trained = fake(error)
    run_accuracy(tmp_path)
    assert trained == ["mean", "gaigs"]
    assert {row["status"] for row in read(tmp_path).values()} == {
        f"unavailable: {type(error).__name__}: {error}"
    }


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), MemoryError()], ids=repr)
def test_a_full_disk_and_a_lack_of_memory_end_it(tmp_path, fake, error):
    fake(error)
    with pytest.raises(type(error)):
        run_accuracy(tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--values=seed=[1]"], "--values: no axis 'seed'; there are: seeds_gaigs, "),
        (["--values=seeds_gaigs=[ga]"], "'ga'"),
        (["split.validation=0"], "must have validation links; set split.validation"),
        ([], r"axis seeds_mirrored \(--values seeds_mirrored=\[\] leaves it out\): .*'gaussians'"),
    ],
)
def test_bad_words_end_it_before_any_training(words, message, tmp_path, fake):
    trained = fake()
    with pytest.raises(ValueError, match=message):
        run_budgets(tmp_path, *words)
    assert not trained


def test_values_in_the_syntax_of_hydra():
    values = [None, True, 3, 0.5, [4, 8], "00:01", "a b", {"name": "path_loss"}]
    texts = ["null", "true", "3", "0.5", "[4,8]", "00:01", "'a b'", "{name: path_loss}"]
    assert [written(value) for value in values] == texts


def test_values_about_a_default():
    defaults = [300, 1, [4, 8], "multiview", 0.5]
    values = [[75, 300, 600], [1, 2], [[1, 2], [4, 8], [8, 16]], [], []]
    assert [multiples(default, (0.25, 1, 2)) for default in defaults] == values


def test_overrides_of_a_row():
    row = {
        "of": "model=gaigs kriging=true",
        "key": "model",
        "value": "mirrored",
        "default": "gaigs",
    }
    assert overrides_of(row) == ["kriging=true", "model=mirrored"]
    assert overrides_of(row | {"value": "gaigs"}) == ["model=gaigs", "kriging=true"]


def test_kriging_is_the_last_point_of_a_curve(tmp_path):
    (tmp_path / "log/version_0").mkdir(parents=True)
    log = "step,seconds,validation/ssim\n9,2.0,\n9,,0.5\n19,4.0,\n19,,0.6\n29,,0.61\n"
    (tmp_path / "log/version_0/metrics.csv").write_text(log)
    scores = {"ssim_median": 0.8, "ssim_mean": 0.7}
    metrics = dict.fromkeys(COSTS) | {
        "task": "spectrum",
        "split": "official",
        "seed": 0,
        "train_seconds": 5.0,
    }
    metrics |= {"models": {"mirrored": scores}, "validation": {"mirrored": {"ssim_mean": 0.75}}}
    assert results(metrics, tmp_path)["curve"] == "2.0:0.5 4.0:0.6", (
        "a point without its time is left out"
    )
    found = results(metrics | {"kriging": {"seconds": 3.0}}, tmp_path)
    assert found["curve"] == "2.0:0.5 4.0:0.6 8.0:0.75"
    assert (found["train_seconds"], found["steps"], found["test"], found["compared"]) == (
        8.0,
        30,
        0.7,
        0.8,
    )


# --- tables of rows that are made up ---

ROW = dict.fromkeys((*Accuracy.keys, *Accuracy.values), "") | {
    "device": "cpu",
    "task": "spectrum",
    "split": "official",
}
ROW |= {"key": "model", "num_parameters": "7", "status": "measured"}


def row(axis, value, validation, test, ms, curve="", **more):
    return ROW | {"axis": axis, "value": value, "validation": str(validation), "test": str(test), "compared": str(test),
                  "inference_ms": str(ms), "curve": curve} | more  # fmt: skip


def values(scores, task="spectrum", axis="Gaussians", key="gaussians.count", default="300", **more):
    more |= {
        "task": task,
        "key": key,
        "default": default,
        "of": "model=gaigs",
        "train_seconds": "20",
    }
    return [row(axis, value, score, "", 3.0, **more) for value, score in scores.items()]


def test_times_to_levels_and_the_best_rows(options, monkeypatch):
    rows = [
        row("look-up", "knn", 0.7, 0.72, 1.0),
        row("system", "nerf2", 0.6, 0.55, 9.0, "1.5:0.5 3.0:0.6 8.0:0.55"),
        row("system", "gaigs", 0.9, 0.85, 8.0, "1.5:0.3 4.5:0.75 9.5:0.9"),
        row(
            "planes",
            "6",
            0.8,
            0.79,
            2.0,
            "2:0.5 5:0.8",
            key="placement.planes",
            default="10",
            of="model=mirrored",
        ),
    ]
    monkeypatch.setattr(Accuracy, "levels", {"ssim": [0.6, 0.95], "mae_db": [3]})
    text = Accuracy(options).tables(rows)
    assert (
        "| validation | inference [ms] | rendering [ms] | training [s] | s to 0.6 | s to `knn` "
        "0.700 | s to 0.95 |" in text
    )
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    assert lines[2:5] == [
        "| **GAI-GS** | 0.850 | 0.850 | 0.900 | 8 |  |  | 4.50 | 4.50 |  |  | 7 |  |",
        "| **`knn`** | 0.720 | 0.720 | 0.700 | 1 |  |  |  |  |  |  | 7 |  |",
        "| NeRF² | 0.550 | 0.550 | 0.600 | 9 |  |  | 3 |  |  |  | 7 |  |",
    ]
    assert "**planes**: `placement.planes` of `model=mirrored`; the default is 10\n" in text


@pytest.mark.parametrize(
    ("task", "scores", "smallest"),
    [
        ("spectrum", {"600": 0.903, "300": 0.9, "150": 0.898, "75": 0.89}, "150"),  # at the bound
        ("spectrum", {"75": 0.91, "300": 0.9}, "75"),
        ("spectrum", {"75": 0.8, "300": 0.9}, "300"),
        ("rssi", {"15": 4.06, "30": 4.04, "60": 4.0}, "30"),
        ("csi", {"[8,16]": 9.0, "[16,32]": 9.04, "[4,8]": 8.0}, "[8,16]"),
    ],
)
def test_the_smallest_within_the_tolerance_is_taken(task, scores, smallest):
    score = Score.of(task)
    rows = values(scores, task)
    rows[0]["test"] = "0.99"  # test links have no say
    assert (
        smallest_within(rows, Budgets.tolerance[score.unit or "ratio"], score)["value"] == smallest
    )


def test_budgets_show_scatter_and_the_smallest_value(options):
    seeds = values({"0": 0.9, "1": 0.904, "2": 0.893}, axis="seeds", key="seed", default="0")
    text = Budgets(options).tables([*seeds, *values({"600": 0.903, "300": 0.9, "75": 0.89})])
    assert (
        "Seeds 0, 1, 2 score 0.900, 0.904, 0.893: they scatter by 0.0110, beyond the tolerance."
        in text
    )
    assert (
        "| part | key | mean SSIM of the validation links by value | smallest within 0.005 | "
        "default now |" in text
    )
    assert (
        "| Gaussians | `gaussians.count` | 75: 0.890, 300: 0.900, 600: 0.903 | **300** | 300 | 3, "
        "3 | 20, 20 |" in text
    )


def test_sections_have_their_unit_conditions_and_command(options):
    rows = values(
        {"60": 4.0, "90": 3.5},
        "rssi",
        default="30",
        scene="data.root=/a/b/flat seed=1",
        trainer="trainer.x=1",
    )
    text = Budgets(options).tables(rows + values({"300": 0.9}))
    assert "## rssi, data.root=flat seed=1, split official\n\ncpu; trainer.x=1\n" in text
    assert "python benchmarks/budgets.py data.root=flat seed=1 trainer.x=1\n" in text
    assert "smallest within 0.05 dB" in text
    assert "| **90**, the largest tried | 30 | 3, not measured |" in text


def test_values_of_axes_are_trained_and_axes_without_a_key_left_out(tmp_path, fake, monkeypatch):
    trained = fake(lambda config: config["model"]["gaussians"]["count"] / 100)
    axes = {"Gaussians": Axis(["model=gaigs"], "gaussians.count"), "grid": Axis([], "pooling.grid")}
    monkeypatch.setattr(Budgets, "axes", axes)
    run_budgets(tmp_path)
    assert len(trained) == 3
    text = (tmp_path / "budgets.md").read_text()
    assert (
        "| Gaussians | `gaussians.count` | 5: 0.0500, 10: 0.100, 20: 0.200 | **20**, the largest "
        "tried | 10 |" in text
    )
    assert "pooling.grid" not in text
