"""The cells of each notebook run, one after another."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_run_and_print_as_they_are_stored(path, capsys, monkeypatch):
    monkeypatch.setattr(plt, "show", lambda: None)
    names: dict = {}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        exec("".join(cell["source"]), names)
        stored = "".join("".join(output.get("text", "")) for output in cell["outputs"])
        assert len(capsys.readouterr().out.splitlines()) == len(stored.splitlines())
    plt.close("all")


def test_there_are_notebooks():
    assert NOTEBOOKS
