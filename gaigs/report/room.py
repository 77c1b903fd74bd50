"""The room from above and from the side: links, walls, Gaussians, learnt planes and paths."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.path import Path
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray
from scipy.spatial import ConvexHull

from gaigs.data import Links
from gaigs.planes.learnt_room import LearntPlane, LearntRoom, Matter
from gaigs.planes.room_paths import LearntPath
from gaigs.report.style import BLUE, GREEN, ORANGE, STYLE, ask, new_figure
from gaigs.splatting.gaussians import SH_DC, Gaussians


class _View(NamedTuple):
    """A panel that shows the room along one axis, with x to the right."""

    ax: Axes
    up: int  # number of the upward axis
    along: int  # number of the axis along the line of sight

    def project(self, points: Float[ndarray, "*shape 3"]) -> Float[ndarray, "*shape 2"]:
        """Points in the panel's coordinates."""
        return points[..., [0, self.up]]


class _Views(NamedTuple):
    """Plan and side view to one scale."""

    figure: Figure
    panels: tuple[_View, _View]
    arrow: float  # length of arrows in them [m]

    @property
    def axes(self) -> list[Axes]:
        """Matplotlib's axes of both panels."""
        return [view.ax for view in self.panels]


class _Cloud(NamedTuple):
    """The drawn Gaussians, and the number of all."""

    means: Float[ndarray, "k 3"]  # [m]
    covariances: Float[ndarray, "k 3 3"]  # [m²]
    strengths: Float[ndarray, " k"]  # |signal| times opacity, ascending
    count: int


class _Content(NamedTuple):
    """Drawn parts of a room."""

    links: Links | None
    cloud: _Cloud | None
    planes: list[LearntPlane]
    matter: Matter | None

    @property
    def corners(self) -> Float[ndarray, "k 3"]:
        """Points that a panel must contain [m]."""
        corners = [plane.corners for plane in self.planes]
        if self.links is not None:
            query = self.links.query
            corners += [_receivers(self.links), self.links.edges.numpy().reshape(-1, 3)]
            for part in (self.links.split.train, self.links.split.test):
                corners.append(query.transmitters[part].numpy())
        if self.cloud is not None:
            corners.append(np.quantile(self.cloud.means, (0.1, 0.9), axis=0))
        if not corners:
            raise ValueError("the model has learnt no planes\npass links= to draw the links")
        return np.concatenate(corners)

    def draw(self, view: _View, arrow: float) -> list[AxesImage | EllipseCollection]:
        """Draws everything in a panel.

        Returns:
            Images that need a colour bar: obstacles, then Gaussians.
        """
        coloured: list[AxesImage | EllipseCollection] = []
        if self.matter is not None:
            coloured.append(_draw_matter(view, self.matter))
        if self.cloud is not None:
            coloured.append(_draw_gaussians(view, self.cloud))
        _draw_planes(view, self.planes)
        if self.links is not None:
            _draw_walls(view, self.links.edges.numpy())
            _draw_links(view, self.links, arrow)
        return coloured

    def draw_bars(self, drawn: Sequence[list], axes: Sequence[Axes]) -> None:
        """Draws the colour bars of panels.

        Args:
            drawn: Result of ``draw`` for each panel.
            axes: Axes of the panels.
        """
        figure = axes[0].figure
        bar: dict[str, Any] = {"ax": axes, "extend": "max", "aspect": 30, "shrink": 0.7}
        if self.cloud is not None:
            shown = f"{len(self.cloud.means):,} strongest of {self.cloud.count:,} Gaussians"
            figure.colorbar(drawn[0][-1], label=f"|signal| × opacity, {shown}", **bar)
        if self.matter is not None:
            # One scale of all views. It spans at least 1 dB, so that a negligible loss is pale, and
            # at most 40 dB, where nothing is left to see.
            highest = [np.quantile(images[0].get_array().data, 0.99) for images in drawn]
            for images in drawn:
                images[0].set_clim(0, min(40.0, max(1.0, *highest)))
            label = "fitted loss by obstacles along the line of sight [dB]"
            figure.colorbar(drawn[0][0], label=label, **bar)


