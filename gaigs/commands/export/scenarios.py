"""Paths of learnt rooms as scenarios of DeepMIMO v4."""

import logging
import math
from pathlib import Path

import numpy as np
import torch
from scipy.constants import speed_of_light

from gaigs.commands.export.predictions import query_of
from gaigs.commands.export.rooms import mirrored_of
from gaigs.core.query import Query
from gaigs.data import deepmimo
from gaigs.io.tables import check_empty, number_places
from gaigs.model import Model
from gaigs.planes.room_paths import trace_paths
from gaigs.processes import only_run

log = logging.getLogger(__name__)

FAINT = 1e-6
"""Amplitude over that of a link's strongest path below which a path is left out: float32 rounds by
as much.
"""


@torch.no_grad()
def write_scenario(
    model: Model, folder: Path, places: object, frequency: float | None = None
) -> list[Path]:
    """Writes the paths of mirrored channels from places to all receivers, without kriging; gives
    the folder.

    Args:
        folder: A missing or empty one.
        places, frequency: As for ``gaigs.commands.export.predictions.write_predictions``; places
            are the users.

    Raises:
        ValueError: The channels are not sums of mirrored paths, there is no place, or the folder is
            not empty.
    """
    own = mirrored_of("a scenario", model)
    if not own.has_margins:
        raise ValueError(
            "a scenario takes channels that are sums of mirrored paths alone\n"
            "train model=mirrored on data of task=csi, without gaussians and trend"
        )
    check_empty(folder)
    asked = query_of("scenarios", own.scene, places, frequency).transmitters.tolist()
    users = torch.tensor(number_places(asked)[0])
    carrier = own.scene.task.frequencies.mean()  # type: ignore[attr-defined]
    unit = own.pooling.strength.item() * speed_of_light / (4 * math.pi * carrier.item())
    stations = []
    for number, receiver in enumerate(own.scene.receivers):
        query = Query(
            users, torch.full((len(users),), number), carrier.to(users).expand(len(users))
        )
        parts = [part.to(own.placement.middle.device) for part in query.parts(64)]
        which = [torch.arange(len(part), device=part.receivers.device) for part in parts]
        heard = [
            own.paths(own.excite(part), rows, number, part)
            for part, rows in zip(parts, which, strict=True)
        ]
        gains = torch.cat([paths.amplitudes for paths in heard]).cpu().to(torch.complex128).numpy()
        sizes = np.abs(gains)
        gains = np.where(sizes > FAINT * sizes.max(1, keepdims=True), unit * gains, 0)
        bounces = (
            trace_paths(own.placement, query).bounces[:, :, ::-1].astype(float)
        )  # from the receiver on
        stations.append((receiver.pose.position.double().numpy(), gains, bounces))
    folder.mkdir(parents=True, exist_ok=True)
    with only_run(folder):
        check_empty(folder)  # another process may have begun to write it
        deepmimo.write(folder, carrier.item(), users.double().numpy(), stations)
    names = ", ".join(
        f"t000_tx{number:03} = {one.name}" for number, one in enumerate(own.scene.receivers)
    )
    log.info("%s: base stations %s", folder, names)
    return [folder]
