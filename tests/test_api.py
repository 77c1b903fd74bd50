"""The library: public names, their examples, and equality with the command line."""

import contextlib
import doctest
import inspect
import pickle
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

import gaigs
from gaigs import configuration
from gaigs.algebra import Algebra
from gaigs.core.propagation import bartlett
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.model.kriging import Kriging
from gaigs.model.mirrored import MirroredSplatting
from gaigs.registry import check_instance, configuration_of
from gaigs.splatting.projection import project
from gaigs.splatting.tokenizer.euclidean import EuclideanTokenizer

pytestmark = pytest.mark.usefixtures("unchecked")

OTHERS = [Algebra, GaussianSplatting, Model.predict, Model.save, project, bartlett]
"""Documented for notebooks beside the names of the package."""

PUBLIC = [name for name in gaigs.__all__ if name != "__version__"]


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gaigs.runs.radio_map", Mock())
        options = ScalarOptions(neighbours=4, iterations=2)
        patch.setattr("gaigs.kriging.scalar.ScalarProcess.options", options)
        yield


@pytest.fixture(scope="module")
def spectra():
    return gaigs.links("synthetic", transmitters=20, order=0)


@pytest.mark.parametrize(
    "thing", [*PUBLIC, *OTHERS], ids=lambda thing: getattr(thing, "__qualname__", thing)
)
def test_the_example_runs(thing, tmp_path, monkeypatch):
    documented = getattr(gaigs, thing) if isinstance(thing, str) else thing
    text = inspect.getdoc(type(documented["task"]) if thing == "registries" else documented)
    names = {"gaigs": gaigs, "torch": torch, "__name__": "example"}
    examples = doctest.DocTestParser().get_doctest(text, names, str(thing), None, None)
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


