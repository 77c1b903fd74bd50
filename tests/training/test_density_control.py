"""Density control without a trainer, at gradients that the test sets."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.splatting.gaussians import Gaussians
from gaigs.training.density_control import DensityControl

MIDDLE = (1.0, 2.0, 0.5)


@pytest.fixture
def module(links):
    """Six Gaussians 2 m from the receiver, the third wide, the sixth faint."""
    scene = replace(
        links.scene, receivers=(Receiver("gateway1", Pose.from_xyzw(MIDDLE, (0.0, 0.0, 0.0, 1.0))),)
    )
    options = {"count": 6, "near": 2.0, "far": 2.0, "spread": 1.0, "opacity": 0.5, "signal": 1.0}
    gaussians = Gaussians(scene, zone=(0.0, math.pi / 2), channels=2, **options)
    with torch.no_grad():
        gaussians.log_scales.fill_(math.log(0.1))
        gaussians.log_scales[2, 1] = math.log(1.0)
        gaussians.opacity_logits[5] = -9
    optimizer = torch.optim.AdamW(gaussians.parameters(), lr=1e-9)
    return SimpleNamespace(
        model=SimpleNamespace(primitives=gaussians, scene=scene), optimizer=optimizer
    )


def control(**options):
    given = {
        "every": 2,
        "start": 2,
        "stop": 6,
        "gradient": 1.0,
        "split_angle": 0.2,
        "opacity": 0.01,
    }
    return DensityControl(**(given | {"max_count": 100, "seed": 0} | options))


def step(callback, module, number, pulls, processes=1):
    """The count after one optimizer step with these gradients of the means [loss/m]."""
    gaussians = module.model.primitives
    for parameter in gaussians.parameters():
        parameter.grad = torch.zeros_like(parameter)
    gaussians.means.grad[: len(pulls), 1] = torch.tensor(pulls)
    callback.on_before_optimizer_step(None, module, module.optimizer)
    module.optimizer.step()
    module.strategy = SimpleNamespace(_setup_model=lambda module: "wrapped anew", model="wrapped")
    trainer = SimpleNamespace(
        global_step=number, optimizers=[module.optimizer], world_size=processes
    )
    trainer.strategy = module.strategy
    callback.on_train_batch_end(trainer, module)
    return len(gaussians)


def test_narrow_gaussians_are_cloned_wide_ones_split_faint_ones_pruned(module):
    callback = control()
    before = module.model.primitives.scales.detach().clone()
    # The bound is 1 per radian, 0.5 per metre at 2 m: the mean pull of the two steps decides, 0.6
    # and 0.45.
    assert step(callback, module, 1, [0.0, 0.9, 0.9, 0.45, 0.0, 0.0]) == 6
    assert step(callback, module, 2, [0.0, 0.3, 0.3, 0.45, 0.0, 0.0]) == 7
    scales = module.model.primitives.scales
    assert torch.equal(scales[[0, 1, 3, 4]], before[[0, 1, 3, 4]])
    assert torch.equal(scales[5], before[1]), "the clone"
    torch.testing.assert_close(scales[[2, 6]], before[[2, 2]] / 1.6)
    for parameter in module.model.primitives.parameters():
        assert module.optimizer.state[parameter]["exp_avg"].shape == parameter.shape


def test_rounds_keep_the_schedule_and_forget_the_pull_before_them(module):
    callback = control(start=4, stop=6)
    counts = [step(callback, module, number, [9.0]) for number in range(1, 10)]
    assert counts == [6, 6, 6, 6, 6, 7, 7, 7, 7], (
        "at 4 one is cloned and one pruned, at 6 one cloned"
    )
    callback = control(stop=100)
    step(callback, module, 1, [9.0])
    assert step(callback, module, 2, [9.0]) == 8
    step(callback, module, 3, [0.0])
    assert step(callback, module, 4, [0.0]) == 8


def test_the_number_grows_to_the_bound_by_the_hardest_pulled(module):
    module.model.primitives.opacity_logits.data[5] = 0
    marks = torch.arange(6.0)
    module.model.primitives.signal.data[:, 0, 0] = marks
    step(control(every=1, start=1, max_count=8), module, 1, [2.0, 5.0, 1.0, 4.0, 3.0, 0.0])
    assert sorted(module.model.primitives.signal[:, 0, 0].tolist()) == sorted(
        [*marks.tolist(), 1, 3]
    )


def test_density_control_goes_on_from_its_state(module):
    first, second = control(), control()
    step(first, module, 1, [9.0])
    second.load_state_dict(first.state_dict())
    assert step(second, module, 2, [0.0]) == 6, (
        "half of 9 is above the bound: one cloned, one pruned"
    )


def test_of_several_processes_each_wraps_the_new_parameters(module):
    step(control(every=1, start=1), module, 1, [9.0], processes=2)
    assert module.strategy.model == "wrapped anew"


def test_frozen_positions_end_density_control(module):
    module.model.primitives.means.requires_grad_(False)
    callback = control(every=1, start=1)
    callback.on_before_optimizer_step(None, module, module.optimizer)
    callback.on_train_batch_end(SimpleNamespace(global_step=1, optimizers=[None]), module)
    assert (callback.steps, len(module.model.primitives)) == (0, 6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, r"every must be at least 1, got 0"),
        ({"start": -1}, r"start must be at least 0, got -1"),
        ({"start": 9, "stop": 8}, r"stop must be at least 9, got 8"),
        ({"gradient": math.nan}, r"gradient must be at least 0, got nan"),
        ({"split_angle": -0.1}, r"split_angle must be at least 0, got -0\.1"),
        ({"opacity": 1.0}, r"opacity must be in \[0, 1\), got 1\.0"),
        ({"opacity": math.nan}, r"opacity must be in \[0, 1\), got nan"),
        ({"max_count": 0}, r"max_count must be at least 1, got 0"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=rf"^density\.{message}$"):
        control(**options)


def test_a_model_without_gaussians_is_refused():
    with pytest.raises(ValueError, match="density needs a model with Gaussians"):
        control().on_fit_start(None, SimpleNamespace(model=SimpleNamespace(primitives=None)))
