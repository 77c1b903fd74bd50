import pytest
import torch
from torch import nn
from torch.optim.lr_scheduler import ConstantLR

from gaigs.training.schedule import make_optimizer, make_schedule

ADAM = {"_target_": "torch.optim.AdamW", "weight_decay": 0.3}
CONSTANT = {"_target_": "torch.optim.lr_scheduler.ConstantLR", "factor": 0.25, "total_iters": 3}


@pytest.fixture
def groups():
    def make(size):
        return nn.Parameter(torch.ones(size))

    return {"means": [make(2)], "network": [make(3), make(1)]}


RATES = {"means": 0.5, "network": 0.1}


def rates(schedule, optimizer, steps):
    """Rates of all groups at each step."""
    drawn = []
    for _ in range(steps):
        drawn.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        schedule.step()
    return torch.tensor(drawn, dtype=torch.float64)


# --- optimizers ---


def test_each_group_has_its_rate_and_the_network_alone_decays(groups):
    optimizer = make_optimizer(ADAM, groups, RATES | {"signal": 9.0})
    assert type(optimizer) is torch.optim.AdamW
    settings = [
        (group["name"], group["lr"], group["weight_decay"]) for group in optimizer.param_groups
    ]
    assert settings == [("means", 0.5, 0.0), ("network", 0.1, 0.3)]
    held = [[id(parameter) for parameter in group["params"]] for group in optimizer.param_groups]
    assert held == [[id(parameter) for parameter in group] for group in groups.values()]


def test_a_decay_that_torch_has_by_default_is_not_that_of_positions(groups):
    assert torch.optim.AdamW(groups["means"]).defaults["weight_decay"] > 0
    optimizer = make_optimizer({"_target_": "torch.optim.AdamW"}, groups, RATES)
    assert [group["weight_decay"] > 0 for group in optimizer.param_groups] == [False, True]
    for parameter in (parameter for group in groups.values() for parameter in group):
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    assert torch.equal(groups["means"][0], torch.ones(2))
    assert (groups["network"][0] < 1).all()


@pytest.mark.parametrize(
    ("target", "options", "fused"),
    [
        ("AdamW", {}, True),
        ("SGD", {}, True),
        ("AdamW", {"fused": False}, False),
        ("AdamW", {"foreach": True}, None),
        ("RMSprop", {}, None),
    ],
)
def test_a_step_is_fused_where_torch_can(groups, target, options, fused):
    optimizer = make_optimizer({"_target_": f"torch.optim.{target}", **options}, groups, RATES)
    assert optimizer.defaults.get("fused") is fused
    groups["means"] = [nn.Parameter(torch.ones(2, dtype=torch.complex64))]
    assert make_optimizer(ADAM, groups, RATES).defaults["fused"] is None, "real numbers alone are"


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        *(
            (
                {"_target_": target},
                ValueError,
                rf"_target_ must be a class of torch\.optim, got '{target}'",
            )
            for target in ("os.system", "AdamW", "torch.nn.Linear", "torch.optim.AdanW", None)
        ),
        (
            {"momentun": 0.9},
            ValueError,
            r"training\.optimizer has no option 'momentun' \(did you mean 'momentum'\?\)",
        ),
        (
            {"lr": 0.1},
            ValueError,
            r"takes no lr, as each group has its own; set training\.learning_rates",
        ),
        ({"params": []}, ValueError, "training.optimizer has no option 'params'"),
        (
            {"nesterov": "yes"},
            TypeError,
            r"training\.optimizer option 'nesterov' must be true or false, got 'yes'",
        ),
        (
            {"momentum": -1.0},
            ValueError,
            r"training\.optimizer cannot be made \(.* Invalid momentum value: -1\.0",
        ),
        (
            {"weight_decay": float("nan")},
            TypeError,
            r"option 'weight_decay' must be a finite number, got nan",
        ),
    ],
)
def test_options_of_the_optimizer_are_its_own(groups, options, error, message):
    with pytest.raises(error, match=message):
        make_optimizer({"_target_": "torch.optim.SGD", **options}, groups, RATES)


# --- schedules ---


@pytest.mark.parametrize(("warmup", "final"), [(4, 0.1), (0, 0.5), (1, 0.5), (50, 1.0)])
def test_rates_rise_linearly_and_fall_exponentially(groups, warmup, final):
    optimizer = make_optimizer(ADAM, groups, RATES)
    schedule = make_schedule({"warmup": warmup, "final": final}, optimizer, lambda step: step / 20)
    drawn = rates(schedule, optimizer, 21)
    rise = [min(1.0, (k + 1) / warmup) if warmup else 1.0 for k in range(21)]
    factors = torch.tensor([rise[k] * final ** (k / 20) for k in range(21)], dtype=torch.float64)
    torch.testing.assert_close(
        drawn, factors[:, None] * torch.tensor([0.5, 0.1], dtype=torch.float64)
    )
    if warmup <= 20:
        assert drawn[-1].tolist() == pytest.approx([0.5 * final, 0.1 * final])


def test_a_schedule_of_torch_is_stepped_once_a_step(groups):
    optimizer = make_optimizer(ADAM, groups, RATES)
    schedule = make_schedule(CONSTANT, optimizer, lambda step: step / 20)
    assert type(schedule) is ConstantLR
    drawn = rates(schedule, optimizer, 5)
    assert drawn[:, 0].tolist() == pytest.approx([0.125, 0.125, 0.125, 0.5, 0.5])


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        (
            {"warmup": -1, "final": 0.1},
            ValueError,
            r"training\.schedule\.warmup must be at least 0 steps, got -1",
        ),
        (
            {"warmup": 0, "final": 0.0},
            ValueError,
            r"training\.schedule\.final must be in \(0, 1\], got 0\.0",
        ),
        (
            {"warmup": 0.5, "final": 1.0},
            TypeError,
            r"schedule option 'warmup' must be a whole number, got 0\.5",
        ),
        (
            {"warmpu": 5, "final": 1.0},
            ValueError,
            r"has no option 'warmpu' \(did you mean 'warmup'\?\)",
        ),
        ({"warmup": 5}, ValueError, r"training\.schedule needs option final"),
        (
            CONSTANT | {"warmup": 5},
            ValueError,
            r"training\.schedule has no option 'warmup'.* it has: factor",
        ),
        (
            CONSTANT | {"_target_": "torch.optim.SGD"},
            ValueError,
            r"must be a class of torch\.optim\.lr_scheduler, got",
        ),
    ],
)
def test_impossible_schedules_are_refused(groups, config, error, message):
    with pytest.raises(error, match=message):
        make_schedule(config, make_optimizer(ADAM, groups, RATES), lambda step: step / 20)
