"""The room from above and from the side: transmitters, receivers, walls, the Gaussians, and what was learnt of it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.report.shapes import LearntRoom, Matter, Path, Plane
from gaigs.report.style import BLUE, GREEN, ORANGE, STYLE

DRAWN = 600
"""Most Gaussians that are drawn; more would hide each other."""

FACING = 0.77
"""A plane is drawn in a view where the cosine of its normal with the line of sight is below this: one that faces the
reader would cover the room, and the other view has it. Above 1 / sqrt(2), so that none is left out."""

SHOWN = 0.001
"""Share of the power from which on a plane is drawn."""

LABEL = (0.14, 0.04)
"""Room that the label of a plane takes, in widths of the view and of its larger edge."""

PIXELS = 300
"""Of the obstacles' image, along its longer edge."""

FAINT_DB = 1.0
"""Loss at which the obstacles' colours end at the least, so that next to none does not look like much [dB]."""

VIEWS = ((1, 2), (2, 1))
"""Which axis points up in plan and side view, and along which one looks."""


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
    learnt: LearntRoom | None = None,
) -> Figure:
    """Plan (x, y) and side view (x, z) of the room, to one scale.

    Of the Gaussians the strongest are drawn, each as its ellipse of one standard deviation, the strongest on top. The
    box shown holds transmitters, receivers and walls, and the middle 80 % of these Gaussians along each axis. Learnt
    planes are the wider the more power comes by way of them; one that is seen nearly from the front is left to the
    other view. What obstacles take from a straight path along the line of sight is shown in colour.

    Args:
        train, test: Transmitters [m].
        receivers: Positions [m].
        rotations: Columns are the axes of the first receivers, drawn as arrows; empty where directions do not matter.
        edges: Line segments of the room [m].
        cloud: The Gaussians; None for a model without.
        learnt: Planes and obstacles; None for a model that learns none.
    """
    corners = [train, test, receivers, edges.reshape(-1, 3)]
    if cloud is not None:
        strongest = np.argsort(cloud.strengths)[-DRAWN:]
        count, cloud = len(cloud.strengths), Cloud(*(values[strongest] for values in cloud))
        corners.append(np.quantile(cloud.means, (0.1, 0.9), axis=0))
    if learnt is not None:
        corners += [plane.corners for plane in learnt.planes if plane.share >= SHOWN]
    corners = np.concatenate(corners)
    with rc_context(STYLE):
        figure, axes, arrow = _views(corners)
        receiver = "receivers, axes of the array" if len(rotations) else "receivers"
        images = []
        for ax, (up, along) in zip(axes, VIEWS, strict=True):
            view = [0, up]
            if learnt is not None and learnt.matter is not None:
                images.append(_draw_matter(ax, learnt.matter, up, along))
            if cloud is not None:
                gaussians = _draw_cloud(ax, cloud, view)
            if learnt is not None:
                _draw_planes(ax, learnt.planes, view, along)
            ax.add_collection(LineCollection(edges[..., view], colors="0.5", linewidths=0.8))
            ax.plot(*train[:, view].T, ".", color="0.2", markersize=2, label="transmitters, train")
            ax.plot(*test[:, view].T, ".", color=ORANGE, markersize=3, label="transmitters, test")
            ax.plot(*receivers[:, view].T, "s", color=GREEN, markersize=5, markeredgecolor="white", label=receiver)
            for position, rotation in zip(receivers, rotations, strict=False):
                _draw_axes(ax, position[view], arrow * rotation[view])
        if cloud is not None:
            label = f"|signal| × opacity, {len(cloud.means):,} strongest of {count:,} Gaussians"
            figure.colorbar(gaussians, ax=axes, label=label, aspect=30, shrink=0.7, extend="max")
        if images:
            highest = max(FAINT_DB, *(np.quantile(image.get_array().data, 0.99) for image in images))
            for image in images:
                image.set_clim(0, highest)
            label = "loss by obstacles along the line of sight [dB]"
            figure.colorbar(images[0], ax=axes, label=label, aspect=30, shrink=0.7, extend="max")
        _legend(figure, axes[0])
    return figure


def paths(learnt: LearntRoom, receivers: Float[ndarray, "receivers 3"], edges: Float[ndarray, "k 2 3"]) -> Figure:
    """The learnt paths of a transmitter, folded through the room, in plan (x, y) and side view (x, z).

    Args:
        learnt: At least one path, all of one transmitter; and the planes, drawn faintly.
        receivers: Positions [m].
        edges: Line segments of the room [m].
    """
    points = [path.points for path in learnt.paths]
    corners = [receivers, edges.reshape(-1, 3), *points]
    corners += [plane.corners for plane in learnt.planes if plane.share >= SHOWN]
    with rc_context(STYLE):
        figure, axes, _ = _views(np.concatenate(corners))
        for ax, (up, along) in zip(axes, VIEWS, strict=True):
            view = [0, up]
            _draw_planes(ax, learnt.planes, view, along)
            ax.add_collection(LineCollection(edges[..., view], colors="0.5", linewidths=0.8))
            lines = _draw_paths(ax, learnt.paths, view)
            ax.plot(*receivers[:, view].T, "s", color=GREEN, markersize=5, markeredgecolor="white", label="receivers")
            ax.plot(*points[0][0, view], "o", color=ORANGE, markeredgecolor="white", label="transmitter")
        x, y, z = points[0][0]
        axes[0].set_title(f"The {len(points)} strongest paths of a transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m")
        label = "power over that of the strongest path [dB]"
        figure.colorbar(lines, ax=axes, label=label, aspect=30, shrink=0.7)
        _legend(figure, axes[0])
    return figure


