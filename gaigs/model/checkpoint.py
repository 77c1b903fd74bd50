"""Complete checkpoints: configuration, scene, split and weights, loaded without the data."""

import hashlib
import io
import itertools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from zipfile import ZipFile

import torch
from torch import Tensor, nn
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present

from gaigs.core.scene import Scene
from gaigs.io.files import atomic_write
from gaigs.processes import lacks_memory
from gaigs.registry import check_type, configuration_of, digests, name_of, only_recorded, registry

KEY = "gaigs"
"""Key of gaigs's entries in a Lightning checkpoint."""

VERSION = 3
"""Format that is written, and the only one that is read."""

SEAL = b"gaigs sha256 "
"""Precedes the digest of all bytes before, which ends the file. Both are the comment of the zip
archive that ``torch.save`` writes, so the file stays an archive."""


def seal(path: Path) -> None:
    """Appends the seal to a file of ``torch.save``, by which ``read`` detects any changed bit."""
    content = path.read_bytes()
    # The last two bytes of a zip archive are the length of its comment; the digest has 64 digits.
    sealed = content[:-2] + (len(SEAL) + 64).to_bytes(2, "little") + SEAL
    path.write_bytes(sealed + hashlib.sha256(sealed).hexdigest().encode())


def write(content: dict, path: Path) -> None:
    """Writes a sealed checkpoint; the old file stays if it cannot be written."""
    with atomic_write(path) as part:
        file = io.BytesIO()  # with a real file torch hides that the disk is full
        torch.save(content, file)
        part.write_bytes(file.getvalue())
        seal(part)


def read(path: str | Path) -> dict:
    """The content of a checkpoint: tensors and plain Python values; errors as in ``gaigs.load``."""
    check_type("path", path, str | Path)
    path = Path(path)
    if not os.path.isfile(path):  # False for a name that is too long
        raise FileNotFoundError(
            f"no checkpoint at {path}, and no run; "
            "a run writes best.ckpt and last.ckpt into its folder"
        )
    data = path.read_bytes()
    try:
        sealed, digest = data[:-64], data[-64:]  # hexadecimal digits
        if not sealed.endswith(SEAL) or hashlib.sha256(sealed).hexdigest().encode() != digest:
            raise ValueError("another digest")
        with ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > len(data):
                raise ValueError("compressed, which torch.save never does")
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        # A view can be far larger than the numbers behind it; the views of a model are not.
        if sum(tensor.nbytes for _, tensor in _tensors(content, "")) > 4 * len(data) + 2**26:
            raise ValueError("larger than the file")
    except Exception as error:
        # Any error of zip readers and unpicklers; torch's own message advises to run code.
        if lacks_memory(error):
            raise
        raise ValueError(
            f"{path} cannot be read: it is damaged, or another program wrote it\n"
            "copy the file again from where it was trained, or train again"
        ) from None
    entries = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise ValueError(f"{path} is no checkpoint of gaigs: it lacks the entry {KEY!r}")
    if (version := entries.get("version")) != VERSION:
        raise ValueError(
            f"{path} has checkpoint format {version!r}, not {VERSION}; use the gaigs that wrote it"
        )
    parents = {"state_dict": content, "model": entries, "scene": entries}
    lacking = [name for name, parent in parents.items() if not isinstance(parent.get(name), dict)]
    if lacking:
        raise ValueError(
            f"{path} is no complete checkpoint: it lacks {', '.join(lacking)}\ntrain again"
        )
    return content


def save(model: nn.Module, path: str | Path) -> None:
    """Writes a model with its configuration and scene; see ``gaigs.Model.save``."""
    state = model.state_dict()
    if not state:
        raise ValueError(
            f"model {name_of(model)!r} has no state: "
            "keep what it learns in buffers, or use model.LookUp"
        )
    entries = {"version": VERSION, "scene": model.scene.state(), **described(model)}
    entries["plugins"] = digests(entries["model"], entries["scene"]["task"])
    weights = {}
    for key, value in state.items():
        # The prefix "model." as in a checkpoint of a training.
        weights[f"model.{key}"] = value.cpu() if isinstance(value, Tensor) else value
    write({KEY: entries, "state_dict": weights}, Path(path))


