"""The two views beside one another."""

import pytest
import torch

from gaigs.gaussians import Placed
from gaigs.query import Query
from gaigs.testing import example_links
from gaigs.tokenizer.multiview import MultiviewTokenizer

GA = {"name": "ga", "width": 5}
EUCLIDEAN = {
    "name": "euclidean",
    "gaussian_octaves": [-3, 2],
    "transmitter_octaves": [-2, 4],
    "hidden": 16,
    "width": 8,
}


def draw():
    """Thirty Gaussians and two transmitters."""
    query = Query(torch.rand(2, 3), torch.zeros(2, dtype=torch.long))
    return Placed(torch.randn(1, 30, 3)), torch.rand(30), query


@pytest.fixture
def tokenizer():
    torch.manual_seed(0)
    return MultiviewTokenizer(example_links().scene, ga=GA, euclidean=EUCLIDEAN)


def test_it_takes_the_scene_of_the_one_and_the_positions_of_the_other(tokenizer):
    inputs = draw()
    tokens = tokenizer(*inputs)
    assert torch.equal(tokens.scene, tokenizer.ga(*inputs).scene)
    assert torch.equal(tokens.gaussians, tokenizer.euclidean(*inputs).gaussians)
    assert torch.equal(tokens.transmitters, tokenizer.euclidean(*inputs).transmitters)
    assert (tokenizer.scene_width, tokenizer.gaussian_width, tokenizer.transmitter_width) == (5, 39, 8)
