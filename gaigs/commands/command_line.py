"""The command line of ``python -m gaigs``: Hydra's jobs, signals, one message for each error."""

import contextlib
import logging
import os
import shutil
import signal
import sys
import traceback
from pathlib import Path
from typing import NamedTuple, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from gaigs import commands, configuration, processes
from gaigs.io.files import LOCK
from gaigs.registry import registry
from gaigs.report import hydra_callback

log = logging.getLogger("gaigs")


class Job(NamedTuple):
    """Facts of a job from Hydra."""

    folder: Path  # the run folder
    is_sweep: bool  # True for a job of a multirun
    launcher: str  # class name of Hydra's launcher
    goes_on: str  # sentence for messages: how to resume the run


def run(config: DictConfig) -> float | None:
    """One job: ``gaigs.run`` in Hydra's run folder; returns the validation score for sweepers.

    An error that a user can correct is printed as one message. ``hydra.verbose=true`` prints the
    traceback first. A signal ends the process with code 128 plus the signal's number, as in shells.
    A run folder without a result is removed.
    """
    settings = HydraConfig.get()
    job = describe_job(settings, config.get("command"))
    words = OmegaConf.to_container(settings.overrides.task)
    parallel_jobs = settings.launcher.get("n_jobs", 1) if job.is_sweep else 1
    processes.keep_memory()
    try:
        # A process of joblib runs several jobs.
        with processes.stopping(waits=job.is_sweep and job.launcher == "JoblibLauncher"):
            is_list = config.get("command") == "devices"
            plain = {"command": "devices"} if is_list else configuration.resolve(config)
            note_task(words, plain)
            with processes.limited_threads(None, parallel_jobs):
                launcher = job.launcher if job.is_sweep else None
                metrics = commands.run(plain, job.folder, launcher)
    except KeyboardInterrupt as stop:
        end_stopped(job, stop)
    except Exception as error:
        end_failed(job, error, settings.verbose)
    finally:
        if not job.is_sweep:
            remove_without_result(job.folder)
    return None if metrics is None else metrics["validation_score"]


def describe_job(settings: DictConfig, command: str | None) -> Job:
    """Facts of the running job, from Hydra's settings and the name of the command."""
    is_sweep = settings.mode is RunMode.MULTIRUN
    mode = "sweep" if is_sweep else "run"
    goes_on = f"the same command with hydra.{mode}.dir={settings[mode].dir} goes on"
    if command in commands.COMMANDS:
        goes_on = "the same command starts anew"
    launcher = settings.launcher["_target_"].rpartition(".")[2]
    return Job(Path(settings.runtime.output_dir), is_sweep, launcher, goes_on)


def end_stopped(job: Job, stop: KeyboardInterrupt) -> NoReturn:
    """Ends a job after a signal: its process, or only the job in a launcher's process."""
    message = f"gaigs: {str(stop) or 'stopped'}; {job.goes_on}"
    number = getattr(stop, "number", signal.SIGINT)
    if job.is_sweep and job.launcher != "BasicLauncher":
        # Only this job ends: a launcher that sees a process exit kills its other jobs before they
        # have saved.
        processes.received.append(number)
        raise CompactHydraException(message) from None
    if not processes.is_first():  # at a failure Lightning would kill the first process
        raise SystemExit(0) from None
    print(message, file=sys.stderr)
    raise SystemExit(128 + number) from None


def end_failed(job: Job, error: Exception, is_verbose: bool) -> NoReturn:
    """Ends a job after an error, with one message if a user can correct it, or the traceback.

    A single run ends the process. A job of a sweep raises, so that Hydra continues with other jobs.
    """
    message = processes.advice(error, job.folder, job.goes_on)
    if is_verbose or (message is None and not job.is_sweep):
        traceback.print_exc()
    if not job.is_sweep:  # exits here, as Hydra would print a line of its own first
        if isinstance(error, BrokenPipeError):
            raise SystemExit(141) from None
        if message is not None:
            print(f"gaigs: {message}", file=sys.stderr)
        raise SystemExit(1) from None
    # Hydra prints the first failure only: each job writes its own, in one line of its log.
    log.error("gaigs: %s", " ".join((message or str(error) or repr(error)).split()))
    if message is None:
        raise error
    raise CompactHydraException(f"gaigs: {message}") from error


