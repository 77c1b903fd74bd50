"""The owners of registered names, found without an import."""

import functools
import hashlib
import itertools
import os
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gaigs.registry.source import (
    PACKAGE,
    Definition,
    Registration,
    UnclearSource,
    read_options,
    registrations,
)

ROOMS = {
    "task": "core/task",
    "placement": "splatting/placement",
    "tokenizer": "splatting/tokenizer",
    "deformation": "splatting/deformation",
    "projection": "splatting/projection",
    "rasterizer": "splatting/rasterizer",
    "pooling": "splatting/pooling",
    "loss": "splatting/loss",
}
"""Folders in gaigs of the kinds that have none of their own there."""


@dataclass(frozen=True)
class Holder:
    """The file or distribution of a named component, found without an import."""

    kind: str
    name: str
    where: str  # file or distribution, for errors
    target: str  # ``module`` that registers the component by decorator, or ``module:attribute``
    file: Path | None = None  # file of the module if the name was read from it
    root: Path | None = None  # folder that the import needs on ``sys.path``; None if it is there

    @property
    def package(self) -> str:
        """The top-level package of the target."""
        return re.split("[.:]", self.target)[0]

    def owns(self, component: object) -> bool:
        """True if a component comes from the holder's file or, for an entry point, its package."""
        module = getattr(component, "__module__", "")
        return module == self.target if self.file else module.split(".")[0] == self.package

    @property
    def folder(self) -> Path | None:
        """Folder of the target's top-level package, which is not imported; None if not found."""
        if self.root is not None:
            return self.root / self.package
        spec = find_spec(self.package)  # imports nothing, as the name has no dots
        return next(map(Path, (spec and spec.submodule_search_locations) or ()), None)

    @property
    def digest(self) -> str:
        """SHA-256 of the component's source and of all files in ./plugins that it imports.

        The component's source is its package or, outside packages, its file.
        """
        place = self.file or self.folder
        if self.file is not None and self.root is not None:
            plugins = self.root / "plugins"
            place = plugins / self.file.relative_to(plugins).parts[0]
        digest = hashlib.sha256()
        for file in sorted(_with_imports(place)) if place else ():
            digest.update(file.read_bytes())
        return digest.hexdigest()

    @property
    def registration(self) -> Registration | None:
        """The component's ``@register`` with its definition; None if an entry point has none."""
        file = self._source
        try:
            components = registrations(file) if file else []
        except (SyntaxError, ValueError):  # the import names the file
            components = []
        for component in components:
            if (component.kind, component.name) == (self.kind, self.name):
                return component
        return None

    def read_options(self, given: tuple[str, ...]) -> dict[str, Any]:
        """Options with their defaults, read from the source, without ``given`` parameters."""
        definition: str | Definition = self.target.partition(":")[2].strip()
        registration = self.registration
        if registration is not None:
            definition = registration.definition
        file = self._source
        if file is None or not definition:
            raise UnclearSource
        return read_options(file, definition, given)

    @property
    def _source(self) -> Path | None:
        """The file of the component, or of its entry point's module; None if it is not found."""
        if self.file is not None or self.folder is None:
            return self.file
        module = self.target.partition(":")[0]
        place = self.folder.joinpath(*module.strip().split(".")[1:])
        files = (place / "__init__.py", place.with_suffix(".py"))
        return next((file for file in files if file.is_file()), None)


def find_holders(kind: str, name: str | None = None) -> tuple[list[Holder], list[str]]:
    """Finds the providers of components of a kind: gaigs, installed packages, and ./plugins.

    With a ``name`` only its providers are found. The second list holds the files that cannot be
    read, each with the cause.
    """
    installed = _installed_holders(kind)
    dropped, unreadable = _dropped_holders(kind)
    targets = {(holder.name, holder.target) for holder in installed}
    holders = _built_in_holders(kind) + installed
    # A package in ./plugins may be installed as well.
    holders += [holder for holder in dropped if (holder.name, holder.target) not in targets]
    return [holder for holder in holders if name in (None, holder.name)], unreadable


def plugin_packages(kinds: Iterable[str]) -> list[Path]:
    """Folders of the packages with an entry point of gaigs, installed or in ./plugins."""
    holders, _ = _dropped_holders()
    installed = map(_installed_holders, kinds)
    holders = [*itertools.chain(*installed), *holders]
    folders = [holder.folder for holder in holders if holder.file is None]
    return [folder for folder in folders if folder is not None]


