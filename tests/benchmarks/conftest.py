"""Scripts import each other by name, as from their own folder; it is the last to be searched."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
