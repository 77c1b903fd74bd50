"""Trainings that end when their time is up, by a clock that the test sets."""

import math
import re
from types import SimpleNamespace

import pytest
import torch
from fitting import Plane, fit, make_module
from lightning.pytorch.callbacks import Callback

from gaigs.core import stages
from gaigs.training import budget as budget_module
from gaigs.training.budget import ENDLESS, make_budget, share_done
from gaigs.training.checkpoints import Interrupted, KeepBest, KeepLast
from gaigs.training.revision import Revision


class Clock(Callback):
    """A second a step; records losses, rates and validations; stops after one step.

    Args:
        start: Its first time [s]; another process's clock shows another.
        validation: Time of each validation [s].
        at: The step after which the training is interrupted.
    """

    def __init__(self, start=0.0, validation=0.0, at=None):
        self.now, self.validation, self.at = start, validation, at
        self.losses, self.rates, self.validated = [], [], []

    def monotonic(self):
        return self.now

    def on_train_batch_start(self, trainer, module, *_):
        self.now += 1.0
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.losses.append(outputs["loss"].item())
        if trainer.global_step == self.at:
            next(
                callback for callback in trainer.callbacks if isinstance(callback, KeepLast)
            ).interrupt(15)

    def on_validation_start(self, trainer, module):
        self.now += self.validation
        self.validated.append(trainer.global_step)


class Turned(Plane):
    """A plane that turns now and then, and records when."""

    revisions = (0.0, 0.3, 0.35, 0.9)

    def __init__(self, scene):
        super().__init__(scene)
        self.turns = []

    def revise(self, number, train, validation, loss):
        self.turns.append(number)
        self.slope += 0.1 * torch.randn(2)
        return "turned"


@pytest.fixture
def train(links, tmp_path, monkeypatch):
    """Trains by a clock; gives the trainer."""

    def train(clock, module=None, steps=-1, resume=None, searched=0.0, **options):
        monkeypatch.setattr(budget_module, "time", clock)
        given = {
            "max_steps": steps,
            "max_time": "00:00:00:10",
            "val_check_interval": "00:00:00:04",
        } | options
        given, budget = make_budget(given, searched)
        del given["max_steps"]
        module = module or make_module(links)
        keep = (
            KeepBest(tmp_path / "best.ckpt", None),
            KeepLast(tmp_path / "last.ckpt", every=math.inf),
        )
        callbacks = [clock, budget, Revision(links, 0), *keep]
        return fit(module, links, tmp_path, steps, *callbacks, resume=resume, **given)

    return train


@pytest.mark.parametrize(
    ("spent", "options", "validated"),
    [
        (0.0, {"val_check_interval": 3}, [3, 6, 9, 10]),  # the last step once
        (2.0, {"val_check_interval": 3}, [3, 6]),  # 3 s, 2 s to validate, 3 s, 2 s to validate
        (0.0, {}, [4, 8, 10]),  # every 4 s from the end of a validation
        (1.0, {}, [4, 8]),
        (3.0, {"max_time": "00:00:00:40"}, [4, 16, 28, 31]),  # slow ones take a fifth of the time
        (0.0, {"steps": 6, "max_time": None}, [4]),  # steps may end it
    ],
)
def test_a_training_ends_and_validates_by_time(train, tmp_path, spent, options, validated):
    clock = Clock(validation=spent)
    trainer = train(clock, **options)
    assert clock.validated == validated
    last = options.get("steps", validated[-1])
    assert trainer.global_step == last
    assert trainer.callbacks[1].seconds == last + spent * len(validated)
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] in (
        *validated,
        last,
    )


def test_rates_fall_with_the_time(train, links):
    clock = Clock()
    module = make_module(
        links, learning_rates={"slope": 1.0, "network": 0.5}, schedule={"warmup": 0, "final": 0.01}
    )
    train(clock, module)
    share = [0, *(k / 10 for k in range(9))]  # as of the end of the step before
    assert clock.rates == pytest.approx([0.01**done for done in share])


