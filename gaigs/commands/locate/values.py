"""Received values in the forms that a user may give: tensors, mappings and files."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.commands.locate.fingerprints import Fingerprints
from gaigs.core.query import as_receivers, as_tensor
from gaigs.core.task import check_range
from gaigs.data import Links
from gaigs.data.rssi_wide.columns import refuse_cells
from gaigs.io.tables import find_file, read_table, shortened


def as_fingerprints(
    value: object, prints: Fingerprints, is_track: bool = False
) -> Float[Tensor, "n r m"]:
    """Fingerprints of the ``value`` of ``locate``; NaN where a receiver has received nothing.

    Args:
        is_track: True if all receivers may have missed a transmission.
    """
    if isinstance(value, Mapping):
        value = in_order(value, prints)
    values = as_values(value, prints)
    numbers = values.reshape(*values.shape[:2], -1)  # (n, r, m)
    is_missing = numbers.isnan().any(2)
    if values.is_complex():
        is_missing |= (numbers == 0).all(2)
    is_silent = is_missing.all(1)  # (n,)
    is_refused = is_silent.all() if is_track else is_silent.any()
    if is_refused:
        raise ValueError(
            f"value {int(is_silent.int().argmax())} was heard by no receiver; leave it out, "
            "or give step of a track"
        )
    if not numbers[~is_missing].isfinite().all():
        raise ValueError("value must be finite, or NaN where a receiver has not heard it")
    labels = values.flatten(0, 1)  # (n r, *shape)
    check_range(prints.task, labels, "value")
    numbers = prints.task.fingerprint(labels).unflatten(0, values.shape[:2])
    return numbers.masked_fill(is_missing[..., None], math.nan)


def in_order(value: Mapping, prints: Fingerprints) -> Tensor:
    """Labels in the order of the receivers, from labels by name; NaN for names that are missing."""
    if not value:
        raise ValueError("value must have the label of one receiver or more, got none")
    receivers = as_receivers([*value], prints.receivers)  # numbers of the named receivers
    expected = "a label, or as many labels, of each receiver"
    labels = as_tensor("value", [*value.values()], expected).detach().cpu()
    dtype = torch.promote_types(labels.dtype, torch.float32)
    ordered = torch.full((len(prints.receivers), *labels.shape[1:]), math.nan, dtype=dtype)
    ordered[receivers] = labels.to(dtype)
    # Several transmissions: from (r, n, *shape) to (n, r, *shape).
    is_several = labels.ndim == 2 + len(prints.task.shape)
    return ordered.transpose(0, 1) if is_several else ordered


def as_values(value: object, prints: Fingerprints) -> Tensor:
    """Labels of several transmissions (n, r, *shape); raises a ``ValueError`` for other shapes."""
    shape = tuple(prints.task.shape)
    count = len(prints.receivers)
    given = as_tensor("value", value, f"labels of {count} receivers").detach().cpu()
    is_complex = prints.task.dtype.is_complex
    if given.is_complex() != is_complex and not given.isnan().all():
        raise ValueError(f"value must have {'complex' if is_complex else 'real'} labels")
    values = given.to(prints.task.dtype)
    is_label = tuple(values.shape[values.ndim - len(shape) :]) == shape
    if count == 1 and is_label and values.ndim <= 1 + len(shape):
        values = values.reshape(-1, 1, *shape)  # the only receiver has no axis
    elif values.ndim == 1 + len(shape):
        values = values[None]  # a single transmission
    if values.ndim != 2 + len(shape) or values.shape[1:] != (count, *shape) or not len(values):
        need = f"{(count, *shape)} or {('n', count, *shape)}, a label of each receiver"
        raise ValueError(f"value must be {need}, got {tuple(given.shape)}")
    return values


def read_value(file: Path, links: Links) -> object:
    """The ``value`` of ``locate`` from a file.

    A ``.npy`` file gives its array (n, r, *shape). For scalar labels, a table with a column for
    each receiver gives its columns by name, with NaN for an empty cell.

    Args:
        links: Links of the model, whose task and receivers' names the file must have.
    """
    content = "received values" if links.task.is_scalar else "a .npy array of received values"
    file = find_file(file, content, "locate.value")
    if file.suffix.lower() == ".npy":
        try:
            return np.load(file, allow_pickle=False)
        except (ValueError, EOFError):
            raise ValueError(f"{file} must be {content}, and is no array of numbers") from None
    if not links.task.is_scalar:
        raise ValueError(
            f"locate.value must be a .npy array of labels of each receiver, got {file}"
        )
    table = read_table(file, "a heading with names of receivers, and one value a line")
    names = [receiver.name for receiver in links.receivers]
    if others := [name for name in table.names if name not in names]:
        raise ValueError(
            f"{file}, line 1: expected names of receivers, {shortened(names)}, "
            f"got {shortened(others)}"
        )
    # A table has infinity for a cell that is neither empty nor a number.
    columns = range(len(table.names))
    refuse_cells(table, columns, np.isinf(table.numbers), "a level [dBm], or an empty cell")
    return dict(zip(table.names, table.numbers.T, strict=True))
