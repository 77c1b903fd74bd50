"""Survey plans against covariances by numpy, and against places drawn at random."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

import gaigs
from gaigs.commands.survey import figure
from gaigs.commands.survey.area import read_area
from gaigs.commands.survey.measured import measured_places
from gaigs.commands.survey.plan import Selection, Spacing, SurveyPlaces, mean_absolute
from gaigs.commands.survey.processes import posterior, reception_chances, with_trend
from gaigs.core.geometry import Frame, even_places
from gaigs.kriging.kernel import Process
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions

MEAN = mean_absolute(1.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8))


def fitted(links):
    """A Gaussian process without intervals: ``gaigs.train`` fits one for each fold, too."""
    model = gaigs.registries["model"].build({"name": "gaussian_process"}, scene=links.scene)
    model.fit(links)
    return model


def process(seed=0, known=12, noise=0.3):
    rng = np.random.default_rng(seed)
    places = torch.from_numpy(rng.uniform(0, 4, (known, 3)))

    def covariances(a, b):
        return 4 * torch.from_numpy(np.exp(-cdist(a, b) / 1.5))

    return Process(covariances, places, torch.full((known,), noise, dtype=torch.float64), noise)


def asked_places(count=60):
    rng = torch.Generator().manual_seed(0)
    return 4 * torch.rand(count, 3, dtype=torch.float64, generator=rng)


def variances(process, rows, asked):
    """Variances at places given some of the known readings, in numpy."""
    places, cover = process.places[rows], lambda a, b: process.covariances(a, b).numpy()
    own = cover(places, places) + np.diag(process.noises[rows])
    return np.diag(
        cover(asked, asked) - cover(asked, places) @ np.linalg.solve(own, cover(places, asked))
    )


def test_covariances_are_those_given_the_readings():
    own, asked = process(), asked_places(5)
    np.testing.assert_allclose(
        posterior(own, asked).diagonal(), variances(own, range(12), asked), atol=1e-9
    )


def test_losses_are_those_of_leaving_a_place_out():
    own, asked = process(noise=1.0), asked_places()
    known, _, losses, superfluous = measured_places([own], asked, MEAN)

    def error(rows):
        return MEAN * np.sqrt(variances(own, rows, asked) + own.noise).mean()

    every = error(range(12))
    for place, loss in zip(known, losses, strict=True):
        kept = (own.places.float() != place).any(1).nonzero()[:, 0]
        assert loss.item() == pytest.approx(error(kept) - every, rel=0.15)
    kept = [i for i in range(12) if not superfluous[(known == own.places[i].float()).all(1)]]
    assert error(kept) <= 1.05 * every
    assert 0 < superfluous.sum() < 12


def test_each_place_lowers_the_mean_variance_most():
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    model = fitted(links)
    candidates = torch.rand(12, 3, generator=torch.Generator().manual_seed(0)) * 3
    box = candidates.amin(0), candidates.amax(0)
    plan = gaigs.survey(model, region=torch.stack(box), count=2, candidates=candidates)
    centres, asked = links.scene.positions(candidates.double()), even_places(*box, 1000).double()
    processes = [with_trend(model.process_at(receiver), centres[receiver]) for receiver in range(4)]
    known = []
    for place in plan.places:
        means = []
        for candidate in candidates:
            parts = []
            for own in processes:
                extra = torch.stack([*known, candidate]).double()
                noises = torch.cat(
                    (own.noises, torch.full((len(extra),), own.noise, dtype=torch.float64))
                )
                more = replace(own, places=torch.cat((own.places, extra)), noises=noises)
                parts.append(variances(more, range(len(more.places)), asked).mean())
            means.append(np.mean(parts))
        assert torch.equal(candidates[int(np.argmin(means))], place)
        known.append(place)
    assert (plan.errors.diff() < 0).all()


def test_a_receiver_counts_where_it_is_likely_to_be_heard():
    near, far = (
        torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * 3 + x for x in (0.0, 9.0)
    )
    both, first = process(), process()
    both, first = (
        replace(own, places=part.double(), noises=torch.full((len(part),), 0.3))
        for own, part in ((both, torch.cat((near, far))), (first, near))
    )
    hearing = reception_chances([both, first], torch.cat((near[:5], far[:5])).double())
    assert (hearing[0] == 1).all()
    assert (hearing[1, :5] > 0.9).all()
    assert (hearing[1, 5:] < 0.1).all()
    # Of a part of its readings, places do not tell.
    first = replace(first, is_part=True)
    assert reception_chances([both, first], far[:5].double())[1].min() > 0.9


def test_plans_count_a_receiver_where_it_is_heard():
    """One receiver is heard at x < 5 alone: plans do not go where it is unknown, and the error
    leaves it out there.
    """
    rng = torch.Generator().manual_seed(0)
    places = torch.rand(80, 3, generator=rng) * torch.tensor([10.0, 4.0, 1.0])
    labels = -50 + 4 * torch.randn(80, 2, generator=rng)
    labels[places[:, 0] > 5, 1] = torch.nan
    stands = torch.tensor([[0.0, 0, 2], [10, 4, 2]])
    model = fitted(
        gaigs.links(
            task="rssi", transmitters=places, receivers=stands, labels=labels, split="random"
        )
    )
    region = torch.stack((places.amin(0), places.amax(0)))
    plan = gaigs.survey(model, region=region, count=6, stop=0.0)
    assert (plan.places[:, 0] < 6).sum() >= 4
    asked, stands = even_places(*region, 1000).double(), model.scene.positions(places.double())
    processes = [with_trend(model.process_at(k), stands[k]) for k in range(2)]
    deviations = [(posterior(own, asked).diagonal() + own.noise).sqrt() for own in processes]
    left, right = asked[:, 0] < 4, asked[:, 0] > 6
    parts = (
        torch.cat((deviations[0], deviations[1][left])),
        torch.cat((deviations[0], deviations[1][left | right])),
    )
    heard, all_over = (MEAN * part.mean() for part in parts)
    assert abs(plan.errors[0] - heard) < 0.3 * (all_over - heard)
    assert plan.losses[plan.known[:, 0] > 6].mean() < plan.losses[plan.known[:, 0] < 4].mean()


def test_planned_places_are_worth_more_than_random_ones():
    links = gaigs.links("synthetic", transmitters=200, order=1)
    split, places = links.split, links.query.transmitters
    train = torch.cat((split.train, split.validation))
    order = places[train][torch.randperm(len(train), generator=torch.Generator().manual_seed(1))]

    def trained(chosen):
        rows = train[(places[train][:, None] == chosen).all(-1).any(1)]
        known = replace(links, split=replace(split, train=rows, validation=rows[:0]))
        return fitted(known), known

    first, _ = trained(order[:15])
    plan = gaigs.survey(first, count=25, candidates=order[15:])
    planned, random = (
        gaigs.evaluate(*trained(chosen), []).models["gaussian_process"]["ssim_mean"]
        for chosen in (torch.cat((order[:15], plan.places)), order[:40])
    )
    assert planned > random + 0.01


def test_first_places_lie_nearer_to_the_region_than_random_ones():
    candidates = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [8.0, 5.0, 0.5]
    )

    def apart(places):
        return torch.cdist(candidates, places).amin(1).mean()

    plan = gaigs.survey(candidates=candidates, count=20)
    assert apart(plan.places) < 0.9 * min(
        apart(candidates[20 * k : 20 * k + 20]) for k in range(20)
    )
    assert torch.equal(gaigs.survey(candidates=candidates, count=8).places, plan.places[:8])


def test_places_that_the_trend_needs_are_not_superfluous():
    rng = torch.Generator().manual_seed(0)
    places, gateway = 8 * torch.rand(50, 3, generator=rng), torch.tensor([0.0, 0.0, 2.0])
    labels = -40 - 30 * (places - gateway).norm(dim=1).log10() + 2 * torch.randn(50, generator=rng)
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=gateway[None], labels=labels[:, None]
    )
    plan = gaigs.survey(fitted(links), count=1)
    kept = plan.known[~plan.superfluous]
    assert len(kept) >= 6
    apart = (kept - gateway).norm(dim=1).log10()
    assert apart.max() - apart.min() > 0.3


def test_plans_are_written_and_wrong_ones_are_refused(tmp_path):
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    model = fitted(links)
    plan = gaigs.survey(model, count=4)
    plan.save(tmp_path / "survey.csv")
    lines = (tmp_path / "survey.csv").read_text().splitlines()
    assert lines[0] == "use,x,y,z,mean_error"
    assert [line.split(",")[0] for line in lines[1:]] == ["measure"] * 4 + ["leave out"] * int(
        plan.superfluous.sum()
    )
    assert str(plan).startswith("4 more places bring the expected mean error from ")
    replace(plan, frame=Frame(32632, 5e5, 5.4e6)).save(tmp_path / "survey.csv")
    with (tmp_path / "survey.csv").open() as text:
        first = next(csv.DictReader(text))
    np.testing.assert_allclose(float(first["easting"]) - 5e5, float(first["x"]), atol=2e-3)
    np.testing.assert_allclose(float(first["northing"]) - 5.4e6, float(first["y"]), atol=2e-3)
    with pytest.raises(ValueError, match="count must be at least 1"):
        gaigs.survey(model, count=0)
    with pytest.raises(ValueError, match="candidates, got 0"):
        gaigs.survey(model, candidates=torch.zeros(0, 3))
    with pytest.raises(ValueError, match="stop must be a share"):
        gaigs.survey(model, stop=1.0)
    with pytest.raises(ValueError, match="carrier in Hz"):
        gaigs.survey(model, frequency=2.4)
    with pytest.raises(ValueError, match="two corners"):
        gaigs.survey(model, region=[[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="model 'mean' has no Gaussian process over places"):
        gaigs.survey(gaigs.train("mean", links))


def test_the_command_plans_by_a_finished_run(tmp_path, capsys):
    words = (
        "+experiment=rssi",
        "model=gaussian_process",
        "data.transmitters=40",
        "data.order=0",
        "baselines=[]",
    )
    gaigs.run(gaigs.compose(*words), tmp_path / "run")
    gaigs.run(
        gaigs.compose("command=survey", f"folder={tmp_path / 'run'}", "survey.count=2"),
        tmp_path / "plan",
    )
    assert {path.name for path in (tmp_path / "plan").iterdir()} == {"survey.csv", "survey.png"}
    assert str(gaigs.survey(gaigs.load(tmp_path / "run"), count=2)) in capsys.readouterr().out
    with pytest.raises(FileNotFoundError, match="holds no run"):
        gaigs.run(gaigs.compose("command=survey", f"folder={tmp_path}"), tmp_path / "plan")
    with pytest.raises(ValueError, match="takes a region or candidates, got neither"):
        gaigs.run(gaigs.compose("command=survey"), tmp_path / "plan")


def test_the_command_plans_before_anything_is_measured(tmp_path, capsys):
    gaigs.run(
        gaigs.compose("command=survey", "survey.region=[[0,0,1],[6,4,1]]", "survey.count=3"),
        tmp_path,
    )
    assert (tmp_path / "survey.png").is_file()
    lines = (tmp_path / "survey.csv").read_text().splitlines()
    assert len(lines) == 4
    assert all(line.startswith("measure,") and line.endswith(",") for line in lines[1:])
    assert "without a trained model their error is unknown" in capsys.readouterr().out
    (tmp_path / "places.csv").write_text("x,y,z\n0,0,1\n6,4,1\n6,0,1\n")
    gaigs.run(
        gaigs.compose("command=survey", f"survey.candidates={tmp_path / 'places.csv'}"), tmp_path
    )
    assert sorted(line.split(",")[1:3] for line in (tmp_path / "survey.csv").read_text().splitlines()[1:]) == [
        ["0.000", "0.000"], ["6.000", "0.000"], ["6.000", "4.000"],
    ]  # fmt: skip


def test_losses_are_those_of_leaving_all_readings_of_a_place_out():
    own, asked = process(noise=1.0), asked_places()
    often = torch.tensor([0] * 8 + [1] * 3 + list(range(2, 12)))
    own = replace(own, places=own.places[often], noises=own.noises[often])
    known, _, losses, _ = measured_places([own], asked, MEAN)

    def error(rows):
        return MEAN * np.sqrt(variances(own, rows, asked) + own.noise).mean()

    for place, loss in zip(known, losses, strict=True):
        rows = [
            row
            for row, there in enumerate(own.places.float())
            if not torch.allclose(there[:3], place)
        ]
        assert float(loss) == pytest.approx(error(rows) - error(range(len(often))), rel=0.1)


def test_no_place_lies_between_two_floors():
    rng = np.random.default_rng(0)
    places = np.concatenate((rng.uniform(0, 6, (40, 2)), np.repeat([[1.0], [4.0]], 20, 0)), 1)
    labels = rng.normal(-60, 8, (40, 2))
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=[[0, 0, 2], [6, 6, 5]], labels=labels
    )
    heights = gaigs.survey(fitted(links), count=6, stop=0.0).places[:, 2]
    assert {*heights.tolist()} == {1.0, 4.0}


def noise_alone():
    """A process of labels that nothing but noise tells apart."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 8, (60, 3))
    labels = rng.normal(-60, 3, (60, 1))
    links = gaigs.links(task="rssi", transmitters=places, receivers=[[0, 0, 2]], labels=labels)
    return fitted(links)


