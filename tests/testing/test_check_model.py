"""The check of models finds what is broken."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from gaigs.model import Model, Prediction
from gaigs.query import Query
from gaigs.testing import check_model, example_links


class Grey(Model):
    """The same grey in all directions, learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        self.grey = nn.Parameter(torch.full((), 0.5))

    def forward(self, batch):
        return Prediction(self.grey * self.grey.new_ones(len(batch), *batch.directions.shape), {})


class Stuck(Grey):
    def parameter_groups(self):
        return {"network": []}


class Fixed(Grey):
    def forward(self, batch):
        return Prediction(self.grey.new_ones(len(batch), *self.scene.task.shape) * self.grey, {})


class Forgetful(Grey):
    level = 1.0

    def fit(self, links):
        self.level = links.labels.mean()

    def forward(self, batch):
        return Prediction(super().forward(batch).value * self.level, {})


class Crowded(Grey):
    def forward(self, batch):
        return Prediction(super().forward(batch).value * len(batch), {})


class Silent(Grey):
    def forward(self, batch):
        return Prediction((super().forward(batch).value * 0).sqrt(), {})


class Trusting(Grey):
    def predict(self, transmitters, receiver=0, frequency=None, batch_size=16, directions=None):
        return torch.full((len(transmitters), 18, 36), 0.5)


class Believing(Grey):
    """Asks no question about a position that it is given."""

    def _ask(self, transmitters, *others):
        if not isinstance(transmitters, Query):
            transmitters = torch.as_tensor(transmitters).nan_to_num()
        return super()._ask(transmitters, *others)


class Graded(Grey):
    """A gradient from the horizon up, by the number of the row."""

    def forward(self, batch):
        rows = batch.directions.shape[0]
        shades = torch.linspace(0, 1, rows).reshape(-1, *[1] * (len(batch.directions.shape) - 1))
        return Prediction(super().forward(batch).value * shades, {})


class Listening(Grey):
    """Takes the first link's receiver for that of all."""

    def forward(self, batch):
        shade = (1 + batch.query.receivers[:1]).expand(len(batch))[:, None, None]
        value = super().forward(batch).value
        return Prediction(value * shade.reshape(-1, *[1] * (value.ndim - 1)), {})


class Boasting(Grey):
    def facts(self):
        return {"mean": torch.zeros(())}


class Untaught(Grey):
    trained_by = "osmosis"


class Unpenalised(Grey):
    def forward(self, batch):
        return Prediction(super().forward(batch).value, {"each": self.grey.expand(len(batch))})


class Chunky(Grey):
    """Evaluates parts of its own, of which it forgets the last."""

    def evaluate(self, batch):
        value = super().evaluate(batch)
        return value if self.chunk is None else value * (torch.arange(value.shape[-1]) < value.shape[-1] - 1)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Stuck, "each parameter must stand in one of parameter_groups"),
        (Fixed, "predict must give the directions asked for"),
        (Forgetful, "all that predict needs must be in the state dict"),
        (Crowded, "the batch size must not change predictions"),
        (Silent, "the gradient of grey must be finite"),
        (Trusting, "a grid of positions must give a grid of predictions"),
        (Believing, "transmitters with NaN must be a ValueError"),
        (Graded, "predict must give the directions asked for"),
        (Listening, "links to several receivers must come out as each by itself"),
        (Boasting, "facts must be plain values"),
        (Untaught, "trained_by must be one of .*'descent'.*, got 'osmosis'"),
        (Unpenalised, r"the penalty each must be of shape \(\), got \(5,\)"),
        (Chunky, "how much is evaluated at a time must not change values"),
    ],
)
def test_a_broken_model_is_found(model, message):
    check_model(Grey, example_links())
    with pytest.raises(AssertionError, match=message):
        check_model(model, example_links())


class Level(Model):
    """One level for each receiver and carrier, learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        self.levels = nn.Parameter(-60.0 - torch.arange(len(scene.receivers)))

    def forward(self, batch):
        levels = self.levels[batch.query.receivers]
        if batch.query.frequencies is not None:
            levels = levels - batch.query.frequencies / 1e9
        return Prediction(levels, {})


class Unordered(Level):
    def forward(self, batch):
        return Prediction(super().forward(batch).value.sort().values, {})


class Wide(Level):
    def forward(self, batch):
        return Prediction(super().forward(batch).value.double(), {})


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Unordered, "links to several receivers must come out as each by itself|the order of links must not matter"),
        (Wide, "predictions must be torch.float32"),
    ],
)
def test_a_broken_model_of_levels_is_found(model, message):
    check_model(Level, example_links("rssi"))
    with pytest.raises(AssertionError, match=message):
        check_model(model, example_links("rssi"))


def test_links_of_several_carriers_are_asked_with_theirs():
    links = example_links("rssi")
    frequencies = torch.tensor([2.4e9, 5.0e9])[torch.arange(24) // 2 % 2]
    check_model(Level, replace(links, query=replace(links.query, frequencies=frequencies)))
