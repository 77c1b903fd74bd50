"""Mirrored Gaussians with the planes and materials of the simulated room against the simulator."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.constants import speed_of_light

import gaigs
from gaigs.core.antenna import Array, Receiver
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.data import Split
from gaigs.data.synthetic import POSE, REGION
from gaigs.data.synthetic.image_source import Room, permittivity, trace
from gaigs.model.mirrored import MirroredSplatting
from gaigs.splatting.gaussians import SH_DC
from gaigs.splatting.placement.mirrored.movable_planes import upright_turn
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.testing import check_placement, example_links
from gaigs.testing.placement import example_gaussians

FREQUENCY = 6.4896e9
ROOM = Room(
    (7.0, 5.0, 3.0), ("concrete", "glass", "wood", "brick", "plasterboard", "ceiling_board")
)
LOWER, UPPER = torch.tensor(REGION)


def scene(pattern="cosine", bandwidth=5e8, task=None):
    array = Array.planar(4, 4, 0.02, pattern)
    return Scene(
        (Receiver("gateway", POSE, array),),
        LOWER,
        UPPER,
        0.3,
        task or Rssi(),
        torch.tensor([FREQUENCY]),
        bandwidth,
    )


def make(order=2, planes=6, obstacles=0, channels=2, **options):
    torch.manual_seed(0)
    return Mirrored(scene(**options), channels, planes, order, obstacles)


def walled(placement):
    """The placement with the room's planes and materials; no path has a gain of its own."""
    with torch.no_grad():
        for wall, material in enumerate(ROOM.walls):
            axis, side = divmod(wall, 2)
            normal = torch.eye(3)[axis] * (1 if side else -1)
            offset = ROOM.size[axis] if side else 0.0
            placement.place(wall, torch.tensor([*normal, offset]))
            epsilon = permittivity(material, FREQUENCY)
            placement.log_permittivities[wall] = math.log(epsilon.real - 1)
            placement.log_conductivities[wall] = math.log(-epsilon.imag)
        placement.log_extents.fill_(20.0)
    return placement


def ask(count=40, seed=0):
    places = torch.lerp(
        LOWER, UPPER, torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    )
    return Query(places, torch.zeros(count, dtype=torch.long), torch.full((count,), FREQUENCY))


def simulated(query, order, pattern):
    """Images, and each path's field over that of free space at one metre, in float64."""
    paths = trace(ROOM, query.transmitters, POSE.position, FREQUENCY, order)
    local = (paths.images - POSE.position.double()) @ POSE.rotation.double()
    lengths = local.norm(dim=-1)
    gains = paths.gains / lengths
    if pattern == "cosine":
        gains = gains * (local[..., 2] / lengths).clamp(min=0)
    return paths.images, gains, lengths


@pytest.mark.parametrize(
    ("order", "pattern"), [(0, "isotropic"), (1, "cosine"), (3, "isotropic"), (2, "cosine")]
)
def test_with_the_rooms_walls_it_is_the_simulator(order, pattern):
    """Each path of the simulator is a Gaussian with the same field; other Gaussians are silent."""
    query = ask()
    placement = walled(make(order, pattern=pattern)).double()
    query = replace(query, transmitters=query.transmitters.double())
    placed = placement(None, query)
    true_images, true_gains, true_lengths = simulated(query, order, pattern)
    for i in range(len(query)):
        distances = (placed.means[i, :, None] - true_images[i]).norm(dim=-1)
        exists = placed.gains[i].abs() > 0
        for k in range(true_images.shape[1]):
            found = (distances[:, k] < 1e-5) & exists
            if true_gains[i, k].abs() == 0:  # behind the array
                assert not found.any()
                continue
            (which,) = found.nonzero()[:, 0].tolist()
            # The planes' buffers are float32.
            assert placed.gains[i, which].item() == pytest.approx(true_gains[i, k].item(), rel=1e-4)
            assert placed.lengths[i, which].item() == pytest.approx(
                true_lengths[i, k].item(), abs=1e-5
            )
        assert exists.sum() == (true_gains[i].abs() > 0).sum()


