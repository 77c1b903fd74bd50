"""The room from above and from the side: transmitters, receivers, walls, and the Gaussians."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from numpy import ndarray

from gaigs.report.style import GREEN, ORANGE, STYLE

DRAWN = 600
"""Most Gaussians that are drawn; more would hide each other."""


class Cloud(NamedTuple):
    """Gaussians as a figure needs them.

    Attributes:
        means: Centres, world frame [m].
        covariances: World frame [m²].
        strengths: |signal| times opacity.
    """

    means: Float[ndarray, "n 3"]
    covariances: Float[ndarray, "n 3 3"]
    strengths: Float[ndarray, "n"]


def room(
    train: Float[ndarray, "train 3"],
    test: Float[ndarray, "test 3"],
    receivers: Float[ndarray, "receivers 3"],
    rotations: Float[ndarray, "arrays 3 3"],
    edges: Float[ndarray, "k 2 3"],
    cloud: Cloud | None = None,
) -> Figure:
    """Plan (x, y) and side view (x, z) of the room, to one scale.

    Of the Gaussians the strongest are drawn, each as its ellipse of one standard deviation, the strongest on top. The
    box shown holds transmitters, receivers and walls, and the middle 80 % of these Gaussians along each axis.

    Args:
        train, test: Transmitters [m].
        receivers: Positions [m].
        rotations: Columns are the axes of the first receivers, drawn as arrows; empty where directions do not matter.
        edges: Line segments of the room [m].
        cloud: The Gaussians; None for a model without.
    """
    corners = [train, test, receivers, edges.reshape(-1, 3)]
    if cloud is not None:
        strongest = np.argsort(cloud.strengths)[-DRAWN:]
        count, cloud = len(cloud.strengths), Cloud(*(values[strongest] for values in cloud))
        corners.append(np.quantile(cloud.means, (0.1, 0.9), axis=0))
    corners = np.concatenate(corners)
    lower, upper = corners.min(0), corners.max(0)
    arrow = 0.1 * (upper - lower).max()
    lower, upper = lower - 1.2 * arrow, upper + 1.2 * arrow
    width, depth, height = upper - lower
    with rc_context(STYLE):
        inches = min(5.8 / width, 6.8 / (depth + height))  # what fits a page, for one metre
        figure = Figure(figsize=(width * inches + 1.3, (depth + height) * inches + 1.0), layout="compressed")
        receiver = "receivers, axes of the array" if len(rotations) else "receivers"
        plan, side = figure.subplots(2, 1, sharex=True, height_ratios=(depth, height))
        for ax, up in ((plan, 1), (side, 2)):
            view = [0, up]
            if cloud is not None:
                gaussians = _draw_cloud(ax, cloud, view)
            ax.add_collection(LineCollection(edges[..., view], colors="0.5", linewidths=0.8))
            ax.plot(*train[:, view].T, ".", color="0.2", markersize=2, label="transmitters, train")
            ax.plot(*test[:, view].T, ".", color=ORANGE, markersize=3, label="transmitters, test")
            ax.plot(*receivers[:, view].T, "s", color=GREEN, markersize=5, markeredgecolor="white", label=receiver)
            for position, rotation in zip(receivers, rotations, strict=False):
                _draw_axes(ax, position[view], arrow * rotation[view])
            ax.set(xlim=(lower[0], upper[0]), ylim=(lower[up], upper[up]), ylabel="xyz"[up] + " [m]", aspect="equal")
        side.set_xlabel("x [m]")
        if cloud is not None:
            label = f"|signal| × opacity, {len(cloud.means):,} strongest of {count:,} Gaussians"
            figure.colorbar(gaussians, ax=(plan, side), label=label, aspect=30, shrink=0.7, extend="max")
        columns = 3 if figure.get_figwidth() > 5.5 else 2
        figure.legend(*plan.get_legend_handles_labels(), loc="outside lower center", ncols=columns, markerscale=1.5)
    return figure


def _draw_cloud(ax: Axes, cloud: Cloud, view: list[int]) -> EllipseCollection:
    variances, axes = np.linalg.eigh(cloud.covariances[:, view][:, :, view])  # ascending
    minor, major = 2 * np.sqrt(variances.clip(0)).T  # rounding can leave a flat ellipse a variance below zero
    ellipses = EllipseCollection(
        major,
        minor,
        np.rad2deg(np.arctan2(axes[:, 1, 1], axes[:, 0, 1])),
        units="xy",
        offsets=cloud.means[:, view],
        offset_transform=ax.transData,
        array=cloud.strengths,
        cmap="Blues",
        clim=(0, np.quantile(cloud.strengths, 0.98)),  # one outlier must not pale all others
        alpha=0.6,
        edgecolors="white",
        linewidths=0.3,
    )
    return ax.add_collection(ellipses)


def _draw_axes(ax: Axes, position: Float[ndarray, "2"], axes: Float[ndarray, "2 3"]) -> None:
    lengths = np.hypot(*axes)
    for name, axis, length in zip("xyz", axes.T, lengths, strict=True):
        if length > 0.3 * lengths.max():  # one that points at the reader would be a dot under the receiver
            ax.annotate(
                name,
                position,
                position + 1.15 * axis,
                ha="center",
                va="center",
                weight="bold",
                arrowprops={"arrowstyle": "<-", "linewidth": 1, "shrinkA": 4, "shrinkB": 0},
            )
