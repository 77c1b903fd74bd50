"""The ray tracer's paths against mirror images and slabs, its requirements and its cache."""

import math

import numpy as np
import pytest
import torch
from gaigs_sionna import cache, tracing
from gaigs_sionna.meshes import THICKNESS, Cuboid
from gaigs_sionna.rooms import ROOMS
from scipy.constants import speed_of_light

from gaigs.data.synthetic import image_source
from gaigs.io.meshes import Mesh

FREQUENCY = 6e9
RECEIVER = torch.tensor([0.0, 0.0, 1.0])
PLATE = ((-3.0, -3.0, 0.0), (3.0, -3.0, 0.0), (3.0, 3.0, 0.0), (-3.0, 3.0, 0.0))
FLOOR = Mesh("floor", "metal", PLATE, ((0, 1, 2, 3),))
WALL = Mesh("wall", "metal", tuple((x, 2.0, y + 1.0) for x, y, _ in PLATE), ((0, 1, 2, 3),))
BOARD = Mesh("board", "wood", tuple((1.0, x, y + 1.0) for x, y, _ in PLATE), ((0, 1, 2, 3),))


def strong(paths, row=0):
    """Images and gains of a transmitter's paths, strongest field first, without the padding."""
    kept = paths.gains[row] != 0
    return paths.images[row][kept].numpy(), paths.gains[row][kept].numpy()


# --- paths ---


@pytest.fixture(scope="module")
def over_floor(tracer):
    """Two transmitters over a plate of metal, and more than are traced at a time."""
    places = torch.tensor([[1.5, 0.5, 0.8], [-1.0, 1.2, 1.6]]).repeat(6, 1)
    return places, tracer.trace([FLOOR], RECEIVER, places, FREQUENCY)


def test_a_floor_of_metal_mirrors_the_transmitter(over_floor):
    places, paths = over_floor
    for row, place in enumerate(places.double().numpy()):
        images, gains = strong(paths, row)
        assert len(gains) == 2
        np.testing.assert_allclose(images, [place, place * (1, 1, -1)], atol=1e-4)
        np.testing.assert_allclose(gains, [1, 1], atol=0.02)  # as a vertical field over a conductor


def test_a_wall_of_metal_turns_the_vertical_field_around(tracer):
    images, gains = strong(
        tracer.trace([WALL], RECEIVER, torch.tensor([[1.5, -0.5, 1.0]]), FREQUENCY)
    )
    np.testing.assert_allclose(images, [(1.5, -0.5, 1), (1.5, 4.5, 1)], atol=1e-4)
    np.testing.assert_allclose(gains, [1, -1], atol=0.02)


@pytest.mark.parametrize("frequency", [0.45e9, 6e9, 28e9])
def test_a_board_transmits_as_a_slab(tracer, frequency):
    """At normal incidence: Airy's formula for the slab, with the board's thickness of air left out
    of the way.
    """
    images, gains = strong(
        tracer.trace([BOARD], RECEIVER, torch.tensor([[2.0, 0.0, 1.0]]), frequency)
    )
    real, c, d = image_source.MATERIALS["wood"]
    epsilon = real - 1j * c * (frequency / 1e9) ** d / (2 * math.pi * frequency * 8.8541878128e-12)
    index = np.sqrt(epsilon)
    phase = np.exp(-2j * math.pi * frequency / speed_of_light * index * THICKNESS["wood"])
    r = (1 - index) / (1 + index)
    expected = (1 - r**2) * phase / (1 - r**2 * phase**2)
    np.testing.assert_allclose(images[0], (2, 0, 1), atol=1e-4)
    assert abs(gains[0]) == pytest.approx(abs(expected), rel=1e-3)


def test_without_the_weakest_paths_nearly_all_power_is_left(tracer, monkeypatch):
    room, place = ROOMS["slanted"], torch.tensor([[3.0, 1.5, 1.2]])
    power = []
    for weakest in (0.0, tracing.WEAKEST):
        monkeypatch.setattr(tracing, "WEAKEST", weakest)
        images, gains = strong(tracer.trace(room.meshes(), room.pose().position, place, FREQUENCY))
        lengths = np.linalg.norm(images - room.pose().position.numpy(), axis=1)
        fields = np.abs(gains) / lengths
        assert (np.diff(fields) <= 1e-9).all(), "strongest first"
        power.append((len(gains), (fields**2).sum()))
    (every, whole), (kept, rest) = power
    assert kept < every
    assert 1 - 1.1 * tracing.WEAKEST < rest / whole < 1


def test_a_wave_bends_around_a_corner(tracer):
    """A block of metal hides the transmitter; the shortest way leads over its edge, at the height
    of both.
    """
    block = Cuboid("block", "metal", (0.5, 0.5, -3.0), (3.0, 3.0, 5.0)).mesh()
    receiver, place = torch.tensor([0.0, 1.5, 1.0]), torch.tensor([[1.5, 0.0, 1.0]])
    images, gains = strong(tracer.trace([block], receiver, place, FREQUENCY))
    half = np.array([0.5, -1.0, 0.0])  # from the receiver to the edge
    np.testing.assert_allclose(images, [receiver.numpy() + 2 * half], atol=1e-3)
    assert 0.01 < abs(gains[0]) < 0.5  # at the shadow's boundary it is half the field
    with pytest.raises(ValueError, match="a path must lead"):
        tracing.trace([block], receiver, place, FREQUENCY, tracing.DEPTH)


