"""The LightningModule that trains a model on labels of any kind."""

import lightning
import torch
from torch import Tensor

from gaigs.checkpoint import KEY
from gaigs.model import Batch, Model
from gaigs.registry import call
from gaigs.training.losses import RssiLoss, SpectrumLoss
from gaigs.training.metrics import scoring


class Training(lightning.LightningModule):
    """A loss with the model's penalties, a learning rate for each group of parameters, and what a checkpoint must hold.

    Args:
        model: What to train.
        identity: What ``gaigs.load`` needs beside the weights, and the configuration and split they come from.
        seed: Of what the training draws at random.
        batch_size: Transmitters a step.
        loss: Options of ``SpectrumLoss`` or ``RssiLoss``, whichever suits the labels.
        penalties: Weight of each of the model's penalties, the paper's alpha.
        learning_rates: Of each of the model's parameter groups, at the start.
        final_rate: Every rate falls exponentially to this fraction of itself at the last step.
        warmup: Steps over which the rates rise linearly at first.
        weight_decay: AdamW's, of the group ``network``.
        patience: Of ``KeepBest``.
        density: Options of ``DensityControl``; None for none.

    Raises:
        ValueError: An option is out of range, or the model has a group of parameters without a learning rate.

    Source: optimiser and schedules after the released configuration.
    """

    def __init__(
        self,
        model: Model,
        identity: dict,
        seed: int,
        batch_size: int,
        loss: dict,
        penalties: dict[str, float],
        learning_rates: dict[str, float],
        final_rate: float,
        warmup: int,
        weight_decay: float,
        patience: int | None,
        density: dict | None,
    ):
        super().__init__()
        if not 0 < final_rate <= 1:
            raise ValueError(f"training.final_rate must be in (0, 1], got {final_rate}")
        if warmup < 0:
            raise ValueError(f"training.warmup must be at least 0 steps, got {warmup}")
        if unset := set(model.parameter_groups()) - set(learning_rates):
            raise ValueError(f"training.learning_rates must give a rate for {', '.join(sorted(unset))}")
        self.model, self.identity, self.seed, self.batch_size = model, identity, seed, batch_size
        self.penalties, self.learning_rates = penalties, learning_rates
        self.final_rate, self.warmup = final_rate, warmup
        self.weight_decay, self.patience, self.density = weight_decay, patience, density
        grid = model.scene.grid
        self.loss = call("training.loss", RssiLoss if grid is None else SpectrumLoss, loss, grid=grid)
        self.scoring = scoring(grid)

    def configure_optimizers(self):
        groups = [
            {
                "params": parameters,
                "lr": self.learning_rates[name],
                "weight_decay": self.weight_decay if name == "network" else 0.0,
                "name": name,
            }
            for name, parameters in self.model.parameter_groups().items()
        ]
        optimizer = torch.optim.AdamW(groups)
        steps = self.trainer.max_steps

        def rate(step: int) -> float:
            return min(1.0, (step + 1) / max(self.warmup, 1)) * self.final_rate ** (step / steps)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        generator = torch.Generator().manual_seed(hash((self.seed, self.global_step)) % 2**63)
        loss, terms, penalties = self.loss(self.model, batch, generator)
        for name, penalty in penalties.items():
            if name not in self.penalties:
                raise ValueError(f"training.penalties must give a weight for {name}; 0 for none")
            loss = loss + self.penalties[name] * penalty
        if not torch.isfinite(loss):
            raise ValueError(
                f"the loss must stay finite, got {loss:g} at step {self.global_step}; lower training.learning_rates"
            )
        self.log("train/loss", loss, prog_bar=True, logger=False)
        if (self.global_step + 1) % self.trainer.log_every_n_steps == 0:
            # Now: Lightning would log behind the step's callbacks, and a checkpoint written there would lack the row.
            values = {f"train/{name}": term.item() for name, term in ({"loss": loss} | terms | penalties).items()}
            for logger in self.loggers:
                logger.log_metrics(values, step=self.global_step)
        return loss

    def validation_step(self, batch: Batch, _: int) -> None:
        prediction, _ = self.model(batch)
        for name, values in self.scoring.scores(batch.labels, prediction).items():
            shown = name == self.scoring.watched
            self.log(f"validation/{name}", values.mean().float(), prog_bar=shown, batch_size=len(batch.labels))

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, _: int) -> Batch:
        return batch.to(device)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint[KEY] = self.identity
