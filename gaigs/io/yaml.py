"""YAML files of data sets, whose numbers are read as they are written.

PyYAML reads 010 as 8, 1:30 as 90, 1e-3 as a word, and keeps the last of two equal keys.
"""

import math
import re
from collections import Counter
from pathlib import Path

import yaml

from gaigs.geometry import FAR, WITHIN
from gaigs.io.tables import quote, read_lines, to_number

OCTAL = re.compile(r"[+-]?0[0-9]+")
"""8 in YAML 1.1 and 10 in YAML 1.2 for 010, so that it is refused."""


class TextLoader(yaml.SafeLoader):
    """Loads scalars as text, and refuses repeated keys and unknown tags."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """The mapping of a node."""
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if repeated := [key for key, count in keys.items() if count > 1]:
            raise yaml.YAMLError(f"the key {quote(repeated[0])} is there twice")
        return super().construct_mapping(node, deep)


TextLoader.yaml_implicit_resolvers = {}


def read_mapping(file: Path, content: str) -> dict[str, object]:
    """The mapping of names to text, lists and mappings that a file holds.

    Raises:
        ValueError: The file cannot be read, is no YAML, holds no mapping, or holds a key twice or one that is no name.
    """
    text = "\n".join(read_lines(file, content))
    try:
        mapping = yaml.load(text, TextLoader)
    except RecursionError:
        raise ValueError(f"cannot parse {file}: brackets are nested too deeply; expected {content}") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # PyYAML does not check escapes such as \UFFFFFFFF
        cause = " ".join(str(error).split())[:300]
        raise ValueError(f"cannot parse {file}: {cause}; expected {content}") from None
    if not isinstance(mapping, dict) or not mapping:
        raise ValueError(f"{file}: expected {content}, got {quote(text.splitlines()[0])}")
    if unnamed := [key for key in mapping if not (isinstance(key, str) and key.strip() and key.isprintable())]:
        raise ValueError(f"{file}: expected a name in front of a colon, got {quote(unnamed[0])}")
    return mapping


def to_vector(place: str, value: object, axes: str) -> list[float]:
    """A list of finite numbers, one for each axis; another value is a ``ValueError`` with its place."""
    items = value if isinstance(value, list) else []
    numbers = [to_number(item) for item in items if isinstance(item, str) and not OCTAL.fullmatch(item)]
    if len(items) != len(axes) or len(numbers) != len(axes) or not all(map(math.isfinite, numbers)):
        expected = f"{len(axes)} finite numbers {', '.join(axes)}, written as 1.5 or -2e-3"
        raise ValueError(f"{place} must be {expected}, got {'none' if value is None else quote(value)}")
    return numbers


def to_position(place: str, value: object) -> list[float]:
    """A list of coordinates [m]; another value, or one too far for float32, is a ``ValueError`` with its place."""
    numbers = to_vector(place, value, "xyz")
    if max(map(abs, numbers)) >= FAR:
        raise ValueError(f"{place}: expected {WITHIN}, got {quote(value)}")
    return numbers
