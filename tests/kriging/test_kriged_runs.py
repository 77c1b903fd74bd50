"""Runs with ``kriging=true``, from end to end on a tiny budget."""

import json
import os
import signal

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import gaigs
from gaigs import checkpoint, evaluation, runs
from gaigs.configuration import conf_dir
from gaigs.data import load
from gaigs.training import kriging
from gaigs.training.descent import Descent

SMALL = (
    "data.transmitters=40",
    "data.order=1",
    "split.validation=0.35",
    "tokenizer=euclidean",
    "rasterizer=torch",
    "gaussians.count=20",
    "training.batch_size=8",
    "trainer.accelerator=cpu",
    "trainer.max_steps=4",
    "trainer.val_check_interval=2",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}]",
)
FOLDS = ("kriging=true", "kriging_folds=2")


def configure(*overrides):
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return OmegaConf.to_container(compose("config", [*SMALL, *overrides]), resolve=True)


@pytest.fixture(scope="module", autouse=True)
def no_figures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "write_figures", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return runs.run(configure(), tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    config, folder = configure("kriging=true"), tmp_path_factory.mktemp("kriged")
    return config, folder, runs.run(config, folder)


@pytest.fixture(scope="module")
def with_folds(tmp_path_factory):
    config, folder = configure(*FOLDS), tmp_path_factory.mktemp("folds")
    return config, folder, runs.run(config, folder)


def results(metrics):
    """What does not depend on how fast the machine is."""
    facts = {key: value for key, value in metrics["kriging"].items() if key != "seconds"}
    return metrics["models"], metrics["validation"], facts


def test_the_trend_has_a_row_of_its_own(finished, plain):
    _, folder, metrics = finished
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    for part in ("models", "validation"):
        assert list(metrics[part]) == ["gaigs", "gaigs_trend", "mean"]
        assert metrics[part]["gaigs_trend"] == plain[part]["gaigs"]
        assert metrics[part]["mean"] == plain[part]["mean"]
        assert metrics[part]["gaigs"]["ssim_mean"] > metrics[part]["gaigs_trend"]["ssim_mean"]
    assert metrics["validation_score"] == metrics["validation"]["gaigs"]["ssim_mean"]
    assert "kriging" not in plain


def test_what_the_kriging_was_is_told(finished):
    config, folder, metrics = finished
    facts, split = metrics["kriging"], load(config["data"], config["split"]).split
    assert list(facts) == ["weight", "share", "length_m", "noise_to_signal", "links", "components", "seconds"]
    assert facts["links"] == len(split.train) + len(split.validation)
    assert facts["seconds"] > 0
    assert metrics["checkpoint_bytes"] == (folder / "best.ckpt").stat().st_size


def test_the_checkpoint_holds_the_kriged_model(finished):
    config, folder, _ = finished
    content = checkpoint.read(folder / "best.ckpt")
    described = content[checkpoint.KEY]["model"]
    assert described == {"name": "kriging", "trend": config["model"], "fallback": None}
    assert checkpoint.read(folder / "last.ckpt")[checkpoint.KEY]["model"] == config["model"]
    with np.load(folder / "predictions.npz") as file:
        found = gaigs.load(folder / "best.ckpt").predict(torch.from_numpy(file["transmitters"]))
        np.testing.assert_allclose(found, file["prediction"], rtol=1e-3, atol=1e-3)  # stored in half precision
        assert {"ssim_gaigs", "ssim_gaigs_trend"} <= {*file.files}


def test_validation_scores_are_of_residuals_of_training_links(finished):
    """To the kriged model itself they would be links that it knows."""
    config, folder, metrics = finished
    links = load(config["data"], config["split"])
    index = links.split.validation
    values = gaigs.load(folder / "best.ckpt").predict(links.query[index])
    own = links.task.scores(links.labels[index], values)["ssim"].mean().item()
    assert metrics["validation"]["gaigs"]["ssim_mean"] < own - 0.01


def test_a_run_killed_behind_its_kriging_goes_on(finished, tmp_path, monkeypatch):
    config, folder, metrics = finished
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "score", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            runs.run(config, tmp_path)
    assert checkpoint.read(tmp_path / "best.ckpt")[checkpoint.KEY]["model"]["name"] == "kriging"
    monkeypatch.setattr(Descent, "training_step", lambda *_: 1 / 0)
    assert results(runs.run(config, tmp_path)) == results(metrics)
    a, b = (checkpoint.read(path / "best.ckpt")["state_dict"] for path in (folder, tmp_path))
    assert a.keys() == b.keys()
    for key in a:
        torch.testing.assert_close(a[key], b[key], rtol=0, atol=0, equal_nan=True)


def test_each_fold_is_trained_without_its_links(with_folds):
    config, folder, _ = with_folds
    split = load(config["data"], config["split"]).split
    held_out = []
    for number in range(2):
        own = checkpoint.read(folder / f"fold_{number}" / "last.ckpt")
        parts = own[checkpoint.KEY]["split"]
        assert own["global_step"] == 4
        assert sorted([*parts["train"].tolist(), *parts["test"].tolist()]) == split.train.tolist()
        assert torch.equal(parts["validation"], split.validation)
        held_out += parts["test"].tolist()
    assert sorted(held_out) == split.train.tolist()
    assert checkpoint.read(folder / "best.ckpt")[checkpoint.KEY]["model"]["name"] == "kriging"


def test_the_trend_is_trained_on_all_links_beside_the_folds(with_folds, plain):
    assert with_folds[2]["models"]["gaigs_trend"] == plain["models"]["gaigs"]


def test_residuals_are_those_of_the_folds(with_folds, tmp_path, monkeypatch):
    config, folder, _ = with_folds
    seen = []
    choose = kriging.Kriging.choose
    monkeypatch.setattr(kriging.Kriging, "choose", lambda *given: seen.append(given) or choose(*given))
    (folder / "metrics.json").unlink()
    runs.run(config, folder)
    ((_, links, values),) = seen
    position = {link: row for row, link in enumerate(kriging.known(links).tolist())}
    whole = gaigs.load(folder / "best.ckpt").trend
    sources = [(gaigs.load(folder / f"fold_{number}" / "best.ckpt"), number) for number in range(2)]
    for model, number in sources:
        held = checkpoint.read(folder / f"fold_{number}" / "best.ckpt")[checkpoint.KEY]["split"]["test"]
        rows = [position[link] for link in held.tolist()]
        torch.testing.assert_close(values[rows], model.predict(links.query[held]))
        assert (values[rows] - whole.predict(links.query[held])).abs().max() > 1e-4
    validation = links.split.validation
    rows = [position[link] for link in validation.tolist()]
    torch.testing.assert_close(values[rows], whole.predict(links.query[validation]))


def test_a_run_stopped_within_a_fold_goes_on_there(with_folds, tmp_path, monkeypatch):
    config, _, metrics = with_folds
    training_step, steps = Descent.training_step, []

    def interrupted(self, batch, index):
        steps.append(index)
        if len(steps) == 4 + 4 + 2:
            os.kill(os.getpid(), signal.SIGINT)
        return training_step(self, batch, index)

    with monkeypatch.context() as patch:
        patch.setattr(Descent, "training_step", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"stopped after step 2$"):
            runs.run(config, tmp_path)
    assert checkpoint.read(tmp_path / "fold_1" / "last.ckpt")["global_step"] == 2
    assert not (tmp_path / "metrics.json").exists()
    assert results(runs.run(config, tmp_path)) == results(metrics)


@pytest.mark.parametrize(("bound", "told"), [(1e9, True), (0.0, False)])
def test_places_learnt_by_heart_are_told_of(bound, told, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(kriging, "BY_HEART", bound)
    with caplog.at_level("INFO", "gaigs"):
        runs.run(configure("kriging=true", "trainer.max_steps=1"), tmp_path)
    assert ("kriging_folds=5 would tell more" in caplog.text) == told


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model=knn", "kriging=true"], "kriging=true takes a model that is trained, and knn is not"),
        (["model=kriging"], "choose that model, and set kriging=true"),
        (
            ["model=kriging", "model.trend={name: mean}"],
            "model=kriging is made from a trained model; choose that model",
        ),
        (["kriging=true", "kriging_folds=1"], "kriging_folds must be at least 2 trainings, or 0 for none, got 1"),
        (["kriging_folds=3"], "kriging_folds=3 takes kriging=true"),
        (
            ["kriging=true", "kriging_folds=900"],
            r"kriging_folds must be at most \d+, the rows of training links, got 900",
        ),
    ],
)
def test_what_cannot_be_kriged_is_refused(overrides, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        runs.run(configure(*overrides), tmp_path)
    assert not (tmp_path / "last.ckpt").exists()


@pytest.mark.filterwarnings("ignore::gaigs.geometry.ExtrapolationWarning")
def test_rssi_falls_back_on_the_trend_of_its_process(tmp_path):
    few = ["+experiment=rssi", "data.transmitters=60", "deformation.width=8", "split.validation=0.2", "kriging=true"]
    metrics = runs.run(configure(*few), tmp_path)
    model = gaigs.load(tmp_path / "best.ckpt")
    assert model.fallback_options == {"name": "path_loss"}
    assert [*metrics["receivers"]["west"]] == ["gaigs", "gaigs_trend", "mean"]
    level = model.predict([[1e4, 0.0, 0.0]], "west")
    share, weight = metrics["kriging"]["share"], metrics["kriging"]["weight"]
    trend, fallback = (part.predict([[1e4, 0.0, 0.0]], "west") for part in (model.trend, model.fallback))
    far = share * trend + (1 - share) * fallback
    torch.testing.assert_close(level, weight * far + (1 - weight) * trend)
