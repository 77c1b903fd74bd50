"""What the documentation names exists, its commands compose, and its plug-in trains by the command that it gives."""

import contextlib
import functools
import json
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from zipfile import ZipFile

import pytest
import torch
from hatchling.builders.wheel import WheelBuilder
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from gaigs import configuration

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("plugins/*/*.md")])
OURS = tuple(f"{folder}/" for folder in ("gaigs", "conf", "plugins", "tests", "docs", "benchmarks"))
FILES = {".ply", ".log"}
"""What a file's name ends in that would pass for a key or a name."""

BRIEF = [
    "trainer.max_steps=2", "trainer.val_check_interval=2", "trainer.accelerator=cpu", "gaussians.count=20",
    "data.transmitters=10", "data.order=0", "split.validation=0.2", "hydra.run.dir=runs/room",
]  # fmt: skip


def blocks(page, language=""):
    """Fenced blocks of a language; shell commands have none."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [text for kind, text in fences if kind == language]


def commands(page):
    """Shell commands as lists of words."""
    lines = (line for block in blocks(page) for line in block.splitlines())
    return [shlex.split(command) for line in lines for command in line.split(" && ")]


def spoken(page):
    """What stands in backticks in the running text, and in it what looks like a place, a key or a name."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S))


def overrides(command):
    """The overrides of a gaigs command, None of any other."""
    program = Path(command[0]).name
    if program == "gaigs" or (program == "python" and command[1:3] == ["-m", "gaigs"]):
        return [word for word in command if "=" in word and not word.startswith("--")]
    return None


def written_files(page):
    """The blocks that begin with a comment that is a path, by this path."""
    texts = [block for language in ("python", "yaml", "toml") for block in blocks(page, language)]
    named = {re.match(r"# (\S+/\S+)\n", text): text for text in texts}
    return {match[1]: text for match, text in named.items() if match}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder that holds what docs/plugins.md tells to write, beside the plug-ins of this repository."""
    folder = tmp_path_factory.mktemp("place")
    shutil.copytree(ROOT / "plugins", folder / "plugins", ignore=shutil.ignore_patterns("__pycache__"))
    files = written_files(ROOT / "docs/plugins.md")
    package = folder / "gaigs-plane-waves/gaigs_plane_waves"
    files[package / "__init__.py"] = files["plugins/plane_waves.py"]
    files[package / "conf/tokenizer/plane_waves.yaml"] = files["plugins/conf/tokenizer/plane_waves.yaml"]
    for path, text in files.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


@pytest.fixture(scope="module")
def composed(place):
    """Composes gaigs's configuration where the documentation's plug-ins are found."""
    configuration.install()

    @functools.cache
    def composed(*words):
        with contextlib.chdir(place), initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
            return OmegaConf.to_container(compose("config", list(words), return_hydra_config=True))

    return composed


page_by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@page_by_page
def test_files_and_links_exist(page, place):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target
    for word in spoken(page):
        if word.startswith(OURS) and not set("<*") & set(word):
            assert (ROOT / word).exists() or (place / word).exists(), word


@page_by_page
def test_anchors_exist(page):
    for target, anchor in re.findall(r"\]\(([^)#]*)#([^)]+)\)", page.read_text()):
        headings = re.findall(r"^#+ (.+)$", (page.parent / target if target else page).read_text(), re.M)
        assert anchor in [re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings]


@page_by_page
def test_names_of_python_exist(page):
    for word in spoken(page):
        if re.fullmatch(r"gaigs(\.\w+)+", word) and Path(word).suffix not in FILES:
            pkgutil.resolve_name(word)


@page_by_page
def test_programs_exist(page):
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for command in commands(page):
        program = Path(command[0]).name
        assert program in {"python", "python3", "pip", "pytest", "source", *scripts}, command
        if "-m" in command:
            module = command[command.index("-m") + 1]
            assert find_spec(f"{module}.__main__"), module
        if "-c" in command:
            assert (ROOT / command[command.index("-c") + 1]).is_file(), command


@page_by_page
def test_commands_compose(page, composed):
    for words in filter(None, map(overrides, commands(page))):
        parsed = OverridesParser.create().parse_overrides(words)
        choices = [
            [f"{o.input_line.partition('=')[0]}={value}" for value in o.sweep_string_iterator()]
            if o.is_sweep_override()
            else [o.input_line]
            for o in parsed
        ]
        for chosen in product(*choices):
            composed(*chosen)


@page_by_page
def test_configuration_keys_exist(page, composed, place):
    with contextlib.chdir(place):
        folders = [configuration.conf_dir(), *configuration.plugin_conf_dirs()]
    for word in spoken(page):
        match = re.fullmatch(r"\+?(?P<top>[a-z_]+)(\.[a-z_]+)*(=\S+)?", word)
        if match is None or not set(".=") & set(word) or Path(word).suffix in FILES:
            continue
        if match["top"] not in composed() and not (configuration.conf_dir() / match["top"]).is_dir():
            continue
        # A key that only some option of its group has, such as data.root, exists too.
        options = [file.stem for folder in folders for file in folder.glob(f"{match['top']}/*.yaml")]
        bases = [[f"{match['top']}={option}"] for option in options if "." in word.partition("=")[0]]
        assert any(_has(composed, base, word) for base in ([], *bases)), word


def _has(composed, base, word):
    if "=" in word:
        with contextlib.suppress(HydraException):
            composed(*base, word)
            return True
        return False
    config = composed(*base)
    for key in word.split("."):
        if not isinstance(config, dict) or key not in config:
            return False
        config = config[key]
    return True


@pytest.mark.parametrize("kind", ["data", "split", "model", "deformation", "loss"])
def test_the_first_page_lists_the_choices(kind):
    _, table = (ROOT / "docs/start.md").read_text().split("| option | choices |\n")
    (row,) = re.findall(rf"^\| `{kind}` \|(.*)$", table.partition("\n\n")[0], re.M)
    files = configuration.conf_dir().glob(f"{kind}/*.yaml")
    assert {*re.findall(r"`(\w+)`", row)} == {file.stem for file in files}


@pytest.mark.parametrize("kind", ["data", "split"])
def test_the_page_on_data_describes_what_there_is(kind):
    first_cells = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/data.md").read_text(), re.M)
    assert {file.stem for file in configuration.conf_dir().glob(f"{kind}/*.yaml")} <= {*first_cells}


def test_the_documented_file_of_channels_is_read(tmp_path):
    (code,) = [block for block in blocks(ROOT / "docs/data.md", "python") if "np.savez" in block]
    check = """
