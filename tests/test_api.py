"""The library: public names, their examples, and that it does what the command line does."""

import doctest
import functools
import inspect
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

import gaigs
from gaigs import configuration
from gaigs.algebra import Algebra
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.model.mirrored import Mirrored
from gaigs.projection import project
from gaigs.propagation import bartlett
from gaigs.registry import configuration_of
from gaigs.tokenizer.euclidean import EuclideanTokenizer

OTHERS = [Algebra, GaussianSplatting, Model.predict, Model.save, project, bartlett]
"""Documented for notebooks beside the names of the package."""

PUBLIC = [name for name in gaigs.__all__ if name != "__version__"]


@pytest.mark.parametrize("thing", [*PUBLIC, *OTHERS], ids=lambda thing: getattr(thing, "__qualname__", thing))
def test_the_example_runs(thing, tmp_path, monkeypatch):
    documented = getattr(gaigs, thing) if isinstance(thing, str) else thing
    text = inspect.getdoc(type(documented["task"]) if thing == "registries" else documented)
    examples = doctest.DocTestParser().get_doctest(text, {"gaigs": gaigs, "torch": torch}, str(thing), None, None)
    assert examples.examples, f"{thing} has no example"
    monkeypatch.chdir(tmp_path)
    said = []
    with torch.random.fork_rng():
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(
            examples, out=said.append
        )
    assert not said, "".join(said)


def test_the_names_are_those_of_the_package():
    assert {*gaigs.__all__} <= {*dir(gaigs)}
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        _ = gaigs.trian


def test_packages_stay_packages():
    """A public name may hide no module."""
    import gaigs.data
    import gaigs.split

    for name in PUBLIC:
        getattr(gaigs, name)
        assert not inspect.ismodule(getattr(gaigs, name)), name
    assert inspect.ismodule(gaigs.data)
    assert inspect.ismodule(gaigs.split)


def test_the_package_is_quick_to_import():
    """It and what composes configurations, which the command line's help and its errors wait for."""
    code = "import sys, gaigs, gaigs.__main__; print(*{'torch', 'lightning', 'scipy', 'matplotlib'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


# --- the same as the command line ---

FEW = {"max_steps": 4, "val_check_interval": 2, "enable_progress_bar": False, "accelerator": "cpu"}
WORDS = [f"trainer.{key}={value}".lower() for key, value in FEW.items()]
PRESETS = {
    "spectrum": ("gaigs", "synthetic"),
    "rssi": ("gaigs", "synthetic_rssi"),
    "csi": ("gaigs", "synthetic_csi"),
    "mirrored": ("mirrored", "synthetic"),
    "mirrored_rssi": ("mirrored", "synthetic_rssi"),
    "mirrored_csi": ("mirrored", "synthetic_csi"),
}


@pytest.mark.parametrize("experiment", PRESETS)
def test_a_model_is_trained_by_the_preset_of_its_experiment(experiment):
    model, data = PRESETS[experiment]
    there = gaigs.compose(f"+experiment={experiment}")
    assert there["data"]["name"] == data
    here = gaigs.compose(*configuration.preset(model, there["task"]["name"]))
    chosen_by_data = {"data", "split"}
    assert {k: here[k] for k in here.keys() - chosen_by_data} == {k: there[k] for k in there.keys() - chosen_by_data}


@pytest.mark.parametrize("experiment", ["spectrum", "mirrored_rssi"])
def test_training_gives_the_command_lines_numbers(experiment, tmp_path):
    model, data = PRESETS[experiment]
    options = {"transmitters": 40, "order": 1}
    metrics = gaigs.run(
        gaigs.compose(f"+experiment={experiment}", *WORDS, *(f"data.{key}={value}" for key, value in options.items())),
        tmp_path / "run",
    )
    links = gaigs.links(data, **options)
    state = torch.get_rng_state()
    trained = gaigs.train(model, links, **FEW, folder=tmp_path / "train")
    assert gaigs.evaluate(trained, links).models == metrics["models"]
    assert torch.equal(torch.get_rng_state(), state), "the caller's random numbers are left as they were"
    assert {path.name for path in (tmp_path / "train").iterdir()} == {
        "config.yaml", "software.json", "best.ckpt", "last.ckpt", "log"
    }  # fmt: skip
    places = links.query[links.split.test[:3]]
    assert torch.equal(gaigs.load(tmp_path / "run/best.ckpt").predict(places), trained.predict(places))
    trained.save(tmp_path / "saved.ckpt")
    assert torch.equal(gaigs.load(tmp_path / "saved.ckpt").predict(places), trained.predict(places))


