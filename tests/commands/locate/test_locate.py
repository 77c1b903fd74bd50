import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import gaigs
from gaigs.commands.locate import posterior as posteriors
from gaigs.commands.locate import prediction_map
from gaigs.commands.locate.candidates import Candidates
from gaigs.commands.locate.fingerprints import Fingerprints, transmissions
from gaigs.commands.locate.likelihood import Mismatch, independent, log_likelihood, mismatch
from gaigs.commands.locate.neighbours import neighbours
from gaigs.commands.locate.posterior import geometric_median, posterior
from gaigs.commands.locate.tracks import smoothed, walk
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.task.csi import Csi


def scalars(values, deviations, hearing=None, **options):
    """Fingerprints of RSSI at places along a line, one row a place."""
    count = len(values)
    places = torch.stack((torch.arange(count).float(), *torch.zeros(2, count)), 1)
    even = torch.full((count,), -math.log(count)), torch.zeros(count)
    task = gaigs.registries["task"].build("rssi")
    parts = torch.tensor(values)[..., None], torch.tensor(deviations)
    parts = *parts, torch.full_like(parts[1], 0.5) if hearing is None else torch.tensor(hearing)
    names = [f"rx{number}" for number in range(len(values[0]))]
    return Fingerprints(
        task, None, names, Candidates(places, *even), torch.eye(1), *parts, **options
    )


@pytest.fixture(scope="module")
def rssi():
    links = gaigs.links("synthetic_rssi", transmitters=120, order=0)
    model = gaigs.train("knn", links)
    return links, model, gaigs.fingerprints(model, links, points=3000)


def test_values_by_names_of_receivers_are_those_in_their_order():
    prints = scalars([[-40.0, -60.0], [-50.0, -52.0], [-60.0, -45.0]], [[2.0, 3.0]] * 3)
    for named, ordered in (
        ({"rx1": -55.0, "rx0": -48.0}, [-48.0, -55.0]),
        ({"rx1": -55.0}, [math.nan, -55.0]),
        ({"rx1": [-55.0, -50.0], "rx0": [-48.0, math.nan]}, [[-48.0, -55.0], [math.nan, -50.0]]),
    ):
        torch.testing.assert_close(
            gaigs.locate(prints, named).probabilities,
            gaigs.locate(prints, ordered).probabilities,
            rtol=0,
            atol=0,
        )
    with pytest.raises(ValueError, match="receiver must be one of 0 = rx0, 1 = rx1, got 'rx2'"):
        gaigs.locate(prints, {"rx2": -55.0})
    with pytest.raises(ValueError, match="must have real labels"):
        gaigs.locate(prints, {"rx1": -55.0 + 1j})
    with pytest.raises(ValueError, match="the label of one receiver or more, got none"):
        gaigs.locate(prints, {})


def test_readings_of_another_unit_are_named():
    prints = scalars([[-40.0, -60.0], [-50.0, -52.0], [-60.0, -45.0]], [[2.0, 3.0]] * 3)
    with pytest.warns(
        ExtrapolationWarning, match="up to 40 dB beyond all predicted ones; check their unit"
    ):
        gaigs.locate(prints, [1e-5, -50.0])
    gaigs.locate(prints, [-30.0, math.nan])


def test_posterior_is_that_of_a_plain_sum_over_the_receivers_that_hear():
    values, deviations = (
        [[-40.0, -60.0], [-50.0, -52.0], [-60.0, -45.0]],
        [[2.0, 3.0], [4.0, 3.0], [2.0, 1.5]],
    )
    hearing = [[0.9, 0.2], [0.5, 0.4], [0.3, 0.8]]
    prints = scalars(values, deviations, hearing, degrees=5.0, temper=0.7)
    for asked in ([-48.0, -55.0], [-48.0, math.nan]):
        found = gaigs.locate(prints, asked)
        logs = []
        for value, deviation, chance in zip(values, deviations, hearing, strict=True):
            heard = [i for i in range(2) if not math.isnan(asked[i])]
            q = sum(((asked[i] - value[i]) / deviation[i]) ** 2 for i in heard)
            logs.append(
                -0.7
                * (
                    (5 + len(heard)) / 2 * np.log1p(q / 5)
                    + sum(np.log(deviation[i]) for i in heard)
                )
            )
            logs[-1] += sum(np.log(chance[i] if i in heard else 1 - chance[i]) for i in range(2))
        p = np.exp(logs) / np.exp(logs).sum()
        np.testing.assert_allclose(found.probabilities[0], p, rtol=1e-5)
        np.testing.assert_allclose(found.mean[0], [p @ [0, 1, 2], 0, 0], rtol=1e-5, atol=1e-6)
        assert found.likeliest[0, 0] == np.argmax(p)


