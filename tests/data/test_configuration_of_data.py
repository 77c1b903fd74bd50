"""Every data set's configuration has all its options with their defaults, and chooses its task and split."""

import inspect

import pytest
from omegaconf import OmegaConf

from gaigs.configuration import conf_dir
from gaigs.registry import registry

CHOICES = {
    "nerf2_spectrum": ("spectrum", "official"),
    "nerf2_rssi": ("rssi", "official_runs"),
    "rssi_csv": ("rssi", "random"),
    "rssi_wide": ("rssi", "random"),
    "csi_npz": ("csi", "random"),
    "deepmimo": ("csi", "random"),
    "deepmimo_rssi": ("rssi", "random"),
    "synthetic": ("spectrum", "official"),
    "synthetic_rssi": ("rssi", "official"),
    "synthetic_csi": ("csi", "official"),
    "sionna": ("spectrum", "official"),
    "sionna_rssi": ("rssi", "official"),
    "sionna_csi": ("csi", "official"),
}
"""Task and split that each chooses."""


def test_every_data_set_has_a_configuration():
    assert {file.stem for file in (conf_dir() / "data").glob("*.yaml")} == CHOICES.keys()
    assert CHOICES.keys() <= {*registry("data").names()}


@pytest.mark.parametrize("name", CHOICES)
def test_a_configuration_has_every_option_with_its_default(name):
    file = OmegaConf.load(conf_dir() / "data" / f"{name}.yaml")
    task, split = CHOICES[name]
    assert file.defaults == [{"override /task": task}, {"override /split": split}]
    config = OmegaConf.to_container(file.data)
    mandatory = {key for key, value in config.items() if value == "???"}
    parameters = inspect.signature(registry("data").get(config.pop("name"))).parameters
    assert config.keys() == parameters.keys()
    assert mandatory == {key for key, p in parameters.items() if p.default is p.empty}
    for key in parameters.keys() - mandatory:
        value, default = config[key], parameters[key].default
        default = [*default] if isinstance(default, tuple) else default
        # PyYAML reads 1e9 without a point as a string, so the numbers are compared by type too.
        assert (value, type(value)) == (default, type(default))


def test_a_split_on_the_command_line_precedes_the_datas_own(configured):
    config = configured("data=nerf2_rssi", "split=blocks", "split.edge=0.5")
    assert config.task.name == "rssi"
    assert config.split == {"name": "blocks", "edge": 0.5, "test": 0.2, "validation": 0.1, "seed": 0}
