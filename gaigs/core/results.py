"""Results as plots and data sets; the libraries are imported on request."""

import importlib
from types import ModuleType
from typing import Any

import numpy as np

from gaigs.registry import call


def plot(result: Any, /, ax: Any = None, **options: Any) -> Any:
    """Draws a result as the run folders do; ``result.plot(...)`` is the same.

    | result | the picture answers | options |
    |---|---|---|
    | ``gaigs.radio_map(...)`` | Where do receivers hear? | receiver, deviation, links |
    | ``model.predict(..., interval=0.9)`` | What is predicted, how surely? | receiver, place |
    | ``gaigs.evaluate(...)`` | How large are errors? | metric |
    | ``gaigs.locate(...)`` | Where is the transmitter? | |
    | ``gaigs.survey(...)`` | Where to measure next? | |
    | ``gaigs.place(...)`` | Where to put access points? | |
    | ``model.learnt_room(links)`` | What is learnt of the room? | links, show_paths |

    Args:
        result: A result of the table.
        ax: Matplotlib axes to draw on; None: a new pyplot figure with all panels.
        options: See the table.

    Returns:
        The axes; an array of them if there are several panels.

    Raises:
        TypeError: The result has no plot.
        ValueError: An option is unknown, or the result has several panels and ``ax`` is given.
        ImportError: Matplotlib is not installed.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> floor = gaigs.radio_map(gaigs.train("knn", links), pitch=0.5)
        >>> ax = floor.plot(receiver="west", links=links)
        >>> ax.get_xlabel(), ax.figure.savefig("west.png")
        ('x [m]', None)
    """
    functions = {
        "RadioMap": "report.radio_maps.plot_radio_map",
        "Estimate": "report.estimates.plot_estimate",
        "Evaluation": "report.curves.plot_scores",
        "Location": "commands.locate.figures.plot_location",
        "SurveyPlan": "commands.survey.plot_plan",
        "SitePlan": "commands.place.plot_plan",
        "LearntRoom": "report.room.plot_room",
    }
    name = type(result).__name__
    if result is None:
        raise TypeError("plot got None; learnt_room is None where the labels show no room")
    if name not in functions:
        raise TypeError(f"plot takes one of {', '.join(functions)}, got {name}\nhelp(gaigs.plot)")
    library("matplotlib", "a plot")
    if ax is not None and not hasattr(ax, "plot"):
        raise TypeError(f"ax must be one axes of matplotlib, got {type(ax).__name__}")
    module, _, function = functions[name].rpartition(".")
    draw = getattr(importlib.import_module(f"gaigs.{module}"), function)
    style = importlib.import_module("gaigs.report.style")
    with style.shown():
        axes = call("plot", draw, options, result=result, ax=ax)
    if not isinstance(axes, list):
        return axes
    return axes[0] if len(axes) == 1 else np.array(axes)


def library(name: str, purpose: str) -> ModuleType:
    """A library for a ``purpose``; an ``ImportError`` with the command to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        problem = f"{purpose} needs {name}, which cannot be imported ({error})"
        raise ImportError(f"{problem}\npip install {name}") from None
