"""The search for planes in channels of an invented room, made by numpy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.optimize import nnls

from gaigs.core import stages
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Links, Split
from gaigs.planes.channel_links import (
    SLABS,
    ChannelOptions,
    ReceiverChannels,
    SlabRoom,
    half_spaces,
)
from gaigs.planes.channel_search import ChannelSearch
from gaigs.planes.common_gains import CommonGains
from gaigs.planes.strengths import fit_free, real_residual
from gaigs.splatting.placement.mirrored.reflections import seen_from

pytestmark = pytest.mark.usefixtures("unchecked")
half_the_steps = pytest.mark.usefixtures("half_the_steps")

FREQUENCIES = 5.5e9 + np.linspace(-2.5e8, 2.5e8, 16)
PLANES = np.array([[1.0, 0, 0, -0.4], [0.6, -0.78, 0.18, -3.5]])
"""Normals and offsets [m]; the second one is not upright to any axis."""
PLANES /= np.linalg.norm(PLANES[:, :3], axis=1, keepdims=True)
MATERIALS = ((3.0 - 0.3j, 1.0), (5.0 - 0.4j, 1.0))
"""Relative permittivities and thicknesses [m]."""


def reflection(permittivity, thickness, cosines, level):
    """Of a slab between air, as a wave of vertical polarisation meets it."""
    root = np.sqrt(permittivity - 1 + cosines**2)
    turns = np.exp(-4j * np.pi * thickness * FREQUENCIES / speed_of_light * root)
    te, tm = (
        (cosines - root) / (cosines + root),
        (permittivity * cosines - root) / (permittivity * cosines + root),
    )
    te, tm = (r * (1 - turns) / (1 - r**2 * turns) for r in (te, tm))
    return (1 - level) * te + level * tm


def channels(places, elements, planes):
    """Direct waves and images of the first order (b, e, s)."""

    def waves(points):
        return np.exp(-2j * np.pi * FREQUENCIES / speed_of_light * points) / points

    def apart(points):
        return np.linalg.norm(points[:, None] - elements, axis=-1)[..., None]

    found = waves(apart(places))
    for (*normal, offset), slab in zip(planes, MATERIALS, strict=False):
        images = places - 2 * (places @ normal - offset)[:, None] * normal
        ways = images - elements.mean(0)
        cosines = np.abs(ways @ normal) / np.linalg.norm(ways, axis=1)
        found = found + reflection(*slab, cosines[:, None, None], normal[2] ** 2) * waves(
            apart(images)
        )
    return found


def room(moved=0.0, receivers=1, count=60, walls=PLANES):
    """Links in a room that is moved along all axes [m], and its planes."""
    places = np.float32(
        np.random.default_rng(0).uniform((0.3, 0.3, 0.5), (5.5, 4.5, 2.2), (count, 3)) + moved
    )
    walls = walls.copy()
    walls[:, 3] += moved * walls[:, :3].sum(1)
    poses = [
        Pose.from_xyzw(tuple(moved + x for x in at), (0, 0, 0, 1))
        for at in ((1.0, 0.6, 2.4), (4.8, 3.9, 1.1))
    ]
    whole = Array.planar(2, 2, 0.027)
    arrays, labels = (whole, Array(whole.elements[:3])), []
    for pose, array in zip(poses, arrays, strict=True):
        elements = pose.to(torch.zeros(0).double()).world(whole.elements.double()).numpy()
        labels.append(channels(np.float64(places), elements, walls))
        labels[-1][:, len(array) :] = 0
    which = torch.arange(count) % receivers
    links = Links(
        query=Query(torch.from_numpy(places), which),
        receivers=tuple(Receiver(f"gateway{k}", poses[k], arrays[k]) for k in range(receivers)),
        labels=torch.from_numpy(np.stack(labels))[which, torch.arange(count)].to(torch.complex64),
        task=Csi(4, torch.from_numpy(FREQUENCIES)),
        split=Split("all", torch.arange(count), torch.arange(0), torch.arange(0)),
    )
    return links, torch.from_numpy(walls)


def coarse(**options):
    """Options with half of the steps along each axis, which are enough in these rooms."""
    return ChannelOptions(offset_cells=32, tilt_cells=20, **options)


def search(links, sign=-1, common=True, options=None, start=(), order=1, most=2):
    torch.manual_seed(0)
    start = torch.as_tensor(start).reshape(-1, 4)
    return ChannelSearch(links, sign, common, order, most, start, options or coarse())


def turned(labels):
    """With a random phase of each link."""
    phases = 2 * math.pi * torch.rand(len(labels), 1, 1, generator=torch.Generator().manual_seed(1))
    return labels * torch.polar(torch.ones_like(phases), phases)


def partly_silent(labels):
    """With a link that is silent in a part of the band."""
    return torch.where(
        (torch.arange(len(labels)) == 7)[:, None, None] & (torch.arange(16) >= 5), 0, labels
    )


CASES = {
    "one, a phase of each link": ({"walls": PLANES[:1], "count": 36}, {"common": False}, turned),
    "two, far away, two receivers of different sizes, a link partly silent, the other sign": (
        {"moved": 1000.0, "receivers": 2, "count": 44}, {"sign": 1}, lambda labels: partly_silent(labels).conj().resolve_conj()
    ),
}  # fmt: skip


@half_the_steps
@pytest.mark.parametrize("case", CASES)
def test_planes_are_found(case):
    """To 5 mm and 0.01 rad, a tenth of a wavelength."""
    made, options, changed = CASES[case]
    links, walls = room(**made)
    links = replace(links, labels=changed(links.labels))
    middle = links.query.transmitters.double().mean(0)
    planes, slabs = search(links, **options).run()
    assert planes.shape == (len(walls), 4)
    assert slabs.shape == (len(walls), 3)
    for wall in walls:
        cosines = planes[:, :3] @ wall[:3]
        number = cosines.abs().argmax()
        heights = (
            plane[:3] @ middle - plane[3]
            for plane in (planes[number] * cosines[number].sgn(), wall)
        )
        assert torch.linalg.cross(planes[number, :3], wall[:3]).norm() < 0.01
        assert abs(next(heights) - next(heights)) < 0.005


def test_a_search_whose_time_is_up_gives_the_planes_that_it_has(monkeypatch):
    links, _ = room()
    own, calls = search(links), []
    rate = own.free.rate
    monkeypatch.setattr(own.free, "rate", lambda *parts: calls.append(0) or rate(*parts))
    monkeypatch.setattr(stages, "is_up", lambda: bool(calls))
    planes, slabs = own.run()
    assert len(calls) == len(planes) == len(slabs) == 1


def test_a_long_search_for_planes_leaves_time_to_resolve_them(monkeypatch):
    own = search(room()[0])

    def find_free(known):
        assert 50 < stages.left() < 61  # [s]
        raise InterruptedError

    monkeypatch.setattr(own, "find_free", find_free)
    with stages.watched(100.0, shown=False), pytest.raises(InterruptedError):
        own.find_room()


def test_many_receivers_need_no_more_places_together():
    links, _ = room(receivers=2)
    data = search(links).data
    data.receivers = data.receivers * 5
    assert sum(len(part.places) for part in data.draw(24)) == 40
    phases = data.reference_phases(torch.zeros(0, 4).double(), data.receivers)
    assert all((phase - phases[0]).abs() < 0.1 for phase in phases[::2])


def test_no_plane_is_found_in_free_space():
    options = coarse(certain_share=1e-6, faint_share=1e-6)
    links, _ = room(walls=PLANES[:0])
    planes, slabs = search(links, options=options).run()
    assert len(planes) == len(slabs) == 0


@half_the_steps
@pytest.mark.parametrize("count", [1, 60])
def test_no_plane_is_found_in_noise(count):
    links, _ = room(count=count)
    noise = torch.randn(
        links.labels.shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(2)
    )
    planes, _ = search(replace(links, labels=noise)).run()
    assert len(planes) == 0


@half_the_steps
def test_false_plane_is_dropped(monkeypatch):
    links, walls = room(walls=PLANES[1:])
    misled, found = search(links), []
    false = seen_from(torch.tensor([[0.0, 0.28, 0.96, 3.1]]).double(), misled.frame.middle)
    true = seen_from(walls, misled.frame.middle)

    def find(known):
        found.append(known)
        return torch.cat((known, true[len(known) :], false[len(found) - 1 :]))

    monkeypatch.setattr(misled, "find_free", find)
    monkeypatch.setattr(misled.along_axes, "grow_along", lambda room, *_: room)
    planes, _ = misled.run()
    torch.testing.assert_close(planes, walls, rtol=0, atol=0.01)
    torch.testing.assert_close(found[1], true, rtol=0, atol=0.05)


@half_the_steps
def test_a_plane_that_a_false_one_moved_returns(monkeypatch):
    """By half a wavelength, to another lobe of its phases."""
    links, walls = room(walls=PLANES[1:])
    own = search(links)
    true, resolve = seen_from(walls, own.frame.middle), own.resolve
    found = torch.cat((true, torch.tensor([[0.0, 0.28, 0.96, 3.1]]).double()))

    def resolved(planes):
        planes, slabs = resolve(planes)
        lobe = torch.tensor([0, 0, 0, own.data.wavelength / 2 * (len(planes) > 1)])
        return SlabRoom(planes + lobe, slabs)

    monkeypatch.setattr(own, "find_free", lambda known: found)
    monkeypatch.setattr(own.free, "descend", lambda planes, **options: planes)
    monkeypatch.setattr(own, "resolve", resolved)
    monkeypatch.setattr(own.along_axes, "grow_along", lambda room, *_: room)
    torch.testing.assert_close(own.run()[0], walls, rtol=0, atol=5e-3)


def test_the_only_plane_may_be_false():
    own = search(room(walls=PLANES[:0])[0])
    plane = torch.tensor([[0.0, 0.28, 0.96, 3.1]]).double()
    planes, slabs = own.prune(SlabRoom(plane, torch.zeros(1, 3).double()))
    assert len(planes) == len(slabs) == 0


def test_tilted_plane_is_turned_square():
    links, walls = room(walls=np.array([[1.0, 0, 0, -0.4], [0, 1.0, 0, -0.7]]))
    tilted, level = torch.tensor([[0.99, -0.13, 0.05, -0.2], [0, 0, 1.0, 3.1]]).double()
    own = search(links)
    turned = own.square_variants(
        seen_from(torch.stack((tilted / tilted[:3].norm(), walls[1], level)), own.frame.middle), 0
    )
    true = seen_from(walls[0], own.frame.middle)
    assert any((plane[0] - true).abs().max() < 0.03 for plane in turned)


def few(links):
    """One element and 8 subcarriers of the links."""
    task = Csi(1, links.task.frequencies[:8])
    receiver = replace(links.receivers[0], array=Array(links.receivers[0].array.elements[:1]))
    return replace(links, receivers=(receiver,), labels=links.labels[:, :1, :8], task=task)


WALL, PARALLEL, FLOOR = [1.0, 0, 0, -0.4], [1.0, 0, 0, 6.3], [0, 0, 1.0, -0.2]


@half_the_steps
def test_walls_along_axes_show_where_channels_have_few_numbers():
    """One element and 8 subcarriers: free strengths at each place explain these channels by many
    planes.
    """
    walls = np.array([[1.0, 0, 0, -0.1], [0, 1.0, 0, 0.1]])
    links, _ = room(count=130, walls=walls)
    planes, _ = search(few(links)).run()
    planes = planes[planes[:, 1].argsort()]
    torch.testing.assert_close(planes, torch.from_numpy(walls), rtol=0, atol=5e-3)


def test_links_that_are_partly_silent_or_repeated_show_no_wall():
    links, walls = room(count=120, walls=np.array([WALL]))
    noise = torch.randn(
        120, 4, 16, dtype=torch.complex64, generator=torch.Generator().manual_seed(0)
    )
    labels = links.labels + 0.1 * links.labels.abs().mean() * noise
    for link in range(0, 120, 5):
        labels[link, :, torch.arange(16) != link % 16] = 0
    often = torch.arange(120).repeat(5)
    query, split = links.query[often], links.split.only(torch.arange(600))
    own = search(replace(links, query=query, labels=labels[often], split=split))
    planes = own.frame.to_world(own.find_axis_walls().planes)
    torch.testing.assert_close(planes, walls, rtol=0, atol=5e-3)


def test_drawn_walls_that_phases_do_not_show_stay():
    links, walls = room(count=120, walls=np.array([WALL]))
    links = few(links)
    noise = torch.randn(
        links.labels.shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(1)
    )
    links = replace(links, labels=links.labels + 0.1 * links.labels.abs().mean() * noise)
    drawn = torch.cat((walls, torch.tensor([[0, 1.0, 0, 5.2], PARALLEL]).double()))
    own = search(links, start=drawn, order=2, most=3)
    torch.testing.assert_close(own.run()[0], drawn, rtol=0, atol=5e-3)


def test_walls_find_the_right_lobe():
    links, walls = room(count=120, walls=np.array([WALL, FLOOR]))
    own = search(few(links))
    true = seen_from(walls, own.frame.middle)
    beside = true + torch.tensor([0, 0, 0, own.data.wavelength / 2])
    gains = CommonGains(own.data, own.start, own.most)
    planes = gains.choose_lobes(own.data.draw(120), beside, 0.05)
    torch.testing.assert_close(planes, true, rtol=0, atol=2e-3)


@pytest.mark.parametrize("error", [0.0, 0.15])
def test_walls_of_a_drawing_stand_where_phases_agree(error, monkeypatch):
    """Free strengths may move walls away that are drawn where they stand, or not move those that
    are drawn beside.
    """
    links, walls = room(walls=np.array([WALL, FLOOR]))
    own = search(few(links), start=walls + torch.tensor([0, 0, 0, error]))
    monkeypatch.setattr(own, "find_free", lambda start: start)
    monkeypatch.setattr(
        own.free, "descend", lambda planes, **options: planes + torch.tensor([0, 0, 0, 0.3])
    )
    monkeypatch.setattr(own, "resolve", half_spaces)
    planes, _ = own.run()
    torch.testing.assert_close(planes, walls, rtol=0, atol=5e-3)


@pytest.mark.parametrize("walls", [[WALL], [WALL, PARALLEL], [WALL, FLOOR]])
def test_room_grows_by_planes_along_its_axes(walls):
    links, walls = room(walls=np.array(walls))
    first = torch.tensor([[math.log(2.0), math.log(0.3), 0.0]]).double()
    own = search(links)
    known = SlabRoom(seen_from(walls, own.frame.middle)[:1], first)
    planes, slabs = own.along_axes.grow_along(known, own.most)
    planes = seen_from(planes, -own.frame.middle)
    assert len(slabs) == len(walls)
    torch.testing.assert_close(planes, walls, rtol=0, atol=0.01)


@half_the_steps
@pytest.mark.parametrize(
    ("walls", "known", "tilt"),
    [([WALL, FLOOR], 0, 0.4), ([WALL, FLOOR], 1, 0.4), ([FLOOR], 0, 1.2)],
)
def test_planes_along_axes_replace_a_tilted_one(walls, known, tilt, monkeypatch):
    """As free strengths of an array that tells no heights apart may find it."""
    links, walls = room(walls=np.array(walls))
    own = search(links, start=walls[:known])
    tilted = torch.tensor([[math.cos(tilt), 0, math.sin(tilt), -0.4]]).double()
    monkeypatch.setattr(
        own, "find_free", lambda start: torch.cat((start, seen_from(tilted, own.frame.middle)))
    )
    monkeypatch.setattr(own.free, "descend", lambda planes, **options: planes)
    monkeypatch.setattr(own, "resolve", lambda planes: SlabRoom(planes, SLABS[: len(planes)]))
    monkeypatch.setattr(own, "prune", lambda room: room)
    planes, _ = own.run()
    order = planes[:, 2].abs().argsort()
    torch.testing.assert_close(
        planes[order] * planes[order].sum(1, keepdim=True).sign(), walls, rtol=0, atol=0.01
    )


# --- strengths ---


def draw(*shape):
    return np.random.default_rng(len(shape)).normal(size=(*shape, 2)) @ [1, 1j]


def test_projection_is_least_squares():
    waves, labels = draw(3, 4, 20), draw(3, 20)
    rest, strengths = fit_free(torch.from_numpy(waves), torch.from_numpy(labels), ridge=0.0)
    for k in range(3):
        expected = np.linalg.lstsq(waves[k].T, labels[k], rcond=None)[0]
        np.testing.assert_allclose(strengths[k], expected, rtol=1e-9)
        np.testing.assert_allclose(rest[k], labels[k] - expected @ waves[k], rtol=0, atol=1e-9)


def test_real_strengths_are_not_negative_unless_signed():
    waves, signed = draw(6, 4, 200), np.array([False, False, True, False])
    strengths = np.random.default_rng(0).uniform(0.5, 1, (6, 4)) * [1, -1, -1, 1]
    labels = (strengths[:, None] @ waves)[:, 0] + 0.1 * draw(6, 200)
    rest = real_residual(*map(torch.from_numpy, (waves, labels, signed)), ridge=0.0)
    for k in range(6):
        columns = np.concatenate((waves[k], -waves[k][signed]))
        parts = (np.concatenate((part.real, part.imag), -1) for part in (columns, labels[k]))
        (both, right) = parts
        expected, _ = nnls(both.T, right)
        np.testing.assert_allclose(rest[k], labels[k] - expected @ columns, rtol=0, atol=1e-9)


def test_walls_are_tried_beside_planes_amid_the_places(monkeypatch):
    """Here three planes amid the places have higher scores than the wall."""
    links, _ = room()
    own, normal = search(links), torch.tensor([[1.0, 0, 0]]).double()
    wall = float(own.frame.points[:, 0].max()) + 0.3
    peaks = torch.tensor([[-1.5, 1.0], [0.0, 0.9], [1.5, 0.8], [wall, 0.5]]).double()

    def share(_, grid):
        return (peaks[:, 1] * (-((grid[..., 3:] - peaks[:, 0]) / 0.1).square()).exp()).sum(-1)

    monkeypatch.setattr(own.score, "added_shares", share)
    walls, amid = own.along_axes.propose_along(half_spaces(torch.zeros(0, 4).double()), normal, 0.1)
    assert [plane[3].item() for plane in walls] == pytest.approx([wall], abs=0.03)
    assert [plane[3].item() for plane in amid] == pytest.approx([-1.5, 0.0], abs=0.03)


@pytest.mark.parametrize("few", [0, 1000])
def test_an_image_counts_by_what_it_adds_to_known_paths(few):
    """Least squares with and without the image, of two receivers with different arrays and some of
    the places each.

    Known paths have complex strengths, or real ones with the phase of the direct path.
    """
    links, planes = room(walls=np.array([WALL, FLOOR]), receivers=2, count=61)
    links.labels[:, :, 5:] *= 1j
    own = search(links, options=ChannelOptions(fewest_free=few), order=2)
    planes = seen_from(planes, own.frame.middle)
    others = planes.new_tensor([[0.6, 0.8, 0.0, -3.0], [0.0, 1.0, 0.0, 0.0]])
    tried = torch.cat((planes[1:], others, planes.repeat(32, 1)))
    known_room = half_spaces(planes[:1])
    shares, expected = own.score.added_shares(known_room, tried), []

    def stacked(x):
        return x if few == 0 else np.concatenate((x.real, x.imag), -1)

    for part, turn in zip(*own.data.sample(planes[:1]), strict=True):

        def waves(images, part=part):
            return part.waves(images.float()).to(torch.complex128).numpy()

        places, normals = part.places.double(), tried[:, :3]
        heights = places @ normals.mT - tried[:, 3]
        outside = heights * (normals @ part.position.double() - tried[:, 3]) > 0
        images = places[:, None] - 2 * heights[..., None] * normals
        known, images = (
            part.reflected(known_room, own.data.sequences(planes[:1])).to(torch.complex128),
            waves(images),
        )
        known = stacked(known.numpy())
        both = (images,) if few == 0 else (images, 1j * images)
        images = np.stack([stacked(wave) for wave in both], 2)
        for row, channel in enumerate(
            stacked((part.flat * turn.conj()).to(torch.complex128).numpy())
        ):

            def fitted(columns, channel=channel):
                return columns.T @ np.linalg.lstsq(columns.T, channel, rcond=1e-4)[0]

            def left(columns, channel=channel):
                return np.linalg.norm(channel - fitted(columns)) ** 2

            after = [left(np.concatenate((known[row], wave))) for wave in images[row]]
            expected.append((1 - np.array(after) / left(known[row])) * outside[row].numpy())
    np.testing.assert_allclose(shares, np.mean(expected, 0), rtol=0, atol=0.005)
    assert 0.1 < shares.max()


@pytest.mark.parametrize("phases", [False, True])
def test_error_is_what_neighbours_do_not_predict(phases):
    """Non-negative least squares over the eight nearest places that are a wavelength away, by
    numpy; and a price.
    """
    links, planes = room(walls=np.array([WALL]), receivers=2, count=61)
    if phases:
        links = replace(links, labels=turned(links.labels))
    links.query.transmitters[4] = links.query.transmitters[2] + 0.01
    options = ChannelOptions(ridge=1e-7)
    own = search(links, common=not phases, options=options)
    known_room = half_spaces(seen_from(planes, own.frame.middle))
    found, shares = own.data.reference_phases(known_room.planes, own.data.receivers), []
    for receiver, turn in zip(own.data.receivers, found, strict=True):
        waves = receiver.reflected(known_room, own.data.sequences(known_room.planes)).numpy()
        channels = (receiver.flat * turn[:, None].conj()).numpy()
        places = receiver.places.numpy()
        for k, own_channel in enumerate(channels):
            apart = np.linalg.norm(places - places[k], axis=1)
            near = np.argsort(np.where(apart < own.data.wavelength, np.inf, apart))[:8]
            size = np.linalg.norm(channels[near], axis=1)[:, None]
            columns, right = (
                (waves[near] / size[..., None]).swapaxes(0, 1).reshape(2, -1),
                (channels[near] / size).ravel(),
            )
            strengths, _ = nnls(
                np.concatenate((columns.real, columns.imag), 1).T, np.r_[right.real, right.imag]
            )
            predicted = strengths @ waves[k]
            if phases:
                own_channel = own_channel * np.exp(1j * np.angle(np.vdot(own_channel, predicted)))
            left = np.linalg.norm(own_channel - predicted) ** 2 / np.linalg.norm(own_channel) ** 2
            shares.append(np.log(left + 1e-3))
    assert own.score.error(known_room) == pytest.approx(np.mean(shares) + options.price, abs=1e-3)


def test_neighbours_may_be_silent_at_the_subcarriers_that_count(monkeypatch):
    """Then nothing speaks for a plane."""
    monkeypatch.setattr(ReceiverChannels, "few_subcarriers", slice(0, None, 2))
    links, planes = room(walls=np.array([WALL]))
    links.labels[:, :, ::2] = 0
    own = search(links)
    wall, none = (
        own.score.error(half_spaces(seen_from(some, own.frame.middle)))
        for some in (planes, planes[:0])
    )
    assert wall == pytest.approx(none + ChannelOptions.price, abs=1e-6)
