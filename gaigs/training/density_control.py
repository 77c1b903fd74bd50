"""Density control: Gaussians are pruned, cloned and split during training."""

import torch
from lightning.pytorch.callbacks import Callback

from gaigs.splatting import density
from gaigs.training import seeded


class DensityControl(Callback):
    """Prunes, clones and splits Gaussians on a schedule.

    The pull at a Gaussian is the mean gradient of the loss by its position since the last round,
    times its distance from the receivers' middle. If the pull exceeds ``gradient``, a wide Gaussian
    is split and a narrow one is cloned.

    Args:
        every: Steps between two rounds.
        start, stop: First and last step of a round.
        gradient: Bound on the pull [loss/rad].
        split_angle: Largest standard deviation over distance of a narrow Gaussian [rad].
        opacity: Opacity below which Gaussians are pruned.
        max_count: Largest number of Gaussians.
        seed: Seed of the random positions after a split.

    Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2; thresholds in docs/methods.md.
    """

    def __init__(
        self,
        every: int,
        start: int,
        stop: int,
        gradient: float,
        split_angle: float,
        opacity: float,
        max_count: int,
        seed: int,
    ):
        for option, value, least in (
            ("every", every, 1),
            ("start", start, 0),
            ("stop", stop, start),
            ("gradient", gradient, 0),
            ("split_angle", split_angle, 0),
            ("max_count", max_count, 1),
        ):
            if not value >= least:
                raise ValueError(f"density.{option} must be at least {least}, got {value}")
        if not 0 <= opacity < 1:
            raise ValueError(f"density.opacity must be in [0, 1), got {opacity}")
        self.every = every
        self.start = start
        self.stop = stop
        self.gradient = gradient
        self.split_angle = split_angle
        self.opacity = opacity
        self.max_count = max_count
        self.seed = seed
        self.pull = torch.zeros(0)
        self.steps = 0

    def state_dict(self) -> dict:
        return {"pull": self.pull, "steps": self.steps}

    def load_state_dict(self, state: dict) -> None:
        self.pull = state["pull"]
        self.steps = state["steps"]

    def on_fit_start(self, trainer, module) -> None:
        if module.model.primitives is None:
            raise ValueError(
                "density needs a model with Gaussians, and this one has none; leave density out"
            )

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        gaussians = module.model.primitives
        if not gaussians.means.requires_grad:
            return
        pull = gaussians.means.grad.norm(dim=-1) * self._distances(module)  # (n,)
        self.pull = pull if self.steps == 0 else self.pull.to(pull) + pull
        self.steps += 1

    @torch.no_grad()
    def on_train_batch_end(self, trainer, module, *_) -> None:
        gaussians = module.model.primitives
        follower = getattr(module.model, "deformation", None)  # may have a row for each Gaussian
        optimizer = trainer.optimizers[0]
        step = trainer.global_step
        is_due = step % self.every == 0 and self.start <= step <= self.stop
        if not is_due or not gaussians.means.requires_grad:
            return
        is_pulled = self.pull / self.steps > self.gradient  # (n,)
        most_new = max(0, self.max_count - len(gaussians))
        if int(is_pulled.sum()) > most_new:  # only the strongest pulls fit
            strongest = torch.topk(torch.where(is_pulled, self.pull, -1), most_new).indices
            is_pulled = torch.zeros_like(is_pulled).index_fill(0, strongest, True)
        # A narrow Gaussian covers too little and is cloned, a wide one too much and is split (Kerbl
        # et al., 2023).
        is_wide = gaussians.scales.amax(-1) / self._distances(module) > self.split_angle  # (n,)
        is_split = is_pulled & is_wide
        density.clone(gaussians, optimizer, is_pulled & ~is_wide, follower)
        # Clones are appended, and are not split.
        is_split = torch.cat((is_split, is_split.new_zeros(len(gaussians) - len(is_split))))
        density.split(gaussians, optimizer, is_split, seeded(self.seed, step), follower)
        is_faint = gaussians.opacities < self.opacity
        if is_faint.any():
            density.prune(gaussians, optimizer, is_faint, follower)
        self.steps = 0
        if trainer.world_size > 1:
            # All processes have the same Gaussians, but Lightning's wrapper still holds the
            # replaced parameters.
            trainer.strategy.model = trainer.strategy._setup_model(module)

    def _distances(self, module) -> torch.Tensor:
        """Distances of Gaussians to the receivers' middle [m]."""
        gaussians = module.model.primitives
        middle = module.model.scene.positions(gaussians.means).mean(0)
        return (gaussians.means.detach() - middle).norm(dim=-1)
