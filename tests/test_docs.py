"""Names in the documentation exist, its commands compose, and its plug-ins train by its commands."""

import contextlib
import csv
import functools
import importlib
import json
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from hatchling.builders.wheel import WheelBuilder
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import gaigs
from gaigs import configuration
from gaigs.configuration.composing import CHOSEN
from gaigs.configuration.hydra_plugins import CONSTRUCTED
from gaigs.configuration.keys import KEYS
from gaigs.data import load
from gaigs.registry import discovery, find_holders, registry

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("docs/results/*.md"),
        *ROOT.glob("plugins/*/*.md"),
    ]
)
OURS = tuple(f"{folder}/" for folder in ("gaigs", "conf", "plugins", "tests", "docs", "benchmarks"))
FILES = {".csv", ".json", ".png", ".ply", ".log"}
"""Endings of files that look like keys."""

PARTS = {*CHOSEN} - {"trainer"}

PLUGINS = ROOT / "docs/plugins.md"
BRIEF = [
    "trainer.max_steps=2", "trainer.val_check_interval=2", "trainer.accelerator=cpu", "gaussians.count=20",
    "trainer.enable_progress_bar=false", "split.validation=0.2", "baselines=[mean,knn]",
]  # fmt: skip
FEW = {
    "data=delay_spread": ["data.places=20"],
    "+experiment=arrival": ["data.places=20"],
    "data=office": [],
}
"""Little data, of an experiment that brings its own."""


def blocks(page, language=""):
    """Fenced blocks of a language; shell commands have none."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [text for kind, text in fences if kind == language]


def commands(page):
    """Shell commands as lists of words."""
    lines = (line for block in blocks(page) for line in block.splitlines())
    return [shlex.split(command) for line in lines for command in line.split(" && ")]


def spoken(page):
    """What stands in backticks in the running text, and in it what looks like a place, a key or a
    name.
    """
    return re.findall(
        r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
    )


def is_importable(name):
    """False for names that take scikit-learn, where it is not installed."""
    return not name.startswith("gaigs.sklearn") or find_spec("sklearn") is not None


def overrides(command):
    """The overrides of a gaigs command, None of any other."""
    module = command[command.index("-m") + 1] if "-m" in command else Path(command[0]).name
    if module == "gaigs":
        return [word for word in command if "=" in word and not word.startswith("--")]
    return None


def written_files(page):
    """The blocks that begin with a comment that is a path, by this path; before it may stand what
    Hydra reads.
    """
    texts = [block for language in ("python", "yaml", "toml") for block in blocks(page, language)]
    named = {re.match(r"(?:# @package \S+\n)?# (\S+/\S+)\n", text): text for text in texts}
    return {match[1]: text for match, text in named.items() if match}


def composable(words):
    """Overrides without a launcher that is not installed here, and without its options."""
    for word in words:
        group, _, name = word.partition("=")
        if group == "hydra/launcher":
            assert name in ("joblib", "submitit_local", "submitit_slurm", "ray"), name
            try:
                metadata.version(f"hydra-{name.partition('_')[0]}-launcher")
            except metadata.PackageNotFoundError:
                return [
                    word
                    for word in words
                    if not word.startswith(("hydra/launcher", "hydra.launcher."))
                ]
    return words


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder that holds what docs/plugins.md tells to write, beside the plug-ins of this
    repository.
    """
    folder = tmp_path_factory.mktemp("place")
    shutil.copytree(
        ROOT / "plugins", folder / "plugins", ignore=shutil.ignore_patterns("__pycache__")
    )
    files = written_files(PLUGINS)
    package = folder / "gaigs-plane-waves/gaigs_plane_waves"
    files[package / "__init__.py"] = files["plugins/plane_waves.py"]
    for path, text in files.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    rows = np.random.default_rng(0).uniform([0, 0, 1, -99, -99], [10, 6, 2, -40, -40], (20, 5))
    np.savetxt(folder / "office.csv", rows, delimiter=",", header="x,y,z,door,window")
    return folder


@pytest.fixture(scope="module")
def composed(place):
    """Composes gaigs's configuration where the documentation's plug-ins are found."""

    search = functools.cache(discovery._dropped_holders)  # no file there changes

    @functools.cache
    def composed(*words):
        with (
            contextlib.chdir(place),
            pytest.MonkeyPatch.context() as patch,
            initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"),
        ):
            patch.setattr(discovery, "_dropped_holders", search)
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
        headings = re.findall(
            r"^#+ (.+)$", (page.parent / target if target else page).read_text(), re.M
        )
        assert anchor in [
            re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings
        ]


