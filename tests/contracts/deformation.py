"""The check of kind ``deformation``."""

from collections.abc import Callable

import torch
from torch import nn

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.deformation import Residuals
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.testing import checks
from gaigs.testing.checks import PRECISION, require, require_tensor


def check_deformation(
    build: Callable[..., nn.Module], scene: Scene, device: torch.device | str = "cpu"
) -> None:
    """Checks a deformation: residuals' shapes, dtype, gradients, attenuations in (0, 1],
    independence of the batch.

    The contract is that of ``gaigs.splatting.deformation.Deformation``.
    ``build(scene=, channels=, tokenizer_widths=, count=)`` makes it.
    """
    generator = torch.Generator().manual_seed(0)
    cases = [(widths, 1) for widths in ((5, 4, 6), (5, 0, 0), (0, 4, 6), (0, 0, 0))] + [
        ((5, 4, 6), 3)
    ]
    for widths, sets in cases:
        for dtype in PRECISION:
            for n, b in ((7, 3), (1, 1)):
                if b < sets:
                    continue
                context = {"channels": 2, "tokenizer_widths": widths, "count": n}
                module = build(scene=scene, **context).to(device, dtype).eval()
                for parameter in module.parameters():  # zero heads would hide earlier layers
                    noise = torch.randn(parameter.shape, generator=generator)
                    parameter.data += 0.1 * noise.to(parameter)

                def random(*shape, to=dtype):
                    return torch.randn(*shape, generator=generator).to(device, to)

                gaussians = random(n, widths[1]) if sets == 1 else random(b, n, widths[1])
                tokens = Tokens(random(b, widths[0]), gaussians, random(b, widths[2]))
                places = checks.random_places(scene, sets * n, generator).to(device, dtype)
                query = checks.random_query(scene, b, generator, dtype, device)
                _check_call(module, tokens, Placed(places.unflatten(0, (sets, n))), query)


def _check_call(module: nn.Module, tokens: Tokens | None, placed: Placed, query: Query) -> None:
    n, b, dtype, device = placed.means.shape[1], len(query), placed.means.dtype, placed.means.device
    last = None
    if not module.reads_tokens:
        tokens = None
    if tokens is not None:
        gaussians = tokens.gaussians if tokens.gaussians.ndim == 2 else tokens.gaussians[-1:]
        last = Tokens(tokens.scene[-1:], gaussians, tokens.transmitters[-1:])
    residuals = module(tokens, placed, query)
    require(
        isinstance(residuals, Residuals),
        f"a deformation must give Residuals, got {type(residuals).__name__}",
    )
    shapes = (b, n, 4), (b, n, 3), (b, n, 2, 1), (b, n), (b, n)
    for name, shape, residual in zip(Residuals._fields, shapes, residuals, strict=True):
        if residual is not None:
            require_tensor(name, residual, shape, dtype, device)
    again, alone = (
        module(tokens, placed, query),
        module(last, Placed(placed.means[-1:]), query[-1:]),
    )
    checks.require_independence(residuals, again, alone, Residuals._fields, PRECISION[dtype])
    found = residuals.attenuations
    require(found is None or (found.gt(0) & found.le(1)).all(), "attenuations must lie in (0, 1]")
    checks.require_gradients(residuals, dict(module.named_parameters()))
