"""Files of radio maps: GeoTIFF, GeoJSON, NetCDF, PNG and PDF."""

import itertools
import json
import logging
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import tifffile
from matplotlib import rc_context
from matplotlib.backends.backend_pdf import PdfPages
from numpy import ndarray

from gaigs.core.geometry import Frame
from gaigs.core.radio_maps import RadioMap
from gaigs.core.scene import Scene
from gaigs.core.task.scalar import with_unit
from gaigs.data.maps import find_pyproj
from gaigs.io.files import atomic_write, write_text
from gaigs.io.netcdf import Variable, write_netcdf
from gaigs.report import style
from gaigs.report.radio_maps import deviation_map, map_pages

log = logging.getLogger(__name__)


def layers(floor: RadioMap) -> dict[str, RadioMap]:
    """Maps of the ``value`` and, if the model has intervals, of the ``deviation``."""
    kinds = {"value": floor}
    if floor.deviations is not None:
        kinds["deviation"] = deviation_map(floor)
    return kinds


def title(floor: RadioMap) -> str:
    """Quantity, unit, height and carrier of a radio map."""
    carrier = "" if floor.frequency is None else f" at {floor.frequency / 1e9:.6g} GHz"
    quantity = with_unit(floor.quantity, floor.unit)
    return f"{quantity} of a transmitter at z = {floor.height:.2f} m{carrier}, by gaigs"


def write_geotiff(file: Path, floor: RadioMap, scene: Scene) -> list[Path]:
    """Writes a GeoTIFF, north up, with two bands for each receiver: value and deviation.

    Coordinates are in the frame's projected system.

    Source: OGC GeoTIFF Standard 1.1; names of bands as GDAL stores them.
    """
    x, y = axes_on_map(file, floor, scene.frame)
    width = np.diff(x[:2])[0]  # of a pixel
    height = np.diff(y[:2])[0]
    kinds = layers(floor).values()
    # Rows of the file run from north to south, rows of the map from south to north.
    north_up = np.stack([kind.values[:, ::-1] for kind in kinds], 1)  # (receivers, kinds, y, x)
    bands = north_up.reshape(-1, len(y), len(x)).astype(np.float32)
    names = []  # one for each band
    for receiver in floor.receivers:
        names += [f"{receiver}: {with_unit(kind.quantity, kind.unit)}" for kind in kinds]
    items = "".join(
        f'<Item name="DESCRIPTION" sample="{band}" role="description">{escape(name)}</Item>'
        for band, name in enumerate(names)
    )
    # Pixel (0, 0) begins at its north-west corner, half a pixel from its centre.
    corner = (0.0, 0.0, 0.0, x[0] - width / 2, y[-1] + height / 2, 0.0)
    tags: list[tuple] = [
        (33550, "d", 3, (width, height, 0.0), True),  # ModelPixelScale
        (33922, "d", 6, corner, True),  # ModelTiepoint
        (42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>".encode(), True),
    ]
    if scene.frame is not None:  # GeoKeyDirectory: projected, pixels are areas, EPSG code
        keys = (1, 1, 1, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, scene.frame.epsg)
        tags.append((34735, "H", len(keys), keys, True))
    options: dict[str, Any] = {
        "photometric": "minisblack",
        "planarconfig": "separate",
        "metadata": None,
    }
    with atomic_write(file) as part:
        tifffile.imwrite(part, bands, description=title(floor).encode(), extratags=tags, **options)
    return [file]


def write_geojson(file: Path, floor: RadioMap, scene: Scene) -> list[Path]:
    """Writes a GeoJSON point for each place, with value and deviation at each receiver.

    Keys of a receiver ``ap`` are ``ap`` and ``ap deviation``. If another receiver has one of these
    names, the first key is ``ap value``.

    Source: RFC 7946: longitudes and latitudes of WGS 84. Without a frame, coordinates are metres.
    """
    x, y = np.meshgrid(*axes_on_map(file, floor, scene.frame))
    if scene.frame is not None:
        transformer = find_pyproj().Transformer.from_crs(scene.frame.epsg, 4326, always_xy=True)
        x, y = transformer.transform(x, y)
    kinds = layers(floor)
    # A receiver may be called "ap deviation" beside one called "ap".
    full_names = {" ".join(pair) for pair in itertools.product(floor.receivers, kinds)}
    collisions = full_names & {*floor.receivers}
    columns = {}
    for receiver, name in enumerate(floor.receivers):
        for key, kind in kinds.items():
            is_short = key == "value" and not collisions
            column = name if is_short else f"{name} {key}"
            columns[column] = kind.values[receiver].ravel().tolist()
    features = []
    for row, (east, north) in enumerate(zip(x.ravel().tolist(), y.ravel().tolist(), strict=True)):
        place = [round(east, 8), round(north, 8)]  # of degrees: 1 mm
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": place},
                "properties": {name: round(column[row], 4) for name, column in columns.items()},
            }
        )
    content = {"type": "FeatureCollection", "title": title(floor), "features": features}
    write_text(file, json.dumps(content, ensure_ascii=False) + "\n")
    return [file]


