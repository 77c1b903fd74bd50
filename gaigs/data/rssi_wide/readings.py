"""Readings of a table: long tables made wide, and means of the readings at each place."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from gaigs.data.rssi_wide.columns import NAMES, Axes, Columns, plain_name
from gaigs.io import tables


class Pivoted(NamedTuple):
    """A table of readings, rearranged to a row for each place and a column for each gateway."""

    table: tables.Table  # coordinates first; a place with repeated readings has several rows
    axes: Axes  # its columns of coordinates
    ignored: list[str]  # names of other columns of the table with a reading a row


def pivoted(table: tables.Table, axes: Axes, receiver: str | None, level: str | None) -> Pivoted:
    """Rearranges a table with one reading in each row: places become rows, gateways become columns.

    Args:
        receiver: Column of the gateways' names.
        level: Column of the readings.
    """
    if receiver is None or level is None:
        missing = "data.receiver" if receiver is None else "data.level"
        raise ValueError(
            f"{table.heading}: a reading a row takes data.receiver and data.level; set {missing}, "
            f"one of {tables.shortened(table.names)}"
        )
    named = table.column(receiver)
    column = table.column(level)
    if column == named or {column, named} & {*axes.columns}:
        raise ValueError(
            f"{table.heading}: data.receiver={receiver} and data.level={level} must differ from "
            "each other and from the coordinates"
        )
    count = len(table.numbers)  # n readings
    texts = [table.text(row, named) for row in range(count)]
    nameless = {row: f"none in column {receiver}" for row, text in enumerate(texts) if not text}
    table.refuse(nameless, "a gateway's name")
    points = table.numbers[:, axes.columns]  # (n, 2 or 3)
    # Number of the place and of the gateway of each reading.
    places = tables.number_places(points.tolist())[1].numpy()
    names, gateways = np.unique(texts, return_inverse=True)

    # The k-th reading of a gateway at a place goes to the place's k-th row.
    pairs = places * len(names) + gateways  # number of each pair of place and gateway
    order = np.argsort(pairs, kind="stable")  # readings of a pair in succession
    starts = np.searchsorted(pairs[order], pairs[order])  # position of the pair's first reading
    repeats = np.empty(count, int)  # k of each reading, from 0
    repeats[order] = np.arange(count) - starts
    keys = places * (repeats.max() + 1) + repeats  # number of each combination of place and k
    _, first, rows = np.unique(keys, return_index=True, return_inverse=True)
    source = np.full((len(first), len(names)), -1)  # number of the reading, -1 without one
    source[rows, gateways] = np.arange(count)
    levels = np.where(source >= 0, table.numbers[source, column], np.nan)

    def text_of(row: int, k: int) -> str:
        """The text of a cell of the new table, for messages."""
        if k < len(axes.columns):
            return table.text(first[row], axes.columns[k])
        reading = source[row, k - len(axes.columns)]
        return table.text(reading, column) if reading >= 0 else ""

    headings = [table.names[k] for k in axes.columns]
    used = {*headings, receiver, level}
    return Pivoted(
        tables.Table(
            file=table.file,
            names=[*headings, *names.tolist()],
            numbers=np.column_stack((points[first], levels)),
            text=text_of,
            unit="place",
            first=table.first,
        ),
        axes._replace(x=0, y=1, z=2 if axes.z >= 0 else -1),
        [name for name in table.names if name not in used],
    )


def refuse_readings(table: tables.Table, columns: Columns) -> None:
    """Raises a ``ValueError`` if each row of the table seems to be one reading.

    Such a table has a single column of levels, and a column with the gateways' names.
    """
    if len(columns.gateways) > 1:
        return
    level = table.names[columns.gateways[0]]
    for name in columns.ignored:
        if name not in table.names or plain_name(name)[0] not in NAMES:
            continue
        column = table.names.index(name)
        texts = {table.text(row, column) for row in range(len(table.numbers))}
        if 1 < len(texts) < len(table.numbers):
            raise ValueError(
                f"{table.heading}: column {name} seems to name the gateway of each reading; set "
                f"data.receiver={name} and data.level={level}, or data.ignore=[{name}]"
            )


class Survey(NamedTuple):
    """Readings averaged at each place."""

    places: Float[ndarray, "p 3"]  # different places [m]
    counts: Float[ndarray, "p g"]  # number of readings at each place and gateway
    means: Float[ndarray, "p g"]  # their means [dBm]; 0 without a reading
    repeats: int  # number of readings beyond the first of a place
    scatter: float  # standard deviation of repeated readings [dB]
    # Standard deviation of each mean [dB]; None without repetitions.
    noises: Float[Tensor, " n"] | None


def averaged(
    points: Float[ndarray, "rows 3"],
    levels: Float[ndarray, "rows g"],
    received: Bool[ndarray, "rows g"],
) -> Survey:
    """Means of the received levels of each place, in dB.

    Args:
        points: Place of each row of the table [m]; a place may have several rows.
        levels: Level of each row at each gateway [dBm].
        received: True for each level that was received.
    """
    places, numbers = tables.number_places(points.tolist())
    place_of = numbers.numpy()  # number of each row's place
    counts = np.zeros((len(places), levels.shape[1]))
    sums = np.zeros_like(counts)
    np.add.at(counts, place_of, received)
    np.add.at(sums, place_of, np.where(received, levels, 0))
    means = sums / counts.clip(1)
    repeats = int(received.sum()) - int((counts > 0).sum())
    if not repeats:
        return Survey(np.array(places), counts, means, 0, 0.0, None)
    errors = np.where(received, levels - means[place_of], 0)
    # The number of repeats is that of readings less that of means: the degrees of freedom.
    scatter = math.sqrt(np.square(errors).sum() / repeats)
    noises = torch.from_numpy(scatter / np.sqrt(counts[counts > 0])).float()
    return Survey(np.array(places), counts, means, repeats, scatter, noises)
