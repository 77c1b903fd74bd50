"""The check of kind ``placement``."""

import copy

import torch
from torch import nn

from gaigs.gaussians import Gaussians
from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.scene import Scene
from gaigs.testing._checks import (
    PRECISION,
    random_frequencies,
    random_places,
    require,
    require_close,
    require_gradients,
    require_tensor,
)


def check_placement(placement: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """A placement built for the scene: shapes, dtype, gradients, independence of the batch.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.placement.Placement``.
    """
    generator = torch.Generator().manual_seed(0)
    for n, b, dtype in ((40, 3, torch.float32), (len(scene.receivers), 1, torch.float32), (40, 3, torch.float64)):
        module = copy.deepcopy(placement).to(device, dtype).eval()
        gaussians = example_gaussians(scene, n).to(device, dtype)
        places = random_places(scene, b, generator).to(dtype)
        query = Query(places, torch.arange(b) % len(scene.receivers), random_frequencies(scene, b)).to(device)
        query.transmitters.requires_grad_()
        placed = module(gaussians, query)
        require(isinstance(placed, Placed), f"a placement must give a Placed, got {type(placed).__name__}")
        _check_placed(placed, n, b, dtype, device)
        again, alone = module(gaussians, query), module(gaussians, query[-1:])
        fields = zip(Placed._fields, placed, again, alone, strict=True)
        for name, whole, twice, single in fields:
            if whole is None:
                require(twice is None and single is None, f"{name} must be given for all queries or for none")
                continue
            require(torch.equal(whole, twice), f"two calls must give the same {name}")
            require_close(single, whole[-1:], PRECISION[dtype], f"{name} must not depend on the other queries")
        leaves = {**dict(gaussians.named_parameters()), **dict(module.named_parameters())}
        given = [tensor for tensor in placed if tensor is not None]
        require_gradients(given, leaves | {"transmitters": query.transmitters})
        nothing = module(gaussians, query[:0]).means
        require(nothing.shape[0] in (0, 1) and nothing.shape[1:] == (n, 3), "no queries must be placed too")


def example_gaussians(scene: Scene, count: int) -> Gaussians:
    """Gaussians about the receivers of a scene."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Gaussians(
            scene, zone=(-0.5, 1.5), channels=2, count=count, near=0.5, far=4.0, spread=1.0, opacity=0.3, signal=1.0
        )


def _check_placed(placed: Placed, n: int, b: int, dtype: torch.dtype, device: torch.device | str) -> None:
    require(len(placed.means) in (1, b), f"means must be (1 or {b}, {n}, 3), got {tuple(placed.means.shape)}")
    require_tensor("means", placed.means, (len(placed.means), n, 3), dtype, device)
    if placed.lengths is not None:
        require_tensor("lengths", placed.lengths, (b, n), dtype, device)
        require(bool((placed.lengths >= 0).all()), "lengths must not be negative [m]")
