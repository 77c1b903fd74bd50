"""Imports go to lower layers only, docs/architecture.md draws them, and a component's name is its file's."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import yaml

from gaigs.registry import KINDS, find_holders

ROOT = Path(__file__).parents[1]
LONGEST_CHAIN = 12


def imports(package):
    """The modules of a package that each module imports, inside functions too."""
    files = {}
    for file in package.rglob("*.py"):
        parts = (package.name, *file.relative_to(package).with_suffix("").parts)
        files[".".join(parts).removesuffix(".__init__")] = file
    found = {}
    for module, file in files.items():
        targets = []
        for node in ast.walk(ast.parse(file.read_text())):
            match node:
                case ast.Import(names=names):
                    targets += [alias.name for alias in names]
                case ast.ImportFrom(module=base, names=names, level=level):
                    assert not level, f"{module} must import by absolute names"
                    absolute = [f"{base}.{alias.name}" for alias in names]
                    targets += [target if target in files else base for target in absolute]
        found[module] = {target for target in targets if target in files}
    return found


def part(module):
    """The file or folder directly in the package that holds a module."""
    return [*module.split("."), "__init__"][1]


def between_parts(imported):
    return {(part(a), part(b)) for a, targets in imported.items() for b in targets if part(a) != part(b)}


def cycle(imported):
    """Modules that import each other in a circle, or None."""
    try:
        TopologicalSorter(imported).prepare()
    except CycleError as error:
        return error.args[1]
    return None


def not_downward(imported, layers):
    """Imports of a part from a part in the same or a higher layer."""
    return sorted((a, b) for a, b in between_parts(imported) if layers[b] >= layers[a])


def drawn(text):
    """The diagram: the layer of each part, counted from the ground; the arrows; the parts that are kinds."""
    (diagram,) = re.findall(r"^```mermaid\n(.*?)^```$", text, re.M | re.S)
    labels = dict(re.findall(r'^ +(\w+)\["(\w+)"\]$', diagram, re.M))
    label = lambda word: labels.get(word, word)
    layers = {}
    for height, parts in re.findall(r'^  subgraph L(\d+)\[" "\]\n(.*?)^  end$', diagram, re.M | re.S):
        for word in re.findall(r"^ +(\w+)", parts, re.M):
            assert label(word) not in layers, f"{word} is drawn twice"
            layers[label(word)] = int(height)
    arrows = {(label(a), label(b)) for a, b in re.findall(r"^  (\w+) --> (\w+)$", diagram, re.M)}
    (kinds,) = re.findall(r"^  class (\S+) kind$", diagram, re.M)
    return layers, arrows, kinds.split(",")


def reached(start, arrows):
    """Parts to which arrows lead."""
    found, new = set(), {start}
    while new:
        new = {b for a, b in arrows if a in new} - found
        found |= new
    return found


@pytest.fixture(scope="module")
def imported():
    return imports(ROOT / "gaigs")


@pytest.fixture(scope="module")
def page():
    return (ROOT / "docs/architecture.md").read_text()


def test_each_part_is_drawn_once(imported, page):
    layers, _, kinds = drawn(page)
    assert layers.keys() == {part(module) for module in imported}
    assert kinds == [*KINDS]
    assert max(layers.values()) <= LONGEST_CHAIN


def test_imports_go_to_lower_layers(imported, page):
    assert not_downward(imported, drawn(page)[0]) == []
    assert cycle(imported) is None


def test_arrows_are_imports_and_imports_follow_from_arrows(imported, page):
    _, arrows, _ = drawn(page)
    pairs = between_parts(imported)
    assert arrows <= pairs
    assert [(a, b) for a, b in sorted(pairs) if b not in reached(a, arrows)] == []
    assert [(a, b) for a, b in sorted(arrows) if b in reached(a, arrows - {(a, b)})] == [], "follows from others"


@pytest.mark.parametrize("kind", KINDS)
def test_a_components_name_is_its_files(kind, page):
    built_in = [holder for holder in find_holders(kind)[0] if holder.file and holder.root is None]
    for holder in built_in:
        place = ROOT / "gaigs" / kind / holder.name
        assert holder.file == place.with_suffix(".py") or holder.file.is_relative_to(place)
    names = {holder.name for holder in built_in}
    assert len(names) == len(built_in)
    presets = {file.stem: yaml.safe_load(file.read_text()) for file in (ROOT / "conf" / kind).glob("*.yaml")}
    for stem, content in presets.items():
        preset = content.get(kind, content)  # tasks and data choose other parts, too
        named = preset["name"] if "name" in preset else preset["defaults"][0]
        assert named == stem or (stem not in names and named in names)
    (row,) = re.findall(rf"^\| `{kind}` \|.*\|(.*)\|$", page, re.M)
    assert {*re.findall(r"`(\w+)`", row)} == names


def test_class_names_are_unique():
    nodes = [node for file in (ROOT / "gaigs").rglob("*.py") for node in ast.parse(file.read_text()).body]
    names = [node.name for node in nodes if isinstance(node, ast.ClassDef)]
    assert sorted(name for name in {*names} if names.count(name) > 1) == []


# --- that a broken rule is found ---

FILES = {
    "__init__": "",
    "top": "from package import middle\n",
    "middle/__init__": "from package.ground import stone\n",
    "middle/table": "import package.ground\n",
    "ground": "stone = 1\n",
}
LAYERS = {"__init__": 4, "top": 3, "middle": 2, "ground": 1}


def write(folder, **changes):
    for name, text in (FILES | changes).items():
        file = folder / "package" / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return imports(folder / "package")


def test_a_package_in_order(tmp_path):
    found = write(tmp_path)
    assert found["package.middle.table"] == {"package.ground"}
    assert between_parts(found) == {("top", "middle"), ("middle", "ground")}
    assert not not_downward(found, LAYERS)
    assert not_downward(found, LAYERS | {"ground": 2}) == [("middle", "ground")], "the same layer is no lower one"
    assert cycle(found) is None


@pytest.mark.parametrize(
    "text",
    [
        "import package.middle.table",
        "from package.middle import table",
        "from package import middle",
        "from package import stone",
        "def late():\n    from package.middle.table import leg",
    ],
)
def test_an_import_upwards_is_found(text, tmp_path):
    found = write(tmp_path, ground=f"{text}\n")
    assert not_downward(found, LAYERS) == [("ground", "__init__" if "stone" in text else "middle")]


def test_a_cycle_within_a_part_is_found(tmp_path):
    text = {
        "middle/__init__": "from package.middle.table import leg\n",
        "middle/table": "from package.middle import leg\n",
    }
    assert {*cycle(write(tmp_path, **text))} == {"package.middle", "package.middle.table"}


def test_a_relative_import_is_refused(tmp_path):
    with pytest.raises(AssertionError, match=r"package\.top must import by absolute names"):
        write(tmp_path, top="from . import middle\n")
