"""The checkpoints that a training leaves, and goes on from."""

import math
import os
import signal
from dataclasses import replace

import pytest
import torch
from fitting import Plane, fit, make_links, make_module
from lightning.pytorch.callbacks import Callback
from torch import nn

from gaigs.loss.absolute import Absolute
from gaigs.model import Model, Prediction
from gaigs.processes import STOPPING
from gaigs.task.rssi import Rssi
from gaigs.training.callbacks import Interrupted, KeepBest, KeepLast


@pytest.fixture(autouse=True)
def handlers():
    """Signals are handled behind each test as before it."""
    before = {number: signal.getsignal(number) for number in STOPPING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def links():
    return make_links()


class Noisy(Plane):
    """A plane that draws from torch's global generator, in training and in validation."""

    def forward(self, batch):
        value, penalties = super().forward(batch)
        return type(self.prediction)(value + 0.1 * torch.randn(value.shape), penalties)


class Watch(Callback):
    """Losses of all steps; gets signals behind some of them."""

    def __init__(self, at=None, number=None):
        self.losses, self.at, self.number = [], at, number

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.losses.append(outputs["loss"].item())
        if trainer.global_step == self.at:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", STOPPING)
@pytest.mark.parametrize("at", [3, 5])  # 5: a validation is due, which draws too
def test_a_training_goes_on_with_the_random_numbers_that_were_next(links, tmp_path, at, number):
    def make():
        torch.manual_seed(0)
        return make_module(links, Noisy(links.scene))

    whole, part, rest = Watch(), Watch(at, number), Watch()
    path = tmp_path / "last.ckpt"
    fit(make(), links, tmp_path, 8, whole, KeepLast(tmp_path / "whole.ckpt", every=math.inf))
    with pytest.raises(Interrupted, match=f"stopped after step {at}$"):
        fit(make(), links, tmp_path, 8, part, KeepLast(path, every=math.inf))
    module = make()
    torch.manual_seed(2)  # which another process need not start from
    fit(module, links, tmp_path, 8, rest, KeepLast(path, every=math.inf), resume=path)
    assert part.losses == whole.losses[:at]
    assert rest.losses == whole.losses[at:]


# --- the best ---


class Level(Model):
    """One number for all links, which the training raises by 1 dB a step."""

    def __init__(self, scene):
        super().__init__(scene)
        self.level = nn.Parameter(torch.zeros(()))

    def forward(self, batch):
        assert batch.query.transmitters.dtype == self.level.dtype
        return Prediction(self.level.expand(len(batch)), {})


class Ready(Level):
    """One that predicts as it is made."""

    predicts_untrained = True


def train(links, folder, model, validation, steps, **options):
    """The step of the best checkpoint, its level, and the callback; training labels are far above those to validate."""
    labels = torch.full((len(links),), 100.0)
    labels[links.split.validation] = validation
    readings = replace(links, labels=labels, task=Rssi())
    module = make_module(
        readings,
        model(readings.scene),
        loss=Absolute(readings.task),
        thinning={},
        penalties={},
        learning_rates={"network": 1.0},
        optimizer={"_target_": "torch.optim.SGD"},
        schedule={"warmup": 0, "final": 1.0},
    )
    best = KeepBest(folder / "best.ckpt", patience=None)
    fit(module, readings, folder, steps, best, **options)
    content = torch.load(folder / "best.ckpt", weights_only=True)
    return content["global_step"], content["state_dict"]["model.level"].item(), best


@pytest.mark.parametrize("precision", ["32-true", "64-true"])
@pytest.mark.parametrize(
    ("model", "validation", "steps", "kept"),
    [
        (Ready, 0.0, 12, 0),  # each step is worse than the one before
        (Ready, 2.0, 12, 0),  # as far off as the start at step 4, which is not looked at
        (Ready, 6.0, 12, 5),
        (Level, 0.0, 12, 5),  # the start does not count
        (Level, 100.0, 10, 10),  # each step is better
        (Level, 100.0, 12, 12),  # where no validation is due
        (Level, 12.0, 12, 12),
        (Level, 8.0, 12, 10),  # off by 2 at step 10 and by 4 at step 12
    ],
)
def test_the_best_of_start_validations_and_end_is_kept(links, tmp_path, model, validation, steps, kept, precision):
    step, level, best = train(links, tmp_path, model, validation, steps, precision=precision)
    assert (step, level) == (kept, kept)
    assert best.best == -abs(kept - validation)


def test_without_validation_the_end_is_kept(links, tmp_path):
    step, level, best = train(links, tmp_path, Ready, 0.0, 7, limit_val_batches=0)
    assert (step, level, best.best) == (7, 7.0, -math.inf)