def test_the_package_is_quick_to_import():
    """The command line's help and errors wait for this import."""
    code = (
        "import sys, gaigs, gaigs.__main__; print(*{'torch', 'lightning', 'scipy', 'matplotlib'} & "
        "{*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


# --- the same as the command line ---

FEW = {"max_steps": 2, "val_check_interval": 1, "enable_progress_bar": False, "accelerator": "cpu"}
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
    assert {k: here[k] for k in here.keys() - chosen_by_data} == {
        k: there[k] for k in there.keys() - chosen_by_data
    }


def test_scores_print_in_a_notebook_as_in_a_terminal(monkeypatch):
    links = gaigs.links("synthetic_rssi", transmitters=20, order=0)
    result = gaigs.evaluate(gaigs.train("mean", links), links, baselines=[])
    plain = str(result)
    assert "MAE" in plain
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert str(result) == plain


@pytest.mark.parametrize(
    ("experiment", "small"),
    [
        ("spectrum", {"gaussians.count": 20}),
        ("mirrored_rssi", {"placement.planes": 6, "placement.order": 0}),
    ],
)
def test_training_gives_the_command_lines_numbers(experiment, small, tmp_path):
    model, data = PRESETS[experiment]
    words = (f"+experiment={experiment}", *WORDS, "data.transmitters=30", "data.order=1")
    # Those of spectra are quick, and show that both have the task's by default.
    few = {} if experiment == "spectrum" else {"baselines": ["mean", "knn"]}
    metrics = gaigs.run(gaigs.compose(*words, **small, **few), tmp_path / "run")
    links = gaigs.links(data, transmitters=30, order=1)
    state = torch.get_rng_state()
    trained = gaigs.train(model, links, **FEW, **small, folder=tmp_path / "train")
    assert gaigs.evaluate(trained, links, **few).models == metrics["models"]
    assert torch.equal(torch.get_rng_state(), state), (
        "the caller's random numbers are left as they were"
    )
    assert {path.name for path in (tmp_path / "train").iterdir()} == {
        "config.yaml", "software.json", "best.ckpt", "last.ckpt", "log"
    }  # fmt: skip
    places = links.query[links.split.test[:3]]
    assert torch.equal(
        gaigs.load(tmp_path / "run/best.ckpt").predict(places), trained.predict(places)
    )
    trained.save(tmp_path / "saved.ckpt")
    assert torch.equal(gaigs.load(tmp_path / "saved.ckpt").predict(places), trained.predict(places))


def test_threads_hold_while_it_trains_and_no_longer(spectra, tmp_path, monkeypatch):
    seen, before = [], torch.get_num_threads()
    config = gaigs.compose("model=mean", "data.transmitters=20", "data.order=0", threads=2)
    monkeypatch.setattr(
        "gaigs.model.mean.Mean.fit",
        lambda self, links: seen.append(torch.get_num_threads()) or 1 / 0,
    )
    with pytest.raises(ZeroDivisionError):
        gaigs.train("mean", spectra, threads=2)
    with pytest.raises(ZeroDivisionError):
        gaigs.run(config, tmp_path)
    assert seen == [2, 2]
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_stepz": 3}, r"there is no option 'max_stepz' \(did you mean 'max_steps'\?\)"),
        (
            {"trainer.max_stepz": 3},
            r"trainer has no key 'max_stepz' \(did you mean 'max_steps'\?\)",
        ),
        (
            {"width": 3},
            "width is an option of several parts; say which: deformation.width, "
            "tokenizer.euclidean.width",
        ),
        ({"tokenizer": "gaa"}, r"there is no tokenizer 'gaa' \(did you mean 'ga'\?\)"),
        (
            {"tokenizer": 3},
            "tokenizer must be a name, a mapping with a name and options, or a component, got 3",
        ),
        (
            {"save_every": torch.nn.GELU()},
            "save_every must be a number, a text, a list or a registered component",
        ),
        ({"transmitters": 3}, "transmitters is an option of data, which gaigs.links reads"),
        ({"seed": -1}, "seed must be in 0..4294967295, got -1"),
        ({"model": "nerf2_"}, "there is no model 'nerf2_'"),
        (
            {"split": None},
            "split must be a name, a mapping with a name and options, or a component, got None",
        ),
        ({"trainer.max_steps.x": 3}, r"trainer.max_steps has no key 'x'; it has: none"),
    ],
)
def test_a_wrong_option_is_named(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        gaigs.compose(**options)


def test_options_are_found_by_name_and_parts_are_chosen():
    config = gaigs.compose(
        "+experiment=rssi", count=7, tokenizer={"name": "ga", "anchors": 3}, blocks=np.int64(2)
    )
    assert config["model"]["gaussians"]["count"] == config["gaussians"]["count"] == 7
    assert config["model"]["tokenizer"]["anchors"] == 3
    assert config["tokenizer"]["blocks"] == 2
    links = gaigs.links("synthetic_rssi", transmitters=20)
    tokenizer = EuclideanTokenizer(links.scene, width=16)
    assert gaigs.compose(tokenizer=tokenizer)["model"]["tokenizer"] == configuration_of(tokenizer)
    config = gaigs.compose(
        "model=knn", k=5, baselines=["mean", {"name": "knn", "k": 3}], **{"+trainer.min_steps": 2}
    )
    assert config["model"]["k"] == 5
    assert config["baselines"] == [{"name": "mean"}, {"name": "knn", "k": 3}]
    assert config["trainer"]["min_steps"] == 2
    assert gaigs.compose(gaussians=None, density=None)["model"]["gaussians"] is None
    assert gaigs.compose(**{"training.jitter": np.float64(0.5)})["training"]["jitter"] == 0.5
    assert gaigs.links(
        "synthetic_rssi", transmitters=20, split={"name": "random", "seed": 4}
    ).split.name.endswith("4")
    with pytest.raises(
        ValueError, match=r"seed is an option of several parts; say which: data.seed, split.seed"
    ):
        gaigs.links("synthetic_rssi", seed=4)


def test_it_composes_inside_another_program_of_hydra(tmp_path):
    (tmp_path / "own.yaml").write_text("a: 1")
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        assert gaigs.compose("model=knn", k=5)["model"]["k"] == 5
        assert compose("own") == {"a": 1}


PLACES = np.random.default_rng(0).uniform(0, 4, (12, 3))
GATEWAYS = [[0.0, 0.0, 2.0], [4.0, 4.0, 2.0]]


# --- parts ---


@pytest.mark.parametrize("reader", ["synthetic", "synthetic_rssi", "synthetic_csi"])
def test_a_model_of_parts_is_trained_and_its_checkpoint_loads(reader, tmp_path):
    links = gaigs.links(reader, transmitters=20, order=0)
    parts = {
        "tokenizer": EuclideanTokenizer(links.scene, width=8),
        "rasterizer": "torch",
        "gaussians": {"count": 10},
    }
    model = gaigs.train(GaussianSplatting(links.scene, **parts), links, **FEW)
    model.save(tmp_path / "model.ckpt")
    again = gaigs.load(tmp_path / "model.ckpt")
    places = links.query[:3]
    assert torch.equal(again.predict(places), model.predict(places))
    assert configuration_of(again) == configuration_of(model)
    assert configuration_of(model)["tokenizer"]["width"] == 8


@pytest.mark.parametrize(
    ("words", "options", "message"),
    [
        (["data=synthetic_csi"], {}, "train takes no options of data and split"),
        ([], {"split.seed": 4}, "train takes no options of data and split"),
        ([], {"tokenizer": "ga"}, "train takes no options of a model that is made already"),
        (["+experiment=mirrored"], {}, r"leave out \+experiment=mirrored"),
    ],
)
def test_options_of_links_and_models_made_already_are_refused(words, options, message, spectra):
    with pytest.raises(ValueError, match=message):
        gaigs.train(GaussianSplatting(spectra.scene), spectra, *words, **options)


def test_arguments_of_another_type_are_refused(spectra, tmp_path):
    for function in (gaigs.train, gaigs.evaluate):
        for arguments in ((3, spectra), ("mean", "synthetic")):
            with pytest.raises(TypeError):
                function(*arguments)
    with pytest.raises(TypeError):
        gaigs.run("config.yaml", tmp_path)
    with pytest.raises(
        ValueError, match="baselines must be names or model configurations with a name, got 3"
    ):
        gaigs.evaluate(gaigs.train("mean", spectra), spectra, baselines=[3])
    model = gaigs.train("mean", spectra)
    with pytest.raises(TypeError, match=r"model must be a gaigs\.Model, got 'room'"):
        check_instance("model", "room", gaigs.Model)  # annotations are checked in tests alone
    untested = replace(spectra, split=replace(spectra.split, test=spectra.split.test[:0]))
    with pytest.raises(ValueError, match="links must have some to test on"):
        gaigs.evaluate(model, untested)


@contextlib.contextmanager
def double_precision():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    assert torch.get_default_dtype() == torch.float64
    torch.set_default_dtype(before)


def numbers(path):
    """Predictions of a model of the built-in room, and of one of arrays, which are tensors of the
    caller's mode.
    """
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    model = gaigs.train(
        "gaigs", links, max_steps=2, count=20, tokenizer="ga", enable_progress_bar=False
    )
    model.save(path)
    values = [gaigs.load(path).predict(PLACES), *model.predict(PLACES, interval=0.5)[:4]]
    places = torch.tensor([[float(k), k % 3, 1.0] for k in range(20)], dtype=torch.float32)
    array = gaigs.Receiver("door", gaigs.Pose.from_xyzw([0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]))
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=array, labels=-40 - places[:, 0]
    )
    few = {"placement.planes": 6, "placement.order": 0}
    model = gaigs.train("mirrored", links, max_steps=2, enable_progress_bar=False, **few)
    return [*values, model.predict(PLACES), array.array.elements, gaigs.Grid.degrees().elevations]


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    return numbers(tmp_path_factory.mktemp("usual") / "room.ckpt")