def test_phases_follow_path_lengths_once_they_count():
    query = ask()
    placement = walled(make())
    quiet = placement(None, query)
    assert not quiet.coherences.any()
    placement.enable_phases(speed_of_light / FREQUENCY)
    with torch.no_grad():
        placement.path_phases[3] = 1.0
        placement.log_blurs[4] = 0.0
    placed = placement(None, query)
    turns = placed.lengths.double() * FREQUENCY / speed_of_light
    expected = quiet.gains * torch.polar(torch.ones_like(turns), -2 * math.pi * turns)
    expected[:, 3] *= torch.polar(torch.tensor(1.0), torch.tensor(1.0))
    scale = expected.abs().max().item()
    torch.testing.assert_close(placed.gains.to(expected), expected, rtol=0, atol=2e-3 * scale)
    # A normal phase error leaves exp(-variance / 2) of the field.
    assert placed.coherences[4].item() == pytest.approx(math.exp(-0.5))
    assert placed.coherences[0].item() == pytest.approx(math.exp(-(0.3**2) / 2))
    torch.testing.assert_close(placed.means, quiet.means)


def test_gradients_of_phases_are_those_of_lengths_in_wavelengths():
    placement = walled(make(1))
    placement.enable_phases(speed_of_light / FREQUENCY)
    query = ask(1)
    placed = placement(None, query)
    wall = 2  # its sequence is the third after the direct path
    phase = placed.gains[0, wall].angle()
    for leaf, of_length in (
        (placement.shifts, placed.lengths[0, wall]),
        (placement.path_phases, None),
    ):
        (by_phase,) = torch.autograd.grad(phase, leaf, retain_graph=True)
        if of_length is None:
            assert by_phase[wall] == pytest.approx(1)
            continue
        (by_length,) = torch.autograd.grad(of_length, leaf, retain_graph=True)
        slopes = by_phase[wall - 1, 3] / by_length[wall - 1, 3]
        assert slopes.item() == pytest.approx(-2 * math.pi * FREQUENCY / speed_of_light, rel=1e-2)


def test_initial_planes_lie_beyond_the_faces_of_the_box():
    placement = make(planes=9)
    assert placement.used.tolist() == [0, 1, 2, 3, 4, 5]
    corners = torch.stack(
        (torch.minimum(LOWER, POSE.position), torch.maximum(UPPER, POSE.position))
    )
    for plane in range(6):
        axis, sign = plane % 3, 1 if plane < 3 else -1
        assert placement.normals[plane, axis] * sign > 0.95
        beyond = (
            placement.offsets[plane]
            - sign * (corners[0 if sign < 0 else 1] - placement.middle)[axis]
        )
        assert 0 < beyond < 0.1 * placement.diagonal


TURNED = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0], [0.5, 0, 0], [0, 0, 0]]))
"""Rotation about z by 0.5 rad."""


@pytest.mark.parametrize(
    ("edges", "expected"),
    [((6.0, 4.0, 2.0), TURNED), ((6.0, 0.3, 2.0), torch.eye(3)), ((0.0, 0.0, 2.0), torch.eye(3))],
    ids=["room", "strip", "one place"],
)
def test_the_first_faces_turn_as_the_places_lie(edges, expected):
    places = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(edges)
    torch.testing.assert_close(upright_turn(places), torch.eye(3))
    turn = upright_turn(places @ TURNED.mT)
    torch.testing.assert_close(turn.mT @ expected, torch.eye(3), atol=0.03, rtol=0)


def test_turned_faces_hold_all_places():
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0)
    room = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [6.0, 4.0, 2.0]
    )
    places = (room @ TURNED.mT)[links.rows]
    links = replace(links, query=replace(links.query, transmitters=places))
    links = replace(links, split=Split("all", torch.arange(len(links)), *torch.zeros(2, 0).long()))
    model = MirroredSplatting(links.scene)
    model.placement.fit(links)
    planes = model.placement.planes[:6]
    assert (places.double() @ planes[:, :3].mT < planes[:, 3] + 0.3).all()
    straight = model._start()
    assert (straight[:, :3] @ TURNED.double()).abs().max(1).values.min() > 0.99
    with torch.no_grad():
        model.placement.shifts.normal_()
    learnt = model.placement.planes
    model.placement.fit(links)
    torch.testing.assert_close(
        model.placement.planes, learnt, rtol=0, atol=0, msg="a second fit turned them"
    )
    torch.testing.assert_close(model._start(), learnt[:6])


def test_few_places_turn_no_face():
    turned = [
        upright_turn(torch.rand(8, 3, generator=torch.Generator().manual_seed(seed)))
        for seed in range(20)
    ]
    assert all(torch.equal(turn, torch.eye(3)) for turn in turned)


