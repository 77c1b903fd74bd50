"""Every option of every registered component with unsuitable values: each is refused by its name.

Numbers at the edge may suit an option, as 0 does a penalty: then the component's result is finite.
Nothing is trained. A registered component is swept without further entries here, in this repository
or in its ``plugins``.
"""

import ast
import contextlib
import copy
import functools
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from gaigs import configuration
from gaigs import registry as registry_module
from gaigs.configuration import files
from gaigs.registry import registry
from gaigs.testing import example_links
from gaigs.training.density_control import DensityControl

pytestmark = pytest.mark.usefixtures("unchecked")

ROOT = Path(__file__).parents[1]
DATA = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
PLAIN = ("rasterizer=torch", "gaussians.count=8")
MIRRORED = ("model=mirrored", "placement.planes=6", "placement.order=1", "placement.obstacles=2")
SMALL = {
    "nerf_apt": ("model.samples=4", "model.rays=[3,8]", "model.widths=[2,3,4]"),
    "newrf": ("model.arrivals=2", "model.samples=4"),
}
"""Options of models that are slow in their own size."""

GIVEN = {"adversarial": ["model=dcgan"], "adaptive": ["model=gaigs"]}
"""Options that a configuration file leaves open."""

WITHOUT_DEFAULT = {"blocks": {"edge": 1.0}, "runs": {"length": 2}, "sparse": {"train": 7}}
"""Options of splits that have no default."""

PARTS = ("placement", "tokenizer", "deformation", "projection", "rasterizer", "pooling")
PLACES = {"density": "training.density", "gaussians": "model.gaussians"}
"""Places of options that belong to no component."""

SWEPT = ("data", "split", *PARTS, "loss", "model", "training")
EDGES = (-1, 0, 1e30, 10**30)
OTHERS = (None, "abc", True, [], math.nan, ["abc"], {"x": 1}, *EDGES)
SUITS = {
    bool: (True,),
    int: (),
    float: (),
    str: ("abc",),
    list: ([],),
    dict: ({"x": 1},),
    type(None): OTHERS,
}
"""Those of ``OTHERS`` that an option may have, by the type of its value in the file; null leaves
the type open.
"""


@contextlib.contextmanager
def repository():
    """As from the root of the repository, where plug-ins are found by name."""
    path = sys.path[:]  # the registry appends to it
    with contextlib.chdir(ROOT):
        yield
    sys.path[:] = path


def names():
    with repository():
        found = [(kind, name) for kind in SWEPT for name in registry(kind).names()]
    return [*found, ("density", "adaptive"), ("gaussians", "lattice")]


@pytest.fixture(scope="module", autouse=True)
def found_once():
    """The folders are looked through once, not for each value."""
    find = functools.cache(registry_module.find_holders)
    with pytest.MonkeyPatch.context() as patch, repository():
        patch.setattr(registry_module, "find_holders", lambda kind, name=None: find(kind, name))
        patch.setattr(files, "plugin_packages", functools.cache(files.plugin_packages))
        yield


@functools.cache
def links_of(task):
    return example_links(task, 2.44e9 if task == "spectrum" else None)


@functools.cache
def composed(*words):
    """Hydra's composition in plain dictionaries; None where a choice is not there."""
    try:
        with initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
            config = compose("config", [*words])
    except HydraException:
        return None
    OmegaConf.set_struct(config, False)
    for key in ("root", "file"):
        if OmegaConf.is_missing(config.data, key):
            config.data[key] = "nowhere"
    return OmegaConf.to_container(config, resolve=True)


def compositions(kind, name):
    """Configurations that may choose the component, each with its task, the plainest first.

    A component without a file of its own is put into the composition of the others, as Hydra does:
    a composition takes 0.2 s.
    """
    is_put = kind != "training" and kind in SWEPT and not files.files_of(kind, name)
    variants = [PLAIN, MIRRORED] if kind in PARTS else [PLAIN]
    if not is_put:
        variants = {"data": [()], "model": [PLAIN, ()]}.get(kind, variants)
    for task in DATA:
        chosen = [f"data={DATA[task]}"]
        if not is_put:
            own = [f"{kind}={name}", *GIVEN.get(name, [])]
            chosen = own if kind == "data" else chosen + own
        for more in variants:
            config = copy.deepcopy(composed(*chosen, *more, *SMALL.get(name, ())))
            if config is None:
                continue
            if is_put:
                options = registry(kind).options(name) | WITHOUT_DEFAULT.get(name, {})
                node = OmegaConf.create({**options, "name": name})  # lists in place of tuples
                for key in ("root", "file"):
                    if kind == "data" and OmegaConf.is_missing(node, key):
                        node[key] = "nowhere"
                (config["model"] if kind in PARTS else config)[kind] = OmegaConf.to_container(node)
            yield task, config