@page_by_page
def test_names_of_python_exist(page):
    for word in spoken(page):
        is_name = re.fullmatch(r"gaigs(\.\w+)+", word) and Path(word).suffix not in FILES
        if is_name and is_importable(word):
            pkgutil.resolve_name(word)


@page_by_page
def test_modules_and_files_of_commands_exist(page):
    for command in commands(page):
        if "-m" in command:
            module = command[command.index("-m") + 1]
            assert find_spec(f"{module}.__main__"), module
        if "-c" in command:
            assert (ROOT / command[command.index("-c") + 1]).is_file(), command


def composable_lines(page):
    """The overrides of each command; of a sweep each word once, beside the others' first."""
    for words in filter(None, map(overrides, commands(page))):
        parsed = OverridesParser.create().parse_overrides(composable(words))
        choices = [
            [f"{o.input_line.partition('=')[0]}={value}" for value in o.sweep_string_iterator()]
            if o.is_sweep_override()
            else [o.input_line]
            for o in parsed
        ]
        first = [values[0] for values in choices]
        yield first
        for position, values in enumerate(choices):
            for value in (value for value in values[1:] if not re.search(r"=[-+.\de]+$", value)):
                yield [*first[:position], value, *first[position + 1 :]]


def chosen(line):
    """The words that choose parts, in their order; the others set values, in whatever order."""
    values = KEYS.keys() - CHOSEN
    return tuple(
        word
        for word in line
        if re.match(r"~|[+]*[\w/@]+=", word) and word.partition("=")[0] not in values
    )


@functools.cache
def together():
    """All words of all pages that stand beside the same choices, each key once: they compose in one
    go.
    """
    found = {}
    for line in (line for page in PAGES for line in composable_lines(page)):
        found.setdefault(chosen(line), {}).update((word.partition("=")[0], word) for word in line)
    return found


def key(word):
    """What a word chooses or sets."""
    return word.lstrip("~+").partition("=")[0]


BRINGING = {"experiment", "variant", "data", "task", "model"}
"""Choices that bring other parts."""


def facts(choice, words):
    """The choices, and each option beside the choices that may have it."""
    chosen = {key(word): word for word in choice}
    bringing = [word for word in choice if key(word) in BRINGING]
    found = {*choice}
    for option in map(key, words.values()):
        part = option.partition(".")[0]
        if part in chosen:
            found.add((chosen[part], option))
        else:  # keys of no part are always there
            found |= {(word, option) for word in (bringing if part in PARTS else [""])}
    return found


@functools.cache
def telling():
    """The fewest choices that have all facts, the one that adds most first."""
    left = {choice: facts(choice, words) for choice, words in together().items()}
    kept = set()
    while any(left.values()):
        most = max(left, key=lambda choice: len(left[choice]))
        kept.add(most)
        left = {choice: found - left[most] for choice, found in left.items()}
    return kept


@page_by_page
def test_commands_compose(page, composed):
    for line in composable_lines(page):
        if chosen(line) in telling():
            composed(*together()[chosen(line)].values())


@pytest.mark.parametrize("command", ["gaigs +experiment", "pytest"])
def test_each_block_of_the_readme_installs_the_processors_torch_first(command):
    """Each is complete alone; torch of PyPI would bring CUDA packages, unless the CPU build is
    there already.
    """
    (block,) = [
        block
        for block in blocks(ROOT / "README.md")
        if "-m venv" in block and f".venv/bin/{command}" in block
    ]
    first, torch_line, install, *_ = block.splitlines()
    assert first == "python3 -m venv .venv"
    assert "--no-deps torch --extra-index-url https://download.pytorch.org/whl/cpu" in torch_line
    assert all(
        line.startswith(".venv/bin/pip install -c constraints.txt ")
        for line in (torch_line, install)
    )


