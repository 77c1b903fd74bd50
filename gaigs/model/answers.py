"""Predictions, deviations and calibrations of models on some of the links of a data set."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.calibration import Calibration
from gaigs.calibration.conformal import usual_deviations
from gaigs.calibration.held_out import Answers, calibrate
from gaigs.calibration.new_receivers import NewReceivers, fit_law
from gaigs.core import stages
from gaigs.core.query import Batch, evenly, thin_labels
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.kriging.blend import blend
from gaigs.kriging.links import PART, single_readings
from gaigs.model.base import Model
from gaigs.registry import name_of


def batch_size(links: Links, model: Model | None = None) -> int:
    """Number of links to predict at a time; without a ``model`` as for a trained one.

    Scalar labels have larger batches, since they take little memory. Look-ups have the largest,
    since each batch takes time for every receiver.
    """
    if not links.task.is_scalar:
        return 64
    return 4096 if model is None or model.is_trained else 2**16


def predicted(
    model: Model,
    links: Links,
    index: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> Tensor:
    """Predictions of a model for the links of ``index``, on the CPU.

    ``frequencies`` are other subcarriers than the labels' [Hz].
    """
    size = batch_size(links, model)
    values = model.predict_batches(links.query[index], batch_size=size, frequencies=frequencies)
    return torch.cat([part.cpu() for part in values])


def weighed_residuals(
    links: Links, fallback: Model, values: Tensor, weights: Sequence[float]
) -> dict[float, Tensor]:
    """Residuals (k, m) of the known links from means of two models, for each weight of the first.

    Residuals are thinned to m numbers by ``thin_labels``.

    Args:
        links: Links with a split.
        fallback: The second model, whose weight is 1 minus that of the first, the trend.
        values: The trend's predictions of the known links.
        weights: Weights of the trend.
    """
    index, task = links.split.known, links.task
    # Without an alignment each number stands alone, so labels may be thinned first, to save time.
    aligns = type(task).align is not Task.align
    parts: dict[float, list[Tensor]] = {weight: [] for weight in weights}
    for rows in torch.arange(len(index)).split(PART):
        labels, of_trend = links.labels[index[rows]], values[rows]
        of_fallback = predicted(fallback, links, index[rows])
        if not aligns:
            labels, of_trend = thin_labels(labels), thin_labels(of_trend)
            of_fallback = thin_labels(of_fallback)
        for weight, residuals in parts.items():
            mean = blend(task, of_trend, of_fallback, weight)
            residuals.append(thin_labels(task.align(labels, mean) - mean))
    return {weight: torch.cat(residuals) for weight, residuals in parts.items()}


def share_at_new(links: Links, held: Int[Tensor, " k"], one: Tensor, other: Model) -> float:
    """Weight w of one model's levels in a mean with another model's, for unknown receivers.

    The weight minimises the mean square error at n receivers that neither model knows. A weight of
    a half is the prior, with the weight of one receiver. With the mean squares a and b of the
    errors, the mean c of their products and m = (a + b) / 2, w minimises

        a w² + 2 c w (1 - w) + b (1 - w)² + 2 m (w - ½)² / n

    Args:
        links: Links with levels as labels.
        held: Links of receivers that neither model knows; each receiver counts equally.
        one: Predictions of these links [dBm].
        other: The other model.

    Source: Stock and Watson, Combination forecasts of output growth, 2004, for weights shrunk
    towards equal ones.
    """
    receivers = links.query.receivers[held]
    _, numbers, counts = receivers.unique(return_inverse=True, return_counts=True)
    votes = 1.0 / counts[numbers].double() / len(counts)  # (k,), equal sums for all receivers
    both = torch.stack((one, predicted(other, links, held))).double()  # (2, k)
    errors = both - links.labels[held]
    (a, c), (_, b) = ((votes * errors) @ errors.T).tolist()
    prior = (a + b) / 2 / len(counts)  # m / n
    curvature = a + b - 2 * c + 2 * prior  # half the second derivative over w
    if curvature <= 0:  # no errors: any weight is right
        return 0.5
    return min(1.0, max(0.0, (b - c + prior) / curvature))


def spreads(model: Model, links: Links, index: Int[Tensor, " k"], values: Tensor) -> Tensor:
    """Standard deviations of labels for the links of ``index``, by ``Model.spread``, on the CPU.

    ``values`` are the model's predictions of these links.
    """
    size = batch_size(links, model)
    queries = links.query[index].parts(size)
    deviations = []
    for query, value in zip(queries, values.split(size), strict=True):
        batch = Batch(query, links.task.directions).to(model.device)
        deviations.append(model.spread(batch, value.to(model.device)).cpu())
    return torch.cat(deviations)


def calibrated(model: Model, links: Links) -> Calibration | None:
    """The calibration of a model by the links of ``Model.unseen``.

    It is None without such links, or if the split holds out carriers.
    """
    if links.held_out is not None:
        return None

    def answer(fold: Model, index: Int[Tensor, " k"]) -> Answers:
        """Predictions and deviations of links that the model of a fold has not seen."""
        values = predicted(fold, links, index)
        # Other hyperparameters of a fold would scale all its deviations.
        fold.take_hyperparameters(model)
        deviations = spreads(fold, links, index, values)
        first_link = Batch(links.query[index[:1]], links.task.directions).to(fold.device)
        states_deviations = fold.deviations(first_link) is not None
        return Answers(values, deviations, states_deviations)

    with stages.timed("intervals"):
        unseen = model.unseen(links)
        calibration = calibrate(links, name_of(model), model.fold_count, unseen, answer)
        if calibration is None or not model.any_receiver or links.one_radio:
            return calibration
        known = links.query.receivers[links.split.known].bincount(minlength=len(links.receivers))
        elsewhere = at_new_receivers(model, links)
        widths = (known == 0).double()  # receivers without links have intervals of ``elsewhere``
        return replace(calibration, widths=widths, elsewhere=elsewhere)


def at_new_receivers(
    model: Model, links: Links, most: int = 1000, receivers: int = 40
) -> Calibration | None:
    """The calibration of a model at receivers without links; None with fewer than three receivers.

    Each receiver with links in turn is predicted as a new one, from the other receivers.

    Args:
        model: A model with ``any_receiver``.
        links: Links with the split of the model.
        most: Largest number of links that calibrate.
        receivers: Largest number of receivers that calibrate.
    """
    split: Any = links.split
    of_links = links.query.receivers
    has_links = of_links[split.train if model.is_trained else split.known].unique()
    # A trained model has learnt from a receiver that is predicted as new; a look-up leaves it out.
    taught = has_links if model.is_trained else has_links[:0]
    asked = split.known
    # A trained model has seen the training links, so only validation links show its errors.
    if model.is_trained and not split.by_receivers:
        asked = split.validation
    asked = single_readings(links, asked)
    chosen = evenly(of_links[asked].unique(), receivers)
    indices, values = [], []
    for receiver in chosen.tolist():
        others = has_links[has_links != receiver]
        if len(others) < 2:
            return None
        index = evenly(asked[of_links[asked] == receiver], most // len(chosen))
        moved = model.at_receivers([links.receivers[receiver]], others)
        # The moved model has this receiver alone, with the number 0.
        query = replace(links.query, receivers=torch.zeros_like(of_links))
        indices.append(index)
        values.append(predicted(moved, replace(links, query=query), index))
    if len(indices) < 3:
        return None
    index, answers = torch.cat(indices), torch.cat(values)
    query = links.query[index]
    # All new receivers share the quantiles, so they have one number.
    as_one = replace(query, receivers=torch.zeros_like(query.receivers))
    calibration = Calibration.of(
        links.task,
        links.labels[index],
        answers,
        usual_deviations(answers),
        as_one,
        None,
        as_one,
        new=NewReceivers(query.receivers, torch.isin(query.receivers, taught)),
    )
    if not links.task.is_scalar:
        return calibration
    errors = []
    places = []
    for index, value in zip(indices, values, strict=True):
        errors.append((links.labels[index] - value).double())
        places.append(links.query.transmitters[index])
    return replace(calibration, scatter=fit_law(errors, places))


def count_in_time(model: Model, links: Links, most: int) -> int:
    """The number of a receiver's known links, from 100 to ``most``, that can be kriged in time.

    The trained model predicts the links once, and once more for each half of the validation links.
    These three predictions may take a third of the run's time that is left.
    """
    if math.isinf(stages.left()):  # the run has no time limit
        return most
    sample = evenly(links.split.known, 64)
    predicted(model, links, sample[:1])  # the first prediction compiles and loads
    began = time.monotonic()
    predicted(model, links, sample)
    link_time = max(time.monotonic() - began, 1e-9) / len(sample)  # [s]
    count = stages.left() / 9 / link_time / links.scene.radios  # 3 predictions, a third of the time
    return int(min(most, max(100, count)))
