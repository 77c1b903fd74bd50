"""Scripts import each other by name, as from their own folder; it is the last to be searched.

Run folders are made as for reports.
"""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path += [
    str(TESTS / "report"),
    str(TESTS.parent / "benchmarks"),
    str(TESTS.parent / "examples"),
]
