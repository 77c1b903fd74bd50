"""The command line: ``python -m gaigs +experiment=spectrum``."""

import contextlib
import importlib
import logging
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs import commands, configuration, processes
from gaigs.io import files
from gaigs.processes import Stopped, forward_to_children, lacks_memory, limited_threads, stopping
from gaigs.report import at_end

log = logging.getLogger("gaigs")

BASIC_LAUNCHER = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
"""Hydra's default, which runs the jobs of a multirun one after the other in this process."""

JOBLIB_LAUNCHER = "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"
"""One whose processes each run several jobs."""


def run(config: DictConfig) -> float | None:
    """One job: ``gaigs.run`` in Hydra's run folder.

    Returns:
        Of a training the mean of the task's monitored score over the validation links, for sweepers; None where nothing
        validates.

    Raises:
        CompactHydraException: What a user can mend, as one message; Hydra prints it without the traceback and exits
            with 1, after the other jobs of a multirun. With ``hydra.verbose=true`` the traceback comes before it.
        SystemExit: A signal has stopped the run: 128 and the signal's number, as shells report it.
    """
    settings = HydraConfig.get()
    is_sweep = settings.mode is RunMode.MULTIRUN
    folder, mode = Path(settings.runtime.output_dir), "sweep" if is_sweep else "run"
    goes_on = f"the same command with hydra.{mode}.dir={settings[mode].dir} goes on"
    if config.get("command") == "agreement":
        goes_on = "the same command does it anew"
    try:
        with mendable(goes_on), stopping(waits=is_sweep and settings.launcher["_target_"] == JOBLIB_LAUNCHER):
            if config.get("command") == "devices":  # whatever the rest of the configuration
                return commands.list_devices()
            plain = configuration.resolve(config)
            own = ("command=", "benchmark=", "benchmark.")
            words = OmegaConf.to_container(settings.overrides.task)
            overrides = [word for word in words if not word.lstrip("+~").startswith(own)]
            if plain["command"] == "train":
                processes.check_ranks()
                importlib.import_module("lightning.pytorch")  # slow: here, once the configuration has proved good
            with limited_threads(None, settings.launcher.get("n_jobs", 1) if is_sweep else 1):
                metrics = commands.run(plain, folder, overrides)
    except KeyboardInterrupt as stop:
        told = f"gaigs: {str(stop) or 'stopped'}; {goes_on}"
        number = getattr(stop, "number", signal.SIGINT)
        if is_sweep and settings.launcher["_target_"] != BASIC_LAUNCHER:
            # Only this job ends: a launcher that sees a process exit kills its other jobs before they have saved.
            processes.received.append(number)
            raise CompactHydraException(told) from None
        if not processes.is_first():  # it ends well: at a code of failure Lightning would kill the first one
            raise SystemExit(0) from None
        print(told, file=sys.stderr)
        raise SystemExit(128 + number) from None
    except Exception as error:
        if is_sweep:
            # Hydra prints that of the first job that failed alone: so each says it in its log, in one line.
            log.error("gaigs: %s", " ".join(str(error).removeprefix("gaigs: ").split()) or repr(error))
        raise
    return None if metrics is None else metrics["validation_score"]


@contextlib.contextmanager
def mendable(goes_on: str) -> Iterator[None]:
    """Has what a user can mend end as one message; with ``hydra.verbose=true`` the traceback comes before it.

    Args:
        goes_on: How to go on with what is done here.

    Raises:
        CompactHydraException: In its place.
    """
    settings = HydraConfig.get()
    try:
        yield
    except Exception as error:
        told = advice(error, Path(settings.runtime.output_dir), goes_on)
        if settings.verbose:
            traceback.print_exc()
        if told is None:
            raise
        raise CompactHydraException(f"gaigs: {told}") from error


def advice(error: Exception, folder: Path, goes_on: str) -> str | None:
    """What a user can do about an error, in one message; None where only a developer can.

    Args:
        error: Of a run.
        folder: Of that run.
        goes_on: How to go on with it.
    """
    if lacks_memory(error):
        cause = " ".join(str(error).split()) or type(error).__name__
        return (
            f"there must be enough memory, and there is not ({cause}); end other programs or give the run more, and "
            f"{goes_on}; or take a smaller training.batch_size in another folder"
        )
    if not folder.is_dir():  # whatever was missed first
        return f"{folder} must stay there while a run is at work, and was removed; the same command begins anew"
    if isinstance(error, OSError):
        return files.sentence(error, folder)
    if isinstance(error, ValueError | TypeError | ImportError | RuntimeError | OmegaConfBaseException):
        return str(error)
    from lightning.pytorch.utilities.exceptions import MisconfigurationException  # slow to import

    return str(error) if isinstance(error, MisconfigurationException) else None


def compose_and_run() -> None:
    """Has Hydra read the command line and run its jobs.

    Raises:
        SystemExit: With 1 where a job fails, or the command line is wrong; what is wrong is printed as one sentence.
    """
    asked = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands on what goes wrong
    try:
        hydra.main(version_base="1.3", config_path=str(configuration.conf_dir()), config_name="config")(run)()
    except Exception as error:
        if asked == "1":
            raise
        told = isinstance(error, HydraException | OmegaConfBaseException | ValueError)
        of_system = isinstance(error, MemoryError) or getattr(error, "errno", None) is not None
        if told or (configuration.is_composing(error) and not of_system):
            print(f"gaigs: {configuration.explain(error)}", file=sys.stderr)
        elif isinstance(error, OSError | MemoryError):  # of one of Hydra's own files
            print(f"gaigs: {advice(error, Path.cwd(), 'the same command goes on')}", file=sys.stderr)
        else:
            traceback.print_exc()
        raise SystemExit(1) from None
    finally:
        os.environ.pop("HYDRA_FULL_ERROR")
        if asked is not None:
            os.environ["HYDRA_FULL_ERROR"] = asked


def main() -> None:
    """The console script ``gaigs``."""
    if "command=benchmark" in sys.argv and not any(word.lstrip("+").startswith("benchmark=") for word in sys.argv):
        sys.argv.append("benchmark=all")  # before Hydra composes, so that its options may be given, too
    logging.raiseExceptions = False  # a log that finds no room tells nothing that the run's own files do not
    signals = []

    def stop(number: int, _) -> None:
        """Jobs in other processes save and end; this one waits for them."""
        signals.append(number)
        forward_to_children(number)
        if not any(arg in ("-m", "--multirun") for arg in sys.argv):
            raise Stopped("stopped", number)

    handler = signal.signal(signal.SIGTERM, stop)
    try:
        compose_and_run()
        at_end.write()
    except SystemExit as end:
        if end.code == 1 and not signals:  # a job has failed, and the others have ended
            at_end.write()
        raise
    except KeyboardInterrupt as stop:
        print("gaigs: stopped", file=sys.stderr)
        raise SystemExit(128 + getattr(stop, "number", signal.SIGINT)) from None
    finally:
        signal.signal(signal.SIGTERM, handler)
        if signals:
            sys.exit(128 + signals[0])


if __name__ == "__main__":
    sys.exit(main())
