"""What all models share, asked of the splatting pipeline: directions, chunks, questions of every kind, carriers."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from pipeline import NONE, PARTS, watch

from gaigs.directions import Rays
from gaigs.geometry import ExtrapolationWarning
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.path_loss import PathLoss
from gaigs.query import Batch, Query
from gaigs.testing import example_links

PROJECTIONS = pytest.mark.parametrize("projection", ["mercator", "equirectangular", "direction_cosine"])


# --- directions ---


@PROJECTIONS
def test_fewer_directions_get_the_values_of_all(build, batch, projection):
    model = build(projection={"name": projection})
    thin = replace(batch, directions=batch.directions.thin(slice(1, None, 3), slice(2, None, 4)), labels=None)
    torch.testing.assert_close(model(thin).value, model(batch).value[:, 1::3, 2::4], rtol=0, atol=1e-5)


@PROJECTIONS
def test_rays_get_the_values_of_the_grids_pixels(build, batch, projection):
    model, whole = build(projection={"name": projection}), batch.directions
    chosen = torch.randperm(whole.shape[0] * whole.shape[1], generator=torch.Generator().manual_seed(0))[:200]
    rays = whole.flatten()[chosen]
    assert isinstance(rays, Rays)
    value = model(replace(batch, directions=rays, labels=None)).value
    assert value.shape == (3, 200)
    torch.testing.assert_close(value, model(batch).value.flatten(1)[:, chosen], rtol=0, atol=1e-5)
    assert (value[:, :-1] - value[:, 1:]).abs().max() > 0.1  # it is no constant map


def test_rays_train_as_the_grid_does(build, batch):
    model = build()
    gradients = []
    for directions in (batch.directions, batch.directions.flatten()):
        value = model(replace(batch, directions=directions, labels=None)).value
        gradients.append(torch.autograd.grad(value.square().sum(), list(model.parameters())))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4 * one.abs().max().item())


def test_labels_are_predicted_in_their_own_directions_unless_told(build, batch):
    model = build()
    assert torch.equal(model(Batch(batch.query)).value, model(batch).value)


@pytest.mark.parametrize("chunk", [1, 100, 648, 700, 1296, 10**6])
def test_evaluation_in_chunks_equals_the_whole(build, batch, chunk):
    model = build()
    whole = model(batch).value.detach()
    model.chunk = chunk
    if chunk == 1:
        batch = replace(batch, directions=batch.directions.flatten()[:5])
        whole = whole.flatten(1)[:, :5]
    drawn = []
    watch(model, drawn)
    found = model.evaluate(batch)
    pairs = [len(arguments[1]) * arguments[4].shape[0] * arguments[4].shape[1] for arguments in drawn]
    assert max(pairs) <= max(chunk, 1)
    torch.testing.assert_close(found, whole, rtol=0, atol=1e-5)
    assert not found.requires_grad


# --- predict ---


def test_batches_do_not_change_predictions(build, links):
    model, places = build(), links.query.transmitters
    together = model.predict(places, batch_size=24)
    for size in (1, 5, 100):
        torch.testing.assert_close(model.predict(places, batch_size=size), together, rtol=0, atol=1e-5)
    assert torch.equal(together, model.predict(places, batch_size=24))


def test_predict_takes_lists_and_leaves_the_mode(build):
    model = build().train()
    values = model.predict([[1, 2, 1.5], [0, 0, 0]], 1)
    assert model.training
    assert values.shape == (2, 18, 36)
    assert not values.requires_grad
    assert values.isfinite().all()
    assert model.eval().predict([[1, 2, 1.5]]).shape == (1, 18, 36)
    assert not model.training
    assert model.predict(torch.zeros(0, 3)).shape == (0, 18, 36)


def test_predict_takes_points_grids_and_receivers_of_any_kind(build):
    model, points = build(), torch.rand(2, 3, 3)
    each = torch.stack([model.predict(points.flatten(0, 1), receiver) for receiver in (0, 1)])
    close = lambda found, true: torch.testing.assert_close(found, true, rtol=0, atol=1e-5)
    close(model.predict(points, "gateway1"), each[1].unflatten(0, (2, 3)))
    close(model.predict(points[1, 2], 1), each[1, 5])
    receivers = torch.tensor([0, 1, 1, 0, 1, 0])
    close(model.predict(points.flatten(0, 1), receivers), each[receivers, torch.arange(6)])
    close(model.predict(Query(points.flatten(0, 1), receivers), batch_size=4), each[receivers, torch.arange(6)])


def test_predict_takes_directions(build, links):
    model, places = build(), links.query.transmitters[:2]
    whole = model.predict(places)
    grid, rays = links.task.directions.thin(slice(0, 3), slice(4, 9)), links.task.directions.flatten()[7:11]
    close = lambda found, true: torch.testing.assert_close(found, true, rtol=0, atol=1e-5)
    close(model.predict(places, directions=grid), whole[:, :3, 4:9])
    close(model.predict(places, directions=rays), whole.flatten(1)[:, 7:11])


@pytest.mark.parametrize(
    ("transmitters", "receiver", "message"),
    [
        ([1.0, 2], 0, r"\(..., 3\) positions \[m\], got shape \(2,\)"),
        ([[1.0, 2]], 0, r"got shape \(1, 2\)"),
        ([[1.0, 2, 3], [0, float("nan"), 1]], 0, r"must be finite, got \[0.0, nan, 1.0\] in row 1"),
        ([[1.0, float("inf"), 3]], 0, "must be finite"),
        ([[1.0, 2, 3]], 2, "must be one of 0 = gateway0, 1 = gateway1, got 2"),
        ([[1.0, 2, 3]], -1, "got -1"),
        ([[1.0, 2, 3]], "gateway2", "must be one of 0 = gateway0, 1 = gateway1, got 'gateway2'"),
        ([[1.0, 2, 3]], True, "must be one of 0 = gateway0, 1 = gateway1, got True"),
        ([[1.0, 2, 3]], ["gateway0"], r"must be one of 0 = gateway0, 1 = gateway1, got \['gateway0'\]"),
        ([[1.0, 2, 3]], torch.tensor([0, 1]), r"one for each of the \(1,\) positions, got \(2,\)"),
        ([[1.0, 2, 3], [0, -1e5, 0]], 0, r"within 1e5 m of the origin .*, got \[0.0, -100000.0, 0.0\] in row 1"),
        ([[1e30, 2, 3]], 0, "positions within 1e5 m of the origin on each axis"),
        (torch.ones(1, 3, dtype=torch.complex64), 0, r"must be \(..., 3\) positions \[m\] in real numbers"),
        (
            [[1.0, 2, 3], [1.0, 2]],
            0,
            r"must be \(..., 3\) positions \[m\] in real numbers, got \[\[1.0, 2, 3\], \[1.0, 2\]\]",
        ),
        ("west", 0, "in real numbers, got 'west'"),
        (None, 0, "in real numbers, got None"),
        (np.ones((1, 3), dtype=bool), 0, "in real numbers"),
        (3.0, 0, r"got shape \(\)"),
        ([[1.0, 2, 3]], 1.0, "must be one of 0 = gateway0, 1 = gateway1, got 1.0"),
        ([[1.0, 2, 3]], 10**30, "must be one of 0 = gateway0, 1 = gateway1, got 1000"),
        ([[1.0, 2, 3]], torch.tensor([0.0]), r"must be one of .*, got \(1,\) of torch.float32"),
        (np.ma.array([[1.0, 2, 3]], mask=[[True, False, False]]), 0, "in real numbers, got masked_array"),
        ([[1.0, 2, 3]] * 3, np.array([0, 7, 1]), "must be one of 0 = gateway0, 1 = gateway1, got 7"),
        ([[1.0, 2, 3]], torch.tensor([[0]]), r"one for each of the \(1,\) positions, got \(1, 1\)"),
    ],
)
@pytest.mark.parametrize("method", ["predict", "predict_batches"])
def test_impossible_questions_are_refused(build, transmitters, receiver, message, method):
    with pytest.raises(ValueError, match=message) as error:
        getattr(build([]), method)(transmitters, receiver)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"batch_size": 0}, ValueError, "batch_size must be at least 1 link, got 0"),
        ({"batch_size": -3}, ValueError, "batch_size must be at least 1 link, got -3"),
        ({"batch_size": 2.5}, TypeError, "batch_size must be a whole number, got 2.5"),
        ({"batch_size": None}, TypeError, "batch_size must be a whole number, got None"),
        ({"directions": 30}, TypeError, r"must be a gaigs\.directions\.Grid or gaigs\.directions\.Rays, .* got int"),
        (
            {"directions": Rays([0.5], [90.0])},
            ValueError,
            "azimuths must be .* rad, got 90; Grid.degrees takes degrees",
        ),
        ({"directions": Rays([-2.0], [0.0])}, ValueError, "elevations must be .* -1.5708 to 1.5708 rad, got -2; Grid"),
        ({"directions": Rays([math.nan], [0.0])}, ValueError, "elevations must be .* rad, got nan"),
        ({"directions": Rays(["up"], [0.0])}, ValueError, r"elevations must be .* in real numbers, got \['up'\]"),
        ({"directions": Rays(0.5, [0.0])}, ValueError, r"elevations must be .* rad, got shape \(\)"),
        ({"directions": Rays([0.5, 0.6], [0.0])}, ValueError, "as many elevations as azimuths, got 2 and 1"),
    ],
)
def test_options_of_predict_that_cannot_be_are_refused(build, options, error, message):
    model = build([])
    for method in (model.predict, model.predict_batches):
        with pytest.raises(error, match=message):
            method([[1.0, 2, 3]], **options)


def test_labels_without_directions_are_predicted_in_none():
    links = example_links("rssi")
    model = PathLoss(links.scene)
    model.fit(links)
    with pytest.raises(ValueError, match="labels of task 'rssi' have no directions; leave directions out"):
        model.predict([[1.0, 2, 3]], directions=Rays(torch.zeros(2), torch.zeros(2)))


@pytest.mark.parametrize("method", ["predict", "predict_batches"])
def test_far_positions_are_predicted_with_a_warning(build, method):
    told = r"^2 of 3 positions are up to 1\.71e\+05 m outside .* is 7\.04 m across: nothing was measured near there$"
    ask, places = getattr(build(), method), [[9.9e4, -9.9e4, 9.9e4], [1.0, 2.0, 1.0], [-9.9e4, 0.0, 0.0]]
    with pytest.warns(ExtrapolationWarning, match=told) as warned:
        values = ask(places)
    assert torch.cat([*values]).isfinite().all()
    assert [warning.filename for warning in warned] == [__file__]
    with pytest.raises(ValueError, match="receiver"):  # which is told first
        ask(places, "nobody")


def test_a_query_is_predicted_without_a_warning(build):
    assert build().predict(Query(torch.full((1, 3), 9e4), torch.tensor([0]))).isfinite().all()


def test_as_far_away_as_the_scene_is_across_is_near_enough(build):
    model = build()
    model.predict(model.scene.upper + torch.tensor([0.99 * model.scene.extent, 0.0, 0.0]))
    with pytest.warns(ExtrapolationWarning, match="1 of 1 positions"):
        model.predict(model.scene.upper + torch.tensor([1.01 * model.scene.extent, 0.0, 0.0]))


def test_indices_of_any_whole_type_name_a_receiver(build):
    model, place = build(), [[1.0, 2, 3]]
    for index in (np.array([1], dtype=np.uint8), np.int16(1), torch.tensor(1, dtype=torch.int32)):
        assert torch.equal(model.predict(place, index), model.predict(place, 1))


# --- predict_batches ---


def test_batches_are_the_prediction_in_parts(build, links):
    model, places = build().train(), links.query.transmitters.reshape(4, 6, 3)
    receivers = links.query.receivers.reshape(4, 6)
    whole = model.predict(places, receivers, batch_size=5)
    parts = model.predict_batches(places, receivers, batch_size=5)
    first = next(parts)
    assert model.training, "between two batches the mode is what it was"
    assert not first.requires_grad
    rest = [*parts]
    assert [len(part) for part in (first, *rest)] == [5, 5, 5, 5, 4]
    assert torch.equal(torch.cat((first, *rest)).reshape(whole.shape), whole)
    assert [*model.predict_batches(torch.zeros(0, 3))] == []


def test_batches_are_computed_one_after_the_other(build, monkeypatch):
    model, asked = build([]), []
    evaluate = model.evaluate
    monkeypatch.setattr(model, "evaluate", lambda batch: asked.append(len(batch)) or evaluate(batch))
    parts = model.predict_batches(torch.rand(100_000, 3), batch_size=2)
    assert asked == []
    next(parts)
    assert asked == [2]


@pytest.mark.parametrize(
    ("frequency", "message"),
    [
        (0.0, r"^a frequency must be a carrier in Hz, from 10000 to 3e\+11, got 0$"),
        (-1e9, r"a carrier in Hz, .* got -1e\+09$"),
        (math.nan, "a carrier in Hz, .* got nan$"),
        (math.inf, "a carrier in Hz, .* got inf$"),
        (0.95, r"a carrier in Hz, .* got 0\.95; in GHz\?$"),
        (950, r"a carrier in Hz, .* got 950; in MHz\?$"),
        (9e11, r"a carrier in Hz, .* got 9e\+11$"),
        (torch.tensor([2.4e9, 5.0]), r"a carrier in Hz, .* got 5; in GHz\?$"),
        ("2 GHz", "must be a carrier in Hz in real numbers, got '2 GHz'"),
        (1e9 + 1j, "must be a carrier in Hz in real numbers, got"),
        (torch.tensor([1e9, 2e9]), r"one for each of the \(1,\) positions, got \(2,\)"),
        (1e9, "the training links have no carrier that is known, which says nothing of others; leave frequency out"),
    ],
)
def test_impossible_frequencies_are_refused(build, frequency, message):
    with pytest.raises(ValueError, match=message):
        build([]).predict([[1.0, 2, 3]], frequency=frequency)


def test_gaussians_that_become_nan_are_not_hidden(build, links):
    model = build()
    with torch.no_grad():
        model.gaussians.means[3] = torch.nan
    assert model.predict(links.query.transmitters[:1]).isnan().any()


# --- several carriers ---


@pytest.fixture
def band(links):
    """The same links at one of three carriers each."""
    query = links.query
    frequencies = torch.tensor([1e9, 2e9, 4e9])[torch.arange(24) // 2 % 3]
    return replace(links, query=Query(query.transmitters, query.receivers, frequencies))


@pytest.mark.parametrize("tokenizer", ["multiview", "ga", "euclidean"])
def test_carriers_change_predictions(build, band, tokenizer):
    parts = {"euclidean": PARTS["tokenizer"]["euclidean"], "multiview": PARTS["tokenizer"]}
    model = build(scene=band.scene, tokenizer=parts.get(tokenizer, {"name": tokenizer}))
    place = band.query.transmitters[:1]
    low, high = (model.predict(place, frequency=frequency) for frequency in (1e9, 4e9))
    assert (low - high).abs().max() > 1e-4
    mixed = model.predict(place.expand(2, 3), frequency=torch.tensor([1e9, 4e9]))
    torch.testing.assert_close(mixed, torch.cat((low, high)), rtol=0, atol=1e-5)


def test_a_missing_frequency_is_refused_where_there_are_several(build, band):
    place = band.query.transmitters[:1]
    for model in (build(scene=band.scene), build(scene=band.scene, **NONE)):
        with pytest.raises(ValueError, match=r"have 3 carriers, 1e\+09 to 4e\+09 Hz; say which with frequency="):
            model.predict(place)
        with pytest.raises(ValueError, match="have 3 carriers"):
            model.predict(Query(place, torch.tensor([0])))
        assert model.predict(Query(place, torch.tensor([0]), torch.tensor([2e9]))).isfinite().all()


def test_one_carrier_goes_without_saying(build, band):
    band = replace(band, query=replace(band.query, frequencies=torch.full((24,), 2e9)))
    model, place = build(scene=band.scene), band.query.transmitters[:1]
    assert torch.equal(model.predict(place), model.predict(place, frequency=2e9))


def test_a_band_is_left_with_a_warning(build, band):
    model, place = build(scene=band.scene), band.query.transmitters[:1]
    told = r"^2 of 3 positions are asked at 9e\+08 to 6e\+10 Hz, outside .* band of 1e\+09 to 4e\+09 Hz: nothing was"
    for method in (model.predict, model.predict_batches):
        with pytest.warns(ExtrapolationWarning, match=told) as warned:
            values = method(place.expand(3, 3), frequency=torch.tensor([6e10, 2e9, 9e8]))
        assert torch.cat([*values]).isfinite().all()
        assert [warning.filename for warning in warned] == [__file__]
    with pytest.warns(ExtrapolationWarning, match=r"^1 of 1 positions are asked at 6e\+10 Hz, outside"):
        model.predict(place, frequency=60e9)


def test_a_band_ends_at_its_carriers_to_rounding(build, band):
    model, place = build(scene=band.scene), band.query.transmitters[:1]
    for frequency in (1e9, 1e9 * (1 - 5e-7), 3e9, 4e9, 4e9 * (1 + 5e-7)):
        assert model.predict(place, frequency=frequency).isfinite().all()
    for frequency in (1e9 * (1 - 2e-6), 4e9 * (1 + 2e-6)):
        with pytest.warns(ExtrapolationWarning, match="1 of 1 positions are asked at"):
            model.predict(place, frequency=frequency)


def test_of_a_querys_frequencies_only_the_range_is_looked_at(build, band):
    model, place, receiver = build(scene=band.scene), band.query.transmitters[:1], torch.tensor([0])
    assert model.predict(Query(place, receiver, torch.tensor([60e9]))).isfinite().all()
    with pytest.raises(ValueError, match=r"must be a carrier in Hz, .* got 60; in GHz\?"):
        model.predict(Query(place, receiver, torch.tensor([60.0])))


CARRIER = 2.437123e9  # of which six digits are another


def channels(carriers):
    """A look-up of channels whose links have these carriers in turn."""
    links = example_links("csi")
    frequencies = torch.tensor(carriers)[torch.arange(24) // 2 % len(carriers)] if carriers else None
    links = replace(links, query=replace(links.query, frequencies=frequencies))
    model = KNearestNeighbours(links.scene, 3)
    model.fit(links)
    return model


@pytest.mark.parametrize("carriers", [(), (CARRIER,), (CARRIER, 5e9)])
@pytest.mark.parametrize("frequency", [0.95, 950, math.nan])
def test_channels_are_refused_at_what_is_no_carrier(carriers, frequency):
    with pytest.raises(ValueError, match=f"must be a carrier in Hz, from .*, got {frequency}") as error:
        channels(carriers).predict([[1.0, 2, 1]], frequency=frequency)
    assert "\n" not in str(error.value)


def test_channels_know_their_own_carrier_alone():
    model, place = channels((CARRIER,)), [[1.0, 2, 1]]
    own = model.predict(place)
    told = "have one carrier, (.*) Hz, which says nothing of others; leave frequency out"
    for other in (60e9, CARRIER * (1 + 2e-6)):
        with pytest.raises(ValueError, match=told) as error:
            model.predict(place, frequency=other)
    printed = float(re.search(told, str(error.value))[1])
    for frequency in (CARRIER, printed, model.scene.frequencies, CARRIER * (1 + 5e-7)):
        assert torch.equal(model.predict(place, frequency=frequency), own)
    with pytest.raises(ValueError, match="have no carrier that is known, which says nothing of others"):
        channels(()).predict(place, frequency=60e9)


def test_channels_of_several_carriers_warn_outside_their_band():
    with pytest.warns(ExtrapolationWarning, match=r"at 6e\+10 Hz, outside .* band of 2\.437123e\+09 to 5e\+09 Hz"):
        channels((CARRIER, 5e9)).predict([[1.0, 2, 1]], frequency=60e9)


def test_a_batch_moves(batch):
    batch = replace(batch, query=replace(batch.query, frequencies=torch.ones(3)))
    moved = batch.to(torch.device("meta"))
    tensors = moved.query.transmitters, moved.query.receivers, moved.query.frequencies, moved.labels
    assert {tensor.device.type for tensor in (*tensors, moved.directions.azimuths)} == {"meta"}
    bare = Batch(Query(batch.query.transmitters, batch.query.receivers)).to(torch.device("meta"))
    assert bare.directions is None
    assert bare.labels is None
    assert bare.query.frequencies is None


@pytest.mark.parametrize(
    ("query", "options", "message"),
    [
        (Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long)), {"receiver": 1}, "a query says itself who hears"),
        (Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long)), {"frequency": 1e9}, "at which frequency; leave"),
        (Query(torch.full((2, 3), torch.nan), torch.zeros(2, dtype=torch.long)), {}, "transmitters must be finite"),
        (Query(torch.zeros(2, 3), torch.full((2,), 9)), {}, "receiver must be one of 0 = "),
    ],
)
def test_queries_that_cannot_be_answered_are_refused(build, query, options, message):
    with pytest.raises(ValueError, match=message):
        build([]).predict(query, **options)


def test_directions_of_ones_own_class_are_asked_for_as_they_are(build):
    class Ring(Rays):
        def __init__(self, n):
            super().__init__(torch.full((n,), 0.5), torch.linspace(-3, 3, n))

    model = build([])
    expected = model.predict([[1.0, 2, 3]], directions=Rays(torch.full((5,), 0.5), torch.linspace(-3, 3, 5)))
    assert torch.equal(model.predict([[1.0, 2, 3]], directions=Ring(5)), expected)
