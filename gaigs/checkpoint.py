"""Checkpoints that are complete: configuration, scene, split and weights in one file, loaded without the data."""

import contextlib
import hashlib
import io
import os
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import torch
from torch import Tensor, nn
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from gaigs.io.files import atomic_write
from gaigs.processes import lacks_memory
from gaigs.registry import check_type, configuration_of, name_of, registry
from gaigs.scene import Scene

KEY = "gaigs"
"""Where our part stands in a Lightning checkpoint."""

VERSION = 2
"""Of our part. Version 1 had no seal. Version 0, which had no number, is read too: see ``_from_version_0``."""

SEAL = b"gaigs sha256 "
"""What stands before a file's last bytes: the digest of all that is before it. Both are the comment of the zip archive
that ``torch.save`` writes, so the file stays one."""

DIGEST = 2 * hashlib.sha256().digest_size
"""Bytes of the digest, in hexadecimal digits."""

ROOM, TIMES = 2**30, 16
"""What may be allocated to make a model: so many bytes, and so many times the size of its file."""

LEAST = 2**16
"""What a tensor counts at least towards that [bytes], so that a file cannot ask for layers without end either."""


def seal(path: Path) -> None:
    """Ends a file of ``torch.save`` in its seal, by which ``read`` finds any bit that changes later."""
    content = path.read_bytes()
    sealed = content[:-2] + (len(SEAL) + DIGEST).to_bytes(2, "little") + SEAL  # the length of the archive's comment
    path.write_bytes(sealed + hashlib.sha256(sealed).hexdigest().encode())


def write(content: dict, path: Path) -> None:
    """Writes a checkpoint, sealed, whole or not at all.

    Raises:
        OSError: It cannot be written, e.g. as the disk is full; what was there before stands.
    """
    with atomic_write(path) as part:
        file = io.BytesIO()  # given a real one, torch would hide that its disk is full
        torch.save(content, file)
        part.write_bytes(file.getvalue())
        seal(part)


def read(path: str | Path) -> dict:
    """A checkpoint's content; nothing but tensors and plain Python can come out of it.

    A file in which a single bit has changed is refused by its seal. Files of versions 0 and 1 have none: of them the
    check sums are looked at that torch writes, and does not look at.

    Raises:
        TypeError: The path is none.
        FileNotFoundError: There is no such file.
        ValueError: It is no checkpoint of gaigs, not a whole one, or of a later version.
    """
    if not isinstance(path, os.PathLike):
        check_type("the path of a checkpoint", path, Path)
    path = Path(path)
    if not os.path.isfile(path):  # Path.is_file raises where a name is too long
        raise FileNotFoundError(f"no checkpoint at {path}; a run leaves best.ckpt and last.ckpt in its folder")
    data = path.read_bytes()
    try:
        is_sealed = _is_sealed(data)
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # whatever archive readers and unpicklers meet; torch's own words advise to run its code
        if lacks_memory(error):  # which says nothing of the file
            raise
        raise ValueError(
            f"{path} must be a checkpoint of gaigs, and is damaged or another file; take another copy of it, or do the "
            "run anew"
        ) from None
    part = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(part, dict):
        raise ValueError(f"{path} must be a checkpoint of gaigs, and lacks the entry {KEY!r}")
    version = part.get("version", 0)
    if not isinstance(version, int) or version < 0:
        raise ValueError(f"{path} must be of a version from 0 to {VERSION}, got {version!r}; take another copy of it")
    if version > VERSION:
        raise ValueError(f"{path} must be of version {VERSION} or earlier, got {version}; update gaigs")
    if version > 1 and not is_sealed:
        raise ValueError(
            f"{path} must end in its seal, and has none: it is damaged, or another program has written it; take the "
            "file as the run left it, or write it by gaigs.checkpoint.write"
        )
    needed = {"state_dict": content, "model": part, "scene": part}
    lacking = [name for name, there in needed.items() if not isinstance(there.get(name), dict)]
    if lacking:
        raise ValueError(f"{path} must be a whole checkpoint of gaigs, and lacks {', '.join(lacking)}; do the run anew")
    for name, value in [*_tensors(content["state_dict"], "weights"), *_tensors(part["scene"], "scene")]:
        is_plain = value.layout == torch.strided and value.device.type == "cpu"
        if not is_plain or value.nbytes > value.untyped_storage().nbytes():
            raise ValueError(f"{path} must hold its tensors whole, and of {name} it holds less than its shape says")
    with _blaming(path):
        return content if version else _from_version_0(content)


def save(model: nn.Module, path: str | Path) -> None:
    """Writes a model with its configuration and scene; see ``gaigs.Model.save``."""
    state = model.state_dict()
    if not state:
        raise ValueError(
            f"model {name_of(model)!r} has no state that a file could hold: it looks its answers up in the links that "
            "it was fitted to; keep those, and fit it again"
        )
    part = {"version": VERSION, "model": configuration_of(model), "scene": model.scene.state()}
    write({KEY: part, "state_dict": {f"model.{key}": value.cpu() for key, value in state.items()}}, Path(path))


