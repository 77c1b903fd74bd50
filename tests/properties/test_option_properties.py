"""Options of any type against any annotation: what suits is taken, what does not is named."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gaigs.registry import LARGEST, PLAIN, check_type

SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.just(Path("a")) | st.just(1j)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=4,
)
ANNOTATIONS = [int, float, str, bool, Path, list, dict, int | None, float | str, list[int], tuple[int, int]]
ANNOTATIONS += [dict[str, float], list[int] | None]


def suits(value, annotation):
    """Written down anew: numbers are no bool, whole ones are numbers too, and all are finite and of 64 bits."""
    match annotation:
        case _ if annotation is int:
            return type(value) is int and abs(value) <= LARGEST
        case _ if annotation is float:
            return suits(value, int) or (type(value) is float and math.isfinite(value))
        case _ if annotation is str:
            return isinstance(value, str)
        case _ if annotation is bool:
            return isinstance(value, bool)
        case _ if annotation is Path:
            return isinstance(value, str | Path)
        case _ if annotation is list:
            return isinstance(value, list)
        case _ if annotation is dict:
            return isinstance(value, dict)
        case _ if annotation == list[int]:
            return isinstance(value, list) and all(suits(entry, int) for entry in value)
        case _ if annotation == tuple[int, int]:
            return isinstance(value, list) and len(value) == 2 and all(suits(entry, int) for entry in value)
        case _ if annotation == dict[str, float]:
            return isinstance(value, dict) and all(suits(entry, float) for entry in value.values())
    return any(value is None if kind is type(None) else suits(value, kind) for kind in annotation.__args__)


@pytest.mark.parametrize("annotation", ANNOTATIONS, ids=str)
@given(VALUES)
def test_what_suits_is_taken_and_what_does_not_is_named(annotation, value):
    if suits(value, annotation):
        check_type("loss.delta", value, annotation)
    else:
        with pytest.raises(TypeError, match=r"loss\.delta.* must be "):
            check_type("loss.delta", value, annotation)


@given(VALUES)
def test_what_is_not_told_is_taken_as_long_as_it_is_a_number(value):
    """Annotations that say nothing plain, such as a class, take whatever a file may hold."""
    if isinstance(value, float) and not math.isfinite(value):
        with pytest.raises(TypeError, match="finite"):
            check_type("loss.delta", value, object)
    else:
        check_type("loss.delta", value, object)


def test_each_plain_type_is_tried():
    assert {int, float, str, bool, Path, list, dict} <= set(PLAIN)
