"""Checkpoints: complete, loaded without data and Hydra, refused when damaged."""

import errno
import os
import random
import re
import shutil
import subprocess
import sys
import traceback
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
import torch
import yaml

import gaigs
from gaigs import runs
from gaigs.core.scene import Scene
from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.model import checkpoint
from gaigs.registry import digests

OVERRIDES = (
    "data.transmitters=20", "data.order=0", "tokenizer.ga.multivectors=4", "gaussians.count=30",
    "training.batch_size=8", "training.thinning.stride=8", "rasterizer=torch", "baselines=[]",
    "training.density={every: 2, start: 2, stop: 4, gradient: 0.0, split_angle: 0.0, opacity: 0.0, max_count: 45}",
    "trainer.accelerator=cpu", "trainer.max_steps=5", "trainer.log_every_n_steps=5",
    "trainer.enable_progress_bar=false",
)  # fmt: skip
PLACES = [[1.0, 2.0, 1.5], [2.0, 2.0, 1.0]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run on measured spectra that are gone, with density control."""
    folder = tmp_path_factory.mktemp("run")
    config = gaigs.compose(*OVERRIDES)
    data = folder / "data"
    write(data, load(config["data"], config["split"]))
    config["data"] = {
        "name": "nerf2_spectrum",
        "root": str(data),
        "frequency": config["data"]["frequency"],
    }
    runs.run(config, folder / "run")
    shutil.rmtree(data)
    return folder / "run"


@pytest.fixture
def content(folder):
    return checkpoint.read(folder / "best.ckpt")


def test_a_checkpoint_predicts_without_data_and_without_hydra(folder, tmp_path):
    script = """
import sys

import torch

sys.modules["hydra"] = None  # cannot be imported
import gaigs

model = gaigs.load(sys.argv[1])
torch.save(model.predict(torch.load(sys.argv[2]), 0), sys.argv[3])
"""
    with np.load(folder / "predictions.npz") as file:
        stored = dict(file)
    torch.save(torch.from_numpy(stored["transmitters"]), tmp_path / "transmitters.pt")
    files = [folder / "best.ckpt", tmp_path / "transmitters.pt", tmp_path / "spectra.pt"]
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent)}
    subprocess.run(
        [sys.executable, "-W", "error", "-c", script, *files],
        check=True,
        cwd=tmp_path,
        env=environment,
    )
    predicted = torch.load(files[-1])
    assert predicted.shape == stored["prediction"].shape
    np.testing.assert_allclose(
        predicted, stored["prediction"], rtol=1e-3, atol=1e-4
    )  # stored in half precision


def test_a_checkpoint_holds_configuration_split_scene_and_optimizer(folder, content):
    identity = content[checkpoint.KEY]
    assert identity["version"] == checkpoint.VERSION == 3
    assert identity["config"] == yaml.safe_load((folder / "config.yaml").read_text())
    assert identity["model"] == identity["config"]["model"]
    split = identity["split"]
    assert split["name"].startswith("official, ")
    assert sorted(
        torch.cat([split[part] for part in ("train", "validation", "test")]).tolist()
    ) == list(range(20))
    assert identity["scene"]["task"]["normalisation"] == "min-max of each spectrum's amplitude"
    assert len(identity["scene"]["receivers"][0]["elements"]) == 16
    assert content["optimizer_states"][0]["state"]


def test_the_number_of_gaussians_is_the_checkpoints(folder, content):
    assert len(gaigs.load(folder / "best.ckpt").gaussians) == 45
    assert content[checkpoint.KEY]["model"]["gaussians"]["count"] == 30


def test_many_spectra_go_to_a_file_as_the_page_shows(folder, tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/start.md").read_text()
    (code,) = [
        block
        for block in re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S)
        if "predict_batches" in block
    ]
    (tmp_path / "runs/room").mkdir(parents=True)
    shutil.copy(folder / "best.ckpt", tmp_path / "runs/room")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(code.replace("100_000", "5").replace("batch_size=16", "batch_size=2"), names)
    stored = np.load("spectra.npy", mmap_mode="r")
    assert torch.equal(
        torch.tensor(stored), names["model"].predict(names["positions"], 0, batch_size=2)
    )


def test_missing_files_and_other_types_are_refused(tmp_path):
    for path in (None, 3, b"best.ckpt"):
        with pytest.raises(TypeError):
            gaigs.load(path)
    with pytest.raises(
        FileNotFoundError, match=r"no checkpoint at .*; a run writes best\.ckpt and last"
    ):
        gaigs.load(tmp_path / "best.ckpt")


class Foreign:
    """An object that only its own code can unpickle."""


MEANS = "model.gaussians.means"


def MODEL(content):
    return content[checkpoint.KEY]["model"]


def SCENE(content):
    return content[checkpoint.KEY]["scene"]


def WEIGHTS(content):
    return content["state_dict"]


DEFECTS = {
    "no weights": (lambda content: content.pop("state_dict"), "it lacks state_dict"),
    "no model": (lambda content: content[checkpoint.KEY].pop("model"), "it lacks model"),
    "another program's": (lambda content: content.pop(checkpoint.KEY), "it lacks the entry 'gaigs'"),
    "code": (lambda content: content.update(callback=Foreign()), "cannot be read: it is damaged, or another program"),
    "an earlier format": (lambda content: content[checkpoint.KEY].update(version=2), "has checkpoint format 2, not 3"),
    "no format": (lambda content: content[checkpoint.KEY].pop("version"), "has checkpoint format None, not"),
    "no receivers": (lambda content: SCENE(content).pop("receivers"), "KeyError: 'receivers'"),
    "no name": (lambda content: MODEL(content).pop("name"), "needs the key 'name'"),
    "a component that is not installed": (
        lambda content: MODEL(content)["tokenizer"].update(name="fourier"), "unknown tokenizer 'fourier'"
    ),
    "a task that is not installed": (lambda content: SCENE(content)["task"].update(name="odour"), "unknown task"),
    "a plug-in that cannot be imported": (
        lambda content: content[checkpoint.KEY].update(model={"name": "broken"}, plugins=digests("broken")),
        "ZeroDivisionError",
    ),
    "a plug-in that is not recorded": (
        lambda content: content[checkpoint.KEY].update(model={"name": "broken"}, plugins={}),
        r"plugins/broken.py is not the source of model 'broken' that was recorded .*\n.* "
        r"trust=True in gaigs.load",
    ),
    "other weights": (lambda content: MODEL(content)["deformation"].update(width=32), "size mismatch for deformation"),
    "a weight too few": (lambda content: WEIGHTS(content).pop(MEANS), "Missing key.*gaussians.means"),
    "a weight that is a word": (lambda content: WEIGHTS(content).update({MEANS: "means"}), "means"),
    "NaN": (lambda content: WEIGHTS(content)[MEANS][3].fill_(torch.nan), "weights gaussians.means is not finite"),
    "a rotation that is none": (
        lambda content: SCENE(content)["receivers"][0].update(rotation=7 * torch.eye(3)), "must have a rotation, whose"
    ),
    "a box of NaN": (lambda content: SCENE(content)["lower"].fill_(torch.nan), "scene lower is not finite"),
}  # fmt: skip


BROKEN = """
from gaigs.registry import register

@register("model", "broken")
class Broken: ...

1 / 0
"""


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_file_with_another_content_is_refused(defect, content, tmp_path, monkeypatch):
    spoil, message = DEFECTS[defect]
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins/broken.py").write_text(BROKEN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    spoil(content)
    checkpoint.write(content, tmp_path / "best.ckpt")
    with pytest.raises((ValueError, ImportError), match=rf"best\.ckpt.*{message}") as error:
        gaigs.load(tmp_path / "best.ckpt")
    assert str(error.value).count("\n") <= 1
    assert "weights_only" not in "".join(traceback.format_exception(error.value)), (
        "torch advises to run its code"
    )
    assert isinstance(error.value, ImportError) == (message == "ZeroDivisionError")
    for name in [name for name in sys.modules if name.partition(".")[0] == "plugins"]:
        del sys.modules[name]


ENDLESS: list = []
ENDLESS.append(ENDLESS)


def compress(path):
    """Its own records, deflated: zeros would take a thousandth of their memory."""
    with ZipFile(path) as archive:
        records = {entry: archive.read(entry) for entry in archive.namelist()}
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for name, record in records.items():
            archive.writestr(name, record)
    checkpoint.seal(path)


SPOILT = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("means, quats\n"),
    "without a seal": lambda path: torch.save(checkpoint.read(path), path),
    "a tensor": lambda path: (torch.save(torch.zeros(3), path), checkpoint.seal(path)),
    "compressed": lambda path: compress(path),
    "larger than its file": lambda path: checkpoint.write(
        checkpoint.read(path) | {"state": torch.zeros(1).expand(2**30)}, path
    ),
    "endless": lambda path: checkpoint.write(checkpoint.read(path) | {"loop": ENDLESS}, path),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-2000]),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"0"),
}


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_damaged_or_foreign_file_is_refused(spoil, folder, tmp_path):
    path = Path(shutil.copy(folder / "best.ckpt", tmp_path))
    SPOILT[spoil](path)
    with pytest.raises(
        ValueError, match=r"best\.ckpt (cannot be read: it is damaged|is no checkpoint of)"
    ) as error:
        gaigs.load(path)
    assert "weights_only" not in "".join(traceback.format_exception(error.value))


def flipped(data, draw, first=0):
    place = draw.randrange(first, len(data))
    return data[:place] + bytes([data[place] ^ 1 << draw.randrange(8)]) + data[place + 1 :]


@pytest.mark.parametrize(
    "change", [flipped, lambda data, draw: flipped(data, draw, len(data) - 200)]
)
def test_any_change_of_a_file_is_found(change, folder, tmp_path):
    data, draw = (folder / "best.ckpt").read_bytes(), random.Random(0)
    for _ in range(8):
        (tmp_path / "best.ckpt").write_bytes(change(data, draw))
        with pytest.raises(ValueError, match="it is damaged"):
            checkpoint.read(tmp_path / "best.ckpt")


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_a_lack_of_memory_is_not_called_a_damaged_file(error, folder, monkeypatch):
    """The advice to take another file would lose a good one."""

    def fail(*_, **__):
        raise error

    for module, name, work in ((torch, "load", checkpoint.read), (Scene, "from_state", gaigs.load)):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, fail)
            with pytest.raises(type(error)) as raised:
                work(folder / "best.ckpt")
        assert raised.value is error


def test_a_checkpoint_stays_an_archive_that_torch_reads(folder, content):
    assert torch.load(folder / "best.ckpt", weights_only=True).keys() == content.keys()
    with ZipFile(folder / "best.ckpt") as archive:
        assert archive.testzip() is None
        assert archive.comment.startswith(checkpoint.SEAL)


def test_a_full_disk_leaves_the_checkpoint_that_was_there(folder, content, tmp_path, monkeypatch):
    path = tmp_path / "best.ckpt"
    shutil.copy(folder / "best.ckpt", path)
    before = path.read_bytes()

    def fill(content, file):
        file.write(b"ha")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(torch, "save", fill)
    with pytest.raises(
        OSError, match=r"best\.ckpt could not be written \(No space left on device\)\ncheck"
    ) as error:
        checkpoint.write(content, path)
    assert error.value.errno == errno.ENOSPC
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]
