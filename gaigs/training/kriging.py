"""What a run does behind its training where ``kriging=true``: trainings without folds, the kriged model, its file."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import lightning
import torch
from torch import Tensor

from gaigs import checkpoint
from gaigs.data import Links
from gaigs.model import Model
from gaigs.model.kriging import Kriging, known, predicted, thinned
from gaigs.processes import is_first
from gaigs.registry import registry
from gaigs.split import folds

log = logging.getLogger(__name__)

BY_HEART = 0.5
"""A model that leaves less over at training links than this share of what it leaves over at validation links, in root
mean square, has learnt its places by heart."""


class Kriged(NamedTuple):
    """What ``krige`` gives.

    Attributes:
        model: The kriged model.
        blind: The same from residuals of training links alone, to be scored on the validation links.
        seconds: What it took, trainings without folds included.
    """

    model: Kriging
    blind: Kriging
    seconds: float


def check_kriging(config: dict, model: Model, links: Links) -> None:
    """Sees to it that what is kriged is a trained model.

    Raises:
        ValueError: It is not, or the links cannot be parted into so many folds.
    """
    count, name = config["kriging_folds"], config["model"]["name"]
    if count < 0 or count == 1:
        raise ValueError(f"kriging_folds must be at least 2 trainings, or 0 for none, got {count}")
    if count and not config["kriging"]:
        raise ValueError(f"kriging_folds={count} takes kriging=true; set it, or leave the folds out")
    if isinstance(model, Kriging):
        raise ValueError(f"model={name} is made from a trained model; choose that model, and set kriging=true")
    if config["kriging"] and not any(parameter.requires_grad for parameter in model.parameters()):
        raise ValueError(f"kriging=true takes a model that is trained, and {name} is not; leave kriging out")
    if count:
        folds(links, count, config["seed"])


def krige(model: Model, links: Links, config: dict, folder: Path, train: Callable) -> Kriged | None:
    """Kriges what a trained model leaves over; ``best.ckpt`` of the run then holds both.

    Args:
        model: The trained one.
        links: All of them.
        config: Of the run.
        folder: Of the run.
        train: Trains a model on links in a folder, and gives it back with the seconds that took.

    Returns:
        None in all but the first of several processes.
    """
    name, (index, values, seconds) = config["model"]["name"], _without_folds(links, config, folder, train)
    if not is_first():
        return None
    start, links = time.monotonic(), thinned(links)
    all_values = predicted(model, links, known(links))
    place = torch.full((len(links),), -1).index_copy(0, index, torch.arange(len(index)))[known(links)]
    all_values[place >= 0] = values[place[place >= 0]]

    processes = (base.get("trend") for base in config["task"]["baselines"] if base["name"] == "gaussian_process")
    fallback = next(processes, None)
    kriged = Kriging(model.scene, model, fallback).to(next(model.parameters()).device)
    left = kriged.choose(links, all_values)
    kriged.solve(links, all_values)
    blind = kriged.without_validation(links, all_values)
    kriged.weigh(links, all_values, blind)
    checkpoint.exchange_model(folder / "best.ckpt", kriged)
    seconds += time.monotonic() - start
    facts = kriged.facts()["kriging"]
    log.info(
        "kriging: weight %g, share %g of %s, length %.3g m, noise %.3g of the signal, %d components, in %.0f s",
        *(facts["weight"], facts["share"], name),
        *(facts["length_m"], facts["noise_to_signal"], facts["components"], seconds),
    )
    if left < BY_HEART and not len(index):
        log.info(
            "kriging: %s leaves %.2g times as much over at training links as at validation links: it has learnt them "
            "by heart; kriging_folds=5 would tell more",
            *(name, left),
        )
    return Kriged(kriged, blind, seconds)


def _without_folds(links: Links, config: dict, folder: Path, train: Callable) -> tuple[Tensor, Tensor, float]:
    """What models say of training links that they were not trained on, each in a folder ``fold_...`` of the run.

    Returns:
        The links and their values, none without folds and in all but the first process; seconds of training.
    """
    shape, dtype = links.task.shape, links.task.dtype
    index, values, total = [torch.zeros(0, dtype=torch.long)], [torch.zeros(0, *shape, dtype=dtype)], 0.0
    count = config["kriging_folds"]
    for number, split in enumerate(folds(links, count, config["seed"]) if count else ()):
        log.info("kriging: training without fold %d of %d", number + 1, count)
        lightning.seed_everything(config["seed"], verbose=False)
        part, own = replace(links, split=split), folder / f"fold_{number}"
        own.mkdir(exist_ok=True)
        model = registry("model").build(config["model"], scene=links.scene)
        model.fit(part)
        model, seconds = train(model, part, own)
        total += seconds
        if is_first():
            index.append(split.test)
            values.append(predicted(model, links, split.test))
    return torch.cat(index), torch.cat(values), total
