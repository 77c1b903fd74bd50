"""A package that is not in ``plugins`` has no tests."""

from pathlib import Path

PACKAGES = Path(__file__).parents[2] / "plugins"
collect_ignore = [
    file.name
    for file in Path(__file__).parent.glob("test_*.py")
    if not (PACKAGES / file.stem.removeprefix("test_")).is_dir()
]
