"""Sequences of planes against homogeneous matrices, images of a box room, legs of each path."""

import itertools

import numpy as np
import pytest
import torch

from gaigs.data.synthetic.image_source import cells, mirror
from gaigs.splatting.placement.mirrored.reflections import (
    all_sequences,
    fold,
    images,
    largest_order,
)

SIZE = torch.tensor([7.0, 5.0, 3.0], dtype=torch.float64)
BOX = (
    torch.cat((torch.eye(3), -torch.eye(3))).double(),
    torch.cat((SIZE, torch.zeros(3, dtype=torch.float64))),
)
"""Planes of a box room with a corner at the origin, normals outwards."""


def places(count, seed=0):
    return (
        0.1
        + (SIZE - 0.2)
        * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)).double()
    )


def slanted(count, seed=0):
    """Planes all over the place."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(normals, dim=1), torch.randn(
        count, generator=generator, dtype=torch.float64
    )


def folded(order, planes=BOX, count=20):
    transmitters, receivers = places(count), places(count, seed=1)
    sequences = all_sequences(len(planes[1]), order)
    seen = images(transmitters, sequences, *planes)
    return sequences, seen, receivers, fold(seen, receivers, sequences, *planes)


def householder(normal, offset):
    """The mirror at a plane as a 4 x 4 matrix."""
    matrix = np.eye(4)
    matrix[:3, :3] -= 2 * np.outer(normal, normal)
    matrix[:3, 3] = 2 * offset * normal
    return matrix


@pytest.mark.parametrize(("planes", "order"), [(1, 3), (2, 1), (6, 2), (9, 0), (4, 3)])
def test_each_sequence_is_there_once(planes, order):
    sequences = all_sequences(planes, order)
    assert sequences.shape == (1 + sum(planes * (planes - 1) ** k for k in range(order)), order)
    assert len({*map(tuple, sequences.tolist())}) == len(sequences)
    if planes > 1:
        assert largest_order(planes, len(sequences)) == order
        assert largest_order(planes, len(sequences) - 1) == order - 1 or not order
    lengths = (sequences >= 0).sum(1)
    assert (lengths.diff() >= 0).all()  # shorter ones first
    for sequence, length in zip(sequences.tolist(), lengths.tolist(), strict=True):
        assert sequence[: order - length] == [-1] * (order - length)
        assert all(0 <= plane < planes for plane in sequence[order - length :])
        assert all(a != b for a, b in itertools.pairwise(sequence[order - length :]))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_images_are_products_of_mirrors(order):
    normals, offsets = slanted(4)
    sequences, points = all_sequences(4, order), places(3)
    found = images(points, sequences, normals, offsets)
    assert len(found) == order + 1
    for step, seen in enumerate(found):
        for k, sequence in enumerate(sequences.tolist()):
            whole = np.eye(4)
            for plane in sequence[:step]:
                if plane >= 0:
                    whole = householder(normals[plane].numpy(), offsets[plane].item()) @ whole
            expected = points.numpy() @ whole[:3, :3].T + whole[:3, 3]
            np.testing.assert_allclose(seen[:, k].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_images_of_a_box_room_are_those_of_its_copies(order):
    _, seen, _, paths = folded(order)
    copies = cells(order).expand(20, -1, -1)
    expected = mirror(places(20)[:, None].expand(copies.shape), copies, SIZE)
    for found, exists, true in zip(seen[-1], paths.exists, expected, strict=True):
        distances = (found[exists][:, None] - true).norm(dim=-1)
        assert exists.sum() == len(true)
        assert max(distances.amin(0).max(), distances.amin(1).max()) < 1e-9


@pytest.mark.parametrize("order", [1, 2, 3])
def test_legs_run_from_the_transmitter_over_the_planes_to_the_receiver(order):
    sequences, seen, receivers, paths = folded(order)
    direct = (seen[-1] - receivers[:, None]).norm(dim=-1)
    legs = torch.zeros_like(direct).index_add(1, paths.path, (paths.end - paths.start).norm(dim=-1))
    torch.testing.assert_close(legs[paths.exists], direct[paths.exists], rtol=1e-9, atol=0)
    normals, offsets = BOX
    for k, sequence in enumerate(sequences.tolist()):
        own = (paths.path == k).nonzero()[:, 0].flip(0)  # the first leg is that of the transmitter
        stops = torch.cat((paths.start[:, own], paths.end[:, own[-1:]]), 1)
        torch.testing.assert_close(stops[:, 0], places(20))
        torch.testing.assert_close(stops[:, -1], receivers)
        torch.testing.assert_close(paths.end[:, own[:-1]], stops[:, 1:-1])
        met = [plane for plane in sequence if plane >= 0]
        heights = (stops[:, 1:-1] * normals[met]).sum(-1) - offsets[met]
        exists = paths.exists[:, k]
        assert (heights[exists].abs() < 1e-9).all()
        inside = (stops >= -1e-9) & (stops <= SIZE + 1e-9)
        assert inside[exists].all()


def test_planes_mirror_at_the_angle_of_incidence():
    sequences, _, receivers, paths = folded(2)
    normals, _ = BOX
    assert paths.firsts == [1, 7]
    assert torch.equal(paths.planes, torch.cat((sequences[1:, -1], sequences[7:, -2])))
    assert torch.equal(paths.normals, normals[paths.planes])
    last, first = paths.bounces[:, :36], paths.bounces[:, 36:]
    arriving = receivers[:, None] - last
    expected = ((arriving * paths.normals[:36]).sum(-1) / arriving.norm(dim=-1)).abs()
    exists = paths.exists[:, 1:]
    torch.testing.assert_close(paths.cosines[:, :36][exists], expected[exists])
    # At the bounce before, the wave comes from the transmitter and leaves for the next point at the
    # same angle.
    for ray in (places(20)[:, None] - first, last[:, 6:] - first):
        expected = ((ray * paths.normals[36:]).sum(-1) / ray.norm(dim=-1)).abs()
        exists = paths.exists[:, 7:]
        torch.testing.assert_close(paths.cosines[:, 36:][exists], expected[exists])


def test_a_plane_behind_both_ends_mirrors_nothing():
    normals, offsets = torch.tensor([[1.0, 0, 0]]), torch.tensor([2.0])
    sequences = all_sequences(1, 1)
    ends = {"both in front": (1.0, 1.5), "both behind": (3.0, 2.5), "on either side": (1.0, 3.0)}
    exists = {}
    for name, (there, here) in ends.items():
        transmitters, receivers = torch.tensor([[there, 0, 0]]), torch.tensor([[here, 1.0, 0]])
        exists[name] = fold(
            images(transmitters, sequences, normals, offsets),
            receivers,
            sequences,
            normals,
            offsets,
        ).exists
    assert exists["both in front"].tolist() == [[True, True]]
    assert exists["both behind"].tolist() == [[True, True]]  # a plane has no back
    assert exists["on either side"].tolist() == [[True, False]]


def test_a_ray_along_a_plane_meets_it_nowhere_and_has_gradients():
    normals = torch.tensor([[0.0, 0, 1]], requires_grad=True)
    offsets = torch.tensor([1.0], requires_grad=True)
    sequences = all_sequences(1, 1)
    transmitters = torch.tensor(
        [[1.0, 2, 1]], requires_grad=True
    )  # in the plane, and so is the receiver
    seen = images(transmitters, sequences, normals, offsets)
    paths = fold(seen, torch.tensor([[3.0, 2, 1]]), sequences, normals, offsets)
    assert paths.exists.tolist() == [[True, False]]
    total = paths.start.square().sum() + paths.end.square().sum() + paths.cosines.sum()
    for gradient in torch.autograd.grad(total, (normals, offsets, transmitters)):
        assert gradient.isfinite().all()


def test_where_a_path_meets_its_planes_is_differentiable():
    sequences = all_sequences(3, 2)
    normals, offsets = (
        torch.eye(3, dtype=torch.float64),
        torch.tensor([4.0, 5.0, 3.0], dtype=torch.float64),
    )
    transmitter, receiver = places(1) * 0.5, places(1, seed=1) * 0.5

    def legs(transmitter, normals, offsets):
        paths = fold(
            images(transmitter, sequences, normals, offsets), receiver, sequences, normals, offsets
        )
        return paths.start[:, paths.exists[0][paths.path]], paths.end[
            :, paths.exists[0][paths.path]
        ]

    leaves = [leaf.requires_grad_() for leaf in (transmitter, normals, offsets)]
    assert torch.autograd.gradcheck(legs, leaves)