def test_a_plane_moves_and_its_paths_are_dropped():
    placement = make(planes=7)
    with torch.no_grad():
        placement.shifts.normal_()
    plane = torch.tensor([0.0, 0.6, 0.8, 1.5])
    placement.place(2, plane)
    torch.testing.assert_close(placement.planes[2].float(), plane)
    assert (placement.offsets[2] - 1.5 + plane[:3] @ placement.middle).abs() < 1e-6
    placement.kept &= placement.sequences_of(torch.tensor([0, 2]))
    assert placement.used.tolist() == [0, 2]
    kept = sorted(map(tuple, placement.sequences[placement.kept].tolist()))
    assert kept == [(-1, -1), (-1, 0), (-1, 2), (0, 2), (2, 0)]
    assert placement(None, ask(3)).means.shape == (3, 5, 3)


def test_enabling_phases_moves_no_plane_and_makes_steps_small():
    placement = make()
    with torch.no_grad():
        placement.shifts.normal_()
    normals, offsets = placement.normals.clone(), placement.offsets.clone()
    placement.enable_phases(0.05)
    torch.testing.assert_close(placement.normals, normals)
    torch.testing.assert_close(placement.offsets, offsets)
    with torch.no_grad():
        placement.shifts[:, 3] += 0.01
    turned = (
        4 * math.pi * (placement.offsets - offsets).abs() / 0.05
    )  # phase of a reflected path in a usual step
    assert ((turned > 0.03) & (turned < 0.4)).all()


def test_held_strengths_stay_while_images_follow():
    query, placement = ask(), walled(make(obstacles=5))
    with placement.holding():
        first = placement(None, query)
        with torch.no_grad():
            placement.origin[0, 3] += 0.3
            placement.plane_gains[0] = -1.0
        moved = placement(None, query)
    after = placement(None, query)
    torch.testing.assert_close(moved.gains * moved.lengths, first.gains * first.lengths)
    assert (moved.means - first.means).norm(dim=-1).max() > 0.5
    torch.testing.assert_close(after.means, moved.means)
    assert (after.gains - moved.gains).abs().max() > 1e-3


def test_obstacles_attenuate_paths_along_their_legs():
    query, bare = ask(), walled(make(1))
    placement = walled(make(1, obstacles=4))
    clear, dimmed = bare(None, query), placement(None, query)
    losses = -(dimmed.gains / clear.gains).abs().log()
    heard = clear.gains.abs() > 0

    # The direct path has one leg, a reflected one two, which meet on the wall.
    def depth(*ends):
        return placement.obstacles(*(end - placement.middle for end in ends))

    direct = depth(query.transmitters, POSE.position.expand_as(query.transmitters))
    torch.testing.assert_close(losses[heard[:, 0], 0], direct[heard[:, 0]], rtol=1e-3, atol=1e-5)
    wall = 1 + 2  # y = 0
    image = query.transmitters * torch.tensor([1, -1, 1])
    share = POSE.position[1] / (POSE.position[1] - image[:, 1])
    stop = torch.lerp(POSE.position.expand_as(image), image, share[:, None])
    both = depth(query.transmitters, stop) + depth(stop, POSE.position.expand_as(stop))
    own = heard[:, wall]
    assert own.any()
    torch.testing.assert_close(losses[own, wall], both[own], rtol=1e-3, atol=1e-5)
    expected = placement.obstacles.densities.mean() * placement.diagonal
    torch.testing.assert_close(placement.penalties(), {"obstacles": expected})
    assert bare.penalties() == {}


def test_box_about_a_receiver_does_not_dim_its_paths():
    query, placement = ask(), walled(make(1, obstacles=4))
    clear = placement(None, query).gains
    place = POSE.position - placement.middle
    corners = torch.stack((place - 0.01, place + 0.01))[None]
    placement.obstacles.place_boxes(torch.eye(3), corners, torch.tensor([3.0]))
    thin = placement(None, query).gains
    placement.obstacles.place_boxes(torch.eye(3), corners + 0.015, torch.tensor([3.0]))
    beside = placement(None, query).gains
    assert (thin.abs() >= clear.abs()).all()  # Gaussians are as faint as at the start
    assert (beside.abs() < 0.1 * thin.abs()).any()


