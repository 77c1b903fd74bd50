"""Signal strength at the base stations of DeepMIMO v4 scenarios."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.deepmimo import StationPaths, gather, read_stations
from gaigs.data.impulse_responses import to_channels
from gaigs.data.simulation import rss_dbm, sample_band
from gaigs.registry import register


@register("data", "deepmimo_rssi")
def read(
    root: str | Path, bandwidth: float = 10e6, transmitters: int | None = None, seed: int = 0
) -> Links:
    """Signal strength of users of 0 dBm at the base stations of a scenario, between isotropic
    antennas.

    Files, errors and other options are those of ``deepmimo``.

    Args:
        bandwidth: Width of the band about the scenario's carrier over which power is averaged [Hz].
    """
    frequency, stations, remarks = read_stations(root, with_angles=False)
    offsets = sample_band(
        bandwidth, speed_of_light * max(station.delays.max() for station in stations)
    ).numpy()

    def strengths(station: StationPaths, users: np.ndarray) -> Tensor:
        channels = to_channels(station.fields[users, None], station.delays[users, None], offsets)
        return rss_dbm(torch.from_numpy(channels))

    links = gather(
        stations, strengths, Rssi(), Array.single(), frequency, transmitters, seed, remarks
    )
    return replace(links, bandwidth=bandwidth)
