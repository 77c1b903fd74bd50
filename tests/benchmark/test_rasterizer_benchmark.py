"""Errors, pairs, times and pages of rasterizers, on scenes of a few Gaussians."""

import csv

import pytest
import torch

from gaigs.benchmark import UNAVAILABLE, Context, _memory, rasterizer
from gaigs.benchmark._passes import Passes, in_turns
from gaigs.benchmark._scenes import SCENES, ApertureScene, cast
from gaigs.benchmark._truth import MOST, sum_densely
from gaigs.benchmark.rasterizer import RasterizerBenchmark
from gaigs.registry import registry

TINY = {"common": [20], "training": [], "aperture": [20], "grids": [[8, 12]], "precisions": ["float32"], "repeats": 2}


@pytest.fixture
def no_process(monkeypatch):
    """Memory is not measured, which takes a process each."""
    monkeypatch.setattr(rasterizer, "peak_mb", lambda *place: 1.5)


@pytest.fixture
def rows(tmp_path, no_process):
    RasterizerBenchmark(**TINY, rasterizers=["aperture", "torch"]).run(tmp_path, Context())
    with open(tmp_path / "rasterizer.csv", newline="") as file:
        found = {(row["scene"], row["rasterizer"], row["way"]): row for row in csv.DictReader(file)}
    return tmp_path, found


def test_rows_of_a_tiny_scene(rows):
    _, found = rows
    assert len(found) == 8
    row = found["common", "torch", "forward"]
    assert 0 < float(row["error_mean"]) < float(row["error_max"]) < 1e-5
    assert float(row["ssim"]) == pytest.approx(1, abs=1e-5)
    assert float(row["error_db"]) < 1e-4
    assert int(row["pixels_checked"]) == 96
    assert (row["repeats"], row["tile"], row["peak_mb"]) == ("2", "16 x 16", "1.5")
    assert float(row["ms"]) >= float(row["least_ms"]) > 0
    assert float(row["pairs_per_second"]) == pytest.approx(int(row["pairs"]) / float(row["ms"]) * 1e3, rel=1e-4)
    assert 0 < float(row["share_of_limit"]) < 1
    back = found["common", "torch", "backward"]
    assert 0 < float(back["error_max"]) < 1e-4
    assert not back["ssim"]
    assert 0 < float(found["aperture", "aperture", "forward"]["error_max"]) < 1e-5


def test_what_a_rasterizer_does_not_do_is_a_row(rows):
    folder, found = rows
    assert found["common", "aperture", "forward"]["status"].startswith(f"{UNAVAILABLE}aperture draws no map")
    assert found["aperture", "torch", "backward"]["status"].startswith(f"{UNAVAILABLE}torch draws maps")
    page = (folder / "rasterizer.md").read_text()
    assert "- unavailable: aperture, float32: aperture draws no map; see the scene aperture" in page
    assert "### common, 20 Gaussians, 8 x 12" in page
    assert (folder / "rasterizer_common.png").is_file()


def test_the_dense_sum_is_that_of_the_torch_rasterizer_in_float64():
    for name in ("common", "training"):
        scene = SCENES[name](15, 10, 16)
        truth = sum_densely(scene, "cpu")
        run = Passes(registry("rasterizer").build({"name": "torch"}), scene)
        run.forward()
        run.backward(truth.clear)
        assert truth.clear.double().mean() > 0.9
        torch.testing.assert_close(run.result(), truth.outputs)
        for found, true in zip(run.gradients(), truth.gradients, strict=True):
            torch.testing.assert_close(found, true)


def test_of_many_pairs_a_band_is_summed(monkeypatch):
    scene = SCENES["common"](50, 10, 64)
    whole = sum_densely(scene, "cpu")
    monkeypatch.setattr("gaigs.benchmark._truth.MOST", 50 * 10 * 16)
    band = sum_densely(scene, "cpu")
    assert MOST > 50 * 10 * 64
    assert (whole.band, band.band) == (slice(0, 64), slice(24, 40))
    assert (whole.checked, band.checked) == (640, 160)
    torch.testing.assert_close(band.outputs, whole.outputs[..., 24:40])
    assert 0.5 < band.pairs / whole.pairs < 2
    assert whole.live <= whole.pairs


def test_precisions(no_process, tmp_path):
    options = TINY | {"aperture": [], "precisions": ["float64", "float32", "bfloat16"], "repeats": 1}
    RasterizerBenchmark(**options, rasterizers=["torch"]).run(tmp_path, Context())
    with open(tmp_path / "rasterizer.csv", newline="") as file:
        errors = [float(row["error_max"]) for row in csv.DictReader(file) if row["way"] == "forward"]
    assert errors[0] < 1e-12 < errors[1] < 1e-5 < 1e-3 < errors[2]


def test_an_aperture_has_no_half_precision(no_process, tmp_path):
    options = TINY | {"common": [], "precisions": ["bfloat16"]}
    RasterizerBenchmark(**options, rasterizers=["aperture"]).run(tmp_path, Context())
    told = "- unavailable: aperture, bfloat16: torch has no complex numbers in half precision\n"
    assert told in (tmp_path / "rasterizer.md").read_text()


def test_things_take_turns_and_slow_ones_have_fewer(monkeypatch):
    monkeypatch.setattr("gaigs.benchmark._passes.LONG", 20.0)
    order = []

    def turn(name, seconds):
        return lambda: order.append(name) or {"forward": seconds}

    times = in_turns({"fast": turn("fast", 0.1), "slow": turn("slow", 4.0), "slowest": turn("slowest", 60.0)}, 10)
    assert {name: len(parts["forward"]) for name, parts in times.items()} == {"fast": 10, "slow": 5, "slowest": 3}
    assert order[6:11] == ["fast", "fast", "slow", "fast", "fast"]


def test_memory_of_a_pass_in_this_process(monkeypatch):
    def told(place):
        return _memory._measure("torch", place, 300, (45, 180), "float32", "cpu", 1)

    assert told("common") is None or 0 <= told("common") < 500
    monkeypatch.setattr(_memory, "RESET", _memory.RESET.with_name("there-is-no-such-file") / "either")
    assert told("common") is None


def test_memory_of_a_cuda_device(monkeypatch):
    reset = []
    monkeypatch.setattr("torch.cuda.reset_peak_memory_stats", lambda: reset.append(True))
    monkeypatch.setattr("torch.cuda.memory_allocated", lambda: 7)
    assert _memory._reset("cuda") == 7
    assert reset


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rasterizers": ["torhc"]}, r"benchmark\.rasterizers has 'torhc' \(did you mean 'torch'\?\)"),
        ({"precisions": ["float16", "int8"]}, r"benchmark\.precisions has 'int8'"),
        ({"common": [0]}, r"benchmark\.common must be numbers of Gaussians of at least 1, got \[0\]"),
        ({"grids": [[90]]}, r"benchmark\.grids must be pairs of rows and columns, each at least 8, got \[\[90\]\]"),
        ({"grids": [[7, 90]]}, r"benchmark\.grids must be pairs of rows and columns"),
        ({"repeats": 0}, r"benchmark\.repeats must be at least 1, got 0"),
    ],
)
def test_options_that_do_not_suit(options, told):
    with pytest.raises(ValueError, match=told):
        RasterizerBenchmark(**TINY | options)


def test_scenes_in_other_precisions():
    scene = cast(SCENES["aperture"](5, 8, 8), "cpu", torch.float32)
    assert isinstance(scene, ApertureScene)
    assert scene.amplitudes.dtype == torch.complex64
    assert {leaf.dtype for leaf in scene.leaves()} == {torch.float32, torch.complex64}
