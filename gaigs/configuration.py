"""Configurations: the files that Hydra joins, the check of the result, and the message of an error
in it.
"""

import contextlib
import hashlib
import logging
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import hydra
from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from gaigs.registry import KINDS, check_type, listed, registry, similar, storable, suggest
from gaigs.registry.holders import plugin_packages
from gaigs.registry.shipped import not_installed

log = logging.getLogger(__name__)
composing = threading.RLock()  # Hydra composes one configuration at a time

HARMLESS = (
    "command", "folder", "survey", "locate", "export", "view", "figures", "save_every", "tensorboard", "threads",
    "trust", "trainer.enable_progress_bar", "trainer.enable_model_summary",
)  # fmt: skip
"""Keys that change no result: a run may be resumed with other values."""

MAY_BE_NULL = ("gaussians", "density", "projection", "rasterizer")
"""Optional parts."""

KEYS = {
    **dict.fromkeys((*KINDS, "trainer"), dict), **dict.fromkeys(MAY_BE_NULL, dict | None),
    "kriging": bool, "kriging_fallback": dict | None, "baselines": list[dict], "command": str, "seed": int,
    "ensemble": int, "max_time": str | dict | None,
    "save_every": float, "tensorboard": bool, "threads": int | None, "trust": bool, "folder": str | None,
    "survey": dict, "locate": dict, "export": dict, "view": dict, "figures": dict,
}  # fmt: skip
"""Top-level keys and their types."""

CHOSEN = (*KINDS, "gaussians", "density", "trainer")
"""Keys that choose one file or component."""

READ_BY_LINKS = ("data", "split", "task")
"""Keys that ``gaigs.links`` reads."""

CONSTRUCTED = tuple(kind for kind in KINDS if kind not in ("task", "training"))
"""Kinds whose components need no configuration file: the options are read from their constructors.
"""


def conf_dir() -> Path:
    """The folder of gaigs's own configuration: in the installed package, or beside the package in a
    checkout.
    """
    here = Path(__file__).parent
    packaged = here / "conf"
    return packaged if packaged.is_dir() else here.parent / "conf"


def plugin_conf_dirs() -> list[Path]:
    """``plugins/conf``, ``plugins/<folder>/conf``, and ``<package>/conf`` of each package with an
    entry point of gaigs.

    They hold ``<kind>/<name>.yaml``; no plug-in is imported.
    """
    folders = [*Path.cwd().glob("plugins/conf"), *sorted(Path.cwd().glob("plugins/[!_.]*/conf"))]
    folders += [package / "conf" for package in plugin_packages(KINDS)]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


