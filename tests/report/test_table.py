"""The table of a run and its sentence."""

from io import StringIO

import pytest
from rich.console import Console

from gaigs.core.task.csi import Csi
from gaigs.registry import registry
from gaigs.report.scores import metrics_table, verdict
from gaigs.report.table import written


def run(task, **models):
    facts = {"split": "runs of 20 [hard]", "seed": 7, "device": "cpu, 2 cores"}
    return facts | ({} if task is None else {"task": task}) | {"models": models}


def printed(table, styles=False, width=120):
    console = Console(
        width=width, record=True, force_terminal=True, color_system="standard", file=StringIO()
    )
    console.print(table)
    return console.export_text(styles=styles)


def heads(metrics):
    """Of the columns, their words in a row."""
    lines = printed(metrics_table(metrics), width=80).splitlines()
    columns = zip(*(line.split("┃")[1:-1] for line in lines if line.startswith("┃")), strict=True)
    return [" ".join(" ".join(words).split()) for words in columns]


def spectrum(median, mae):
    return {"ssim_median": median, "ssim_mean": 0.5, "ssim_p10": 0.25, "ssim_p90": 0.75, "mae": mae}


def rssi(mae, rmse=14.0):
    return {"mae_db": mae, "median_ae_db": 1.5, "rmse_db": rmse}


def csi(median, aligned):
    return {name: float(i) for i, name in enumerate(Csi.metrics())} | {
        "snr_db_median": median, "snr_aligned_db_median": aligned
    }  # fmt: skip


SPECTRA = run(
    "spectrum", gaigs=spectrum(0.912, 0.05), mean=spectrum(0.667, 0.2), knn=spectrum(0.962, 0.04)
)
RSSI = run("rssi", gaigs=rssi(3.25), mean=rssi(6.25))
MODELS = ("gaigs", "mean", "knn", "friis", "path_loss", "gaussian_process")


def test_best_of_each_metric_is_bold():
    bold = printed(metrics_table(SPECTRA), styles=True)
    assert "\x1b[1m0.962\x1b[0m" in bold
    assert "\x1b[1m0.040\x1b[0m" in bold
    for score in ("0.912", "0.667", "0.050", "0.200"):
        assert f"\x1b[1m{score}\x1b[0m" not in bold
    errors = printed(metrics_table(RSSI), styles=True)
    assert "\x1b[1m3.250\x1b[0m" in errors
    assert "\x1b[1m6.250\x1b[0m" not in errors
    assert errors.count("\x1b[1m14.0\x1b[0m") == 2  # a tie
    nearly = printed(
        metrics_table(run("spectrum", gaigs=spectrum(0.97712, 0.04), knn=spectrum(0.97708, 0.05))),
        styles=True,
    )
    assert nearly.count("\x1b[1m0.977\x1b[0m") == 2, "equal as printed"


def test_table_says_where_the_numbers_come_from():
    text = " ".join(printed(metrics_table(SPECTRA)).split())
    assert "split runs of 20 [hard]" in text
    assert "run with seed 7 on cpu, 2 cores" in text
    assert heads(SPECTRA) == ["model", "median SSIM", "mean SSIM", "p10 SSIM", "p90 SSIM", "MAE"]
    assert heads(RSSI) == ["model", "MAE [dB]", "median AE [dB]", "RMSE [dB]"]


@pytest.mark.parametrize(
    ("task", "scores", "shown"),
    [
        (
            "spectrum",
            spectrum(0.9125, 0.1),
            ["ssim_median", "mae"],
        ),
        ("rssi", rssi(13.25), ["mae_db", "median_ae_db", "rmse_db"]),
        (
            "csi",
            csi(-11.5, 21.5),
            ["snr_db_median", "snr_db_mean", "snr_aligned_db_median", "nmse_db"],
        ),
    ],
)
def test_all_models_and_the_validation_score_fit_eighty_columns(task, scores, shown):
    first = shown[0]
    metrics = run(task, **dict.fromkeys(MODELS, scores))
    p = {model: {first: 0.004} for model in MODELS[:-1]}
    metrics["paired"] = {"baseline": "gaussian_process", "places": 9, "p": p}
    metrics["validation"] = {model: scores | {first: 77.25 + i} for i, model in enumerate(MODELS)}
    known = registry("task").get(task).metrics()
    lines = printed(metrics_table(metrics), width=80).splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    for i, model in enumerate(MODELS):
        (row,) = (
            line.replace("│", " ").split() for line in lines if line.startswith(f"│ {model} ")
        )
        numbers = [written(scores[name]) for name in shown]
        tests = ["0.004"] if model in p else []
        assert row == [model, *numbers, *tests, written(77.25 + i)]
    titles = [known[name].title for name in shown]
    p_title = "p against gaussian_ process"
    assert heads(metrics) == ["model", *titles, p_title, f"{titles[0]}, validation"]


