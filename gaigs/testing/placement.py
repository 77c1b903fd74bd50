"""The check of kind ``placement``."""

import copy
import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.gaussians import Gaussians, Placed
from gaigs.testing import checks
from gaigs.testing.checks import PRECISION, require, require_close, require_same, require_tensor


def check_placement(placement: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a placement: shapes, dtype, gradients, independence of the batch.

    The placement must be built for the scene and 2 channels. A placement that makes Gaussians is
    also called without free ones. The contract is in ``gaigs.splatting.placement.Placement``.
    """
    generator = torch.Generator().manual_seed(0)
    cases = [(40, 3, torch.float32), (40, 3, torch.float64)]
    if placement.has_own:
        cases += [(0, 3, torch.float32), (0, 3, torch.float64)]
    cases.append((len(scene.receivers), 1, torch.float32))
    for count, b, dtype in cases:
        module = copy.deepcopy(placement).to(device, dtype).eval()
        gaussians = example_gaussians(scene, count).to(device, dtype) if count else None
        query = checks.random_query(scene, b, generator, dtype, device)
        query.transmitters.requires_grad_()
        _check_call(module, gaussians, query)
    checks.require_groups(placement.parameter_groups(), placement)
    for name, penalty in placement.penalties().items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32)


def example_gaussians(scene: Scene, count: int) -> Gaussians:
    """Gaussians about the receivers of a scene, with 2 channels."""
    options = {"near": 0.5, "far": 4.0, "spread": 1.0, "opacity": 0.3, "signal": 1.0}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Gaussians(scene, zone=(-0.5, 1.5), channels=2, count=count, **options)


def _check_call(placement: nn.Module, gaussians: Gaussians | None, query: Query) -> None:
    """Checks the placed Gaussians of a query, and that queries are independent."""
    count = 0 if gaussians is None else len(gaussians)
    placed = placement(gaussians, query)
    is_placed = isinstance(placed, Placed)
    require(is_placed, f"a placement must give a Placed, got {type(placed).__name__}")
    n = placed.means.shape[-2] if placement.has_own else count
    require(n >= count, f"the free Gaussians, {count}, must be among those placed, got {n}")
    _check_fields(placed, n, query.transmitters)
    again = placement(gaussians, query)
    alone = placement(gaussians, query[-1:])
    per_query = ("means", "lengths", "scales", "gains")
    tolerance = PRECISION[query.transmitters.dtype]
    checks.require_independence(placed, again, alone, per_query, tolerance)
    if not placement.sees_receivers:
        moved = replace(query, receivers=torch.zeros_like(query.receivers))
        other = placement(gaussians, moved)
        for name, here, there in zip(Placed._fields, placed, other, strict=True):
            rule = f"{name} must not depend on the receiver unless sees_receivers is true"
            if here is not None:
                require_same(here, there, rule)
    leaves = {"transmitters": query.transmitters, **dict(placement.named_parameters())}
    if gaussians is not None:
        leaves |= {f"gaussians.{name}": leaf for name, leaf in gaussians.named_parameters()}
    checks.require_gradients(placed, leaves)
    nothing = placement(gaussians, query[:0]).means
    checks.require_empty(nothing.shape, [(0, n, 3), (1, n, 3)], "no queries must be placed too")


def _check_fields(placed: Placed, n: int, transmitters: Tensor) -> None:
    """Checks shapes, dtypes and ranges of n placed Gaussians for b queries."""
    together = ("quats", "scales", "opacities", "signal")
    missing = [name for name in together if getattr(placed, name) is None]
    rule = f"{', '.join(together)} must be given together, and {', '.join(missing)} is missing"
    require(len(missing) in (0, 4), rule)
    b = len(transmitters)

    def rows(tensor: Tensor | None) -> int:
        return 1 if tensor is not None and len(tensor) == 1 else b

    shapes = {
        "means": (rows(placed.means), n, 3),
        "lengths": (b, n),
        "quats": (n, 4),
        "scales": (rows(placed.scales), n, 3),
        "opacities": (n,),
        "signal": (n, 2, 1),
        "gains": (b, n),
        "coherences": (n,),
        "bandwidth": (),
    }
    limits = {"opacities": 1, "coherences": 1, "lengths": math.inf, "bandwidth": math.inf}
    for name, tensor in placed._asdict().items():
        if tensor is None:
            continue
        dtype = transmitters.dtype.to_complex() if name == "gains" else transmitters.dtype
        require_tensor(name, tensor, shapes[name], dtype, transmitters.device)
        if name in limits:
            high = limits[name]
            inside = tensor.ge(0) & tensor.le(high)
            require(inside.all(), f"{name} must lie in [0, {high}]")
    if placed.quats is not None:
        require(placed.scales.gt(0).all(), "scales must be positive [m]")
        norms = placed.quats.norm(dim=1)
        tolerance = PRECISION[transmitters.dtype]
        require_close(norms, torch.ones_like(norms), tolerance, "quats must be of length 1")
