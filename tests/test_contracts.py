"""Every built-in name of every kind keeps its contract, with the options of its configuration file.

Packages in ``plugins`` have tests of their own, in ``tests/plugins``.
"""

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from contracts.deformation import check_deformation
from contracts.loss import check_loss
from contracts.projection import check_projection
from contracts.rasterizer import check_rasterizer
from contracts.split import check_split
from contracts.tokenizer import check_tokenizer
from contracts.training import check_training
from omegaconf import OmegaConf

import gaigs
from gaigs.data import load, nerf2_spectrum
from gaigs.io import deepmimo
from gaigs.model.gaigs import GaussianSplatting
from gaigs.registry import registry
from gaigs.splatting.pooling.paths import PathPooling
from gaigs.splatting.pooling.softmax_attention import SoftmaxAttention
from gaigs.testing import (
    check_data,
    check_model,
    check_placement,
    check_pooling,
    check_task,
    example_links,
)
from gaigs.testing.pooling import example_paths

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
SMALL = {
    "synthetic": ["data.transmitters=12", "data.order=1"],
    "synthetic_rssi": ["data.transmitters=40", "data.order=1"],
    "synthetic_csi": ["data.transmitters=12", "data.order=1", "data.subcarriers=3"],
    "gaigs": ["gaussians.count=60", "deformation.width=16"],
    **dict.fromkeys(("sionna", "sionna_rssi"), ("data.transmitters=6",)),
    "sionna_csi": ["data.transmitters=6", "data.subcarriers=3"],
    "blocks": ["split.edge=1.0"], "runs": ["split.length=2"], "sparse": ["split.train=7"],
}  # fmt: skip
"""Options that make a component quick to check, or that have no default."""

SIMULATED = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
"""The data set that brings a task."""

MADE_FOR = {
    "loss": {"l1_ssim": ["spectrum"], "relative_error": ["csi"], "log_relative_error": ["csi"]}
    | dict.fromkeys(("absolute", "squared", "huber"), ("spectrum", "rssi")),
    # The last five are made from trained models, a regressor and a map.
    "model": {
        "path_loss": ["rssi"],
        "shaped_path_loss": ["rssi"],
        "friis": ["csi"],
        "kriging": [],
        "ensemble": [],
        "adapted": [],
        "sklearn": [],
        "site": [],
    },
}
"""The tasks of a loss or model that refuses others."""

MIRRORED = ["placement=mirrored", "deformation=none", "~projection", "~rasterizer"]

CARRIER = 5e9
"""Of the links to arrays that are known [Hz]."""


def built_in(kind):
    """The names of a kind that do not come from plug-ins."""
    package = Path(gaigs.__file__).parent
    floors = (package / kind, package / "core" / kind, package / "splatting" / kind)
    (folder,) = (floor for floor in floors if floor.is_dir())
    return [
        name
        for name in registry(kind).names()
        if (folder / f"{name}.py").exists() or (folder / name).is_dir()
    ]


def every(kind):
    return pytest.mark.parametrize("name", built_in(kind))


on_every_device = pytest.mark.parametrize("device", DEVICES)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


composed = functools.cache(gaigs.compose)


def configured(kind, name, *overrides):
    """The configuration of a name: that of the command line, or for built-in parts the name with
    overrides alone.
    """
    overrides = [*SMALL.get(name, []), *overrides]
    if kind in ("model", "training") or name not in built_in(kind):
        return composed(f"{kind}={name}", *overrides)[kind]
    dots = OmegaConf.to_container(OmegaConf.from_dotlist(overrides))
    return {"name": name, **dots.get(kind, {})}


def scenes():
    """A scene, and one whose links have several carriers."""
    scene = example_links("rssi").scene
    return scene, replace(scene, frequencies=torch.tensor([2.4e9, 5.0e9]))


def on_its_tasks(kind):
    """Parametrises over the names of a kind, each with the tasks that it is made for."""
    pairs = [
        (name, task) for name in built_in(kind) for task in MADE_FOR[kind].get(name, SIMULATED)
    ]
    return pytest.mark.parametrize(("name", "task"), pairs)


def poolings_with_tasks():
    """Poolings, each with the tasks whose labels it gives for maps or paths of the right shape."""
    pairs = []
    for name in built_in("pooling"):
        tasks = [task for task in SIMULATED if gives(name, task)]
        assert tasks, f"pooling {name!r} must give labels of a task"
        pairs += [(name, task) for task in tasks]
    return pairs


