"""A split that holds out cubes of space."""

import torch

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, part


@register("split", "blocks")
def blocks(
    links: Links, edge: float, test: float = 0.2, validation: float | None = None, seed: int = 0
) -> Split:
    """Splits space into cubes and tests on randomly drawn cubes, in which nothing was trained.

    Args:
        edge: Edge of a cube [m]; the first cube starts at the lower corner of all transmitters.
            Other options and errors: see ``gaigs.split.part``.
    """
    low, high = 1e-6, 1e6  # float32 has no finer resolution, and data no larger extent
    check("edge", edge, low <= edge <= high, f"from {low:g} to {high:g} m")
    places = links.query.transmitters.double()
    cubes = ((places - places.amin(0)) / edge).floor().long()
    return part(
        f"blocks {edge:g} m",
        links,
        torch.unique(cubes, dim=0, return_inverse=True)[1],
        test,
        validation,
        seed,
    )
