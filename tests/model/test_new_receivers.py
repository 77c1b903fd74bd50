"""Receivers that no measurement has."""

import math
from dataclasses import replace

import pytest
import torch

import gaigs
from gaigs.calibration.new_receivers import fit_law
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.model.answers import predicted, share_at_new
from gaigs.model.friis import Friis
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mirrored import MirroredSplatting
from gaigs.model.path_loss import PathLoss
from gaigs.planes.box_search import BoxSearch, Cuboid
from gaigs.registry import registry

PLACES = torch.tensor([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]])


@pytest.fixture(scope="module")
def links():
    return gaigs.links("synthetic_rssi", transmitters=60)


@pytest.fixture(scope="module")
def path_loss(links):
    model = PathLoss(links.scene)
    model.fit(links)
    return model


def test_a_new_receiver_has_the_mean_law(path_loss):
    distances = (PLACES - torch.tensor([3.0, 2.0, 2.0])).norm(dim=1)
    law = path_loss.levels.mean() - 10 * path_loss.exponents.mean() * distances.log10()
    for receiver in (
        [3, 2, 2],
        [3.0, 2.0, 2.0],
        Pose.at([3.0, 2.0, 2.0]),
        Receiver("door", Pose.at([3.0, 2.0, 2.0])),
    ):
        torch.testing.assert_close(path_loss.predict(PLACES, receiver=receiver), law)


def test_whole_numbers_beside_as_many_transmitters_are_indices(path_loss):
    places = PLACES[[0, 1, 0]]
    indices = path_loss.predict(places, receiver=[3, 2, 2])
    every = path_loss.predict(places)
    torch.testing.assert_close(indices, torch.stack((every[0, 3], every[1, 2], every[2, 2])))


def test_a_receiver_that_is_turned_is_another_one():
    channels = gaigs.links("synthetic_csi", transmitters=30, order=0)
    friis = Friis(channels.scene)
    friis.fit(channels)
    known = channels.receivers[0]
    turned = Pose(known.pose.position, known.pose.rotation.roll(1, 1))
    there = friis.predict(PLACES, receiver=Receiver(known.name, turned, known.array))
    assert not torch.equal(there, friis.predict(PLACES, receiver=0))


def test_phases_of_cables_do_not_weaken_a_new_receiver(links):
    channels = gaigs.links("synthetic_csi", transmitters=30, order=0, receivers=3)
    friis = Friis(channels.scene)
    friis.fit(channels)
    friis.gains.copy_(torch.polar(torch.full((3,), 2.0), torch.tensor([0.0, 2.0, 4.0])))
    moved = friis.at_receivers(channels.receivers[:1])
    torch.testing.assert_close(moved.gains.abs(), torch.tensor([2.0]))


def test_a_far_receiver_warns(path_loss):
    with pytest.warns(gaigs.core.geometry.ExtrapolationWarning, match="a receiver is"):
        path_loss.predict(PLACES, receiver=[1e4, 0.0, 2.0])


@pytest.mark.parametrize("names", [[], ["a", "a"]])
def test_new_receivers_have_names_of_their_own(path_loss, names):
    receivers = [Receiver(name, Pose.at([3.0, 2.0, 2.0])) for name in names]
    with pytest.raises(ValueError, match="each with a name of its own"):
        path_loss.at_receivers(receivers)


def test_a_receiver_of_the_scene_is_known(path_loss, links):
    own = path_loss.predict(PLACES, receiver=links.receivers[1])
    assert torch.equal(own, path_loss.predict(PLACES, receiver="south"))


def test_batches_and_models_at_receivers_agree(path_loss):
    door = Receiver("door", Pose.at([3.0, 2.0, 2.0]))
    moved = path_loss.at_receivers([door, path_loss.scene.receivers[0]])
    values = moved.predict(PLACES)
    assert values.shape == (2, 2)
    assert torch.equal(values[:, 0], path_loss.predict(PLACES, receiver=door))
    assert torch.equal(values[:, 0], torch.cat([*path_loss.predict_batches(PLACES, door)]))
    own = path_loss.predict(PLACES, receiver=0)
    assert not torch.allclose(values[:, 1], own)  # of a receiver in general


