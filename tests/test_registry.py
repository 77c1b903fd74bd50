import math
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Optional, Union

import numpy as np
import pytest
import torch
from lightning import Trainer
from torch.optim.lr_scheduler import StepLR

from gaigs.configuration import compose
from gaigs.registry import (
    KINDS,
    Registry,
    call,
    configuration_of,
    find_holders,
    register,
    registries,
    registry,
)
from gaigs.registry.building import named_parameters
from gaigs.registry.storing import GIVEN


class Waveguide:
    def __init__(self, scene, width: float, modes: int = 3):
        self.scene, self.width, self.modes = scene, width, modes


def horn(*, gain_db=0.0, **rest):
    return gain_db, rest


@pytest.fixture
def models():
    """A registry of two components, apart from the one of the process."""
    models = Registry("model")
    models.register("waveguide")(Waveguide)
    models.register("horn")(horn)
    return models


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    """Writes files below ./plugins of an empty working directory; imports from there are undone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    for module in [
        name for name in sys.modules if name.split(".")[0] == "plugins"
    ]:  # of other tests
        monkeypatch.delitem(sys.modules, module)

    def write(path, text):
        file = tmp_path / "plugins" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    yield write
    for module in [name for name in sys.modules if name.split(".")[0] in ("plugins", "cavity")]:
        del sys.modules[module]
    for kind in KINDS:
        registered = registries[kind]._registered
        for name in [
            name
            for name, component in registered.items()
            if component.__module__.split(".")[0] in ("plugins", "cavity")
        ]:
            del registered[name]


def component(kind, name, body="value = 1"):
    return (
        f"from gaigs.registry import register\n\n\n@register({kind!r}, {name!r})\nclass "
        f"Component:\n    {body}\n"
    )


def test_registry_of_an_unknown_kind_suggests_the_nearest():
    with pytest.raises(
        ValueError,
        match=r"'tokeniser' \(did you mean 'tokenizer'\?\); there are: task, data, split, ",
    ):
        registry("tokeniser")
    with pytest.raises(ValueError, match="unknown kind"):
        register("antenna", "horn")


# --- names taken and unknown ---


def test_a_taken_name_tells_who_holds_it_and_who_asks(models):
    with pytest.raises(
        ValueError, match=r"model 'horn' is held by \w+.horn, and \w+.Waveguide asks for it"
    ):
        models.register("horn")(Waveguide)
    assert models.get("horn") is horn


def test_a_built_in_name_is_taken_before_its_file_is_imported():
    with pytest.raises(
        ValueError,
        match=(
            r"'mercator' is held by gaigs.splatting.projection.mercator\.py, and \w+.Waveguide "
            r"asks"
        ),
    ):
        Registry("projection").register("mercator")(Waveguide)


def test_a_module_loaded_anew_may_register_again(models):
    reloaded = type(
        "Waveguide",
        (),
        {"__module__": Waveguide.__module__, "__qualname__": Waveguide.__qualname__},
    )
    models.register("waveguide")(reloaded)
    assert models.get("waveguide") is reloaded


def test_an_unknown_name_suggests_the_nearest_and_lists_all(models):
    with pytest.raises(
        ValueError,
        match=r"unknown model 'wavegiude' \(did you mean 'waveguide'\?\); there are:.* horn\b",
    ):
        models.get("wavegiude")


# --- build ---


def test_build_passes_options_and_the_context_that_is_asked_for(models):
    config = {"name": "waveguide", "width": 0.33, "modes": 2}
    built = models.build(config, scene="room", frequency=9e8)
    assert (built.scene, built.width, built.modes) == ("room", 0.33, 2)
    assert config.keys() == {"name", "width", "modes"}, (
        "the caller's configuration is left as it was"
    )
    assert configuration_of(built) == {"name": "waveguide", "width": 0.33, "modes": 2}, (
        "without the context"
    )


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        (
            {"width": 1},
            ValueError,
            r"needs the key 'name', got {'width': 1}; there are:.* horn,.* waveguide",
        ),
        (
            {"name": "waveguide"},
            ValueError,
            r"model 'waveguide' needs option width; it has: width, modes",
        ),
        (
            {"name": "waveguide", "widht": 1, "width": 1},
            ValueError,
            r"'waveguide' has no option 'widht' \(did you mean 'width'\?\); it has: width, modes",
        ),
        (
            {"name": "waveguide", "width": 1, "scene": 2},
            ValueError,
            "'waveguide' has no option 'scene'; it has: ",
        ),
        (
            {"name": "horn", "scene": 2},
            ValueError,
            r"'horn' has no option 'scene'; it has: gain_db",
        ),
        ({"name": 3}, TypeError, r"^model\.name must be a string, got 3$"),
        (["horn"], TypeError, "must be a mapping with the key 'name', got"),
        (None, TypeError, "must be a mapping with the key 'name', got None"),
    ],
)
def test_build_refuses(models, config, error, message):
    with pytest.raises(error, match=message):
        models.build(config, scene="room")


def test_a_registered_component_can_be_called(models):
    with pytest.raises(TypeError, match=r"^model 'mast' must be a class or a function, got 3$"):
        models.register("mast")(3)


def test_a_name_alone_and_a_component_are_built_too(models):
    assert models.build("horn", scene="room") == models.build({"name": "horn"}, scene="room")
    part = models.build({"name": "waveguide", "width": 0.3, "modes": 2}, scene="room")
    assert models.build(part) is part


def test_a_subclass_without_a_name_cannot_be_stored(models):
    class Wider(models.get("waveguide")):
        pass

    with pytest.raises(
        ValueError, match=r"^Wider must have a name to be stored; put @gaigs\.register"
    ):
        configuration_of(Wider("room", 0.3))


# --- types of options ---


def tuned(
    count: int = 1,
    width: float = 1.0,
    name: str = "",
    on: bool = False,
    most: int | None = None,
    rate: Optional[float] = None,  # noqa: UP045
    every: Union[int, float] = 1,  # noqa: UP007
    tests: int | bool = 1,
    shorthand: int = None,  # noqa: RUF013
    root: str | Path = "",
    octaves: tuple[int, int] | None = None,
    heads: list[str] = (),
    weights: dict[str, float] | None = None,
    sizes: tuple[int, ...] = (),
    parts: dict = {},  # noqa: B006
    devices: Union[list[int], str, int] = 1,  # noqa: UP007
    bands: Sequence[float] = (),
    precision: Literal[16, 32] = 32,
    tagged: Annotated[int, []] = 0,
    free=None,
    **rest: int,
):
    return {key: value for key, value in locals().items() if key != "rest"} | rest


NO = {
    "count": {
        "a whole number, got 40.0; write 40": 40.0, "a whole number, got inf": math.inf,
        "a whole number, got True": True, "a whole number, got '3'": "3", "a whole number, got None": None,
        "a whole number, got [3]": [3], "a whole number, got 1e+300": 1e300,
        "a whole number up to 9.2e+18, got 10000000000000000000": 10**19,
    },
    "width": {
        "a number, got False": False, "a number, got 'wide'": "wide", "a finite number, got nan": math.nan,
        "a number up to 9.2e+18, got 1000000000000000000000000000000": 10**30,
    },
    "name": {"a string, got 3": 3},
    "on": {"true or false, got 1": 1, "true or false, got 'yes'": "yes"},
    "most": {"a whole number or null, got 8.0; write 8": 8.0},
    "rate": {"a number or null, got '1'": "1", "a finite number or null, got nan": math.nan},
    "every": {"a whole number or a number, got True": True},
    "tests": {"a whole number or true or false, got 1.0; write 1": 1.0},
    "shorthand": {"a whole number, got 1.5": 1.5},
    "tagged": {"a finite number, got nan": math.nan},
    "root": {"a string or a path, got 3": 3},
    "parts": {"a mapping, got []": []},
    "heads": {"a list, got 'signal'": "signal"},
    "devices": {"a list or a string or a whole number, got 1.5": 1.5},
    "octaves": {"a list or null, got {}": {}, "a list of 2, got [1]": [1]},
}  # fmt: skip
"""Values that do not suit an option, by the end of the message."""


@pytest.mark.parametrize("option", NO)
def test_an_option_of_another_type_is_refused(option):
    for message, value in NO[option].items():
        with pytest.raises(
            TypeError, match=f"^horn option '{option}' must be {re.escape(message)}$"
        ):
            call("horn", tuned, {option: value})


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("octaves", [0.5, 2], "horn option 'octaves', entry 0, must be a whole number, got 0.5"),
        (
            "weights",
            {"opacity": "high"},
            "horn option 'weights', entry 'opacity', must be a number, got 'high'",
        ),
        ("weights", {3: 1.0}, "a key of horn option 'weights' must be a string, got 3"),
        (
            "sizes",
            [8, 16.0],
            "horn option 'sizes', entry 1, must be a whole number, got 16.0; write 16",
        ),
        ("devices", [0, None], "horn option 'devices', entry 1, must be a whole number, got None"),
    ],
)
def test_an_entry_of_another_type_is_refused(option, value, message):
    with pytest.raises(TypeError, match=f"^{message}$"):
        call("horn", tuned, {option: value})


@pytest.mark.parametrize(
    ("function", "options", "cause"),
    [
        (lambda steps: 1 / steps, {"steps": 0}, "ZeroDivisionError: division by zero"),
        (lambda count: bytes(count), {"count": 2**62}, "MemoryError:"),
        (lambda count: torch.empty(count), {"count": 2**58}, "RuntimeError: "),
        (lambda: sys.exit(0), {}, "SystemExit: 0"),
        (StepLR, {"optimizer": 3, "step_size": 1}, "TypeError: int is not an Optimizer"),
    ],
)
def test_an_error_that_names_no_option_is_given_with_all_options(function, options, cause):
    keys = ", ".join(options) or "none"
    with pytest.raises(
        ValueError,
        match=rf"^horn cannot be made \({re.escape(cause)}.*\)\ncheck its options: {keys}$",
    ):
        call("horn", function, options)


def test_an_option_that_suits_or_cannot_be_checked_passes():
    suitable = {
        "count": [3, np.int64(3)], "width": [3, np.float32(0.5)], "name": ["3"], "on": [True], "most": [None],
        "rate": [2], "every": [0.5], "tests": [True], "shorthand": [None], "root": [Path("here"), "here"],
        "octaves": [[-3, 2], None], "heads": [("signal",)], "weights": [{"opacity": 1}], "sizes": [[]],
        "parts": [{3: None}], "devices": ["auto", [0, 1]], "bands": [[1, 2.5]], "precision": ["16"], "tagged": [0.5],
        "free": [object()], "anything": [0.5],
    }  # fmt: skip
    for option, values in suitable.items():
        for value in values:
            assert call("horn", tuned, {option: value})[option] is value
    assert call("horn", tuned, {}, count=0.5)["count"] == 0.5, (
        "the caller's own arguments are not checked"
    )


def test_annotations_in_quotes_are_checked_where_they_can_be_read():
    def quoted(count: "int", scene: "Scene" = None): ...  # noqa: F821

    with pytest.raises(ValueError, match="needs option count"):
        call("horn", quoted, {})
    call("horn", quoted, {"count": 0.5})  # there is no Scene here
    quoted.__annotations__["scene"] = "Waveguide"
    with pytest.raises(TypeError, match=r"'count' must be a whole number, got 0\.5"):
        call("horn", quoted, {"count": 0.5})


def test_options_of_the_trainer_are_checked_as_lightning_annotates_them(tmp_path):
    options = {
        "logger": False,
        "enable_checkpointing": False,
        "accelerator": "cpu",
        "enable_model_summary": False,
    }
    with pytest.raises(TypeError, match=r"'max_steps' must be a whole number, got 10\.0; write 10"):
        call("trainer", Trainer, options | {"max_steps": 10.0})
    trainer = call(
        "trainer",
        Trainer,
        options | {"max_steps": 10, "limit_val_batches": 0.5},
        default_root_dir=tmp_path,
    )
    assert trainer.max_steps == 10


# --- files dropped in ./plugins ---


@pytest.mark.parametrize("kind", KINDS)
def test_a_dropped_file_is_imported_when_it_is_built(plugins, kind):
    plugins("slot.py", component(kind, "slot"))
    plugins("patch.py", component(kind, "patch"))
    assert {"slot", "patch"} <= set(registry(kind).names())
    assert not any("slot" in registry(other).names() for other in KINDS if other != kind)
    assert not any(module.startswith("plugins") for module in sys.modules)
    assert registry(kind).build({"name": "slot"}).value == 1
    assert "plugins.slot" in sys.modules
    assert "plugins.patch" not in sys.modules


def test_a_dropped_folder_is_a_package(plugins):
    plugins("dipole/__init__.py", "LENGTH = 0.16\n")
    plugins("dipole/half_wave.py", component("model", "half_wave", "from . import LENGTH as value"))
    plugins("dipole/_private.py", component("model", "private"))
    assert registry("model").build({"name": "half_wave"}).value == 0.16
    assert "private" not in registry("model").names()


@pytest.mark.parametrize("layout", ["cavity/cavity/box.py", "cavity/src/cavity/box.py"])
def test_a_dropped_project_need_not_be_installed(plugins, layout):
    plugins(
        "cavity/pyproject.toml",
        '[project]\nname = "Cavity"\n[project.entry-points."gaigs.model"]\nbox = "cavity.box:Box"\n',
    )
    plugins(layout, "from . import MODES\n\n\nclass Box:\n    modes = MODES\n")
    plugins(Path(layout).with_name("__init__.py"), "MODES = 7\n")
    assert registry("model").build({"name": "box"}).modes == 7


def test_names_in_comments_strings_and_functions_are_no_names(plugins):
    plugins(
        "hidden.py",
        '"""\n@register("model", "in_docstring")\n"""\n# @register("model", "in_comment")\n'
        'def local():\n    @register("model", "in_function")\n    class Local: ...\n',
    )
    assert not {"in_docstring", "in_comment", "in_function"} & set(registry("model").names())


@pytest.mark.parametrize(
    ("body", "cause"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("value = 1 / 0", "ZeroDivisionError: division by zero"),
        ("import sys; sys.exit(0)", "SystemExit: 0"),
        ("class Halt(BaseException): ...\n    raise Halt('at once')", "Halt: at once"),
    ],
)
def test_a_plugin_that_fails_hurts_only_who_asks_for_it(plugins, body, cause):
    plugins("broken.py", component("model", "broken", body))
    plugins("sound.py", component("model", "sound"))
    assert registry("model").build({"name": "sound"}).value == 1
    with pytest.raises(
        ImportError, match=rf"model 'broken' of plugins.broken\.py cannot be loaded: {cause}"
    ):
        registry("model").get("broken")


def test_ctrl_c_within_a_plugin_stays_one_and_says_where(plugins):
    plugins("slow.py", component("model", "slow", "raise KeyboardInterrupt"))
    with pytest.raises(
        KeyboardInterrupt, match=r"^stopped while model 'slow' of plugins.slow\.py was loaded$"
    ):
        registry("model").get("slow")


@pytest.mark.parametrize(
    ("file", "content", "cause"),
    [
        ("cavity/pyproject.toml", "[project\n", "line 1"),
        ("odd/pyproject.toml", "project = 3", "has no attribute"),
        ("odd.py", "value = = 1", r"invalid syntax \(odd.py, line 1\)"),
        (
            "odd.py",
            f"x = {100_000 * '-'}1\n",
            r"odd\.py: (MemoryError|Parser stack)",
        ),  # Python's, if too deep
    ],
)
def test_an_unreadable_file_is_named_where_a_name_is_missing(file, content, cause, plugins):
    plugins(file, content)
    plugins("sound.py", component("model", "sound"))
    assert registry("model").build({"name": "sound"}).value == 1
    with pytest.raises(ValueError, match=f"unknown model 'odd'.*; cannot read plugins.*{cause}"):
        registry("model").get("odd")


def test_a_plugin_may_not_take_a_name(plugins, models):
    plugins("flare.py", component("model", "horn"))
    with pytest.raises(
        ValueError, match=r"'horn' is held by \w+\.horn, and plugins.flare\.py asks for it"
    ):
        models.get("horn")
    plugins("map.py", component("projection", "mercator"))
    with pytest.raises(
        ValueError,
        match=r"'mercator' is held by gaigs.*mercator\.py, and plugins.map\.py asks for it",
    ):
        registry("projection").get("mercator")
    registry("projection").get("equirectangular")


def test_a_module_of_the_same_name_from_elsewhere_is_not_taken_for_the_plugin(
    plugins, tmp_path, monkeypatch
):
    plugins("slot.py", component("model", "slot"))
    registry("model").get("slot")
    other = tmp_path / "elsewhere"
    plugins("../elsewhere/plugins/slot.py", component("model", "notch"))
    monkeypatch.chdir(other)
    with pytest.raises(
        ImportError,
        match=r"model 'notch' of plugins.slot\.py .* is imported as 'plugins.slot' already",
    ):
        registry("model").get("notch")


@pytest.mark.parametrize(
    ("target", "file"), [("cavity.box:Box.open", "box.py"), ("cavity.horn", "horn.py")]
)
def test_an_entry_point_names_an_attribute_or_a_module_that_registers(plugins, target, file):
    plugins(
        "cavity/pyproject.toml",
        f'[project]\n[project.entry-points."gaigs.model"]\nopened = "{target}"\n',
    )
    plugins(
        "cavity/cavity/box.py",
        "class Box:\n    @staticmethod\n    def open(value=1):\n        return Box()\n",
    )
    plugins("cavity/cavity/horn.py", component("model", "opened"))
    assert (
        type(registry("model").build({"name": "opened"})).__module__
        == f"cavity.{file.removesuffix('.py')}"
    )


def test_a_plugin_is_imported_when_composed_if_its_source_does_not_tell_its_options(plugins):
    """Here the constructor is another package's."""
    plugins(
        "broken.py",
        "from nothing import Whole\n@register('model', 'broken')\nclass Broken(Whole): ...\n"
        "@register('model', 'sound')\nclass Sound:\n"
        "    def __init__(self, scene, width: int = 3): ...\n",
    )
    assert compose(model="sound", width=5)["model"] == {"name": "sound", "width": 5}
    with pytest.raises(
        ValueError,
        match=r"model 'broken' of plugins.broken\.py cannot be loaded: ModuleNotFoundError",
    ):
        compose(model="broken")


