"""Choices of configuration files together, and resolvers that depend on installed packages."""

import functools
import logging
from importlib import metadata
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from gaigs.configuration import conf_dir, differences
from gaigs.configuration.hydra_plugins import installed, known, launcher
from gaigs.registry import registry

ROOT = Path(__file__).parents[1]
DATA = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
MIRRORED = {"spectrum": "mirrored", "rssi": "mirrored_rssi", "csi": "mirrored_csi"}
TRENDS = {"spectrum": None, "rssi": {"name": "mean"}, "csi": None}


@pytest.fixture(scope="module")
def configure():
    """Composes the configuration; with Hydra's own part, as it stands."""

    def configure(*overrides, with_hydra=False):
        config = compose("config", [*overrides], return_hydra_config=with_hydra)
        return config if with_hydra else OmegaConf.to_container(config, resolve=True)

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        yield functools.cache(configure)


# --- a model of several tasks ---


@pytest.mark.parametrize("task", DATA)
def test_a_model_chooses_what_suits_it_for_every_task(configure, task):
    config = configure("model=mirrored", f"data={DATA[task]}")
    assert config == configure(f"+experiment={MIRRORED[task]}")
    assert config["task"]["name"] == task
    model = config["model"]
    parts = ("name", "placement", "deformation", "pooling")
    names = [model[part] if part == "name" else model[part]["name"] for part in parts]
    assert names == ["mirrored", "mirrored", "none", f"path_{task}"]
    assert model["projection"] is model["rasterizer"] is None
    assert (model["gaussians"], model["trend"]) == (None, TRENDS[task])
    steps = 2000 if task == "csi" else 900
    assert (config["kriging"], config["threads"], config["trainer"]["max_steps"]) == (
        True,
        1,
        steps,
    )


def test_the_command_line_wins_over_a_model_and_a_model_over_the_task(configure):
    chosen = (
        "pooling=softmax_attention",
        "gaussians=lattice",
        "gaussians.count=7",
        "kriging=false",
        "threads=2",
    )
    config = configure("model=mirrored", "data=synthetic_rssi", *chosen, "trainer.max_steps=5")
    assert config["pooling"] == configure("data=synthetic_rssi")["pooling"]
    assert config["model"]["gaussians"]["count"] == 7
    assert (config["kriging"], config["threads"], config["trainer"]["max_steps"]) == (False, 2, 5)


def test_an_experiment_wins_over_a_model_and_a_variant_brings_the_papers_network(configure):
    config = configure("+experiment=rssi", "model=mirrored", "+variant=paper")
    assert config["trainer"]["max_steps"] == 600
    assert config["model"]["gaussians"] is None
    assert config["deformation"]["name"] == "two_branch"
    assert len(config["deformation"]["heads"]) == 5


# --- the width of the deformation network ---


@pytest.mark.parametrize(("task", "width"), [("spectrum", None), ("rssi", 32), ("csi", 64)])
def test_the_task_says_how_wide_the_network_is_and_the_command_line_wins(configure, task, width):
    for words, expected in (
        ((), width),
        (("deformation=two_branch",), 64),
        (("deformation.width=5",), 5),
    ):
        assert configure(f"data={DATA[task]}", *words)["model"]["deformation"]["width"] == expected


@pytest.mark.parametrize(("task", "width"), [("spectrum", 64), ("rssi", 32), ("csi", 64)])
def test_variants_of_the_paper_are_as_wide_as_they_were_measured(configure, task, width):
    for words in (
        ("+variant=no_scale", "+experiment=claims"),
        ("+experiment=claims", "+variant=no_scale"),
    ):
        deformation = configure(f"data={DATA[task]}", *words)["deformation"]
        assert (deformation["width"], len(deformation["heads"])) == (width, 4)
    assert configure(f"data={DATA[task]}", "+variant=static", "+experiment=claims")[
        "deformation"
    ] == {"name": "none"}


# --- all systems ---


@pytest.mark.parametrize("task", DATA)
@pytest.mark.parametrize("model", ["gaigs", "mirrored", "knn"])
def test_systems_have_one_budget_with_every_model(configure, task, model):
    config = configure(f"+experiment=systems_{task}", f"model={model}")
    assert (config["task"]["name"], config["model"]["name"], config["data"]["name"]) == (
        task,
        model,
        DATA[task],
    )
    budget = {"max_time": "00:00:03:00", "val_check_interval": "00:00:00:15"}
    assert config["trainer"] == configure("trainer.max_steps=-1")["trainer"] | budget


@pytest.mark.parametrize("task", DATA)
def test_systems_are_swept_over_as_far_as_they_are_installed(
    configure, task, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)  # where no plug-in is
    settings = configure(f"+experiment=systems_{task}", with_hydra=True).hydra
    listed = OmegaConf.to_container(settings.sweeper.params)["model"]
    names = listed.removeprefix("${installed:").removesuffix("}").replace(" ", "").split(",")
    assert {"gaigs", "mirrored"} <= {*names}
    swept = settings.sweeper.params["model"].split(",")
    assert {*swept} <= {*registry("model").names()}
    assert swept[-2:] == ["gaigs", "mirrored"]
    assert settings.sweep.dir == f"runs/systems_{task}"
    assert settings.callbacks.report["_target_"] == "gaigs.report.hydra_callback.MultirunReport"


def test_a_choice_by_task_exists_or_is_replaced():
    assert known("pooling", "path_rssi", "spectrum") == "path_rssi"
    assert known("pooling", "path_delay", "path_rssi") == "path_rssi"


def test_models_that_are_not_installed_are_left_out_with_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        assert installed("knn", "yagi", "gaigs", "loop") == "knn,gaigs"
    assert [record.getMessage() for record in caplog.records] == [
        "left out, as not installed: model=yagi,loop"
    ]


def test_two_jobs_run_at_a_time_if_joblib_is_installed(configure, monkeypatch):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs gaigs[parallel]")

    def settings(*more):
        return configure.__wrapped__(
            "+experiment=systems_rssi", *more, with_hydra=True
        ).hydra.launcher

    assert settings()["n_jobs"] == 2
    assert settings()["_target_"].endswith("JoblibLauncher")

    def lacks(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", lacks)
    assert launcher("two") == "basic"
    assert settings()["_target_"].endswith("BasicLauncher")


@pytest.mark.parametrize(
    ("there", "here", "expected"),
    [
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 3, "c": 2}, "d": 4}, {"a.b": (1, 3), "d": (None, 4)}),
        (
            {"part": {"name": "x", "k": 1}},
            {"part": {"name": "y", "l": 1}},
            {"part.name": ("x", "y")},
        ),
        (
            {"threads": 1, "trainer": {"enable_progress_bar": True}},
            {"threads": 2, "trainer": {}},
            {},
        ),
    ],
)
def test_differences_name_the_part_and_leave_out_harmless_keys(there, here, expected):
    assert differences(there, here) == expected
