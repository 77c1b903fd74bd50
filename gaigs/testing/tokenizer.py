"""The check of kind ``tokenizer``."""

import copy

import torch
from torch import nn

from gaigs.gaussians import Placed, Tokens
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


def check_tokenizer(tokenizer: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a tokenizer built for the scene: widths, dtype, gradients, independence of the batch.

    The inputs include Gaussians that stand elsewhere for each query, and the scene's carriers.

    Raises:
        AssertionError: The contract of ``gaigs.tokenizer.Tokens`` is broken.
    """
    generator = torch.Generator().manual_seed(0)
    cases = (40, 3, 1, torch.float32), (1, 1, 1, torch.float32), (40, 3, 1, torch.float64), (40, 3, 3, torch.float32)
    for n, b, sets, dtype in cases:
        module = copy.deepcopy(tokenizer).to(device, dtype).eval()
        placed = Placed(random_places(scene, sets * n, generator).to(device, dtype).unflatten(0, (sets, n)))
        opacities = torch.rand(n, generator=generator).to(device, dtype)
        query = random_query(scene, b, generator, dtype, device)
        query.transmitters.requires_grad_()
        tokens = module(placed, opacities, query)
        _check_shapes(module, tokens, n, b, sets, dtype, device)
        again = module(placed, opacities, query)
        require(all(map(torch.equal, tokens, again)), "two calls must give the same tokens")
        alone = module(Placed(placed.means[-1:]), opacities, query[-1:])
        for name, token, single in zip(Tokens._fields, tokens, alone, strict=True):
            shared = name == "gaussians" and token.ndim == 2
            expected = token if shared else token[-1:].reshape(single.shape)
            require_close(single, expected, PRECISION[dtype], f"the token {name} must not depend on the other queries")
        require_gradients(tokens, {**dict(module.named_parameters()), "transmitters": query.transmitters})
        heard = torch.cat((tokens.scene, tokens.transmitters), -1)
        if b > 1 and heard.shape[1]:
            apart = (heard[0] - heard[1]).abs().max() > PRECISION[dtype] * heard.abs().max()
            require(bool(apart), "tokens of two transmitters must differ")
        nothing = module(Placed(placed.means[:1]), opacities, query[:0])
        require(len(nothing.scene) == len(nothing.transmitters) == 0, "no queries must have no tokens")


def _check_shapes(module, tokens, n, b, sets, dtype, device) -> None:
    require(isinstance(tokens, Tokens), f"a tokenizer must give Tokens, got {type(tokens).__name__}")
    gaussians = (n, module.gaussian_width)
    if tokens.gaussians.ndim == 3:
        gaussians = (b, *gaussians)
    require(
        sets == 1 or not module.gaussian_width or len(gaussians) == 3,
        "Gaussians that differ between queries must have own tokens",
    )
    shapes = (b, module.scene_width), gaussians, (b, module.transmitter_width)
    for name, token, shape in zip(Tokens._fields, tokens, shapes, strict=True):
        require_tensor(f"the token {name}", token, shape, dtype, device)
