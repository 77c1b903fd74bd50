"""One run: interruption and resume, the run folder, refused options and data."""

import errno
import hashlib
import json
import linecache
import os
import re
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import lightning
import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

import gaigs
from gaigs import configuration, runs
from gaigs.core.geometry import Pose
from gaigs.core.radio_maps import RadioMap
from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.io.files import atomic_write
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import checkpoint
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.channel_links import SLABS, SlabRoom
from gaigs.planes.channel_search import ChannelSearch
from gaigs.planes.lag_search import LagSearch
from gaigs.processes import Stopped, stopping
from gaigs.registry import registry
from gaigs.report.training_log import read_curves, read_log
from gaigs.runs import descent, evaluation
from gaigs.runs.folder import claim
from gaigs.testing import example_links
from gaigs.training.descent import Descent

pytestmark = pytest.mark.usefixtures("unchecked")

SMALL = (
    "data.transmitters=30",
    "tokenizer=euclidean",
    "rasterizer=torch",
    "gaussians.count=30",
    "training.batch_size=7",  # 22 links train: batches of 7, 7, 7 and 1
    "training.thinning.stride=8",
    "trainer.accelerator=cpu",
    "trainer.max_steps=14",
    "trainer.val_check_interval=5",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}, {name: knn, k: 3, power: 2.0}]",
)
CASES = {
    "validation": (3, ()),  # within a pass
    "no validation": (5, ("split.validation=0",)),
    "no validation in time": (3, ("trainer.val_check_interval=100",)),
    "density control": (  # before a density round
        5,
        (
            "training.density={every: 3, start: 3, stop: 9, gradient: 1.0e-4, split_angle: 0.3, opacity: 0.005, "
            "max_count: 50}",
        ),
    ),
    # The first step drives all opacities to 0 or 1, so the second validation is as good as the
    # first
    "early stop": (
        3,
        (
            "trainer.val_check_interval=3",
            "training.patience=1",
            "training.learning_rates={means: 0, quats: 0, log_scales: 0, opacity_logits: 1e5, signal: 0, network: 0}",
        ),
    ),
}
"""The step at which a run is interrupted, and its options."""

METRICS = [
    "task", "data", "split", "seed", "device", "rasterizer", "train_seconds", "inference_ms", "render_ms",
    "num_gaussians", "num_gaussians_start", "num_parameters", "checkpoint_bytes", "models", "validation",
    "validation_score", "receivers", "paired", "seconds",
]  # fmt: skip


def configure(*overrides):
    return gaigs.compose(*SMALL, *overrides)


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory):
    """A step, a configuration, and the folder of its run, which nothing interrupted."""
    at, options = CASES[request.param]
    config, folder = configure(*options), tmp_path_factory.mktemp("uninterrupted")
    return at, config, folder, runs.run(config, folder)


def interrupt(monkeypatch, at, times=1):
    """Presses Ctrl-C within a step."""
    training_step = Descent.training_step

    def interrupted(self, batch, index):
        if self.global_step + 1 == at:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
        return training_step(self, batch, index)

    monkeypatch.setattr(Descent, "training_step", interrupted)


