import torch

from gaigs.core.query import Query
from gaigs.splatting.gaussians import Placed
from gaigs.splatting.tokenizer.multiview import MultiviewTokenizer
from gaigs.testing import example_links


def test_tokens_are_the_scene_of_ga_and_the_positions_of_euclidean():
    torch.manual_seed(0)
    octaves = {"gaussian_octaves": [-3, 2], "transmitter_octaves": [-2, 4]}
    euclidean = {"name": "euclidean", "hidden": 16, "width": 8, **octaves}
    tokenizer = MultiviewTokenizer(
        example_links().scene, ga={"name": "ga", "width": 5}, euclidean=euclidean
    )
    inputs = (
        Placed(torch.randn(1, 30, 3)),
        torch.rand(30),
        Query(torch.rand(2, 3), torch.zeros(2, dtype=torch.long)),
    )
    tokens = tokenizer(*inputs)
    assert torch.equal(tokens.scene, tokenizer.ga(*inputs).scene)
    assert torch.equal(tokens.gaussians, tokenizer.euclidean(*inputs).gaussians)
    assert torch.equal(tokens.transmitters, tokenizer.euclidean(*inputs).transmitters)
    assert (tokenizer.scene_width, tokenizer.gaussian_width, tokenizer.transmitter_width) == (
        5,
        39,
        8,
    )
