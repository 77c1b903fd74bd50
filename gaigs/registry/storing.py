"""Components as configurations: components record their arguments, and files store them."""

import contextlib
import functools
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaigs.registry.torch_modes import usual_modes

GIVEN = {
    "split": ("links",),
    "placement": ("scene", "channels"),
    "tokenizer": ("scene",),
    "deformation": ("scene", "channels", "tokenizer_widths", "count"),
    "projection": ("pixel",),
    "pooling": ("scene",),
    "loss": ("task",),
    "model": ("scene",),
    "training": ("model", "loss", "identity", "seed"),
}
"""Arguments that gaigs passes to the components of a kind; all others are options."""


def name_of(component: object) -> str:
    """The registered name of a component, or its class's, for errors."""
    return getattr(component, "configuration", {}).get("name", type(component).__name__)


def configuration_of(component: object) -> dict:
    """The configuration of a component for files and for ``Registry.build``."""
    if not hasattr(component, "configuration"):
        kind = type(component).__name__
        advice = "put @gaigs.register(kind, name) over the class"
        raise ValueError(f"{kind} must have a name to be stored; {advice}")
    return storable(component.configuration, name_of(component))


def storable(value: Any, where: str) -> Any:
    """A value converted to plain dictionaries, lists, numbers and strings.

    Accepted are these types, registered components, estimators of scikit-learn, paths, and numbers
    of numpy or torch. Other types raise a ``ValueError``.
    """
    if isinstance(value, Mapping):
        return {key: storable(entry, f"{where}, {key}") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [storable(entry, where) for entry in value]
    if isinstance(value, Path):
        return str(value)
    # A number of numpy or torch, which may be a float, too.
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if hasattr(value, "configuration"):
        return configuration_of(value)
    if type(value).__module__.startswith("sklearn.") and hasattr(value, "get_params"):
        return {"_target_": _target_of(value), **storable(_own_options(value), where)}
    kinds = "a number, a text, a list or a registered component"
    raise ValueError(f"{where} must be {kinds} to be stored, got {type(value).__name__}")


def _target_of(estimator: Any) -> str:
    """The name of an estimator's class, ``sklearn.<module>.<class>``."""
    module = type(estimator).__module__
    public = [word for word in module.split(".") if not word.startswith("_")]
    return ".".join((*public, type(estimator).__name__))


def _own_options(estimator: Any) -> dict:
    """Options of an estimator of scikit-learn that differ from its defaults."""
    known = inspect.signature(type(estimator)).parameters
    options = estimator.get_params(deep=False)
    return {key: value for key, value in options.items() if value is not known[key].default}


def note_arguments(kind: str, name: str, component: Any) -> Any:
    """Replaces a class's constructor by one that records its arguments as ``configuration``.

    Functions, and classes that already do so, are unchanged.
    """
    make: Any = getattr(component, "__init__", None)
    if not isinstance(component, type) or getattr(make, "notes", None) is component:
        return component
    signature = inspect.signature(make)
    itself, *_ = signature.parameters
    by_kind = {parameter.kind: key for key, parameter in signature.parameters.items()}
    positional = by_kind.get(inspect.Parameter.VAR_POSITIONAL)
    keywords = by_kind.get(inspect.Parameter.VAR_KEYWORD)
    no_options = {itself, positional, keywords, *GIVEN.get(kind, ())}

    @functools.wraps(make)
    def noting(self, *args, **kwargs) -> None:
        with usual_modes():
            make(self, *args, **kwargs)  # the class's own constructor
        if type(self) is component:  # a subclass has a name of its own, or none
            bound = signature.bind(self, *args, **kwargs)
            bound.apply_defaults()
            options = bound.arguments | bound.arguments.get(keywords, {})
            options = {key: value for key, value in options.items() if key not in no_options}
            with contextlib.suppress(AttributeError):  # e.g. of a tuple
                object.__setattr__(self, "configuration", {**options, "name": name})

    vars(noting)["notes"] = component
    type.__setattr__(component, "__init__", noting)
    return component