def assert_same(a, b, where):
    """Two parts of a checkpoint hold the same numbers, bit for bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_same(*pair, f"{where}[{i}]")
    else:
        assert torch.equal(a, b) if torch.is_tensor(a) else a == b, where


def assert_same_run(metrics, folder, others, other):
    """Two runs ended alike."""
    assert metrics["models"] == others["models"]
    for name in ("best.ckpt", "last.ckpt"):
        a, b = (torch.load(path / name, weights_only=True) for path in (folder, other))
        for part in ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "gaigs"):
            assert_same(a[part], b[part], f"{name}: {part}")
    curves, resumed = (
        read_curves(sorted(path.glob("log/*/metrics.csv"))) for path in (folder, other)
    )
    assert curves.keys() == resumed.keys()
    for name in curves:
        np.testing.assert_array_equal(curves[name], resumed[name], name)


def test_an_interrupted_run_ends_as_if_it_had_not_been(case, tmp_path, monkeypatch):
    at, config, folder, metrics = case
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        interrupt(patch, at)
        with pytest.raises(KeyboardInterrupt, match=f"stopped after step {at}$"):
            runs.run(config, tmp_path)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == at
    assert not (tmp_path / "metrics.json").exists()
    assert_same_run(metrics, folder, runs.run(config, tmp_path), tmp_path)
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize("case", ["density control"], indirect=True)
def test_a_run_is_resumed_after_several_interruptions_with_a_save_every_step(
    case, tmp_path, monkeypatch
):
    _, config, folder, metrics = case
    config = config | {"save_every": 0}
    for at in (1, 2, 6):
        with monkeypatch.context() as patch:
            interrupt(patch, at)
            with pytest.raises(KeyboardInterrupt):
                runs.run(config, tmp_path)
    others = runs.run(config, tmp_path)
    assert metrics["models"] == others["models"]
    for name in ("best.ckpt", "last.ckpt"):
        a, b = (
            torch.load(path / name, weights_only=True)["state_dict"] for path in (folder, tmp_path)
        )
        assert_same(a, b, name)


@pytest.mark.parametrize(
    ("hook", "number", "message", "left"),
    [
        ("on_fit_start", signal.SIGINT, "stopped", False),
        ("on_fit_start", signal.SIGTERM, "stopped", False),
        ("on_train_end", signal.SIGTERM, "stopped after step 2", True),
    ],
)
def test_a_signal_around_the_steps_stops_a_run_too(
    hook, message, left, number, tmp_path, monkeypatch
):
    """Lightning exits with 1 and no message before the first step, and ignores a signal after the
    last.
    """
    monkeypatch.setattr(Descent, hook, lambda *_: signal.raise_signal(number), raising=False)
    with stopping(), pytest.raises(Stopped, match=f"{message}$") as stop:
        runs.run(configure("trainer.max_steps=2"), tmp_path)
    assert stop.value.number == number
    assert (tmp_path / "last.ckpt").exists() == left
    assert not (tmp_path / "metrics.json").exists()


# --- the run folder ---


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    config, folder = configure("trainer.max_steps=3"), tmp_path_factory.mktemp("finished")
    return config, folder, runs.run(config, folder)


def digest(folder):
    """Contents of the files of a folder, and times of their writing."""
    return {
        path: (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_metrics(finished):
    _, folder, metrics = finished
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert list(metrics) == METRICS
    assert {path.name for path in folder.iterdir()} == {
        "config.yaml", "software.json", "best.ckpt", "last.ckpt", "log", "predictions.npz", "gaussians.ply",
        "metrics.json"
    }  # fmt: skip
    assert metrics["split"] == "official, validation 0.1, seed 0"
    assert (metrics["seed"], metrics["rasterizer"]) == (0, "torch")
    assert metrics["num_gaussians"] == metrics["num_gaussians_start"] == 30
    assert metrics["checkpoint_bytes"] == (folder / "best.ckpt").stat().st_size
    assert metrics["num_parameters"] == sum(
        p.numel() for p in gaigs.load(folder / "best.ckpt").parameters()
    )
    assert min(metrics[time] for time in ("train_seconds", "inference_ms", "render_ms")) > 0
    assert list(metrics["models"]) == ["gaigs", "mean", "knn"] == list(metrics["validation"])
    best = torch.load(folder / "best.ckpt", weights_only=True)["callbacks"]
    (kept,) = (state["best"] for name, state in best.items() if name.startswith("KeepBest"))
    assert (
        metrics["validation_score"]
        == metrics["validation"]["gaigs"]["ssim_mean"]
        == pytest.approx(kept, abs=1e-6)
    )
    numbers = ["ssim_median", "ssim_mean", "ssim_p10", "ssim_p90", "mae"]
    intervals = [
        "coverage_50",
        "coverage_50_error",
        "coverage_90",
        "coverage_90_error",
        "width_90",
        "crps",
        "nll",
    ]
    for name, scores in metrics[
        "models"
    ].items():  # two validation links are too few for intervals of 90 %
        assert list(scores) == numbers + [*intervals, "calibration_links"] * (name != "gaigs")
        assert list(metrics["validation"][name]) == numbers


def test_predictions_belong_to_the_test_links(finished):
    config, folder, metrics = finished
    links = load(config["data"], config["split"])
    with np.load(folder / "predictions.npz") as file:
        stored = dict(file)
    assert stored["link"].tolist() == links.split.test.tolist()
    np.testing.assert_array_equal(
        stored["transmitters"], links.query.transmitters[links.split.test]
    )
    np.testing.assert_allclose(stored["labels"], links.labels[links.split.test], atol=5e-4)
    assert np.median(stored["ssim_gaigs"]) == pytest.approx(
        metrics["models"]["gaigs"]["ssim_median"]
    )


def test_a_finished_run_started_again_ends_at_once(finished, monkeypatch):
    config, folder, metrics = finished
    before = digest(folder)
    monkeypatch.setattr(runs, "train_and_test", None)
    assert runs.run(config, folder) == metrics
    assert digest(folder) == before


@pytest.mark.parametrize("name", ["last.ckpt", "best.ckpt"])
def test_a_damaged_checkpoint_to_resume_from_destroys_nothing(finished, tmp_path, name):
    config, folder, _ = finished
    copy = shutil.copytree(folder, tmp_path / "run")
    (copy / "metrics.json").unlink()
    (copy / name).write_bytes((copy / name).read_bytes()[:-999])
    before = digest(copy)
    with pytest.raises(
        ValueError,
        match=rf"cannot resume the training: .*{name} cannot be read: it is damaged.*\nmove .*last\.ckpt",
    ):
        runs.run(config, copy)
    assert digest(copy) == before


def test_a_folder_that_was_removed_and_made_anew_gets_its_configuration_again(
    finished, tmp_path, monkeypatch
):
    """Loggers make it anew where it is removed before the first save."""
    config, _, metrics = finished
    own = tmp_path / "run"

    def remove(*_):
        shutil.rmtree(own)
        own.mkdir()
        return metrics

    monkeypatch.setattr(runs, "train_and_test", remove)
    assert runs.run(config, own) == runs.run(config, own) == metrics
    assert yaml.safe_load((own / "config.yaml").read_text()) == config


@pytest.mark.parametrize(
    "text",
    ["model: 3\ndata: ${x.y\n", "model: &a {x: *a}\ndata: {}\n", "model: {null: 2}\ndata: {}\n"],
)
def test_a_damaged_configuration_in_the_folder_is_named(text, finished, tmp_path):
    config, folder, _ = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"cannot parse .*config\.yaml: "):
        runs.run(config, tmp_path)


def test_a_full_disk_leaves_nothing_half_written(finished, tmp_path, monkeypatch):
    """One on which the predictions find no room any more."""
    config, folder, _ = finished
    copy = shutil.copytree(folder, tmp_path / "run")
    for name in ("metrics.json", "predictions.npz"):
        (copy / name).unlink()
    names = {path.name for path in copy.iterdir()}

    def fill(path, **arrays):
        path.write_bytes(b"ha")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", fill)
        with pytest.raises(
            OSError, match=r"predictions\.npz could not be written \(No space left on device\)"
        ) as error:
            runs.run(config, copy)
    assert error.value.errno == errno.ENOSPC
    assert {path.name for path in copy.iterdir()} == names


@pytest.mark.parametrize("left", ["last.ckpt", "metrics.json"])
def test_another_configuration_in_the_same_folder_is_refused(left, finished, tmp_path):
    config, run, _ = finished
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / ({"last.ckpt", "metrics.json"} - {left}).pop()).unlink()
    before = digest(folder)
    other = config | {"seed": 1, "gaussians": config["gaussians"] | {"count": 31}}
    other["model"] = config["model"] | {"gaussians": other["gaussians"]}
    message = (
        r"a run of another configuration: gaussians\.count was 30, is 31; seed was 0, is 1\nchoose "
        r"another"
    )
    with pytest.raises(ValueError, match=message):
        runs.run(other, folder)
    assert digest(folder) == before


def test_options_that_change_no_result_may_change(finished, tmp_path):
    config, run, metrics = finished
    folder = shutil.copytree(run, tmp_path / "run")
    other = config | {
        "save_every": 99.0,
        "trainer": config["trainer"] | {"enable_progress_bar": True},
    }
    assert other != config
    assert runs.run(other, folder) == metrics


def test_a_folder_without_a_checkpoint_is_free(tmp_path):
    (tmp_path / "config.yaml").write_text("seed: 5\nmodel: {name: knn}\ndata: {name: synthetic}\n")
    runs.run(configure("trainer.max_steps=1"), tmp_path)
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["seed"] == 0


@pytest.mark.parametrize("name", ["[bold]x", "runs[/red]"])
def test_the_name_of_a_folder_is_no_markup(name, tmp_path, capsys):
    runs.run(configure("model=mean"), tmp_path / name)
    assert capsys.readouterr().out.endswith(f"results: {tmp_path / name}\n")


def test_the_name_of_a_split_is_no_markup():
    task = gaigs.links("synthetic_rssi", transmitters=10, order=0).task
    scores = {"mean": task.scores(torch.zeros(3), torch.ones(3))}
    assert "on split folder[/red]." in str(
        evaluation.Evaluation(task, "folder[/red]", scores, "cpu")
    )


def test_files_that_a_killed_writer_left_are_removed(tmp_path):
    config = configure("trainer.max_steps=1")
    claim(tmp_path, config)
    for place in (tmp_path / "figures", tmp_path / "members" / "1"):
        place.mkdir(parents=True)
    for name in ("last.ckpt", "figures/loss.png", "members/1/best.ckpt"):
        writer = atomic_write(tmp_path / name)
        writer.__enter__().write_bytes(b"cut")
        claim(tmp_path, config)
        assert not [*tmp_path.rglob("*.part*")]


@pytest.mark.parametrize("name", ["config.yaml", "predictions.npz", "figures"])
def test_a_folder_of_something_else_is_left_alone(name, tmp_path):
    (tmp_path / name).write_text("my: own\n")
    before = digest(tmp_path)
    with pytest.raises(ValueError, match=f"holds {name} of something else"):
        runs.run(configure("trainer.max_steps=1"), tmp_path)
    assert digest(tmp_path) == before


@pytest.mark.parametrize(("model", "others"), [("knn", ["mean"]), ("mean", ["knn"])])
def test_look_ups_run_without_training(model, others, finished, tmp_path, monkeypatch):
    metrics = runs.run(configure(f"model={model}"), tmp_path)
    assert list(metrics) == METRICS
    assert list(metrics["models"]) == [model, *others]
    assert metrics["models"][model] == finished[2]["models"][model], "as beside any other model"
    assert (
        metrics["num_gaussians"],
        metrics["num_gaussians_start"],
        metrics["num_parameters"],
    ) == (0, 0, 0)
    for key in ("rasterizer", "train_seconds", "render_ms"):
        assert metrics[key] is None
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"config.yaml", "software.json", "best.ckpt", "predictions.npz", "metrics.json"}
    monkeypatch.setattr("gaigs.data.load", None)  # the data are not read again
    with np.load(tmp_path / "predictions.npz") as file:
        found = gaigs.load(tmp_path).predict(file["transmitters"], 0)
        np.testing.assert_allclose(
            found, file["prediction"], rtol=1e-3, atol=1e-3
        )  # stored in half precision
    (tmp_path / "best.ckpt").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"has no best\.ckpt: the run is not finished, or one of a look-up"
    ):
        gaigs.load(tmp_path)


# --- refused options and data ---


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"+model.gaussians.conut": 3},
            r"gaussians has no option 'conut' \(did you mean 'count'\?\); it has: count, near",
        ),
        (
            {"+training.thinning.strid": 2},
            r"training.thinning has no option 'strid' \(did you mean 'stride'\?\)",
        ),
        (
            {"+training.learning_rates.netwrk": 1},
            r"training.learning_rates has no key 'netwrk' \(did you mean 'network'\?\)",
        ),
        (
            {"baselines": ["mean", {"name": "mean"}]},
            r"baselines must have different names, got 'mean' twice",
        ),
        ({"baselines": ["gaigs2"]}, r"unknown model 'gaigs2'"),
        (
            {"baselines": [{"k": 3}]},
            r"baselines must be names or model configurations with a name, got {'k': 3}",
        ),
        (
            {"baselines": [{"name": "mirrored", "pooling": "path_spectrum"}]},
            r"baseline 'mirrored' has to be trained",
        ),
        ({"task.name": "rssi"}, r"the labels of data 'synthetic' are of task 'spectrum', and"),
        ({"+trainer.callbacks": []}, r"trainer has no option 'callbacks'"),
        (
            {"+trainer.accumulate_grad_batches": 2},
            r"trainer.accumulate_grad_batches must be left out",
        ),
        (
            {"trainer.devices": 2, "trainer.strategy": "ddp_spawn"},
            r"trainer.strategy must be auto for one",
        ),
        ({"+trainer.limit_val_batches": 2}, r"trainer.limit_val_batches must be left out"),
        ({"+trainer.limit_train_batches": 1}, r"trainer.limit_train_batches must be left out"),
        ({"+trainer.overfit_batches": 0.5}, r"trainer.overfit_batches must be left out"),
        ({"+trainer.fast_dev_run": True}, r"trainer.fast_dev_run must be left out"),
        ({"task.trend": {"name": "gaigs"}}, "task.trend.name cannot be gaigs; take mean"),
    ],
)
def test_a_wrong_option_is_named(options, message, small, tmp_path):
    config = OmegaConf.create(small)
    for key, value in options.items():
        OmegaConf.update(config, key.removeprefix("+"), value, merge=False)
        if key == "task.trend":
            config.model.trend = value
    with pytest.raises((ValueError, TypeError), match=message):
        gaigs.run(configuration.resolve(config), tmp_path)
    assert not list(tmp_path.glob("*.ckpt"))


@pytest.fixture(scope="module")
def small():
    return configure()


@pytest.fixture(scope="module")
def rfid(tmp_path_factory):
    """A small data set in the folder layout of NeRF²."""
    folder = tmp_path_factory.mktemp("rfid") / "data"
    config = configure("data.transmitters=12")
    write(folder, load(config["data"], config["split"]))
    return folder


def measured(folder):
    """A configuration of measured spectra."""
    config = configure("trainer.max_steps=2")
    return config | {"data": {"name": "nerf2_spectrum", "root": str(folder)}}


def test_damaged_data_are_refused_and_left_alone(rfid, tmp_path):
    before = digest(rfid)
    runs.run(measured(rfid), tmp_path / "whole")
    assert digest(rfid) == before
    data = shutil.copytree(rfid, tmp_path / "data")
    lines = (data / "tx_pos.csv").read_text().splitlines()
    lines[3] = "0.5,nan,1.0"
    (data / "tx_pos.csv").write_text("\n".join(lines))
    before = digest(data)
    with pytest.raises(
        ValueError, match=r"tx_pos\.csv, line 4: expected a finite number, got 'nan' in column y"
    ):
        runs.run(measured(data), tmp_path / "run")
    assert digest(data) == before


def test_another_split_in_the_same_folder_is_refused():
    links = {
        "split": {
            "train": torch.tensor([0, 1]),
            "validation": torch.tensor([2]),
            "test": torch.tensor([3]),
        }
    }
    links["links"] = "digest"
    runs.folder.check_same_links(links, links, Path("last.ckpt"))
    exchanged = links | {
        "split": links["split"] | {"train": torch.tensor([0, 3]), "test": torch.tensor([1])}
    }
    for others in (exchanged, links | {"links": "another"}):
        with pytest.raises(ValueError, match=r"the data have changed since last\.ckpt was written"):
            runs.folder.check_same_links(links, others, Path("last.ckpt"))


def test_a_fingerprint_sees_every_change_of_the_links():
    links = example_links()
    turned = replace(links.receivers[0], pose=Pose(links.receivers[0].pose.position, torch.eye(3)))
    changes = {
        "query": replace(links.query, transmitters=links.query.transmitters + 1e-6),
        "receivers": (turned, *links.receivers[1:]),
        "labels": links.labels * 0.999,
    }
    queries = {
        "receivers": links.query.receivers.flip(0),
        "frequencies": torch.full((len(links),), 1e9),
    }
    others = {
        runs.folder.fingerprint(replace(links, **{name: value})) for name, value in changes.items()
    }
    for name, value in queries.items():
        others.add(
            runs.folder.fingerprint(replace(links, query=replace(links.query, **{name: value})))
        )
    assert len(others | {runs.folder.fingerprint(links)}) == 6
    assert runs.folder.fingerprint(example_links()) == runs.folder.fingerprint(links)


RSSI = (
    *(
        "+experiment=rssi",
        "data.transmitters=40",
        "data.order=0",
        "tokenizer=euclidean",
        "rasterizer=torch",
    ),
    *(
        "gaussians.count=12",
        "deformation.width=8",
        "trainer.max_steps=6",
        "trainer.val_check_interval=3",
    ),
    *(
        "trainer.accelerator=cpu",
        "trainer.enable_progress_bar=false",
        "trainer.log_every_n_steps=1",
    ),
)


def rssi_run(folder, *overrides):
    return runs.run(gaigs.compose(*RSSI, *overrides), folder)


def test_rssi_from_end_to_end(tmp_path):
    metrics = rssi_run(tmp_path)
    assert list(metrics) == METRICS
    assert list(metrics["models"]) == ["gaigs", "mean", "knn", "path_loss", "gaussian_process"]
    assert list(metrics["receivers"]) == ["west", "south", "east", "north"]
    assert metrics["data"].startswith("157 readings of 40 places at 4 gateways; 3 below -95 dBm")
    with np.load(tmp_path / "predictions.npz") as stored:
        for name, scores in metrics["models"].items():
            errors = np.abs(stored[f"error_{name}"].astype(float))
            assert scores["mae_db"] == pytest.approx(errors.mean(), abs=1e-4)
            assert scores["median_ae_db"] == pytest.approx(np.median(errors), abs=1e-4)
            west = errors[stored["receiver"] == 0]
            assert metrics["receivers"]["west"][name]["mae_db"] == pytest.approx(
                west.mean(), abs=1e-4
            )
        np.testing.assert_allclose(
            stored["prediction"] - stored["labels"], stored["error_gaigs"], atol=1e-4
        )
    model = gaigs.load(tmp_path / "best.ckpt")
    floor = RadioMap.load(tmp_path / "radio_map.npz")
    point = torch.tensor([floor.x[3], floor.y[2], floor.height])
    assert floor.values[1, 2, 3] == pytest.approx(model.predict(point, "south").item(), abs=1e-3)


@pytest.mark.parametrize(("part", "word"), [("validation", "training"), ("test", "known")])
def test_a_receiver_without_links_to_learn_from_is_refused_before_the_training(
    part, word, tmp_path, monkeypatch
):
    links = load({"name": "synthetic_rssi", "transmitters": 20, "order": 0}, {"name": "random"})
    own = getattr(links.split, part)
    links.query.receivers[links.query.receivers == 3] = 2
    links.query.receivers[own[:1]] = 3
    monkeypatch.setattr(runs.data, "load", lambda *_: links)
    monkeypatch.setattr("gaigs.runs.fitting.descend", lambda *_: pytest.fail("trained"))
    with pytest.raises(ValueError, match=f"has no {word} links of north; choose another split"):
        rssi_run(tmp_path)


def test_channels_of_mirrored_gaussians_end_no_lower_than_free_space(tmp_path, monkeypatch):
    """Whatever the steps do: here they drive all apart. The start is looked at before the first
    revision.
    """
    options = (
        "+experiment=mirrored_csi", "data.transmitters=30", "data.order=1", "split.validation=0.5", "kriging=false",
        "baselines=[{name: friis}]", "trainer.max_steps=6", "trainer.val_check_interval=3", *SMALL[9:11],
        "training.learning_rates={planes: 10, paths: 10, obstacles: 10}", "placement.planes=6", "placement.order=1",
    )  # fmt: skip
    found = SlabRoom(torch.eye(4)[:3].double(), SLABS[:3])  # instead of a search
    monkeypatch.setattr(ChannelSearch, "run", lambda _: found)
    metrics = runs.run(gaigs.compose(*options), tmp_path)
    own, free_space = (metrics["validation"][name] for name in ("mirrored", "friis"))
    for name in ("sinad_db_mean", "snr_db_median", "nmse_db"):
        assert own[name] == pytest.approx(free_space[name], abs=1e-2)
    assert (metrics["paths_kept"], metrics["planes_kept"]) == (1, 0)
    assert gaigs.load(tmp_path / "best.ckpt").predict([[1.0, 2.0, 1.5]]).abs().max() > 0


STARTS = (
    "+experiment=mirrored", "data.transmitters=20", "data.order=0", "kriging=false", "baselines=[mean]",
    "placement.planes=6", "placement.order=1", "placement.obstacles=1", "trainer.max_steps=2",
    "trainer.val_check_interval=1", "trainer.enable_progress_bar=false", "model.search=null",
)  # fmt: skip


@pytest.fixture
def two_starts(monkeypatch):
    """A search that finds the ceiling at once, so that spectra have a second start."""
    monkeypatch.setattr(runs, "radio_map", Mock())  # which takes long
    monkeypatch.setattr(LagSearch, "run", lambda *_: torch.tensor([[0.0, 0.0, 1.0, 2.7]]))


@pytest.mark.usefixtures("two_starts")
def test_several_processes_have_one_start(tmp_path, monkeypatch):
    """The further ones end with the first training."""
    monkeypatch.setattr(lightning.Trainer, "world_size", 2)
    runs.run(gaigs.compose(*STARTS), tmp_path)
    assert (tmp_path / "best.ckpt").is_file()
    assert not (tmp_path / "second_start").exists()


@pytest.mark.usefixtures("two_starts")
def test_a_given_model_is_trained_in_place_from_one_start(tmp_path):
    links = gaigs.links("synthetic", transmitters=20, order=0)
    placement = {"name": "mirrored", "planes": 6, "order": 1}
    model = MirroredSplatting(links.scene, placement=placement)
    for steps in (1, 2):  # an untrained model, and a trained one
        options = {"max_steps": steps, "enable_progress_bar": False, "kriging": False}
        assert gaigs.train(model, links, folder=tmp_path / str(steps), **options) is model
        assert not (tmp_path / str(steps) / "second_start").exists()


@pytest.mark.usefixtures("two_starts")
@pytest.mark.parametrize("scores", [(0.9, 0.5), (0.5, 0.9)])
def test_validation_chooses_the_start_of_mirrored_gaussians(tmp_path, monkeypatch, scores):
    given = {tmp_path: scores[0], tmp_path / "second_start": scores[1]}

    def descend(model, loss, links, config, folder, *rest, **named):
        trained = descent.descend(model, loss, links, config, folder, *rest, **named)
        for name in ("best.ckpt", "last.ckpt"):
            content = checkpoint.read(folder / name)
            content["callbacks"]["KeepBest"]["best"] = given[folder]
            checkpoint.write(content, folder / name)
        return trained

    monkeypatch.setattr("gaigs.runs.fitting.descend", descend)
    runs.run(gaigs.compose(*STARTS), tmp_path)
    second = gaigs.load(tmp_path / "second_start" / "best.ckpt")
    model = gaigs.load(tmp_path)
    is_second = scores[0] < scores[1]
    assert model.search is (False if is_second else None)
    curves, other = read_log(tmp_path), read_log(tmp_path / "second_start")
    of_second = [np.array_equal(curves[name], curve) for name, curve in other.items()]
    assert all(of_second) == is_second
    places = [[1.0, 2.0, 1.5]]
    assert torch.equal(model.predict(places), second.predict(places)) == is_second


# --- the software of a run ---


def test_a_folder_of_an_earlier_version_is_refused(finished, tmp_path):
    config, folder, _ = finished
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "software.json").unlink()
    with pytest.raises(
        ValueError, match=r"copy was begun by gaigs 0.1 or earlier, and this is .*\nchoose another"
    ):
        runs.run(config, copy)
    (copy / "software.json").write_text('{"gaigs": "0.1.3"}')
    with pytest.raises(ValueError, match=r"copy was begun by gaigs 0.1.3, and this is"):
        runs.run(config, copy)


PLUGIN = """
import gaigs
from gaigs.model.mean import Mean
from plugins.other import LEVEL

