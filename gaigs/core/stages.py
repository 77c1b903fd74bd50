"""Stages of a run: a progress bar for each, and the time limit of the whole run."""

import contextlib
import functools
import importlib
import io
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextvars import ContextVar
from typing import Any

import rich
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TimeRemainingColumn

log = logging.getLogger(__name__)


class Timekeeper:
    """The clock of a run.

    Args:
        limit: Time limit of the run [s].
        shown: True if its stages have progress bars.

    Attributes:
        stages: Open stages, the innermost one last.
        left_out: Descriptions of parts that were skipped for lack of time.
        seconds: Time of each ``timed`` part [s], without nested parts.
        ends: Function that is True when the current part, such as a training, must end; or None.
    """

    def __init__(self, limit: float = math.inf, shown: bool = True):
        self.limit = limit
        self.shown = shown
        self.began = time.monotonic()
        self.stages: list[Stage] = []
        self.left_out: list[str] = []
        self.seconds: dict[str, float] = {}
        self.ends: Callable[[], bool] | None = None
        self.bars: Progress | None = None
        self.lock = threading.RLock()  # bars appear in a thread of their own

    def left(self, share: float = 1.0) -> float:
        """Time until a fraction of the limit [s]."""
        return self.began + share * self.limit - time.monotonic()


class Stage:
    """A part of a run, with a number of steps; arguments as for ``stage``."""

    def __init__(self, keeper: Timekeeper, name: str, total: int, until: float, is_fixed: bool):
        self.keeper = keeper
        self.name = name
        self.total = total
        self.until = until
        self.is_fixed = is_fixed
        self.done = 0
        self.began = time.monotonic()
        self.row: TaskID | None = None
        self.owns_bars = False

    def advance(self) -> None:
        """Counts a step as done; the first one warns if a fixed stage will exceed the limit."""
        self.done += 1
        if self.row is not None and self.keeper.bars is not None:
            self.keeper.bars.update(
                self.row, completed=self.done, count=f"{self.done}/{self.total}"
            )
        # After the first step, the time that the others will take [s].
        remaining = (time.monotonic() - self.began) * (self.total - 1)
        if self.is_fixed and self.done == 1 and remaining > max(2.0, self.keeper.left()):
            words = "%s: %.0f s more, which cannot be shortened; max_time leaves %.0f s"
            log.warning(words, self.name, remaining, max(0.0, self.keeper.left()))

    def show(self) -> None:
        """Adds the bar to the run's bars."""
        with self.keeper.lock:
            if self not in self.keeper.stages:  # the stage has ended before its timer
                return
            if self.keeper.bars is None:
                self.keeper.bars = make_bars(transient=True)
                self.keeper.bars.start()
                self.owns_bars = True
            fields: dict[str, Any] = {"count": f"{self.done}/{self.total}", "scores": ""}
            self.row = self.keeper.bars.add_task(
                self.name, total=self.total, completed=self.done, **fields
            )

    def close(self) -> None:
        """Ends the stage, and removes the bar; the stage that started the run's bars stops them."""
        with self.keeper.lock:
            self.keeper.stages.remove(self)
            bars = self.keeper.bars
            if bars is not None and self.row in bars.task_ids:
                bars.remove_task(self.row)
            if bars is not None and self.owns_bars:
                bars.stop()
                self.keeper.bars = None


_keeper: ContextVar[Timekeeper | None] = ContextVar("keeper", default=None)


def current() -> Timekeeper:
    """The timekeeper of the present run; outside of runs one without a limit."""
    keeper = _keeper.get()
    if keeper is None:
        keeper = Timekeeper()
        _keeper.set(keeper)
    return keeper


@contextlib.contextmanager
def watched(limit: float = math.inf, shown: bool = True) -> Iterator[Timekeeper]:
    """A run with a time limit [s]; with ``shown`` its stages have bars."""
    token = _keeper.set(Timekeeper(limit, shown))
    try:
        yield current()
    finally:
        _keeper.reset(token)


