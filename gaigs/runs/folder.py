"""The run folder: who may use it, and what a training there goes on from."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import torch
import yaml
from omegaconf import OmegaConf
from torch import Tensor

from gaigs.configuration import differences
from gaigs.data import Links, are_alike
from gaigs.io.files import atomic_write, write_text
from gaigs.registry import digests
from gaigs.version import __version__

SOFTWARE = "software.json"
"""What computed a run: see ``software``."""

WRITTEN = ("config.yaml", SOFTWARE, "best.ckpt", "log", "predictions.npz", "gaussians.ply", "radio_map.npz", "figures")
"""What a run writes into its folder before there is anything to go on from."""


def claim(folder: Path, config: dict) -> None:
    """Writes the configuration into a run folder, unless a run has left something there to go on from.

    Raises:
        ValueError: It has, and it was a run of another configuration or of other software; or files of that name are
            not a run's.
    """
    file = folder / "config.yaml"
    there = [name for name in (*WRITTEN, "last.ckpt", "metrics.json") if (folder / name).exists()]
    if there and not is_configuration(file):
        raise ValueError(
            f"{folder} must be free or hold a run, and it holds {', '.join(there)} of something else; choose another "
            "folder (hydra.run.dir=DIR)"
        )
    if not (folder / "last.ckpt").is_file() and not (folder / "metrics.json").is_file():
        store(config, folder)
        return
    check_software(folder, config)
    try:
        there = OmegaConf.to_container(OmegaConf.load(file))
    except Exception as error:  # whatever a file meets that is YAML, but no configuration
        raise ValueError(
            f"{file} must be what a run wrote, and is damaged ({' '.join(str(error).split())}); take another copy of "
            "it, or choose another folder (hydra.run.dir=DIR)"
        ) from error
    differing = differences(there, config)
    if differing:
        told = [key for key in differing if not (key.startswith("model.") and key.removeprefix("model.") in differing)]
        listed = "; ".join("{} was {!r}, is {!r}".format(key, *differing[key]) for key in told)
        raise ValueError(
            f"{folder} must be free or hold a run of the same configuration, but {listed}; choose another folder "
            "(hydra.run.dir=DIR)"
        )


def store(config: dict, folder: Path) -> None:
    """Writes the configuration of a run into its folder, and what computes it."""
    with atomic_write(folder / "config.yaml") as part:
        OmegaConf.save(OmegaConf.create(config), part)
    write_text(folder / SOFTWARE, json.dumps(software(config), indent=2) + "\n")


def software(config: dict) -> dict[str, str]:
    """What computes a run beside its configuration: the version of gaigs, digests of the sources of plug-ins."""
    return {"gaigs": __version__} | digests({*_names(config)})


def _names(part: object) -> Iterator[str]:
    """Names of all components in a configuration."""
    if isinstance(part, dict):
        yield from (value for key, value in part.items() if key == "name")
    for entry in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from _names(entry)


def check_software(folder: Path, config: dict) -> None:
    """Sees to it that a run goes on with the software that it began with, so that its numbers are of one make.

    Raises:
        ValueError: It was begun by another version, or the source of a plug-in has changed; patch versions change no
            number.
    """
    try:
        there = json.loads((folder / SOFTWARE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        there = {}
    here = software(config)
    series = lambda version: ".".join(version.split(".")[:2])
    began = str(there.get("gaigs", "0.1 or earlier"))
    if series(began) != series(here["gaigs"]):
        raise ValueError(
            f"{folder} was begun by gaigs {began}, and this is {here['gaigs']}, whose runs are others; choose another "
            "folder (hydra.run.dir=DIR)"
        )
    changed = sorted(key for key in here.keys() | there.keys() if key != "gaigs" and here.get(key) != there.get(key))
    if changed:
        raise ValueError(
            f"{folder} must be of the same plug-ins, and the source of {', '.join(changed)} has changed since it was "
            "begun; choose another folder (hydra.run.dir=DIR)"
        )


def is_configuration(file: Path) -> bool:
    """Whether a file is the configuration of a run."""
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(content, dict) and {"model", "data"} <= content.keys()


def check_same_links(there: dict, here: dict, path: Path) -> None:
    """Sees to it that a training goes on with the links it began with, so that none of the test has been trained on.

    Raises:
        ValueError: The split or the links are others.
    """
    parts = ("train", "validation", "test")
    same = all(torch.equal(there["split"][part], here["split"][part]) for part in parts)
    same = same and are_alike(there.get("scene"), here.get("scene"))
    if not same or there["links"] != here["links"]:
        raise ValueError(
            f"{path} must be of these very data to go on, but they have another split, or other transmitters, "
            "receivers, frequencies or labels now; choose another folder (hydra.run.dir=DIR)"
        )


def fingerprint(links: Links) -> str:
    """A digest of queries and receivers, and of labels that are in memory; images would have to be decoded for it."""
    parts = [links.query.transmitters, links.query.receivers]
    for receiver in links.receivers:
        parts += [receiver.pose.position, receiver.pose.rotation, receiver.array.elements]
    if links.query.frequencies is not None:
        parts.append(links.query.frequencies)
    if isinstance(links.labels, Tensor):
        parts.append(links.labels)
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()
