"""Files of predictions of any task: CSV and NetCDF."""

import itertools
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from gaigs.data.compatibility import check_fit
from gaigs.io.netcdf import Variable, write_netcdf
from gaigs.io.tables import write_table
from gaigs.model import Model

log = logging.getLogger(__name__)


class Labels(NamedTuple):
    """Links to predict, with their test labels if known."""

    query: Query
    task: Task  # task of the values; of held-out subcarriers their own
    measured: Tensor | None  # labels of links' test; None for places
    subcarriers: Tensor | None  # held-out subcarriers [Hz]; None if there are none


def write_predictions(
    model: Model, file: Path, places: object, frequency: float | None = None, interval: float = 0.9
) -> list[Path]:
    """Writes predictions with their deviations and intervals, ``.csv`` or ``.nc``.

    Args:
        places: Positions (n, 3) [m] of transmitters, each for all receivers; or a ``Query``; or
            ``Links``, of which the test links are predicted and written beside their labels.
        frequency: Carrier for positions [Hz]; None: the only known one.
        interval: Probability with which an interval holds the label. Files of a model without
            intervals have no deviations and intervals.
    """
    scene = model.scene
    query, task, measured, subcarriers = _to_predict(scene, places, frequency)
    if not 0 < interval < 1:
        raise ValueError(
            f"interval must be a probability between 0 and 1 such as 0.9, got {interval!r}"
        )
    if subcarriers is None and model.calibration is not None and model.calibration.gives(interval):
        estimate = model.predict(query, interval=interval)
    else:
        log.warning("%s has values alone: the model has no intervals of %g here", file, interval)
        values = model.predict(query, frequencies=subcarriers)
        estimate = Estimate(values, None, None, None)  # type: ignore[arg-type]
    absent = torch.tensor(False).expand(len(query), *task.shape)  # True for missing elements
    if task.is_channel:
        channel: Any = task
        receivers = query.receivers.cpu()
        absent = lacking(scene.receivers, receivers, channel.elements, channel.frequencies)
        estimate = Estimate(*(_blank(part, absent) for part in estimate))
        measured = _blank(measured, absent)
    variables = tabulate(query, scene, task, estimate, measured)
    if scene.frame is not None:
        log.info("easting and northing are those of EPSG:%d", scene.frame.epsg)
    if file.suffix.lower() == ".csv":
        write_table(file, _rows(variables, absent.numpy()))
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


def _to_predict(scene: Scene, places: object, frequency: float | None) -> Labels:
    """The links to predict for the ``places`` of ``write_predictions``, with labels if known.

    ``Links`` give their test links. If they hold out subcarriers, these are predicted.
    """
    query = query_of("predictions", scene, places, frequency)
    if not isinstance(places, Links):
        return Labels(query, scene.task, None, None)
    test = places.split.test
    if places.held_out is None:
        return Labels(query, scene.task, places.labels[test], None)
    task: Any = places.held_out.task
    return Labels(query, task, places.held_out.labels[test], task.frequencies)


def _blank(part: Tensor | None, absent: Bool[Tensor, " n *shape"]) -> Tensor | None:
    """A tensor with NaN at missing elements of arrays.

    None and tensors without the axes of elements and subcarriers are returned unchanged.
    """
    if part is None or part.ndim < 3:
        return part
    return part.cpu().masked_fill(absent, math.nan)


def query_of(kind: str, scene: Scene, places: object, frequency: float | None) -> Query:
    """The query of ``places``, as for ``write_predictions``; a ``ValueError`` if it is empty.

    Args:
        kind: Name of the file in errors.
    """
    if places is None:
        raise ValueError(f"{kind} take places: positions [m], a query, or links with a test")
    if isinstance(places, Links):
        check_fit(places, scene)
        query = places.query[places.split.test]
    elif isinstance(places, Query):
        query = places
    else:
        points = as_positions("places", places)
        names = [receiver.name for receiver in scene.receivers]
        query, _ = Query.from_positions(points, None, frequency, names, scene.frequencies)
    if not len(query):
        raise ValueError(f"{kind} take one place or more; give positions [m], or links with a test")
    return query


