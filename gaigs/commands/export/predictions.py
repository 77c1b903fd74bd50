"""Files of predictions of any task: CSV and NetCDF."""

import itertools
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gaigs.calibration import Estimate
from gaigs.core.antenna import lacking
from gaigs.core.query import Query, as_positions
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.data.matching import check_fit
from gaigs.io import tables
from gaigs.io.netcdf import Variable, write_netcdf
from gaigs.model import Model

log = logging.getLogger(__name__)

LINK = "x", "y", "z", "easting", "northing", "receiver", "frequency"
"""Columns of a link."""


def write_predictions(
    model: Model, file: Path, places: object, frequency: float | None = None, interval: float = 0.9
) -> list[Path]:
    """Writes predictions with their deviations and intervals, ``.csv`` or ``.nc``.

    Args:
        places: Positions (n, 3) [m], from which each receiver hears; a query; or links, whose test
            is predicted and written beside its labels.
        frequency: Carrier of positions [Hz]; None: the only known one.
        interval: Probability with which an interval holds the label. A model without intervals
            gives values alone.

    Raises:
        ValueError: There is no place, or a place, frequency or probability is impossible.
    """
    scene, labels, subcarriers = model.scene, None, None
    asked: Any = places
    query = query_of("predictions", scene, places, frequency)
    if isinstance(places, Links):
        asked = places.held_out or places
        subcarriers = None if places.held_out is None else asked.task.frequencies
        labels = asked.labels[places.split.test]
    if not 0 < interval < 1:
        raise ValueError(
            f"interval must be a probability between 0 and 1 such as 0.9, got {interval!r}"
        )
    if subcarriers is None and model.calibration is not None and model.calibration.gives(interval):
        found = model.predict(query, interval=interval)
    else:
        log.warning("%s has values alone: the model has no intervals of %g here", file, interval)
        found = Estimate(model.predict(query, frequencies=subcarriers), None, None, None)  # type: ignore[arg-type]
    task = asked.task if subcarriers is not None else scene.task
    absent = torch.tensor(False).expand(len(query), *task.shape)
    if task.is_channel:  # elements that a receiver's array lacks
        absent = lacking(scene.receivers, query.receivers.cpu(), task.elements)[
            ..., None
        ].expand_as(absent)
        blank = lambda part: (
            part if part is None or part.ndim < 3 else part.cpu().masked_fill(absent, math.nan)
        )
        found, labels = Estimate(*map(blank, found)), blank(labels)
    variables = tabulate(query, scene, task, found, labels)
    if scene.frame is not None:
        log.info("easting and northing are those of EPSG:%d", scene.frame.epsg)
    if file.suffix.lower() == ".csv":
        write_csv(file, variables, absent.numpy())
        return [file]
    about = {"title": f"{task.quantity} predicted by gaigs", "interval": interval}
    if scene.frame is not None:
        about |= {
            "frame_epsg": scene.frame.epsg,
            "frame_x": scene.frame.x,
            "frame_y": scene.frame.y,
        }
    write_netcdf(file, variables, about)
    return [file]


def query_of(kind: str, scene: Scene, places: object, frequency: float | None) -> Query:
    """The links of ``places``, one or more, as for ``write_predictions``; ``kind`` names the file
    in errors.
    """
    if places is None:
        raise ValueError(f"{kind} take places: positions [m], a query, or links with a test")
    if isinstance(places, Links):
        check_fit(places, scene)
        query = places.query[places.split.test]
    elif isinstance(places, Query):
        query = places
    else:
        points, names = (
            as_positions("places", places),
            [receiver.name for receiver in scene.receivers],
        )
        query, _ = Query.from_positions(points, None, frequency, names, scene.frequencies)
    if not len(query):
        raise ValueError(f"{kind} take one place or more; give positions [m], or links with a test")
    return query


def tabulate(
    query: Query, scene: Scene, task: Task, found: Estimate, labels: Tensor | None
) -> dict[str, Variable]:
    """Columns of links, axes of labels, and values by links and axes; complex values as real and
    imaginary part.
    """
    places, metres = query.transmitters.cpu().double().numpy(), {"units": "m"}
    variables = {axis: Variable(("link",), places[:, k], metres) for k, axis in enumerate("xyz")}
    if scene.frame is not None:
        about = metres | {"long_name": f"of EPSG:{scene.frame.epsg}"}
        variables["easting"] = Variable(("link",), scene.frame.x + places[:, 0], about)
        variables["northing"] = Variable(("link",), scene.frame.y + places[:, 1], about)
    names = np.array([receiver.name for receiver in scene.receivers])
    variables["receiver"] = Variable(("link",), names[query.receivers.cpu().numpy()])
    if query.frequencies is not None:
        carriers = query.frequencies.cpu().double().numpy()
        variables["frequency"] = Variable(
            ("link",), carriers, {"units": "Hz", "standard_name": "radiation_frequency"}
        )
    axes = axes_of(task)
    variables |= axes
    parts = {
        "value": found.value,
        "deviation": found.std,
        "lower": found.lower,
        "upper": found.upper,
    }
    parts |= {"radius": found.radius, "measured": labels}
    for name, part in parts.items():
        if part is None:
            continue
        part, unit = (
            part.detach().cpu(),
            {"units": task.unit or "1", "long_name": f"{task.quantity}: {name}"},
        )
        if name in ("deviation", "radius"):
            unit["units"] = task.error_unit or "1"
        of_link = part.reshape(len(part), *[1] * (len(task.shape) + 1 - part.ndim), *part.shape[1:])
        ends = {"_real": "real", "_imag": "imag"} if part.is_complex() else {"": "real"}
        for ending, side in ends.items():
            values = getattr(of_link, side).expand(len(part), *task.shape).float().numpy()
            variables[f"{name}{ending}"] = Variable(("link", *axes), values, unit)
    return variables


def axes_of(task: Task) -> dict[str, Variable]:
    """The axes of a label."""
    variables = {}
    for name, axis in task.axes().items():
        units = {"units": axis.unit} if axis.unit else {}
        variables[name] = Variable((name,), axis.values, units)
    return variables


def write_csv(
    file: Path, variables: Mapping[str, Variable], absent: Bool[np.ndarray, " n *shape"]
) -> None:
    """A row for each number of each link that is not absent: columns of the link, of the axes, and
    of the values.
    """
    axes = {
        name: one.values.tolist() for name, one in variables.items() if one.dimensions == (name,)
    }
    links = {name: one.values.tolist() for name, one in variables.items() if name in LINK}
    values = {name: one.values for name, one in variables.items() if name not in axes | links}
    shown = lambda value, digits=7: value if isinstance(value, str) else f"{value:.{digits}g}"
    digits = [10 if name in ("easting", "northing") else 7 for name in links]
    places = [
        *itertools.product(*([f"{number:.10g}" for number in axis] for axis in axes.values()))
    ]

    def rows() -> Iterator[Sequence[str]]:
        yield [*links, *axes, *values]
        for number, link in enumerate(zip(*links.values(), strict=True)):
            start = [*map(shown, link, digits)]
            own = (map(shown, part[number].ravel().tolist()) for part in values.values())
            for place, row, is_absent in zip(
                places, zip(*own, strict=True), absent[number].ravel(), strict=True
            ):
                if not is_absent:
                    yield [*start, *place, *row]

    tables.write_csv(file, rows())
