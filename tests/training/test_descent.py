"""Descent: its loss, rates, logs and validation by independent formulas; the batch of a step;
refusals.
"""

from dataclasses import replace

import pytest
import torch
from fitting import Plane, fit, make_module
from lightning.pytorch.callbacks import Callback
from skimage.metrics import structural_similarity
from torch import nn

from gaigs.core.geometry import Rays
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.model import Model, Prediction
from gaigs.report.training_log import read_curves
from gaigs.splatting.loss.absolute import Absolute
from gaigs.splatting.loss.relative_error import RelativeError


@pytest.fixture
def module(links):
    return make_module(links)


class Referee(Callback):
    """Rates, corners and losses of all steps; each loss is compared with scikit-image's, from the
    whole label.
    """

    def __init__(self):
        self.rates, self.losses, self.offsets = [], [], []

    def on_train_batch_end(self, trainer, module, outputs, batch, _):
        rows, columns = (
            torch.rad2deg(x).round().int().tolist()
            for x in vars(module.model.batch.directions).values()
        )
        assert rows == list(range(rows[0], 24, 3))
        assert columns == list(range(columns[0], 30, 3))
        labels = batch.labels[:, rows[0] :: 3, columns[0] :: 3].double()
        predictions = module.model.prediction.value.detach().double()
        pairs = zip(labels.numpy(), predictions.numpy(), strict=True)
        ssim = sum(structural_similarity(*pair, data_range=1.0, win_size=3) for pair in pairs) / 4
        mae = (labels - predictions).abs().mean().item()
        expected = (
            0.75 * mae + 0.25 * (1 - ssim) + 0.5 * module.model.prediction.penalties["gain"].item()
        )
        assert outputs["loss"].item() == pytest.approx(expected, abs=1e-5)
        self.losses.append(outputs["loss"].item())
        self.offsets.append((rows[0], columns[0]))
        self.rates.append([group["lr"] for group in trainer.optimizers[0].param_groups])


def test_a_training_is_the_papers_at_rates_of_its_own(links, tmp_path):
    referee, again, other = Referee(), Referee(), Referee()
    trainer = fit(make_module(links), links, tmp_path / "a", 30, referee)
    # The rate recorded after step k is that of step k + 1.
    factors = [min(1, (k + 1) / 4) * 0.1 ** (k / 30) for k in range(1, 31)]
    torch.testing.assert_close(
        torch.tensor(referee.rates), torch.tensor([[0.01 * f, 0.02 * f] for f in factors])
    )
    groups = trainer.optimizers[0].param_groups
    assert [(group["name"], group["weight_decay"]) for group in groups] == [
        ("slope", 0.0),
        ("network", 0.3),
    ]
    assert {*referee.offsets} == {(row, column) for row in range(3) for column in range(3)}
    curves = read_curves(list(tmp_path.glob("a/log/*/metrics.csv")))
    assert curves["train/loss"][0].tolist() == list(range(1, 30, 2)), (
        "every second step, counted from 0"
    )
    assert curves["train/loss"][1].tolist() == pytest.approx(referee.losses[1::2])
    terms = {
        name.partition("/")[2]: curves[name][1]
        for name in ("train/l1", "train/ssim", "penalty/gain")
    }
    blend = 0.75 * terms["l1"] + 0.25 * terms["ssim"] + 0.5 * terms["gain"]
    assert blend.tolist() == pytest.approx(referee.losses[1::2])
    assert curves["validation/ssim"][0].tolist() == [4, 9, 14, 19, 24, 29]
    torch.manual_seed(99)
    fit(make_module(links), links, tmp_path / "b", 6, again)
    fit(make_module(links, seed=1), links, tmp_path / "c", 6, other)
    assert again.offsets == referee.offsets[:6] != other.offsets, "seed and step decide"


