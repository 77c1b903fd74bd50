"""Two optimizers in turn: a discriminator separates labels from predictions, and the model learns
to deceive it.
"""

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from gaigs.core.query import Batch
from gaigs.registry import call
from gaigs.training.budget import share_done
from gaigs.training.descent import Descent
from gaigs.training.schedule import make_optimizer, make_schedule

DISCRIMINATOR = "discriminator"
"""Parameter group of the second optimizer."""


class Adversarial(Descent):
    """Training in turns: a step of the discriminator, then a step of all other parameters.

    Both count as one step. The model has a method ``discriminate(batch, values)``, which gives a
    logit for each link (b,), large where it takes the values for labels, and a parameter group
    ``discriminator``.

    Args:
        weight: Weight of the adversarial term beside the loss.
        **options: Options of ``gaigs.training.descent.Descent``.

    Raises:
        ValueError: An option is out of range, or the model has no discriminator.

    Source: Goodfellow et al., Generative Adversarial Nets, 2014, in the non-saturating form.
    """

    name = "adversarial"

    def __init__(self, weight: float, **options):
        call(f"training {self.name!r}", super().__init__, options)
        if not weight >= 0:
            raise ValueError(f"training.weight must be at least 0, got {weight}")
        if DISCRIMINATOR not in self.model.parameter_groups():
            raise ValueError(
                f"adversarial training needs a model with a parameter group {DISCRIMINATOR!r}"
            )
        self.weight = weight
        self.automatic_optimization = False

    def configure_optimizers(self):
        groups = self.model.parameter_groups()
        of_discriminator = {DISCRIMINATOR: groups.pop(DISCRIMINATOR)}
        optimizers = [
            make_optimizer(self.optimizer, part, self.learning_rates)
            for part in (groups, of_discriminator)
        ]
        done = share_done(self.trainer)
        schedules = [make_schedule(self.schedule, optimizer, done) for optimizer in optimizers]
        return optimizers, schedules

    def on_fit_start(self) -> None:
        if self.trainer.world_size > 1:
            raise ValueError("adversarial training takes one process; set trainer.devices=1")
        if getattr(self.trainer.precision_plugin, "scaler", None) is not None:
            raise ValueError(
                "adversarial training does not scale gradients; set trainer.precision to "
                "bf16-mixed or 32"
            )

    def training_step(self, batch: Batch, _: int) -> Tensor:
        batch = self.prepare(batch)
        generator, discriminator = self.optimizers()
        value, penalties = self.model(batch)

        # The discriminator learns to give labels a large logit and predictions a small one.
        discriminator.zero_grad()
        real = self.model.discriminate(batch, batch.labels)
        fake = self.model.discriminate(batch, value.detach())
        of_real = cross_entropy(real, torch.ones_like(real))
        of_fake = cross_entropy(fake, torch.zeros_like(fake))
        judgement = of_real + of_fake
        self.manual_backward(judgement)
        # Past Lightning, which would count it as a step of the training.
        discriminator.optimizer.step()

        # The model learns predictions with a large logit.
        generator.zero_grad()
        loss, terms = self.loss(value, batch)
        fooled = self.model.discriminate(batch, value)
        deceit = cross_entropy(fooled, torch.ones_like(fooled))
        terms = terms | {"discriminator": judgement, "deceit": deceit}
        total = self.add_up(loss + self.weight * deceit, terms, penalties, batch)
        self.manual_backward(total)
        generator.step()
        for schedule in self.lr_schedulers():
            schedule.step()
        return total.detach()
