"""Composition: a configuration from presets, command-line words and options."""

import contextlib
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import hydra
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from gaigs.configuration.files import conf_dir, files_of
from gaigs.configuration.keys import MAY_BE_NULL, check, option_keys
from gaigs.configuration.messages import explain
from gaigs.registry import KINDS, listed, storable, suggest

_composing = threading.RLock()  # Hydra composes one configuration at a time

CHOSEN = (*KINDS, "gaussians", "density", "trainer")
"""Keys that choose one file or component."""

READ_BY_LINKS = ("data", "split", "task")
"""Keys that ``gaigs.links`` reads."""


def compose(*overrides: str, **options) -> dict:
    """The configuration of a run, in the form that the command line makes.

    Overrides change the presets. Options change presets and overrides.

    Args:
        overrides: Command-line words, e.g. ``"+experiment=mirrored"`` or
            ``"trainer.max_steps=300"``.
        options: Values by their keys, ``**{"trainer.max_steps": 300}``, or by the option's name,
            ``max_steps=300``, if only one part has it. A part is chosen by its name,
            ``tokenizer="ga"``, by a mapping with a name and options, or by an object.

    Returns:
        Plain dictionaries, lists, numbers and strings: the argument of ``gaigs.run``.

    Raises:
        TypeError: A value has the wrong type.
        ValueError: A word or an option is unknown, a value is out of range, or a mandatory value is
            missing.

    Example:
        >>> configuration = gaigs.compose("+experiment=mirrored", "trainer.max_steps=300", planes=8)
        >>> configuration["model"]["name"], configuration["placement"]["planes"]
        ('mirrored', 8)
    """
    return composed(overrides, options)


def composed(overrides: Sequence[str], options: Mapping, sections: Sequence[str] = ()) -> dict:
    """The configuration of a run, as from ``compose``.

    Args:
        overrides, options: As for ``compose``.
        sections: Keys of the parts in which the names of options are searched; empty for all parts.
    """
    choices, values = _choices(options)
    with _composing:
        running = GlobalHydra.instance()
        before = running.hydra  # the command line's own instance, restored at the end
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


def preset(model: str, task: str) -> list[str]:
    """The command-line words for a model and a task, with their experiment if there is one."""
    names = (task,) if model == "gaigs" else (f"{model}_{task}", model)
    experiments = [f"+experiment={name}" for name in names if files_of("experiment", name)]
    tasks = [f"task={task}"] if files_of("task", task) else []
    return [*experiments[:1], f"model={model}", *tasks]


def resolve(config: DictConfig) -> dict:
    """A composed configuration in plain dictionaries, unchecked.

    A baseline given as a name becomes a mapping with this name.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise ValueError(_missing_value(error.full_key, config.model.name)) from None
    except OmegaConfBaseException as error:
        cause = " ".join(str(error).split())
        raise ValueError(f"the configuration is not complete: {cause}") from error
    baselines = plain.get("baselines")
    if isinstance(baselines, list):
        named = [{"name": entry} if isinstance(entry, str) else entry for entry in baselines]
        plain["baselines"] = named
    return plain


def _missing_value(key: str, model: str) -> str:
    """The message for a missing mandatory value."""
    words = {"model.trend": "kriging=true", "model.members": "ensemble=5"}
    if key in words and model in ("kriging", "ensemble"):
        return f"model {model!r} is made from trained models; set {words[key]}, with any model"
    examples = {
        "split.edge": "1.0, the edge of a cube [m]",
        "split.length": "50, the samples of a run",
        "split.train": "100, the training places",
        "data.root": "/path/to/folder",
        "data.file": "/path/to/file",
    }
    return f"{key} must be given, as it has no default; add {key}={examples.get(key, '...')}"


def _choices(options: Mapping) -> tuple[list[str], dict]:
    """Command-line words that choose parts, and all other options as plain values."""
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
            kinds = "a name, a mapping with a name and options, or a component"
            raise TypeError(f"{key} must be {kinds}, got {value!r}")
    return choices, values


def _path(config: DictConfig, name: str, sections: Sequence[str]) -> str:
    """The full key of an option.

    A name with dots, or of a top-level key, is already the key. Other names are options of one
    part.
    """
    is_new = name.startswith("+")
    name = name.removeprefix("+")
    plain: Any = OmegaConf.to_container(config)
    if not sections and name in CHOSEN:
        return name
    is_key = not sections and ("." in name or name in plain)
    if is_key or name.partition(".")[0] in sections:
        _check_parent(config, name, is_new)
        return name
    commands = {"survey", "place", "locate", "export", "view", "figures"}
    searched = sections or plain.keys() - {*READ_BY_LINKS} - commands
    names = {key: key.rpartition(".")[2] for key in option_keys(plain, searched)}
    keys = sorted(key for key, last in names.items() if last == name)
    # A model's own option wins over its parts' options.
    if not sections and f"model.{name}" in keys:
        return f"model.{name}"
    if len(keys) > 1:
        raise ValueError(f"{name} is an option of several parts; say which: {', '.join(keys)}")
    if keys:
        return keys[0]
    raise ValueError(_unknown_option(plain, name, sections, {*names.values()} - {"name"}))


def _check_parent(config: DictConfig, key: str, is_new: bool) -> None:
    """Raises a ``ValueError`` for a key that its mapping does not have, unless the key is new."""
    place, _, last = key.rpartition(".")
    parent = OmegaConf.select(config, place) if place else config
    known = sorted(map(str, parent)) if isinstance(parent, DictConfig) else []
    is_open = isinstance(parent, DictConfig) and OmegaConf.is_struct(parent) is False
    if not (is_new or last in known or is_open):
        raise ValueError(f"{place} has no key {suggest(last, known)}; it has: {listed(known)}")


def _unknown_option(config: dict, name: str, sections: Sequence[str], names: set[str]) -> str:
    """The message for an option that no part has.

    Args:
        sections: Keys of the parts that were searched; empty for all parts.
        names: Options that the parts have.
    """
    if sections:
        parts = " and ".join(f"{section} {config[section]['name']!r}" for section in sections)
        known = sorted(names)
        there = ", ".join(known)
        return f"there is no option {suggest(name, known)} of {parts}; there are: {there}"
    for section in READ_BY_LINKS:
        if name in config[section]:
            key = f"{section}.{name}"
            return f"{name} is an option of {section}, which gaigs.links reads; say {key}"
    near = suggest(name, {*names, *config})
    return f"there is no option {near}; python -m gaigs --help lists all"