def test_threads_hold_while_it_trains_and_no_longer(tmp_path, monkeypatch):
    seen, before = [], torch.get_num_threads()
    config = gaigs.compose("model=mean", "data.transmitters=20", "data.order=0", threads=2)
    monkeypatch.setattr("gaigs.model.mean.Mean.fit", lambda self, links: seen.append(torch.get_num_threads()) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0), threads=2)
    with pytest.raises(ZeroDivisionError):
        gaigs.run(config, tmp_path)
    assert seen == [2, 2]
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_stepz": 3}, r"there is no option 'max_stepz' \(did you mean 'max_steps'\?\)"),
        ({"trainer.max_stepz": 3}, r"trainer has no key 'max_stepz' \(did you mean 'max_steps'\?\)"),
        ({"width": 3}, "width is an option of several parts; say which: deformation.width, tokenizer.euclidean.width"),
        ({"tokenizer": "gaa"}, r"there is no tokenizer 'gaa' \(did you mean 'ga'\?\)"),
        ({"tokenizer": 3}, "tokenizer must be a name, a mapping with a name and options, or a component, got 3"),
        ({"save_every": torch.nn.GELU()}, "save_every must be a number, a text, a list or a registered component"),
        ({"transmitters": 3}, "transmitters is an option of data, which gaigs.links reads"),
        ({"seed": -1}, "seed must be in 0..4294967295, got -1"),
        ({"model": "nerf2_"}, "there is no model 'nerf2_'"),
    ],
)
def test_a_wrong_option_is_named(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        gaigs.compose(**options)


def test_options_are_found_by_name_and_parts_are_chosen():
    config = gaigs.compose("+experiment=rssi", count=7, tokenizer={"name": "ga", "anchors": 3}, blocks=np.int64(2))
    assert config["model"]["gaussians"]["count"] == config["gaussians"]["count"] == 7
    assert config["model"]["tokenizer"]["anchors"] == 3
    assert config["tokenizer"]["blocks"] == 2
    links = gaigs.links("synthetic_rssi", transmitters=20)
    tokenizer = EuclideanTokenizer(links.scene, width=16)
    assert gaigs.compose(tokenizer=tokenizer)["model"]["tokenizer"] == configuration_of(tokenizer)
    assert gaigs.compose("model=knn", k=5)["model"]["k"] == 5
    assert gaigs.compose(gaussians=None, density=None)["model"]["gaussians"] is None
    assert gaigs.compose(**{"training.jitter": np.float64(0.5)})["training"]["jitter"] == 0.5
    assert gaigs.links("synthetic_rssi", transmitters=20, split={"name": "random", "seed": 4}).split.name.endswith("4")
    with pytest.raises(ValueError, match=r"seed is an option of data and split; say which: data.seed, split.seed"):
        gaigs.links("synthetic_rssi", seed=4)


def test_it_composes_inside_another_program_of_hydra(tmp_path):
    (tmp_path / "own.yaml").write_text("a: 1")
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        assert gaigs.compose("model=knn", k=5)["model"]["k"] == 5
        assert compose("own") == {"a": 1}


# --- arrays in memory ---

PLACES = np.random.default_rng(0).uniform(0, 4, (12, 3))
GATEWAYS = [[0.0, 0.0, 2.0], [4.0, 4.0, 2.0]]


def test_readings_of_all_gateways_become_links():
    readings = np.arange(24.0).reshape(12, 2) - 90
    readings[3, 1] = np.nan
    links = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=readings, frequency=2.4e9)
    assert len(links) == 23
    heard = ~np.isnan(readings.ravel())
    assert torch.equal(links.labels, torch.tensor(readings.ravel()[heard], dtype=torch.float32))
    assert torch.equal(links.query.receivers, torch.arange(2).repeat(12)[torch.tensor(heard)])
    assert torch.equal(links.rows, torch.arange(12).repeat_interleave(2)[torch.tensor(heard)])
    long = gaigs.links(
        task="rssi", transmitters=PLACES.repeat(2, 0), receivers=GATEWAYS, labels=readings.ravel(), index=[0, 1] * 12
    )
    assert torch.equal(long.rows, links.rows), "links of one place are never parted"
    assert links.query.frequencies.unique().tolist() == [2.4e9]
    assert "1 links were not heard" in links.remarks


