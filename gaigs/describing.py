"""A first look at links: what was read, what was left out, and what is suspicious."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from gaigs.antenna import lacking
from gaigs.data import Links, load, phase_doubts
from gaigs.data.doubts import doubts, places_doubts
from gaigs.data.readings import marks_of
from gaigs.io.files import write_text
from gaigs.io.tables import shortened
from gaigs.kriging.links import distances
from gaigs.query import evenly
from gaigs.registry import check_instance
from gaigs.report import style
from gaigs.task.csi import Csi
from gaigs.task.rssi import Rssi
from gaigs.task.scalar import with_unit
from gaigs.task.spectrum import Spectrum

LINKS, RECEIVERS = 2000, 12
"""Most links whose spectra or channels are read, evenly spread, and most receivers that the text lists."""

BETTER = 0.85
"""Ratio of the errors about the law of distance below which other coordinates of the receivers are named."""


@dataclass(frozen=True)
class Description:
    """What ``describe`` finds; its text is one screen.

    Attributes:
        read: Sentences on the links, places, labels and receivers, and what the reader left out.
        suspicious: Sentences on what is probably wrong.

    Example:
        >>> print(gaigs.describe(gaigs.links("synthetic_rssi", transmitters=60)))
        rssi: 240 links of 60 places at 4 receivers
        ...
        nothing suspicious
    """

    read: tuple[str, ...]
    suspicious: tuple[str, ...]

    def __str__(self) -> str:
        found = ["suspicious:", *(f"  {one}" for one in self.suspicious)] if self.suspicious else ["nothing suspicious"]
        return "\n".join((*self.read, *found))


@torch.no_grad()
def describe(links: Links) -> Description:
    """A first look at links of any task: extent, levels and receivers, and what is suspicious in them.

    Args:
        links: With or without a split.

    Example:
        >>> gaigs.describe(gaigs.links("synthetic", transmitters=40, order=0)).suspicious
        ()
    """
    check_instance("links", links, Links)
    places, index = links.query.transmitters, _read(links)
    sites, values = places.unique(dim=0), levels(links, index)
    axes = zip("xyz", sites.amin(0).tolist(), sites.amax(0).tolist(), strict=True)
    quantity, unit = quantity_of(links)
    low, middle, high = np.quantile(values.numpy(), (0.0, 0.5, 1.0)).tolist()  # torch takes no more than 2**24
    count = len(links.receivers)
    read = [
        f"{links.task.name}: {len(links)} links of {len(sites)} places at {count} receiver{'s' * (count != 1)}",
        "places [m]: " + ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in axes),
        f"{with_unit(quantity, unit)}: {low:.3g} to {high:.3g}, median {middle:.3g}"
        + f" of {len(index)} links" * (len(index) < len(links)),
    ]
    if links.split is not None:
        read.append(f"split {links.split.name}: " + ", ".join(f"{len(p)} {n}" for n, p in links.split.parts().items()))
    suspicious, remarks = tuple(suspicions(links, sites)), links.remarks
    for doubt in suspicious:  # which a split has told, too
        remarks = remarks.replace(doubt, "")
    read += filter(None, remarks.split("; "))
    if count > 1:
        read.append(f"{'receiver':20} {'links':>6} {'median':>7}  position [m]")
        numbers = links.query.receivers.bincount(minlength=count)
        for k in numbers.argsort(descending=True)[:RECEIVERS].tolist():
            own, receiver = values[links.query.receivers[index] == k], links.receivers[k]
            median = f"{own.median().item():7.3g}" if len(own) else "       "
            place = ", ".join(f"{x:.2f}" for x in receiver.pose.position.tolist())
            certain = 0.0 if links.uncertainties is None else links.uncertainties[k].item()
            about = f" +- {certain:.2g}, estimated" if certain else ""
            read.append(f"{receiver.name[:20]:20} {numbers[k]:6} {median}  {place}{about}")
        if count > RECEIVERS:
            read.append(f"... and {count - RECEIVERS} more receivers with fewer links")
    return Description(tuple(read), suspicious)


def _read(links: Links) -> Int[Tensor, " k"]:
    """The links whose labels are read: all of one number each, otherwise at most ``LINKS``."""
    index = torch.arange(len(links))
    return evenly(index, LINKS) if links.task.shape else index


def quantity_of(links: Links) -> tuple[str, str]:
    """Name and unit of ``levels``."""
    task = links.task
    if task.dtype.is_complex:
        return "mean power", "dB"
    return (f"mean {task.quantity}" if task.shape else task.quantity), task.unit


def levels(links: Links, index: Tensor) -> Float[Tensor, " k"]:
    """One number of each of some labels: itself, its mean, or the mean power of a channel [dB]."""
    found = []
    for part in index.split(256):
        flat = links.labels[part].reshape(len(part), -1)
        is_wave = flat.is_complex()
        mean = (flat.abs().double().square() if is_wave else flat.double()).mean(1)
        if isinstance(links.task, Csi):  # over the elements that arrays have
            absent = lacking(links.receivers, links.query.receivers[part], links.task.elements)
            mean = mean / (1 - absent.double().mean(1))
        found.append(10 * mean.clamp_min(1e-300).log10() if is_wave else mean)
    return torch.cat(found)


def suspicions(links: Links, sites: Float[Tensor, "n 3"]) -> Iterator[str]:
    """Sentences on what is probably wrong, of any task first."""
    query, receivers = links.query, links.receivers
    stands = torch.stack([receiver.pose.position for receiver in receivers])
    given = torch.ones(len(receivers), dtype=torch.bool) if links.uncertainties is None else links.uncertainties == 0
    if links.split is None:
        yield from places_doubts(links)
    else:
        yield from [*doubts(links), *phase_doubts(links)]
    if len(receivers) > 10 and len(links) < 1.5 * len(receivers):
        each = "models are learnt for each, so a fixed one must have one place"
        yield f"{len(receivers)} receivers have {len(links)} links: {each}"
    near = (distances(sites.double(), stands[given].double()) < 0.01).any(1)
    if len(sites) > 1 and near.any():
        yield f"{int(near.sum())} places are where a receiver stands"
    for a, b in itertools.combinations(given.nonzero()[:, 0].tolist(), 2):
        if (stands[a] - stands[b]).norm() < 0.01:
            yield f"{receivers[a].name} and {receivers[b].name} stand at one place"
    parts = [query.transmitters, query.receivers[:, None].float()]
    keys = torch.cat(parts if query.frequencies is None else [*parts, query.frequencies[:, None]], 1)
    if repeated := len(keys) - len(keys.unique(dim=0)):
        yield f"{repeated} links repeat place and receiver of another"
    if isinstance(links.task, Rssi):
        yield from suspicions_of_levels(links, stands, given)
    if links.task.is_scalar or (isinstance(links.task, Spectrum) and links.split is not None):  # its doubts have told
        return
    labels = [links.labels[part].reshape(len(part), -1) for part in evenly(torch.arange(len(links)), 256).split(64)]
    if constant := sum(int(((own - own[:, :1]).abs().amax(1) == 0).sum()) for own in labels if own.shape[1] > 1):
        yield f"{constant} of {sum(map(len, labels))} labels have one value throughout"


def suspicions_of_levels(links: Links, stands: Float[Tensor, "r 3"], given: Tensor) -> Iterator[str]:
    """Signs, marks, constant and equal receivers, and receivers that the law of distance does not suit."""
    query, names = links.query, [receiver.name for receiver in links.receivers]
    values = links.labels[torch.arange(len(links))].double()
    if positive := int((values > 0).sum()):
        yield f"{positive} levels are above 0 dBm; was a sign lost?"
    for mark in marks_of(values[:, None].numpy()):
        yield f"{int((values == mark).sum())} levels are {mark:g} dBm; does it mean not heard?"
    places, which = query.transmitters.unique(dim=0, return_inverse=True)
    table = torch.full((len(names), len(places)), math.nan, dtype=torch.float64)
    table[query.receivers, which] = values
    heard = ~table.isnan()
    constant = [k for k in range(len(names)) if heard[k].sum() >= 5 and table[k][heard[k]].unique().numel() == 1]
    if constant:
        yield f"levels are constant at {shortened([names[k] for k in constant])}"
    first: dict[bytes, int] = {}
    for k in set(range(len(names))) - {*constant}:
        other = first.setdefault(np.nan_to_num(table[k].numpy()).tobytes(), k)
        if other != k and heard[k].sum() >= 3:
            yield f"{names[other]} and {names[k]} have the same levels"
    own = given.nonzero()[:, 0]
    if len(own) < 3:
        return
    usual, exponents = misfit(table, heard, places, stands, own)
    if rising := [names[k] for k, slope in zip(own.tolist(), exponents, strict=True) if slope > 5]:
        yield f"levels rise with the distance from {shortened(rising)}; are names or places exchanged?"
    others = {"x and y are exchanged": stands[:, [1, 0, 2]]}
    for factor in (1e-3, 1e-2, 0.3048, 1 / 0.3048, 1e2, 1e3):
        others[f"coordinates are times {factor:.4g}"] = stands * factor
    errors = {name: misfit(table, heard, places, moved, own)[0] for name, moved in others.items()}
    name, error = min(errors.items(), key=lambda pair: pair[1])
    if error < BETTER * usual:
        yield f"levels follow the distance to {error:.2g} dB instead of {usual:.2g} dB if the receivers' {name}"


def misfit(
    table: Float[Tensor, "r n"], heard: Tensor, places: Float[Tensor, "n 3"], stands: Float[Tensor, "r 3"], own: Tensor
) -> tuple[float, list[float]]:
    """Root mean square error of a + b log10(distance) at some receivers, and b of each [dB per decade]."""
    errors, slopes = [], []
    decades = distances(stands.double(), places.double()).clamp_min(0.1).log10()
    for k in own.tolist():
        x, y = decades[k][heard[k]], table[k][heard[k]]
        if len(x) < 10:
            slopes.append(0.0)
            continue
        x, y = x - x.mean(), y - y.mean()
        slopes.append(((x @ y) / x.square().sum().clamp_min(1e-12)).item())
        errors.append(y - min(slopes[-1], 0.0) * x)  # levels fall with the distance
    return (torch.cat(errors).square().mean().sqrt().item() if errors else 0.0), slopes


def run(config: dict, folder: Path) -> None:
    """Describes the data of a configuration; prints the text, and writes ``describe.txt`` and ``describe.png``."""
    links = load(config["data"], config["split"])
    text = str(describe(links))
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "describe.txt", text + "\n")
    style.save(figure(links), folder / "describe.png")
    print(f"{text}\nresults: {folder}")


def figure(links: Links) -> Figure:
    """Places and receivers from above, and a histogram of levels.

    Colours are the number of receivers that hear a place, or the level at the first one if all numbers are equal.
    """
    index = _read(links)
    values, (quantity, unit) = levels(links, index), quantity_of(links)
    heard = torch.cat((links.query.transmitters, links.query.receivers[:, None].float()), 1).unique(dim=0)
    places, counts = heard[:, :3].unique(dim=0, return_counts=True)
    colours, label = counts, "receivers that hear the place"
    if counts.min() == counts.max():
        first = links.query.receivers[index] == 0
        places, colours, label = links.query.transmitters[index[first]], values[first], with_unit(quantity, unit)
        label += f" at {links.receivers[0].name}" if len(links.receivers) > 1 else ""
    with rc_context(style.STYLE):
        drawn = Figure(figsize=(style.PAGE, 0.46 * style.PAGE), layout="compressed")
        left, right = drawn.subplots(1, 2)
        dots = left.scatter(*places[:, :2].T.numpy(), 8, colours.numpy(), cmap="viridis", zorder=2)
        drawn.colorbar(dots, ax=left, label=label)
        stands = torch.stack([receiver.pose.position for receiver in links.receivers])
        words = "receivers" if links.uncertainties is None or not links.uncertainties.any() else "receivers, estimated"
        left.plot(*stands[:, :2].T.numpy(), "^", color=style.ORANGE, markeredgecolor="white", markersize=6, label=words)
        left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        drawn.legend(loc="outside lower left")
        low, high = math.floor(values.min().item()), values.max().item()
        step = math.ceil((high - low) / 40) if links.task.is_noisy else 0
        edges = np.arange(low - 0.5, high + step, step) if step else 40  # levels are whole numbers
        right.hist(values.numpy(), edges, color=style.BLUE)
        right.set(xlabel=with_unit(quantity, unit), ylabel="links")
        right.grid(axis="y")
        right.set_axisbelow(True)
    return drawn
