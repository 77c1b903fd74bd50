"""Prediction, common to all models, of the splatting pipeline: directions, chunks, batches,
carriers, warnings.
"""

from dataclasses import replace

import pytest
import torch
from pipeline import PARTS, watch

from gaigs.core.geometry import ExtrapolationWarning, Rays
from gaigs.core.query import Batch, Query


def close(found, true):
    torch.testing.assert_close(found, true, rtol=0, atol=1e-5)


# --- directions ---


@pytest.mark.parametrize("projection", ["mercator", "equirectangular", "direction_cosine"])
def test_some_directions_get_the_values_of_all(build, batch, projection):
    model, grid = build(projection={"name": projection}), batch.directions
    whole = model(batch).value
    assert torch.equal(model(Batch(batch.query)).value, whole)  # the label's own
    close(
        model(replace(batch, directions=grid.thin(slice(1, None, 3), slice(2, None, 4)))).value,
        whole[:, 1::3, 2::4],
    )
    chosen = torch.randperm(
        grid.shape[0] * grid.shape[1], generator=torch.Generator().manual_seed(0)
    )[:200]
    value = model(replace(batch, directions=grid.flatten()[chosen])).value
    close(value, whole.flatten(1)[:, chosen])
    assert (value[:, :-1] - value[:, 1:]).abs().max() > 0.1  # the map is not constant


def test_rays_train_as_the_grid_does(build, batch):
    model = build()
    gradients = []
    for directions in (batch.directions, batch.directions.flatten()):
        value = model(replace(batch, directions=directions, labels=None)).value
        gradients.append(torch.autograd.grad(value.square().sum(), list(model.parameters())))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4 * one.abs().max().item())


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
    pairs = [
        len(arguments[1]) * arguments[4].shape[0] * arguments[4].shape[1] for arguments in drawn
    ]
    assert max(pairs) <= max(chunk, 1)
    close(found, whole)
    assert not found.requires_grad
    assert model.evaluate(replace(batch, query=batch.query[:0])).shape == (0, *whole.shape[1:])


# --- predict ---


def test_predict_takes_points_grids_and_receivers_of_any_kind(build):
    model, points = build(), torch.rand(2, 3, 3)
    each = torch.stack([model.predict(points.flatten(0, 1), receiver) for receiver in (0, 1)])
    close(model.predict(points, "gateway1"), each[1].unflatten(0, (2, 3)))
    close(model.predict(points[1, 2], 1), each[1, 5])
    receivers = torch.tensor([0, 1, 1, 0, 1, 0])
    close(model.predict(points.flatten(0, 1), receivers), each[receivers, torch.arange(6)])
    close(
        model.predict(Query(points.flatten(0, 1), receivers), batch_size=4),
        each[receivers, torch.arange(6)],
    )


@pytest.mark.parametrize("method", ["predict", "predict_batches"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transmitters": [[1.0, 2]]}, r"transmitters must be \(..., 3\) positions"),
        ({"receiver": "nobody"}, "must be one of 0 = gateway0, 1 = gateway1, got 'nobody'"),
        ({"frequency": 0.0}, "must be a carrier"),
        ({"batch_size": 0}, "batch_size must be at least 1 link, got 0"),
        ({"directions": Rays(torch.tensor([-2.0]), torch.zeros(1))}, "elevations must be"),
        # Before any warning:
        ({"transmitters": [[9e4, 9e4, 9e4]], "receiver": 2}, "receiver must be"),
    ],
)
def test_impossible_questions_are_refused(build, method, options, message):
    with pytest.raises(ValueError, match=message):
        getattr(build([]), method)(**{"transmitters": [[1.0, 2, 3]]} | options)


def test_batches_are_the_prediction_in_parts(build, links, monkeypatch):
    model, places = build().train(), links.query.transmitters.reshape(4, 6, 3)
    receivers = links.query.receivers.reshape(4, 6)
    whole = model.predict(places, receivers, batch_size=5)
    close(whole, model.predict(places, receivers, batch_size=100))
    evaluate, asked = model.evaluate, []
    monkeypatch.setattr(
        model, "evaluate", lambda batch: asked.append(len(batch)) or evaluate(batch)
    )
    parts = model.predict_batches(places, receivers, batch_size=5)
    assert asked == []
    first = next(parts)
    assert asked == [5], "a batch is computed when it is asked for"
    assert model.training, "between two batches the mode stays"
    assert not first.requires_grad
    rest = [*parts]
    assert [len(part) for part in (first, *rest)] == [5, 5, 5, 5, 4]
    assert torch.equal(torch.cat((first, *rest)).reshape(whole.shape), whole)
    assert [len(part) for part in model.predict_batches(torch.zeros(0, 3))] == [0]


