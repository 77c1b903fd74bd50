"""Every data set brings its options with their defaults, its task and its split."""

import inspect

import pytest
from omegaconf import OmegaConf

from gaigs.registry import registry

CHOICES = {
    "nerf2_spectrum": ("spectrum", "official"),
    "nerf2_rssi": ("rssi", "official_runs"),
    "synthetic": ("spectrum", "official"),
    "synthetic_rssi": ("rssi", "official"),
    "synthetic_csi": ("csi", "official"),
    "sionna": ("spectrum", "official"),
    "sionna_rssi": ("rssi", "official"),
    "sionna_csi": ("csi", "official"),
    **dict.fromkeys(("rssi_csv", "rssi_wide", "deepmimo_rssi"), ("rssi", "random")),
    **dict.fromkeys(("csi_npz", "deepmimo"), ("csi", "random")),
}
"""Task and split that each chooses."""


@pytest.mark.parametrize("name", CHOICES)
def test_a_data_set_brings_its_options_task_and_split(configured, name):
    config, (task, split) = configured(f"data={name}"), CHOICES[name]
    named = inspect.signature(registry("data").get(name)).parameters
    defaults = {key: "???" if p.default is p.empty else p.default for key, p in named.items()}
    defaults = {
        key: [*value] if isinstance(value, tuple) else value for key, value in defaults.items()
    }
    assert OmegaConf.to_container(config.data) == {"name": name, **defaults}
    assert config.task.name == task
    assert config.split == configured(f"data={name}", f"split={split}").split


def test_a_split_on_the_command_line_precedes_the_datas_own(configured):
    config = configured("data=nerf2_rssi", "split=blocks", "split.edge=0.5")
    assert config.task.name == "rssi"
    assert config.split == {
        "name": "blocks",
        "edge": 0.5,
        "test": 0.2,
        "validation": None,
        "seed": 0,
    }
