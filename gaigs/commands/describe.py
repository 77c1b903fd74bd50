"""A first look at links: extent, readings left out, and suspected faults."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
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


@dataclass(frozen=True)
class Description:
    """Facts and suspected faults of a data set, as text of one screen.

    Attributes:
        read: Sentences on the links, places, labels and receivers, and on excluded readings.
        findings: What is probably wrong, and how to correct it.

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
        verdict = ["nothing suspicious"]
        if self.findings:
            verdict = ["suspicious:", *(f"  {sentence}" for sentence in self.suspicious)]
        return "\n".join((*self.read, *verdict))


@torch.no_grad()
def describe(links: Links) -> Description:
    """A first look at links of any task: extent, levels, receivers, and suspected faults.

    Args:
        links: Links, with or without a split.

    Example:
        >>> gaigs.describe(gaigs.links("synthetic", transmitters=40, order=0)).suspicious
        ()
    """
    check_instance("links", links, Links)
    levels = Levels.of(links)
    findings = tuple(check(links))
    remarks = links.remarks
    for finding in findings:  # a split has them among its remarks
        remarks = remarks.replace(str(finding), "")
    read = [
        *extent_lines(links, levels),
        *filter(None, remarks.split("; ")),
        *receiver_lines(links, levels),
    ]
    return Description(tuple(read), findings)


@dataclass(frozen=True)
class Levels:
    """One level for each link: its label, the label's mean, or a channel's mean power."""

    index: Int[Tensor, " k"]  # numbers of the links
    values: Float[Tensor, " k"]  # their levels
    title: str  # name and unit of a level

    @classmethod
    def of(cls, links: Links, most: int = 2000) -> "Levels":
        """Levels of all scalar links, or of at most ``most`` evenly spread links with arrays."""
        task = links.task
        index = torch.arange(len(links))
        title = with_unit(task.quantity, task.unit)
        if task.shape:
            index = evenly(index, most)
            title = with_unit(f"mean {task.quantity}", task.unit)
        if task.dtype.is_complex:
            title = "mean power [dB]"
        values = [mean_levels(links, block) for block in index.split(256)]
        return cls(index, torch.cat(values), title)


