"""The budget of a training in steps, wall time or both, and the fraction that is spent."""

import contextlib
import math
import time
from collections.abc import Callable, Mapping

from lightning.pytorch.callbacks import Callback, Timer
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from gaigs.core import stages
from gaigs.processes import is_first
from gaigs.registry import check_type

ENDLESS = 2**40
"""More steps than any training has; without a number Lightning fetches batches ahead, which a
resumption misses.
"""


class Budget(Callback):
    """Measures the time of a training, ends it in time, and schedules validations.

    The clock of the first process decides for all, after each step. Lightning's ``max_time`` would
    give each process its own clock. The time includes the search for planes, validations, and
    earlier parts of a resumed training.

    Args:
        max_time: Limit of search and training together [s]. At least half of it is for the
            training, after a search of any duration. None: only steps end the training.
        every: Smallest time between validations [s]; they take at most a fifth of the training.
            None: steps schedule validations.
        searched: Duration of the search before the training [s], by the first process's clock.

    Attributes:
        end: Time at which the limit of the run ends the training, at least a second after the
            search [s]; infinite without a limit.
        share: Fraction of the training's time that is spent, equal in all processes; 0 without a
            limit.
    """

    def __init__(
        self, max_time: float | None = None, every: float | None = None, searched: float = 0.0
    ):
        self.max_time = max_time
        self.every = every
        self.searched = searched
        self.share = 0.0
        self.end = math.inf
        self.began = searched  # time at which the last validation began [s]
        self.validated = searched  # time at which the last validation ended [s]
        self.is_due = False  # True if a validation follows the present step
        self.spent = searched  # time before the training [s]
        self.start: float | None = None  # clock at the start of the training [s]

    @property
    def seconds(self) -> float:
        """Time of the search and of the training so far [s]."""
        return self.spent + (0.0 if self.start is None else time.monotonic() - self.start)

    @property
    def limit(self) -> float:
        """Time at which the training ends [s]; infinite if only steps end it."""
        limit = math.inf
        if self.max_time is not None:
            limit = max(self.max_time, self.searched + self.max_time / 2)
        return min(limit, max(self.end, self.searched + 1.0))

    def state_dict(self) -> dict:
        names = ("seconds", "searched", "share", "began", "validated", "is_due")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict) -> None:
        self.spent = state["seconds"]
        self.searched = state.get("searched", 0.0)
        for name in ("share", "began", "validated", "is_due"):
            setattr(self, name, state[name])

    def on_fit_start(self, trainer, module) -> None:
        names = ("searched", "spent", "began", "validated")
        # All processes take the times of the first one.
        of_first = trainer.strategy.broadcast([getattr(self, name) for name in names])
        for name, value in zip(names, of_first, strict=True):
            setattr(self, name, value)
        self.end = self.spent + stages.left()
        self._stop_in_time(trainer)  # a run that was killed once its time was up

    def on_train_start(self, trainer, module) -> None:
        self.start = time.monotonic()
        # The checkpoint was written after a validation, which is not to be repeated.
        if self.is_due:
            trainer.val_check_batch = trainer.global_step

    def on_train_batch_end(self, trainer, module, *_) -> None:
        if math.isinf(self.limit) and self.every is None:
            return
        elapsed = self._measure_time(trainer)
        # Validations take at most a fifth of the time: 4 d of training follow one of duration d.
        pause = 4 * (self.validated - self.began)
        is_time = self.every is not None and elapsed >= self.validated + max(self.every, pause)
        self.is_due = trainer.should_stop or is_time
        if self.is_due:
            trainer.val_check_batch = trainer.global_step
            self.began = elapsed
        elif self.every is not None:
            trainer.val_check_batch = ENDLESS

    def on_validation_end(self, trainer, module) -> None:
        if math.isinf(self.limit) and self.every is None:
            return
        self.validated = self._measure_time(trainer)
        if not trainer.sanity_checking:
            for logger in trainer.loggers:  # beside the scores of this validation
                logger.log_metrics({"seconds": self.validated}, step=trainer.global_step - 1)

    def on_train_end(self, trainer, module) -> None:
        self.spent = self.seconds
        self.start = None

    def _measure_time(self, trainer) -> float:
        """The first process's time [s]; stops the training when the time is up."""
        elapsed = trainer.strategy.broadcast(self.seconds)
        self.share = (elapsed - self.searched) / (self.limit - self.searched)
        self._stop_in_time(trainer)
        return elapsed

    def _stop_in_time(self, trainer) -> None:
        """Asks Lightning to stop after this step if the whole time is spent."""
        trainer.should_stop = trainer.should_stop or self.share >= 1


