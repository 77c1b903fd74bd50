"""The networks: formulas against plain loops in float64, contracts, refusals, and a short run of
each on each task.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import splatting
import torch
from contracts.training import check_training
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger
from scipy.interpolate import BSpline

from gaigs.core.query import Batch, Query
from gaigs.core.task.scalar import Scalar
from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.report.training_log import read_curves
from gaigs.splatting.loss.absolute import Absolute
from gaigs.testing import example_links
from gaigs.training.batches import Batches, InOrder

ROOT = Path(__file__).parents[2]
TASKS = {"spectrum": "synthetic", "rssi": "synthetic_rssi", "csi": "synthetic_csi"}
"""The data set that brings a task."""

SHARED = {"octaves": [-2, 0], "pixel": 20.0}
SMALL = {
    "mlp": {"widths": [6, 5], "dropout": 0.25},
    "fire": {"widths": [8, 7, 6], "latent": 3},
    "dcgan": {"width": 2, "noise": 3},
    "wrf_kan": {"widths": [5, 4], "intervals": 4},
}
LINKS = {task: example_links(task) for task in TASKS}
every_system = pytest.mark.parametrize("name", SMALL)


@pytest.fixture(autouse=True)
def place():
    """The root of the repository, where the package is found by name."""
    with splatting.repository():
        yield


def build(name, scene, **options):
    return splatting.build("model", {"name": name} | SHARED | SMALL[name] | options, scene=scene)


def fitted(name, task, **options):
    model = build(name, LINKS[task].scene, **options)
    model.fit(LINKS[task])
    return model


def doubled(model):
    """In float64, with statistics as a training leaves them."""
    generator = torch.Generator().manual_seed(1)
    for part in model.modules():
        if isinstance(part, torch.nn.BatchNorm1d):
            part.running_mean.normal_(generator=generator)
            part.running_var.uniform_(0.5, 2, generator=generator)
            part.weight.data.uniform_(0.5, 2, generator=generator)
            part.bias.data.normal_(generator=generator)
    return model.double().eval()


def numbers(module):
    """Parameters and buffers in numpy."""
    return {name: value.detach().numpy() for name, value in module.state_dict().items()}


def numbers_of_links(model, count=3):
    width = model.question.width
    return torch.randn(
        count, width, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )


# --- contracts ---


@every_system
def test_a_label_of_several_numbers(name):
    class Triple(Scalar):
        name, quantity, unit, error_unit = "triple", "level", "dBm", "dB"
        shape = (3,)

    links = replace(LINKS["rssi"], task=Triple(), labels=torch.randn(24, 3))
    model = build(name, links.scene)
    model.fit(links)
    assert model.label.shape == (1, 1, 3)
    assert model.train()(links.batch(torch.arange(5))).value.shape == (5, 3)


@every_system
@pytest.mark.parametrize("task", TASKS)
def test_a_batch_of_one_link_trains(name, task):
    model = fitted(name, task).train()
    batch = LINKS[task].batch(torch.tensor([3]))
    value, penalties = model(batch)
    total = (value - batch.labels).abs().sum() + sum(penalties.values())
    if name == "dcgan":
        total = total + model.discriminate(batch, value).sum()
    total.backward()
    gradients = [parameter.grad for parameter in model.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    assert any((gradient != 0).any() for gradient in gradients)


# --- inputs ---


def moved(scene, by=0.0, factor=1.0):
    return replace(scene, lower=factor * scene.lower + by, upper=factor * scene.upper + by)


def test_places_are_relative_to_the_box():
    scene, places = LINKS["rssi"].scene, LINKS["rssi"].query.transmitters

    def ask(scene, places):
        return build("mlp", scene).question(
            Query(places, torch.zeros(len(places), dtype=torch.long))
        )

    answer = ask(scene, places)
    torch.testing.assert_close(ask(moved(scene, by=7.0), places + 7), answer, rtol=0, atol=1e-4)
    # The coordinates themselves keep their meaning in a larger box, their waves stay those of the
    # same octaves.
    torch.testing.assert_close(
        ask(moved(scene, factor=3.0), 3 * places)[:, :3], answer[:, :3], rtol=0, atol=1e-5
    )
    middle, half = ((scene.lower + s * scene.upper).double().numpy() / 2 for s in (1, -1))
    x = places.double().numpy() - middle
    phases = (x[:, :, None] * 2 * math.pi * 2.0 ** np.arange(-2, 1)).reshape(len(x), -1)
    expected = np.concatenate((x / np.abs(half).max(), np.sin(phases), np.cos(phases)), 1)
    np.testing.assert_allclose(answer[:, :-2], expected, atol=1e-5)
    assert answer[:, -2:].tolist() == [[1.0, 0.0]] * len(places)


def test_receivers_and_carriers_are_inputs():
    scene = replace(LINKS["rssi"].scene, frequencies=torch.tensor([2.4e9, 5.0e9, 5.8e9]))
    question = build("mlp", scene).question
    place = torch.ones(3, 3)
    answers = question(Query(place, torch.tensor([0, 1, 1]), torch.tensor([2.4e9, 2.4e9, 5.0e9])))
    assert answers.shape == (3, question.width)
    own, band = answers[:, 21:23], answers[:, 23:]
    assert own.tolist() == [[1, 0], [0, 1], [0, 1]]
    assert torch.equal(band[0], band[1])
    assert (band[0] - band[2]).abs().max() > 0.1
    with pytest.raises(ValueError, match="a frequency must be given"):
        question(Query(place, torch.tensor([0, 1, 1])))


# --- labels as images ---


def free_space_scale(links):
    """The amplitude of free space at the median link, times the median link's strength over it, by
    receiver.
    """
    train = links.split.train
    heard, labels = links.query.receivers[train].numpy(), links.labels[train].numpy()
    stands = np.stack([receiver.pose.position.numpy() for receiver in links.receivers])
    distances = np.linalg.norm(links.query.transmitters[train].numpy() - stands[heard], axis=1)
    waves = 299792458 / (4 * np.pi * distances[:, None] * links.task.frequencies.numpy())
    waves, sizes = np.sqrt((waves**2).mean(1)), np.sqrt((np.abs(labels) ** 2).mean((1, 2)))
    each = [np.median((sizes / waves)[heard == k]) for k in np.unique(heard)]
    return np.median(waves) * np.exp(np.log(each).mean())


@pytest.mark.parametrize("task", TASKS)
def test_mean_and_scale_are_those_of_the_training_links(task):
    links = LINKS[task]
    label = fitted("mlp", task).label
    labels = links.labels[links.split.train].numpy()
    if task == "csi":
        mean, scale = 0.0, free_space_scale(links)
    else:
        mean, scale = labels.mean(), labels.std()
    assert label.mean.item() == pytest.approx(mean, rel=1e-5)
    assert label.scale.item() == pytest.approx(scale, rel=1e-4)


def test_labels_that_are_all_the_same():
    links = replace(LINKS["rssi"], labels=torch.full((24,), -70.0))
    model = build("mlp", links.scene)
    model.fit(links)
    assert (model.label.mean.item(), model.label.scale.item()) == (-70, 1)


@pytest.mark.parametrize("task", TASKS)
def test_an_image_with_all_pixels_is_the_label(task):
    links, label = LINKS[task], fitted("mlp", task, pixel=1.0).label
    batch = links.batch(torch.arange(5))
    images = label.own_images(batch.labels, batch.directions)
    shapes = {"spectrum": (1, 18, 36), "rssi": (1, 1, 1), "csi": (2, 4, 5)}
    assert images.shape == (5, *shapes[task]) == (5, *label.shape)
    torch.testing.assert_close(
        label.images(batch.labels, batch.directions), images, rtol=0, atol=1e-5
    )
    torch.testing.assert_close(
        label.values(images, batch.directions), batch.labels, rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(
    ("pixel", "shape"), [(5.0, (18, 36)), (10.0, (9, 36)), (19.0, (6, 36)), (20.0, (5, 18))]
)
def test_pixels_are_at_most_as_large_as_the_option(pixel, shape):
    assert build("mlp", LINKS["spectrum"].scene, pixel=pixel).label.shape == (1, *shape)


def test_between_pixels_spectra_are_linear_and_azimuths_go_round():
    label = build("mlp", LINKS["spectrum"].scene).label.double()
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(1, *label.shape, dtype=torch.float64, generator=generator)
    elevations, azimuths = (
        angles.double().numpy() for angles in (label.grid.elevations, label.grid.azimuths)
    )
    asked = LINKS["spectrum"].task.directions.flatten().to(torch.float64)
    asked.azimuths += 0.1
    found = label.values(image, asked)[0].numpy()
    for value, elevation, azimuth in zip(
        found, asked.elevations.numpy(), asked.azimuths.numpy(), strict=True
    ):
        row = [
            np.interp(azimuth, azimuths, pixels, period=2 * np.pi) for pixels in image[0, 0].numpy()
        ]
        assert value == pytest.approx(np.interp(elevation, elevations, row), abs=1e-9)


def test_labels_of_single_directions_make_no_image():
    batch = LINKS["spectrum"].batch(torch.arange(4))
    rays = Batch(batch.query, batch.directions.flatten()[:9], batch.labels.flatten(1)[:, :9])
    for name in ("fire", "dcgan"):
        model = build(name, LINKS["spectrum"].scene).train()
        looks = {
            "fire": lambda model=model: model(rays),
            "dcgan": lambda model=model: model.discriminate(rays, rays.labels),
        }
        with pytest.raises(
            ValueError, match=r"needs rows and columns, .* set training\.thinning\.rays=null"
        ):
            looks[name]()


# --- the formulas ---


def leaky(x, slope=0.01):
    return np.where(x > 0, x, slope * x)


def normalised(x, part):
    """By running statistics."""
    return (x - part["running_mean"]) / np.sqrt(part["running_var"] + 1e-5) * part["weight"] + part[
        "bias"
    ]


def test_the_mlp_is_the_formula():
    model = doubled(build("mlp", LINKS["spectrum"].scene))
    given = numbers_of_links(model)
    x = given.numpy()
    for layer in (0, 4):  # linear, normalised, rectified; a prediction leaves nothing out
        linear, norm = (numbers(model.network[layer + i]) for i in (0, 1))
        x = leaky(normalised(x @ linear["weight"].T + linear["bias"], norm))
    head = numbers(model.network[8])
    expected = (x @ head["weight"].T + head["bias"]).reshape(3, 1, 5, 18)
    np.testing.assert_allclose(model.draw(given).detach(), expected, rtol=1e-9, atol=1e-9)


def test_a_kolmogorov_arnold_layer_is_the_formula():
    model = doubled(build("wrf_kan", LINKS["rssi"].scene))
    layer = model.network[1]
    x = 0.7 * torch.randn(6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    x[0] = torch.tensor([-1.0, 1.0, 0.0, 3.0, -3.0])
    with torch.no_grad():
        layer.splines.normal_()
    base, coefficients = numbers(layer.base), layer.splines.detach().numpy().reshape(4, 5, 7)
    knots = -1 + 0.5 * np.arange(-3, 8)
    expected = np.zeros((6, 4))
    for b in range(6):
        for o in range(4):
            expected[b, o] = base["bias"][o]
            for i, value in enumerate(x[b].numpy()):
                expected[b, o] += base["weight"][o, i] * value / (1 + np.exp(-value))
                for k in range(7):
                    spline = BSpline.basis_element(knots[k : k + 5], extrapolate=False)
                    expected[b, o] += coefficients[o, i, k] * np.nan_to_num(spline(value))
    np.testing.assert_allclose(layer(x).detach(), expected, rtol=1e-9, atol=1e-9)
    inside = torch.linspace(-1, 1, 50, dtype=torch.float64)[None]
    torch.testing.assert_close(layer.basis(inside).sum(-1), torch.ones_like(inside))


def test_fire_draws_from_the_middle_of_the_prior():
    model = doubled(build("fire", LINKS["csi"].scene))
    given = LINKS["csi"].query[torch.arange(4)]
    given = replace(given, transmitters=given.transmitters.double())
    x = np.concatenate((np.zeros((4, 3)), model.question(given).numpy()), 1)
    for layer in (0, 2, 4):
        part = numbers(model.decoder[0][layer])
        x = leaky(x @ part["weight"].T + part["bias"])
    head = numbers(model.decoder[1])
    drawn = (x @ head["weight"].T + head["bias"]).reshape(4, 2, 4, 5)
    value = model(Batch(given)).value.detach()
    np.testing.assert_allclose(value, drawn[:, 0] + 1j * drawn[:, 1], rtol=1e-9, atol=1e-9)
    assert model(Batch(given)).penalties == {}


@pytest.mark.parametrize("task", TASKS)
def test_the_latent_code_is_penalised_by_its_divergence(task):
    links = LINKS[task]
    model = fitted("fire", task).train()
    batch = links.batch(torch.arange(6))
    torch.manual_seed(5)
    value, penalties = model(batch)
    given = model.question(batch.query)
    seen = torch.cat((model.label.own_images(batch.labels, batch.directions).flatten(1), given), 1)
    mean, log_variance = model.posterior(model.encoder(seen)).chunk(2, 1)
    posterior = torch.distributions.Normal(mean, (log_variance / 2).exp())
    kl = (
        torch.distributions.kl_divergence(posterior, torch.distributions.Normal(0.0, 1.0))
        .sum(1)
        .mean()
    )
    unit = 1.0 if task == "csi" else links.labels[links.split.train].var(correction=0)
    expected = unit * kl / math.prod(model.label.shape)
    torch.testing.assert_close(penalties["kl"], expected, rtol=1e-4, atol=1e-7)
    torch.manual_seed(5)
    images = model.decoder(torch.cat((posterior.rsample(), given), 1))
    torch.testing.assert_close(
        value, model.label.values(images, batch.directions), rtol=1e-4, atol=1e-4
    )


def test_fire_sees_thinned_labels_as_whole_ones():
    """A label that is linear in elevation is the same seen in every so many rows."""
    links = LINKS["spectrum"]
    label = fitted("fire", "spectrum").label
    grid = links.task.directions
    labels = grid.elevations[:, None].expand(grid.shape)[None]
    rows, columns = slice(0, None, 17), slice(2, None, 5)
    thin = label.own_images(labels[:, rows, columns], grid.thin(rows, columns))
    torch.testing.assert_close(thin, label.own_images(labels, grid), rtol=0, atol=1e-5)


def transposed_by_loops(x, weight, bias, stride, padding):
    (outs, rows, columns), (height, width) = (weight.shape[1], *x.shape[2:]), weight.shape[2:]
    sizes = ((rows - 1) * stride[0] + height, (columns - 1) * stride[1] + width)
    whole = np.zeros((len(x), outs, *sizes))
    for r in range(rows):
        for c in range(columns):
            at = (
                slice(r * stride[0], r * stride[0] + height),
                slice(c * stride[1], c * stride[1] + width),
            )
            whole[:, :, at[0], at[1]] += np.einsum("bi,iohw->bohw", x[:, :, r, c], weight)
    cut = (slice(padding[0], sizes[0] - padding[0]), slice(padding[1], sizes[1] - padding[1]))
    return whole[:, :, cut[0], cut[1]] + bias[None, :, None, None]


@pytest.mark.parametrize("task", TASKS)
def test_the_generator_is_four_transposed_convolutions(task):
    model = doubled(build("dcgan", LINKS[task].scene))
    given = numbers_of_links(model)
    linear, *blocks = [part for part in model.generator if numbers(part)]
    first = numbers(linear)
    x = np.concatenate((np.zeros((3, 3)), given.numpy()), 1) @ first["weight"].T + first["bias"]
    channels, rows, columns = model.label.shape
    x = x.reshape(3, *{"spectrum": (16, 1, 2), "rssi": (16, 1, 1), "csi": (16, 1, 1)}[task])
    assert len(blocks) == 8
    for norm, layer in zip(blocks[::2], blocks[1::2], strict=True):
        part = {name: value.reshape(-1, 1, 1) for name, value in numbers(norm).items()}
        x = np.maximum(normalised(x, part), 0)
        x = transposed_by_loops(x, **numbers(layer), stride=layer.stride, padding=layer.padding)
    widths = [16, 8, 4, 2, channels]
    assert [layer.in_channels for layer in blocks[1::2]] == widths[:-1]
    assert x.shape[1:] == {"spectrum": (1, 8, 32), "rssi": (1, 1, 1), "csi": (2, 4, 8)}[task]
    np.testing.assert_allclose(
        model.draw(given).detach(), x[..., :rows, :columns], rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("task", TASKS)
def test_the_discriminator_looks_at_label_and_link(task):
    model = fitted("dcgan", task).eval()
    batch = LINKS[task].batch(torch.arange(6))

    def judge(labels, query=batch.query):
        return model.discriminate(replace(batch, query=query), labels)

    own = judge(batch.labels)
    assert own.shape == (6,)
    assert (own - judge(batch.labels.flip(0))).abs().max() > 1e-6
    other = Query(batch.query.transmitters + 1, batch.query.receivers)
    assert (own - judge(batch.labels, other)).abs().max() > 1e-6
    torch.testing.assert_close(
        own[2:3], model.discriminate(LINKS[task].batch(torch.tensor([2])), batch.labels[2:3])
    )
    groups = model.parameter_groups()
    gradients = torch.autograd.grad(own.square().sum(), groups["discriminator"])
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert {*map(id, groups["discriminator"])}.isdisjoint(map(id, groups["network"]))


@pytest.mark.parametrize(("name", "dropout"), [("mlp", 0.5), ("mlp", 0.0), ("dcgan", None)])
def test_dropout_and_noise_are_for_the_training_alone(name, dropout):
    batch = LINKS["rssi"].batch(torch.arange(8))
    model = fitted(name, "rssi", **({} if dropout is None else {"dropout": dropout}))
    one, other = (model.train()(batch).value for _ in range(2))
    assert torch.equal(one, other) == (dropout == 0)
    one, other = (model.eval()(batch).value for _ in range(2))
    assert torch.equal(one, other)


@pytest.mark.parametrize("stride", range(1, 7))
def test_the_discriminator_takes_labels_however_thin(stride):
    links = LINKS["spectrum"]
    model = fitted("dcgan", "spectrum", pixel=1.0)
    thin = links.task.thinning(stride=stride)(
        links.batch(torch.arange(4)), torch.Generator().manual_seed(0)
    )
    assert model.discriminate(thin, thin.labels).isfinite().all()


# --- adversarial training ---


class Forger(Model):
    """A level with noise on it, from the transmitter's place, and a discriminator that sees level
    and place.
    """

    trained_by = "adversarial"
    learning_rates: Mapping[str, float] = {"network": 0.02, "discriminator": 0.05}
    penalty_weights: Mapping[str, float] = {"gain": 0.5}

    def __init__(self, scene):
        super().__init__(scene)
        self.network, self.judge = torch.nn.Linear(3, 1), torch.nn.Linear(2, 1)

    def parameter_groups(self):
        return {
            "network": [*self.network.parameters()],
            "discriminator": [*self.judge.parameters()],
        }

    def forward(self, batch):
        value = self.network(batch.query.transmitters)[:, 0]
        noise = (
            0.01 * torch.randn(value.shape) if self.training else 0.0
        )  # of the global generator, which is kept
        return Prediction(value + noise, {"gain": value.square().mean()})

    def discriminate(self, batch, values):
        return self.judge(torch.stack((values, batch.query.transmitters[:, 0]), 1))[:, 0]


class Unjudged(Forger):
    def parameter_groups(self):
        return {"network": [*self.network.parameters()]}


ADVERSARIAL = {
    "name": "adversarial", "weight": 0.5, "batch_size": 4, "thinning": {}, "jitter": 0.0, "penalties": {},
    "learning_rates": {}, "optimizer": {"_target_": "torch.optim.SGD"}, "schedule": {"warmup": 0, "final": 0.1},
    "patience": None, "density": None,
}  # fmt: skip


def adversarial(model=Forger, **options):
    torch.manual_seed(0)
    links = LINKS["rssi"]
    context = {
        "model": model(links.scene),
        "loss": Absolute(links.task),
        "identity": {"who": "the check"},
        "seed": 0,
    }
    return registry("training").build(ADVERSARIAL | options, **context)


def test_adversarial_training_keeps_the_contract_of_trainings():
    """Both learn, a step of both is one step, and a stopped training goes on as if it had never
    stopped.
    """
    check_training(
        functools.partial(registry("training").build, ADVERSARIAL), Forger, LINKS["rssi"]
    )


def test_a_step_is_goodfellows_with_the_gradient_of_its_own_player_alone(tmp_path):
    module, counted = adversarial(), []
    forger, links = module.model, LINKS["rssi"]

    class Referee(Callback):
        def on_train_batch_start(self, trainer, module, batch, _):
            self.random = torch.random.get_rng_state()
            self.before = {
                name: parameter.detach().clone() for name, parameter in forger.named_parameters()
            }
            self.rates = [
                group["lr"] for optimizer in trainer.optimizers for group in optimizer.param_groups
            ]

        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            factor = 0.1 ** ((trainer.global_step - 1) / 3)
            assert self.rates == pytest.approx([0.02 * factor, 0.05 * factor]), (
                "both follow the schedule"
            )
            leaves = {name: value.clone().requires_grad_() for name, value in self.before.items()}
            torch.random.set_rng_state(self.random)
            value, penalties = torch.func.functional_call(forger, leaves, (batch,))

            def logits(x, weight, bias):
                return (torch.stack((x, batch.query.transmitters[:, 0]), 1) @ weight.T + bias)[:, 0]

            judge = [leaves["judge.weight"], leaves["judge.bias"]]
            real, fake = (
                logits(batch.labels, *judge).sigmoid(),
                logits(value.detach(), *judge).sigmoid(),
            )
            judged = -(real.log().mean() + (1 - fake).log().mean())
            steps = zip(judge, torch.autograd.grad(judged, judge), strict=True)
            moved = [(x - self.rates[1] * g).detach() for x, g in steps]
            torch.testing.assert_close(
                [forger.judge.weight.detach(), forger.judge.bias.detach()], moved
            )
            deceit = -logits(value, *moved).sigmoid().log().mean()
            loss = (value - batch.labels).abs().mean() + 0.5 * deceit + 0.5 * penalties["gain"]
            assert outputs["loss"].item() == pytest.approx(loss.item(), rel=1e-5)
            for name in ("network.weight", "network.bias"):
                (gradient,) = torch.autograd.grad(loss, leaves[name], retain_graph=True)
                expected = self.before[name] - self.rates[0] * gradient
                torch.testing.assert_close(forger.get_parameter(name).detach(), expected)
            counted.append(trainer.global_step)

    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=-1, max_steps=3, val_check_interval=3, enable_progress_bar=False,
        enable_model_summary=False, enable_checkpointing=False, callbacks=[Referee()], log_every_n_steps=1,
        check_val_every_n_epoch=None, num_sanity_val_steps=0,
        logger=CSVLogger(tmp_path, "log"),
    )  # fmt: skip
    trainer.fit(
        module,
        Batches(links, links.split.train, 4, 0, 3),
        InOrder(links, links.split.validation, 4),
    )
    assert counted == [1, 2, 3]
    curves = read_curves(list(tmp_path.glob("log/*/metrics.csv")))
    assert all(
        len({*curves[f"train/{name}"][1].tolist()}) == 3
        for name in ("discriminator", "deceit", "mae")
    )


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (
            type("Plain", (Forger,), {"trained_by": "descent"}),
            {},
            "is trained by 'descent'; set training=descent",
        ),
        (Unjudged, {}, "adversarial training needs a model with a parameter group 'discriminator'"),
        (Forger, {"weight": -1.0}, r"training\.weight must be at least 0, got -1\.0"),
    ],
)
def test_adversarial_training_refuses(model, options, message):
    with pytest.raises(ValueError, match=message):
        adversarial(model, **options)


@pytest.mark.parametrize(
    ("processes", "scaler", "message"), [(2, None, "one process"), (1, "a scaler", "not scale")]
)
def test_adversarial_training_takes_one_process_and_unscaled_gradients(processes, scaler, message):
    module = adversarial()
    module._trainer = SimpleNamespace(
        world_size=processes, precision_plugin=SimpleNamespace(scaler=scaler)
    )
    with pytest.raises(ValueError, match=f"adversarial training .*{message}"):
        module.on_fit_start()