@pytest.mark.parametrize(("searched", "steps"), [(3.0, 7), (5.0, 5), (30.0, 5)])
def test_a_search_counts_but_leaves_half_of_the_time(train, links, searched, steps):
    clock = Clock()
    module = make_module(
        links, learning_rates={"slope": 1.0, "network": 0.5}, schedule={"warmup": 0, "final": 0.01}
    )
    trainer = train(clock, module, searched=searched)
    assert trainer.global_step == steps
    assert trainer.callbacks[1].seconds == searched + steps
    assert clock.rates == pytest.approx([0.01 ** (k / steps) for k in (0, *range(steps - 1))])


def test_of_steps_and_time_the_larger_share_counts(train, links):
    clock = Clock()
    schedule = {"warmup": 0, "final": 0.01}
    train(
        clock,
        make_module(links, learning_rates={"slope": 1.0, "network": 0.5}, schedule=schedule),
        steps=5,
    )
    assert clock.rates == pytest.approx([0.01 ** (k / 5) for k in range(5)])
    trainer = SimpleNamespace(max_steps=50, callbacks=[SimpleNamespace()])
    assert share_done(trainer)(20) == 20 / 50
    _, budget = make_budget({"max_steps": 50, "max_time": "00:00:00:10"})
    trainer.callbacks.append(budget)
    budget.share = 0.5
    assert [share_done(trainer)(step) for step in (20, 30)] == [0.5, 0.6]


def test_revisions_come_after_their_shares_of_the_time(train, links, caplog):
    caplog.set_level("INFO")
    module = make_module(links, Turned(links.scene))
    train(Clock(), module)
    lines = [
        record.getMessage() for record in caplog.records if record.name == "gaigs.training.revision"
    ]
    assert lines == ["step 0: turned", "step 3: turned", "step 4: turned", "step 9: turned"]
    assert module.model.turns == [0, 1, 2, 3]
    module = make_module(links, Turned(links.scene))
    train(Clock(), module, steps=8)
    assert module.model.turns == [0, 1, 2, 3], "steps and time bring each once"


class Searched(Turned):
    """A plane whose second revision takes a second a step of a search of ten."""

    clock = None

    def __init__(self, scene):
        super().__init__(scene)
        self.looks = []

    def revise(self, number, train, validation, loss):
        self.before = self.slope.clone()
        super().revise(number, train, validation, loss)
        for _ in range(10 if number == 1 else 0):
            self.clock.now += 1.0
            self.looks.append(stages.is_up())
            self.network(train.query.transmitters)
        return "turned"


def test_a_revision_ends_with_the_time_and_leaves_the_model_as_it_was(train, links, caplog):
    caplog.set_level("INFO")
    clock, module = Clock(), make_module(links, Searched(links.scene))
    module.model.clock = clock
    trainer = train(clock, module)
    assert trainer.global_step == 4, "one step more, which is validated"
    assert clock.now <= 12
    assert clock.validated[-1] == 4
    lines = [
        record.getMessage() for record in caplog.records if record.name == "gaigs.training.revision"
    ]
    assert lines == [
        "step 0: turned",
        "step 3: the time is up within a revision, which is not made",
    ]
    assert (module.model.slope - module.model.before).abs().max() < 0.02, "of one step, not of 0.1"
    *early, last = module.model.looks  # of searches that call no submodule
    assert early
    assert (any(early), last, stages.is_up()) == (False, True, False)


@pytest.mark.parametrize("at", [3, 4])
def test_a_training_that_goes_on_has_the_time_that_was_spent(train, links, tmp_path, at):
    """Stopped between validations and at one, it sees what an uninterrupted one sees, whatever the
    clock shows now.
    """

    def make():
        return make_module(
            links, Turned(links.scene), learning_rates={"slope": 0.05, "network": 0.02}
        )

    whole, part, rest = Clock(), Clock(at=at), Clock(start=5000.0)
    torch.manual_seed(0)
    uninterrupted, stopped, resumed = make(), make(), make()
    torch.manual_seed(0)
    train(whole, uninterrupted)
    (tmp_path / "best.ckpt").unlink()
    torch.manual_seed(0)
    with pytest.raises(Interrupted, match=f"stopped after step {at}$"):
        train(part, stopped)
    torch.manual_seed(7)
    trainer = train(rest, resumed, resume=tmp_path / "last.ckpt")
    assert trainer.global_step == 10
    assert part.losses + rest.losses == whole.losses
    assert part.rates + rest.rates == whole.rates
    assert part.validated + rest.validated == whole.validated == [4, 8, 10]
    assert stopped.model.turns + resumed.model.turns == uninterrupted.model.turns == [0, 1, 2, 3]
    for name, value in uninterrupted.model.state_dict().items():
        assert torch.equal(resumed.model.state_dict()[name], value), name


