"""Runs of several models, as the table and the figures of systems show them."""

import csv

import numpy as np
import pytest
import yaml
from folders import read, write_run
from matplotlib.figure import Figure

from gaigs.core.task import Metric
from gaigs.core.task.spectrum import Spectrum
from gaigs.registry import registry
from gaigs.report import systems
from gaigs.report.curves import learning_curves
from gaigs.report.multirun import report
from gaigs.report.predictions import scores_of_systems
from gaigs.report.published import read_published
from gaigs.report.run_figures import figures_of
from gaigs.report.run_folders import read_runs
from gaigs.report.spectrum import SpectrumFigures, side_by_side

SCORES = ("ssim_median", "ssim_mean", "ssim_p10", "ssim_p90", "mae")
GRID = np.deg2rad(np.arange(1, 12)), np.deg2rad(np.arange(14))


def scores(median):
    return dict(
        zip(SCORES, (median, median - 0.01, median - 0.1, median + 0.01, 1 - median), strict=True)
    )


def write_system(
    folder,
    model,
    median=None,
    seed=0,
    log="",
    drawn=True,
    overrides=(),
    shift=0.0,
    knn=0.9,
    **facts,
):
    """A run of a spectrum's system with its predictions, or one that has logged something and has
    no result.
    """
    own = folder / ",".join([f"model={model}", *overrides, f"seed={seed}"])
    typed = ["data=room", f"model={model}", *overrides, f"seed={seed}"]
    if median is None:
        return write_run(own, typed, log=log)
    models = {model: scores(median), "mean": scores(0.6)} | (
        {"knn": scores(knn)} if model != "knn" else {}
    )
    facts = {"seed": seed, "validation": {name: scores(0.5) for name in models}} | facts
    write_run(own, typed, models, **facts)
    if drawn:
        rng = np.random.default_rng(seed)
        spectra = rng.random((5, 11, 14)) + shift
        content = {"labels": spectra, "prediction": spectra + 0.1 * rng.random(spectra.shape)}
        content |= {
            f"ssim_{name}": value["ssim_median"] + 0.01 * np.arange(5)
            for name, value in models.items()
        }
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


