"""Runs with ``kriging=true``, from end to end on a tiny budget."""

import json
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import gaigs
from gaigs import runs
from gaigs.data import load
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import checkpoint
from gaigs.runs import evaluation
from gaigs.training.descent import Descent

SMALL = (
    "+experiment=rssi", "data.transmitters=50", "data.order=1", "split.validation=0.2", "tokenizer=euclidean",
    "rasterizer=torch", "gaussians.count=10", "deformation.width=8", "trainer.accelerator=cpu", "trainer.max_steps=2",
    "trainer.val_check_interval=1", "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}]", "kriging=true",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "radio_map", Mock())
        patch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8, iterations=2))
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    config, folder = gaigs.compose(*SMALL), tmp_path_factory.mktemp("kriged")
    return config, folder, runs.run(config, folder)


def test_trend_and_kriging_are_reported(finished):
    config, folder, metrics = finished
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    plain = runs.run(config | {"kriging": False}, folder / "plain")
    assert "kriging" not in plain
    for part in ("models", "validation"):
        assert list(metrics[part]) == ["gaigs", "gaigs_trend", "mean"]
        assert metrics[part]["gaigs_trend"] == plain[part]["gaigs"]
        assert metrics[part]["mean"] == plain[part]["mean"]
        assert metrics[part]["gaigs"]["mae_db"] < metrics[part]["gaigs_trend"]["mae_db"]
    assert metrics["validation_score"] == metrics["validation"]["gaigs"]["mae_db"]
    assert [*metrics["receivers"]["west"]] == ["gaigs", "gaigs_trend", "mean"]
    facts, links = metrics["kriging"], load(config["data"], config["split"])
    choices = ["length_m", "nugget", "smoothness", "degrees_of_freedom"]
    assert list(facts) == ["weight", "trend_weight", *choices, "links", "seconds"]
    assert facts["links"] == len(links.split.train) + len(links.split.validation)
    assert facts["seconds"] > 0
    # The validation scores are of the validation model: the kriged one knows these links.
    labels, model = links.labels[links.split.validation], gaigs.load(folder / "best.ckpt")
    values = model.predict(links.query[links.split.validation])
    assert links.task.scores(labels, values)["mae_db"].mean() < metrics["validation_score"] - 0.1
    evaluated = gaigs.evaluate(model, links, ["mean"]).models
    for name, scores in metrics["models"].items():
        assert evaluated[name] == pytest.approx(
            {key: scores[key] for key in evaluated[name]}, rel=1e-4
        )


def test_the_checkpoint_holds_the_kriged_model(finished):
    config, folder, metrics = finished
    kriged = {"name": "kriging", "trend": config["model"], "fallback": {"name": "path_loss"}}
    assert checkpoint.read(folder / "best.ckpt")[checkpoint.KEY]["model"] == kriged
    assert checkpoint.read(folder / "last.ckpt")[checkpoint.KEY]["model"] == config["model"]
    assert metrics["checkpoint_bytes"] == (folder / "best.ckpt").stat().st_size
    with np.load(folder / "predictions.npz") as file:
        receivers = torch.from_numpy(file["receiver"])
        found = gaigs.load(folder / "best.ckpt").predict(
            torch.from_numpy(file["transmitters"]), receivers
        )
        np.testing.assert_allclose(found, file["prediction"], rtol=1e-4)


def test_a_run_killed_after_its_kriging_continues(finished, tmp_path, monkeypatch):
    config, folder, metrics = finished
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "score", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            runs.run(config, tmp_path)
    assert checkpoint.read(tmp_path / "best.ckpt")[checkpoint.KEY]["model"]["name"] == "kriging"
    monkeypatch.setattr(Descent, "training_step", lambda *_: 1 / 0)
    again = runs.run(config, tmp_path)
    assert again["models"] == metrics["models"]
    assert again["kriging"] | {"seconds": 0} == metrics["kriging"] | {"seconds": 0}
    a, b = (checkpoint.read(path / "best.ckpt")["state_dict"] for path in (folder, tmp_path))
    assert a.keys() == b.keys()
    for key in a:
        torch.testing.assert_close(a[key], b[key], rtol=0, atol=0, equal_nan=True)


def test_kriging_is_not_trained_itself(finished, tmp_path):
    config, _, _ = finished
    model = {"name": "kriging", "trend": config["model"], "fallback": None}
    with pytest.raises(ValueError, match="choose a trained model, and set kriging=true"):
        runs.run(config | {"model": model}, tmp_path)
