"""Runs of several models, as the table and the figures of systems show them."""

import csv
import json

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from gaigs.registry import registry
from gaigs.report import systems
from gaigs.report.curves import learning_curves
from gaigs.report.multirun import report
from gaigs.report.runs import read_runs
from gaigs.report.spectra import side_by_side
from gaigs.report.systems import read_published
from gaigs.task import stored_scores

SCORES = ("ssim_median", "ssim_mean", "ssim_p10", "ssim_p90", "mae")
GRID = np.deg2rad(np.arange(1, 12)), np.deg2rad(np.arange(14))


def scores(median):
    return dict(zip(SCORES, (median, median - 0.01, median - 0.1, median + 0.01, 1 - median), strict=True))


def write_run(folder, model, median=None, seed=0, said=(), drawn=True, **facts):
    """A run of a spectrum's system, or one that has said something and ended without a result."""
    own = folder / f"model={model},seed={seed}"
    (own / ".hydra").mkdir(parents=True)
    (own / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(["data=room", f"model={model}", f"seed={seed}"]))
    (own / "gaigs.log").write_text("".join(f"{line}\n" for line in said))
    if median is None:
        return own
    models = {model: scores(median), "mean": scores(0.6), "knn": scores(0.9)}
    metrics = {"task": "spectrum", "split": "official", "seed": seed, "device": "cpu", "models": models}
    metrics |= {"validation": {name: scores(0.5) for name in models}, "train_seconds": 180.0, "inference_ms": 17.25}
    metrics |= {"render_ms": None, "num_parameters": 1234, "num_gaussians": 0, "checkpoint_bytes": 2_500_000}
    (own / "metrics.json").write_text(json.dumps(metrics | facts))
    if drawn:
        rng = np.random.default_rng(seed)
        spectra = rng.random((5, 11, 14))
        content = {"labels": spectra, "prediction": spectra + 0.1 * rng.random(spectra.shape)}
        content |= {f"ssim_{name}": value["ssim_median"] + 0.01 * np.arange(5) for name, value in models.items()}
        np.savez(own / "predictions.npz", elevations=GRID[0], azimuths=GRID[1], **content)
    return own


def write_log(own, *rows):
    """Steps, seconds and validation scores, as a training by time logs them."""
    (own / "log" / "version_0").mkdir(parents=True)
    with open(own / "log" / "version_0" / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["step", "seconds", "train/loss", "validation/ssim"])
        writer.writeheader()
        for step, seconds, ssim in rows:
            writer.writerow({"step": step, "seconds": seconds})
            writer.writerow({"step": step, "validation/ssim": ssim})
        writer.writerow({"step": 999, "train/loss": 0.5})


