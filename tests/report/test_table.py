"""The table of a run and its sentence."""

from io import StringIO

import pytest
from rich.console import Console

from gaigs.report.table import metrics_table, verdict, written


def run(**models):
    return {"split": "runs of 20 [hard]", "seed": 7, "device": "cpu, 2 cores", "models": models}


def printed(table, styles=False):
    console = Console(width=120, record=True, force_terminal=True, color_system="standard", file=StringIO())
    console.print(table)
    return console.export_text(styles=styles)


SPECTRA = run(
    gaigs={"ssim_median": 0.912, "mae": 0.05},
    mean={"ssim_median": 0.667, "mae": 0.2},
    knn={"ssim_median": 0.962, "mae": 0.04},
)
RSSI = run(gaigs={"mae_db": 3.25, "rmse_db": 14.0}, mean={"mae_db": 6.25, "rmse_db": 14.0})


def test_best_of_each_metric_is_bold():
    bold = printed(metrics_table(SPECTRA), styles=True)
    assert "\x1b[1m0.962\x1b[0m" in bold
    assert "\x1b[1m0.040\x1b[0m" in bold
    assert bold.count("\x1b[1m0.") == 2
    errors = printed(metrics_table(RSSI), styles=True)
    assert "\x1b[1m3.250\x1b[0m" in errors
    assert errors.count("\x1b[1m14.0\x1b[0m") == 2  # a tie


def test_table_says_where_the_numbers_come_from():
    text = " ".join(printed(metrics_table(SPECTRA)).split())
    assert "split runs of 20 [hard]" in text
    assert "run with seed 7 on cpu, 2 cores" in text
    assert "median SSIM" in text
    assert "MAE [dB]" in printed(metrics_table(RSSI))


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        (SPECTRA, "gaigs is 0.245 above mean and 0.050 below knn in median SSIM on split runs of 20 [hard]."),
        (RSSI, "gaigs is 3.000 below mean in MAE [dB] (lower is better) on split runs of 20 [hard]."),
        (
            run(gaigs={"ssim_median": 0.9}, knn={"ssim_median": 0.9004}, mean={"ssim_median": 0.8996}),
            "gaigs is level with knn and level with mean in median SSIM on split runs of 20 [hard].",
        ),
        (run(knn={"fit": 0.9}), "knn is at 0.900 in fit (lower is better) on split runs of 20 [hard]."),
    ],
)
def test_verdict(metrics, sentence):
    assert verdict(metrics) == sentence


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.96251, "0.963"), (1234.56, "1,234.6"), (-3.0, "-3.000"), (20000, "20,000"), (0, "0"), ("ga", "ga"), (None, "")],
)
def test_written(value, text):
    assert written(value) == text
