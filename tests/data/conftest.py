"""Data sets that tests of several files read, written by hand, and the configuration as a run
composes it.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from PIL import Image

from gaigs.configuration import conf_dir

RSSI = """\
west,east,attic
-50.5,-61,-100
-52,-100,-80
-54,-65,-100
-100,-100,-100
-58.25,-69,-88
-60,-71,-90
"""
"""Twelve readings that were heard, and six that were not."""


@pytest.fixture
def rssi_folder(tmp_path):
    """Six rows at three gateways, which stand in another order than the columns."""
    root = tmp_path / "flat"
    root.mkdir()
    (root / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k}.5,{-k},0.25\n" for k in range(6)))
    (root / "gateway_rssi.csv").write_text(RSSI)
    (root / "gateway_position.yml").write_text(
        "east: [5.0, 1, 2]\nwest:\n- 0.5\n- 1\n- 2\nattic: [3, 1, 4.5]\n"
    )
    (root / "train_index.txt").write_text("4\n0\n1\n")
    (root / "test_index.txt").write_text("5\n2\n")
    return root


@pytest.fixture(scope="session")
def spectra(tmp_path_factory):
    """A data set of six spectra, whose pixels are drawn with the number of the image as a seed."""
    root = tmp_path_factory.mktemp("spectra") / "room"
    (root / "spectrum").mkdir(parents=True)
    for k in range(1, 7):
        pixels = np.random.default_rng(k).integers(0, 256, (90, 360), dtype=np.uint8)
        Image.fromarray(pixels).save(root / "spectrum" / f"{k:05d}.png", compress_level=1)
    (root / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k}.5,{-k},0.25\n" for k in range(1, 7)))
    (root / "gateway_info.yml").write_text(
        "dataset_name: room\ngateway1:\n"
        "  position: [5.0, 0.26, 0]\n  orientation: [0.5, -0.5, -0.5, 0.5]  # quaternion\n"
    )
    (root / "train_index.txt").write_text("00005\n00001\n00002\n00003\n")
    (root / "test_index.txt").write_text("00006\n00004\n")
    return root


@pytest.fixture
def spectrum_folder(spectra, tmp_path):
    """A copy of these spectra, to be changed."""
    return Path(shutil.copytree(spectra, tmp_path / "room"))


@pytest.fixture(scope="session")
def measured():
    """Finds a measured data set by name, or skips the test."""

    def find(name):
        root = (
            Path(os.environ.get("GAIGS_DATA", Path(__file__).parents[3] / "shared" / "data")) / name
        )
        if not root.is_dir():
            pytest.skip(
                f"needs the measured data set {name}; set GAIGS_DATA to the folder that holds it"
            )
        return root

    return find


@pytest.fixture(scope="session")
def configured():
    """Composes the configuration of a run from its command line."""

    def run(*overrides):
        with initialize_config_dir(str(conf_dir()), version_base=None):
            return compose("config", [*overrides])

    return run


@pytest.fixture
def checked_when_described(monkeypatch):
    """Data are checked where they are described, and not where they are loaded, too."""
    monkeypatch.setattr("gaigs.data.check", lambda links: ())
