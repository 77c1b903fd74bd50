"""Checkpoints that are complete: configuration, scene, split and weights in one file, loaded without the data."""

from pathlib import Path

import torch
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present

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
    weights = content["state_dict"]
    consume_prefix_in_state_dict_if_present(weights, "model.")
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:  # one line a tensor
        defects = " ".join(str(error).split())
        raise ValueError(f"{path} must hold the weights of its configuration, and does not: {defects}") from error
    return model.eval()