@pytest.mark.parametrize("frequency", [1e8, 5e10, math.nan])
def test_frequencies_out_of_range_are_refused(frequency):
    with pytest.raises(ValueError, match=r"frequency must lie in 3e\+08\.\.4e\+10 Hz, got"):
        tracing.trace([FLOOR], RECEIVER, torch.tensor([[1.0, 1.0, 1.0]]), frequency)


def test_a_transmitter_that_no_path_leads_to_is_named(tracer):
    chest = Cuboid("chest", "metal", (1.0, 1.0, 0.5), (2.0, 2.0, 1.5)).mesh()
    with pytest.raises(ValueError, match=r"got none to \[1\.5, 1\.5, 1\.0\]; move it"):
        tracer.trace([chest], RECEIVER, torch.tensor([[1.5, 0.5, 1.0], [1.5, 1.5, 1.0]]), FREQUENCY)


# --- requirements ---


@pytest.fixture
def libraries(monkeypatch):
    """Makes files of libLLVM of made-up versions the only ones that there are."""

    def make(versions):
        monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
        monkeypatch.setattr(
            tracing,
            "glob",
            lambda pattern: [*versions] if pattern.startswith("/usr/lib64/") else [],
        )
        monkeypatch.setattr(tracing, "llvm_version", lambda file: versions.get(file, 0))

    return make


def test_the_chosen_or_newest_llvm_is_taken_and_checked(libraries, monkeypatch):
    libraries(
        {"/a/libLLVM.so.18.1": 18, "/a/libLLVM.so.19.1": 19, "/b/mine.so": 17, "/b/old.so": 15}
    )
    assert tracing.find_llvm() == "/a/libLLVM.so.19.1"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/b/mine.so")
    assert tracing.find_llvm() == "/b/mine.so"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/b/old.so")
    with pytest.raises(
        RuntimeError, match=r"needs libLLVM 17 or later, got /b/old\.so \(15\); install it"
    ):
        tracing.find_llvm()
    libraries({})
    with pytest.raises(RuntimeError, match="needs libLLVM 17 or later, got none"):
        tracing.find_llvm()


# --- cache ---

PATHS = image_source.Paths(
    torch.tensor([[[1.0, 2.0, 3.25], [0.5, 0.25, 9.0]]]).double(),
    torch.tensor([[0.5 - 0.25j, 0.0]], dtype=torch.complex128),
)
PLACE = torch.tensor([[2.0, 1.0, 1.0]])


@pytest.fixture
def traced(monkeypatch, tmp_path):
    """The arguments that the tracer is called with, which gives the same paths always; the cache is
    empty.
    """
    calls = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tracing, "find_packages", lambda: {"sionna-rt": "2.2.0"})
    monkeypatch.setattr(tracing, "trace", lambda *arguments: calls.append(arguments) or PATHS)
    return calls


def test_paths_are_traced_once(traced, tmp_path):
    room = ROOMS["slanted"]
    first, again = (cache.find_paths(room, RECEIVER, PLACE, FREQUENCY) for _ in range(2))
    assert len(traced) == 1
    assert traced[0][0] == room.meshes()
    for paths in (first, again):
        assert torch.equal(paths.images, PATHS.images)
        assert torch.equal(paths.gains, PATHS.gains)
    (file,) = (tmp_path / "gaigs" / "sionna").iterdir()
    assert file.suffix == ".npz", "and nothing half-written is left"


@pytest.mark.parametrize(
    "change",
    [
        lambda patch: ("l_shape", RECEIVER, PLACE, FREQUENCY),
        lambda patch: ("slanted", RECEIVER + 0.1, PLACE, FREQUENCY),
        lambda patch: ("slanted", RECEIVER, PLACE + 0.1, FREQUENCY),
        lambda patch: ("slanted", RECEIVER, PLACE, 5e9),
        lambda patch: ("slanted", RECEIVER, PLACE, FREQUENCY, False),
        lambda patch: patch.setattr(tracing, "DEPTH", 2),
        lambda patch: patch.setattr(tracing, "find_packages", lambda: {"sionna-rt": "2.3.0"}),
    ],
)
def test_other_paths_are_traced_anew(traced, monkeypatch, change):
    same = "slanted", RECEIVER, PLACE, FREQUENCY
    cache.find_paths(ROOMS["slanted"], *same[1:])
    name, *rest = change(monkeypatch) or same
    cache.find_paths(ROOMS[name], *rest)
    assert len(traced) == 2


def test_paths_of_a_faster_process_stay(traced, monkeypatch):
    other = image_source.Paths(2 * PATHS.images, 2 * PATHS.gains)

    def slow(*arguments):
        monkeypatch.setattr(tracing, "trace", lambda *arguments: other)
        cache.find_paths(ROOMS["slanted"], RECEIVER, PLACE, FREQUENCY)
        return PATHS

    monkeypatch.setattr(tracing, "trace", slow)
    assert torch.equal(
        cache.find_paths(ROOMS["slanted"], RECEIVER, PLACE, FREQUENCY).images, other.images
    )


def test_a_damaged_file_is_named(traced, tmp_path):
    cache.find_paths(ROOMS["slanted"], RECEIVER, PLACE, FREQUENCY)
    (file,) = (tmp_path / "gaigs" / "sionna").iterdir()
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ValueError, match=rf"cannot parse {file}: .*; delete it"):
        cache.find_paths(ROOMS["slanted"], RECEIVER, PLACE, FREQUENCY)
