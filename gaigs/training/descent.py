"""Gradient descent with one optimizer."""

from collections.abc import Mapping
from dataclasses import replace

import lightning
import torch
from torch import Tensor

from gaigs.core.query import Batch
from gaigs.model import Model
from gaigs.model.checkpoint import KEY
from gaigs.registry import call, register, suggest
from gaigs.splatting.loss import Loss
from gaigs.training import MeanScores, seeded
from gaigs.training.budget import share_done
from gaigs.training.divergence import find_broken, is_finite
from gaigs.training.schedule import make_optimizer, make_schedule


@register("training", "descent")
class Descent(lightning.LightningModule):
    """A loss with the model's penalties, and a learning rate for each group of parameters.

    Args:
        identity: Entries of a checkpoint besides the weights: scene, configuration and split.
        seed: Seed of the training's random numbers.
        batch_size: Places in a step.
        thinning: Options of the task's thinning: the part of each label in a step.
        jitter: Standard deviation of a random shift of each place in every step, along each axis
            [m].
        penalties: Weights of penalties by name; they replace ``Model.penalty_weights``.
        learning_rates: Initial rates by parameter group; they replace ``Model.learning_rates``.
        optimizer, schedule: Arguments of ``gaigs.training.schedule``.
        patience: Validations without a better score before the training stops; None: the training
            runs to the last step.
        density: Options of ``gaigs.training.density_control.DensityControl``; None: a fixed number
            of Gaussians.
        links: Largest number of links in a step, drawn at random from the links of its places;
            None: all.

    Raises:
        ValueError: An option is out of range, or the model lacks a parameter group or penalty.

    Source: optimizer and schedules as in the released configuration of GAI-GS.
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
        links: int | None = None,
    ):
        super().__init__()
        if model.trained_by != self.name:
            raise ValueError(
                f"this model is trained by {model.trained_by!r}; set training={model.trained_by}"
            )
        if not jitter >= 0:
            raise ValueError(f"training.jitter must be at least 0 m, got {jitter}")
        if links is not None and links < 1:
            raise ValueError(f"training.links must be at least 1 link or null, got {links}")
        self.penalties = _overridden("training.penalties", model.penalty_weights, penalties)
        self.learning_rates = _overridden(
            "training.learning_rates", model.learning_rates, learning_rates
        )
        if unset := model.parameter_groups().keys() - self.learning_rates.keys():
            raise ValueError(
                f"the model has no learning rate for {', '.join(sorted(unset))}; "
                "add it to learning_rates"
            )
        self.model = model
        self.loss = loss
        self.identity = identity
        self.seed = seed
        self.links = links
        self.batch_size = batch_size
        self.jitter = jitter
        self.patience = patience
        self.density = density
        self.optimizer = optimizer
        self.schedule = schedule
        self.task = model.scene.task
        self.thin = call("training.thinning", self.task.thinning, thinning)

    def configure_optimizers(self):
        optimizer = make_optimizer(
            self.optimizer, self.model.parameter_groups(), self.learning_rates
        )
        schedule = make_schedule(self.schedule, optimizer, share_done(self.trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        batch = self.prepare(batch)
        value, penalties = self.model(batch)
        loss, terms = self.loss(value, batch)
        return self.add_up(loss, terms, penalties, batch)

    def prepare(self, batch: Batch) -> Batch:
        """A batch as input of a step: fewer links, thinned labels, shifted places."""
        generator = seeded(self.seed, self.global_step)
        if self.links is not None and len(batch) > self.links:
            order = torch.randperm(len(batch), generator=generator)
            chosen = order[: self.links].sort().values.to(batch.labels.device)  # (links,)
            batch = replace(batch, query=batch.query[chosen], labels=batch.labels[chosen])
        batch = self.thin(batch, generator)
        if self.jitter:
            # Links of one place to all receivers shift together.
            places, which = batch.query.unique(with_receivers=False)
            shifts = torch.randn(places.transmitters.shape, generator=generator)
            shifts = self.jitter * shifts.to(places.transmitters)
            shifted = (places.transmitters + shifts)[which]  # (b, 3)
            batch = replace(batch, query=replace(batch.query, transmitters=shifted))
        return batch

    def add_up(
        self, loss: Tensor, terms: dict[str, Tensor], penalties: dict[str, Tensor], batch: Batch
    ) -> Tensor:
        """The loss plus the weighted penalties; checks that it is finite, and logs all.

        Args:
            loss: Mean loss of the batch.
            terms: Terms of the loss, for the log.
            penalties: Penalties of the model, means over places.
            batch: The batch, whose ``shares`` weight means over links and places.
        """
        links, places = batch.shares
        total = links * loss
        for name, penalty in penalties.items():
            if name not in self.penalties:
                raise ValueError(
                    f"the model has no weight of its penalty {name!r}; add it to penalty_weights"
                )
            total = total + self.penalties[name] * places * penalty
        if not torch.isfinite(total):
            raise self._diverged(total, terms, batch)
        if (self.global_step + 1) % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            logged = {"train/loss": total}
            logged |= {f"train/{name}": links * term for name, term in terms.items()}
            logged |= {f"penalty/{name}": places * value for name, value in penalties.items()}
            self._log_now(logged)
        return total

    def _log_now(self, terms: dict[str, Tensor]) -> None:
        """Logs means over processes at once.

        Lightning would log after the callbacks of the step: their checkpoint would lack the row.
        """
        values = torch.stack([*terms.values()]).detach()
        values = self.trainer.strategy.reduce(values, reduce_op="mean").tolist()
        row = dict(zip(terms, values, strict=True))
        for logger in self.loggers:
            logger.log_metrics(row, step=self.global_step)

    def _diverged(self, total: Tensor, terms: dict[str, Tensor], batch: Batch) -> ValueError:
        """The error of a step with an infinite or NaN loss: first broken quantity, and advice."""
        if not is_finite(batch.labels):
            cause = "the data's labels; check the files"
        else:
            remedy = "lower training.learning_rates"
            if self.global_step == 0:
                remedy = "no rate has acted yet, so check the options of that part"
            cause = f"{find_broken(self.model, batch, terms)}; {remedy}"
        place = f"{total:g} at step {self.global_step}"
        return ValueError(f"the loss must stay finite, got {place}, first in {cause}")

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


def _overridden(
    option: str, defaults: Mapping[str, float], values: Mapping[str, float]
) -> dict[str, float]:
    """A model's defaults replaced by ``values``; errors name their ``option``."""
    for name, value in values.items():
        if name not in defaults:
            listed = ", ".join(sorted(defaults)) or "none"
            raise ValueError(f"{option} has no key {suggest(name, defaults)}; it has: {listed}")
        if not value >= 0:
            raise ValueError(f"{option}.{name} must be at least 0, got {value}")
    return {**defaults, **values}
