"""Optimizers, and their learning rates over a training."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType

import torch
from torch import nn
from torch.optim import Optimizer, lr_scheduler
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from gaigs.registry import call


def make_optimizer(
    config: Mapping, groups: Mapping[str, Sequence[nn.Parameter]], rates: Mapping[str, float]
) -> Optimizer:
    """An optimizer of ``torch.optim`` with a learning rate for each group.

    Args:
        config: ``_target_``, a class of ``torch.optim``, and its options. Weight decay acts on the
            group ``network`` only: positions, scales and opacities need not be small. On a CPU a
            step is fused by default if the class supports it.
        groups: Parameters by name.
        rates: Learning rate of each group.
    """
    kind, options = _target("training.optimizer", config, torch.optim, Optimizer)
    if "lr" in options:
        raise ValueError(
            "training.optimizer takes no lr, as each group has its own; set training.learning_rates"
        )
    parts = []
    parameters: list[nn.Parameter] = []
    for name, group in groups.items():
        parts.append({"params": [*group], "lr": rates[name], "name": name})
        parameters += group
    known = inspect.signature(kind).parameters.keys()
    implementations = {"fused", "foreach", "differentiable"} & known
    on_cpu = all(p.is_floating_point() and p.device.type == "cpu" for p in parameters)
    is_chosen = bool(implementations & options.keys())  # by the user
    # On a GPU ``fused`` stays None: True and False would switch off torch's own fast steps.
    if "fused" in implementations and on_cpu and not is_chosen:
        options["fused"] = True
    optimizer = call("training.optimizer", kind, options, params=parts)
    for group in optimizer.param_groups:
        if group["name"] != "network" and "weight_decay" in group:
            group["weight_decay"] = 0.0
    return optimizer


def make_schedule(
    config: Mapping, optimizer: Optimizer, share_done: Callable[[int], float]
) -> LRScheduler:
    """A schedule of all rates of an optimizer, with one call for each step.

    Args:
        config: Options of ``warmup_and_decay``; or ``_target_``, a class of
            ``torch.optim.lr_scheduler``, with the options of that class.
        optimizer: The optimizer.
        share_done: Fraction of the training that is done after a number of steps. Classes of torch
            count steps instead.
    """
    if "_target_" not in config:
        given = {"optimizer": optimizer, "share_done": share_done}
        return call("training.schedule", warmup_and_decay, config, **given)
    kind, options = _target("training.schedule", config, lr_scheduler, LRScheduler)
    return call("training.schedule", kind, options, optimizer=optimizer)


def warmup_and_decay(
    optimizer: Optimizer, share_done: Callable[[int], float], warmup: int, final: float
) -> LRScheduler:
    """A schedule of rates that rise linearly over ``warmup`` steps and decay exponentially.

    The final rate is the fraction ``final`` of the optimizer's rate.
    """
    if not 0 < final <= 1:
        raise ValueError(f"training.schedule.final must be in (0, 1], got {final}")
    if warmup < 0:
        raise ValueError(f"training.schedule.warmup must be at least 0 steps, got {warmup}")

    def factor(step: int) -> float:
        rise = min(1.0, (step + 1) / max(warmup, 1))
        decay = final ** share_done(step)
        return rise * decay

    return LambdaLR(optimizer, factor)


def _target(option: str, config: Mapping, module: ModuleType, base: type) -> tuple[type, dict]:
    """The class that ``_target_`` names, and the other options.

    Raises:
        ValueError: The class is not in ``module``, or has not the base class ``base``.
    """
    options = dict(config)
    target = str(options.pop("_target_", None))
    start = f"{module.__name__}."
    kind = getattr(module, target.removeprefix(start), None)
    is_inside = target.startswith(start)
    if is_inside and isinstance(kind, type) and issubclass(kind, base):
        return kind, options
    raise ValueError(f"{option}._target_ must be a class of {module.__name__}, got {target!r}")