def note_task(words: list[str], config: dict) -> None:
    """Logs a warning if ``words`` of the command line choose an experiment of another task.

    The name of an experiment holds the name of its task, such as ``csi`` in ``mirrored_csi``.
    """
    components = [config.get(key) for key in ("task", "data")]
    if not all(isinstance(component, dict) and "name" in component for component in components):
        return  # the check of the configuration says what is wrong
    task, data = (component["name"] for component in components)
    message = "+experiment=%s is for task %s; labels of data=%s are of %s"
    for word in words:
        key, _, name = word.partition("=")
        other_tasks = {*name.split("_")} & {*registry("task").names()} - {task}
        if key == "+experiment" and other_tasks:
            log.warning(message, name, min(other_tasks), data, task)


def remove_without_result(folder: Path) -> None:
    """Removes a run folder without a result, unless a run is using it.

    Such a folder holds only files of Hydra and of the start of a run.
    """
    files_of_start = {".hydra", "gaigs.log", "config.yaml", "software.json", LOCK}
    # The errors: the folder is missing, cannot be read, or another run is using it.
    with contextlib.suppress(OSError, ValueError), processes.only_run(folder):
        names = {path.name for path in folder.iterdir()}
        # A run writes both: a configuration alone belongs to someone else.
        is_ours = "config.yaml" not in names or "software.json" in names
        if names <= files_of_start and is_ours and not Path.cwd().is_relative_to(folder):
            shutil.rmtree(folder)


def wrong_flag() -> str | None:
    """The message for a command-line flag unknown to Hydra; None if all are known."""
    _, unknown = get_args_parser().parse_known_args()
    for word in unknown:
        if word.startswith("-"):
            flag = word.partition("=")[0]
            name = flag.lstrip("-").replace("-", "_")
            similar = configuration.nearest(name, configuration.compose())
            option = similar or "trainer.max_steps"  # an example
            return f"there is no flag {flag}; options have no dashes, such as {option}=..."
    return None


def compose_and_run() -> None:
    """Lets Hydra read the command line and run its jobs.

    An error ends the process with code 1, after one message if a user can correct it. An unknown
    flag gives code 2, a closed output 141. ``HYDRA_FULL_ERROR=1`` raises errors instead.
    """
    if message := wrong_flag():
        print(f"gaigs: {message}", file=sys.stderr)
        raise SystemExit(2)
    full_error = os.environ.get("HYDRA_FULL_ERROR", "")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    try:
        folder = str(configuration.conf_dir())
        hydra.main(version_base="1.3", config_path=folder, config_name="config")(run)()
    except Exception as error:
        if full_error == "1":
            raise
        # In a multirun the broken pipe may be a launcher's own.
        if isinstance(error, BrokenPipeError) and not configuration.is_multirun():
            raise SystemExit(141) from None
        message = configuration.explain(error)
        message = message or processes.advice(error, Path.cwd(), "the same command goes on")
        if message is None:
            traceback.print_exc()
        else:
            print(f"gaigs: {message}", file=sys.stderr)
        raise SystemExit(1) from None
    finally:
        os.environ["HYDRA_FULL_ERROR"] = full_error


def main() -> None:
    """The console script ``gaigs``: jobs, signals, and at the end the tables of a multirun.

    A signal ends the process with code 128 plus its number, as in shells.
    """
    # Matplotlib reports the making of its font cache.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    # On a full disk the log stays silent; the run's own files report it.
    logging.raiseExceptions = False
    signals = []

    def stop(number: int, _) -> None:
        """Lets jobs in other processes save and end; outside a multirun also stops this process."""
        signals.append(number)
        processes.hang_up(number)
        processes.forward_to_children(number)
        if not configuration.is_multirun():
            raise processes.Stopped("stopped", number)

    handlers = {number: signal.signal(number, stop) for number in processes.STOPPING[1:]}
    try:
        compose_and_run()
        hydra_callback.write_requested()
    except SystemExit as end:
        if end.code == 1 and not signals:  # a job has failed, and the others have ended
            hydra_callback.write_requested()
        raise
    except KeyboardInterrupt as stop:
        print("gaigs: stopped", file=sys.stderr)
        raise SystemExit(128 + getattr(stop, "number", signal.SIGINT)) from None
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        try:
            sys.stdout.flush()
        except BrokenPipeError:  # nobody reads the output any more, as behind | head
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            signals.append(13)  # SIGPIPE
        if signals:
            sys.exit(128 + signals[0])
