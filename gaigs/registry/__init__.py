"""Components by name: built-in ones, from installed packages and in ./plugins.

Names are found without an import; a component is imported when it is built.
"""

import contextlib
import functools
import hashlib
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType

from gaigs.registry.building import call, check_known, named_parameters
from gaigs.registry.discovery import Holder, find_holders, sources
from gaigs.registry.option_types import check_instance, check_type, is_built, is_plain
from gaigs.registry.shipped import not_installed
from gaigs.registry.source import MISSING, UnclearSource, registering_statement
from gaigs.registry.storing import GIVEN, configuration_of, name_of, note_arguments, storable
from gaigs.registry.words import listed, similar, suggest

__all__ = [
    "KINDS", "Registry", "call", "check_instance", "check_type", "configuration_of", "digests",
    "find_holders", "is_built", "listed", "name_of", "only_recorded", "register", "registries",
    "registry", "similar", "storable", "suggest",
]  # fmt: skip

KINDS = (
    "task", "data", "split", "placement", "tokenizer", "deformation", "projection", "rasterizer",
    "pooling", "loss", "model", "training",
)  # fmt: skip
"""Kinds of components; each is a folder of gaigs and of conf."""

_recorded: ContextVar[Mapping[str, str] | None] = ContextVar("recorded", default=None)


class Registry:
    """The components of one kind, by name.

    Args:
        kind: One of ``KINDS``: the name of a folder of gaigs, of a group of choices, and of the
            entry-point group ``gaigs.<kind>``.

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
        self._choices: dict[str, dict[str, str]] = {}

    def names(self) -> list[str]:
        """All names, sorted."""
        holders, _ = find_holders(self.kind)
        return sorted({holder.name for holder in holders} | self._registered.keys())

    def register(self, name: str, task: str | None = None, split: str | None = None) -> Callable:
        """The decorator of ``gaigs.register`` for this kind."""
        check_type(f"the name of a {self.kind}", name, str)
        given = {"task": task, "split": split}
        choices = {key: choice for key, choice in given.items() if choice is not None}
        if choices and self.kind != "data":
            word = listed(choices)
            raise ValueError(f"{self.kind} {name!r} chooses no {word}; only data take these words")
        for key, choice in choices.items():
            check_type(f"data {name!r}, {key},", choice, str)

        def decorate(component):
            if not callable(component):
                message = f"must be a class or a function, got {component!r}"
                raise TypeError(f"{self.kind} {name!r} {message}")
            former = self._registered.get(name)
            # A module that is loaded again has the same origin.
            if former is not None and _origin(former) != _origin(component):
                raise self._taken(name, _origin(former), _origin(component))
            holders, _ = find_holders(self.kind, name)
            if holders and not any(holder.owns(component) for holder in holders):
                raise self._taken(name, holders[0].where, _origin(component))
            self._registered[name] = component
            self._choices[name] = choices
            if not holders:  # of a notebook or a script
                self._sources[name] = registering_statement(component)
            return note_arguments(self.kind, name, component)

        return decorate

    def get(self, name: str) -> Callable:
        """The class or function with this name; only its module is imported."""
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
        message = f"unknown {self.kind} {suggest(name, names)}; there are: {listed(names)}"
        raise ValueError(message + causes + advice)

    def options(self, name: str) -> dict:
        """The options of a component with their defaults; ``???`` marks a mandatory option.

        They are read from the source. If the source does not show them, the component is imported.
        Options whose default a configuration cannot store are left out.
        """
        given = GIVEN.get(self.kind, ())
        holders, _ = find_holders(self.kind, name)
        try:
            if len(holders) != 1 or name in self._registered:
                raise UnclearSource
            options = holders[0].read_options(given)
        except (UnclearSource, OSError, SyntaxError):
            named = named_parameters(self.get(name))
            options = {
                key: MISSING if parameter.default is parameter.empty else parameter.default
                for key, parameter in named.items()
                if key not in given
            }
        return {key: value for key, value in options.items() if is_plain(value)}

    def check_options(self, config: Mapping) -> None:
        """Raises a ``ValueError`` for an option that the configured component does not have.

        The component is imported only if its source does not show its options.
        """
        name = config["name"]
        options = config.keys() - {"name"}
        if not options <= self.options(name).keys():
            given = GIVEN.get(self.kind, ())
            check_known(f"{self.kind} {name!r}", self.get(name), sorted(options), given)

    def choices(self, name: str) -> dict[str, str]:
        """Task and split that a data reader's registration chooses, without an import."""
        if name in self._choices:
            return self._choices[name]
        holders, _ = find_holders(self.kind, name)
        registration = holders[0].registration if holders else None
        return registration.keywords if registration else {}

    def build(self, config: str | Mapping | object, **context):
        """Makes the component of a configuration.

        Args:
            config: The name, or a mapping with the key ``name`` and options; a component itself is
                returned.
            context: Arguments of the caller, e.g. ``scene``; each is passed if the component has
                this parameter.

        Raises:
            TypeError: The configuration has another type.
            ValueError: The name is missing, unknown or registered twice; an option is missing or
                unknown.
            ImportError: The component cannot be imported.
        """
        if is_built(config):
            return config
        if not isinstance(config, str | Mapping):
            raise TypeError(f"a {self.kind} must be a mapping with the key 'name', got {config!r}")
        options = {"name": config} if isinstance(config, str) else dict(config)
        if "name" not in options:
            names = listed(self.names())
            message = f"a {self.kind} needs the key 'name', got {options}; there are: {names}"
            raise ValueError(message)
        name = options.pop("name")
        check_type(f"{self.kind}.name", name, str)
        return call(f"{self.kind} {name!r}", self.get(name), options, **context)

    def _load(self, holder: Holder) -> Callable:
        """Imports a component; a ``ValueError`` if its source differs from the recorded one."""
        if holder.root is not None:
            self._check_recorded(holder)
            # A package in ./plugins may import another one there.
            roots = {str(root): None for root in (holder.root, *sources(Path.cwd() / "plugins"))}
            # Last, so that nothing shadows installed packages.
            sys.path += [root for root in roots if root not in sys.path]
        try:
            return self._import(holder)
        except KeyboardInterrupt as error:  # Ctrl-C, or raised by the module
            message = f"stopped while {self.kind} {holder.name!r} of {holder.where} was loaded"
            error.args = error.args or (message,)
            raise
        except BaseException as error:  # any error or exit of a plug-in's module
            cause = f"{type(error).__name__}: {error}"
            raise ImportError(
                f"{self.kind} {holder.name!r} of {holder.where} cannot be loaded: {cause}"
            ) from error

    def _check_recorded(self, holder: Holder) -> None:
        """Raises a ``ValueError`` if a model recorded another source of a plug-in."""
        recorded = _recorded.get()
        if recorded is not None and recorded.get(f"{self.kind} {holder.name}") != holder.digest:
            source = f"the source of {self.kind} {holder.name!r} that was recorded with the model"
            advice = "set trust=True in gaigs.load, or trust=true on the command line"
            raise ValueError(f"{holder.where} is not {source}\nif you trust that file, {advice}")

    def _import(self, holder: Holder) -> Callable:
        """Imports a holder's module and returns its component; ``_load`` wraps errors."""
        name, _, attribute = holder.target.partition(":")
        module = importlib.import_module(name.strip())
        if holder.file is not None and not holder.file.samefile(module.__file__):
            raise ImportError(
                f"{module.__file__} is imported as {name!r} already; rename one of the two"
            )
        if not attribute:
            return self._registered[holder.name]
        component = functools.reduce(getattr, attribute.strip().split("."), module)
        return note_arguments(self.kind, holder.name, component)

    def _taken(self, name: str, holder: str, asker: str) -> ValueError:
        """The error for two components of one name, with the file or class of both."""
        claim = f"is held by {holder}, and {asker} asks for it"
        return ValueError(f"{self.kind} {name!r} {claim}; choose another name")


