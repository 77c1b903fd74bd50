"""Configurations with this repository's plug-ins, and short runs, for the tests of systems."""

import contextlib
import functools
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import torch

import gaigs
from gaigs import runs
from gaigs.registry import registry
from gaigs.testing import example_links

ROOT = Path(__file__).parents[2]
DATA = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
"""The data set that brings a task."""

RUN = (
    "rasterizer=torch", "training.batch_size=7", "trainer.accelerator=cpu", "trainer.max_steps=4",
    "trainer.val_check_interval=2", "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}]",
)  # fmt: skip


@contextlib.contextmanager
def repository():
    """Runs in the root of the repository, where plug-ins are found by name."""
    path = sys.path[:]  # the registry appends to it
    with contextlib.chdir(ROOT):
        yield
    sys.path[:] = path


@functools.cache
def composed(*overrides):
    """The whole configuration, as the command line would have it."""
    with repository():
        return gaigs.compose(*overrides)


def build(kind, config, seed=0, **context):
    """A component of a plug-in."""
    torch.manual_seed(seed)
    with repository():
        return registry(kind).build(config, **context)


def links_of(task, carriers=()):
    """The example of a task, at several carriers in turn, if any."""
    links = example_links(task)
    if not carriers:
        return links
    frequencies = torch.tensor(carriers)[torch.arange(24) % len(carriers)]
    return replace(links, query=replace(links.query, frequencies=frequencies))


def run(folder, monkeypatch, *overrides):
    """A short training on the built-in room: its configuration, its metrics, and the model of its
    checkpoint.
    """
    monkeypatch.setattr(runs, "radio_map", Mock())
    few = (
        [] if any(word.startswith("data.root=") for word in overrides) else ["data.transmitters=30"]
    )
    config = composed(*overrides, *few, *RUN)
    with repository():
        return config, runs.run(config, folder), gaigs.load(folder / "best.ckpt")
