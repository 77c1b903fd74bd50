"""Folders that Hydra itself makes, and what the report makes of them."""

import csv
import json
import re
import subprocess
import sys
from io import StringIO

import pytest
import yaml
from matplotlib import image
from rich.console import Console

from gaigs.report import multirun
from gaigs.report.multirun import ablation, read_runs, report

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
    run = {"split": "official", "seed": 1, "device": "cpu", "models": models}
    Path(HydraConfig.get().runtime.output_dir, "metrics.json").write_text(json.dumps(run))

main()
"""


def write_run(folder, number, overrides, **metrics):
    (folder / number / ".hydra").mkdir(parents=True)
    (folder / number / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    if metrics:
        facts = {"split": "official", "seed": 1, "device": "cpu", "train_seconds": 60.5, "inference_ms": 17.25}
        facts |= {"num_gaussians": 2000, "num_parameters": 123456}
        (folder / number / "metrics.json").write_text(json.dumps(facts | metrics))


def scores(gaigs, mean=0.6, knn=0.95):
    medians = {"gaigs": gaigs, "mean": mean, "knn": knn}
    return {name: {"ssim_median": median, "mae": 1 - median} for name, median in medians.items()}


def errors(gaigs, knn=4.158, path_loss=4.974):
    means = {"gaigs": gaigs, "knn": knn, "path_loss": path_loss}
    return {name: {"mae_db": e, "median_ae_db": 0.8 * e, "rmse_db": 1.3 * e} for name, e in means.items()}


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


def test_failed_runs_stay_and_lookups_come_once(tmp_path):
    common = ["+experiment=spectrum", "data=rfid"]
    write_run(tmp_path, "0", [*common, "tokenizer=ga", "seed=1"], models=scores(0.91))
    write_run(tmp_path, "1", [*common, "tokenizer=multiview", "seed=1"])
    write_run(tmp_path, "10", [*common, "tokenizer=ga", "seed=2"], seed=2, models=scores(0.87, knn=0.95 + 1e-9))
    write_run(tmp_path, "2", [*common, "tokenizer=euclidean", "seed=1"], models=scores(0.81), num_gaussians=None)
    table = report(tmp_path)
    rows = read_csv(tmp_path)
    assert list(rows[0])[:5] == ["run", "status", "model", "tokenizer", "seed"]
    assert [(row["run"], row["status"], row["model"]) for row in rows] == [
        ("0", "done", "gaigs"),
        ("1", "failed", ""),
        ("2", "done", "gaigs"),
        ("10", "done", "gaigs"),
        ("", "look-up", "mean"),
        ("", "look-up", "knn"),
    ]
    assert [row["ssim_median"] for row in rows[:4]] == ["0.91", "", "0.81", "0.87"]
    assert [row["num_gaussians"] for row in rows[:4]] == ["2000", "", "", "2000"]
    assert (rows[0]["train_seconds"], rows[0]["inference_ms"], rows[0]["num_parameters"]) == ("60.5", "17.25", "123456")
    assert table.row_count == 6
    assert table.caption == "experiment=spectrum, data=rfid, split=official, device=cpu; all columns in ablation.md"
    markdown = (tmp_path / "ablation.md").read_text().splitlines()
    assert len({line.count("|") for line in markdown[:8]}) == 1
    assert markdown[3].startswith("| 1 | failed |  | multiview | 1 |")
    assert markdown[-1] == table.caption.removesuffix("; all columns in ablation.md")
    assert image.imread(tmp_path / "speed_against_error.png").shape[1] > 1000


def test_split_is_a_column_where_it_varies(tmp_path):
    write_run(tmp_path, "0", ["data/split=official"], models=scores(0.91))
    write_run(tmp_path, "1", ["data/split=runs"], split="runs of 20", models=scores(0.71, mean=0.5, knn=0.7))
    report(tmp_path)
    lookups = [(row["model"], row["split"], row["ssim_median"]) for row in read_csv(tmp_path)[2:]]
    assert lookups == [
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
    names, values, times, label, lookups = drawn[0]
    assert names == ["tokenizer=ga", "tokenizer=none"]
    assert values.tolist() == [0.91, 0.8]
    assert [str(time) for time in times["inference [ms a transmitter]"]] == ["17.25", "nan"]
    assert times["training [s]"].tolist() == [60.5, 60.5]
    assert (label, lookups) == ("median SSIM", {"mean": 0.6, "knn": 0.95})


def test_runs_of_rssi(tmp_path, monkeypatch):
    common = ["+experiment=rssi", "data=nerf2_rssi"]
    write_run(tmp_path, "0", [*common, "pooling=softmax_attention"], models=errors(3.859), receivers={"g": errors(3.0)})
    write_run(tmp_path, "1", [*common, "pooling=mean_power"], models=errors(4.021), receivers={"g": errors(3.0)})
    drawn = []
    original = multirun.speed_against_error
    monkeypatch.setattr(multirun, "speed_against_error", lambda *args: drawn.append(args) or original(*args))
    table = report(tmp_path)
    rows = read_csv(tmp_path)
    assert list(rows[0])[3:7] == ["pooling", "mae_db", "median_ae_db", "rmse_db"]
    assert [row["mae_db"] for row in rows] == ["3.859", "4.021", "4.158", "4.974"]
    assert [row["model"] for row in rows[2:]] == ["knn", "path_loss"]  # once, for they are the same in both runs
    assert not any("ssim" in column for column in rows[0])
    names, values, _, label, lookups = drawn[0]
    assert names == ["pooling=softmax_attention", "pooling=mean_power"]
    assert values.tolist() == [3.859, 4.021]
    assert (label, lookups) == ("MAE [dB]", {"knn": 4.158, "path_loss": 4.974})
    console = Console(width=80, file=StringIO())
    console.print(table)
    printed = console.file.getvalue()
    assert all(score in printed for score in ("3.859", "4.021", "4.158", "4.974"))
    assert "…" not in printed  # long names are folded


def test_models_may_vary(tmp_path):
    write_run(tmp_path, "0", ["model=gaigs_small"], models=scores(0.9))
    write_run(tmp_path, "1", ["model=mlp"], models={"mlp": scores(0.8)["gaigs"]})
    write_run(tmp_path, "2", ["model=fire"])
    report(tmp_path)
    assert [row["model"] for row in read_csv(tmp_path)] == ["gaigs_small", "mlp", "fire", "mean", "knn"]


def test_all_failed(tmp_path):
    write_run(tmp_path, "0", ["tokenizer=[a]"])
    write_run(tmp_path, "1", ["tokenizer=[b]"])
    assert report(tmp_path).row_count == 2
    assert [(row["status"], row["tokenizer"]) for row in read_csv(tmp_path)] == [("failed", "[a]"), ("failed", "[b]")]
    assert not (tmp_path / "speed_against_error.png").exists()


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{re.escape(str(tmp_path))} must hold the runs"):
        report(tmp_path)


def test_overrides_of_a_refused_start_are_not_taken_for_the_runs(tmp_path):
    write_run(tmp_path, "0", ["seed=2"], models=scores(0.9))
    (tmp_path / "0" / "config.yaml").write_text("seed: 1\n")  # what the run's metrics are of
    (tmp_path / "0" / ".hydra" / "config.yaml").write_text("seed: 2\n")
    with pytest.raises(ValueError, match="holds a run of another configuration than the one last started there"):
        report(tmp_path)
    (tmp_path / "0" / ".hydra" / "config.yaml").write_text("seed: 1\nsave_every: 5\n")  # which changes no result
    assert report(tmp_path).row_count == 3


def test_command_line(tmp_path, monkeypatch, capsys):
    from gaigs.report.__main__ import main

    monkeypatch.setenv("COLUMNS", "150")
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "must hold the runs" in capsys.readouterr().err
    write_run(tmp_path, "0", ["tokenizer=[ga]"], models=scores(0.9))
    write_run(tmp_path, "1", ["tokenizer=none"])
    main()
    printed = capsys.readouterr().out
    assert "[ga]" in printed
    assert "failed" in printed
