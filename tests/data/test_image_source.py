"""Physics of the simulated room: free space against Friis, paths against folded legs, blockers
against samples.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose, from_spherical
from gaigs.core.propagation import bartlett, fresnel
from gaigs.data.synthetic import respond_in_parts
from gaigs.data.synthetic.image_source import (
    Box,
    Room,
    frequency_offsets,
    passes,
    permittivity,
    trace,
)

FREQUENCY = 3e9
WAVELENGTH = speed_of_light / FREQUENCY
CARRIER = torch.zeros(1)
PATCHES = Array.planar(4, 4, WAVELENGTH / 2, "cosine")
SCATTERED = Array(
    torch.tensor([[0.0, 0.0, 0.0], [0.04, -0.01, 0.02], [-0.03, 0.05, -0.06], [0.11, 0.02, 0.01]])
)
"""No two of its elements are as far apart, nor the same way."""

WALLS = ("concrete", "glass", "plasterboard", "brick", "wood", "ceiling_board")
HALL = Room((400.0, 400.0, 400.0), WALLS)
"""So large that order 0 in its middle is free space."""

ROOM = Room(
    (7.0, 5.0, 3.0),
    WALLS,
    (
        Box("cupboard", (2.0, 4.3, 0.0), (4.0, 5.0, 2.0), 12.0),
        Box("shelf", (4.6, 1.6, 0.0), (5.0, 3.2, 1.9), 7.0),
        Box("table", (1.0, 1.2, 0.7), (2.4, 2.0, 0.75), 3.0),
        Box("column", (3.1, 2.6, 0.0), (3.4, 2.9, 3.0), 20.0),
    ),
)
RECEIVER = torch.tensor([0.4, 0.5, 2.6], dtype=torch.float64)
TRANSMITTERS = torch.tensor(
    [[5.9, 3.1, 1.2], [1.5, 3.4, 0.4], [4.3, 0.6, 2.2], [6.3, 4.4, 0.3], [1.7, 1.6, 0.5]],
    dtype=torch.float64,
)


def pose(position, angles=(0.0, 0.0, 0.0)):
    return Pose.from_xyzw(position, Rotation.from_euler("ZYZ", angles, degrees=True).as_quat())


def patches(position, angles=(0.0, 0.0, 0.0)):
    return Receiver("gateway1", pose(position, angles), PATCHES)


def places(receiver):
    """Of the elements, world frame, in float64."""
    return (
        receiver.pose.position.double()
        + receiver.array.elements.double() @ receiver.pose.rotation.double().T
    )


def fold(points, size):
    """Unfolded points back in the room: a triangle wave along each axis."""
    return size - np.abs(points % (2 * size) - size)


@pytest.mark.parametrize(
    "array", [PATCHES, SCATTERED, Array.single()], ids=["patches", "scattered", "single"]
)
def test_free_space_follows_friis(array):
    receiver = Receiver("gateway1", pose((200.0, 200.0, 200.0)), array)
    for distance in (1.0, 3.7, 25.0):
        transmitter = receiver.pose.position + torch.tensor([0.0, 0.0, distance])
        ((response,),) = respond_in_parts(HALL, transmitter[None], receiver, FREQUENCY, CARRIER, 0)
        distances = (transmitter.double() - places(receiver)).norm(dim=-1)
        expected = (
            WAVELENGTH
            / (4 * math.pi * distances)
            * torch.exp(-2j * math.pi * distances / WAVELENGTH)
        )
        torch.testing.assert_close(response[:, 0], expected, rtol=1e-6, atol=0)


def test_patches_do_not_hear_from_behind_and_fade_as_the_cosine():
    receiver = patches((200.0, 200.0, 200.0), (0, 90, 0))
    angles = torch.tensor([0.0, 60.0, 85.0, 95.0, 180.0]).deg2rad()
    directions = torch.stack(
        (angles.cos(), angles.sin(), 0 * angles), -1
    )  # the normal points along x
    transmitters = receiver.pose.position + 20 * directions
    (responses,) = respond_in_parts(HALL, transmitters, receiver, FREQUENCY, CARRIER, 0)
    responses = responses.abs().mean((1, 2))
    torch.testing.assert_close(
        responses / responses[0], angles.cos().clamp(min=0).double(), atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("angles", [(0, 0, 0), (40, 125, 20), (-100, 60, 170)])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 30), (77, 45), (301, 62)])
def test_spectrum_peaks_at_the_direction_of_arrival(angles, azimuth, elevation):
    receiver = patches((200.0, 200.0, 200.0), angles)
    direction = from_spherical(*torch.tensor([azimuth, elevation]).deg2rad())
    transmitter = receiver.pose.position + 50 * receiver.pose.rotation @ direction
    grid = Grid.degrees()
    for frequency in (FREQUENCY, 0.7 * FREQUENCY):  # the array stays as it is
        (response,) = respond_in_parts(HALL, transmitter[None], receiver, frequency, CARRIER, 0)
        row, column = divmod(int(bartlett(response, grid, PATCHES, frequency)[0].argmax()), 360)
        assert (column, row + 1) == (azimuth, elevation)


def test_a_band_is_sampled_finely_enough_for_its_longest_path():
    offsets = frequency_offsets(ROOM, 500e6, 2)
    assert offsets[[0, -1]].tolist() == [-250e6, 250e6]
    spacing = (offsets[1] - offsets[0]).item()
    corners = torch.tensor([[0.01, 0.01, 0.01], [6.99, 4.99, 2.99]], dtype=torch.float64)
    longest = max(
        (trace(ROOM, corners, c, FREQUENCY, 2).images - c).norm(dim=-1).max().item()
        for c in corners
    )
    assert spacing < speed_of_light / longest


def test_third_order_has_every_image_once():
    images = trace(ROOM, TRANSMITTERS[:1], RECEIVER, FREQUENCY, 3).images[0].numpy()
    found = [tuple(np.floor(image / np.array(ROOM.size)).astype(int).tolist()) for image in images]
    expected = [c for c in itertools.product(range(-3, 4), repeat=3) if sum(map(abs, c)) <= 3]
    assert sorted(found) == sorted(expected)
    np.testing.assert_allclose(
        fold(images, np.array(ROOM.size)), np.tile(TRANSMITTERS[0], (63, 1)), atol=1e-12
    )
    np.testing.assert_array_equal(images[0], TRANSMITTERS[0])


def test_gains_are_those_of_the_reflection_points():
    """Legs folded back into the room: each ends on a wall, and each bounce has that wall's
    coefficient at its angle.
    """
    empty = Room(ROOM.size, WALLS)
    size, start = np.array(ROOM.size), RECEIVER.numpy()
    paths = trace(empty, TRANSMITTERS, RECEIVER, FREQUENCY, 2)
    for images, gains in zip(paths.images.numpy(), paths.gains, strict=True):
        for image, gain in zip(images, gains, strict=True):
            cell = np.floor(image / size).astype(int)
            crossings = []
            for axis, steps in enumerate(cell):
                planes = range(1, steps + 1) if steps > 0 else range(0, steps, -1)
                crossings += [
                    ((k * size[axis] - start[axis]) / (image - start)[axis], axis) for k in planes
                ]
            stops = [
                start,
                *(fold(start + t * (image - start), size) for t, _ in sorted(crossings)),
                fold(image, size),
            ]
            legs = [b - a for a, b in itertools.pairwise(stops)]
            assert sum(map(np.linalg.norm, legs)) == pytest.approx(
                np.linalg.norm(image - start), rel=1e-12
            )
            expected = 1
            for stop, (_, axis), before, after in zip(
                stops[1:], sorted(crossings), legs, legs[1:], strict=False
            ):
                side = round(stop[axis] / size[axis])
                assert stop[axis] == pytest.approx(side * size[axis], abs=1e-9)
                cosine = abs(before[axis]) / np.linalg.norm(before)
                assert cosine == pytest.approx(abs(after[axis]) / np.linalg.norm(after))
                te, tm = fresnel(
                    permittivity(WALLS[2 * axis + side], FREQUENCY), torch.tensor([cosine])
                )
                expected = expected * (tm if axis == 2 else te).item()
            assert gain.item() == pytest.approx(expected, rel=1e-9)


def test_furniture_takes_its_loss_on_every_leg():
    """Brute force: every leg is sampled each 0.5 mm and folded into the room."""
    size, start = np.array(ROOM.size), RECEIVER.numpy()
    furnished = trace(ROOM, TRANSMITTERS, RECEIVER, FREQUENCY, 2)
    empty = trace(Room(ROOM.size, WALLS), TRANSMITTERS, RECEIVER, FREQUENCY, 2)
    losses_db = -20 * torch.log10((furnished.gains / empty.gains).abs())
    for images, losses in zip(furnished.images.numpy(), losses_db.tolist(), strict=True):
        for image, loss_db in zip(images, losses, strict=True):
            points = np.linspace(start, image, int(np.linalg.norm(image - start) / 5e-4))
            legs, inside = np.floor(points / size), fold(points, size)
            expected = 0.0
            for box in ROOM.furniture:
                hit = ((inside > box.lower) & (inside < box.upper)).all(-1)
                expected += box.loss_db * len(np.unique(legs[hit], axis=0))
            assert loss_db == pytest.approx(expected, abs=1e-9)
    assert 0.2 < (losses_db > 0).double().mean() < 0.95  # both kinds of paths are there


@pytest.mark.parametrize(
    "array", [PATCHES, SCATTERED, Array.single()], ids=["patches", "scattered", "single"]
)
@pytest.mark.parametrize("frequency", [FREQUENCY, 1.1e9])
def test_spectrum_is_the_mean_power_of_steered_sums(array, frequency):
    """Against the formula of the labels, element by element in the array's own frame."""
    responses = np.random.default_rng(0).normal(size=(3, len(array), 2, 2)) @ [1, 1j]
    grid = Grid.degrees((1, 37, 90), (0, 123, 359))
    spectra = bartlett(torch.from_numpy(responses), grid, array, frequency)
    x, y, z = array.elements.double().numpy().T
    for (i, el), (j, az) in itertools.product(
        enumerate(np.deg2rad((1, 37, 90))), enumerate(np.deg2rad((0, 123, 359)))
    ):
        delay = x * np.cos(az) * np.cos(el) + y * np.sin(az) * np.cos(el) + z * np.sin(el)
        weights = np.exp(-2j * np.pi * frequency / speed_of_light * delay)
        expected = np.sqrt((np.abs(np.einsum("bnf,n->bf", responses, weights)) ** 2).mean(1))
        np.testing.assert_allclose(spectra[:, i, j], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("start", "end", "hits"),
    [
        ((-1, 0.5, 0.5), (2, 0.5, 0.5), True),  # along an axis, through the middle
        ((1.1, 0.5, 0.5), (3, 0.5, 0.5), False),  # starts behind
        ((0.5, 0.5, 0.5), (0.5, 0.5, 9), True),  # starts inside
        ((-1, 1, 0.5), (2, 1, 0.5), False),  # runs in a face
        ((-1, 1, 0.5), (1, 3, 0.5), False),  # past a corner
        ((-0.5, 0.5, 0.5), (0.5, 1.5, 0.5), False),  # touches an edge
        ((-0.5, 0.4, 0.5), (0.5, 1.4, 0.5), True),  # cuts off an edge
    ],
)
def test_segments_through_the_unit_cube(start, end, hits):
    cube = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    start, end = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    assert passes(start, end, *cube).item() is hits
    assert passes(end, start, *cube).item() is hits


