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
        parts = [x]  # e_w ^ x for each w, the first of which is 1
        for wedge in null_wedges[1:]:
            parts.append((wedge @ x.flatten(1)).view_as(x))
        wedges = torch.cat(parts, -1)  # (k, n, 2**r c)
        # A matrix for each component k: the matrices W[maps[w, k]] of all w below each other.
        matrices = weight.index_select(0, maps.mT.flatten())
        matrices = matrices.view(len(x), -1, weight.shape[2])  # (k, 2**r c, c_out)
        result = torch.bmm(wedges, matrices)  # (k, n, c_out)
        # Scalars mix with the components 1, which are invariant too.
        result[0].addmm_(flat, from_weight.mT).add_(from_bias)
        invariants = torch.cat((x[0], flat), -1)  # (n, c + s)
        mixed = torch.addmm(to_bias, invariants, to_weight.mT)  # (n, s_out)
        ctx.save_for_backward(
            invariants, matrices, weight, from_weight, to_weight, maps, null_wedges, wedges
        )
        tokens = multivectors.shape[:-2]
        return result.unflatten(1, tokens).movedim(0, -1), mixed.unflatten(0, tokens)

    @staticmethod
    @once_differentiable
    def backward(ctx, to_multivectors, to_scalars):
        invariants, matrices, weight, from_weight, to_weight, maps, null_wedges, wedges = (
            ctx.saved_tensors
        )
        shape, scalars_shape = ctx.shapes
        channels = shape[-2]
        # Gradients of the results.
        g = _components_first(to_multivectors)  # (k, n, c_out)
        flat = to_scalars.flatten(0, -2)  # (n, s_out)
        # Gradients of e_w ^ x for each w, which the wedges' transposes lead back to x.
        d_wedges = torch.bmm(g, matrices.mT)  # (k, n, 2**r c)
        d_x, *d_null_wedges = d_wedges.split(channels, -1)  # (k, n, c) each
        d_x = d_x.contiguous()
        for wedge, d_wedge in zip(null_wedges[1:], d_null_wedges, strict=True):
            d_x.flatten(1).addmm_(wedge.mT, d_wedge.flatten(1))
        # Each matrix is a row of ``weight`` by ``maps``, so its gradient adds to that row's.
        d_matrices = torch.bmm(wedges.mT, g).view(-1, *weight.shape[1:])
        d_weight = torch.zeros_like(weight)
        d_weight.index_add_(0, maps.mT.flatten(), d_matrices)
        # Gradients of the components 1 and of the scalars by way of the scalars' map.
        d_ones, d_scalars = (flat @ to_weight).split((channels, scalars_shape[-1]), -1)
        d_x[0] += d_ones
        # In the order of the arguments of ``forward``.
        return (
            d_x.unflatten(1, shape[:-2]).movedim(0, -1),
            torch.addmm(d_scalars, g[0], from_weight).view(scalars_shape),
            d_weight,
            g[0].mT @ invariants[:, channels:],
            g[0].sum(0),
            flat.mT @ invariants,
            flat.sum(0),
            None,
            None,
        )


def _components_first(multivectors: Tensor) -> Tensor:
    """Multivectors (*tokens, channels, k) as (k, tokens, channels), contiguous.

    Torch multiplies other layouts matrix by matrix.
    """
    return multivectors.movedim(-1, 0).flatten(1, -2).contiguous()
