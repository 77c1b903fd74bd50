"""Writes a simulated room in a layout that gaigs reads: python -m gaigs.data FOLDER DATA [OPTION=VALUE ...]"""

import argparse
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.data import csi_npz, load, nerf2_spectrum, rssi_csv, sionna, synthetic
from gaigs.data.sionna.meshes import wavefront_obj
from gaigs.io.files import write_text
from gaigs.io.tables import check_empty


def main() -> None:
    """Reads the command line, simulates and writes."""
    parser = argparse.ArgumentParser(
        prog="python -m gaigs.data", description="Simulate a room and write its labels in a layout that gaigs reads."
    )
    rooms = [f"{room}{labels}" for room in ("synthetic", "sionna") for labels in ("", "_rssi", "_csi")]
    parser.add_argument("folder", type=Path, help="folder to write; must be empty or missing")
    parser.add_argument("data", choices=rooms, help="data set: spectra, readings (rssi) or channels (csi) of a room")
    parser.add_argument("options", nargs="*", metavar="option=value", help="its options, as in conf/data/DATA.yaml")
    arguments = parser.parse_args()
    folder = arguments.folder
    try:
        check_empty(folder)
        options: dict[str, Any] = OmegaConf.to_container(OmegaConf.from_dotlist(arguments.options))
        links = load({"name": arguments.data, **options}, {"name": "official", "validation": 0})
        if arguments.data.startswith("synthetic"):
            geometry = synthetic.wavefront_obj(synthetic.ROOM)
        else:
            geometry = wavefront_obj(sionna.ROOMS[options.get("room", "furnished")].meshes())
        folder.mkdir(parents=True, exist_ok=True)
        writers = {"spectrum": nerf2_spectrum.write, "rssi": rssi_csv.write, "csi": csi_npz.write}
        writers[links.task.name](folder, links)
        write_text(folder / "geometry.obj", geometry)
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, OmegaConfBaseException) as error:
        parser.error(str(error))
    print(f"{folder}: {len(links.split.train)} training and {len(links.split.test)} test labels")


if __name__ == "__main__":
    main()