class PluginConfigurations(SearchPathPlugin):
    """Hydra's search path: gaigs's own files, then those of plug-ins, then the constructors of
    components.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_conf_dirs():
            search_path.append(provider="gaigs plug-in", path=f"file://{folder}")
        search_path.append(provider="constructors", path=f"{Constructors.scheme()}://")


class Constructors(ConfigSource):
    """The configuration of a component: ``name``, and its constructor's options with defaults.

    A file of the same name takes it from the group ``constructors/<kind>``.
    """

    def __init__(self, provider: str, path: str):
        super().__init__(provider, path)
        self.found = {
            f"{kind}/{name}": (kind, name)
            for kind in CONSTRUCTED
            for name in registry(kind).names()
        }

    def __deepcopy__(self, memo: dict) -> "Constructors":
        return self  # Hydra copies its sources for each group that it lists

    @staticmethod
    def scheme() -> str:
        return "constructors"

    def load_config(self, config_path: str) -> ConfigResult:
        kind, name = self.found[config_path.removesuffix(".yaml").removeprefix("constructors/")]
        node = OmegaConf.create({**registry(kind).options(name), "name": name})
        return ConfigResult(self.provider, f"{self.scheme()}://", node, {"package": None})

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.rstrip("/") in ("", *CONSTRUCTED)

    def is_config(self, config_path: str) -> bool:
        return config_path.removesuffix(".yaml").removeprefix("constructors/") in self.found

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        files: list[str] = []
        components = [f"{name}.yaml" for kind, name in self.found.values() if kind == config_path]
        for name in components if config_path else CONSTRUCTED:
            self._list_add_result(files, f"{config_path}/{name}".strip("/"), name, results_filter)
        return sorted(set(files))


def differences(there: Mapping, here: Mapping, prefix: str = "") -> dict[str, tuple]:
    """The values of two configurations at the keys in which they differ, joined by dots and sorted.

    Of a part with another name, the key ``name`` is the only one.
    """
    found: dict[str, tuple] = {}
    for key in sorted(there.keys() | here.keys()):
        path, a, b = f"{prefix}{key}", there.get(key), here.get(key)
        if path in HARMLESS or a == b:
            continue
        if not isinstance(a, dict) or not isinstance(b, dict):
            found[path] = a, b
        elif a.get("name") != b.get("name"):
            found[f"{path}.name"] = a.get("name"), b.get("name")
        else:
            found |= differences(a, b, f"{path}.")
    return found


def check(config: dict) -> None:
    """Checks the keys of a configuration and their values; raises a ``TypeError`` or a
    ``ValueError``.
    """
    if unknown := [key for key in config if key not in KEYS]:
        raise ValueError(
            f"the configuration has no key {suggest(unknown[0], KEYS)}; it has: {listed(sorted(KEYS))}"
        )
    if missing := sorted(KEYS.keys() - {*MAY_BE_NULL} - config.keys()):
        raise ValueError(
            f"the configuration needs the key {missing[0]!r}; conf/config.yaml has them all"
        )
    for key, annotation in KEYS.items():
        check_type(key, config.get(key), annotation)
    for kind in KINDS:
        if config.get(kind) is not None:
            check_type(f"{kind}.name", config[kind].get("name"), str)
    task = {"name": str, "trend": dict | None, "baselines": list[dict | str]}
    for key, value in config["task"].items():
        if key not in task:
            raise ValueError(f"task has no key {suggest(key, task)}; it has: {', '.join(task)}")
        check_type(f"task.{key}", value, task[key])
    if not 0 <= config["seed"] < 2**32:
        raise ValueError(f"seed must be in 0..{2**32 - 1}, got {config['seed']}")
    if config["save_every"] < 0:
        raise ValueError(f"save_every must be at least 0 s, got {config['save_every']}")


def compose(*overrides: str, **options) -> dict:
    """The configuration of a run, as the command line makes it: presets, then overrides, then
    options.

    Args:
        overrides: Command-line words, e.g. ``"+experiment=mirrored"`` or
            ``"trainer.max_steps=300"``.
        options: Values by their keys, ``**{"trainer.max_steps": 300}``, or by an option's name
            alone if only one part has it, ``max_steps=300``. A part is chosen by its name,
            ``tokenizer="ga"``, by a mapping with a name and options, or by an object.

    Returns:
        Plain dictionaries, lists, numbers and strings: the argument of ``gaigs.run``.

    Raises:
        TypeError: A value has the wrong type.
        ValueError: A word or an option is unknown, a value is out of range, or a mandatory value is
            missing.

    Example:
        >>> configuration = gaigs.compose("+experiment=mirrored", "trainer.max_steps=300", planes=8)
        >>> configuration["model"]["name"], configuration["trainer"]["max_steps"], configuration["placement"]["planes"]
        ('mirrored', 300, 8)
    """
    return composed(overrides, options)


def composed(overrides: Sequence[str], options: Mapping, sections: Sequence[str] = ()) -> dict:
    """Like ``compose``; with sections, options are looked up in these sections only."""
    choices, values = _choices(options)
    with composing:
        running = GlobalHydra.instance()
        before = running.hydra
        paths = [] if before is None else running.config_loader().get_search_path().get_path()
        try:
            with contextlib.ExitStack() as stack:
                # Within a run of the command line Hydra allows no second instance.
                if not any(str(conf_dir()) in str(element.path) for element in paths):
                    running.clear()
                    stack.enter_context(initialize_config_dir(str(conf_dir()), version_base="1.3"))
                config = hydra.compose("config", [*overrides, *choices])
        except Exception as error:
            message = explain(error)
            if message is None:
                raise
            raise ValueError(message) from None
        finally:
            GlobalHydra.instance().hydra = before
    for key, value in values.items():
        is_new = key.startswith("+") or key in CHOSEN  # a part's constructor knows its keys
        path = _path(config, key, sections)
        OmegaConf.update(config, path, value, merge=isinstance(value, Mapping), force_add=is_new)
    plain = resolve(config)
    check(plain)
    return plain


def files_of(kind: str, name: str) -> list[Path]:
    """The configuration files of that kind and name, of gaigs and of plug-ins."""
    files = (folder / kind / f"{name}.yaml" for folder in (conf_dir(), *plugin_conf_dirs()))
    return [file for file in files if file.is_file()]


def preset(model: str, task: str) -> list[str]:
    """The command-line words for a model and a task, with their experiment if there is one."""
    names = (task,) if model == "gaigs" else (f"{model}_{task}", model)
    experiment = [f"+experiment={name}" for name in names if files_of("experiment", name)][:1]
    return [*experiment, f"model={model}", *([f"task={task}"] if files_of("task", task) else [])]


def resolve(config: DictConfig) -> dict:
    """A composed configuration in plain dictionaries, unchecked; a baseline's name becomes its
    configuration.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = error.full_key
        words = {"model.trend": "kriging=true", "model.members": "ensemble=5"}
        if key in words and config.model.name in ("kriging", "ensemble"):
            message = f"model {config.model.name!r} is made from trained models; set {words[key]}, with any model"
            raise ValueError(message) from None
        examples = {
            "split.edge": "1.0, the edge of a cube [m]",
            "split.length": "50, the samples of a run",
        }
        examples |= {
            "split.train": "100, the training places",
            "data.root": "/path/to/folder",
            "data.file": "/path/to/file",
        }
        example = examples.get(key, "...")
        raise ValueError(
            f"{key} must be given, as it has no default; add {key}={example}"
        ) from None
    except OmegaConfBaseException as error:
        raise ValueError(
            f"the configuration is not complete: {' '.join(str(error).split())}"
        ) from error
    if isinstance(plain.get("baselines"), list):
        plain["baselines"] = [
            {"name": base} if isinstance(base, str) else base for base in plain["baselines"]
        ]
    return plain