@torch.no_grad()
def room(
    links: Links | None, gaussians: Gaussians | None = None, learnt: LearntRoom | None = None
) -> Figure:
    """Plan (x, y) and side view (x, z) of the room, to one scale.

    The 600 strongest Gaussians by |signal| times opacity are drawn, as ellipses of one standard
    deviation. The drawn box contains transmitters, receivers, walls and, along each axis, the
    middle 80 % of these Gaussians. Line widths of learnt planes grow with their fraction of the
    power. Colour shows the loss by obstacles along the line of sight.
    """
    cloud = None if gaussians is None else _strongest(gaussians)
    matter = None if learnt is None else learnt.matter
    content = _Content(links, cloud, _drawn_planes(learnt), matter)
    question = f"Where are the {'links' if cloud is None else 'Gaussians'}?"
    if content.planes or matter is not None:
        question = "What has the model learnt of the room?"
    note = (
        "Obstacles are losses that explain the training labels. They are no evidence of a "
        "wall:\nthey also stand for all else that weakens paths, and are arbitrary where few "
        "paths pass."
    )
    with rc_context(STYLE):
        views = _views(content.corners)
        drawn = [content.draw(view, views.arrow) for view in views.panels]
        content.draw_bars(drawn, views.axes)
        _legend(views)
        ask(views.figure, question, "" if matter is None else note)
    return views.figure


def plot_room(
    result: LearntRoom, ax: Any = None, links: Links | None = None, show_paths: bool = False
) -> Any:
    """Draws the learnt room of a model.

    Args:
        result: Planes, obstacles and paths from ``model.learnt_room(links)``.
        ax: Axes for the plan; None: plan and side view in a new figure.
        links: Links whose transmitters, receivers and walls are also drawn; or None.
        show_paths: True to draw the paths of a transmitter instead of links and obstacles. This
            needs ``links``, and no ``ax``.
    """
    if show_paths and (links is None or not result.paths or ax is not None):
        raise ValueError(
            "paths need links and a figure of their own\n"
            "pass links=, both here and to model.learnt_room(links), and no ax"
        )
    if ax is None:
        figure = paths(links, result) if show_paths else room(links, None, result)
        return figure.axes[:2]
    content = _Content(links, None, _drawn_planes(result), result.matter)
    ends, arrow = _rims(content.corners)
    _fit(ax, ends, 1)
    ax.set_xlabel("x [m]")
    content.draw_bars([content.draw(_View(ax, up=1, along=2), arrow)], [ax])
    ax.legend()
    return ax


def paths(links: Links, learnt: LearntRoom) -> Figure:
    """The learnt paths of a transmitter, folded through the room, in plan and side view."""
    receivers = _receivers(links)
    edges = links.edges.numpy()
    planes = _drawn_planes(learnt)
    points = [path.points for path in learnt.paths]
    corners = [receivers, edges.reshape(-1, 3), *points]
    corners += [plane.corners for plane in planes]
    transmitter = points[0][0]
    with rc_context(STYLE):
        views = _views(np.concatenate(corners))
        for view in views.panels:
            _draw_planes(view, planes)
            _draw_walls(view, edges)
            lines = _draw_paths(view, learnt.paths)
            _draw_receivers(view, receivers, "receivers")
            look = {"color": ORANGE, "markeredgecolor": "white"}
            view.ax.plot(*view.project(transmitter), "o", label="transmitter", **look)
        place = ", ".join(f"{number:.2f}" for number in transmitter)
        question = f"How does the signal from ({place}) m arrive?"
        label = "power over that of the strongest path [dB]"
        views.figure.colorbar(lines, ax=views.axes, label=label, aspect=30, shrink=0.7)
        _legend(views)
        ask(views.figure, question, f"the {len(points)} strongest paths that the model has learnt")
    return views.figure


def _receivers(links: Links) -> Float[ndarray, "receivers 3"]:
    """Positions of the receivers [m]."""
    return np.stack([receiver.pose.position.numpy() for receiver in links.receivers])


def _drawn_planes(learnt: LearntRoom | None, least: float = 0.001) -> list[LearntPlane]:
    """Learnt planes with at least the fraction ``least`` of the power."""
    planes = [] if learnt is None else learnt.planes
    return [plane for plane in planes if plane.share >= least]


def _strongest(gaussians: Gaussians, most: int = 600) -> _Cloud:
    """The strongest Gaussians; more would hide each other."""
    signal = gaussians.signal[..., 0].norm(dim=-1)  # (n,)
    strengths = (gaussians.opacities * SH_DC * signal).cpu().numpy()
    chosen = np.argsort(strengths)[-most:]
    means = gaussians.means.cpu().numpy()[chosen]
    covariances = gaussians.covariances.cpu().numpy()[chosen]
    return _Cloud(means, covariances, strengths[chosen], len(gaussians.means))


def _draw_walls(view: _View, edges: Float[ndarray, "k 2 3"]) -> None:
    label = "walls and furniture" if len(edges) else "_nothing"
    lines = LineCollection(view.project(edges), colors="0.5", linewidths=0.8, label=label)
    view.ax.add_collection(lines)


def _draw_receivers(view: _View, places: Float[ndarray, "receivers 3"], label: str) -> None:
    look = {"color": GREEN, "markersize": 5, "markeredgecolor": "white"}
    view.ax.plot(*view.project(places).T, "s", label=label, **look)