def load(path: str | Path, trust: bool, recorded: Mapping[str, str]) -> nn.Module:
    """The model of a checkpoint in evaluation mode, on the CPU; errors as in ``gaigs.load``.

    ``recorded`` gives digests of plug-ins for a checkpoint of an earlier version, which has none.
    """
    content = read(path)
    weights, scene = content["state_dict"], content[KEY]["scene"]
    try:
        consume_prefix_in_state_dict_if_present(weights, "model.")
        _check_finite("scene", scene)
        with only_recorded(None if trust else {**recorded, **content[KEY].get("plugins", {})}):
            model = registry("model").build(content[KEY]["model"], scene=Scene.from_state(scene))
        # Buffers that a new model does not set, such as gains before a fit, may be NaN in the file.
        fresh = {**dict(model.named_parameters()), **dict(model.named_buffers())}
        unset = {name for name, value in fresh.items() if not value.isfinite().all()}
        model.load_state_dict(weights)
        # The model's own state: an older checkpoint may have other names.
        state = model.state_dict()
        _check_finite("weights", {name: state[name] for name in state if name not in unset})
        model.calibrate(content[KEY].get("calibration"))
        model.known_places = content[KEY].get("known_places")
    except Exception as error:  # any error of a constructor with damaged options
        if lacks_memory(error):
            raise
        cause = (
            str(error)
            if isinstance(error, ValueError | ImportError)
            else f"{type(error).__name__}: {error}"
        )
        is_short = cause.count("\n") < 2
        message = (
            f"cannot make the model of {path}: {cause if is_short else ' '.join(cause.split())}"
        )
        raise (ImportError if isinstance(error, ImportError) else ValueError)(message) from error
    return model.eval()


def trained_weights(content: dict) -> dict:
    """Weights of the trained model in a checkpoint, by their names in the training module.

    ``update`` may have stored them within a model that wraps the trained one.
    """
    weights = content["state_dict"]
    if "trained" not in content[KEY]:
        return weights
    prefix = f"model.{content[KEY]['trained']}."
    of_trained = {}
    for key, value in weights.items():
        if key.startswith(prefix):
            of_trained[f"model.{key.removeprefix(prefix)}"] = value
    return of_trained


def described(model: nn.Module) -> dict:
    """Entries that describe a model: configuration, calibration, keys of known places."""
    calibration = None if model.calibration is None else model.calibration.state()
    return {
        "model": configuration_of(model),
        "calibration": calibration,
        "known_places": model.known_places,
    }


def update(path: Path, model: nn.Module, trained: str | None = None) -> None:
    """Rewrites the entries of ``described`` in a checkpoint, and the weights of a wrapped model.

    Args:
        path: Checkpoint of a training.
        model: The trained model, or an ensemble or kriged model that contains it.
        trained: Prefix of the trained model in ``model.state_dict()``, such as ``"trend"``; the
            weights of the whole ``model`` are stored. None: the weights stay as they are.
    """
    content = read(path)
    content[KEY] |= described(model)
    if trained is not None:
        content[KEY]["trained"] = trained
        content["state_dict"] = {
            f"model.{key}": value.cpu() for key, value in model.state_dict().items()
        }
    write(content, path)


def _tensors(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """Yields all tensors in nested mappings and lists, each with its path of keys.

    Raises:
        ValueError: Nesting is too deep or endless.
    """
    pending = [(name, value, 0)]
    for count in itertools.count():
        if not pending:
            return
        name, value, depth = pending.pop()
        if depth > 50 or count > 1_000_000:  # a list in a file may contain itself
            raise ValueError(f"{name:.80} is nested too deeply")
        if isinstance(value, Tensor):
            yield name, value
        elif isinstance(value, dict | list | tuple):
            entries = value.items() if isinstance(value, dict) else enumerate(value)
            pending += [(f"{name} {key}", item, depth + 1) for key, item in entries]


def _check_finite(name: str, value: object) -> None:
    """Raises a ``ValueError`` unless all numbers in nested values are finite."""
    for place, tensor in _tensors(value, name):
        if not tensor.isfinite().all():
            raise ValueError(f"{place} is not finite")
