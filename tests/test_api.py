"""The library: public names, their examples, and that it does what the command line does."""

import doctest
import inspect
import subprocess
import sys

import pytest
import torch

import gaigs
from gaigs.algebra import Algebra
from gaigs.model import Model
from gaigs.model.gaigs import GaussianSplatting
from gaigs.projection import project
from gaigs.propagation import bartlett

OTHERS = [Algebra, GaussianSplatting, Model.predict, Model.save, project, bartlett]
"""Documented for notebooks beside the names of the package."""

PUBLIC = [name for name in gaigs.__all__ if name != "__version__"]


@pytest.mark.parametrize("thing", [*PUBLIC, *OTHERS], ids=lambda thing: getattr(thing, "__qualname__", thing))
def test_the_example_runs(thing, tmp_path, monkeypatch):
    documented = getattr(gaigs, thing) if isinstance(thing, str) else thing
    text = inspect.getdoc(type(documented["task"]) if thing == "registries" else documented)
    examples = doctest.DocTestParser().get_doctest(text, {"gaigs": gaigs, "torch": torch}, str(thing), None, None)
    assert examples.examples, f"{thing} has no example"
    monkeypatch.chdir(tmp_path)
    said = []
    with torch.random.fork_rng():
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(
            examples, out=said.append
        )
    assert not said, "".join(said)


def test_the_names_are_those_of_the_package():
    assert {*gaigs.__all__} <= {*dir(gaigs)}
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        _ = gaigs.trian


def test_packages_stay_packages():
    """A public name may hide no module."""
    import gaigs.data
    import gaigs.split

    for name in PUBLIC:
        getattr(gaigs, name)
        assert not inspect.ismodule(getattr(gaigs, name)), name
    assert inspect.ismodule(gaigs.data)
    assert inspect.ismodule(gaigs.split)


def test_the_package_is_quick_to_import():
    """It and what composes configurations, which the command line's help and its errors wait for."""
    code = "import sys, gaigs, gaigs.__main__; print(*{'torch', 'lightning', 'scipy', 'matplotlib'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
