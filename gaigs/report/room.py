"""The room from above and from the side: transmitters, receivers, walls, Gaussians, and learnt
planes and paths.
"""

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.data import Links
from gaigs.planes.learnt_room import LearntPlane, LearntRoom, Matter
from gaigs.planes.room_paths import LearntPath
from gaigs.report.style import BLUE, GREEN, ORANGE, STYLE
from gaigs.splatting.gaussians import SH_DC, Gaussians

SHOWN = 0.001
"""Smallest share of the power of a plane that is drawn."""

VIEWS = ((1, 2), (2, 1))
"""Upward axis and line of sight of plan and side view."""


@torch.no_grad()
def room(
    links: Links, gaussians: Gaussians | None = None, learnt: LearntRoom | None = None
) -> Figure:
    """Plan (x, y) and side view (x, z) of the room, to one scale.

    The 600 strongest Gaussians by |signal| times opacity are drawn, as ellipses of one standard
    deviation. The box holds transmitters, receivers, walls and the middle 80 % of these Gaussians
    along each axis. Line widths of learnt planes grow with their share of the power. Colour shows
    the loss by obstacles along the line of sight.
    """
    train, test = (
        links.query.transmitters[part].numpy() for part in (links.split.train, links.split.test)
    )
    receivers, edges = _receivers(links), links.edges.numpy()
    has_axes = all(
        len(one.array) > 1 or links.task.directions is not None for one in links.receivers
    )
    corners = [train, test, receivers, edges.reshape(-1, 3)]
    if gaussians is not None:
        strengths = (
            (gaussians.opacities * SH_DC * gaussians.signal[..., 0].norm(dim=-1)).cpu().numpy()
        )
        strongest = np.argsort(strengths)[-600:]  # more would hide each other
        parts = gaussians.means.cpu().numpy(), gaussians.covariances.cpu().numpy(), strengths
        means, covariances, strengths = (part[strongest] for part in parts)
        corners.append(np.quantile(means, (0.1, 0.9), axis=0))
    if learnt is not None:
        corners += [plane.corners for plane in learnt.planes if plane.share >= SHOWN]
    with rc_context(STYLE):
        figure, axes, arrow = _views(np.concatenate(corners))
        obstacles = []
        for ax, (up, along) in zip(axes, VIEWS, strict=True):
            view = [0, up]
            if learnt is not None and learnt.matter is not None:
                obstacles.append(_draw_matter(ax, learnt.matter, up, along))
            if gaussians is not None:
                ellipses = _draw_gaussians(
                    ax, means[:, view], covariances[:, view][:, :, view], strengths
                )
            if learnt is not None:
                _draw_planes(ax, learnt.planes, view, along)
            _draw_walls(ax, edges[..., view])
            ax.plot(*train[:, view].T, ".", color="0.2", markersize=2, label="transmitters, train")
            ax.plot(*test[:, view].T, ".", color=ORANGE, markersize=3, label="transmitters, test")
            _draw_receivers(
                ax, receivers[:, view], "receivers, axes of the array" if has_axes else "receivers"
            )
            for receiver in links.receivers if has_axes else ():
                _draw_axes(
                    ax,
                    receiver.pose.position.numpy()[view],
                    arrow * receiver.pose.rotation.numpy()[view],
                )
        bar = {"aspect": 30, "shrink": 0.7}
        if gaussians is not None:
            label = f"|signal| × opacity, {len(means):,} strongest of {len(gaussians.means):,} Gaussians"
            figure.colorbar(ellipses, ax=axes, label=label, extend="max", **bar)
        if obstacles:
            # The scale spans at least 1 dB, so that a negligible loss is pale, and 40 dB, where
            # nothing is left to see.
            highest = min(
                40.0, max(1.0, *(np.quantile(image.get_array().data, 0.99) for image in obstacles))
            )
            for image in obstacles:
                image.set_clim(0, highest)
            label = "loss by obstacles along the line of sight [dB]"
            figure.colorbar(obstacles[0], ax=axes, label=label, extend="max", **bar)
        _legend(figure, axes[0])
    return figure


