"""Rules, tolerances, gradients and random inputs, shared by the checks."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.core.scene import Scene

PRECISION = {torch.float32: 1e-4, torch.float64: 1e-9}
"""Largest error of a result, relative to the largest true value."""


def require(holds: object, rule: str) -> None:
    """Raises an ``AssertionError`` with the rule unless it holds."""
    if not holds:
        raise AssertionError(rule)


def require_empty(got: Sequence[int], shapes: Collection[Sequence[int]], rule: str) -> None:
    """Requires that the shape ``got`` of a result for no links is one of ``shapes``."""
    remedy = "with b = 0, flatten(1) works and reshape(b, -1) does not"
    require(tuple(got) in shapes, f"{rule}, got {tuple(got)}; {remedy}")


def require_refusal(call: Callable[[], object], rule: str) -> None:
    """Requires that a call raises a ``ValueError``, or a ``TypeError`` as type checkers do."""
    try:
        call()
    except (ValueError, TypeError):
        return
    except Exception as other:
        raise AssertionError(rule) from other
    raise AssertionError(rule)


def require_close(actual: Tensor, expected: Tensor, tolerance: float, rule: str) -> None:
    """Requires errors of at most ``tolerance`` times the largest expected magnitude, or times 1.

    ``rule`` is the message of the error.
    """
    largest = max(1.0, _largest(expected))
    wide = torch.complex128 if expected.is_complex() else torch.float64
    _require_within(actual.to(wide), expected.to(wide), tolerance * largest, rule)


def require_same(actual: Tensor, expected: Tensor, rule: str) -> None:
    """Requires equal tensors; on a GPU equal up to rounding, as the order of its sums varies."""
    rounds = actual.is_floating_point() or actual.is_complex()
    if actual.device.type == "cpu" or not rounds:
        require(torch.equal(actual, expected), rule)
    else:
        rounding = 1e3 * torch.finfo(actual.dtype).eps * _largest(expected)
        _require_within(actual, expected, rounding, rule)


def _largest(values: Tensor) -> float:
    """Largest magnitude; 0 for an empty tensor."""
    return values.abs().max().item() if values.numel() else 0.0


def _require_within(actual: Tensor, expected: Tensor, most: float, rule: str) -> None:
    """Requires errors of at most ``most``; the message has the rule and the largest error."""

    def explain(detail: str) -> str:
        return f"{rule}\n{detail}"

    torch.testing.assert_close(actual, expected, rtol=0, atol=most, msg=explain)


def require_tensor(
    name: str,
    tensor: Tensor,
    shape: Sequence[int],
    dtype: torch.dtype,
    device: torch.device | str | None = None,
) -> None:
    """Requires a finite tensor of this shape, dtype and type of device."""
    expected = tuple(shape)
    got = tuple(tensor.shape)
    require(expected == got, f"{name} must be of shape {expected}, got {got}")
    rule = f"{name} must be {dtype}, got {tensor.dtype}; convert it by .to({dtype})"
    require(tensor.dtype == dtype, rule)
    stays = device is None or tensor.device.type == torch.device(device).type
    rule = f"{name} must be on {device} as its input, got {tensor.device}"
    require(stays, f"{rule}; keep constants by register_buffer")
    require(tensor.isfinite().all(), f"{name} must be finite; clamp before log and division")


def require_independence(
    result: Any, again: Any, alone: Any, per_query: Collection[str], tolerance: float
) -> None:
    """Requires that a call is repeatable, and that queries do not influence each other.

    Args:
        result, again: Named tuples of two equal calls.
        alone: Named tuple of a call with the last query only.
        per_query: Fields that may have a row for each query.
        tolerance: As for ``require_close``.
    """
    for name, first, second, last in zip(result._fields, result, again, alone, strict=True):
        if first is None:
            missing = second is None and last is None
            require(missing, f"{name} must be given for all queries or for none")
            continue
        rule = f"two calls must give the same {name}; draw random numbers in the constructor"
        require_same(first, second, rule)
        row = first[-1:] if name in per_query else first
        rule = f"{name} must not depend on the other queries; sum over no axis of queries"
        require_close(last, row, tolerance, rule)


def require_gradients(outputs: Iterable[Tensor | None], leaves: Mapping[str, Tensor]) -> None:
    """Requires finite gradients of the outputs with respect to the leaves, given by name.

    A leaf without effect on any output needs no gradient.
    """
    sums = []
    for output in outputs:
        if output is not None and output.requires_grad and output.numel():
            sums.append(fixed_sum(output))
    if not sums or not leaves:
        return
    gradients = torch.autograd.grad(
        sum(sums), [*leaves.values()], allow_unused=True, retain_graph=True
    )
    for name, gradient in zip(leaves, gradients, strict=True):
        is_finite = gradient is None or gradient.isfinite().all()
        rule = f"the gradient of {name} must be finite; clamp before log, sqrt and division"
        require(is_finite, rule)


def require_groups(groups: Mapping[str, Iterable[nn.Parameter]], module: nn.Module) -> None:
    """Requires each parameter of a module in exactly one group."""
    grouped: list[int] = []
    for group in groups.values():
        grouped += map(id, group)
    rule = "each parameter must be in one of parameter_groups; add those that are missing"
    require(sorted(grouped) == sorted(map(id, module.parameters())), rule)


def fixed_sum(values: Tensor) -> Tensor:
    """A real weighted sum with distinct weights, so that no two gradients cancel."""
    if values.is_complex():
        values = torch.view_as_real(values.resolve_conj())
    weights = torch.arange(values.numel(), dtype=torch.float64).cos().to(values)
    return (values.flatten() * weights).sum()


def random_places(scene: Scene, count: int, generator: torch.Generator) -> Tensor:
    """Places uniform in the box of the training transmitters (count, 3) [m]."""
    return torch.lerp(scene.lower, scene.upper, torch.rand(count, 3, generator=generator))


def random_query(
    scene: Scene,
    count: int,
    generator: torch.Generator,
    dtype: torch.dtype,
    device: torch.device | str,
) -> Query:
    """Links from random places; receivers and the scene's carriers alternate."""
    number = torch.arange(count)
    frequencies = None
    if len(scene.frequencies):
        frequencies = scene.frequencies[number % len(scene.frequencies)]
    places = random_places(scene, count, generator).to(dtype)
    return Query(places, number % len(scene.receivers), frequencies).to(device)


def flat(state: object) -> list:
    """The content of nested lists and dictionaries as one list that can be compared."""
    if isinstance(state, Tensor):
        return [str(state.dtype), state.tolist()]
    if isinstance(state, dict):
        state = [*state.items()]
    if not isinstance(state, list | tuple):
        return [state]
    content = []
    for part in state:
        content += flat(part)
    return content
