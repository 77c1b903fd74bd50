"""The check for authors of a training: it passes ours, and finds each defect."""

from functools import partial

import pytest
import torch
from fitting import OPTIONS, Plane
from torch import nn

from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.testing import check_training, example_links
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
def test_descent_is_as_the_contract_says(links, options):
    build = partial(registry("training").build, {"name": "descent", **OPTIONS, **options})
    check_training(build, Plane, links)


@pytest.mark.parametrize("task", ["rssi", "csi"])
def test_descent_is_as_the_contract_says_for_other_tasks(task):
    check_training(partial(registry("training").build, SIMPLE), Linear, example_links(task))


class Forgetful(Descent):
    def on_save_checkpoint(self, checkpoint):
        pass


class Careless(Descent):
    def __init__(self, model, **options):
        model.trained_by = "descent"
        super().__init__(model, **options)


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


class Lazy(Descent):
    def configure_optimizers(self):
        optimizer = torch.optim.SGD([self.model.slope], lr=0.1)
        return {"optimizer": optimizer}


class Twice(Descent):
    def __init__(self, **options):
        super().__init__(**options)
        self.automatic_optimization = False

    def training_step(self, batch, index):
        for _ in range(2):
            loss = super().training_step(batch, index)
            self.optimizers().zero_grad()
            self.manual_backward(loss)
            self.optimizers().step()


class Unheard(Descent):
    def log(self, name, *values, **options):
        if name != "train/loss":
            super().log(name, *values, **options)


class Blind(Descent):
    def on_validation_epoch_end(self):
        self.log("validation/score", 0.5)


class Flattering(Descent):
    def validation_step(self, batch, index):
        self.scores.add(batch, batch.labels)


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        (Forgetful, "a checkpoint must hold the identity as its entry 'gaigs'"),
        (Careless, "a model of another training must be a ValueError"),
        (Erratic, "the same seed must give the same training"),
        (Stateful, "a resumed training must equal an uninterrupted one"),
        (Lazy, "the parameters of group network must change in training"),
        (Twice, "6 batches must be as many steps, got"),
        (Unheard, "each step must log a finite train/loss for the progress bar"),
        (Blind, "a validation must log validation/ssim, got .*validation/score"),
        (Flattering, "validation/ssim must be the mean score of the validation links"),
    ],
)
def test_what_is_broken_is_found(links, kind, rule):
    with pytest.raises(AssertionError, match=rule):
        check_training(lambda **context: kind(**context, **OPTIONS), Plane, links)


@pytest.mark.parametrize(("name", "value"), [("batch_size", 0), ("patience", 0), ("density", 3)])
def test_what_a_run_asks_for_has_to_be_there(links, name, value):
    def build(**context):
        module = Descent(**context, **OPTIONS)
        setattr(module, name, value)
        return module

    with pytest.raises(AssertionError, match=f"{name} must be"):
        check_training(build, Plane, links)
    with pytest.raises(AssertionError, match="a training must be a LightningModule"):
        check_training(lambda **context: torch.nn.Identity(), Plane, links)
