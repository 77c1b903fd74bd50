import errno
import os
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
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import gaigs
from gaigs import checkpoint, evaluation, runs
from gaigs.configuration import conf_dir
from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.registry import registry
from gaigs.scene import Scene

OVERRIDES = (
    "data.transmitters=20",
    "tokenizer.ga.multivectors=4",
    "gaussians.count=30",
    "training.batch_size=8",
    "training.thinning.stride=8",
    "training.density={every: 2, start: 2, stop: 4, gradient: 0.0, split_angle: 0.0, opacity: 0.0, max_count: 45}",
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
    write(data, load(config["data"], config["split"]))
    config["data"] = {"name": "nerf2_spectrum", "root": str(data), "frequency": config["data"]["frequency"]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "write_figures", lambda *_: None)
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
    assert identity["version"] == checkpoint.VERSION == 2
    assert identity["config"] == OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    assert identity["model"] == identity["config"]["model"]
    split = identity["split"]
    assert split["name"].startswith("official, ")
    assert sorted(torch.cat([split[part] for part in ("train", "validation", "test")]).tolist()) == list(range(20))
    assert identity["scene"]["task"]["normalisation"] == "min-max of each spectrum's amplitude"
    assert len(identity["scene"]["receivers"][0]["elements"]) == 16
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


def test_many_spectra_go_to_a_file_as_the_page_shows(folder, tmp_path, monkeypatch):
    page = (Path(__file__).parents[1] / "docs/start.md").read_text()
    (code,) = [
        block for block in re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S) if "predict_batches" in block
    ]
    (tmp_path / "runs/room").mkdir(parents=True)
    shutil.copy(folder / "best.ckpt", tmp_path / "runs/room")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(code.replace("100_000", "5").replace("batch_size=16", "batch_size=2"), names)
    stored = np.load("spectra.npy", mmap_mode="r")
    assert torch.equal(torch.tensor(stored), names["model"].predict(names["positions"], batch_size=2))


@pytest.mark.parametrize("path", [None, 3, b"best.ckpt"])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(TypeError, match=f"the path of a checkpoint must be a path, got {path!r}"):
        gaigs.load(path)


def test_a_name_that_no_file_can_have_is_that_of_none():
    with pytest.raises(FileNotFoundError, match="no checkpoint at xxxx"):
        gaigs.load("x" * 5000)


