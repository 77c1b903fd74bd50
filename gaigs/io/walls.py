"""Floor plans: the walls of a room from a table of vertices."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.io.tables import read_points


def read_walls(file: Path) -> Float[Tensor, "k 2 3"]:
    """Walls of a floor plan, at z = 0 [m]: segments from each vertex x,y of a file to the next.

    Raises:
        ValueError: The file has a defect, or fewer than two vertices.
    """
    vertices = read_points(file, "xy", "consecutive wall vertices x,y [m], one a line")
    if len(vertices) == 1:
        raise ValueError(f"{file}: expected two wall vertices or more, got 1")
    corners = torch.nn.functional.pad(torch.tensor(vertices), (0, 1))
    return torch.stack((corners[:-1], corners[1:]), 1)
