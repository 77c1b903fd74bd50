"""The check of kind ``placement``."""

import copy
from dataclasses import replace

import torch
from torch import Tensor, nn

from gaigs.gaussians import Gaussians, Placed
from gaigs.query import Query
from gaigs.scene import Scene
from gaigs.testing.checks import (
    PRECISION,
    random_query,
    require,
    require_close,
    require_gradients,
    require_groups,
    require_tensor,
)


def check_placement(placement: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a placement built for the scene and 2 channels: shapes, dtype, gradients, independence of the batch.

    A placement with Gaussians of its own is also asked for these alone.

    Raises:
        AssertionError: The contract of ``gaigs.placement.Placement`` is broken.
    """
    generator = torch.Generator().manual_seed(0)
    free = (40, 0) if placement.has_own else (40,)
    for count, b, dtype in (
        *((n, 3, dtype) for n in free for dtype in (torch.float32, torch.float64)),
        (len(scene.receivers), 1, torch.float32),
    ):
        module = copy.deepcopy(placement).to(device, dtype).eval()
        gaussians = example_gaussians(scene, count).to(device, dtype) if count else None
        query = random_query(scene, b, generator, dtype, device)
        query.transmitters.requires_grad_()
        placed = module(gaussians, query)
        require(isinstance(placed, Placed), f"a placement must give a Placed, got {type(placed).__name__}")
        n = placed.means.shape[-2] if placement.has_own else count
        require(n >= count, f"the free Gaussians, {count}, must be among those that are placed, got {n}")
        _check_placed(placed, n, b, dtype, device)
        _check_independence(module, gaussians, query, placed)
        leaves = dict(module.named_parameters())
        if gaussians is not None:
            leaves |= {f"gaussians.{name}": leaf for name, leaf in gaussians.named_parameters()}
        given = [tensor for tensor in placed if tensor is not None]
        require_gradients(given, leaves | {"transmitters": query.transmitters})
        nothing = module(gaussians, query[:0]).means
        require(nothing.shape[0] in (0, 1) and nothing.shape[1:] == (n, 3), "no queries must be placed too")
    require_groups(placement.parameter_groups(), placement)
    for name, penalty in placement.penalties().items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32)


def _check_independence(module: nn.Module, gaussians: Gaussians | None, query: Query, placed: Placed) -> None:
    """Two calls and a single query give the same; the receiver counts only where ``sees_receivers`` is true."""
    dtype = placed.means.dtype
    per_query = ("means", "lengths", "scales", "gains")  # fields that may have a row for each query
    again, alone = module(gaussians, query), module(gaussians, query[-1:])
    for name, whole, twice, single in zip(Placed._fields, placed, again, alone, strict=True):
        if whole is None:
            require(twice is None and single is None, f"{name} must be given for all queries or for none")
            continue
        require(torch.equal(whole, twice), f"two calls must give the same {name}")
        own = whole[-1:] if name in per_query else whole
        require_close(single, own, PRECISION[dtype], f"{name} must not depend on the other queries")
    if not module.sees_receivers:
        other = module(gaussians, replace(query, receivers=torch.zeros_like(query.receivers)))
        for name, whole, moved in zip(Placed._fields, placed, other, strict=True):
            same = whole is None or torch.equal(whole, moved)
            require(same, f"{name} must not depend on the receiver unless sees_receivers says so")


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
    own = {name: getattr(placed, name) for name in ("quats", "scales", "opacities", "signal")}
    if any(tensor is not None for tensor in own.values()):
        missing = [name for name, tensor in own.items() if tensor is None]
        require(not missing, f"{', '.join(own)} must be given together, and {', '.join(missing)} is missing")
        require(len(placed.scales) in (1, b), f"scales must be (1 or {b}, {n}, 3), got {tuple(placed.scales.shape)}")
        require_tensor("scales", placed.scales, (len(placed.scales), n, 3), dtype, device)
        require(bool((placed.scales > 0).all()), "scales must be positive [m]")
        require_tensor("quats", placed.quats, (n, 4), dtype, device)
        require_close(
            placed.quats.norm(dim=1), torch.ones_like(placed.opacities), PRECISION[dtype], "quats must be of length 1"
        )
        require_tensor("opacities", placed.opacities, (n,), dtype, device)
        _require_share("opacities", placed.opacities)
        require_tensor("signal", placed.signal, (n, 2, 1), dtype, device)
    if placed.gains is not None:
        require_tensor("gains", placed.gains, (b, n), dtype.to_complex(), device)
    if placed.coherences is not None:
        require_tensor("coherences", placed.coherences, (n,), dtype, device)
        _require_share("coherences", placed.coherences)
    if placed.bandwidth is not None:
        require_tensor("bandwidth", placed.bandwidth, (), dtype, device)
        require(bool(placed.bandwidth >= 0), "bandwidth must not be negative [Hz]")


def _require_share(name: str, values: Tensor) -> None:
    require(bool(values.ge(0).all() and values.le(1).all()), f"{name} must lie in [0, 1]")
