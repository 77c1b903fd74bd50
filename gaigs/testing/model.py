"""The check of kind ``model``."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gaigs.core.geometry import Directions, ExtrapolationWarning, Grid
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.splatting.gaussians import Gaussians
from gaigs.testing import checks
from gaigs.testing.checks import require, require_close, require_same, require_tensor


def check_model(
    build: Callable[[Scene], Model], links: Links, device: torch.device | str = "cpu"
) -> None:
    """Checks a model: it fits, predicts, evaluates any directions, trains and can be stored.

    The contract is in ``gaigs.model.Model``.

    Args:
        build: Function that makes the model for a scene.
        links: Links with a split.
        device: Device of the model.
    """
    model = build(links.scene).to(device)
    model.fit(links)
    index = torch.cat((links.split.train, links.split.test))
    receivers = links.query.receivers[index]
    batch = links.batch(index[receivers == receivers[0]][:5]).to(model.device)
    query = _hard_query(links, batch.query.to("cpu"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExtrapolationWarning)  # one place of the query is far away
        _check_predictions(model, links, query)
        _check_arguments(model, links, query)
        _check_evaluation(model, batch, links.batch(index[:8]).to(model.device))
        _check_directions(model, batch)
        _check_report(model, batch)
        checks.require_groups(model.parameter_groups(), model)
        if not model.state_dict():
            return
        if [*model.parameters()]:
            _check_training(model, batch)
        twin = build(Scene.from_state(links.scene.state())).to(device)
        twin.load_state_dict(model.state_dict())
        # Predicted again: a training step may move running statistics, as of a batch normalisation.
        values = model.train().predict(query)
        restored = twin.train().predict(query)
        rule = "a model's state dict must restore its predictions; register_buffer what fit learns"
        require_same(values, restored, rule)


def _hard_query(links: Links, query: Query) -> Query:
    """A query with two more places: the receiver's, and one a kilometre away on each axis."""
    receiver = links.receivers[query.receivers[0]].pose.position[None]
    places = torch.cat((query.transmitters, receiver, receiver + 1e3))
    count = len(places)
    frequencies = None if query.frequencies is None else query.frequencies[:1].expand(count)
    return Query(places, query.receivers[:1].expand(count), frequencies)


def _predict(model: Model, query: Query, places: Tensor, **options: Any) -> Tensor:
    """Predictions for places, with the receiver and the carrier of a query."""
    # A receiver for each place: values of arrays of different sizes are then padded as a query's.
    receivers = torch.full(places.shape[:-1], int(query.receivers[0]))
    frequency = None if query.frequencies is None else float(query.frequencies[0])
    return model.predict(places, receivers, frequency, **options)


def _check_predictions(model: Model, links: Links, query: Query) -> None:
    """Checks predictions for a query; for its positions one by one and as a grid; for none."""
    task = links.task
    places = query.transmitters
    values = model.train().predict(query)
    require(model.training, "predict must leave the model in the mode it was in")
    require_tensor("predictions", values, (len(places), *task.shape), task.dtype)
    require(not values.requires_grad, "predictions must not carry a gradient")
    rule = "two calls must give the same predictions; draw random numbers in the constructor"
    require_same(values, model.predict(query), rule)
    singles = _predict(model, query, places, batch_size=1)
    rule = "the batch size must not change predictions; use no statistics of a batch"
    require_close(singles, values, 1e-4, rule)
    none = _predict(model, query, places[:0])
    rule = "no transmitters must give no predictions"
    checks.require_empty(none.shape, [(0, *task.shape)], rule)
    grid = _predict(model, query, places.expand(2, *places.shape))
    rule = "a grid of positions must give a grid of predictions"
    require_close(grid, values.expand(2, *values.shape), 1e-4, rule)


def _check_arguments(model: Model, links: Links, query: Query) -> None:
    """Checks directions and subcarriers as arguments, and errors of impossible ones."""
    task = links.task
    places = query.transmitters
    values = model.predict(query)
    if task.directions is not None:
        rays = task.directions.flatten()[3::7]
        chosen = _predict(model, query, places, directions=rays)
        rule = "predict must give the directions of its argument"
        require_close(chosen, values.flatten(1)[:, 3::7], 1e-4, rule)
    if task.is_channel:
        last = _predict(model, query, places, frequencies=task.frequencies[-1:])
        require_same(last, values[..., -1:], "own subcarriers must keep values")
        # In another order, and so near to their own that values hardly change.
        beside = task.frequencies.flip(0) * (1 + 1e-8)
        other = _predict(model, query, places, frequencies=beside)
        rule = "predict must give the subcarriers of its argument"
        require_close(other, values.flip(-1), 2e-3, rule)

    def predict_nowhere() -> Tensor:
        return _predict(model, query, places * torch.nan)

    def predict_for_a_stranger() -> Tensor:
        return _predict(model, replace(query, receivers=query.receivers * 0 - 1), places)

    checks.require_refusal(predict_nowhere, "NaN as a position must be a ValueError")
    checks.require_refusal(predict_for_a_stranger, "an unknown receiver must be a ValueError")