def test_permittivity_is_that_of_the_recommendation():
    """Its own form of the imaginary part: 17.98 sigma / f with f in GHz."""
    at_10 = permittivity("concrete", 10e9)
    assert at_10.real == 5.24
    assert at_10.imag == pytest.approx(-17.98 * 0.0462 * 10**0.7822 / 10, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"room": Room(ROOM.size, ("marzipan",) * 6)},
            "unknown material 'marzipan'; there are: concrete, brick",
        ),
        (
            {"frequency": 920e6},
            r"frequency must lie in 1e9\.\.40e9 Hz, where materials are tabulated, got 9\.2e\+08",
        ),
        ({"offsets": torch.tensor([-4e9])}, "frequencies must be positive"),
        ({"order": -1}, "order must be the largest number of reflections, 0 or more, got -1"),
        (
            {"transmitters": torch.tensor([[1.0, 1.0, 3.5]])},
            r"inside the room of .* got \[1\.0, 1\.0, 3\.5\]",
        ),
        (
            {"transmitters": torch.tensor([[3.2, 2.7, 1.0]])},
            r"outside its furniture, got \[3\.2, 2\.7, 1\.0\]",
        ),
        ({"transmitters": torch.tensor([[math.nan, 1.0, 1.0]])}, "inside the room"),
    ],
)
def test_impossible_scenes_are_refused(change, message):
    scene = {
        "room": ROOM,
        "transmitters": TRANSMITTERS,
        "receiver": patches(RECEIVER.tolist()),
        "frequency": FREQUENCY,
    }
    with pytest.raises(ValueError, match=message):
        next(respond_in_parts(**scene | {"offsets": CARRIER, "order": 1} | change))