@functools.cache  # gaigs's files do not change
def _built_in_holders(kind: str) -> list[Holder]:
    """The components of gaigs: ``<kind>/<name>.py``, or a file in ``<kind>/<name>/``."""
    holders = []
    room = PACKAGE / ROOMS.get(kind, kind)
    for place in sorted(room.glob("[!_.]*")):
        name = place.stem
        for file in sorted(place.glob("*.py")) if place.is_dir() else [place]:
            if file.suffix != ".py" or f'\n@register("{kind}", "{name}"' not in file.read_text():
                continue
            where = str(file.relative_to(PACKAGE.parent))
            words = file.relative_to(PACKAGE.parent).with_suffix("").parts
            module = ".".join(words).removesuffix(".__init__")
            holders.append(Holder(kind, name, where, module, file))
    return holders


def _installed_holders(kind: str) -> list[Holder]:
    """Holders of a kind by the entry points of installed packages."""
    # The key of the cache of entry points: an installation changes a folder of sys.path.
    path = tuple(
        (folder, os.stat(folder or ".").st_mtime_ns)
        for folder in sys.path
        if os.path.isdir(folder or ".")
    )
    holders = []
    for point in _entry_points(path).get(f"gaigs.{kind}", ()):
        where = f"distribution {point.dist.name} {point.dist.version}"
        holders.append(Holder(kind, point.name, where, point.value))
    return holders


@functools.lru_cache
def _entry_points(_: tuple) -> dict[str, metadata.EntryPoints]:
    """Entry points of gaigs by group; cached, since the file of every package must be read."""
    points = metadata.entry_points()
    groups = [group for group in points.groups if group.startswith("gaigs.")]
    return {group: points.select(group=group) for group in groups}


def _dropped_holders(kind: str | None = None) -> tuple[list[Holder], list[str]]:
    """Holders in ./plugins, of one kind or all kinds, and the files that cannot be read."""
    holders: list[Holder] = []
    unreadable = []
    root = Path.cwd()
    for module, file in _plugin_files(root / "plugins", "plugins"):
        where = str(file.relative_to(root))
        try:
            if file.name == "pyproject.toml":
                (source,) = sources(root / "plugins", file.parent.name)
                state = file.stat()
                points = _project_entry_points(file, state.st_mtime_ns, state.st_size)
                for group, name, target in points:
                    holders.append(Holder(group, name, where, target, root=source))
            else:
                for found in registrations(file):
                    holders.append(Holder(found.kind, found.name, where, module, file, root))
        except Exception as error:  # any error of a parser
            unreadable.append(f"{where}: {str(error) or type(error).__name__}")
    return [holder for holder in holders if kind in (None, holder.kind)], unreadable


@functools.cache  # a composition asks for each kind
def _project_entry_points(file: Path, *_state: int) -> list[tuple[str, str, str]]:
    """Kind, name and target of each entry point of gaigs in a pyproject.toml."""
    project = tomllib.loads(file.read_text(encoding="utf-8")).get("project", {})
    entries = []
    for group, points in project.get("entry-points", {}).items():
        if group.startswith("gaigs."):
            for name, target in points.items():
                entries.append((group.removeprefix("gaigs."), name, str(target)))
    return entries


def _plugin_files(folder: Path, package: str) -> Iterator[tuple[str, Path]]:
    """Names and files of the modules in a folder and its packages.

    For a project (a folder with a pyproject.toml) the result is its name and this file.
    """
    for path in sorted(folder.glob("[!_.]*")):
        if path.suffix == ".py":
            yield f"{package}.{path.stem}", path
        elif (path / "pyproject.toml").is_file():
            yield path.name, path / "pyproject.toml"
        elif (path / "__init__.py").is_file():
            yield f"{package}.{path.name}", path / "__init__.py"
            yield from _plugin_files(path, f"{package}.{path.name}")


def sources(folder: Path, project: str = "[!_.]*") -> list[Path]:
    """Source folders of the projects in a folder: ``src`` where it exists, else the project's own.

    A project has a ``pyproject.toml``. ``project`` is the pattern of the projects' folder names.
    """
    places = [file.parent for file in sorted(folder.glob(f"{project}/pyproject.toml"))]
    return [place / "src" if (place / "src").is_dir() else place for place in places]


def _with_imports(place: Path) -> set[Path]:
    """The source files of a module or package, and of those in ./plugins that they import."""
    plugins = Path.cwd() / "plugins"
    roots = [plugins, *sources(plugins)]
    entries: list[Path] = []
    for root in filter(Path.is_dir, roots):
        entries += root.iterdir()
    known: set[Path] = set()
    places = [place]
    while places:
        place = places.pop()
        files = {place} if place.is_file() else {*place.rglob("*.py")}
        for file in files - known:
            text = file.read_text(errors="replace")
            # All words of import statements. Too many are harmless, as only existing files count.
            words: set[str] = set()
            for line in re.findall(r"^\s*(?:from|import)\s(.*)", text, re.M):
                words |= {*re.findall(r"(?:plugins\.)?(\w+)", line)}
            places += [path for path in entries if path.name.removesuffix(".py") in words]
        known |= files
    return known