def mean_levels(links: Links, index: Int[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Mean of each label of the links ``index``, or the mean power [dB] if it is a channel."""
    labels = links.labels[index].reshape(len(index), -1)
    if not labels.is_complex():
        return labels.double().mean(1)
    power = labels.abs().double().square().mean(1)  # (k,)
    if links.task.is_channel:
        # Absent elements and subcarriers are 0 in labels. The mean is over the others only.
        task: Any = links.task
        receivers = links.query.receivers[index]
        absent = lacking(links.receivers, receivers, task.elements, task.frequencies)
        power = power / (1 - absent.double().mean((1, 2)))
    return 10 * power.clamp_min(1e-300).log10()  # no -inf for a channel of zeros


def extent_lines(links: Links, levels: Levels) -> list[str]:
    """Lines on links, places, levels, the split and repeated links, for ``Description.read``."""
    places = links.query.transmitters.unique(dim=0)
    axes = zip("xyz", places.amin(0).tolist(), places.amax(0).tolist(), strict=True)
    ranges = ", ".join(f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in axes)
    # By numpy: quantiles of torch take no more than 2**24 numbers.
    low, median, high = np.quantile(levels.values.numpy(), (0.0, 0.5, 1.0)).tolist()
    count = len(links.receivers)
    receivers = "1 receiver" if count == 1 else f"{count} receivers"
    note = f" of {len(levels.index)} links" if len(levels.index) < len(links) else ""
    lines = [
        f"{links.task.name}: {len(links)} links of {len(places)} places at {receivers}",
        f"places [m]: {ranges}",
        f"{levels.title}: {low:.3g} to {high:.3g}, median {median:.3g}{note}",
    ]
    if links.split is not None:
        counts = ", ".join(f"{len(part)} {name}" for name, part in links.split.parts().items())
        lines.append(f"split {links.split.name}: {counts}")
    distinct, _ = links.query.unique(with_receivers=True)
    if repeated := len(links) - len(distinct):
        lines.append(f"{repeated} links repeat place and receiver of another")
    return lines


def receiver_lines(links: Links, levels: Levels, most: int = 12) -> list[str]:
    """A table of the ``most`` receivers with the most links; empty for one receiver."""
    count = len(links.receivers)
    if count == 1:
        return []
    lines = [f"{'receiver':20} {'links':>6} {'median':>7}  position [m]"]
    numbers = links.query.receivers.bincount(minlength=count)
    for k in numbers.argsort(descending=True)[:most].tolist():
        receiver = links.receivers[k]
        values = levels.values[links.query.receivers[levels.index] == k]
        median = f"{values.median().item():7.3g}" if len(values) else " " * 7
        place = ", ".join(f"{x:.2f}" for x in receiver.pose.position.tolist())
        deviation = 0.0 if links.uncertainties is None else links.uncertainties[k].item()
        about = f" +- {deviation:.2g}, estimated" if deviation else ""
        lines.append(f"{receiver.name[:20]:20} {numbers[k]:6} {median}  {place}{about}")
    if count > most:
        lines.append(f"... and {count - most} more receivers with fewer links")
    return lines


def run(config: dict, folder: Path) -> None:
    """Describes the data of a configuration; writes ``describe.txt`` and ``describe.png``."""
    links = load(config["data"], config["split"], is_checked=False)
    text = str(describe(links))
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "describe.txt", text + "\n")
    style.save(figure(links), folder / "describe.png")
    print(f"{text}\nresults: {folder}")


def figure(links: Links) -> Figure:
    """Places and receivers from above, and a histogram of levels."""
    levels = Levels.of(links)
    with rc_context(style.STYLE):
        drawn = style.new_figure(style.PAGE, 0.46 * style.PAGE, "compressed")
        above, histogram = drawn.subplots(1, 2)
        draw_places(above, links, levels)
        drawn.legend(loc="outside lower left")
        draw_histogram(histogram, levels, links.task.is_noisy)
        style.ask(drawn, "Where was measured, and what?")
    return drawn


def draw_places(axis: Axes, links: Links, levels: Levels) -> None:
    """Draws places and receivers from above.

    Colours show the number of receivers that receive each place. If this number is the same
    everywhere, colours show the level at the first receiver.
    """
    query = links.query
    pairs = torch.cat((query.transmitters, query.receivers[:, None].float()), 1)
    distinct_pairs = pairs.unique(dim=0)  # (pairs, 4): place and receiver, without repetitions
    places, colours = distinct_pairs[:, :3].unique(dim=0, return_counts=True)
    label = "receivers that hear the place"
    if colours.min() == colours.max():
        is_first = query.receivers[levels.index] == 0
        places = query.transmitters[levels.index[is_first]]
        colours = levels.values[is_first]
        label = levels.title
        label += f" at {links.receivers[0].name}" if len(links.receivers) > 1 else ""
    x, y = places[:, :2].T.numpy()
    dots = axis.scatter(x, y, 8, colours.numpy(), cmap="viridis", zorder=2)
    axis.figure.colorbar(dots, ax=axis, label=label)
    positions = torch.stack([receiver.pose.position for receiver in links.receivers])
    is_estimated = links.uncertainties is not None and links.uncertainties.any()
    axis.plot(
        *positions[:, :2].T.numpy(),
        "^",
        color=style.ORANGE,
        markeredgecolor="white",
        markersize=6,
        label="receivers, estimated" if is_estimated else "receivers",
    )
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def draw_histogram(axis: Axes, levels: Levels, is_noisy: bool, bins: int = 40) -> None:
    """Draws a histogram of the links' levels.

    Noisy levels are often whole numbers, so each bin spans the same number of whole numbers.
    """
    edges: int | np.ndarray = bins
    low = math.floor(levels.values.min().item())
    high = levels.values.max().item()
    step = math.ceil((high - low) / bins) if is_noisy else 0
    if step:
        edges = np.arange(low - 0.5, high + step, step)
    axis.hist(levels.values.numpy(), edges, color=style.BLUE)
    axis.set(xlabel=levels.title, ylabel="links")
    axis.grid(axis="y")
    axis.set_axisbelow(True)