def _choices(options: Mapping) -> tuple[list[str], dict]:
    """The command-line words that choose parts, and the values of all other options."""
    choices, values = [], {}
    for key, value in options.items():
        value = storable(value, key)
        if key not in CHOSEN:
            values[key] = value
        elif isinstance(value, str):
            choices.append(f"{key}={value}")
        elif value is None and key in MAY_BE_NULL:
            values[key] = None
        elif isinstance(value, Mapping):
            choices += [f"{key}={value['name']}"] if "name" in value else []
            values[key] = {name: entry for name, entry in value.items() if name != "name"}
        else:
            raise TypeError(
                f"{key} must be a name, a mapping with a name and options, or a component, got {value!r}"
            )
    return choices, values


def _path(config: DictConfig, name: str, sections: Sequence[str]) -> str:
    """The full key of an option: the name itself if it has dots or is a top-level key, else the
    part's key.
    """
    is_new, name = name.startswith("+"), name.removeprefix("+")
    plain: Any = OmegaConf.to_container(config)
    if not sections and name in CHOSEN:
        return name
    if name.partition(".")[0] in sections or (not sections and ("." in name or name in plain)):
        place, _, last = name.rpartition(".")
        parent = OmegaConf.select(config, place) if place else config
        has = sorted(map(str, parent)) if isinstance(parent, DictConfig) else []
        is_open = isinstance(parent, DictConfig) and OmegaConf.is_struct(parent) is False
        if not (is_new or last in has or is_open):
            raise ValueError(f"{place} has no key {suggest(last, has)}; it has: {listed(has)}")
        return name
    searched = sections or plain.keys() - {
        *READ_BY_LINKS,
        "survey",
        "locate",
        "export",
        "view",
        "figures",
    }
    keys = {key: key.rpartition(".")[2] for key in _options(plain, searched)}
    found = sorted(key for key, last in keys.items() if last == name)
    if (
        not sections and f"model.{name}" in found
    ):  # a model's own option wins over those of its parts
        return f"model.{name}"
    if len(found) > 1:
        raise ValueError(f"{name} is an option of several parts; say which: {', '.join(found)}")
    if found:
        return found[0]
    for section in () if sections else READ_BY_LINKS:
        if name in plain[section]:
            raise ValueError(
                f"{name} is an option of {section}, which gaigs.links reads; say {section}.{name}"
            )
    has = sorted({*keys.values()} - {"name"})
    if not sections:
        raise ValueError(
            f"there is no option {suggest(name, {*has, *plain})}; python -m gaigs --help lists all"
        )
    parts = " and ".join(f"{section} {plain[section]['name']!r}" for section in sections)
    raise ValueError(
        f"there is no option {suggest(name, has)} of {parts}; there are: {', '.join(has)}"
    )


