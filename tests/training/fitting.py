"""A model of two parameter groups, made-up links that it learns, and a short training."""

import os
import signal
from collections.abc import Mapping

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint
from lightning.pytorch.loggers import CSVLogger
from torch import nn

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Split
from gaigs.model import Model, Prediction
from gaigs.splatting.loss.absolute import Absolute
from gaigs.splatting.loss.l1_ssim import L1Ssim
from gaigs.training.batches import Batches, InOrder
from gaigs.training.budget import ENDLESS
from gaigs.training.descent import Descent

PLACES = 12
"""Transmitters: 8 to train, 3 to validate, 1 to test."""

OPTIONS = {
    "batch_size": 4,
    "thinning": {"stride": 3},
    "jitter": 0.0,
    "penalties": {},
    "learning_rates": {},
    "optimizer": {"_target_": "torch.optim.AdamW", "weight_decay": 0.3},
    "schedule": {"warmup": 4, "final": 0.1},
    "patience": None,
    "density": None,
}


class Plane(Model):
    """A label that rises with elevation and azimuth, times a gain that a network gives for the
    transmitter.
    """

    learning_rates: Mapping[str, float] = {"slope": 0.01, "network": 0.02}
    penalty_weights: Mapping[str, float] = {"gain": 0.5}

    def __init__(self, scene):
        super().__init__(scene)
        self.slope = nn.Parameter(torch.tensor([0.3, 0.1]))
        self.network = nn.Linear(3, 1)

    def parameter_groups(self):
        return {"slope": [self.slope], "network": list(self.network.parameters())}

    def forward(self, batch):
        directions = batch.directions
        rises = self.slope[0] * directions.elevations, self.slope[1] * directions.azimuths
        image = (
            rises[0][:, None] + rises[1] if isinstance(directions, Grid) else rises[0] + rises[1]
        )
        gain = self.network(batch.query.transmitters)
        self.batch = batch
        self.prediction = Prediction(
            gain.sigmoid().reshape(-1, *[1] * image.ndim) * image, {"gain": gain.square().mean()}
        )
        return self.prediction


class Watch(Callback):
    """Losses of all steps; gets a signal after one of them."""

    def __init__(self, at=None):
        self.losses, self.at = [], at

    def on_train_batch_start(self, trainer, module, *_):
        assert module.model.training

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.losses.append(outputs["loss"].item())
        if trainer.global_step == self.at:
            os.kill(os.getpid(), signal.SIGTERM)


def make_links():
    """Spectra at 12 places, which one receiver hears."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid.degrees(range(24), range(30))
    return Links(
        query=Query(
            torch.rand(PLACES, 3, generator=generator), torch.zeros(PLACES, dtype=torch.long)
        ),
        receivers=(Receiver("gateway1", Pose.from_xyzw((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))),),
        labels=torch.rand(PLACES, 24, 30, generator=generator),
        task=Spectrum(grid.elevations, grid.azimuths, "none"),
        split=Split("8, 3 and 1", torch.arange(8), torch.arange(8, 11), torch.arange(11, 12)),
    )


def make_module(links, model=None, loss=None, seed=0, kind=Descent, **options):
    """The training of a plane by the paper's loss, or of another model by another loss."""
    torch.manual_seed(0)
    model = model or Plane(links.scene)
    loss = loss or (
        Absolute(links.task)
        if "rays" in options.get("thinning", {})
        else L1Ssim(links.task, ssim=0.25)
    )
    return kind(
        model=model, loss=loss, identity={"who": "the plane"}, seed=seed, **OPTIONS | options
    )


def fit(module, links, folder, steps, *callbacks, resume=None, at_a_time=2, **options):
    """Trains with a validation after every fifth step, and a row of the log every second."""
    options = {"val_check_interval": 5, "log_every_n_steps": 2} | options
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=-1, max_steps=steps, num_sanity_val_steps=0, check_val_every_n_epoch=None,
        enable_progress_bar=False, enable_model_summary=False, callbacks=list(callbacks),
        enable_checkpointing=any(isinstance(callback, Checkpoint) for callback in callbacks),
        logger=CSVLogger(folder, "log"), default_root_dir=folder, **options,
    )  # fmt: skip
    batches = Batches(
        links, links.split.train, module.batch_size, 0, ENDLESS if steps == -1 else steps
    )
    validation = InOrder(links, links.split.validation, at_a_time)
    trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    return trainer