def test_errors_say_what_to_do(path_loss, links):
    with pytest.raises(ValueError, match="receiver must be"):
        path_loss.predict(PLACES, receiver=[3.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        path_loss.predict(PLACES, receiver=[math.nan, 2.0, 2.0])
    knn = KNearestNeighbours(links.scene)
    knn.fit(links)
    with pytest.raises(ValueError, match="own receivers alone; for others take"):
        knn.predict(PLACES, receiver=[3.0, 2.0, 2.0])
    channels = gaigs.links("synthetic_csi", transmitters=20, order=0)
    friis = Friis(channels.scene)
    friis.fit(channels)
    with pytest.raises(ValueError, match="orientation"):
        friis.predict(PLACES, receiver=[3.0, 2.0, 2.0])


def test_free_space_reaches_a_new_array(links):
    channels = gaigs.links("synthetic_csi", transmitters=30, order=0)
    friis = Friis(channels.scene)
    friis.fit(channels)
    pose = channels.receivers[0].pose
    moved = Pose(pose.position + 0.5, pose.rotation)
    there = friis.predict(PLACES + 0.5, receiver=moved)
    torch.testing.assert_close(there, friis.predict(PLACES, receiver=0), atol=1e-6, rtol=1e-3)


def test_mirrored_gaussians_share_the_room(links, tmp_path):
    model = MirroredSplatting(links.scene, trend="mean")
    model.fit(links)
    with torch.no_grad():
        model.placement.receiver_gains.copy_(torch.tensor([0.0, 0.2, 0.4, 0.6]))
    model.eval()
    own = links.receivers[2]
    other = model.at_receivers([own])
    # The same room seen from the same place: gains differ alone.
    gain = 20 / math.log(10) * (0.3 - 0.4) + model.trend.means.mean() - model.trend.means[2]
    expected = model.predict(PLACES, receiver=2) + gain
    torch.testing.assert_close(other.predict(PLACES)[:, 0], expected, atol=1e-3, rtol=0)
    far = model.at_receivers([Receiver("far", Pose.at([14.0, 2.0, 2.0]))])
    far.save(tmp_path / "far.ckpt")  # the room does not move with the receivers
    assert torch.equal(gaigs.load(tmp_path / "far.ckpt").predict(PLACES), far.predict(PLACES))


def readings(links, receiver, index):
    """Some links of one receiver, which is their only one."""
    query = links.query[index]
    query.receivers = torch.zeros_like(query.receivers)
    only = {
        "query": query,
        "labels": links.labels[index],
        "receivers": (links.receivers[receiver],),
    }
    return replace(links, **only, split=None, rows=None)


def test_held_out_receivers_have_the_prediction_of_a_new_one():
    links = gaigs.links("synthetic_rssi", transmitters=60, split="receivers", hold=["west"])
    assert links.split.by_receivers
    assert set(links.query.receivers[links.split.test].tolist()) == {0}
    for name in ("path_loss", "mean", "gaussian_process"):
        model = gaigs.train(name, links, progress=False)
        new = model.predict(PLACES, receiver=Receiver("new", links.receivers[0].pose))
        torch.testing.assert_close(model.predict(PLACES, receiver="west"), new, msg=name)
    result = gaigs.evaluate(model, links)
    assert list(result.models) == ["gaussian_process", "mean", "path_loss"]  # knn has no neighbours
    with pytest.raises(ValueError, match="receivers with links alone"):
        gaigs.train("knn", links)


def test_trained_models_learn_nothing_of_receivers_that_validate_or_test():
    links = gaigs.links("synthetic_rssi", transmitters=40, receivers=6, split="receivers")
    model = MirroredSplatting(links.scene, trend="mean")
    model.fit(links)
    heard = links.query.receivers[links.split.train].unique()
    assert model.placement.is_heard.nonzero()[:, 0].tolist() == heard.tolist()
    others = [number for number in range(6) if number not in heard]
    assert torch.allclose(model.trend.means[others], model.trend.means[heard].mean())


def test_intervals_at_new_receivers_count_receivers(tmp_path):
    links = gaigs.links("synthetic_rssi", transmitters=80, receivers=9, split="receivers")
    model = gaigs.train("path_loss", links, progress=False)
    test = links.split.test
    estimate = model.predict(links.query[test], interval=0.9)
    at_known = model.predict(links.query[links.split.train], interval=0.9)
    assert (estimate.upper - estimate.lower).min() > (at_known.upper - at_known.lower).max()
    labels = links.labels[test]
    share = ((estimate.lower <= labels) & (labels <= estimate.upper)).double().mean()
    assert share > 0.8
    model.save(tmp_path / "room.ckpt")
    again = gaigs.load(tmp_path / "room.ckpt").predict(links.query[test], interval=0.9)
    assert torch.equal(again.upper, estimate.upper)
    moved = model.predict(PLACES, receiver=[3.0, 2.0, 2.0], interval=0.9)
    assert torch.isfinite(moved.std).all()


def test_intervals_know_receivers_up_to_the_last_with_links():
    links = gaigs.links(
        "synthetic_rssi", transmitters=150, receivers=4, split="receivers", hold="gateway4"
    )
    model = gaigs.train("path_loss", links, progress=False)
    assert torch.isfinite(model.predict(PLACES, interval=0.5).std).all()


def test_readings_at_a_new_receiver_correct_its_level():
    links = gaigs.links("synthetic_rssi", transmitters=80, receivers=9, split="receivers")
    model = gaigs.train("path_loss", links, progress=False)
    receiver = int(links.query.receivers[links.split.test[0]])
    own = (links.query.receivers == receiver).nonzero()[:, 0]
    far = readings(links, receiver, own[:60])
    far.labels.add_(20.0)  # cables and front end
    before = model.at_receivers(far.receivers)
    errors = []
    for count in (0, 3, 10, 60):
        some = readings(far, 0, torch.arange(max(count, 1)))
        moved = model.adapt(some) if count else before
        rest = far.query
        errors.append((moved.predict(rest) - far.labels).mean().abs().item())
    assert errors[0] > errors[1] > errors[2] > errors[3]
    wide, narrow = (one.predict(PLACES, 0, interval=0.9) for one in (before, moved))
    assert (narrow.upper - narrow.lower < wide.upper - wide.lower).all()
    repeated = readings(far, 0, torch.zeros(30, dtype=torch.long))
    once = model.adapt(readings(far, 0, torch.arange(1))).predict(PLACES)
    torch.testing.assert_close(model.adapt(repeated).predict(PLACES), once)
    with pytest.raises(ValueError, match="all readings together"):
        moved.adapt(far)
    with pytest.raises(ValueError, match="adapt takes a model of levels"):
        gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0)).adapt(far)


