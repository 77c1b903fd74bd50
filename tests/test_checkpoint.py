import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import gaigs
from gaigs import checkpoint, experiment
from gaigs.configuration import conf_dir
from gaigs.data.nerf2_spectrum import write
from gaigs.registry import registry

OVERRIDES = (
    "data.transmitters=20",
    "tokenizer.ga.multivectors=4",
    "gaussians.count=30",
    "training.batch_size=8",
    "training.loss.stride=8",
    "training.density={every: 2, start: 2, stop: 4, gradient: 0.0, wide: 0.0, opacity: 0.0, most: 45}",
    "trainer.accelerator=cpu",
    "trainer.max_steps=5",
    "trainer.log_every_n_steps=5",
    "trainer.enable_progress_bar=false",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run on measured spectra that are gone, whose Gaussians density control has made more."""
    folder = tmp_path_factory.mktemp("run")
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = OmegaConf.to_container(compose("config", list(OVERRIDES)), resolve=True)
    data = folder / "data"
    write(data, registry("data").build(config["data"]))
    config["data"] = {"name": "nerf2_spectrum", "root": str(data), "split": config["data"]["split"]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "write_figures", lambda *_: None)
        experiment.run(config, folder / "run")
    shutil.rmtree(data)
    return folder / "run"


@pytest.fixture
def content(folder):
    return checkpoint.read(folder / "best.ckpt")


def test_a_checkpoint_predicts_without_data_and_without_hydra(folder, tmp_path):
    script = """
import sys

import torch

sys.modules["hydra"] = None  # what cannot be imported
import gaigs

model = gaigs.load(sys.argv[1])
torch.save(model.predict(torch.load(sys.argv[2])), sys.argv[3])
"""
    with np.load(folder / "predictions.npz") as file:
        stored = dict(file)
    torch.save(torch.from_numpy(stored["transmitters"]), tmp_path / "transmitters.pt")
    files = [folder / "best.ckpt", tmp_path / "transmitters.pt", tmp_path / "spectra.pt"]
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent)}
    subprocess.run([sys.executable, "-W", "error", "-c", script, *files], check=True, cwd=tmp_path, env=environment)
    predicted = torch.load(files[-1])
    assert predicted.shape == stored["prediction"].shape
    np.testing.assert_allclose(predicted, stored["prediction"], rtol=1e-3, atol=1e-4)  # stored in half precision


def test_a_checkpoint_holds_all_that_a_run_is(folder, content):
    identity = content[checkpoint.KEY]
    assert identity["config"] == OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    assert identity["model"] == identity["config"]["model"]
    split = identity["split"]
    assert split["name"] == "official, validation 0.1, seed 0"
    assert sorted(torch.cat([split[part] for part in ("train", "validation", "test")]).tolist()) == list(range(20))
    assert identity["scene"]["normalisation"] == "min-max of each spectrum's amplitude"
    assert content["optimizer_states"][0]["state"]


def test_the_number_of_gaussians_is_the_checkpoints(folder, content):
    assert len(gaigs.load(folder / "best.ckpt").gaussians) == 45
    assert content[checkpoint.KEY]["model"]["gaussians"]["count"] == 30


def test_a_loaded_model_is_ready_to_predict(folder):
    model = gaigs.load(str(folder / "last.ckpt"))
    assert not model.training
    spectra = model.predict([[1.0, 2.0, 1.5], [2.0, 2.0, 1.0]])
    assert spectra.shape == (2, 90, 360)
    assert not spectra.requires_grad


def test_a_missing_checkpoint(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*best\.ckpt; a run leaves best\.ckpt and last"):
        gaigs.load(tmp_path / "best.ckpt")


class Foreign:
    """Something that only its own code can unpickle."""


@pytest.mark.parametrize(
    "spoil",
    {
        "truncated": lambda path, content: path.write_bytes(path.read_bytes()[:-2000]),
        "empty": lambda path, content: path.write_bytes(b""),
        "text": lambda path, content: path.write_text("means, quats\n"),
        "another program's": lambda path, content: torch.save({"state_dict": content["state_dict"]}, path),
        "a tensor": lambda path, content: torch.save(torch.zeros(3), path),
        "code": lambda path, content: torch.save(content | {"callback": Foreign()}, path),
    }.items(),
    ids=lambda item: item[0],
)
def test_a_damaged_or_foreign_file_gives_one_line(spoil, folder, content, tmp_path):
    path = tmp_path / "best.ckpt"
    shutil.copy(folder / "best.ckpt", path)
    spoil[1](path, content)
    with pytest.raises(ValueError, match=r"best\.ckpt must be a checkpoint of gaigs, and (is damaged|lacks)") as error:
        gaigs.load(path)
    assert "\n" not in str(error.value)


def test_weights_that_do_not_fit_give_one_line(content, tmp_path):
    content[checkpoint.KEY]["model"]["mapping"]["width"] = 32
    torch.save(content, tmp_path / "best.ckpt")
    message = r"must hold the weights of its configuration, and does not: .*size mismatch for mapping"
    with pytest.raises(ValueError, match=message) as error:
        gaigs.load(tmp_path / "best.ckpt")
    assert "\n" not in str(error.value)


def test_a_component_that_is_not_installed_is_named(content, tmp_path):
    content[checkpoint.KEY]["model"]["tokenizer"]["name"] = "fourier"
    torch.save(content, tmp_path / "best.ckpt")
    with pytest.raises(ValueError, match="unknown tokenizer 'fourier'"):
        gaigs.load(tmp_path / "best.ckpt")
