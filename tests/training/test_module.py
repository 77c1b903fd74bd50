from dataclasses import replace

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger
from skimage.metrics import structural_similarity
from torch import nn

from gaigs.checkpoint import KEY
from gaigs.data import Grid, Links, Receiver, Split
from gaigs.geometry import Pose
from gaigs.model import Model, Prediction
from gaigs.report.curves import read_curves
from gaigs.training.batches import Batches, Pass, take
from gaigs.training.module import Training


class Plane(Model):
    """A label that rises with elevation and azimuth, times what the network makes of the transmitter."""

    def __init__(self, scene):
        super().__init__(scene)
        self.slope = nn.Parameter(torch.tensor([0.3, 0.1]))
        self.network = nn.Linear(3, 1)

    def parameter_groups(self):
        return {"slope": [self.slope], "network": list(self.network.parameters())}

    def forward(self, batch):
        image = self.slope[0] * batch.grid.elevations[:, None] + self.slope[1] * batch.grid.azimuths
        gain = self.network(batch.transmitters)
        self.batch = batch
        self.prediction = Prediction(gain[..., None].sigmoid() * image, {"gain": gain.square().mean()})
        return self.prediction


OPTIONS = {
    "batch_size": 4,
    "loss": {"stride": 3, "ssim": 0.25},
    "penalties": {"gain": 0.5},
    "learning_rates": {"slope": 0.01, "network": 0.02, "elsewhere": 1.0},
    "final_rate": 0.1,
    "warmup": 4,
    "weight_decay": 0.3,
    "patience": None,
    "density": None,
}


@pytest.fixture(scope="module")
def links():
    generator = torch.Generator().manual_seed(0)
    return Links(
        transmitters=torch.rand(12, 3, generator=generator),
        receivers=(Receiver("gateway1", Pose.from_xyzw((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))),),
        receiver_index=torch.zeros(12, dtype=torch.long),
        labels=torch.rand(12, 24, 30, generator=generator),
        split=Split("8, 3 and 1", torch.arange(8), torch.arange(8, 11), torch.arange(11, 12)),
        grid=Grid.degrees(range(24), range(30)),
        normalisation="none",
    )


@pytest.fixture
def module(links):
    torch.manual_seed(0)
    return Training(Plane(links.scene), {"who": "the plane"}, seed=0, **OPTIONS)


def fit(module, links, tmp_path, steps, *callbacks, **options):
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=-1, max_steps=steps, num_sanity_val_steps=0, check_val_every_n_epoch=None,
        val_check_interval=5, log_every_n_steps=2, enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False, callbacks=list(callbacks), logger=CSVLogger(tmp_path, "log"), **options,
    )  # fmt: skip
    trainer.fit(module, Batches(links, links.split.train, 4, 0, steps), Pass(links, links.split.validation, 2))
    return trainer


class Recorder(Callback):
    """Rates, first row and column, and loss of every step."""

    def __init__(self):
        self.rates, self.offsets, self.losses = [], [], []

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.rates.append([group["lr"] for group in trainer.optimizers[0].param_groups])
        rows, columns = (torch.rad2deg(x).round().int() for x in vars(module.model.batch.grid).values())
        assert rows.tolist() == list(range(int(rows[0]), 24, 3))
        assert columns.tolist() == list(range(int(columns[0]), 30, 3))
        self.offsets.append((int(rows[0]), int(columns[0])))
        self.losses.append(outputs["loss"].item())


class Referee(Callback):
    """Computes every step's loss from the prediction, with scikit-image, and from the whole label."""

    def on_train_batch_end(self, trainer, module, outputs, batch, _):
        row, column = (round(torch.rad2deg(x[0]).item()) for x in vars(module.model.batch.grid).values())
        labels = batch.labels[:, row::3, column::3].double()
        predictions = module.model.prediction.label.detach().double()
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


def test_rows_and_columns_are_random_but_follow_from_seed_and_step(module, links, tmp_path):
    first, again, other = Recorder(), Recorder(), Recorder()
    state = {name: value.clone() for name, value in module.model.state_dict().items()}
    fit(module, links, tmp_path, 30, first)
    module.model.load_state_dict(state)
    torch.manual_seed(99)
    fit(Training(module.model, {}, seed=0, **OPTIONS), links, tmp_path, 30, again)
    fit(Training(module.model, {}, seed=1, **OPTIONS), links, tmp_path, 30, other)
    assert first.offsets == again.offsets
    assert first.losses == again.losses
    assert first.offsets != other.offsets
    assert set(first.offsets) == {(row, column) for row in range(3) for column in range(3)}


