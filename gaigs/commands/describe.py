"""A first look at links: what was read, what was left out, and what is suspicious."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from gaigs.core.antenna import lacking
from gaigs.core.query import evenly
from gaigs.core.task.scalar import with_unit
from gaigs.data import Links, load
from gaigs.data.checks import Finding, check
from gaigs.io.files import write_text
from gaigs.registry import check_instance
from gaigs.report import style

LINKS, RECEIVERS = 2000, 12
"""Most links whose spectra or channels are read, evenly spread, and most receivers that the text
lists.
"""


@dataclass(frozen=True)
class Description:
    """What ``describe`` finds; its text is one screen.

    Attributes:
        read: Sentences on the links, places, labels and receivers, and what the reader left out.
        findings: What is probably wrong, and what mends it.

    Example:
        >>> print(gaigs.describe(gaigs.links("synthetic_rssi", transmitters=60)))
        rssi: 240 links of 60 places at 4 receivers
        ...
        nothing suspicious
    """

    read: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def suspicious(self) -> tuple[str, ...]:
        """The findings as sentences."""
        return tuple(map(str, self.findings))

    def __str__(self) -> str:
        found = ["nothing suspicious"]
        if self.findings:
            found = ["suspicious:", *(f"  {sentence}" for sentence in self.suspicious)]
        return "\n".join((*self.read, *found))


@torch.no_grad()
def describe(links: Links) -> Description:
    """A first look at links of any task: extent, levels and receivers, and what is suspicious in
    them.

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
    low, middle, high = np.quantile(
        values.numpy(), (0.0, 0.5, 1.0)
    ).tolist()  # torch takes no more than 2**24
    count = len(links.receivers)
    read = [
        f"{links.task.name}: {len(links)} links of {len(sites)} places at {count} receiver{'s' * (count != 1)}",
        "places [m]: " + ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in axes),
        f"{with_unit(quantity, unit)}: {low:.3g} to {high:.3g}, median {middle:.3g}"
        + f" of {len(index)} links" * (len(index) < len(links)),
    ]
    if links.split is not None:
        read.append(
            f"split {links.split.name}: "
            + ", ".join(f"{len(p)} {n}" for n, p in links.split.parts().items())
        )
    if repeated := len(links) - len(links.query.unique(with_receivers=True)[0]):
        read.append(f"{repeated} links repeat place and receiver of another")
    findings = tuple(check(links))
    remarks = links.remarks
    for finding in findings:  # a split has them among its remarks
        remarks = remarks.replace(str(finding), "")
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
    return Description(tuple(read), findings)


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
        if links.task.is_channel:  # over the elements that arrays have
            absent = lacking(links.receivers, links.query.receivers[part], links.task.elements)
            mean = mean / (1 - absent.double().mean(1))
        found.append(10 * mean.clamp_min(1e-300).log10() if is_wave else mean)
    return torch.cat(found)


def run(config: dict, folder: Path) -> None:
    """Describes the data of a configuration; prints the text, and writes ``describe.txt`` and
    ``describe.png``.
    """
    links = load(config["data"], config["split"])
    text = str(describe(links))
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "describe.txt", text + "\n")
    style.save(figure(links), folder / "describe.png")
    print(f"{text}\nresults: {folder}")


def figure(links: Links) -> Figure:
    """Places and receivers from above, and a histogram of levels.

    Colours are the number of receivers that hear a place, or the level at the first one if all
    numbers are equal.
    """
    index = _read(links)
    values, (quantity, unit) = levels(links, index), quantity_of(links)
    heard = torch.cat((links.query.transmitters, links.query.receivers[:, None].float()), 1).unique(
        dim=0
    )
    places, counts = heard[:, :3].unique(dim=0, return_counts=True)
    colours, label = counts, "receivers that hear the place"
    if counts.min() == counts.max():
        first = links.query.receivers[index] == 0
        places, colours, label = (
            links.query.transmitters[index[first]],
            values[first],
            with_unit(quantity, unit),
        )
        label += f" at {links.receivers[0].name}" if len(links.receivers) > 1 else ""
    with rc_context(style.STYLE):
        drawn = Figure(figsize=(style.PAGE, 0.46 * style.PAGE), layout="compressed")
        left, right = drawn.subplots(1, 2)
        dots = left.scatter(*places[:, :2].T.numpy(), 8, colours.numpy(), cmap="viridis", zorder=2)
        drawn.colorbar(dots, ax=left, label=label)
        stands = torch.stack([receiver.pose.position for receiver in links.receivers])
        words = (
            "receivers"
            if links.uncertainties is None or not links.uncertainties.any()
            else "receivers, estimated"
        )
        left.plot(
            *stands[:, :2].T.numpy(),
            "^",
            color=style.ORANGE,
            markeredgecolor="white",
            markersize=6,
            label=words,
        )
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
