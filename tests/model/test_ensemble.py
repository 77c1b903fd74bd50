from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import checkpoint
from gaigs.model.ensemble import Ensemble
from gaigs.model.gaigs import GaussianSplatting
from gaigs.registry import registry

FEW = {"max_steps": 2, "count": 20, "enable_progress_bar": False}


@pytest.fixture(scope="module")
def links():
    return gaigs.links("synthetic_rssi", transmitters=60, order=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("ensemble")


@pytest.fixture(scope="module")
def model(links, folder):
    return gaigs.train("gaigs", links, ensemble=3, seed=4, folder=folder, **FEW)


def test_members_are_the_models_of_successive_seeds(links, model):
    places = [[1.0, 2.0, 1.5], [2.0, 1.0, 1.0]]
    assert len(model.members) == 3
    alone = gaigs.train("gaigs", links, seed=6, **FEW)
    torch.testing.assert_close(model.members[2].predict(places), alone.predict(places))
    values = np.stack([member.predict(places).numpy() for member in model.members])
    np.testing.assert_allclose(model.predict(places), values.mean(0), rtol=1e-5)
    assert (values.std(0) > 0).all()


def test_deviations_are_those_of_the_members(links, model):
    train = links.batch(links.split.train)
    every = np.stack([member.predict(train.query).numpy() for member in model.members])
    assert model.typical.item() == pytest.approx(every.var(0, ddof=1).mean(), rel=1e-4)
    batch = links.batch(links.split.test[:5])
    values = np.stack([member.predict(batch.query).numpy() for member in model.members])
    expected = np.sqrt((2 * values.var(0, ddof=1) + 4 * model.typical.item()) / 6)
    np.testing.assert_allclose(model.deviations(batch).detach(), expected, rtol=1e-4)


def test_an_ensemble_is_stored_whole_and_a_finished_one_is_not_trained_again(links, model, folder):
    loaded = gaigs.load(folder / "best.ckpt")
    assert isinstance(loaded, Ensemble)
    place = [1.0, 2.0, 1.5]
    for own, other in zip(
        model.predict(place, interval=0.5), loaded.predict(place, interval=0.5), strict=True
    ):
        torch.testing.assert_close(own, other)
    again = gaigs.train("gaigs", links, ensemble=3, seed=4, folder=folder, **FEW)
    torch.testing.assert_close(again.predict(place), model.predict(place))
    steps = [checkpoint.read(path)["global_step"] for path in folder.glob("members/*/last.ckpt")]
    assert steps == [2, 2]


def test_channels_deviate_by_the_size_of_their_complex_difference():
    links = gaigs.links("synthetic_csi", transmitters=20, order=0)
    friis = [gaigs.registries["model"].build("friis", scene=links.scene) for _ in range(2)]
    for one in friis:
        one.fit(links)
    ensemble = Ensemble(links.scene, friis)
    ensemble.members[1].forward = lambda batch: type(friis[0](batch))(
        1j * friis[0](batch).value, {}
    )
    batch = links.batch(links.split.test[:3])
    power = friis[0](batch).value.abs().square().mean((1, 2))
    torch.testing.assert_close(ensemble.deviations(batch), (power / 5).sqrt())


def test_kriging_has_the_ensemble_as_its_trend(tmp_path, monkeypatch):
    options = ScalarOptions(neighbours=4, iterations=2)
    monkeypatch.setattr(ScalarProcess, "options", options)
    links = gaigs.links("synthetic_rssi", transmitters=20, order=0)
    model = gaigs.train("gaigs", links, ensemble=2, kriging=True, folder=tmp_path, **FEW)
    assert isinstance(gaigs.load(tmp_path / "best.ckpt").trend, Ensemble)
    weights = checkpoint.trained_weights(checkpoint.read(tmp_path / "best.ckpt"))
    first = model.trend.members[0].state_dict()
    assert {f"model.{name}" for name in first} == weights.keys()


def test_an_ensemble_has_a_member_and_one_process_and_is_not_trained_again(links):
    with pytest.raises(ValueError, match="ensemble must be at least 1"):
        gaigs.train("gaigs", links, ensemble=0, **FEW)
    with pytest.raises(
        ValueError, match=r"an ensemble trains in one process; set trainer\.devices=1"
    ):
        gaigs.train("gaigs", links, "trainer.devices=2", "trainer.strategy=ddp", ensemble=2, **FEW)
    with pytest.raises(
        ValueError,
        match=r"max_time and model=auto work with one process; with several, set trainer",
    ):
        gaigs.train(
            "gaigs",
            links,
            "trainer.devices=2",
            "trainer.strategy=ddp",
            max_time="00:00:10:00",
            **FEW,
        )
    model = Ensemble(links.scene, [GaussianSplatting(links.scene, gaussians={"count": 20})])
    with pytest.raises(ValueError, match=r"train one of its models, members\[0\]"):
        gaigs.train(model, links, **FEW)


def test_all_members_are_rendered():
    links = gaigs.links("synthetic", transmitters=10, order=0)
    model = Ensemble(
        links.scene, [GaussianSplatting(links.scene, gaussians={"count": 20}) for _ in range(3)]
    )
    assert len(model.rendering(links.batch(links.split.test[:1]))()) == 3


def test_deviations_do_not_depend_on_the_asked_directions():
    links = gaigs.links("synthetic", transmitters=30, order=0)
    model = Ensemble(
        links.scene, [GaussianSplatting(links.scene, gaussians={"count": 20}) for _ in range(2)]
    )
    batch = links.batch(links.split.test[:2])
    few = gaigs.Grid.degrees([30], [40])
    expected = model.deviations(batch)
    assert (expected > 0).all()
    torch.testing.assert_close(model.deviations(replace(batch, directions=few)), expected)


@pytest.mark.parametrize("other", ["path_loss", "gaigs"])
def test_held_out_predictions_of_a_blend_have_not_seen_their_links(links, other):
    nearest = registry("model").build({"name": "knn", "k": 1}, scene=links.scene)
    nearest.fit(links)
    members = [nearest, gaigs.train(other, links, **(FEW if other == "gaigs" else {}))]
    blend = Ensemble(links.scene, members, [0.5, 0.5]).eval()
    blend.fit(links)
    unseen = [*blend.unseen(links)]
    assert unseen
    for part in unseen:
        query = links.query[part.asked]
        # The nearest neighbour of a known link is the link itself.
        torch.testing.assert_close(nearest.predict(query), links.labels[part.asked])
        held_out, other_one = part.model.members
        assert not torch.allclose(held_out.predict(query), links.labels[part.asked])
        expected = (held_out.predict(query) + other_one.predict(query)) / 2
        torch.testing.assert_close(part.model.predict(query), expected)
