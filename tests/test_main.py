"""The command line as a user meets it; results of runs are tested in test_runs.py."""

import csv
import errno
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml

import gaigs
from gaigs import runs
from gaigs.commands import agreement, command_line
from gaigs.processes import Stopped, only_run
from gaigs.report.multirun import report
from gaigs.report.training_log import read_curves

pytestmark = pytest.mark.usefixtures("unchecked")

SMALL = (
    "tokenizer=euclidean",
    "data.transmitters=30",
    "rasterizer=torch",
    "gaussians.count=30",
    "training.batch_size=7",
    "training.thinning.stride=8",
    "trainer.accelerator=cpu",
    "trainer.max_steps=40",
    "trainer.val_check_interval=15",
    "trainer.log_every_n_steps=2",
    "baselines=[{name: mean}, {name: knn, k: 3, power: 2.0}]",
)


def start(folder, *overrides):
    """``python -m gaigs``, as from any folder."""
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent), "COLUMNS": "80"}
    return subprocess.Popen(
        [sys.executable, "-m", "gaigs", *SMALL, *overrides],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """A run in the folder that it chooses, and its output."""
    cwd = tmp_path_factory.mktemp("anywhere")
    process = start(cwd, "+experiment=spectrum")
    out, err = process.communicate()
    assert process.returncode == 0, err
    (folder,) = (cwd / "runs").iterdir()
    return folder, out, err


@pytest.mark.parametrize(
    ("experiment", "task", "count"),
    [("spectrum", "rssi", 1), ("mirrored_csi", "rssi", 1), ("spectrum_full", "csi", 1), ("rssi", "rssi", 0),
     ("claims_rssi", "rssi", 0), ("mirrored", "rssi", 0)],
)  # fmt: skip
def test_an_experiment_for_another_task_than_the_data_is_named(caplog, experiment, task, count):
    config = {"task": {"name": task}, "data": {"name": "rssi_csv"}}
    command_line.note_task([f"+experiment={experiment}", "data=rssi_csv"], config)
    command_line.note_task([f"+experiment={experiment}", "command=devices"], {"command": "devices"})
    found = [record.message for record in caplog.records]
    assert len(found) == count
    assert all(f"labels of data=rssi_csv are of {task}" in line for line in found)


def test_a_run_prints_what_it_does_and_nothing_else(uninterrupted):
    folder, out, err = uninterrupted
    assert err == ""
    lines = out.splitlines()
    assert (folder / "gaigs.log").read_text().splitlines() == [*lines[:3], *lines[4:7]]
    assert (
        lines[0]
        == "data: synthetic; split official, validation 0.1, seed 0: 22 train, 2 validation, 6 test"
    )
    assert re.match(
        r"data: training transmitters within \d\.\d\d x \d\.\d\d x \d\.\d\d m$", lines[1]
    )
    assert lines[2].startswith(
        "model: gaigs, placement free, tokenizer euclidean, deformation basis, projection mercator"
    )
    assert re.match(
        r"training .* 40/40 [\d.]+ steps/s 0:00:00 loss \d\.\d{3} ssim \d\.\d{3}$", lines[3]
    )
    assert re.match(r"trained 40 steps of 7 places in \d+ s: [\d.]+ steps/s$", lines[4])
    assert lines[5] == "gaigs has no intervals: 2 links calibrate them, and 9 are needed"
    assert lines[6].startswith("seconds: reading ")
    assert "Test scores" in lines[7]
    assert lines[-1].endswith(str(folder))
    assert all(len(line) <= 80 for line in [*lines[3:6], *lines[7:-1]])


def test_a_run_folder(uninterrupted):
    folder, _, _ = uninterrupted
    figures = {path.name for path in (folder / "figures").iterdir()}
    assert figures == {"room.png", "loss.png", "spectra.png", "spectra_polar.png", "ssim_cdf.png"}
    assert json.loads((folder / "metrics.json").read_text())["train_seconds"] > 0
    assert yaml.safe_load((folder / "config.yaml").read_text())["gaussians"]["count"] == 30


def test_a_killed_run_ends_as_if_it_had_not_been(uninterrupted, run, tmp_path):
    process, last = start(tmp_path, "save_every=0", "hydra.run.dir=run"), tmp_path / "run/last.ckpt"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if last.exists() and torch.load(last, weights_only=True)["global_step"] >= 6:
            break
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert run(*SMALL, "+experiment=spectrum", "hydra.run.dir=run") == (0, "")
    assert int(re.search(r"going on after step (\d+)", run.out)[1]) >= 6
    folder = uninterrupted[0]
    metrics, others = (
        json.loads((path / "metrics.json").read_text()) for path in (folder, tmp_path / "run")
    )
    assert metrics["models"] == others["models"]
    for name in ("best.ckpt", "last.ckpt"):
        a, b = (torch.load(path / name, weights_only=True) for path in (folder, tmp_path / "run"))
        assert a["global_step"] == b["global_step"]
        assert list(a["state_dict"]) == list(b["state_dict"])
        assert all(
            torch.equal(a["state_dict"][key], b["state_dict"][key]) for key in a["state_dict"]
        )


# --- within this process, as a start takes seconds ---


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Runs the command line; gives its exit code and its stderr; ``run.out`` is the rest."""
    monkeypatch.chdir(tmp_path)
    root = logging.getLogger()
    handlers = list(root.handlers)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["gaigs", *arguments])
        code = 0
        try:
            command_line.main()
        except SystemExit as end:
            code = end.code
        run.out, err = capsys.readouterr()
        return code, err

    yield run
    for handler in set(root.handlers) - set(handlers):
        handler.close()
    root.handlers[:] = handlers


HERE = ("hydra.run.dir=run", "trainer.enable_progress_bar=false")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("tokenizer.widht=3", "tokenizer 'euclidean' has no key 'widht' (did you mean 'width'?); it has: "),
        ("sede=3", "the configuration has no key 'sede'; did you mean seed?\n"),
        ("lr=0.01", "the configuration has no key 'lr'; did you mean training.learning_rates?\n"),
        ("training.lr=0.01", "(did you mean 'learning_rates'?); it has: "),
        ("xyzzy=1", "the configuration has no key 'xyzzy'; it has: baselines, command"),
        ("tokenizer=gaa", "there is no tokenizer 'gaa' (did you mean 'ga'?); there are: euclidean, "),
        ("model=gsrf", "model 'gsrf' is in the package gaigs-gsrf, which is not installed\npip install gaigs-gsrf"),
        ("data=sionna_csi", "data 'sionna_csi' is in the package gaigs-sionna, which is not installed"),
        ("+experiment=foo", "there is no experiment 'foo'; there are: claims, claims_rssi, csi, mirrored, "),
        ("seed=[", "Hydra cannot read it: no viable alternative at input '['"),
        ("~nothing", "Hydra cannot read it: Could not delete from config. 'nothing' does not exist."),
        ("density=null", "a part is chosen by the name of its file (Config group"),
        ("+tokenizer.widht=3", "tokenizer 'euclidean' has no option 'widht' (did you mean 'width'?)"),
        ("data=nerf2_spectrum data.root=nowhere +split.sede=3", "has no option 'sede' (did you mean 'seed'?)"),
        ("trainer.accelerator=gpu", "No supported gpu backend found!)\ncheck its options: accelerator=gpu\n"),
        ("seed=${sed}", "the configuration is not complete: Interpolation key 'sed' not found"),
        ("trainer.val_check_interval=1.5", "trainer.val_check_interval must be a whole number, got 1.5"),
        ("save_every=nan", "save_every must be a finite number, got nan"),
        ("save_every=-1", "save_every must be at least 0 s, got -1"),
        ("baselines=[3]", "baselines, entry 0, must be a mapping, got 3"),
        ("seed=-1", "seed must be in 0..4294967295, got -1"),
        ("+thread=3", "the configuration has no key 'thread' (did you mean 'threads'?)"),
        ("command=trian", "command must be one of train, agreement, describe, survey, place, locate, export, "),
        ("command=describe folder=runs/a", "reads no folder; leave it out and use data=... and split=..."),
        ("command=exprt", "devices, got 'exprt' (did you mean 'export'?)"),
        ("command=report", "there is no command 'report'; python -m gaigs.report FOLDER makes its tables"),
        ("command=benchmark", "there is no command 'benchmark'; python benchmarks/step.py and others measure, in a"),
        ("split=blocks", "split.edge must be given, as it has no default; add split.edge=1.0, the edge of a cube [m]"),
        ("~command", "the configuration needs the key 'command'"),
        ("data=nerf2_spectrum", "data.root must be given, as it has no default; add data.root=/path/to/folder"),
        ("data=nerf2_spectrum data.root=nowhere", "nowhere must be the folder of a data set"),
        ("-m model=knn,mean model.k=3", "in a sweep write ++model.k=... for a key that only the swept model has"),
        ("model=kriging", "model 'kriging' is made from trained models; set kriging=true, with any model"),
    ],
)  # fmt: skip
def test_a_wrong_word_gives_one_message(overrides, message, run):
    if "accelerator=gpu" in overrides and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    small = () if "data=" in overrides else SMALL
    words = overrides.split()
    code, err = run(
        *(["-m"] if "-m" in words else []), *small, *HERE, *(word for word in words if word != "-m")
    )
    assert code == 1
    assert message in err
    assert "Traceback" not in err
    if "-m" not in words:  # of a sweep Hydra names the job first
        assert err.startswith("gaigs: ")
    text = err[err.index("gaigs: ") :].rstrip("\n")
    assert text.count("\n") <= 1, text
    assert not Path("run").exists(), "a folder without a result"


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (
            ("--epochs", "10"),
            "there is no flag --epochs; options have no dashes, such as trainer.max_steps=...",
        ),
        (
            ("--batch-size=8",),
            "there is no flag --batch-size; options have no dashes, such as "
            "training.batch_size=...",
        ),
        (
            ("seed=1", "--model", "knn"),
            "there is no flag --model; options have no dashes, such as model=...",
        ),
    ],
)
def test_a_flag_names_the_option_that_it_means(words, near, run):
    assert run(*words) == (2, f"gaigs: {near}\n")


UNREADABLE = {
    "a list without its end": (b"name: [odd\n", "odd.yaml: while parsing"),
    "a key twice": (b"name: odd\nname: odd\n", "odd.yaml: while constructing"),
    "code": (
        b"name: !!python/object/apply:os.system ['true']\n",
        "odd.yaml: could not determine a constructor",
    ),
    "UTF-16": ("name: odd".encode("utf-16"), "odd.yaml: not UTF-8\n"),
    "no list of defaults": (b"defaults: x\n", "files (Invalid defaults list in"),
    "a circle": (b"defaults: [odd]\nname: odd\n", "its files choose each other in a circle"),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_configuration_file_that_hydra_cannot_read_is_named(case, run, tmp_path):
    content, message = UNREADABLE[case]
    folder = tmp_path / "plugins" / "conf" / "model"
    folder.mkdir(parents=True)
    (folder / "odd.yaml").write_bytes(content)
    code, err = run(*HERE, "model=odd")
    assert code == 1
    assert message in err
    assert err.startswith(
        ("gaigs: cannot parse ", "gaigs: Hydra cannot join command line and configuration")
    )
    assert err.count("\n") == 1


def test_a_verbose_run_prints_the_traceback_before_the_message(run):
    code, err = run(*SMALL, *HERE, "tokenizer.width=0", "hydra.verbose=true")
    assert code == 1
    assert re.search("Traceback.*\nValueError: (.*)\n.*gaigs: \\1", err, re.DOTALL)
    assert not os.environ["HYDRA_FULL_ERROR"]


@pytest.fixture
def devices(monkeypatch):
    """Two OpenCL devices, neither of which is asked for; to be changed."""
    opencl = pytest.importorskip("gaigs.splatting.rasterizer.opencl", exc_type=ImportError)
    kind, platform = opencl.cl.device_type, SimpleNamespace(name="Maker", get_devices=lambda: found)
    found = [
        SimpleNamespace(name=name, type=getattr(kind, name), platform=platform)
        for name in ("GPU", "CPU")
    ]
    monkeypatch.setattr(opencl.cl, "get_platforms", lambda: [platform])
    monkeypatch.delenv("GAIGS_OPENCL_DEVICE", raising=False)
    return found


@pytest.mark.usefixtures("devices")
def test_devices_are_listed_whatever_the_rest_of_the_configuration(run, tmp_path, monkeypatch):
    mark = "  <- rasterizer=opencl takes this one"
    monkeypatch.setattr(runs, "run", None)
    assert run("command=devices", "data=nerf2_spectrum", "seed=${sed}", *HERE) == (0, "")
    assert run.out == f"Maker: GPU (GPU)\nMaker: CPU (CPU){mark}\n"
    assert not (tmp_path / "run").exists()
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", "gpu")
    assert run("command=devices", *HERE) == (0, "")
    assert run.out == f"Maker: GPU (GPU){mark}\nMaker: CPU (CPU)\n"


def test_devices_that_are_not_there(run, devices, monkeypatch):
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", "abacus")
    code, err = run("command=devices", *HERE)
    assert code == 1
    assert (
        "no OpenCL device is called 'abacus'; there are: Maker: GPU (GPU); Maker: CPU (CPU)" in err
    )
    devices.clear()
    code, err = run("command=devices", *HERE)
    assert code == 1
    assert "gaigs: rasterizer 'opencl' needs an OpenCL driver: pip install 'pyopencl[pocl]'" in err
    assert "Traceback" not in err


def test_a_folder_of_another_run_or_of_other_files_stays(run, tmp_path):
    (tmp_path / "run").mkdir()
    with only_run(tmp_path / "run"):
        code, err = run(*SMALL, *HERE)
        assert code == 1
        assert "another run is at work in" in err
        assert (tmp_path / "run" / "gaigs.log").exists()
    (tmp_path / "run" / "software.json").unlink(missing_ok=True)
    for name in ("config.yaml", "notes.txt"):
        (tmp_path / "run" / name).write_text("mine: 1")
        assert run("command=devices", *HERE)[0] in (0, 1)
        assert (tmp_path / "run" / name).read_text() == "mine: 1"


def test_output_that_nobody_reads_is_no_error(tmp_path):
    read, write = os.pipe()
    os.close(read)
    environment = os.environ | {"PYTHONPATH": str(Path(gaigs.__path__[0]).parent)}
    command = [sys.executable, "-m", "gaigs", "--help"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdout=write, stderr=subprocess.PIPE, text=True
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_ctrl_c_while_packages_are_imported_is_one_line(tmp_path):
    (tmp_path / "hydra.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n")
    environment = os.environ | {
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(gaigs.__path__[0]).parent}"
    }
    command = [sys.executable, "-m", "gaigs"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "gaigs: stopped\n")


def test_labels_are_compared(run, tmp_path):
    data = ("data=synthetic_rssi", "data.order=1", "baselines=[]", *HERE)
    assert run("command=agreement", "data.transmitters=30", *data) == (0, "")
    assert run.out.startswith("data: synthetic_rssi, 1")
    assert run.out.splitlines()[-1].endswith("run")
    assert (tmp_path / "run" / "agreement.md").is_file()
    code, err = run("command=agreement", "data.transmitters=1", *data)
    assert code == 1
    assert "gaigs: transmitters must be at least 2" in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("stop", "code"), [(KeyboardInterrupt(), 130), (Stopped("stopped", signal.SIGTERM), 143)]
)
def test_a_command_that_is_stopped_says_so(stop, code, run, monkeypatch):
    def stopped(*_):
        raise stop

    monkeypatch.setattr(agreement, "run", stopped)
    assert run("command=agreement", *HERE) == (
        code,
        "gaigs: stopped; the same command starts anew\n",
    )


def test_an_unknown_error_has_a_traceback(run, monkeypatch):
    monkeypatch.setattr(runs, "train_and_test", lambda *_: {}["lost"])
    code, err = run(*SMALL, *HERE)
    assert code == 1
    assert "KeyError: 'lost'" in err
    assert "Traceback" in err


TORCH = (
    "[enforce fail at alloc_cpu.cpp:124] DefaultCPUAllocator: can't allocate memory: you tried to "
    "allocate 8 bytes."
)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (MemoryError(), "out of memory (MemoryError)"),
        (RuntimeError(TORCH), f"out of memory ({TORCH})"),
        (RuntimeError("could not create a primitive"), "out of memory (could not"),
        (SystemError("error return without exception set"), "out of memory (error"),
        (ValueError("no model"), "out of memory (no model)"),
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
            "run could not be written (No space left on device)\ncheck",
        ),
        (
            OSError(errno.ENOSPC, "run/best.ckpt could not be written"),
            "run/best.ckpt could not be written\n",
        ),
    ],
    ids=["python", "torch", "oneDNN", "no room for the error", "cause", "disk", "named already"],
)
def test_faults_of_the_machine_have_a_short_message(error, text, run, monkeypatch):
    def fail(*_):
        raise error from (MemoryError() if isinstance(error, ValueError) else None)

    monkeypatch.setattr(runs, "train_and_test", fail)
    code, err = run(*SMALL, *HERE)
    assert code == 1
    assert err.count("gaigs: ") == 1
    assert "Traceback" not in err
    assert text in err
    assert "memory" not in text or "the same command with hydra.run.dir=run goes on" in err


def test_a_run_folder_that_was_removed_is_named(run, tmp_path, monkeypatch):
    def remove(*_):
        shutil.rmtree(tmp_path / "run")
        raise FileNotFoundError("no checkpoint at run/best.ckpt")

    monkeypatch.setattr(runs, "train_and_test", remove)
    code, err = run(*SMALL, *HERE)
    assert code == 1
    assert "Traceback" not in err
    assert "run was removed during the run; the same command begins anew\n" in err


def test_a_run_folder_that_hydra_cannot_make_has_a_short_message(run, tmp_path):
    (tmp_path / "taken").write_text("mine")
    code, err = run(*SMALL, "hydra.run.dir=taken/run")
    assert code == 1
    assert "Traceback" not in err
    assert re.match(
        r"gaigs: .*taken/run could not be read or written \(Not a directory\)\ncheck its folder",
        err,
    )


def test_ctrl_c_outside_of_the_training(run, monkeypatch):
    def press(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "train_and_test", press)
    stopped = "gaigs: stopped; the same command with hydra.{} goes on\n"
    assert run(*SMALL, "hydra.run.dir=run") == (130, stopped.format("run.dir=run"))
    assert run("-m", *SMALL, "hydra.sweep.dir=sweep", "seed=0,1") == (
        130,
        stopped.format("sweep.dir=sweep"),
    )


def test_a_job_of_a_multirun_trains_in_one_process(run):
    two = ("trainer.devices=2", "trainer.strategy=ddp", "seed=0", "hydra.sweep.dir=sweep", HERE[1])
    code, err = run("-m", *SMALL, *two)
    assert code == 1
    assert "a job of a multirun must train in one process\nrun it alone" in err


def test_a_multirun_goes_past_a_failure_and_reports(run, tmp_path):
    varied = ("gaussians.count=0,30", "trainer.max_steps=1", HERE[1])
    code, err = run("-m", *SMALL, "hydra.sweep.dir=sweep", *varied)
    assert code == 1
    assert "gaigs: gaussians.count must be at least 1, got 0" in err
    assert "Traceback" not in err
    (table,) = report(tmp_path / "sweep").renderables
    assert table.row_count == 2 + 2
    with open(tmp_path / "sweep" / "ablation.csv", newline="") as file:
        ended = {row["gaussians.count"]: row["status"] for row in csv.DictReader(file)}
    assert (ended["0"], ended["30"]) == ("unfinished", "done")


def test_systems_are_in_one_table_if_one_fails(run, tmp_path):
    command = (
        "-m",
        "+experiment=systems_spectrum",
        "data.transmitters=30",
        "hydra/launcher=basic",
        *SMALL[-1:],
    )
    code, err = run(*command, "model=knn,friis,mean")
    assert code == 1
    assert "gaigs: model 'friis'" in err
    folder = tmp_path / "runs" / "systems_spectrum"
    table = (folder / "systems.md").read_text()
    assert [line.split(" | ")[0] for line in table.splitlines()[2:4]] == ["| knn", "| mean"]
    assert "- without a result: friis: model 'friis'" in table
    assert {path.name for path in folder.glob("systems*")} == {
        *(f"systems.{ending}" for ending in ("md", "csv")),
        *(f"systems_{name}.png" for name in ("cdf", "spectra")),
    }
    assert "Systems" in run.out
    assert run(*command, "model=knn,mean")[0] == 0
    assert run.out.count("finished already") == 2
    assert (folder / "systems.md").read_text() == table


def test_a_training_by_time_ends_and_logs_its_seconds(run, tmp_path):
    by_time = (
        "trainer.max_steps=-1",
        "trainer.max_time=00:00:00:01",
        "trainer.val_check_interval=00:00:00:01",
    )
    assert run(*SMALL, *by_time, "hydra.run.dir=run")[0] == 0
    steps = torch.load(tmp_path / "run" / "last.ckpt", weights_only=True)["global_step"]
    curves = read_curves([tmp_path / "run" / "log" / "version_0" / "metrics.csv"])
    seconds, scores = curves["seconds"], curves["validation/ssim"]
    assert seconds[0].tolist() == scores[0].tolist()
    assert seconds[0][-1] == steps - 1
    assert seconds[1][-1] >= 1
    assert run(*SMALL, *by_time, "hydra.run.dir=run")[0] == 0
    assert run.out.splitlines()[0].startswith("finished already")