def test_validation_scores_whole_spectra_alike_as_the_model_evaluates_them(
    module, links, tmp_path, monkeypatch
):
    asked, evaluate = [], Plane.evaluate

    def record(self, batch):
        assert not torch.is_grad_enabled()
        asked.append((len(batch), batch.directions.shape))
        return evaluate(self, batch)

    monkeypatch.setattr(Plane, "evaluate", record)
    trainer = fit(module, links, tmp_path, 5)
    assert asked == [(2, (24, 30)), (1, (24, 30))]
    labels, prediction = (
        links.labels[links.split.validation],
        module.model.predict(links.query[links.split.validation]),
    )
    pairs = zip(labels.numpy(), prediction.numpy(), strict=True)
    ssim = sum(structural_similarity(*pair, data_range=1.0) for pair in pairs) / 3
    assert trainer.callback_metrics["validation/ssim"].item() == pytest.approx(ssim, abs=1e-6)
    mae = (labels - prediction).abs().mean().item()
    assert trainer.callback_metrics["validation/mae"].item() == pytest.approx(mae, abs=1e-6)


def test_shares_weigh_the_loss_by_links_and_the_penalties_by_places(module, links, tmp_path):
    """As where several processes train, though there is one."""
    shares, seen = (1.75, 0.5), []

    class Shared(Callback):
        def on_train_batch_start(self, trainer, module, batch, _):
            batch.shares = shares

        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            seen.append((outputs["loss"].item(), module.model.prediction.penalties["gain"].item()))

    module.loss = lambda values, batch: (values.sum() * 0 + 3.0, {"three": torch.tensor(3.0)})
    fit(module, links, tmp_path, 2, Shared())
    for loss, gain in seen:
        assert loss == pytest.approx(1.75 * 3 + 0.5 * 0.5 * gain)
    curves = read_curves(list(tmp_path.glob("log/*/metrics.csv")))
    logged = [curves[name][1].item() for name in ("train/loss", "train/three", "penalty/gain")]
    assert logged == pytest.approx([seen[1][0], 1.75 * 3, 0.5 * seen[1][1]])


def test_double_precision_reaches_model_data_and_scores(module, links, tmp_path):
    trainer = fit(module, links, tmp_path, 5, precision="64-true")
    assert {parameter.dtype for parameter in module.model.parameters()} == {torch.float64}
    assert module.model.batch.query.transmitters.dtype == torch.float64
    index = links.split.validation
    query = replace(links.query[index], transmitters=links.query.transmitters[index].double())
    prediction = module.model.evaluate(replace(links.batch(index), query=query))
    mae = (links.labels[index] - prediction).abs().mean().item()
    assert trainer.callback_metrics["validation/mae"].item() == pytest.approx(mae, abs=1e-6)


# --- the batch of a step ---


