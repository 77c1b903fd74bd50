"""Components by name: the built-in ones, those of installed packages and those in ./plugins of the
working directory.

Names are found without an import; a component is imported when it is built.
"""

import ast
import contextlib
import difflib
import functools
import hashlib
import importlib
import inspect
import linecache
import math
import numbers
import reprlib
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Any

from gaigs.registry.holders import GIVEN, MISSING, Holder, find_holders, is_plain, sources
from gaigs.registry.modes import usual_modes
from gaigs.registry.shipped import not_installed

KINDS = (
    "task", "data", "split", "placement", "tokenizer", "deformation", "projection", "rasterizer", "pooling", "loss",
    "model", "training",
)  # fmt: skip
"""Kinds of components; each is a folder of gaigs and of conf."""

PLAIN: dict[Any, tuple[Any, str]] = {
    int: (numbers.Integral, "a whole number"), float: (numbers.Real, "a number"), str: (str, "a string"),
    Path: (str | Path, "a path"), bool: (bool, "true or false"), NoneType: (NoneType, "null"),
    **dict.fromkeys((list, tuple, Sequence), (list | tuple, "a list")),
    **dict.fromkeys((dict, Mapping), (Mapping, "a mapping")),
}  # fmt: skip
"""Annotations that options are checked against: accepted types, and the words of errors. A bool is
no number.
"""

_recorded: ContextVar[Mapping[str, str] | None] = ContextVar("recorded", default=None)

LARGEST = 2**63 - 1
"""Largest whole number of an option: torch takes 64 bits. Other numbers must be finite."""


