"""What the checks share: rules, tolerances, tensors and gradients."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gaigs.scene import Scene

PRECISION = {torch.float32: 1e-4, torch.float64: 1e-9}
"""How far a result may be from the truth, of the largest true value."""


def require(holds: bool, rule: str) -> None:
    """Raises an ``AssertionError`` with the rule where it does not hold."""
    if not holds:
        raise AssertionError(rule)


def require_raises(error: type[Exception], call: Callable, rule: str) -> None:
    """Raises an ``AssertionError`` with the rule where a call does not raise an error of that type."""
    try:
        call()
    except error:
        return
    except Exception as other:
        raise AssertionError(rule) from other
    raise AssertionError(rule)


def require_close(actual: Tensor, expected: Tensor, tolerance: float, rule: str) -> None:
    """Equal to within a fraction of the largest expected value, or of 1 where that is smaller."""
    largest = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
    wide = torch.complex128 if expected.is_complex() else torch.float64
    torch.testing.assert_close(
        actual.to(wide), expected.to(wide), rtol=0, atol=tolerance * largest, msg=lambda detail: f"{rule}\n{detail}"
    )


def require_tensor(
    name: str, tensor: Tensor, shape: Sequence[int], dtype: torch.dtype, device: torch.device | str | None = None
) -> None:
    """Of that shape, dtype and kind of device, and finite."""
    require(tuple(tensor.shape) == tuple(shape), f"{name} must be of shape {tuple(shape)}, got {tuple(tensor.shape)}")
    require(tensor.dtype == dtype, f"{name} must be {dtype} as its input, got {tensor.dtype}")
    same = device is None or tensor.device.type == torch.device(device).type
    require(same, f"{name} must be on {device} as its input, got {tensor.device}")
    require(bool(tensor.isfinite().all()), f"{name} must be finite")


def require_gradients(outputs: Sequence[Tensor], leaves: dict[str, Tensor]) -> None:
    """All gradients of a fixed function of the outputs exist where they can, and are finite."""
    outputs = [output for output in outputs if output.requires_grad and output.numel()]
    if not outputs:
        return
    total = sum(map(fixed_sum, outputs))
    gradients = torch.autograd.grad(total, [*leaves.values()], allow_unused=True, retain_graph=True)
    for name, gradient in zip(leaves, gradients, strict=True):
        require(gradient is None or bool(gradient.isfinite().all()), f"the gradient of {name} must be finite")


def fixed_sum(values: Tensor) -> Tensor:
    """A real sum with weights that differ but are always the same, so that no two gradients cancel."""
    if values.is_complex():
        values = torch.view_as_real(values.resolve_conj())
    weights = torch.arange(values.numel(), device=values.device).cos().to(values)
    return (values.flatten() * weights).sum()


def random_labels(shape: Sequence[int], dtype: torch.dtype, generator: torch.Generator) -> Tensor:
    """Uniform in [0, 1], in both parts where they are complex: labels that suit every task."""
    if dtype.is_complex:
        return torch.view_as_complex(torch.rand(*shape, 2, generator=generator)).to(dtype)
    return torch.rand(*shape, generator=generator).to(dtype)


def random_places(scene: Scene, count: int, generator: torch.Generator) -> Tensor:
    """Uniform in the box of the training transmitters (count, 3) [m]."""
    return torch.lerp(scene.lower, scene.upper, torch.rand(count, 3, generator=generator))


def random_frequencies(scene: Scene, count: int) -> Tensor | None:
    """The carriers of a scene that has some, over and over (count,) [Hz]; None for one that has none."""
    if not len(scene.frequencies):
        return None
    return scene.frequencies[torch.arange(count) % len(scene.frequencies)]


def flat(state: object) -> list:
    """Tensors and all else in nested lists and dicts, one after another, comparable."""
    if isinstance(state, Tensor):
        return [str(state.dtype), state.tolist()]
    if isinstance(state, dict):
        return [x for key, part in state.items() for x in (key, *flat(part))]
    if isinstance(state, list | tuple):
        return [x for part in state for x in flat(part)]
    return [state]
