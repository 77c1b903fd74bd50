"""The house stands as docs/architecture.md draws it: imports go down, a name is a place."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import yaml

from gaigs.registry import KINDS, find_holders

ROOT = Path(__file__).parents[1]


# --- what the code has ---


def imports(package):
    """What each module of a package imports of that package, inside functions too."""
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
                    assert not level, f"{module} must import by whole names"
                    whole = [f"{base}.{alias.name}" for alias in names]
                    targets += [target if target in files else base for target in whole]
        found[module] = {target for target in targets if target in files}
    return found


def room(module):
    """The folder or file of the package that a module lies in."""
    return [*module.split("."), "__init__"][1]


def between_rooms(imported):
    return {(room(a), room(b)) for a, targets in imported.items() for b in targets if room(a) != room(b)}


def circle(imported):
    """A circle of modules that import each other, or None."""
    try:
        TopologicalSorter(imported).prepare()
    except CycleError as error:
        return error.args[1]
    return None


def upward(imported, floors):
    """Pairs of rooms of which the first imports the second, though it is no lower."""
    return sorted((a, b) for a, b in between_rooms(imported) if floors[b] >= floors[a])


# --- what the page says ---


def drawn(text):
    """The diagram: floor of each room, counted from the ground; arrows; rooms that are kinds."""
    (diagram,) = re.findall(r"^```mermaid\n(.*?)^```$", text, re.M | re.S)
    labels = dict(re.findall(r'^ +(\w+)\["(\w+)"\]$', diagram, re.M))
    called = lambda word: labels.get(word, word)
    floors = {}
    for height, rooms in re.findall(r'^  subgraph F(\d+)\[" "\]\n(.*?)^  end$', diagram, re.M | re.S):
        for word in re.findall(r"^ +(\w+)", rooms, re.M):
            assert called(word) not in floors, f"{word} is drawn twice"
            floors[called(word)] = int(height)
    arrows = {(called(a), called(b)) for a, b in re.findall(r"^  (\w+) --> (\w+)$", diagram, re.M)}
    (kinds,) = re.findall(r"^  class (\S+) kind$", diagram, re.M)
    return floors, arrows, kinds.split(",")


def reached(start, arrows):
    """Rooms that arrows lead to."""
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


# --- the rules ---


def test_each_room_is_drawn_once(imported, page):
    floors, _, kinds = drawn(page)
    assert floors.keys() == {room(module) for module in imported}
    assert kinds == [*KINDS]


def test_no_room_imports_upwards(imported, page):
    assert not upward(imported, drawn(page)[0])


def test_no_modules_import_each_other(imported):
    assert circle(imported) is None


def test_arrows_are_imports_and_imports_follow_from_arrows(imported, page):
    _, arrows, _ = drawn(page)
    pairs = between_rooms(imported)
    assert arrows <= pairs
    assert [(a, b) for a, b in sorted(pairs) if b not in reached(a, arrows)] == []
    assert [(a, b) for a, b in sorted(arrows) if b in reached(a, arrows - {(a, b)})] == [], "follows from others"


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_is_a_place(kind, page):
    built_in = [holder for holder in find_holders(kind)[0] if holder.file and holder.root is None]
    for holder in built_in:
        places = {f"{kind}/{holder.name}.py", f"{kind}/{holder.name}/__init__.py"}
        assert holder.file.relative_to(ROOT / "gaigs").as_posix() in places
    names = {holder.name for holder in built_in}
    assert len(names) == len(built_in)
    files = {file.stem: yaml.safe_load(file.read_text()) for file in (ROOT / "conf" / kind).glob("*.yaml")}
    parts = {stem: content.get(kind, content) for stem, content in files.items()}  # tasks and data choose others, too
    for stem, part in parts.items():
        named = part["name"] if "name" in part else part["defaults"][0]
        assert named == stem or (stem not in names and named in names)
    (row,) = re.findall(rf"^\| `{kind}` \|.*\|(.*)\|$", page, re.M)
    assert {*re.findall(r"`(\w+)`", row)} == names


# --- that the rules can be broken ---

HOUSE = {
    "__init__": "",
    "roof": "from house import middle\n",
    "middle/__init__": "from house.ground import stone\n",
    "middle/table": "import house.ground\n",
    "ground": "stone = 1\n",
}
FLOORS = {"__init__": 4, "roof": 3, "middle": 2, "ground": 1}


def build(folder, **changes):
    for name, text in (HOUSE | changes).items():
        file = folder / "house" / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder / "house"


def test_a_house_in_order(tmp_path):
    house = imports(build(tmp_path))
    assert house["house.middle.table"] == {"house.ground"}
    assert between_rooms(house) == {("roof", "middle"), ("middle", "ground")}
    assert not upward(house, FLOORS)
    assert circle(house) is None


@pytest.mark.parametrize(
    "text",
    [
        "import house.middle.table",
        "from house.middle import table",
        "from house import middle",
        "from house import stone",
        "def late():\n    from house.middle.table import leg",
    ],
)
def test_an_arrow_upwards_is_found(text, tmp_path):
    house = imports(build(tmp_path, ground=f"{text}\n"))
    assert upward(house, FLOORS) == [("ground", "__init__" if "stone" in text else "middle")]


def test_a_neighbour_is_no_floor_below(tmp_path):
    assert upward(imports(build(tmp_path)), FLOORS | {"ground": 2}) == [("middle", "ground")]


def test_a_circle_within_a_room_is_found(tmp_path):
    house = imports(build(tmp_path, **{"middle/__init__": "from house.middle.table import leg\n"}))
    assert circle(house) is None
    text = {"middle/__init__": "from house.middle.table import leg\n", "middle/table": "from house.middle import leg\n"}
    assert {*circle(imports(build(tmp_path, **text)))} == {"house.middle", "house.middle.table"}


def test_a_relative_import_is_refused(tmp_path):
    with pytest.raises(AssertionError, match=r"house\.roof must import by whole names"):
        imports(build(tmp_path, roof="from . import middle\n"))
