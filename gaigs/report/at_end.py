"""The report of a multirun, written once its jobs have ended: an experiment asks for it by ``hydra.callbacks``."""

import sys
from pathlib import Path

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

folders: list[Path] = []
"""Multiruns of this process of which a report is asked for."""


class AtEnd(Callback):
    """Asks for the report of a multirun. Hydra tells of its end only where no job has failed, so ``main`` writes it."""

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        """Remembers the folder."""
        folders.append(Path(config.hydra.sweep.dir))


def write() -> None:
    """Writes the reports that are asked for, and prints their tables."""
    while folders:
        folder = folders.pop()
        from rich.console import Console

        from gaigs.report.multirun import report  # slow to import

        try:
            Console().print(report(folder))
        except Exception as error:  # the jobs have ended well: nothing may make that look as if they had not
            print(f"gaigs: no report: {' '.join(str(error).split()) or repr(error)}", file=sys.stderr)
        else:
            print(f"report: {folder}; python -m gaigs.report {folder} writes it anew")
