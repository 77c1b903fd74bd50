"""Components by name: the built-in ones, those of installed packages and those in ./plugins of the working directory.

Names are found without importing anybody's code; what a name stands for is imported when it is asked for.
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

from omegaconf import OmegaConf

from gaigs.registry.holders import GIVEN, MISSING, Holder, find_holders, is_plain, sources
from gaigs.registry.holders import digests as digests

KINDS = (
    "task", "data", "split", "placement", "tokenizer", "deformation", "projection", "rasterizer", "pooling", "loss",
    "model", "training", "benchmark",
)  # fmt: skip
"""In the order of a prediction's parts, and then what measures them; each is a folder of gaigs and of conf."""

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
"""Annotations that options are checked against: what suits them, and what errors call it. Numbers are no bool."""

LARGEST = 2**63 - 1
"""Whole numbers beyond it suit no option: torch takes 64 bits. Other numbers are finite."""


class Registry:
    """The components of one kind, by name.

    ``gaigs.registries`` has one for each kind, by its name.

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
        """Every name that can be asked for, sorted."""
        holders, _ = find_holders(self.kind)
        return sorted({holder.name for holder in holders} | self._registered.keys())

    def register(self, name: str) -> Callable:
        """The decorator that ``gaigs.register`` gives for this kind.

        Raises:
            TypeError: The name is no string, or the component cannot be called.
            ValueError: The name is taken by another component.
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
        """The class or function of that name; of all modules only the one that holds it is imported.

        Raises:
            ValueError: Nobody holds the name, or two do.
            ImportError: The module cannot be imported.
        """
        holders, unreadable = find_holders(self.kind, name)
        component = self._registered.get(name)
        claims = [holder.where for holder in holders]
        if component is not None and not any(holder.owns(component) for holder in holders):
            claims.insert(0, _origin(component))  # registered by code that no file of ours declares, e.g. a notebook
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
        """The arguments that a component takes from a configuration, with their defaults; ``???`` must be given.

        Those whose default a configuration cannot hold are left out, and of files so are inherited ones.
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
        """The component that a configuration names, made with its options.

        Args:
            config: The name, or a mapping with the key ``name``, whose other keys are options of the component. A
                component that is built already is given back.
            context: What the caller knows and no configuration says, e.g. ``scene``; passed where the component has a
                parameter of that name.

        Raises:
            TypeError: The configuration is none of these.
            ValueError: The name is missing, unknown or taken twice; an option is missing or unknown.
            ImportError: The component cannot be imported.
        """
        if is_built(config):
            return config
        options = {"name": config} if isinstance(config, str) else _plain(config, self.kind)
        if "name" not in options:
            raise ValueError(
                f"a {self.kind} configuration needs the key 'name', got {options}; there are: {_listed(self.names())}"
            )
        name = options.pop("name")
        check_type(f"{self.kind}.name", name, str)
        return call(f"{self.kind} {name!r}", self.get(name), options, **context)

    def _load(self, holder: Holder) -> Callable:
        if holder.root is not None:
            # A package in ./plugins may need another one there, as installed ones may need each other.
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
        except KeyboardInterrupt as error:  # Ctrl-C, or of the module's own
            error.args = error.args or (f"stopped while {self.kind} {holder.name!r} of {holder.where} was loaded",)
            raise
        except BaseException as error:  # whatever a stranger's module raises, or its end: say whose it is, and why
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
    """Decorator that gives a class or function a name among the components of a kind.

    Kind and name are string literals and the component stands at the top level of its file, because names are read
    from the source before anything is imported.

    Raises:
        TypeError: The name is no string, or the component cannot be called.
        ValueError: There is no such kind, or the name is taken by another component.

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
    """Whether what stands for a component is the component itself, and neither its name nor its configuration."""
    return not isinstance(config, str | bytes | Mapping | Sequence | NoneType | numbers.Number | type)


def name_of(component: object) -> str:
    """What errors call a component: its registered name, or its class's."""
    return getattr(component, "configuration", {}).get("name", type(component).__name__)


