"""The owners of registered names, found without an import."""

import ast
import functools
import hashlib
import os
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
"""Folder of gaigs."""

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

GIVEN = {
    "split": ("links",),
    "placement": ("scene", "channels"),
    "tokenizer": ("scene",),
    "deformation": ("scene", "channels", "tokenizer_widths"),
    "projection": ("pixel",),
    "pooling": ("scene",),
    "loss": ("task",),
    "model": ("scene",),
    "training": ("model", "loss", "identity", "seed"),
}
"""Arguments that gaigs passes to the components of a kind; all others are options."""

MISSING = "???"
"""Placeholder of a mandatory option."""


@dataclass(frozen=True)
class Holder:
    """The owner of a name.

    Attributes:
        where: File or distribution, for errors.
        target: ``module`` that registers the component by decorator, or ``module:attribute``.
        file: File of the module if the name was read from it.
        root: Folder that the import needs on ``sys.path``; None if it is there.
    """

    name: str
    where: str
    target: str
    file: Path | None = None
    root: Path | None = None

    @property
    def package(self) -> str:
        """The top-level package of the target."""
        return re.split("[.:]", self.target)[0]

    def owns(self, component: object) -> bool:
        """True if a component comes from the holder's file or, for an entry point, from its
        package.
        """
        module = getattr(component, "__module__", "")
        return module == self.target if self.file else module.split(".")[0] == self.package

    @property
    def folder(self) -> Path | None:
        """Folder of an entry point's top-level package, which is not imported; None if it does not
        exist.
        """
        if self.root is not None:
            return self.root / self.package
        spec = find_spec(self.package)  # imports nothing, as the name has no dots
        return next(map(Path, (spec and spec.submodule_search_locations) or ()), None)

    @property
    def digest(self) -> str:
        """Digest of the sources: the file in ./plugins or the package, and other plug-ins there
        that it imports.
        """
        place = self.file or self.folder
        if (
            self.file is not None
            and self.root is not None
            and self.file.parent != self.root / "plugins"
        ):
            place = self.root / "plugins" / self.file.relative_to(self.root / "plugins").parts[0]
        digest = hashlib.sha256()
        for file in sorted(_with_imports(place)) if place else ():
            digest.update(file.read_bytes())
        return digest.hexdigest()


def find_holders(kind: str, name: str | None = None) -> tuple[list[Holder], list[str]]:
    """The holders of a kind's names, or of one name: gaigs, then installed packages, then
    ./plugins.

    The second list has the unreadable files, each with the cause.
    """
    room = ROOMS.get(kind, kind)
    built_in, unreadable = _scan(kind, PACKAGE / room, f"gaigs.{room.replace('/', '.')}")
    installed = _installed_holders(kind)
    dropped, causes = _scan(kind, Path.cwd() / "plugins", "plugins", root=Path.cwd())
    targets = {(holder.name, holder.target) for holder in installed}
    # A package in ./plugins may be installed as well.
    holders = (
        built_in
        + installed
        + [holder for holder in dropped if (holder.name, holder.target) not in targets]
    )
    return [holder for holder in holders if name in (None, holder.name)], unreadable + causes


def plugin_packages(kinds: Iterable[str]) -> list[Path]:
    """Folders of the packages with an entry point of gaigs, installed or in ./plugins; none is
    imported.
    """
    holders = [holder for kind in kinds for holder in _installed_holders(kind)]
    holders += _scan(None, Path.cwd() / "plugins", "plugins", root=Path.cwd())[0]
    return [
        holder.folder for holder in holders if holder.file is None and holder.folder is not None
    ]


def _installed_holders(kind: str) -> list[Holder]:
    # An installation changes a folder of sys.path.
    path = tuple(
        (folder, os.stat(folder or ".").st_mtime_ns)
        for folder in sys.path
        if os.path.isdir(folder or ".")
    )
    points = _installed(f"gaigs.{kind}", path)
    return [Holder(p.name, f"distribution {p.dist.name} {p.dist.version}", p.value) for p in points]