@pytest.mark.parametrize("parted", [False, True])
def test_a_receiver_that_hears_nothing_tells_where_a_transmitter_is(parted):
    """Unless its link may be in another part of the split."""
    rng = torch.Generator().manual_seed(0)
    places = torch.rand(100, 3, generator=rng) * torch.tensor([10.0, 4.0, 1.0])
    labels = -50 + torch.randn(100, 2, generator=rng)
    labels[places[:, 0] > 5, 1] = math.nan
    stands = torch.tensor([[5.0, -5, 2], [5, 9, 2]])
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=stands, labels=labels, split="random"
    )
    if parted:
        links = replace(links, split=links.split.only(torch.arange(len(links))[::2]))
        links = replace(links, split=replace(links.split, test=torch.arange(len(links))[1::2]))
    prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=400)
    for value, is_right in (([-50.0, -50.0], False), ([-50.0, math.nan], True)):
        likely = (
            gaigs.locate(prints, value).probabilities[0]
            @ (prints.candidates.places[:, 0] > 5).double()
        )
        assert (
            abs(likely - 0.5) < 0.35
            if parted
            else (likely > 0.85) == is_right and abs(likely - 0.5) > 0.3
        )


def test_unknown_power_takes_the_offset_with_the_least_error():
    prints = scalars(
        [[-40.0, -60.0, -50.0], [-50.0, -52.0, -70.0]], [[2.0, 3.0, 1.0], [4.0, 3.0, 2.0]]
    )
    asked = torch.tensor([[[-47.0], [-66.0], [-58.0]]])
    total, _, count, _ = mismatch(prints, asked, unknown_power=True)
    for place in range(2):
        errors, deviations = asked[0, :, 0] - prints.values[place, :, 0], prints.deviations[place]
        best = min(
            ((errors - x) / deviations).square().sum().item() for x in torch.arange(-20, 20, 0.01)
        )
        assert total[0, place].item() == pytest.approx(best, abs=1e-3)
    assert count.tolist() == [2]
    found = gaigs.locate(prints, asked[..., 0] + 25, unknown_power=True).probabilities
    torch.testing.assert_close(
        found, gaigs.locate(prints, asked[..., 0], unknown_power=True).probabilities
    )


def test_spectra_of_unknown_power_may_have_any_factor():
    links = gaigs.links("synthetic", transmitters=30, order=0)
    prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=300)
    label = links.labels[links.split.test[:1]]
    with_power, without = (
        gaigs.locate(prints, 0.3 * label, unknown_power=unknown) for unknown in (False, True)
    )
    same = gaigs.locate(prints, label, unknown_power=True)
    asked = torch.rand(1, 1, prints.values.shape[2])
    total, *_ = mismatch(prints, asked, unknown_power=True)
    factors = torch.linspace(0, 3, 301)[:, None] * asked.norm() / prints.values[:, 0].norm(dim=1)
    left = (asked - factors[..., None] * prints.values[:, 0]).square().sum(2).amin(
        0
    ) / asked.square().sum()
    torch.testing.assert_close(
        total[0],
        left * prints.values.square().sum((1, 2)).mean(),
        rtol=1e-3,
        atol=1e-3 * total.max().item(),
    )
    torch.testing.assert_close(without.probabilities, same.probabilities, rtol=1e-3, atol=1e-6)
    assert not torch.allclose(with_power.probabilities, without.probabilities, atol=1e-3)