def configuration_of(component: object) -> dict:
    """The configuration that makes a component anew: ``build`` takes it.

    Raises:
        ValueError: The component, or a part of it, has no registered name, or was made with what no file can hold.
    """
    if not hasattr(component, "configuration"):
        raise ValueError(
            f"{type(component).__name__} must have a name to be stored; put @gaigs.register(kind, name) over the class"
        )
    return storable(component.configuration, name_of(component))


def storable(value: object, where: str):
    """A value in plain dictionaries, lists, numbers and strings.

    Args:
        value: Of those, or of registered components, paths, and numbers of numpy or torch.
        where: What errors call it.

    Raises:
        ValueError: It is, or holds, something else.
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
    """A class whose instances note as ``configuration`` what they were made with; functions as they are."""
    make = getattr(component, "__init__", None)
    if not isinstance(component, type) or getattr(make, "notes", None) is component:
        return component
    signature = inspect.signature(make)
    itself = next(iter(signature.parameters))
    given = {itself, *GIVEN.get(kind, ())}

    @functools.wraps(make)
    def noting(self, *args, **kwargs) -> None:
        make(self, *args, **kwargs)
        if type(self) is component:  # and no subclass, which has a name of its own, or none
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
            with contextlib.suppress(AttributeError):  # of a tuple, say, which holds nothing else
                object.__setattr__(self, "configuration", {**options, "name": name})

    noting.notes = component
    component.__init__ = noting
    return component


def call(what: str, function: Callable, options: Mapping, /, **context):
    """The result of a function or class that takes the options of a configuration.

    Args:
        what: Whose options they are, as errors call it.
        function: Its parameters are the options.
        options: By name.
        context: What the caller knows and no configuration says; passed where the function has such a parameter.

    Raises:
        TypeError: The options are no mapping, or one is not what its parameter is annotated as, see ``check_type``.
        ValueError: An option is missing or unknown; or with such options the function overflows, wants more memory than
            there is, ends the process or, where it is of torch or Lightning, fails at all.
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"{what} must be a mapping of options, got {options!r}")
    parameters = _signature(function).parameters.values()
    named = {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    # (*args, **kwargs) is what a torch module without a constructor of its own seems to take: it takes nothing.
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
        # What says nothing of the options, and neither do these packages.
        is_bare = isinstance(error, ArithmeticError | MemoryError | SystemExit)
        is_bare = is_bare or (isinstance(error, RuntimeError) and "tried to allocate" in str(error))
        if not is_bare and function.__module__.partition(".")[0] not in ("lightning", "torch"):
            raise
        raise ValueError(f"{what} cannot be made with {dict(options)}: {type(error).__name__}: {error}") from error


def check_type(what: str, value: object, annotation: object) -> None:
    """Sees to it that a value is what an annotation in ``PLAIN``, or a union of such, says; others say nothing.

    In a union with other classes, their objects suit, too.

    Raises:
        TypeError: It is not.
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
        allowed = kinds = [float]  # whatever it may be, it is finite
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
    """Whether a value is of a type of ``PLAIN``, whatever its entries."""
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
    except Exception:  # whatever an annotation in quotes raises, e.g. a name that only type checkers import
        return inspect.signature(function)


def _plain(config: Mapping, kind: str) -> dict:
    """A configuration as plain dicts, lists and scalars, its interpolations resolved."""
    if OmegaConf.is_config(config):
        missing = OmegaConf.missing_keys(config)
        if missing:
            raise ValueError(
                f"a {kind} configuration needs values for {_listed(sorted(missing))}, which stand at '???'"
            )
        config = OmegaConf.to_container(config, resolve=True)
    if not isinstance(config, Mapping):
        raise TypeError(f"a {kind} configuration must be a mapping with the key 'name', got {config!r}")
    return {k: OmegaConf.to_container(v, resolve=True) if OmegaConf.is_config(v) else v for k, v in config.items()}


def suggest(word: str, known: Iterable[str]) -> str:
    """A word in quotes, and the known one that it may stand for."""
    near = difflib.get_close_matches(str(word), known, n=1)
    return f"{word!r} (did you mean {near[0]!r}?)" if near else repr(word)


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words) or "none"


def _origin(component: Callable) -> str:
    return f"{component.__module__}.{component.__qualname__}"