def load(path: str | Path) -> nn.Module:
    """The model of a checkpoint, ready to predict; needs neither data nor Hydra.

    Args:
        path: A file ``best.ckpt`` or ``last.ckpt`` of a run, or what ``Model.save`` wrote.

    Returns:
        The model in evaluation mode, on the CPU: ``load(path).predict(transmitters)``.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no checkpoint of gaigs, or damaged; its components are not installed here; its weights are not
            theirs, or not finite; or the model would be far larger than the file.
        ImportError: A component cannot be imported.

    Example:
        >>> gaigs.train("mean", gaigs.links("synthetic_rssi", transmitters=50)).save("room.ckpt")
        >>> model = gaigs.load("room.ckpt")
        >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]], receiver="west").shape  # [dBm]
        torch.Size([2])
    """
    content = read(path)
    weights, scene = content["state_dict"], content[KEY]["scene"]
    with _blaming(path), _Bounded(ROOM + TIMES * Path(path).stat().st_size):
        consume_prefix_in_state_dict_if_present(weights, "model.")
        _check_finite("scene", scene)
        model = registry("model").build(content[KEY]["model"], scene=Scene.from_state(scene))
        unset = {name for name, value in model.state_dict().items() if not value.isfinite().all()}
        try:
            model.load_state_dict(weights)
        except RuntimeError as error:  # one line a tensor
            raise ValueError(f"its weights are not those of its configuration: {error}") from error
        _check_finite("weights", {name: value for name, value in weights.items() if name not in unset})
    return model.eval()


def trained_weights(content: dict) -> dict:
    """The weights of the training module in a checkpoint, without what was kriged on top of it."""
    weights = content["state_dict"]
    if content[KEY]["model"]["name"] != "kriging":
        return weights
    trend = "model.trend."
    return {f"model.{key.removeprefix(trend)}": value for key, value in weights.items() if key.startswith(trend)}


def exchange_model(path: Path, model: nn.Module) -> None:
    """Puts another model into a checkpoint, whole or not at all.

    Args:
        path: The file, which is rewritten.
        model: In its place, of the same scene.
    """
    content = read(path)
    content[KEY] |= {"version": VERSION, "model": configuration_of(model)}
    content["state_dict"] = {f"model.{key}": value.cpu() for key, value in model.state_dict().items()}
    write(content, path)


def _from_version_0(content: dict) -> dict:
    """The splatting pipeline's parts had other names: mapping, the map's grid in the model, reference."""
    part = content[KEY]
    model = dict(part["model"])
    if "mapping" in model:
        model["deformation"] = {"name": "two_branch", **model.pop("mapping")}
        model["placement"] = {"name": "free"}
        model["trend"] = model.pop("reference")
        grid = model.pop("grid")
        if grid is not None:
            model["pooling"] = {**model["pooling"], "grid": grid}
    names = {"model.mapping.": "model.deformation.", "model.reference.": "model.trend."}
    weights = {}
    for key, value in content["state_dict"].items():
        for old, new in names.items():
            key = new + key.removeprefix(old) if key.startswith(old) else key
        weights[key] = value
    return content | {KEY: part | {"model": model}, "state_dict": weights}


def _is_sealed(data: bytes) -> bool:
    """Whether a file has a seal, which a version 2 must have.

    Raises:
        ValueError: It is damaged, or would unpack to more than it is.
        zipfile.BadZipFile: It is damaged, or no file of ``torch.save``.
    """
    sealed, digest = data[:-DIGEST], data[-DIGEST:]
    is_sealed = sealed.endswith(SEAL)
    if is_sealed and hashlib.sha256(sealed).hexdigest().encode() != digest:
        raise ValueError("another digest")
    with ZipFile(io.BytesIO(data)) as archive:
        parts = archive.infolist()
        if sum(part.file_size for part in parts) > len(data):
            raise ValueError("more than it is")
        for part in [] if is_sealed else parts:
            archive.read(part)  # which looks at its check sum
    return is_sealed


def _tensors(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """All tensors in nested mappings and lists, with their places."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, dict | list | tuple):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _tensors(item, f"{name} {key}")


def _check_finite(name: str, value: object) -> None:
    for place, tensor in _tensors(value, name):
        if not tensor.isfinite().all():
            raise ValueError(f"{place} must be finite, and is not; take another copy of the file, or do the run anew")


@contextlib.contextmanager
def _blaming(path: str | Path) -> Iterator[None]:
    """Turns whatever a file's content leads to into one sentence that names the file."""
    try:
        yield
    except Exception as error:  # whatever constructors make of what they were not written for
        if lacks_memory(error):
            raise
        cause = str(error) if isinstance(error, ValueError | ImportError) else f"{type(error).__name__}: {error}"
        told = f"{path} must hold a model that can be made here, and does not: {' '.join(cause.split())}"
        raise (ImportError if isinstance(error, ImportError) else ValueError)(told) from error


class _Bounded(TorchDispatchMode):
    """Refuses, before memory is taken, tensors beyond what the file of a model explains.

    Args:
        limit: Of all tensors that are made [bytes].
    """

    def __init__(self, limit: int):
        super().__init__()
        self.limit, self.made = limit, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.made += self._size(function, args, kwargs or {})
        if self.made > self.limit:
            raise ValueError(
                f"its configuration asks for more than {self.limit:.3g} bytes, which its weights do not fill"
            )
        return function(*args, **(kwargs or {}))

    @staticmethod
    def _size(function, args: tuple, kwargs: dict) -> int:
        """Bytes that an operation takes, from its shapes alone; 0 for a view and where shapes alone do not say it."""
        schema = function._schema
        if any(result.alias_info for result in schema.returns):
            return 0
        args, kwargs = tree_map_only(Tensor, lambda value: value.to("meta"), (args, kwargs))
        if any(argument.name == "device" for argument in schema.arguments):
            kwargs |= {"device": "meta"}
        try:
            made = function(*args, **kwargs)
        except Exception:  # values count
            return 0
        return sum(max(LEAST, value.nbytes) for value in tree_leaves(made) if isinstance(value, Tensor))
