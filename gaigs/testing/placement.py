"""The check of kind ``placement``."""

import copy
import math
from dataclasses import replace

import torch
from torch import nn

from gaigs.core.scene import Scene
from gaigs.splatting.gaussians import Gaussians, Placed
from gaigs.testing import checks
from gaigs.testing.checks import PRECISION, require, require_close, require_same, require_tensor


def check_placement(placement: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a placement built for the scene and 2 channels: shapes, dtype, gradients, independence
    of the batch.

    A placement with Gaussians of its own is also called without free ones. The contract is that of
    ``gaigs.splatting.placement.Placement``.
    """
    generator = torch.Generator().manual_seed(0)
    cases = [
        (n, 3, dtype) for n in ((40, 0) if placement.has_own else (40,)) for dtype in PRECISION
    ]
    for count, b, dtype in (*cases, (len(scene.receivers), 1, torch.float32)):
        module = copy.deepcopy(placement).to(device, dtype).eval()
        gaussians = example_gaussians(scene, count).to(device, dtype) if count else None
        query = checks.random_query(scene, b, generator, dtype, device)
        query.transmitters.requires_grad_()
        placed = module(gaussians, query)
        require(
            isinstance(placed, Placed),
            f"a placement must give a Placed, got {type(placed).__name__}",
        )
        n = placed.means.shape[-2] if placement.has_own else count
        require(
            n >= count, f"the free Gaussians, {count}, must be among those that are placed, got {n}"
        )
        _check_placed(placed, n, b, dtype, device)
        again, alone = module(gaussians, query), module(gaussians, query[-1:])
        per_query = (
            "means",
            "lengths",
            "scales",
            "gains",
        )  # fields that may have a row for each query
        checks.require_independence(placed, again, alone, per_query, PRECISION[dtype])
        if not module.sees_receivers:
            other = module(gaussians, replace(query, receivers=torch.zeros_like(query.receivers)))
            for name, whole, moved in zip(Placed._fields, placed, other, strict=True):
                if whole is not None:
                    require_same(
                        whole,
                        moved,
                        f"{name} must not depend on the receiver unless sees_receivers is true",
                    )
        leaves = {"transmitters": query.transmitters, **dict(module.named_parameters())}
        if gaussians is not None:
            leaves |= {f"gaussians.{name}": leaf for name, leaf in gaussians.named_parameters()}
        checks.require_gradients(placed, leaves)
        nothing = module(gaussians, query[:0]).means
        require(
            nothing.shape[0] in (0, 1) and nothing.shape[1:] == (n, 3),
            "no queries must be placed too",
        )
    checks.require_groups(placement.parameter_groups(), placement)
    for name, penalty in placement.penalties().items():
        require_tensor(f"the penalty {name}", penalty, (), torch.float32)


def example_gaussians(scene: Scene, count: int) -> Gaussians:
    """Gaussians about the receivers of a scene."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Gaussians(
            scene,
            zone=(-0.5, 1.5),
            channels=2,
            count=count,
            near=0.5,
            far=4.0,
            spread=1.0,
            opacity=0.3,
            signal=1.0,
        )


def _check_placed(
    placed: Placed, n: int, b: int, dtype: torch.dtype, device: torch.device | str
) -> None:
    own = ("quats", "scales", "opacities", "signal")
    missing = [name for name in own if getattr(placed, name) is None]
    require(
        len(missing) in (0, 4),
        f"{', '.join(own)} must be given together, and {', '.join(missing)} is missing",
    )
    rows = lambda tensor: 1 if tensor is not None and len(tensor) == 1 else b
    shapes = {
        "means": (rows(placed.means), n, 3), "lengths": (b, n), "quats": (n, 4), "scales": (rows(placed.scales), n, 3),
        "opacities": (n,), "signal": (n, 2, 1), "gains": (b, n), "coherences": (n,), "bandwidth": (),
    }  # fmt: skip
    for name, tensor in placed._asdict().items():
        if tensor is not None:
            require_tensor(
                name, tensor, shapes[name], dtype.to_complex() if name == "gains" else dtype, device
            )
    limits = {
        **dict.fromkeys(("opacities", "coherences"), 1),
        **dict.fromkeys(("lengths", "bandwidth"), math.inf),
    }
    for name, high in limits.items():
        tensor = getattr(placed, name)
        require(
            tensor is None or (tensor.ge(0) & tensor.le(high)).all(),
            f"{name} must lie in [0, {high}]",
        )
    if placed.quats is not None:
        require(placed.scales.gt(0).all(), "scales must be positive [m]")
        norms = placed.quats.norm(dim=1)
        require_close(norms, torch.ones_like(norms), PRECISION[dtype], "quats must be of length 1")
