"""Where Hydra finds gaigs's configuration files and those of plug-ins, and how two configurations differ."""

import hashlib
import logging
import traceback
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

import hydra
from hydra import initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
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
"""Keys that change nothing of what a run finds: one that goes on may have others."""

MAY_BE_NULL = ("gaussians", "density", "benchmark")
"""Choices that a configuration may be without."""

KEYS = {
    **dict.fromkeys((*KINDS, "trainer"), dict), **dict.fromkeys(MAY_BE_NULL, dict | None),
    "kriging": bool, "kriging_folds": int, "baselines": list[dict], "command": str, "seed": int, "save_every": float,
    "tensorboard": bool, "threads": int | None,
}  # fmt: skip
"""What stands at the top of a configuration, and of which type it is."""

TASK_KEYS = {"name": str, "trend": dict | None, "baselines": list[dict]}
"""The same under ``task``, of which all but the name may be missing."""

CHOSEN = (*KINDS, "gaussians", "density", "trainer")
"""Keys of which each is a choice of one file or component."""

CONSTRUCTED = tuple(kind for kind in KINDS if kind not in ("task", "training", "benchmark"))
"""Kinds whose components need no configuration file: their constructors say what there is to set."""

LONGEST = 200
"""Bytes in the name of a job's folder; most file systems end at 255."""


def conf_dir() -> Path:
    """The folder of gaigs's own configuration: inside the package where it is installed, beside it in a checkout."""
    here = Path(__file__).parent
    packaged = here / "conf"
    return packaged if packaged.is_dir() else here.parent / "conf"


def plugin_conf_dirs() -> list[Path]:
    """The conf folders of plug-ins, each with ``<kind>/<name>.yaml`` inside.

    They are ``plugins/conf``, ``plugins/<folder>/conf``, and ``<package>/conf`` of every package that an entry point of
    ours points into. No plug-in is imported.
    """
    folders = [*Path.cwd().glob("plugins/conf"), *sorted(Path.cwd().glob("plugins/[!_.]*/conf"))]
    for holder in (holder for kind in KINDS for holder in find_holders(kind)[0]):
        if holder.file is None and holder.folder is not None:
            folders.append(holder.folder / "conf")
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


class PluginConfigurations(SearchPathPlugin):
    """Puts the conf folders of plug-ins behind gaigs's own, so that none of them replaces a file of ours.

    Behind them all comes for each component its constructor: the options with their defaults.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_conf_dirs():
            search_path.append(provider="gaigs plug-in", path=f"file://{folder}")
        search_path.append(provider="constructors", path=f"{Constructors.scheme()}://")


class Constructors(ConfigSource):
    """What Hydra finds where a component has no file: ``name``, and its constructor's options with their defaults."""

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
        known = (
            CONSTRUCTED
            if config_path == ""
            else [key.split("/")[1] for key in self.found if key.startswith(f"{config_path}/")]
        )
        for name in known:
            name = name if config_path == "" else f"{name}.yaml"
            self._list_add_result(files, f"{config_path}/{name}".strip("/"), name, results_filter)
        return sorted(set(files))


def differences(there: dict, here: dict) -> dict[str, tuple]:
    """What two resolved configurations have at the keys, joined by dots, in which their runs may differ; sorted."""
    there, here = _flat(there), _flat(here)
    keys = sorted((there.keys() | here.keys()) - set(HARMLESS))
    return {key: (there.get(key), here.get(key)) for key in keys if there.get(key) != here.get(key)}


