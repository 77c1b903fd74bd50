"""Static Gaussians: nothing changes, and nothing is read or learnt."""

import torch

from gaigs.deformation import Residuals
from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.testing import example_links


def test_nothing_changes_and_nothing_is_learnt():
    deformation = registry("deformation").build(
        {"name": "none"}, scene=example_links().scene, channels=2, tokenizer_widths=(0, 0, 0)
    )
    assert not deformation.reads_tokens
    assert not deformation.sees_receivers
    assert not list(deformation.parameters())
    query = Query(torch.zeros(3, 3), torch.zeros(3, dtype=torch.long))
    assert deformation(None, Placed(torch.zeros(1, 7, 3)), query) == Residuals(None, None, None, None, None)
