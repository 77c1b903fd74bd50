"""The check of kind ``model``."""

import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gaigs.data import Links
from gaigs.gaussians import Gaussians
from gaigs.geometry import Directions, ExtrapolationWarning, Grid
from gaigs.model import Model, Prediction, call_optional
from gaigs.query import Batch, Query
from gaigs.registry import registry
from gaigs.scene import Scene
from gaigs.testing.checks import (
    require,
    require_close,
    require_gradients,
    require_groups,
    require_raises,
    require_tensor,
)


def check_model(build: Callable[[Scene], Model], links: Links, device: torch.device | str = "cpu") -> None:
    """Checks a model: it fits, predicts, evaluates any directions, trains and can be stored.

    Args:
        build: Makes the model for a scene.
        links: Links for ``fit``, with a split.
        device: Device of the computation.

    Raises:
        AssertionError: The contract of ``gaigs.model.Model`` is broken.
    """
    model = build(links.scene).to(device)
    model.fit(links)
    index = torch.cat((links.split.train, links.split.test))
    receivers = links.query.receivers[index]
    batch = links.batch(index[receivers == receivers[0]][:5]).to(device)
    mixed = links.batch(index[:8]).to(device)
    query = _ask(links, batch)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExtrapolationWarning)  # one place asked for is far away
        _check_predictions(model, links, query)
        _check_refusals(model, links, query)
        _check_evaluation(model, batch, mixed)
        _check_report(model, batch)
        require_groups(model.parameter_groups(), model)
        if not model.state_dict():
            return
        if parameters := dict(model.named_parameters()):
            _check_training(model, batch, parameters)
        twin = build(Scene.from_state(links.scene.state())).to(device)
        twin.load_state_dict(model.state_dict())
        # Predicted again, because a training step may move running statistics, as of a batch normalisation.
        values, twice = (predictor.train().predict(query) for predictor in (model, twin))
        require(torch.equal(values, twice), "all that predict needs must be in the state dict")


def _ask(links: Links, batch: Batch) -> Query:
    """A query on the CPU for the places of a batch, the receiver's place and a far one."""
    query = batch.query.to("cpu")
    receiver = links.receivers[query.receivers[0]].pose.position
    places = torch.cat((query.transmitters, receiver[None], receiver[None] + 1e3))
    frequencies = None if query.frequencies is None else query.frequencies[:1].expand(len(places))
    return Query(places, query.receivers[:1].expand(len(places)), frequencies)


def _check_predictions(model: Model, links: Links, query: Query) -> None:
    """Predictions for a query, the same positions, grids of them and single directions."""
    task, asked, receiver = links.task, query.transmitters, int(query.receivers[0])
    frequency = None if query.frequencies is None else float(query.frequencies[0])
    predict = lambda places, who=receiver, **options: model.predict(places, who, frequency, **options)
    values = model.train().predict(query)
    require(model.training, "predict must leave the model in the mode it was in")
    require_tensor("predictions", values, (len(asked), *task.shape), task.dtype)
    require(not values.requires_grad, "predictions must not carry a gradient")
    require(torch.equal(values, model.predict(query)), "two calls must give the same predictions")
    require_close(predict(asked), values, 1e-4, "positions with a receiver must give the predictions of their query")
    name = links.receivers[receiver].name
    require_close(predict(asked, name), values, 1e-4, "a receiver's name must give the predictions of its index")
    require_close(predict(asked, batch_size=1), values, 1e-4, "the batch size must not change predictions")
    require(tuple(predict(asked[:0]).shape) == (0, *task.shape), "no transmitters must give no predictions")
    grid = predict(asked.expand(2, *asked.shape))
    require_close(grid, values.expand(2, *values.shape), 1e-4, "a grid of positions must give a grid of predictions")
    if task.directions is not None:
        rays = task.directions.flatten()[3::7]
        rule = "predict must give the directions asked for"
        require_close(predict(asked, directions=rays), values.flatten(1)[:, 3::7], 1e-4, rule)