class Registry:
    """The components of one kind, by name.

    Args:
        kind: One of ``KINDS``: a folder of gaigs, a group of choices, and the entry-point group
            ``gaigs.<kind>``.

    Example:
        >>> "multiview" in gaigs.registries["tokenizer"].names()
        True
        >>> gaigs.registries["rasterizer"].build({"name": "torch"}).used
        'torch'
    """

    def __init__(self, kind: str):
        self.kind = kind
        self._registered: dict[str, Callable] = {}
        self._sources: dict[str, str] = {}

    def names(self) -> list[str]:
        """All names, sorted."""
        holders, _ = find_holders(self.kind)
        return sorted({holder.name for holder in holders} | self._registered.keys())

    def register(self, name: str) -> Callable:
        """The decorator of ``gaigs.register`` for this kind."""

        check_type(f"the name of a {self.kind}", name, str)

        def decorate(component):
            if not callable(component):
                raise TypeError(
                    f"{self.kind} {name!r} must be a class or a function, got {component!r}"
                )
            held = self._registered.get(name)
            if held is not None and _origin(held) != _origin(
                component
            ):  # the same origin: a module loaded anew
                raise self._taken(name, _origin(held), _origin(component))
            holders, _ = find_holders(self.kind, name)
            if holders and not any(holder.owns(component) for holder in holders):
                raise self._taken(name, holders[0].where, _origin(component))
            self._registered[name] = component
            if not holders:  # of a notebook or a script
                self._sources[name] = _source(component)
            return _noting(self.kind, name, component)

        return decorate

    def get(self, name: str) -> Callable:
        """The class or function of that name; only its module is imported.

        Raises:
            ValueError: No component has the name, or two have it.
            ImportError: The module cannot be imported.
        """
        holders, unreadable = find_holders(self.kind, name)
        component = self._registered.get(name)
        claims = [holder.where for holder in holders]
        if component is not None and not any(holder.owns(component) for holder in holders):
            claims.insert(0, _origin(component))  # registered without a file, e.g. in a notebook
        if len(claims) > 1:
            raise self._taken(name, *claims[:2])
        if holders:
            return self._load(holders[0])
        if component is not None:
            return component
        if hint := not_installed(self.kind, name):
            raise ValueError(hint)
        names = self.names()
        causes = "".join(f"; cannot read {cause}" for cause in unreadable)
        advice = "; one of your own must be imported first, or be in the folder plugins"
        raise ValueError(
            f"unknown {self.kind} {suggest(name, names)}; there are: {listed(names)}{causes}{advice}"
        )

    def options(self, name: str) -> dict:
        """The options of a component with their defaults; ``???`` stands for a mandatory one.

        Options whose default a configuration cannot hold are left out.
        """
        named = _named(self.get(name))
        defaults = {key: MISSING if p.default is p.empty else p.default for key, p in named.items()}
        given = GIVEN.get(self.kind, ())
        return {
            key: value for key, value in defaults.items() if key not in given and is_plain(value)
        }

    def build(self, config: str | Mapping | object, **context):
        """Makes the component of a configuration.

        Args:
            config: The name, or a mapping with the key ``name`` and options; a component itself is
                returned.
            context: Arguments of the caller, e.g. ``scene``; passed if the component has a
                parameter of that name.

        Raises:
            TypeError: The configuration has another type.
            ValueError: The name is missing, unknown or taken twice; an option is missing or
                unknown.
            ImportError: The component cannot be imported.
        """
        if is_built(config):
            return config
        if not isinstance(config, str | Mapping):
            raise TypeError(f"a {self.kind} must be a mapping with the key 'name', got {config!r}")
        options = {"name": config} if isinstance(config, str) else dict(config)
        if "name" not in options:
            raise ValueError(
                f"a {self.kind} needs the key 'name', got {options}; there are: {listed(self.names())}"
            )
        name = options.pop("name")
        check_type(f"{self.kind}.name", name, str)
        return call(f"{self.kind} {name!r}", self.get(name), options, **context)

    def _load(self, holder: Holder) -> Callable:
        if holder.root is not None:
            recorded = _recorded.get()
            if recorded is not None and recorded.get(f"{self.kind} {holder.name}") != holder.digest:
                source = (
                    f"the source of {self.kind} {holder.name!r} that was recorded with the model"
                )
                advice = "if you trust that file, set trust=True in gaigs.load, or trust=true on the command line"
                raise ValueError(f"{holder.where} is not {source}\n{advice}")
            # A package in ./plugins may import another one there.
            roots = {str(root): None for root in (holder.root, *sources(Path.cwd() / "plugins"))}
            sys.path += [
                root for root in roots if root not in sys.path
            ]  # last: nothing shadows what is installed
        name, _, attribute = holder.target.partition(":")
        try:
            module = importlib.import_module(name.strip())
            if holder.file is not None and not holder.file.samefile(module.__file__):
                raise ImportError(
                    f"{module.__file__} is imported as {name!r} already; rename one of the two"
                )
            if attribute:
                return _noting(
                    self.kind,
                    holder.name,
                    functools.reduce(getattr, attribute.strip().split("."), module),
                )
            return self._registered[holder.name]
        except KeyboardInterrupt as error:  # Ctrl-C, or raised by the module
            error.args = error.args or (
                f"stopped while {self.kind} {holder.name!r} of {holder.where} was loaded",
            )
            raise
        except BaseException as error:  # any error or exit of a plug-in's module
            cause = f"{type(error).__name__}: {error}"
            raise ImportError(
                f"{self.kind} {holder.name!r} of {holder.where} cannot be loaded: {cause}"
            ) from error

    def _taken(self, name: str, holder: str, asker: str) -> ValueError:
        return ValueError(
            f"{self.kind} {name!r} is held by {holder}, and {asker} asks for it; choose another name"
        )


registries: Mapping[str, Registry] = MappingProxyType({kind: Registry(kind) for kind in KINDS})
"""The registry of each kind."""


def registry(kind: str) -> Registry:
    """The registry of a kind.

    Raises:
        ValueError: There is no such kind.
    """
    if kind not in registries:
        raise ValueError(f"unknown kind {suggest(kind, KINDS)}; there are: {listed(KINDS)}")
    return registries[kind]


