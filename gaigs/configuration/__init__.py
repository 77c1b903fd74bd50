"""Configurations: the files that Hydra joins, the check of the result, and error messages."""

from gaigs.configuration import hydra_plugins
from gaigs.configuration.composing import compose, composed, preset, resolve
from gaigs.configuration.files import conf_dir, files_of, plugin_conf_dirs
from gaigs.configuration.hydra_plugins import run_folder
from gaigs.configuration.keys import HARMLESS, check, differences
from gaigs.configuration.messages import explain, is_multirun, nearest

__all__ = [
    "HARMLESS", "check", "compose", "composed", "conf_dir", "differences", "explain", "files_of",
    "is_multirun", "nearest", "plugin_conf_dirs", "preset", "resolve", "run_folder",
]  # fmt: skip

hydra_plugins.install()