@page_by_page
def test_configuration_keys_exist(page, composed, place):
    for word in spoken(page):
        match = re.fullmatch(r"\+?(?P<top>[a-z_]+)(\.[a-z_]+)*(=\S+)?", word)
        if match is None or not set(".=") & set(word) or Path(word).suffix in FILES:
            continue
        if (
            match["top"] not in composed()
            and not (configuration.conf_dir() / match["top"]).is_dir()
        ):
            continue
        key, _, value = word.removeprefix("+").partition("=")
        top, *rest = key.split(".")
        options = options_of(top, place)
        if options and not rest:
            assert value.strip('"') in options, word
        elif not _has(composed(), key):
            # A key that only some option of its group has, such as data.root, exists too.
            own = any(_has(option, ".".join(rest)) for option in options.values())
            if not (own or any(_has(composed(f"{top}={name}"), key) for name in options)):
                assert "=" in word, word
                composed(word)  # of a section to which any key may be added


@functools.cache
def options_of(top, place):
    """Names of the files and components of a group, and their keys."""
    with contextlib.chdir(place):
        folders = [configuration.conf_dir(), *configuration.plugin_conf_dirs()]
        options = {
            file.stem: OmegaConf.to_container(OmegaConf.load(file))
            for folder in folders
            for file in folder.glob(f"{top}/*.yaml")
        }
        for name in registry(top).names() if top in CONSTRUCTED else ():
            options[name] = registry(top).options(name) | options.get(name, {})
    return options


def _has(config, key):
    for part in key.split("."):
        if not isinstance(config, dict) or part not in config:
            return False
        config = config[part]
    return True


def choices(kind):
    """Names of our own components and presets of a kind."""
    built_in = (
        holder.name for holder in find_holders(kind)[0] if holder.file and holder.root is None
    )
    return {*built_in, *(file.stem for file in configuration.conf_dir().glob(f"{kind}/*.yaml"))}


@pytest.mark.parametrize("kind", ["data", "split", "model", "deformation", "loss"])
def test_the_first_page_lists_the_choices(kind):
    _, table = (ROOT / "docs/start.md").read_text().split("| option | choices |\n")
    (row,) = re.findall(rf"^\| `{kind}` \|(.*)$", table.partition("\n\n")[0], re.M)
    assert {*re.findall(r"`(\w+)`", row)} == choices(kind)


@pytest.mark.parametrize("kind", ["data", "split"])
def test_the_page_on_data_describes_each_component(kind):
    first_cells = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/data.md").read_text(), re.M)
    assert choices(kind) <= {*first_cells}


SETS = {
    "README.md": {
        "200 measured spectra, published split": ("rfid-s23-200", "median SSIM"),
        "simulated room, random places": ("built-in", "median SSIM"),
        "simulated room, held-out blocks": ("built-in-blocks", "median SSIM"),
        "flat with Bluetooth, another run": ("ble-flat", "MAE [dB]"),
        "simulated channels": ("built-in-csi", "median SNR [dB]"),
    },
    "docs/results/systems.md": {
        "rfid-s23-200": ("rfid-s23-200", "median SSIM"),
        "built-in": ("built-in", "median SSIM"),
        "blocks 1 m": ("built-in-blocks", "median SSIM"),
        "ble-flat": ("ble-flat", "MAE [dB]"),
        "channels, SNR": ("built-in-csi", "median SNR [dB]"),
        "channels, NMSE": ("built-in-csi", "NMSE [dB]"),
    },
}
"""Columns of pages, by their heads, with the folder of docs/results that is their source, and the
score.
"""

SECTIONS = {
    "Measured spectra, 200 samples": "rfid-s23-200",
    "The built-in room": "built-in",
    "Received signal strength: six Bluetooth gateways in a flat": "ble-flat",
    "Complex channels: the built-in room": "built-in-csi",
}
"""Sections of docs/results.md whose baselines are those of a folder of docs/results."""


