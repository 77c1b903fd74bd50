"""The check of kind ``model``."""

import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gaigs.data import Links
from gaigs.directions import Directions, Grid
from gaigs.gaussians import Gaussians
from gaigs.geometry import ExtrapolationWarning
from gaigs.model import Model, Prediction
from gaigs.query import Batch, Query
from gaigs.registry import registry
from gaigs.scene import Scene
from gaigs.testing.checks import require, require_close, require_gradients, require_raises, require_tensor


def check_model(build: Callable[[Scene], Model], links: Links, device: torch.device | str = "cpu") -> None:
    """A model: it fits, predicts, evaluates any directions, trains and can be stored.

    Args:
        build: Makes the model for a scene.
        links: What it is fitted to; with a split.
        device: Where it works.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.model.Model``.
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
        parameters = dict(model.named_parameters())
        grouped = [id(parameter) for group in model.parameter_groups().values() for parameter in group]
        require(
            sorted(grouped) == sorted(map(id, parameters.values())),
            "each parameter must stand in one of parameter_groups",
        )
        if not model.state_dict():
            return
        if parameters:
            _check_training(model, batch, parameters)
        twin = build(Scene.from_state(links.scene.state())).to(device)
        twin.load_state_dict(model.state_dict())
        # Predicted anew: a step may have moved running statistics, as those of a batch normalisation.
        values, twice = (predictor.train().predict(query) for predictor in (model, twin))
        require(torch.equal(values, twice), "all that predict needs must be in the state dict")


def _ask(links: Links, batch: Batch) -> Query:
    """Places of a batch, the receiver's own, and one far away; on the CPU, as a user asks."""
    query = batch.query.to("cpu")
    receiver = links.receivers[query.receivers[0]].pose.position
    places = torch.cat((query.transmitters, receiver[None], receiver[None] + 1e3))
    frequencies = None if query.frequencies is None else query.frequencies[:1].expand(len(places))
    return Query(places, query.receivers[:1].expand(len(places)), frequencies)


def _check_predictions(model: Model, links: Links, query: Query) -> None:
    """What ``predict`` gives for a query."""
    task, asked, receiver = links.task, query.transmitters, int(query.receivers[0])
    frequency = None if query.frequencies is None else float(query.frequencies[0])
    predict = lambda places, who=receiver, **options: model.predict(places, who, frequency, **options)
    values = model.train().predict(query)
    require(model.training, "predict must leave the model in the mode it was in")
    require_tensor("predictions", values, (len(asked), *task.shape), task.dtype)
    require(not values.requires_grad, "predictions must not carry a gradient")
    require(torch.equal(values, model.predict(query)), "two calls must give the same predictions")
    require_close(predict(asked), values, 1e-4, "positions and a receiver must be predicted as the query of both")
    name = links.receivers[receiver].name
    require_close(predict(asked, name), values, 1e-4, "a receiver's name must be as good as its number")
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
    for what, places in {"two coordinates": asked[:, :2], "NaN": asked * torch.nan}.items():
        call = lambda places=places: model.predict(places, 0, frequency)
        require_raises(ValueError, call, f"transmitters with {what} must be a ValueError")
    for who in (-1, len(links.receivers), "nobody of that name"):
        call = lambda who=who: model.predict(asked, who, frequency)
        require_raises(ValueError, call, f"receiver {who!r} must be a ValueError")
    for wrong in (0.0, -1e9, torch.nan):
        call = lambda wrong=wrong: model.predict(asked, 0, wrong)
        require_raises(ValueError, call, f"a frequency of {wrong} Hz must be a ValueError")


def _check_evaluation(model: Model, batch: Batch, mixed: Batch) -> None:
    """``evaluate`` and ``forward`` give the same, whatever is asked for at a time."""
    model.eval()
    whole = model.evaluate(batch)
    require_tensor("an evaluation", whole, batch.labels.shape, batch.labels.dtype, batch.labels.device)
    prediction = model(replace(batch, labels=None))
    require(isinstance(prediction, Prediction), f"a model must give a Prediction, got {type(prediction).__name__}")
    require_close(prediction.value.detach(), whole, 1e-4, "evaluate must give what the model gives")
    each = torch.cat([model.evaluate(_only(mixed, i)) for i in range(len(mixed))])
    together = model.evaluate(mixed)
    require_close(together, each, 1e-4, "links to several receivers must come out as each by itself")
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
            require_close(part, expected, 1e-4, f"{what} must get the same values")
            bare = model(replace(batch, directions=directions, labels=None)).value.detach()
            require_close(bare, expected, 1e-4, f"{what} must get the same values")
    usual = model.chunk
    require(usual is None or (isinstance(usual, int) and usual > 0), f"chunk must be a number or None, got {usual!r}")
    if batch.directions is not None:
        model.chunk = 200
        parts = model.evaluate(batch)
        model.chunk = usual
        require_close(parts, whole, 1e-4, "how much is evaluated at a time must not change values")


def _check_report(model: Model, batch: Batch) -> None:
    """What a run says of the model."""
    facts = model.facts()
    require(isinstance(facts, dict), f"facts must be a dictionary, got {type(facts).__name__}")
    require(_is_plain(facts), f"facts must be plain values by name, got {facts}")
    trainings = registry("training").names()
    require(model.trained_by in trainings, f"trained_by must be one of {trainings}, got {model.trained_by!r}")
    require(isinstance(model.predicts_untrained, bool), "predicts_untrained must be true or false")
    primitives = model.primitives
    require(primitives is None or isinstance(primitives, Gaussians), "primitives must be Gaussians or None")
    rendering = model.rendering(batch)
    if rendering is not None:
        rendering()


def _is_plain(value: object) -> bool:
    """Whether a value is what a JSON file holds."""
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


def _only(batch: Batch, i: int) -> Batch:
    """One link by itself."""
    return replace(batch, query=batch.query[i : i + 1], labels=None)