def _options(config: Mapping, parts: Iterable[str], prefix: str = "") -> Iterator[str]:
    """Full keys of all options of some parts; a reference ${...} to another part is left out."""
    for part in parts:
        value = config[part]
        if isinstance(value, Mapping) and (not prefix or "name" in value):
            yield from _options(value, value.keys(), f"{prefix}{part}.")
        elif prefix and not str(value).startswith("${"):
            yield f"{prefix}{part}"


def nearest(word: str, config: Mapping) -> str:
    """Full keys of the options with the name most similar to a word, joined by or; empty if none is
    similar.
    """
    parts = config.keys() - {"hydra", "survey", "locate", "export", "view"}
    keys = {key: key.rpartition(".")[2] for key in (*parts, *_options(config, parts))}
    near = similar(word, {*keys.values()} - {"name"})
    found = [key for key in near if key in config] or sorted(
        key for key, name in keys.items() if name in near
    )
    return " or ".join(found)


def wrong_flag() -> str | None:
    """The message for a flag on the command line that Hydra does not have; None if it has all."""
    _, unknown = get_args_parser().parse_known_args()
    for flag in (word.partition("=")[0] for word in unknown if word.startswith("-")):
        near = nearest(flag.lstrip("-").replace("-", "_"), composed([], {})) or "trainer.max_steps"
        return f"there is no flag {flag}; options have no dashes, such as {near}=..."
    return None


