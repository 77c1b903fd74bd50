"""NetCDF files, classic format with 64-bit offsets, by SciPy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from scipy.io import netcdf_file

from gaigs.io.files import atomic_write


class Variable(NamedTuple):
    """A variable of a NetCDF file: real numbers or texts, with attributes by the CF conventions.

    ``dimensions`` names each axis of ``values``.
    """

    dimensions: tuple[str, ...]
    values: ndarray
    attributes: Mapping[str, Any] = {}


def write_netcdf(
    file: Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> None:
    """Writes variables by name. A variable with the name of its only dimension is a coordinate.

    Texts are stored as characters along a further dimension; xarray joins them.
    """
    with atomic_write(file) as part, netcdf_file(part, "w", version=2) as content:
        _describe(content, {"Conventions": "CF-1.11", **attributes})
        for name, (dimensions, values, about) in variables.items():
            if values.dtype.kind == "U":
                rows = [text.encode() for text in values.tolist()]
                longest = max(map(len, rows), default=0) or 1
                values = np.array(rows, f"S{longest}")[:, None].view("S1")  # (rows, longest)
                dimensions = (*dimensions, f"{name}_length")
                about = {"_Encoding": "utf-8", **about}
            for dimension, size in zip(dimensions, values.shape, strict=True):
                if dimension not in content.dimensions:
                    content.createDimension(dimension, size)
            variable = content.createVariable(name, values.dtype, dimensions)
            variable[...] = values
            _describe(variable, about)


def _describe(part: Any, attributes: Mapping[str, Any]) -> None:
    """Gives attributes to a file or a variable; texts as UTF-8."""
    for key, value in attributes.items():
        setattr(part, key, value.encode() if isinstance(value, str) else value)
