"""The check of kind ``tokenizer``."""

import copy

import torch
from torch import nn

from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.scene import Scene
from gaigs.testing.checks import (
    PRECISION,
    random_frequencies,
    random_places,
    require,
    require_close,
    require_gradients,
    require_tensor,
)
from gaigs.tokenizer import Tokens


def check_tokenizer(tokenizer: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """A tokenizer built for the scene: widths, dtype, gradients, independence of the batch.

    Gaussians that stand elsewhere for each query are among what it is given, and so are the carriers of a scene that
    has some.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.tokenizer.Tokens``.
    """
    generator = torch.Generator().manual_seed(0)
    cases = (40, 3, 1, torch.float32), (1, 1, 1, torch.float32), (40, 3, 1, torch.float64), (40, 3, 3, torch.float32)
    for n, b, sets, dtype in cases:
        module = copy.deepcopy(tokenizer).to(device, dtype).eval()
        means, places = (random_places(scene, count, generator).to(device, dtype) for count in (sets * n, b))
        placed = Placed(means.unflatten(0, (sets, n)))
        opacities = torch.rand(n, generator=generator).to(device, dtype)
        query = Query(places, torch.arange(b) % len(scene.receivers), random_frequencies(scene, b)).to(device)
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
            require(bool(apart), "tokens must tell two transmitters apart")
        nothing = module(Placed(placed.means[:1]), opacities, query[:0])
        require(len(nothing.scene) == len(nothing.transmitters) == 0, "no queries must have no tokens")


def _check_shapes(module, tokens, n, b, sets, dtype, device) -> None:
    require(isinstance(tokens, Tokens), f"a tokenizer must give Tokens, got {type(tokens).__name__}")
    gaussians = (n, module.gaussian_width)
    if tokens.gaussians.ndim == 3:
        gaussians = (b, *gaussians)
    require(sets == 1 or not module.gaussian_width or len(gaussians) == 3, "Gaussians that move must have own tokens")
    shapes = (b, module.scene_width), gaussians, (b, module.transmitter_width)
    for name, token, shape in zip(Tokens._fields, tokens, shapes, strict=True):
        require_tensor(f"the token {name}", token, shape, dtype, device)