def _draw_links(view: _View, links: Links, arrow: float) -> None:
    """Transmitters, receivers, and the axes of arrays, each as long as an arrow [m]."""
    train = links.query.transmitters[links.split.train].numpy()
    test = links.query.transmitters[links.split.test].numpy()
    dots = {"color": "0.2", "markersize": 2, "label": "transmitters, train"}
    view.ax.plot(*view.project(train).T, ".", **dots)
    dots = {"color": ORANGE, "markersize": 3, "label": "transmitters, test"}
    view.ax.plot(*view.project(test).T, ".", **dots)
    has_directions = links.task.directions is not None
    has_axes = all(len(receiver.array) > 1 or has_directions for receiver in links.receivers)
    label = "receivers, axes of the array" if has_axes else "receivers"
    _draw_receivers(view, _receivers(links), label)
    for receiver in links.receivers if has_axes else ():
        # The axes are the columns of the rotation.
        axes = arrow * receiver.pose.rotation.numpy().T
        _draw_axes(view, receiver.pose.position.numpy(), axes)


def _rims(corners: Float[ndarray, "k 3"]) -> tuple[Float[ndarray, "2 3"], float]:
    """A box around points with margins [m], and the length of arrows in a drawing of it [m]."""
    ends = np.stack((corners.min(0), corners.max(0)))
    arrow = 0.1 * float(np.ptp(ends, 0).max())
    return ends + 1.2 * arrow * np.array([[-1], [1]]), arrow


def _fit(ax: Axes, ends: Float[ndarray, "2 3"], up: int) -> None:
    """Sets the limits of a panel to a box, and its label; ``up`` is the number of its y axis."""
    ax.set(xlim=ends[:, 0], ylim=ends[:, up], ylabel="xyz"[up] + " [m]", aspect="equal")


def _views(corners: Float[ndarray, "k 3"]) -> _Views:
    """Empty plan and side view that contain some points [m]."""
    ends, arrow = _rims(corners)
    width, depth, height = np.ptp(ends, 0)
    inches = min(5.8 / width, 6.8 / (depth + height))  # of one metre on the page
    size = (width * inches + 1.3, (depth + height) * inches + 1.4)
    figure = new_figure(*size, "compressed")
    plan, side = figure.subplots(2, 1, sharex=True, height_ratios=(depth, height))
    _fit(plan, ends, 1)
    _fit(side, ends, 2)
    side.set_xlabel("x [m]")
    return _Views(figure, (_View(plan, up=1, along=2), _View(side, up=2, along=1)), arrow)


def _legend(views: _Views) -> None:
    handles, labels = views.axes[0].get_legend_handles_labels()
    columns = 3 if views.figure.get_figwidth() > 5.5 and len(labels) <= 3 else 2
    look: dict[str, Any] = {"ncols": columns, "markerscale": 1.5}
    views.figure.legend(handles, labels, loc="outside lower center", **look)


def _draw_gaussians(view: _View, cloud: _Cloud) -> EllipseCollection:
    """Draws Gaussians as ellipses of one standard deviation, coloured by strength."""
    flat = [0, view.up]
    covariances = cloud.covariances[:, flat][:, :, flat]  # (k, 2, 2)
    variances, axes = np.linalg.eigh(covariances)  # ascending, axes in columns
    # Rounding can leave a flat ellipse a variance below zero.
    minor, major = 2 * np.sqrt(variances.clip(0)).T  # full lengths [m]
    angles = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])  # of the major axes
    ellipses = EllipseCollection(
        major,
        minor,
        np.rad2deg(angles),
        units="xy",
        offsets=view.project(cloud.means),
        offset_transform=view.ax.transData,
        array=cloud.strengths,
        cmap="Blues",
        clim=(0, np.quantile(cloud.strengths, 0.98)),  # one outlier must not pale all others
        alpha=0.6,
        edgecolors="white",
        linewidths=0.3,
    )
    view.ax.add_collection(ellipses)
    return ellipses


