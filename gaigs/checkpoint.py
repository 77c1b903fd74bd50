"""Checkpoints that are complete: configuration, scene, split and weights in one file, loaded without the data."""

from pathlib import Path

import torch

from gaigs.data import Scene
from gaigs.model import Model
from gaigs.registry import registry

KEY = "gaigs"
"""Where our part stands in a Lightning checkpoint."""


def read(path: str | Path) -> dict:
    """A checkpoint's content; nothing but tensors and plain Python can come out of it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no checkpoint of gaigs, or not a whole one.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}; a run leaves best.ckpt and last.ckpt in its folder")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler or archive reader meets
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(f"{path} must be a checkpoint of gaigs, and is damaged or another file ({cause})") from error
    if not isinstance(content, dict) or KEY not in content:
        raise ValueError(f"{path} must be a checkpoint of gaigs, and lacks the entry {KEY!r}")
    return content


def load(path: str | Path) -> Model:
    """The model of a checkpoint, ready to predict; needs neither data nor Hydra.

    Args:
        path: A file ``best.ckpt`` or ``last.ckpt`` of a run.

    Returns:
        The model in evaluation mode, on the CPU: ``load(path).predict(transmitters)``.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no checkpoint of gaigs, its components are not installed here, or its weights are not theirs.
    """
    content = read(path)
    model = registry("model").build(content[KEY]["model"], scene=Scene.from_state(content[KEY]["scene"]))
    prefix = "model."
    weights = {key.removeprefix(prefix): value for key, value in content["state_dict"].items() if key.startswith(prefix)}
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:  # one line a tensor
        defects = " ".join(str(error).split())
        raise ValueError(f"{path} holds weights that do not fit its configuration in this version: {defects}") from error
    return model.eval()
