"""Runs of variants, as the table of the paper's claims shows them."""

import csv
import json

import pytest
import yaml
from hydra import compose, initialize_config_dir

from gaigs.configuration import conf_dir
from gaigs.registry import registry
from gaigs.report.claims import interval, read_claims
from gaigs.report.multirun import report

EXPERIMENTS = {"claims": "spectrum", "claims_rssi": "rssi"}


def write_run(folder, variant, score=None, seed=0, task="spectrum", said="", **overrides):
    """A run of a variant, or one that has said something and ended without a result."""
    typed = [f"{key}={value}" for key, value in overrides.items()] + [f"+variant={variant}", f"seed={seed}"]
    own = folder / ",".join(typed)
    (own / ".hydra").mkdir(parents=True)
    (own / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(typed))
    (own / "gaigs.log").write_text(said)
    if score is None:
        return
    name = next(iter(registry("task").get(task).metrics()))
    metrics = {"task": task, "split": "official", "seed": seed, "device": "cpu"}
    metrics |= {"models": {"gaigs": {name: score}, "mean": {name: 0.5}}, "train_seconds": 9.0, "inference_ms": 2.0}
    (own / "metrics.json").write_text(json.dumps(metrics))


def read(folder):
    with open(folder / "claims.csv", newline="") as file:
        return list(csv.DictReader(file))


def row(folder, better, than):
    (found,) = (row for row in read(folder) if (row["better"], row["than"]) == (better, than))
    return found


# --- intervals ---


def test_an_interval_of_three_gains_by_hand():
    """Mean 2, sample deviation 1; t of two degrees of freedom is 4.302653, and 4.302653 / sqrt(3) is 2.484138."""
    assert interval([1.0, 2.0, 3.0]) == pytest.approx((2 - 2.484138, 2 + 2.484138), abs=1e-5)


def test_an_interval_of_two_gains_by_hand():
    """Mean 1, deviation sqrt(2), over sqrt(2) it is 1; t of one degree of freedom is 12.7062."""
    assert interval([0.0, 2.0]) == pytest.approx((1 - 12.7062, 1 + 12.7062), abs=1e-4)


def test_one_seed_has_no_interval(tmp_path):
    assert interval([0.3]) is None
    write_run(tmp_path, "paper", 0.9)
    write_run(tmp_path, "ga", 0.6)
    report(tmp_path)
    found = row(tmp_path, "paper", "ga")
    assert (found["low"], found["high"], found["seeds"], found["says"]) == ("", "", "1", "one seed")


@pytest.mark.parametrize(
    ("task", "paper", "other", "word"),
    [
        ("spectrum", [0.90, 0.80, 0.70], [0.80, 0.71, 0.60], "confirmed"),
        ("spectrum", [0.80, 0.71, 0.60], [0.90, 0.80, 0.70], "contradicted"),
        ("spectrum", [0.90, 0.80, 0.70], [0.80, 0.90, 0.70], "not seen"),
        ("rssi", [3.0, 4.0, 5.0], [4.0, 5.1, 6.0], "confirmed"),
        ("rssi", [4.0, 5.1, 6.0], [3.0, 4.0, 5.0], "contradicted"),
    ],
)
def test_a_word_follows_from_the_differences_of_each_seed(task, paper, other, word, tmp_path):
    """Seeds differ by more than variants do: paired, they do not hide what a variant changes."""
    for seed, (a, b) in enumerate(zip(paper, other, strict=True)):
        write_run(tmp_path, "paper", a, seed, task)
        write_run(tmp_path, "euclidean", b, seed, task)
    report(tmp_path)
    found = row(tmp_path, "paper", "euclidean")
    sign = 1 if task == "spectrum" else -1
    gains = [sign * (a - b) for a, b in zip(paper, other, strict=True)]
    assert float(found["gain"]) == pytest.approx(sum(gains) / 3)
    assert [float(found["low"]), float(found["high"])] == pytest.approx(interval(gains))
    assert (found["says"], found["seeds"]) == (word, "3")
    assert found["published gain"] == ("0.014" if task == "spectrum" else "")


# --- tables ---


@pytest.fixture
def sweep(tmp_path):
    """Two variants with three seeds and one that has lost a seed, one alone, one that failed."""
    for seed, (both, alone, few) in enumerate([(0.90, 0.60, 0.901), (0.91, 0.62, 0.899), (0.92, 0.61, None)]):
        write_run(tmp_path, "paper", both, seed)
        write_run(tmp_path, "ga", alone, seed)
        write_run(tmp_path, "anchors_4", few, seed, said="gaigs: the disk is full")
    write_run(tmp_path, "blocks_4", said="gaigs: the disk is full")
    write_run(tmp_path, "no_such", 0.9)
    return tmp_path


