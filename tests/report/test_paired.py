"""Paired tests over places, and tables for papers."""

import math
import re

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.task.rssi import Rssi
from gaigs.report.paired import paired
from gaigs.report.table import best_in_bold, latex, tex


def errors(seed, places=40, links=4, shift=0.0):
    """Absolute errors of links whose places share most of their error."""
    rng = np.random.default_rng(seed)
    of_place = rng.normal(0, 3, (places, 1))
    return {
        "mae_db": torch.from_numpy(
            abs(of_place + rng.normal(0, 0.3, (places, links))) + shift
        ).ravel()
    }


PLACES = torch.arange(40).repeat_interleave(4)


def test_a_difference_at_every_place_is_no_chance():
    scores = {"own": errors(0), "worse": errors(0, shift=1.0), "mean": errors(0, shift=2.0)}
    test = paired(Rssi(), scores, PLACES, resamples=200)
    assert (test.baseline, test.places) == ("worse", 40)
    assert test.p["own"]["mae_db"] == pytest.approx(2 / 201)
    assert "worse" not in test.p


def test_of_many_links_a_part_of_the_places_is_drawn_from():
    """The best baseline is that of all links."""
    other = errors(0, shift=1.0)
    scores = {"own": errors(0), "worse": other, "mean": {"mae_db": other["mae_db"] + 0.01}}
    test = paired(Rssi(), scores, PLACES, resamples=200, most=40)
    assert (test.baseline, test.places) == ("worse", 10)
    assert test.p["own"]["mae_db"] == pytest.approx(2 / 201)


def test_places_not_links_are_drawn():
    """A difference of a few places is chance, though many links of these have it."""
    other = errors(0)["mae_db"].clone()
    other[:8] += 4.0  # two places of 40
    scores = {"own": errors(0), "mean": {"mae_db": other}}
    by_place = paired(Rssi(), scores, PLACES, resamples=400).p["own"]["mae_db"]
    by_link = paired(Rssi(), scores, torch.arange(160), resamples=400).p["own"]["mae_db"]
    assert by_place > 0.1 > by_link


def test_p_is_uniform_without_a_difference():
    found = [
        paired(Rssi(), {"own": errors(k), "mean": errors(100 + k)}, PLACES, 100).p["own"]["mae_db"]
        for k in range(40)
    ]
    assert 0.3 < np.mean(found) < 0.7
    assert np.mean(np.array(found) < 0.1) < 0.3


def test_there_is_no_test_without_baselines_or_places():
    assert paired(Rssi(), {"own": errors(0), "own_trend": errors(1)}, PLACES) is None
    assert paired(Rssi(), {"own": errors(0), "mean": errors(1)}, 0 * PLACES) is None


def test_an_unknown_score_differs_from_none_and_is_not_the_best():
    unknown = {"mae_db": torch.full((160,), torch.nan)}
    test = paired(Rssi(), {"own": errors(0), "lost": unknown, "mean": errors(1)}, PLACES, 50)
    assert test.p.get("lost", {}) == {}
    assert best_in_bold([math.nan, 2.0, None], False, "<{}>") == ["nan", "<2.000>", ""]


def cells(text):
    """Rows of a tabular as LaTeX divides them; checks braces, columns and the end of each row."""
    plain = re.sub(r"\\[&%$#_{}]", "", text)
    assert plain.count("{") == plain.count("}")
    assert plain.count("$") % 2 == 0
    assert re.findall(r"\\begin\{(\w+)\}", text) == re.findall(r"\\end\{(\w+)\}", text)[::-1]
    columns, body = re.search(
        r"\\begin\{tabular\}\{([lr]+)\}\n(.*)\\end\{tabular\}", text, re.S
    ).groups()
    rows = []
    for line in body.splitlines():
        if line != r"\hline":
            assert line.endswith(r" \\")
            row = re.split(r"(?<!\\)&", line.removesuffix(r" \\"))
            assert len(row) == len(columns)
            rows.append([cell.strip() for cell in row])
    return rows


def test_signs_of_latex_are_text():
    name = r"[a_b] 5 % & #1 {x} ~^\ NeRF² ± −"
    rows = cells(latex([["model", "MAE"], [tex(name), "1"]], 1, "caption"))
    assert rows[1][0] == (
        r"{}[a\_b] 5 \% \& \#1 \{x\} \textasciitilde{}\textasciicircum{}\textbackslash{} NeRF$^2$ "
        r"$\pm$ $-$"
    )
    assert rows[1][0].isascii()


@pytest.fixture(scope="module")
def evaluation():
    links = gaigs.links("synthetic_rssi", transmitters=60)
    return gaigs.evaluate(gaigs.train("knn", links), links, baselines=["mean", "path_loss"])


def test_scores_go_into_a_paper(evaluation):
    head, *rows = cells(evaluation.to_latex())
    assert head == ["model", "MAE [dB]", "median AE [dB]", "RMSE [dB]"]
    assert [row[0] for row in rows] == ["knn", "mean", r"path\_loss"]
    scores = evaluation.models
    for column, name in enumerate(("mae_db", "median_ae_db", "rmse_db"), 1):
        best = min(scores, key=lambda model: scores[model][name])
        bold = [row[0].replace("\\", "") for row in rows if r"\textbf{" in row[column]]
        assert bold == [best]
        for row, model in zip(rows, scores, strict=True):
            p = evaluation.paired.p.get(model, {}).get(name, 1.0)
            assert row[column].endswith("$^*$") == (p < 0.05)
    assert r"path\_loss, the best baseline" in evaluation.to_latex()


def test_ties_are_bold_too(evaluation):
    twin = evaluation.scores | {"twin": evaluation.scores["knn"]}
    tied = gaigs.runs.evaluation.Evaluation(evaluation.task, "random", twin, "cpu")
    _, *rows = cells(tied.to_latex())
    assert rows[0][1] == rows[-1][1]
    assert r"\textbf" in rows[0][1]
    assert "$^*$" not in tied.to_latex()


def test_scores_as_a_frame(evaluation):
    pytest.importorskip("pandas")
    frame = evaluation.to_dataframe()
    assert [*frame.index] == ["knn", "mean", "path_loss"]
    assert frame.loc["knn", "MAE [dB]"] == evaluation.models["knn"]["mae_db"]
    assert frame.loc["mean", "MAE [dB], p"] == evaluation.paired.p["mean"]["mae_db"]
    assert np.isnan(frame.loc["path_loss", "MAE [dB], p"])
    assert frame.attrs["best_baseline"] == "path_loss"
