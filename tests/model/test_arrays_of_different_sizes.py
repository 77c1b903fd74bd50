"""Receivers with different numbers of elements: what a receiver lacks is 0, and changes nothing for
the others.
"""

from dataclasses import replace

import pytest
import torch

import gaigs
from gaigs.core.antenna import Array, Receiver
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import divide
from gaigs.registry import registry
from gaigs.splatting.loss.log_relative_error import LogRelativeError

SPLIT = {"name": "random", "seed": 0}


@pytest.fixture(scope="module")
def links():
    """Channels of the built-in room at 16 elements, and at nine of them alone."""
    made = gaigs.links("synthetic_csi", transmitters=60, subcarriers=4)
    (large,) = made.receivers
    kept = [k for k in range(16) if k // 4 and k % 4]
    small = Receiver("small", large.pose, Array(large.array.elements[kept], large.array.pattern))
    fewer = torch.zeros_like(made.labels)
    fewer[:, :9] = made.labels[:, kept]
    places, carriers = made.query.transmitters.repeat(2, 1), made.query.frequencies.repeat(2)
    query = Query(places, torch.arange(2).repeat_interleave(60), carriers)
    both = replace(
        made, query=query, receivers=(large, small), labels=torch.cat((made.labels, fewer))
    )
    return divide(replace(both, rows=made.rows.repeat(2), official=None), SPLIT)


@pytest.mark.parametrize("name", ["friis", "knn", "mean", "gaussian_process"])
def test_look_ups_predict_nothing_at_missing_elements(links, name):
    model = registry("model").build({"name": name}, scene=links.scene)
    model.fit(links)
    index = links.split.test
    values, is_small = model.predict(links.query[index]), links.query.receivers[index] == 1
    assert values.shape[1:] == (16, 4)
    assert not values[is_small][:, 9:].any()
    assert values[is_small][:, :9].abs().min() > 0


def test_all_receivers_are_predicted_each_with_its_own_elements(links):
    model = gaigs.train("friis", links)
    places, names = links.query.transmitters[:2], [receiver.name for receiver in links.receivers]
    found = model.predict(places, interval=0.5)
    assert {name: tuple(one.value.shape) for name, one in found.items()} == {
        names[0]: (2, 16, 4),
        "small": (2, 9, 4),
    }
    for number, name in enumerate(names):
        query = Query(places, torch.full((2,), number), links.query.frequencies[:2])
        padded = model.predict(query)
        assert torch.equal(found[name].value, padded[:, : len(links.receivers[number].array)])
        assert torch.equal(found[name].value, model.predict(places, name))
        assert torch.equal(found[name].value, model.predict(places)[name])
        assert torch.equal(found[name].snr_db, model.predict(query, interval=0.5).snr_db)
        assert found[name].std.isfinite().all()
        parts = [part[name] for part in model.predict_batches(places, batch_size=1)]
        assert torch.equal(found[name].value, torch.cat(parts))


def test_friis_has_the_gains_that_each_receiver_has_alone(links):
    both, alone = (
        registry("model").build("friis", scene=own.scene) for own in (links, one(links, 1))
    )
    both.fit(links)
    alone.fit(one(links, 1))
    torch.testing.assert_close(both.gains[1], alone.gains[0])


def one(links, receiver):
    """The links of one receiver alone, with as many elements as it has."""
    own, count = links.query.receivers == receiver, len(links.receivers[receiver].array)
    query = links.query[own]
    alone = replace(
        links,
        query=replace(query, receivers=torch.zeros_like(query.receivers)),
        receivers=links.receivers[receiver : receiver + 1],
        labels=links.labels[own][:, :count],
        rows=links.rows[own],
        task=Csi(count, links.task.frequencies),
    )
    return divide(alone, SPLIT)


UNSEARCHED = {"name": "mirrored", "order": 0}


@pytest.mark.parametrize(
    "options",
    [{"name": "gaigs", "gaussians": {"count": 5}}, {"name": "mirrored", "placement": UNSEARCHED}],
)
def test_trained_models_have_the_loss_of_the_elements_that_are_there(links, options):
    task = Csi(9, links.task.frequencies)
    small = replace(links.scene, task=task, receivers=(links.receivers[1],) * 2)
    model, other = (registry("model").build(options, scene=scene) for scene in (links.scene, small))
    model.fit(links)
    other.load_state_dict(model.state_dict())
    batch = links.batch(torch.arange(60, 70))
    value = model.eval()(batch).value
    assert value.shape[1:] == (16, 4)
    assert not value[:, 9:].any()
    cut = replace(batch, labels=batch.labels[:, :9])
    expected, _ = LogRelativeError(task)(other.eval()(cut).value, cut)
    assert LogRelativeError(links.task)(value, batch)[0].item() == pytest.approx(
        expected.item(), rel=1e-5
    )


def test_scores_of_padded_channels_are_those_of_the_elements_that_are_there(links):
    small = one(links, 1)
    noise = torch.randn(60, 9, 4, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    values = small.labels + noise * small.labels.abs()
    padded = torch.zeros(60, 16, 4, dtype=values.dtype)
    padded[:, :9] = values
    for phase in ("known", "per_link_and_delay"):
        tasks = [Csi(count, links.task.frequencies, phase) for count in (9, 16)]
        here, there = (
            tasks[0].scores(small.labels, values),
            tasks[1].scores(links.labels[60:], padded),
        )
        for name, score in here.items():
            torch.testing.assert_close(there[name], score, rtol=1e-6, atol=1e-6)
