"""Synthetic links, and the check of kind ``data``."""

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


def example_links(task: str = "spectrum", carrier: float | None = None) -> Links:
    """A synthetic data set: 24 links to two rotated receivers.

    Args:
        task: ``spectrum``: random spectra of 18 x 36 pixels, each of another place. ``rssi``:
            random levels of 12 places at both receivers. ``csi``: channels of 12 such places at 4
            elements and 5 subcarriers, the direct wave plus noise.
        carrier: Carrier of all links [Hz], with a bandwidth of 0.5 GHz; spectra then come from
            arrays of 3 x 3 elements with a pitch of half a wavelength. None if unknown.
    """
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(24, 3, generator=generator) * torch.tensor([6.0, 4.0, 2.0])  # (24, 3) [m]
    receivers = torch.arange(24) % 2
    rows: Tensor | None = torch.arange(24) // 2  # of a table with both receivers in a row
    array = Array.single()
    poses = (
        Pose.from_xyzw((0.2, 0.2, 2.5), (-0.6, 0, 0, 0.8)),
        Pose.from_xyzw((5.0, 4.0, 1.0), (0, 0.6, 0.8, 0)),
    )
    of_labels: Task
    match task:
        case "spectrum":
            grid = Grid.degrees(range(4, 90, 5), range(0, 360, 10))
            scale = "none" if carrier is None else MIN_MAX
            of_labels = Spectrum(grid.elevations, grid.azimuths, scale)
            if carrier is not None:
                array = Array.planar(3, 3, speed_of_light / carrier / 2, "cosine")
            labels = torch.rand(24, *grid.shape, generator=generator)
            rows = None
        case "rssi":
            of_labels = Rssi()
            places = places[:12].repeat_interleave(2, 0)
            labels = -60 - 10 * torch.rand(24, generator=generator)
        case "csi":
            array = Array.planar(2, 2, speed_of_light / 2.44e9 / 2)
            places = places[:12].repeat_interleave(2, 0)
            frequencies = 2.44e9 + torch.linspace(-1e7, 1e7, 5, dtype=torch.float64)
            of_labels = Csi(len(array), frequencies)
            shape = (24, *of_labels.shape)
            noise = torch.randn(shape, dtype=torch.complex64, generator=generator)
            by_receiver = [pose.to(array.elements).world(array.elements) for pose in poses]
            elements = torch.stack(by_receiver)[receivers]  # (24, 4, 3) [m]
            labels = _direct_waves(places, elements, frequencies) + 0.1 * noise
        case _:
            raise ValueError(f"task must be spectrum, rssi or csi, got {task!r}")
    return Links(
        query=Query(places, receivers, None if carrier is None else torch.full((24,), carrier)),
        receivers=tuple(Receiver(f"gateway{i}", pose, array) for i, pose in enumerate(poses)),
        labels=labels,
        task=of_labels,
        rows=rows,
        official=lambda: torch.arange(24).split((20, 4)),
        split=Split("example", *torch.arange(24).split((16, 4, 4))),
        bandwidth=None if carrier is None else 5e8,
    )


def _direct_waves(places: Tensor, elements: Tensor, frequencies: Tensor) -> Tensor:
    """Waves of free space (b, e, s): exp(-j 2 pi f d / c) / d, with d from place to element."""
    distances = (places[:, None] - elements).double().norm(dim=-1)[..., None]  # (b, e, 1) [m]
    phases = -2 * math.pi * frequencies / speed_of_light * distances  # (b, e, s) [rad]
    return torch.polar(1 / distances, phases).to(torch.complex64)


def check_data(links: Links) -> None:
    """Checks links: shapes, ranges, repeatable labels, disjoint parts, a storable scene.

    The contract is in ``gaigs.data.Links``.
    """
    _check_query(links)
    _check_receivers(links)
    require_tensor("edges", links.edges, (len(links.edges), 2, 3), torch.float32)
    width = links.bandwidth
    is_known = width is None or 0 <= width < math.inf
    require(is_known, f"bandwidth must be 0 or more [Hz], or None where it is unknown, got {width}")
    _check_rows(links)
    with contextlib.suppress(FileNotFoundError):  # without its file only the official split fails
        if links.official is not None:
            train, test = links.official()
            check_parts({"train": train, "test": test}, len(links))
    if links.split is not None:
        check_parts(links.split.parts(), len(links))
    _check_labels(links)
    everything = torch.arange(len(links))
    split = links.split or Split("all", everything, everything[:0], everything[:0])
    state = replace(links, split=split).scene.state()
    again = Scene.from_state(state).state()
    require(flat(state) == flat(again), "the scene must come back from its state as it was")