def tables(text):
    """Tables of a text in Markdown, each as lists of cells, without the line below the head."""
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        rows = [
            [cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()
        ]
        yield [rows[0], *rows[2:]]


@functools.cache
def source(folder):
    """Scores in ``systems.csv``, by system and title."""
    with (ROOT / "docs/results" / folder / "systems.csv").open() as file:
        return {row["system"]: row for row in csv.DictReader(file)}


def require_score(printed, folder, system, title):
    number = printed.strip("*")
    digits = len(number.partition(".")[2])
    assert round(float(source(folder)[system][title]), digits) == float(number), (
        folder,
        system,
        title,
    )


@pytest.mark.parametrize("page", SETS)
def test_pages_have_the_scores_of_their_source(page):
    columns, names = (
        SETS[page],
        {"nearest neighbours": "knn", "Gaussian process": "gaussian_process"},
    )
    (table,) = [rows for rows in tables((ROOT / page).read_text()) if columns.keys() <= {*rows[0]}]
    count = 0
    for name, *cells in table[1:]:
        for head, printed in zip(table[0][1:], cells, strict=True):
            if head in columns and re.fullmatch(r"\**-?[\d.]+\**", printed):
                folder, title = columns[head]
                require_score(printed, folder, names.get(name, name.strip("`")), title)
                count += 1
    assert count >= 4 * len(columns)


def test_the_page_of_results_has_the_scores_of_their_source():
    text = (ROOT / "docs/results.md").read_text()
    first, *sections = re.split(r"^##+ ", text, flags=re.M)
    rows = {
        "200 measured spectra, published split": (
            "rfid-s23-200",
            ["median SSIM"],
            ["knn", "gaussian_process"],
        ),
        "built-in room, spectra": ("built-in", ["median SSIM"], ["gaussian_process"]),
        "flat with six Bluetooth gateways, another run as test": (
            "ble-flat",
            ["MAE [dB]"],
            ["gaussian_process"],
        ),
        "built-in room, complex channels": (
            "built-in-csi",
            ["median SNR [dB]", "NMSE [dB]"],
            ["friis"],
        ),
    }
    (table,) = [table for table in tables(first) if "best baseline" in table[0]]
    cells = {row[0]: row for row in table}
    for row, (folder, titles, baselines) in rows.items():
        for cell, systems in ((1, ["GAI-GS"]), (2, baselines)):
            numbers = re.findall(r"-?\d+\.\d+", cells[row][cell])
            for system in systems:
                for number, title in zip(numbers, titles, strict=True):
                    require_score(number, folder, system, title)
    number = re.search(r"median SNR ([\d.]+) dB in the built-in room", first)[1]
    require_score(number, "built-in-csi", "mirrored Gaussians", "median SNR [dB]")
    for section in sections:
        if (folder := SECTIONS.get(section.partition("\n")[0])) is None:
            continue
        head, *rows = next(table for table in tables(section) if table[0][0] == "model")
        for name, *cells in rows:
            scores = source(folder).get(name.strip("`"), {})
            for title, printed in zip(head[1:], cells, strict=True):
                if title in scores and printed:
                    require_score(printed, folder, name.strip("`"), title)


@pytest.mark.parametrize(
    "page",
    [*PAGES, *sorted(ROOT.glob("docs/results/*/*.md"))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_all_that_equal_the_best_of_a_column_are_bold(page):
    for head, *rows in tables(page.read_text()):
        for title, *cells in zip(
            *(row for row in (head, *rows) if len(row) == len(head)), strict=True
        ):
            best = {cell.strip("*") for cell in cells if re.fullmatch(r"\*\*[-\d.,]+\*\*", cell)}
            assert not best & {*cells}, (head[0], title)


def test_every_page_is_in_the_navigation_and_in_the_readmes_table():
    nav, readme = ((ROOT / name).read_text() for name in ("mkdocs.yml", "README.md"))
    for page in ROOT.glob("docs/*.md"):
        assert f"- docs/{page.name}\n" in nav, page.name
        assert f"](docs/{page.name})" in readme, page.name


def test_the_reference_has_every_public_name():
    listed = re.findall(r"^::: (\S+)$", (ROOT / "docs/reference.md").read_text(), re.M)
    assert {f"gaigs.{name}" for name in gaigs.__all__} - {"gaigs.__version__"} <= {*listed}
    for name in filter(is_importable, listed):
        pkgutil.resolve_name(name)


@page_by_page
def test_tables_of_options_have_a_description_of_each(page, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    options = importlib.import_module("options")
    filled = options.fill_in(page.read_text())  # an option without a description is an error
    assert not options.LINE.search(filled)


def test_the_documented_file_of_channels_is_read(tmp_path):
    (code,) = [
        block for block in blocks(ROOT / "docs/data.md", "python") if 'np.savez("room.npz"' in block
    ]
    with contextlib.chdir(tmp_path):
        exec(code, {})
        links = load({"name": "csi_npz", "file": "room.npz"}, {"name": "random"})
    assert (len(links), *links.task.shape) == (200, 4, 8)


@pytest.fixture(scope="module")
def runs(place):
    """The folders that the commands of docs/plugins.md leave, in their order, each after two steps."""
    script = """
import functools, json, sys
from gaigs.__main__ import main
from gaigs.report import run_figures
from gaigs.runs import evaluation
evaluation.paired = functools.partial(evaluation.paired, resamples=20)
evaluation.median_ms = lambda work: (work(), 1.0)[1]
draw, runs = run_figures.write_figures, json.loads(sys.argv[1])
for number, words in enumerate(runs):
    sys.argv = ["gaigs", *words]
    run_figures.write_figures = draw if number in (4, 5) else lambda *_: None  # a test looks at them
    main()
"""
    found = [words for words in map(overrides, commands(PLUGINS)) if words is not None]
    folders = [Path("runs/room"), *(Path(f"runs/{number}") for number in range(1, len(found)))]
    runs = []
    for words, folder in zip(found, folders, strict=True):
        few = [FEW[word] for word in words if word in FEW] or [
            ["data.transmitters=10", "data.order=0"]
        ]
        runs.append([*words, *BRIEF, *few[0], f"hydra.run.dir={folder}"])
    _python(place, "-c", script, json.dumps(runs))
    return [place / folder for folder in folders]


def test_the_plug_ins_train_by_their_commands(runs):
    expected = [
        ("gaigs", "spectrum", "tokenizer.waves.weight"),
        ("gaigs", "rssi", "gaussians.means"),
        ("gaigs", "rssi", "gaussians.means"),
        ("direction_mlp", "spectrum", "receivers.weight"),
        ("gaigs", "delay_spread", "trend.levels"),
        ("gaigs", "arrival", "gaussians.means"),
        ("gaigs", "spectrum", "placement.share"),
        ("gaigs", "spectrum", "gaussians.means"),
    ]
    for folder, (model, task, weights) in zip(runs, expected, strict=True):
        metrics = json.loads((folder / "metrics.json").read_text())
        assert [*metrics["models"]][:3] == [model, "mean", "knn"]
        assert metrics["task"] == task
        checkpoint = torch.load(folder / "best.ckpt", weights_only=True)
        assert checkpoint["global_step"] in (0, 2), (
            "where a trend alone was best, the start is kept"
        )
        assert f"model.{weights}" in checkpoint["state_dict"]
    assert metrics["split"].startswith("layers 0.2 m, test 0.2, validation 0.2")


def test_a_plug_ins_task_has_its_own_scores_and_figures(runs):
    folder = runs[4]
    (own, *_) = json.loads((folder / "metrics.json").read_text())["models"].values()
    assert [*own] == ["mae_ns", "median_ae_ns", "rmse_ns"]
    with np.load(folder / "radio_map.npz") as radio_map:
        assert (str(radio_map["quantity"]), str(radio_map["unit"])) == ("RMS delay spread", "ns")
        assert radio_map["values_ns"].shape[0] == 1
    drawn = {path.stem for path in (folder / "figures").glob("*.png")}
    assert drawn >= {"radio_map", "predicted_against_measured", "error_cdf"}
    assert {path.stem for path in (runs[5] / "figures").glob("*.png")} >= {"room", "angle_cdf"}


def test_the_readme_predicts_and_the_plug_ins_keep_their_contracts_as_the_page_checks_them(
    place, runs
):
    (predict,) = [block for block in blocks(ROOT / "README.md", "python") if "runs/room" in block]
    (check,) = [block for block in blocks(PLUGINS, "python") if "from gaigs.testing" in block]
    assert (
        _python(place, "-c", f"{predict}\nprint([*spectra.shape])\n{check}").strip()
        == "[2, 90, 360]"
    )


def test_the_packages_are_found_once_installed(place, tmp_path):
    for project in ("gaigs-plane-waves", "plugins/array_response"):
        (wheel,) = WheelBuilder(str(place / project)).build(
            directory=str(tmp_path / "wheels"), versions=["standard"]
        )
        with ZipFile(wheel) as archive:
            archive.extractall(tmp_path / "site")  # what pip does with a wheel
    (tmp_path / "elsewhere").mkdir()
    script = """
from hydra import compose, initialize_config_dir
from gaigs import configuration
from gaigs.registry import registry
with initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
    config = compose("config", ["tokenizer=plane_waves", "model=array_response"])
parts = [registry(kind).get(config[kind]["name"]) for kind in ("tokenizer", "model")]
print(*(part.__module__ for part in parts))
"""
    found = _python(tmp_path / "elsewhere", "-c", script, path=tmp_path / "site")
    assert found.split() == ["gaigs_plane_waves", "gaigs_array_response"]


def _python(folder, *arguments, path=None):
    """The output of a fresh interpreter in a folder."""
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
