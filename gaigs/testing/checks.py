"""Rules, tolerances, tensors, gradients and random inputs, shared by the checks."""

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


def require_refusal(call: Callable[[], object], rule: str) -> None:
    """Raises an ``AssertionError`` with the rule unless a call raises a ``ValueError``, or a type
    checker's error.
    """
    try:
        call()
    except (ValueError, TypeError):
        return
    except Exception as other:
        raise AssertionError(rule) from other
    raise AssertionError(rule)


def require_close(actual: Tensor, expected: Tensor, tolerance: float, rule: str) -> None:
    """Requires equality to within a fraction of the largest expected value, at least 1."""
    largest = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
    wide = torch.complex128 if expected.is_complex() else torch.float64
    torch.testing.assert_close(
        actual.to(wide),
        expected.to(wide),
        rtol=0,
        atol=tolerance * largest,
        msg=lambda detail: f"{rule}\n{detail}",
    )


def require_same(actual: Tensor, expected: Tensor, rule: str) -> None:
    """Requires equality; but for rounding on a GPU, which adds in any order."""
    if actual.device.type == "cpu" or not (actual.is_floating_point() or actual.is_complex()):
        require(torch.equal(actual, expected), rule)
    else:
        least = (
            1e3
            * torch.finfo(actual.dtype).eps
            * (expected.abs().max().item() if expected.numel() else 0.0)
        )
        torch.testing.assert_close(
            actual, expected, rtol=0, atol=least, msg=lambda detail: f"{rule}\n{detail}"
        )


def require_tensor(
    name: str,
    tensor: Tensor,
    shape: Sequence[int],
    dtype: torch.dtype,
    device: torch.device | str | None = None,
) -> None:
    """Requires a finite tensor of that shape, dtype and type of device."""
    require(
        tuple(tensor.shape) == tuple(shape),
        f"{name} must be of shape {tuple(shape)}, got {tuple(tensor.shape)}",
    )
    require(tensor.dtype == dtype, f"{name} must be {dtype} as its input, got {tensor.dtype}")
    same = device is None or tensor.device.type == torch.device(device).type
    require(same, f"{name} must be on {device} as its input, got {tensor.device}")
    require(tensor.isfinite().all(), f"{name} must be finite")


def require_independence(
    result: Any, again: Any, alone: Any, per_query: Collection[str], tolerance: float
) -> None:
    """Requires named tuples of two calls to be the same, and one of the last query alone to equal
    the last row.
    """
    for name, whole, twice, single in zip(result._fields, result, again, alone, strict=True):
        if whole is None:
            require(
                twice is None and single is None,
                f"{name} must be given for all queries or for none",
            )
            continue
        require_same(whole, twice, f"two calls must give the same {name}")
        own = whole[-1:] if name in per_query else whole
        require_close(single, own, tolerance, f"{name} must not depend on the other queries")


def require_gradients(outputs: Iterable[Tensor | None], leaves: Mapping[str, Tensor]) -> None:
    """Requires finite gradients of a fixed function of the outputs; a leaf that has no influence
    needs none.
    """
    given = [
        output
        for output in outputs
        if output is not None and output.requires_grad and output.numel()
    ]
    if not given or not leaves:
        return
    gradients = torch.autograd.grad(
        sum(map(fixed_sum, given)), [*leaves.values()], allow_unused=True, retain_graph=True
    )
    for name, gradient in zip(leaves, gradients, strict=True):
        require(
            gradient is None or gradient.isfinite().all(), f"the gradient of {name} must be finite"
        )


def require_groups(groups: Mapping[str, Iterable[nn.Parameter]], module: nn.Module) -> None:
    """Requires that each parameter of a module is in exactly one group."""
    grouped = [id(parameter) for group in groups.values() for parameter in group]
    rule = "each parameter must be in one of parameter_groups"
    require(sorted(grouped) == sorted(map(id, module.parameters())), rule)


def fixed_sum(values: Tensor) -> Tensor:
    """A real sum with fixed, different weights, so that no two gradients cancel."""
    if values.is_complex():
        values = torch.view_as_real(values.resolve_conj())
    weights = torch.arange(values.numel(), dtype=torch.float64).cos().to(values)
    return (values.flatten() * weights).sum()


def random_places(scene: Scene, count: int, generator: torch.Generator) -> Tensor:
    """Uniform in the box of the training transmitters (count, 3) [m]."""
    return torch.lerp(scene.lower, scene.upper, torch.rand(count, 3, generator=generator))


def random_query(
    scene: Scene,
    count: int,
    generator: torch.Generator,
    dtype: torch.dtype,
    device: torch.device | str,
) -> Query:
    """Links from random places to the receivers in turn, at the scene's carriers in turn where
    there are any.
    """
    number = torch.arange(count)
    frequencies = (
        scene.frequencies[number % len(scene.frequencies)] if len(scene.frequencies) else None
    )
    places = random_places(scene, count, generator).to(dtype)
    return Query(places, number % len(scene.receivers), frequencies).to(device)


def flat(state: object) -> list:
    """The content of nested lists and dicts as one list that can be compared."""
    if isinstance(state, Tensor):
        return [str(state.dtype), state.tolist()]
    if isinstance(state, dict):
        return [x for key, part in state.items() for x in (key, *flat(part))]
    if isinstance(state, list | tuple):
        return [x for part in state for x in flat(part)]
    return [state]
