"""Several processes that train together, signals that stop a run, and the resources that runs
share.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import gaigs
from gaigs import processes
from gaigs.io.tables import check_empty
from gaigs.report.training_log import read_curves
from gaigs.training.checkpoints import KeepLast

SMALL = (
    "+experiment=spectrum", "data.transmitters=36", "data.order=1", "training.thinning.stride=8",
    "tokenizer=euclidean", "gaussians.count=24", "deformation.width=8", "rasterizer=torch",
    # 26 places train: batches of 7, 7, 7 and 5, halves of 4 and 3 or of 3 and 2
    "training.batch_size=7",
    "training.density={every: 4, start: 4, stop: 12, gradient: 1e-4, split_angle: 0.3, opacity: 0.005, max_count: 40}",
    "trainer.accelerator=cpu", "trainer.precision=64-true", "trainer.max_steps=40", "trainer.val_check_interval=12",
    "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false", "baselines=[mean]",
)  # fmt: skip


def start(folder, *overrides):
    """``python -m gaigs`` beside a folder."""
    environment = os.environ | {
        "PYTHONPATH": str(Path(gaigs.__path__[0]).parent),
        "OMP_NUM_THREADS": "1",
    }
    words = [
        *(["-m"] if "-m" in overrides else []),
        *SMALL,
        *(word for word in overrides if word != "-m"),
    ]
    return subprocess.Popen(
        [sys.executable, "-m", "gaigs", *words],
        cwd=folder.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def wait_for(process, found):
    """Waits for the files of a training."""
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and process.poll() is None and not found():
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()


def test_two_processes_train_as_one_though_they_are_stopped(tmp_path):
    """40 steps in float64, with batches of odd sizes; SIGTERM to the first process alone."""
    folder = tmp_path / "two"
    command = (folder, "trainer.devices=2", "trainer.strategy=ddp", f"hydra.run.dir={folder}")
    process = start(*command, "save_every=0")
    wait_for(process, (folder / "last.ckpt").is_file)
    with (
        pytest.raises(ValueError, match=r"another run is at work in .*two"),
        processes.only_run(folder),
    ):
        pass
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 143
    step = torch.load(folder / "last.ckpt", weights_only=True)["global_step"]
    assert (
        err
        == f"gaigs: stopped after step {step}; the same command with hydra.run.dir={folder} goes on\n"
    )
    process = start(*command)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert out.count("data: synthetic") == 1, "the first process logs for all"

    metrics, others = (
        gaigs.run(gaigs.compose(*SMALL), tmp_path / "one"),
        json.loads((folder / "metrics.json").read_text()),
    )
    assert metrics["num_gaussians"] == others["num_gaussians"] != metrics["num_gaussians_start"]
    assert metrics["models"]["gaigs"] == pytest.approx(others["models"]["gaigs"], rel=1e-5)
    one, two = (
        torch.load(tmp_path / name / "last.ckpt", weights_only=True)["state_dict"]
        for name in ("one", "two")
    )
    assert one.keys() == two.keys()
    for key in one:
        torch.testing.assert_close(one[key], two[key], rtol=1e-9, atol=1e-9)
    curves, resumed = (
        read_curves(sorted((tmp_path / name).glob("log/*/metrics.csv"))) for name in ("one", "two")
    )
    assert curves.keys() == resumed.keys()
    for name, (steps, values) in curves.items():
        assert steps.tolist() == resumed[name][0].tolist()
        assert values == pytest.approx(resumed[name][1], rel=1e-6), (
            name
        )  # float32 in the validation's mean


def test_sigterm_stops_all_jobs_of_a_launcher(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs gaigs[parallel]")
    jobs = (
        "-m",
        "seed=0,1,2",
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
        f"hydra.sweep.dir={tmp_path / 's'}",
    )
    process = start(tmp_path / "s", *jobs, "save_every=0.2", "trainer.max_steps=100000")

    def saved():
        return sorted((tmp_path / "s").glob("*/last.ckpt"))

    wait_for(process, lambda: len(saved()) == 2)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=120)
    assert process.returncode == 143
    assert [path.parent.name.partition("seed=")[2][0] for path in saved()] == ["0", "1"], (
        "the third is not started"
    )
    assert all(torch.load(path, weights_only=True)["global_step"] > 0 for path in saved())


def test_a_launchers_process_that_waits_for_a_run_outlives_sigterm(monkeypatch):
    """Its launcher would wait for it forever; and no other run starts there."""
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


class Dying:
    """An object whose end ignores the error of a signal."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        signal.raise_signal(self.number)


@pytest.mark.parametrize("number", processes.STOPPING)
def test_a_signal_that_python_ignores_stops_a_run_all_the_same(number):
    def work():
        Dying(number)
        for _ in range(1000):
            time.sleep(0.02)

    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt) as stop, processes.stopping():
        work()
    assert getattr(stop.value, "number", signal.SIGINT) == number
    assert sys.unraisablehook is hook


