"""Third-party packages as a stranger would ship them: real files, a fresh interpreter, no mock."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from zipfile import ZipFile

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

from gaigs.registry import registry
from gaigs.registry.shipped import PACKAGES

ROOT = Path(__file__).parents[1]


@pytest.fixture
def place(tmp_path):
    """An empty working directory ``run`` with site-packages beside it, and an interpreter that sees
    both.
    """
    return Place(tmp_path)


class Place:
    def __init__(self, root):
        self.root = root
        self.write("run/primary/config.yaml", "defaults: [_self_]\n")

    def write(self, path, text):
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    def install(self, distribution, package, entry_points, **files):
        """What pip leaves behind: the package and its dist-info."""
        info = f"site/{distribution.replace('-', '_')}-1.2.dist-info"
        self.write(
            f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n"
        )
        self.write(f"{info}/entry_points.txt", entry_points)
        for name, text in files.items():
            self.write(f"site/{package}/{name}.py", text)

    def python(self, script, gaigs=ROOT):
        """The JSON that a script prints."""
        path = os.pathsep.join((str(self.root / "site"), str(gaigs)))
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                f"import json, sys\nfrom gaigs.registry import registry\n{script}",
            ],
            cwd=self.root / "run",
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)


COMPOSE = """
from pathlib import Path
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from gaigs import configuration
def composed(*overrides):
    with initialize_config_dir(str(Path("primary").absolute()), version_base="1.3"):
        return OmegaConf.to_container(compose("config", list(overrides)))
"""

YAGI = (
    "class Yagi:\n    def __init__(self, scene, elements: int):\n        self.gain = scene * "
    "elements\n"
)
ENTRY = "[gaigs.pooling]\nyagi = yagi_antenna.pooling:Yagi\n"


def test_an_installed_package_is_found_by_registry_and_hydra(place):
    place.install("yagi-antenna", "yagi_antenna", ENTRY, __init__="", pooling=YAGI)
    place.write("site/yagi_antenna/conf/pooling/yagi.yaml", "name: yagi\nelements: 5\n")
    script = """
config = composed("+pooling=yagi", "pooling.elements=4")
assert "yagi" in registry("pooling").names()
imported = "yagi_antenna" in sys.modules
gain = registry("pooling").build(config["pooling"], scene=3).gain
print(json.dumps([config, imported, gain]))
"""
    config, imported, gain = place.python(COMPOSE + script)
    assert config == {"pooling": {"name": "yagi", "elements": 4}}
    assert not imported, "names and configuration are found without importing the plug-in"
    assert gain == 12


def test_configurations_of_plugins_in_the_working_directory_are_found(place):
    project = (
        '[project]\nname = "loop"\n[project.entry-points."gaigs.model"]\nloop = "loop.model:Loop"\n'
    )
    place.write("run/plugins/loop/pyproject.toml", project)
    place.write("run/plugins/loop/src/loop/conf/model/packaged.yaml", "name: loop\n")
    place.write("run/plugins/loop/conf/model/beside.yaml", "name: loop\n")
    place.write("run/plugins/conf/model/dropped.yaml", "name: whip\n")
    place.write("run/primary/model/own.yaml", "name: own\n")
    place.write("run/plugins/conf/model/own.yaml", "name: usurper\n")
    script = """
files = ("packaged", "beside", "dropped", "own")
print(json.dumps([composed(f"+model={file}")["model"]["name"] for file in files]))
"""
    assert place.python(COMPOSE + script) == ["loop", "loop", "whip", "own"]


ERRORS = """
def error(kind, name):
    try:
        return registry(kind).get(name).__name__
    except (ValueError, ImportError) as error:
        return f"{type(error).__name__}: {error}"
"""


def test_packages_that_are_broken_or_rivals_hurt_only_who_asks(place):
    place.install("yagi-antenna", "yagi_antenna", ENTRY, __init__="", pooling=YAGI)
    place.install(
        "rival",
        "rival",
        "[gaigs.pooling]\nhelix = rival:Helix\n[gaigs.data]\nmuseum = rival:Gone\n",
        __init__="",
    )
    place.install(
        "late",
        "late",
        "[gaigs.pooling]\nhelix = late:Helix\n[gaigs.data]\nattic = absent:Attic\n",
        __init__="",
    )
    place.write(
        "run/plugins/fan.py", 'import gaigs\n@gaigs.register("pooling", "yagi")\nclass Fan: ...\n'
    )
    script = """
