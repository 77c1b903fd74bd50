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

    Loss: (1 - ssim) L_MAE + ssim L_SSIM + sum of weight times penalty, on every ``stride``-th row and column of the label,
    from a random one on: neighbouring pixels of a spectrum are far closer than the array resolves.

    Args:
        model: What to train.
        identity: What ``gaigs.load`` needs beside the weights, and what a resumed run is checked against.
        stride: Rows and columns between those that a step looks at.
        ssim: Weight of the SSIM term, the paper's 1 - beta.
        penalties: Weight of each of the model's penalties, the paper's alpha.
        learning_rates: Of each of the model's parameter groups, at the start.
        final_rate: Every rate falls exponentially to this fraction of itself at the last step.
        warmup: Steps over which the rates rise linearly at first.
        weight_decay: AdamW's, of the group ``network``.
        seed: Of the random rows and columns.

    Source: GAI-GS, "Results"; optimiser and schedules after the released configuration.
    """

    def __init__(
        self,
        model: Model,
        identity: dict,
        stride: int,
        ssim: float,
        penalties: dict[str, float],
        learning_rates: dict[str, float],
        final_rate: float,
        warmup: int,
        weight_decay: float,
        seed: int,
    ):
        super().__init__()
        groups = set(model.parameter_groups())
        if unset := groups - set(learning_rates):
            raise ValueError(f"training.learning_rates must give a rate for {', '.join(sorted(unset))}")
        self.model, self.identity, self.stride, self.ssim = model, identity, stride, ssim
        self.penalties, self.learning_rates, self.final_rate = penalties, learning_rates, final_rate
        self.warmup, self.weight_decay, self.seed = warmup, weight_decay, seed

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
            loss = loss + self.penalties[name] * penalty
        if not torch.isfinite(loss):
            raise ValueError(
                f"the loss must stay finite, got {loss.item()} at step {self.global_step}; lower training.learning_rates"
            )
        self.log_dict({f"train/{name}": term for name, term in (terms | penalties).items()})
        self.log("train/loss", loss, prog_bar=True)
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

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        weights = checkpoint["state_dict"]
        if (means := weights.get("model.gaussians.means")) is not None:
            self.model.gaussians.resize(len(means))
