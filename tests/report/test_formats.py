"""Formats of figure files: those of the command, and no others."""

import pytest
from matplotlib.figure import Figure

import gaigs
from gaigs.report.formats import figure_formats
from gaigs.report.style import save

HEADS = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}


@pytest.mark.parametrize("given", ["pdf", ["png", "pdf"], ["svg"]])
def test_figures_have_the_formats_of_the_context(pixels, tmp_path, given):
    with figure_formats(given):
        files = save(Figure(), tmp_path / "room.png")
    endings = [given] if isinstance(given, str) else given
    assert files == [tmp_path / f"room.{ending}" for ending in endings]
    assert {*tmp_path.iterdir()} == {*files}
    assert all(file.read_bytes().startswith(HEADS[file.suffix[1:]]) for file in files)
    assert save(Figure(), tmp_path / "room.png") == [tmp_path / "room.png"]


@pytest.mark.parametrize("given", ["jpg", [], ["png", "jpg"]])
def test_unknown_formats_are_refused_before_the_run(tmp_path, given):
    configuration = gaigs.compose("model=knn") | {"figures": {"format": given}}
    with pytest.raises(
        ValueError, match=r"figures\.format must be one or several of png, pdf, svg, got "
    ):
        gaigs.run(configuration, tmp_path / "run")
    assert not (tmp_path / "run").exists()