def test_channels_of_unknown_phase_are_led_by_the_score_that_they_have():
    scores = {
        name: score for name, score in csi(1.5, 21.5).items() if not name.startswith("snr_db")
    }
    metrics = run("csi", gaigs=scores, mean=scores | {"snr_aligned_db_median": 20.25}) | {
        "validation": {"gaigs": scores}
    }
    title = "median SNR, phase removed [dB]"
    assert heads(metrics) == ["model", title, "NMSE [dB]", f"{title}, validation"]
    assert verdict(metrics).startswith("gaigs: median SNR, phase removed 21.50 dB, 1.25 dB better")


def test_receivers_stand_below_with_the_first_metric_of_each_model():
    def at(gaigs, mean):
        return {"gaigs": rssi(gaigs, 77.0), "mean": rssi(mean, 66.0)}

    metrics = RSSI | {"receivers": {"[attic]": at(2.125, 7.5), "cellar": at(4.5, 3.875)}}
    bold = printed(metrics_table(metrics), styles=True)
    assert "\x1b[1m2.125\x1b[0m" in bold
    assert "\x1b[1m3.875\x1b[0m" in bold
    lines = printed(metrics_table(metrics)).splitlines()
    title = next(i for i, line in enumerate(lines) if "MAE [dB] at each receiver" in line)
    words = [line.replace("│", " ").replace("┃", " ").split() for line in lines[title:]]
    assert ["receiver", "gaigs", "mean"] in words
    assert ["[attic]", "2.125", "7.500"] in words
    assert ["cellar", "4.500", "3.875"] in words
    assert not any("77" in line for line in lines)
    assert any("6.250" in line for line in lines[:title])  # all receivers together come first


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        (SPECTRA, "gaigs: median SSIM 0.912, 0.050 worse than knn, the best baseline, on"),
        (RSSI, "gaigs: MAE 3.25 dB, 3.00 dB better than mean, the best baseline, on"),
        (
            run("spectrum", gaigs=spectrum(0.9, 0), knn=spectrum(0.9004, 0)),
            "gaigs: median SSIM 0.900, level with knn, the best baseline, on",
        ),
        (
            RSSI | {"paired": {"baseline": "mean", "places": 9, "p": {"gaigs": {"mae_db": 0.25}}}},
            "gaigs: MAE 3.25 dB, 3.00 dB better than mean, the best baseline (p = 0.25, may be "
            "chance), on",
        ),
        (run("rssi", knn=rssi(4.158)), "knn: MAE 4.16 dB, on"),
        (
            run("csi", gaigs=csi(12.25, 13), friis=csi(-3.5, 20)),
            "gaigs: median SNR 12.25 dB, 15.75 dB better than friis, the best baseline, on",
        ),
    ],
)
def test_verdict(metrics, sentence):
    assert verdict(metrics) == f"{sentence} split runs of 20 [hard]."


def test_the_model_before_its_kriging_is_no_baseline():
    metrics = run("rssi", gaigs=rssi(3.25), gaigs_trend=rssi(1.5), mean=rssi(6.25))
    assert verdict(metrics).endswith("[hard]. Before kriging (gaigs_trend) it is 1.50 dB.")
    assert "3.00 dB better than mean" in verdict(metrics)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.96251, "0.963"),
        (1234.56, "1,234.6"),
        (-3.0, "-3.000"),
        (20000, "20,000"),
        (0, "0"),
        ("ga", "ga"),
        (None, ""),
    ],
)
def test_written(value, text):
    assert written(value) == text
