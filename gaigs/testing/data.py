"""Made-up links, and the check of kind ``data``."""

import contextlib
import math
from dataclasses import replace

import torch
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import CARRIERS, Query
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import MIN_MAX, Spectrum
from gaigs.data import Links, Split
from gaigs.testing.checks import flat, require, require_tensor

POSES = (
    Pose.from_xyzw((0.2, 0.2, 2.5), (-0.6, 0, 0, 0.8)),
    Pose.from_xyzw((5.0, 4.0, 1.0), (0, 0.6, 0.8, 0)),
)


def example_links(task: str = "spectrum", carrier: float | None = None) -> Links:
    """A made-up data set: 24 links to two turned receivers.

    Args:
        task: ``spectrum``: random spectra of 18 x 36 pixels, each of another place. ``rssi``:
            random levels of 12 places that both receivers hear. ``csi``: channels of 12 such places
            at 4 elements and 5 subcarriers, the direct wave and noise.
        carrier: Carrier of all links [Hz], with a bandwidth of 0.5 GHz; spectra then come from 3 x
            3 patches half a wavelength apart. None if unknown.

    Raises:
        ValueError: There is no such task here.
    """
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(24, 3, generator=generator) * torch.tensor([6.0, 4.0, 2.0])
    heard_by = torch.arange(24) % 2
    rows = torch.arange(24) // 2
    array = Array.single()
    made: Task
    match task:
        case "spectrum":
            grid = Grid.degrees(range(4, 90, 5), range(0, 360, 10))
            made = Spectrum(grid.elevations, grid.azimuths, "none" if carrier is None else MIN_MAX)
            if carrier is not None:
                array = Array.planar(3, 3, speed_of_light / carrier / 2, "cosine")
            labels, rows = torch.rand(24, *grid.shape, generator=generator), None
        case "rssi":
            made, places = Rssi(), places[:12].repeat_interleave(2, 0)
            labels = -60 - 10 * torch.rand(24, generator=generator)
        case "csi":
            array, places = (
                Array.planar(2, 2, speed_of_light / 2.44e9 / 2),
                places[:12].repeat_interleave(2, 0),
            )
            frequencies = 2.44e9 + torch.linspace(-1e7, 1e7, 5, dtype=torch.float64)
            made = Csi(len(array), frequencies)
            noise = torch.randn(24, *made.shape, dtype=torch.complex64, generator=generator)
            elements = torch.stack(
                [pose.to(array.elements).world(array.elements) for pose in POSES]
            )[heard_by]
            distances = (places[:, None] - elements).double().norm(dim=-1)[..., None]
            direct = torch.polar(
                1 / distances, -2 * math.pi * frequencies / speed_of_light * distances
            )
            labels = direct.to(torch.complex64) + 0.1 * noise
        case _:
            raise ValueError(f"task must be spectrum, rssi or csi, got {task!r}")
    return Links(
        query=Query(places, heard_by, None if carrier is None else torch.full((24,), carrier)),
        receivers=tuple(Receiver(f"gateway{i}", pose, array) for i, pose in enumerate(POSES)),
        labels=labels,
        task=made,
        rows=rows,
        official=lambda: torch.arange(24).split((20, 4)),
        split=Split("example", *torch.arange(24).split((16, 4, 4))),
        bandwidth=None if carrier is None else 5e8,
    )