def _check_evaluation(model: Model, batch: Batch, mixed: Batch) -> None:
    """Checks that ``evaluate`` and ``forward`` agree, and that links do not affect each other.

    Links of ``batch`` are to one receiver, links of ``mixed`` to several.
    """
    model.eval()
    values = model.evaluate(batch)
    labels = batch.labels
    require_tensor("an evaluation", values, labels.shape, labels.dtype, labels.device)
    prediction = model(replace(batch, labels=None))
    is_prediction = isinstance(prediction, Prediction)
    require(is_prediction, f"a model must give a Prediction, got {type(prediction).__name__}")
    rule = "evaluate must give the values of forward"
    require_close(prediction.value.detach(), values, 1e-4, rule)
    singles = []
    for i in range(len(mixed)):
        single = replace(mixed, query=mixed.query[i : i + 1], labels=None)
        singles.append(model.evaluate(single))
    rule = "links to several receivers must get the values of single links; read query.receivers"
    require_close(model.evaluate(mixed), torch.cat(singles), 1e-4, rule)
    none = model.evaluate(Batch(batch.query[:0], batch.directions))
    checks.require_empty(none.shape, [(0, *values.shape[1:])], "no links must give no values")


def _check_directions(model: Model, batch: Batch) -> None:
    """Checks that values depend neither on other directions nor on the model's ``chunk``."""
    values = model.evaluate(batch)
    if isinstance(batch.directions, Grid):
        rows, columns = slice(1, None, 3), slice(2, None, 4)
        chosen = torch.tensor([5, 0, 17, 17], device=values.device)
        parts: dict[str, tuple[Directions, Tensor]] = {
            "fewer directions": (batch.directions.thin(rows, columns), values[:, rows, columns]),
            "a list of rays": (batch.directions.flatten()[chosen], values.flatten(1)[:, chosen]),
        }
        for case, (directions, expected) in parts.items():
            part = replace(batch, directions=directions, labels=None)
            for value in (model.evaluate(part), model(part).value.detach()):
                require_tensor(f"the value of {case}", value, expected.shape, values.dtype)
                require_close(value, expected, 1e-4, f"{case} must get the values of the whole")
    chunk = model.chunk
    is_number = chunk is None or (isinstance(chunk, int) and chunk > 0)
    require(is_number, f"chunk must be a number or None, got {chunk!r}")
    if batch.directions is not None:
        model.chunk = 200
        require_close(model.evaluate(batch), values, 1e-4, "chunk must not change values")
        model.chunk = chunk


def _check_report(model: Model, batch: Batch) -> None:
    """Checks attributes and optional methods that runs use."""
    facts = model.facts()
    is_table = isinstance(facts, dict)
    require(is_table, f"facts must be a dictionary, got {type(facts).__name__}")
    try:
        json.dumps(facts)
    except TypeError as error:
        raise AssertionError(f"facts must be plain values by name, got {facts}") from error
    trainings = registry("training").names()
    is_trained = model.trained_by in trainings
    require(is_trained, f"trained_by must be one of {trainings}, got {model.trained_by!r}")
    require(isinstance(model.predicts_untrained, bool), "predicts_untrained must be true or false")
    primitives = model.primitives
    is_scene = primitives is None or isinstance(primitives, Gaussians)
    require(is_scene, "primitives must be Gaussians or None")
    rendering = model.rendering(batch)
    if callable(rendering):
        rendering()


def _check_training(model: Model, batch: Batch) -> None:
    """Checks values, penalties and gradients of a training step."""
    value, penalties = model.train()(batch)
    labels = batch.labels
    require_tensor("the value", value, labels.shape, labels.dtype, labels.device)
    rule = "the value must carry a gradient to the parameters; detach nothing of them"
    require(value.requires_grad, rule)
    for name, penalty in penalties.items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32, labels.device)
    checks.require_gradients([value, *penalties.values()], dict(model.named_parameters()))
