"""The cells of quick notebooks run, one after another. The workflow runs all of them whole, as
CONTRIBUTING.md says.
"""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

FOLDER = Path(__file__).parent.parent / "docs" / "notebooks"
BUDGETS = {"own_component": {"transmitters": 20, "steps": 1}, "rasterize": {"count": 3, "steps": 2}}
"""Of the tests, in place of those of the cell that is tagged as parameters."""


@pytest.mark.parametrize("name", BUDGETS)
def test_cells_run_and_print_as_they_are_stored(name, capsys, monkeypatch):
    monkeypatch.setattr(plt, "show", lambda: None)
    names: dict = {"__name__": "__main__"}
    for cell in json.loads((FOLDER / f"{name}.ipynb").read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        exec("".join(cell["source"]), names)
        if "parameters" in cell["metadata"].get("tags", ()):
            assert BUDGETS[name].keys() <= names.keys()
            names |= BUDGETS[name]
        stored = "".join("".join(output.get("text", "")) for output in cell["outputs"])
        assert len(capsys.readouterr().out.splitlines()) == len(stored.splitlines())
    plt.close("all")


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.ipynb")), ids=lambda file: file.stem)
def test_outputs_are_stored(file):
    cells = [cell for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)], (
        "run in order, from the start"
    )
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert (
        any("image/png" in output.get("data", ()) for output in outputs)
        or file.stem == "own_component"
    )
    assert not any(
        output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs
    )
