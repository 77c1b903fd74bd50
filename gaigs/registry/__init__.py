"""Components by name: the built-in ones, those of installed packages and those in ./plugins of the working directory.

Names are found without an import; a component is imported when it is built.
"""

import contextlib
import difflib
import functools
import importlib
import inspect
import math
import numbers
import sys
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType

from gaigs.registry.holders import GIVEN, MISSING, Holder, find_holders, is_plain, sources
from gaigs.registry.holders import digests as digests

KINDS = (
    "task", "data", "split", "placement", "tokenizer", "deformation", "projection", "rasterizer", "pooling", "loss",
    "model", "training", "benchmark",
)  # fmt: skip
"""Kinds of components; each is a folder of gaigs and of conf."""

PLAIN = {
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    str: (str, "a string"),
    Path: (str | Path, "a path"),
    bool: (bool, "true or false"),
    NoneType: (NoneType, "null"),
    **dict.fromkeys((list, tuple, Sequence), (list | tuple, "a list")),
    **dict.fromkeys((dict, Mapping), (Mapping, "a mapping")),
}
"""Annotations that options are checked against: accepted types, and the words of errors. A bool is no number."""

LARGEST = 2**63 - 1
"""Largest whole number of an option: torch takes 64 bits. Other numbers must be finite."""


class Registry:
    """The components of one kind, by name.

    Args:
        kind: One of ``KINDS``: a folder of gaigs, a group of choices, and the entry-point group ``gaigs.<kind>``.

    Example:
        >>> gaigs.registries["tokenizer"].names()
        ['euclidean', 'ga', 'multiview']
        >>> gaigs.registries["rasterizer"].build({"name": "torch"}).used
        'torch'
    """

    def __init__(self, kind: str):
        self.kind = kind
        self._registered: dict[str, Callable] = {}

    def names(self) -> list[str]:
        """All names, sorted."""
        holders, _ = find_holders(self.kind)
        return sorted({holder.name for holder in holders} | self._registered.keys())

    def register(self, name: str) -> Callable:
        """The decorator of ``gaigs.register`` for this kind.

        Raises:
            TypeError: The name is not a string, or the component not callable.
            ValueError: Another component has the name.
        """
        check_type(f"the name of a {self.kind} to register", name, str)

        def decorate(component):
            if not callable(component):
                raise TypeError(f"{self.kind} {name!r} must be a class or a function, got {component!r}")
            held = self._registered.get(name)
            if held is not None and _origin(held) != _origin(component):  # the same origin: a module loaded anew
                raise self._taken(name, _origin(held), _origin(component))
            holders, _ = find_holders(self.kind, name)
            if holders and not any(holder.owns(component) for holder in holders):
                raise self._taken(name, holders[0].where, _origin(component))
            self._registered[name] = component
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
        names = self.names()
        causes = "".join(f"; cannot read {cause}" for cause in unreadable)
        raise ValueError(f"unknown {self.kind} {suggest(name, names)}; there are: {_listed(names)}{causes}")

    def options(self, name: str) -> dict:
        """The options of a component with their defaults; ``???`` stands for a mandatory one.

        Options whose default a configuration cannot hold are left out, and so are inherited ones of files.
        """
        holders, _ = find_holders(self.kind, name)
        if holders:
            return holders[0].options(self.kind)
        options = {}
        for key, parameter in _signature(self._registered[name]).parameters.items():
            is_own = parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
            default = MISSING if parameter.default is parameter.empty else parameter.default
            if is_own and key not in GIVEN.get(self.kind, ()) and is_plain(default):
                options[key] = default
        return options

    def build(self, config: str | Mapping | object, **context):
        """Makes the component of a configuration.

        Args:
            config: The name, or a mapping with the key ``name`` and the component's options. A component that is built
                already is returned.
            context: Arguments of the caller, e.g. ``scene``; passed if the component has a parameter of that name.

        Raises:
            TypeError: The configuration has another type.
            ValueError: The name is missing, unknown or taken twice; an option is missing or unknown.
            ImportError: The component cannot be imported.
        """
        if is_built(config):
            return config
        if not isinstance(config, str | Mapping):
            raise TypeError(f"a {self.kind} configuration must be a mapping with the key 'name', got {config!r}")
        options = {"name": config} if isinstance(config, str) else dict(config)
        if "name" not in options:
            raise ValueError(
                f"a {self.kind} configuration needs the key 'name', got {options}; there are: {_listed(self.names())}"
            )
        name = options.pop("name")
        check_type(f"{self.kind}.name", name, str)
        return call(f"{self.kind} {name!r}", self.get(name), options, **context)

    def _load(self, holder: Holder) -> Callable:
        if holder.root is not None:
            # A package in ./plugins may import another one there.
            roots = {str(root): None for root in (holder.root, *sources(Path.cwd() / "plugins"))}
            sys.path += [root for root in roots if root not in sys.path]  # last: nothing shadows what is installed
        name, _, attribute = holder.target.partition(":")
        try:
            module = importlib.import_module(name.strip())
            if holder.file is not None and not holder.file.samefile(module.__file__):
                raise ImportError(f"{module.__file__} is imported as {name!r} already; rename one of the two")
            if attribute:
                return _noting(self.kind, holder.name, functools.reduce(getattr, attribute.strip().split("."), module))
            return self._registered[holder.name]
        except KeyboardInterrupt as error:  # Ctrl-C, or raised by the module
            error.args = error.args or (f"stopped while {self.kind} {holder.name!r} of {holder.where} was loaded",)
            raise
        except BaseException as error:  # any error or exit of a plug-in's module
            cause = f"{type(error).__name__}: {error}"
            raise ImportError(f"{self.kind} {holder.name!r} of {holder.where} cannot be loaded: {cause}") from error

    def _taken(self, name: str, holder: str, asker: str) -> ValueError:
        return ValueError(f"{self.kind} {name!r} is held by {holder}, and {asker} asks for it; choose another name")


