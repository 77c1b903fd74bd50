"""Placement against brute force, integrals by scipy and simulated locations."""

import csv
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

import gaigs
from gaigs.calibration import Estimate
from gaigs.commands.place import figure
from gaigs.commands.place.objectives import Coverage, LocationError, MeanLevel, choose
from gaigs.commands.place.plan import candidate_places
from gaigs.core.geometry import Frame


class Room(gaigs.Model):
    """Levels that fall with the distance, by receivers anywhere, with a deviation."""

    def __init__(self, deviation=3.0, **scene):
        links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
        super().__init__(replace(links.scene, **scene))
        self.deviation = deviation

    def predict(self, places, receiver, frequency=None, interval=None):
        stand = receiver
        if isinstance(receiver, int):
            stand = self.scene.receivers[receiver].pose.position
        value = -45 - 35 * (places - stand.to(places)).norm(dim=-1).log10()
        return Estimate(value, torch.full_like(value, self.deviation), value, value)


def levels(receivers=9, places=30, seed=0):
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform(-95, -55, (receivers, places)))
    return means, torch.from_numpy(rng.uniform(2, 6, (receivers, places)))


def score(rule, numbers):
    return rule.quality(rule.factors(torch.tensor(numbers)).prod(0)).mean().item()


def rules(seed, receivers=9, count=30):
    """The objectives of receivers and places at random in a room."""
    rng = np.random.default_rng(seed)
    stands = torch.from_numpy(rng.uniform(0, (7, 5, 3), (receivers, 3)))
    places = torch.from_numpy(rng.uniform(0, (7, 5, 2), (count, 3)))
    means = -45 - 35 * torch.cdist(stands, places).log10()
    deviations = torch.from_numpy(rng.uniform(2, 6, means.shape))
    return (
        Coverage(means, deviations, -60.0),
        MeanLevel(means, deviations),
        LocationError(means, deviations, places),
    )


@pytest.mark.parametrize("kind", range(3), ids=["coverage", "mean", "locate"])
@pytest.mark.parametrize("standing", [0, 2])
def test_chosen_receivers_are_the_best_beside_those_that_stand(kind, standing):
    known = [*range(standing)]
    for seed in range(4):
        rule = rules(seed)[kind]
        chosen, qualities = choose(rule, standing, 2)
        scores = {
            extra: rule.sign * score(rule, [*known, *extra])
            for extra in itertools.combinations(range(standing, 9), 2)
        }
        got = scores[tuple(sorted(chosen.tolist()))]
        best = max(scores.values())
        assert got >= best - 0.005 * abs(best)
        # Each is the best of the chosen ones beside those before it.
        first = [rule.sign * score(rule, [*known, number]) for number in chosen]
        assert first[0] == max(first)
        assert rule.sign * qualities.mean(1)[1] == pytest.approx(first[0])


def test_one_by_one_is_not_always_best():
    # The first receiver covers two thirds; two others cover all together.
    means = torch.full((3, 6), -90.0, dtype=torch.float64)
    means[0, 1:5] = means[1, :3] = means[2, 3:] = -40.0
    rule = Coverage(means, torch.ones_like(means), -65.0)
    chosen, qualities = choose(rule, 0, 2)
    assert sorted(chosen.tolist()) == [1, 2]
    assert qualities.mean(1)[-1] == pytest.approx(100.0)
    assert choose(rule, 0, 1)[0].tolist() == [0]


def test_coverage_and_mean_level_are_those_of_the_best_of_independent_readings():
    means, deviations = levels(3, 4)
    readings = np.random.default_rng(0).normal(means, deviations, (200_000, 3, 4)).max(1)
    everyone = torch.arange(3)
    covered = Coverage(means, deviations, -70.0)
    chances = covered.quality(covered.factors(everyone).prod(0))
    np.testing.assert_allclose(chances, 100 * (readings > -70).mean(0), atol=0.4)
    mean = MeanLevel(means, deviations)
    best = mean.quality(mean.factors(everyone).prod(0))
    np.testing.assert_allclose(best, readings.mean(0), atol=0.05)


def test_location_errors_are_those_of_the_posterior_mean():
    axis = torch.linspace(0, 6, 25)
    places = torch.cartesian_prod(axis, axis, torch.tensor([1.0])).double()
    stands = torch.tensor([[0.0, 0, 2], [6, 0, 2], [2, 6, 2]]).double()
    means = -45 - 35 * torch.cdist(stands, places).log10()
    deviations = torch.full_like(means, 4.0)
    rng = np.random.default_rng(0)
    for count in (1, 2, 3):
        rule = LocationError(means[:count], deviations[:count], places)
        expected = score(rule, [*range(count)])
        errors = []
        for number in range(len(places)):
            readings = rng.normal(means[:count, number], 4.0, (20, count))
            likelihood = norm.logpdf(readings[..., None], means[None, :count], 4.0).sum(1)
            weights = np.exp(likelihood - likelihood.max(1, keepdims=True))
            guesses = weights @ places.numpy() / weights.sum(1, keepdims=True)
            squares = ((guesses - places[number].numpy()) ** 2).sum(1)
            errors.append(squares.mean() ** 0.5)
        assert expected == pytest.approx(np.mean(errors), rel=0.1)


