"""Writes the built-in scene as a folder: python -m gaigs.data.synthetic FOLDER"""

import argparse
from pathlib import Path

from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.data.synthetic import ROOM, wavefront_obj
from gaigs.io.files import write_text


def main() -> None:
    # An option that is not given is not passed on, so that the function's defaults hold.
    parser = argparse.ArgumentParser(
        prog="python -m gaigs.data.synthetic",
        description="Simulate the furnished room and write its spectra in the layout of the NeRF² spectra.",
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("folder", type=Path, help="folder to write; must not exist, or be empty")
    parser.add_argument("--spectrum", choices=("band", "carrier"), help="averaged over the band, or one frequency")
    parser.add_argument("--transmitters", type=int, help="how many; the last fifth of them tests")
    parser.add_argument("--frequency", type=float, action="append", help="carrier [Hz]; give it again for several")
    parser.add_argument("--bandwidth", type=float, help="width of the band around each [Hz]")
    parser.add_argument("--order", type=int, help="largest number of reflections of a path")
    parser.add_argument("--seed", type=int, help="of the transmitters' places")
    options = vars(parser.parse_args())
    folder = options.pop("folder")
    try:
        links = load({"name": "synthetic", **options}, {"name": "official", "validation": 0})
        write(folder, links)
        write_text(folder / "geometry.obj", wavefront_obj(ROOM))
    except (ValueError, TypeError, OSError) as error:
        parser.error(str(error))
    print(f"{folder}: {len(links.split.train)} training and {len(links.split.test)} test spectra")


if __name__ == "__main__":
    main()
