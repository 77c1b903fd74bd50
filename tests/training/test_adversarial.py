import math
from itertools import pairwise

import lightning
import pytest
import torch
from fitting import OPTIONS, Plane, fit, make_links, make_module
from lightning.pytorch.callbacks import Callback
from torch import nn

from gaigs import checkpoint
from gaigs.loss.absolute import Absolute
from gaigs.loss.l1_ssim import L1Ssim
from gaigs.registry import registry
from gaigs.report.curves import read_curves
from gaigs.training.adversarial import Adversarial
from gaigs.training.callbacks import KeepLast, save

RATES = {"slope": 0.01, "network": 0.02, "discriminator": 0.05}
SGD = {"_target_": "torch.optim.SGD"}
CONSTANT = {"warmup": 0, "final": 1.0}


class Forger(Plane):
    """A plane with noise on it, and a judge that looks at brightness and contrast."""

    trained_by = "adversarial"

    def __init__(self, scene):
        super().__init__(scene)
        self.judge = nn.Linear(2, 1)

    def parameter_groups(self):
        return super().parameter_groups() | {"discriminator": list(self.judge.parameters())}

    def forward(self, batch):
        value, penalties = super().forward(batch)
        if self.training:
            value = value + 0.01 * torch.randn(value.shape)  # of the global generator, which has to be kept
        return type(self.prediction)(value, penalties)

    def discriminate(self, batch, values):
        assert len(values) == len(batch)
        flat = values.flatten(1)
        return self.judge(torch.stack((flat.mean(1), flat.std(1)), 1))[:, 0]


@pytest.fixture(scope="module")
def links():
    return make_links()


def make(links, **options):
    torch.manual_seed(0)
    options = {"weight": 0.5, "learning_rates": RATES} | options
    return make_module(links, Forger(links.scene), kind=Adversarial, **options)


class States(Callback):
    """The model's state behind every step, and how many steps Lightning has counted."""

    def __init__(self):
        self.states, self.counts = [], []

    def on_train_batch_end(self, trainer, module, *_):
        self.states.append({name: value.clone() for name, value in module.model.state_dict().items()})
        self.counts.append(trainer.global_step)


def test_both_learn_and_one_step_is_one_step(links, tmp_path):
    module, states = make(links), States()
    before = {name: value.clone() for name, value in module.model.state_dict().items()}
    trainer = fit(module, links, tmp_path, 8, states)
    assert states.counts == list(range(1, 9))
    assert trainer.global_step == 8
    for name in before:
        course = [before[name], *(state[name] for state in states.states)]
        assert all(not torch.equal(a, b) for a, b in pairwise(course)), name
    curves = read_curves(list(tmp_path.glob("log/*/metrics.csv")))
    for name in ("discriminator", "deceit", "l1"):
        steps, values = curves[f"train/{name}"]
        assert steps.tolist() == [1, 3, 5, 7]
        assert len(set(values.tolist())) == 4, name
    assert "validation/ssim" in trainer.callback_metrics


def test_a_step_is_the_formulas(links, tmp_path):
    """Goodfellow's non-saturating losses, each with the gradient of its own player alone."""
    options = {"optimizer": SGD, "schedule": CONSTANT, "penalties": {"gain": 0.5}, "loss": Absolute(links.task)}
    module, seen = make(links, **options), {}
    forger = module.model

    class Referee(Callback):
        def on_train_batch_start(self, trainer, module, batch, _):
            seen["random"] = torch.random.get_rng_state()
            self.batch = batch
            self.before = {name: parameter.detach().clone() for name, parameter in forger.named_parameters()}

        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            after = {name: parameter.detach().clone() for name, parameter in forger.named_parameters()}
            global_step = trainer.global_step - 1
            leaves = {name: value.clone().requires_grad_() for name, value in self.before.items()}
            torch.random.set_rng_state(seen["random"])
            thin = module.thin(batch, _generator(module.seed, global_step))
            value, penalties = torch.func.functional_call(forger, leaves, (thin,))
            logits = lambda judge, x: _logits(judge, x.flatten(1))
            judge = [leaves["judge.weight"], leaves["judge.bias"]]
            real, fake = logits(judge, thin.labels), logits(judge, value.detach())
            judged = -(real.sigmoid().log().mean() + (1 - fake.sigmoid()).log().mean())
            gradients = torch.autograd.grad(judged, judge)
            moved = [x - RATES["discriminator"] * g for x, g in zip(judge, gradients, strict=True)]
            torch.testing.assert_close([after["judge.weight"], after["judge.bias"]], [x.detach() for x in moved])
            deceit = -logits([x.detach() for x in moved], value).sigmoid().log().mean()
            loss = (value - thin.labels).abs().mean() + 0.5 * deceit + 0.5 * penalties["gain"]
            assert outputs["loss"].item() == pytest.approx(loss.item(), rel=1e-5)
            own = ["slope", "network.weight", "network.bias"]
            gradients = torch.autograd.grad(loss, [leaves[name] for name in own])
            for name, gradient in zip(own, gradients, strict=True):
                rate = RATES["slope" if name == "slope" else "network"]
                torch.testing.assert_close(after[name], self.before[name] - rate * gradient)
            seen["steps"] = trainer.global_step

    fit(module, links, tmp_path, 3, Referee())
    assert seen["steps"] == 3