def test_a_track_has_the_posterior_of_all_its_paths():
    rng = torch.Generator().manual_seed(0)
    places = torch.rand(4, 3, generator=rng, dtype=torch.float64)
    values, step = torch.randn(3, 4, generator=rng, dtype=torch.float64), 0.4
    found = torch.softmax(smoothed(values, places, step, torch.tensor([True, False, True])), 1)
    spacing = torch.cdist(places, places).fill_diagonal_(math.inf).amin(1).median()
    size = math.hypot(step, spacing)
    expected = np.zeros((3, 4))
    for path in itertools.product(range(4), repeat=3):
        weight = np.exp(sum(values[t, i].item() for t, i in enumerate(path)))
        for a, b in itertools.pairwise(path):
            weight *= np.exp(-(((places[a] - places[b]).norm() / size) ** 2).item() / 2) + 1e-4
        expected[range(3), path] += weight
    np.testing.assert_allclose(found, expected / expected.sum(1, keepdims=True), rtol=1e-6)


def test_a_track_goes_on_where_no_receiver_hears(rssi):
    links, _, prints = rssi
    values, places = transmissions(links, links.split.train)
    ends = values[[places[:, 0].argmin(), places[:, 0].argmax()], :, 0].repeat_interleave(3, 0)
    found = gaigs.locate(
        prints, torch.cat((ends[:3], torch.full((7, 4), math.nan), ends[3:])), step=0.5
    )
    way, middle = (found.mean[-1] - found.mean[0]).norm(), (found.mean[0] + found.mean[-1]) / 2
    assert way > 2
    assert found.probabilities[6] @ (found.places - middle).norm(dim=1).double() < 0.4 * way


def test_transmitters_are_nearer_than_their_neighbours_and_in_their_regions():
    links = gaigs.links("synthetic_csi", transmitters=120, order=0)
    prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=2000)
    known = torch.cat((links.split.train, links.split.validation))
    (asked, truth), (prior, places) = (
        transmissions(links, links.split.test),
        transmissions(links, known),
    )
    found = posterior(prints, asked, False, None, 0.9)
    guess = neighbours(asked, prior, places, torch.arange(len(places)))
    own, other = ((part - truth).norm(dim=1).mean() for part in (found.mean, guess))
    assert own < other
    assert found.holds(truth).double().mean() >= 0.75
    assert posterior(prints, asked, False, None, 0.5).region.sum() < 0.7 * found.region.sum()
    torch.testing.assert_close(prints.candidates.prior.exp().sum(), torch.tensor(1.0))


def test_values_are_located_in_parts(rssi, monkeypatch):
    prints, sizes = rssi[2], []
    own = posteriors.mismatch
    monkeypatch.setattr(
        posteriors, "mismatch", lambda *parts: sizes.append(len(parts[1])) or own(*parts)
    )
    values = torch.randn(150, 4, generator=torch.Generator().manual_seed(0)) * 10 - 60
    found, last = gaigs.locate(prints, values), gaigs.locate(prints, values[-1])
    assert sizes == [64, 64, 22, 1]
    for name in ("probabilities", "mean", "likeliest", "region", "sizes"):
        torch.testing.assert_close(
            getattr(found, name)[-1:], getattr(last, name), rtol=1e-4, atol=1e-4
        )


def test_walks_go_to_the_nearest_place_and_stay_while_steps_would_take_them_there():
    line = torch.tensor([0.0, 2.0, 1.0, 3.0])[:, None] * torch.tensor([1.0, 0.0, 0.0])
    assert walk(line, 1.0).tolist() == [0, 2, 1, 3]
    assert walk(line, 0.3).tolist() == [0, 0, 2, 2, 1, 1, 3, 3]
    assert walk(line[:1], 0.3).tolist() == [0]