def test_a_missing_checkpoint(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*best\.ckpt; a run leaves best\.ckpt and last"):
        gaigs.load(tmp_path / "best.ckpt")


class Foreign:
    """Something that only its own code can unpickle."""


def pack(path):
    """The archive anew with its parts deflated, one of which unpacks to more than all of the file."""
    with ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for name, part in (parts | {"archive/data/0": bytes(10**7)}).items():
            archive.writestr(name, part)


@pytest.mark.parametrize(
    "spoil",
    {
        "truncated": lambda path, content: path.write_bytes(path.read_bytes()[:-2000]),
        "empty": lambda path, content: path.write_bytes(b""),
        "text": lambda path, content: path.write_text("means, quats\n"),
        "another program's": lambda path, content: torch.save({"state_dict": content["state_dict"]}, path),
        "of another meaning": lambda path, content: checkpoint.write(content | {checkpoint.KEY: 3}, path),
        "a tensor": lambda path, content: torch.save(torch.zeros(3), path),
        "code": lambda path, content: checkpoint.write(content | {"callback": Foreign()}, path),
        "packed": lambda path, content: pack(path),
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
    told = "".join(traceback.format_exception(error.value))
    assert "weights_only" not in told, "torch's advice runs the code of a hostile file"


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_a_lack_of_memory_is_not_called_a_damaged_file(error, folder, monkeypatch):
    """The advice to take another file would lose a good one."""

    def fail(*_, **__):
        raise error

    for module, name, work in ((torch, "load", checkpoint.read), (Scene, "from_state", gaigs.load)):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, fail)
            with pytest.raises(type(error)) as told:
                work(folder / "best.ckpt")
        assert told.value is error


def test_weights_that_do_not_fit_give_one_line(content, tmp_path):
    content[checkpoint.KEY]["model"]["deformation"]["width"] = 32
    checkpoint.write(content, tmp_path / "best.ckpt")
    message = r"and does not: its weights are not those of its configuration: .*size mismatch for deformation"
    with pytest.raises(ValueError, match=message) as error:
        gaigs.load(tmp_path / "best.ckpt")
    assert "\n" not in str(error.value)


def test_a_component_that_is_not_installed_is_named(content, tmp_path):
    content[checkpoint.KEY]["model"]["tokenizer"]["name"] = "fourier"
    checkpoint.write(content, tmp_path / "best.ckpt")
    with pytest.raises(ValueError, match="unknown tokenizer 'fourier'"):
        gaigs.load(tmp_path / "best.ckpt")


@pytest.mark.parametrize("version", [3, 10])
def test_a_later_version_is_refused(content, tmp_path, version):
    content[checkpoint.KEY]["version"] = version
    checkpoint.write(content, tmp_path / "best.ckpt")
    with pytest.raises(ValueError, match=rf"best\.ckpt must be of version 2 or earlier, got {version}; update gaigs"):
        gaigs.load(tmp_path / "best.ckpt")


def test_a_scene_of_a_later_version_is_refused(content, tmp_path):
    content[checkpoint.KEY]["scene"]["version"] = 9
    checkpoint.write(content, tmp_path / "best.ckpt")
    with pytest.raises(ValueError, match="a scene must be of version 1 or earlier, got 9; update gaigs"):
        gaigs.load(tmp_path / "best.ckpt")


def change(content, *place):
    """The mapping or tensor at a place of a checkpoint's content."""
    for key in place:
        content = content[key]
    return content


MODEL, SCENE, WEIGHTS = (checkpoint.KEY, "model"), (checkpoint.KEY, "scene"), ("state_dict",)
MEANS = "model.gaussians.means"
DEFECTS = {
    "no weights": (lambda content: content.pop("state_dict"), "lacks state_dict"),
    "no model": (lambda content: change(content, checkpoint.KEY).pop("model"), "lacks model"),
    "neither model nor scene": (
        lambda content: content.update({checkpoint.KEY: {"version": 2, "scene": 3}}),
        "lacks model, scene",
    ),
    "a version that is none": (
        lambda content: change(content, checkpoint.KEY).update(version="2"),
        "be of a version from 0 to 2, got '2'",
    ),
    "no receivers": (lambda content: change(content, *SCENE).pop("receivers"), "KeyError: 'receivers'"),
    "a receiver without a place": (
        lambda content: change(content, *SCENE, "receivers", 0).pop("position"),
        "KeyError: 'position'",
    ),
    "no name": (lambda content: change(content, *MODEL).pop("name"), "needs the key 'name'"),
    "a weight too few": (lambda content: change(content, *WEIGHTS).pop(MEANS), "Missing key.*gaussians.means"),
    "a weight that is a word": (lambda content: change(content, *WEIGHTS).update({MEANS: "means"}), "means"),
    "NaN": (
        lambda content: change(content, *WEIGHTS, MEANS)[3].fill_(torch.nan),
        "weights gaussians.means must be finite",
    ),
    "infinity": (
        lambda content: change(content, *WEIGHTS, "model.gaussians.signal")[0].fill_(-torch.inf),
        "weights gaussians.signal must be finite",
    ),
    "a box of NaN": (lambda content: change(content, *SCENE, "lower").fill_(torch.nan), "scene lower must be finite"),
    "a billion Gaussians in the options": (
        lambda content: change(content, *MODEL, "gaussians").update(count=10**9),
        "asks for more than .* bytes",
    ),
    "a billion Gaussians in a shape": (
        lambda content: change(content, *WEIGHTS).update({MEANS: torch.zeros(1, 3).expand(10**9, 3)}),
        "of weights model.gaussians.means it holds less than its shape says",
    ),
    "a billion neurons": (
        lambda content: change(content, *MODEL, "deformation").update(width=10**9),
        "asks for more than .* bytes",
    ),
    "layers without end": (
        lambda content: change(content, *MODEL, "deformation").update(attenuation_layers=10**9),
        "asks for more than .* bytes",
    ),
    "a sparse weight": (
        lambda content: change(content, *WEIGHTS).update({MEANS: torch.zeros(45, 3).to_sparse()}),
        "hold its tensors whole",
    ),
    "a weight of no device": (
        lambda content: change(content, *WEIGHTS).update({MEANS: torch.zeros(45, 3, device="meta")}),
        "hold its tensors whole",
    ),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_file_that_says_what_cannot_be_is_refused_in_one_line(defect, content, tmp_path, monkeypatch):
    spoil, message = DEFECTS[defect]
    monkeypatch.setattr(checkpoint, "ROOM", 2**28)  # a quarter of the bound, so that layers without end end soon
    spoil(content)
    checkpoint.write(content, tmp_path / "best.ckpt")
    with pytest.raises(ValueError, match=rf"best\.ckpt must .*{message}") as error:
        gaigs.load(tmp_path / "best.ckpt")
    assert "\n" not in str(error.value)


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
        OSError, match=r"best\.ckpt could not be written \(No space left on device\); see that"
    ) as error:
        checkpoint.write(content, path)
    assert error.value.errno == errno.ENOSPC
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]


# --- version 0 ---
# Runs of the code before checkpoints had versions, on the built-in rooms; Gaussians and heads were then drawn at
# random, so that every part counts. What they predicted was computed with that code.

OLD = Path(__file__).parent / "checkpoints"
PLACES = [[2.0, 3.0, 1.5], [4.5, 1.0, 1.0], [3.0, 4.0, 0.5]]
SPECTRA = [
    [[0.36173096, 0.01918342, 0.22673881], [0.30776653, 0.02448762, 0.32166761], [0.16608080, 0.00758122, 0.18318915]],
    [[0.35744926, 0.01934322, 0.22847906], [0.30408016, 0.02477377, 0.32428062], [0.16415791, 0.00728209, 0.18465294]],
    [[0.36794734, 0.01961070, 0.22789855], [0.31256407, 0.02539572, 0.32379055], [0.16685458, 0.00783554, 0.18453588]],
]
"""At rows 20, 45 and 70 and columns 20, 110 and 200, for each place."""
LEVELS = {
    "west": [-47.52437973, -51.94501495, -50.48336792],
    "south": [-56.44497681, -56.61431122, -63.58337784],
    "east": [-68.23526764, -55.13262939, -66.97018433],
    "north": [-50.21317291, -50.91043472, -50.12911987],
}
"""RSSI at each gateway, for each place [dBm]."""


@pytest.fixture(params=["torch", "opencl"])
def rasterizer(request):
    """Each of the two, where it can be had."""
    try:
        registry("rasterizer").build({"name": request.param})
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    return request.param


def load_old(name, rasterizer, folder):
    """A model of version 0, whose rasterizer was the fastest one."""
    content = torch.load(OLD / name, weights_only=True)
    content["gaigs"]["model"]["rasterizer"]["name"] = rasterizer
    torch.save(content, folder / name)
    return gaigs.load(folder / name)


def test_spectra_of_version_0_are_predicted_as_they_were(tmp_path, rasterizer):
    model = load_old("version_0_spectrum.ckpt", rasterizer, tmp_path)
    assert not model.training
    assert model.scene.task.name == "spectrum"
    assert model.scene.task.normalisation == "min-max of each spectrum's amplitude"
    spectra = model.predict(PLACES)
    assert spectra.shape == (3, 90, 360)
    torch.testing.assert_close(spectra[:, 20::25, 20:270:90], torch.tensor(SPECTRA), rtol=0, atol=1e-5)


def test_rssi_of_version_0_is_predicted_as_it_was(tmp_path, rasterizer):
    model = load_old("version_0_rssi.ckpt", rasterizer, tmp_path)
    assert model.scene.task.name == "rssi"
    levels = torch.stack([model.predict(PLACES, receiver=name) for name in LEVELS])
    torch.testing.assert_close(levels, torch.tensor([*LEVELS.values()]), rtol=0, atol=1e-4)


@pytest.mark.parametrize("file", sorted(OLD.iterdir()), ids=lambda file: file.stem)
def test_version_0_loads_as_it_is(file):
    assert gaigs.load(file).predict(PLACES).isfinite().all()
    assert file.stat().st_size < 100_000
    assert "version" not in torch.load(file, weights_only=True)["gaigs"]
