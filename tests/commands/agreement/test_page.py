"""The table and the figure of how far labels agree."""

import math

from gaigs.commands.agreement.page import Cell, figure, write
from gaigs.core.task.rssi import Rssi

CELLS = [
    Cell((0.0, 0.0), (0, 3), 1, 1, (5.0, 5.0, 5.0)),
    Cell((0.0, 0.01), (0, 3), 3466, 300, (0.5, 1.25, 2.0)),
    Cell((0.0, 0.01), (31, math.inf), 113, 113, (-1.0, 2.5, 4.0)),
    Cell((0.01, 0.02), (4, 30), 20, 20, (-0.001, 2.0, 3.0)),
]
ROWS = {"one label as near": {"mae_db": 1.0, "median_ae_db": 0.5, "rmse_db": 2.0}}
MARKDOWN = r"""Median |difference| [dB] of two labels, 10th to 90th percentile, and number of pairs, by the distance
of their places and by how many measurements apart they are:

| distance [m] | within 3 | 4 to 30 | over 30 |
| --- | --- | --- | --- |
| same place | 5.00 (5.00 to 5.00), 1 |  |  |
| under 0.01 | 1.25 (0.50 to 2.00), 3,466 |  | 2.50 (-1.00 to 4.00), 113 |
| 0.01 to 0.02 |  | 2.00 (0.00 to 3.00), 20 |  |

What that lets expect on split made:

| predicted by | MAE [dB] | median AE [dB] | RMSE [dB] |
| --- | --- | --- | --- |
| one label as near | 1.00 | 0.50 | 2.00 |

- a remark
- of a cell with more, 300 random pairs are compared
"""


def test_the_page(tmp_path):
    page = write(tmp_path, Rssi(), CELLS, ROWS, "made", ["a remark"])
    assert (
        (tmp_path / "agreement.md").read_text()
        == page
        == MARKDOWN.replace("distance\nof", "distance of")
    )
    assert (tmp_path / "agreement.png").is_file()


def test_the_figure_has_a_line_for_each_separation():
    drawn = figure("|difference| [dB]", CELLS)
    (ax,) = drawn.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        "distance of the places [m]",
        "|difference| [dB] of two labels",
    )
    assert [tick.get_text() for tick in ax.get_xticklabels()] == [
        "same place",
        "under 0.01",
        "0.01 to 0.02",
    ]
    lines = {entry.get_label(): entry.lines[0] for entry in ax.containers}
    assert [*lines] == ["within 3", "4 to 30", "over 30"]
    assert lines["within 3"].get_ydata().tolist() == [5.0, 1.25]
    assert len({(line.get_linestyle(), line.get_marker()) for line in lines.values()}) == 3
