"""YAML files of data sets, with numbers as people mean them.

PyYAML would read 010 as 8, 1:30 as 90 and 1e-3 as a word.
"""

import math
import re
from collections import Counter
from pathlib import Path

import yaml

from gaigs.io import FAR, WITHIN
from gaigs.io.tables import quote, read_lines, to_number


class TextLoader(yaml.SafeLoader):
    """Loads scalars as text, and rejects unknown tags and repeated keys (PyYAML keeps the last)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """The mapping of a node."""
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if repeated := [key for key, count in keys.items() if count > 1]:
            raise yaml.YAMLError(f"the key {quote(repeated[0])} is there twice")
        return super().construct_mapping(node, deep)


TextLoader.yaml_implicit_resolvers = {}


def read_mapping(file: Path, content: str) -> dict[str, object]:
    """The mapping of names to text, lists and mappings in a file; a ``ValueError`` for others."""
    text = "\n".join(read_lines(file, content))
    try:
        mapping = yaml.load(text, TextLoader)
    # Escapes and deep nesting raise other errors.
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        cause = " ".join(str(error).split())[:300]
        raise ValueError(f"cannot parse {file}: {cause}; expected {content}") from None
    if not isinstance(mapping, dict) or not mapping:
        raise ValueError(f"{file}: expected {content}, got {quote(text.splitlines()[0])}")
    for key in mapping:
        if not (isinstance(key, str) and key.strip() and key.isprintable()):
            raise ValueError(f"{file}: expected a name in front of a colon, got {quote(key)}")
    return mapping


def to_vector(place: str, value: object, axes: str) -> list[float]:
    """A list of one finite number for each axis; a ``ValueError`` names ``place``."""
    items = value if isinstance(value, list) else []
    octal = re.compile(r"[+-]?0[0-9]+")  # 010 is 8 in YAML 1.1 and 10 in YAML 1.2
    numbers = [
        to_number(item) for item in items if isinstance(item, str) and not octal.fullmatch(item)
    ]
    if len(items) != len(axes) or len(numbers) != len(axes) or not all(map(math.isfinite, numbers)):
        expected = f"{len(axes)} finite numbers {', '.join(axes)}, written as 1.5 or -2e-3"
        raise ValueError(
            f"{place} must be {expected}, got {'none' if value is None else quote(value)}"
        )
    return numbers


def to_position(place: str, value: object) -> list[float]:
    """Coordinates x, y, z [m] within ``FAR``; a ``ValueError`` names ``place``."""
    numbers = to_vector(place, value, "xyz")
    if max(map(abs, numbers)) >= FAR:
        raise ValueError(f"{place}: expected {WITHIN}, got {quote(value)}")
    return numbers
