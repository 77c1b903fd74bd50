"""The LightningModule that trains any model with parameters."""

import lightning
import torch
from torch import Tensor

from gaigs.checkpoint import KEY
from gaigs.model import Batch, Model
from gaigs.training.losses import spectrum_loss
from gaigs.training.metrics import spectrum_scores


class Training(lightning.LightningModule):
    """The paper's loss, a learning rate for each group of parameters, and what a checkpoint must hold.

    Loss: (1 - ssim) L_MAE + ssim L_SSIM + sum of weight times penalty, on every ``stride``-th row and column of the
    label, from a random one on: neighbouring pixels of a spectrum are far closer than the array resolves.

    Args:
        model: What to train.
        identity: What ``gaigs.load`` needs beside the weights, and the configuration and split they come from.
        seed: Of the random rows and columns.
        batch_size: Transmitters a step.
        stride: Rows and columns between those that a step looks at.
        ssim: Weight of the SSIM term, the paper's 1 - beta.
        penalties: Weight of each of the model's penalties, the paper's alpha.
        learning_rates: Of each of the model's parameter groups, at the start.
        final_rate: Every rate falls exponentially to this fraction of itself at the last step.
        warmup: Steps over which the rates rise linearly at first.
        weight_decay: AdamW's, of the group ``network``.
        patience: Of ``KeepBest``.
        density: Options of ``DensityControl``; None for none.

    Raises:
        ValueError: An option is out of range, or the model has a group of parameters without a learning rate.

    Source: GAI-GS, "Results"; optimiser and schedules after the released configuration.
    """

    def __init__(
        self,
        model: Model,
        identity: dict,
        seed: int,
        batch_size: int,
        stride: int,
        ssim: float,
        penalties: dict[str, float],
        learning_rates: dict[str, float],
        final_rate: float,
        warmup: int,
        weight_decay: float,
        patience: int | None,
        density: dict | None,
    ):
        super().__init__()
        coarsest = min(model.scene.grid.shape) // 3  # which leaves the SSIM's smallest window
        for option, value, holds, bounds in (
            ("ssim", ssim, 0 <= ssim <= 1, "in [0, 1]"),
            ("final_rate", final_rate, 0 < final_rate <= 1, "in (0, 1]"),
            ("warmup", warmup, warmup >= 0, "at least 0 steps"),
            ("stride", stride, 1 <= stride <= coarsest, f"in 1..{coarsest} for this grid"),
        ):
            if not holds:
                raise ValueError(f"training.{option} must be {bounds}, got {value}")
        if unset := set(model.parameter_groups()) - set(learning_rates):
            raise ValueError(f"training.learning_rates must give a rate for {', '.join(sorted(unset))}")
        self.model, self.identity, self.seed, self.batch_size = model, identity, seed, batch_size
        self.stride, self.ssim, self.penalties = stride, ssim, penalties
        self.learning_rates, self.final_rate, self.warmup = learning_rates, final_rate, warmup
        self.weight_decay, self.patience, self.density = weight_decay, patience, density

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
        row, column = torch.randint(self.stride, (2,), generator=generator).tolist()
        batch = batch.thin(slice(row, None, self.stride), slice(column, None, self.stride))
        prediction, penalties = self.model(batch)
        terms = spectrum_loss(prediction, batch.labels, self.stride)
        loss = (1 - self.ssim) * terms["l1"] + self.ssim * terms["ssim"]
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
        scores = spectrum_scores(batch.labels, prediction)
        size = len(batch.labels)
        self.log("validation/ssim", scores["ssim"].mean().float(), prog_bar=True, batch_size=size)
        self.log("validation/mae", scores["mae"].mean().float(), batch_size=size)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, _: int) -> Batch:
        return batch.to(device)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint[KEY] = self.identity
