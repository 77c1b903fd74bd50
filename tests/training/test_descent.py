from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from fitting import OPTIONS, Plane, fit, make_links, make_module
from lightning.pytorch.callbacks import Callback
from skimage.metrics import structural_similarity
from torch import nn
from torch.optim.lr_scheduler import ConstantLR

from gaigs.checkpoint import KEY
from gaigs.loss.absolute import Absolute
from gaigs.loss.huber import Huber
from gaigs.loss.relative_error import RelativeError
from gaigs.loss.squared import Squared
from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.report.curves import read_curves
from gaigs.task.csi import Csi
from gaigs.task.rssi import Rssi
from gaigs.training.finite import find_broken

GROUPS = {"slope": 0.01, "network": 0.02}


@pytest.fixture(scope="module")
def links():
    return make_links()


@pytest.fixture
def module(links):
    return make_module(links)


class Recorder(Callback):
    """Rates and loss of every step."""

    def __init__(self):
        self.rates, self.losses = [], []

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.rates.append([group["lr"] for group in trainer.optimizers[0].param_groups])
        self.losses.append(outputs["loss"].item())


class Referee(Callback):
    """Computes every step's loss from the prediction, with scikit-image, and from the whole label."""

    def on_train_batch_end(self, trainer, module, outputs, batch, _):
        row, column = (round(torch.rad2deg(x[0]).item()) for x in vars(module.model.batch.directions).values())
        labels = batch.labels[:, row::3, column::3].double()
        predictions = module.model.prediction.value.detach().double()
        pairs = zip(labels.numpy(), predictions.numpy(), strict=True)
        ssim = sum(structural_similarity(*pair, data_range=1.0, win_size=3) for pair in pairs) / 4
        mae = (labels - predictions).abs().mean().item()
        expected = 0.75 * mae + 0.25 * (1 - ssim) + 0.5 * module.model.prediction.penalties["gain"].item()
        assert outputs["loss"].item() == pytest.approx(expected, abs=1e-5)


def test_the_loss_blends_the_papers_terms_on_every_third_row_and_column(module, links, tmp_path):
    fit(module, links, tmp_path, 4, Referee())


def test_rates_rise_and_fall_and_each_group_has_its_own(module, links, tmp_path):
    recorder = Recorder()
    trainer = fit(module, links, tmp_path, 12, recorder)
    # What is recorded behind step k is the rate of step k + 1.
    factors = [min(1, (k + 1) / 4) * 0.1 ** (k / 12) for k in range(1, 13)]
    torch.testing.assert_close(torch.tensor(recorder.rates), torch.tensor([[0.01 * f, 0.02 * f] for f in factors]))
    groups = trainer.optimizers[0].param_groups
    assert [(group["name"], group["weight_decay"]) for group in groups] == [("slope", 0.0), ("network", 0.3)]


def test_optimizer_and_schedule_are_any_of_torch(links, tmp_path):
    """The training of SGD with momentum, at a quarter of its rate for 3 steps, by its formula."""
    module = make_module(
        links,
        optimizer={"_target_": "torch.optim.SGD", "momentum": 0.5},
        schedule={"_target_": "torch.optim.lr_scheduler.ConstantLR", "factor": 0.25, "total_iters": 3},
    )
    slope, gradients = module.model.slope.detach().clone(), []

    class Gradients(Callback):
        def on_before_optimizer_step(self, trainer, module, optimizer):
            gradients.append(module.model.slope.grad.clone())

    trainer = fit(module, links, tmp_path, 5, Gradients())
    assert type(trainer.optimizers[0]) is torch.optim.SGD
    assert type(trainer.lr_scheduler_configs[0].scheduler) is ConstantLR
    memory = torch.zeros(2)
    for gradient, rate in zip(gradients, [0.0025, 0.0025, 0.0025, 0.01, 0.01], strict=True):
        memory = 0.5 * memory + gradient
        slope -= rate * memory
    torch.testing.assert_close(module.model.slope.detach(), slope)


# --- scores and logs ---


def test_validation_scores_whole_spectra_and_weighs_them_alike(module, links, tmp_path):
    trainer = fit(module, links, tmp_path, 5)
    index = links.split.validation
    prediction = module.model.predict(links.query[index])
    ssim = [
        structural_similarity(a.numpy(), b.numpy(), data_range=1.0)
        for a, b in zip(links.labels[index], prediction, strict=True)
    ]
    assert trainer.callback_metrics["validation/ssim"].item() == pytest.approx(sum(ssim) / 3, abs=1e-6)
    mae = (links.labels[index] - prediction).abs().mean().item()
    assert trainer.callback_metrics["validation/mae"].item() == pytest.approx(mae, abs=1e-6)


