"""Runs of variants, as the table of the paper's claims shows them."""

import pytest
import yaml
from claims import compare, interval, main, read_claims, write_claims
from folders import read, write_run
from hydra import compose, initialize_config_dir

from gaigs.configuration import conf_dir
from gaigs.registry import registry
from gaigs.report.run_folders import read_runs


def write_variant(folder, variant, score=None, seed=0, task="spectrum", log="", **overrides):
    """A run of a variant, or one that has logged something and has no result."""
    typed = [
        *(f"{key}={value}" for key, value in overrides.items()),
        f"+variant={variant}",
        f"seed={seed}",
    ]
    name = next(iter(registry("task").get(task).metrics()))
    models = None if score is None else {"gaigs": {name: score}, "mean": {name: 0.5}}
    write_run(folder / ",".join(typed), typed, models, task, log, seed=seed)


def found(folder):
    """Rows of the table by their variants."""
    return {(row["better"], row["than"]): row for row in compare(read_runs(folder), read_claims())}


# --- intervals ---


def test_an_interval_of_three_gains_by_hand():
    """Mean 2, sample deviation 1; t of two degrees of freedom is 4.302653, and 4.302653 / sqrt(3)
    is 2.484138.
    """
    assert interval([1.0, 2.0, 3.0]) == pytest.approx((2 - 2.484138, 2 + 2.484138), abs=1e-5)


def test_one_seed_has_no_interval(tmp_path):
    write_variant(tmp_path, "paper", 0.9)
    write_variant(tmp_path, "ga", 0.6)
    main([str(tmp_path)])
    (row,) = read(tmp_path / "claims.csv")
    assert (row["low"], row["high"], row["seeds"], row["says"]) == ("", "", "1", "one seed")


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
def test_the_verdict_on_a_claim_follows_from_paired_seeds(task, paper, other, word, tmp_path):
    """Seeds differ by more than variants do: paired seeds show the effect of a variant."""
    for seed, (a, b) in enumerate(zip(paper, other, strict=True)):
        write_variant(tmp_path, "paper", a, seed, task)
        write_variant(tmp_path, "euclidean", b, seed, task)
    row = found(tmp_path)["paper", "euclidean"]
    sign = 1 if task == "spectrum" else -1
    gains = [sign * (a - b) for a, b in zip(paper, other, strict=True)]
    assert row["gain"] == pytest.approx(sum(gains) / 3)
    assert (row["low"], row["high"]) == pytest.approx(interval(gains))
    assert (row["says"], row["seeds"]) == (word, 3)
    assert row["published gain"] == (0.014 if task == "spectrum" else None)


# --- tables ---


@pytest.fixture
def sweep(tmp_path):
    """Two variants with three seeds and one that has lost a seed, one alone, one that failed."""
    for seed, (both, alone, few) in enumerate(
        [(0.90, 0.60, 0.901), (0.91, 0.62, 0.899), (0.92, 0.61, None)]
    ):
        write_variant(tmp_path, "paper", both, seed)
        write_variant(tmp_path, "ga", alone, seed)
        write_variant(tmp_path, "anchors_4", few, seed, log="gaigs: the disk is full")
    write_variant(tmp_path, "blocks_4", log="gaigs: the disk is full")
    write_variant(tmp_path, "no_such", 0.9)
    return tmp_path


def test_the_table(sweep):
    table = write_claims(sweep, read_runs(sweep))
    first, *notes = (sweep / "claims.md").read_text().split("\n\n")
    lines = first.splitlines()
    assert (
        lines[0]
        == "| claim | compared | score | published gain | with | without | ours | seeds | says |"
    )
    assert lines[2:] == [
        "| both tokenizers beat geometric algebra alone | paper, ga | median SSIM | none | 0.910 | "
        "0.610 | "
        "+0.300 (+0.275, +0.325) | 3 | confirmed |",
        "| 16 anchors beat 4 | paper, anchors_4 | median SSIM | none | 0.905 | 0.900 | +0.005 "
        "(-0.071, +0.081) | 2 | "
        "not seen |",
    ]
    assert "95%" in notes[0]
    assert (
        '- 16 anchors beat 4: section "Multi-view Tokenizer", anchors stand for the scene\n'
        in notes[1]
    )
    assert "- without a result: +variant=anchors_4,seed=2: the disk is full\n" in notes[1]
    assert "- without a result: +variant=blocks_4,seed=0: the disk is full\n" in notes[1]
    assert table.title == "Claims of the paper"
    assert [column.header for column in table.columns] == ["claim", "ours", "seeds", "says"]


