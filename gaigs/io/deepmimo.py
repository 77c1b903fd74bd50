"""Scenarios of DeepMIMO v4: folders with the traced paths from base stations to users."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light

from gaigs.io.files import atomic_write, write_text


class Station(NamedTuple):
    """A base station and its paths to users."""

    position: Float[np.ndarray, "3"]  # place of the station [m]
    # Gain of each path at the carrier, with the phase of its length; 0 for no path.
    fields: Complex[np.ndarray, "n p"]
    # Points of up to k reflections in order from the station [m]; NaN for missing points.
    bounces: Float[np.ndarray, "n p k 3"]


def write_scenario(
    folder: str | Path,
    frequency: float,
    users: Float[np.ndarray, "n 3"],
    stations: Sequence[Station],
) -> None:
    """Writes traced paths as a scenario of DeepMIMO v4.

    DeepMIMO loads the scenario by name from ``deepmimo_scenarios`` in the working folder; the name
    must be in lower case. By default DeepMIMO loads the strongest 25 paths of a user.

    Args:
        folder: An existing folder.
        frequency: Carrier [Hz].
        users: Positions [m].

    Example:
        >>> from gaigs.io.deepmimo import Station, write_scenario
        >>> users = np.array([[3.0, 0.0, 1.0], [0.0, 4.0, 1.0]])
        >>> gains = 0.01 * np.exp(-2j * np.pi * 3.5e9 / 299792458 * np.array([[3.0], [4.0]]))
        >>> station = Station(np.array([0.0, 0.0, 1.0]), gains, np.zeros((2, 1, 0, 3)))
        >>> write_scenario(tmp_path, 3.5e9, users, [station])
        >>> np.load(tmp_path / "power_t000_tx000_r001.npz")["power"].round()
        array([[-40.],
               [-40.]], dtype=float32)
    """
    folder = Path(folder)
    depth = 0
    for number, station in enumerate(stations):
        for key, array in _matrices(users, station).items():
            with atomic_write(folder / f"{key}_t000_tx{number:03}_r001.npz") as part:
                np.savez_compressed(part, **{key: array.astype(np.float32)})
        reflections = np.isfinite(station.bounces[station.fields != 0]).all(-1).sum(-1)
        depth = max(depth, int(reflections.max(initial=0)))
    with atomic_write(folder / "vertices.npz") as part:
        np.savez_compressed(part, vertices=np.zeros((0, 3)))
    write_text(folder / "objects.json", "[]\n")
    has_path = np.any([station.fields.any(1) for station in stations], 0)  # (users,)
    params = {
        "version": "4.0.5",
        "rt_params": _tracer_parameters(frequency, depth),
        "scene": {
            "num_scenes": 1,
            "n_objects": 0,
            "n_vertices": 0,
            "n_faces": 0,
            "n_triangular_faces": 0,
        },
        "materials": {},
        "txrx_sets": {
            "txrx_set_0": _set_parameters(0, "base stations", len(stations), len(stations)),
            "txrx_set_1": _set_parameters(1, "users", len(users), int(has_path.sum())),
        },
    }
    write_text(folder / "params.json", json.dumps(params, indent=2) + "\n")


def _tracer_parameters(frequency: float, depth: int) -> dict:
    """The entry ``rt_params``, for paths of at most ``depth`` reflections at a carrier [Hz]."""
    return {
        "raytracer_name": "gaigs",
        "raytracer_version": "",
        "frequency": float(frequency),
        "max_path_depth": depth,
        "max_reflections": depth,
        "max_diffractions": 0,
        "max_scattering": 0,
        "max_transmissions": 0,
        "diffuse_reflections": 0,
        "diffuse_diffractions": 0,
        "diffuse_transmissions": 0,
        "diffuse_final_interaction_only": False,
        "diffuse_random_phases": False,
        "terrain_reflection": False,
        "terrain_diffraction": False,
        "terrain_scattering": False,
        "num_rays": 0,
        "ray_casting_method": "image",
        "synthetic_array": True,
        "ray_casting_range_az": 360.0,
        "ray_casting_range_el": 180.0,
        "gps_bbox": [0, 0, 0, 0],
    }


def _set_parameters(number: int, name: str, points: int, active: int) -> dict:
    """An entry of ``txrx_sets``: set 0 transmits, set 1 receives."""
    return {
        "name": name,
        "id": number,
        "is_tx": number == 0,
        "is_rx": number == 1,
        "num_points": points,
        "num_active_points": active,
        "num_ant": 1,
        "dual_pol": False,
        "ant_rel_positions": [[0, 0, 0]],
        "array_orientation": [0, 0, 0],
        "grid_spacing": None,
    }


def _matrices(users: Float[np.ndarray, "n 3"], station: Station) -> dict[str, np.ndarray]:
    """The arrays of one base station by DeepMIMO's names, strongest paths first.

    ``power`` [dB], ``phase`` [deg], ``delay`` [s], angles [deg] and ``inter`` are (n, p).
    ``inter_pos`` [m] is (n, p, k, 3). Missing paths are NaN.
    """
    order = np.argsort(-np.abs(station.fields), axis=1, kind="stable")  # (n, p)
    fields = np.take_along_axis(station.fields, order, 1)
    bounces = np.take_along_axis(station.bounces, order[..., None, None], 1)  # (n, p, k, 3)
    # Reflections that exist come first.
    is_met = np.isfinite(bounces).all(-1)  # (n, p, k)
    bounces = np.take_along_axis(bounces, np.argsort(~is_met, axis=2, kind="stable")[..., None], 2)
    count = is_met.sum(2)
    exists = fields != 0

    # A missing point counts as the user, so that its leg has no length.
    ends = np.broadcast_to(users[:, None, None], (*fields.shape, 1, 3))
    starts = np.broadcast_to(station.position, ends.shape)
    points = np.concatenate((starts, bounces, ends), 2)  # (n, p, k + 2, 3)
    legs = np.diff(np.where(np.isfinite(points), points, ends), axis=2)  # (n, p, k + 1, 3)
    last = np.take_along_axis(legs, count[..., None, None], 2)[:, :, 0]  # (n, p, 3)
    matrices = {
        "power": 20 * np.log10(np.abs(np.where(exists, fields, 1))),
        "phase": np.angle(fields, deg=True),
        "delay": np.linalg.norm(legs, axis=-1).sum(2) / speed_of_light,
        "inter": (10.0**count - 1) / 9,  # a digit of 1 for each reflection
    }
    # Arrivals and departures both point away from their end. Elevations count from the z axis.
    for end, ray in (("aoa", -last), ("aod", legs[:, :, 0])):
        horizontal = np.hypot(ray[..., 0], ray[..., 1])
        matrices[f"{end}_az"] = np.rad2deg(np.arctan2(ray[..., 1], ray[..., 0]))
        matrices[f"{end}_el"] = np.rad2deg(np.arctan2(horizontal, ray[..., 2]))
    matrices = {key: np.where(exists, array, np.nan) for key, array in matrices.items()}
    matrices["inter_pos"] = np.where(exists[..., None, None], bounces, np.nan)
    return matrices | {"rx_pos": users, "tx_pos": station.position[None]}
