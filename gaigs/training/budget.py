"""What a training may take: steps, wall time, or both; and how much of it is spent."""

from collections.abc import Callable, Mapping

import lightning
from lightning.pytorch.callbacks import Callback, Timer
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from gaigs.registry import check_type

ENDLESS = 2**40
"""A number of steps that no training comes to. Without one Lightning fetches batches ahead of the steps, and a training
that goes on would miss those."""


VALIDATING = 0.2
"""The share of a training by time that validations take at the most, where they are slow: they wait until then."""


class Budget(Callback):
    """Ends a training when its time is up, and has it validate by time.

    The clock of the first process decides for all, behind each step. It goes on while a training validates, and where
    one goes on it has the time that was spent before. Lightning's own validation by time is not used: its processes
    each go by a clock of their own, and nothing between the steps could tell that a validation is due.

    Args:
        timer: Measures the time; it stands before this one among the callbacks, and the trainer has no ``max_time``.
        max_time: Of the training [s]; None where steps alone end it.
        every: Time from the end of a validation to the next, or more where validations are slow [s]; None where steps
            say when to validate.
    """

    def __init__(self, timer: Timer, max_time: float | None, every: float | None):
        self.timer, self.max_time, self.every = timer, max_time, every
        self.share = 0.0
        self.began = self.validated = 0.0  # the last validation, and its end [s]
        self.is_due = False

    def state_dict(self) -> dict:
        return {"share": self.share, "began": self.began, "validated": self.validated, "is_due": self.is_due}

    def load_state_dict(self, state: dict) -> None:
        self.share, self.is_due = state["share"], state["is_due"]
        self.began, self.validated = state["began"], state["validated"]

    def on_fit_start(self, trainer, module) -> None:
        self._stop_in_time(trainer)  # a run that was killed once its time was up

    def on_train_start(self, trainer, module) -> None:
        if self.is_due:  # the checkpoint was written behind a validation, which is not to be repeated
            trainer.val_check_batch = trainer.global_step

    def on_train_batch_end(self, trainer, module, *_) -> None:
        elapsed = self._look(trainer)
        pause = (self.validated - self.began) * (1 - VALIDATING) / VALIDATING
        is_time = self.every is not None and elapsed >= self.validated + max(self.every, pause)
        self.is_due = trainer.should_stop or is_time
        if self.is_due:
            trainer.val_check_batch = trainer.global_step
            self.began = elapsed
        elif self.every is not None:
            trainer.val_check_batch = ENDLESS

    def on_validation_end(self, trainer, module) -> None:
        self.validated = self._look(trainer)
        if not trainer.sanity_checking:
            for logger in trainer.loggers:  # beside the scores of this validation
                logger.log_metrics({"seconds": self.validated}, step=trainer.global_step - 1)

    def _look(self, trainer) -> float:
        """Looks at the clock: seconds so far."""
        elapsed = trainer.strategy.broadcast(self.timer.time_elapsed("train"))
        self.share = 0.0 if self.max_time is None else elapsed / self.max_time
        self._stop_in_time(trainer)
        return elapsed

    def _stop_in_time(self, trainer) -> None:
        trainer.should_stop = trainer.should_stop or self.share >= 1


def make_budget(options: Mapping, timer: Timer) -> tuple[dict, Budget | None]:
    """The options of Lightning's trainer without those that the budget keeps, and the budget.

    Args:
        options: Those of the configuration: ``max_time`` and, where it is a time, ``val_check_interval`` are kept.
        timer: As ``Budget`` takes it.

    Returns:
        None in place of a budget where steps alone count.

    Raises:
        TypeError: What counts steps is no whole number.
        ValueError: A time is not written as Lightning reads it, or is less than a second; nothing ends the training; or
            an option has steps or epochs at which nothing can happen.
    """
    options = dict(options)
    max_time, every = options.pop("max_time", None), options.get("val_check_interval")
    if max_time is not None:
        max_time = seconds("trainer.max_time", max_time)
    elif options.get("max_steps", -1) == -1:
        raise ValueError("trainer.max_steps must be at least 1, got -1; time alone ends it with trainer.max_time")
    if isinstance(every, str | dict):
        every, options["val_check_interval"] = seconds("trainer.val_check_interval", every), ENDLESS
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
            raise ValueError(f"trainer.{option} must be {only or 'null'}, as steps or time count, got {epochs}")
    return options, None if max_time is None and every is None else Budget(timer, max_time, every)


def seconds(option: str, time: object) -> float:
    """A time in the words of Lightning's ``Timer`` [s].

    Args:
        option: Whose it is.
        time: DD:HH:MM:SS, or a mapping such as ``{minutes: 3}``.

    Raises:
        ValueError: It is neither, or less than a second.
    """
    try:
        found = Timer(duration=time).time_remaining() if isinstance(time, str | dict) else 0
    except (MisconfigurationException, TypeError):
        found = 0
    if found < 1:
        raise ValueError(
            f"{option} must be a time of at least a second as 'DD:HH:MM:SS', in quotes in a file, got {time!r}"
        )
    return found


def time_share(trainer: lightning.Trainer) -> float | None:
    """The share of the time that is spent, the same in all processes; None where no time is given."""
    budgets = (callback for callback in trainer.callbacks if isinstance(callback, Budget))
    return next((budget.share for budget in budgets if budget.max_time is not None), None)


def share_done(trainer: lightning.Trainer) -> Callable[[int], float]:
    """How much of a training is done after so many steps: of its steps or of its time, whichever is more."""

    def share(step: int) -> float:
        by_steps = step / trainer.max_steps if trainer.max_steps > 0 else 0.0
        return max(by_steps, time_share(trainer) or 0.0)

    return share