@gaigs.register("model", "own_mean")
class OwnMean(Mean):
    pass
"""


LEVEL = """
import gaigs
import torch
from gaigs.model import Model, Prediction
from plugins.other import LEVEL

@gaigs.register("model", "own_level")
class OwnLevel(Model):
    def __init__(self, scene):
        super().__init__(scene)
        self.level = torch.nn.Parameter(torch.tensor(-50.0))

    def forward(self, batch):
        return Prediction(self.level * torch.ones(len(batch)), {})
"""


def test_a_changed_plug_in_is_no_finished_run(tmp_path, monkeypatch, caplog):
    (tmp_path / "plugins").mkdir()
    own, other = tmp_path / "plugins/own.py", tmp_path / "plugins/other.py"
    own.write_text(PLUGIN)
    other.write_text("LEVEL = 1")
    monkeypatch.chdir(tmp_path)
    there = runs.folder.software({"model": {"name": "own_mean"}, "baselines": [{"name": "mean"}]})
    assert there.keys() == {"gaigs", "model own_mean"}
    config = configure("model=mean") | {"baselines": [{"name": "own_mean"}]}
    folder = tmp_path / "run"
    folder.mkdir()
    runs.folder.claim(folder, config)
    (folder / "metrics.json").write_text("{}")
    runs.folder.claim(folder, config)
    for file in (other, own):
        text = file.read_text()
        file.write_text(text + "\n")
        with pytest.raises(
            ValueError, match=r"the source of model own_mean has changed since .*run was begun"
        ):
            runs.folder.claim(folder, config)
        runs.folder.warn_of_changes(folder, {"name": "own_mean"})
        assert f"the source of model own_mean has changed since {folder} was trained" in caplog.text
        caplog.clear()
        file.write_text(text)
    runs.folder.warn_of_changes(folder, {"name": "own_mean"})
    assert not caplog.text
    (tmp_path / "plugins/unrelated.py").write_text("")
    runs.folder.claim(folder, config)


def test_a_reader_of_a_run_is_imported_if_it_is_the_recorded_one_or_trusted(tmp_path, monkeypatch):
    (tmp_path / "plugins").mkdir()
    source = tmp_path / "plugins/own_data.py"
    source.write_text(
        "import gaigs\nfrom gaigs.data.synthetic import furnished_room\n\n"
        "@gaigs.register('data', 'own_data')\ndef own_data():\n    return "
        "furnished_room(transmitters=30, order=0)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    runs.run(gaigs.compose("model=knn", "data=own_data", baselines=[]), tmp_path / "run")
    source.write_text(source.read_text() + "\n")
    forget = [
        (sys.modules, "plugins.own_data"),
        (registry("data")._registered, "own_data"),
    ]  # as a new process
    for names, name in forget:
        del names[name]
    with pytest.raises(
        ValueError, match=r"plugins/own_data.py is not the source of data 'own_data'"
    ):
        runs.links_of(tmp_path / "run", trust=False)
    assert len(runs.links_of(tmp_path / "run", trust=True)) == 30
    for names, name in forget:
        del names[name]


@pytest.mark.parametrize("name", ["own_mean", "own_level"])
def test_a_plug_in_is_imported_if_it_is_the_recorded_one_or_trusted(
    name, tmp_path, monkeypatch, caplog
):
    """A look-up by the digests of its folder; a trained model by those of its checkpoint, or of an
    old one's folder.
    """
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins/other.py").write_text("LEVEL = 1")
    (tmp_path / f"plugins/{name}.py").write_text(PLUGIN if name == "own_mean" else LEVEL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr(registry("model"), "_registered", registry("model")._registered.copy())
    words = (
        "data=synthetic_rssi",
        "data.transmitters=30",
        "trainer.max_steps=1",
        "trainer.enable_progress_bar=false",
    )
    config = gaigs.compose(f"model={name}", *words, baselines=[])
    runs.run(config, tmp_path / "run")
    loaded = [tmp_path / "run"]
    if name == "own_level":
        loaded.append(tmp_path / "saved.ckpt")
        gaigs.load(tmp_path / "run").save(loaded[-1])
        gaigs.load(tmp_path / "run/best.ckpt")
        content = checkpoint.read(tmp_path / "run/best.ckpt")
        del content[checkpoint.KEY]["plugins"]
        checkpoint.write(content, tmp_path / "run/best.ckpt")
        with pytest.raises(ValueError, match="that was recorded with the model"):
            gaigs.load(tmp_path / "run/best.ckpt")
    for path in loaded:
        gaigs.load(path)
    (tmp_path / "plugins/other.py").write_text("LEVEL = 2")
    for path in loaded:
        with pytest.raises(
            ValueError, match=rf"plugins/{name}.py is not the source .*\n.*trust=True in gaigs.load"
        ):
            gaigs.load(path)
        gaigs.load(path, trust=True).predict([[1.0, 2.0, 1.5]])
    with pytest.raises(ValueError, match="is not the source"):
        gaigs.run(
            gaigs.compose("command=survey", folder=str(tmp_path / "run")), tmp_path / "survey"
        )
    for module in [module for module in sys.modules if module.partition(".")[0] == "plugins"]:
        del sys.modules[module]


@pytest.mark.parametrize(
    "body",
    [
        "def part(links):\n    half = {}",
        "class Part:\n    half = {}",
        "class Part(list):\n    def half(self): return {}",
    ],
    ids=["function", "attribute", "method"],
)
def test_a_changed_component_of_a_notebook_is_no_finished_run(body, monkeypatch):
    """Cells have no file: their text is where Python looks for that of errors."""
    monkeypatch.setitem(registry("split")._registered, "cell", None)
    digests = []
    for number, value in enumerate((2, 3, 2)):
        cell = (
            f"# {number}\n@gaigs.register('split', 'cell')\n{body.format(value)}\nother = "
            f"{number}\n"
        )
        monkeypatch.setitem(
            linecache.cache, f"cell {number}", (len(cell), None, cell.splitlines(True), "")
        )
        exec(compile(cell, f"cell {number}", "exec"), {"__name__": "__main__", "gaigs": gaigs})
        digests.append(runs.folder.software({"split": {"name": "cell"}})["split cell"])
    assert digests[0] == digests[2] != digests[1]


def test_a_run_killed_behind_its_training_only_tests_anew(finished, tmp_path, monkeypatch):
    config, folder, metrics = finished
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "score", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            runs.run(config, tmp_path)
    monkeypatch.setattr(Descent, "training_step", lambda *_: 1 / 0)
    trained = torch.load(tmp_path / "last.ckpt", weights_only=True)["callbacks"]["Budget"][
        "seconds"
    ]
    others = runs.run(config, tmp_path)
    assert_same_run(metrics, folder, others, tmp_path)
    assert others["train_seconds"] == trained


def test_tensorboard_logs_beside_the_csv(tmp_path):
    pytest.importorskip("tensorboard")
    runs.run(configure("tensorboard=true", "trainer.max_steps=2"), tmp_path)
    assert list(tmp_path.glob("tensorboard/*/events*"))
    assert list(tmp_path.glob("log/*/metrics.csv"))


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_the_first_page_names_every_key_of_the_metrics(tmp_path, monkeypatch, task):
    monkeypatch.setattr(runs, "radio_map", Mock())  # which takes long
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(iterations=2))
    words = [
        f"+experiment={'mirrored' if task == 'spectrum' else f'mirrored_{task}'}", "data.transmitters=16",
        "trainer.max_steps=1", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "placement.order=1",
        "placement.planes=6", "placement.obstacles=2", "placement.fixed=true", "baselines=[mean]",
        "data.order=0", "split.validation=0.3",
    ]  # fmt: skip
    metrics = runs.run(gaigs.compose(*words), tmp_path)
    rows = [*metrics["models"].values(), *metrics["validation"].values(), metrics["kriging"]]
    rows += [*metrics["planes"], *metrics["paths"]]
    page = (Path(__file__).parents[1] / "docs/start.md").read_text()
    section = page[page.index("`metrics.json`:") : page.index("## Stop and continue")]
    rows_and_paths = (line for line in section.splitlines() if line.startswith(("|", "`paths`")))
    table = {*re.findall(r"`(\w+)`", "".join(rows_and_paths))}
    keys = {*metrics, *(key for row in rows for key in row)}
    assert not keys - table
