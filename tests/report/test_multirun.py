"""Tables of a multirun, and the folders that they refuse."""

import json
import re
import sys

import numpy as np
import pytest
import yaml
from folders import FACTS, read, terminal, write_run

from gaigs.report.__main__ import main
from gaigs.report.ablation import ablation
from gaigs.report.multirun import report
from gaigs.report.run_folders import read_metrics, read_runs


def scores(gaigs, mean=0.6, knn=0.95):
    medians = {"gaigs": gaigs, "mean": mean, "knn": knn}
    return {name: {"ssim_median": median, "mae": 1 - median} for name, median in medians.items()}


def errors(gaigs, knn=4.158, path_loss=4.974):
    means = {"gaigs": gaigs, "knn": knn, "path_loss": path_loss}
    return {
        name: {"mae_db": e, "median_ae_db": 0.8 * e, "rmse_db": 1.3 * e}
        for name, e in means.items()
    }


# --- one row a run ---


def test_overrides_are_read_as_they_were_typed(tmp_path):
    for number, tokenizer in enumerate(("ga", "'a|b'", r"a\,b")):
        models = scores(0.9) if number < 2 else None
        write_run(tmp_path / str(number), [f"+tokenizer={tokenizer}", "+widths=[8,16]"], models)
    runs = read_runs(tmp_path)
    assert [run.name for run in runs] == ["0", "1", "2"]
    assert [run.metrics is None for run in runs] == [False, False, True]
    rows, shared = ablation(runs)
    assert [row.get("tokenizer") for row in rows[:3]] == ["ga", "'a|b'", "a,b"]
    assert shared["widths"] == "[8,16]"
    report(tmp_path)
    assert r"a\|b" in (tmp_path / "ablation.md").read_text()
    assert (tmp_path / "speed_against_error.png").exists()


def test_names_of_runs_are_no_formulas_and_no_markup(tmp_path):
    for name in ("@[bold]one", "@two[/red]"):
        write_run(tmp_path / name, [], scores(0.9))
    text = "\n".join(terminal(report(tmp_path)))
    assert [row["run"] for row in read(tmp_path / "ablation.csv")][:2] == [
        "'@[bold]one",
        "'@two[/red]",
    ]
    assert "@[bold]one" in text
    assert "@two[/red]" in text


def test_unfinished_runs_stay_and_baselines_come_once(tmp_path):
    common = ["+experiment=spectrum", "data=rfid"]
    write_run(tmp_path / "0", [*common, "tokenizer=ga", "seed=1"], scores(0.91), seed=1)
    write_run(tmp_path / "1", [*common, "tokenizer=multiview", "seed=1"])
    write_run(
        tmp_path / "10", [*common, "tokenizer=ga", "seed=2"], scores(0.87, knn=0.95 + 1e-9), seed=2
    )
    write_run(
        tmp_path / "2",
        [*common, "tokenizer=euclidean", "seed=1"],
        scores(0.81),
        seed=1,
        num_gaussians=None,
    )
    table, seeds = report(tmp_path).renderables
    rows = read(tmp_path / "ablation.csv")
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
    assert [row["num_gaussians"] for row in rows[:4]] == ["0", "", "", "0"]
    assert (rows[0]["train_seconds"], rows[0]["inference_ms"], rows[0]["num_parameters"]) == (
        "180.0",
        "17.25",
        "1234",
    )
    assert (table.row_count, seeds.row_count) == (6, 1)
    assert (
        table.caption
        == "experiment=spectrum, data=rfid, split=official, device=cpu; all columns in ablation.csv"
    )
    markdown = (tmp_path / "ablation.md").read_text().splitlines()
    assert len({line.count("|") for line in markdown[:8]}) == 1
    assert markdown[3].startswith("| unfinished |  | multiview | 1 |")
    assert table.caption.removesuffix("; all columns in ablation.csv") in markdown


