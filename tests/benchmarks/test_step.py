"""The parts of a training step."""

import csv

import pytest
import step

BRIEF = (
    "data.transmitters=12", "data.order=0", "gaussians.count=10", "training.batch_size=3", "training.thinning.stride=8",
    "tokenizer=euclidean", "rasterizer=torch",
)  # fmt: skip


def test_a_step_is_divided(tmp_path):
    overrides = (*BRIEF, "trainer.max_steps=-1", "trainer.max_time=00:00:00:00")
    step.main([*overrides, "--repeats", "2", "--devices", "cpu", "--folder", str(tmp_path)])
    with open(tmp_path / "step.csv", newline="") as file:
        rows = {row["part"]: row for row in csv.DictReader(file)}
    assert tuple(rows) == step.PARTS
    whole = rows["whole step"]
    assert (
        whole
        | {"repeats": "2", "gaussians": "10", "places": "3", "share": "1", "rasterizer": "torch"}
        == whole
    )
    assert all(float(row["ms"]) > 0 for row in rows.values())
    page = (tmp_path / "step.md").read_text()
    assert f"python benchmarks/step.py {' '.join(overrides)}\n" in page
    assert "| backward: rasterizer |" in page


def test_a_model_without_its_parts_is_refused(tmp_path):
    message = "a step needs a model with a deformation and a rasterizer, got model=mean"
    with pytest.raises(ValueError, match=message):
        step.main(["model=mean", "--folder", str(tmp_path)])
