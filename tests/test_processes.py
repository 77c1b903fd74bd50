"""Several processes that train together, signals that stop a run, and what runs share: as a user starts them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import gaigs
from gaigs import processes
from gaigs.report.curves import read_curves

SMALL = (
    "tokenizer=euclidean",
    "gaussians.count=24",
    "deformation.width=8",
    "training.batch_size=7",  # 26 places train: batches of 7, 7, 7 and 5, halves of 4 and 3 or of 3 and 2
    "trainer.accelerator=cpu",
    "trainer.precision=64-true",
    "trainer.max_steps=20",
    "trainer.val_check_interval=6",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "baselines=[{name: mean}]",
)
SPECTRUM = ("+experiment=spectrum", "data.transmitters=36", "data.order=1", "training.thinning.stride=8")
DENSITY = (
    "training.density={every: 4, start: 4, stop: 12, gradient: 1.0e-4, split_angle: 0.3, opacity: 0.005, max_count: 40}"
)
RSSI = ("+experiment=rssi", "data.transmitters=36", "data.order=0")  # not every gateway hears every place
TWO = ("trainer.devices=2", "trainer.strategy=ddp")
LONG = ("trainer.max_steps=100000", "trainer.precision=32-true")


def start(folder, *overrides, multirun=False):
    """``python -m gaigs`` in a folder."""
    place = f"hydra.sweep.dir={folder}" if multirun else f"hydra.run.dir={folder}"
    command = [sys.executable, "-m", "gaigs", *(["-m"] if multirun else []), *SMALL, *overrides, place]
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent), "COLUMNS": "80"}
    environment["OMP_NUM_THREADS"] = "1"
    return subprocess.Popen(
        command, cwd=folder.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run(folder, *overrides):
    process = start(folder, *overrides)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out


def wait_for(process, found):
    """Until something is there that a training leaves behind."""
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and process.poll() is None and not found():
        time.sleep(0.05)
    assert process.poll() is None, process.communicate()


def weights(folder, name="last"):
    return torch.load(folder / f"{name}.ckpt", weights_only=True)["state_dict"]


def assert_same_training(one, other, tolerance):
    """Weights and the log of every step are the same to a tolerance."""
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    for key in a:
        torch.testing.assert_close(
            a[key], b[key], rtol=tolerance, atol=tolerance, msg=lambda text, k=key: f"{k}: {text}"
        )
    curves, others = (read_curves(sorted(folder.glob("log/*/metrics.csv"))) for folder in (one, other))
    assert curves.keys() == others.keys()
    for name, (steps, values) in curves.items():
        assert steps.tolist() == others[name][0].tolist()
        assert values == pytest.approx(others[name][1], rel=1e-6), name  # float32 in the validation's mean


@pytest.mark.parametrize("overrides", [(*SPECTRUM, DENSITY), RSSI], ids=["spectrum with density control", "rssi"])
def test_two_processes_train_as_one_does(overrides, tmp_path):
    """20 steps in float64; batches do not halve evenly, and a place of RSSI has as many links as gateways hear it."""
    run(tmp_path / "one", *overrides)
    out = run(tmp_path / "two", *overrides, *TWO)
    assert out.count("data: synthetic") == 1, "one of the processes tells it all"
    assert_same_training(tmp_path / "one", tmp_path / "two", 1e-9)
    if DENSITY in overrides:
        counts = json.loads((tmp_path / "two" / "metrics.json").read_text())
        assert counts["num_gaussians"] != counts["num_gaussians_start"], "density control has changed their number"
    one, two = (json.loads((tmp_path / name / "metrics.json").read_text())["models"] for name in ("one", "two"))
    for model in one:
        assert one[model] == pytest.approx(two[model], rel=1e-5)


def test_two_processes_stop_together_and_go_on(tmp_path):
    """SIGTERM to the first alone."""
    run(tmp_path / "whole", *SPECTRUM, *TWO, "trainer.max_steps=60")
    process = start(tmp_path / "stopped", *SPECTRUM, *TWO, "trainer.max_steps=60", "save_every=0")
    wait_for(process, (tmp_path / "stopped" / "last.ckpt").is_file)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 143, err
    assert err.count("\n") == 1
    assert "gaigs: stopped after step" in err
    run(tmp_path / "stopped", *SPECTRUM, *TWO, "trainer.max_steps=60", "save_every=0")
    assert_same_training(tmp_path / "whole", tmp_path / "stopped", 0)


def test_two_processes_end_together_when_their_time_is_up(tmp_path):
    """Validations and the last step are the same for both, or they would wait for each other."""
    by_time = ("trainer.max_steps=-1", "trainer.max_time=00:00:00:03", "trainer.val_check_interval=00:00:00:01")
    run(tmp_path / "timed", *SPECTRUM, *TWO, *by_time)
    step = torch.load(tmp_path / "timed" / "last.ckpt", weights_only=True)["global_step"]
    validated, _ = read_curves([tmp_path / "timed" / "log" / "version_0" / "metrics.csv"])["seconds"]
    assert validated[-1] == step - 1


def test_sigterm_stops_a_run_as_ctrl_c_does(tmp_path):
    process = start(tmp_path / "run", *SPECTRUM, *LONG, "save_every=0.2")
    wait_for(process, (tmp_path / "run" / "last.ckpt").is_file)
    second = start(tmp_path / "run", *SPECTRUM, *LONG, "save_every=0.2")
    _, err = second.communicate(timeout=120)
    assert second.returncode == 1
    assert "must be free, and another run is at work there" in err
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 143
    step = torch.load(tmp_path / "run" / "last.ckpt", weights_only=True)["global_step"]
    assert err == f"gaigs: stopped after step {step}; the same command with hydra.run.dir={tmp_path / 'run'} goes on\n"


def test_a_launchers_process_that_waits_for_a_run_outlives_sigterm(monkeypatch):
    """Its launcher would wait for it for ever; and no other run is to start there."""
    monkeypatch.setattr(processes, "received", [])
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(processes.Stopped), processes.stopping(waits=True):
            os.kill(os.getpid(), signal.SIGTERM)
        assert not processes.received
        os.kill(os.getpid(), signal.SIGTERM)
        assert processes.received == [signal.SIGTERM]
        with pytest.raises(processes.Stopped), processes.stopping(waits=True):
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("number", processes.STOPPING)
def test_a_signal_that_python_passes_over_stops_a_run_all_the_same(number):
    class Dying:
        def __del__(self):
            signal.raise_signal(number)

    def work():
        Dying()  # whose end passes over the error
        time.sleep(20)

    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt) as stop, processes.stopping():
        work()
    assert getattr(stop.value, "number", signal.SIGINT) == number
    assert sys.unraisablehook is hook


class Passing:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_that_was_passed_over_at_the_very_end_counts():
    with pytest.raises(processes.Stopped), processes.stopping():
        Passing()


def test_a_signal_that_was_passed_over_does_not_come_again_while_a_run_stops():
    saved = []

    def work():
        try:
            Passing()
            signal.raise_signal(signal.SIGTERM)
        finally:
            time.sleep(4 * processes.AGAIN)
            saved.append(True)

    with pytest.raises(processes.Stopped), processes.stopping():
        work()
    assert saved


def test_torchrun_within_slurm_says_itself_which_process_this_is(monkeypatch):
    monkeypatch.setenv("SLURM_NTASKS", "2")
    monkeypatch.delenv("SLURM_NTASKS_PER_NODE", raising=False)
    monkeypatch.delenv("SLURM_JOB_NAME", raising=False)
    with pytest.raises(ValueError, match="SLURM_NTASKS_PER_NODE must be in the environment"):
        processes.check_ranks()
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    processes.check_ranks()


def test_sigterm_stops_all_jobs_of_a_launcher(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs gaigs[parallel]")
    jobs = ("seed=0,1,2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "save_every=0.2")
    process = start(tmp_path / "sweep", *SPECTRUM, *LONG, *jobs, multirun=True)
    saved = lambda: sorted((tmp_path / "sweep").glob("*/last.ckpt"))
    wait_for(process, lambda: len(saved()) == 2)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=120)
    assert process.returncode == 143
    assert len(saved()) == 2, "the third is not started"
    assert sorted(path.parent.name.partition("seed=")[2][0] for path in saved()) == ["0", "1"]
    for path in saved():
        assert torch.load(path, weights_only=True)["global_step"] > 0


def test_jobs_of_a_launcher_share_the_processors(monkeypatch):
    threads = torch.get_num_threads()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name in ("OMP_NUM_THREADS", *processes.POCL_THREADS):
        monkeypatch.setenv(name, "")
    for count, jobs, expected in ((None, 4, 2), (None, -1, 1), (None, 16, 1), (3, 4, 3), (None, 1, threads)):
        with processes.limited_threads(count, jobs):
            assert torch.get_num_threads() == expected
            if expected != threads:
                assert {os.environ[name] for name in ("OMP_NUM_THREADS", *processes.POCL_THREADS)} == {str(expected)}
        assert torch.get_num_threads() == threads, "undone"
        assert os.environ["OMP_NUM_THREADS"] == ""
    with (
        pytest.raises(ValueError, match="threads must be at least 1, or null for all, got 0"),
        processes.limited_threads(0),
    ):
        pass


def test_a_folder_is_held_by_one_run_at_a_time(tmp_path):
    with (
        processes.only_run(tmp_path),
        pytest.raises(ValueError, match="another run is at work there; wait for it, or choose another folder"),
        processes.only_run(tmp_path),
    ):
        pass
    with processes.only_run(tmp_path):
        assert not list(tmp_path.iterdir())


def test_a_job_of_a_multirun_trains_in_one_process(tmp_path):
    process = start(tmp_path / "sweep", *SPECTRUM, *TWO, "seed=0", multirun=True)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "a job of a multirun must train in one process; run it alone" in err