def test_runs_of_rssi(tmp_path):
    common = ["+experiment=rssi", "data=nerf2_rssi"]
    at = {"g": errors(3.0)}
    write_run(
        tmp_path / "0", [*common, "pooling=softmax_attention"], errors(3.859), "rssi", receivers=at
    )
    write_run(
        tmp_path / "1", [*common, "pooling=mean_power"], errors(4.021), "rssi", inference_ms=None
    )
    write_run(tmp_path / "2", [*common, "pooling=broken"], task="rssi")
    printed = "\n".join(terminal(report(tmp_path)))
    rows = read(tmp_path / "ablation.csv")
    assert list(rows[0])[3:7] == ["pooling", "mae_db", "median_ae_db", "rmse_db"]
    assert [row["mae_db"] for row in rows] == ["3.859", "4.021", "", "4.158", "4.974"]
    assert [row["model"] for row in rows[3:]] == ["knn", "path_loss"]
    assert all(score in printed for score in ("3.859", "4.021", "4.158", "4.974"))
    assert "…" not in printed  # long names are folded
    assert "RMSE" not in printed
    assert "RMSE [dB]" in (tmp_path / "ablation.md").read_text()


def test_names_are_shown_only_if_the_overrides_are_equal(tmp_path):
    write_run(tmp_path / "a/one", ["width=8"], scores(0.9))
    write_run(tmp_path / "a/two", ["width=9"], scores(0.9))
    assert not any("a/one" in line for line in terminal(report(tmp_path)))
    write_run(tmp_path / "b/one", ["width=8"], scores(0.8))
    lines = terminal(report(tmp_path))
    assert all(any(name in line for line in lines) for name in ("a/one", "a/two", "b/one"))


def test_runs_without_a_result_have_rows(tmp_path):
    write_run(tmp_path / "0", ["tokenizer=[a]"], log="data: room\ngaigs: the disk is full\n")
    write_run(tmp_path / "1", ["tokenizer=[b]"])
    (table,) = report(tmp_path).renderables
    assert table.row_count == 2
    rows = read(tmp_path / "ablation.csv")
    assert [(row["status"], row["tokenizer"]) for row in rows] == [
        ("unfinished", "[a]"),
        ("unfinished", "[b]"),
    ]
    assert "- without a result: 0: the disk is full\n" in (tmp_path / "ablation.md").read_text()


# --- over seeds ---


def test_spread_over_seeds(tmp_path):
    medians = {
        ("8", "1"): 0.90,
        ("8", "2"): 0.84,
        ("8", "3"): 0.87,
        ("16", "1"): 0.95,
        ("16", "2"): 0.93,
    }
    for (width, seed), median in medians.items():
        overrides = ["data=rfid", f"width={width}", f"seed={seed}"]
        write_run(tmp_path / f"{width}-{seed}", overrides, scores(median), seed=int(seed))
    write_run(tmp_path / "8-4", ["data=rfid", "width=8", "seed=4"])  # unfinished
    write_run(tmp_path / "32-1", ["data=rfid", "width=32", "seed=1"], scores(0.99), seed=1)  # alone
    tables = report(tmp_path)
    _, seeds = tables.renderables
    rows = read(tmp_path / "ablation.csv")
    spread = [row for row in rows if row["status"] == "seeds"]
    assert [(row["width"], row["runs"]) for row in spread] == [("8", "3"), ("16", "2")]
    for row, values in zip(spread, ([0.90, 0.84, 0.87], [0.95, 0.93]), strict=True):
        assert float(row["ssim_median"]) == pytest.approx(np.mean(values))
        assert float(row["ssim_median_sd"]) == pytest.approx(np.std(values, ddof=1))
        assert float(row["ssim_median_least"]) == min(values)
        assert float(row["mae_least"]) == pytest.approx(1 - max(values))
    assert all(row["ssim_median_sd"] == "" for row in rows if row["status"] != "seeds")
    assert [column.header for column in seeds.columns] == [
        "model",
        "width",
        "runs",
        "median\nSSIM",
        "MAE",
    ]
    page = (tmp_path / "ablation.md").read_text()
    assert "| gaigs | 8 | 3 | 0.870 ± 0.030, least 0.840 | 0.130 ± 0.030, least 0.100 |\n" in page
    printed = "\n".join(terminal(tables))
    assert "0.940 ± 0.014" in printed
    assert "least 0.930" in printed


def test_runs_of_one_seed_have_no_spread_and_a_default_seed_counts(tmp_path):
    write_run(tmp_path / "a", ["width=8"], scores(0.9))
    write_run(tmp_path / "b", ["width=8"], scores(0.9))  # the same once more
    write_run(tmp_path / "c", ["width=9", "seed=2"], scores(0.9), seed=2)
    assert len(report(tmp_path).renderables) == 1
    models = scores(0.8)
    del models["gaigs"]["mae"]  # a score that one seed lacks has no spread
    write_run(tmp_path / "d", ["width=9"], models, split="random, seed 0")
    assert len(report(tmp_path).renderables) == 2
    (row,) = (row for row in read(tmp_path / "ablation.csv") if row["status"] == "seeds")
    assert (row["split"], row["runs"], row["ssim_median_least"]) == ("2 splits", "2", "0.8")
    assert "mae_sd" not in row