@pytest.mark.parametrize("levels", [[-50.0], [-50.0, -52.0], [-50.0, float("nan"), -52.0]])
def test_readings_too_few_for_a_split_are_taken(law, levels):
    door = Receiver("door", Pose.at([3.0, 0.2, 2.0]))
    spots = [[1.0, 2.0, 1.5], [2.0, 1.0, 1.5], [4.0, 2.5, 1.0]][: len(levels)]
    few = gaigs.links(task="rssi", transmitters=spots, receivers=[door], labels=levels)
    assert "degrees" not in few.remarks
    assert law[0].adapt(few).predict(spots).isfinite().all()
    assert len(few.split.train)


def drawn_errors(count, generator):
    """Errors of receivers with a level of 3 dB, a field of 4 dB and 2 m, and noise of 2 dB."""
    errors, places = [], []
    for _ in range(count):
        place = 10 * torch.rand(80, 3, generator=generator, dtype=torch.float64)
        field = 16 * (-torch.cdist(place, place) / 2).exp()
        factor = torch.linalg.cholesky(9 + field + 4 * torch.eye(80))
        errors.append(factor @ torch.randn(80, generator=generator, dtype=torch.float64))
        places.append(place)
    return errors, places


def test_the_law_of_errors_is_found_again():
    generator = torch.Generator().manual_seed(0)
    errors, places = drawn_errors(40, generator)
    errors[0], places[0] = errors[0][:30], places[0][:30]
    law = fit_law(errors, places)
    torch.testing.assert_close(law, torch.tensor([9.0, 4.0, 16.0, 2.0]).double(), rtol=0.3, atol=0)
    nothing = fit_law([torch.zeros(4)] * 3, [torch.zeros(4, 3)] * 3)
    assert nothing.isfinite().all()


def test_sparse_places_do_not_take_noise_for_a_field():
    """By their likelihood alone readings so far apart have no noise."""
    links = gaigs.links("synthetic_rssi", transmitters=80, receivers=9, split="receivers")
    scatter = gaigs.train("path_loss", links, progress=False).calibration.elsewhere.scatter
    assert 1 < scatter[1] < 9, "the noise of the simulated levels is 4 dB squared"


@pytest.fixture(scope="module")
def law():
    """A model that is asked for receivers without links, and these links."""
    links = gaigs.links("synthetic_rssi", transmitters=80, receivers=9, split="receivers")
    return gaigs.train("path_loss", links, progress=False), links


def test_readings_correct_places_near_them(law, tmp_path):
    model, links = law
    model.calibration.elsewhere.scatter.copy_(torch.tensor([9.0, 4.0, 16.0, 2.0]))
    few = readings(links, 0, torch.tensor([0]))
    few = replace(few, receivers=(Receiver("door", Pose.at([3.0, 2.0, 2.0])),))
    place = few.query.transmitters
    asked = torch.cat((place, PLACES, place + torch.tensor([8.0, 0.0, 0.0])))
    before = model.at_receivers(few.receivers).predict(asked)[:, 0]
    few.labels.copy_(before[:1] + 10)
    moved = model.adapt(few)
    shares = (9 + 16 * (-(asked - place).norm(dim=1) / 2).exp()) / 29
    torch.testing.assert_close(moved.predict(asked, receiver="door") - before, 10 * shares)
    moved.save(tmp_path / "door.ckpt")
    again = gaigs.load(tmp_path / "door.ckpt")
    found = again.predict(asked, receiver="door", interval=0.9)
    left = (1 - shares**2).sqrt()
    torch.testing.assert_close(found.std / found.std[-1], left / left[-1])
    other = [1.0, 1.0, 2.0]
    assert torch.equal(again.predict(PLACES, receiver=other), model.predict(PLACES, receiver=other))


