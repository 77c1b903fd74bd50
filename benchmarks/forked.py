"""The command line in processes of their own, forked from one in which the packages are imported; for soak.py."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from gaigs import __main__ as command_line

HUNG = 1800
"""Seconds that no run takes."""


class Process:
    """The command line in a forked process.

    Args:
        arguments: Of the command line.
        says: File for what it says on stderr; the rest goes beside it.
        before: What it does first.
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
        """Whether it has ended, before ``until`` was true."""
        start = time.monotonic()
        while self.code is None and not until():
            done, status = os.waitpid(self.id, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if done else None
            if time.monotonic() > start + HUNG:
                os.killpg(self.id, signal.SIGKILL)
                raise TimeoutError(f"a run must end within {HUNG} s, and one did not; see {self.says}")
            time.sleep(0.002)
        return self.code is not None

    @property
    def told(self) -> list[str]:
        """What it said on stderr, without the lines that Hydra puts around each message."""
        lines = self.says.read_text().splitlines()
        return [line for line in lines if line and not line.startswith(("Error executing job", "Set the environment"))]

    @property
    def end(self) -> str:
        """How it ended, in words."""
        if self.code < 0:
            return signal.Signals(-self.code).name
        messages = {"enough memory": "not enough memory", "not be written": "could not be written"}
        messages |= {"was removed": "folder was removed", "stopped": "stopped", "not started": "stopped"}
        said = next(
            (name for words, name in messages.items() if any(words in line for line in self.told)), "no message"
        )
        return f"{said}, exit code {self.code}" if self.code else "ended well"