@functools.lru_cache
def _installed(group: str, _: tuple) -> metadata.EntryPoints:
    """Entry points of a group. They stand in a file of each package on ``sys.path``, and reading
    these is slow.
    """
    return metadata.entry_points(group=group)


def _with_imports(place: Path) -> set[Path]:
    """The source files of a module or package, and of those in ./plugins that they import."""
    plugins = Path.cwd() / "plugins"
    roots = [plugins, *sources(plugins)]
    found: set[Path] = set()
    places = [place]
    while places:
        place = places.pop()
        files = {place} if place.is_file() else {*place.rglob("*.py")}
        for file in files - found:
            lines = re.findall(r"^\s*(?:from|import)\s(.*)", file.read_text(errors="replace"), re.M)
            words = {word for line in lines for word in re.findall(r"(?:plugins\.)?(\w+)", line)}
            paths = [
                root / name for root in roots for word in words for name in (word, f"{word}.py")
            ]
            places += [path for path in paths if path.exists()]
        found |= files
    return found


def _scan(
    kind: str | None, folder: Path, package: str, root: Path | None = None
) -> tuple[list[Holder], list[str]]:
    """Holders of a kind, or of all kinds, in a folder's files, and the files that cannot be read."""
    holders, unreadable = [], []
    for module, file in _files(folder, package):
        where = str(file.relative_to(root or PACKAGE.parent))
        try:
            stat = file.stat()
            claims = _claims(file, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size)
            own = [(name, target) for claimed, name, target in claims if kind in (None, claimed)]
            if file.name == "pyproject.toml":
                (source,) = sources(folder, file.parent.name)
                holders += [Holder(name, where, target, root=source) for name, target in own]
            else:
                holders += [Holder(name, where, module, file, root) for name, _ in own]
        except Exception as error:  # any error of a parser
            unreadable.append(f"{where}: {str(error) or type(error).__name__}")
    return holders, unreadable


def _files(folder: Path, package: str) -> Iterator[tuple[str, Path]]:
    """Modules and their files in a folder and its packages, and of an installable project its
    pyproject.toml.
    """
    for path in sorted(folder.glob("[!_.]*")):
        if path.suffix == ".py":
            yield f"{package}.{path.stem}", path
        elif (path / "pyproject.toml").is_file():
            yield path.name, path / "pyproject.toml"
        elif (path / "__init__.py").is_file():
            yield f"{package}.{path.name}", path / "__init__.py"
            yield from _files(path, f"{package}.{path.name}")


def sources(folder: Path, project: str = "[!_.]*") -> list[Path]:
    """The folders with the packages of the installable projects in a folder: ``src`` if it exists,
    else their own.
    """
    places = [file.parent for file in sorted(folder.glob(f"{project}/pyproject.toml"))]
    return [place / "src" if (place / "src").is_dir() else place for place in places]


@functools.cache  # called for each kind
def _claims(file: Path, *_state: int) -> list[tuple[str, str, str]]:
    """Kind, name and target that a file's top-level ``@register(kind, name)`` decorators or entry
    points claim.
    """
    if file.name == "pyproject.toml":
        groups = (
            tomllib.loads(file.read_text(encoding="utf-8"))
            .get("project", {})
            .get("entry-points", {})
        )
        return [
            (group.removeprefix("gaigs."), name, str(target))
            for group, points in groups.items()
            if group.startswith("gaigs.")
            for name, target in points.items()
        ]
    found = []
    for node in ast.parse(file.read_bytes(), file.name).body:
        for decorator in getattr(node, "decorator_list", ()):
            match decorator:
                case ast.Call(
                    func=ast.Name(id="register") | ast.Attribute(attr="register"),
                    args=[ast.Constant(value=str(kind)), ast.Constant(value=str(name))],
                ):
                    found.append((kind, name, ""))
    return found


def is_plain(value: object) -> bool:
    """True if a configuration can hold a value."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(entry) for key, entry in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    # A subclass, such as numpy's float64 or a text of an Enum, is no configuration's value.
    return (
        value is None
        or type(value) in (bool, int, float)
        or (type(value) is str and "${" not in value)
    )