def test_laws_of_older_checkpoints_have_a_level_and_noise(law):
    model, links = law
    older = replace(model.calibration.elsewhere, scatter=torch.tensor([9.0, 27.0]))
    model.calibration = replace(model.calibration, elsewhere=older)
    few = readings(links, 0, torch.tensor([0, 9]))
    before = model.at_receivers(few.receivers).predict(PLACES)
    few.labels.copy_(model.at_receivers(few.receivers).predict(few.query) + 10)
    moved = model.adapt(few).predict(PLACES)
    torch.testing.assert_close(moved - before, torch.full((2, 1), 10 * 9 / (9 + 27 / 2)))


@torch.no_grad()
@pytest.mark.parametrize("loss", [1.0, 50.0])
def test_boxes_of_levels_need_receivers_that_confirm_them(monkeypatch, loss):
    links = gaigs.links("synthetic_rssi", transmitters=30, receivers=6, split="receivers")
    model = MirroredSplatting(links.scene, placement={"name": "mirrored", "order": 1})
    model.fit(links)
    places = model.shadowed.query.transmitters
    proving = model.proof.query.receivers
    assert not torch.isin(proving, model.shadowed.query.receivers).any()
    ends = places.amin(0), places.amax(0)
    box = Cuboid(torch.stack(ends) - model.placement.middle, loss)
    monkeypatch.setattr(BoxSearch, "run", lambda search: [box])
    monkeypatch.setattr(BoxSearch, "gain", lambda search, boxes: 2.0 - boxes[0].loss)
    outcome = model._place_boxes()
    assert model.placement.obstacles.used.any() == (loss < 2)
    assert ("do not confirm" in outcome) == (loss > 2)


def test_levels_at_known_receivers_have_boxes_on_demand():
    links = gaigs.links("synthetic_rssi", transmitters=30, receivers=6)
    placement = {"name": "mirrored", "order": 1}
    model = MirroredSplatting(links.scene, placement=placement)
    model.fit(links)
    assert model.shadowed is None
    assert model._place_boxes() == ""
    model = MirroredSplatting(links.scene, placement=placement, boxes=True)
    model.fit(links)
    assert len(model.shadowed.labels) == len(links.split.train)
    assert not model.placement.path_gains.requires_grad


def test_kriged_levels_at_new_receivers_are_a_mean_with_path_loss(tmp_path):
    links = gaigs.links("synthetic_rssi", transmitters=60, receivers=6, split="receivers")
    options = {"max_steps": 2, "val_check_interval": 1, "enable_progress_bar": False}
    model = gaigs.train("mirrored", links, "kriging=true", folder=tmp_path, **options)
    share = model.new_weight.item()
    assert 0 < share < 1
    fallback = registry("model").build({"name": "path_loss"}, scene=links.scene)
    fallback.fit(replace(links, split=links.split.validating()))
    held = links.split.validation
    one, other = (predicted(part, links, held) for part in (model.trend, fallback))
    assert share_at_new(links, held, one, fallback) == pytest.approx(share)
    # The least of the mean square error over receivers, and of one receiver more for a half.
    receivers = links.query.receivers[held]
    tried = torch.linspace(0, 1, 1001, dtype=torch.float64)
    errors = tried[:, None] * (one - other).double() + (other - links.labels[held]).double()
    squares = [errors[:, receivers == number].square().mean(1) for number in receivers.unique()]
    mean = torch.stack(squares).mean(0)
    cost = mean + (mean[0] + mean[-1]) * (tried - 0.5) ** 2 / len(squares)
    assert tried[cost.argmin()] == pytest.approx(share, abs=1e-3)
    # Known and new receivers.
    new = model.predict(PLACES, receiver=Receiver("new", links.receivers[0].pose))
    parts = [
        part.predict(PLACES, receiver=Receiver("new", links.receivers[0].pose))
        for part in (model.trend, model.fallback)
    ]
    torch.testing.assert_close(new, share * parts[0] + (1 - share) * parts[1])
    test = links.split.test
    asked = links.query[test[links.query.receivers[test] == links.query.receivers[test[0]]][:3]]
    parts = [part.predict(asked) for part in (model.trend, model.fallback)]
    torch.testing.assert_close(model.predict(asked), share * parts[0] + (1 - share) * parts[1])
    torch.testing.assert_close(gaigs.load(tmp_path).predict(asked), model.predict(asked))