registries: Mapping[str, Registry] = MappingProxyType({kind: Registry(kind) for kind in KINDS})
"""The registry of each kind."""


def registry(kind: str) -> Registry:
    """The registry of a kind.

    Raises:
        ValueError: There is no such kind.
    """
    if kind not in registries:
        raise ValueError(f"unknown kind {suggest(kind, KINDS)}; there are: {_listed(KINDS)}")
    return registries[kind]


def register(kind: str, name: str, /) -> Callable:
    """Decorator that registers a class or function under a name of a kind.

    Kind and name are string literals, and the component is at the top level of its file: names are read from the source
    before an import.

    Raises:
        TypeError: The name is not a string, or the component not callable.
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


def is_built(config: object) -> bool:
    """True for a component itself, in contrast to its name or configuration."""
    return not isinstance(config, str | bytes | Mapping | Sequence | NoneType | numbers.Number | type)


def name_of(component: object) -> str:
    """The registered name of a component, or its class's, for errors."""
    return getattr(component, "configuration", {}).get("name", type(component).__name__)


def configuration_of(component: object) -> dict:
    """The configuration of a component, an argument of ``Registry.build``.

    Raises:
        ValueError: The component or a part has no registered name, or an argument that no file can hold.
    """
    if not hasattr(component, "configuration"):
        raise ValueError(
            f"{type(component).__name__} must have a name to be stored; put @gaigs.register(kind, name) over the class"
        )
    return storable(component.configuration, name_of(component))


