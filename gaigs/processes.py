"""Resources and signals of a run: threads, memory, Ctrl-C and SIGTERM, other processes, locked
folders.
"""

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
from collections.abc import Iterator
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException

from gaigs.io.files import file_message

STOPPING = [signal.SIGINT, signal.SIGTERM]
"""Signals at which a run saves and stops: Ctrl-C, that of schedulers, and that of a closed
terminal.
"""
if (
    hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
):  # as nohup sets it
    STOPPING.append(signal.SIGHUP)

THREADS = ("OMP_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
"""Environment variables that limit threads of OpenMP and of PoCL's OpenCL, up to version 3 and
later.
"""

AGAIN = 0.05
"""Delay before an ignored signal is sent again [s]."""

if hasattr(
    os, "register_at_fork"
):  # a forked process lacks the threads of torch, and would wait for them for ever
    os.register_at_fork(
        after_in_child=lambda: "torch" in sys.modules and sys.modules["torch"].set_num_threads(1)
    )

received: list[int] = []
"""Signals that have stopped runs of this process: a launcher's worker starts no further run."""


class Stopped(KeyboardInterrupt):
    """A signal has stopped a run; the message names the step."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.number = number


def keep_memory() -> None:
    """Makes this process faster and its memory larger.

    Freed arrays stay with the process: with glibc each step would map their pages anew. Imports
    make half a million objects that stay: looking for cycles among them is rarer, and left out at
    the end.
    """
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        trim, mapped = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h, in bytes
        libc.mallopt(trim, 2**31 - 1)
        libc.mallopt(mapped, 2**30) or libc.mallopt(mapped, 2**25)  # older ones take no more


@contextlib.contextmanager
def limited_threads(count: int | None, jobs: int = 1) -> Iterator[None]:
    """Limits the threads of torch and PoCL; PoCL keeps the limit of its first use.

    Args:
        count: Number of threads; None: no limit for one job, an equal share of the processors for
            several.
        jobs: Number of jobs that run at a time on this machine; -1: one for each processor.
    """
    if count is None and jobs in (0, 1):
        yield
        return
    processors = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    if count is None:
        count = max(1, processors // (processors if jobs < 0 else jobs))
    if count < 1:
        raise ValueError(f"threads must be at least 1, or null for all, got {count}")
    import torch  # slow to import

    before, environment = torch.get_num_threads(), {name: os.environ.get(name) for name in THREADS}
    os.environ |= dict.fromkeys(THREADS, str(count))
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        for name, value in environment.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def lacks_memory(error: BaseException | None) -> bool:
    """True if an error, or its cause, is a lack of memory of the processor or of a GPU."""
    messages = (
        "allocate memory", "unable to allocate", "not enough memory", "out of memory", "bad_alloc", "bad allocation",
        "failed to map segment", "can't start new thread", "mem_object_allocation_failure",
        "could not create a primitive",
        "error return without exception set",  # of Python without memory for the error itself
    )  # fmt: skip
    while error is not None:
        if isinstance(error, MemoryError) or any(words in str(error).lower() for words in messages):
            return True
        error = error.__cause__
    return False


def advice(error: Exception, folder: Path, goes_on: str) -> str | None:
    """The message of an error of a run in a folder that a user can mend; None for a fault of the
    program.

    ``goes_on`` says how to resume the run.
    """
    if lacks_memory(error):
        cause = " ".join(str(error).split()) or type(error).__name__
        return (
            f"out of memory ({cause})\nend other programs or give the run more, and {goes_on}; or take a smaller "
            "training.batch_size in another folder"
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
    """File and line if code that is neither gaigs nor installed is at fault, and did not raise the
    error itself.
    """
    here, stdlib = str(Path(__file__).parent) + os.sep, sysconfig.get_path("stdlib")
    is_library = lambda name: (
        name.startswith(("<", stdlib)) or "site-packages" in name or "dist-packages" in name
    )
    trace = traceback.extract_tb(error.__traceback__)
    frames = [one for one in trace if one.filename.startswith(here) or not is_library(one.filename)]
    if not frames or frames[-1].filename.startswith(here) or "raise " in (frames[-1].line or ""):
        return ""
    return f"\nat {frames[-1].filename}, line {frames[-1].lineno}; hydra.verbose=true prints the traceback"


def is_first() -> bool:
    """True in the first of the processes that train together; only this one writes files."""
    from lightning.pytorch.utilities import rank_zero_only  # slow to import

    # Without torchrun and SLURM, Lightning's rank is that within a machine.
    is_global = any(name in os.environ for name in ("RANK", "SLURM_PROCID"))
    machine = 0 if is_global else int(os.environ.get("NODE_RANK", os.environ.get("GROUP_RANK", 0)))
    return rank_zero_only.rank == 0 and machine == 0  # type: ignore[attr-defined]


@contextlib.contextmanager
def only_run(folder: Path, waits: bool = False) -> Iterator[None]:
    """Locks a folder, at most until this process ends; writes nothing there.

    Where another one holds it, it ``waits``, or raises a ``ValueError``.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
        except BlockingIOError:
            advice = "wait, or choose another folder (hydra.run.dir)"
            raise ValueError(f"another run is at work in {folder}\n{advice}") from None
        yield
    finally:
        os.close(handle)


def hang_up(number: int) -> None:
    """At SIGHUP drops the output to the closed terminal, and ignores further ones: the shell sends
    one, too.
    """
    if number != getattr(signal, "SIGHUP", None):
        return
    signal.signal(number, signal.SIG_IGN)
    null = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(output).st_mode) and not os.isatty(output):
                os.dup2(null, output)


@contextlib.contextmanager
def stopping(waits: bool = False) -> Iterator[None]:
    """Lets the signals ``STOPPING`` stop a run as Ctrl-C does, and restores the handlers.

    Python ignores errors that are raised while it destroys an object; such a signal is sent again.
    A process that ``waits`` for another run afterwards ignores them then, as its launcher would
    wait for it forever.
    """
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # other threads may not set handlers
        yield
        return
    handlers = {number: signal.getsignal(number) for number in STOPPING}

    def stop(number: int, _) -> None:
        for timer in timers:  # no second signal while the run stops
            timer.cancel()
        hang_up(number)
        raise Stopped("stopped", number)

    timers, hook = [], sys.unraisablehook

    def repeat(lost) -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt):
            hook(lost)
            return
        number = getattr(lost.exc_value, "number", signal.SIGINT)
        if number != signal.SIGINT:
            signal.signal(number, stop)  # a second SIGHUP is ignored
        timers.append(threading.Timer(AGAIN, os.kill, (os.getpid(), number)))
        timers[-1].daemon = True
        timers[-1].start()

    for number in STOPPING[1:]:
        signal.signal(number, stop)
    sys.unraisablehook = repeat
    try:
        if received:  # between two runs of a process that waits
            raise Stopped("stopped", received[0])
        yield
        for timer in timers:
            if not timer.finished.is_set():  # the run ended first
                raise Stopped("stopped", timer.args[1])
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in STOPPING[1:] if waits else ():
            signal.signal(number, lambda number, _: received.append(number))


def forward_to_children(number: int) -> None:
    """Sends a signal to the child processes, on systems with ``/proc``."""
    for task in Path("/proc/self/task").glob("*/children"):
        for child in task.read_text().split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), number)