def test_validation_asks_the_model_to_evaluate(module, links, tmp_path, monkeypatch):
    """Which may go through the directions by chunks."""
    asked = []

    def evaluate(self, batch):
        assert not torch.is_grad_enabled()
        asked.append((len(batch), batch.directions.shape))
        return torch.full_like(batch.labels, 0.25)

    monkeypatch.setattr(Plane, "evaluate", evaluate)
    trainer = fit(module, links, tmp_path, 5)
    assert asked == [(2, (24, 30)), (1, (24, 30))]
    mae = (links.labels[links.split.validation] - 0.25).abs().mean().item()
    assert trainer.callback_metrics["validation/mae"].item() == pytest.approx(mae, abs=1e-6)


def test_the_log_holds_the_loss_and_its_terms(module, links, tmp_path):
    recorder = Recorder()
    fit(module, links, tmp_path, 7, recorder)
    curves = read_curves(list(tmp_path.glob("log/*/metrics.csv")))
    assert curves["train/loss"][0].tolist() == [1, 3, 5], "every second step, counted from 0"
    assert curves["train/loss"][1].tolist() == pytest.approx(recorder.losses[1::2])
    terms = {name: curves[f"train/{name}"][1] for name in ("l1", "ssim", "gain")}
    blend = 0.75 * terms["l1"] + 0.25 * terms["ssim"] + 0.5 * terms["gain"]
    assert blend.tolist() == pytest.approx(recorder.losses[1::2])
    assert curves["validation/ssim"][0].tolist() == [4]


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
    logged = [curves[f"train/{name}"][1].item() for name in ("loss", "three", "gain")]
    assert logged == pytest.approx([seen[1][0], 1.75 * 3, 0.5 * seen[1][1]])


def test_a_checkpoint_says_whose_it_is(module):
    checkpoint = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint == {KEY: {"who": "the plane"}}


def test_twice_the_digits(links, tmp_path):
    """trainer.precision=64-true."""
    module = make_module(links)
    trainer = fit(module, links, tmp_path, 5, precision="64-true")
    assert {parameter.dtype for parameter in module.model.parameters()} == {torch.float64}
    assert module.model.batch.query.transmitters.dtype == torch.float64
    index = links.split.validation
    query = replace(links.query[index], transmitters=links.query.transmitters[index].double())
    prediction = module.model.evaluate(replace(links.batch(index), query=query))
    mae = (links.labels[index] - prediction).abs().mean().item()
    assert trainer.callback_metrics["validation/mae"].item() == pytest.approx(mae, abs=1e-6)


# --- refusals ---


@pytest.mark.parametrize(
    ("rates", "error", "message"),
    [
        ({"network": 0.1}, ValueError, r"training\.learning_rates must give a rate for slope"),
        (
            GROUPS | {"slop": 0.1, "zzz": 1.0},
            ValueError,
            r"rates has 'slop' \(did you mean 'slope'\?\) and 'zzz', and the model's groups are network, slope",
        ),
        (GROUPS | {"slope": -0.1}, ValueError, r"training\.learning_rates\.slope must be at least 0, got -0\.1"),
        (GROUPS | {"slope": float("nan")}, ValueError, r"learning_rates\.slope must be at least 0, got nan"),
    ],
)
def test_rates_are_those_of_the_models_groups(links, rates, error, message):
    with pytest.raises(error, match=message):
        make_module(links, learning_rates=rates)


def test_rates_of_the_splatting_pipeline_may_stay(links):
    default = {"means": 5e-3, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 1e-2, "signal": 3e-2}
    make_module(links, learning_rates=GROUPS | default)


@pytest.mark.parametrize(
    ("penalties", "message"),
    [
        ({"opacity": 1.0}, r"training\.penalties must give a weight for gain; 0 for none"),
        ({"gain": 1.0, "gian": 0.5}, r"training\.penalties has 'gian' \(did you mean 'gain'\?\), and the model has no"),
        ({"gain": 1.0, "opacty": 0.5}, r"training\.penalties has 'opacty' \(did you mean 'opacity'\?\), and the model"),
    ],
)
def test_penalties_are_those_of_the_model(links, tmp_path, penalties, message):
    with pytest.raises(ValueError, match=message):
        fit(make_module(links, penalties=penalties), links, tmp_path, 3)