def check(config: dict) -> None:
    """Sees to it that a configuration has the keys that there are, and no others, with values that suit them.

    Raises:
        TypeError: A value is not of its key's type.
        ValueError: A key is unknown or missing, or its value out of range.
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
        raise ValueError("command=benchmark needs a benchmark, and it was left out; add benchmark=all")
    for kind in KINDS[: KINDS.index("benchmark")]:
        check_type(f"{kind}.name", config[kind].get("name"), str)
    for key, value in config["task"].items():
        if key not in TASK_KEYS:
            raise ValueError(f"task has no key {suggest(key, TASK_KEYS)}; it has: {', '.join(TASK_KEYS)}")
        check_type(f"task.{key}", value, TASK_KEYS[key])
    if not 0 <= config["seed"] < 2**32:
        raise ValueError(f"seed must be in 0..{2**32 - 1}, got {config['seed']}")
    if config["save_every"] < 0:
        raise ValueError(f"save_every must be at least 0 s, got {config['save_every']}")


def compose(*overrides: str, **options) -> dict:
    """The whole configuration of a run, as the command line makes it: presets, then overrides, then options.

    Args:
        overrides: Words of the command line, e.g. ``"+experiment=mirrored"`` or ``"trainer.max_steps=300"``.
        options: Values by their keys, ``**{"trainer.max_steps": 300}``, or by an option's name alone where only one
            part has it, ``max_steps=300``. A part is chosen by its name, ``tokenizer="ga"``, by a mapping with a name
            and options, or by an object.

    Returns:
        Plain dictionaries, lists, numbers and strings: what ``gaigs.run`` takes.

    Raises:
        TypeError: A value is not of its key's type.
        ValueError: A word or an option is unknown, a value out of range, or one that must be given is missing.

    Example:
        >>> configuration = gaigs.compose("+experiment=mirrored", "trainer.max_steps=300", planes=8)
        >>> configuration["model"]["name"], configuration["trainer"]["max_steps"], configuration["placement"]["planes"]
        ('mirrored', 300, 8)
    """
    return composed(overrides, options)


def composed(overrides: Sequence[str], options: Mapping, sections: Sequence[str] = ()) -> dict:
    """As ``compose``; with sections, the options are those of these alone."""
    choices, values = _choices(options)
    running = GlobalHydra.instance()
    before = running.hydra
    is_ours = before is not None and any(
        str(conf_dir()) in str(element.path) for element in running.config_loader().get_search_path().get_path()
    )
    try:
        if is_ours:  # Hydra's main, which allows no other
            config = hydra.compose("config", [*overrides, *choices])
        else:
            running.clear()
            with initialize_config_dir(str(conf_dir()), version_base="1.3"):
                config = hydra.compose("config", [*overrides, *choices])
    except Exception as error:
        if not isinstance(error, HydraException | OmegaConfBaseException | ValueError) and not is_composing(error):
            raise
        raise ValueError(explain(error)) from None
    finally:
        GlobalHydra.instance().hydra = before
    for key, value in values.items():
        is_new = key.startswith("+") or key in CHOSEN  # what a part has, its constructor knows
        path = _path(config, key, sections)
        OmegaConf.update(config, path, value, merge=isinstance(value, Mapping), force_add=is_new)
    return resolve(config)


def has_file(kind: str, name: str) -> bool:
    """Whether there is a configuration file of that kind and name, ours or a plug-in's."""
    return any((folder / kind / f"{name}.yaml").is_file() for folder in (conf_dir(), *plugin_conf_dirs()))


def preset(model: str, task: str) -> list[str]:
    """The command line's words for a model and the task of its links.

    That is the experiment of the model, of the model and the task, or, of GAI-GS, of the task, where there is one.
    """
    names = (task,) if model == "gaigs" else (f"{model}_{task}", model)
    experiment = [f"+experiment={name}" for name in names if has_file("experiment", name)][:1]
    return [*experiment, f"model={model}", *([f"task={task}"] if has_file("task", task) else [])]


def resolve(config: DictConfig) -> dict:
    """A composed configuration in plain dictionaries, checked.

    Raises:
        TypeError: A value is not of its key's type.
        ValueError: It is not complete, a key is unknown, or a value out of range.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise ValueError(f"{error.full_key} must be given, as it has no default; add {error.full_key}=...") from None
    except OmegaConfBaseException as error:
        raise ValueError(f"the configuration is not complete\n{error}") from error
    check(plain)
    return plain


def _choices(options: Mapping) -> tuple[list[str], dict]:
    """Of options the words that choose a part, and the values to be set then."""
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
    """The key that a name stands for: itself if there are dots in it or it stands at the top, else where a part has it.

    Raises:
        ValueError: There is no such key, or several parts have one.
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
        parent = plain
        for part in name.split(".")[:-1]:
            parent = parent.get(part) if isinstance(parent, dict) else None
        if not is_new and (not isinstance(parent, dict) or name.rpartition(".")[2] not in parent):
            has = parent if isinstance(parent, dict) else ()
            raise ValueError(
                f"{name.rpartition('.')[0]} has no key {suggest(name.rpartition('.')[2], has)}; it has: "
                f"{', '.join(sorted(has)) or 'none'}"
            )
        return name
    found = {key for key in _options(plain, "") if key.rpartition(".")[2] == name}
    # The model is joined from the parts; of its own options none is another's.
    found = found & {f"model.{name}"} or found
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
    """Keys of all options of parts; what parts are made of others refers to them by ${...}."""
    for key, value in config.items():
        is_part = isinstance(value, Mapping) and (not prefix or "name" in value)
        if is_part and key not in ("data", "split", "task"):
            yield from _options(value, f"{prefix}{key}.")
        elif prefix and not str(value).startswith("${"):
            yield f"{prefix}{key}"


