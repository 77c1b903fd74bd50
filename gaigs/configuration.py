"""Configurations: the files that Hydra joins, the check of the result, and the message of an error in it."""

import hashlib
import logging
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

import hydra
from hydra import initialize_config_dir
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

from gaigs.registry import KINDS, check_type, find_holders, registry, storable, suggest

log = logging.getLogger(__name__)

HARMLESS = (
    "command", "save_every", "tensorboard", "threads", "trainer.enable_progress_bar", "trainer.enable_model_summary"
)  # fmt: skip
"""Keys that change no result: a run may be resumed with other values."""

MAY_BE_NULL = ("gaussians", "density", "benchmark", "projection", "rasterizer")
"""Optional parts."""

KEYS = {
    **dict.fromkeys((*KINDS, "trainer"), dict), **dict.fromkeys(MAY_BE_NULL, dict | None),
    "kriging": bool, "kriging_fallback": dict | None, "baselines": list[dict], "command": str, "seed": int,
    "save_every": float, "tensorboard": bool, "threads": int | None,
}  # fmt: skip
"""Top-level keys and their types."""

CHOSEN = (*KINDS, "gaussians", "density", "trainer")
"""Keys that choose one file or component."""

CONSTRUCTED = tuple(kind for kind in KINDS if kind not in ("task", "training", "benchmark"))
"""Kinds whose components need no configuration file: the options are read from their constructors."""


def conf_dir() -> Path:
    """The folder of gaigs's own configuration: in the installed package, or beside the package in a checkout."""
    here = Path(__file__).parent
    packaged = here / "conf"
    return packaged if packaged.is_dir() else here.parent / "conf"


def plugin_conf_dirs() -> list[Path]:
    """The conf folders of plug-ins, which hold ``<kind>/<name>.yaml``; no plug-in is imported.

    They are ``plugins/conf``, ``plugins/<folder>/conf``, and ``<package>/conf`` of each package with an entry point of
    gaigs.
    """
    folders = [*Path.cwd().glob("plugins/conf"), *sorted(Path.cwd().glob("plugins/[!_.]*/conf"))]
    for holder in (holder for kind in KINDS for holder in find_holders(kind)[0]):
        if holder.file is None and holder.folder is not None:
            folders.append(holder.folder / "conf")
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


class PluginConfigurations(SearchPathPlugin):
    """Hydra's search path: gaigs's own files, then those of plug-ins, then the constructors of components."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_conf_dirs():
            search_path.append(provider="gaigs plug-in", path=f"file://{folder}")
        search_path.append(provider="constructors", path=f"{Constructors.scheme()}://")


class Constructors(ConfigSource):
    """The configuration of a component without a file: ``name``, and its constructor's options with defaults."""

    def __init__(self, provider: str, path: str):
        super().__init__(provider, path)
        self.found = {f"{kind}/{name}": (kind, name) for kind in CONSTRUCTED for name in registry(kind).names()}

    def __deepcopy__(self, memo: dict) -> "Constructors":
        return self  # Hydra copies its sources for each group that it lists

    @staticmethod
    def scheme() -> str:
        return "constructors"

    def load_config(self, config_path: str) -> ConfigResult:
        kind, name = self.found[config_path.removesuffix(".yaml")]
        node = OmegaConf.create({**registry(kind).options(name), "name": name})
        return ConfigResult(self.provider, f"{self.scheme()}://", node, {"package": None})

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.rstrip("/") in ("", *CONSTRUCTED)

    def is_config(self, config_path: str) -> bool:
        return config_path.removesuffix(".yaml") in self.found

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        files: list[str] = []
        components = [f"{name}.yaml" for kind, name in self.found.values() if kind == config_path]
        for name in components if config_path else CONSTRUCTED:
            self._list_add_result(files, f"{config_path}/{name}".strip("/"), name, results_filter)
        return sorted(set(files))


