"""Writes a simulated room in a layout that gaigs reads.

python -m gaigs.data FOLDER DATA [OPTION=VALUE ...]
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.core.propagation import free_space
from gaigs.data import Links, csi_npz, load, nerf2_spectrum, rssi_csv, synthetic
from gaigs.data.synthetic.image_source import bounces, trace
from gaigs.io import deepmimo
from gaigs.io.files import write_text
from gaigs.io.meshes import Mesh, wavefront_obj
from gaigs.io.tables import check_empty, number_places
from gaigs.processes import only_run


def main() -> None:
    """Reads the command line, simulates and writes."""
    parser = _parser()
    arguments = parser.parse_intermixed_args()
    folder = arguments.folder
    try:
        check_empty(folder)
        options: dict[str, Any] = OmegaConf.to_container(OmegaConf.from_dotlist(arguments.options))
        links = load({"name": arguments.data, **options}, {"name": "official", "validation": 0})
        if arguments.deepmimo and not arguments.data.startswith("synthetic"):
            raise ValueError(
                "--deepmimo writes the built-in room; "
                "DeepMIMO has a converter of its own for Sionna RT"
            )
        geometry = _geometry(arguments.data, options)
        folder.mkdir(parents=True, exist_ok=True)
        writers = {"spectrum": nerf2_spectrum.write, "rssi": rssi_csv.write, "csi": csi_npz.write}
        with only_run(folder):
            check_empty(folder)  # another process may have begun to write it
            if arguments.deepmimo:
                _write_paths(folder, links, options.get("order", 2))
            else:
                writers[links.task.name](folder, links)
            if geometry:
                write_text(folder / "geometry.obj", wavefront_obj(geometry))
    except (
        ValueError,
        TypeError,
        OSError,
        ImportError,
        RuntimeError,
        OmegaConfBaseException,
    ) as error:
        parser.error(str(error))
    print(f"{folder}: {len(links.split.train)} training and {len(links.split.test)} test labels")


def _parser() -> argparse.ArgumentParser:
    """The command line: a folder, a data set, and its options."""
    parser = argparse.ArgumentParser(
        prog="python -m gaigs.data",
        description="Simulate a room and write its labels in a layout that gaigs reads.",
    )
    rooms = []
    for room in ("synthetic", "sionna"):
        rooms += [room, f"{room}_rssi", f"{room}_csi"]
    parser.add_argument("folder", type=Path, help="folder to write; must be empty or missing")
    parser.add_argument(
        "data", choices=rooms, help="data set: spectra, readings (rssi) or channels (csi) of a room"
    )
    parser.add_argument(
        "--deepmimo",
        action="store_true",
        help="write the paths of the built-in room, as a scenario of DeepMIMO v4",
    )
    parser.add_argument(
        "options", nargs="*", metavar="option=value", help="its options, as in docs/data.md"
    )
    return parser


def _geometry(data: str, options: dict[str, Any]) -> list[Mesh]:
    """The surfaces of a simulated room; empty for a scene file of the user."""
    if data.startswith("synthetic"):
        return synthetic.meshes(synthetic.ROOM)
    if options.get("scene") is not None:
        return []
    from gaigs_sionna.rooms import ROOMS  # of the plug-in, which has simulated the labels

    return ROOMS[options.get("room", "furnished")].meshes()


def _write_paths(folder: Path, links: Links, order: int) -> None:
    """Writes the paths of the built-in room to the receivers as a scenario of DeepMIMO v4."""
    frequencies = links.query.frequencies.unique().tolist()
    if len(frequencies) > 1:
        raise ValueError(f"a scenario of DeepMIMO has one carrier, got frequency={frequencies}")
    frequency = frequencies[0]
    users = torch.tensor(number_places(links.query.transmitters.tolist())[0], dtype=torch.float64)
    stations = []
    for receiver in links.receivers:
        position = receiver.pose.position.double()
        paths = trace(synthetic.ROOM, users, position, frequency, order)
        lengths = (paths.images - position).norm(dim=-1)  # (users, paths)
        waves = free_space(lengths, torch.tensor(frequency))
        points = bounces(synthetic.ROOM, paths.images, position, order)  # from the receiver on
        fields = (paths.gains * waves).numpy()
        stations.append(deepmimo.Station(position.numpy(), fields, points.numpy()))
    deepmimo.write_scenario(folder, frequency, users.numpy(), stations)


if __name__ == "__main__":
    main()
