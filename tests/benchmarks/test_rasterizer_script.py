"""Errors, pairs and times of rasterizers, on scenes of a few Gaussians."""

import csv

import pytest
import rasterizer
import torch
from common import UNAVAILABLE
from scenes import SCENES, Truth

from gaigs.registry import registry

TINY = ["--common", "20", "--training", "4", "--grids", "8x12", "--devices", "cpu"]


def test_rows_of_tiny_scenes(tmp_path, monkeypatch):
    def no_driver(*_):
        raise RuntimeError("no driver")

    monkeypatch.setattr("gaigs.splatting.rasterizer.opencl.open_queue", no_driver)
    precisions = ["float64", "float32", "bfloat16"]
    own = ["--precisions", *precisions, "--rasterizers", "torch", "opencl", "--repeats", "2"]
    rasterizer.main([*TINY, *own, "--folder", str(tmp_path)])
    with open(tmp_path / "rasterizer.csv", newline="") as file:
        found = {
            (row["scene"], row["rasterizer"], row["precision"]): row for row in csv.DictReader(file)
        }
    assert len(found) == 12
    row = found["common", "torch", "float32"]
    assert (row["repeats"], row["times"]) == ("2", "1")
    assert min(float(row["forward_ms"]), float(row["backward_ms"]), int(row["pairs"])) > 0
    for key in ("error", "gradient_error"):
        errors = [float(found["training", "torch", precision][key]) for precision in precisions]
        assert errors[0] < 1e-12 < errors[1] < 1e-4 < 1e-3 < errors[2]
    assert found["common", "opencl", "float32"]["status"] == f"{UNAVAILABLE}no driver"
    page = (tmp_path / "rasterizer.md").read_text()
    assert page.index("## common, ") < page.index("## training, ")
    assert "| 20 | 8 x 12 | torch | float32 | " in page


def test_a_long_pass_is_repeated_three_times(tmp_path, monkeypatch):
    monkeypatch.setattr("rasterizer.passes", lambda *_: lambda: (0.4, 0.6))
    own = ["--training", "--precisions", "float32", "--rasterizers", "torch", "--repeats", "9"]
    rasterizer.main([*TINY, *own, "--folder", str(tmp_path)])
    assert "| 600 | 0 | 3 | 1 |" in (tmp_path / "rasterizer.md").read_text()


@pytest.mark.parametrize("name", SCENES)
def test_wrong_maps_and_gradients_are_seen(name):
    drawn = registry("rasterizer").build({"name": "torch"})
    truth = Truth(SCENES[name](15, 10, 16))
    assert truth.pixels.double().mean() > 0.9

    def wrong(splats, *arguments):
        image, left = drawn(splats, *arguments)
        return image + 0.1 * image.detach().abs().max(), left

    assert truth.errors(drawn, "cpu", torch.float64)["error"] < 1e-12
    assert truth.errors(wrong, "cpu", torch.float64)["error"] == pytest.approx(0.1, rel=0.2)

    def halved(signal):
        return signal.detach() + 0.5 * (signal - signal.detach())

    found = truth.errors(
        lambda splats, signal, *rest: drawn(splats, halved(signal), *rest), "cpu", torch.float64
    )
    assert found["error"] < 1e-12
    assert found["gradient_error"] == pytest.approx(0.5, rel=0.01)


def test_many_pairs_are_summed_on_a_coarser_grid():
    scene = SCENES["common"](50, 30, 60)
    coarse = scene.coarse(50 * 200)
    assert tuple(coarse.plane.shape) == (10, 20)
    assert coarse.plane.u.equal(scene.plane.u[:, ::3])
    assert Truth(scene).pairs == pytest.approx(Truth(coarse).pairs * 9, rel=0.3)