def test_location_errors_are_the_bound_where_levels_are_linear():
    places = torch.zeros(801, 3, dtype=torch.float64)
    places[:, 0] = torch.linspace(-20, 20, 801)
    means = torch.stack((3 * places[:, 0], -4 * places[:, 0]))
    rule = LocationError(means, torch.full_like(means, 2.0), places)
    errors = rule.quality(rule.factors(torch.arange(2)).prod(0))
    assert errors[400].item() == pytest.approx(2.0 / 5.0, rel=1e-3)  # Fisher information 25 / 4


def test_known_receivers_count():
    room = Room()
    beside = torch.stack([own.pose.position for own in room.scene.receivers]) + 0.05
    far = torch.tensor([[3.5, 2.5, 1.2]])
    candidates = torch.cat((beside, far))
    plan = gaigs.place(room, candidates, 1, threshold=-50.0)
    assert torch.equal(plan.places, far)
    assert torch.equal(plan.standing, room.scene.positions(far))
    alone = gaigs.place(room, candidates, 5, threshold=-50.0, known=False)
    assert alone.scores[0] == 0
    assert len(alone.standing) == 0
    assert alone.places.unique(dim=0).shape == (5, 3)
    assert (alone.scores.diff() > 0).all()
    assert re.fullmatch(r"5 bring \d+\.\d % above -50 dBm", str(alone))
    mean = gaigs.place(room, candidates, 1, "mean", known=False)
    assert re.fullmatch(r"1 brings the mean best level to -\d+\.\d dBm", str(mean))


@pytest.mark.parametrize(
    ("objective", "text"),
    [
        ("coverage", r"2 more bring \d+\.\d to \d+\.\d % above -55 dBm"),
        ("mean", r"2 more bring the mean best level from -\d+\.\d to -\d+\.\d dBm"),
        ("locate", r"2 more bring the expected error of locations from \d\.\d\d to \d\.\d\d m"),
    ],
)
def test_a_plan_is_a_sentence_a_table_and_a_picture(objective, text, tmp_path):
    room = Room(frame=Frame(32632, 500_000.0, 5_400_000.0))
    region = [[0.5, 0.5, 1.2], [6.5, 4.5, 1.2]]
    plan = gaigs.place(room, 4.0, 2, objective, -55.0, region)
    assert re.fullmatch(text, str(plan))
    plan.save(tmp_path / "place.csv")
    rows = [*csv.reader((tmp_path / "place.csv").read_text().splitlines())]
    assert rows[0] == ["use", "x", "y", "z", "easting", "northing", objective]
    assert [row[0] for row in rows[1:]] == ["stands"] * 4 + ["place"] * 2
    assert float(rows[-1][4]) == pytest.approx(500_000 + plan.places[1, 0].item(), abs=1e-3)
    assert float(rows[-1][-1]) == pytest.approx(plan.scores[2].item(), rel=1e-4)
    axes = figure(plan).axes
    assert len(axes) == 3
    assert axes[1].get_title().startswith("with the new ones")
    assert len(figure(gaigs.place(room, 4.0, 1, objective, region=region, known=False)).axes) == 2


def test_trained_models_place_receivers_or_say_that_they_cannot():
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0)
    plan = gaigs.place(gaigs.train("path_loss", links), 2.0, 1, "mean")
    assert plan.scores[1] > plan.scores[0]
    assert len(plan.standing) == 4
    with pytest.raises(ValueError, match="predicts for its own receivers alone"):
        gaigs.place(gaigs.train("knn", links), 2.0)


def test_candidates_stand_along_the_walls():
    scene = Room().scene
    lower, upper = scene.box
    for spacing, count in ((None, 64), (2.0, 12)):
        places = candidate_places(scene, spacing)
        assert len(places) == count
        is_on_side = (places[:, :2] - lower[:2]).abs().amin(1) < 1e-5
        is_on_side |= (places[:, :2] - upper[:2]).abs().amin(1) < 1e-5
        assert is_on_side.all()
        assert (places[:, 2] == scene.positions(places)[:, 2].median()).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "cover"}, r"objective must be one of coverage, mean, locate, got 'cover'"),
        ({"count": 0}, "count must be 1 to 64, the candidates, got 0"),
        ({"count": 65}, "count must be 1 to 64, the candidates, got 65"),
        ({"threshold": float("nan")}, "threshold must be a finite level"),
        ({"candidates": 0}, "candidates must be .* m apart or more, got 0 m"),
        ({"candidates": [[1.0, 2.0]]}, "candidates must be"),
        ({"region": [[1.0, 2.0, 3.0]]}, "region must be two corners"),
    ],
)
def test_impossible_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        gaigs.place(Room(), **options)


def test_labels_must_be_levels():
    task = gaigs.links("synthetic", transmitters=10, order=0).task
    with pytest.raises(ValueError, match="a placement takes a model of one real number a link"):
        gaigs.place(Room(task=task))


def test_the_command_reads_candidates_of_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gaigs.commands.place.load", lambda folder, trust: Room())
    (tmp_path / "sites.csv").write_text("x,y,z\n3.5,2.5,2.9\n0.5,0.5,2.9\n")
    words = "command=place", "folder=room", f"place.candidates={tmp_path}/sites.csv"
    gaigs.run(gaigs.compose(*words, "place.objective=mean"), tmp_path / "place")
    assert "1 more brings the mean best level from" in capsys.readouterr().out
    assert {file.name for file in (tmp_path / "place").iterdir()} == {"place.csv", "place.png"}
    with pytest.raises(ValueError, match="add folder=runs"):
        gaigs.run(gaigs.compose("command=place"), tmp_path / "place")
