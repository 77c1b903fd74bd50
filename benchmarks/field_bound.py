"""Scores that the images in a room's known walls allow in a field of few numbers a place.

    python benchmarks/field_bound.py FILE.npz --box -1.5 -1.5 0 1.5 1.5 2.5    a box room: its two corners [m]
    python benchmarks/field_bound.py built-in --frequency 2.4e9                the built-in room, one antenna
    python benchmarks/field_bound.py built-in --isotropic --empty              no pattern, no furniture

``FILE`` is as for ``data=csi_npz``, phases known. The second command also writes the field into
``runs/field.npz``. Strengths are fitted to training and validation links of the default split. Prints a
table in Markdown: median SNR and NMSE of the test links [dB] with paths of up to 1, 2 and 3 reflections, by
least squares with one complex strength a path; by gains that paths share; and by these gains with strengths
that vary over places (kriging by path). What the second column lacks is strengths by angle, what the last one
gains is shadows, and what it lacks is further planes, edges and noise. docs/results.md has the numbers.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gaigs.data import Links, load
from gaigs.data.simulation import simulate_channels
from gaigs.data.synthetic import ROOM, default_room, respond_in_parts
from gaigs.planes.channel_links import SLABS, ChannelData, ChannelOptions
from gaigs.planes.field_room import FieldFit, FieldRoom, Variation
from gaigs.report.table import markdown


def write_built_in(
    frequency: float, pattern: str, is_empty: bool, file: Path, places: int = 0
) -> None:
    """Channels of the built-in room at one antenna of its array, whose pattern no file tells.

    The places are those of the furnished room, also with ``is_empty``.
    ``places`` is the seed of their draw.
    """
    links = simulate_channels(default_room(2), 500, frequency, 1e6, 1, places)
    receiver = links.receivers[0]
    antenna = replace(receiver, array=replace(receiver.array, pattern=pattern))
    room = replace(ROOM, furniture=()) if is_empty else ROOM
    offsets = torch.zeros(1, dtype=torch.float64)
    parts = respond_in_parts(room, links.query.transmitters, antenna, frequency, offsets, 2)
    channels = torch.cat([*parts]).to(links.labels)
    file.parent.mkdir(exist_ok=True)
    np.savez(
        file,
        h=channels[:, 5:6].numpy(),
        tx=links.query.transmitters.numpy(),
        rx=receiver.pose.world(receiver.array.elements)[5:6].numpy(),
        frequencies=np.array([frequency]),
    )


def load_field(file: Path, seed: int = 0) -> Links:
    """Links of a field with the default split."""
    return load(
        {"name": "csi_npz", "file": str(file)},
        {"name": "random", "test": 0.2, "validation": 0.1, "seed": seed},
        "csi",
    )


def walls_of(box: list[float]) -> torch.Tensor:
    """Planes of the six faces of a box (6, 4)."""
    axes = torch.eye(3, dtype=torch.float64).repeat(2, 1)
    return torch.cat((axes, torch.tensor(box, dtype=torch.float64)[:, None]), 1)


def fit_of(links: Links, rows: torch.Tensor, order: int) -> tuple[ChannelData, FieldFit]:
    """Fit of some links."""
    split = replace(links.split, train=rows, validation=rows[:0])
    data = ChannelData(replace(links, split=split), -1, True, order, ChannelOptions())
    data.order = order
    return data, FieldFit(data, largest=10_000)


def best_room(data: ChannelData, fit: FieldFit, walls: torch.Tensor) -> FieldRoom:
    """Known walls with the gains of least error, as dielectrics or as metal."""
    start = fit.start(walls[:0])
    planes = data.frame.from_world(walls)
    rooms = []
    for slab in (SLABS[1], torch.tensor([0.0, math.log(1e6), 0.0]).double()):
        for sign in (1, -1):
            gains = torch.full((1, len(walls)), 0.7 * sign, dtype=torch.complex128)
            uses = torch.ones(1, len(walls), dtype=torch.bool)
            room = FieldRoom(planes, slab.repeat(len(walls), 1), gains, start.receivers, uses)
            rooms.append(fit.fit_gains(room, 30))
    return min(rooms, key=lambda room: fit.mean_log(fit.residual(room)).item())


def scores(links: Links, walls: torch.Tensor, order: int) -> list[str]:
    """Cells of a row."""
    data, fit = fit_of(links, links.split.known, order)
    test_data, test = fit_of(links, links.split.test, order)
    room = best_room(data, fit, walls)
    waves = fit.waves(room.planes, room)
    planes = test_data.frame.from_world(walls)
    raw = test.values / test.scale
    test_waves = test.waves(planes, room) / test.scale[:, None]

    def cell(predicted: torch.Tensor) -> str:
        power = (raw - predicted).abs().square()
        snr = -10 * (power / raw.abs().square()).log10()
        nmse = 10 * (power.sum() / raw.abs().square().sum()).log10()
        return f"{snr.quantile(0.5):.1f} / {nmse:.1f}"

    free = torch.zeros_like(raw)
    for number in range(len(data.receivers)):
        own = waves[fit.owner == number]
        gram = own.mH @ own
        gram = gram + 0.01 * gram.diagonal().real.mean() * torch.eye(len(gram))
        strengths = torch.linalg.solve(gram, own.mH @ fit.values[fit.owner == number])
        rows = test.owner == number
        free[rows] = test_waves[rows] @ strengths
    products = fit.products(room)[0]
    fields = waves * products * room.receivers[fit.owner, None]
    test_fields = test_waves * products * room.receivers[test.owner, None]
    shared = test_fields.sum(1)
    fit.choose_variation(room)
    kriged = shared + krige(
        fit, test, fit.variations[0], fields, test_fields, fit.residual(room, waves)
    )
    return [str(order), cell(free), cell(shared), cell(kriged)]


def krige(
    fit: FieldFit,
    test: FieldFit,
    variation: Variation,
    fields: torch.Tensor,
    test_fields: torch.Tensor,
    rest: torch.Tensor,
) -> torch.Tensor:
    """Deviations of test channels by those of the known places."""
    share, length, noise = variation
    places, test_places = (
        torch.cat([part.places - part.position for part in each.receivers])  # of one number a place
        for each in (fit, test)
    )
    same = fit.owner[:, None] == fit.owner
    covariance = share**2 * (fields @ fields.mH) * same
    covariance = covariance * (-torch.cdist(places, places) / length).exp()
    covariance = covariance + noise**2 * torch.eye(len(rest))
    across = share**2 * (test_fields @ fields.mH) * (test.owner[:, None] == fit.owner)
    across = across * (-torch.cdist(test_places, places) / length).exp()
    return across @ torch.linalg.solve(covariance, rest)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("file")
    parser.add_argument("--box", type=float, nargs=6)
    parser.add_argument("--frequency", type=float, default=2.4e9)
    parser.add_argument("--isotropic", action="store_true", help="the built-in room's antenna")
    parser.add_argument("--empty", action="store_true", help="the built-in room without furniture")
    parser.add_argument("--places", type=int, default=0, help="seed of the built-in room's places")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    file, box = Path(arguments.file), arguments.box
    if arguments.file == "built-in":
        file, box = Path("runs/field.npz"), [0.0, 0.0, 0.0, *ROOM.size]
        pattern = "isotropic" if arguments.isotropic else "cosine"
        write_built_in(arguments.frequency, pattern, arguments.empty, file, arguments.places)
    links = load_field(file)
    rows = [("order", "strength a path", "shared gains", "varying over places")]
    rows += [scores(links, walls_of(box), order) for order in (1, 2, 3)]
    print(markdown(rows))


if __name__ == "__main__":
    with torch.no_grad():
        main()