def is_composing(error: Exception) -> bool:
    """Whether an error came up while Hydra read configuration files and joined them, and not in a job."""
    return any(frame.name == "load_configuration" for frame in traceback.extract_tb(error.__traceback__))


def unreadable() -> str | None:
    """What is wrong with the first configuration file that cannot be read, in one sentence; None where all can."""
    for file in (file for folder in (conf_dir(), *plugin_conf_dirs()) for file in sorted(folder.rglob("*.yaml"))):
        try:
            OmegaConf.load(file)
        except Exception as error:  # whatever YAML meets
            if getattr(error, "errno", None) is not None:  # of the system, and not of what is in the file
                continue
            cause = " ".join(str(error).split())
            return f"{file} must be a YAML file in UTF-8, and is none ({cause}); mend it, or take it away"
    return None


def explain(error: Exception) -> str:
    """What is wrong with a command line of which Hydra makes no configuration, in one sentence."""
    cause = error.__cause__
    match error, cause:
        case _, ConfigAttributeError(full_key=str(key)) | ConfigKeyError(full_key=str(key)):
            has = [str(name) for name in cause.parent_node]
            place = key.rpartition(".")[0] or "the configuration"
            word = suggest(key.rpartition(".")[2], has)
            return f"{place} has no key {word}; it has: {', '.join(sorted(has)) or 'none'}"
        case MissingConfigException(missing_cfg_file=str(file), options=list(names)), _:
            kind, _, name = file.rpartition("/")
            packages = OmegaConf.load(conf_dir() / "published.yaml").packages if kind == "model" else {}
            if name in packages:
                package, folder = packages[name], packages[name].removeprefix("gaigs-").replace("-", "_")
                return (
                    f"there is no {kind} {name!r} here: it is in the package {package}; pip install {package}, or of a "
                    f"copy of the repository pip install plugins/{folder}"
                )
            return f"there is no {kind} {suggest(name, names)}; there are: {', '.join(names) or 'none'}"
        case HydraException(), _ if str(error).startswith("gaigs: "):  # of a job, which says itself what is wrong
            reason = f"\n{cause}" if isinstance(cause, OmegaConfBaseException) else ""
            return f"{str(error).removeprefix('gaigs: ')}{reason}"
        case HydraException(), _:
            words = " ".join(f"{error} {cause or ''}".split())
            return f"Hydra cannot read it: {words}"
        case _ if not str(error).startswith("Config group"):
            words = " ".join(str(error).split())
            about = "; its files may not choose each other in a circle" if isinstance(error, RecursionError) else ""
            cannot = f"Hydra cannot join command line and configuration files ({words}){about}; mend what is your own"
            return unreadable() or cannot
        case _:  # of null, or a number, for a group
            return f"a word on the command line that chooses a file must be its name ({error}); ~density chooses none"


def _flat(config: dict, prefix: str = "") -> dict:
    """Nested keys joined by dots."""
    flat = {}
    for key, value in config.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def run_folder(overrides: str) -> str:
    """The name of a job's folder from its overrides: one folder, whatever is in them, and no longer than allowed."""
    name = overrides.replace("/", "_") or "defaults"
    if name == overrides and len(name.encode()) <= LONGEST:
        return name
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return name.encode()[: LONGEST - len(digest) - 1].decode(errors="ignore") + "-" + digest


def installed(*names: str) -> str:
    """Those models of a list that are installed, as a sweep takes them; the log tells of the others."""
    holders, _ = find_holders("model")
    known = {holder.name for holder in holders}
    if missing := [name for name in names if name not in known]:
        log.warning("left out, as not installed: model=%s", ",".join(missing))
    return ",".join(name for name in names if name in known)


def known(kind: str, name: str, otherwise: str) -> str:
    """A name of a kind where a configuration file or a component has it, and else another: for choices by task."""
    return name if has_file(kind, name) or name in registry(kind).names() else otherwise


def by_task(values: Mapping, otherwise: object, *, _root_: DictConfig) -> object:
    """The value of a run's task, by the task's name."""
    return values.get(_root_.task.name, otherwise)


def launcher(name: str) -> str:
    """A launcher that joblib is needed for, where it is installed; else Hydra's own, which runs job by job."""
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
if PluginConfigurations not in Plugins.instance().discover(SearchPathPlugin):
    Plugins.instance().register(Constructors)
    Plugins.instance().register(PluginConfigurations)
