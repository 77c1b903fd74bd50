"""The check of kind ``tokenizer``."""

import copy

import torch
from torch import nn

from gaigs.core.scene import Scene
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.testing import checks
from gaigs.testing.checks import PRECISION, require, require_tensor


def check_tokenizer(tokenizer: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """Checks a tokenizer built for the scene: widths, dtype, gradients, independence of the batch.

    The inputs include Gaussians that stand elsewhere for each query, and the scene's carriers. The
    contract is that of ``gaigs.splatting.gaussians.Tokens``.
    """
    generator = torch.Generator().manual_seed(0)
    cases = (
        (40, 3, 1, torch.float32),
        (1, 1, 1, torch.float32),
        (40, 3, 1, torch.float64),
        (40, 3, 3, torch.float32),
    )
    for n, b, sets, dtype in cases:
        module = copy.deepcopy(tokenizer).to(device, dtype).eval()
        placed = Placed(
            checks.random_places(scene, sets * n, generator)
            .to(device, dtype)
            .unflatten(0, (sets, n))
        )
        opacities = torch.rand(n, generator=generator).to(device, dtype)
        query = checks.random_query(scene, b, generator, dtype, device)
        query.transmitters.requires_grad_()
        tokens = module(placed, opacities, query)
        require(
            isinstance(tokens, Tokens), f"a tokenizer must give Tokens, got {type(tokens).__name__}"
        )
        own = tokens.gaussians.ndim == 3
        rule = "Gaussians that differ between queries must have own tokens"
        require(own or sets == 1 or not module.gaussian_width, rule)
        gaussians = (b, n, module.gaussian_width) if own else (n, module.gaussian_width)
        shapes = (b, module.scene_width), gaussians, (b, module.transmitter_width)
        for name, token, shape in zip(Tokens._fields, tokens, shapes, strict=True):
            require_tensor(f"the token {name}", token, shape, dtype, device)
        again = module(placed, opacities, query)
        alone = module(Placed(placed.means[-1:]), opacities, query[-1:])
        if own:
            alone = alone._replace(gaussians=alone.gaussians.reshape(1, n, -1))
        per_query = Tokens._fields if own else ("scene", "transmitters")
        checks.require_independence(tokens, again, alone, per_query, PRECISION[dtype])
        checks.require_gradients(
            tokens, {**dict(module.named_parameters()), "transmitters": query.transmitters}
        )
        heard = torch.cat((tokens.scene, tokens.transmitters), -1)
        if b > 1 and heard.shape[1]:
            apart = (heard[0] - heard[1]).abs().max() > PRECISION[dtype] * heard.abs().max()
            require(apart, "tokens of two transmitters must differ")
        nothing = module(Placed(placed.means[:1]), opacities, query[:0])
        require(
            len(nothing.scene) == len(nothing.transmitters) == 0, "no queries must have no tokens"
        )
