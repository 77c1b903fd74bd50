import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Optional, Union

import numpy as np
import pytest
import torch
from lightning import Trainer
from torch.optim.lr_scheduler import StepLR

import gaigs
from gaigs.registry import KINDS, Registry, call, configuration_of, find_holders, register, registries, registry


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
    """Writes files below ./plugins of an empty working directory; what is imported from there is forgotten again."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])

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
    return f"from gaigs.registry import register\n\n\n@register({kind!r}, {name!r})\nclass Component:\n    {body}\n"


@pytest.mark.parametrize("kind", KINDS)
def test_a_built_in_file_bears_the_registered_name(kind):
    holders, unreadable = find_holders(kind)
    folder = Path(gaigs.__path__[0]) / kind
    assert not unreadable
    assert holders
    assert all(callable(registry(kind).get(h.name)) for h in holders if h.file and h.name not in ("opencl", "aperture"))
    assert [h.name for h in holders if h.file and h.file.parent == folder] == sorted(
        file.stem for file in folder.glob("[!_]*.py") if "@register(" in file.read_text()
    )


def test_registry_of_an_unknown_kind_suggests_the_nearest():
    with pytest.raises(ValueError, match=r"'tokeniser' \(did you mean 'tokenizer'\?\); there are: task, data, split, "):
        registry("tokeniser")
    with pytest.raises(ValueError, match="unknown kind"):
        register("antenna", "horn")


# --- names taken and unknown ---


def test_a_taken_name_tells_who_holds_it_and_who_asks(models):
    with pytest.raises(ValueError, match=r"model 'horn' is held by \w+.horn, and \w+.Waveguide asks for it"):
        models.register("horn")(Waveguide)
    assert models.get("horn") is horn


def test_a_built_in_name_is_taken_before_its_file_is_imported():
    with pytest.raises(
        ValueError, match=r"'mercator' is held by gaigs.projection.mercator\.py, and \w+.Waveguide asks"
    ):
        Registry("projection").register("mercator")(Waveguide)


def test_a_module_loaded_anew_may_register_again(models):
    reloaded = type("Waveguide", (), {"__module__": Waveguide.__module__, "__qualname__": Waveguide.__qualname__})
    models.register("waveguide")(reloaded)
    assert models.get("waveguide") is reloaded


def test_an_unknown_name_suggests_the_nearest_and_lists_all(models):
    with pytest.raises(
        ValueError, match=r"unknown model 'wavegiude' \(did you mean 'waveguide'\?\); there are:.* horn\b"
    ):
        models.get("wavegiude")


# --- build ---


def test_build_passes_options_and_the_context_that_is_asked_for(models):
    config = {"name": "waveguide", "width": 0.33, "modes": 2}
    built = models.build(config, scene="room", frequency=9e8)
    assert (built.scene, built.width, built.modes) == ("room", 0.33, 2)
    assert config.keys() == {"name", "width", "modes"}, "the caller's configuration is left as it was"
    assert configuration_of(built) == {"name": "waveguide", "width": 0.33, "modes": 2}, "without the context"


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"width": 1}, r"a model configuration needs the key 'name', got {'width': 1}; there are:.* horn,.* waveguide"),
        ({"name": "waveguide"}, r"model 'waveguide' needs option width; it has: width, modes"),
        (
            {"name": "waveguide", "widht": 1, "width": 1},
            r"'waveguide' has no option 'widht' \(did you mean 'width'\?\); it has: width, modes",
        ),
        ({"name": "waveguide", "width": 1, "scene": 2}, r"'waveguide' has no option 'scene'; it has: width, modes"),
        ({"name": "horn", "scene": 2}, r"'horn' has no option 'scene'; it has: gain_db"),
    ],
)
def test_build_refuses(models, config, message):
    with pytest.raises(ValueError, match=message):
        models.build(config, scene="room")


@pytest.mark.parametrize("name", [None, 3, ["horn"], True])
def test_a_name_is_a_string(models, name):
    with pytest.raises(TypeError, match=rf"^model\.name must be a string, got {re.escape(repr(name))}$"):
        models.build({"name": name}, scene="room")


@pytest.mark.parametrize("name", [None, 3, ["horn"], True])
def test_a_name_to_register_is_a_string(models, name):
    with pytest.raises(
        TypeError, match=rf"^the name of a model to register must be a string, got {re.escape(repr(name))}$"
    ):
        models.register(name)


def test_what_is_registered_can_be_called(models):
    with pytest.raises(TypeError, match=r"^model 'mast' must be a class or a function, got 3$"):
        models.register("mast")(3)


@pytest.mark.parametrize("config", [["horn"], None, 3])
def test_build_needs_a_name_or_a_mapping(models, config):
    with pytest.raises(TypeError, match="must be a mapping with the key 'name', got"):
        models.build(config)


def test_a_name_alone_and_a_component_are_built_too(models):
    assert models.build("horn", scene="room") == models.build({"name": "horn"}, scene="room")
    part = models.build({"name": "waveguide", "width": 0.3, "modes": 2}, scene="room")
    assert models.build(part) is part


def test_a_subclass_without_a_name_cannot_be_stored(models):
    class Wider(models.get("waveguide")):
        pass

    with pytest.raises(ValueError, match=r"^Wider must have a name to be stored; put @gaigs\.register"):
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


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("count", 40.0, "a whole number, got 40.0; write 40"),
        ("count", 0.5, "a whole number, got 0.5"),
        ("count", math.inf, "a whole number, got inf"),
        ("count", True, "a whole number, got True"),
        ("count", "3", "a whole number, got '3'"),
        ("count", None, "a whole number, got None"),
        ("count", [3], r"a whole number, got \[3\]"),
        ("width", False, "a number, got False"),
        ("width", "wide", "a number, got 'wide'"),
        ("name", 3, "a string, got 3"),
        ("on", 1, "true or false, got 1"),
        ("on", "yes", "true or false, got 'yes'"),
        ("most", 8.0, "a whole number or null, got 8.0; write 8"),
        ("rate", "1", "a number or null, got '1'"),
        ("every", "1", "a whole number or a number, got '1'"),
        ("every", True, "a whole number or a number, got True"),
        ("tests", 1.0, "a whole number or true or false, got 1.0; write 1"),
        ("shorthand", 1.5, "a whole number, got 1.5"),
        ("count", 1e300, r"a whole number, got 1e\+300"),
        ("count", 10**19, r"a whole number up to 9\.2e\+18, got 10000000000000000000"),
        ("width", math.nan, "a finite number, got nan"),
        ("width", -math.inf, "a finite number, got -inf"),
        ("width", 10**30, r"a number up to 9\.2e\+18, got 10{30}"),
        ("rate", math.nan, "a finite number or null, got nan"),
        ("tagged", math.nan, "a finite number, got nan"),
        ("root", 3, "a string or a path, got 3"),
        ("parts", [], r"a mapping, got \[\]"),
        ("heads", "signal", "a list, got 'signal'"),
        ("heads", 3, "a list, got 3"),
        ("devices", 1.5, "a list or a string or a whole number, got 1.5"),
        ("octaves", {}, r"a list or null, got {}"),
        ("octaves", [1], r"a list of 2, got \[1\]"),
    ],
)
def test_an_option_of_another_type_is_refused(option, value, message):
    with pytest.raises(TypeError, match=f"^horn option '{option}' must be {message}$"):
        call("horn", tuned, {option: value})


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("octaves", [0.5, 2], "horn option 'octaves', entry 0, must be a whole number, got 0.5"),
        ("heads", ["signal", 3], "horn option 'heads', entry 1, must be a string, got 3"),
        ("weights", {"opacity": "high"}, "horn option 'weights', entry 'opacity', must be a number, got 'high'"),
        ("weights", {3: 1.0}, "a key of horn option 'weights' must be a string, got 3"),
        ("sizes", [8, 16.0], "horn option 'sizes', entry 1, must be a whole number, got 16.0; write 16"),
        ("devices", [0, None], "horn option 'devices', entry 1, must be a whole number, got None"),
        ("bands", [math.nan], "horn option 'bands', entry 0, must be a finite number, got nan"),
    ],
)
def test_an_entry_of_another_type_is_refused(option, value, message):
    with pytest.raises(TypeError, match=f"^{message}$"):
        call("horn", tuned, {option: value})


def exits():
    sys.exit(0)


@pytest.mark.parametrize(
    ("function", "options", "cause"),
    [
        (lambda steps: 1 / steps, {"steps": 0}, "ZeroDivisionError: division by zero"),
        (lambda order: 10.0**order, {"order": 999}, "OverflowError: "),
        (lambda count: bytes(count), {"count": 2**62}, "MemoryError:"),
        (lambda count: torch.empty(count), {"count": 2**58}, "RuntimeError: "),
        (exits, {}, "SystemExit: 0"),
        (StepLR, {"optimizer": 3, "step_size": 1}, "TypeError: int is not an Optimizer"),
    ],
)
def test_what_says_nothing_of_its_options_is_told_with_them(function, options, cause):
    keys = ", ".join(options) or "none"
    with pytest.raises(ValueError, match=rf"^horn cannot be made \({re.escape(cause)}.*\)\ncheck its options: {keys}$"):
        call("horn", function, options)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("count", 3),
        ("count", np.int64(3)),
        ("width", 3),
        ("width", np.float32(0.5)),
        ("name", "3"),
        ("on", True),
        ("most", None),
        ("rate", 2),
        ("every", 0.5),
        ("tests", True),
        ("shorthand", None),
        ("root", Path("here")),
        ("root", "here"),
        ("octaves", [-3, 2]),
        ("octaves", None),
        ("heads", ("signal",)),
        ("weights", {"opacity": 1}),
        ("sizes", []),
        ("parts", {3: None}),
        ("devices", "auto"),
        ("devices", [0, 1]),
        ("bands", [1, 2.5]),
        ("precision", "16"),
        ("tagged", 0.5),
        ("free", object()),
        ("anything", 0.5),
    ],
)
def test_an_option_that_fits_or_cannot_be_checked_passes(option, value):
    assert call("horn", tuned, {option: value})[option] is value


def test_types_of_the_context_are_the_callers_own():
    assert call("horn", tuned, {}, count=0.5)["count"] == 0.5


def test_annotations_in_quotes_are_checked_where_they_can_be_read():
    def quoted(count: "int", scene: "Scene" = None): ...  # noqa: F821

    with pytest.raises(ValueError, match="needs option count"):
        call("horn", quoted, {})
    call("horn", quoted, {"count": 0.5})  # there is no Scene here
    quoted.__annotations__["scene"] = "Waveguide"
    with pytest.raises(TypeError, match=r"'count' must be a whole number, got 0\.5"):
        call("horn", quoted, {"count": 0.5})


def test_options_of_the_trainer_are_checked_as_lightning_annotates_them(tmp_path):
    options = {"logger": False, "enable_checkpointing": False, "accelerator": "cpu", "enable_model_summary": False}
    with pytest.raises(TypeError, match=r"'max_steps' must be a whole number, got 10\.0; write 10"):
        call("trainer", Trainer, options | {"max_steps": 10.0})
    trainer = call("trainer", Trainer, options | {"max_steps": 10, "limit_val_batches": 0.5}, default_root_dir=tmp_path)
    assert trainer.max_steps == 10


# --- files dropped in ./plugins ---


@pytest.mark.parametrize("kind", KINDS)
def test_of_dropped_files_only_the_one_asked_for_is_imported(plugins, kind):
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
    with pytest.raises(ImportError, match=rf"model 'broken' of plugins.broken\.py cannot be loaded: {cause}"):
        registry("model").get("broken")


def test_ctrl_c_within_a_plugin_stays_one_and_says_where(plugins):
    plugins("slow.py", component("model", "slow", "raise KeyboardInterrupt"))
    with pytest.raises(KeyboardInterrupt, match=r"^stopped while model 'slow' of plugins.slow\.py was loaded$"):
        registry("model").get("slow")


def test_files_that_cannot_be_read_hurt_only_who_finds_no_name(plugins):
    plugins("typo.py", component("model", "typo", "value = = 1"))
    plugins("cavity/pyproject.toml", "[project\n")
    plugins("sound.py", component("model", "sound"))
    assert registry("model").build({"name": "sound"}).value == 1
    with pytest.raises(
        ValueError, match=r"unknown model 'typo'.*; cannot read plugins.cavity.*; cannot read .*typo\.py"
    ) as error:
        registry("model").get("typo")
    assert "invalid syntax (typo.py, line 6)" in str(error.value)


@pytest.mark.parametrize(
    ("file", "content", "cause"),
    [
        ("odd/pyproject.toml", "project = 3", "project must be a table, got 3"),
        ("odd/pyproject.toml", "[project]\nentry-points = 3", "entry-points must be a table, got 3"),
        ("odd/pyproject.toml", "[project.entry-points]\n'gaigs.model' = 3", "gaigs.model must be a table, got 3"),
        (
            "odd/pyproject.toml",
            "[project.entry-points.'gaigs.model']\nodd = 3",
            "entry point 'odd' must be a string module:attribute, got 3",
        ),
        ("odd.py", f"x = {100_000 * '-'}1\n", r"odd\.py: MemoryError"),  # Python's for what it cannot parse
    ],
)
def test_files_that_say_something_else_hurt_only_who_finds_no_name(file, content, cause, plugins):
    plugins(file, content)
    registry("model").get("mean")
    with pytest.raises(ValueError, match=f"unknown model 'odd'.*; cannot read plugins.*{cause}"):
        registry("model").get("odd")


def test_a_dropped_file_may_not_take_a_name(plugins):
    plugins("map.py", component("projection", "mercator"))
    with pytest.raises(ValueError, match=r"'mercator' is held by gaigs.*mercator\.py, and plugins.map\.py asks for it"):
        registry("projection").get("mercator")
    registry("projection").get("equirectangular")


def test_a_plugin_may_not_take_a_registered_name(plugins, models):
    plugins("flare.py", component("model", "horn"))
    with pytest.raises(ValueError, match=r"'horn' is held by \w+\.horn, and plugins.flare\.py asks for it"):
        models.get("horn")


def test_a_module_of_the_same_name_from_elsewhere_is_not_taken_for_the_plugin(plugins, tmp_path, monkeypatch):
    plugins("slot.py", component("model", "slot"))
    registry("model").get("slot")
    other = tmp_path / "elsewhere"
    plugins("../elsewhere/plugins/slot.py", component("model", "notch"))
    monkeypatch.chdir(other)
    with pytest.raises(
        ImportError, match=r"model 'notch' of plugins.slot\.py .* is imported as 'plugins.slot' already"
    ):
        registry("model").get("notch")


@pytest.mark.parametrize(("target", "file"), [("cavity.box:Box.open", "box.py"), ("cavity.horn", "horn.py")])
def test_an_entry_point_names_an_attribute_or_a_module_that_registers(plugins, target, file):
    plugins("cavity/pyproject.toml", f'[project]\n[project.entry-points."gaigs.model"]\nopened = "{target}"\n')
    plugins("cavity/cavity/box.py", "class Box:\n    @staticmethod\n    def open(value=1):\n        return Box()\n")
    plugins("cavity/cavity/horn.py", component("model", "opened"))
    assert type(registry("model").build({"name": "opened"})).__module__ == f"cavity.{file.removesuffix('.py')}"
