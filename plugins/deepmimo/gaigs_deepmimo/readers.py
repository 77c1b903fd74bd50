"""Channels and signal strengths at the base stations of a scenario."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.bands import hold_out_band
from gaigs.data.impulse_responses import to_channels
from gaigs.data.simulation import rss_dbm, sample_band

from .scenarios import UPRIGHT, StationPaths, choose_users, read_scenario, to_links


def read_channels(
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

    DeepMIMO's generator gives the same channels times 1 / sqrt(subcarriers): isotropic antennas,
    plane waves over the array, time dependence exp(+j omega t). The links of
    one user share a row. Users without a path and paths between base stations are left out. There
    is no official split.

    Args:
        root: Folder with ``params.json`` and a file for each matrix, base station and set of users,
            such as ``power_t001_tx000_r000.npz`` (or .mat, .npy). A dynamic scenario has such a
            folder for each scene.
        elements: Rows and columns of the stations' arrays, half a wavelength of the carrier apart.
        bandwidth: From the lowest subcarrier to the highest, about the scenario's carrier [Hz].
        subcarriers: Number of subcarriers, evenly over the band; a single one is the carrier.
        transmitters: Number of random users to take; None for all.
        seed: Seed of the choice of users.
        phase: See ``gaigs.core.task.csi.Csi``.
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
    scenario = read_scenario(root, with_angles=math.prod(elements) > 1)
    frequency = scenario.frequency
    array = Array.planar(elements[0], elements[1], speed_of_light / frequency / 2)
    edge = bandwidth / 2 if subcarriers > 1 else 0.0
    offsets = np.linspace(-edge, edge, subcarriers)
    task = Csi(len(array), torch.from_numpy(frequency + offsets), phase)
    # Positions of the elements in the world's axes [wavelengths].
    wavelengths = (
        array.elements.double().numpy() @ np.array(UPRIGHT).T * (frequency / speed_of_light)
    )

    def channels(station: StationPaths, users: np.ndarray) -> Tensor:
        """Channels of users, rows of ``station.users``, at a station (n, e, s)."""
        gains = station.fields[users, None]  # (n, 1, p)
        if station.departures is not None:
            # A plane wave towards u reaches an element at x by exp(2 j pi u . x / wavelength).
            turns = np.einsum("npx,ex->nep", station.departures[users], wavelengths)
            gains = gains * np.exp(2j * np.pi * turns)
        return torch.from_numpy(to_channels(gains, station.delays[users, None], offsets))

    chosen = choose_users(scenario.stations, transmitters, seed)
    labels = [
        channels(station, users)
        for station, users in zip(scenario.stations, chosen.of_station, strict=True)
    ]
    links = to_links(scenario, chosen, torch.cat(labels), task, array)
    return hold_out_band(links, band_train, band_test)


def read_strengths(
    root: str | Path, bandwidth: float = 10e6, transmitters: int | None = None, seed: int = 0
) -> Links:
    """Signal strength of users of 0 dBm at the base stations of a scenario.

    Antennas are isotropic. For files, errors and other options see ``deepmimo``.

    Args:
        bandwidth: Width of the band about the scenario's carrier over which power is averaged [Hz].
    """
    scenario = read_scenario(root, with_angles=False)
    longest = max(station.delays.max() for station in scenario.stations)
    offsets = sample_band(bandwidth, speed_of_light * longest).numpy()
    chosen = choose_users(scenario.stations, transmitters, seed)
    labels = []
    for station, users in zip(scenario.stations, chosen.of_station, strict=True):
        channels = to_channels(station.fields[users, None], station.delays[users, None], offsets)
        labels.append(rss_dbm(torch.from_numpy(channels)))
    links = to_links(scenario, chosen, torch.cat(labels), Rssi(), Array.single())
    return replace(links, bandwidth=bandwidth)
