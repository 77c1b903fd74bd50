"""The parts of a training step."""

import csv

import pytest

from gaigs.benchmark import UNAVAILABLE, Context
from gaigs.benchmark._watch import PARTS
from gaigs.benchmark.step import WHOLE, StepBenchmark
from gaigs.rasterizer import torch as eager

BRIEF = (
    "data.transmitters=12", "data.order=0", "gaussians.count=10", "training.batch_size=3", "training.thinning.stride=8",
    "tokenizer=euclidean",
)  # fmt: skip


@pytest.mark.parametrize("overrides", [(), ("trainer.max_steps=-1", "trainer.max_time=00:00:00:00")])
def test_a_step_is_divided(tmp_path, overrides):
    context = Context(overrides=(*BRIEF, *overrides))
    StepBenchmark(["torch", "aperture"], repeats=2).run(tmp_path, context)
    with open(tmp_path / "step.csv", newline="") as file:
        rows = {(row["rasterizer"], row["part"]): row for row in csv.DictReader(file)}
    assert len(rows) == 2 * (len(PARTS) + 1)
    assert rows["aperture", WHOLE]["status"].startswith(f"{UNAVAILABLE}aperture draws no map")
    own = {part: row for (name, part), row in rows.items() if name == "torch"}
    assert own[WHOLE] | {"repeats": "2", "gaussians": "10", "places": "3", "share": "1"} == own[WHOLE]
    parts = {part: float(row["ms"]) for part, row in own.items()}
    assert all(milliseconds > 0 for milliseconds in parts.values())
    page = (tmp_path / "step.md").read_text()
    assert f"python -m gaigs command=benchmark benchmark=step {' '.join((*BRIEF, *overrides))}\n" in page
    assert "| backward: rasterizer |" in page
    assert eager._Tiles.__init__.__qualname__ == "_Tiles.__init__"


def test_a_model_without_maps_is_told(tmp_path):
    with pytest.raises(
        ValueError, match=r"benchmark=step needs a model .* got model=mirrored with rasterizer=aperture"
    ):
        StepBenchmark(["torch"]).run(tmp_path, Context(overrides=("+experiment=mirrored",)))


def test_data_of_another_task_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"labels of data 'synthetic' are of task 'spectrum'.*; add task=spectrum"):
        StepBenchmark(["torch"]).run(tmp_path, Context(overrides=(*BRIEF[:2], "task=rssi")))


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("+trainer.limit_train_batches=0", "trainer.limit_train_batches must be left out"),
        ("+trainer.fast_dev_run=true", "trainer.fast_dev_run must be left out"),
        ("trainer.max_epochs=0", "trainer.max_epochs must be -1"),
    ],
)
def test_options_that_would_leave_steps_out_are_refused(word, told, tmp_path):
    with pytest.raises(ValueError, match=told):
        StepBenchmark(["torch"], 1).run(tmp_path, Context(overrides=(*BRIEF, word)))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rasterizers": []}, r"benchmark\.rasterizers must have at least one of "),
        ({"rasterizers": ["torhc"]}, r"benchmark\.rasterizers has 'torhc' \(did you mean 'torch'\?\)"),
        ({"rasterizers": ["torch"], "repeats": 0}, r"benchmark\.repeats must be at least 1, got 0"),
    ],
)
def test_options_that_do_not_suit(options, told):
    with pytest.raises(ValueError, match=told):
        StepBenchmark(**options)