def test_the_table(sweep):
    *_, table = report(sweep).renderables
    first, *notes = (sweep / "claims.md").read_text().split("\n\n")
    lines = first.splitlines()
    assert lines[0] == "| claim | compared | score | published gain | with | without | ours | seeds | says |"
    assert lines[2:] == [
        "| both tokenizers beat geometric algebra alone | paper, ga | median SSIM | none | 0.910 | 0.610 | "
        "+0.300 (+0.275, +0.325) | 3 | confirmed |",
        "| 16 anchors beat 4 | paper, anchors_4 | median SSIM | none | 0.905 | 0.900 | +0.005 (-0.071, +0.081) | 2 | "
        "not seen |",
    ]
    assert "95%" in notes[0]
    assert '- 16 anchors beat 4: section "Multi-view Tokenizer", anchors stand for the scene\n' in notes[1]
    assert "- without a result: +variant=anchors_4,seed=2: the disk is full\n" in notes[1]
    assert "- without a result: +variant=blocks_4,seed=0: the disk is full\n" in notes[1]
    assert table.title == "Claims of the paper"
    assert [column.header for column in table.columns] == ["claim", "ours", "seeds", "says"]
    text = (sweep / "claims.tex").read_text()
    assert text.startswith("\\begin{tabular}{lcccccccc}\n\\toprule\nclaim & compared & score &")
    assert r"16 anchors beat 4 & paper, anchors\_4 & median SSIM &" in text


def test_runs_of_several_settings_are_not_mixed_and_seeds_in_pieces_are(tmp_path):
    for seed in range(3):
        for data, gap in (("room", 0.1), ("rfid", -0.1)):
            part = tmp_path / f"{data}{seed // 2}"  # the last seed came later, elsewhere
            write_run(part, "paper", 0.8 + 0.01 * seed, seed, data=data)
            write_run(part, "ga", 0.8 - gap, seed, data=data, threads=1 + seed)  # which changes no result
    write_run(tmp_path / "run twice", "paper", 0.1, 0, data="room")  # the one first by name counts
    report(tmp_path)
    found = {row["setting"]: row for row in read(tmp_path)}
    assert {setting: (row["says"], row["seeds"]) for setting, row in found.items()} == {
        "data=rfid": ("contradicted", "3"),
        "data=room": ("confirmed", "3"),
    }


def test_claims_of_several_tasks_are_one_table(tmp_path):
    for seed in range(2):
        for task in EXPERIMENTS.values():
            write_run(tmp_path / task, "paper", 3.0 + 0.01 * seed, seed, task, data=task)
            write_run(tmp_path / task, "ga", 4.0, seed, task, data=task)
    (table,) = report(tmp_path).renderables
    assert table.row_count == 2
    assert {row["score"]: row["says"] for row in read(tmp_path)} == {
        "MAE [dB]": "confirmed",
        "median SSIM": "contradicted",
    }


def test_runs_without_variants_make_no_claims(tmp_path):
    (tmp_path / "a/.hydra").mkdir(parents=True)
    (tmp_path / "a/.hydra/overrides.yaml").write_text(yaml.safe_dump(["tokenizer=ga"]))
    report(tmp_path)
    assert not [*tmp_path.glob("claims*")]


# --- what is claimed ---


def test_claims_are_of_variants_there_are():
    variants = {file.stem for file in (conf_dir() / "variant").glob("*.yaml")}
    claims = read_claims()
    assert {name for claim in claims for name in (claim.better, claim.than)} == variants
    for claim in claims:
        assert claim.published.keys() <= {*registry("task").names()}
        assert claim.source


@pytest.mark.parametrize(
    "broken",
    [
        "claims: 3", "claims: [{claim: a}]", "a: [", "3", "claims: [{claim: a, better: b, than: c, source: 4}]",
        "claims: [{claim: a, better: b, than: c, source: d, published: {spectrum: {gain: much, source: e}}}]",
    ],
)  # fmt: skip
def test_a_broken_list_of_claims_is_named(broken, tmp_path):
    file = tmp_path / "claims.yaml"
    file.write_text(broken)
    with pytest.raises(ValueError, match=r"claims\.yaml must have the form of conf/claims\.yaml: "):
        read_claims(file)


@pytest.mark.parametrize(("experiment", "task"), EXPERIMENTS.items())
def test_variants_differ_from_the_paper_in_one_thing(experiment, task):
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        params = compose("config", [f"+experiment={experiment}"], return_hydra_config=True).hydra.sweeper.params
        names = "".join(params["+variant"].split()).split(",")
        composed = {name: compose("config", [f"+variant={name}", f"+experiment={experiment}"]) for name in names}
    assert params["seed"] == "0,1,2"
    assert names[0] == "paper"
    paper = composed.pop("paper")
    assert paper.task.name == task
    assert len(paper.deformation.heads) == 5
    parts = {"tokenizer", "deformation", "projection", "pooling"}
    for name, config in composed.items():
        assert {key for key in paper if config[key] != paper[key]} - {"model"} <= parts
        assert sum(config[part] != paper[part] for part in parts) == 1, name