@pytest.mark.parametrize("mode", [double_precision, torch.inference_mode])
def test_numbers_are_the_same_in_any_mode_of_torch(mode, usual, tmp_path):
    with mode():
        found = numbers(tmp_path / "room.ckpt")
        assert torch.is_inference_mode_enabled() == (mode is torch.inference_mode)
    for value, true in zip(found, usual, strict=True):
        assert value.dtype == true.dtype == torch.float32
        assert torch.equal(value, true)


def test_links_are_made_in_several_threads_at_once():
    """In any default dtype, which is that of all threads."""
    start, found = threading.Barrier(6), []

    def make(_):
        start.wait()
        return gaigs.links("synthetic_rssi", transmitters=20, split="random").split.test

    with double_precision(), ThreadPoolExecutor(6) as pool:
        found = [*pool.map(make, range(6))]
    assert all(torch.equal(test, found[0]) for test in found)


def test_public_functions_go_to_other_processes_and_warn_at_the_line_that_calls_them():
    functions = [
        value for value in (getattr(gaigs, name) for name in PUBLIC) if inspect.isfunction(value)
    ]
    assert all(pickle.loads(pickle.dumps(function)) is function for function in functions)
    # Checks of annotations add frames, so the line is that of a program without them.
    program = (
        "import gaigs\n"
        "model = gaigs.train('mean', gaigs.links('synthetic_rssi', transmitters=20))\n"
        "gaigs.radio_map(model, pitch=1.0, height=500.0)\n"
    )
    written = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stderr
    assert "<string>:3: ExtrapolationWarning" in written