def register(kind: str, name: str, /) -> Callable:
    """Decorator that registers a class or function under a name of a kind.

    Kind and name are string literals, and the component is at the top level of its file: names are
    read from the source before an import.

    Raises:
        TypeError: The component is not callable.
        ValueError: The kind is unknown, or another component has the name.

    Example:
        >>> @gaigs.register("split", "every_third")
        ... def every_third(links):
        ...     number = torch.arange(len(links))
        ...     part = lambda k: number[number % 3 == k]
        ...     return type(links.split)("every third", part(0), part(1), part(2)) if links.split else None
        >>> "every_third" in gaigs.registries["split"].names()
        True
    """
    return registry(kind).register(name)


@contextlib.contextmanager
def only_recorded(recorded: Mapping[str, str] | None) -> Iterator[None]:
    """Imports components of ./plugins only if their sources have these ``digests``; None: all."""
    token = _recorded.set(recorded)
    try:
        yield
    finally:
        _recorded.reset(token)


def digests(*configurations: object) -> dict[str, str]:
    """Digests of the sources of components outside gaigs that configurations name, by kind and
    name.

    Of a component of a notebook or a script, the statement that registers it counts, a class or a
    function as a rule.
    """
    found, names, parts = {}, set(), [*configurations]
    while parts:
        part = parts.pop()
        names |= {part} if isinstance(part, str) else set()
        parts += (
            part.values()
            if isinstance(part, Mapping)
            else part
            if isinstance(part, list | tuple)
            else ()
        )
    for kind, components in registries.items():
        holders = {holder.name: holder for holder in find_holders(kind)[0]}
        for name in sorted(names.intersection(components.names())):
            if (holder := holders.get(name)) is None:
                if source := components._sources.get(name):
                    found[f"{kind} {name}"] = hashlib.sha256(source.encode()).hexdigest()
            elif holder.root is not None or holder.file is None:
                found[f"{kind} {name}"] = holder.digest
    return found


def _source(component: Callable) -> str:
    """The statement that registers a component, which runs now, and its definition; empty if the
    text is not kept.
    """
    frame: Any = sys._getframe()
    while frame is not None and frame.f_globals.get("__name__") != component.__module__:
        frame = frame.f_back
    if frame is None:
        return ""
    text, line = (
        "".join(linecache.getlines(frame.f_code.co_filename, frame.f_globals)),
        frame.f_lineno,
    )
    try:
        statements = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt)]
    except SyntaxError:  # the file has been edited meanwhile
        return ""
    first = lambda node: min(part.lineno for part in (node, *getattr(node, "decorator_list", ())))
    around = [node for node in statements if first(node) <= line <= node.end_lineno]
    own = [node for node in statements if getattr(node, "name", None) == component.__name__]
    chosen = dict.fromkeys([*([max(around, key=first)] if around else []), *own[-1:]])
    return "\n".join(ast.get_source_segment(text, node) or "" for node in chosen)


def is_built(config: object) -> bool:
    """True for a component itself, in contrast to its name or configuration."""
    return not isinstance(
        config, str | bytes | Mapping | Sequence | NoneType | numbers.Number | type
    )


def name_of(component: object) -> str:
    """The registered name of a component, or its class's, for errors."""
    return getattr(component, "configuration", {}).get("name", type(component).__name__)


def configuration_of(component: object) -> dict:
    """The configuration of a component, an argument of ``Registry.build``.

    Raises:
        ValueError: The component or a part has no registered name, or an argument that no file can
            hold.
    """
    if not hasattr(component, "configuration"):
        kind = type(component).__name__
        raise ValueError(
            f"{kind} must have a name to be stored; put @gaigs.register(kind, name) over the class"
        )
    return storable(component.configuration, name_of(component))