def test_seeds_of_one_setting_are_joined_and_settings_kept_apart(tmp_path):
    for seed in range(3):
        for data, gap in (("room", 0.1), ("rfid", -0.1)):
            part = tmp_path / f"{data}{seed // 2}"  # the last seed came later, elsewhere
            write_variant(part, "paper", 0.8 + 0.01 * seed, seed, data=data)
            write_variant(
                part, "ga", 0.8 - gap, seed, data=data, threads=1 + seed
            )  # which changes no result
    write_variant(
        tmp_path / "run twice", "paper", 0.1, 0, data="room"
    )  # the one first by name counts
    rows = compare(read_runs(tmp_path), read_claims())
    assert {row["setting"]: (row["says"], row["seeds"]) for row in rows} == {
        "data=rfid": ("contradicted", 3),
        "data=room": ("confirmed", 3),
    }


def test_claims_of_several_tasks_are_one_table(tmp_path):
    for seed in range(2):
        for task in ("spectrum", "rssi"):
            write_variant(tmp_path / task, "paper", 3.0 + 0.01 * seed, seed, task, data=task)
            write_variant(tmp_path / task, "euclidean", 4.0, seed, task, data=task)
    table = write_claims(tmp_path, read_runs(tmp_path))
    assert table.row_count == 2
    assert {row["score"]: row["says"] for row in read(tmp_path / "claims.csv")} == {
        "MAE [dB]": "confirmed",
        "median SSIM": "contradicted",
    }
    assert "- published gain +0.014: 0.91 of GAI-GS" in (tmp_path / "claims.md").read_text()


def test_a_folder_without_two_variants_is_refused(tmp_path, capsys):
    for what in ("must hold runs, each with its", "must hold runs of two variants"):
        with pytest.raises(SystemExit, match="2"):
            main([str(tmp_path)])
        assert what in " ".join(capsys.readouterr().err.split())
        write_variant(tmp_path / what, "paper", 0.9)


# --- the list of claims ---


def test_claims_name_the_variants_of_conf():
    variants = {file.stem for file in (conf_dir() / "variant").glob("*.yaml")}
    claims = read_claims()
    assert {name for claim in claims for name in (claim.better, claim.than)} == variants
    for claim in claims:
        assert claim.published.keys() <= {*registry("task").names()}
        assert claim.source


PARTS = {"tokenizer", "deformation", "projection", "pooling"}


@pytest.mark.parametrize(("experiment", "task"), [("claims", "spectrum"), ("claims_rssi", "rssi")])
def test_variants_differ_from_the_paper_in_one_thing(experiment, task):
    """By their files; the last one is composed, too."""
    params = yaml.safe_load((conf_dir() / "experiment" / f"{experiment}.yaml").read_text())[
        "hydra"
    ]["sweeper"]["params"]
    first, *names = "".join(params["+variant"].split()).split(",")
    assert first == "paper"
    for name in names:
        content = yaml.safe_load((conf_dir() / "variant" / f"{name}.yaml").read_text())
        base, *others = content.pop("defaults")
        overridden = [
            key.removeprefix("override /")
            for entry in (base, *others)
            if isinstance(entry, dict)
            for key in entry
        ]
        assert (base == "paper") != (name == "static"), "static Gaussians have no heads"
        assert len([*content, *overridden]) == 1, name
        assert {*content, *overridden} <= PARTS
        if "heads" in content.get("deformation", {}):
            assert len(content["deformation"]["heads"]) == 4
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        paper, config = (
            compose("config", [f"+variant={name}", f"+experiment={experiment}"])
            for name in (first, name)
        )
    assert paper.task.name == task
    assert len(paper.deformation.heads) == 5
    assert len([key for key in paper if config[key] != paper[key] and key in PARTS]) == 1
    assert {key for key in paper if config[key] != paper[key]} - {"model"} <= PARTS