def make_budget(options: Mapping, searched: float = 0.0) -> tuple[dict, Budget]:
    """Options of Lightning's trainer without the budget's options, and the budget.

    The budget takes ``max_time``, and a ``val_check_interval`` given as a time. ``searched`` is the
    duration of the search before the training [s].

    Raises:
        TypeError: A number of steps is not a whole number.
        ValueError: A time is not in Lightning's format, or below a second; nothing ends the
            training; or an option counts epochs.
    """
    options = dict(options)
    max_time = options.pop("max_time", None)
    every = options.get("val_check_interval")
    if max_time is not None:
        max_time = seconds("trainer.max_time", max_time)
    elif options.get("max_steps", -1) == -1 and math.isinf(stages.left()):
        raise ValueError(
            "trainer.max_steps must be at least 1, got -1; time alone ends it with trainer.max_time"
        )
    if isinstance(every, str | dict):
        every = seconds("trainer.val_check_interval", every)
        options["val_check_interval"] = ENDLESS
    else:
        every = None
    for option in ("val_check_interval", "log_every_n_steps"):
        steps = options.get(option, 1)
        check_type(f"trainer.{option}", steps, int)
        if steps < 1:
            raise ValueError(f"trainer.{option} must be at least 1 step, got {steps}")
    for option, only in (("max_epochs", -1), ("check_val_every_n_epoch", None)):
        epochs = options.get(option)
        if epochs not in (only, None):
            raise ValueError(
                f"trainer.{option} must be {only or 'null'}, as steps or time count, got {epochs}"
            )
    return options, Budget(max_time, every, searched)


def seconds(option: str, duration: object) -> float:
    """A duration [s] in the format of Lightning's ``Timer``: DD:HH:MM:SS, or ``{minutes: 3}``."""
    length = None
    with contextlib.suppress(MisconfigurationException, TypeError):
        if isinstance(duration, str | dict):
            length = Timer(duration=duration).time_remaining()
    if not length or length < 1:
        raise ValueError(
            f"{option} must be at least 1 s as 'DD:HH:MM:SS', in quotes in a file, got {duration!r}"
        )
    return length


def watched(config: Mapping) -> contextlib.AbstractContextManager[stages.Timekeeper]:
    """The timekeeper of a run with the limit ``max_time``; with bars if the trainer has bars."""
    limit = math.inf
    if config.get("max_time") is not None:
        limit = seconds("max_time", config["max_time"])
    has_bars = is_first() and config["trainer"].get("enable_progress_bar", True)
    return stages.watched(limit, has_bars)


def time_share(trainer) -> float | None:
    """The spent fraction of the time, equal in all processes; None without a time limit."""
    shares = (budget.share for budget in _budgets(trainer) if math.isfinite(budget.limit))
    return next(shares, None)


def is_time_up(trainer) -> bool:
    """True if the time of a training is up, by the clock of the first process."""
    strategy = trainer.strategy
    return any(strategy.broadcast(budget.seconds) >= budget.limit for budget in _budgets(trainer))


def _budgets(trainer) -> list[Budget]:
    """The callbacks of the trainer that are a ``Budget``: one or none."""
    return [callback for callback in trainer.callbacks if isinstance(callback, Budget)]


def share_done(trainer) -> Callable[[int], float]:
    """A function of the step: the fraction of steps that is done, or of the time if larger."""

    def share(step: int) -> float:
        by_steps = step / trainer.max_steps if trainer.max_steps > 0 else 0.0
        return max(by_steps, time_share(trainer) or 0.0)

    return share