def _draw_planes(view: _View, planes: Sequence[LearntPlane]) -> None:
    """Draws planes with their fraction of the power, except planes parallel to the panel."""
    # The limit is above 1 / sqrt(2), so that each plane is in one view at least.
    shown = [plane for plane in planes if abs(plane.normal[view.along]) < 0.77]
    if not shown:
        return
    polygons = PolyCollection(
        [view.project(plane.corners) for plane in shown],
        facecolors=to_rgba(BLUE, 0.06),
        edgecolors=to_rgba(BLUE, 0.45),
        linewidths=[0.6 + 5 * plane.share**0.5 for plane in shown],
        label="learnt planes, by share of power",
    )
    view.ax.add_collection(polygons)
    taken: list[ndarray] = []
    for plane in shown:
        normal = view.project(plane.normal)
        outward = normal / np.linalg.norm(normal)
        place = _free_place(view, plane, outward, taken)
        taken.append(place)
        # Texts are outside the room: -1, 0 or 1 of the direction, plus 1, choose their anchors.
        across, upwards = np.round(outward).astype(int) + 1
        view.ax.annotate(
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


def _free_place(
    view: _View, plane: LearntPlane, outward: Float[ndarray, "2"], taken: Sequence[ndarray]
) -> Float[ndarray, "2"]:
    """A place for the label of a plane at its outer edge, or the edge's middle if none is free.

    Args:
        outward: Unit normal of the plane in the panel, which points out of the room.
        taken: Places of other labels.
    """
    width = np.ptp(view.ax.get_xlim())
    height = np.ptp(view.ax.get_ylim())
    needed = np.array((0.14 * width, 0.04 * max(width, height)))  # of a label
    corners = view.project(plane.corners)
    middle = corners.mean(0)
    offsets = corners - middle
    edge = middle + (offsets @ outward).max() * outward  # middle of the outer edge
    along = (-outward[1], outward[0])  # unit vector along the edge
    sideways = np.array(along) * np.ptp(offsets @ along)
    for share in (0, 0.2, -0.2, 0.4, -0.4):
        place = edge + share * sideways
        if all((np.abs(place - other) > needed).any() for other in taken):
            return place
    return edge


def _draw_matter(view: _View, matter: Matter) -> AxesImage:
    """Draws the loss of a path through all obstacles along the line of sight [dB]."""
    left, right = view.ax.get_xlim()
    bottom, top = view.ax.get_ylim()
    pixel = max(right - left, top - bottom) / 300
    x = np.arange(left + pixel / 2, right, pixel)
    y = np.arange(bottom + pixel / 2, top, pixel)
    # A Gaussian density [dB/m] is a product of three factors. Along the line of sight its integral
    # is the density at the centre times sqrt(2 pi) width.
    central_losses = matter.densities * np.sqrt(2 * np.pi) * matter.widths[:, view.along]  # [dB]
    across = _bells(x, matter, 0)  # (x, obstacles)
    upwards = _bells(y, matter, view.up)  # (y, obstacles)
    extent = (left, left + len(x) * pixel, bottom, bottom + len(y) * pixel)
    losses = (upwards * central_losses) @ across.T  # (y, x)
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    for corners, loss in zip(matter.boxes, matter.losses, strict=True):
        outline = view.project(corners)
        hull = Path(outline[ConvexHull(outline).vertices])
        losses += loss * hull.contains_points(pixels).reshape(losses.shape)
    return view.ax.imshow(losses, origin="lower", extent=extent, cmap="Purples", alpha=0.8)


def _bells(values: Float[ndarray, " n"], matter: Matter, axis: int) -> Float[ndarray, "n k"]:
    """Each obstacle's factor exp(-offset² / 2) along an axis, at coordinates ``values`` [m].

    The offset is the distance from the obstacle's centre over its width.
    """
    offsets = (values[:, None] - matter.centres[:, axis]) / matter.widths[:, axis]  # (n, k)
    return np.exp(-(offsets**2) / 2)


def _draw_paths(view: _View, paths: Sequence[LearntPath]) -> LineCollection:
    """Draws paths coloured by power, the strongest on top."""
    ordered = sorted(paths, key=lambda path: path.power_db)
    powers = np.array([path.power_db for path in ordered])
    lowest = min(-10.0, powers.min())
    visible = colormaps["plasma_r"](np.linspace(0.12, 1, 256))  # paler colours vanish on white
    lines = LineCollection(
        [view.project(path.points) for path in ordered],
        array=powers,
        cmap=ListedColormap(visible),
        clim=(lowest, 0),
        linewidths=0.8 + 1.4 * (1 - powers / lowest),
    )
    view.ax.add_collection(lines)
    return lines


def _draw_axes(view: _View, position: Float[ndarray, "3"], axes: Float[ndarray, "3 3"]) -> None:
    """Draws an arrow from a position along each axis (a row), with its name."""
    start = view.project(position)
    ends = view.project(axes)  # (3, 2)
    lengths = np.hypot(*ends.T)
    for name, end, length in zip("xyz", ends, lengths, strict=True):
        if length > 0.3 * lengths.max():  # an axis along the line of sight would be a dot
            view.ax.annotate(
                name,
                start,
                start + 1.15 * end,
                ha="center",
                va="center",
                weight="bold",
                arrowprops={"arrowstyle": "<-", "linewidth": 1, "shrinkA": 4, "shrinkB": 0},
            )
