"""The check of kind ``training``."""

import math
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Model
from gaigs.model.checkpoint import KEY
from gaigs.processes import stopping
from gaigs.testing.checks import flat, require, require_close, require_refusal
from gaigs.training.batches import Batches, InOrder
from gaigs.training.checkpoints import KeepLast, save

STEPS, STOP = 6, 3
"""Steps of a training and of an interrupted one; every second step validates."""


def check_training(
    build: Callable[..., lightning.LightningModule],
    build_model: Callable[[Scene], Model],
    links: Links,
    device: torch.device | str = "cpu",
) -> None:
    """Checks a training: one step a batch, validation, results that follow from the seed, bit-exact
    resume.

    The contract is that of ``gaigs.training.descent.Descent``.

    Args:
        build: Makes the training, given ``model``, ``loss``, ``identity`` and ``seed`` by name, as
            ``functools.partial(registry("training").build, config)`` does; all learning rates are
            positive.
        build_model: Makes a model for a scene.
        links: Links with a split that validates.
    """
    identity = {"who": "the check", "numbers": torch.arange(3)}

    def loss(values, batch):
        error = (values - batch.labels).abs().square().mean()
        return error, {"squared": error}

    def make(**changes) -> Any:
        torch.manual_seed(0)
        model = build_model(links.scene)
        model.fit(links)
        for name, value in changes.items():
            setattr(model, name, value)
        return build(model=model, loss=loss, identity=identity, seed=0)

    module = make()
    require(
        isinstance(module, lightning.LightningModule),
        f"a training must be a LightningModule, got {type(module)}",
    )
    require(isinstance(module.model, Model), "the training's model must be its attribute model")
    require(
        module.task.name == links.task.name, "the training's task must be that of its model's scene"
    )
    size, patience, density = module.batch_size, module.patience, module.density
    require(
        isinstance(size, int) and size >= 1, f"batch_size must be a number of places, got {size!r}"
    )
    counts = patience is None or (isinstance(patience, int) and patience >= 1)
    require(counts, f"patience must be a number of validations or None, got {patience!r}")
    require(
        density is None or isinstance(density, Mapping),
        f"density must be options or None, got {density!r}",
    )
    content: dict = {}
    module.on_save_checkpoint(content)
    require(
        flat(content.get(KEY)) == flat(identity),
        f"a checkpoint must hold the identity as its entry {KEY!r}",
    )
    other = f"none but {module.model.trained_by}"
    require_refusal(
        lambda: make(trained_by=other), "a model of another training must be a ValueError"
    )
    before = _copy(module.model)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        whole = _train(module, links, folder, device)
        require(
            whole.steps == list(range(1, STEPS + 1)),
            f"{STEPS} batches must be as many steps, got {whole.steps}",
        )
        finite = all(map(math.isfinite, whole.losses))
        require(
            finite, f"each step must return its loss, for the progress line, got {whole.losses}"
        )
        after, names = (
            whole.states[-1],
            {id(parameter): name for name, parameter in module.model.named_parameters()},
        )
        for group, parameters in module.model.parameter_groups().items():
            own = [names[id(parameter)] for parameter in parameters if parameter.requires_grad]
            changed = any(not torch.equal(after[name], before[name]) for name in own)
            require(changed, f"the parameters of group {group} must change in training")
        _check_validation(module.model, links, whole.metrics)
        again = _train(make(), links, folder, device)
        _compare(again.states, whole.states, "the same seed must give the same training")
        unlike = make()
        torch.manual_seed(1)  # another process starts from another state
        rest = _train(unlike, links, folder, device, resume=folder / f"{STOP}.ckpt")
    require(
        rest.steps == whole.steps[STOP:],
        f"a resumed training must start where it stopped, got steps {rest.steps}",
    )
    _compare(rest.states, whole.states[STOP:], "a resumed training must equal an uninterrupted one")


@dataclass(eq=False)
class _Course(Callback):
    """Keeps the model and the loss of every step; writes a checkpoint after step ``STOP``."""

    folder: Path
    steps: list[int] = field(default_factory=list)
    states: list[dict[str, Tensor]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    metrics: dict[str, float] = field(default_factory=dict)

    def on_train_batch_end(self, trainer, module, outputs, *_) -> None:
        self.steps.append(trainer.global_step)
        self.states.append(_copy(module.model))
        self.losses.append(math.nan if outputs is None else float(outputs["loss"]))
        if trainer.global_step == STOP:
            save(trainer, self.folder / f"{STOP}.ckpt")

    def on_train_end(self, trainer, module) -> None:
        self.metrics = {name: value.item() for name, value in trainer.callback_metrics.items()}


def _train(module, links: Links, folder: Path, device, resume: Path | None = None) -> _Course:
    course = _Course(folder)
    with stopping(), warnings.catch_warnings():
        for message in (
            ".*LeafSpec",
            ".*does not have many workers",
            "GPU available but not used",
        ):  # Lightning's
            warnings.filterwarnings("ignore", message)
        trainer = lightning.Trainer(
            accelerator="gpu" if torch.device(device).type == "cuda" else "cpu", devices=1, max_epochs=-1,
            max_steps=STEPS, val_check_interval=2, check_val_every_n_epoch=None, num_sanity_val_steps=0,
            log_every_n_steps=1, logger=False, enable_progress_bar=False, enable_model_summary=False,
            callbacks=[course, KeepLast(folder / "last.ckpt", math.inf)], default_root_dir=folder,
        )  # fmt: skip
        batches = Batches(links, links.split.train, module.batch_size, 0, STEPS)
        validation = InOrder(links, links.split.validation, module.batch_size)
        trainer.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    return course


def _check_validation(model: Model, links: Links, metrics: Mapping[str, float]) -> None:
    batch = links.batch(links.split.validation)
    device = next(model.parameters()).device
    values = model.eval().evaluate(batch.to(device)).cpu()
    scores = links.task.scores(batch.labels, values)
    for name, expected in links.task.logged(
        {name: score.mean().item() for name, score in scores.items()}
    ).items():
        logged = metrics.get(f"validation/{name}")
        require(
            logged is not None,
            f"a validation must log validation/{name}, got {', '.join(metrics) or 'nothing'}",
        )
        rule = f"validation/{name} must be the mean score of the validation links"
        require_close(torch.tensor(logged), torch.tensor(expected), 1e-4, rule)


def _compare(states: list[dict[str, Tensor]], expected: list[dict[str, Tensor]], rule: str) -> None:
    require(len(states) == len(expected), f"{rule}, got {len(states)} steps for {len(expected)}")
    for a, b in zip(states, expected, strict=True):
        for name, tensor in b.items():
            require_close(a[name], tensor, 1e-6, f"{rule}; {name} differs")


def _copy(model: Model) -> dict[str, Tensor]:
    return {name: tensor.detach().cpu().clone() for name, tensor in model.state_dict().items()}
