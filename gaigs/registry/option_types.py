"""Types of options: values against annotations."""

import math
import numbers
import reprlib
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

PLAIN: dict[Any, tuple[Any, str]] = {
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    str: (str, "a string"),
    Path: (str | Path, "a path"),
    bool: (bool, "true or false"),
    NoneType: (NoneType, "null"),
    list: (list | tuple, "a list"),
    tuple: (list | tuple, "a list"),
    Sequence: (list | tuple, "a list"),
    dict: (Mapping, "a mapping"),
    Mapping: (Mapping, "a mapping"),
}
"""Annotations that are checked: accepted types, and words of errors. A bool is no number."""

LARGEST = 2**63 - 1
"""Largest whole number of an option: torch takes 64 bits. Other numbers must be finite."""


def check_instance(name: str, value: object, kind: type) -> None:
    """Raises a ``TypeError`` unless a value is an object of ``kind``, a class of gaigs."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a gaigs.{kind.__name__}, got {reprlib.repr(value)}")


def check_type(name: str, value: Any, annotation: Any) -> None:
    """Raises a ``TypeError`` unless a value matches an annotation in ``PLAIN`` or a union of them.

    Other annotations are not checked. In a union with other classes their objects also pass.
    """
    allowed = _allowed(value, annotation)
    if not allowed:
        return
    for kind in allowed:
        if _suits(value, _bare(kind)):
            _check_entries(name, value, typing.get_args(kind))
            return
    raise TypeError(f"{name} must be {_expectation(value, [*map(_bare, allowed)])}")


def _allowed(value: Any, annotation: Any) -> list[Any]:
    """Annotations of ``PLAIN`` that a value may match; empty for a value that is not checked."""
    is_union = typing.get_origin(annotation) in (typing.Union, UnionType)
    allowed = [*typing.get_args(annotation)] if is_union else [annotation]
    plain = [kind for kind in allowed if isinstance(_bare(kind), type) and _bare(kind) in PLAIN]
    if len(plain) == len(allowed):
        return plain
    has_classes = is_union and all(isinstance(_bare(kind), type) for kind in allowed)
    if plain and has_classes and not is_built(value):
        return plain
    return [float] if isinstance(value, float) else []  # a number is finite whatever the annotation


def _bare(annotation: Any) -> Any:
    """An annotation without its arguments, such as ``list`` for ``list[int]``."""
    return typing.get_origin(annotation) or annotation


def _expectation(value: Any, kinds: list[Any]) -> str:
    """The end of a message: the expected type of a value, and the value."""
    words = " or ".join(PLAIN[kind][1] for kind in kinds)
    advice = ""
    if isinstance(value, float) and not math.isfinite(value):
        words = words.replace("a number", "a finite number")
    elif type(value) is int and {int, float} & set(kinds):
        words += f" up to {LARGEST:.2g}"
    if int in kinds and isinstance(value, float) and value.is_integer() and _suits(int(value), int):
        advice = f"; write {int(value)}"
    return f"{words}, got {value!r}{advice}"


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
        is_uniform = kinds[1:] in ((), (...,))
        entry_kinds = kinds[:1] * len(value) if is_uniform else kinds
        if len(value) != len(entry_kinds):
            raise TypeError(f"{name} must be a list of {len(entry_kinds)}, got {value!r}")
        for number, (entry, kind) in enumerate(zip(value, entry_kinds, strict=True)):
            check_type(f"{name}, entry {number},", entry, kind)


def is_built(config: object) -> bool:
    """True for a component object, in contrast to its name or configuration."""
    plain = (str, bytes, Mapping, Sequence, NoneType, numbers.Number, type)
    return not isinstance(config, plain)


def is_plain(value: object) -> bool:
    """True if a configuration can store a value."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(entry) for key, entry in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    # A subclass, such as numpy's float64 or a text of an Enum, is no configuration's value.
    if type(value) is str:
        return "${" not in value
    return value is None or type(value) in (bool, int, float)
