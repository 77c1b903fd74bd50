"""The function of ``layers.EquivariantLinear``, with a gradient written by hand."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class Mix(torch.autograd.Function):
    """Equivariant linear layer on multivectors and scalars, with its gradient in closed form.

        result_k = sum_w (e_w ^ x)_k W[maps[w, k]]

    is component k. x are the multivectors. e_w is each blade of the algebra's null vectors; the
    first is 1. W is a matrix over channels for each equivariant map. Component 1 also mixes with
    scalars. The tensors are small, so autograd's calls would take most of a training step.

    Args:
        multivectors: (*tokens, c, k), c channels of k components.
        scalars: (*tokens, s).
        weight: A matrix for each equivariant map (maps, c, c_out).
        from_weight, from_bias: Linear map from scalars to component 1.
        to_weight, to_bias: Linear map from component 1 and scalars to scalars.
        maps: Row of ``weight`` for each blade w and component (2**r, k), with r null vectors.
        null_wedges: Matrix that maps x to e_w ^ x for each w (2**r, k, k), the identity first.
    """

    @staticmethod
    def forward(
        ctx,
        multivectors,
        scalars,
        weight,
        from_weight,
        from_bias,
        to_weight,
        to_bias,
        maps,
        null_wedges,
    ) -> tuple[Tensor, Tensor]:
        ctx.shapes = multivectors.shape, scalars.shape
        x = _components_first(multivectors)  # (k, n, c) for n tokens
        flat = scalars.flatten(0, -2)  # (n, s)
        parts = [x, *((wedge @ x.flatten(1)).view_as(x) for wedge in null_wedges[1:])]
        wedges = torch.cat(parts, -1)  # (k, n, 2**r c)
        # A matrix for each component, from all wedges.
        matrices = weight.index_select(0, maps.mT.flatten())
        matrices = matrices.view(len(x), -1, weight.shape[2])  # (k, 2**r c, c_out)
        result = torch.bmm(wedges, matrices)  # (k, n, c_out)
        # Scalars mix with the components 1, which are invariant too.
        result[0].addmm_(flat, from_weight.mT).add_(from_bias)
        seen = torch.cat((x[0], flat), -1)  # (n, c + s)
        mixed = torch.addmm(to_bias, seen, to_weight.mT)  # (n, s_out)
        ctx.save_for_backward(
            seen, matrices, weight, from_weight, to_weight, maps, null_wedges, wedges
        )
        tokens = multivectors.shape[:-2]
        return result.unflatten(1, tokens).movedim(0, -1), mixed.unflatten(0, tokens)

    @staticmethod
    @once_differentiable
    def backward(ctx, to_multivectors, to_scalars):
        seen, matrices, weight, from_weight, to_weight, maps, null_wedges, wedges = (
            ctx.saved_tensors
        )
        shape, scalars_shape = ctx.shapes
        g = _components_first(to_multivectors)  # (k, n, c_out)
        flat = to_scalars.flatten(0, -2)  # (n, s_out)
        x, *others = torch.bmm(g, matrices.mT).split(shape[-2], -1)  # (k, n, c) each
        x = x.contiguous()
        for wedge, other in zip(null_wedges[1:], others, strict=True):
            x.flatten(1).addmm_(wedge.mT, other.flatten(1))
        # Each matrix is a row of ``weight`` by ``maps``, so its gradient adds to that row's.
        matrix_gradients = torch.bmm(wedges.mT, g).view(-1, *weight.shape[1:])
        weight_gradient = torch.zeros_like(weight)
        weight_gradient.index_add_(0, maps.mT.flatten(), matrix_gradients)
        # Gradients of the components 1 and of the scalars by way of the scalars' map.
        ones, scalars = (flat @ to_weight).split((shape[-2], scalars_shape[-1]), -1)
        x[0] += ones
        return (
            x.unflatten(1, shape[:-2]).movedim(0, -1),
            torch.addmm(scalars, g[0], from_weight).view(scalars_shape),
            weight_gradient,
            g[0].mT @ seen[:, shape[-2] :],
            g[0].sum(0),
            flat.mT @ seen,
            flat.sum(0),
            None,
            None,
        )


def _components_first(multivectors: Tensor) -> Tensor:
    """Multivectors (*tokens, channels, k) as (k, tokens, channels), contiguous.

    Torch multiplies other layouts matrix by matrix.
    """
    return multivectors.movedim(-1, 0).flatten(1, -2).contiguous()
