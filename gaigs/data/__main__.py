"""Writes a simulated room in a layout that gaigs reads: python -m gaigs.data FOLDER DATA
[OPTION=VALUE ...]
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.core.propagation import free_space
from gaigs.data import Links, csi_npz, deepmimo, load, nerf2_spectrum, rssi_csv, sionna, synthetic
from gaigs.data.sionna.meshes import wavefront_obj
from gaigs.data.synthetic.image_source import bounces, trace
from gaigs.io.files import write_text
from gaigs.io.tables import check_empty, number_places
from gaigs.processes import only_run


def main() -> None:
    """Reads the command line, simulates and writes."""
    parser = argparse.ArgumentParser(
        prog="python -m gaigs.data",
        description="Simulate a room and write its labels in a layout that gaigs reads.",
    )
    rooms = [
        f"{room}{labels}" for room in ("synthetic", "sionna") for labels in ("", "_rssi", "_csi")
    ]
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
    arguments = parser.parse_intermixed_args()
    folder = arguments.folder
    try:
        check_empty(folder)
        options: dict[str, Any] = OmegaConf.to_container(OmegaConf.from_dotlist(arguments.options))
        links = load({"name": arguments.data, **options}, {"name": "official", "validation": 0})
        is_built_in = arguments.data.startswith("synthetic")
        if arguments.deepmimo and not is_built_in:
            raise ValueError(
                "--deepmimo writes the built-in room; DeepMIMO has a converter of its own for Sionna RT"
            )
        if is_built_in:
            geometry = synthetic.wavefront_obj(synthetic.ROOM)
        elif options.get("scene") is None:
            geometry = wavefront_obj(sionna.ROOMS[options.get("room", "furnished")].meshes())
        else:  # the user has the surfaces
            geometry = None
        folder.mkdir(parents=True, exist_ok=True)
        writers = {"spectrum": nerf2_spectrum.write, "rssi": rssi_csv.write, "csi": csi_npz.write}
        with only_run(folder):
            check_empty(folder)  # another process may have begun to write it
            if arguments.deepmimo:
                write_paths(folder, links, options.get("order", 2))
            else:
                writers[links.task.name](folder, links)
            if geometry is not None:
                write_text(folder / "geometry.obj", geometry)
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


def write_paths(folder: Path, links: Links, order: int) -> None:
    """Writes the paths of the built-in room to the receivers of links of one carrier, as a scenario
    of DeepMIMO v4.
    """
    frequencies = links.query.frequencies.unique().tolist()
    if len(frequencies) > 1:
        raise ValueError(f"a scenario of DeepMIMO has one carrier, got frequency={frequencies}")
    users = torch.tensor(number_places(links.query.transmitters.tolist())[0], dtype=torch.float64)
    stations = []
    for position in (receiver.pose.position.double() for receiver in links.receivers):
        paths = trace(synthetic.ROOM, users, position, frequencies[0], order)
        waves = free_space((paths.images - position).norm(dim=-1), torch.tensor(frequencies[0]))
        points = bounces(synthetic.ROOM, paths.images, position, order)
        stations.append((position.numpy(), (paths.gains * waves).numpy(), points.numpy()))
    deepmimo.write(folder, frequencies[0], users.numpy(), stations)


if __name__ == "__main__":
    main()