@pytest.mark.parametrize("task", [Rssi(), Csi(16, torch.tensor([FREQUENCY]))])
def test_obstacles_dim_all_paths_but_faint_ones_of_levels(task):
    query, placement = ask(), walled(make(obstacles=4, task=task))
    found, clear = placement(None, query).gains, walled(make(task=task))(None, query).gains
    shares = (clear.abs() / clear.abs().square().sum(1, keepdim=True).sqrt()).square()
    placement.faint = 0.0
    dimmed = placement(None, query).gains
    # Shares of ``_depths`` are before the element's pattern, which takes power away.
    skipped = (found != dimmed).nonzero().tolist()
    assert all(shares[link, path] < 0.01 for link, path in skipped)
    assert bool(skipped) == (not task.dtype.is_complex)


def test_obstacles_of_channels_turn_phases():
    placement = make(order=0, obstacles=3, task=Csi(16, torch.tensor([FREQUENCY])))
    assert make(order=0, obstacles=3).obstacles.turns is None
    with torch.no_grad():
        placement.obstacles.turns.fill_(1.5)
        _, _, folded = placement.folded(query := ask(10))
        clear, own = (placement.strengths(query, folded, blocked) for blocked in (False, True))
    depths = -(own / clear).log()
    torch.testing.assert_close(depths.imag, 1.5 * depths.real)
    assert depths.real.max() > 0.01


def test_a_small_plane_reflects_near_its_middle():
    query, whole, small = ask(), walled(make(1)), walled(make(1))
    with torch.no_grad():
        small.middles[4] = torch.tensor([3.0, 2.0, 0.0]) - small.middle
        small.log_extents[4] = math.log(0.5)
    ratio = (small(None, query).gains / whole(None, query).gains)[:, 1 + 4].abs()
    image = query.transmitters * torch.tensor([1, 1, -1])
    share = POSE.position[2] / (POSE.position[2] - image[:, 2])
    stop = torch.lerp(POSE.position.expand_as(image), image, share[:, None])
    aside = (stop - torch.tensor([3.0, 2.0, 0.0])).square().sum(1) / 0.25
    heard = ratio.isfinite()
    assert heard.any()
    torch.testing.assert_close(ratio[heard], (-aside / 2).exp()[heard], rtol=1e-3, atol=1e-6)


def test_free_gaussians_follow_the_mirrored_ones():
    query, placement = ask(3), make()
    gaussians = example_gaussians(placement.scene, 8)
    alone, both = placement(None, query), placement(gaussians, query)
    n = alone.means.shape[1]
    assert both.means.shape == (3, n + 8, 3)
    for name in ("means", "scales"):
        torch.testing.assert_close(getattr(both, name)[:, :n], getattr(alone, name))
        assert torch.equal(getattr(both, name)[0, n:], getattr(gaussians, name))
    for name in ("quats", "opacities", "signal", "coherences"):
        assert torch.equal(getattr(both, name)[:n], getattr(alone, name))
    assert torch.equal(both.opacities[n:], gaussians.opacities)
    assert torch.equal(both.signal[n:], gaussians.signal)
    assert (both.gains[:, n:] == SH_DC).all()  # as if nothing had placed them
    assert not both.coherences[n:].any()


@pytest.mark.parametrize("sharp", [False, True])
@pytest.mark.parametrize("carrier", [None, 5e9])
def test_it_keeps_the_contract_of_placements(sharp, carrier):
    links = example_links("rssi", carrier)
    torch.manual_seed(0)
    placement = Mirrored(links.scene, 2, planes=7, order=2, obstacles=4)
    if sharp and carrier is not None:
        placement.enable_phases(speed_of_light / carrier)
        with torch.no_grad():
            placement.shifts.normal_()
    check_placement(placement, links.scene)


def test_the_initial_band_is_that_of_the_data_or_of_the_rooms_size():
    assert make().log_bandwidth.exp().item() == pytest.approx(5e8)
    assert make(bandwidth=None).log_bandwidth.exp().item() == pytest.approx(
        speed_of_light / make().diagonal
    )
    for placement in (make(bandwidth=0.0), make(task=Csi(16, torch.tensor([FREQUENCY])))):
        assert placement.log_bandwidth is None
        assert placement(None, ask(1)).bandwidth is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planes": 5}, "placement.planes must be at least 6, got 5"),
        ({"order": -1}, "placement.order must be at least 0, got -1"),
        (
            {"order": 9},
            r"order=9 gives more than 100,000 sequences of 6 planes, .*\n.*placement.order=6 or "
            r"less",
        ),
        ({"planes": 10, "order": 10**9}, "set placement.order=5 or less"),
        ({"obstacles": -2}, "placement.obstacles must be at least 0, got -2"),
        ({"channels": 10}, "'mirrored' has 1 or 2 channels, amplitude or complex, got 10"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
