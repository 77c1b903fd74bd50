"""Predictions, deviations and calibrations of models on some of the links of a data set."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.calibration import Calibration
from gaigs.calibration.held_out import Answers, calibrate
from gaigs.core.query import Batch
from gaigs.core.stages import timed
from gaigs.data import Links
from gaigs.model.base import Model
from gaigs.registry import name_of


def batch_size(links: Links) -> int:
    """Links predicted at a time; of labels of one number more, which take little memory."""
    return 4096 if links.task.is_scalar else 64


def predicted(
    model: Model,
    links: Links,
    index: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> Tensor:
    """Predictions of a model for some links, on the CPU; of channels at other subcarriers, if they
    are given [Hz].
    """
    size = batch_size(links)
    values = model.predict_batches(links.query[index], batch_size=size, frequencies=frequencies)
    return torch.cat([part.cpu() for part in values])


def spreads(model: Model, links: Links, index: Int[Tensor, " k"], values: Tensor) -> Tensor:
    """Deviations of some links, ``Model.spread``, on the CPU; ``values`` are their predictions."""
    directions, device = links.task.directions, model.device
    size = batch_size(links)
    parts = []
    for query, part in zip(links.query[index].parts(size), values.split(size), strict=True):
        batch = Batch(query, directions).to(device)
        parts.append(model.spread(batch, part.to(device)).cpu())
    return torch.cat(parts)


def calibrated(model: Model, links: Links) -> Calibration | None:
    """The calibration of a model, by errors at links that it has not seen, see ``Model.unseen``;
    None without such links, or if the test is at other subcarriers.
    """
    if links.held_out is not None:
        return None

    def answer(one: Model, index: Int[Tensor, " k"]) -> Answers:
        values = predicted(one, links, index)
        # A fold's hyperparameters may state larger or smaller deviations everywhere.
        one.take_hyperparameters(model)
        deviations = spreads(one, links, index, values)
        batch = Batch(links.query[index[:1]], links.task.directions).to(one.device)
        return Answers(values, deviations, one.deviations(batch) is not None)

    with timed("intervals"):
        return calibrate(links, name_of(model), model.fold_count, model.unseen(links), answer)