def test_rays_are_random_pixels_of_all_links_alike(links, tmp_path):
    seen = []

    class Rayed(Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            rays, prediction = module.model.batch.directions, module.model.prediction
            assert isinstance(rays, Rays)
            rows, columns = (
                torch.rad2deg(x).round().long() for x in (rays.elevations, rays.azimuths)
            )
            assert len({*zip(rows.tolist(), columns.tolist(), strict=True)}) == 50
            mae = (batch.labels[:, rows, columns] - prediction.value).abs().mean().item()
            assert outputs["loss"].item() == pytest.approx(
                mae + 0.5 * prediction.penalties["gain"].item(), rel=1e-5
            )
            seen.append((30 * rows + columns).tolist())

    trainer = fit(make_module(links, thinning={"rays": 50}), links, tmp_path, 12, Rayed())
    assert len({tuple(sorted(rays)) for rays in seen}) == 12
    assert len({ray for rays in seen for ray in rays}) > 350, (
        "of 720; 50 of them 12 times leave 303 out on average"
    )
    assert "validation/ssim" in trainer.callback_metrics, "of whole spectra"


def test_a_step_takes_some_links_anew(links, monkeypatch):
    batch, seen = links.batch(torch.arange(12)), []
    module = make_module(links)
    module.links = 5
    for step in range(40):
        monkeypatch.setattr(type(module), "global_step", step)
        part = module.prepare(batch)
        rows = (
            (part.query.transmitters[:, None] == batch.query.transmitters)
            .all(-1)
            .nonzero()[:, 1]
            .tolist()
        )
        assert len(part) == len(part.labels) == len({*rows}) == 5
        seen.append(tuple(rows))
    assert len({*seen}) > 30
    assert {*sum(seen, ())} == {*range(12)}
    module.links = 12
    assert len(module.prepare(batch)) == 12


def test_jitter_moves_all_links_of_a_place_alike_and_anew_in_every_step(
    links, tmp_path, monkeypatch
):
    """Links by threes at one place; the third of them has another carrier."""
    places, carriers = torch.arange(12) // 3, torch.tensor([1e9, 1e9, 1.1e9]).repeat(4)
    query = Query(links.query.transmitters[places], torch.arange(12) % 2, carriers)
    crowd, before = replace(links.batch(torch.arange(12)), query=query), query.transmitters.clone()

    def moves(step, **options):
        module = make_module(links, **options)
        monkeypatch.setattr(type(module), "global_step", step)
        batch = module.prepare(crowd)
        assert torch.equal(batch.query.receivers, query.receivers)
        assert torch.equal(batch.query.frequencies, query.frequencies)
        return batch.query.transmitters - before

    moved = torch.stack([moves(step, jitter=0.1) for step in range(100)])
    assert torch.equal(moved[:, 0::3], moved[:, 1::3]), "one place, one carrier"
    assert (moved[:, 0::3] != moved[:, 2::3]).all(), "another carrier is another place"
    independent = moved.unflatten(1, (4, 3))[:, :, 1:].flatten()
    # Of 2,400 draws the deviation is known to 1 / sqrt(4800) = 1.4 %, and their mean to 0.1 /
    # sqrt(2400).
    assert independent.std().item() == pytest.approx(0.1, rel=0.05)
    assert abs(independent.mean().item()) < 0.008
    assert len(independent.unique()) > 2350
    assert torch.equal(query.transmitters, before), "the data stay where they are"
    assert torch.equal(moves(3, jitter=0.1), moved[3])
    assert not torch.equal(moves(3, jitter=0.1, seed=1), moved[3])
    assert not moves(5).any(), "none by default"
    monkeypatch.undo()
    module = make_module(links, jitter=5.0)
    fit(module, links, tmp_path, 5)
    assert torch.equal(module.model.batch.query.transmitters, links.query.transmitters[10:11]), (
        "none to validate"
    )


# --- other tasks ---


class Slope(Model):
    """A label that rises with x, of any task without directions."""

    def __init__(self, scene):
        super().__init__(scene)
        self.slope = nn.Parameter(torch.tensor(2.0))

    def forward(self, batch):
        task, value = self.scene.task, self.slope * batch.query.transmitters[:, 0]
        value = value.reshape(-1, *[1] * len(task.shape)).expand(-1, *task.shape)
        return Prediction(value.to(task.dtype), {})


def test_complex_channels_are_trained_and_scored_by_snr(links, tmp_path):
    generator = torch.Generator().manual_seed(0)
    labels = torch.randn(12, 2, 5, dtype=torch.complex64, generator=generator)
    channels = replace(links, labels=labels, task=Csi(2, 1e9 + 1e6 * torch.arange(5)))
    module = make_module(
        channels, Slope(channels.scene), RelativeError(channels.task), thinning={}, jitter=0.01
    )
    trainer = fit(module, channels, tmp_path, 5)
    assert module.model.slope.item() != 2.0
    index = channels.split.validation
    guesses, truth = (
        part.flatten(1) for part in (module.model.predict(channels.query[index]), labels[index])
    )
    snr = -10 * ((truth - guesses).abs().square().sum(1) / truth.abs().square().sum(1)).log10()
    assert trainer.callback_metrics["validation/snr_db"].item() == pytest.approx(
        snr.mean().item(), abs=1e-5
    )


# --- refusals ---


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"learning_rates": {"slop": 0.1}},
            r"no key 'slop' \(did you mean 'slope'\?\); it has: network",
        ),
        (
            {"learning_rates": {"slope": -0.1}},
            r"training\.learning_rates\.slope must be at least 0, got -0\.1",
        ),
        (
            {"learning_rates": {"slope": float("nan")}},
            r"training\.learning_rates\.slope must be at least 0, got nan",
        ),
        (
            {"penalties": {"gian": 1.0}},
            r"training\.penalties has no key 'gian' \(did you mean 'gain'\?\)",
        ),
        ({"penalties": {"gain": -1.0}}, r"training\.penalties\.gain must be at least 0, got -1\.0"),
        ({"jitter": -0.1}, r"training\.jitter must be at least 0 m, got -0\.1"),
        ({"jitter": float("nan")}, r"training\.jitter must be at least 0 m, got nan"),
        (
            {"thinning": {"strid": 3}},
            r"no option 'strid' \(did you mean 'stride'\?\); it has: stride, rays",
        ),
        ({"thinning": {"stride": 0}}, r"training\.thinning\.stride must be at least 1, got 0"),
        ({"thinning": {"rays": 721}}, r"rays must be in 1\.\.720 with stride=1, got 721"),
        ({"thinning": {"rays": 5, "stride": 2}}, "with stride=1, got 5, stride 2"),
    ],
)
def test_values_out_of_range_and_unknown_names_are_refused(links, options, message):
    with pytest.raises(ValueError, match=message):
        make_module(links, **options)


