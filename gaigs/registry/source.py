"""Registered names and options of components, read from source files without an import."""

import ast
import functools
import linecache
import sys
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parents[1]
"""Folder of gaigs."""

MISSING = "???"
"""Placeholder of a mandatory option."""

Definition = ast.ClassDef | ast.FunctionDef


class Registration(NamedTuple):
    """A top-level class or function with the decorator ``@register(kind, name, **keywords)``."""

    kind: str
    name: str
    keywords: dict[str, Any]
    definition: Definition


class Located(NamedTuple):
    """A syntax node and the file that has it."""

    file: Path
    node: Any


class UnclearSource(Exception):
    """An option or its default cannot be read from the source; an import is needed."""


def registrations(file: Path) -> list[Registration]:
    """The components registered in a file; a ``SyntaxError`` if it is not Python."""
    components = []
    for node in _parsed(file).body:
        if not isinstance(node, Definition):
            continue
        for decorator in node.decorator_list:
            match decorator:
                case ast.Call(
                    func=ast.Name(id="register") | ast.Attribute(attr="register"),
                    args=[ast.Constant(value=str(kind)), ast.Constant(value=str(name))],
                    keywords=keywords,
                ):
                    literals = {str(word.arg): ast.literal_eval(word.value) for word in keywords}
                    components.append(Registration(kind, name, literals, node))
    return components


def read_options(file: Path, definition: str | Definition, given: tuple[str, ...]) -> dict:
    """The options of a class or function with their defaults; ``???`` marks a mandatory option.

    Args:
        given: Parameters that are not options.

    Raises:
        UnclearSource: The constructor is inherited from another package, or a default is computed.
    """
    if isinstance(definition, str):
        located = _definition(file, definition)
    else:
        located = Located(file, definition)
    constructor = _constructor(located)
    if constructor is None:
        return {}
    arguments = constructor.node.args
    names = [argument.arg for argument in arguments.posonlyargs + arguments.args]
    defaults: dict[str, ast.expr | None] = dict.fromkeys(names)
    # Defaults belong to the last of the positional parameters.
    defaults |= zip(names[len(names) - len(arguments.defaults) :], arguments.defaults, strict=True)
    defaults |= {
        argument.arg: default
        for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    }
    # A constructor's first parameter is the object itself.
    itself = names[:1] if isinstance(located.node, ast.ClassDef) else []
    no_options = {*itself, *given, *(argument.arg for argument in arguments.posonlyargs)}
    return {
        name: MISSING if default is None else _value(Located(constructor.file, default))
        for name, default in defaults.items()
        if name not in no_options
    }


def registering_statement(component: Callable) -> str:
    """The statement that registers a component now, with its definition; empty if unknown."""
    # The calling frame that belongs to the component's module, and the line that it executes.
    frame: Any = sys._getframe()
    while frame is not None and frame.f_globals.get("__name__") != component.__module__:
        frame = frame.f_back
    if frame is None:
        return ""
    line = frame.f_lineno
    text = "".join(linecache.getlines(frame.f_code.co_filename, frame.f_globals))
    try:
        statements = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt)]
    except SyntaxError:  # the file has been edited meanwhile
        return ""
    # The innermost statement around this line starts last.
    around = [node for node in statements if _first_line(node) <= line <= (node.end_lineno or 0)]
    innermost = [max(around, key=_first_line)] if around else []
    # A call register(...)(Name) is separate from the definition of Name.
    named = [node for node in statements if getattr(node, "name", None) == component.__name__]
    chosen = dict.fromkeys([*innermost, *named[-1:]])
    return "\n".join(ast.get_source_segment(text, node) or "" for node in chosen)


def _first_line(node: ast.stmt) -> int:
    """The line of a statement or of its first decorator."""
    decorators = getattr(node, "decorator_list", [])
    return min(part.lineno for part in (node, *decorators))


def _parsed(file: Path) -> ast.Module:
    """The syntax tree of a file, parsed again after the file has changed."""
    state = file.stat()
    return _parse(file, state.st_mtime_ns, state.st_ctime_ns, state.st_size)


@functools.cache
def _parse(file: Path, *_state: int) -> ast.Module:
    return ast.parse(file.read_bytes(), file.name)


def _constructor(definition: Located) -> Located | None:
    """The function that takes the arguments of a class or function; None if it takes none."""
    file, node = definition
    if not isinstance(node, Definition):
        raise UnclearSource
    for decorator in node.decorator_list:
        # Another decorator, such as dataclass, may change the parameters.
        if not ast.unparse(decorator).partition("(")[0].endswith("register"):
            raise UnclearSource
    if isinstance(node, ast.FunctionDef):
        return definition
    for statement in node.body:
        if getattr(statement, "name", "") in ("__init__", "__new__"):
            if not isinstance(statement, ast.FunctionDef) or statement.decorator_list:
                raise UnclearSource
            return Located(file, statement)
    # Their constructors take no option.
    plain = ("ABC", "nn.Module", "torch.nn.Module", "object")
    names = [ast.unparse(base) for base in node.bases]
    parents = [name for name in names if name not in plain]
    if node.keywords or len(parents) > 1:
        raise UnclearSource
    return _constructor(_definition(file, parents[0])) if parents else None


def _definition(file: Path, name: str) -> Located:
    """The statement that defines a top-level name, in another file if it is imported from there."""
    if not file.is_file():
        raise UnclearSource
    definitions: list[Located] = []
    for node in _parsed(file).body:
        match node:
            case ast.ClassDef(name=defined) | ast.FunctionDef(name=defined) if defined == name:
                definitions.append(Located(file, node))
            case ast.Assign(targets=[ast.Name(id=defined)]) if defined == name:
                definitions.append(Located(file, node.value))
            case ast.AnnAssign(target=ast.Name(id=defined), value=ast.expr()) if defined == name:
                definitions.append(Located(file, node.value))
            case ast.ImportFrom(module=module, names=aliases, level=level):
                for alias in aliases:
                    if name == (alias.asname or alias.name):
                        origin = _module_file(file, module or "", level)
                        definitions.append(_definition(origin, alias.name))
    if len(definitions) != 1:
        raise UnclearSource
    return definitions[0]


def _module_file(importer: Path, module: str, level: int) -> Path:
    """The file of an imported module; an error unless it is of gaigs or the importer's package.

    ``level`` is the number of leading dots of a relative import.
    """
    words = module.split(".") if module else []
    if level:
        folder = importer.parents[level - 1]
    else:
        packages = [PACKAGE, *(p for p in importer.parents if (p / "__init__.py").is_file())]
        roots = [package for package in packages if package.name == words[0]]
        if not roots:
            raise UnclearSource
        folder = roots[-1].parent  # the outermost one of that name
    place = folder.joinpath(*words)
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


def _value(default: Located) -> object:
    """The value of a default, which is a literal or the name of a literal in its file."""
    file, node = default
    try:
        return ast.literal_eval(node)  # type: ignore[arg-type]
    except ValueError:
        if isinstance(node, ast.Name):
            return _value(_definition(file, node.id))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "MappingProxyType":
            return MappingProxyType({})  # an object, which no configuration holds
        raise UnclearSource from None