from gaigs.data import load
links = load({"name": "csi_npz", "file": "room.npz"}, {"name": "random"})
print(len(links), *links.task.shape)
"""
    assert _python(tmp_path, "-c", code + check).split() == ["200", "4", "8"]


def test_the_tokenizer_has_fifteen_lines():
    source = written_files(ROOT / "docs/plugins.md")["plugins/plane_waves.py"]
    assert len([line for line in source.splitlines()[1:] if line.strip()]) <= 15


def test_the_tokenizer_trains_by_its_command_and_predicts_as_the_readme_says(place):
    (command,) = [words for words in map(overrides, commands(ROOT / "docs/plugins.md")) if words is not None]
    _python(place, "-m", "gaigs", *command, *BRIEF)
    metrics = json.loads((place / "runs/room/metrics.json").read_text())
    assert [*metrics["models"]] == ["gaigs", "mean", "knn", "gaussian_process"]
    checkpoint = torch.load(place / "runs/room/best.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 2
    assert "model.tokenizer.waves.weight" in checkpoint["state_dict"]
    (predict,) = blocks(ROOT / "README.md", "python")
    check = blocks(ROOT / "docs/plugins.md", "python")[-1]
    script = f"{predict}\nprint([*spectra.shape])\n{check}\ntest_plane_waves()"
    assert _python(place, "-c", script).strip() == "[2, 90, 360]"


def test_the_packages_are_found_once_installed(place, tmp_path):
    for project in ("gaigs-plane-waves", "plugins/array_response"):
        (wheel,) = WheelBuilder(str(place / project)).build(directory=str(tmp_path / "wheels"), versions=["standard"])
        with ZipFile(wheel) as archive:
            archive.extractall(tmp_path / "site")  # what pip does with a wheel
    (tmp_path / "elsewhere").mkdir()
    script = """
from hydra import compose, initialize_config_dir
from gaigs import configuration
from gaigs.registry import registry
configuration.install()
with initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
    config = compose("config", ["tokenizer=plane_waves", "model=array_response"])
parts = [registry(kind).get(config[kind]["name"]) for kind in ("tokenizer", "model")]
print(*(part.__module__ for part in parts))
"""
    found = _python(tmp_path / "elsewhere", "-c", script, path=tmp_path / "site")
    assert found.split() == ["gaigs_plane_waves", "gaigs_array_response"]


def _python(folder, *arguments, path=None):
    """What a fresh interpreter prints that is started in a folder."""
    paths = [str(path) for path in (path, ROOT) if path]
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
