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


def test_receivers_stand_below_with_the_first_metric_of_each_model():
    at = lambda gaigs, mean: {"gaigs": {"mae_db": gaigs, "rmse_db": 77.0}, "mean": {"mae_db": mean, "rmse_db": 66.0}}
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


def test_one_receiver_has_no_table_of_its_own():
    assert "receiver" not in printed(metrics_table(RSSI | {"receivers": {}}))
    assert "receiver" not in printed(metrics_table(RSSI))


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        (SPECTRA, "gaigs is 0.245 above mean and 0.050 below knn in median SSIM on split runs of 20 [hard]."),
        (RSSI, "gaigs is 3.00 dB below mean in MAE (lower is better) on split runs of 20 [hard]."),
        (
            run(gaigs={"ssim_median": 0.9}, knn={"ssim_median": 0.9004}, mean={"ssim_median": 0.8996}),
            "gaigs is level with knn and level with mean in median SSIM on split runs of 20 [hard].",
        ),
        (
            run(gaigs={"mae_db": 3.961}, mean={"mae_db": 6.28}, knn={"mae_db": 3.76}, path_loss={"mae_db": 3.964}),
            "gaigs is 2.32 dB below mean, 0.20 dB above knn and level with path_loss in MAE (lower is better) on split "
            "runs of 20 [hard].",
        ),
        (run(knn={"mae_db": 4.158}), "knn is at 4.16 dB in MAE (lower is better) on split runs of 20 [hard]."),
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