def paths(links: Links, learnt: LearntRoom) -> Figure:
    """The learnt paths of a transmitter, at least one, folded through the room, in plan (x, y) and
    side view (x, z).
    """
    receivers, edges = _receivers(links), links.edges.numpy()
    points = [path.points for path in learnt.paths]
    corners = [receivers, edges.reshape(-1, 3), *points]
    corners += [plane.corners for plane in learnt.planes if plane.share >= SHOWN]
    with rc_context(STYLE):
        figure, axes, _ = _views(np.concatenate(corners))
        for ax, (up, along) in zip(axes, VIEWS, strict=True):
            view = [0, up]
            _draw_planes(ax, learnt.planes, view, along)
            _draw_walls(ax, edges[..., view])
            lines = _draw_paths(ax, learnt.paths, view)
            _draw_receivers(ax, receivers[:, view], "receivers")
            ax.plot(
                *points[0][0, view], "o", color=ORANGE, markeredgecolor="white", label="transmitter"
            )
        x, y, z = points[0][0]
        axes[0].set_title(
            f"The {len(points)} strongest paths of a transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        )
        label = "power over that of the strongest path [dB]"
        figure.colorbar(lines, ax=axes, label=label, aspect=30, shrink=0.7)
        _legend(figure, axes[0])
    return figure


def _receivers(links: Links) -> Float[ndarray, "receivers 3"]:
    return np.stack([receiver.pose.position.numpy() for receiver in links.receivers])


def _draw_walls(ax: Axes, edges: Float[ndarray, "k 2 2"]) -> None:
    label = "walls and furniture" if len(edges) else "_nothing"
    ax.add_collection(LineCollection(edges, colors="0.5", linewidths=0.8, label=label))


def _draw_receivers(ax: Axes, places: Float[ndarray, "receivers 2"], label: str) -> None:
    ax.plot(*places.T, "s", color=GREEN, markersize=5, markeredgecolor="white", label=label)


def _views(corners: Float[ndarray, "k 3"]) -> tuple[Figure, tuple[Axes, Axes], np.floating]:
    """Empty plan and side view that contain some points [m], and the length of arrows in them [m]."""
    lower, upper = corners.min(0), corners.max(0)
    arrow = 0.1 * (upper - lower).max()
    lower, upper = lower - 1.2 * arrow, upper + 1.2 * arrow
    width, depth, height = upper - lower
    inches = min(5.8 / width, 6.8 / (depth + height))  # of one metre on the page
    figure = Figure(
        figsize=(width * inches + 1.3, (depth + height) * inches + 1.0), layout="compressed"
    )
    plan, side = figure.subplots(2, 1, sharex=True, height_ratios=(depth, height))
    for ax, (up, _) in zip((plan, side), VIEWS, strict=True):
        ax.set(
            xlim=(lower[0], upper[0]),
            ylim=(lower[up], upper[up]),
            ylabel="xyz"[up] + " [m]",
            aspect="equal",
        )
    side.set_xlabel("x [m]")
    return figure, (plan, side), arrow


def _legend(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    columns = 3 if figure.get_figwidth() > 5.5 and len(labels) <= 3 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, markerscale=1.5)


def _draw_gaussians(
    ax: Axes,
    means: Float[ndarray, "n 2"],
    covariances: Float[ndarray, "n 2 2"],
    strengths: Float[ndarray, " n"],
) -> EllipseCollection:
    variances, axes = np.linalg.eigh(covariances)  # ascending
    minor, major = (
        2 * np.sqrt(variances.clip(0)).T
    )  # rounding can leave a flat ellipse a variance below zero
    ellipses = EllipseCollection(
        major,
        minor,
        np.rad2deg(np.arctan2(axes[:, 1, 1], axes[:, 0, 1])),
        units="xy",
        offsets=means,
        offset_transform=ax.transData,
        array=strengths,
        cmap="Blues",
        clim=(0, np.quantile(strengths, 0.98)),  # one outlier must not pale all others
        alpha=0.6,
        edgecolors="white",
        linewidths=0.3,
    )
    ax.add_collection(ellipses)
    return ellipses


def _draw_planes(ax: Axes, planes: list[LearntPlane], view: list[int], along: int) -> None:
    """Outlines with their share of the power. A plane that faces the reader would cover the room
    and is left out.
    """
    # The limit is above 1 / sqrt(2), so that each plane is in one view at least.
    shown = [plane for plane in planes if abs(plane.normal[along]) < 0.77 and plane.share >= SHOWN]
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
    needed = np.array((0.14 * width, 0.04 * max(width, height)))  # of a label
    taken: list[ndarray] = []
    for plane in shown:
        outward = plane.normal[view] / np.linalg.norm(plane.normal[view])
        flat = plane.corners[:, view] - plane.corners[:, view].mean(0)
        edge = plane.corners[:, view].mean(0) + (flat @ outward).max() * outward
        sideways = np.array((-outward[1], outward[0])) * np.ptp(flat @ (-outward[1], outward[0]))
        places = [edge + share * sideways for share in (0, 0.2, -0.2, 0.4, -0.4)]
        free = (
            place
            for place in places
            if all((np.abs(place - other) > needed).any() for other in taken)
        )
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
    """Loss of a path through all obstacles along the line of sight [dB]."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    pixel = max(right - left, top - bottom) / 300
    x, y = np.arange(left + pixel / 2, right, pixel), np.arange(bottom + pixel / 2, top, pixel)
    columns = matter.densities * np.sqrt(2 * np.pi) * matter.widths[:, along]
    across, upwards = (
        np.exp(-(((values[:, None] - matter.centres[:, axis]) / matter.widths[:, axis]) ** 2) / 2)
        for values, axis in ((x, 0), (y, up))
    )
    extent = (left, left + len(x) * pixel, bottom, bottom + len(y) * pixel)
    losses = (upwards * columns) @ across.T
    return ax.imshow(losses, origin="lower", extent=extent, cmap="Purples", alpha=0.8)


def _draw_paths(ax: Axes, paths: list[LearntPath], view: list[int]) -> LineCollection:
    """The strongest on top."""
    ordered = sorted(paths, key=lambda path: path.power_db)
    powers = np.array([path.power_db for path in ordered])
    lowest = min(-10.0, powers.min())
    lines = LineCollection(
        [path.points[:, view] for path in ordered],
        array=powers,
        cmap=ListedColormap(
            colormaps["plasma_r"](np.linspace(0.12, 1, 256))
        ),  # paler colours vanish on white
        clim=(lowest, 0),
        linewidths=0.8 + 1.4 * (1 - powers / lowest),
    )
    ax.add_collection(lines)
    return lines


def _draw_axes(ax: Axes, position: Float[ndarray, "2"], axes: Float[ndarray, "2 3"]) -> None:
    lengths = np.hypot(*axes)
    for name, axis, length in zip("xyz", axes.T, lengths, strict=True):
        if length > 0.3 * lengths.max():  # an axis along the line of sight would be a dot
            ax.annotate(
                name,
                position,
                position + 1.15 * axis,
                ha="center",
                va="center",
                weight="bold",
                arrowprops={"arrowstyle": "<-", "linewidth": 1, "shrinkA": 4, "shrinkB": 0},
            )
