"""What a run shares a machine with: threads, memory, the signals that stop it, other runs, its own other processes."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

STOPPING = (signal.SIGINT, signal.SIGTERM)
"""Signals at which a run stops where it can go on: Ctrl-C, and what schedulers send before they kill."""

POCL_THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
"""Environment variables that limit the threads of OpenCL on the processor: PoCL up to version 3, and later ones."""

OUT_OF_MEMORY = ("allocate memory", "unable to allocate", "not enough memory", "out of memory", "bad_alloc")
OUT_OF_MEMORY += ("bad allocation", "failed to map segment", "can't start new thread", "mem_object_allocation_failure")
OUT_OF_MEMORY += ("could not create a primitive", "error return without exception set")
"""Words of torch, C++, the loader of libraries, Python, OpenCL and oneDNN for it, in small letters; the last ones are
Python's where there was no memory for the error itself."""

AGAIN = 0.05
"""Until a signal comes once more that was passed over [s]."""

RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "NODE_RANK", "GROUP_RANK")
"""Environment variables that number processes and machines."""

COUNTS = ("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_NNODES")
"""Environment variables that count processes and machines."""

received: list[int] = []
"""Signals at which runs of this process have stopped: a launcher's worker starts no other then."""


class Stopped(KeyboardInterrupt):
    """A signal has stopped a run.

    Args:
        message: Where it stopped.
        number: Of the signal.
    """

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.number = number


@contextlib.contextmanager
def limited_threads(count: int | None, jobs: int = 1) -> Iterator[None]:
    """Has torch and PoCL take so many threads; PoCL keeps those with which it was first used.

    Args:
        count: Threads; None leaves everything as it is, but shares the processors where several jobs run at a time.
        jobs: How many jobs run at a time on this machine; -1 is one for each processor.

    Raises:
        ValueError: The count is less than 1.
    """
    if count is None and jobs in (0, 1):
        yield
        return
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if count is None:
        count = max(1, processors // (processors if jobs < 0 else jobs))
    if count < 1:
        raise ValueError(f"threads must be at least 1, or null for all, got {count}")
    import torch  # slow to import

    names = ("OMP_NUM_THREADS", *POCL_THREADS)
    before, environment = torch.get_num_threads(), {name: os.environ.get(name) for name in names}
    os.environ |= dict.fromkeys(names, str(count))
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
    """Whether an error, or what caused it, is that there was no more memory, of the processor or of a GPU."""
    while error is not None:
        if isinstance(error, MemoryError) or any(words in str(error).lower() for words in OUT_OF_MEMORY):
            return True
        error = error.__cause__
    return False


def check_ranks() -> None:
    """Sees to it that what numbers processes are numbers; to be called before Lightning is imported, which reads them.

    Raises:
        ValueError: One is none, or SLURM's say not how many processes a machine has.
    """
    for name in (*RANKS, *COUNTS):
        value = os.environ.get(name, "0")
        if not value.isdecimal():
            raise ValueError(f"{name} must be a whole number in the environment, got {value!r}; unset it")
    count = int(os.environ.get("SLURM_NTASKS", 1))
    is_shell = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")  # where one process runs alone
    asked = not is_shell and "TORCHELASTIC_RUN_ID" not in os.environ  # torchrun's numbers go before SLURM's
    if count > 1 and asked and "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise ValueError(
            f"SLURM_NTASKS_PER_NODE must be in the environment where SLURM_NTASKS is more than 1, got {count}; give "
            "srun --ntasks-per-node in place of --ntasks, or unset SLURM_NTASKS for one process"
        )


def is_first() -> bool:
    """Whether this is the first of the processes that train together, which alone writes files."""
    from lightning.pytorch.utilities import rank_zero_only  # slow to import

    # Lightning's number is that within a machine where neither torchrun nor SLURM gives one over all of them.
    is_global = any(name in os.environ for name in ("RANK", "SLURM_PROCID"))
    machine = 0 if is_global else int(os.environ.get("NODE_RANK", os.environ.get("GROUP_RANK", 0)))
    return rank_zero_only.rank == 0 and machine == 0


@contextlib.contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Holds a run's folder against other runs, as long as this process lives; nothing is written there.

    Raises:
        ValueError: Another run holds it.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{folder} must be free, and another run is at work there; wait for it, or choose another folder "
                "(hydra.run.dir=DIR)"
            ) from None
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def stopping(waits: bool = False) -> Iterator[None]:
    """Has SIGTERM stop a run as Ctrl-C does; what handlers there were come back.

    Python passes over what is raised while it destroys an object; such a signal comes once more.

    Args:
        waits: Whether the process waits for another run then. SIGTERM does not end it while it does, as its launcher
            would wait for it for ever.
    """
    if threading.current_thread() is not threading.main_thread():  # others may set no handlers
        yield
        return
    handlers = {number: signal.getsignal(number) for number in STOPPING}

    def stop(number: int, _) -> None:
        for timer in timers:  # they are not to interrupt what this one ends
            timer.cancel()
        raise Stopped("stopped", number)

    timers, hook = [], sys.unraisablehook

    def repeat(lost) -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt):
            hook(lost)
            return
        timers.append(threading.Timer(AGAIN, os.kill, (os.getpid(), getattr(lost.exc_value, "number", signal.SIGINT))))
        timers[-1].daemon = True
        timers[-1].start()

    signal.signal(signal.SIGTERM, stop)
    sys.unraisablehook = repeat
    try:
        if received:  # between two runs of a process that waits
            raise Stopped("stopped", received[0])
        yield
        for timer in timers:
            if not timer.finished.is_set():  # the end came before it did
                raise Stopped("stopped", timer.args[1])
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if waits:
            signal.signal(signal.SIGTERM, lambda number, _: received.append(number))


def forward_to_children(number: int) -> None:
    """Sends a signal to the processes that this one has started, as far as the system tells."""
    for task in Path("/proc/self/task").glob("*/children"):
        for child in task.read_text().split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), number)
