"""Several benchmarks one after the other, in one process, and one page of them."""

import logging
import re
from collections.abc import Mapping
from pathlib import Path

import torch

from gaigs.benchmark import Benchmark, Context, Glance
from gaigs.benchmark._page import table
from gaigs.io.files import write_text
from gaigs.registry import register, registry

log = logging.getLogger(__name__)

PAGE = "speed-error"
"""Name of the page, and of the folder beside it that has the files of its parts."""

INTRODUCTION = """# Speed against error

What do you pay in error for which speed, with which component, on which machine? The first tables say it at a glance;
each section below has the measurements behind it. One command gives all of this page and its figures on your machine:

```
python -m gaigs command=benchmark
```

"""


@register("benchmark", "all")
class All(Benchmark):
    """Runs its parts in turn, shares the minutes between them, and joins their sections into ``speed-error.md``;
    ``speed-error/`` beside it has their files.

    Args:
        parts: Configurations of benchmarks, by name, in the order of the page.
        minutes, device: As of every benchmark; those of a part hold for the part.

    Raises:
        ValueError: There is no part.
    """

    def __init__(self, parts: Mapping[str, dict], minutes: float | None = None, device: str | None = None):
        super().__init__(minutes, device)
        if not parts:
            raise ValueError("benchmark.parts must name at least one benchmark, got none")
        self.parts = [registry("benchmark").build(part) for part in parts.values()]

    def run(self, folder: Path, context: Context) -> None:
        context = context.within(self.minutes, self.device)
        beside = folder / PAGE
        beside.mkdir(exist_ok=True)
        for number, part in enumerate(self.parts):
            share = context.seconds_left() / (len(self.parts) - number)
            part.run(beside, context.within(share / 60))
        page = folder / f"{PAGE}.md"
        text = INTRODUCTION + self._table(beside) + "\n" + self.section(beside)
        write_text(page, re.sub(r"\]\((?=[^)/]+\.png\))", f"]({PAGE}/", text))
        log.info("page: %s", page)

    def section(self, folder: Path) -> str:
        return "\n".join(part.section(folder) for part in self.parts)

    def glance(self, folder: Path) -> list[Glance]:
        return [line for part in self.parts for line in part.glance(folder)]

    def _table(self, folder: Path) -> str:
        """The table at a glance, one for each device."""
        by_device: dict[str, list[Glance]] = {}
        for line in self.glance(folder):
            by_device.setdefault(line.device, []).append(line)
        parts = []
        for device, lines in by_device.items():
            told = table(["choice", "where", "time", "error"], [line[:-1] for line in lines])
            parts.append(f"On {device}, torch {torch.__version__}:\n\n{told}")
        return "\n".join(parts)
