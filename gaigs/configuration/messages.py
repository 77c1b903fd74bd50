"""Error messages of configurations."""

import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from gaigs.configuration.files import conf_dir, plugin_conf_dirs
from gaigs.configuration.keys import option_keys
from gaigs.registry import listed, similar, suggest
from gaigs.registry.shipped import not_installed


def explain(error: Exception) -> str | None:
    """The message of an error in a configuration or in a job; None for any other error."""
    is_known = isinstance(error, HydraException | OmegaConfBaseException | ValueError)
    frames = traceback.extract_tb(error.__traceback__)
    is_composing = any(frame.name == "load_configuration" for frame in frames)
    is_system_error = isinstance(error, MemoryError) or getattr(error, "errno", None) is not None
    # Hydra lets errors of YAML files and of plug-ins through, of any type, while it composes.
    if not is_known and (is_system_error or not is_composing):
        return None
    cause = error.__cause__
    words = " ".join(str(error).split())
    match error, cause:
        case _, ConfigAttributeError(full_key=str(key)) | ConfigKeyError(full_key=str(key)):
            return _unknown_key(key, cause.parent_node)
        case MissingConfigException(missing_cfg_file=str(file), options=list(names)), _:
            kind, _, name = file.rpartition("/")
            missing = f"there is no {kind} {suggest(name, names)}; there are: {listed(names)}"
            return not_installed(kind, name) or missing
        case HydraException(), _ if str(error).startswith("gaigs: "):  # the message of a job
            reason = f"\n{cause}" if isinstance(cause, OmegaConfBaseException) else ""
            return f"{str(error).removeprefix('gaigs: ')}{reason}"
        case HydraException(), _:
            return " ".join(f"Hydra cannot read it: {words} {cause or ''}".split())
        case ImportError(), _:  # of a plug-in whose constructor has the options
            return words
        case _ if words.startswith("Config group"):  # null or a number as a file's name
            return f"a part is chosen by the name of its file ({error}); ~density leaves it out"
    if unreadable := _unreadable():
        return unreadable
    about = "; its files choose each other in a circle" if isinstance(error, RecursionError) else ""
    return f"Hydra cannot join command line and configuration files ({words}){about}"


def _unknown_key(key: str, parent: Any) -> str:
    """The message for a key that its mapping does not have."""
    place, _, word = key.rpartition(".")
    known = [str(name) for name in parent]
    part = place or "the configuration"
    if "name" in known:
        part = f"{place} {parent['name']!r}"
    plain: Any = OmegaConf.to_container(parent)
    if not place and (near := nearest(word, plain)):
        return f"{part} has no key {word!r}; did you mean {near}?"
    hint = ""
    if is_multirun():
        hint = f"\nin a sweep write ++{key}=... for a key that only the swept {place} has"
    return f"{part} has no key {suggest(word, known)}; it has: {listed(sorted(known))}{hint}"


def _unreadable() -> str | None:
    """The message for the first configuration file that cannot be parsed; None if all can."""
    files: list[Path] = []
    for folder in (conf_dir(), *plugin_conf_dirs()):
        files += sorted(folder.rglob("*.yaml"))
    for file in files:
        try:
            OmegaConf.load(file)
        except UnicodeDecodeError:
            return f"cannot parse {file}: not UTF-8"
        except Exception as error:  # any error of the YAML parser
            if getattr(error, "errno", None) is None:
                return f"cannot parse {file}: {' '.join(str(error).split())}"
    return None


def is_multirun() -> bool:
    """True if the command line asks for a sweep."""
    return any(word in ("-m", "--multirun") for word in sys.argv)


def nearest(word: str, config: Mapping) -> str:
    """Full keys of the options with the name most similar to a word, joined by "or".

    The text is empty if no name is similar.
    """
    parts = config.keys() - {"hydra", "survey", "place", "locate", "export", "view"}
    names = {key: key.rpartition(".")[2] for key in (*parts, *option_keys(config, parts))}
    near = similar(word, {*names.values()} - {"name"})
    keys = [key for key in near if key in config]
    return " or ".join(keys or sorted(key for key, name in names.items() if name in near))
