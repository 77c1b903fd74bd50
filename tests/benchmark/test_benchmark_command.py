"""command=benchmark, and the page that all benchmarks make together."""

import sys
import time

import pytest

from gaigs import __main__ as command_line
from gaigs.benchmark import Context, Glance, rasterizer
from gaigs.benchmark.all import All

TINY = (
    "benchmark.common=[16]", "benchmark.training=[]", "benchmark.aperture=[]", "benchmark.grids=[[8,12]]",
    "benchmark.precisions=[float32]", "benchmark.rasterizers=[torch]", "benchmark.repeats=1",
)  # fmt: skip


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Runs the command line; gives its exit code and what it says on stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rasterizer, "peak_mb", lambda *place: None)

    def run(*arguments):
        monkeypatch.setattr(
            sys, "argv", ["gaigs", *arguments, f"hydra.run.dir={tmp_path / 'run'}", "hydra/job_logging=none"]
        )
        code = 0
        try:
            command_line.main()
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr().err

    return run


def test_a_benchmark_by_name(run, tmp_path):
    assert run("command=benchmark", "benchmark=rasterizer", *TINY) == (0, "")
    assert {path.name for path in (tmp_path / "run").glob("raster*")} == {
        "rasterizer.csv", "rasterizer.md", "rasterizer_common.png"
    }  # fmt: skip


def test_without_a_name_all_are_run_and_make_one_page(run, monkeypatch):
    seen = {}
    monkeypatch.setattr(All, "run", lambda self, folder, context: seen.update(all=self, context=context))
    assert run("command=benchmark", "benchmark.minutes=3", "benchmark.parts.step.repeats=4", "seed=7") == (0, "")
    assert seen["all"].minutes == 3
    assert [type(part).__name__ for part in seen["all"].parts][:2] == ["RasterizerBenchmark", "StepBenchmark"]
    assert seen["all"].parts[1].repeats == 4
    assert seen["context"].overrides == ("seed=7",)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("benchmark=step",), "benchmark=step needs command=benchmark, got command=train; add command=benchmark"),
        (("command=benchmark", "benchmark=step", "benchmark.repeats=0"), "benchmark.repeats must be at least 1, got 0"),
        (("command=benchmark", "benchmark=step", "benchmark.repeats=x"), "option 'repeats' must be a whole number"),
        (("command=benchmark", "benchmark=step", "benchmark.minutes=-1"), "benchmark.minutes must be at least 0"),
        (("command=benchmark", "~benchmark"), "command=benchmark needs a benchmark, and it was left out"),
        (("command=bench",), "command must be train, benchmark, agreement or devices, got 'bench'"),
    ],
)
def test_what_does_not_suit_is_told_in_a_sentence(run, arguments, told):
    code, err = run(*arguments)
    assert code == 1
    assert told in err
    assert "Traceback" not in err


class Part:
    """A benchmark that notes its time."""

    def __init__(self, seconds, device="a machine"):
        self.seconds, self.device, self.had = seconds, device, None

    def run(self, folder, context):
        self.had = context.seconds_left()
        time.sleep(self.seconds)

    def section(self, folder):
        return "## A part\n\n![a figure](part.png)\n"

    def glance(self, folder):
        return [Glance("this for that", "a map", "1 ms", "1e-7", self.device)]


def test_parts_share_the_minutes_and_a_page(tmp_path, monkeypatch):
    whole = All({"step": {"name": "step", "rasterizers": ["torch"]}}, minutes=0.6 / 60)
    whole.parts = [Part(0), Part(0.1, "another"), Part(0)]
    whole.run(tmp_path, Context())
    first, second, third = (part.had for part in whole.parts)
    assert first <= 0.2 < second <= 0.3 < third <= 0.5
    page = (tmp_path / "speed-error.md").read_text()
    assert page.startswith("# Speed against error\n")
    line = "| this for that | a map | 1 ms | 1e-7 |\n"
    first, second = page.partition("On a machine, ")[2].split("On another, ")
    assert (first.count(line), second.count(line)) == (2, 1)
    assert page.count("## A part\n\n![a figure](speed-error/part.png)\n") == 3


def test_all_has_parts():
    with pytest.raises(ValueError, match=r"benchmark\.parts must name at least one benchmark, got none"):
        All({})
