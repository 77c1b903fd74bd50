"""Paths of learnt rooms as scenarios of DeepMIMO v4."""

import logging
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex
from numpy import ndarray
from scipy.constants import speed_of_light

from gaigs.commands.export.predictions import query_of
from gaigs.commands.export.rooms import mirrored_of
from gaigs.core.query import Query
from gaigs.io import deepmimo
from gaigs.io.tables import check_empty, number_places
from gaigs.model import Model
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.room_paths import trace_paths
from gaigs.processes import only_run

log = logging.getLogger(__name__)


@torch.no_grad()
def write_scenario(
    model: Model, folder: Path, places: object, frequency: float | None = None
) -> list[Path]:
    """Writes the paths of mirrored channels from places to all receivers, without kriging.

    Receivers become the scenario's base stations, and ``places`` its users. Arguments are as for
    ``gaigs.commands.export.predictions.write_predictions``. The folder must be missing or empty.
    """
    mirrored = mirrored_of("a scenario", model)
    if not mirrored.has_margins:
        raise ValueError(
            "a scenario takes channels that are sums of mirrored paths alone\n"
            "train model=mirrored on data of task=csi, without gaussians and trend"
        )
    check_empty(folder)
    receivers = mirrored.scene.receivers
    query = query_of("scenarios", mirrored.scene, places, frequency)
    distinct_places, _ = number_places(query.transmitters.tolist())
    users = torch.tensor(distinct_places)  # (users, 3)
    carrier = mirrored.scene.task.frequencies.mean()  # type: ignore[attr-defined]
    stations = []
    for number, receiver in enumerate(receivers):
        receiver_numbers = torch.full((len(users),), number)
        query = Query(users, receiver_numbers, carrier.to(users).expand(len(users)))
        bounces = trace_paths(mirrored.placement, query).bounces  # (users, paths, order, 3)
        stations.append(
            deepmimo.Station(
                position=receiver.pose.position.double().numpy(),
                fields=_fields(mirrored, query, number, carrier.item()),
                bounces=bounces[:, :, ::-1].astype(float),  # from the receiver on
            )
        )
    folder.mkdir(parents=True, exist_ok=True)
    with only_run(folder):
        check_empty(folder)  # another process may have begun to write it
        deepmimo.write_scenario(folder, carrier.item(), users.double().numpy(), stations)
    names = [f"t000_tx{number:03} = {receiver.name}" for number, receiver in enumerate(receivers)]
    log.info("%s: base stations %s", folder, ", ".join(names))
    return [folder]


def _fields(
    model: MirroredSplatting, query: Query, receiver: int, carrier: float
) -> Complex[ndarray, "users paths"]:
    """Complex gains of paths from users to a receiver at the carrier [Hz]; 0 without a path."""
    amplitudes = []
    for batch in query.parts(64):
        batch = batch.to(model.placement.middle.device)
        rows = torch.arange(len(batch), device=batch.receivers.device)
        paths = model.paths(model.excite(batch), rows, receiver, batch)
        amplitudes.append(paths.amplitudes)
    relative_gains = torch.cat(amplitudes).cpu().to(torch.complex128).numpy()  # (users, paths)
    magnitudes = np.abs(relative_gains)
    # Weaker paths are rounding errors: float32 has seven digits of a link's strongest path.
    faintest = 1e-6 * magnitudes.max(1, keepdims=True)
    # The model's gains are relative to free space at 1 m, whose amplitude is
    # wavelength / (4 pi) (Friis).
    gain_at_1_m = model.pooling.strength.item() * speed_of_light / (4 * math.pi * carrier)
    return np.where(magnitudes > faintest, gain_at_1_m * relative_gains, 0)