@pytest.mark.parametrize("weight", [-1.0, float("nan")])
def test_weights_of_penalties_are_not_negative(links, weight):
    with pytest.raises(ValueError, match=rf"training\.penalties\.gain must be at least 0, got {weight}"):
        make_module(links, penalties={"gain": weight})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rates": GROUPS | {"slope": None}}, "'learning_rates', entry 'slope', must be a number, got None"),
        ({"learning_rates": GROUPS | {"slope": "abc"}}, "'learning_rates', entry 'slope', must be a number, got 'abc'"),
        ({"learning_rates": [0.1]}, r"'learning_rates' must be a mapping, got \[0\.1\]"),
        ({"penalties": {"gain": "1"}}, "'penalties', entry 'gain', must be a number, got '1'"),
        ({"penalties": {"gain": float("nan")}}, "'penalties', entry 'gain', must be a finite number, got nan"),
        ({"penalties": None}, "'penalties' must be a mapping, got None"),
        ({"thinning": None}, "'thinning' must be a mapping, got None"),
        ({"optimizer": None}, "'optimizer' must be a mapping, got None"),
        ({"density": 3}, "'density' must be a mapping or null, got 3"),
    ],
)
def test_options_are_of_their_types(links, options, message):
    context = {"model": Plane(links.scene), "loss": None, "identity": {}, "seed": 0}
    with pytest.raises(TypeError, match=f"^training 'descent' option {message}$"):
        registry("training").build({"name": "descent", **OPTIONS, **options}, **context)


def test_the_default_penalty_may_stay(links, tmp_path):
    fit(make_module(links, penalties={"gain": 0.0, "opacity": 1.0}), links, tmp_path, 2)


class Breaks(Callback):
    """Makes something NaN before a step."""

    def __init__(self, at, breaks):
        self.at, self.breaks = at, breaks

    def on_train_batch_start(self, trainer, module, batch, _):
        if trainer.global_step == self.at:
            self.breaks(module, batch)


def poison(module, name):
    """Has a part, or the model itself, give NaN."""
    part = module.model.get_submodule(name)
    forward = part.forward

    def poisoned(*arguments):
        output = forward(*arguments)
        return output._replace(value=output.value * torch.nan) if isinstance(output, Prediction) else output * torch.nan

    part.forward = poisoned


def poison_penalty(module, batch):
    forward = module.model.forward
    module.model.forward = lambda batch: forward(batch)._replace(penalties={"gain": torch.tensor(torch.nan)})


def poison_loss(module, batch):
    loss = module.loss
    module.loss = lambda value, batch: (loss(value, batch)[0] * torch.nan, {"l1": torch.tensor(torch.nan)})


RATES_DID_IT = r"lower training\.learning_rates"
NO_RATE_DID = "no rate has acted yet, so check the options of that part"


@pytest.mark.parametrize(
    ("at", "breaks", "what", "remedy"),
    [
        (0, lambda module, _: module.model.slope.data.mul_(torch.nan), "the parameter slope", NO_RATE_DID),
        (2, lambda module, _: module.model.slope.data.mul_(torch.nan), "the parameter slope", RATES_DID_IT),
        (0, lambda module, _: poison(module, "network"), "the output of network", NO_RATE_DID),
        (0, lambda module, _: poison(module, ""), "the prediction", NO_RATE_DID),
        (0, poison_penalty, "the penalty gain", NO_RATE_DID),
        (1, poison_loss, "the term l1", RATES_DID_IT),
        (0, lambda _, batch: batch.query.transmitters.mul_(torch.nan), "the places as training.jitter", NO_RATE_DID),
        (1, lambda _, batch: batch.labels.mul_(torch.nan), "the data's labels", "check the files"),
    ],
)
def test_a_loss_that_is_not_finite_ends_the_training(module, links, tmp_path, at, breaks, what, remedy):
    links = replace(links, labels=links.labels.clone())
    told = f"^the loss must stay finite, got nan at step {at}, and what is not finite there is {what}.*; {remedy}$"
    with pytest.raises(ValueError, match=told):
        fit(module, links, tmp_path, 3, Breaks(at, breaks))