def test_test_links_that_a_model_has_learnt_from_are_told(spectra, tmp_path, caplog):
    gaigs.train("gaigs", spectra, max_steps=1, count=20, enable_progress_bar=False).save(
        tmp_path / "model.ckpt"
    )
    look_up = gaigs.train("knn", spectra)
    for model in (gaigs.load(tmp_path / "model.ckpt"), look_up):
        gaigs.evaluate(model, spectra, baselines=[])
        assert "learnt" not in caplog.text
        other = gaigs.links(
            "synthetic", transmitters=20, order=0, **{"split.seed": 5}, split="random"
        )
        gaigs.evaluate(model, other, baselines=[])
        assert re.search(
            r"has learnt from the places of \d of 4 test links\ntake links of the split",
            caplog.text,
        )
        caplog.clear()
    model = gaigs.load(tmp_path / "model.ckpt")
    gaigs.train(model, other, max_steps=1, enable_progress_bar=False)
    gaigs.evaluate(model, other, baselines=[])
    assert "has learnt from the places of" in caplog.text, "a second training forgets nothing"


def test_a_kriged_model_is_trained_on_and_stays_as_it_is(spectra):
    options = {"max_steps": 1, "enable_progress_bar": False}
    model = gaigs.train("gaigs", spectra, "kriging=true", count=20, **options)
    before = model.predict([1.0, 2.0, 1.5])
    again = gaigs.train(model, spectra, "kriging=true", **options)
    assert torch.equal(model.predict([1.0, 2.0, 1.5]), before)
    assert isinstance(again, Kriging)
    assert not torch.equal(again.predict([1.0, 2.0, 1.5]), before)


def test_mirrored_gaussians_have_parts_that_suit_them():
    for reader in ("synthetic", "synthetic_rssi", "synthetic_csi"):
        links = gaigs.links(reader, transmitters=20, order=0)
        built = configuration_of(MirroredSplatting(links.scene))
        preset = gaigs.compose(*configuration.preset("mirrored", links.task.name))["model"]
        assert preset["pooling"]["name"] == MirroredSplatting.own_pooling(links.scene)
        assert [preset[kind]["name"] for kind in ("placement", "deformation")] == [
            built[kind] for kind in ("placement", "deformation")
        ]
        assert preset["projection"] is preset["rasterizer"] is None


def test_models_that_cannot_be_stored_are_refused(spectra, tmp_path):
    with pytest.raises(ValueError, match="model 'knn' has no links to save; fit it first"):
        gaigs.registries["model"].build("knn", scene=spectra.scene).save(tmp_path / "knn.ckpt")
    with pytest.raises(
        ValueError, match="model 'Model' has no state: keep what it learns in buffers"
    ):
        Model(spectra.scene).save(tmp_path / "stateless.ckpt")

    class Own(EuclideanTokenizer):
        pass

    model = GaussianSplatting(spectra.scene, tokenizer=Own(spectra.scene))
    with pytest.raises(
        ValueError,
        match=r"gaigs, tokenizer must be .* a registered component to be stored, got Own",
    ):
        model.save(tmp_path / "own.ckpt")
    assert not list(tmp_path.iterdir())


