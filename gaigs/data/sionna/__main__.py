"""Writes a simulated room as files: python -m gaigs.data.sionna FOLDER"""

import argparse
from pathlib import Path

import numpy as np

from gaigs.data import Links, load, nerf2_spectrum
from gaigs.data.sionna import find_room
from gaigs.data.sionna.meshes import wavefront_obj
from gaigs.io.files import atomic_write, write_text


def write_rssi(folder: Path, links: Links) -> None:
    """Readings as the table that ``rssi_csv`` reads."""
    positions = np.array([receiver.pose.position.numpy() for receiver in links.receivers])
    numbers = np.column_stack(
        (links.query.transmitters.numpy(), positions[links.query.receivers.numpy()], links.labels.numpy())
    )
    lines = [",".join(f"{value:.9g}" for value in row) for row in numbers]  # nine digits bring the same float32 back
    write_text(folder / "room.csv", "\n".join(("tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm", *lines)) + "\n")


def write_channels(folder: Path, links: Links) -> None:
    """Channels as the file of arrays that ``csi_npz`` reads."""
    (receiver,) = links.receivers
    with atomic_write(folder / "room.npz") as part:
        np.savez(
            part,
            tx=links.query.transmitters.numpy(),
            rx=receiver.pose.position.numpy()[None],
            rx_index=links.query.receivers.numpy(),
            frequencies=links.task.frequencies.numpy(),
            h=links.labels.numpy(),
            elements=(receiver.array.elements.double() @ receiver.pose.rotation.double().T).numpy(),
        )


WRITERS = {
    "spectrum": ("sionna", nerf2_spectrum.write),
    "rssi": ("sionna_rssi", write_rssi),
    "csi": ("sionna_csi", write_channels),
}
"""Data set and writer of each task."""


def main() -> None:
    # An option that is not given is not passed on, so that the function's defaults hold.
    parser = argparse.ArgumentParser(
        prog="python -m gaigs.data.sionna",
        description="Simulate a room by Sionna RT and write its labels in a layout that gaigs reads.",
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("folder", type=Path, help="folder to write; must not exist, or be empty")
    parser.add_argument(
        "--task",
        choices=WRITERS,
        default="spectrum",
        help="spectra in the layout of NeRF² (default), readings in room.csv, or channels in room.npz",
    )
    parser.add_argument("--room", help="l_shape, slanted or furnished", default="furnished")
    parser.add_argument("--spectrum", choices=("band", "carrier"), help="averaged over the band, or one frequency")
    parser.add_argument("--transmitters", type=int, help="how many; the last fifth of them tests")
    parser.add_argument("--frequency", type=float, help="carrier [Hz]; not of readings")
    parser.add_argument("--bandwidth", type=float, help="width of the band around it [Hz]; not of readings")
    parser.add_argument("--subcarriers", type=int, help="how many, of channels")
    parser.add_argument("--noise", type=float, help="standard deviation of a reading's error [dB]")
    parser.add_argument("--sensitivity", type=float, help="weaker readings are left out [dBm]")
    parser.add_argument("--seed", type=int, help="of the transmitters' places")
    options = vars(parser.parse_args())
    folder, (name, write) = options.pop("folder"), WRITERS[options.pop("task")]
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(f"{folder} must be an empty folder or none, and is not; choose another name")
        links = load({"name": name, **options}, {"name": "official", "validation": 0})
        folder.mkdir(parents=True, exist_ok=True)
        write(folder, links)
        write_text(folder / "geometry.obj", wavefront_obj(find_room(options["room"]).meshes()))
    except (ValueError, TypeError, OSError, ImportError, RuntimeError) as error:
        parser.error(str(error))
    print(f"{folder}: {len(links.split.train)} training and {len(links.split.test)} test labels")


if __name__ == "__main__":
    main()
