"""Scenarios of DeepMIMO v4, folders of ray-traced paths from base stations to users; docs/data.md
describes them.
"""

import json
import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.io
import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query, check_carrier
from gaigs.core.task import Task
from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.data.bands import hold_out_band
from gaigs.data.impulse_responses import lacks_carrier, to_channels
from gaigs.io import FAR, WITHIN
from gaigs.io.files import atomic_write, write_text
from gaigs.io.tables import find_folder, has_file, number_places, quote
from gaigs.registry import register

UPRIGHT = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Rotation of the stations' arrays: rows run upwards, columns along y, and the normal along x, as
DeepMIMO's panels.
"""

RANGES = {
    "rx_pos": (-FAR, FAR, WITHIN),
    "tx_pos": (-FAR, FAR, WITHIN),
    "power": (-360.0, 360.0, "a gain within 360 dB"),
    "phase": (-1e6, 1e6, "an angle in degrees"),
    "delay": (0.0, 1e-3, "a delay of 0 to 1 ms in seconds"),
    "aod_az": (-720.0, 720.0, "an angle in degrees"),
    "aod_el": (
        0.0,
        180.0,
        "an angle from the z axis, 0 to 180 degrees; data.elements=[1, 1] needs none",
    ),
    "inter": (-1.0, math.inf, "a code of interactions, 0 for line of sight"),
}
"""Lowest and highest value of each matrix that is read, and its description; for paths that exist.
"""


@dataclass(frozen=True)
class StationPaths:
    """Paths from a base station to users.

    Attributes:
        name: Transmitter set and number as in file names, such as ``t001_tx000``.
        position: Of the base station [m].
        users: Positions (n, 3) [m].
        fields: Gain of each path at the carrier, with its phase (n, p); 0 for no path.
        delays: (n, p) [s].
        departures: Directions in which paths leave the station (n, p, 3); None if not read.
    """

    name: str
    position: Float[np.ndarray, "3"]
    users: Float[np.ndarray, "n 3"]
    fields: Complex[np.ndarray, "n p"]
    delays: Float[np.ndarray, "n p"]
    departures: Float[np.ndarray, "n p 3"] | None


@register("data", "deepmimo")
def read(
    root: str | Path,
    elements: Sequence[int] = (1, 8),
    bandwidth: float = 10e6,
    subcarriers: int = 16,
    transmitters: int | None = None,
    seed: int = 0,
    phase: str = "known",
    band_train: Sequence[float] | None = None,
    band_test: Sequence[float] | None = None,
) -> Links:
    """Channels from users to the base stations of a scenario; by reciprocity the users transmit.

    Channels are those of DeepMIMO's generator without its factor of 1 / sqrt(subcarriers):
    isotropic antennas, plane waves over the array, time dependence exp(+j omega t). The links of
    one user share a row. Users without a path and paths between base stations are left out. There
    is no official split.

    Args:
        root: Folder with ``params.json`` and a file of each matrix for each base station and set of
            users, such as ``power_t001_tx000_r000.npz`` (or .mat, .npy). Of a dynamic scenario it
            is the folder of one scene.
        elements: Rows and columns of the stations' arrays, half a wavelength of the carrier apart.
        bandwidth: From the lowest subcarrier to the highest, about the scenario's carrier [Hz].
        subcarriers: Evenly over the band; a single one is the carrier.
        transmitters: Number of random users to take; None for all.
        seed: Seed of the choice of users.
        phase: Of ``gaigs.core.task.csi.Csi``.
        band_train, band_test: Subcarriers to train and to test on, as for
            ``gaigs.data.bands.hold_out_band`` [Hz].

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: An option is out of range, or a file is missing or has a defect; the message
            names it.

    Source: the format as the package deepmimo 4.0.5 reads it; Alkhateeb, DeepMIMO, 2019,
    arXiv:1902.06435.
    """
    if len(elements) != 2 or not all(isinstance(count, int) and count > 0 for count in elements):
        raise ValueError(
            f"elements must be the array's rows and columns, such as [1, 8], got {[*elements]}"
        )
    if not 0 < bandwidth < math.inf:
        raise ValueError(f"bandwidth must be positive [Hz], got {bandwidth}")
    if subcarriers < 1:
        raise ValueError(f"subcarriers must be at least 1, got {subcarriers}")
    frequency, stations, remarks = read_stations(root, with_angles=math.prod(elements) > 1)
    array = Array.planar(elements[0], elements[1], speed_of_light / frequency / 2)
    edge = bandwidth / 2 if subcarriers > 1 else 0.0
    offsets = np.linspace(-edge, edge, subcarriers)
    task = Csi(len(array), torch.from_numpy(frequency + offsets), phase)
    wavelengths = (
        array.elements.double().numpy() @ np.array(UPRIGHT).T * (frequency / speed_of_light)
    )

    def channels(station: StationPaths, users: np.ndarray) -> Tensor:
        gains = station.fields[users, None]
        if station.departures is not None:
            turns = np.einsum("npx,ex->nep", station.departures[users], wavelengths)
            gains = gains * np.exp(2j * np.pi * turns)
        return torch.from_numpy(to_channels(gains, station.delays[users, None], offsets))

    links = gather(stations, channels, task, array, frequency, transmitters, seed, remarks)
    return hold_out_band(links, band_train, band_test)


def gather(
    stations: Sequence[StationPaths],
    measure: Callable[[StationPaths, np.ndarray], Tensor],
    task: Task,
    array: Array,
    frequency: float,
    transmitters: int | None,
    seed: int,
    remarks: Sequence[str],
) -> Links:
    """Links from users to the stations that have a path to them; ``measure`` gives the labels of
    some of its users.
    """
    heard = [np.flatnonzero(station.fields.any(1)) for station in stations]
    users = np.concatenate(
        [station.users[own] for station, own in zip(stations, heard, strict=True)]
    )
    places, rows = number_places(users.tolist())
    if transmitters is not None:
        if not 2 <= transmitters <= len(places):
            raise ValueError(
                f"transmitters must be 2 to {len(places)}, the users with a path, got {transmitters}"
            )
        chosen = torch.randperm(len(places), generator=torch.Generator().manual_seed(seed))[
            :transmitters
        ]
        kept = torch.isin(rows, chosen)
        heard = [
            own[part.numpy()]
            for own, part in zip(heard, kept.split([*map(len, heard)]), strict=True)
        ]
        users, rows = users[kept.numpy()], rows[kept].unique(return_inverse=True)[1]
    counts = torch.tensor([*map(len, heard)])
    names = [station.name for station in stations]
    present = sorted({name for name, own in zip(names, heard, strict=True) if len(own)})
    number = torch.tensor([present.index(name) if name in present else -1 for name in names])
    poses = {
        s.name: Pose(torch.from_numpy(s.position).float(), torch.tensor(UPRIGHT)) for s in stations
    }
    every = len(np.unique(np.concatenate([station.users for station in stations]), axis=0))
    absent = sorted({*names} - {*present})
    return Links(
        query=Query(
            torch.from_numpy(users).float(),
            number.repeat_interleave(counts),
            torch.full((len(users),), frequency),
        ),
        receivers=tuple(Receiver(name, poses[name], array) for name in present),
        labels=torch.cat(
            [measure(station, own) for station, own in zip(stations, heard, strict=True)]
        ),
        task=task,
        rows=rows,
        remarks="; ".join(
            (
                f"{len(users)} links from {len(rows.unique())} of {every} users to {len(present)} base stations",
                f"{every - len(places)} users without a path are left out",
                *([f"stations without a path are left out: {', '.join(absent)}"] if absent else []),
                *remarks,
            )
        ),
    )


def read_stations(
    root: str | Path, with_angles: bool
) -> tuple[float, list[StationPaths], list[str]]:
    """The carrier of a scenario [Hz], its paths of each base station and set of users, and remarks
    on them.
    """
    root = find_folder(root)
    names = sorted(
        path.name for path in (*root.iterdir(), *root.glob("*/*.mat"))
    )  # scenes have a folder each
    old = [
        name
        for name in names
        if re.fullmatch(r"BS\d+_(BS|UE_\d+-\d+)\.mat|.*\.\d+\.(CIR|DoA|DoD)\.mat", name)
    ]
    if old:
        raise ValueError(
            f"{root}: a scenario of DeepMIMO v3 or before, as {old[0]} shows; get that of v4\n"
            f"by the package deepmimo: deepmimo.download({root.name!r}), or deepmimo.convert of the ray tracer's files"
        )
    file = root / "params.json"
    if not has_file(file) and has_file(
        root.parent / file.name
    ):  # of a dynamic scenario, one folder a scene
        file = root.parent / file.name
    try:
        params = json.loads(file.read_text(encoding="utf-8"))
        frequency, tracer = (
            float(params["rt_params"]["frequency"]),
            str(params["rt_params"].get("raytracer_name")),
        )
        both = {int(own["id"]) for own in params["txrx_sets"].values() if own["is_tx"]}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        expected = "rt_params.frequency and txrx_sets, as DeepMIMO v4 writes them"
        raise ValueError(f"cannot parse {file}: {cause}; expected {expected}") from error
    check_carrier(f"{file}: rt_params.frequency", frequency)
    pattern = re.compile(r"power_((t\d+_tx\d+)_r(\d+))\.(?:npz|mat|npy)")
    found = sorted(
        {
            m.groups()
            for name in sorted(p.name for p in root.iterdir())
            if (m := pattern.fullmatch(name))
        }
    )
    pairs = [(code, name) for code, name, users in found if int(users) not in both]
    if not pairs:
        folders = quote([path.name for path in root.iterdir() if path.is_dir()])
        raise ValueError(
            f"{root}: expected paths from base stations to users, such as power_t000_tx000_r001.npz, got none; of a "
            f"dynamic scenario root is the folder of one scene, of {folders}"
        )
    stations, direct = [], []
    for code, name in pairs:
        station, is_direct = _read_station(root, code, name, with_angles)
        stations.append(station)
        direct.append((station.fields[is_direct], station.delays[is_direct]))
    if not any(station.fields.any() for station in stations):
        names = ", ".join(_find(root, f"power_{code}").name for code, _ in pairs)
        raise ValueError(f"{root}: expected a path to a user in {names}, got none")
    remarks = []
    fields, delays = (np.concatenate(part) for part in zip(*direct, strict=True))
    if lacks_carrier(fields, delays, frequency, otherwise=tracer.startswith("Sionna")):
        turn = lambda station: np.exp(-2j * np.pi * frequency * station.delays)
        stations = [replace(station, fields=station.fields * turn(station)) for station in stations]
        remarks.append(
            "phases lack the carrier's over the delay, as those of Sionna RT; it is added"
        )
    return frequency, stations, remarks


def _read_station(
    root: Path, code: str, name: str, with_angles: bool
) -> tuple[StationPaths, np.ndarray]:
    """The paths of one base station and set of users, and True for those in line of sight (n, p)."""
    angles = ("aod_az", "aod_el") if with_angles else ()
    names = ("power", "rx_pos", "tx_pos", "phase", "delay", *angles, "inter")
    files = {key: _find(root, f"{key}_{code}") for key in names}
    arrays = {key: _load(file, key) for key, file in files.items()}
    shape = arrays["power"].shape
    if len(shape) != 2:
        raise ValueError(f"{files['power']}: expected the shape (users, paths), got {shape}")
    exists = ~np.isnan(arrays["power"]) & (arrays["power"] != -np.inf)
    for key, array in arrays.items():
        is_position = key.endswith("_pos")
        expected = ({"tx_pos": 1}.get(key, shape[0]), 3) if is_position else shape
        if array.shape != expected:
            raise ValueError(
                f"{files[key]}: expected the shape {expected} to {files['power'].name} of {shape}, got {array.shape}"
            )
        low, high, expected = RANGES[key]
        wrong = np.argwhere(~((low <= array) & (array <= high)) & (is_position or exists))
        if len(wrong):
            at, got = f"{files[key]}: {key}{wrong[0].tolist()}", f"{array[tuple(wrong[0])]:.7g}"
            raise ValueError(f"{at}: expected {expected}, got {got} ({len(wrong)} of {array.size})")
        arrays[key] = array if is_position else np.where(exists, array, 0)
    powers = arrays["power"][exists]
    if (
        len(powers) and 0 <= powers.min() and powers.max() <= 1
    ):  # no passive path has a gain of 0 dB or more
        span = f"{powers.min():.3g} to {powers.max():.3g}"
        raise ValueError(
            f"{files['power']}: expected gains in dB, got {span} for all paths, as if linear\n"
            "store 10 log10 of powers, or 20 log10 of amplitudes"
        )
    departures = None
    if with_angles:
        azimuths, zeniths = np.deg2rad(arrays["aod_az"]), np.deg2rad(arrays["aod_el"])
        level = np.sin(zeniths)
        departures = np.stack(
            (level * np.cos(azimuths), level * np.sin(azimuths), np.cos(zeniths)), -1
        )
    fields = exists * 10 ** (arrays["power"] / 20) * np.exp(1j * np.deg2rad(arrays["phase"]))
    station = StationPaths(
        name, arrays["tx_pos"][0], arrays["rx_pos"], fields, arrays["delay"], departures
    )
    return station, exists & (arrays["inter"] == 0)


def _find(root: Path, stem: str) -> Path:
    """The file of a matrix, the first one in DeepMIMO's own order of formats."""
    files = [root / f"{stem}{suffix}" for suffix in (".mat", ".npz", ".npy")]
    found = next(filter(has_file, files), None)
    if found is None:
        raise ValueError(f"{root}: expected {files[1].name}, got no such file")
    return found


