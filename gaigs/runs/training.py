"""Training of a model on links, by name or by choice."""

import contextlib
import copy
import tempfile
from collections.abc import Sequence
from pathlib import Path

import lightning
from lightning.pytorch.utilities.seed import isolate_rng

from gaigs.configuration import composed, preset
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.model import Model
from gaigs.model.ensemble import Ensemble
from gaigs.model.kriging import Kriging
from gaigs.processes import limited_threads, only_run
from gaigs.registry import configuration_of, registry
from gaigs.runs.choice import NAME, choose
from gaigs.runs.fitting import fit
from gaigs.runs.folder import claim
from gaigs.training.budget import watched


def train(
    model: str | Model | Links,
    links: Links | str | None = None,
    /,
    *overrides: str,
    folder: str | Path | None = None,
    progress: bool = True,
    **options,
) -> Model:
    """Trains a model on links as the command line does, with the preset of model and task.

    Args:
        model: Name of a registered model; or ``"auto"``, the default, which tries several models
            and returns the best by the validation links; or a model, which is trained in place,
            from one start. For a kriged model a copy of the trend is trained.
        links: Links to learn from; validation links choose the best step. Test links are not used.
        overrides: Command-line words, e.g. ``"variant=ga"`` or ``"trainer.max_steps=300"``.
        folder: Folder of the configuration, the log and the checkpoints. The same call resumes an
            interrupted training there. None: no files.
        progress: False hides progress bars, like ``enable_progress_bar=False``.
        options: Values by their keys or names, as in ``gaigs.compose``: ``max_steps=300, seed=0``.

    Returns:
        The model with the best validation score, on the CPU and in evaluation mode, as
        ``gaigs.load`` gives it; with ``mirrored`` a kriged model.

    Raises:
        TypeError: An option has the wrong type.
        ValueError: A name is unknown, an option is out of range, or model and links do not fit.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> options = {"max_steps": 1, "enable_progress_bar": False}
        >>> model = gaigs.train(links, candidates=["path_loss", "knn"], **options)
        >>> links = gaigs.links("synthetic", transmitters=40, order=0)
        >>> model = gaigs.train("gaigs", links, count=20, **options)
        >>> model.predict([[1.0, 2.0, 1.5], [2.5, 1.0, 0.8]]).shape
        torch.Size([2, 1, 90, 360])
    """
    if isinstance(model, Links):
        overrides = overrides if links is None else (links, *overrides)  # type: ignore[assignment]
        model, links = NAME, model
    if not isinstance(model, str | Model) or not isinstance(links, Links):
        raise TypeError(
            f"train takes a model and links, got {type(model).__name__} and {type(links).__name__}"
        )
    if not progress:
        options["enable_progress_bar"] = False
    made = _made(model)
    check_fit(links, None if made is None else made.scene)
    # Options that are components themselves, not their configurations.
    parts = {key: option for key, option in options.items() if hasattr(option, "configuration")}
    config = _configuration(model, made, links, overrides, options)
    with contextlib.ExitStack() as stack:
        stack.enter_context(limited_threads(config["threads"]))
        stack.enter_context(isolate_rng())
        if folder is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        stack.enter_context(only_run(place))
        claim(place, config)
        stack.enter_context(watched(config))
        if config["model"]["name"] == NAME:
            return choose(links, config, place).models[NAME].eval().cpu()
        lightning.seed_everything(config["seed"], verbose=False)
        loss = registry("loss").build(parts.pop("loss", config["loss"]), task=links.task)
        if parts:
            made = registry("model").build(config["model"] | parts, scene=links.scene)
        return fit(made, loss, links, config, place).models[config["model"]["name"]].eval().cpu()


def _made(model: str | Model) -> Model | None:
    """The model that is trained further; None for the name of a model, which is built later."""
    if isinstance(model, str):
        return None
    made = copy.deepcopy(model.trend) if isinstance(model, Kriging) else model
    if isinstance(made, Ensemble):
        members = "members" if made is model else "trend.members"
        raise ValueError(
            f"an ensemble cannot be trained further; train one of its models, {members}[0]"
        )
    return made


def _configuration(
    model: str | Model, made: Model | None, links: Links, overrides: Sequence[str], options: dict
) -> dict:
    """The configuration of a training on existing links.

    Args:
        model: First argument of ``train``.
        made: The model that is trained further; None: the training builds it.
    """
    name = model if made is None else configuration_of(made)["name"]
    if experiments := [word for word in overrides if word.startswith("+experiment=")]:
        raise ValueError(
            f"leave out {experiments[0]}: train takes the experiment of the model and the task"
        )
    words = preset(name, links.task.name)
    config = composed([*words, *overrides], options)
    if overrides or options:
        usual = composed(words, {})
        if config["data"] != usual["data"] or config["split"] != usual["split"]:
            raise ValueError("train takes no options of data and split; pass them to gaigs.links")
        made_here = {key for key, option in options.items() if hasattr(option, "configuration")}
        if made is not None and (config["model"] != usual["model"] or made_here - {"loss"}):
            raise ValueError(
                "train takes no options of a model that is made already; "
                "pass them to its constructor"
            )
    config |= {"data": {"name": "arrays"}, "split": {"name": links.split.name}, **links.origin}
    if made is not None:
        config["model"] = configuration_of(made)
    return config
