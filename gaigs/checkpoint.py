"""Checkpoints that are complete: configuration, scene, split and weights in one file, loaded without the data."""

from pathlib import Path

import torch
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present

from gaigs.model import Model
from gaigs.registry import registry
from gaigs.scene import Scene

KEY = "gaigs"
"""Where our part stands in a Lightning checkpoint."""

VERSION = 1
"""Of our part. Version 0, which had no number, is read too: see ``_from_version_0``."""


def read(path: str | Path) -> dict:
    """A checkpoint's content; nothing but tensors and plain Python can come out of it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no checkpoint of gaigs, not a whole one, or of a later version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}; a run leaves best.ckpt and last.ckpt in its folder")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler or archive reader meets
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(f"{path} must be a checkpoint of gaigs, and is damaged or another file ({cause})") from error
    if not isinstance(content, dict) or not isinstance(content.get(KEY), dict):
        raise ValueError(f"{path} must be a checkpoint of gaigs, and lacks the entry {KEY!r}")
    version = content[KEY].get("version", 0)
    if version > VERSION:
        raise ValueError(f"{path} must be of version {VERSION} or earlier, got {version}; update gaigs")
    return content if version else _from_version_0(content)


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


def trained_weights(content: dict) -> dict:
    """The weights of the training module in a checkpoint, without what was kriged on top of it."""
    weights = content["state_dict"]
    if content[KEY]["model"]["name"] != "kriging":
        return weights
    trend = "model.trend."
    return {f"model.{key.removeprefix(trend)}": value for key, value in weights.items() if key.startswith(trend)}


def exchange_model(path: Path, config: dict, model: Model) -> None:
    """Puts another model into a checkpoint, whole or not at all.

    Args:
        path: The file, which is rewritten.
        config: Of the model.
        model: In its place, of the same scene.
    """
    content = read(path)
    content[KEY] |= {"model": config}
    content["state_dict"] = {f"model.{key}": value.cpu() for key, value in model.state_dict().items()}
    part = path.with_suffix(".part")
    torch.save(content, part)
    part.replace(path)


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