def gives(name, task):
    """True if a pooling gives labels of a task's shape."""
    links = example_links(task, CARRIER)
    try:
        pooling = registry("pooling").build(configured("pooling", name), scene=links.scene)
    except ValueError:
        return False
    query, grid = links.query[:1], pooling.grid or links.task.directions
    if isinstance(pooling, PathPooling):
        received = example_paths(links.receivers[0], query, torch.float32)
    elif grid is None:
        return False
    else:
        received = torch.ones(1, pooling.channels, *grid.shape)
    return pooling(received, query).shape[1:] == links.task.shape


def unsuitable(kind):
    return [
        (name, task)
        for name, tasks in MADE_FOR[kind].items()
        for task in SIMULATED
        if task not in tasks
    ]


# --- tasks, data and splits ---


@every("task")
def test_task(name):
    config = composed(f"data={SIMULATED[name]}")
    assert config["task"]["name"] == name
    thinnings = [{"stride": 4}, {"rays": 25}] if name == "spectrum" else []
    check_task(example_links(name).task, config["training"]["thinning"], *thinnings)


def write_rssi_folder(root):
    (root / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k},{k % 3},1\n" for k in range(12)))
    readings = "".join(f"-6{k},-100\n-5{k},-70\n" for k in range(6))
    (root / "gateway_rssi.csv").write_text(f"one,two\n{readings}")
    (root / "gateway_position.yml").write_text("one: [0, 0, 2]\ntwo: [5, 1, 2]\n")
    for part, rows in (("train", range(9)), ("test", range(9, 12))):
        (root / f"{part}_index.txt").write_text("".join(f"{row}\n" for row in rows))
    return [f"data.root={root}", "split.length=2"]


def write_spectrum_folder(root):
    config = composed("data=synthetic", *SMALL["synthetic"], "split.validation=0")
    nerf2_spectrum.write(root / "room", load(config["data"], config["split"]))
    return [f"data.root={root / 'room'}"]


def write_rssi_table(root):
    rows = "".join(f"{k},{k % 3},1,{5 * (k % 2)},1,2,-6{k % 10}\n" for k in range(20))
    (root / "room.csv").write_text("tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm\n" + rows)
    return [f"data.file={root / 'room.csv'}"]


def write_channels(root):
    random = np.random.default_rng(0)
    arrays = {
        "tx": random.random((20, 3)),
        "rx": np.array([[0.0, 0, 2], [5, 1, 2]]),
        "rx_index": np.arange(20) % 2,
    }
    arrays |= {"frequencies": 2.4e9 + 1e6 * np.arange(3), "elements": 0.06 * np.eye(3)[:2]}
    arrays["h"] = (
        random.standard_normal((20, 2, 3)) + 1j * random.standard_normal((20, 2, 3))
    ).astype(np.complex64)
    np.savez(root / "room.npz", **arrays)
    return [f"data.file={root / 'room.npz'}"]


def write_wide_table(root):
    rows = "".join(f"{k},{k % 3},-6{k % 10},{'' if k % 4 else -70 - k}\n" for k in range(20))
    (root / "room.csv").write_text("x,y,one,two\n" + rows)
    return [f"data.file={root / 'room.csv'}"]


def write_scenario(root):
    users = np.random.default_rng(0).uniform((1, -5, 0.5), (9, 5, 2), (20, 3))
    fields = 1j / np.linalg.norm(users, axis=1, keepdims=True)
    station = deepmimo.Station(np.zeros(3), fields, np.full((20, 1, 0, 3), np.nan))
    deepmimo.write_scenario(root, 3.5e9, users, [station])
    return [f"data.root={root}"]


FILES = {
    "deepmimo": write_scenario,
    "deepmimo_rssi": write_scenario,
    "nerf2_rssi": write_rssi_folder,
    "nerf2_spectrum": write_spectrum_folder,
    "rssi_csv": write_rssi_table,
    "rssi_wide": write_wide_table,
    "csi_npz": write_channels,
}


@every("data")
def test_data(name, tmp_path, request):
    if name.startswith("sionna"):
        request.getfixturevalue("tracer")
    overrides = FILES[name](tmp_path) if name in FILES else []
    config = composed(f"data={name}", *SMALL.get(name, []), *overrides)
    assert config["data"]["name"] == name
    check_data(registry("data").build(config["data"]))
    links = load(config["data"], config["split"])
    check_data(links)
    check_task(links.task)
    assert links.task.name == config["task"]["name"]


@every("split")
@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_split(name, task):
    """The links of the RSSI share rows; the spectra's do not."""
    links, config = example_links(task), configured("split", name, "split.validation=0.25")
    if name == "receivers":  # the example has two
        data = {"spectrum": "synthetic", "rssi": "synthetic_rssi"}[task]
        links = gaigs.links(data, transmitters=9, receivers=6, order=0)

    def build(seed):
        return registry("split").build(config | {"seed": seed}, links=links)

    check_split(build, links, parts_rows=name in ("official", "receivers"))


