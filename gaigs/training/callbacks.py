"""What happens between the steps: density control, and a clean stop at Ctrl-C."""

import signal
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import Callback

from gaigs import density


class DensityControl(Callback):
    """Prunes, clones and splits Gaussians on a schedule.

    A Gaussian that the loss pulls at, though it is already where it should be, is too few: its mean positional gradient
    since the last time, times its distance to the receivers' middle (a pull per radian seen from there), is compared with
    ``gradient``. Wide ones split, narrow ones are cloned.

    Args:
        every: Steps between two rounds.
        start, stop: First and last step at which a round may happen.
        gradient: Bound on that pull [loss/rad].
        wide: A Gaussian is wide if its largest standard deviation over its distance exceeds this [rad].
        opacity: Gaussians below this opacity are pruned.
        most: Their number does not grow beyond this.
        seed: Of the halves' random places.

    Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2; thresholds in docs/methods.md.
    """

    def __init__(
        self, every: int, start: int, stop: int, gradient: float, wide: float, opacity: float, most: int, seed: int
    ):
        if every < 1:
            raise ValueError(f"density.every must be at least 1 step, got {every}")
        self.every, self.start, self.stop = every, start, stop
        self.gradient, self.wide, self.opacity, self.most, self.seed = gradient, wide, opacity, most, seed
        self.pull = torch.zeros(0)
        self.steps = 0

    def state_dict(self) -> dict:
        return {"pull": self.pull, "steps": self.steps}

    def load_state_dict(self, state: dict) -> None:
        self.pull, self.steps = state["pull"], state["steps"]

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        gaussians = module.model.gaussians
        pull = gaussians.means.grad.norm(dim=-1) * self._distances(module)
        self.pull = pull if self.steps == 0 else self.pull.to(pull) + pull
        self.steps += 1

    @torch.no_grad()
    def on_train_batch_end(self, trainer, module, *_) -> None:
        step = trainer.global_step
        if step % self.every or not self.start <= step <= self.stop:
            return
        gaussians, optimizer = module.model.gaussians, trainer.optimizers[0]
        pulled = self.pull / self.steps > self.gradient
        room = max(0, self.most - len(gaussians))
        if int(pulled.sum()) > room:  # only the hardest pulled
            chosen = torch.topk(torch.where(pulled, self.pull, -1), room).indices
            pulled = torch.zeros_like(pulled).index_fill(0, chosen, True)
        wide = gaussians.scales.amax(-1) / self._distances(module) > self.wide
        cloned, split = pulled & ~wide, pulled & wide
        density.clone(gaussians, optimizer, cloned)
        split = torch.cat((split, split.new_zeros(len(gaussians) - len(split))))
        generator = torch.Generator().manual_seed(hash((self.seed, step)) % 2**63)
        density.split(gaussians, optimizer, split, generator)
        faint = gaussians.opacities < self.opacity
        if faint.any():
            density.prune(gaussians, optimizer, faint)
        self.steps = 0

    def _distances(self, module) -> torch.Tensor:
        gaussians = module.model.gaussians
        middle = torch.stack([receiver.pose.position for receiver in module.model.scene.receivers]).mean(0)
        return (gaussians.means.detach() - middle.to(gaussians.means)).norm(dim=-1)


class StopCleanly(Callback):
    """At the first Ctrl-C: finishes the step, writes the checkpoint, stops. At the second: stops at once.

    Args:
        path: Where the checkpoint goes.
    """

    def __init__(self, path: Path):
        self.path = path
        self.asked = False

    def on_fit_start(self, trainer, module) -> None:
        self.before = signal.getsignal(signal.SIGINT)
        signal.signal(signal.SIGINT, self._ask)

    def on_train_batch_end(self, trainer, module, *_) -> None:
        if self.asked:
            trainer.save_checkpoint(self.path)
            raise KeyboardInterrupt

    def on_fit_end(self, trainer, module) -> None:
        signal.signal(signal.SIGINT, self.before)

    def _ask(self, number, frame) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, self.before)
