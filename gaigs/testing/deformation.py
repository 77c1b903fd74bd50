"""The check of kind ``deformation``."""

from collections.abc import Callable

import torch
from torch import nn

from gaigs.deformation import Residuals
from gaigs.gaussians import Placed, Tokens
from gaigs.query import Query
from gaigs.scene import Scene
from gaigs.testing.checks import (
    PRECISION,
    random_places,
    random_query,
    require,
    require_close,
    require_gradients,
    require_tensor,
)

CHANNELS = 2


def check_deformation(build: Callable[..., nn.Module], scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a deformation: residuals' shapes, dtype, gradients, attenuations in (0, 1], independence of the batch.

    Args:
        build: Makes the deformation: ``build(scene=..., channels=..., tokenizer_widths=...)``.
        scene: Passed to ``build``.
        device: Device of the computation.

    Raises:
        AssertionError: The contract of ``gaigs.deformation.Deformation`` is broken.
    """
    generator = torch.Generator().manual_seed(0)
    cases = [(widths, 1) for widths in ((5, 4, 6), (5, 0, 0), (0, 4, 6), (0, 0, 0))] + [((5, 4, 6), 3)]
    for widths, sets in cases:
        for dtype in PRECISION:
            module = build(scene=scene, channels=CHANNELS, tokenizer_widths=widths).to(device, dtype).eval()
            for parameter in module.parameters():  # zero heads would hide earlier layers
                parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator).to(parameter)
            for n, b in ((7, 3), (1, 1)):
                if b >= sets:
                    _check_call(module, _arguments(scene, widths, n, b, sets, generator, dtype, device))


def _arguments(scene, widths, n, b, sets, generator, dtype, device) -> tuple[Tokens, Placed, Query]:
    random = lambda *shape: torch.randn(*shape, generator=generator).to(device, dtype)
    gaussians = random(n, widths[1]) if sets == 1 else random(b, n, widths[1])
    tokens = Tokens(random(b, widths[0]), gaussians, random(b, widths[2]))
    placed = Placed(random_places(scene, sets * n, generator).to(device, dtype).unflatten(0, (sets, n)))
    return tokens, placed, random_query(scene, b, generator, dtype, device)


def _check_call(module: nn.Module, arguments: tuple[Tokens, Placed, Query]) -> None:
    tokens, placed, query = arguments
    n, b, dtype, device = placed.means.shape[1], len(query), placed.means.dtype, placed.means.device
    if not module.reads_tokens:
        tokens = None
    residuals = module(tokens, placed, query)
    require(isinstance(residuals, Residuals), f"a deformation must give Residuals, got {type(residuals).__name__}")
    shapes = (b, n, 4), (b, n, 3), (b, n, CHANNELS, 1), (b, n), (b, n)
    again, alone = module(tokens, placed, query), module(*_last(tokens, placed, query))
    for name, shape, residual, twice, single in zip(Residuals._fields, shapes, residuals, again, alone, strict=True):
        if residual is None:
            require(twice is None and single is None, f"{name} must be given for all queries or for none")
            continue
        require_tensor(name, residual, shape, dtype, device)
        require(torch.equal(residual, twice), f"two calls must give the same {name}")
        require_close(single, residual[-1:], PRECISION[dtype], f"{name} must not depend on the other queries")
    if residuals.attenuations is not None:
        inside = residuals.attenuations.gt(0) & residuals.attenuations.le(1)
        require(bool(inside.all()), "attenuations must lie in (0, 1]")
    if leaves := dict(module.named_parameters()):
        require_gradients([residual for residual in residuals if residual is not None], leaves)


def _last(tokens: Tokens | None, placed: Placed, query: Query) -> tuple[Tokens | None, Placed, Query]:
    """The last query by itself."""
    if tokens is not None:
        gaussians = tokens.gaussians if tokens.gaussians.ndim == 2 else tokens.gaussians[-1:]
        tokens = Tokens(tokens.scene[-1:], gaussians, tokens.transmitters[-1:])
    return tokens, Placed(placed.means[-1:]), query[-1:]
