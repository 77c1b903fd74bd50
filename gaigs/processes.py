"""Resources of a run and the signals that stop it: threads, memory, Ctrl-C, locked folders."""

import atexit
import contextlib
import ctypes
import gc
import os
import signal
import stat
import sys
import sysconfig
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout
from omegaconf.errors import OmegaConfBaseException

from gaigs.io.files import LOCK, file_message

Part = TypeVar("Part")
Result = TypeVar("Result")

STOPPING = [signal.SIGINT, signal.SIGTERM]
"""Signals at which a run saves and stops: Ctrl-C, a scheduler's, and a closed terminal's."""
# nohup ignores it.
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
    STOPPING.append(signal.SIGHUP)


def _limit_forked_threads() -> None:
    """Limits a forked process to one thread: it lacks torch's threads, and would wait forever."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_limit_forked_threads)

received: list[int] = []
"""Signals that have stopped runs of this process: a launcher's worker starts no further run."""


class Stopped(KeyboardInterrupt):
    """A signal has stopped a run; the message names the step."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.number = number


def keep_memory() -> None:
    """Makes this process faster, at the cost of memory.

    The process keeps the memory of freed arrays, which glibc would otherwise map again in each
    step. Garbage collection becomes rarer, since imports create half a million permanent objects,
    and is skipped at the end.
    """
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        trim, mapped = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h, in bytes
        libc.mallopt(trim, 2**31 - 1)
        libc.mallopt(mapped, 2**30) or libc.mallopt(mapped, 2**25)  # older ones take no more


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Limits torch's threads alone; other threads of Python may do so at the same time."""
    import torch  # slow to import

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def limited_threads(count: int | None, jobs: int = 1) -> Iterator[None]:
    """Limits the threads of torch and PoCL; PoCL keeps the limit of its first use.

    Args:
        count: Number of threads. None: no limit for one job; for several jobs an equal part of the
            processors.
        jobs: Number of jobs that run at a time on this machine; -1: one for each processor.
    """
    if count is None and jobs in (0, 1):
        yield
        return
    if hasattr(os, "sched_getaffinity"):
        processors = len(os.sched_getaffinity(0))
    else:
        processors = os.cpu_count() or 1
    if count is None:
        count = max(1, processors // (processors if jobs < 0 else jobs))
    if count < 1:
        raise ValueError(f"threads must be at least 1, or null for all, got {count}")
    # OpenMP, and OpenCL of PoCL up to version 3 and later.
    variables = ("OMP_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
    environment = {name: os.environ.get(name) for name in variables}
    with torch_threads(count):
        os.environ |= dict.fromkeys(variables, str(count))
        try:
            yield
        finally:
            for name, value in environment.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def in_threads(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Results of a function of each part, in order, computed in as many threads as torch has.

    torch factors many small matrices one after the other, so its own threads do not help there.
    """
    import torch  # slow to import

    before = torch.get_num_threads()
    count = min(before, len(parts))
    if count < 2:
        return [function(part) for part in parts]
    # These settings of torch belong to a thread.
    has_gradient, is_inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def call(part: Part) -> Result:
        with torch.inference_mode(is_inference), torch.set_grad_enabled(has_gradient):
            return function(part)

    try:
        with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(call, parts))
    finally:
        torch.set_num_threads(before)  # a thread's call also sets the number of later threads


def lacks_memory(error: BaseException | None) -> bool:
    """True if an error, or its cause, is a lack of CPU or GPU memory."""
    messages = (
        "allocate memory",
        "unable to allocate",
        "not enough memory",
        "out of memory",
        "bad_alloc",
        "bad allocation",
        "failed to map segment",
        "can't start new thread",
        "mem_object_allocation_failure",
        "could not create a primitive",
        "error return without exception set",  # of Python without memory for the error itself
    )
    while error is not None:
        if isinstance(error, MemoryError) or any(words in str(error).lower() for words in messages):
            return True
        error = error.__cause__
    return False


def advice(error: Exception, folder: Path, goes_on: str) -> str | None:
    """The message of an error that a user can correct; None for a fault of the program.

    Args:
        error: The error of a run.
        folder: The run folder.
        goes_on: Words on how to resume the run.
    """
    if lacks_memory(error):
        cause = " ".join(str(error).split()) or type(error).__name__
        return (
            f"out of memory ({cause})\nend other programs or give the run more, and {goes_on}; "
            "or take a smaller training.batch_size in another folder"
        )
    if not folder.is_dir():  # the first cause, whatever file was missed
        return f"{folder} was removed during the run; the same command begins anew"
    if isinstance(error, OSError):
        return file_message(error, folder)
    is_known = isinstance(
        error, ValueError | TypeError | ImportError | RuntimeError | OmegaConfBaseException
    )
    is_known |= type(error).__name__ == "MisconfigurationException"  # Lightning's
    return f"{error}{fault_of_plug_in(error)}" if is_known else None


def fault_of_plug_in(error: Exception) -> str:
    """File and line in a plug-in at which an error occurred; empty if the plug-in raised it.

    Files of gaigs and of installed packages do not count as plug-ins.
    """
    here = str(Path(__file__).parent) + os.sep
    trace = traceback.extract_tb(error.__traceback__)
    frames = [
        frame
        for frame in trace
        if frame.filename.startswith(here) or not _is_library(frame.filename)
    ]
    if not frames or frames[-1].filename.startswith(here) or "raise " in (frames[-1].line or ""):
        return ""
    place = f"at {frames[-1].filename}, line {frames[-1].lineno}"
    return f"\n{place}; hydra.verbose=true prints the traceback"


def _is_library(file: str) -> bool:
    """True for a file of Python or of an installed package."""
    if file.startswith(("<", sysconfig.get_path("stdlib"))):
        return True
    return "site-packages" in file or "dist-packages" in file


def is_first() -> bool:
    """True in the first of the processes of a training, the only one that writes files."""
    from lightning.pytorch.utilities import rank_zero_only  # slow to import

    # Without torchrun and SLURM, Lightning's rank is that within a machine.
    is_global = any(name in os.environ for name in ("RANK", "SLURM_PROCID"))
    machine = 0 if is_global else int(os.environ.get("NODE_RANK", os.environ.get("GROUP_RANK", 0)))
    return rank_zero_only.rank == 0 and machine == 0  # type: ignore[attr-defined]


@contextlib.contextmanager
def only_run(folder: Path, waits: bool = False) -> Iterator[None]:
    """Locks a folder, at most until this process ends.

    The file ``.lock`` in the folder is removed at the end. A killed process leaves the file,
    without the lock.

    Args:
        waits: True to wait for another process that has the lock.
    """
    folder.stat()  # raises an error for a missing folder, which FileLock would make
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=waits, poll_interval=0.05)
    except Timeout:
        advice = "wait, or choose another folder (hydra.run.dir)"
        raise ValueError(f"another run is at work in {folder}\n{advice}") from None
    held = (folder / LOCK).stat()
    try:
        yield
    finally:
        # Before the release: a process that opens the file meanwhile sees that it has no name.
        # Windows removes no open file. If the folder was made again, another process has the file.
        with contextlib.suppress(OSError):
            if os.path.samestat(held, (folder / LOCK).stat()):
                (folder / LOCK).unlink()
        lock.release()


def hang_up(number: int) -> None:
    """At SIGHUP discards the output to the closed terminal, and ignores any further SIGHUP.

    Terminal and shell each send one, so two are common.
    """
    if number != getattr(signal, "SIGHUP", None):
        return
    signal.signal(number, signal.SIG_IGN)
    null = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(output).st_mode) and not os.isatty(output):
                os.dup2(null, output)


class _Repeater:
    """Handler of a stopping signal, which raises an error to stop the run.

    Python ignores the error while it destroys an object; the signal is then sent again.
    """

    def __init__(self, delay: float = 0.05):
        self.delay = delay  # [s]
        self.timers: list[threading.Timer] = []
        self.hook = sys.unraisablehook

    def stop(self, number: int, _) -> None:
        """Raises ``Stopped``; signals that were still to be sent again are cancelled."""
        self.cancel()
        hang_up(number)
        raise Stopped("stopped", number)

    def repeat(self, lost) -> None:
        """Sends a stopping signal again if its error was ignored; the hook for ignored errors."""
        if not isinstance(lost.exc_value, KeyboardInterrupt):
            self.hook(lost)
            return
        number = getattr(lost.exc_value, "number", signal.SIGINT)
        if number != signal.SIGINT:
            signal.signal(number, self.stop)  # a second SIGHUP is ignored
        timer = threading.Timer(self.delay, os.kill, (os.getpid(), number))
        timer.daemon = True
        self.timers.append(timer)
        timer.start()

    def raise_pending(self) -> None:
        """Raises ``Stopped`` if a repeated signal is still pending."""
        for timer in self.timers:
            if not timer.finished.is_set():
                raise Stopped("stopped", timer.args[1])

    def cancel(self) -> None:
        """Cancels repeated signals that are still pending."""
        for timer in self.timers:
            timer.cancel()


@contextlib.contextmanager
def stopping(waits: bool = False) -> Iterator[None]:
    """Makes the signals ``STOPPING`` stop a run as Ctrl-C does, and finally restores the handlers.

    Args:
        waits: True for a launcher's process that waits for its next run. A signal during the wait
            then stops that run, since the launcher would hang if the process ended.
    """
    # Other threads may not set handlers.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    repeater = _Repeater()
    for number in STOPPING[1:]:
        signal.signal(number, repeater.stop)
    sys.unraisablehook = repeater.repeat
    try:
        if received:  # between two runs of a process that waits
            raise Stopped("stopped", received[0])
        yield
        repeater.raise_pending()  # the run ended first
    finally:
        repeater.cancel()
        sys.unraisablehook = repeater.hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if waits:
            for number in STOPPING[1:]:
                signal.signal(number, lambda number, _: received.append(number))


def forward_to_children(number: int) -> None:
    """Sends a signal to the child processes, on systems with ``/proc``."""
    for task in Path("/proc/self/task").glob("*/children"):
        for child in task.read_text().split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), number)
