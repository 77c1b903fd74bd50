"""The report at the end of a multirun, requested by an experiment under ``hydra.callbacks``."""

import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from gaigs.report.formats import figure_formats

folders: list[tuple[Path, str | list[str]]] = []
"""Multiruns of this process that need a report, and the formats of its figures."""


class AtEnd(Callback):
    """Requests the report of a multirun. ``main`` writes it, as Hydra calls no callback after a
    failed job.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        """Remembers the folder and the formats."""
        plain: Any = OmegaConf.to_container(config)
        folders.append((Path(config.hydra.sweep.dir), plain["figures"]["format"]))


def write() -> None:
    """Writes the requested reports and prints their tables."""
    while folders:
        folder, formats = folders.pop()
        from rich.console import Console

        from gaigs.report.multirun import report  # slow to import

        try:
            with figure_formats(formats):
                Console(emoji=False).print(report(folder))
        except Exception as error:  # a failed report must not look like a failed job
            print(
                f"gaigs: no report: {' '.join(str(error).split()) or repr(error)}", file=sys.stderr
            )
        else:
            print(f"report: {folder}; python -m gaigs.report {folder} writes it anew")
