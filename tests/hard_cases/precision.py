"""Configured components, and checks of float32 against float64, for the hard cases."""

import copy
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import nn

from gaigs.core.query import Query
from gaigs.registry import registry

sys.path.append(str(Path(__file__).parents[1]))
import test_contracts

TOLERANCE = 1e-3
"""Between float32 and float64, of the largest value or of 1."""

TASKS = ("spectrum", "rssi", "csi")
DTYPES = (torch.float32, torch.float64)


def build(kind, name, *overrides, **context):
    torch.manual_seed(0)
    return registry(kind).build(test_contracts.configured(kind, name, *overrides), **context)


def build_rasterizer(name):
    """A rasterizer; None where it cannot work here."""
    try:
        return registry("rasterizer").build({"name": name})
    except (ImportError, RuntimeError) as error:
        if not any(
            words in str(error)
            for words in ("needs an OpenCL driver", "cannot build kernels", "pyopencl")
        ):
            raise
        return None


def widen(part, dtype):
    """Tensors, queries, modules and tuples in another precision."""
    if isinstance(part, torch.Tensor) and (part.is_floating_point() or part.is_complex()):
        return part.to(dtype.to_complex() if part.is_complex() else dtype)
    if isinstance(part, Query):
        return replace(part, transmitters=widen(part.transmitters, dtype))
    if isinstance(part, nn.Module):
        # Module.to would take complex buffers for real ones.
        return (nn.Module.double if dtype == torch.float64 else nn.Module.float)(
            copy.deepcopy(part).eval()
        )
    if isinstance(part, tuple):
        moved = [widen(entry, dtype) for entry in part]
        return type(part)(*moved) if hasattr(part, "_fields") else tuple(moved)
    return part


def flat(values):
    if isinstance(values, tuple | list):
        return [tensor for value in values for tensor in flat(value)]
    return [values]


def require_same(ask, module, *leaves, tolerance=TOLERANCE, within=None):
    """Values of ``ask(module, *leaves)`` in float64: float32's are the same, all are finite,
    gradients too.

    Values may differ by ``tolerance`` of the largest value of a tensor or of 1, or by ``within`` if
    that is more.
    """
    answers = []
    for dtype in DTYPES:
        part, own = (
            widen(module, dtype),
            [widen(leaf.detach(), dtype).requires_grad_() for leaf in leaves],
        )
        answers.append(flat(ask(part, *own)))
        require_finite(answers[-1], [*own, *(() if part is None else part.parameters())])
    for one, two in zip(*answers, strict=True):
        assert (one is None) == (two is None)
        if one is None or not one.numel():
            continue
        if one.is_floating_point() or one.is_complex():
            assert (one.dtype, two.dtype) == (
                widen(one, DTYPES[0]).dtype,
                widen(one, DTYPES[1]).dtype,
            )
        largest = max(1.0, two.detach().abs().max().item())
        assert (one.to(two.dtype) - two).abs().max() <= max(tolerance * largest, within or 0)
    return answers[1]


def require_finite(values, leaves):
    """Requires finite values and finite gradients by the leaves."""
    values = [value for value in flat(values) if value is not None and value.numel()]
    assert all(value.isfinite().all() for value in values)
    real = [
        torch.view_as_real(value) if value.is_complex() else value
        for value in values
        if value.requires_grad
    ]
    if real:
        # A weight for each entry: sums of differences that cancel would hide gradients.
        weights = [torch.arange(value.numel()).cos().to(value).view_as(value) for value in real]
        sizes = [max(1.0, value.detach().abs().max().item()) * value.numel() for value in real]
        total = sum(
            (value * weight).sum() / size
            for value, weight, size in zip(real, weights, sizes, strict=True)
        )
        gradients = torch.autograd.grad(
            total, [leaf for leaf in leaves if leaf.requires_grad], allow_unused=True
        )
        assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)
