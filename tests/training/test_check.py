"""The check for authors of a training: it passes ours, and finds each defect."""

from functools import partial

import pytest
import torch
from contracts.training import check_training
from fitting import OPTIONS, Plane
from torch import nn

from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.testing import example_links
from gaigs.training.descent import Descent

SIMPLE = OPTIONS | {"name": "descent", "thinning": {}}


class Linear(Model):
    """A label of any task, from position and receiver."""

    def __init__(self, scene):
        super().__init__(scene)
        self.real, self.imaginary = nn.Linear(4, 1), nn.Linear(4, 1)

    def parameter_groups(self):
        used = [self.real, self.imaginary] if self.scene.task.dtype.is_complex else [self.real]
        return {"network": [parameter for part in used for parameter in part.parameters()]}

    def forward(self, batch):
        inputs = torch.cat((batch.query.transmitters, batch.query.receivers[:, None].float()), 1)
        value = self.real(inputs)[:, 0]
        if self.scene.task.dtype.is_complex:
            value = torch.complex(value, self.imaginary(inputs)[:, 0])
        shape = self.scene.task.shape if batch.directions is None else batch.directions.shape
        return Prediction(value.reshape(-1, *[1] * len(shape)).expand(-1, *shape), {})


@pytest.mark.parametrize("options", [{}, {"thinning": {"rays": 40}, "jitter": 0.05}], ids=str)
def test_descent_keeps_the_contract(links, options):
    build = partial(registry("training").build, {"name": "descent", **OPTIONS, **options})
    check_training(build, Plane, links)


@pytest.mark.parametrize("task", ["rssi", "csi"])
def test_descent_keeps_the_contract_for_other_tasks(task):
    check_training(partial(registry("training").build, SIMPLE), Linear, example_links(task))


class Forgetful(Descent):
    def on_save_checkpoint(self, checkpoint):
        pass


class Erratic(Descent):
    draws = torch.Generator().manual_seed(0)  # which nothing keeps

    def prepare(self, batch):
        batch = super().prepare(batch)
        batch.labels = batch.labels + torch.rand(1, generator=self.draws)
        return batch


class Stateful(Descent):
    """Each step weighs more than the one before, by a count that no checkpoint holds."""

    count = 0

    def add_up(self, loss, *others):
        self.count += 1
        return super().add_up(self.count * loss, *others)


class Flattering(Descent):
    def validation_step(self, batch, index):
        self.scores.add(batch, batch.labels)


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        (Forgetful, "a checkpoint must hold the identity as its entry 'gaigs'"),
        (Erratic, "the same seed must give the same training"),
        (Stateful, "a resumed training must equal an uninterrupted one"),
        (Flattering, "validation/ssim must be the mean score of the validation links"),
    ],
)
def test_each_defect_is_found(links, kind, rule):
    with pytest.raises(AssertionError, match=rule):
        check_training(lambda **context: kind(**context, **OPTIONS), Plane, links)


@pytest.mark.parametrize(("name", "value"), [("batch_size", 0), ("patience", 0), ("density", 3)])
def test_wrong_attributes_are_found(links, name, value):
    def build(**context):
        module = Descent(**context, **OPTIONS)
        setattr(module, name, value)
        return module

    with pytest.raises(AssertionError, match=f"{name} must be"):
        check_training(build, Plane, links)
    with pytest.raises(AssertionError, match="a training must be a LightningModule"):
        check_training(lambda **context: torch.nn.Identity(), Plane, links)
