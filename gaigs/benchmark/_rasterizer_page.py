"""Tables and figures of the benchmark of rasterizers, from its rows."""

from collections.abc import Sequence

from gaigs.benchmark import MEASURED, Glance, Row
from gaigs.benchmark._page import number, remarks, table

HEAD = (
    "rasterizer",
    "precision",
    "way",
    "ms",
    "spread",
    "pairs/s",
    "of limit",
    "largest error",
    "mean error",
    "SSIM",
    "dB",
    "MB",
)


def tables(rows: Sequence[Row]) -> str:
    parts = ["## Rasterizers\n"]
    places = dict.fromkeys((row["device"], row["scene"], row["gaussians"], row["grid"]) for row in rows)
    for place in places:
        own = [r for r in rows if (r["device"], r["scene"], r["gaussians"], r["grid"]) == place]
        lines = [
            [
                r["rasterizer"],
                r["precision"],
                r["way"],
                *(
                    number(r[key])
                    for key in (
                        "ms",
                        "spread_ms",
                        "pairs_per_second",
                        "share_of_limit",
                        "error_max",
                        "error_mean",
                        "ssim",
                        "error_db",
                        "peak_mb",
                    )
                ),
            ]
            for r in own
            if r["status"] == MEASURED
        ]
        parts.append(f"{', '.join(place)}\n\n" + table(HEAD, lines))
    return "\n".join(parts) + "\n" + remarks(rows, ("rasterizer", "precision"))


def figures(rows: Sequence[Row]) -> dict:
    return {}


def highlights(rows: Sequence[Row]) -> list[Glance]:
    return []