asked = [("pooling", "helix"), ("pooling", "yagi"), ("data", "museum"), ("data", "attic")]
print(json.dumps([error(*who) for who in asked]))
"""
    helix, yagi, museum, attic = place.python(ERRORS + script)
    assert helix.startswith("ValueError: pooling 'helix' is held by distribution ")
    assert "distribution rival 1.2" in helix
    assert "distribution late 1.2" in helix
    assert "'yagi' is held by distribution yagi-antenna 1.2, and plugins/fan.py asks for it" in yagi
    assert museum.startswith(
        "ImportError: data 'museum' of distribution rival 1.2 cannot be loaded: AttributeError:"
    )
    assert attic.endswith(
        "distribution late 1.2 cannot be loaded: ModuleNotFoundError: No module named 'absent'"
    )


def test_a_package_both_installed_and_in_plugins_is_no_rival_of_itself(place):
    place.install("yagi-antenna", "yagi_antenna", ENTRY, __init__="", pooling=YAGI)
    project = '[project]\nname = "yagi_antenna"\n[project.entry-points."gaigs.pooling"]\nyagi = "yagi_antenna.pooling:Yagi"\n'
    place.write("run/plugins/yagi/pyproject.toml", project)
    place.write("run/plugins/yagi/yagi_antenna/pooling.py", YAGI)
    assert place.python(ERRORS + 'print(json.dumps(error("pooling", "yagi")))') == "Yagi"


def test_a_component_may_carry_decorator_and_entry_point(place):
    decorated = f'from gaigs.registry import register\n\n\n@register("pooling", "yagi")\n{YAGI}'
    place.install(
        "yagi-antenna",
        "yagi_antenna",
        ENTRY,
        __init__="from .pooling import Yagi",
        pooling=decorated,
    )
    assert place.python(ERRORS + 'print(json.dumps(error("pooling", "yagi")))') == "Yagi"


def test_the_wheel_holds_the_package_and_its_configuration(place, tmp_path):
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    unpacked = tmp_path / "unpacked"
    with ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    assert {path.name.split("-")[0] for path in unpacked.iterdir()} == {"gaigs"}
    shipped = {
        str(path.relative_to(unpacked))
        for path in unpacked.glob("gaigs/**/*")
        if path.suffix in (".py", ".cl", ".yaml")
    }
    assert shipped == {
        *(
            str(path.relative_to(ROOT))
            for path in ROOT.glob("gaigs/**/*")
            if path.suffix in (".py", ".cl")
        ),
        *(f"gaigs/{path.relative_to(ROOT)}" for path in ROOT.glob("conf/**/*.yaml")),
    }
    script = """
from gaigs.configuration import conf_dir
print(json.dumps([str(conf_dir()), registry("projection").names()]))
"""
    conf, projections = place.python(script, gaigs=unpacked)
    assert Path(conf) == unpacked / "gaigs" / "conf"
    assert "mercator" in projections


def test_the_package_installs_from_its_source_archive(tmp_path):
    """As ``pipx run --spec dist/*.whl gaigs --help`` does, without the dependencies."""
    (archive,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    site = tmp_path / "site"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run([*pip, "-q", "--target", str(site), archive], check=True, cwd=tmp_path)
    script = site / "bin" / "gaigs"
    done = subprocess.run(
        [sys.executable, str(script), "--help"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(site)},
    )
    assert done.returncode == 0, done.stderr
    assert "mirrored_rssi" in done.stdout, "experiments are those of the installed conf"


def test_the_table_of_shipped_plug_ins_has_all_entry_points():
    names = {}
    for file in (ROOT / "plugins").glob("*/pyproject.toml"):
        groups = tomllib.loads(file.read_text())["project"]["entry-points"].values()
        names[file.parent.name] = {name for group in groups for name in group}
    assert names == {folder: {*shipped} for folder, shipped in PACKAGES.items()}


def test_an_unknown_name_of_a_shipped_plug_in_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"gaigs-sionna, which is not installed\npip install"):
        registry("data").get("sionna")