def rows_of(folder):
    return {row["system"]: row for row in read(folder / "systems.csv")}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Two systems with two seeds, one of a stranger, one that failed and one at work; figures
    noted, not written.
    """
    folder, noted = tmp_path_factory.mktemp("sweep"), {}
    write_system(folder, "yagi", 0.99)
    write_system(folder, "gaigs", 0.94, num_gaussians=300, render_ms=3.5)
    write_system(folder, "gaigs", 0.96, seed=1, num_gaussians=300, render_ms=4.5)
    write_system(folder, "nerf2", 0.81, kriging={"seconds": 20.0})
    write_system(folder, "nerf2", 0.83, seed=1)
    write_system(folder, "fire", log="data: room\ngaigs: model 'fire' gives levels; take another\n")
    write_system(folder, "mlp", log="gaigs: it failed at first\ngoing on after step 3\n")
    for model, last in (("nerf2", 0.8), ("gaigs", 0.9)):
        write_log(folder / f"model={model},seed=0", (9, 15.0, 0.3), (24, 30.5, last))
    drawn = SpectrumFigures.of_systems

    def spy(self, task, files, split):
        noted["files"], noted["split"] = files, split
        return drawn(self, task, files, split)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SpectrumFigures, "of_systems", spy)
        patch.setattr(
            systems, "learning_curves", lambda *given: noted.update(curves=given) or Figure()
        )
        patch.setattr(Figure, "savefig", lambda self, file, **_: file.touch())
        *_, noted["table"] = report(folder).renderables
    return folder, noted


def test_published_figures_and_costs_stand_beside_ours(sweep):
    rows = rows_of(sweep[0])
    assert [*rows] == ["NeRF²", "GAI-GS", "yagi", "mean", "knn"]

    def column(title):
        return [row[title] for row in rows.values()]

    assert column("published median SSIM, RFID") == ["0.78", "0.91", "", "", ""]
    assert column("published training [min], A100") == ["", "203.0", "", "", ""]
    assert column("model") == ["nerf2", "gaigs", "yagi", "mean", "knn"]
    assert [float(median) for median in column("median SSIM")] == pytest.approx(
        [0.82, 0.95, 0.99, 0.6, 0.9]
    )
    assert float(rows["NeRF²"]["median SSIM, sd"]) == pytest.approx(np.std([0.81, 0.83], ddof=1))
    assert rows["yagi"]["median SSIM, sd"] == ""
    assert column("training [s]") == ["190.0", "180.0", "180.0", "", ""], "with its kriging"
    assert column("rendering [ms]") == ["", "4.0", "", "", ""]
    assert column("Gaussians") == ["", "300", "", "", ""]
    assert column("checkpoint [MB]") == ["2.5", "2.5", "2.5", "", ""]


def test_the_page_of_systems(sweep):
    folder, _ = sweep
    scored, cost, notes = (folder / "systems.md").read_text().split("\n\n")
    assert scored.splitlines()[0].startswith(
        "| system | published median SSIM, RFID | median SSIM | mean SSIM |"
    )
    assert scored.splitlines()[2].startswith("| NeRF² | 0.780 | 0.820 ± 0.014 |")
    assert scored.splitlines()[4].startswith("| yagi |  | **0.990** |")
    assert scored.count("**") == 2 * len(SCORES)
    assert cost.splitlines()[0].startswith("| system | published training [min], A100 |")
    assert {line.count("|") for line in cost.splitlines()} == {cost.splitlines()[0].count("|")}
    assert notes.splitlines() == [
        "data=room, split=official, device=cpu",
        "- published median SSIM, RFID: GAI-GS, table 1, on the 6,123 spectra of NeRF²; WRF-GS+ "
        "after its repository, "
        "issue 4",
        "- published training [min], A100: GAI-GS, table 2, on a part of the same spectra and one "
        "NVIDIA A100",
        "- published inference [ms], A100: likewise",
        "- published rendering [ms], A100: likewise",
        "- without a result: MLP: unfinished",
        "- without a result: FIRE: model 'fire' gives levels; take another",
    ]


def test_the_terminal_has_the_brief_columns_and_what_failed(sweep):
    folder, noted = sweep
    table = noted["table"]
    assert table.title == "Systems"
    assert (
        table.caption
        == "MLP: unfinished\nFIRE: model 'fire' gives levels; take another\nall columns in systems.md"
    )
    heads = [column.header.replace("\\", "") for column in table.columns]
    assert heads[:4] == ["system", "published\nmedian\nSSIM,\nRFID", "median\nSSIM", "MAE"]
    assert heads[4:] == ["training\n[s]", "inference\n[ms]", "parameters"]
    assert table.row_count == 5
    failures = {run.overrides["model"]: run.failure for run in read_runs(folder)}
    assert failures["fire"] == "model 'fire' gives levels; take another"
    assert failures["mlp"] is failures["gaigs"] is None, "one is at work again"


def test_figures_show_the_first_seed_of_each_system(sweep):
    folder, noted = sweep
    assert {name: file.parent.name for name, file in noted["files"].items()} == {
        "NeRF²": "model=nerf2,seed=0",
        "GAI-GS": "model=gaigs,seed=0",
        "yagi": "model=yagi,seed=0",
    }
    assert noted["split"] == "official"
    curves, baselines, metric = noted["curves"]
    assert curves == {"NeRF²": ((15.0, 30.5), (0.3, 0.8)), "GAI-GS": ((15.0, 30.5), (0.3, 0.9))}
    assert metric == Spectrum.metrics()["ssim_mean"]
    assert baselines == {"mean": 0.49, "knn": 0.49}
    names = {"systems_cdf.png", "systems_spectra.png", "systems_curves.png"}
    assert {path.name for path in folder.glob("systems_*")} == names


def test_runs_of_one_model_are_no_table_of_systems(tmp_path):
    write_system(tmp_path, "gaigs", 0.9)
    write_system(tmp_path, "gaigs", 0.8, seed=1)
    write_system(tmp_path, "fire")
    report(tmp_path)
    assert not [*tmp_path.glob("systems*")]


def test_all_systems_that_print_as_the_best_are_bold(tmp_path):
    for model, score in (("gaigs", 0.97712), ("mlp", 0.97708), ("fire", 0.9764)):
        write_system(tmp_path, model, score)
    report(tmp_path)
    lines = (tmp_path / "systems.md").read_text().splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in lines if "**0.977**" in line] == [
        "MLP",
        "GAI-GS",
    ]


def test_other_settings_have_rows_of_their_own_without_published_figures(tmp_path):
    for model in ("gaigs", "mlp"):
        for width in (8, 16):
            write_system(tmp_path, model, 0.9, overrides=[f"width={width}"])
    report(tmp_path)
    rows = rows_of(tmp_path)
    assert [*rows] == [
        "MLP width=16",
        "MLP width=8",
        "GAI-GS width=16",
        "GAI-GS width=8",
        "mean",
        "knn",
    ]
    assert "published" not in "".join(rows["mean"])


def test_a_baseline_that_is_a_system_too_comes_once_unless_it_scores_otherwise(tmp_path):
    write_system(tmp_path / "same", "gaigs", 0.9, knn=0.8)
    write_system(tmp_path / "same", "knn", 0.8, checkpoint_bytes=None)
    report(tmp_path / "same")
    assert [*rows_of(tmp_path / "same")] == ["GAI-GS", "knn", "mean"]
    write_system(tmp_path / "other", "gaigs", 0.9)
    write_system(tmp_path / "other", "knn", 0.7)
    report(tmp_path / "other")
    medians = {name: float(row["median SSIM"]) for name, row in rows_of(tmp_path / "other").items()}
    assert medians == {"GAI-GS": 0.9, "knn": 0.7, "knn (baseline)": 0.9, "mean": 0.6}
    files = {
        run.overrides["model"]: run.folder / "predictions.npz"
        for run in read_runs(tmp_path / "other")
    }
    firsts = {name: values[0] for name, values in scores_of_systems(files, "ssim").items()}
    assert firsts == {"gaigs": 0.9, "knn": 0.7, "mean": 0.6, "knn (baseline)": 0.9}


@pytest.mark.parametrize("facts", [{"shift": 1.0}, {"split": "runs of 20"}])
def test_figures_of_different_test_links_are_not_drawn(tmp_path, facts):
    write_system(tmp_path, "gaigs", 0.9)
    write_system(tmp_path, "mlp", 0.8, **facts)
    report(tmp_path)
    assert not [*tmp_path.glob("systems_*.png")]
    baselines = ["mean", "knn"]
    if "split" in facts:
        baselines = [
            f"{name} {split}" for split in ("official", "runs of 20") for name in baselines
        ]
    assert [*rows_of(tmp_path)][2:] == baselines


def test_a_seed_that_failed_is_noted_and_one_that_was_run_twice_counts_once(tmp_path):
    for part in ("one", "two"):
        write_system(tmp_path / part, "gaigs", 0.9)
        write_system(tmp_path / part, "fire", 0.7)
    write_system(tmp_path, "mlp", 0.8, seed=1)
    write_system(tmp_path, "mlp", log="gaigs: the disk is full")
    report(tmp_path)
    rows = rows_of(tmp_path)
    assert float(rows["MLP"]["median SSIM"]) == 0.8
    assert not any(title.endswith(", sd") for title in rows["MLP"])
    assert (
        "- without a result: MLP: seed 0: the disk is full\n"
        in (tmp_path / "systems.md").read_text()
    )


# --- figures ---


def test_spectra_side_by_side():
    rng = np.random.default_rng(3)
    spectra = {f"system {i}": rng.random((11, 14)) for i in range(7)}
    figure = side_by_side(spectra, *(np.rad2deg(angles) for angles in GRID))
    *panels, bar = figure.axes
    assert [ax.get_title() for ax in panels] == [*spectra]
    for ax, values in zip(panels, spectra.values(), strict=True):
        np.testing.assert_allclose(ax.collections[0].get_array(), values, rtol=1e-6)
        assert ax.collections[0].get_clim() == (0, 1)
    assert bar.get_xlabel() == "normalised amplitude"
    assert [ax.get_xlabel() != "" for ax in panels] == [False] * 3 + [True] * 4


@pytest.mark.parametrize(("higher_is_better", "scale"), [(True, "linear"), (False, "log")])
def test_learning_curves(higher_is_better, scale):
    curves = {"GAI-GS": ((1, 2, 3), (0.1, 0.5, 0.6)), "NeRF²": ((2, 4), (0.2, 0.3))}
    metric = Metric("mean SSIM", higher_is_better)
    figure = learning_curves(curves, {"mean": 0.4}, metric)
    (ax,) = figure.axes
    order = ["GAI-GS", "NeRF²"] if higher_is_better else ["NeRF²", "GAI-GS"]
    for line, name in zip(ax.lines, order, strict=False):
        assert line.get_label() == name
        np.testing.assert_array_equal(line.get_data(), curves[name])
    assert ax.lines[2].get_ydata() == [0.4, 0.4]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("training [s]", "mean SSIM, validation")
    assert len(figure.legends[0].get_texts()) == 3
    assert ax.get_yscale() == scale
    curves["NeRF²"] = (1,), (0.0,)  # which has no logarithm
    assert learning_curves(curves, {}, metric).axes[0].get_yscale() == "linear"


@pytest.mark.parametrize(
    ("task", "kind", "label", "medians"),
    [
        ("rssi", "error", "|error| [dB]", ["GAI-GS 2.00", "MLP 5.00", "knn 9.00"]),
        ("csi", "snr_db", "SNR [dB]", ["knn 9.00", "MLP 4.00", "GAI-GS 2.00"]),
    ],
)
def test_other_tasks_draw_the_distribution_of_their_scores(tmp_path, task, kind, label, medians):
    for name, own in (("gaigs", [-1.0, 2.0, 3.0]), ("mlp", [4.0, -5.0, 6.0])):
        content = {
            f"{kind}_{name}": own,
            f"{kind}_{name}_trend": [8.0] * 3,
            f"{kind}_knn": [9.0, 9.0, 9.0],
        }
        np.savez(
            tmp_path / f"{name}.npz", **{key: np.array(value) for key, value in content.items()}
        )
    files = {"GAI-GS": tmp_path / "gaigs.npz", "MLP": tmp_path / "mlp.npz"}
    kind = registry("task").get(task)
    (ax,) = figures_of(kind).of_systems(kind, files, "a")["cdf"].axes
    assert [
        line.get_label() for line in ax.lines if not line.get_label().startswith("_")
    ] == medians
    assert ax.get_xlabel() == label


# --- published figures ---


def test_published_figures_are_of_named_models_and_known_tasks():
    published = read_published()
    for part in (published["scores"], published["costs"]):
        assert part.keys() <= {*registry("task").names()}
        for column in (column for columns in part.values() for column in columns):
            assert column["figures"].keys() <= published["names"].keys()
            assert all(isinstance(figure, float) for figure in column["figures"].values())
            assert column["source"]


def test_a_package_brings_published_figures_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "plugins/conf/published.yaml"
    file.parent.mkdir(parents=True)
    column = {"title": "median SSIM, its paper", "source": "its paper", "figures": {"yagi": 0.5}}
    file.write_text(yaml.safe_dump({"names": {"yagi": "Yagi"}, "scores": {"spectrum": [column]}}))
    published = read_published()
    assert published["names"]["yagi"] == "Yagi"
    assert published["scores"]["spectrum"][-1] == column
    assert len(published["scores"]["spectrum"]) == 2
    for broken in ("names: 3", "scores: {spectrum: [{title: a}]}", "a: [", "3"):
        file.write_text(broken)
        with pytest.raises(
            ValueError, match=r"published\.yaml must have the form of conf/published\.yaml: "
        ):
            read_published()
