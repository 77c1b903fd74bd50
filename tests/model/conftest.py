"""Made-up links, and a pipeline for them."""

import pytest
import torch
from pipeline import ALL, PARTS, trained, two_branch

from gaigs.model.gaigs import GaussianSplatting
from gaigs.testing import example_links


@pytest.fixture
def links():
    return example_links()


@pytest.fixture
def batch(links):
    return links.batch(torch.tensor([0, 2, 4]))


@pytest.fixture
def build(links):
    def build(heads=ALL, scene=links.scene, **parts):
        torch.manual_seed(0)
        return trained(
            GaussianSplatting(scene, **(PARTS | {"deformation": two_branch(heads)} | parts))
        )

    return build