def test_regions_of_tracks_hold_more_than_the_posterior_says(rssi):
    links, model, _ = rssi
    prints = gaigs.fingerprints(model, links, points=500)
    asked, truth = transmissions(links, links.split.test)
    order = walk(truth, 0.5)
    own, plain = (
        posterior(one, asked[order], False, 0.5, 0.9) for one in (prints, replace(prints, held=()))
    )
    assert own.calibrated
    assert (
        own.holds(truth[order]).double().mean() >= 0.75 > plain.holds(truth[order]).double().mean()
    )
    assert own.sizes.mean() < 0.5


def test_prior_follows_the_known_places_and_a_region_replaces_it(rssi):
    links, model, prints = rssi
    known = links.query.transmitters[links.split.train]

    def apart(places):
        return torch.cdist(places, known).amin(1).median()

    box = torch.stack((known.amin(0), known.amax(0)))
    even = gaigs.fingerprints(model, region=box, points=1000)
    assert apart(prints.candidates.places) < 0.95 * apart(even.candidates.places)
    assert even.candidates.prior.unique().numel() == 1
    assert not len(even.drops())
    assert not gaigs.locate(even, [-50.0, -60.0, -55.0, -70.0]).calibrated


@pytest.mark.parametrize(("data", "degrees"), [("synthetic_rssi", 4.0), ("synthetic", 0.25)])
def test_few_fingerprints_do_not_rule_outliers_out(data, degrees):
    links = gaigs.links(data, transmitters=16, order=0)
    prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=200)
    assert 0 < prints.held_out_count < 20
    assert prints.degrees == degrees  # the least energy score of the levels would be at 30


def test_held_out_fingerprints_are_located_among_the_other_places(monkeypatch):
    # A density that knew them would put each region about its own place.
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0)
    asked = []
    own = prediction_map.near_candidates
    monkeypatch.setattr(
        prediction_map, "near_candidates", lambda *parts: asked.append(parts[-1]) or own(*parts)
    )
    prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=300)
    every, *others = (set(known.tolist()) for known in asked)
    held = [every - known for known in others]
    assert len(held) == 5
    assert all(held)
    assert len(set.union(*held)) == sum(map(len, held))
    assert len(prints.drops()) == sum(
        len({links.rows[row].item() for row in part}) for part in held
    )


def test_carriers_without_known_links_are_refused_and_folds_without_them_left_out():
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    carriers = torch.full((len(links),), 900e6)
    carriers[links.rows == links.rows[links.split.train[0]]] = 915e6
    links = replace(links, query=replace(links.query, frequencies=carriers))
    model = gaigs.train("mean", links)
    with pytest.raises(
        ValueError, match=r"that of known links, 9e\+08, 9\.15e\+08 Hz, got 9\.2e\+08; or"
    ):
        gaigs.fingerprints(model, links, frequency=920e6, points=50)
    assert not gaigs.fingerprints(model, links, frequency=915e6, points=50).held


def test_channels_are_compared_without_power_phase_and_delay():
    rng = torch.Generator().manual_seed(0)
    h = torch.view_as_complex(torch.randn(2, 4, 8, 2, generator=rng))
    frequencies = 5e9 + 1e6 * torch.arange(8)
    known, none = Csi(4, frequencies), Csi(4, frequencies, "per_link_and_delay")
    turned = 3 * torch.exp(1j * torch.tensor([1.0, 2.0]))[:, None, None] * h
    torch.testing.assert_close(known.fingerprint(turned), known.fingerprint(h))
    late = turned * torch.exp(-2j * math.pi * frequencies * 3e-8)
    torch.testing.assert_close(
        none.fingerprint(late.to(h)), none.fingerprint(h), rtol=1e-3, atol=1e-4
    )
    assert (known.fingerprint(late.to(h)) - known.fingerprint(h)).abs().max() > 0.05


def test_errors_are_independent_along_their_axes():
    rng = torch.Generator().manual_seed(0)
    mix = torch.randn(6, 6, generator=rng)
    errors = torch.randn(5000, 6, generator=rng) @ mix
    along = errors @ independent(errors)
    torch.testing.assert_close(along.T @ along / len(along), torch.eye(6) / 6, atol=0.02, rtol=0)
    few = torch.randn(3, 6, generator=rng) @ mix
    assert independent(few).isfinite().all()
    assert independent(torch.zeros(3, 6)).isfinite().all()


