"""The part of a training step that is not finite."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from gaigs.model import Model
from gaigs.query import Batch


@torch.no_grad()
def find_broken(model: Model, batch: Batch, terms: Mapping[str, Tensor]) -> str:
    """Names the first quantity of a step's loss that is not finite.

    It calls the model once more, with a hook at each part.

    Args:
        model: As it was in the step.
        batch: Batch of the step, with finite labels.
        terms: Terms of the loss, by name.

    Returns:
        The places, a parameter, the output of a part, the prediction, a penalty, or a term of the loss.
    """
    if not is_finite(batch.query.transmitters):
        return "the places as training.jitter moves them"
    for name, parameter in model.named_parameters():
        if not is_finite(parameter):
            return f"the parameter {name}"
    found = []

    def look(name: str):
        def hook(part, arguments, output) -> None:
            found.extend(f"{field} of {name}" for field, tensor in _tensors(output) if not is_finite(tensor))

        return hook

    hooks = [part.register_forward_hook(look(name)) for name, part in model.named_modules() if name]
    try:
        value, penalties = model(batch)
    finally:
        for hook in hooks:
            hook.remove()
    rest = {"the prediction": value}
    rest |= {f"the penalty {name}": penalty for name, penalty in penalties.items()}
    rest |= {f"the term {name}": term for name, term in terms.items()}
    found += [name for name, tensor in rest.items() if not is_finite(tensor)]
    return (found or ["their sum"])[0]


def is_finite(values: Tensor) -> bool:
    """True if every element is finite."""
    return bool(values.isfinite().all())


def _tensors(output: object) -> Iterator[tuple[str, Tensor]]:
    """The tensors in a part's output, each with a name."""
    if isinstance(output, Tensor):
        yield "the output", output
    elif isinstance(output, tuple):
        names = getattr(output, "_fields", [f"output {number}" for number in range(len(output))])
        yield from ((name, part) for name, part in zip(names, output, strict=True) if isinstance(part, Tensor))