def _load(file: Path, name: str) -> np.ndarray:
    """A matrix as float64."""
    try:
        with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
            if file.suffix == ".mat":
                array = scipy.io.loadmat(stream, variable_names=[name])[name]
            else:
                content = np.load(stream, allow_pickle=False)
                array = content if file.suffix == ".npy" else content[name]
            if array.dtype.kind not in "iuf":
                raise ValueError(f"{array.dtype} for real numbers")
            return array.astype(float).reshape(
                (1, 3) if name == "tx_pos" and array.size == 3 else array.shape
            )
    except Exception as error:  # damaged files make numpy and scipy raise exceptions of many types
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"cannot parse {file}: {cause}; expected an array {name!r} of real numbers"
        ) from error


def write(
    folder: str | Path,
    frequency: float,
    users: Float[np.ndarray, "n 3"],
    stations: Sequence[
        tuple[Float[np.ndarray, "3"], Complex[np.ndarray, "n p"], Float[np.ndarray, "n p k 3"]]
    ],
) -> None:
    """Writes traced paths as a scenario of DeepMIMO v4.

    DeepMIMO loads it by name from ``deepmimo_scenarios`` in the working folder, if the name has no
    capitals; of its own accord it loads the strongest 25 paths of a user.

    Args:
        folder: An existing folder.
        frequency: Carrier [Hz].
        users: Positions [m].
        stations: Of each base station its position [m], the gain of each path at the carrier with
            the phase of its length, 0 for no path, and the points of its reflections from the
            station on [m], NaN in place of missing ones.

    Example:
        >>> from gaigs.data import deepmimo
        >>> users, station = np.array([[3.0, 0.0, 1.0], [0.0, 4.0, 1.0]]), np.array([0.0, 0.0, 1.0])
        >>> gains = 0.01 * np.exp(-2j * np.pi * 3.5e9 / 299792458 * np.array([[3.0], [4.0]]))
        >>> deepmimo.write(tmp_path, 3.5e9, users, [(station, gains, np.zeros((2, 1, 0, 3)))])
        >>> deepmimo.read(tmp_path, subcarriers=4).labels.shape
        torch.Size([2, 8, 4])
    """
    folder, depth = Path(folder), 0
    for number, (position, fields, bounces) in enumerate(stations):
        for key, array in _matrices(users, position, fields, bounces).items():
            with atomic_write(folder / f"{key}_t000_tx{number:03}_r001.npz") as part:
                np.savez_compressed(part, **{key: array.astype(np.float32)})
        depth = max(depth, int(np.isfinite(bounces[fields != 0]).all(-1).sum(-1).max(initial=0)))
    with atomic_write(folder / "vertices.npz") as part:
        np.savez_compressed(part, vertices=np.zeros((0, 3)))
    write_text(folder / "objects.json", "[]\n")
    heard = np.any([fields.any(1) for _, fields, _ in stations], 0)
    sets = (
        ("base stations", len(stations), len(stations)),
        ("users", len(users), int(heard.sum())),
    )
    params = {
        "version": "4.0.5",
        "rt_params": {
            "raytracer_name": "gaigs",
            "raytracer_version": "",
            "frequency": float(frequency),
            "max_path_depth": depth,
            "max_reflections": depth,
            **dict.fromkeys(("max_diffractions", "max_scattering", "max_transmissions"), 0),
            **{f"diffuse_{kind}": 0 for kind in ("reflections", "diffractions", "transmissions")},
            **dict.fromkeys(("diffuse_final_interaction_only", "diffuse_random_phases"), False),
            **{f"terrain_{kind}": False for kind in ("reflection", "diffraction", "scattering")},
            **{"num_rays": 0, "ray_casting_method": "image", "synthetic_array": True},
            **{
                "ray_casting_range_az": 360.0,
                "ray_casting_range_el": 180.0,
                "gps_bbox": [0, 0, 0, 0],
            },
        },
        "scene": {
            "num_scenes": 1,
            "n_objects": 0,
            "n_vertices": 0,
            "n_faces": 0,
            "n_triangular_faces": 0,
        },
        "materials": {},
        "txrx_sets": {
            f"txrx_set_{k}": {
                "name": name,
                "id": k,
                "is_tx": k == 0,
                "is_rx": k == 1,
                "num_points": count,
                "num_active_points": active,
                "num_ant": 1,
                "dual_pol": False,
                "ant_rel_positions": [[0, 0, 0]],
                "array_orientation": [0, 0, 0],
                "grid_spacing": None,
            }
            for k, (name, count, active) in enumerate(sets)
        },
    }
    write_text(folder / "params.json", json.dumps(params, indent=2) + "\n")