registries: Mapping[str, Registry] = MappingProxyType({kind: Registry(kind) for kind in KINDS})
"""The registry of each kind."""


def registry(kind: str) -> Registry:
    """The registry of a kind.

    Raises:
        ValueError: The kind does not exist.
    """
    if kind not in registries:
        raise ValueError(f"unknown kind {suggest(kind, KINDS)}; there are: {listed(KINDS)}")
    return registries[kind]


def register(
    kind: str, name: str, /, *, task: str | None = None, split: str | None = None
) -> Callable:
    """Decorator that registers a class or function under a name of a kind.

    All arguments must be literals, and the component must be at the top level of its file. They are
    read from the source without an import.

    Args:
        kind: The kind, one of the keys of ``gaigs.registries``.
        name: The name on the command line and in configurations.
        task: Task of a data reader's labels; ``data=<name>`` also selects it.
        split: Split of a data reader's links; ``data=<name>`` also selects it.

    Raises:
        TypeError: The component is not callable.
        ValueError: The kind is unknown, another component has the name, or a component other than a
            data reader has a task or split.

    Example:
        >>> @gaigs.register("split", "every_third")
        ... def every_third(links):
        ...     part = torch.arange(len(links)) % 3
        ...     train, validation, test = ((part == k).nonzero()[:, 0] for k in range(3))
        ...     return gaigs.data.Split("every third", train, validation, test)
        >>> "every_third" in gaigs.registries["split"].names()
        True
    """
    return registry(kind).register(name, task, split)


@contextlib.contextmanager
def only_recorded(recorded: Mapping[str, str] | None) -> Iterator[None]:
    """Imports components of ./plugins only if their sources have these ``digests``; None: all."""
    token = _recorded.set(recorded)
    try:
        yield
    finally:
        _recorded.reset(token)


def digests(*configurations: object) -> dict[str, str]:
    """Digests of the sources of all components outside gaigs that configurations name.

    Keys are ``"kind name"``. The source of a component in a notebook or a script is the statement
    that registers it, usually its class or function.
    """
    names = _texts(configurations)
    sources_by_key = {}
    for kind, components in registries.items():
        holders = {holder.name: holder for holder in find_holders(kind)[0]}
        for name in sorted(names.intersection(components.names())):
            holder = holders.get(name)
            statement = components._sources.get(name)
            if holder is None and statement:
                sources_by_key[f"{kind} {name}"] = hashlib.sha256(statement.encode()).hexdigest()
            elif holder is not None and (holder.root is not None or holder.file is None):
                sources_by_key[f"{kind} {name}"] = holder.digest
    return sources_by_key


def _texts(value: object) -> set[str]:
    """All texts in a configuration, without keys."""
    if isinstance(value, str):
        return {value}
    if isinstance(value, Mapping):
        value = [*value.values()]
    if not isinstance(value, list | tuple):
        return set()
    return set().union(*map(_texts, value))


def _origin(component: Callable) -> str:
    """Module and qualified name of a component, for errors."""
    return f"{component.__module__}.{component.__qualname__}"