def test_a_model_has_to_suit_the_training(links, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Plane, "trained_by", "adversarial")
        with pytest.raises(
            ValueError, match="this model is trained by 'adversarial'; set training=adversarial"
        ):
            make_module(links)
    with monkeypatch.context() as patch:
        patch.setattr(Plane, "learning_rates", {"network": 0.1})
        with pytest.raises(
            ValueError, match="the model has no learning rate for slope; add it to learning_rates"
        ):
            make_module(links)
    monkeypatch.setattr(Plane, "penalty_weights", {})
    with pytest.raises(
        ValueError, match="the model has no weight of its penalty 'gain'; add it to penalty_weights"
    ):
        fit(make_module(links), links, tmp_path, 2)
    readings = replace(links, labels=torch.zeros(12), task=Rssi())
    with pytest.raises(
        ValueError, match=r"training\.thinning has no option 'stride'; it has: none"
    ):
        make_module(readings, Slope(readings.scene), Absolute(readings.task))


# --- not finite ---


def poison(module, name):
    """Has a part, or the model itself, give NaN."""
    part = module.model.get_submodule(name)
    forward = part.forward

    def poisoned(*arguments):
        output = forward(*arguments)
        return (
            output._replace(value=output.value * torch.nan)
            if isinstance(output, Prediction)
            else output * torch.nan
        )

    part.forward = poisoned


def poison_penalty(module, batch):
    forward = module.model.forward
    module.model.forward = lambda batch: forward(batch)._replace(
        penalties={"gain": torch.tensor(torch.nan)}
    )


def poison_loss(module, batch):
    loss = module.loss
    module.loss = lambda value, batch: (
        loss(value, batch)[0] * torch.nan,
        {"l1": torch.tensor(torch.nan)},
    )


RATES_DID_IT = r"lower training\.learning_rates"
NO_RATE_DID = "no rate has acted yet, so check the options of that part"


@pytest.mark.parametrize(
    ("at", "breaks", "where", "remedy"),
    [
        (
            0,
            lambda module, _: module.model.slope.data.mul_(torch.nan),
            "the parameter slope",
            NO_RATE_DID,
        ),
        (
            2,
            lambda module, _: module.model.slope.data.mul_(torch.nan),
            "the parameter slope",
            RATES_DID_IT,
        ),
        (0, lambda module, _: poison(module, "network"), "the output of network", NO_RATE_DID),
        (0, lambda module, _: poison(module, ""), "the prediction", NO_RATE_DID),
        (0, poison_penalty, "the penalty gain", NO_RATE_DID),
        (1, poison_loss, "the term l1", RATES_DID_IT),
        (
            0,
            lambda _, batch: batch.query.transmitters.mul_(torch.nan),
            "the places as training.jitter",
            NO_RATE_DID,
        ),
        (1, lambda _, batch: batch.labels.mul_(torch.nan), "the data's labels", "check the files"),
    ],
)
def test_a_loss_that_is_not_finite_ends_the_training(
    module, links, tmp_path, at, breaks, where, remedy
):
    class Breaks(Callback):
        def on_train_batch_start(self, trainer, module, batch, _):
            if trainer.global_step == at:
                breaks(module, batch)

    links = replace(links, labels=links.labels.clone())
    message = f"^the loss must stay finite, got nan at step {at}, first in {where}.*; {remedy}$"
    with pytest.raises(ValueError, match=message):
        fit(module, links, tmp_path, 3, Breaks())
