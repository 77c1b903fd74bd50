"""Folders that Hydra itself makes, and what the report makes of them."""

import csv
import errno
import json
import os
import re
import subprocess
import sys
from io import StringIO

import numpy as np
import pytest
import yaml
from matplotlib import image
from matplotlib.figure import Figure
from rich.console import Console

from gaigs.report import multirun
from gaigs.report.__main__ import main
from gaigs.report.multirun import ablation, read_runs, report
from gaigs.task.csi import Csi

APPLICATION = """
import json
import hydra
from hydra.core.hydra_config import HydraConfig
from pathlib import Path

@hydra.main(version_base=None, config_path=None)
def main(config):
    if config.tokenizer == "broken":
        raise RuntimeError("no such tokenizer")
    models = {"gaigs": {"ssim_median": 0.9}, "mean": {"ssim_median": 0.6}}
    run = {"task": "spectrum", "split": "official", "seed": 1, "device": "cpu", "models": models}
    Path(HydraConfig.get().runtime.output_dir, "metrics.json").write_text(json.dumps(run))

main()
"""


def write_run(folder, name, overrides, task="spectrum", **metrics):
    (folder / name / ".hydra").mkdir(parents=True)
    (folder / name / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    if metrics:
        facts = {"split": "official", "seed": 1, "device": "cpu", "train_seconds": 60.5, "inference_ms": 17.25}
        facts |= {"task": task, "num_gaussians": 2000, "num_parameters": 123456}
        (folder / name / "metrics.json").write_text(json.dumps(facts | metrics))


def scores(gaigs, mean=0.6, knn=0.95):
    medians = {"gaigs": gaigs, "mean": mean, "knn": knn}
    return {name: {"ssim_median": median, "mae": 1 - median} for name, median in medians.items()}


def errors(gaigs, knn=4.158, path_loss=4.974):
    means = {"gaigs": gaigs, "knn": knn, "path_loss": path_loss}
    return {name: {"mae_db": e, "median_ae_db": 0.8 * e, "rmse_db": 1.3 * e} for name, e in means.items()}


def channels(gaigs, friis=-1.5):
    return {
        name: {key: snr + i for i, key in enumerate(Csi.metrics())}
        for name, snr in (("gaigs", gaigs), ("friis", friis))
    }


def terminal(tables):
    """What a terminal of 80 columns shows, line by line."""
    console = Console(width=80, file=StringIO())
    console.print(tables)
    return console.file.getvalue().splitlines()


def read_csv(folder):
    with open(folder / "ablation.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_folder_of_hydra_is_read(tmp_path):
    (tmp_path / "application.py").write_text(APPLICATION)
    overrides = ["+tokenizer=ga,'a|b',broken", "+widths=[8,16]", "hydra.sweep.dir=sweep"]
    subprocess.run([sys.executable, "application.py", "--multirun", *overrides], cwd=tmp_path, capture_output=True)
    runs = read_runs(tmp_path / "sweep")
    assert [run.name for run in runs] == ["0", "1", "2"]
    assert [run.overrides["widths"] for run in runs] == ["[8,16]"] * 3
    assert [run.metrics is None for run in runs] == [False, False, True]
    rows, shared = ablation(runs)
    assert [row.get("tokenizer") for row in rows] == ["ga", "'a|b'", "broken", None]  # as Hydra notes them
    assert shared["widths"] == "[8,16]"
    report(tmp_path / "sweep")
    assert r"a\|b" in (tmp_path / "sweep" / "ablation.md").read_text()


def test_unfinished_runs_stay_and_baselines_come_once(tmp_path):
    common = ["+experiment=spectrum", "data=rfid"]
    write_run(tmp_path, "0", [*common, "tokenizer=ga", "seed=1"], models=scores(0.91))
    write_run(tmp_path, "1", [*common, "tokenizer=multiview", "seed=1"])
    write_run(tmp_path, "10", [*common, "tokenizer=ga", "seed=2"], seed=2, models=scores(0.87, knn=0.95 + 1e-9))
    write_run(tmp_path, "2", [*common, "tokenizer=euclidean", "seed=1"], models=scores(0.81), num_gaussians=None)
    table, seeds = report(tmp_path).renderables
    rows = read_csv(tmp_path)
    assert list(rows[0])[:5] == ["run", "status", "model", "tokenizer", "seed"]
    assert [(row["run"], row["status"], row["model"]) for row in rows] == [
        ("0", "done", "gaigs"),
        ("1", "unfinished", ""),
        ("2", "done", "gaigs"),
        ("10", "done", "gaigs"),
        ("", "baseline", "mean"),
        ("", "baseline", "knn"),
        ("", "seeds", "gaigs"),
    ]
    assert [row["ssim_median"] for row in rows[:4]] == ["0.91", "", "0.81", "0.87"]
    assert [row["num_gaussians"] for row in rows[:4]] == ["2000", "", "", "2000"]
    assert (rows[0]["train_seconds"], rows[0]["inference_ms"], rows[0]["num_parameters"]) == ("60.5", "17.25", "123456")
    assert (table.row_count, seeds.row_count) == (6, 1)
    assert table.caption == "experiment=spectrum, data=rfid, split=official, device=cpu; all columns in ablation.md"
    markdown = (tmp_path / "ablation.md").read_text().splitlines()
    assert len({line.count("|") for line in markdown[:8]}) == 1
    assert markdown[3].startswith("| 1 | unfinished |  | multiview | 1 |")
    assert table.caption.removesuffix("; all columns in ablation.md") in markdown
    assert image.imread(tmp_path / "speed_against_error.png").shape[1] > 1000


def test_split_is_a_column_where_it_varies(tmp_path):
    write_run(tmp_path, "0", ["data/split=official"], models=scores(0.91))
    write_run(tmp_path, "1", ["data/split=runs"], split="runs of 20", models=scores(0.71, mean=0.5, knn=0.7))
    report(tmp_path)
    baselines = [(row["model"], row["split"], row["ssim_median"]) for row in read_csv(tmp_path)[2:]]
    assert baselines == [
        ("mean", "official", "0.6"),
        ("knn", "official", "0.95"),
        ("mean", "runs of 20", "0.5"),
        ("knn", "runs of 20", "0.7"),
    ]


def test_speed_is_drawn_from_the_runs_that_ended(tmp_path, monkeypatch):
    write_run(tmp_path, "0", ["tokenizer=ga", "seed=3"], models=scores(0.91))
    write_run(tmp_path, "1", ["tokenizer=broken", "seed=3"])
    write_run(tmp_path, "2", ["tokenizer=none", "seed=3"], models=scores(0.8), inference_ms=None)
    drawn = []
    original = multirun.speed_against_error
    monkeypatch.setattr(multirun, "speed_against_error", lambda *args: drawn.append(args) or original(*args))
    report(tmp_path)
    names, values, times, label, baselines = drawn[0]
    assert names == ["tokenizer=ga", "tokenizer=none"]
    assert values.tolist() == [0.91, 0.8]
    assert [str(time) for time in times["inference [ms a transmitter]"]] == ["17.25", "nan"]
    assert times["training [s]"].tolist() == [60.5, 60.5]
    assert (label, baselines) == ("median SSIM", {"mean": 0.6, "knn": 0.95})


def test_runs_of_rssi(tmp_path, monkeypatch):
    common, at = ["+experiment=rssi", "data=nerf2_rssi"], {"g": errors(3.0)}
    write_run(tmp_path, "0", [*common, "pooling=softmax_attention"], "rssi", models=errors(3.859), receivers=at)
    write_run(tmp_path, "1", [*common, "pooling=mean_power"], "rssi", models=errors(4.021), receivers=at)
    drawn = []
    original = multirun.speed_against_error
    monkeypatch.setattr(multirun, "speed_against_error", lambda *args: drawn.append(args) or original(*args))
    tables = report(tmp_path)
    rows = read_csv(tmp_path)
    assert list(rows[0])[3:7] == ["pooling", "mae_db", "median_ae_db", "rmse_db"]
    assert [row["mae_db"] for row in rows] == ["3.859", "4.021", "4.158", "4.974"]
    assert [row["model"] for row in rows[2:]] == ["knn", "path_loss"]  # once, for they are the same in both runs
    assert not any("ssim" in column for column in rows[0])
    names, values, _, label, baselines = drawn[0]
    assert names == ["pooling=softmax_attention", "pooling=mean_power"]
    assert values.tolist() == [3.859, 4.021]
    assert (label, baselines) == ("MAE [dB]", {"knn": 4.158, "path_loss": 4.974})
    printed = "\n".join(terminal(tables))
    assert all(score in printed for score in ("3.859", "4.021", "4.158", "4.974"))
    assert "…" not in printed  # long names are folded
    assert "RMSE" not in printed
    assert "RMSE [dB]" in (tmp_path / "ablation.md").read_text()


def test_runs_of_channels_fit_a_terminal(tmp_path):
    for i, pooling in enumerate(("element_sum", "softmax_attention")):
        for seed in (1, 2):
            name = f"pooling={pooling},seed={seed}"
            overrides = ["data=image_source", f"pooling={pooling}", f"seed={seed}"]
            write_run(tmp_path, name, overrides, "csi", seed=seed, models=channels(12.25 + i + seed / 8))
    lines = terminal(report(tmp_path))
    assert not any("…" in line for line in lines)
    for score in ("12.4", "12.5", "13.4", "13.5", "-1.500", "12.4 ± 0.088", "least 12.4"):  # medians
        assert any(score in line for line in lines)
    assert not any("p10" in line for line in lines)
    header = " ".join(lines[: next(i for i, line in enumerate(lines) if "━" in line or "─" in line)])
    assert all(word in header.split() for word in ("removed", "inference", "parameters", "training"))  # whole words


def test_runs_lie_at_any_depth_and_are_named_by_their_folders(tmp_path):
    write_run(tmp_path, "first/width=16,seed=2", ["width=16", "seed=2"], models=scores(0.91))
    write_run(tmp_path, "first/width=8,seed=10", ["width=8", "seed=10"], models=scores(0.9))
    write_run(tmp_path, "first/width=8,seed=2", ["width=8", "seed=2"], models=scores(0.89))
    write_run(tmp_path, "second/deeper/²", ["width=4", "seed=2"], models=scores(0.88))
    names = ["first/width=8,seed=2", "first/width=8,seed=10", "first/width=16,seed=2", "second/deeper/²"]
    assert [run.name for run in read_runs(tmp_path)] == names
    assert [run.name for run in read_runs(tmp_path / "second" / "deeper" / "²")] == ["."]
    report(tmp_path)
    assert [row["run"] for row in read_csv(tmp_path)][:4] == names


def test_names_are_shown_only_where_the_overrides_do_not_tell(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(multirun, "speed_against_error", lambda *args: drawn.append(args[0]) or Figure())
    write_run(tmp_path, "a/one", ["width=8"], models=scores(0.9))
    write_run(tmp_path, "a/two", ["width=9"], models=scores(0.9))
    assert not any("a/one" in line for line in terminal(report(tmp_path)))
    write_run(tmp_path, "b/one", ["width=8"], models=scores(0.8))
    lines = terminal(report(tmp_path))
    assert all(any(name in line for line in lines) for name in ("a/one", "a/two", "b/one"))
    assert drawn == [["width=8", "width=9"], ["a/one", "a/two", "b/one"]]


def test_spread_over_seeds(tmp_path):
    medians = {("8", "1"): 0.90, ("8", "2"): 0.84, ("8", "3"): 0.87, ("16", "1"): 0.95, ("16", "2"): 0.93}
    for (width, seed), median in medians.items():
        overrides = ["data=rfid", f"width={width}", f"seed={seed}"]
        write_run(tmp_path, f"{width}-{seed}", overrides, seed=int(seed), models=scores(median))
    write_run(tmp_path, "8-4", ["data=rfid", "width=8", "seed=4"])  # unfinished
    write_run(tmp_path, "32-1", ["data=rfid", "width=32", "seed=1"], models=scores(0.99))  # alone
    _, seeds = report(tmp_path).renderables
    rows = [row for row in read_csv(tmp_path) if row["status"] == "seeds"]
    assert [(row["width"], row["runs"]) for row in rows] == [("8", "3"), ("16", "2")]
    for row, values in zip(rows, ([0.90, 0.84, 0.87], [0.95, 0.93]), strict=True):
        assert float(row["ssim_median"]) == pytest.approx(np.mean(values))
        assert float(row["ssim_median_sd"]) == pytest.approx(np.std(values, ddof=1))
        assert float(row["ssim_median_least"]) == min(values)
        assert float(row["mae_least"]) == pytest.approx(1 - max(values))
    assert all(row["ssim_median_sd"] == "" for row in read_csv(tmp_path) if row["status"] != "seeds")
    assert [column.header for column in seeds.columns] == ["model", "width", "runs", "median\nSSIM", "MAE"]
    lines = (tmp_path / "ablation.md").read_text().splitlines()
    assert "| gaigs | 8 | 3 | 0.870 ± 0.030, least 0.840 | 0.130 ± 0.030, least 0.100 |" in [
        line.removeprefix("| seeds ") for line in lines
    ]
    printed = "\n".join(terminal(report(tmp_path)))
    assert "0.940 ± 0.014" in printed
    assert "least 0.930" in printed


def test_runs_of_one_seed_have_no_spread(tmp_path):
    write_run(tmp_path, "a", ["width=8"], models=scores(0.9))
    write_run(tmp_path, "b", ["width=8"], models=scores(0.9))  # the same once more
    write_run(tmp_path, "c", ["width=9", "seed=2"], seed=2, models=scores(0.9))
    assert len(report(tmp_path).renderables) == 1
    assert "seeds" not in {row["status"] for row in read_csv(tmp_path)}


def test_a_seed_by_default_and_one_asked_for_are_two(tmp_path):
    write_run(tmp_path, "a", ["width=8"], models=scores(0.9))
    write_run(tmp_path, "b", ["width=8", "seed=2"], seed=2, split="random, seed 2", models=scores(0.8))
    assert len(report(tmp_path).renderables) == 2
    (row,) = (row for row in read_csv(tmp_path) if row["status"] == "seeds")
    assert (row["split"], row["runs"], row["ssim_median_least"]) == ("2 splits", "2", "0.8")


def test_runs_of_two_tasks_make_no_table(tmp_path):
    write_run(tmp_path, "a", ["data=rfid"], models=scores(0.9))
    write_run(tmp_path, "b", ["data=ble"], "rssi", models=errors(3.9))
    with pytest.raises(
        ValueError, match="must be of one task, got spectrum in a, rssi in b; pass a folder with runs of"
    ):
        report(tmp_path)
    assert not (tmp_path / "ablation.csv").exists()


def test_models_may_vary(tmp_path):
    write_run(tmp_path, "0", ["model=gaigs_small"], models=scores(0.9))
    write_run(tmp_path, "1", ["model=mlp"], models={"mlp": scores(0.8)["gaigs"]})
    write_run(tmp_path, "2", ["model=fire"])
    report(tmp_path)
    assert [row["model"] for row in read_csv(tmp_path)] == ["gaigs_small", "mlp", "fire", "mean", "knn"]


def test_none_has_ended(tmp_path):
    write_run(tmp_path, "0", ["tokenizer=[a]"])
    write_run(tmp_path, "1", ["tokenizer=[b]"])
    (table,) = report(tmp_path).renderables
    assert table.row_count == 2
    assert [(row["status"], row["tokenizer"]) for row in read_csv(tmp_path)] == [
        ("unfinished", "[a]"),
        ("unfinished", "[b]"),
    ]
    assert not (tmp_path / "speed_against_error.png").exists()


def test_a_folder_may_be_a_string(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{re.escape(str(tmp_path))} must hold runs"):
        report(str(tmp_path))
    with pytest.raises(TypeError, match="folder must be a path, got 3"):
        report(3)


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{re.escape(str(tmp_path))} must hold runs"):
        report(tmp_path)


def without(*keys):
    """Spoils a file of metrics by leaving a key out, at any depth."""

    def spoil(file):
        metrics = part = json.loads(file.read_text())
        for key in keys[:-1]:
            part = part[key]
        del part[keys[-1]]
        file.write_text(json.dumps(metrics))

    return spoil


DAMAGED = {
    "truncated": (lambda file: file.write_text(file.read_text()[:-20]), "Expecting"),
    "empty": (lambda file: file.write_text(""), "Expecting value"),
    "of another program": (lambda file: file.write_bytes(b"\xff\xfe\x00"), "can't decode byte 0xff"),
    "a list": (lambda file: file.write_text("[1, 2]"), r"it must be a mapping, got \[1, 2\]"),
    "brackets": (lambda file: file.write_text("[" * 10**5), "recursion depth"),
    "without a task": (without("task"), "must have the key 'task'"),
    "without a split": (without("split"), "'split' must be a string, got None"),
    "without models": (without("models"), "'models' must be the scores of models, got None"),
    "without a score": (
        without("models", "mean", "ssim_median"),
        "'ssim_median' of 'mean' in 'models' must be a number",
    ),
    "with a word for a time": (
        lambda file: file.write_text(file.read_text().replace("60.5", '"long"')),
        "'train_seconds' must be a number or null, got 'long'",
    ),
    "with an unknown task": (
        lambda file: file.write_text(file.read_text().replace('"spectrum"', '"spectra"')),
        r"unknown task 'spectra' \(did you mean 'spectrum'\?\)",
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_metrics_are_named_in_one_line(damage, tmp_path, monkeypatch, capsys):
    spoil, message = DAMAGED[damage]
    for name in ("0", "1"):
        write_run(tmp_path, name, [f"seed={name}"], seed=int(name), models=scores(0.9))
    spoil(tmp_path / "1" / "metrics.json")
    with pytest.raises(ValueError, match=rf"/1/metrics\.json must hold what a run writes, .*{message}") as error:
        report(tmp_path)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(
        "move the file elsewhere, and the run's command writes it anew without another training"
    )
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not [*tmp_path.glob("ablation.*")]


@pytest.mark.parametrize("text", ["", "{a: 1", "seed=1", "a: 1"])
def test_damaged_overrides_are_named_in_one_line(text, tmp_path):
    write_run(tmp_path, "0", ["seed=1"], models=scores(0.9))
    (tmp_path / "0" / ".hydra" / "overrides.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"overrides\.yaml must be YAML that Hydra wrote") as error:
        report(tmp_path)
    assert "\n" not in str(error.value)


def test_a_score_that_one_seed_lacks_has_no_spread(tmp_path):
    for seed in (1, 2):
        write_run(tmp_path, str(seed), [f"seed={seed}"], seed=seed, models=scores(0.9))
    without("models", "gaigs", "mae")(tmp_path / "2" / "metrics.json")
    report(tmp_path)
    assert "mae_sd" not in read_csv(tmp_path)[-1]


def test_a_full_disk_leaves_no_part_of_a_figure(tmp_path, monkeypatch):
    write_run(tmp_path, "0", ["seed=1"], models=scores(0.9))

    def fill(figure, file, **options):
        file.write_text("ha")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Figure, "savefig", fill)
    with pytest.raises(OSError, match=r"speed_against_error\.png could not be written \(No space left on device\)"):
        report(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"0", "ablation.csv", "ablation.md"}


def test_overrides_of_a_refused_start_are_not_taken_for_the_runs(tmp_path):
    write_run(tmp_path, "0", ["seed=2"], models=scores(0.9))
    (tmp_path / "0" / "config.yaml").write_text("seed: 1\n")  # what the run's metrics are of
    (tmp_path / "0" / ".hydra" / "config.yaml").write_text("seed: 2\n")
    with pytest.raises(ValueError, match="holds a run of another configuration than the one last started there"):
        report(tmp_path)
    (tmp_path / "0" / ".hydra" / "config.yaml").write_text("seed: 1\nsave_every: 5\n")  # which changes no result
    (table,) = report(tmp_path).renderables
    assert table.row_count == 3


def test_command_line(tmp_path, monkeypatch, capsys):
    from gaigs.report.__main__ import main

    monkeypatch.setenv("COLUMNS", "150")
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "must hold runs, each with its" in capsys.readouterr().err
    write_run(tmp_path, "0", ["tokenizer=[ga]"], models=scores(0.9))
    write_run(tmp_path, "1", ["tokenizer=none"])
    main()
    printed = capsys.readouterr().out
    assert "[ga]" in printed
    assert "unfinished" in printed


def test_a_run_without_its_kriging_is_no_baseline(tmp_path):
    models = scores(0.9)
    models = {"gaigs": models["gaigs"], "gaigs_trend": {"ssim_median": 0.8, "mae": 0.2}} | models
    write_run(tmp_path, "0", ["kriging=true"], models=models)
    rows, _ = ablation(read_runs(tmp_path))
    assert [(row["status"], row["model"]) for row in rows] == [
        ("done", "gaigs"),
        ("baseline", "mean"),
        ("baseline", "knn"),
    ]