# --- refused ---


def test_runs_of_two_tasks_make_no_table(tmp_path):
    write_run(tmp_path / "a", ["data=rfid"], scores(0.9))
    write_run(tmp_path / "b", ["data=ble"], errors(3.9), "rssi")
    with pytest.raises(
        ValueError,
        match="must be of one task, got spectrum in a, rssi in b; pass a folder with runs",
    ):
        report(tmp_path)
    assert not (tmp_path / "ablation.csv").exists()


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{re.escape(str(tmp_path))} must hold runs"):
        report(str(tmp_path))


METRICS = FACTS | {"task": "spectrum", "models": scores(0.9)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (json.dumps(METRICS)[:-20], "JSONDecodeError: Expecting"),
        ("[1, 2]", "TypeError"),
        (json.dumps(FACTS), "KeyError: 'task'"),
        (
            json.dumps(METRICS | {"models": {"mean": {"ssim_median": None}}}),
            "'ssim_median' must be a number, got None",
        ),
        (
            json.dumps(METRICS | {"task": "spectra"}),
            r"unknown task 'spectra' \(did you mean 'spectrum'\?\)",
        ),
    ],
)
def test_a_damaged_file_of_metrics_is_named(content, message, tmp_path):
    (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(
        ValueError, match=rf"cannot read .*metrics\.json \(.*{message}.*\)\nmove it elsewhere"
    ):
        read_metrics(tmp_path / "metrics.json")


@pytest.mark.parametrize("text", ["{a: 1", "a: 1"])
def test_a_damaged_file_of_overrides_is_named(text, tmp_path):
    run = write_run(tmp_path / "0", ["seed=1"], scores(0.9))
    (run / ".hydra" / "overrides.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"cannot parse .*overrides\.yaml, which Hydra wrote: "):
        report(tmp_path)


def test_overrides_of_a_refused_start_are_not_shown_as_the_runs(tmp_path):
    run = write_run(tmp_path / "0", ["seed=2"], scores(0.9))
    (run / "config.yaml").write_text("seed: 1\n")  # of the run's metrics
    (run / ".hydra" / "config.yaml").write_text("seed: 2\n")
    with pytest.raises(
        ValueError, match="holds a run of another configuration than the one last started there"
    ):
        report(tmp_path)
    (run / ".hydra" / "config.yaml").write_text(
        "seed: 1\nsave_every: 5\n"
    )  # which changes no result
    assert len(read_runs(tmp_path)) == 1


def write_configured(folder, overrides, config, own):
    write_run(folder, overrides, scores(own), seed=config["seed"])
    (folder / "config.yaml").write_text(yaml.safe_dump(config))


def configured(seed, tokenizer="ga", deformation="two_branch", **others):
    parts = {"tokenizer": {"name": tokenizer}, "deformation": {"name": deformation}}
    return {
        "seed": seed,
        "model": {"name": "gaigs", **parts},
        **parts,
        "split": {"name": "official"},
    } | others


def test_the_configuration_counts_where_overrides_were_changed(tmp_path):
    words = [
        "tokenizer=ga",
        "split=official_runs",
        "+experiment=spectrum",
        "rate=1e-3",
        "name='a b'",
        "list=[1,2]",
    ]
    others = {"rate": 0.001, "name": "a b", "list": [1, 2]}
    write_configured(tmp_path / "0", [*words, "seed=0"], configured(0, **others), 0.9)
    write_configured(tmp_path / "1", [*words, "seed=0"], configured(1, "euclidean", **others), 0.7)
    first, second = read_runs(tmp_path)
    assert first.doubts == []
    assert (second.overrides["tokenizer"], second.overrides["seed"]) == ("euclidean", "1")
    named = ".hydra/overrides.yaml has tokenizer=ga, and config.yaml euclidean, which counts"
    assert second.doubts[0] == named
    report(tmp_path)
    assert f"- 1: {named}\n" in (tmp_path / "ablation.md").read_text()
    assert not [row for row in read(tmp_path / "ablation.csv") if row["status"] == "seeds"]


def test_runs_whose_overrides_were_cut_are_told_apart(tmp_path):
    for seed, tokenizer, words in (
        (0, "ga", ["seed=0"]),
        (1, "ga", ["seed=1"]),
        (2, "euclidean", ["seed=2"]),
    ):
        write_configured(tmp_path / str(seed), words, configured(seed, tokenizer), 0.9)
    assert [run.overrides["tokenizer"] for run in read_runs(tmp_path)] == ["ga", "ga", "euclidean"]
    assert [run.doubts for run in read_runs(tmp_path)][:2] == [[], []]
    report(tmp_path)
    assert (
        "2: .hydra/overrides.yaml has no tokenizer, and config.yaml euclidean"
        in (tmp_path / "ablation.md").read_text()
    )
    (group,) = [row for row in read(tmp_path / "ablation.csv") if row["status"] == "seeds"]
    assert (group["tokenizer"], group["runs"]) == ("ga", "2")


def test_runs_that_differ_in_two_things_are_told_apart(tmp_path):
    write_configured(tmp_path / "0", ["seed=0"], configured(0), 0.9)
    write_configured(tmp_path / "1", ["seed=1"], configured(1, "euclidean", rate=2), 0.9)
    first, second = read_runs(tmp_path)
    assert (first.overrides["tokenizer"], second.overrides["tokenizer"]) == ("ga", "euclidean")
    assert (first.overrides["rate"], second.overrides["rate"]) == ("None", "2")
    assert len(first.doubts + second.doubts) == 2


def test_a_tokenizer_that_is_not_read_is_none_in_tables(tmp_path):
    for seed, tokenizer in enumerate(("ga", "euclidean")):
        words = [f"tokenizer={tokenizer}", "deformation=none", f"seed={seed}"]
        write_configured(tmp_path / str(seed), words, configured(seed, tokenizer, "none"), 0.9)
    runs = read_runs(tmp_path)
    assert [(run.overrides["tokenizer"], run.doubts) for run in runs] == [("none", [])] * 2


def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "must hold runs, each with its" in capsys.readouterr().err
    write_run(tmp_path / "0", ["tokenizer=[ga]"], scores(0.9))
    write_run(tmp_path / "1", ["tokenizer=none"])
    main()
    printed = capsys.readouterr().out
    assert "[ga]" in printed
    assert "unfinished" in printed


def test_models_may_vary_and_a_run_without_its_kriging_is_no_baseline(tmp_path):
    kriged = {
        "gaigs": scores(0.9)["gaigs"],
        "gaigs_trend": {"ssim_median": 0.8, "mae": 0.2},
    } | scores(0.9)
    write_run(tmp_path / "0", ["model=gaigs_small"], kriged)
    write_run(tmp_path / "1", ["model=mlp"], {"mlp": scores(0.8)["gaigs"]})
    write_run(tmp_path / "2", ["model=fire"])
    report(tmp_path)
    assert [row["model"] for row in read(tmp_path / "ablation.csv")] == [
        "gaigs_small",
        "mlp",
        "fire",
        "mean",
        "knn",
    ]


def test_a_run_of_a_baseline_comes_once_in_a_paper(tmp_path):
    for name in ("gaigs", "knn"):
        models = scores(0.9)
        write_run(tmp_path / name, [f"model={name}"], {name: models[name]} | models)
    report(tmp_path)
    lines = (tmp_path / "ablation.tex").read_text().splitlines()
    rows = [line.partition(" ")[0] for line in lines if line.endswith(r"\\")]
    assert sorted(rows) == ["gaigs", "knn", "mean", "model"]


def test_runs_lie_at_any_depth_and_are_named_by_their_folders(tmp_path):
    write_run(tmp_path / "first/width=16,seed=2", ["width=16", "seed=2"], scores(0.91))
    write_run(tmp_path / "first/width=8,seed=10", ["width=8", "seed=10"], scores(0.9))
    write_run(tmp_path / "first/width=8,seed=2", ["width=8", "seed=2"], scores(0.89))
    write_run(tmp_path / "second/deeper/²", ["width=4", "seed=2"], scores(0.88))
    names = [
        "first/width=8,seed=2",
        "first/width=8,seed=10",
        "first/width=16,seed=2",
        "second/deeper/²",
    ]
    assert [run.name for run in read_runs(tmp_path)] == names
    assert [run.name for run in read_runs(tmp_path / "second" / "deeper" / "²")] == ["."]