def storable(value: object, where: str):
    """A value in plain dictionaries, lists, numbers and strings.

    Args:
        value: These, registered components, paths, and numbers of numpy or torch.
        where: Its name in errors.

    Raises:
        ValueError: The value has, or holds, another type.
    """
    if isinstance(value, Mapping):
        return {key: storable(entry, f"{where}, {key}") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [storable(entry, where) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:  # a number of numpy or torch, which may be a float
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if hasattr(value, "configuration"):
        return configuration_of(value)
    raise ValueError(
        f"{where} must be a number, a text, a list or a registered component to be stored, got {type(value).__name__}"
    )


def _noting(kind: str, name: str, component: Callable) -> Callable:
    """Makes the instances of a class note their arguments as ``configuration``; functions are returned unchanged."""
    make = getattr(component, "__init__", None)
    if not isinstance(component, type) or getattr(make, "notes", None) is component:
        return component
    signature = inspect.signature(make)
    itself = next(iter(signature.parameters))
    given = {itself, *GIVEN.get(kind, ())}

    @functools.wraps(make)
    def noting(self, *args, **kwargs) -> None:
        make(self, *args, **kwargs)
        if type(self) is component:  # a subclass has a name of its own, or none
            bound = signature.bind(self, *args, **kwargs)
            bound.apply_defaults()
            options = {}
            for key, value in bound.arguments.items():
                match signature.parameters[key].kind:
                    case inspect.Parameter.VAR_KEYWORD:
                        options |= value
                    case inspect.Parameter.VAR_POSITIONAL:
                        pass
                    case _:
                        options[key] = value
            options = {key: value for key, value in options.items() if key not in given}
            with contextlib.suppress(AttributeError):  # e.g. of a tuple
                object.__setattr__(self, "configuration", {**options, "name": name})

    noting.notes = component
    component.__init__ = noting
    return component


def call(what: str, function: Callable, options: Mapping, /, **context):
    """Calls a function or class with the options of a configuration.

    Args:
        what: Name of the options' owner in errors.
        function: Its parameters are the options.
        options: Values by name.
        context: Arguments of the caller; passed if the function has such a parameter.

    Raises:
        TypeError: The options are not a mapping, or one does not suit its annotation, see ``check_type``.
        ValueError: An option is missing or unknown; or the function overflows, runs out of memory, ends the process or,
            if it is of torch or Lightning, fails.
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"{what} must be a mapping of options, got {options!r}")
    parameters = _signature(function).parameters.values()
    named = {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    # A torch module without a constructor has the signature (*args, **kwargs), and takes nothing.
    variable = {p.kind for p in parameters} & {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}
    takes_all = variable == {inspect.Parameter.VAR_KEYWORD}
    has = [key for key in named if key not in context]
    unknown = [key for key in options if key in context or not (takes_all or key in named)]
    if unknown:
        words = " or ".join(suggest(key, has) for key in unknown)
        raise ValueError(f"{what} has no option {words}; it has: {_listed(has)}")
    arguments = {**options, **{key: value for key, value in context.items() if takes_all or key in named}}
    missing = [key for key, p in named.items() if p.default is p.empty and key not in arguments]
    if missing:
        raise ValueError(f"{what} needs option {_listed(missing)}; it has: {_listed(has)}")
    for key in options.keys() & named.keys():
        if options[key] is not named[key].default:  # `width: int = None` is a common shorthand
            check_type(f"{what} option {key!r}", options[key], named[key].annotation)
    try:
        return function(**arguments)
    except (Exception, SystemExit) as error:
        # Messages that name no option; errors of torch and Lightning name none either.
        is_bare = isinstance(error, ArithmeticError | MemoryError | SystemExit)
        is_bare = is_bare or (isinstance(error, RuntimeError) and "tried to allocate" in str(error))
        if not is_bare and function.__module__.partition(".")[0] not in ("lightning", "torch"):
            raise
        text = str(error)
        suspects = [key for key, own in options.items() if key in text or (isinstance(own, str) and own in text)]
        keys = _listed(f"{key}={options[key]}" for key in suspects) if suspects else _listed(options)
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{what} cannot be made ({cause})\ncheck its options: {keys}") from error


def check_type(what: str, value: object, annotation: object) -> None:
    """Checks a value against an annotation in ``PLAIN`` or a union of them; other annotations are not checked.

    In a union with other classes, their objects are accepted, too.

    Raises:
        TypeError: The value does not suit.
    """
    is_union = typing.get_origin(annotation) in (typing.Union, UnionType)
    allowed = typing.get_args(annotation) if is_union else (annotation,)
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
    if fitting := [whole for whole, kind in zip(allowed, kinds, strict=True) if _suits(value, kind)]:
        return _check_entries(what, value, typing.get_args(fitting[0]))
    words = " or ".join(PLAIN[kind][1] for kind in kinds)
    if isinstance(value, float) and not math.isfinite(value):
        words = words.replace("a number", "a finite number")
    elif type(value) is int and {int, float} & set(kinds):
        words += f" up to {LARGEST:.2g}"
    is_whole = int in kinds and isinstance(value, float) and value.is_integer() and _suits(int(value), int)
    raise TypeError(f"{what} must be {words}, got {value!r}" + (f"; write {int(value)}" if is_whole else ""))


def _suits(value: object, kind: type) -> bool:
    """True if a value has a type of ``PLAIN``; entries are not checked."""
    if kind in (int, float) and isinstance(value, numbers.Integral):
        return not isinstance(value, bool) and abs(int(value)) <= LARGEST
    return isinstance(value, PLAIN[kind][0]) and (kind is not float or math.isfinite(value))


def _check_entries(what: str, value: object, kinds: tuple) -> None:
    """Checks the entries of a list or mapping whose annotation has these arguments."""
    if isinstance(value, Mapping) and kinds:
        for key, entry in value.items():
            check_type(f"a key of {what}", key, kinds[0])
            check_type(f"{what}, entry {key!r},", entry, kinds[1])
    elif isinstance(value, list | tuple) and kinds:
        kinds = kinds[:1] * len(value) if kinds[1:] in ((), (...,)) else kinds
        if len(value) != len(kinds):
            raise TypeError(f"{what} must be a list of {len(kinds)}, got {value!r}")
        for number, (entry, kind) in enumerate(zip(value, kinds, strict=True)):
            check_type(f"{what}, entry {number},", entry, kind)


def _signature(function: Callable) -> inspect.Signature:
    try:
        return inspect.signature(function, eval_str=True)
    except Exception:  # any error of an annotation in quotes, e.g. a name that only type checkers import
        return inspect.signature(function)


def suggest(word: str, known: Iterable[str]) -> str:
    """A word in quotes, with the most similar known word."""
    near = difflib.get_close_matches(str(word), known, n=1)
    return f"{word!r} (did you mean {near[0]!r}?)" if near else repr(word)


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words) or "none"


def _origin(component: Callable) -> str:
    return f"{component.__module__}.{component.__qualname__}"
