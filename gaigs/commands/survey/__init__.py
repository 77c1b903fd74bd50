"""Survey planning: places to measure next, and superfluous measured places."""

from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gaigs.commands.survey.area import read_candidates
from gaigs.commands.survey.plan import SurveyPlan, survey
from gaigs.registry import call
from gaigs.report import style
from gaigs.runs import load


def run(config: dict, folder: Path) -> None:
    """Plans a survey, with a finished run if given; writes ``survey.csv`` and ``survey.png``."""
    model = None if config["folder"] is None else load(config["folder"], config["trust"])
    options = dict(config["survey"])
    if isinstance(options["candidates"], str):
        options["candidates"] = read_candidates(Path(options["candidates"]), model)
    plan = call("survey", survey, options, model=model)
    folder.mkdir(parents=True, exist_ok=True)
    plan.save(folder / "survey.csv")
    style.save(figure(plan), folder / "survey.png")
    print(plan)
    if plan.frame is not None:
        print(f"easting and northing are those of EPSG:{plan.frame.epsg}")
    print(f"results: {folder}")


def figure(plan: SurveyPlan) -> Figure:
    """A figure of places from above, and of the error after each new place if the error falls."""
    with rc_context(style.STYLE):
        drawn = style.new_figure(style.PAGE, 0.52 * style.PAGE, "compressed")
        # A flat curve says no more than the text.
        has_curve = plan.errors is not None and plan.errors[-1] < 0.98 * plan.errors[0]
        count = 2 if has_curve else 1
        axes = drawn.subplots(1, count, squeeze=False)[0]
        draw_places(axes[0], plan)
        drawn.legend(loc="outside lower left", ncols=3)
        if count == 2:
            draw_errors(axes[1], plan)
        gain = "" if plan.errors is None else ", and what does it bring"
        style.ask(drawn, f"Where to measure next{gain}?")
    return drawn


def plot_plan(result: SurveyPlan, ax: Any = None) -> Any:
    """Draws the places on ``ax``, or in a new figure together with the errors."""
    if ax is None:
        return figure(result).axes
    draw_places(ax, result)
    ax.legend()
    return ax


def draw_places(axis: Axes, plan: SurveyPlan) -> None:
    """Draws measured places, and places to measure with their numbers, from above."""
    if len(plan.known):
        x, y = plan.known[~plan.superfluous, :2].T.numpy()
        axis.plot(x, y, "o", markersize=3, label="measured", color=style.GREY)
        x, y = plan.known[plan.superfluous, :2].T.numpy()
        label = "measured, could be left out"
        axis.plot(x, y, "o", markersize=3, label=label, color="none", markeredgecolor=style.GREY)
    x, y = plan.places[:, :2].T.numpy()
    label = "to measure, in this order"
    axis.plot(x, y, "o", markersize=8, label=label, color=style.ORANGE, clip_on=False)
    numbers: dict[tuple[float, ...], list[str]] = {}
    for number, place in enumerate(plan.places.tolist(), 1):
        numbers.setdefault(tuple(place[:2]), []).append(str(number))
    for point, lines in numbers.items():  # one above the other, for places at several heights
        size = 5 / len(lines) ** 0.5
        text = "\n".join(lines)
        axis.annotate(text, point, ha="center", va="center", color="white", size=size)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def draw_errors(axis: Axes, plan: SurveyPlan) -> None:
    """Draws the expected error after each new place; the y axis spans at least 5 % of the error."""
    label = f"expected mean error [{plan.unit}]" if plan.unit else "expected mean error"
    axis.plot(plan.errors.numpy(), color=style.BLUE)
    first, last = plan.errors.max().item(), plan.errors.min().item()
    # The axis begins near the data, so that a small fall is seen. Its smallest span keeps a flat
    # line from looking steep.
    rim = max(0.1 * (first - last), 0.025 * first)
    axis.set(xlabel="new places", ylabel=label, ylim=(last - rim, first + rim))
    # No number of places lowers the error below this.
    scatter = f"labels at one place scatter by {plan.scatter:.3g} {plan.unit}".rstrip()
    axis.set_title(scatter, fontsize="medium")
    axis.locator_params(axis="x", integer=True)
    axis.grid()
    axis.set_axisbelow(True)
