"""Search for the first quantity that is not finite in a diverged training step."""

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor, nn

from gaigs.core.query import Batch
from gaigs.model import Model


@torch.no_grad()
def find_broken(model: Model, batch: Batch, terms: Mapping[str, Tensor]) -> str:
    """The name of the first quantity in a step's loss that is not finite.

    The search order is: places, parameters, outputs of the model's parts (by hooks), the
    prediction, penalties, terms of the loss.
    """
    if not is_finite(batch.query.transmitters):
        return "the places as training.jitter moves them"
    for name, parameter in model.named_parameters():
        if not is_finite(parameter):
            return f"the parameter {name}"
    broken: list[str] = []

    def check_output(name: str, part: nn.Module, arguments: tuple, output: object) -> None:
        """A forward hook, which records parts in the order of their calls."""
        outputs = output if isinstance(output, tuple) else (output,)
        tensors = [value for value in outputs if isinstance(value, Tensor)]
        if not all(is_finite(tensor) for tensor in tensors):
            broken.append(f"the output of {name}")

    hooks = []
    for name, part in model.named_modules():
        if name:  # not the whole model
            hooks.append(part.register_forward_hook(partial(check_output, name)))
    try:
        value, penalties = model(batch)
    finally:
        for hook in hooks:
            hook.remove()
    results = {"the prediction": value}
    results |= {f"the penalty {name}": penalty for name, penalty in penalties.items()}
    results |= {f"the term {name}": term for name, term in terms.items()}
    broken += [name for name, tensor in results.items() if not is_finite(tensor)]
    return broken[0] if broken else "their sum"


def is_finite(values: Tensor) -> bool:
    """True if every element is finite."""
    return bool(values.isfinite().all())
