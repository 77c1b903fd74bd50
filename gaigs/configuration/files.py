"""Folders and files of configurations, of gaigs and of plug-ins."""

from pathlib import Path

from gaigs.registry import KINDS
from gaigs.registry.discovery import plugin_packages


def conf_dir() -> Path:
    """The folder of gaigs's own configuration: in the package, or beside it in a clone."""
    package = Path(__file__).parents[1]
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def plugin_conf_dirs() -> list[Path]:
    """Configuration folders of plug-ins, found without an import.

    They are ``plugins/conf``, ``plugins/<folder>/conf``, and ``<package>/conf`` of packages with an
    entry point of gaigs. They hold ``<kind>/<name>.yaml``.
    """
    folders = [*Path.cwd().glob("plugins/conf"), *sorted(Path.cwd().glob("plugins/[!_.]*/conf"))]
    folders += [package / "conf" for package in plugin_packages(KINDS)]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def files_of(kind: str, name: str) -> list[Path]:
    """The existing files ``<kind>/<name>.yaml`` of gaigs and of plug-ins."""
    files = (folder / kind / f"{name}.yaml" for folder in (conf_dir(), *plugin_conf_dirs()))
    return [file for file in files if file.is_file()]
