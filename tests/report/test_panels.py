"""Panels on pages."""

import pytest
from matplotlib.figure import Figure

from gaigs.report.panels import PANELS, numbered, pages
from gaigs.report.style import round_step


@pytest.mark.parametrize("count", [0, 1, PANELS, PANELS + 1, 3 * PANELS])
def test_every_panel_is_on_one_page(count):
    drawn = pages(count)
    assert [panel for page in drawn for panel in page] == list(range(count))
    assert all(1 <= len(page) <= PANELS for page in drawn)


def test_figures_are_numbered_from_the_second_on():
    first, second, third, other = (Figure() for _ in range(4))
    files = numbered({"map": [first, second, third], "scatter": [other], "none": []})
    assert files == {"map": first, "map_2": second, "map_3": third, "scatter": other}


@pytest.mark.parametrize(
    ("span", "most", "step"), [(40, 40, 1), (41, 40, 2), (81, 40, 5), (201, 40, 10), (3e-9, 10, 5e-10), (7e8, 7, 1e8)]
)
def test_steps_are_round(span, most, step):
    assert round_step(span, most) == pytest.approx(step)