def _matrices(
    users: Float[np.ndarray, "n 3"],
    position: Float[np.ndarray, "3"],
    fields: Complex[np.ndarray, "n p"],
    bounces: Float[np.ndarray, "n p k 3"],
) -> dict[str, np.ndarray]:
    """All matrices of one base station, strongest paths first, NaN where there is no path."""
    order = np.argsort(-np.abs(fields), axis=1, kind="stable")
    fields, bounces = (
        np.take_along_axis(fields, order, 1),
        np.take_along_axis(bounces, order[..., None, None], 1),
    )
    met = np.isfinite(bounces).all(-1)
    bounces = np.take_along_axis(bounces, np.argsort(~met, axis=2, kind="stable")[..., None], 2)
    count, exists = met.sum(2), fields != 0
    # A missing point counts as the user, so that its leg has no length.
    ends = np.broadcast_to(users[:, None, None], (*fields.shape, 1, 3))
    points = np.concatenate((np.broadcast_to(position, ends.shape), bounces, ends), 2)
    legs = np.diff(np.where(np.isfinite(points), points, ends), axis=2)
    first, last = legs[:, :, 0], np.take_along_axis(legs, count[..., None, None], 2)[:, :, 0]
    angles = {"aoa": -last, "aod": first}  # both point away from their end
    found = {
        "power": 20 * np.log10(np.abs(np.where(exists, fields, 1))),
        "phase": np.angle(fields, deg=True),
        "delay": np.linalg.norm(legs, axis=-1).sum(2) / speed_of_light,
        **{
            f"{end}_az": np.rad2deg(np.arctan2(ray[..., 1], ray[..., 0]))
            for end, ray in angles.items()
        },
        **{
            f"{end}_el": np.rad2deg(np.arctan2(np.hypot(*ray[..., :2].T).T, ray[..., 2]))
            for end, ray in angles.items()
        },
        "inter": (10.0**count - 1) / 9,  # a digit of 1 for each reflection
    }
    found = {key: np.where(exists, array, np.nan) for key, array in found.items()}
    found["inter_pos"] = np.where(exists[..., None, None], bounces, np.nan)
    return found | {"rx_pos": users, "tx_pos": position[None]}
