"""Gradient descent of one optimizer."""

from dataclasses import replace

import lightning
import torch
from torch import Tensor

from gaigs.checkpoint import KEY
from gaigs.gaussians import Gaussians
from gaigs.loss import Loss
from gaigs.model import Model
from gaigs.query import Batch
from gaigs.registry import call, register, suggest
from gaigs.training import MeanScores, seeded
from gaigs.training.budget import share_done
from gaigs.training.finite import find_broken, is_finite
from gaigs.training.schedule import make_optimizer, make_schedule

RATES = {*Gaussians.PARAMETERS, "network", "planes", "paths", "obstacles"}
"""Groups of parameters of the splatting pipeline: rates of those that a configuration leaves out may stay."""

PENALTIES = {"opacity", "obstacles"}
"""Its penalties: likewise their weights."""


@register("training", "descent")
class Descent(lightning.LightningModule):
    """A loss with the model's penalties, a learning rate for each group of parameters, and what a checkpoint must hold.

    Args:
        model: What to train.
        loss: What to minimise.
        identity: What ``gaigs.load`` needs beside the weights, and the configuration and split they come from.
        seed: Of what the training draws at random.
        batch_size: Places a step.
        thinning: Options of the task's thinning: which part of each label a step looks at.
        jitter: Standard deviation by which each place is moved along each axis, anew in every step [m]. Places are not
            known to the centimetre and readings fade within a wavelength: what changes faster is not to be learnt.
        penalties: Weight of each of the model's penalties, the paper's alpha.
        learning_rates: Of each of the model's parameter groups, at the start.
        optimizer: As ``gaigs.training.schedule.make_optimizer`` takes it.
        schedule: As ``gaigs.training.schedule.make_schedule`` takes it.
        patience: Validations without a better score until the training stops; None: it goes on to the last step.
        density: Options of ``gaigs.training.callbacks.DensityControl``; None for none.

    Raises:
        ValueError: An option is out of range, or the learning rates are not those of the model's groups.

    Source: optimiser and schedules after the released configuration.
    """

    name = "descent"

    def __init__(
        self,
        model: Model,
        loss: Loss,
        identity: dict,
        seed: int,
        batch_size: int,
        thinning: dict,
        jitter: float,
        penalties: dict[str, float],
        learning_rates: dict[str, float],
        optimizer: dict,
        schedule: dict,
        patience: int | None,
        density: dict | None,
    ):
        super().__init__()
        if model.trained_by != self.name:
            raise ValueError(f"this model is trained by {model.trained_by!r}; set training={model.trained_by}")
        if not jitter >= 0:
            raise ValueError(f"training.jitter must be at least 0 m, got {jitter}")
        check_rates(model, learning_rates)
        for key, weight in penalties.items():
            if not weight >= 0:
                raise ValueError(f"training.penalties.{key} must be at least 0, got {weight}")
        self.model, self.loss, self.identity, self.seed = model, loss, identity, seed
        self.batch_size, self.jitter = batch_size, jitter
        self.penalties, self.learning_rates = penalties, learning_rates
        self.optimizer, self.schedule, self.patience, self.density = optimizer, schedule, patience, density
        self.task = model.scene.task
        self.thin = call("training.thinning", self.task.thinning, thinning)

    def configure_optimizers(self):
        optimizer = make_optimizer(self.optimizer, self.model.parameter_groups(), self.learning_rates)
        schedule = make_schedule(self.schedule, optimizer, share_done(self.trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        batch = self.prepare(batch)
        value, penalties = self.model(batch)
        loss, terms = self.loss(value, batch)
        return self.add_up(loss, terms, penalties, batch)

    def prepare(self, batch: Batch) -> Batch:
        """What a step looks at of a batch."""
        generator = seeded(self.seed, self.global_step)
        batch = self.thin(batch, generator)
        if self.jitter:
            places, which = batch.query.unique(with_receivers=False)
            moves = self.jitter * torch.randn(places.transmitters.shape, generator=generator).to(places.transmitters)
            moved = (places.transmitters + moves)[which]
            batch = replace(batch, query=replace(batch.query, transmitters=moved))
        return batch

    def add_up(self, loss: Tensor, terms: dict[str, Tensor], penalties: dict[str, Tensor], batch: Batch) -> Tensor:
        """The loss with its penalties, checked and logged."""
        links, places = batch.shares
        total = links * loss
        if unknown := self.penalties.keys() - penalties.keys() - PENALTIES:
            words = " and ".join(suggest(name, PENALTIES | penalties.keys()) for name in sorted(unknown))
            raise ValueError(f"training.penalties has {words}, and the model has no such penalty; leave it out")
        for name, penalty in penalties.items():
            if name not in self.penalties:
                raise ValueError(f"training.penalties must give a weight for {name}; 0 for none")
            total = total + self.penalties[name] * places * penalty
        if not torch.isfinite(total):
            raise self._diverged(total, terms, batch)
        self.log("train/loss", total, prog_bar=True, logger=False)
        if (self.global_step + 1) % self.trainer.log_every_n_steps == 0:
            # Now: Lightning would log behind the step's callbacks, and a checkpoint written there would lack the row.
            shared = {name: links * term for name, term in terms.items()}
            shared |= {name: places * penalty for name, penalty in penalties.items()}
            values = torch.stack([total, *shared.values()]).detach()
            values = self.trainer.strategy.reduce(values, reduce_op="mean").tolist()
            values = dict(zip((f"train/{name}" for name in ("loss", *shared)), values, strict=True))
            for logger in self.loggers:
                logger.log_metrics(values, step=self.global_step)
        return total

    def _diverged(self, total: Tensor, terms: dict[str, Tensor], batch: Batch) -> ValueError:
        """Says what it is that is not finite in a step, and what to do."""
        what, remedy = "the data's labels", "check the files"
        if is_finite(batch.labels):
            what, remedy = find_broken(self.model, batch, terms), "lower training.learning_rates"
            if self.global_step == 0:
                remedy = "no rate has acted yet, so check the options of that part"
        return ValueError(
            f"the loss must stay finite, got {total:g} at step {self.global_step}, and what is not finite there is "
            f"{what}; {remedy}"
        )

    def on_validation_epoch_start(self) -> None:
        self.scores = MeanScores(self.task)

    def validation_step(self, batch: Batch, _: int) -> None:
        self.scores.add(batch, self.model.evaluate(batch))

    def on_validation_epoch_end(self) -> None:
        for name, mean in self.scores.over_processes(self.trainer.strategy).items():
            self.log(f"validation/{name}", mean, prog_bar=name == self.task.monitor, sync_dist=True)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, _: int) -> Batch:
        return batch.to(device)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint[KEY] = self.identity


def check_rates(model: Model, rates: dict[str, float]) -> None:
    """Sees to it that each of a model's parameter groups has a learning rate, and that no rate is for nothing.

    Raises:
        ValueError: A group has none, or a rate has no group; the groups of the splatting pipeline may stay. A rate is
            negative.
    """
    groups = set(model.parameter_groups())
    if unset := groups - set(rates):
        raise ValueError(f"training.learning_rates must give a rate for {', '.join(sorted(unset))}")
    if unknown := set(rates) - groups - RATES:
        words = " and ".join(suggest(name, groups | RATES) for name in sorted(unknown))
        raise ValueError(f"training.learning_rates has {words}, and the model's groups are {', '.join(sorted(groups))}")
    for name, rate in rates.items():
        if not rate >= 0:
            raise ValueError(f"training.learning_rates.{name} must be at least 0, got {rate}")