def write_map_netcdf(file: Path, floor: RadioMap, scene: Scene) -> list[Path]:
    """Writes a NetCDF file with ``value`` and ``deviation`` by receiver, y and x.

    Source: NetCDF Climate and Forecast Metadata Conventions 1.11.
    """
    x, y = axes_on_map(file, floor, scene.frame)
    variables = {"receiver": Variable(("receiver",), np.array(floor.receivers))}
    standard_names: dict[str, dict[str, str]] = {"x": {}, "y": {}}
    shared = {"coordinates": "z"}  # attributes of value and deviation
    if scene.frame is not None:
        system = find_pyproj().CRS.from_epsg(scene.frame.epsg).to_cf()
        variables["crs"] = Variable((), np.array(0, np.int32), system)
        for axis in "xy":
            standard_names[axis] = {"standard_name": f"projection_{axis}_coordinate"}
        shared["grid_mapping"] = "crs"
    for axis, values in (("x", x), ("y", y)):
        attributes = {"units": "m", "axis": axis.upper(), **standard_names[axis]}
        variables[axis] = Variable((axis,), values, attributes)
    variables["z"] = Variable(
        (), np.array(floor.height), {"units": "m", "long_name": "height of the transmitter"}
    )
    if floor.frequency is not None:
        carrier = {"units": "Hz", "standard_name": "radiation_frequency"}
        variables["frequency"] = Variable((), np.array(floor.frequency), carrier)
        shared["coordinates"] += " frequency"
    for name, kind in layers(floor).items():
        about = {"long_name": kind.quantity, "units": kind.unit or "1", **shared}
        variables[name] = Variable(("receiver", "y", "x"), kind.values.astype(np.float32), about)
    write_netcdf(file, variables, {"title": title(floor)})
    return [file]


def write_figures(file: Path, floor: RadioMap, scene: Scene) -> list[Path]:
    """Writes the maps as figures, pages of one PDF or a PNG each; returns the files."""
    gateways = {receiver.name: receiver.pose.position.numpy() for receiver in scene.receivers}
    pages = map_pages(floor, gateways, {}, np.zeros((0, 2, 3), np.float32))
    if file.suffix.lower() == ".pdf":
        with atomic_write(file) as part, rc_context(style.STYLE), PdfPages(part) as document:
            for page in pages.values():
                document.savefig(page)
        return [file]
    files = []
    for name, page in pages.items():
        ending = name.removeprefix("radio_map").replace("deviation_map", "_deviation")
        files.append(file.with_stem(f"{file.stem}{ending}"))
        with atomic_write(files[-1]) as part, rc_context(style.STYLE):
            page.savefig(part, dpi=style.DPI)
    return files


def axes_on_map(file: Path, floor: RadioMap, frame: Frame | None) -> tuple[ndarray, ndarray]:
    """Coordinates x and y of the map's places [m], in the frame's system or the data's."""
    if frame is None:
        log.warning("%s has no coordinate system: x and y are metres in the data's own frame", file)
        return floor.x, floor.y
    return frame.x + floor.x, frame.y + floor.y