def test_a_plan_ends_where_labels_scatter_by_the_whole_error():
    model = noise_alone()
    plan = gaigs.survey(model, count=5)
    assert len(plan.places) == 0
    assert plan.scatter > 0.9 * plan.errors[0]
    assert str(plan).startswith(
        f"measure no more: labels at one place scatter by {plan.scatter:.3g} dB"
    )
    whole = gaigs.survey(model, count=3, stop=0.0)
    assert len(whole.places) == 3
    assert len(figure(plan).axes) == len(figure(whole).axes) == 1  # a flat curve is not drawn


def test_places_of_a_plan_stand_half_a_length_apart_while_there_is_room():
    noisy = replace(process(known=0), noise=40.0)  # a reading leaves much to know of its place
    row = torch.arange(0, 12.0, 0.25, dtype=torch.float64)
    asked = torch.nn.functional.pad(row[:, None], (0, 2))  # (48, 3)
    places = SurveyPlaces(asked, asked[:0])

    def chosen(count, spacing):
        numbers, _ = Selection([noisy], asked, places, MEAN).choose(count, spacing)
        return row[numbers].sort().values

    assert chosen(12, None).diff().min() < 0.75
    apart = chosen(12, Spacing([noisy], asked))
    assert apart.diff().min() >= 0.75  # half of 1.5 m
    assert len(chosen(40, Spacing([noisy], asked))) == 40  # no room: nearer ones


