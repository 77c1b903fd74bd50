"""Scenarios of DeepMIMO v4, folders of ray-traced paths from base stations to users.

docs/data.md of gaigs describes their files.
"""

import json
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query, check_carrier
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.data.impulse_responses import lacks_carrier
from gaigs.io import FAR, WITHIN
from gaigs.io.tables import find_folder, has_file, number_places, quote

UPRIGHT = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Rotation of the stations' arrays, as DeepMIMO's panels: rows run upwards, columns along y, and
the normal along x.
"""


class Range(NamedTuple):
    """Lowest and highest value of a matrix, and its description for errors."""

    low: float
    high: float
    expected: str


ZENITH = "an angle from the z axis, 0 to 180 degrees; data.elements=[1, 1] needs none"
RANGES = {
    "rx_pos": Range(-FAR, FAR, WITHIN),
    "tx_pos": Range(-FAR, FAR, WITHIN),
    "power": Range(-360.0, 360.0, "a gain within 360 dB"),
    "phase": Range(-1e6, 1e6, "an angle in degrees"),
    "delay": Range(0.0, 1e-3, "a delay of 0 to 1 ms in seconds"),
    "aod_az": Range(-720.0, 720.0, "an angle in degrees"),
    "aod_el": Range(0.0, 180.0, ZENITH),
    "inter": Range(-1.0, math.inf, "a code of interactions, 0 for line of sight"),
}
"""Values of paths that exist, for each matrix that is read."""


@dataclass(frozen=True)
class StationPaths:
    """Paths from a base station to users.

    Attributes:
        name: Transmitter set and number as in file names, such as ``t001_tx000``.
        position: Position of the base station [m].
        users: Positions of the users [m].
        fields: Gain of each path at the carrier, with its phase; 0 for no path.
        delays: Delay of each path [s].
        departures: Directions in which paths leave the station; None if not read.
        is_direct: True for lines of sight.
    """

    name: str
    position: Float[np.ndarray, "3"]
    users: Float[np.ndarray, "n 3"]
    fields: Complex[np.ndarray, "n p"]
    delays: Float[np.ndarray, "n p"]
    departures: Float[np.ndarray, "n p 3"] | None
    is_direct: np.ndarray


class Scenario(NamedTuple):
    """The traced paths of a scenario."""

    frequency: float  # carrier [Hz]
    stations: list[StationPaths]  # one for each base station and set of users
    remarks: list[str]


class ChosenUsers(NamedTuple):
    """Users that links are made for.

    Attributes:
        of_station: Rows of each station's chosen users.
        places: Positions of all links' users [m].
        rows: Number of each link's user.
        count: Number of users with a path, chosen or not.
    """

    of_station: list[Int[np.ndarray, " k"]]
    places: Float[np.ndarray, "n 3"]
    rows: Int[Tensor, " n"]
    count: int


def choose_users(
    stations: Sequence[StationPaths], transmitters: int | None, seed: int
) -> ChosenUsers:
    """Users with a path to a station: all, or so many random ``transmitters`` of them."""
    of_station = [np.flatnonzero(station.fields.any(1)) for station in stations]
    places = np.concatenate(
        [station.users[rows] for station, rows in zip(stations, of_station, strict=True)]
    )
    distinct, rows = number_places(places.tolist())
    if transmitters is None:
        return ChosenUsers(of_station, places, rows, len(distinct))
    if not 2 <= transmitters <= len(distinct):
        raise ValueError(
            f"transmitters must be 2 to {len(distinct)}, the users with a path, got {transmitters}"
        )
    order = torch.randperm(len(distinct), generator=torch.Generator().manual_seed(seed))
    is_chosen = torch.isin(rows, order[:transmitters])  # (links,)
    parts = is_chosen.split([*map(len, of_station)])
    of_station = [users[part.numpy()] for users, part in zip(of_station, parts, strict=True)]
    rows = rows[is_chosen].unique(return_inverse=True)[1]
    return ChosenUsers(of_station, places[is_chosen.numpy()], rows, len(distinct))


def to_links(
    scenario: Scenario, chosen: ChosenUsers, labels: Tensor, task: Task, array: Array
) -> Links:
    """Links from users to the stations that have a path to them."""
    stations = scenario.stations
    counts = [len(rows) for rows in chosen.of_station]
    names = [station.name for station in stations]
    present = sorted({name for name, count in zip(names, counts, strict=True) if count})
    absent = sorted({*names} - {*present})
    number = torch.tensor([present.index(name) if name in present else -1 for name in names])
    poses = {}
    for station in stations:
        position = torch.from_numpy(station.position).float()
        poses[station.name] = Pose(position, torch.tensor(UPRIGHT))
    every = len(np.unique(np.concatenate([station.users for station in stations]), axis=0))

    links = len(chosen.rows)
    remarks = [
        f"{links} links from {len(chosen.rows.unique())} of {every} users "
        f"to {len(present)} base stations",
        f"{every - chosen.count} users without a path are left out",
    ]
    if absent:
        remarks.append(f"stations without a path are left out: {', '.join(absent)}")
    return Links(
        query=Query(
            torch.from_numpy(chosen.places).float(),
            number.repeat_interleave(torch.tensor(counts)),
            torch.full((links,), scenario.frequency),
        ),
        receivers=tuple(Receiver(name, poses[name], array) for name in present),
        labels=labels,
        task=task,
        rows=chosen.rows,
        remarks="; ".join([*remarks, *scenario.remarks]),
    )


def read_scenario(root: str | Path, with_angles: bool) -> Scenario:
    """The carrier and the paths of a scenario, with angles of departure if asked for.

    Phases without the carrier's turn over the delay, as of Sionna RT, get it.
    """
    root = find_folder(root)
    _refuse_old_formats(root)
    parameters = _read_parameters(root)
    codes = _station_codes(root, parameters.both_ends)
    stations = [_read_station(root, code, with_angles) for code in codes]
    if not any(station.fields.any() for station in stations):
        names = ", ".join(_find(root, f"power_{code}").name for code in codes)
        raise ValueError(f"{root}: expected a path to a user in {names}, got none")
    frequency = parameters.frequency
    fields = np.concatenate([station.fields[station.is_direct] for station in stations])
    delays = np.concatenate([station.delays[station.is_direct] for station in stations])
    remarks = []
    is_sionna = parameters.tracer.startswith("Sionna")
    if lacks_carrier(fields, delays, frequency, otherwise=is_sionna):
        with_carrier = []
        for station in stations:
            waves = np.exp(-2j * np.pi * frequency * station.delays)
            with_carrier.append(replace(station, fields=station.fields * waves))
        stations = with_carrier
        remarks.append(
            "phases lack the carrier's over the delay, as those of Sionna RT; it is added"
        )
    return Scenario(frequency, stations, remarks)


def _refuse_old_formats(root: Path) -> None:
    """Raises a ``ValueError`` for a scenario of DeepMIMO v3 or before."""
    # Scenes of dynamic scenarios have a folder each.
    names = sorted(path.name for path in (*root.iterdir(), *root.glob("*/*.mat")))
    for name in names:
        if re.fullmatch(r"BS\d+_(BS|UE_\d+-\d+)\.mat|.*\.\d+\.(CIR|DoA|DoD)\.mat", name):
            raise ValueError(
                f"{root}: a scenario of DeepMIMO v3 or before, as {name} shows; get that of v4\n"
                f"by the package deepmimo: deepmimo.download({root.name!r}), "
                "or deepmimo.convert of the ray tracer's files"
            )


class Parameters(NamedTuple):
    """Entries of ``params.json``.

    Attributes:
        frequency: Carrier [Hz].
        tracer: Name of the ray tracer.
        both_ends: Numbers of the sets of base stations, which may receive, too.
    """

    frequency: float
    tracer: str
    both_ends: set[int]


def _read_parameters(root: Path) -> Parameters:
    """Entries of ``params.json``, which a dynamic scenario has one folder above its scenes."""
    file = root / "params.json"
    if not has_file(file) and has_file(root.parent / file.name):
        file = root.parent / file.name
    try:
        params = json.loads(file.read_text(encoding="utf-8"))
        traced = params["rt_params"]
        frequency = float(traced["frequency"])
        both_ends = {int(entry["id"]) for entry in params["txrx_sets"].values() if entry["is_tx"]}
        parameters = Parameters(frequency, str(traced.get("raytracer_name")), both_ends)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        expected = "rt_params.frequency and txrx_sets, as DeepMIMO v4 writes them"
        raise ValueError(f"cannot parse {file}: {cause}; expected {expected}") from error
    check_carrier(f"{file}: rt_params.frequency", parameters.frequency)
    return parameters


def _station_codes(root: Path, both_ends: set[int]) -> list[str]:
    """Codes of stations and sets of users in file names, such as ``t001_tx000_r000``."""
    codes: set[str] = set()
    for path in root.iterdir():
        match = re.fullmatch(r"power_(t\d+_tx\d+_r(\d+))\.(?:npz|mat|npy)", path.name)
        # Paths between base stations are no links.
        if match and int(match[2]) not in both_ends:
            codes.add(match[1])
    if not codes:
        folders = quote([path.name for path in root.iterdir() if path.is_dir()])
        raise ValueError(
            f"{root}: expected paths from base stations to users, such as "
            "power_t000_tx000_r001.npz, got none; of a dynamic scenario root is the folder of "
            f"one scene, of {folders}"
        )
    return sorted(codes)


def _read_station(root: Path, code: str, with_angles: bool) -> StationPaths:
    """The paths of one base station and set of users."""
    angles = ("aod_az", "aod_el") if with_angles else ()
    names = ("power", "rx_pos", "tx_pos", "phase", "delay", *angles, "inter")
    files = {key: _find(root, f"{key}_{code}") for key in names}
    arrays = {key: _load(file, key) for key, file in files.items()}
    shape = arrays["power"].shape
    if len(shape) != 2:
        raise ValueError(f"{files['power']}: expected the shape (users, paths), got {shape}")
    exists = ~np.isnan(arrays["power"]) & (arrays["power"] != -np.inf)  # (n, p)
    for key, array in arrays.items():
        is_position = key.endswith("_pos")
        expected = ({"tx_pos": 1}.get(key, shape[0]), 3) if is_position else shape
        if array.shape != expected:
            raise ValueError(
                f"{files[key]}: expected the shape {expected} to {files['power'].name} "
                f"of {shape}, got {array.shape}"
            )
        _check_range(files[key], key, array, is_position or exists)
        arrays[key] = array if is_position else np.where(exists, array, 0)
    _check_decibels(files["power"], arrays["power"][exists])
    departures = None
    if with_angles:
        azimuths = np.deg2rad(arrays["aod_az"])
        zeniths = np.deg2rad(arrays["aod_el"])
        horizontal = np.sin(zeniths)
        directions = (horizontal * np.cos(azimuths), horizontal * np.sin(azimuths), np.cos(zeniths))
        departures = np.stack(directions, -1)  # (n, p, 3)
    fields = exists * 10 ** (arrays["power"] / 20) * np.exp(1j * np.deg2rad(arrays["phase"]))
    return StationPaths(
        name=code.rpartition("_")[0],
        position=arrays["tx_pos"][0],
        users=arrays["rx_pos"],
        fields=fields,
        delays=arrays["delay"],
        departures=departures,
        is_direct=exists & (arrays["inter"] == 0),
    )


def _check_range(file: Path, key: str, array: np.ndarray, counts: bool | np.ndarray) -> None:
    """Raises a ``ValueError`` for a value out of range, where ``counts`` is true."""
    low, high, expected = RANGES[key]
    wrong = np.argwhere(~((low <= array) & (array <= high)) & counts)
    if len(wrong):
        place = f"{file}: {key}{wrong[0].tolist()}"
        value = f"{array[tuple(wrong[0])]:.7g}"
        share = f"{len(wrong)} of {array.size}"
        raise ValueError(f"{place}: expected {expected}, got {value} ({share})")


def _check_decibels(file: Path, powers: Float[np.ndarray, " k"]) -> None:
    """Raises a ``ValueError`` for powers that are linear."""
    # No passive path has a gain of 0 dB or more.
    if len(powers) and 0 <= powers.min() and powers.max() <= 1:
        span = f"{powers.min():.3g} to {powers.max():.3g}"
        raise ValueError(
            f"{file}: expected gains in dB, got {span} for all paths, as if linear\n"
            "store 10 log10 of powers, or 20 log10 of amplitudes"
        )


def _find(root: Path, stem: str) -> Path:
    """The file of a matrix, the first one in DeepMIMO's own order of formats."""
    for suffix in (".mat", ".npz", ".npy"):
        file = root / f"{stem}{suffix}"
        if has_file(file):
            return file
    raise ValueError(f"{root}: expected {stem}.npz, got no such file")


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
    # Damaged files make numpy and scipy raise exceptions of many types.
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"cannot parse {file}: {cause}; expected an array {name!r} of real numbers"
        ) from error
    is_vector = name == "tx_pos" and array.size == 3
    return array.astype(float).reshape((1, 3) if is_vector else array.shape)