def read(folder):
    with open(folder / "systems.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def sweep(tmp_path):
    """Two systems with two seeds, one of a stranger, one that failed and one at work."""
    write_run(tmp_path, "yagi", 0.99)
    write_run(tmp_path, "gaigs", 0.94, num_gaussians=300, render_ms=3.5)
    write_run(tmp_path, "gaigs", 0.96, seed=1, num_gaussians=300, render_ms=4.5)
    write_run(tmp_path, "nerf2", 0.81, kriging={"seconds": 20.0})
    write_run(tmp_path, "nerf2", 0.83, seed=1)
    write_run(tmp_path, "fire", said=["data: room", "gaigs: model 'fire' gives levels; take another"])
    write_run(tmp_path, "mlp", said=["data: room", "gaigs: it failed at first", "going on after step 3"])
    return tmp_path


def test_published_figures_stand_beside_ours(sweep):
    report(sweep)
    rows = {row["system"]: row for row in read(sweep)}
    assert [*rows] == ["NeRF²", "GAI-GS", "yagi", "mean", "knn"]
    assert [row["published median SSIM, RFID"] for row in rows.values()] == ["0.78", "0.91", "", "", ""]
    assert [row["published training [min], A100"] for row in rows.values()] == ["", "203.0", "", "", ""]
    assert [row["model"] for row in rows.values()] == ["nerf2", "gaigs", "yagi", "mean", "knn"]
    assert [float(row["median SSIM"]) for row in rows.values()] == pytest.approx([0.82, 0.95, 0.99, 0.6, 0.9])
    assert float(rows["NeRF²"]["median SSIM, sd"]) == pytest.approx(np.std([0.81, 0.83], ddof=1))
    assert rows["yagi"]["median SSIM, sd"] == ""


def test_costs_stand_beside_the_scores(sweep):
    report(sweep)
    rows = {row["system"]: row for row in read(sweep)}
    assert [row["training [s]"] for row in rows.values()] == ["190.0", "180.0", "180.0", "", ""], "with its kriging"
    assert [row["rendering [ms]"] for row in rows.values()] == ["", "4.0", "", "", ""]
    assert [row["Gaussians"] for row in rows.values()] == ["", "300", "", "", ""]
    assert [row["checkpoint [MB]"] for row in rows.values()] == ["2.5", "2.5", "2.5", "", ""]


def test_markdown_and_latex(sweep):
    report(sweep)
    text = (sweep / "systems.md").read_text()
    scored, cost, notes = text.split("\n\n")
    assert scored.splitlines()[0].startswith("| system | published median SSIM, RFID | median SSIM | mean SSIM |")
    assert scored.splitlines()[2].startswith("| NeRF² | 0.780 | 0.820 ± 0.014 |")
    assert scored.splitlines()[4].startswith("| yagi |  | **0.990** |")
    assert scored.count("**") == 2 * len(SCORES)
    assert cost.splitlines()[0].startswith("| system | published training [min], A100 |")
    assert {line.count("|") for line in cost.splitlines()} == {cost.splitlines()[0].count("|")}
    assert notes.splitlines() == [
        "data=room, split=official, device=cpu",
        "- published median SSIM, RFID: GAI-GS, table 1, on the 6,123 spectra of NeRF²; WRF-GS+ after its repository, "
        "issue 4",
        "- published training [min], A100: GAI-GS, table 2, on a part of the same spectra and one NVIDIA A100",
        "- published inference [ms], A100: likewise",
        "- published rendering [ms], A100: likewise",
        "- without a result: MLP: unfinished",
        "- without a result: FIRE: model 'fire' gives levels; take another",
    ]
    first, second = (sweep / "systems.tex").read_text().split("\n\n")
    assert first.startswith(
        "\\begin{tabular}{lcccccc}\n\\toprule\nMethod & published median SSIM, RFID & median SSIM &"
    )
    assert r"NeRF\textsuperscript{2} & 0.780 & 0.820 $\pm$ 0.014 &" in first
    assert r"yagi & -- & \textbf{0.990} &" in first
    for part in (first, second):
        lines = part.strip().splitlines()
        assert lines[-2:] == [r"\bottomrule", r"\end{tabular}"]
        assert len({line.count("&") for line in lines if "&" in line}) == 1


def test_the_terminal_tells_what_has_no_result(sweep):
    *_, table = report(sweep).renderables
    assert table.title == "Systems"
    assert table.caption == (
        "MLP: unfinished\nFIRE: model 'fire' gives levels; take another\nall columns in systems.md"
    )
    heads = [column.header for column in table.columns]
    assert heads[:4] == ["system", "published\nmedian\nSSIM,\nRFID", "median\nSSIM", "MAE"]
    assert table.row_count == 5


def test_a_failure_is_the_last_line_of_the_log(sweep):
    failures = {run.overrides["model"]: run.failure for run in read_runs(sweep)}
    assert failures["fire"] == "model 'fire' gives levels; take another"
    assert failures["mlp"] is None, "it is at work again"
    assert failures["gaigs"] is None


def test_runs_of_one_model_are_no_table_of_systems(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    write_run(tmp_path, "gaigs", 0.8, seed=1)
    write_run(tmp_path, "fire")
    report(tmp_path)
    assert not [*tmp_path.glob("systems*")]


def test_what_is_varied_beside_model_and_seed_has_rows_of_its_own(tmp_path):
    for model in ("gaigs", "mlp"):
        for width in (8, 16):
            own = write_run(tmp_path / str(width), model, 0.9)
            overrides = [f"model={model}", f"width={width}"]
            (own / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    report(tmp_path)
    names = ["MLP width=16", "MLP width=8", "GAI-GS width=16", "GAI-GS width=8", "mean", "knn"]
    assert [row["system"] for row in read(tmp_path)] == names


def test_figures_show_the_first_seed_of_each_system(sweep, monkeypatch):
    for model, last in (("nerf2", 0.8), ("gaigs", 0.9)):
        write_log(sweep / f"model={model},seed=0", (9, 15.0, 0.3), (24, 30.5, last))
    asked = {}
    kind = registry("task").get("spectrum")
    compared = kind.compared.__func__

    def spy(cls, files, split):
        asked["files"], asked["split"] = files, split
        return compared(cls, files, split)

    monkeypatch.setattr(kind, "compared", classmethod(spy))
    monkeypatch.setattr(systems, "learning_curves", lambda *given: asked.update(curves=given) or Figure())
    report(sweep)
    assert {name: file.parent.name for name, file in asked["files"].items()} == {
        "NeRF²": "model=nerf2,seed=0",
        "GAI-GS": "model=gaigs,seed=0",
        "yagi": "model=yagi,seed=0",
    }
    assert asked["split"] == "official"
    curves, label, baselines, higher_is_better = asked["curves"]
    assert curves == {"NeRF²": ((15.0, 30.5), (0.3, 0.8)), "GAI-GS": ((15.0, 30.5), (0.3, 0.9))}
    assert label == "mean SSIM, validation"
    assert baselines == {"mean": 0.49, "knn": 0.49}
    assert higher_is_better
    assert {path.name for path in sweep.glob("systems_*")} == {
        "systems_cdf.png",
        "systems_spectra.png",
        "systems_curves.png",
    }


def test_a_baseline_that_is_a_system_of_its_own_comes_once(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    write_run(tmp_path, "knn", 0.8)
    report(tmp_path)
    assert [row["system"] for row in read(tmp_path)] == ["GAI-GS", "knn", "mean"]


def test_a_baseline_with_other_options_than_the_system_of_its_name_is_told_apart(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    own = write_run(tmp_path, "knn", 0.8)
    metrics = json.loads((own / "metrics.json").read_text())
    metrics["models"]["knn"] = scores(0.7)
    (own / "metrics.json").write_text(json.dumps(metrics))
    content = dict(np.load(own / "predictions.npz")) | {"ssim_knn": 0.7 + 0.01 * np.arange(5)}
    np.savez(own / "predictions.npz", **content)
    report(tmp_path)
    medians = {row["system"]: float(row["median SSIM"]) for row in read(tmp_path)}
    assert medians == {"GAI-GS": 0.9, "knn": 0.7, "knn (baseline)": 0.9, "mean": 0.6}
    files = {run.overrides["model"]: run.folder / "predictions.npz" for run in read_runs(tmp_path)}
    found = stored_scores(files, "ssim")
    assert {name: values[0] for name, values in found.items()} == {
        "gaigs": 0.9,
        "knn": 0.7,
        "mean": 0.6,
        "knn (baseline)": 0.9,
    }


def test_systems_with_other_test_links_are_not_drawn_together(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    own = write_run(tmp_path, "mlp", 0.8)
    content = dict(np.load(own / "predictions.npz"))
    np.savez(own / "predictions.npz", **content | {"labels": content["labels"] + 1})
    report(tmp_path)
    assert not [*tmp_path.glob("systems_*.png")]
    assert len(read(tmp_path)) == 4


@pytest.mark.parametrize("damage", [lambda content: content[:100], lambda content: b"", lambda content: b"no archive"])
def test_damaged_predictions_leave_the_table_as_it_is(tmp_path, damage):
    write_run(tmp_path, "gaigs", 0.9)
    file = write_run(tmp_path, "mlp", 0.8) / "predictions.npz"
    file.write_bytes(damage(file.read_bytes()))
    report(tmp_path)
    assert not [*tmp_path.glob("systems_*.png")]
    assert len(read(tmp_path)) == 4


def test_seeds_that_failed_are_told_beside_those_that_ended(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path, "gaigs", 0.9 + 0.01 * seed, seed=seed)
    write_run(tmp_path, "mlp", 0.8, seed=1)
    write_run(tmp_path, "mlp", seed=0, said=["gaigs: the disk is full"])
    report(tmp_path)
    rows = {row["system"]: row for row in read(tmp_path)}
    assert float(rows["MLP"]["median SSIM"]) == 0.8
    assert "- without a result: MLP: seed 0: the disk is full\n" in (tmp_path / "systems.md").read_text()


def test_a_seed_that_was_run_twice_counts_once(tmp_path):
    for part in ("one", "two"):
        write_run(tmp_path / part, "gaigs", 0.9)
        write_run(tmp_path / part, "mlp", 0.8)
    report(tmp_path)
    assert "sd" not in "".join(read(tmp_path)[0])


def test_what_is_published_is_of_systems_as_they_are(tmp_path):
    for model in ("gaigs", "mlp"):
        for jitter in ("0.0", "0.1"):
            own = write_run(tmp_path / jitter, model, 0.9)
            overrides = ["data=room", f"model={model}", "seed=0", f"training.jitter={jitter}"]
            (own / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    report(tmp_path)
    assert "published" not in "".join(read(tmp_path)[0])


def test_runs_of_two_splits_are_not_drawn_side_by_side(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    write_run(tmp_path, "mlp", 0.8, split="runs of 20")
    report(tmp_path)
    assert not [*tmp_path.glob("systems_*.png")]
    assert [row["system"] for row in read(tmp_path)][2:] == [
        "mean official",
        "knn official",
        "mean runs of 20",
        "knn runs of 20",
    ]


def test_runs_without_predictions_are_left_out_of_the_figures(tmp_path):
    write_run(tmp_path, "gaigs", 0.9, drawn=False)
    write_run(tmp_path, "mlp", 0.8, drawn=False)
    report(tmp_path)
    assert not [*tmp_path.glob("systems_*.png")]


# --- figures ---


def test_a_spectrum_and_what_systems_predict():
    rng = np.random.default_rng(3)
    predictions = {f"system {i}": rng.random((11, 14)) for i in range(6)}
    label = rng.random((11, 14))
    ssim = {name: 0.1 * i for i, name in enumerate(predictions)}
    figure = side_by_side(label, predictions, ssim, *(np.rad2deg(angles) for angles in GRID))
    *panels, bar = figure.axes
    assert [ax.get_title() for ax in panels] == ["label", *(f"{name} {score:.3f}" for name, score in ssim.items())]
    for ax, values in zip(panels, (label, *predictions.values()), strict=True):
        np.testing.assert_allclose(ax.collections[0].get_array(), values, rtol=1e-6)
        assert ax.collections[0].get_clim() == (0, 1)
    figure.draw_without_rendering()
    assert bar.get_xlabel() == "normalised amplitude"
    assert [ax.get_xlabel() != "" for ax in panels] == [False] * 3 + [True] * 4


@pytest.mark.parametrize(("higher_is_better", "scale"), [(True, "linear"), (False, "log")])
def test_learning_curves(higher_is_better, scale):
    curves = {"GAI-GS": ((1, 2, 3), (0.1, 0.5, 0.6)), "NeRF²": ((2, 4), (0.2, 0.3))}
    figure = learning_curves(curves, "mean SSIM, validation", {"mean": 0.4}, higher_is_better)
    (ax,) = figure.axes
    for line, (name, points) in zip(ax.lines, curves.items(), strict=False):
        assert line.get_label() == name
        np.testing.assert_array_equal(line.get_data(), points)
    assert ax.lines[2].get_ydata() == [0.4, 0.4]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("training [s]", "mean SSIM, validation")
    assert len(figure.legends[0].get_texts()) == 3
    assert ax.get_yscale() == scale


def test_errors_of_zero_have_no_logarithm():
    figure = learning_curves({"GAI-GS": ((1, 2), (0.1, 0.0))}, "error", {}, higher_is_better=False)
    assert figure.axes[0].get_yscale() == "linear"


@pytest.mark.parametrize(
    ("task", "kind", "label"), [("rssi", "error", "|error| [dB], split a"), ("csi", "snr_db", "SNR [dB], split a")]
)
def test_other_tasks_draw_how_their_scores_are_distributed(tmp_path, task, kind, label):
    values = {"gaigs": [-1.0, 2.0, 3.0], "mlp": [4.0, -5.0, 6.0]}
    for name, own in values.items():
        content = {f"{kind}_{name}": own, f"{kind}_{name}_trend": [8.0] * 3, f"{kind}_knn": [9.0, 9.0, 9.0]}
        np.savez(tmp_path / f"{name}.npz", **{key: np.array(value) for key, value in content.items()})
    files = {"GAI-GS": tmp_path / "gaigs.npz", "MLP": tmp_path / "mlp.npz"}
    figure = registry("task").get(task).compared(files, "a")["cdf"]
    (ax,) = figure.axes
    medians = {"rssi": ["GAI-GS 2.00", "MLP 5.00", "knn 9.00"], "csi": ["GAI-GS 2.00", "MLP 4.00", "knn 9.00"]}
    assert [line.get_label() for line in ax.lines if not line.get_label().startswith("_")] == medians[task]
    assert ax.get_xlabel() == label


# --- what is published ---


def test_what_is_published_is_of_models_with_a_name_and_of_tasks_there_are():
    published = read_published()
    for part in (published.scores, published.costs):
        assert part.keys() <= {*registry("task").names()}
        for column in (column for columns in part.values() for column in columns):
            assert column["figures"].keys() <= published.names.keys()
            assert all(isinstance(figure, float) for figure in column["figures"].values())
            assert column["source"]


def test_a_package_brings_what_is_published_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "plugins/conf/published.yaml"
    file.parent.mkdir(parents=True)
    column = {"title": "median SSIM, its paper", "source": "its paper", "figures": {"yagi": 0.5}}
    file.write_text(yaml.safe_dump({"names": {"yagi": "Yagi"}, "scores": {"spectrum": [column]}}))
    published = read_published()
    assert published.names["yagi"] == "Yagi"
    assert published.scores["spectrum"][-1] == column
    assert len(published.scores["spectrum"]) == 2
    for broken in ("names: 3", "scores: {spectrum: [{title: a}]}", "a: [", "3"):
        file.write_text(broken)
        with pytest.raises(ValueError, match=r"published\.yaml must have the form of conf/published\.yaml: "):
            read_published()


def test_a_failure_is_told_where_there_is_no_table_of_systems(tmp_path):
    write_run(tmp_path, "gaigs", 0.9)
    write_run(tmp_path, "mlp", said=["gaigs: the disk is full"])
    report(tmp_path)
    assert not (tmp_path / "systems.md").exists()
    assert "- without a result: model=mlp,seed=0: the disk is full\n" in (tmp_path / "ablation.md").read_text()
