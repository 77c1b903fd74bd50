"""Placement of access points: the best places, and the quality that each adds."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from gaigs.commands.place.plan import SitePlan, place
from gaigs.commands.survey.area import read_candidates
from gaigs.core.task.scalar import with_unit
from gaigs.registry import call
from gaigs.report import style
from gaigs.runs import load


def run(config: dict, folder: Path) -> None:
    """Places access points by a finished run; writes ``place.csv`` and ``place.png``."""
    model = load(config["folder"], config["trust"])
    options = dict(config["place"])
    if isinstance(options["candidates"], str):
        options["candidates"] = read_candidates(Path(options["candidates"]), model)
    plan = call("place", place, options, model=model)
    folder.mkdir(parents=True, exist_ok=True)
    plan.save(folder / "place.csv")
    style.save(figure(plan), folder / "place.png")
    print(f"{plan}\nresults: {folder}")


def figure(plan: SitePlan) -> Figure:
    """Maps of the objective from above: before, and with the new places."""
    with rc_context(style.STYLE):
        count = 2 if len(plan.standing) else 1
        drawn = style.new_figure(count * style.COLUMN, 0.46 * style.PAGE, "compressed")
        panels = drawn.subplots(1, count, sharey=True, squeeze=False)[0]
        if count == 2:
            draw_map(panels[0], plan, plan.qualities[0])
            panels[0].set_title(f"as it stands: mean {plan.scores[0]:.3g} {plan.score_unit}")
        image = draw_map(panels[-1], plan, plan.qualities[-1], plan.places)
        panels[-1].set_title(f"with the new ones: mean {plan.scores[-1]:.3g} {plan.score_unit}")
        names = {"coverage": f"chance of a reading above {plan.threshold:g} {plan.unit}"}
        names |= {"mean": "expected best reading", "locate": "error of a location"}
        label = with_unit(names[plan.objective], plan.score_unit)
        drawn.colorbar(image, ax=panels, label=label)
        drawn.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        style.ask(drawn, "Where to put access points, and what do they bring?")
    return drawn


def plot_plan(result: SitePlan, ax: Any = None) -> Any:
    """Draws the map with the new places on ``ax``, or in a new figure without it."""
    if ax is None:
        return figure(result).axes[:-1]
    draw_map(ax, result, result.qualities[-1], result.places)
    ax.legend()
    return ax


def draw_map(
    axis: Axes, plan: SitePlan, values: Float[Tensor, " g"], new: Float[Tensor, "n 3"] | None = None
) -> Any:
    """Draws values from above with receivers, and returns the image.

    Args:
        values: The objective at each place of ``plan.area``; a map cell is the mean over heights.
        new: Positions of new access points [m]; None: they are not drawn.
    """
    x, columns = np.unique(plan.area[:, 0].numpy(), return_inverse=True)
    y, rows = np.unique(plan.area[:, 1].numpy(), return_inverse=True)
    cells = rows * len(x) + columns  # the area is a grid, so each cell has a place at each height
    means = np.bincount(cells, values.numpy()) / np.bincount(cells)
    low, high = 0.0, 100.0
    if plan.objective != "coverage":  # both maps have the same colours
        displayed = plan.qualities[[0, -1] if len(plan.standing) else [-1]]
        low, high = float(displayed.min()), float(displayed.max())
    colours = "viridis_r" if plan.objective == "locate" else "viridis"  # bright is good
    look = {"cmap": colours, "vmin": low, "vmax": high, "rasterized": True}
    image = axis.pcolormesh(x, y, means.reshape(len(y), len(x)), shading="nearest", **look)
    dots = {"linestyle": "none", "markeredgecolor": "white", "clip_on": False, "markersize": 8}
    if len(plan.standing):
        standing_x, standing_y = plan.standing[:, :2].T.numpy()
        axis.plot(standing_x, standing_y, "^", label="stand already", color=style.GREY, **dots)
    if new is not None:
        label = "new, in this order"
        axis.plot(*new[:, :2].T.numpy(), "o", label=label, color=style.ORANGE, **dots)
        text = {"ha": "center", "va": "center", "color": "white", "size": 5}
        for number, point in enumerate(new[:, :2].tolist(), 1):
            axis.annotate(str(number), point, **text)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    return image