AREA = {
    "type": "FeatureCollection",
    "features": [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [9, 9]}},
        {
            "type": "Feature",
            "geometry": {
                "type": "Polygon",
                "coordinates": [
                    [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]],
                    [[1, 1], [3, 1], [3, 3], [1, 3], [1, 1]],
                ],
            },
        },
    ],
}
"""A square ring of edges 4 m and 2 m."""


def test_candidates_lie_in_drawn_areas(tmp_path):
    file = tmp_path / "area.geojson"
    file.write_text(json.dumps(AREA))
    model = fitted(gaigs.links("synthetic_rssi", transmitters=40, order=0))
    places = read_area(file, model)
    offsets = (places[:, :2] - 2).abs().amax(1)
    assert 500 <= len(places) <= 2000
    assert ((offsets >= 1) & (offsets <= 2)).all()
    middle = (model.scene.lower[2] + model.scene.upper[2]) / 2
    assert torch.allclose(places[:, 2], middle)
    with pytest.raises(ValueError, match="needs a height, its third number"):
        read_area(file, None)
    # The room's origin lies at an easting and a northing, of which the file has degrees.
    pyproj = pytest.importorskip("pyproj")
    model.scene = replace(model.scene, frame=Frame(32632, 5e5, 5.4e6))
    transformer = pyproj.Transformer.from_crs(32632, 4326, always_xy=True)
    square = [(5e5, 5.4e6), (5e5 + 4, 5.4e6), (5e5 + 4, 5.4e6 + 4), (5e5, 5.4e6)]
    for corners in (square, [transformer.transform(*corner) for corner in square]):
        file.write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
        there = read_area(file, model)
        assert (there[:, :2] > -0.01).all()
        assert (there[:, :2] < 4.01).all()
        assert (there[:, 1] < there[:, 0] + 0.01).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "as GeoJSON: JSONDecodeError"),
        ("[]", "as GeoJSON: TypeError"),
        ('{"type": "Point", "coordinates": [0, 0]}', "has no polygon"),
        ('{"type": "Polygon", "coordinates": [[[0], [1], [2]]]}', "two or three finite numbers"),
        ('{"type": "Polygon", "coordinates": [[[0, 0, 1], [1]]]}', "as GeoJSON: ValueError"),
    ],
)
def test_files_without_an_area_are_refused(tmp_path, text, message):
    file = tmp_path / "area.geojson"
    file.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        read_area(file, None)
    assert str(raised.value).count("\n") <= 1


def test_the_command_takes_a_drawn_area(tmp_path):
    positions = [[0, 0, 1.5], [4, 0, 1.5], [4, 4, 1.5], [0, 0, 1.5]]
    file = tmp_path / "area.geojson"
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [positions]}))
    words = "command=survey", f"survey.candidates={file}", "survey.count=3"
    gaigs.run(gaigs.compose(*words), tmp_path)
    with (tmp_path / "survey.csv").open() as text:
        rows = [*csv.DictReader(text)]
    assert len(rows) == 3
    assert all(float(row["z"]) == 1.5 and float(row["y"]) < float(row["x"]) for row in rows)
