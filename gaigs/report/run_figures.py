"""All figures of a run."""

from pathlib import Path

from gaigs.core import stages
from gaigs.core.task import Task
from gaigs.core.task.csi import Csi
from gaigs.core.task.scalar import Scalar
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links
from gaigs.model import Model
from gaigs.report import figures, style
from gaigs.report.csi import CsiFigures
from gaigs.report.curves import loss_curves
from gaigs.report.intervals import intervals
from gaigs.report.room import paths, room
from gaigs.report.scalar import ScalarFigures
from gaigs.report.spectrum import SpectrumFigures
from gaigs.report.training_log import read_log


def figures_of(task: type[Task]) -> figures.TaskFigures:
    """Figures of a task: registered for its class, or for the nearest base class."""
    known = {Csi: CsiFigures, Scalar: ScalarFigures, Spectrum: SpectrumFigures}
    known |= figures.registered
    for base in task.__mro__:
        if base in known:
            return known[base]()
    return figures.TaskFigures()


def write_figures(folder: Path, links: Links, model: Model) -> list[Path]:
    """Draws the room, the losses and the figures of the task into ``figures``.

    The model's ``primitives`` and ``learnt_room`` are drawn if they exist. Everything else comes
    from the files of the run.
    """
    learnt = model.learnt_room(links)
    drawn = {"room": room(links, model.primitives, learnt)}
    if learnt is not None and learnt.paths:
        drawn["paths"] = paths(links, learnt)
    if losses := read_log(folder):
        drawn["loss"] = loss_curves(losses)
    task = (links.held_out or links).task
    if (drawn_intervals := intervals(folder, task, links.split.name)) is not None:
        drawn["intervals"] = drawn_intervals
    drawn |= figures_of(type(links.task)).of_run(task, folder, links)
    (folder / "figures").mkdir(exist_ok=True)
    files: list[Path] = []
    for number, (name, figure) in enumerate(stages.track(drawn.items(), "figures")):
        if stages.is_up():
            stages.leave_out(f"no figures {', '.join([*drawn][number:])}")
            break
        files += style.save(figure, folder / "figures" / f"{name}.png")
    return files
