"""Extensions of Hydra: its search path, the options of constructors, and resolvers."""

import hashlib
import logging
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from gaigs.configuration.files import files_of, plugin_conf_dirs
from gaigs.registry import KINDS, registry

log = logging.getLogger(__name__)

CONSTRUCTED = tuple(kind for kind in KINDS if kind not in ("task", "training"))
"""Kinds whose components need no configuration file, as their constructors have the options."""


class PluginConfigurations(SearchPathPlugin):
    """Hydra's search path: gaigs's own files, plug-ins' files, then the constructors."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_conf_dirs():
            search_path.append(provider="gaigs plug-in", path=f"file://{folder}")
        search_path.append(provider="constructors", path=f"{Constructors.scheme()}://")


def _keep(part: Any, memo: dict) -> Any:
    """The same object in place of a deep copy, since Hydra copies it for each of 210 groups."""
    return part


class Constructors(ConfigSource):
    """The configuration of a component: ``name``, and its constructor's options with defaults.

    The configuration of a data reader also selects task and split, as given to ``gaigs.register``.
    A YAML file of the same name replaces it. Such a file includes the options from
    ``constructors/<kind>/<name>``.
    """

    def __init__(self, provider: str, path: str):
        super().__init__(provider, path)
        self.components: dict[str, tuple[str, str]] = {}
        for kind in CONSTRUCTED:
            for name in registry(kind).names():
                self.components[f"{kind}/{name}"] = (kind, name)
        # A run composes twice, and each search for a component's file lists all plug-ins.
        self.contents: dict[tuple[str, str], tuple[dict, dict]] = {}  # choices and options

    __deepcopy__ = _keep

    @staticmethod
    def scheme() -> str:
        return "constructors"

    def load_config(self, config_path: str) -> ConfigResult:
        kind, name = self.components[self._component_path(config_path)]
        if (kind, name) not in self.contents:
            components = registry(kind)
            self.contents[kind, name] = components.choices(name), components.options(name)
        choices, defaults = self.contents[kind, name]
        package = None
        if choices and not config_path.startswith("constructors/"):
            # As a file of conf that begins with # @package _global_.
            package = "_global_"
            options = f"/constructors/{kind}/{name}@{kind}"
            overrides = [{f"override /{group}": choice} for group, choice in choices.items()]
            node = OmegaConf.create({"defaults": [options, *overrides]})
        else:
            node = OmegaConf.create({**defaults, "name": name})
        return ConfigResult(self.provider, f"{self.scheme()}://", node, {"package": package})

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.rstrip("/") in ("", *CONSTRUCTED)

    def is_config(self, config_path: str) -> bool:
        return self._component_path(config_path) in self.components

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        names: list[str] = [*CONSTRUCTED]  # the groups, at the root
        if config_path:
            components = self.components.values()
            names = [f"{name}.yaml" for kind, name in components if kind == config_path]
        files: list[str] = []
        for name in names:
            self._list_add_result(files, f"{config_path}/{name}".strip("/"), name, results_filter)
        return sorted(set(files))

    @staticmethod
    def _component_path(config_path: str) -> str:
        return config_path.removesuffix(".yaml").removeprefix("constructors/")


def run_folder(overrides: str) -> str:
    """The folder name of a job from its overrides, at most 200 bytes: file systems allow 255."""
    name = overrides.replace("/", "_") or "defaults"
    if name == overrides and len(name.encode()) <= 200:
        return name
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return f"{name.encode()[:187].decode(errors='ignore')}-{digest}"


def installed(*names: str) -> str:
    """Names of installed models, joined by commas for a sweep; the log lists the other names."""
    models = registry("model").names()
    missing = [name for name in names if name not in models]
    if missing:
        log.warning("left out, as not installed: model=%s", ",".join(missing))
    return ",".join(name for name in names if name in models)


def known(kind: str, name: str, otherwise: str) -> str:
    """``name`` if the kind has a file or component with this name, else ``otherwise``."""
    return name if files_of(kind, name) or name in registry(kind).names() else otherwise


def by_task(values: Mapping, otherwise: object, *, _root_: DictConfig) -> object:
    """The value for the run's task among ``values`` by task name, else ``otherwise``."""
    return values.get(_root_.task.name, otherwise)


def launcher(name: str) -> str:
    """The launcher if joblib is installed, else Hydra's own, which runs one job at a time."""
    try:
        metadata.version("hydra-joblib-launcher")
    except metadata.PackageNotFoundError:
        return "basic"
    return name


def install() -> None:
    """Registers the extensions with Hydra and OmegaConf.

    The function is called at import, since the workers of a launcher also need them.
    """
    for resolver in (run_folder, known, by_task, launcher):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
    OmegaConf.register_new_resolver("installed", installed, replace=True, use_cache=True)
    # Hydra refuses a new key on the command line, except in a mapping that is open.
    node = OmegaConf.create({}, flags={"struct": False})
    ConfigStore.instance().store(name="open", node=node)
    ConfigStore.__deepcopy__ = _keep  # type: ignore[attr-defined]
    if PluginConfigurations not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(Constructors)
        Plugins.instance().register(PluginConfigurations)
