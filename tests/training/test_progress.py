import re
from types import SimpleNamespace

import pytest
import torch

from gaigs.training.budget import make_budget
from gaigs.training.progress import ProgressLine

MODULE = SimpleNamespace(task=SimpleNamespace(monitor="ssim"))


def trainer(step, steps, **options):
    options = {"progress_bar_metrics": {}, "is_global_zero": True, "callbacks": []} | options
    return SimpleNamespace(global_step=step, max_steps=steps, **options)


@pytest.mark.parametrize(
    ("steps", "share", "shown"),
    [
        (1500, 1499 / 1500, r"1499/1500 [\d.]+ steps/s \S+ loss 0\.250 ssim 0\.500"),
        (-1, 0.25, r"1499 steps .*"),
    ],
)
def test_the_line_fits_80_columns_and_counts_steps_or_time(
    capsys, monkeypatch, steps, share, shown
):
    monkeypatch.setenv("COLUMNS", "80")
    _, budget = make_budget({"max_steps": steps, "max_time": "00:00:03:00"})
    own = trainer(1200, steps, callbacks=[budget], progress_bar_metrics={"v_num": 3})
    line = ProgressLine()
    line.on_train_start(own, None)
    own.global_step, budget.share = 1499, 0.25
    own.progress_bar_metrics["validation/ssim"] = 0.5
    line.on_train_batch_end(own, MODULE, {"loss": torch.tensor(0.25)})
    assert [task.percentage for task in line.line.tasks] == [pytest.approx(100 * share)]
    line.on_train_end(own, MODULE)
    (out,) = capsys.readouterr().out.strip().splitlines()
    assert len(out) <= 80
    assert re.fullmatch(rf"training \S+ +{shown}", out), out


def test_the_line_gives_the_terminal_back_after_an_error():
    line = ProgressLine()
    line.on_exception(None, None, ValueError())
    line.on_train_start(trainer(0, 3), None)
    line.on_exception(None, None, ValueError())
    assert not line.line.live.is_started


def test_of_several_processes_the_first_alone_shows_a_line(capsys):
    line, own = ProgressLine(), trainer(0, 3, is_global_zero=False)
    line.setup(own, MODULE, "fit")
    line.disable()
    line.on_train_start(own, MODULE)
    line.on_train_batch_end(own, MODULE, {"loss": torch.tensor(0.25)})
    line.on_train_end(own, MODULE)
    assert capsys.readouterr().out == ""