def _check_refusals(model: Model, links: Links, query: Query) -> None:
    asked = query.transmitters
    frequency = None if query.frequencies is None else float(query.frequencies[0])
    wrong = {
        "transmitters with two coordinates": (asked[:, :2], 0, frequency),
        "transmitters with NaN": (asked * torch.nan, 0, frequency),
        **{f"receiver {who!r}": (asked, who, frequency) for who in (-1, len(links.receivers), "an unknown name")},
        **{f"a frequency of {carrier} Hz": (asked, 0, carrier) for carrier in (0.0, -1e9, torch.nan)},
    }
    for what, arguments in wrong.items():
        call = lambda arguments=arguments: model.predict(*arguments)
        require_raises(ValueError, call, f"{what} must be a ValueError")


def _check_evaluation(model: Model, batch: Batch, mixed: Batch) -> None:
    """``evaluate`` and ``forward`` give the same for any part of the links and directions."""
    model.eval()
    whole = model.evaluate(batch)
    require_tensor("an evaluation", whole, batch.labels.shape, batch.labels.dtype, batch.labels.device)
    prediction = model(replace(batch, labels=None))
    require(isinstance(prediction, Prediction), f"a model must give a Prediction, got {type(prediction).__name__}")
    require_close(prediction.value.detach(), whole, 1e-4, "evaluate must give the values of forward")
    single = lambda i: replace(mixed, query=mixed.query[i : i + 1], labels=None)
    each = torch.cat([model.evaluate(single(i)) for i in range(len(mixed))])
    together = model.evaluate(mixed)
    require_close(together, each, 1e-4, "links to several receivers must get the values of single links")
    order = torch.arange(len(mixed), device=together.device).flip(0)
    turned = model.evaluate(replace(mixed, query=mixed.query[order], labels=None))
    require_close(turned, together[order], 1e-4, "the order of links must not matter")
    none = model.evaluate(Batch(batch.query[:0], batch.directions))
    require(tuple(none.shape) == (0, *whole.shape[1:]), f"no links must give no values, got {tuple(none.shape)}")
    if isinstance(batch.directions, Grid):
        rows, columns = slice(1, None, 3), slice(2, None, 4)
        chosen = torch.tensor([5, 0, 17, 17], device=whole.device)
        asked: dict[str, tuple[Directions, Tensor]] = {
            "fewer directions": (batch.directions.thin(rows, columns), whole[:, rows, columns]),
            "a list of rays": (batch.directions.flatten()[chosen], whole.flatten(1)[:, chosen]),
        }
        for what, (directions, expected) in asked.items():
            part = model.evaluate(replace(batch, directions=directions, labels=None))
            require_tensor(f"what is evaluated in {what}", part, expected.shape, whole.dtype)
            require_close(part, expected, 1e-4, f"{what} must get the values of the whole")
            bare = model(replace(batch, directions=directions, labels=None)).value.detach()
            require_close(bare, expected, 1e-4, f"{what} must get the values of the whole")
    usual = model.chunk
    require(usual is None or (isinstance(usual, int) and usual > 0), f"chunk must be a number or None, got {usual!r}")
    if batch.directions is not None:
        model.chunk = 200
        parts = model.evaluate(batch)
        model.chunk = usual
        require_close(parts, whole, 1e-4, "chunk must not change values")


def _check_report(model: Model, batch: Batch) -> None:
    """Attributes and optional methods that a run reads."""
    facts = call_optional(model, "facts")
    require(facts is None or isinstance(facts, dict), f"facts must be a dictionary, got {type(facts).__name__}")
    require(_is_plain(facts), f"facts must be plain values by name, got {facts}")
    trainings = registry("training").names()
    require(model.trained_by in trainings, f"trained_by must be one of {trainings}, got {model.trained_by!r}")
    require(isinstance(model.predicts_untrained, bool), "predicts_untrained must be true or false")
    primitives = model.primitives
    require(primitives is None or isinstance(primitives, Gaussians), "primitives must be Gaussians or None")
    rendering = call_optional(model, "rendering", batch)
    if rendering is not None:
        rendering()


def _is_plain(value: object) -> bool:
    """True if a JSON file can hold the value."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(part) for key, part in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float)


def _check_training(model: Model, batch: Batch, parameters: dict[str, Tensor]) -> None:
    prediction = model.train()(batch)
    require_tensor("the value", prediction.value, batch.labels.shape, batch.labels.dtype, batch.labels.device)
    require(prediction.value.requires_grad, "the value must carry a gradient to what is trained")
    for name, penalty in prediction.penalties.items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32, batch.labels.device)
    require_gradients([prediction.value, *prediction.penalties.values()], parameters)