def storable(value: Any, where: str) -> Any:
    """A value in plain dictionaries, lists, numbers and strings.

    It holds these, registered components, paths, and numbers of numpy or torch; another type is a
    ``ValueError``.
    """
    if isinstance(value, Mapping):
        return {key: storable(entry, f"{where}, {key}") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [storable(entry, where) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if (
        hasattr(value, "item") and getattr(value, "ndim", None) == 0
    ):  # a number of numpy or torch, which may be a float
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if hasattr(value, "configuration"):
        return configuration_of(value)
    kinds = "a number, a text, a list or a registered component"
    raise ValueError(f"{where} must be {kinds} to be stored, got {type(value).__name__}")


def _noting(kind: str, name: str, component: Any) -> Any:
    """Makes the instances of a class note their arguments as ``configuration``; functions are
    returned unchanged.
    """
    make: Any = getattr(component, "__init__", None)
    if not isinstance(component, type) or getattr(make, "notes", None) is component:
        return component
    signature = inspect.signature(make)
    itself, *_ = signature.parameters
    names = {parameter.kind: key for key, parameter in signature.parameters.items()}
    several = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    given = {itself, *map(names.get, several), *GIVEN.get(kind, ())}

    @functools.wraps(make)
    def noting(self, *args, **kwargs) -> None:
        with usual_modes():
            make(self, *args, **kwargs)
        if type(self) is component:  # a subclass has a name of its own, or none
            bound = signature.bind(self, *args, **kwargs)
            bound.apply_defaults()
            options = bound.arguments | bound.arguments.get(
                names.get(inspect.Parameter.VAR_KEYWORD), {}
            )
            options = {key: value for key, value in options.items() if key not in given}
            with contextlib.suppress(AttributeError):  # e.g. of a tuple
                object.__setattr__(self, "configuration", {**options, "name": name})

    vars(noting)["notes"] = component
    type.__setattr__(component, "__init__", noting)
    return component


def call(owner: str, function: Callable, options: Mapping, /, **context):
    """Calls a function or class with the options of a configuration, and with those of ``context``
    that it takes.

    Args:
        owner: Name in errors.

    Raises:
        TypeError: The options are not a mapping, or one does not suit its annotation, see
            ``check_type``.
        ValueError: An option is missing or unknown; or the function overflows, runs out of memory,
            ends the process or, if it is of torch or Lightning, fails.
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"{owner} must be a mapping of options, got {options!r}")
    named, kinds = _named(function), {p.kind for p in _signature(function).parameters.values()}
    # A torch module without a constructor has the signature (*args, **kwargs), and takes nothing.
    takes_all = (
        inspect.Parameter.VAR_KEYWORD in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds
    )
    has = [key for key in named if key not in context]
    if unknown := [key for key in options if key in context or not (takes_all or key in named)]:
        words = " or ".join(suggest(key, has) for key in unknown)
        raise ValueError(f"{owner} has no option {words}; it has: {listed(has)}")
    arguments = {
        **options,
        **{key: value for key, value in context.items() if takes_all or key in named},
    }
    if missing := [
        key for key, p in named.items() if p.default is p.empty and key not in arguments
    ]:
        raise ValueError(f"{owner} needs option {listed(missing)}; it has: {listed(has)}")
    for key in options.keys() & named.keys():
        if options[key] is not named[key].default:  # `width: int = None` is a common shorthand
            check_type(f"{owner} option {key!r}", options[key], named[key].annotation)
    try:
        return function(**arguments)
    except (Exception, SystemExit) as error:
        # Messages that name no option; errors of torch and Lightning name none either.
        text = str(error)
        is_bare = (
            isinstance(error, ArithmeticError | MemoryError | SystemExit)
            or "tried to allocate" in text
        )
        if not is_bare and function.__module__.partition(".")[0] not in ("lightning", "torch"):
            raise
        suspects = [
            key
            for key, own in options.items()
            if key in text or (isinstance(own, str) and own in text)
        ]
        keys = listed(f"{key}={options[key]}" for key in suspects) if suspects else listed(options)
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{owner} cannot be made ({cause})\ncheck its options: {keys}") from error


def check_instance(name: str, value: object, kind: type) -> None:
    """Raises a ``TypeError`` unless a value is an object of a class of gaigs."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a gaigs.{kind.__name__}, got {reprlib.repr(value)}")


def check_type(name: str, value: Any, annotation: Any) -> None:
    """Checks a value against an annotation in ``PLAIN`` or a union of them; other annotations are
    not checked.

    In a union with other classes, their objects are accepted, too.

    Raises:
        TypeError: The value does not suit.
    """
    is_union = typing.get_origin(annotation) in (typing.Union, UnionType)
    allowed = [*typing.get_args(annotation)] if is_union else [annotation]
    kinds = [typing.get_origin(kind) or kind for kind in allowed]
    is_plain = [isinstance(kind, type) and kind in PLAIN for kind in kinds]
    is_known = is_union and any(is_plain) and all(isinstance(kind, type) for kind in kinds)
    if is_known and not all(is_plain) and not is_built(value):
        allowed = [whole for whole, plain in zip(allowed, is_plain, strict=True) if plain]
        kinds = [kind for kind, plain in zip(kinds, is_plain, strict=True) if plain]
    elif not all(is_plain):
        if not isinstance(value, float):
            return
        allowed = kinds = [float]  # a number must be finite whatever the annotation
    if fitting := [
        whole for whole, kind in zip(allowed, kinds, strict=True) if _suits(value, kind)
    ]:
        return _check_entries(name, value, typing.get_args(fitting[0]))
    words = " or ".join(PLAIN[kind][1] for kind in kinds)
    if isinstance(value, float) and not math.isfinite(value):
        words = words.replace("a number", "a finite number")
    elif type(value) is int and {int, float} & set(kinds):
        words += f" up to {LARGEST:.2g}"
    is_whole = (
        int in kinds and isinstance(value, float) and value.is_integer() and _suits(int(value), int)
    )
    raise TypeError(
        f"{name} must be {words}, got {value!r}" + (f"; write {int(value)}" if is_whole else "")
    )


def _suits(value: Any, kind: Any) -> bool:
    """True if a value has a type of ``PLAIN``; entries are not checked."""
    if kind in (int, float) and isinstance(value, numbers.Integral):
        return not isinstance(value, bool) and abs(int(value)) <= LARGEST
    return isinstance(value, PLAIN[kind][0]) and (kind is not float or math.isfinite(value))


def _check_entries(name: str, value: object, kinds: tuple) -> None:
    """Checks the entries of a list or mapping whose annotation has these arguments."""
    if isinstance(value, Mapping) and kinds:
        for key, entry in value.items():
            check_type(f"a key of {name}", key, kinds[0])
            check_type(f"{name}, entry {key!r},", entry, kinds[1])
    elif isinstance(value, list | tuple) and kinds:
        kinds = kinds[:1] * len(value) if kinds[1:] in ((), (...,)) else kinds
        if len(value) != len(kinds):
            raise TypeError(f"{name} must be a list of {len(kinds)}, got {value!r}")
        for number, (entry, kind) in enumerate(zip(value, kinds, strict=True)):
            check_type(f"{name}, entry {number},", entry, kind)


def _signature(function: Callable) -> inspect.Signature:
    try:
        return inspect.signature(function, eval_str=True)
    except (
        Exception
    ):  # any error of an annotation in quotes, e.g. a name that only type checkers import
        return inspect.signature(function)


def _named(function: Callable) -> dict[str, inspect.Parameter]:
    """Parameters with a name of their own."""
    parameters = _signature(function).parameters.items()
    return {key: p for key, p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}


def suggest(word: str, known: Iterable[str]) -> str:
    """A word in quotes, with the most similar known word."""
    near = similar(word, known)
    return f"{word!r} (did you mean {near[0]!r}?)" if near else repr(word)


def similar(word: str, known: Iterable[str]) -> list[str]:
    """The known word that is most similar to a word, or to what other programs call by it; empty
    without any.
    """
    others = {
        "lr": "learning_rates",
        "epoch": "max_steps",
        "epochs": "max_steps",
        "iterations": "max_steps",
    }
    return difflib.get_close_matches(others.get(str(word), str(word)), known, n=1)


def listed(words: Iterable[str]) -> str:
    """Words joined by commas; ``none`` without any."""
    return ", ".join(words) or "none"


def _origin(component: Callable) -> str:
    return f"{component.__module__}.{component.__qualname__}"