def explain(error: Exception) -> str | None:
    """The message of an error of a job or of a command line that Hydra cannot compose; None for any
    other error.
    """
    is_known = isinstance(error, HydraException | OmegaConfBaseException | ValueError)
    is_composing = any(
        frame.name == "load_configuration" for frame in traceback.extract_tb(error.__traceback__)
    )
    of_system = isinstance(error, MemoryError) or getattr(error, "errno", None) is not None
    if not is_known and (of_system or not is_composing):
        return None
    cause, words = error.__cause__, " ".join(str(error).split())
    match error, cause:
        case _, ConfigAttributeError(full_key=str(key)) | ConfigKeyError(full_key=str(key)):
            place, _, word = key.rpartition(".")
            has = [str(name) for name in cause.parent_node]
            part = (
                f"{place} {cause.parent_node['name']!r}"
                if "name" in has
                else place or "the configuration"
            )
            plain: Any = OmegaConf.to_container(cause.parent_node)
            if not place and (near := nearest(word, plain)):
                return f"{part} has no key {word!r}; did you mean {near}?"
            hint = (
                f"\nin a sweep write ++{key}=... for a key that only the swept {place} has"
                if is_multirun()
                else ""
            )
            return f"{part} has no key {suggest(word, has)}; it has: {listed(sorted(has))}{hint}"
        case MissingConfigException(missing_cfg_file=str(file), options=list(names)), _:
            kind, _, name = file.rpartition("/")
            unknown = f"there is no {kind} {suggest(name, names)}; there are: {listed(names)}"
            return not_installed(kind, name) or unknown
        case HydraException(), _ if str(error).startswith("gaigs: "):  # the message of a job
            reason = f"\n{cause}" if isinstance(cause, OmegaConfBaseException) else ""
            return f"{str(error).removeprefix('gaigs: ')}{reason}"
        case HydraException(), _:
            return " ".join(f"Hydra cannot read it: {words} {cause or ''}".split())
        case ImportError(), _:  # of a plug-in whose constructor has the options
            return words
        case _ if words.startswith("Config group"):  # null or a number as a file's name
            return f"a part is chosen by the name of its file ({error}); ~density leaves it out"
    about = "; its files choose each other in a circle" if isinstance(error, RecursionError) else ""
    return (
        _unreadable() or f"Hydra cannot join command line and configuration files ({words}){about}"
    )


def _unreadable() -> str | None:
    """The message for the first configuration file that cannot be parsed; None if all can."""
    for file in (
        file
        for folder in (conf_dir(), *plugin_conf_dirs())
        for file in sorted(folder.rglob("*.yaml"))
    ):
        try:
            OmegaConf.load(file)
        except Exception as error:  # any error of the YAML parser
            cause = (
                "not UTF-8"
                if isinstance(error, UnicodeDecodeError)
                else " ".join(str(error).split())
            )
            if getattr(error, "errno", None) is None:
                return f"cannot parse {file}: {cause}"
    return None


def is_multirun() -> bool:
    """True if the command line asks for a sweep."""
    return any(word in ("-m", "--multirun") for word in sys.argv)


def run_folder(overrides: str) -> str:
    """The folder name of a job from its overrides, at most 200 bytes; most file systems allow 255."""
    name = overrides.replace("/", "_") or "defaults"
    if name == overrides and len(name.encode()) <= 200:
        return name
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return f"{name.encode()[:187].decode(errors='ignore')}-{digest}"


def installed(*names: str) -> str:
    """The installed models of a list, joined by commas for a sweep; the log names the others."""
    known = registry("model").names()
    if missing := [name for name in names if name not in known]:
        log.warning("left out, as not installed: model=%s", ",".join(missing))
    return ",".join(name for name in names if name in known)


def known(kind: str, name: str, otherwise: str) -> str:
    """The name if a configuration file or a component has it, else the other one: for choices by
    task.
    """
    return name if files_of(kind, name) or name in registry(kind).names() else otherwise


def by_task(values: Mapping, otherwise: object, *, _root_: DictConfig) -> object:
    """The value of a run's task, by the task's name."""
    return values.get(_root_.task.name, otherwise)


def launcher(name: str) -> str:
    """The launcher if joblib is installed, else Hydra's own, which runs one job at a time."""
    try:
        metadata.version("hydra-joblib-launcher")
    except metadata.PackageNotFoundError:
        return "basic"
    return name


# At import: a launcher's workers need them too.
OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
OmegaConf.register_new_resolver("installed", installed, replace=True, use_cache=True)
OmegaConf.register_new_resolver("known", known, replace=True)
OmegaConf.register_new_resolver("by_task", by_task, replace=True)
OmegaConf.register_new_resolver("launcher", launcher, replace=True)
# Hydra refuses a new key on the command line, but for those of a mapping that says it takes them.
ConfigStore.instance().store(name="open", node=OmegaConf.create({}, flags={"struct": False}))
if PluginConfigurations not in Plugins.instance().discover(SearchPathPlugin):
    Plugins.instance().register(Constructors)
    Plugins.instance().register(PluginConfigurations)
