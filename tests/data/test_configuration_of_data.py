"""Every data set's configuration has all its options with their defaults, and chooses its task and split."""

import inspect

import pytest
from omegaconf import OmegaConf

from gaigs.configuration import conf_dir
from gaigs.data import load
from gaigs.registry import registry

CHOICES = {
    "nerf2_spectrum": ("spectrum", "official, validation 0.1, seed 0"),
    "nerf2_rssi": ("rssi", "official, validation 0.1 in runs of 100, seed 0"),
    "rssi_csv": ("rssi", "random, test 0.2, validation 0.1, seed 0"),
    "csi_npz": ("csi", "random, test 0.2, validation 0.1, seed 0"),
    "synthetic": ("spectrum", "official, validation 0.1, seed 0"),
    "synthetic_rssi": ("rssi", "official, validation 0.1, seed 0"),
    "synthetic_csi": ("csi", "official, validation 0.1, seed 0"),
    "sionna": ("spectrum", "official, validation 0.1, seed 0"),
    "sionna_rssi": ("rssi", "official, validation 0.1, seed 0"),
    "sionna_csi": ("csi", "official, validation 0.1, seed 0"),
}
"""Task, and name of the split, that each chooses."""


def test_every_data_set_has_a_configuration():
    assert {file.stem for file in (conf_dir() / "data").glob("*.yaml")} == CHOICES.keys()
    assert CHOICES.keys() <= {*registry("data").names()}


@pytest.mark.parametrize("name", CHOICES)
def test_a_configuration_has_every_option_with_its_default(name):
    config = OmegaConf.to_container(OmegaConf.load(conf_dir() / "data" / f"{name}.yaml").data)
    mandatory = {key for key, value in config.items() if value == "???"}
    parameters = inspect.signature(registry("data").get(config.pop("name"))).parameters
    assert config.keys() == parameters.keys()
    assert mandatory == {key for key, p in parameters.items() if p.default is p.empty}
    for key in parameters.keys() - mandatory:
        value, default = config[key], parameters[key].default
        default = [*default] if isinstance(default, tuple) else default
        # PyYAML reads 1e9 without a point as a string, so the numbers are compared by type too.
        assert (value, type(value)) == (default, type(default))


@pytest.fixture(scope="module")
def room():
    return registry("data").build({"name": "synthetic_rssi", "order": 0})


@pytest.mark.parametrize("name", CHOICES)
def test_a_configuration_chooses_task_and_split(configured, room, name):
    task, split = CHOICES[name]
    config = configured(f"data={name}")
    assert config.task.name == task
    assert registry("split").build(config.split, links=room).name == split


def test_a_split_on_the_command_line_is_taken_before_the_datas_own(configured):
    config = configured("data=nerf2_rssi", "split=blocks", "split.edge=0.5")
    assert config.split == {"name": "blocks", "edge": 0.5, "test": 0.2, "validation": 0.1, "seed": 0}


@pytest.mark.parametrize("name", [name for name in CHOICES if name.startswith("synthetic")])
def test_a_configured_simulation_is_of_its_task(configured, name):
    config = configured(f"data={name}", "data.transmitters=20", "data.order=1")
    links = load(config.data, config.split)
    assert links.task.name == config.task.name
    config = configured(f"data={name}", "+data.order_=3")
    with pytest.raises(ValueError, match=r"has no option 'order_' \(did you mean 'order'\?\)"):
        load(config.data, config.split)


def test_several_carriers_come_from_the_command_line(configured):
    config = configured("data=synthetic", "data.transmitters=3", "data.frequency=[5e9,6e9]")
    assert load(config.data, config.split).query.frequencies.tolist() == [5e9, 6e9] * 3
