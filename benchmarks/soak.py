"""Kills, starves and robs a run, has the same command go on, and compares its end with that of an
undisturbed run.

    python benchmarks/soak.py python benchmarks/soak.py --faults kill --repeats 40 --seed 1 python
    benchmarks/soak.py +experiment=mirrored data.transmitters=30 trainer.max_steps=60 --faults kill
    python benchmarks/soak.py --markdown docs/results/faults.md python benchmarks/soak.py --writers
    --minutes 1

Overrides are those of ``python -m gaigs``; without any it is a short run of GAI-GS with kriging.
Each run is the command line in a process of its own, forked once the packages are imported, so that
random moments fall into the work. Moments are in processor time, so that other work on the machine
does not move them. Linux only. Disks are filled in a small file system, which needs root. The page
is written anew after each fault. With ``--writers`` no run is disturbed: two processes export, save
and load the same files. The exit code is 1 where anything was lost.
"""

import argparse
import contextlib
import json
import math
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch

import gaigs
from gaigs import runs  # noqa: F401, imported before the forks
from gaigs.commands import command_line
from gaigs.io.files import write_text
from gaigs.model import checkpoint
from gaigs.report import curves, run_figures, style  # noqa: F401, imported before the forks
from gaigs.report.table import markdown
from gaigs.runs.evaluation import device_name

RUN = (
    "+experiment=spectrum",
    "kriging=true",
    "tokenizer=euclidean",
    "rasterizer=torch",
    "data.transmitters=30",
    "gaussians.count=30",
    "training.thinning.stride=16",
    "training.batch_size=8",
    "trainer.max_steps=240",
    "trainer.val_check_interval=40",
    "trainer.log_every_n_steps=10",
    "baselines=[{name: mean}, {name: knn, k: 3, power: 2.0}]",
)

ALWAYS = (
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "threads=1",
    "save_every=0.5",
)

TIMED = ("train_seconds", "inference_ms", "render_ms", "checkpoint_bytes", "seconds")
"""Keys of metrics.json that differ between two runs of the same command."""

PHASES = {
    "metrics.json": "ended",
    "figures": "figures",
    "predictions.npz": "testing",
    "last.ckpt": "training, kriging",
    "log": "before the first save",
}
"""Phase of a run by the first of these files in its folder; without any it is at the start."""

NAMES = {
    "kill": "",
    "disk": "disk full",
    "files": "files limited in size",
    "folder": "run folder removed",
}
NAMES |= {"memory": "memory limited", "multirun": "two jobs of `joblib`, "}
"""Faults in the words of the table."""

PAGE = """# Faults

Here you see what became of runs that were killed, or left without disk, folder or memory: {verdict}. Written by

```
{command}
```

A short training with kriging, tests and figures was disturbed at random moments (seed {seed}). Then the same command
went on in the same folder, once there was room, folder or memory again. It lost nothing where

- it ended with the scores, predictions, weights and loss curves of an undisturbed run, to the bit;
- checkpoints in between were whole, and no half-written file was left;
- its message was one or two lines.

Undisturbed it took {work:.1f} s of one core, and {seconds:.0f} s on a machine shared by others: {device}.

{table}

- A run that ended well was disturbed too late, or needed no more room or memory than there was.
- Training lost: seconds from the last save to the fault. `save_every` was 0.5 s; a save waits for the end of a step.
- SIGKILL and SIGTERM came one after the other in the same folder, in turn.
{wrong}"""