def test_of_several_outputs_the_broken_one_is_told(module, links):
    class Told(NamedTuple):
        tokens: torch.Tensor | None
        residuals: torch.Tensor

    class Network(nn.Linear):
        def forward(self, x):
            return Told(None, super().forward(x) / 0)

    class Reads(Plane):
        def forward(self, batch):
            return Prediction(self.network(batch.query.transmitters).residuals, {})

    model = Reads(links.scene)
    model.network = Network(3, 1)
    assert find_broken(model, links.batch(torch.arange(3)), {}) == "residuals of network"


@pytest.mark.parametrize("jitter", [-0.1, float("nan")])
def test_jitter_refuses(links, jitter):
    with pytest.raises(ValueError, match=rf"training\.jitter must be at least 0 m, got {jitter}"):
        make_module(links, jitter=jitter)


def test_a_model_that_is_trained_otherwise_is_refused(links, monkeypatch):
    monkeypatch.setattr(Plane, "trained_by", "adversarial")
    with pytest.raises(ValueError, match="this model is trained by 'adversarial'; set training=adversarial"):
        make_module(links)


# --- other tasks ---


class Slope(Model):
    """A label that rises with x, of any task without directions."""

    def __init__(self, scene):
        super().__init__(scene)
        self.slope = nn.Parameter(torch.tensor(2.0))

    def forward(self, batch):
        value = self.slope * batch.query.transmitters[:, 0]
        task = self.scene.task
        value = value.reshape(-1, *[1] * len(task.shape)).expand(-1, *task.shape)
        return Prediction(value.to(task.dtype), {})


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        (Absolute, {}, lambda e: e.abs()),
        (Squared, {}, lambda e: e**2),
        (Huber, {"delta": 60.0}, lambda e: torch.where(e.abs() < 60, e**2 / 2, 60 * (e.abs() - 30))),
    ],
)
def test_rssi_is_trained_and_scored_in_db(links, tmp_path, kind, options, expected):
    readings = replace(links, labels=torch.linspace(-90, -40, 12), task=Rssi())
    losses = []

    class Losses(Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            errors = 2 * batch.query.transmitters[:, 0] - batch.labels
            assert outputs["loss"].item() == pytest.approx(expected(errors).mean().item())
            losses.append(errors.abs().mean().item())

    options = {"loss": kind(readings.task, **options), "thinning": {}, "penalties": {}}
    options |= {"optimizer": {"_target_": "torch.optim.SGD"}, "learning_rates": {"network": 0.0}}
    module = make_module(readings, Slope(readings.scene), **options)
    trainer = fit(module, readings, tmp_path, 5, Losses())
    curves = read_curves(list(tmp_path.glob("log/*/metrics.csv")))
    assert curves["train/mae"][1].tolist() == pytest.approx(losses[1::2])
    index = readings.split.validation
    errors = module.model.predict(readings.query[index]) - readings.labels[index]
    assert trainer.callback_metrics["validation/mae_db"].item() == pytest.approx(errors.abs().mean().item(), rel=1e-6)


def test_complex_channels_are_trained_and_scored_by_snr(links, tmp_path):
    generator = torch.Generator().manual_seed(0)
    labels = torch.randn(12, 2, 5, dtype=torch.complex64, generator=generator)
    channels = replace(links, labels=labels, task=Csi(2, 1e9 + 1e6 * torch.arange(5)))
    options = {"loss": RelativeError(channels.task), "thinning": {}, "penalties": {}}
    options["learning_rates"] = {"network": 0.1}
    module = make_module(channels, Slope(channels.scene), jitter=0.01, **options)
    trainer = fit(module, channels, tmp_path, 5)
    assert module.model.slope.item() != 2.0
    index = channels.split.validation
    guesses, truth = (part.flatten(1) for part in (module.model.predict(channels.query[index]), labels[index]))
    snr = -10 * ((truth - guesses).abs().square().sum(1) / truth.abs().square().sum(1)).log10()
    assert trainer.callback_metrics["validation/snr_db"].item() == pytest.approx(snr.mean().item(), abs=1e-5)


def test_labels_without_directions_are_not_thinned(links):
    readings = replace(links, labels=torch.zeros(12), task=Rssi())
    options = {"loss": Absolute(readings.task), "penalties": {}, "learning_rates": {"network": 0.1}}
    with pytest.raises(ValueError, match=r"training\.thinning has no option 'stride'; it has: none"):
        make_module(readings, Slope(readings.scene), thinning={"stride": 2}, **options)
