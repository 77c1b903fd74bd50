"""The check of kind ``model``."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch

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

    ``build`` makes it for a scene; the links have a split. The contract is that of
    ``gaigs.model.Model``.
    """
    model = build(links.scene).to(device)
    model.fit(links)
    index = torch.cat((links.split.train, links.split.test))
    receivers = links.query.receivers[index]
    batch = links.batch(index[receivers == receivers[0]][:5]).to(model.device)
    query = batch.query.to("cpu")
    stand = links.receivers[query.receivers[0]].pose.position[None]
    places = torch.cat((query.transmitters, stand, stand + 1e3))
    frequencies = None if query.frequencies is None else query.frequencies[:1].expand(len(places))
    query = Query(places, query.receivers[:1].expand(len(places)), frequencies)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExtrapolationWarning)  # one place of the query is far away
        _check_predictions(model, links, query)
        _check_evaluation(model, batch, links.batch(index[:8]).to(model.device))
        _check_report(model, batch)
        checks.require_groups(model.parameter_groups(), model)
        if not model.state_dict():
            return
        if any(True for _ in model.parameters()):
            _check_training(model, batch)
        twin = build(Scene.from_state(links.scene.state())).to(device)
        twin.load_state_dict(model.state_dict())
        # Predicted again, because a training step may move running statistics, as of a batch
        # normalisation.
        values, twice = (predictor.train().predict(query) for predictor in (model, twin))
        require_same(values, twice, "a model's state dict must restore its predictions")


def _check_predictions(model: Model, links: Links, query: Query) -> None:
    """Predictions for a query, the same positions, grids of them and single directions."""
    task, places, receiver = links.task, query.transmitters, int(query.receivers[0])
    frequency = None if query.frequencies is None else float(query.frequencies[0])
    # A receiver for each place: where arrays have different numbers of elements, values are padded
    # as those of a query.
    heard = lambda places: torch.full(places.shape[:-1], receiver)
    predict = lambda places, **options: model.predict(places, heard(places), frequency, **options)
    values = model.train().predict(query)
    require(model.training, "predict must leave the model in the mode it was in")
    require_tensor("predictions", values, (len(places), *task.shape), task.dtype)
    require(not values.requires_grad, "predictions must not carry a gradient")
    require_same(values, model.predict(query), "two calls must give the same predictions")
    require_close(
        predict(places, batch_size=1), values, 1e-4, "the batch size must not change predictions"
    )
    require(
        tuple(predict(places[:0]).shape) == (0, *task.shape),
        "no transmitters must give no predictions",
    )
    grid = predict(places.expand(2, *places.shape))
    require_close(
        grid,
        values.expand(2, *values.shape),
        1e-4,
        "a grid of positions must give a grid of predictions",
    )
    if task.directions is not None:
        rays = task.directions.flatten()[3::7]
        rule = "predict must give the directions of its argument"
        require_close(predict(places, directions=rays), values.flatten(1)[:, 3::7], 1e-4, rule)
    if task.is_channel:
        own = task.frequencies
        require_same(
            predict(places, frequencies=own[-1:]),
            values[..., -1:],
            "own subcarriers must keep values",
        )
        # In another order, and so little beside their own that values hardly change.
        beside = predict(places, frequencies=own.flip(0) * (1 + 1e-8))
        require_close(
            beside, values.flip(-1), 2e-3, "predict must give the subcarriers of its argument"
        )
    checks.require_refusal(
        lambda: predict(places * torch.nan), "NaN as a position must be a ValueError"
    )
    unknown = lambda: model.predict(places, -1, frequency)
    checks.require_refusal(unknown, "an unknown receiver must be a ValueError")


def _check_evaluation(model: Model, batch: Batch, mixed: Batch) -> None:
    """``evaluate`` and ``forward`` give the same for any part of the links and directions."""
    model.eval()
    whole = model.evaluate(batch)
    require_tensor(
        "an evaluation", whole, batch.labels.shape, batch.labels.dtype, batch.labels.device
    )
    prediction = model(replace(batch, labels=None))
    require(
        isinstance(prediction, Prediction),
        f"a model must give a Prediction, got {type(prediction).__name__}",
    )
    require_close(
        prediction.value.detach(), whole, 1e-4, "evaluate must give the values of forward"
    )
    single = lambda i: replace(mixed, query=mixed.query[i : i + 1], labels=None)
    each = torch.cat([model.evaluate(single(i)) for i in range(len(mixed))])
    require_close(
        model.evaluate(mixed),
        each,
        1e-4,
        "links to several receivers must get the values of single links",
    )
    none = model.evaluate(Batch(batch.query[:0], batch.directions))
    require(
        tuple(none.shape) == (0, *whole.shape[1:]),
        f"no links must give no values, got {tuple(none.shape)}",
    )
    if isinstance(batch.directions, Grid):
        rows, columns = slice(1, None, 3), slice(2, None, 4)
        chosen = torch.tensor([5, 0, 17, 17], device=whole.device)
        parts: dict[str, tuple[Directions, torch.Tensor]] = {
            "fewer directions": (batch.directions.thin(rows, columns), whole[:, rows, columns]),
            "a list of rays": (batch.directions.flatten()[chosen], whole.flatten(1)[:, chosen]),
        }
        for case, (directions, expected) in parts.items():
            part = replace(batch, directions=directions, labels=None)
            for values in (model.evaluate(part), model(part).value.detach()):
                require_tensor(f"the value of {case}", values, expected.shape, whole.dtype)
                require_close(values, expected, 1e-4, f"{case} must get the values of the whole")
    usual = model.chunk
    require(
        usual is None or (isinstance(usual, int) and usual > 0),
        f"chunk must be a number or None, got {usual!r}",
    )
    if batch.directions is not None:
        model.chunk = 200
        require_close(model.evaluate(batch), whole, 1e-4, "chunk must not change values")
        model.chunk = usual


def _check_report(model: Model, batch: Batch) -> None:
    """Attributes and optional methods that a run reads."""
    facts = model.facts()
    require(
        isinstance(facts, dict),
        f"facts must be a dictionary, got {type(facts).__name__}",
    )
    try:
        json.dumps(facts)
    except TypeError as error:
        raise AssertionError(f"facts must be plain values by name, got {facts}") from error
    trainings = registry("training").names()
    require(
        model.trained_by in trainings,
        f"trained_by must be one of {trainings}, got {model.trained_by!r}",
    )
    require(isinstance(model.predicts_untrained, bool), "predicts_untrained must be true or false")
    primitives = model.primitives
    require(
        primitives is None or isinstance(primitives, Gaussians),
        "primitives must be Gaussians or None",
    )
    rendering = model.rendering(batch)
    if callable(rendering):
        rendering()


def _check_training(model: Model, batch: Batch) -> None:
    value, penalties = model.train()(batch)
    require_tensor("the value", value, batch.labels.shape, batch.labels.dtype, batch.labels.device)
    require(value.requires_grad, "the value must carry a gradient to the parameters")
    for name, penalty in penalties.items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32, batch.labels.device)
    checks.require_gradients([value, *penalties.values()], dict(model.named_parameters()))