def differences(there: dict, here: dict) -> dict[str, tuple]:
    """The values of two configurations at the keys in which they differ, joined by dots and sorted."""
    there, here = _flat(there), _flat(here)
    keys = sorted((there.keys() | here.keys()) - set(HARMLESS))
    return {key: (there.get(key), here.get(key)) for key in keys if there.get(key) != here.get(key)}


def check(config: dict) -> None:
    """Checks the keys of a configuration and their values.

    Raises:
        TypeError: A value has the wrong type.
        ValueError: A key is unknown or missing, or a value out of range.
    """
    if unknown := [key for key in config if key not in KEYS]:
        listed = ", ".join(sorted(KEYS))
        raise ValueError(f"the configuration has no key {suggest(unknown[0], KEYS)}; there are: {listed}")
    if missing := sorted(KEYS.keys() - {*MAY_BE_NULL} - config.keys()):
        raise ValueError(f"the configuration needs the key {missing[0]!r}; conf/config.yaml has them all")
    for key, annotation in KEYS.items():
        check_type(key, config.get(key), annotation)
    if config.get("benchmark") is not None and config["command"] != "benchmark":
        raise ValueError(
            f"benchmark={config['benchmark'].get('name')} needs command=benchmark, got command={config['command']}; "
            "add command=benchmark, or leave out the benchmark"
        )
    if config.get("benchmark") is None and config["command"] == "benchmark":
        raise ValueError("command=benchmark needs a benchmark; add benchmark=accuracy, budgets, rasterizer or step")
    for kind in KINDS[: KINDS.index("benchmark")]:
        if config.get(kind) is not None:
            check_type(f"{kind}.name", config[kind].get("name"), str)
    task_keys = {"name": str, "trend": dict | None, "baselines": list[dict | str]}
    for key, value in config["task"].items():
        if key not in task_keys:
            raise ValueError(f"task has no key {suggest(key, task_keys)}; it has: {', '.join(task_keys)}")
        check_type(f"task.{key}", value, task_keys[key])
    if not 0 <= config["seed"] < 2**32:
        raise ValueError(f"seed must be in 0..{2**32 - 1}, got {config['seed']}")
    if config["save_every"] < 0:
        raise ValueError(f"save_every must be at least 0 s, got {config['save_every']}")


def compose(*overrides: str, **options) -> dict:
    """The configuration of a run, as the command line makes it: presets, then overrides, then options.

    Args:
        overrides: Command-line words, e.g. ``"+experiment=mirrored"`` or ``"trainer.max_steps=300"``.
        options: Values by their keys, ``**{"trainer.max_steps": 300}``, or by an option's name alone if only one part
            has it, ``max_steps=300``. A part is chosen by its name, ``tokenizer="ga"``, by a mapping with a name and
            options, or by an object.

    Returns:
        Plain dictionaries, lists, numbers and strings: the argument of ``gaigs.run``.

    Raises:
        TypeError: A value has the wrong type.
        ValueError: A word or an option is unknown, a value is out of range, or a mandatory value is missing.

    Example:
        >>> configuration = gaigs.compose("+experiment=mirrored", "trainer.max_steps=300", planes=8)
        >>> configuration["model"]["name"], configuration["trainer"]["max_steps"], configuration["placement"]["planes"]
        ('mirrored', 300, 8)
    """
    return composed(overrides, options)


def composed(overrides: Sequence[str], options: Mapping, sections: Sequence[str] = ()) -> dict:
    """Like ``compose``; with sections, options are looked up in these sections only."""
    choices, values = _choices(options)
    running = GlobalHydra.instance()
    before = running.hydra
    is_ours = before is not None and any(
        str(conf_dir()) in str(element.path) for element in running.config_loader().get_search_path().get_path()
    )
    try:
        if is_ours:  # within a run of the command line, where Hydra allows no second instance
            config = hydra.compose("config", [*overrides, *choices])
        else:
            running.clear()
            with initialize_config_dir(str(conf_dir()), version_base="1.3"):
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