def test_neighbours_are_those_of_numpy():
    rng = torch.Generator().manual_seed(0)
    known, places, asked = (
        torch.rand(40, *shape, generator=rng) for shape in ((3, 1), (3,), (3, 1))
    )
    known[0, 1] = math.nan
    errors = {}
    filled = np.nan_to_num(known[..., 0].numpy(), nan=np.nanmin(known.numpy()))

    def guess(point, rows, count):
        apart = np.linalg.norm(filled[rows] - point, axis=1)
        near = np.argsort(apart)[:count]
        weights = 1 / apart[near]
        return weights @ places.numpy()[rows][near] / weights.sum()

    for count in (1, 2, 3, 5, 8, 12, 20, 30, 50):

        def rows(i):
            return [j for j in range(40) if j != i]

        errors[count] = np.mean(
            [
                np.linalg.norm(guess(filled[i], rows(i), count) - places[i].numpy())
                for i in range(40)
            ]
        )
    best = min(errors, key=errors.get)
    expected = [guess(point, list(range(40)), best) for point in asked[..., 0].numpy()]
    np.testing.assert_allclose(
        neighbours(asked, known, places, torch.arange(40)), expected, rtol=1e-4
    )


def test_median_place_has_the_least_expected_distance():
    rng = np.random.default_rng(0)
    places, weights = rng.normal(size=(30, 3)), rng.dirichlet(np.full(30, 0.3), 2)
    found = geometric_median(torch.tensor(places).float(), torch.tensor(weights))
    for own, median in zip(weights, found.numpy(), strict=True):

        def expected(place, own=own):
            return own @ np.linalg.norm(places - place, axis=1)

        best = minimize(
            expected, own @ places, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9}
        )
        np.testing.assert_allclose(expected(median), best.fun, rtol=1e-4)
    alone = geometric_median(torch.eye(3), torch.tensor([[0.0, 1.0, 0.0]]).double())
    torch.testing.assert_close(alone, torch.eye(3)[1:2])


def test_likelihood_of_a_perfect_value_is_finite():
    perfect = Mismatch(torch.zeros(1, 2), torch.zeros(1, 2), torch.ones(1), torch.zeros(1, 2))
    found = log_likelihood(perfect, 0.25, 16.0)
    assert found.isfinite().all()


def test_wrong_values_are_refused(rssi):
    links, model, prints = rssi
    for value, words in (
        ([-50.0, -60.0], "a label of each receiver"),
        ([math.nan] * 4, "heard by no receiver"),
        (
            [100.0, -50.0, -60.0, -70.0],
            "value of task 'rssi' must be from -200 to 30 dBm, nan where nothing was heard",
        ),
        (np.zeros((0, 4)), "a label of each receiver"),
        ([-50.0, math.inf, -60.0, -70.0], "must be finite"),
        ([-50.0 + 1j, -50.0, -60.0, -70.0], "must have real labels"),
        ("loud", "value must be labels of 4 receivers"),
    ):
        with pytest.raises(ValueError, match=words):
            gaigs.locate(prints, value)
    one = [-50.0, -60.0, -55.0, -70.0]
    for options, words in (
        ({"level": 1.0}, "level must be a probability"),
        ({"step": 0.0}, "step must be above 0"),
        ({"links": links}, "leave links and region out"),
    ):
        with pytest.raises(ValueError, match=words):
            gaigs.locate(prints, one, **options)
    with pytest.raises(ValueError, match="points must be at least 2"):
        gaigs.fingerprints(model, points=1)
    with pytest.raises(ValueError, match="two corners"):
        gaigs.fingerprints(model, region=[[0.0, 0.0, 0.0]])
    alone = {
        "transmitters": torch.rand(20, 3),
        "receivers": [0.0, 0.0, 1.0],
        "labels": torch.rand(20) - 50,
    }
    others = gaigs.links(task="rssi", split="random", **alone)
    with pytest.raises(ValueError, match="the model's receivers"):
        gaigs.fingerprints(model, others)