# --- options from the source ---

BASES = """
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple
from gaigs.registry import register
from torch import nn
from .lengths import LONG as LENGTH, Base

WIDTH: int = 4

class Nearer(Base):
    "It has no constructor of its own."

@register("model", "plain")
class Plain(nn.Module):
    def __init__(self, scene, /, width=WIDTH, length=LENGTH, *, depth, octaves=(-3, 2), **rest): ...

@register("model", "inherits")
class Inherits(Nearer): ...

@register("model", "bare")
class Bare(nn.Module): ...

@register("model", "function")
def function(scene, count=-1, part=None): ...

@register("model", "computed")
class Computed:
    def __init__(self, scene, width=sqrt(4)): ...

@register("model", "frozen")
@dataclass
class Frozen:
    width: int = 3

@register("model", "tupled")
class Tupled(NamedTuple):
    width: int = 3
"""


def test_options_are_read_from_the_source_where_it_tells_them(plugins):
    plugins("parts/__init__.py", "")
    plugins("parts/bases.py", BASES)
    base = "class Base:\n    def __init__(self, scene, pitch: float, name='x'): ...\n"
    plugins("parts/lengths.py", f"LONG = 2.5\n{base}")
    expected = {
        "plain": {"width": 4, "length": 2.5, "octaves": (-3, 2), "depth": "???"},
        "inherits": {"pitch": "???", "name": "x"},
        "bare": {},
        "function": {"count": -1, "part": None},
    }
    for name, options in expected.items():
        assert registry("model").options(name) == options
    assert "plugins.parts.bases" not in sys.modules
    for name, options in {"computed": {"width": 2.0}, "tupled": {"width": 3}}.items():
        assert registry("model").options(name) == options
    assert "plugins.parts.bases" in sys.modules
    for name, options in expected.items():
        assert registry("model").options(name) == options, "of the imported component"
    assert registry("model").options("frozen") == {"width": 3}


