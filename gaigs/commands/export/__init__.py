"""Export for other programs: radio maps, predictions, the learnt room and its paths."""

from itertools import chain
from pathlib import Path

from gaigs.commands.export import maps, predictions, rooms, scenarios
from gaigs.core.query import Query
from gaigs.core.radio_maps import radio_map
from gaigs.data import Links
from gaigs.io.tables import read_points
from gaigs.model import Model
from gaigs.model.requests import as_new_receiver
from gaigs.registry import call, check_instance, check_type
from gaigs.runs import links_of, load

MAP_FILES = {
    ".tif": maps.write_geotiff,
    ".tiff": maps.write_geotiff,
    ".geojson": maps.write_geojson,
    ".nc": maps.write_map_netcdf,
    ".png": maps.write_figures,
    ".pdf": maps.write_figures,
}

OTHER_FILES = {
    "predictions": (".csv", ".nc"),
    "room": (".glb", ".gltf", ".obj", ".xml"),
    "scenario": (".deepmimo",),
}


def export(
    model: Model,
    file: str | Path,
    places: object = None,
    pitch: float | None = None,
    height: float | None = None,
    frequency: float | None = None,
    interval: float = 0.9,
    receiver: object = None,
) -> list[Path]:
    """Writes predictions or the learnt room into a file for other programs.

    The suffix of the file chooses the content and the format.

    Args:
        model: A fitted or loaded model.
        file: ``.tif``, ``.geojson``, ``.nc``, ``.png`` or ``.pdf`` for the radio map, with
            deviations if the model has intervals; ``.csv`` or ``.nc`` for predictions at places;
            ``.glb``, ``.gltf``, ``.obj`` or ``.xml`` (a Mitsuba scene for Sionna RT) for the learnt
            room; ``.deepmimo`` for the paths of mirrored channels, a folder with a DeepMIMO v4
            scenario.
        places: Positions (n, 3) [m] of transmitters, each for all receivers; or a ``Query``; or
            ``Links``, of which the test links are predicted and written beside their labels.
        pitch, height: Grid of a radio map [m], as for ``gaigs.radio_map``.
        frequency: Carrier of radio map, places and materials of the room [Hz]; None: the training
            links' carrier.
        interval: Probability with which the intervals of predictions hold the label.
        receiver: A new receiver that replaces the model's: a position [m], ``Pose`` or
            ``Receiver``, as for ``Model.predict``; None: the model's receivers.

    Returns:
        Paths of the files. A figure for each receiver, or a scene with meshes, are several.

    Raises:
        TypeError: The model is not a ``gaigs.Model``.
        ValueError: The suffix is unknown, the model has no radio map or room, or an option is out
            of range.
        ImportError: A package is not installed.
        OSError: A file cannot be written.

    Example:
        >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
        >>> [path.name for path in gaigs.export(model, "floor.tif", pitch=0.5)]
        ['floor.tif']
        >>> (file,) = gaigs.export(model, "places.csv", [[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]])
        >>> file.read_text().splitlines()[0]
        'x,y,z,receiver,frequency,value,deviation,lower,upper'
    """
    check_instance("model", model, Model)
    check_type("file", file, str | Path)
    file = Path(file)
    suffix = check_suffix(file)
    if receiver is not None:
        new = as_new_receiver(receiver, model.scene, places)
        if new is None or isinstance(places, Links | Query):
            raise ValueError(
                f"export takes a receiver [x, y, z] with places, or a radio map, got {receiver!r}"
            )
        model = model.at_receivers([new])
    if suffix in OTHER_FILES["room"]:
        return rooms.write_room(model, file, frequency)
    if suffix in OTHER_FILES["scenario"]:
        return scenarios.write_scenario(model, file, places, frequency)
    if suffix in OTHER_FILES["predictions"] and (places is not None or suffix not in MAP_FILES):
        return predictions.write_predictions(model, file, places, frequency, interval)
    return MAP_FILES[suffix](
        file, radio_map(model, pitch, height, frequency=frequency), model.scene
    )


def suffixes() -> tuple[str, ...]:
    """All suffixes of exported files."""
    return (*dict.fromkeys((*MAP_FILES, *chain.from_iterable(OTHER_FILES.values()))),)


def check_suffix(file: Path) -> str:
    """The suffix of an output file; a ``ValueError`` for an unknown one."""
    if (suffix := file.suffix.lower()) not in suffixes():
        raise ValueError(
            f"an exported file must end with one of {', '.join(suffixes())}, got {file.name!r}"
        )
    return suffix


def run(config: dict, folder: Path) -> None:
    """Exports from a finished run into a folder, with the options of ``config["export"]``.

    Without ``places``, predictions and scenarios are for the test links. The file is named after
    its content: ``predictions``, ``radio_map`` or ``room``.
    """
    options = dict(config["export"])
    form, places = options.pop("format"), options.pop("places")
    if form is None:
        forms = ", ".join(suffix[1:] for suffix in suffixes())
        raise ValueError(f"command=export needs export.format, one of {forms}")
    suffix = check_suffix(Path(f"export.{form}"))
    model = load(config["folder"], config["trust"])
    # For scalar labels a ``.nc`` without places is a radio map.
    takes_places = suffix in OTHER_FILES["predictions"] + OTHER_FILES["scenario"]
    has_map = suffix in MAP_FILES and model.scene.task.is_scalar
    if places is None and takes_places and not has_map:
        places = "test"
    if suffix in OTHER_FILES["predictions"] and places:
        name = "predictions"
    else:
        name = "radio_map" if suffix in MAP_FILES else "room"
    if places == "test":
        places = links_of(config["folder"], config["trust"])
    elif isinstance(places, str):
        places = read_points(Path(places), "xyz", "x,y,z [m] of one place a line")
    folder.mkdir(parents=True, exist_ok=True)
    call("export", export, options, model=model, file=folder / f"{name}{suffix}", places=places)
    print(f"results: {folder}")
