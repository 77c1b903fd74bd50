"""Places within areas that were drawn on a map, as candidates of a survey."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.path import Path as Outline
from numpy import ndarray
from torch import Tensor

from gaigs.core.geometry import Frame, even_places
from gaigs.data.maps import check_metres, find_pyproj
from gaigs.io.tables import read_points
from gaigs.model import Model

Rings = list[Float[ndarray, "_ d"]]
"""Outline of a polygon and its holes, as positions."""


def read_candidates(file: Path, model: Model | None) -> object:
    """Candidates of a file: a table of x,y,z [m], or places within the areas of ``.geojson``."""
    if file.suffix.lower() in (".geojson", ".json"):
        return read_area(file, model)
    return read_points(file, "xyz", "x,y,z [m] of one candidate a line")


def read_area(file: Path, model: Model | None, count: int = 1000) -> Float[Tensor, "c 3"]:
    """About ``count`` even places [m] within the polygons of a GeoJSON file.

    Positions are longitude and latitude, or easting and northing, if the model knows its place on
    the map; else metres of the room. The height is the third number of the positions, or that of
    the model's training transmitters: each floor, or half-way between the lowest and the highest.

    Raises:
        ValueError: The file is no GeoJSON, has no polygon, or a height is missing.

    Source: RFC 7946.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        polygons = [*polygons_of(content)]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"cannot read {file} as GeoJSON: {type(error).__name__}: {error}"
        ) from error
    if not polygons:
        raise ValueError(f"{file} has no polygon\ndraw the area as Polygon or MultiPolygon")
    frame = None if model is None else model.scene.frame
    outlines = []
    for rings in polygons:
        outlines.append([_in_metres(file, ring, frame) for ring in rings])
    corners = np.concatenate([*itertools.chain.from_iterable(outlines)])  # (k, 3)
    heights = corners[:1, 2]
    if model is not None and np.isnan(corners[:, 2]).any():
        floors = model.scene.floors
        middle = (model.scene.lower[2:] + model.scene.upper[2:]) / 2
        heights = np.asarray(floors if len(floors) else middle, dtype=float)
    if np.isnan(heights).any():
        raise ValueError(
            f"{file}: without a trained model each position needs a height, its third number [m]\n"
            "add it, or plan with folder=runs/..."
        )
    inside = _places_inside(outlines, corners[:, :2], max(1, count // len(heights)))  # (g, 2)
    places = [np.insert(inside, 2, height, axis=1) for height in heights]
    return torch.tensor(np.concatenate(places), dtype=torch.float32)


def polygons_of(content: Any) -> Iterator[Rings]:
    """The polygons of a GeoJSON object, at any depth."""
    match content["type"]:
        case "FeatureCollection":
            parts = content["features"]
        case "GeometryCollection":
            parts = content["geometries"]
        case "Feature":
            parts = [content["geometry"]] if content["geometry"] else []
        case "MultiPolygon":
            parts = [{"type": "Polygon", "coordinates": one} for one in content["coordinates"]]
        case "Polygon":
            yield [np.array(ring, dtype=float) for ring in content["coordinates"]]
            return
        case _:  # points and lines have no area
            return
    for part in parts:
        yield from polygons_of(part)


def _in_metres(
    file: Path, ring: Float[ndarray, "k d"], frame: Frame | None
) -> Float[ndarray, "k 3"]:
    """Positions in the room's metres; the height is NaN where there is none."""
    if ring.ndim != 2 or ring.shape[1] not in (2, 3) or not np.isfinite(ring).all():
        raise ValueError(f"{file}: a position must be two or three finite numbers")
    x, y = ring[:, 0], ring[:, 1]
    height = ring[:, 2] if ring.shape[1] == 3 else np.full(len(ring), np.nan)
    if frame is None:
        check_metres(str(file), ring, "the data have no place on a map: draw the area in metres")
        return np.stack((x, y, height), 1)
    if np.abs(x).max() <= 180 and np.abs(y).max() <= 90:
        transformer = find_pyproj().Transformer.from_crs(4326, frame.epsg, always_xy=True)
        x, y = transformer.transform(x, y)
    return np.stack((x - frame.x, y - frame.y, height), 1)


def _places_inside(
    polygons: list[Rings], corners: Float[ndarray, "k 2"], count: int
) -> Float[ndarray, "g 2"]:
    """About ``count`` even places within polygons, at least one."""
    lower = torch.tensor([*corners.min(0), 0.0])
    upper = torch.tensor([*corners.max(0), 0.0])
    tried = count
    for _ in range(6):  # a narrow area is a small part of its box
        places = even_places(lower, upper, tried)[:, :2].numpy()
        is_inside = np.zeros(len(places), dtype=bool)
        for outline, *holes in polygons:
            within = Outline(outline[:, :2]).contains_points(places)
            for hole in holes:
                within &= ~Outline(hole[:, :2]).contains_points(places)
            is_inside |= within
        if 2 * is_inside.sum() >= count:
            break
        tried *= 2
    if not is_inside.any():
        return corners[:1]
    return places[is_inside]
