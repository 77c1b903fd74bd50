"""Prune, clone and split: optimizer state, opacities, places."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from gaigs.core.geometry import semi_axes
from gaigs.splatting import density
from gaigs.splatting.gaussians import Gaussians
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer import ALPHA_MIN
from gaigs.splatting.rasterizer.torch import TorchRasterizer
from gaigs.testing import example_links

N = 20
CHANGES = {
    "prune": lambda gaussians, optimizer, chosen: density.prune(gaussians, optimizer, chosen),
    "clone": lambda gaussians, optimizer, chosen: density.clone(gaussians, optimizer, chosen),
    "split": lambda gaussians, optimizer, chosen: density.split(
        gaussians, optimizer, chosen, torch.Generator()
    ),
}


@pytest.fixture
def scene():
    scene = example_links().scene
    return replace(scene, receivers=scene.receivers[:1])


@pytest.fixture
def gaussians(scene):
    torch.manual_seed(0)
    return make(scene, channels=2, count=N)


def make(scene, channels, count):
    options = {
        "count": count,
        "near": 2.0,
        "far": 5.0,
        "spread": 0.5,
        "opacity": 0.1,
        "signal": 1.0,
    }
    return Gaussians(scene, zone=(0.0, math.pi / 2), channels=channels, **options)


@pytest.fixture
def chosen():
    return torch.arange(N) % 3 == 0


def optimizer_of(gaussians, kind=torch.optim.AdamW):
    groups = [
        {"params": [parameter], "lr": 1e-2 * (i + 1), "name": name}
        for i, (name, parameter) in enumerate(gaussians.named_parameters())
    ]
    other = torch.nn.Parameter(torch.ones(3))
    return kind([*groups, {"params": [other], "lr": 1.0, "name": "network"}])


def render(gaussians, scene):
    grid = scene.task.directions
    projection = Mercator(grid.pitch)
    axes = semi_axes(gaussians.quats, gaussians.scales)[None]
    splats = projection.project(gaussians.means, axes, scene.receivers[0].pose)
    signal, opacities = gaussians.signal.squeeze(-1)[None], gaussians.opacities[None]
    return TorchRasterizer()(splats, signal, opacities, None, projection.plane(grid))[0]


def train(gaussians, optimizer, scene, steps=3):
    for _ in range(steps):
        optimizer.zero_grad()
        render(gaussians, scene).square().mean().backward()
        optimizer.step()


OPTIMIZERS = {
    "AdamW": torch.optim.AdamW,
    "SGD": torch.optim.SGD,  # without a state
    "momentum": partial(torch.optim.SGD, momentum=0.9),
    "Adagrad": torch.optim.Adagrad,
}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("kind", OPTIMIZERS.values(), ids=OPTIMIZERS)
def test_the_optimizer_keeps_the_state_of_remaining_gaussians(gaussians, scene, chosen, name, kind):
    optimizer = optimizer_of(gaussians, kind)
    train(gaussians, optimizer, scene)
    old = dict(gaussians.named_parameters())
    memories = {name: dict(optimizer.state[parameter]) for name, parameter in old.items()}
    CHANGES[name](gaussians, optimizer, chosen)

    origin = (
        torch.arange(N)[~chosen]
        if name == "prune"
        else torch.cat((torch.arange(N), torch.arange(N)[chosen]))
    )
    kept = min(N, len(origin))
    new = dict(gaussians.named_parameters())
    assert {id(p) for p in optimizer.state} & {id(p) for p in old.values()} == set()
    for group, (parameter_name, parameter) in zip(
        optimizer.param_groups, new.items(), strict=False
    ):
        assert group["name"] == parameter_name
        assert len(group["params"]) == 1
        assert group["params"][0] is parameter
        for key, memory in memories[parameter_name].items():
            now = optimizer.state[parameter][key]
            if key == "step":
                assert now == memory == 3
                continue
            assert now.shape == parameter.shape
            assert memory.any()
            assert torch.equal(now[:kept], memory[origin[:kept]])
            assert not now[kept:].any()
    assert optimizer.param_groups[-1]["name"] == "network"


SCALED = {
    name: getattr(torch.optim, name)
    for name in ("AdamW", "Adagrad", "Adafactor")
    if hasattr(torch.optim, name)
}
"""Optimizers whose steps do not depend on the gradient's size; Adafactor (torch 2.5) keeps rows and
columns.
"""


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("kind", SCALED.values(), ids=SCALED)
def test_training_goes_on(gaussians, scene, chosen, name, kind):
    optimizer = optimizer_of(gaussians, kind)
    train(gaussians, optimizer, scene)
    CHANGES[name](gaussians, optimizer, chosen)
    before = {name: parameter.detach().clone() for name, parameter in gaussians.named_parameters()}
    train(gaussians, optimizer, scene, 2)
    for parameter_name, parameter in gaussians.named_parameters():
        assert parameter.isfinite().all()
        assert not torch.equal(parameter, before[parameter_name]), parameter_name
    assert len(gaussians) == (N - 7 if name == "prune" else N + 7)


@pytest.mark.parametrize("name", CHANGES)
def test_an_empty_choice_changes_nothing_and_frozen_means_stay_frozen(gaussians, name):
    before = {key: value.clone() for key, value in gaussians.state_dict().items()}
    gaussians.means.requires_grad_(False)
    CHANGES[name](gaussians, optimizer_of(gaussians), torch.zeros(N, dtype=torch.bool))
    assert all(torch.equal(value, before[key]) for key, value in gaussians.state_dict().items())
    assert not gaussians.means.requires_grad
    assert gaussians.signal.requires_grad


def test_pruning_keeps_all_others_and_refuses_to_remove_all(gaussians, chosen):
    before = {key: value.clone() for key, value in gaussians.state_dict().items()}
    density.prune(gaussians, optimizer_of(gaussians), chosen)
    assert all(
        torch.equal(value, before[key][~chosen]) for key, value in gaussians.state_dict().items()
    )
    with pytest.raises(ValueError, match="pruning would remove all 13 Gaussians"):
        density.prune(gaussians, optimizer_of(gaussians), torch.ones(13, dtype=torch.bool))
    assert len(gaussians) == 13


def test_a_clone_and_its_original_cover_what_one_did(gaussians, chosen):
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.linspace(-12, 40, N))  # at 40, 1 - a is 0 in float32
    logits = gaussians.opacity_logits.detach().double()
    density.clone(gaussians, optimizer_of(gaussians), chosen)
    originals, clones = gaussians.opacity_logits[:N][chosen], gaussians.opacity_logits[N:]
    assert torch.equal(originals, clones)
    # 1 - a is the sigmoid of the negative logit.
    missed = torch.sigmoid(-originals.detach().double()).square()
    torch.testing.assert_close(missed, torch.sigmoid(-logits[chosen]), rtol=1e-4, atol=0)
    covered = -torch.log1p(-torch.sigmoid(originals.detach().double())) * 2
    torch.testing.assert_close(
        covered, torch.nn.functional.softplus(logits[chosen]), rtol=1e-4, atol=0
    )
    assert torch.equal(gaussians.opacity_logits[:N][~chosen].double(), logits[~chosen])
    assert torch.equal(gaussians.means[N:], gaussians.means[:N][chosen])
    assert torch.equal(gaussians.signal[N:], gaussians.signal[:N][chosen])


def test_cloning_leaves_the_image_to_first_order(gaussians, scene):
    only = torch.zeros(N, dtype=torch.bool)
    only[7] = True
    with torch.no_grad():
        gaussians.signal.zero_()
        gaussians.signal[7, 0] = 1
        gaussians.opacity_logits.fill_(-20)
        gaussians.opacity_logits[7] = math.log(0.2 / 0.8)
    before = render(gaussians, scene)[0, 0]
    density.clone(gaussians, optimizer_of(gaussians), only)
    after = render(gaussians, scene)[0, 0]
    # Instead of A = a G the two give A + a² (G - G²) / 4 + ... above ALPHA_MIN.
    whole = before > 2.2 * ALPHA_MIN
    assert whole.sum() > 10
    change = (after - before)[whole].abs().max().item()
    assert 0.1 * 0.2**2 / 16 < change < 1.3 * 0.2**2 / 16


def test_halves_are_smaller_and_all_else_stays(gaussians):
    chosen, halves = torch.arange(N) == 5, torch.tensor([5, N])
    before = {key: value.clone() for key, value in gaussians.state_dict().items()}
    density.split(gaussians, optimizer_of(gaussians), chosen, torch.Generator().manual_seed(1))
    torch.testing.assert_close(gaussians.scales[halves] * 1.6, before["log_scales"][[5, 5]].exp())
    for key in ("quats", "opacity_logits", "signal"):
        assert torch.equal(gaussians.state_dict()[key][halves], before[key][[5, 5]])
    assert all(
        torch.equal(value[:N][~chosen], before[key][~chosen])
        for key, value in gaussians.state_dict().items()
    )


def test_the_places_of_halves_follow_the_whole(scene):
    count = 4000
    gaussians = make(scene, channels=1, count=count)
    with torch.no_grad():
        for name, value in (
            ("means", [1.0, 2, 3]),
            ("quats", [0.3, -1.0, 0.5, 0.2]),
            ("log_scales", [0.0, -1, -2]),
        ):
            getattr(gaussians, name).copy_(torch.tensor(value).expand(count, -1))
    covariance = gaussians.covariances[0].detach()
    everyone = torch.ones(count, dtype=torch.bool)

    density.split(gaussians, optimizer_of(gaussians), everyone, torch.Generator().manual_seed(0))
    places = gaussians.means.detach()
    # 8,000 draws show a covariance to a fraction sqrt(2 / 8000) = 1.6 % of the largest variance.
    torch.testing.assert_close(
        places.T.cov(), covariance, rtol=0, atol=0.08 * covariance.max().item()
    )
    torch.testing.assert_close(places.mean(0), torch.tensor([1.0, 2, 3]), rtol=0, atol=0.06)