def test_validation_scores_whole_spectra_and_weighs_them_alike(module, links, tmp_path):
    trainer = fit(module, links, tmp_path, 5)
    index = links.split.validation
    prediction = module.model.predict(links.transmitters[index])
    ssim = [
        structural_similarity(a.numpy(), b.numpy(), data_range=1.0)
        for a, b in zip(links.labels[index], prediction, strict=True)
    ]
    assert trainer.callback_metrics["validation/ssim"].item() == pytest.approx(sum(ssim) / 3, abs=1e-6)
    mae = (links.labels[index] - prediction).abs().mean().item()
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


def test_a_checkpoint_says_whose_it_is(module):
    checkpoint = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint == {KEY: {"who": "the plane"}}


def test_every_group_needs_a_rate(links):
    with pytest.raises(ValueError, match="learning_rates must give a rate for slope"):
        Training(Plane(links.scene), {}, seed=0, **OPTIONS | {"learning_rates": {"network": 0.1}})


def test_every_penalty_needs_a_weight(module, links, tmp_path):
    module.penalties = {"opacity": 1.0}
    with pytest.raises(ValueError, match="penalties must give a weight for gain"):
        fit(module, links, tmp_path, 3)


def test_a_loss_that_is_not_finite_ends_the_training(module, links, tmp_path):
    module.model.network.bias.data[0] = float("nan")
    with pytest.raises(ValueError, match=r"loss must stay finite, got nan at step 0; lower training\.learning_rates"):
        fit(module, links, tmp_path, 3)


@pytest.mark.parametrize(("option", "value"), [("final_rate", 0.0), ("warmup", -1)])
def test_an_option_out_of_range_is_refused(links, option, value):
    with pytest.raises(ValueError, match=rf"training\.{option} must be .*, got {value}"):
        Training(Plane(links.scene), {}, seed=0, **OPTIONS | {option: value})


@pytest.mark.parametrize(("option", "value"), [("ssim", 2.0), ("stride", 0), ("stride", 40)])
def test_an_option_of_the_loss_out_of_range_is_refused(links, option, value):
    with pytest.raises(ValueError, match=rf"training\.loss\.{option} must be .*, got {value}"):
        Training(Plane(links.scene), {}, seed=0, **OPTIONS | {"loss": OPTIONS["loss"] | {option: value}})


class Slope(Model):
    """An RSSI that rises with x."""

    def __init__(self, scene):
        super().__init__(scene)
        self.slope = nn.Parameter(torch.tensor(2.0))

    def forward(self, batch):
        return Prediction(self.slope * batch.transmitters[:, 0], {})


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("absolute", lambda e: e.abs()), ("squared", lambda e: e**2), ("huber", lambda e: huber(e.abs()))],
)
def test_rssi_is_trained_and_scored_in_db(links, tmp_path, kind, expected):
    labels = torch.linspace(-90, -40, 12)
    readings = replace(links, labels=labels, grid=None)
    options = OPTIONS | {"loss": {"kind": kind, "bend": 60.0, "jitter": 0.0}, "penalties": {}}
    module = Training(Slope(readings.scene), {}, seed=0, **options)
    batch = take(readings, torch.arange(12))
    loss, terms, _ = module.loss(module.model, batch, torch.Generator())
    errors = 2 * readings.transmitters[:, 0] - labels
    assert loss.item() == pytest.approx(expected(errors).mean().item())
    assert terms["mae_db"].item() == pytest.approx(errors.abs().mean().item())
    trainer = fit(module, readings, tmp_path, 5)
    index = readings.split.validation
    errors = module.model.predict(readings.transmitters[index]) - labels[index]
    assert trainer.callback_metrics["validation/mae_db"].item() == pytest.approx(errors.abs().mean().item(), rel=1e-6)


def huber(errors, bend=60.0):
    return torch.where(errors < bend, errors**2 / 2, bend * (errors - bend / 2))