def check_data(links: Links) -> None:
    """Checks a reader's links: shapes, ranges, repeatable labels, parts without overlap, a storable
    scene.

    The contract is that of ``gaigs.data.Links``.
    """
    n = len(links)
    _check_query(links)
    for receiver in links.receivers:
        elements = receiver.array.elements
        require_tensor(
            f"the position of {receiver.name}", receiver.pose.position, (3,), torch.float32
        )
        require_tensor(
            f"the elements of {receiver.name}", elements, (len(elements), 3), elements.dtype
        )
        require(
            elements.dtype.is_floating_point, f"the elements of {receiver.name} must be floats [m]"
        )
    width = links.bandwidth
    known = width is None or 0 <= width < math.inf
    require(known, f"bandwidth must be 0 or more [Hz], or None where it is unknown, got {width}")
    names = [receiver.name for receiver in links.receivers]
    require(len({*names}) == len(names), "receivers must have different names")
    require_tensor("edges", links.edges, (len(links.edges), 2, 3), torch.float32)
    _check_rows(links)
    with contextlib.suppress(
        FileNotFoundError
    ):  # a missing index file prevents the official split only
        if links.official is not None:
            train, test = links.official()
            check_parts({"train": train, "test": test}, n)
    if links.split is not None:
        check_parts(links.split.parts(), n)
    _check_labels(links)
    everything = torch.arange(n)
    state = replace(
        links, split=links.split or Split("all", everything, everything[:0], everything[:0])
    ).scene.state()
    require(
        flat(state) == flat(Scene.from_state(state).state()),
        "the scene must come back from its state as it was",
    )


def check_parts(parts: dict[str, Tensor], n: int) -> None:
    """Checks parts of n links: ascending numbers without repetition, with links to train and to
    test on.
    """
    for name, part in parts.items():
        require(
            part.ndim == 1 and part.dtype == torch.long,
            f"{name} must be the numbers of links, got {part.dtype}",
        )
        require(part.diff().gt(0).all(), f"{name} must ascend")
    everything = torch.cat([*parts.values()])
    require(
        len(everything.unique()) == len(everything),
        f"no link may stand twice in {', '.join(parts)}",
    )
    require((everything.lt(n) & everything.ge(0)).all(), f"the split must point at the {n} links")
    require(
        len(parts["train"]) and len(parts["test"]),
        "the split must leave links to train and to test on",
    )


def _check_query(links: Links) -> None:
    n, index, frequencies = len(links), links.query.receivers, links.query.frequencies
    require_tensor("transmitters", links.query.transmitters, (n, 3), torch.float32)
    require(
        tuple(index.shape) == (n,) and index.dtype == torch.long,
        "receivers must hold an integer for each link",
    )
    require(
        (index.lt(len(links.receivers)) & index.ge(0)).all(), "the query must point into receivers"
    )
    if frequencies is not None:
        require_tensor("frequencies", frequencies, (n,), frequencies.dtype)
        require(frequencies.dtype.is_floating_point, "frequencies must be floats [Hz]")
        low, high = CARRIERS
        inside = frequencies.ge(low) & frequencies.le(high)
        require(inside.all(), f"frequencies must be from {low:g} to {high:g} Hz")


def _check_rows(links: Links) -> None:
    if links.rows is None:
        return
    rows, places = links.rows, links.query.transmitters
    require(
        tuple(rows.shape) == (len(links),) and rows.dtype == torch.long,
        "rows must hold an integer for each link",
    )
    require(rows.ge(0).all(), "rows must count from 0")
    _, which = rows.unique(return_inverse=True)
    first = torch.zeros(int(which.max()) + 1, dtype=torch.long).scatter_(
        0, which, torch.arange(len(rows))
    )
    require(
        torch.equal(places[first[which]], places),
        "links of one row must have one transmitter position",
    )


def _check_labels(links: Links) -> None:
    task = links.task
    some = torch.linspace(0, len(links) - 1, 9).long().flip(0)
    labels, batch = links.labels[some], links.batch(some)
    require_tensor("labels", labels, (len(some), *task.shape), task.dtype)
    require(torch.equal(labels, links.labels[some]), "labels read twice must be the same")
    require(
        torch.equal(labels[-1:], links.labels[some[-1:]]),
        "a label must not depend on the others that are read",
    )
    require(torch.equal(batch.labels, labels), "a batch must have the labels of its links")
    if task.directions is not None:
        require((labels.ge(0) & labels.le(1)).all(), "spectra must lie in [0, 1]")
        require(
            task.directions.elevations.abs().max() <= math.pi / 2 + 1e-6,
            "elevations must be in radians",
        )
        require(
            task.directions.azimuths.abs().max() <= 2 * math.pi + 1e-6,
            "azimuths must be in radians",
        )
    best = task.scores(labels, labels)[task.monitor]
    require(best.isfinite().all(), "each label must have a score")