@functools.cache
def untrained(task, config):
    """Several trainings have the same model, which none of them changes."""
    return registry("model").build(ast.literal_eval(config), scene=links_of(task).scene)


def build(kind, task, config):
    """Builds the components of a run up to that kind; returns their result, to be finite."""
    links = links_of(task)
    if kind == "data":  # not read: tests/data has what readers make of numbers
        name, given = (
            config["data"]["name"],
            {key: value for key, value in config["data"].items() if key != "name"},
        )
        reader = functools.wraps(registry("data").get(name))(lambda **_: torch.zeros(()))
        return registry_module.call(f"data {name!r}", reader, given)
    if kind == "split":
        return registry("split").build(config["split"], links=links).train
    torch.manual_seed(0)
    loss = registry("loss").build(config["loss"], task=links.task)
    if kind == "loss":
        some = links.batch(torch.tensor([0, 1]))
        return loss(some.labels * 0.5, some)[0]
    if kind in ("training", "density"):
        model = untrained(task, repr(config["model"]))
        module = registry("training").build(
            config["training"], model=model, loss=loss, identity={}, seed=0
        )
        module.trainer = SimpleNamespace(max_steps=1, callbacks=[])
        module.configure_optimizers()
        if module.density is not None:
            registry_module.call("density", DensityControl, module.density, seed=0)
        return torch.zeros(())
    model = registry("model").build(config["model"], scene=links.scene)
    if config["model"]["name"] == "ray_tracing":  # traces for seconds
        return torch.zeros(())
    model.fit(links)
    train = links.split.train[:2]
    batch = links.batch(train)
    value, penalties = model(batch)
    return loss(value, batch)[0] + sum(penalties.values())


@functools.cache
def chosen(kind, name):
    """The first of the compositions that can be built, and its task."""
    for task, config in compositions(kind, name):
        with contextlib.suppress(ValueError, TypeError, FileNotFoundError, AttributeError):
            if build(kind, task, config).isfinite().all():
                return task, config
    return None


def options(config, prefix):
    """All keys below a prefix, joined by dots, that have a value of their own, with the value."""
    node = functools.reduce(dict.__getitem__, prefix.split("."), config)
    for key, value in node.items():
        name = f"{prefix}.{key}"
        if key == "name" or (prefix == "model" and key in (*PARTS, "gaussians")):
            continue
        yield name, value
        if isinstance(value, dict):
            yield from options(config, name)


def with_value(config, key, value):
    *path, last = key.split(".")
    config = copy.deepcopy(config)
    functools.reduce(dict.__getitem__, path, config)[last] = value
    return config


@pytest.mark.parametrize(("kind", "name"), names())
def test_unsuitable_values_are_refused_by_name(kind, name):
    found = chosen(kind, name)
    if found is None:
        assert any(compositions(kind, name)), "no configuration chooses it"
        pytest.skip("needs its files, or another package")
    task, config = found
    prefix = PLACES.get(kind, f"model.{kind}" if kind in PARTS else kind)
    wrong = []
    for key, own in options(config, prefix):
        for value in OTHERS:
            try:
                given = build(kind, task, with_value(config, key, value))
            except (ValueError, TypeError, FileNotFoundError) as error:
                message = str(error)
                if key.rpartition(".")[2] not in message or message.count("\n") > 1:
                    wrong.append((key, value, message))
            except Exception as error:
                wrong.append((key, value, repr(error)))
            else:
                # Lists of carriers and of files, which tests/data has.
                if kind == "data" and value in ([], ["abc"]):
                    continue
                is_edge = isinstance(own, int | float) and type(value) in (int, float)
                if not given.isfinite().all() or not (
                    is_edge or value is None or value in SUITS[type(own)]
                ):
                    wrong.append((key, value, given))
    assert not wrong, "\n".join(map(str, wrong))


@pytest.mark.parametrize("name", [name for kind, name in names() if kind == "model"])
def test_half_the_digits_are_enough_or_refused(name):
    """``trainer.precision=bf16-mixed``."""
    found = chosen("model", name)
    if found is None:
        pytest.skip("needs its files, or another package")
    if not [*untrained(found[0], repr(found[1]["model"])).parameters()]:
        pytest.skip("is not trained")
    message = ""
    with torch.autocast("cpu", torch.bfloat16):
        try:
            assert build("model", *found).isfinite()
        except ValueError as error:
            message = str(error)
    assert not message or "set trainer.precision to 32-true or 64-true" in message
