"""A callback of Hydra, named in ``hydra.callbacks``, that requests the tables of a multirun."""

import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from gaigs.report.formats import figure_formats

requested: list[tuple[Path, str | list[str]]] = []
"""Multiruns of this process whose tables are to be written, and the formats of their figures."""


class MultirunReport(Callback):
    """Requests tables, which ``main`` writes: Hydra calls no callback after a failed job."""

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        """Stores the folder of the multirun and the formats of its figures."""
        plain: Any = OmegaConf.to_container(config)
        requested.append((Path(config.hydra.sweep.dir), plain["figures"]["format"]))


def write_requested() -> None:
    """Writes the requested tables and prints them."""
    while requested:
        folder, formats = requested.pop()
        from rich.console import Console

        from gaigs.report.multirun import report  # slow to import

        try:
            with figure_formats(formats):
                Console(emoji=False).print(report(folder))
        except Exception as error:  # a failed report must not look like a failed job
            message = " ".join(str(error).split()) or repr(error)
            print(f"gaigs: no report: {message}", file=sys.stderr)
        else:
            print(f"report: {folder}; python -m gaigs.report {folder} writes it anew")