def check_parts(parts: dict[str, Tensor], n: int) -> None:
    """Checks the parts of n links: ascending, no repetition, links to train and to test."""
    for name, part in parts.items():
        is_index = part.ndim == 1 and part.dtype == torch.long
        rule = f"{name} must be the numbers of links, got {part.dtype}"
        require(is_index, f"{rule}; of a mask mask.nonzero()[:, 0]")
        require(part.diff().gt(0).all(), f"{name} must ascend; take part.sort().values")
    everything = torch.cat([*parts.values()])
    once = len(everything.unique()) == len(everything)
    require(once, f"no link may stand twice in {', '.join(parts)}")
    require((everything.lt(n) & everything.ge(0)).all(), f"the split must point at the {n} links")
    is_usable = len(parts["train"]) and len(parts["test"])
    require(is_usable, "the split must leave links to train and to test on")


def _check_query(links: Links) -> None:
    """Checks shapes, dtypes and ranges of transmitters, receivers and frequencies."""
    n = len(links)
    index = links.query.receivers
    require_tensor("transmitters", links.query.transmitters, (n, 3), torch.float32)
    is_index = tuple(index.shape) == (n,) and index.dtype == torch.long
    require(is_index, "receivers must hold an integer for each link; take .long()")
    points = index.lt(len(links.receivers)) & index.ge(0)
    require(points.all(), "the query must point into receivers; count them from 0")
    frequencies = links.query.frequencies
    if frequencies is not None:
        require_tensor("frequencies", frequencies, (n,), frequencies.dtype)
        require(frequencies.dtype.is_floating_point, "frequencies must be floats [Hz]")
        low, high = CARRIERS
        inside = frequencies.ge(low) & frequencies.le(high)
        require(inside.all(), f"frequencies must be from {low:g} to {high:g} Hz; not in GHz")


def _check_receivers(links: Links) -> None:
    """Checks that receivers have different names, and finite positions and elements."""
    names = [receiver.name for receiver in links.receivers]
    require(len({*names}) == len(names), "receivers must have different names")
    for receiver in links.receivers:
        position = receiver.pose.position
        elements = receiver.array.elements
        require_tensor(f"the position of {receiver.name}", position, (3,), torch.float32)
        noun = f"the elements of {receiver.name}"
        require_tensor(noun, elements, (len(elements), 3), elements.dtype)
        require(elements.dtype.is_floating_point, f"{noun} must be floats [m]")


def _check_rows(links: Links) -> None:
    """Checks that rows are numbers from 0, and that links of one row have one transmitter place."""
    if links.rows is None:
        return
    rows = links.rows
    places = links.query.transmitters
    is_index = tuple(rows.shape) == (len(links),) and rows.dtype == torch.long
    require(is_index, "rows must hold an integer for each link")
    require(rows.ge(0).all(), "rows must count from 0")
    _, number = rows.unique(return_inverse=True)
    members = torch.zeros(int(number.max()) + 1, dtype=torch.long)
    members.scatter_(0, number, torch.arange(len(rows)))  # one link of each row
    at_one_place = torch.equal(places[members[number]], places)
    rule = "links of one row must have one transmitter position; number rows by place"
    require(at_one_place, rule)


def _check_labels(links: Links) -> None:
    """Checks that labels can be read twice, singly and as a batch, and that each has a score."""
    task = links.task
    index = torch.linspace(0, len(links) - 1, 9).long().flip(0)  # in descending order
    labels = links.labels[index]
    require_tensor("labels", labels, (len(index), *task.shape), task.dtype)
    rule = "labels read twice must be the same; draw random numbers once, with a seed"
    require(torch.equal(labels, links.labels[index]), rule)
    alone = torch.equal(labels[-1:], links.labels[index[-1:]])
    require(alone, "a label must not depend on the others that are read")
    batch = links.batch(index)
    require(torch.equal(batch.labels, labels), "a batch must have the labels of its links")
    if task.directions is not None:
        rule = "spectra must lie in [0, 1]; scale each by its minimum and maximum"
        require((labels.ge(0) & labels.le(1)).all(), rule)
        elevations, azimuths = task.directions.elevations.abs(), task.directions.azimuths.abs()
        require(elevations.max() <= math.pi / 2 + 1e-6, "elevations must be in radians")
        require(azimuths.max() <= 2 * math.pi + 1e-6, "azimuths must be in radians")
    best = task.scores(labels, labels)[task.monitor]
    require(best.isfinite().all(), "each label must have a score")
