"""The smallest value that is good enough, of rows that were made up, and of two that were trained."""

import pytest

from gaigs import evaluation
from gaigs.benchmark import Context
from gaigs.benchmark._scale import scale_of
from gaigs.benchmark.budgets import Budgets, size, smallest_within

ROW = dict.fromkeys(("scene", "trainer", "curve", "test"), "") | {
    "of": "model=gaigs",
    "device": "cpu",
    "split": "official",
}
ROW |= {"status": "measured", "inference_ms": "3", "train_seconds": "20"}


def rows(scores, task="spectrum", axis="Gaussians", key="gaussians.count", default="300"):
    own = ROW | {"task": task, "axis": axis, "key": key, "default": default}
    return [own | {"value": value, "validation": str(score)} for value, score in scores.items()]


def budgets(factors=(0.25, 1, 2), axes=None):
    return Budgets({}, axes or {}, [*factors], {"ratio": 0.005, "dB": 0.05})


@pytest.mark.parametrize(
    ("task", "scores", "smallest"),
    [
        ("spectrum", {"600": 0.903, "300": 0.9, "150": 0.898, "75": 0.89}, "150"),  # at the bound
        ("spectrum", {"75": 0.91, "300": 0.9}, "75"),
        ("spectrum", {"75": 0.8, "300": 0.9}, "300"),
        ("rssi", {"15": 4.06, "30": 4.04, "60": 4.0}, "30"),
        ("rssi", {"15": 4.0, "60": 4.6}, "15"),
        ("csi", {"[8,16]": 9.0, "[16,32]": 9.04, "[4,8]": 8.0}, "[8,16]"),
    ],
)
def test_the_smallest_within_the_tolerance_is_taken(task, scores, smallest):
    tolerance = 0.005 if task == "spectrum" else 0.05
    assert smallest_within(rows(scores, task), tolerance, scale_of(task))["value"] == smallest


def test_a_table_tells_values_and_what_is_small_enough():
    seeds = rows({"0": 0.9, "1": 0.904, "2": 0.893}, axis="seed of gaigs", key="seed", default="0")
    text = budgets().tables([*seeds, *rows({"600": 0.903, "300": 0.9, "75": 0.89})])
    assert "Seeds 0, 1, 2 score 0.900, 0.904, 0.893: they scatter by 0.0110, beyond the tolerance." in text
    head = "| part | key | mean SSIM of the validation links by value | smallest within 0.005 | default now |"
    assert head in text
    assert "| Gaussians | `gaussians.count` | 75: 0.890, 300: 0.900, 600: 0.903 | **300** | 300 | 3.00, 3.00 |" in text


def test_dbs_have_a_tolerance_of_their_own():
    text = budgets().tables(rows({"30": 4.04, "60": 4.0}, "rssi", default="60"))
    assert "MAE [dB] of the validation links by value | smallest within 0.05 dB |" in text
    assert "| 30: 4.04, 60: 4.00 | **30** | 60 |" in text


def test_sections_tell_their_data():
    scenes = [
        row | {"scene": scene} for scene in ("", "data.root=x#0a1b2c seed=1") for row in rows({"300": 0.9, "600": 0.92})
    ]
    text = budgets().tables(scenes)
    titles = [line for line in text.splitlines() if line.startswith("### ")]
    (split,) = {row["split"] for row in scenes}
    assert titles == [f"### spectrum, split {split}", f"### spectrum, data.root=x seed=1, split {split}"]
    assert "benchmark=budgets data.root=x seed=1\n" in text


def test_the_largest_tried_is_told():
    assert "| **600**, the largest tried | 300 |" in budgets().tables(rows({"300": 0.9, "600": 0.92}))


def test_test_links_have_no_say():
    scores = rows({"75": 0.8, "300": 0.9})
    scores[0]["test"], scores[1]["test"] = "0.99", "0.1"
    assert "**300**" in budgets().tables(scores)


def test_a_unit_without_a_tolerance_is_refused():
    with pytest.raises(ValueError, match=r"benchmark.tolerance must have the unit 'dB' of MAE \[dB\]"):
        Budgets({}, {}, [1], {"ratio": 0.005}).tables(rows({"30": 4.0}, "rssi"))


@pytest.mark.parametrize(
    ("default", "values"),
    [(300, [75, 300, 600]), (1, [1, 2]), ([4, 8], [[1, 2], [4, 8], [8, 16]]), ([1, 2], [[1, 1], [1, 2], [2, 4]])],
)
def test_values_stand_about_the_default(default, values):
    assert budgets().values_about("width", default) == values


def test_defaults_that_are_no_numbers_need_values():
    with pytest.raises(ValueError, match=r"benchmark.axes.tokenizer needs values"):
        budgets(axes={"tokenizer": {"of": [], "key": "tokenizer"}}).values_about("tokenizer", "multiview")


@pytest.mark.parametrize("value", ["ga", None, True, [], [4, "wide"]])
def test_values_that_are_no_sizes_are_refused_before_any_training(value):
    with pytest.raises(TypeError, match=r"benchmark\.axes\.part\.values must be sizes, numbers or lists of them, got"):
        budgets(axes={"part": {"of": [], "key": "gaussians.count", "values": [3, value]}})


@pytest.mark.parametrize("key", ["tokenizer", "trainer.precision", "data.name"])
def test_defaults_that_are_no_sizes_are_refused_before_any_training(key, tmp_path):
    benchmark = budgets(axes={"part": {"of": [], "key": key, "values": [1]}})
    with pytest.raises(ValueError, match=rf"benchmark\.axes\.part\.key must be that of a size, .* and {key} is "):
        benchmark.run(tmp_path, Context(("data.transmitters=20",)))
    assert not (tmp_path / "budgets").exists()


@pytest.mark.parametrize("axis", [{"key": ".."}, {"of": ["modl=gaigs"]}, {"of": ["model=["]}], ids=str)
def test_an_axis_that_cannot_be_read_is_named(axis, tmp_path):
    benchmark = budgets(axes={"part": {"of": [], "key": "gaussians.count", "values": [1]} | axis})
    with pytest.raises(
        ValueError, match=r"^benchmark\.axes\.part must have overrides and a key of a run, .* mend them$"
    ):
        benchmark.run(tmp_path, Context(("data.transmitters=20",)))


@pytest.mark.parametrize(("value", "number"), [("300", 300), ("[4,8]", 32), ("0.5", 0.5)])
def test_sizes_of_values(value, number):
    assert size(value) == number


@pytest.mark.parametrize("value", ["multiview", "[a]", "null", "[4,wide]"])
def test_what_is_no_size_is_none(value):
    with pytest.raises((TypeError, ValueError)):
        size(value)


def test_values_are_trained_and_axes_that_do_not_apply_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "write_figures", lambda *_: None)
    axes = {"Gaussians": {"of": ["model=gaigs"], "key": "gaussians.count"}, "grid": {"of": [], "key": "pooling.grid"}}
    tiny = ("data.transmitters=20", "tokenizer=euclidean", "rasterizer=torch", "gaussians.count=8")
    tiny += ("trainer.max_steps=2", "trainer.val_check_interval=1", "trainer.log_every_n_steps=1")
    tiny += ("trainer.enable_progress_bar=false", "training.batch_size=8", "training.thinning.stride=8")
    budgets((0.5, 1), axes).run(tmp_path, Context(tiny))
    text = (tmp_path / "budgets.md").read_text()
    assert "| Gaussians | `gaussians.count` | 4: " in text
    assert ", 8: " in text
    assert "pooling.grid" not in text
