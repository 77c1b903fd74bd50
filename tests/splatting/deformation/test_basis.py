"""Features of the transmitter that each Gaussian weighs: residuals, sizes, density control."""

from dataclasses import replace

import pytest
import torch

from gaigs.core.query import Query
from gaigs.splatting import density
from gaigs.splatting.deformation.basis import Basis
from gaigs.splatting.gaussians import Gaussians, Placed, Tokens
from gaigs.testing import example_links

N, WIDTHS = 7, (5, 4, 6)
SCENE = example_links().scene


def make(**options):
    return Basis(SCENE, **{"count": N, "tokenizer_widths": WIDTHS, "channels": 2, **options})


def ask(basis, b=3, n=N):
    generator = torch.Generator().manual_seed(0)
    shapes = (b, 5), (n, 4), (b, 6)
    tokens = Tokens(*(torch.randn(*shape, generator=generator) for shape in shapes))
    query = Query(torch.zeros(b, 3), torch.zeros(b, dtype=torch.long))
    return basis(tokens, Placed(torch.zeros(1, n, 3)), query)


def test_a_gaussian_answers_by_its_own_weights_alone():
    basis = make(width=8)
    before = ask(basis)
    assert not before.delta_opacities.any()  # as two_branch starts
    with torch.no_grad():
        basis.weights[2] *= 3
        basis.weights[2, -1] = 1.0
    after = ask(basis)
    expected = before.delta_signal.clone()
    expected[:, 2] *= 3
    torch.testing.assert_close(after.delta_signal, expected)
    assert after.delta_opacities[:, 2].all()
    assert not after.delta_opacities[:, 3:].any()


@pytest.mark.parametrize(("places", "width"), [(0, 128), (100, 256), (999, 256), (1000, 512)])
def test_more_places_teach_a_wider_network_at_a_lower_rate(places, width):
    basis = Basis(replace(SCENE, places=places), N, WIDTHS, 2)
    assert basis.weights.shape == (N, 3, width)
    assert basis.learning_rate == 2.0 / width


def test_weights_follow_their_gaussians_through_density_control():
    torch.manual_seed(0)
    gaussians = Gaussians(SCENE, zone=(0.0, 1.5), channels=2, count=N)
    basis = make(width=8)
    groups = [
        {"params": [*gaussians.parameters()], "lr": 0.1},
        {"params": [*basis.parameters()], "lr": 0.1},
    ]
    optimizer = torch.optim.AdamW(groups)
    old = basis.weights.detach().clone()
    chosen = torch.arange(N) % 3 == 0
    density.clone(gaussians, optimizer, chosen, basis)
    torch.testing.assert_close(basis.weights.detach(), torch.cat((old, old[chosen])))
    density.prune(gaussians, optimizer, torch.arange(len(gaussians)) < N, basis)
    torch.testing.assert_close(basis.weights.detach(), old[chosen])
    assert any(parameter is basis.weights for parameter in optimizer.param_groups[1]["params"])
    assert ask(basis, n=len(gaussians)).delta_signal.shape[1] == len(gaussians)
    other = make(width=8)
    other.load_state_dict(basis.state_dict())
    torch.testing.assert_close(other.weights, basis.weights)


def test_gaussians_of_an_unknown_number_are_refused():
    with pytest.raises(ValueError, match="set deformation=two_branch or none"):
        make(count=None)