def test_places_outside_the_region_do_not_calibrate_it(rssi):
    links, model, _ = rssi
    lower, upper = model.scene.lower.clone(), model.scene.upper.clone()
    upper[0] = lower[0] + 0.4 * (upper[0] - lower[0])
    prints = gaigs.fingerprints(model, links, region=torch.stack((lower, upper)), points=500)
    held = torch.cat([one.truth for one in prints.held])
    assert len(held)
    assert (held <= upper).all()


def test_the_command_locates_the_test_transmitters_of_a_run(tmp_path, capsys):
    words = (
        "+experiment=rssi",
        "model=knn",
        "data.transmitters=40",
        "data.order=0",
        "baselines=[]",
    )
    gaigs.run(gaigs.compose(*words), tmp_path / "run")
    command = ("command=locate", f"folder={tmp_path / 'run'}", "locate.points=300")
    gaigs.run(gaigs.compose(*command), tmp_path / "found")
    files = {"locate.csv", "locate.json", "locate.png"}
    assert {path.name for path in (tmp_path / "found").iterdir()} == files
    numbers = json.loads((tmp_path / "found" / "locate.json").read_text())
    rows = (tmp_path / "found" / "locate.csv").read_text().splitlines()
    assert numbers["transmissions"] == len(rows) - 1 == 8
    errors = [float(row.split(",")[rows[0].split(",").index("mean_error")]) for row in rows[1:]]
    assert numbers["locate"]["mean_m"] == pytest.approx(np.mean(errors), abs=1e-3)
    assert {"median_m", "mean_m", "region_90", "share_90"} <= numbers["locate"].keys()
    assert {"median_m", "mean_m"} == numbers["knn"].keys()
    assert "8 transmitters: median" in capsys.readouterr().out
    values = tmp_path / "values.csv"
    values.write_text("west;south;north\n-50,5;-48;\n-50,5;-48;-61\n")
    for name, value in (("one", "[-50.5,-48,null,null]"), ("many", str(values))):
        gaigs.run(gaigs.compose(*command, f"locate.value={value}"), tmp_path / name)
        assert {path.name for path in (tmp_path / name).iterdir()} == files - {"locate.json"}
    one, many = (
        (tmp_path / name / "locate.csv").read_text().splitlines() for name in ("one", "many")
    )
    assert (many[:2], len(many)) == (one, 3)
    values.write_text("west,south\n-50.5,far\n")
    with pytest.raises(ValueError, match=r"line 2: expected a level .* got 'far' in column south"):
        gaigs.run(gaigs.compose(*command, f"locate.value={values}"), tmp_path / "one")
    values.write_text("west,sooth\n-50.5,-48\n")
    with pytest.raises(
        ValueError, match=r"values.csv, line 1: expected names of receivers, west.*, got sooth"
    ):
        gaigs.run(gaigs.compose(*command, f"locate.value={values}"), tmp_path / "one")
    with pytest.raises(ValueError, match="needs the folder of a finished run"):
        gaigs.run(gaigs.compose("command=locate"), tmp_path / "found")


def test_candidates_are_on_floors():
    rng = np.random.default_rng(0)
    places = np.concatenate((rng.uniform(0, 6, (40, 2)), np.repeat([[1.0], [4.2]], 20, 0)), 1)
    labels = rng.normal(-60, 8, (40, 2))
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=[[0, 0, 2], [6, 6, 5]], labels=labels
    )
    model = gaigs.train("knn", links)
    for prints in (
        gaigs.fingerprints(model, links, points=200),
        gaigs.fingerprints(model, points=200),
    ):
        own, prior, _ = prints.candidates
        assert {*own[:, 2].tolist()} == {1.0, torch.tensor(4.2).item()}
        torch.testing.assert_close(prior.exp().sum(), torch.tensor(1.0))