@contextlib.contextmanager
def stage(
    name: str = "", total: int = 1, until: float = 1.0, is_fixed: bool = False
) -> Iterator[Stage]:
    """A stage of the current run.

    Args:
        name: Text before the bar. The terminal shows the bar after a second; no bar without a name.
        total: Number of its steps.
        until: Fraction of the run's time limit at which the stage has to end.
        is_fixed: True if the stage cannot end early. After its first step a log line says if it
            will exceed the limit.
    """
    opened = Stage(current(), name, total, until, is_fixed)
    timer = threading.Timer(1.0, opened.show)
    timer.daemon = True
    opened.keeper.stages.append(opened)
    is_main = threading.current_thread() is threading.main_thread()
    has_reader = rich.get_console().is_terminal or rich.get_console().is_jupyter
    if name and total > 1 and opened.keeper.shown and is_main and has_reader:
        timer.start()
    try:
        yield opened
    finally:
        timer.cancel()
        opened.close()


def portion(share: float) -> contextlib.AbstractContextManager[Stage]:
    """A stage that has to end after the fraction ``share`` of the time that open stages leave."""
    keeper = current()
    if math.isinf(keeper.limit):
        return stage()
    after = keeper.left() - share * left()  # from the end of the stage to the run's limit [s]
    return stage(until=1 - after / keeper.limit)


@contextlib.contextmanager
def timed(name: str) -> Iterator[None]:
    """A part of the current run whose time is recorded under a name, without nested parts."""
    seconds = current().seconds
    recorded_before = sum(seconds.values())
    began = time.monotonic()
    try:
        yield
    finally:
        nested = sum(seconds.values()) - recorded_before
        seconds[name] = seconds.get(name, 0.0) + time.monotonic() - began - nested


def track(
    items: Iterable, name: str = "", total: int | None = None, is_fixed: bool = False
) -> Iterator[Any]:
    """Yields items, each as a step of a stage; ``total`` is needed if they have no length."""
    if total is None:
        total = len(items) if isinstance(items, Sized) else 1
    with stage(name, total, is_fixed=is_fixed) as opened:
        for item in items:
            yield item
            opened.advance()


def advance() -> None:
    """Counts a step of the innermost stage as done, if there is one."""
    for innermost in current().stages[-1:]:
        innermost.advance()


def left() -> float:
    """Time until the open stages and the run have to end [s]; infinite without a limit."""
    keeper = current()
    return keeper.left(min([1.0, *(opened.until for opened in keeper.stages)]))


def is_up() -> bool:
    """True if an open stage, or the current part of the run, has to end now."""
    ends = current().ends
    return left() <= 0 or (ends is not None and ends())


def end_in_time(_: object) -> None:
    """A callback of ``scipy.optimize.minimize`` that ends it when the stage has to end."""
    if is_up():
        raise StopIteration


def leave_out(what: str) -> None:
    """Records and logs a part that is skipped for lack of time."""
    current().left_out.append(what)
    log.warning("max_time: %s", what)


def with_progress(function: Callable) -> Callable:
    """A decorator that hides the progress bars of calls with ``progress=False``."""

    @functools.wraps(function)
    def shown(*arguments, **options):
        keeper = current()
        before = keeper.shown
        keeper.shown = before and options.get("progress", True)
        try:
            return function(*arguments, **options)
        finally:
            keeper.shown = before

    return shown


class NotebookBars(Progress):
    """Progress bars in a notebook: a text that is replaced twice a second, without a widget."""

    def start(self) -> None:
        if not self.disable:
            display = importlib.import_module("IPython.display").display
            self.output = display({"text/plain": ""}, raw=True, display_id=True)
            self.drawn = 0.0

    def update(self, *arguments: Any, **options: Any) -> None:
        super().update(*arguments, **options)
        if not self.disable and time.monotonic() - self.drawn > 0.5:
            self.drawn = time.monotonic()
            self._write(self.get_renderable())

    def stop(self) -> None:
        if not self.disable:
            self._write("" if self.live.transient else self.get_renderable())

    def _write(self, content: Any) -> None:
        page = Console(file=io.StringIO(), width=100, force_jupyter=False, record=True)
        page.print(content)
        self.output.update({"text/plain": page.export_text()}, raw=True)


def make_bars(**options: Any) -> Progress:
    """Progress bars with description, count, time left and scores, each in a line."""
    count, scores = "{task.fields[count]}", "{task.fields[scores]}"
    columns = "{task.description}", BarColumn(None), count, TimeRemainingColumn(), scores
    kind = NotebookBars if rich.get_console().is_jupyter else Progress
    return kind(*columns, console=rich.get_console(), expand=True, **options)
