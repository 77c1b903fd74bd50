"""Places within areas drawn on a map, as candidates of a survey."""

import itertools
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.path import Path as Outline
from numpy import ndarray
from torch import Tensor

from gaigs.core.geometry import even_places
from gaigs.data.geojson import Rings, read_polygons
from gaigs.io.tables import read_points
from gaigs.model import Model


def read_candidates(file: Path, model: Model | None) -> object:
    """Candidates of a file: a table of x,y,z [m], or places within the areas of ``.geojson``."""
    if file.suffix.lower() in (".geojson", ".json"):
        return read_area(file, model)
    return read_points(file, "xyz", "x,y,z [m] of one candidate a line")


def read_area(file: Path, model: Model | None, count: int = 1000) -> Float[Tensor, "c 3"]:
    """About ``count`` evenly spread places [m] within the polygons of a GeoJSON file.

    If the model has a frame, positions are longitude and latitude, or easting and northing;
    otherwise metres of the room. The height is the third coordinate. Without one it is the height
    of each floor of the training transmitters, or of the middle of a single floor.

    Source: RFC 7946.
    """
    frame = None if model is None else model.scene.frame
    outlines = [rings for rings, _ in read_polygons(file, frame, "draw the area")]
    # Corners of all outer and inner rings; the height is NaN where the file has none.
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


def _places_inside(
    polygons: list[Rings], corners: Float[ndarray, "k 2"], count: int
) -> Float[ndarray, "g 2"]:
    """Evenly spread places within polygons, at least half of ``count`` if possible.

    If no place of the finest grid is inside, the result is the first corner.

    Args:
        polygons: An outer ring each, then its holes.
        corners: Corners of all rings [m].
    """
    lower = torch.tensor([*corners.min(0), 0.0])
    upper = torch.tensor([*corners.max(0), 0.0])
    tried = count  # places of a grid over the box of all polygons
    for _ in range(6):  # a narrow area is a small part of its box: double the grid
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
