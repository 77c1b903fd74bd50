"""YAML files of data sets, read as they are written: PyYAML takes 010 for 8, 1:30 for 90, and the last of two keys."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import yaml

from gaigs.geometry import FAR, WITHIN
from gaigs.io.tables import read_lines, to_number

CORE = "tag:yaml.org,2002:"
"""What the tags of YAML's own types begin with; others may stand for anything, as a unit."""

OCTAL = re.compile(r"[+-]?0[0-9]+")
"""8 to a reader of YAML 1.1, and 10 to one of YAML 1.2: such a 010 is neither."""


@dataclass(frozen=True)
class Entry:
    """A value of a mapping.

    Attributes:
        line: Of its key, from 1.
        node: As PyYAML composes it, before it is taken for a number or a date.
    """

    line: int
    node: yaml.Node

    @property
    def is_mapping(self) -> bool:
        """Whether it is a mapping itself."""
        return isinstance(self.node, yaml.MappingNode)


def read_mapping(file: Path, expected: str, defects: list[str]) -> dict[str, Entry]:
    """The mapping that a file is, by its keys as they are written."""
    text = "\n".join(read_lines(file, expected, defects))
    try:
        node = yaml.compose(text, yaml.SafeLoader)
    except RecursionError:
        defects.append(f"{file.name}: no YAML: brackets are nested too deeply; expected {expected}")
        return {}
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # PyYAML checks no escape such as \UFFFFFFFF
        defects.append(f"{file.name}: no YAML: {' '.join(str(error).split())}")
        return {}
    before, entries = len(defects), to_entries(file.name, node, defects)
    if text and not entries and len(defects) == before:
        defects.append(f"{file.name}: expected {expected}, got {text.splitlines()[0]!r}")
    return entries


def to_entries(file: str, node: yaml.Node | None, defects: list[str]) -> dict[str, Entry]:
    """Values of a mapping by their keys, each a name that stands there once; none where it is no mapping."""
    entries: dict[str, Entry] = {}
    for key, value in node.value if isinstance(node, yaml.MappingNode) else []:
        line = key.start_mark.line + 1
        name = key.value if isinstance(key, yaml.ScalarNode) else ""
        if not name.strip() or not name.isprintable():
            defects.append(f"{file}, line {line}: expected a name in front of a colon, got {_written(key)!r}")
        elif name in entries:
            defects.append(f"{file}, line {line}: {name} stands in line {entries[name].line} already")
        else:
            entries[name] = Entry(line, value)
    return entries


def to_vector(place: str, entry: Entry | None, axes: str, defects: list[str]) -> list[float]:
    """A list of numbers, one for each axis."""
    values = []
    if entry and isinstance(entry.node, yaml.SequenceNode) and entry.node.tag == f"{CORE}seq":
        values = [_to_number(item) for item in entry.node.value]
    if len(values) != len(axes) or not all(map(math.isfinite, values)):
        expected = f"{len(axes)} finite numbers {', '.join(axes)}, written as 1.5 or -2e-3"
        defects.append(f"{place} must be {expected}, got {repr(_written(entry.node)) if entry else 'none'}")
    return values


def to_position(place: str, entry: Entry | None, defects: list[str]) -> list[float]:
    """A list of coordinates [m], finite and near enough for float32."""
    before, values = len(defects), to_vector(f"{place}: position", entry, "xyz", defects)
    if len(defects) == before and max(map(abs, values)) >= FAR:
        defects.append(f"{place}: expected {WITHIN}, got {_written(entry.node)!r}")
    return values


def _to_number(node: yaml.Node) -> float:
    """What a scalar says in decimals; not a number where it says none."""
    is_core = isinstance(node, yaml.ScalarNode) and node.tag.startswith(CORE)
    return to_number(node.value) if is_core and not OCTAL.fullmatch(node.value) else math.nan


def _written(node: yaml.Node) -> str:
    """A node as it stands in the file, on one line."""
    start, end = node.start_mark, node.end_mark
    return " ".join(start.buffer[start.index : end.index].split())