def tabulate(
    query: Query, scene: Scene, task: Task, estimate: Estimate, measured: Tensor | None
) -> dict[str, Variable]:
    """The variables of a file of predictions, by name.

    Places, receivers and carriers have one entry a link (n,). Each axis of a label is a variable,
    such as ``subcarrier``. The axes of the links and of a label are the axes of all other
    variables: values, deviations, bounds of intervals, radii of complex intervals, and ``measured``
    labels. A complex variable is stored as two, ``_real`` and ``_imag``.
    """
    axes = {}
    for name, axis in task.axes().items():
        axes[name] = Variable((name,), axis.values, {"units": axis.unit} if axis.unit else {})
    variables = _link_columns(query, scene) | axes
    parts = {
        "value": estimate.value,
        "deviation": estimate.std,
        "lower": estimate.lower,
        "upper": estimate.upper,
        "radius": estimate.radius,
        "measured": measured,
    }
    for name, part in parts.items():
        if part is None:
            continue
        part = part.detach().cpu()
        unit = task.unit
        if name in ("deviation", "radius"):
            unit = task.error_unit
        about = {"units": unit or "1", "long_name": f"{task.quantity}: {name}"}
        # A part without some axes, such as one radius a link, is the same along them: it gets these
        # axes with length 1, and is then repeated.
        axes_to_add = len(task.shape) + 1 - part.ndim
        full_rank = part.reshape(len(part), *[1] * axes_to_add, *part.shape[1:])
        components = {"": full_rank}
        if part.is_complex():
            components = {"_real": full_rank.real, "_imag": full_rank.imag}
        for ending, component in components.items():
            values = component.expand(len(part), *task.shape).float().numpy()
            variables[f"{name}{ending}"] = Variable(("link", *axes), values, about)
    return variables


def _link_columns(query: Query, scene: Scene) -> dict[str, Variable]:
    """Columns of links: place, receiver and, if known, frequency."""
    places = query.transmitters.cpu().double().numpy()
    metres = {"units": "m"}
    columns = {axis: Variable(("link",), places[:, k], metres) for k, axis in enumerate("xyz")}
    if scene.frame is not None:
        about = metres | {"long_name": f"of EPSG:{scene.frame.epsg}"}
        columns["easting"] = Variable(("link",), scene.frame.x + places[:, 0], about)
        columns["northing"] = Variable(("link",), scene.frame.y + places[:, 1], about)
    names = np.array([receiver.name for receiver in scene.receivers])
    columns["receiver"] = Variable(("link",), names[query.receivers.cpu().numpy()])
    if query.frequencies is not None:
        carriers = query.frequencies.cpu().double().numpy()
        about = {"units": "Hz", "standard_name": "radiation_frequency"}
        columns["frequency"] = Variable(("link",), carriers, about)
    return columns


def _rows(
    variables: Mapping[str, Variable], absent: Bool[np.ndarray, " n *shape"]
) -> Iterator[Sequence[str]]:
    """Yields the rows of a table: a heading, then one row for each number of each label.

    A row has the columns of the link, the coordinates along the label's axes, such as element and
    subcarrier, and the values there. Numbers at missing elements have no row.

    Args:
        variables: Result of ``tabulate``.
        absent: True at missing elements.
    """
    link_names = ("x", "y", "z", "easting", "northing", "receiver", "frequency")
    axes: dict[str, list] = {}
    links: dict[str, list] = {}
    values: dict[str, np.ndarray] = {}
    for name, variable in variables.items():
        if variable.dimensions == (name,):
            axes[name] = [f"{number:.10g}" for number in variable.values.tolist()]
        elif name in link_names:
            links[name] = variable.values.tolist()
        else:
            values[name] = variable.values
    digits = [10 if name in ("easting", "northing") else 7 for name in links]
    coordinates = [*itertools.product(*axes.values())]  # of each number of a label

    yield [*links, *axes, *values]
    for number, link in enumerate(zip(*links.values(), strict=True)):
        link_cells = [*map(_shown, link, digits)]
        columns = [map(_shown, array[number].ravel().tolist()) for array in values.values()]
        rows = zip(*columns, strict=True)
        for point, row, is_absent in zip(coordinates, rows, absent[number].ravel(), strict=True):
            if not is_absent:
                yield [*link_cells, *point, *row]


def _shown(value: Any, digits: int = 7) -> str:
    """A cell of the table: a text unchanged, or a number with ``digits`` significant digits."""
    return value if isinstance(value, str) else f"{value:.{digits}g}"
