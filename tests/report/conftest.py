"""Figures are files without content, unless a test asks for pixels."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from gaigs.report import style


@pytest.fixture(autouse=True)
def empty_files(monkeypatch):
    """Rendering takes longer than all else."""
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: Path(file).touch())


@pytest.fixture
def pixels(empty_files, monkeypatch):
    """Figures are rendered, but coarsely."""
    monkeypatch.undo()
    monkeypatch.setattr(style, "DPI", 40)