class Process:
    """The command line in a forked process.

    Args:
        arguments: Of the command line.
        says: File for stderr; stdout goes beside it.
        before: Called first in the new process.
    """

    def __init__(self, arguments: Sequence[str], says: Path, before: Callable = lambda: None):
        self.says, self.code = says.with_name(f"{says.name}.err"), None
        sys.stdout.flush()
        self.id = os.fork()
        if self.id == 0:
            self._work(arguments, before)

    def _work(self, arguments: Sequence[str], before: Callable) -> None:
        os.setsid()
        for number, file in (1, self.says.with_suffix(".out")), (2, self.says):
            os.dup2(os.open(file, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
        code = 0
        try:
            before()
            sys.argv = ["gaigs", *arguments]
            command_line.main()
        except SystemExit as end:
            code = end.code or 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
            code = 1
        finally:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)

    @property
    def seconds(self) -> float:
        """Of the processor, so far."""
        ticks = Path(f"/proc/{self.id}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

    def wait(self, until: Callable[[], bool] = lambda: False) -> bool:
        """True if it ended before ``until`` was true; a run that takes half an hour hangs."""
        start = time.monotonic()
        while self.code is None and not until():
            done, status = os.waitpid(self.id, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if done else None
            if time.monotonic() > start + 1800:
                os.killpg(self.id, signal.SIGKILL)
                raise TimeoutError(
                    f"a run must end within {1800} s, and one did not; see {self.says}"
                )
            time.sleep(0.002)
        return self.code is not None

    @property
    def messages(self) -> list[str]:
        """Messages on stderr, without the line that Hydra puts before that of a sweep."""
        lines = self.says.read_text().splitlines()
        return [line for line in lines if line and not line.startswith("Error executing job")]

    @property
    def end(self) -> str:
        """How it ended, in words."""
        if self.code < 0:
            return signal.Signals(-self.code).name
        causes = {"out of memory": "not enough memory", "not be written": "could not be written"}
        causes |= {
            "was removed": "folder was removed",
            "stopped": "stopped",
            "not started": "stopped",
        }
        said = next(
            (
                name
                for words, name in causes.items()
                if any(words in line for line in self.messages)
            ),
            "no message",
        )
        return f"{said}, exit code {self.code}" if self.code else "ended well"


@dataclass
class Trial:
    """One disturbance: at which phase it came, how the run ended, training lost [s], and the faults
    found.
    """

    fault: str
    phase: str
    end: str
    lost: float | None
    wrong: list[str] = field(default_factory=list)


class Soak:
    """All trials of one command.

    Args:
        overrides: Of the command.
        top: For run folders.
        draw: Random moments and sizes.
    """

    def __init__(self, overrides: Sequence[str], top: Path, draw: random.Random):
        self.overrides, self.top, self.draw = [*overrides, *ALWAYS], top, draw
        self.trials: list[Trial] = []
        self.count, self.fault = 0, ""
        self.reference = top / "undisturbed"
        start, process = time.monotonic(), self.start(self.reference)
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        process.wait()
        self.seconds = time.monotonic() - start
        self.work = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        if process.code:
            raise SystemExit(
                f"the undisturbed run must end well, and says {' '.join(process.messages)}"
            )
        self.sizes = sorted(
            path.stat().st_size for path in self.reference.rglob("*") if path.is_file()
        )

    def start(self, folder: Path, before: Callable = lambda: None) -> Process:
        """The command, in a run folder."""
        self.began = time.time()
        return Process([*self.overrides, f"hydra.run.dir={folder}"], self.top / folder.name, before)

    def new_folder(self) -> Path:
        self.count += 1
        return self.top / f"run{self.count}"

    def disturbed(
        self, folder: Path, act: Callable[[Process], None], after: float = 0
    ) -> tuple[Process, str, float]:
        """A run to which something is done at a random moment; at which phase; how much training is
        not saved then.
        """
        process, moment = self.start(folder), self.draw.uniform(0, max(0.1, self.work - after))
        self.moment = after + moment
        phase, lost = "ended", None
        if not process.wait(lambda: process.seconds >= moment):
            phase, lost = self.phase(folder), self.unsaved(folder)
            act(process)
            process.wait()
        return process, phase, lost

    def judge(
        self, process: Process, phase: str, lost: float | None = None, codes: tuple = (0, 1)
    ) -> Trial:
        """Looks at how a disturbed run has ended."""
        trial = Trial(self.fault, phase, process.end, lost)
        messages = process.messages
        is_clear = (process.code > 0) == bool(messages) and len(
            messages
        ) <= 2  # cause, and what to do
        is_clear = is_clear and all(line.startswith("gaigs: ") for line in messages[:1])
        if process.code not in codes or not is_clear or "no message" in process.end:
            trial.wrong.append(f"exit code {process.code}, {' '.join(process.messages)}")
        self.trials.append(trial)
        return trial

    def go_on(self, folder: Path, trial: Trial) -> None:
        """Checks the files left, runs the same command again, and checks its result."""
        for path in folder.rglob("*.ckpt"):
            with contextlib.suppress(FileNotFoundError):
                if ".part" not in path.name:
                    try:
                        checkpoint.read(path)
                    except ValueError as error:
                        trial.wrong.append(str(error))
        process = self.start(folder)
        process.wait()
        if process.code:
            trial.wrong.append(f"going on: exit code {process.code}, {' '.join(process.messages)}")
        else:
            trial.wrong += self.differences(folder)
        print(trial, flush=True)
        if not trial.wrong:
            shutil.rmtree(folder)

    def phase(self, folder: Path) -> str:
        return next((phase for name, phase in PHASES.items() if (folder / name).exists()), "start")

    def unsaved(self, folder: Path) -> float | None:
        """Seconds of training since the last save; None outside of the training."""
        now, log = time.time(), folder / "gaigs.log"
        started = max((path.stat().st_mtime for path in folder.glob("log/version_*")), default=0)
        if started < self.began or "\ntrained " in log.read_text().rpartition("\nmodel: ")[2]:
            return None
        last = folder / "last.ckpt"
        return max(0.0, now - max(started, last.stat().st_mtime if last.exists() else 0))

    def differences(self, folder: Path) -> list[str]:
        """How a run folder differs from that of the undisturbed run, to the bit."""
        tops = (self.reference, folder)
        mine, other = (
            {
                str(path.relative_to(top))
                for path in top.rglob("*")
                if not {"log", ".hydra"} & {*path.parts}
            }
            for top in tops
        )
        wrong = [f"lacks {name}" for name in mine - other] + [
            f"has {name}" for name in other - mine
        ]
        mine, other = (untimed(json.loads((top / "metrics.json").read_text())) for top in tops)
        wrong += [f"metrics.json: {key}" for key in mine if mine[key] != other.get(key)]
        predictions = [dict(np.load(top / "predictions.npz")) for top in tops]
        weights = [checkpoint.read(top / "best.ckpt")["state_dict"] for top in tops]
        logs = [curves.read_curves(sorted(top.glob("log/*/metrics.csv"))) for top in tops]
        for part, (mine, other) in {
            "predictions": predictions,
            "weights": weights,
            "curves": logs,
        }.items():

            def same(name, a=mine, b=other):
                return np.array_equal(a[name], b[name], equal_nan=True)

            if mine.keys() != other.keys() or not all(map(same, mine)):
                wrong.append(f"other {part}")
        return wrong

    # --- faults ---

    def kill(self) -> None:
        """SIGKILL and SIGTERM, or the other way round, one after the other in a folder."""
        folder, numbers, self.moment = self.new_folder(), [signal.SIGKILL, signal.SIGTERM], 0.0
        for number in numbers if self.count % 2 else reversed(numbers):
            process, phase, lost = self.disturbed(
                folder, lambda p, n=number: os.kill(p.id, n), self.moment
            )
            saved = any("after step" in line for line in process.messages)
            self.fault = number.name
            trial = self.judge(process, phase, 0.0 if saved else lost, (0, 143, -number))
        self.go_on(folder, trial)

    def fill_disk(self) -> None:
        """A file system of random size; then it has room."""
        top = self.new_folder()
        top.mkdir()
        size = int(2**12 + 1.2 * sum(self.sizes) * self.draw.random() ** 2)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", top]
        if subprocess.run(mount, capture_output=True).returncode:
            print("no file system can be mounted here, so no disk is filled: root alone may")
            return
        try:
            process = self.start(top / f"run{self.count}")
            process.wait()
            trial = self.judge(process, self.phase(top / f"run{self.count}"))
            trial.wrong += [f"left {path.name}" for path in top.rglob("*.part*")]
            subprocess.run(["mount", "-o", "remount,size=1g", top], check=True)
            self.go_on(top / f"run{self.count}", trial)
        finally:
            subprocess.run(["umount", top], check=True)

    def limit_files(self) -> None:
        """No file may grow beyond some size; then any may."""
        size, folder = self.draw.choice(self.sizes) - 1, self.new_folder()
        limit = (size, resource.RLIM_INFINITY)
        process = self.start(folder, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit))
        process.wait()
        trial = self.judge(process, self.phase(folder))
        trial.wrong += [f"left {path.name}" for path in folder.rglob("*.part*")]
        self.go_on(folder, trial)

    def remove_folder(self) -> None:
        """The run folder is removed."""
        folder = self.new_folder()

        def remove(_) -> None:
            while folder.exists():
                shutil.rmtree(folder, ignore_errors=True)

        process, phase, _ = self.disturbed(folder, remove)
        trial = self.judge(process, phase)
        trial.wrong += ["wrote on"] if process.code and folder.exists() else []
        self.go_on(folder, trial)

    def limit_memory(self) -> None:
        """Hardly more memory may be taken than there is."""

        def limit(process: Process) -> None:
            pages = int(Path(f"/proc/{process.id}/statm").read_text().split()[0])
            most = pages * resource.getpagesize() + self.draw.randrange(2**22)
            resource.prlimit(process.id, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))

        folder = self.new_folder()
        process, phase, _ = self.disturbed(folder, limit)
        trial = self.judge(process, phase)
        trial.wrong += [f"left {path.name}" for path in folder.rglob("*.part*")]
        self.go_on(folder, trial)

    def kill_multirun(self) -> None:
        """Two jobs at a time, one of them the undisturbed run's; SIGKILL goes to all processes."""
        for number in (signal.SIGKILL, signal.SIGTERM):
            top, kind = self.new_folder(), self.fault
            words = [
                "-m",
                *self.overrides,
                "hydra/launcher=joblib",
                "hydra.launcher.n_jobs=2",
                "seed=0,1",
            ]
            words += [f"hydra.sweep.dir={top}", "hydra.sweep.subdir=${hydra.job.num}"]
            process = Process(words, self.top / top.name)
            process.wait(lambda top=top: any(top.glob("*/last.ckpt")))
            if process.code is None:
                (os.killpg if number == signal.SIGKILL else os.kill)(process.id, number)
            process.wait()
            self.fault = kind + number.name
            trial = self.judge(process, "training, kriging", None, (143, -number))
            again = Process(words, self.top / top.name)
            again.wait()
            trial.wrong += (
                [f"going on: exit code {again.code}, {' '.join(again.messages)}"]
                if again.code
                else []
            )
            self.fault = kind
            self.go_on(top / "0", trial)


FAULTS = {
    "kill": (Soak.kill, 10),
    "disk": (Soak.fill_disk, 6),
    "files": (Soak.limit_files, 3),
    "folder": (Soak.remove_folder, 3),
    "memory": (Soak.limit_memory, 6),
    "multirun": (Soak.kill_multirun, 1),
}
"""Faults and how often each is tried, in turns; ``kill`` and ``multirun`` with each of two signals.
"""


def shared_files(seconds: float, top: Path) -> int:  # noqa: C901, two processes in one story
    """Two processes export, save and load the same files of two models; the number of those that
    were mixed or failed.

    A file must be that of one model or of the other, to the byte.
    """
    links, rooms, maps = gaigs.links("synthetic_rssi", transmitters=60), [], []
    options = {"max_steps": 1, "kriging": False, "order": 1, "enable_progress_bar": False}
    for number in (0, 1):
        rooms.append(gaigs.train("mirrored", links, planes=6 + number, obstacles=0, **options))
        maps.append(
            gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=60 + number))
        )
    names = ("floor.tif", "floor.geojson", "floor.nc", "places.csv")
    places = links.query.transmitters[:40]

    def write(number: int, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        for name in names:
            gaigs.export(
                maps[number], folder / name, places if name == "places.csv" else None, pitch=1.0
            )
        for name in ("room.glb", "room.obj", "room.xml"):
            gaigs.export(rooms[number], folder / name)
        rooms[number].save(folder / "room.ckpt")
        gaigs.radio_map(maps[number], 1.0).save(folder / "floor.npz")

    def digests(folder: Path) -> dict[str, bytes]:
        """A scene counts with its meshes."""
        found = {
            name: (folder / name).read_bytes()
            for name in (*names, "room.glb", "room.obj", "room.xml")
        }
        found["room.xml"] += b"".join(map(Path.read_bytes, scene_files(folder / "room.xml")))
        with np.load(folder / "floor.npz") as floor:
            found["floor.npz"] = floor["values_dbm"].tobytes()
        weights = gaigs.load(folder / "room.ckpt").state_dict()
        return found | {
            "room.ckpt": b"".join(value.numpy().tobytes() for value in weights.values())
        }

    for number in (0, 1):
        write(number, top / str(number))
    expected = [digests(top / str(number)) for number in (0, 1)]
    shared, end, turns = top / "shared", time.monotonic() + seconds, 0
    write(0, shared)
    child, wrong = os.fork(), 0
    torch.set_num_threads(1)
    while time.monotonic() < end:
        try:
            write(int(child == 0), shared)
            mixed = [
                name
                for name, part in digests(shared).items()
                if part not in [one[name] for one in expected]
            ]
        except (OSError, ValueError) as error:
            mixed = [str(error)]
        if mixed:
            print("mixed or failed:", *mixed, flush=True)
        wrong, turns = wrong + len(mixed), turns + 1
    print(f"{turns} turns of {len(expected[0])} files, {wrong} mixed or failed", flush=True)
    if child == 0:
        os._exit(min(wrong, 255))
    return wrong + os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def scene_files(file: Path) -> list[Path]:
    """The meshes of a scene."""
    names = ElementTree.parse(file).getroot().iterfind("shape/string")
    return [file.parent / one.get("value", "") for one in names]


def untimed(metrics: dict) -> dict:
    """Metrics without the keys that differ between two runs of the same command."""
    values = {key: value for key, value in metrics.items() if key not in TIMED}
    return {
        key: untimed(value) if isinstance(value, dict) else value for key, value in values.items()
    }


def rows(trials: Sequence[Trial]) -> list[list[str]]:
    """Of the table: a head, and a row for each fault."""
    table = [
        ["fault", "times", "at", "the run", "lost nothing", "training lost, median and most [s]"]
    ]
    for fault in dict.fromkeys(trial.fault for trial in trials):
        own = [trial for trial in trials if trial.fault == fault]
        lost = [trial.lost for trial in own if trial.lost is not None]
        counted = (
            ", ".join(f"{name} ({count})" for name, count in Counter(values).most_common())
            for values in ((trial.phase for trial in own), (trial.end for trial in own))
        )
        seconds = f"{np.median(lost):.2f}, {max(lost):.2f}" if lost else ""
        table.append(
            [fault, str(len(own)), *counted, str(sum(not trial.wrong for trial in own)), seconds]
        )
    return table


def wrong(trials: Sequence[Trial]) -> list[str]:
    """Defects, a line each."""
    return [f"- {trial.fault}, {trial.phase}: {text}" for trial in trials for text in trial.wrong]


def page(soak: Soak, seed: int) -> str:
    """The page of documentation."""
    good, device = sum(not trial.wrong for trial in soak.trials), device_name(torch.device("cpu"))
    return PAGE.format(
        table=markdown(rows(soak.trials)).rstrip(),
        verdict=f"{good} of {len(soak.trials)} lost nothing",
        wrong="".join(f"{line}\n" for line in wrong(soak.trials)).replace(str(soak.top), "DIR"),
        command=shlex.join(["python", *sys.argv]),
        **{"seconds": soak.seconds, "work": soak.work, "seed": seed, "device": device},
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=[*FAULTS])
    parser.add_argument("--repeats", type=int, help="of each fault")
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="after which nothing more is tried"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    parser.add_argument("--markdown", type=Path, help="page to write")
    parser.add_argument(
        "--writers", action="store_true", help="two processes that write the same files"
    )
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    start = time.monotonic()
    style.DPI = 40  # figures are drawn in less time
    with tempfile.TemporaryDirectory(prefix="soak") as top:
        if options.writers:
            raise SystemExit(shared_files(60 * min(options.minutes, 1000), Path(top)) > 0)
        soak = Soak(options.overrides or RUN, Path(top), random.Random(options.seed))
        most = {name: options.repeats or FAULTS[name][1] for name in options.faults}
        turns = [name for turn in range(max(most.values())) for name in most if turn < most[name]]
        for name in turns:
            if time.monotonic() > start + 60 * options.minutes:
                break
            soak.fault = NAMES[name]
            FAULTS[name][0](soak)
            if options.markdown:
                write_text(options.markdown, page(soak, options.seed))
    print(markdown(rows(soak.trials)))
    raise SystemExit("\n".join(wrong(soak.trials)) or 0)


if __name__ == "__main__":
    main()
