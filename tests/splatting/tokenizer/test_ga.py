"""The scene token: most opaque Gaussians, invariances, gradients, and the short cut of the last
block.
"""

import pytest
import torch

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.core.task.rssi import Rssi
from gaigs.splatting.gaussians import Placed
from gaigs.splatting.tokenizer.ga import GATokenizer

N, B = 40, 3
both = pytest.mark.parametrize("algebra", ["projective", "spacetime"])


def make_scene(shift=0.0, scale=1.0):
    def place(*coordinates):
        return scale * torch.tensor(coordinates) + shift

    receiver = Receiver("gateway", Pose(place(5.0, 0.3, 1.0), torch.eye(3)))
    return Scene((receiver,), place(0.0, 0.0, 0.0), place(4.0, 3.0, 2.0), 0.1, Rssi())


def tokens_of(tokenizer, means, opacities, transmitters, frequencies=None):
    query = Query(transmitters, torch.zeros(len(transmitters)).long(), frequencies)
    return tokenizer(Placed(means[None]), opacities, query)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture
def room():
    """Gaussian centres [m], their opacities, transmitters [m]."""
    return 3 * torch.randn(N, 3), torch.rand(N), 4 * torch.rand(B, 3)


@both
def test_only_the_most_opaque_gaussians_count(room, algebra):
    tokenizer = GATokenizer(make_scene(), anchors=5, algebra=algebra)
    means, opacities, transmitters = room
    scene = tokens_of(tokenizer, *room).scene
    ranks = opacities.argsort(descending=True)
    for moved, counts in ((ranks[5:], False), (ranks[4], True)):
        other = means.clone()
        other[moved] += 1
        assert (
            torch.equal(tokens_of(tokenizer, other, opacities, transmitters).scene, scene) != counts
        )
    raised = opacities.clone()
    raised[ranks[20]] = 2  # chosen anew at every call
    assert not torch.allclose(tokens_of(tokenizer, means, raised, transmitters).scene, scene)


@both
def test_the_origin_and_the_unit_of_length_do_not_count(room, algebra):
    tokenizers = []
    for scene in (make_scene(), make_scene(shift=20.0, scale=3.0)):
        torch.manual_seed(4)
        tokenizers.append(GATokenizer(scene, algebra=algebra).double())
    means, opacities, transmitters = (x.double() for x in room)
    torch.testing.assert_close(
        tokens_of(tokenizers[1], 3 * means + 20, opacities, 3 * transmitters + 20).scene,
        tokens_of(tokenizers[0], means, opacities, transmitters).scene,
        rtol=1e-5,  # the scene's corners are float32
        atol=1e-6,
    )


@both
def test_gradients_reach_every_parameter_but_not_the_anchors(room, algebra):
    tokenizer = GATokenizer(make_scene(), blocks=2, algebra=algebra)
    means, opacities, transmitters = (x.requires_grad_() for x in room)
    tokens_of(tokenizer, means, opacities, transmitters).scene.square().sum().backward()
    assert means.grad is None
    assert opacities.grad is None
    assert transmitters.grad.any()
    for name, parameter in tokenizer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_a_room_of_one_point_is_refused():
    receiver = Receiver("gateway", Pose(torch.ones(3), torch.eye(3)))
    scene = Scene((receiver,), torch.ones(3), torch.ones(3), 0.1, Rssi())
    with pytest.raises(ValueError, match="one point"):
        GATokenizer(scene)


def plain_scene(tokenizer, means, opacities, transmitters):
    """CLS where all tokens of all transmitters go through all of each block."""
    b, m = len(transmitters), min(tokenizer.anchors, len(means))
    anchors = means[opacities.topk(m).indices].expand(b, m, 3)
    tx, anchors = (
        (positions - tokenizer.middle) / tokenizer.scale for positions in (transmitters, anchors)
    )
    points = tokenizer.embed(torch.cat((tokenizer.cls.expand(b, 1, 3), tx[:, None], anchors), 1))
    types = torch.cat((tokenizer.types[:2], tokenizer.types[2:].expand(m, 2))).expand(b, -1, -1)
    tokens = tokenizer.first(points[..., None, :], types)
    for block in tokenizer.blocks:
        tokens = block(*tokens, points.mean(1))
    multivectors, scalars = tokenizer.last(*tokens)
    return tokenizer.read_out(torch.cat((multivectors[:, 0, 0], scalars[:, 0]), -1))


@both
@pytest.mark.parametrize("blocks", [1, 2])
@pytest.mark.parametrize(("b", "n"), [(B, N), (1, 1), (5, 3), (2, 0), (0, 3)])
def test_the_last_blocks_short_cut_changes_neither_values_nor_gradients(algebra, blocks, b, n):
    tokenizer = GATokenizer(make_scene(), blocks=blocks, algebra=algebra).double()
    inputs = 3 * torch.randn(n, 3).double(), torch.rand(n).double(), 4 * torch.rand(b, 3).double()
    found, expected = tokens_of(tokenizer, *inputs).scene, plain_scene(tokenizer, *inputs)
    weights = torch.randn_like(expected)
    gradients = [
        torch.autograd.grad(scene, [*tokenizer.parameters()], weights)
        for scene in (found, expected)
    ]
    for one, other in zip((found, *gradients[0]), (expected, *gradients[1]), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)
