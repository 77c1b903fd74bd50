"""The parts of a training step."""

import csv

import pytest

from gaigs.benchmark.step import PARTS, StepBenchmark

BRIEF = (
    "data.transmitters=12", "data.order=0", "gaussians.count=10", "training.batch_size=3", "training.thinning.stride=8",
    "tokenizer=euclidean", "rasterizer=torch",
)  # fmt: skip


def test_a_step_is_divided(tmp_path):
    overrides = (*BRIEF, "trainer.max_steps=-1", "trainer.max_time=00:00:00:00")
    StepBenchmark(repeats=2).run(tmp_path, overrides)
    with open(tmp_path / "step.csv", newline="") as file:
        rows = {row["part"]: row for row in csv.DictReader(file)}
    assert tuple(rows) == PARTS
    whole = rows["whole step"]
    assert whole | {"repeats": "2", "gaussians": "10", "places": "3", "share": "1", "rasterizer": "torch"} == whole
    assert all(float(row["ms"]) > 0 for row in rows.values())
    page = (tmp_path / "step.md").read_text()
    assert f"python -m gaigs command=benchmark benchmark=step {' '.join(overrides)}\n" in page
    assert "| backward: rasterizer |" in page


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model=mean"], "benchmark=step needs a model with a deformation and a rasterizer, got model=mean"),
        ([*BRIEF[:2], "task=rssi"], r"labels of data 'synthetic' are of task 'spectrum'.*; add task=rssi|add task="),
        ([*BRIEF, "+trainer.limit_train_batches=0"], "trainer.limit_train_batches must be left out"),
        ([*BRIEF, "trainer.max_epochs=0"], "trainer.max_epochs must be -1"),
    ],
)
def test_runs_that_do_not_suit(overrides, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        StepBenchmark(1).run(tmp_path, overrides)