def test_gaussians_that_become_nan_are_not_hidden(build, links):
    model = build()
    with torch.no_grad():
        model.gaussians.means[3] = torch.nan
    assert model.predict(links.query.transmitters[:1]).isnan().any()


# --- extrapolation and carriers ---


@pytest.mark.parametrize("method", ["predict", "predict_batches"])
def test_far_positions_are_predicted_with_a_warning(build, method):
    message = (
        r"^2 of 3 positions are up to 1\.71e\+05 m outside .* is 7\.04 m across: nothing was "
        r"measured near there$"
    )
    ask, places = (
        getattr(build(), method),
        [[9.9e4, -9.9e4, 9.9e4], [1.0, 2.0, 1.0], [-9.9e4, 0.0, 0.0]],
    )
    with pytest.warns(ExtrapolationWarning, match=message):
        values = ask(places)
    assert torch.cat([*values]).isfinite().all()


def test_positions_within_the_extent_give_no_warning(build):
    model = build()
    model.predict(model.scene.upper + torch.tensor([0.99 * model.scene.extent, 0.0, 0.0]))
    with pytest.warns(ExtrapolationWarning, match="1 of 1 positions"):
        model.predict(model.scene.upper + torch.tensor([1.01 * model.scene.extent, 0.0, 0.0]))
    assert (
        model.predict(Query(torch.full((1, 3), 9e4), torch.tensor([0]))).isfinite().all()
    )  # of a query no warning


@pytest.fixture
def band(links):
    """The same links at one of three carriers each."""
    frequencies = torch.tensor([1e9, 2e9, 4e9])[torch.arange(24) // 2 % 3]
    return replace(links, query=replace(links.query, frequencies=frequencies))


@pytest.mark.parametrize("tokenizer", ["multiview", "ga", "euclidean"])
def test_carriers_change_predictions(build, band, tokenizer):
    parts = {"euclidean": PARTS["tokenizer"]["euclidean"], "multiview": PARTS["tokenizer"]}
    model = build(scene=band.scene, tokenizer=parts.get(tokenizer, {"name": tokenizer}))
    place = band.query.transmitters[:1]
    low, high = (model.predict(place, frequency=frequency) for frequency in (1e9, 4e9))
    assert (low - high).abs().max() > 1e-4
    close(
        model.predict(place.expand(2, 3), frequency=torch.tensor([1e9, 4e9])),
        torch.cat((low, high)),
    )
    query = Query(place, torch.tensor([0]), torch.tensor([60e9]))
    assert model.predict(query).isfinite().all()  # of a query no warning


def test_a_single_known_carrier_is_the_default(build, band):
    band = replace(band, query=replace(band.query, frequencies=torch.full((24,), 2e9)))
    model, place = build(scene=band.scene), band.query.transmitters[:1]
    assert torch.equal(model.predict(place), model.predict(place, frequency=2e9))


def test_a_band_is_left_with_a_warning(build, band):
    model, place = build(scene=band.scene), band.query.transmitters[:1]
    message = (
        r"^2 of 3 positions are asked at 9e\+08 to 6e\+10 Hz, outside .* band of 1e\+09 to 4e\+09 "
        r"Hz: nothing was"
    )
    for method in (model.predict, model.predict_batches):
        with pytest.warns(ExtrapolationWarning, match=message):
            values = method(place.expand(3, 3), frequency=torch.tensor([6e10, 2e9, 9e8]))
        assert torch.cat([*values]).isfinite().all()
    for frequency in (1e9, 1e9 * (1 - 5e-7), 3e9, 4e9, 4e9 * (1 + 5e-7)):
        assert model.predict(place, frequency=frequency).isfinite().all()
    for frequency, shown in (
        (1e9 * (1 - 2e-6), "9.99998e"),
        (4e9 * (1 + 2e-6), "4.000008e"),
        (60e9, "6e"),
    ):
        with pytest.warns(
            ExtrapolationWarning, match=f"^1 of 1 positions are asked at {shown}[^ ]* Hz, outside"
        ):
            model.predict(place, frequency=frequency)
