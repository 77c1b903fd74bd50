"""Rows that a user chooses for training and test."""

import reprlib
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.core.query import as_tensor


def parts_of_rows(
    row: Int[Tensor, " m"], count: int, test_rows: Any, train_rows: Any
) -> tuple[Int[Tensor, " k"], Int[Tensor, " l"]]:
    """Training and test links, from the rows of each that the user gives.

    Args:
        row: Row of each link.
        count: Number of rows.
        test_rows: Rows to test on, as numbers or as a mask.
        train_rows: Rows to train on; None: all others.

    Raises:
        ValueError: Rows are in both parts, or no row is left to train on.
    """
    testing = _rows("test_rows", test_rows, count)
    everything = torch.arange(count)
    training = everything[~torch.isin(everything, testing)]
    if train_rows is not None:
        training = _rows("train_rows", train_rows, count)
    both = training[torch.isin(training, testing)]
    if len(both):
        raise ValueError(
            f"train_rows and test_rows must have no row in common, got {both[0].item()} in both"
        )
    if not len(training):
        raise ValueError(f"test_rows leave no row to train on, got all {count}")
    return torch.isin(row, training).nonzero()[:, 0], torch.isin(row, testing).nonzero()[:, 0]


def _rows(name: str, values: Any, count: int) -> Int[Tensor, " k"]:
    """Ascending numbers of rows, from numbers or from a mask of all ``count`` rows."""
    rows = as_tensor(name, values, "numbers of rows")
    if rows.dtype == torch.bool and rows.shape == (count,):
        rows = rows.nonzero()[:, 0]
    given = reprlib.repr(values)
    if rows.ndim != 1 or not len(rows) or not are_numbers(rows, count):
        raise ValueError(
            f"{name} must be numbers of rows from 0 to {count - 1}, or a mask of {count}, got "
            f"{given}"
        )
    numbers = rows.long()
    if len(numbers.unique()) < len(numbers):
        raise ValueError(
            f"{name} must hold each row once, got {given}; a mask must be boolean, of True and "
            "False"
        )
    return numbers.sort().values


def are_numbers(values: Tensor, count: int) -> bool:
    """True for whole numbers from 0 to ``count`` - 1."""
    is_whole = not (values.is_floating_point() or values.is_complex() or values.dtype == torch.bool)
    return is_whole and bool(((values >= 0) & (values < count)).all())