@pytest.mark.parametrize("trains", [False, True])
def test_the_second_signal_of_a_closed_terminal_is_ignored(trains, tmp_path):
    """The system and the shell each send one; at a second signal of another kind a training does
    not save.
    """
    before = signal.getsignal(signal.SIGHUP)
    keep = KeepLast(tmp_path / "last.ckpt", every=0)
    try:
        with contextlib.suppress(processes.Stopped), processes.stopping():
            if trains:
                signal.signal(signal.SIGHUP, keep.interrupt)
            try:
                signal.raise_signal(signal.SIGHUP)
            finally:
                signal.raise_signal(signal.SIGHUP)
                saved = True
    finally:
        signal.signal(signal.SIGHUP, before)
    assert saved
    assert keep.received == (signal.SIGHUP if trains else None)


def test_nohup_is_heeded():
    code = "import signal; from gaigs import processes; print(signal.SIGHUP in processes.STOPPING)"
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent)}
    for words, expected in ((["nohup"], "False"), ([], "True")):
        command = [*words, sys.executable, "-c", code]

        def usual():
            return signal.signal(signal.SIGHUP, signal.SIG_DFL)

        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, preexec_fn=usual
        )
        assert done.stdout.strip() == expected


def test_an_ignored_signal_at_the_very_end_counts():
    with pytest.raises(processes.Stopped), processes.stopping():
        Dying(signal.SIGTERM)


def test_an_ignored_signal_is_not_sent_again_while_a_run_stops():
    saved = []

    def work():
        try:
            Dying(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
        finally:
            time.sleep(0.2)  # four times the delay
            saved.append(True)

    with pytest.raises(processes.Stopped), processes.stopping():
        work()
    assert saved


@pytest.mark.parametrize("name", ["NODE_RANK", "GROUP_RANK"])
def test_only_one_machine_has_the_first_process(name, monkeypatch):
    assert processes.is_first()
    monkeypatch.setenv(name, "1")
    assert not processes.is_first()
    monkeypatch.setenv("RANK", "0")  # a number over all machines, from torchrun
    assert processes.is_first()


def test_jobs_of_a_launcher_share_the_processors(monkeypatch):
    threads = torch.get_num_threads()
    names = ("OMP_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name in names:
        monkeypatch.setenv(name, "")
    for count, jobs, expected in (
        (None, 4, 2),
        (None, -1, 1),
        (None, 16, 1),
        (3, 4, 3),
        (None, 1, threads),
    ):
        with processes.limited_threads(count, jobs):
            assert torch.get_num_threads() == expected
            if expected != threads:
                assert {os.environ[name] for name in names} == {str(expected)}
        assert torch.get_num_threads() == threads, "undone"
        assert os.environ["OMP_NUM_THREADS"] == ""
    with pytest.raises(ValueError, match="threads must be at least 1, or null for all, got 0"):
        with processes.limited_threads(0):
            pass


def test_parts_in_threads_give_what_they_give_one_after_the_other():
    leaf = torch.ones(5, requires_grad=True)

    def squares(row: int) -> torch.Tensor:
        if row > 4:
            raise ValueError("no such row")
        return leaf[row] ** 2

    for count in (1, 3):
        with processes.limited_threads(count):
            results = processes.in_threads(squares, range(5))
            assert results[4].requires_grad
            with torch.no_grad():
                assert not processes.in_threads(squares, range(5))[4].requires_grad
            with pytest.raises(ValueError, match="no such row"):
                processes.in_threads(squares, range(6))
            assert torch.get_num_threads() == count


def test_a_fault_of_a_plug_in_has_its_file_and_line(tmp_path):
    file = tmp_path / "plug_in.py"
    file.write_text(
        "def fault():\n    return len(3)\n\n\ndef refusal():\n    raise ValueError('width is too "
        "small')\n"
    )
    functions: dict = {}
    exec(compile(file.read_text(), str(file), "exec"), functions)
    messages = {}
    for name in ("fault", "refusal"):
        with pytest.raises((TypeError, ValueError)) as caught:
            functions[name]()
        error = caught.value.with_traceback(caught.tb.tb_next)  # without the test's own frame
        messages[name] = processes.advice(error, tmp_path, "")
    assert messages["fault"].splitlines()[1].startswith(f"at {file}, line 2; hydra.verbose=true")
    assert messages["refusal"] == "width is too small"


def test_a_folder_is_held_by_one_run_at_a_time(tmp_path):
    with pytest.raises(ValueError, match="another run is at work"):
        with processes.only_run(tmp_path), processes.only_run(tmp_path):
            pass
    with processes.only_run(tmp_path):
        check_empty(tmp_path)  # the lock does not count
    assert not list(tmp_path.iterdir())


def test_a_killed_process_holds_no_folder(tmp_path):
    code = (
        "import os, pathlib, signal; from gaigs import processes\n"
        f"with processes.only_run(pathlib.Path({str(tmp_path)!r})):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    assert [file.name for file in tmp_path.iterdir()] == [".lock"]
    with processes.only_run(tmp_path):
        pass


def test_a_run_whose_folder_was_made_anew_leaves_the_lock_of_another(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    with processes.only_run(folder):
        shutil.rmtree(folder)
        folder.mkdir()
        with processes.only_run(folder):
            pass
        (folder / ".lock").touch()  # of another run
    assert (folder / ".lock").exists()
    with pytest.raises(FileNotFoundError), processes.only_run(tmp_path / "missing"):
        pass
    assert not (tmp_path / "missing").exists()
