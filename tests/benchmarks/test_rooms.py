import argparse

import pytest
import torch
from rooms import TEST, build, networks, share, simulate, split, train

OPTIONS = argparse.Namespace(octaves=[-5, -2], width=8, gaussians=12)


@pytest.fixture(scope="module")
def rooms():
    return [split(simulate(seed, 6 + TEST), 6, 0) for seed in (0, 1)]


def test_rooms_differ_about_an_array_at_the_origin(rooms):
    first, second = rooms
    assert not torch.equal(first.scene.box[1], second.scene.box[1])
    for links in rooms:
        assert torch.equal(links.receivers[0].pose.position, torch.zeros(3).double())
        assert not {*links.split.train.tolist()} & {*links.split.test.tolist()}


@pytest.mark.parametrize("deformation", ["two_branch", "basis"])
def test_rooms_share_networks_and_keep_their_gaussians(rooms, deformation):
    models = [build(links, deformation, "multiview", OPTIONS) for links in rooms]
    share(models[1], models[0])
    assert [*map(id, networks(models[1]))] == [*map(id, networks(models[0]))]
    before = [[p.clone() for p in model.parameters()] for model in models]
    train([*zip(models, rooms, strict=True)], 4, 1e-3, 0)
    known = {id(parameter) for parameter in networks(models[0])}
    for model, old in zip(models, before, strict=True):
        own = 0
        for parameter, value in zip(model.parameters(), old, strict=True):
            is_shared = id(parameter) in known
            own += not is_shared and not torch.equal(parameter, value)
        # Means, rotations, scales, opacities and signal, and with ``basis`` the weights.
        assert own == 5 + (deformation == "basis")