def _generator(seed, step):
    return torch.Generator().manual_seed(hash((seed, step)) % 2**63)


def _logits(judge, flat):
    weight, bias = judge
    return (torch.stack((flat.mean(1), flat.std(1)), 1) @ weight.T + bias)[:, 0]


def test_both_follow_the_schedule(links, tmp_path):
    module = make(links, schedule={"warmup": 4, "final": 0.1})
    trainer = fit(module, links, tmp_path, 6)
    factor = 0.1
    own, judge = ([group["lr"] for group in optimizer.param_groups] for optimizer in trainer.optimizers)
    assert own == pytest.approx([0.01 * factor, 0.02 * factor])
    assert judge == pytest.approx([0.05 * factor])
    names = [[group["name"] for group in optimizer.param_groups] for optimizer in trainer.optimizers]
    assert names == [["slope", "network"], ["discriminator"]]


class Save(Callback):
    """Writes a checkpoint behind some step."""

    def __init__(self, path, step):
        self.path, self.step = path, step

    def on_train_batch_end(self, trainer, module, *_):
        if trainer.global_step == self.step:
            save(trainer, self.path)


@pytest.mark.parametrize("step", [1, 4, 6])  # before and behind a validation
def test_a_training_goes_on_as_if_it_had_never_stopped(links, tmp_path, step):
    whole, rest = States(), States()
    path = tmp_path / "last.ckpt"
    keep = lambda: KeepLast(tmp_path / "end.ckpt", every=math.inf)
    fit(make(links), links, tmp_path, 8, whole, keep(), Save(path, step))
    content = torch.load(path, weights_only=True)
    assert content["global_step"] == step
    assert len(content["optimizer_states"]) == len(content["lr_schedulers"]) == 2
    assert content[checkpoint.KEY] == {"who": "the plane"}
    torch.manual_seed(5)
    fit(make(links), links, tmp_path, 8, rest, keep(), resume=path)
    assert rest.counts == list(range(step + 1, 9))
    for name in whole.states[-1]:
        for a, b in zip(whole.states[step:], rest.states, strict=True):
            assert torch.equal(a[name], b[name]), name


# --- refusals ---


def test_a_model_without_a_discriminator_is_refused(links, monkeypatch):
    monkeypatch.setattr(Plane, "trained_by", "adversarial")
    with pytest.raises(ValueError, match="adversarial training needs a model with a parameter group 'discriminator'"):
        make_module(links, kind=Adversarial, weight=0.5)


def test_each_training_refuses_the_others_models(links):
    with pytest.raises(ValueError, match="this model is trained by 'descent'; set training=descent"):
        make_module(links, Plane(links.scene), kind=Adversarial, weight=0.5)
    with pytest.raises(ValueError, match="this model is trained by 'adversarial'; set training=adversarial"):
        make_module(links, Forger(links.scene), learning_rates=RATES)


@pytest.mark.parametrize("weight", [-1.0, float("nan")])
def test_the_weight_is_not_negative(links, weight):
    with pytest.raises(ValueError, match=rf"training\.weight must be at least 0, got {weight}"):
        make(links, weight=weight)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"jiter": 0.1}, ValueError, r"training 'adversarial' has no option 'jiter' \(did you mean 'jitter'\?\)"),
        ({"batch_size": 4.0}, TypeError, "training 'adversarial' option 'batch_size' must be a whole number, got 4.0"),
        ({"weight": "much"}, TypeError, "training 'adversarial' option 'weight' must be a number, got 'much'"),
        ({"learning_rates": {"slope": 0.1, "network": 0.1}}, ValueError, "must give a rate for discriminator"),
    ],
)
def test_options_are_those_of_descent_and_the_weight(links, options, error, message):
    config = {"name": "adversarial", "weight": 0.5, **OPTIONS, "learning_rates": RATES} | options
    context = {"model": Forger(links.scene), "loss": L1Ssim(links.task, 0.25), "identity": {}, "seed": 0}
    with pytest.raises(error, match=message):
        registry("training").build(config, **context)


def test_a_model_may_be_judged_in_one_process_only(links):
    module = make(links)
    module.trainer = lightning.Trainer(accelerator="cpu", devices=2, strategy="ddp", logger=False)
    with pytest.raises(ValueError, match=r"adversarial training takes one process; set trainer\.devices=1"):
        module.on_fit_start()
