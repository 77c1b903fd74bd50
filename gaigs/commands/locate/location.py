"""The result of ``locate``: candidate places with their probabilities."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.core.geometry import Frame
from gaigs.core.results import plot
from gaigs.io.tables import write_table
from gaigs.kriging.links import distances


@dataclass(frozen=True, repr=False)
class Location:
    """Posterior of the places of transmitters, from ``locate``.

    Attributes:
        places: Candidate places (g, 3) [m].
        probabilities: Probability of each candidate for each transmission (n, g).
        mean: Posterior mean (n, 3) [m].
        median: Place with the least expected distance from the transmitter (n, 3) [m].
        likeliest: Candidate with the highest posterior density (n, 3) [m].
        region: True for candidates in the region that holds the transmitter with probability
            ``level`` of ``locate`` (n, g).
        sizes: Prior probability of each region (n,), a measure of its size.
        calibrated: True if held-out fingerprints set the size of regions. Otherwise the posterior
            sets it, and regions are often too small.
        frame: Place of x and y on a map; None if unknown.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> found = gaigs.locate(gaigs.train("knn", links), [-50.0, -48.0, -55.0, -61.0])
        >>> found.holds(found.likeliest)
        tensor([True])
        >>> found.save("locate.csv")
    """

    places: Float[Tensor, "g 3"]
    probabilities: Float[Tensor, "n g"]
    mean: Float[Tensor, "n 3"]
    median: Float[Tensor, "n 3"]
    likeliest: Float[Tensor, "n 3"]
    region: Bool[Tensor, "n g"]
    sizes: Float[Tensor, " n"]
    calibrated: bool
    frame: Frame | None = None
    plot = plot

    def __repr__(self) -> str:
        return f"<{self.summary()}>"

    def summary(self) -> str:
        """One sentence: the place and the region of the first transmission."""
        count = len(self.median)
        place = ", ".join(f"{x:.2f}" for x in self.median[0].tolist())
        which = "transmitter" if count == 1 else f"{count} transmitters, the first"
        size = f"{self.region[0].sum()} of {len(self.places)} candidates"
        return f"{which} near ({place}) m, in a region of {size}"

    def holds(self, places: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """True for each transmission whose region has the candidate nearest to its place."""
        nearest = distances(places.double(), self.places.double()).argmin(1)
        return self.region.gather(1, nearest[:, None])[:, 0]

    def save(self, path: str | Path) -> None:
        """Writes a CSV table with a row for each transmission.

        Columns are the mean, median and likeliest place [m], and ``region_share``, the prior
        probability of the region. With a ``frame`` the table also has eastings and northings.
        """
        write_columns(path, self.columns())

    def columns(self) -> dict[str, Tensor]:
        """Columns (n,) of ``save`` by their names."""
        columns: dict[str, Tensor] = {}
        for name in ("mean", "median", "likeliest"):
            x, y, z = getattr(self, name).double().T
            columns |= {f"{name}_x": x, f"{name}_y": y, f"{name}_z": z}
            if self.frame is not None:
                columns[f"{name}_easting"] = self.frame.x + x
                columns[f"{name}_northing"] = self.frame.y + y
        return columns | {"region_share": self.sizes}


def joined(parts: Sequence[Location]) -> Location:
    """One location with all transmissions of several, which have the same candidates."""
    fields = {}
    for name in ("probabilities", "mean", "median", "likeliest", "region", "sizes"):
        fields[name] = torch.cat([getattr(part, name) for part in parts])
    return replace(parts[0], **fields)


def write_columns(path: str | Path, columns: Mapping[str, Tensor]) -> None:
    """Writes columns as a CSV table, rounded to six decimals."""
    rows: list[list[str]] = [[*columns]]
    for numbers in zip(*(column.tolist() for column in columns.values()), strict=True):
        rows.append([f"{round(number, 6):.12g}" for number in numbers])
    write_table(Path(path), rows)