def test_a_training_whose_time_is_up_takes_no_step_more(train, tmp_path):
    train(Clock())
    again = Clock(start=100.0)
    trainer = train(again, resume=tmp_path / "last.ckpt")
    assert (trainer.global_step, again.losses, again.validated) == (10, [], [])


def test_the_search_of_the_first_process_counts():
    _, budget = make_budget({"max_time": "00:00:00:10"}, 4.0)
    trainer = SimpleNamespace(
        strategy=SimpleNamespace(broadcast=lambda own: (1.0,) * len(own)), should_stop=False
    )
    budget.on_fit_start(trainer, None)
    assert (budget.searched, budget.seconds, budget.limit) == (1.0, 1.0, 10.0)


def test_the_clock_of_the_first_process_decides():
    """This process's clock is ahead, the first one's is not."""
    _, budget = make_budget({"max_time": "00:00:00:10", "val_check_interval": "00:00:00:05"})
    budget.spent = 99.0
    asked = []
    strategy = SimpleNamespace(broadcast=lambda value: asked.append(value) or first)
    trainer = SimpleNamespace(
        strategy=strategy, should_stop=False, global_step=7, val_check_batch=None
    )
    trainer.sanity_checking, trainer.loggers = False, []
    first = 4.0
    budget.on_train_batch_end(trainer, None)
    assert (budget.share, trainer.should_stop, trainer.val_check_batch) == (0.4, False, ENDLESS)
    first = 6.0
    budget.on_train_batch_end(trainer, None)
    assert (budget.share, trainer.should_stop, trainer.val_check_batch) == (0.6, False, 7)
    budget.on_validation_end(trainer, None)
    assert budget.validated == 6.0
    first = 10.0
    budget.on_train_batch_end(trainer, None)
    assert (trainer.should_stop, trainer.val_check_batch) == (True, 7)
    assert asked == [99.0] * 4


@pytest.mark.parametrize(
    ("options", "max_time", "every"),
    [
        ({"max_steps": 5, "val_check_interval": 2}, None, None),
        ({"max_steps": 5, "val_check_interval": 2, "max_time": None}, None, None),
        ({"max_steps": -1, "val_check_interval": 2, "max_time": "00:01:03:20"}, 3800.0, None),
        ({"max_steps": 5, "val_check_interval": {"minutes": 2}}, None, 120.0),
        (
            {"max_steps": -1, "val_check_interval": "00:00:00:09", "max_time": {"minutes": 3}},
            180.0,
            9.0,
        ),
    ],
)
def test_times_and_steps_become_a_budget(options, max_time, every):
    before = dict(options)
    rest, budget = make_budget(options)
    assert options == before
    assert "max_time" not in rest
    assert rest["max_steps"] == options["max_steps"]
    assert rest["val_check_interval"] == (2 if every is None else ENDLESS)
    assert (budget.max_time, budget.every) == (max_time, every)


TIMES = ("3 min", "00:03:00", 180, "00:00:00:00", {"minuets": 3}, {"seconds": 0.5})


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        *(("max_time", time, f"at least 1 s .*got {re.escape(repr(time))}") for time in TIMES),
        ("val_check_interval", "00:03:00", "at least 1 s as 'DD.*got '00:03:00'"),
        ("val_check_interval", 0, "at least 1 step, got 0"),
        ("val_check_interval", None, "a whole number, got None"),
        ("log_every_n_steps", 0.5, "a whole number, got 0.5"),
        ("max_epochs", 3, "-1, as steps or time count, got 3"),
        ("check_val_every_n_epoch", 1, "null, as steps or time count, got 1"),
        ("max_steps", -1, r"at least 1, got -1; time alone ends it with trainer\.max_time"),
    ],
)
def test_impossible_budgets_are_refused(option, value, message):
    with pytest.raises((ValueError, TypeError), match=rf"^trainer\.{option} must be {message}$"):
        make_budget({"max_steps": 10, option: value})
