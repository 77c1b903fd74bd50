"""Arbitrary inputs of the properties."""

import math

import torch
from hypothesis import strategies as st

from gaigs.core.geometry import from_spherical

coordinates = st.floats(-50, 50, width=32)
seeds = st.integers(0, 2**31 - 1)


def tensors(elements, *shape):
    """Float64 tensors of a shape."""
    count = math.prod(shape)
    return st.lists(elements, min_size=count, max_size=count).map(
        lambda values: torch.tensor(values, dtype=torch.float64).reshape(shape)
    )


points = tensors(coordinates, 3)
quaternions = tensors(st.floats(-1, 1, width=32), 4)


@st.composite
def normals(draw):
    """Unit vectors, the poles and the seam among them."""
    azimuth = draw(
        st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi]) | st.floats(-math.pi, math.pi)
    )
    elevation = draw(
        st.sampled_from([0.0, math.pi / 2, -math.pi / 2]) | st.floats(-math.pi / 2, math.pi / 2)
    )
    return from_spherical(
        *(torch.tensor(angle, dtype=torch.float64) for angle in (azimuth, elevation))
    )
