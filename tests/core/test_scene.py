"""Arrays, the band, and scenes that come back from a checkpoint."""

import io
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Frame, Grid, Pose
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.core.task.csi import Csi
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import floors_of
from gaigs.testing import example_links

POSE = Pose.from_xyzw((0.2, 0.3, 2.5), (-0.6, 0, 0, 0.8))


def stored(state):
    """A state as it comes back from a checkpoint."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_separate_floors_have_their_heights():
    """Places of a floor scatter by hand-held heights; among heights of a drone there is no floor."""
    rng = np.random.default_rng(0)
    heights = [floor + rng.uniform(0.9, 1.5, count) for floor, count in ((0, 20), (4, 50), (8, 30))]

    def places(z):
        return torch.from_numpy(np.column_stack((rng.uniform(size=(len(z), 2)), z))).float()

    several = places(np.concatenate(heights))
    np.testing.assert_allclose(floors_of(several), [5.2, 9.2, 1.2], atol=0.2)
    links = example_links("rssi")
    scene = replace(links.scene, floors=floors_of(several))
    assert scene.height == floors_of(several)[0]
    assert torch.equal(Scene.from_state(stored(scene.state())).floors, scene.floors)
    for heights in (
        rng.uniform(0, 30, 40),
        np.array([0.0, 1.9, 5.0, 6.5]),
        np.array([1.0, 1.0, 2.5]),
    ):
        assert not len(floors_of(places(heights)))
    assert links.scene.height == pytest.approx(
        (links.scene.lower[2] + links.scene.upper[2]).item() / 2
    )


# --- arrays ---


def test_a_square_array_has_the_elements_of_the_nerf2_spectra():
    """Element 4 i + k stands i half wavelengths along x and k along y from the first."""
    wavelength = 0.046
    array = Array.planar(4, 4, wavelength / 2)
    expected = [
        [(i - 1.5) * wavelength / 2, (k - 1.5) * wavelength / 2, 0]
        for i in range(4)
        for k in range(4)
    ]
    np.testing.assert_allclose(array.elements, expected, atol=1e-8)
    world = POSE.to(array.elements).world(array.elements)
    turned = POSE.position.numpy() + np.array(expected) @ POSE.rotation.numpy().T
    np.testing.assert_allclose(world, turned, atol=1e-6)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 5), (3, 1)])
def test_rows_lie_along_y_and_columns_along_x(rows, columns):
    elements = Array.planar(rows, columns, 0.1).elements.reshape(columns, rows, 3)
    x, y = (0.1 * (np.arange(count) - (count - 1) / 2) for count in (columns, rows))
    np.testing.assert_allclose(elements[:, :, 0], np.broadcast_to(x[:, None], (columns, rows)))
    np.testing.assert_allclose(elements[:, :, 1], np.broadcast_to(y, (columns, rows)))
    assert not elements[:, :, 2].any()


def test_elements_of_an_array_have_places_in_the_room():
    receiver = Receiver(
        "door", Pose.from_xyzw([1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0]), Array.planar(2, 2, 1.0)
    )
    places = receiver.pose.world(receiver.array.elements)
    assert places.tolist() == [[1.5, 2.5, 3.0], [1.5, 1.5, 3.0], [0.5, 2.5, 3.0], [0.5, 1.5, 3.0]]
    assert torch.equal(receiver.pose.local(places), receiver.array.elements)


def test_elements_hear_as_their_pattern_says():
    directions = Grid.degrees(range(-90, 91, 30), range(0, 360, 60)).vectors().double()
    assert torch.equal(Array.single().gain(directions), torch.ones(7, 6, dtype=torch.float64))
    patch = Array.planar(2, 2, 0.1, "cosine").gain(directions)
    off_normal = np.radians(90 - np.arange(-90, 91, 30))
    np.testing.assert_allclose(patch[:, 0], np.maximum(np.cos(off_normal), 0), atol=1e-7)
    assert patch.dtype == torch.float64


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Array(torch.zeros(1, 3), "parrot"),
            f"one of {', '.join(Array.patterns)}, got 'parrot'",
        ),
        (lambda: Array(torch.zeros(0, 3)), r"must be \(e, 3\) positions \[m\], got \(0, 3\)"),
        (lambda: Array(torch.zeros(3)), r"got \(3,\)"),
        (lambda: Array(torch.zeros(4, 2)), r"got \(4, 2\)"),
        (
            lambda: Array.planar(0, 4, 0.1),
            "at least 1 x 1 elements at a positive pitch, got 0 x 4 at 0.1 m",
        ),
        (lambda: Array.planar(4, -1, 0.1), "got 4 x -1"),
        (lambda: Array.planar(4, 4, 0.0), "at 0.0 m"),
        (lambda: Array.planar(4, 4, math.nan), "at nan m"),
        (lambda: Array.planar(4, 4, math.inf), "at inf m"),
        (
            lambda: Receiver("door", Pose(torch.zeros(3), torch.eye(3) * 7)),
            "of receiver 'door' must have a rotation",
        ),
        (
            lambda: Receiver("door", Pose(torch.zeros(3), torch.eye(3).flip(0))),
            "must have a rotation",
        ),
    ],
)
def test_impossible_arrays_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- the band ---


@pytest.fixture
def scene():
    return example_links().scene


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_carriers_place_in_the_band_is_that_of_its_logarithm(scene, dtype):
    scene = replace(scene, frequencies=torch.tensor([1e9, 2e9, 8e9]))
    query = Query(
        torch.zeros(4, 3, dtype=dtype), torch.zeros(4).long(), torch.tensor([1e9, 2e9, 8e9, 16e9])
    )
    places = scene.band_positions(query)
    assert places.dtype == dtype
    np.testing.assert_allclose(places, [-1, -1 / 3, 1, 5 / 3], rtol=1e-6)


def test_a_band_needs_a_frequency(scene):
    scene = replace(scene, frequencies=torch.tensor([2.4e9, 5.0e9]))
    with pytest.raises(ValueError, match="a frequency must be given, as the data have 2 carriers"):
        scene.band_positions(Query(torch.zeros(1, 3), torch.zeros(1).long()))


# --- lags ---


@pytest.mark.parametrize(
    "array", [Array.single(), Array(torch.rand(5, 3)), Array.planar(2, 3, 0.1)]
)
def test_each_pair_of_elements_has_its_lag(array):
    steps, pairs, counts = array.lags
    count = len(array)
    for k, (i, j) in enumerate((i, j) for i in range(count) for j in range(count)):
        apart = array.elements[i].double() - array.elements[j].double()
        np.testing.assert_allclose(steps[pairs[k]], apart, atol=1e-9)
    assert counts.sum() == count**2
    torch.testing.assert_close(
        steps, -steps.flip(0)
    )  # opposite ones stand opposite, and 0 in the middle
    assert not steps[len(steps) // 2].any()


# --- frames ---


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (
            (32632, 11.5, 48.1),
            r"an easting and a northing .*, got Frame\(epsg=32632, x=11.5, y=48.1\)",
        ),
        ((32632, 0.0, 0.0), "an easting and a northing"),
        ((32632, 5.4e6, 4.5e5), "an easting and a northing"),
        ((32632, math.nan, 5.4e6), "x=nan"),
        (("32632", 4.5e5, 5.4e6), "epsg='32632'"),
        (
            (2263, 980000.0, 200000.0),
            r"projected system in metres, got EPSG:2263, .* in US survey foot\ngaigs.data",
        ),
        ((4978, 4e6, 5e5), "projected system in metres, got EPSG:4978"),
        ((99999, 1e5, 1e5), "there is no coordinate system EPSG:99999"),
    ],
)
def test_frames_that_are_no_projected_metres_are_refused(frame, message):
    pytest.importorskip("pyproj")
    with pytest.raises(ValueError, match=message):
        Frame(*frame)


@pytest.mark.usefixtures("unchecked")
def test_systems_in_metres_are_taken_and_those_of_utm_without_pyproj(monkeypatch):
    pytest.importorskip("pyproj")
    for code, x, y in (
        (25832, 4.5e5, 5.4e6),
        (27700, 0.0, 0.0),
        (3857, 1e6, 6e6),
        (np.int64(32633), -8e4, 6.9e6),
    ):
        assert Frame(code, x, y).epsg == code
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert Frame(32632, 4.5e5, 5.4e6) == Frame(32632, 450000.0, 5400000.0)
    with pytest.raises(ValueError, match="an easting and a northing"):
        Frame(4326, 11.5, 48.1)


def test_a_stored_scene_with_an_impossible_frame_has_none(scene, caplog):
    for frame, expected in (
        ((4326, 11.5, 48.1), None),
        ((32632, 4.5e5, 5.4e6), Frame(32632, 4.5e5, 5.4e6)),
    ):
        assert Scene.from_state(scene.state() | {"frame": frame}).frame == expected
    assert (
        caplog.text.count("predictions have no place on a map: a frame must be an EPSG code") == 1
    )


# --- states ---


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_a_scene_comes_back_from_its_state(task):
    patches = Receiver("patches", POSE, Array.planar(2, 3, 0.1, "cosine"))
    scene = replace(
        example_links(task).scene, frequencies=torch.tensor([2.4e9, 5.0e9]), bandwidth=499.2e6
    )
    scene = replace(
        scene, receivers=(*scene.receivers, patches), frame=Frame(32632, np.float64(4.5e5), 5.4e6)
    )
    # A run that was begun before receivers had bands goes on if its scene is the same.
    assert all("band" not in entry for entry in scene.state()["receivers"])
    again = Scene.from_state(stored(scene.state()))
    for receiver, other in zip(scene.receivers, again.receivers, strict=True):
        assert other.name == receiver.name
        assert torch.equal(other.pose.position, receiver.pose.position)
        assert torch.equal(other.pose.rotation, receiver.pose.rotation)
        assert torch.equal(other.array.elements, receiver.array.elements)
        assert other.array.pattern == receiver.array.pattern
    for field in ("lower", "upper", "frequencies"):
        assert torch.equal(getattr(again, field), getattr(scene, field))
    assert (again.spacing, again.frame) == (scene.spacing, scene.frame)
    assert again.bandwidth == 499.2e6
    assert type(again.task) is type(scene.task)
    assert again.task.shape == scene.task.shape
    assert again.task.normalisation == scene.task.normalisation


def test_a_tasks_options_come_back_bit_by_bit():
    grid = Grid.degrees(range(4, 90, 5), range(0, 360, 10))
    task = Spectrum(grid.elevations, grid.azimuths, "min-max")
    scene = replace(example_links().scene, task=task)
    again = Scene.from_state(stored(scene.state())).task
    assert torch.equal(again.directions.elevations, grid.elevations)
    assert torch.equal(again.directions.azimuths, grid.azimuths)
    assert again.normalisation == "min-max"
    channels = Csi(4, torch.tensor([2.4e9, 2.4e9 + 312.5e3], dtype=torch.float64))
    again = Scene.from_state(stored(replace(scene, task=channels).state())).task
    assert torch.equal(again.frequencies, channels.frequencies)
    assert again.elements == 4