def test_each_link_has_a_receiver_of_its_own():
    index = torch.arange(12) % 2
    given = gaigs.links(task="rssi", transmitters=PLACES, receivers=GATEWAYS, labels=np.zeros(12) - 50, index=index)
    stands = np.array(GATEWAYS)[index.numpy()]
    placed = gaigs.links(task="rssi", transmitters=PLACES, receivers=stands, labels=np.zeros(12) - 50)
    assert torch.equal(given.query.receivers, placed.query.receivers)
    assert len(placed.receivers) == 2
    alone = gaigs.links(task="rssi", transmitters=PLACES, receivers=[0, 0, 2], labels=np.zeros(12) - 50, test=0.5)
    assert len(alone.receivers) == 1
    assert len(alone.split.test) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": np.zeros((12, 3))}, r"labels of task 'rssi' must be \(12,\) .* or \(12, 2\).*, got \(12, 3\)"),
        ({"labels": np.zeros((12, 2)) + np.inf}, "labels must be finite where something was heard"),
        ({"labels": np.zeros(12), "index": [5] * 12}, "index must be 12 whole numbers from 0 to 1"),
        ({"transmitters": PLACES[:, :2]}, r"transmitters must be \(..., 3\) positions \[m\], got shape \(12, 2\)"),
        ({"transmitters": PLACES * np.nan}, "transmitters must be finite"),
        ({"frequency": 2.4}, "frequency must be a carrier in Hz, from 10000 to 3e.11, got 2.4; in GHz?"),
        ({"tset": 0.5}, r"there is no option 'tset' \(did you mean 'test'\?\) of split 'random'"),
        ({"task": "rsi"}, r"unknown task 'rsi' \(did you mean 'rssi'\?\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes, message):
    arrays = {"task": "rssi", "transmitters": PLACES, "receivers": GATEWAYS, "labels": np.zeros((12, 2)) - 50}
    with pytest.raises(ValueError, match=message):
        gaigs.links(**(arrays | changes))


# --- parts ---


@pytest.mark.parametrize("reader", ["synthetic", "synthetic_rssi", "synthetic_csi"])
def test_a_model_of_parts_is_trained_and_its_checkpoint_loads(reader, tmp_path):
    links = gaigs.links(reader, transmitters=30)
    parts = {"tokenizer": EuclideanTokenizer(links.scene, width=8), "rasterizer": "torch", "gaussians": {"count": 10}}
    model = gaigs.train(GaussianSplatting(links.scene, **parts), links, **FEW)
    model.save(tmp_path / "model.ckpt")
    again = gaigs.load(tmp_path / "model.ckpt")
    places = links.query[:3]
    assert torch.equal(again.predict(places), model.predict(places))
    assert configuration_of(again) == configuration_of(model)
    assert configuration_of(model)["tokenizer"]["width"] == 8


def test_an_object_is_trained_itself_and_no_copy_of_it():
    links = gaigs.links("synthetic", transmitters=20, order=0)
    tokenizer = EuclideanTokenizer(links.scene, width=8)
    model = gaigs.train("gaigs", links, tokenizer=tokenizer, count=5, **FEW)
    assert model.tokenizer is tokenizer
    modes = []
    tokenizer.register_forward_hook(lambda module, *_: modes.append(module.training))
    gaigs.train(model, links, **FEW)
    assert modes[0], "trained once more, it is in training mode"


@pytest.mark.parametrize(
    ("words", "options", "message"),
    [
        (["data=synthetic_csi"], {}, "data and split are the links' own"),
        ([], {"split.seed": 4}, "data and split are the links' own"),
        ([], {"tokenizer": "ga"}, "the model is made already"),
        (["+experiment=mirrored"], {}, r"\+experiment=mirrored must be left out"),
    ],
)
def test_options_of_what_is_made_already_are_refused(words, options, message):
    links = gaigs.links("synthetic", transmitters=20, order=0)
    with pytest.raises(ValueError, match=message):
        gaigs.train(GaussianSplatting(links.scene), links, *words, **options)


def test_a_class_of_a_notebook_is_trained_by_its_name():
    @gaigs.register("loss", "notebook")
    class Notebook:
        def __init__(self, task, power: float = 2.0):
            self.power = power

        def __call__(self, values, batch):
            loss = (values - batch.labels).abs().pow(self.power).mean()
            return loss, {"notebook": loss}

    assert gaigs.compose(loss="notebook")["loss"] == {"name": "notebook", "power": 2.0}
    links = gaigs.links("synthetic", transmitters=20, order=0)
    gaigs.train("gaigs", links, loss={"name": "notebook", "power": 1.5}, count=5, **FEW)


def test_mirrored_gaussians_have_parts_that_suit_them():
    for reader in ("synthetic", "synthetic_rssi", "synthetic_csi"):
        links = gaigs.links(reader, transmitters=20)
        built = configuration_of(Mirrored(links.scene))
        preset = gaigs.compose(*configuration.preset("mirrored", links.task.name))["model"]
        pooling = Mirrored.own_pooling(links.scene)
        assert preset["pooling"]["name"] == (pooling if isinstance(pooling, str) else pooling["name"])
        for kind in ("placement", "deformation", "projection", "rasterizer"):
            assert preset[kind]["name"] == built[kind]


def test_what_cannot_be_stored_says_so(tmp_path):
    links = gaigs.links("synthetic", transmitters=20, order=0)
    with pytest.raises(ValueError, match="model 'knn' has no state that a file could hold"):
        gaigs.train("knn", links).save(tmp_path / "knn.ckpt")

    class Own(EuclideanTokenizer):
        pass

    model = GaussianSplatting(links.scene, tokenizer=Own(links.scene))
    with pytest.raises(ValueError, match=r"gaigs, tokenizer must be .* a registered component to be stored, got Own"):
        model.save(tmp_path / "own.ckpt")
    assert not list(tmp_path.iterdir())


def test_links_of_other_receivers_are_not_scored():
    arrays = {"task": "rssi", "transmitters": PLACES, "labels": np.zeros((12, 2)) - 50}
    model = gaigs.train("mean", gaigs.links(**arrays, receivers=GATEWAYS))
    with pytest.raises(ValueError, match="links must have the model's receivers in the same order"):
        gaigs.evaluate(model, gaigs.links(**arrays, receivers=GATEWAYS[::-1]))


def test_links_without_their_test_or_of_another_task_are_refused():
    links = gaigs.links("synthetic_rssi", transmitters=20)
    model = gaigs.train("mean", links)
    with pytest.raises(ValueError, match="links must have the model's labels, 'rssi'"):
        gaigs.evaluate(model, gaigs.links("synthetic", transmitters=20, order=0))
    with pytest.raises(ValueError, match="links must have a split"):
        gaigs.train("mean", replace(links, split=None))


# --- plain tensors ---


def cloud(n=5, b=None, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.rand(*([b] if b else []), n, *shape, generator=generator, dtype=dtype)
    return {
        "means": draw(3) * 2 + 1, "quats": draw(4) - 0.5, "scales": draw(3) * 0.3 + 0.1, "opacities": draw() * 0.8,
        "signal": draw(2) - 0.5, "attenuations": draw() * 0.5 + 0.5,
    }  # fmt: skip


POSE = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
FINE = gaigs.registries["projection"].build("mercator", pixel=0.1)
"""An object of a pixel of its own."""

COARSE = gaigs.Grid.degrees(elevations=range(5, 90, 10), azimuths=range(0, 360, 20))


@pytest.mark.parametrize("projection", ["mercator", "equirectangular", "direction_cosine"])
def test_a_map_has_right_gradients_to_all_tensors(projection):
    tensors = {name: value.requires_grad_() for name, value in cloud().items()}

    def draw(*values):
        inputs = dict(zip(tensors, values, strict=True))
        return gaigs.rasterize(**inputs, receiver=POSE, grid=COARSE, projection=projection, rasterizer="torch")

    image, left = draw(*tensors.values())
    assert (image.shape, left.shape) == ((2, 9, 18), (9, 18))
    assert torch.autograd.gradcheck(draw, tuple(tensors.values()), atol=1e-5)


@pytest.mark.parametrize(
    "batched", [["signal"], ["means"], ["quats", "scales"], ["means", "opacities", "attenuations"]]
)
def test_a_batch_is_its_maps_one_by_one(batched):
    single, many = cloud(), cloud(b=3)
    inputs = {name: many[name] if name in batched else single[name] for name in single}
    draw = functools.partial(gaigs.rasterize, receiver=POSE, grid=COARSE, rasterizer="torch")
    image, left = draw(**inputs)
    for row in range(3):
        own, passed = draw(**{name: value[row] if name in batched else value for name, value in inputs.items()})
        torch.testing.assert_close(image[row], own)
        torch.testing.assert_close(left[row], passed)


def test_rays_are_pixels_of_the_grid():
    inputs = cloud()
    grid, _ = gaigs.rasterize(**inputs, receiver=POSE, grid=COARSE, projection=FINE, rasterizer="torch")
    rays, left = gaigs.rasterize(**inputs, receiver=POSE, grid=COARSE.flatten(), pixel=0.1, rasterizer="torch")
    assert left.shape == (9 * 18,)
    torch.testing.assert_close(rays, grid.flatten(1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quats": torch.ones(4, 4)}, r"quats must be \(5, 4\) or \('b', 5, 4\), got \(4, 4\)"),
        ({"opacities": torch.ones(5)}, "opacities must be real numbers of means' torch.float64, got torch.float32"),
        ({"signal": torch.ones(2, 5, 1).double(), "means": torch.ones(3, 5, 3).double()}, "one number of transmitters"),
        ({"grid": COARSE.flatten()}, "pixel must be given for rays"),
        ({"grid": gaigs.Grid(torch.arange(1.0, 90.0), torch.arange(360.0))}, "Grid.degrees takes degrees"),
        ({"rasterizer": "aperture"}, "rasterizer 'aperture' draws no map; take fastest, opencl or torch"),
        ({"rasterizer": "torhc"}, r"unknown rasterizer 'torhc' \(did you mean 'torch'\?\)"),
        (
            {"projection": "direction_cosine", "grid": gaigs.Grid.degrees(range(-40, 50, 10))},
            "the grid reaches below the receiver's plane, which direction_cosine folds",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        gaigs.rasterize(**({**cloud(), "receiver": POSE, "grid": COARSE, "rasterizer": "torch"} | changes))


def test_the_beamformer_is_the_sum_over_elements_and_has_a_gradient_in_its_nulls():
    array, wavelength = gaigs.Array.planar(2, 3, pitch=0.1), 299792458.0 / 1e9
    waves = torch.randn(2, 6, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    phases = 2j * torch.pi / wavelength * (array.elements @ COARSE.flatten().vectors().double().T)
    direct = torch.einsum("bnf,nk->bfk", waves, torch.exp(-phases)).abs().square().mean(1).sqrt()
    torch.testing.assert_close(bartlett(waves, COARSE, array, 1e9).flatten(1), direct, atol=1e-7, rtol=1e-6)
    torch.testing.assert_close(bartlett(waves[0], COARSE.flatten(), array, 1e9), direct[0], atol=1e-7, rtol=1e-6)
    silent = torch.zeros(1, 6, 1, dtype=torch.complex128, requires_grad=True)
    bartlett(silent, COARSE, array, 1e9).sum().backward()
    assert torch.equal(silent.grad, torch.zeros_like(silent))
    with pytest.raises(ValueError, match=r"of the array's 6 elements, got \(2, 5, 3\)"):
        bartlett(waves[:, :5], COARSE, array, 1e9)


def test_the_page_on_python_runs(tmp_path, monkeypatch, capsys):
    """Its blocks one after the other, as in a notebook, with few steps."""
    page = (Path(__file__).parents[1] / "docs/python.md").read_text()
    code = "\n".join(re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S))
    code = re.sub(r"max_steps=\d+", "max_steps=2", code)
    code = re.sub(r'links\("synthetic"(, transmitters=100)?\)', 'links("synthetic", transmitters=30, order=0)', code)
    code = code.replace('"+experiment=spectrum"', '"+experiment=spectrum", "data.transmitters=30", "data.order=0"')
    monkeypatch.chdir(tmp_path)
    told = {}
    exec(compile(code, "docs/python.md", "exec"), told)
    assert told["means"].grad.shape == (2, 3)
    assert "gaigs" in told["metrics"]["models"]
    assert told["channel_links"].task.shape == (4, 8)
    assert {path.name for path in tmp_path.iterdir()} == {"room.ckpt", "parts.ckpt", "runs"}