def test_the_page_on_python_runs(tmp_path, monkeypatch, capsys):
    """Its blocks one after the other, as in a notebook, with few steps."""
    page = (Path(__file__).parents[1] / "docs/python.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S)
    missing = {name for name in ("pandas", "sklearn") if find_spec(name) is None} | {"sionna"}
    taken = [block for block in blocks if not missing & {*re.findall(r"\w+", block)}]
    rows = [f"{k % 6},{k // 6},ap{k % 2},{-40 - k % 7 - k // 8}" for k in range(48)]
    (tmp_path / "survey.csv").write_text("\n".join(("x,y,bssid,rssi", *rows)))
    code = "\n".join(taken)
    code = re.sub(r"max_steps=\d+", "max_steps=1", code)
    code = code.replace("max_steps=1, seed=0", 'max_steps=1, seed=0, **{"placement.order": 0}')
    code = re.sub(
        r'links\("synthetic"(, transmitters=100)?\)',
        'links("synthetic", transmitters=20, order=0)',
        code,
    )
    code = re.sub(
        r'(links\("synthetic_rssi"), transmitters=\d+', r"\1, transmitters=40, order=0", code
    )
    code = code.replace("pitch=0.5", "pitch=2.0").replace("n_estimators=20", "n_estimators=2")
    code = code.replace("gaigs.radio_map(model)", "gaigs.radio_map(model, pitch=1.0)")
    code = code.replace('["path_loss", "knn", "mirrored"]', '["path_loss", "knn"]')
    code = re.sub(
        r'links\(\s+"synthetic"\s+\)', 'links("synthetic", transmitters=20, order=0)', code
    )
    code = code.replace("[6, 4, 2], (100, 3)", "[6, 4, 2], (40, 3)")
    code = code.replace("range(80, 100)", "range(30, 40)").replace("cv=3", "cv=2")
    code = code.replace("train(links, max_steps=1)", "train('gaigs', links, max_steps=1)")
    code = code.replace(
        '"+experiment=spectrum"', '"+experiment=spectrum", "data.transmitters=30", "data.order=0"'
    )
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, "docs/python.md", "exec"), names)
    assert names["means"].grad.shape == (2, 3)
    assert "gaigs" in names["metrics"]["models"]
    assert names["channel_links"].task.shape == (4, 8)
    written = {path.name for path in tmp_path.iterdir()}
    assert written - {"floor.npz"} == {"survey.csv", "room.ckpt", "parts.ckpt", "floor.pdf", "runs"}


def test_links_of_other_receivers_are_not_scored():
    arrays = {"task": "rssi", "transmitters": PLACES, "labels": np.zeros((12, 2)) - 50}
    model = gaigs.train("mean", gaigs.links(**arrays, receivers=GATEWAYS))
    with pytest.raises(ValueError, match="links must have the model's receivers in the same order"):
        gaigs.evaluate(model, gaigs.links(**arrays, receivers=GATEWAYS[::-1]))


def test_a_class_of_a_notebook_is_trained_by_its_name(spectra):
    @gaigs.register("loss", "notebook")
    class Notebook:
        def __init__(self, task, power: float = 2.0):
            self.power = power

        def __call__(self, values, batch):
            loss = (values - batch.labels).abs().pow(self.power).mean()
            return loss, {"notebook": loss}

    assert gaigs.compose(loss="notebook")["loss"] == {"name": "notebook", "power": 2.0}
    gaigs.train("gaigs", spectra, loss={"name": "notebook", "power": 1.5}, count=5, **FEW)


def test_a_given_part_is_trained_itself_not_a_copy(spectra):
    tokenizer = EuclideanTokenizer(spectra.scene, width=8)
    model = gaigs.train("gaigs", spectra, tokenizer=tokenizer, count=5, **FEW)
    assert model.tokenizer is tokenizer
    modes = []
    tokenizer.register_forward_hook(lambda module, *_: modes.append(module.training))
    gaigs.train(model, spectra, **FEW)
    assert modes[0], "trained once more, it is in training mode"


def test_the_citations_have_the_version_of_the_package():
    root = Path(__file__).parents[1]
    cited = re.findall(r"^version: (.+)$", (root / "CITATION.cff").read_text(), re.M)
    cited += re.findall(r"version = \{(.+)\}", (root / "README.md").read_text())
    assert cited == [gaigs.__version__] * 2