def _views(corners: Float[ndarray, "k 3"]) -> tuple[Figure, tuple[Axes, Axes], float]:
    """Empty plan and side view that hold some points [m], and the length of an arrow that suits them [m]."""
    lower, upper = corners.min(0), corners.max(0)
    arrow = 0.1 * (upper - lower).max()
    lower, upper = lower - 1.2 * arrow, upper + 1.2 * arrow
    width, depth, height = upper - lower
    inches = min(5.8 / width, 6.8 / (depth + height))  # what fits a page, for one metre
    figure = Figure(figsize=(width * inches + 1.3, (depth + height) * inches + 1.0), layout="compressed")
    plan, side = figure.subplots(2, 1, sharex=True, height_ratios=(depth, height))
    for ax, (up, _) in zip((plan, side), VIEWS, strict=True):
        ax.set(xlim=(lower[0], upper[0]), ylim=(lower[up], upper[up]), ylabel="xyz"[up] + " [m]", aspect="equal")
    side.set_xlabel("x [m]")
    return figure, (plan, side), arrow


def _legend(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    columns = 3 if figure.get_figwidth() > 5.5 and len(labels) <= 3 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, markerscale=1.5)


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


def _draw_planes(ax: Axes, planes: list[Plane], view: list[int], along: int) -> None:
    """Outlines, the wider the larger the share; edge on they are lines."""
    shown = [plane for plane in planes if abs(plane.normal[along]) < FACING and plane.share >= SHOWN]
    if not shown:
        return
    polygons = PolyCollection(
        [plane.corners[:, view] for plane in shown],
        facecolors=to_rgba(BLUE, 0.06),
        edgecolors=to_rgba(BLUE, 0.45),
        linewidths=[0.6 + 5 * plane.share**0.5 for plane in shown],
        label="learnt planes, by share of power",
    )
    ax.add_collection(polygons)
    width, height = np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())
    needed = np.array(LABEL) * (width, max(width, height))
    taken = []
    for plane in shown:
        outward = plane.normal[view] / np.linalg.norm(plane.normal[view])
        flat = plane.corners[:, view] - plane.corners[:, view].mean(0)
        edge = plane.corners[:, view].mean(0) + (flat @ outward).max() * outward
        sideways = np.array((-outward[1], outward[0])) * np.ptp(flat @ (-outward[1], outward[0]))
        places = [edge + share * sideways for share in (0, 0.2, -0.2, 0.4, -0.4)]
        free = (place for place in places if all((np.abs(place - other) > needed).any() for other in taken))
        place = next(free, edge)
        taken.append(place)
        across, upwards = np.round(outward).astype(int) + 1
        ax.annotate(
            f"{plane.number}: {100 * plane.share:.2g} %",
            place,
            5 * outward,
            textcoords="offset points",
            ha=("right", "center", "left")[across],
            va=("top", "center", "bottom")[upwards],
            color=BLUE,
            size=7,
            path_effects=[Stroke(linewidth=1.5, foreground="white"), Normal()],
        )


def _draw_matter(ax: Axes, matter: Matter, up: int, along: int) -> AxesImage:
    """What a path through all of it along the line of sight loses [dB]."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    pixel = max(right - left, top - bottom) / PIXELS
    x, y = np.arange(left + pixel / 2, right, pixel), np.arange(bottom + pixel / 2, top, pixel)
    columns = matter.densities * np.sqrt(2 * np.pi) * matter.widths[:, along]
    across, upwards = (
        np.exp(-(((values[:, None] - matter.centres[:, axis]) / matter.widths[:, axis]) ** 2) / 2)
        for values, axis in ((x, 0), (y, up))
    )
    extent = (left, left + len(x) * pixel, bottom, bottom + len(y) * pixel)
    losses = (upwards * columns) @ across.T
    return ax.imshow(losses, origin="lower", extent=extent, cmap="Purples", alpha=0.8)


def _draw_paths(ax: Axes, paths: list[Path], view: list[int]) -> LineCollection:
    """The strongest on top."""
    ordered = sorted(paths, key=lambda path: path.power_db)
    powers = np.array([path.power_db for path in ordered])
    lowest = min(-10.0, powers.min())
    lines = LineCollection(
        [path.points[:, view] for path in ordered],
        array=powers,
        cmap=ListedColormap(colormaps["plasma_r"](np.linspace(0.12, 1, 256))),  # paler ones are no lines on white
        clim=(lowest, 0),
        linewidths=0.8 + 1.4 * (1 - powers / lowest),
    )
    return ax.add_collection(lines)


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