@pytest.mark.parametrize("kind", KINDS)
def test_the_sources_of_gaigs_tell_all_options(kind):
    for holder in find_holders(kind)[0]:
        if holder.root is None and holder.file is not None:
            given = GIVEN.get(kind, ())
            parameters = named_parameters(registry(kind).get(holder.name))
            options = {
                key: "???" if parameter.default is parameter.empty else parameter.default
                for key, parameter in parameters.items()
                if key not in given
            }
            assert holder.read_options(given) == options


def test_the_task_and_split_of_a_reader_are_read_without_an_import(plugins):
    reader = '@register("data", "mast", task="csi", split="runs")\ndef mast(file="m.csv"): ...\n'
    plugins("mast.py", f"from gaigs.registry import register\n\n\n{reader}")
    assert registry("data").choices("mast") == {"task": "csi", "split": "runs"}
    config = compose("data=mast", "split.length=3")
    assert config["data"] == {"file": "m.csv", "name": "mast"}
    assert (config["task"]["name"], config["split"]["name"]) == ("csi", "runs")
    config = compose("data=mast", "task=rssi", "split=random")
    assert (config["task"]["name"], config["split"]["name"]) == ("rssi", "random")
    assert "plugins.mast" not in sys.modules
    with pytest.raises(ValueError, match="split 'thirds' chooses no task; only data take"):
        register("split", "thirds", task="csi")
    register("data", "scripted", task="rssi")(horn)
    try:
        assert compose("data=scripted")["task"]["name"] == "rssi"
    finally:
        del registries["data"]._registered["scripted"], registries["data"]._choices["scripted"]


def test_a_composition_imports_neither_torch_nor_the_chosen_components(tmp_path):
    code = """
import sys, gaigs
gaigs.compose("+experiment=mirrored_rssi", "model=knn", "tokenizer=ga", k=3, **{"seed": 2})
gaigs.compose("+experiment=csi", "data=nerf2_rssi", "data.root=here")
print([name for name in ("torch", "lightning", "numpy", "gaigs.model", "gaigs.data",
    "gaigs.splatting.tokenizer.ga") if name in sys.modules])
"""
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.mark.parametrize("word", ["--help", "modle=knn", "knn.k=3", "command=trian", "seed=-1"])
def test_help_and_messages_import_no_torch(word, tmp_path):
    code = """
import sys
from gaigs.commands.command_line import main
try:
    main()
finally:
    assert not {"torch", "lightning"} & {*sys.modules}
"""
    words = [sys.executable, "-c", code, "hydra.run.dir=run", word]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert "AssertionError" not in done.stderr
    assert done.returncode == (0 if word == "--help" else 1), done.stderr
