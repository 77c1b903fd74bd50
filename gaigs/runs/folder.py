"""The run folder: its claim by one configuration, and checks before a run is resumed."""

import hashlib
import json
import logging
from pathlib import Path

import torch
import yaml
from omegaconf import OmegaConf
from torch import Tensor

from gaigs.data import Links
from gaigs.data.compatibility import are_alike
from gaigs.io.files import atomic_write, remove_parts, write_text
from gaigs.registry import digests
from gaigs.version import __version__

log = logging.getLogger(__name__)

ANOTHER = "choose another folder (hydra.run.dir)"


def claim(folder: Path, config: dict) -> None:
    """Writes the configuration into a run folder, or checks that the folder's run has the same.

    Raises a ``ValueError`` if the folder holds other files or a run with another configuration.
    """
    file = folder / "config.yaml"
    files = "config.yaml software.json best.ckpt log predictions.npz gaussians.ply radio_map.npz"
    names = [*files.split(), "figures", "last.ckpt", "metrics.json"]
    existing = [name for name in names if (folder / name).exists()]
    if existing and not is_configuration(file):
        raise ValueError(f"{folder} holds {', '.join(existing)} of something else\n{ANOTHER}")
    training_folders = (folder, folder / "second_start", *folder.glob("members/*"))
    for written in (folder / "figures", *training_folders):
        remove_parts(written)  # a killed run leaves temporary files
    # Without a checkpoint or scores there is nothing to resume: the run starts from scratch.
    if not (folder / "last.ckpt").is_file() and not (folder / "metrics.json").is_file():
        store(config, folder)
        return
    check_software(folder, config)
    try:
        earlier = OmegaConf.to_container(OmegaConf.load(file))
    except Exception as error:  # any error of YAML or OmegaConf
        raise ValueError(f"cannot parse {file}: {' '.join(str(error).split())}") from error
    from gaigs.configuration import differences  # with Hydra, which loading does without

    differing = []
    values = differences(earlier, config)
    for key, (was, value) in values.items():
        # The configuration of a model repeats the configurations of its parts.
        if not (key.startswith("model.") and key.removeprefix("model.") in values):
            differing.append(f"{key} was {was!r}, is {value!r}")
    if differing:
        listed = "; ".join(differing)
        raise ValueError(f"{folder} holds a run of another configuration: {listed}\n{ANOTHER}")


def store(config: dict, folder: Path) -> None:
    """Writes the configuration and the software of a run into its folder."""
    with atomic_write(folder / "config.yaml") as part:
        OmegaConf.save(OmegaConf.create(config), part)
    write_text(folder / "software.json", json.dumps(software(config), indent=2) + "\n")


def software(config: dict) -> dict[str, str]:
    """The version of gaigs, and the digests of the plug-ins that a configuration uses."""
    return {"gaigs": __version__} | digests(config)


def stored_software(folder: Path) -> dict[str, str]:
    """Versions and digests stored at the start of a run, as of ``software``; empty if unknown."""
    try:
        return json.loads((folder / "software.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def warn_of_changes(folder: Path, model: dict) -> None:
    """Warns if sources of a model's plug-ins have changed, so that stored numbers are invalid."""
    stored = stored_software(folder)
    changed = [key for key, digest in digests(model).items() if stored.get(key, digest) != digest]
    if changed:
        log.warning(
            "the source of %s has changed since %s was trained: predictions differ",
            ", ".join(changed),
            folder,
        )


def check_software(folder: Path, config: dict) -> None:
    """Raises a ``ValueError`` unless a run is resumed by its original software.

    Versions of gaigs may differ in the third number. Plug-ins must have the same source.
    """
    stored = stored_software(folder)
    current = software(config)
    stored_version = str(stored.get("gaigs", "0.1 or earlier"))
    version = current["gaigs"]
    if stored_version.split(".")[:2] != version.split(".")[:2]:
        raise ValueError(
            f"{folder} was begun by gaigs {stored_version}, and this is {version}\n{ANOTHER}"
        )
    plugins = (current.keys() | stored.keys()) - {"gaigs"}
    changed = sorted(key for key in plugins if current.get(key) != stored.get(key))
    if changed:
        raise ValueError(
            f"the source of {', '.join(changed)} has changed since {folder} was begun\n"
            f"restore it, or {ANOTHER}"
        )


def is_configuration(file: Path) -> bool:
    """True if a file is the configuration of a run."""
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(content, dict) and {"model", "data"} <= content.keys()


def check_same_links(stored: dict, current: dict, path: Path) -> None:
    """Raises a ``ValueError`` unless a resumed training has its original links and split.

    ``stored`` comes from the checkpoint ``path``, ``current`` from the resumed run.
    """
    parts = ("train", "validation", "test")
    has_split = all(torch.equal(stored["split"][part], current["split"][part]) for part in parts)
    has_scene = are_alike(stored.get("scene"), current.get("scene"))
    if not (has_split and has_scene and stored["links"] == current["links"]):
        raise ValueError(
            f"the data have changed since {path} was written: another split, or other "
            f"transmitters, receivers, frequencies or labels\n{ANOTHER}"
        )


def fingerprint(links: Links) -> str:
    """A digest of queries and receivers, and of labels in memory.

    Labels in files are left out, since they are slow to decode.
    """
    tensors = [links.query.transmitters, links.query.receivers]
    for receiver in links.receivers:
        tensors += [receiver.pose.position, receiver.pose.rotation, receiver.array.elements]
    if links.query.frequencies is not None:
        tensors.append(links.query.frequencies)
    if isinstance(links.labels, Tensor):
        tensors.append(links.labels)
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