# --- the parts of the splatting pipeline ---


@every("placement")
@on_every_device
def test_placement(name, device):
    for scene in scenes():
        placement = registry("placement").build(
            configured("placement", name), scene=scene, channels=2
        )
        check_placement(placement, scene, device)


@every("tokenizer")
@on_every_device
def test_tokenizer(name, device):
    for scene in scenes():
        check_tokenizer(
            registry("tokenizer").build(configured("tokenizer", name), scene=scene), scene, device
        )


@every("deformation")
@on_every_device
def test_deformation(name, device):
    build = functools.partial(registry("deformation").build, configured("deformation", name))
    check_deformation(build, example_links().scene, device)


@on_every_device
def test_deformation_with_all_heads(device):
    heads = "[rotation,scale,signal,opacity,attenuation]"
    config = configured(
        "deformation", "two_branch", f"deformation.heads={heads}", "deformation.width=8"
    )
    check_deformation(
        functools.partial(registry("deformation").build, config), example_links().scene, device
    )


@every("projection")
@on_every_device
def test_projection(name, device):
    check_projection(
        registry("projection").build(configured("projection", name), pixel=math.radians(1)), device
    )


@every("rasterizer")
@on_every_device
def test_rasterizer(name, device):
    if name == "opencl" and device != "cpu":
        pytest.skip("works on the CPU's tensors")
    try:
        rasterizer = registry("rasterizer").build(configured("rasterizer", name))
    except RuntimeError as error:
        if "needs an OpenCL driver" not in str(error) and "cannot build kernels" not in str(error):
            raise
        pytest.skip(str(error))
    check_rasterizer(rasterizer, device)


@pytest.mark.parametrize(("name", "task"), poolings_with_tasks())
@on_every_device
def test_pooling(name, task, device):
    config, links = configured("pooling", name), example_links(task, CARRIER)
    check_pooling(lambda scene: registry("pooling").build(config, scene=scene), links, device)


def test_each_task_has_poolings_of_maps_and_of_paths():
    expected = {"spectrum": ("array_response", "path_spectrum", "spectrum")}
    expected["rssi"] = ("path_rssi", "mean_power", "softmax_attention")
    expected["csi"] = ("path_csi", "element_sum")
    pairs = poolings_with_tasks()
    for task, names in expected.items():
        assert {name for name, of_task in pairs if of_task == task} >= {*names}


@on_every_device
def test_learnt_pooling(device):
    def build(scene):
        return SoftmaxAttention([4, 8], temperature=0.5, prior=0.1, learn=True)

    check_pooling(build, example_links("rssi"), device)


# --- losses, models and trainings ---


@on_its_tasks("loss")
@on_every_device
def test_loss(name, task, device):
    links = example_links(task)
    check_loss(registry("loss").build(configured("loss", name), task=links.task), links, device)


@on_its_tasks("model")
@on_every_device
def test_model(name, task, device):
    config = {"name": name}
    if name in ("gaigs", "mirrored"):
        own = [*MIRRORED, f"pooling=path_{task}"] if name == "mirrored" else []
        config = configured("model", name, f"data={SIMULATED[task]}", *own)
    links = example_links(task, CARRIER if name == "mirrored" else None)
    check_model(lambda scene: registry("model").build(config, scene=scene), links, device)


@on_every_device
def test_training(device):
    options = configured("model", "gaigs", f"data={SIMULATED['spectrum']}")
    options = {key: value for key, value in options.items() if key != "name"}
    build = functools.partial(registry("training").build, configured("training", "descent"))
    check_training(
        build, lambda scene: GaussianSplatting(scene, **options), example_links(), device
    )


@pytest.mark.parametrize(
    ("kind", "name", "task"),
    [(kind, *pair) for kind in ("loss", "model") for pair in unsuitable(kind)],
)
def test_a_task_that_a_component_is_not_made_for_is_refused(kind, name, task):
    links = example_links(task)
    with pytest.raises(
        ValueError, match=r"label|needs (option (base|trend|members)|a regressor|a map)"
    ):
        registry(kind).build({"name": name}, scene=links.scene, task=links.task)


@pytest.mark.parametrize("task", SIMULATED)
def test_a_task_brings_a_pooling_a_loss_and_baselines_that_suit_it(task):
    config, scene = composed(f"data={SIMULATED[task]}"), example_links(task).scene
    assert gives(config["pooling"]["name"], task)
    registry("loss").build(config["loss"], task=scene.task)
    assert {"mean", "knn"} <= {model["name"] for model in config["baselines"]}
    for model in config["baselines"]:
        registry("model").build(model, scene=scene)