def has_file(kind: str, name: str) -> bool:
    """True if gaigs or a plug-in has a configuration file of that kind and name."""
    return any((folder / kind / f"{name}.yaml").is_file() for folder in (conf_dir(), *plugin_conf_dirs()))


def preset(model: str, task: str) -> list[str]:
    """The command-line words for a model and a task, with their experiment if there is one."""
    names = (task,) if model == "gaigs" else (f"{model}_{task}", model)
    experiment = [f"+experiment={name}" for name in names if has_file("experiment", name)][:1]
    return [*experiment, f"model={model}", *([f"task={task}"] if has_file("task", task) else [])]


def resolve(config: DictConfig) -> dict:
    """A composed configuration in plain dictionaries, unchecked; a baseline's name becomes its configuration.

    Raises:
        ValueError: A mandatory value or the key of a reference is missing.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise ValueError(f"{error.full_key} must be given, as it has no default; add {error.full_key}=...") from None
    except OmegaConfBaseException as error:
        raise ValueError(f"the configuration is not complete: {' '.join(str(error).split())}") from error
    if isinstance(plain.get("baselines"), list):
        plain["baselines"] = [{"name": base} if isinstance(base, str) else base for base in plain["baselines"]]
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
            raise TypeError(f"{key} must be a name, a mapping with a name and options, or a component, got {value!r}")
    return choices, values


def _path(config: DictConfig, name: str, sections: Sequence[str]) -> str:
    """The full key of an option: the name itself if it has dots or is a top-level key, else the part's key.

    Raises:
        ValueError: No part has such a key, or several have.
    """
    is_new, name = name.startswith("+"), name.removeprefix("+")
    plain = OmegaConf.to_container(config)
    if sections and name.partition(".")[0] not in sections:
        places = [f"{section}.{name}" for section in sections if name in plain[section]]
        if len(places) > 1:
            raise ValueError(f"{name} is an option of {' and '.join(sections)}; say which: {', '.join(places)}")
        if not places:
            has = sorted({key for section in sections for key in plain[section]} - {"name"})
            parts = " and ".join(f"{section} {plain[section]['name']!r}" for section in sections)
            raise ValueError(f"there is no option {suggest(name, has)} of {parts}; there are: {', '.join(has)}")
        return places[0]
    if name in CHOSEN:
        return name
    if "." in name or name in plain:
        place, _, last = name.rpartition(".")
        parent = plain
        for part in filter(None, place.split(".")):
            parent = parent.get(part) if isinstance(parent, dict) else None
        has = parent if isinstance(parent, dict) else {}
        is_open = isinstance(parent, dict) and OmegaConf.is_struct(OmegaConf.select(config, place)) is False
        if not (is_new or last in has or is_open):
            raise ValueError(f"{place} has no key {suggest(last, has)}; it has: {_listed(sorted(has)) or 'none'}")
        return name
    found = {key for key in _options(plain, "") if key.rpartition(".")[2] == name}
    found = found & {f"model.{name}"} or found  # a model's own option wins over those of its parts
    if len(found) == 1:
        return found.pop()
    if found:
        raise ValueError(f"{name} is an option of several parts; say which: {', '.join(sorted(found))}")
    known = {key.rpartition(".")[2] for key in _options(plain, "")} | plain.keys()
    for section in ("data", "split", "task"):
        if name in plain[section]:
            raise ValueError(f"{name} is an option of {section}, which gaigs.links reads; say {section}.{name}")
    raise ValueError(f"there is no option {suggest(name, known)}; python -m gaigs --help lists all")


def _options(config: Mapping, prefix: str) -> Iterator[str]:
    """Keys of all options of parts; a reference ${...} to another part is left out."""
    for key, value in config.items():
        is_part = isinstance(value, Mapping) and (not prefix or "name" in value)
        if is_part and key not in ("data", "split", "task"):
            yield from _options(value, f"{prefix}{key}.")
        elif prefix and not str(value).startswith("${"):
            yield f"{prefix}{key}"


def explain(error: Exception) -> str | None:
    """The message of an error of a job or of a command line that Hydra cannot compose; None for any other error."""
    is_known = isinstance(error, HydraException | OmegaConfBaseException | ValueError)
    is_composing = any(frame.name == "load_configuration" for frame in traceback.extract_tb(error.__traceback__))
    of_system = isinstance(error, MemoryError) or getattr(error, "errno", None) is not None
    if not is_known and (of_system or not is_composing):
        return None
    cause = error.__cause__
    match error, cause:
        case _, ConfigAttributeError(full_key=str(key)) | ConfigKeyError(full_key=str(key)):
            place, _, word = key.rpartition(".")
            has = [str(name) for name in cause.parent_node]
            told = f"{place or 'the configuration'} has no key {suggest(word, has)}; it has: {_listed(sorted(has))}"
            return f"{told}\nall parts of a sweep must have its keys; sweep this part alone" if is_multirun() else told
        case MissingConfigException(missing_cfg_file=str(file), options=list(names)), _:
            kind, _, name = file.rpartition("/")
            packages = OmegaConf.load(conf_dir() / "published.yaml").packages if kind == "model" else {}
            if name in packages:
                package, folder = packages[name], packages[name].removeprefix("gaigs-").replace("-", "_")
                return (
                    f"model {name!r} is in the package {package}, which is not installed\n"
                    f"pip install {package}, or in a copy of the repository pip install plugins/{folder}"
                )
            return f"there is no {kind} {suggest(name, names)}; there are: {_listed(names)}"
        case HydraException(), _ if str(error).startswith("gaigs: "):  # the message of a job
            reason = f"\n{cause}" if isinstance(cause, OmegaConfBaseException) else ""
            return f"{str(error).removeprefix('gaigs: ')}{reason}"
        case HydraException(), _:
            words = " ".join(f"{error} {cause or ''}".split())
            return f"Hydra cannot read it: {words}"
        case _ if not str(error).startswith("Config group"):
            about = "; its files choose each other in a circle" if isinstance(error, RecursionError) else ""
            told = f"Hydra cannot join command line and configuration files ({' '.join(str(error).split())}){about}"
            return _unreadable() or told
        case _:  # null or a number as a file's name
            return f"a part is chosen by the name of its file ({error}); ~density leaves it out"


def _unreadable() -> str | None:
    """The message for the first configuration file that cannot be parsed; None if all can."""
    for file in (file for folder in (conf_dir(), *plugin_conf_dirs()) for file in sorted(folder.rglob("*.yaml"))):
        try:
            OmegaConf.load(file)
        except UnicodeDecodeError:
            return f"cannot parse {file}: not UTF-8"
        except Exception as error:  # any error of the YAML parser
            if getattr(error, "errno", None) is None:
                return f"cannot parse {file}: {' '.join(str(error).split())}"
    return None


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def is_multirun() -> bool:
    """True if the command line asks for a sweep."""
    return any(word in ("-m", "--multirun") for word in sys.argv)


def _flat(config: dict, prefix: str = "") -> dict:
    """Nested keys joined by dots."""
    flat = {}
    for key, value in config.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def run_folder(overrides: str) -> str:
    """The folder name of a job from its overrides, at most 200 bytes; most file systems allow 255."""
    name = overrides.replace("/", "_") or "defaults"
    if name == overrides and len(name.encode()) <= 200:
        return name
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return name.encode()[:187].decode(errors="ignore") + "-" + digest


def installed(*names: str) -> str:
    """The installed models of a list, joined by commas for a sweep; the log names the others."""
    holders, _ = find_holders("model")
    known = {holder.name for holder in holders}
    if missing := [name for name in names if name not in known]:
        log.warning("left out, as not installed: model=%s", ",".join(missing))
    return ",".join(name for name in names if name in known)


def known(kind: str, name: str, otherwise: str) -> str:
    """The name if a configuration file or a component has it, else the other one: for choices by task."""
    return name if has_file(kind, name) or name in registry(kind).names() else otherwise


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
