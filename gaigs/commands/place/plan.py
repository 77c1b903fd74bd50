"""Places for access points: candidates chosen one by one, by predicted levels."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.commands.place.objectives import Coverage, LocationError, MeanLevel, choose
from gaigs.commands.survey.plan import survey_places, write_places
from gaigs.core.geometry import Frame
from gaigs.core.query import as_positions
from gaigs.core.radio_maps import scalar_scene
from gaigs.core.results import plot
from gaigs.core.scene import Scene
from gaigs.core.stages import track, with_progress
from gaigs.model import Model
from gaigs.registry import check_type, suggest


@dataclass(frozen=True, repr=False)
class SitePlan:
    """Places for access points, and the expected quality after each.

    Attributes:
        places: Chosen candidates, the first choice first (n, 3) [m].
        standing: Existing receivers (k, 3) [m].
        area: Places of transmitters (g, 3) [m].
        qualities: The objective at each place of ``area``, before and after each choice (n + 1, g).
            The mean level without receivers is NaN.
        objective: ``coverage`` [%], ``mean`` in the unit of the labels, or ``locate`` [m].
        threshold: Level for ``coverage``.
        unit: Unit of the labels.
        frame: Place of x and y on a map; None if unknown.

    Example:
        >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
        >>> plan = gaigs.place(model, [[3.0, 0.2, 2.0], [1.0, 3.0, 2.0]], objective="mean")
        >>> tuple(plan.places.shape), len(plan.standing), plan.score_unit
        ((1, 3), 4, 'dBm')
    """

    places: Float[Tensor, "n 3"]
    standing: Float[Tensor, "k 3"]
    area: Float[Tensor, "g 3"]
    qualities: Float[Tensor, "n1 g"]
    objective: str
    threshold: float
    unit: str
    frame: Frame | None = None
    plot = plot

    @property
    def scores(self) -> Float[Tensor, " n1"]:
        """Mean of the objective over the area, before and after each choice."""
        return self.qualities.mean(1)

    @property
    def score_unit(self) -> str:
        """Unit of ``scores``."""
        return {"coverage": "%", "locate": "m"}.get(self.objective, self.unit)

    def __repr__(self) -> str:
        return f"<{self}>"

    def __str__(self) -> str:
        more = " more" if len(self.standing) else ""
        verb = "brings" if len(self.places) == 1 else "bring"
        subject = f"{len(self.places)}{more} {verb}"
        digits = 2 if self.objective == "locate" else 1
        first, last = (f"{score:.{digits}f}" for score in self.scores[[0, -1]].tolist())
        if self.objective == "coverage":
            start = f"{first} to " if len(self.standing) else ""
            return f"{subject} {start}{last} % above {self.threshold:g} {self.unit}".rstrip()
        quantity = "mean best level" if self.objective == "mean" else "expected error of locations"
        start = "" if first == "nan" else f"from {first} "
        return f"{subject} the {quantity} {start}to {last} {self.score_unit}".rstrip()

    def save(self, path: str | Path) -> None:
        """Writes a CSV table: existing receivers, then new places, each with the score after it."""
        rows = [("stands", position, None) for position in self.standing.tolist()]
        new = zip(self.places.tolist(), self.scores[1:].tolist(), strict=True)
        rows += [("place", position, score) for position, score in new]
        write_places(Path(path), self.objective, rows, self.frame)


@with_progress
@torch.no_grad()
def place(
    model: Model,
    candidates: object = None,
    count: int = 1,
    objective: str = "coverage",
    threshold: float = -75.0,
    region: object = None,
    known: bool = True,
    frequency: float | None = None,
    *,
    progress: bool = True,
) -> SitePlan:
    """Places for new access points, chosen one by one for the best quality with all earlier ones.

    Args:
        model: A trained model of levels with intervals, which predicts receivers at any place.
        candidates: Possible places (c, 3) [m], or the distance [m] between places along the walls.
            Walls are the sides of the box of training transmitters and receivers, at the receivers'
            median height. None: 64 places along the walls.
        count: Number of access points.
        objective: ``coverage``: probability that a reading is above the threshold at one receiver
            or more; ``mean``: reading of the best receiver; ``locate``: error of a location by all
            readings.
        threshold: Level for ``coverage``, in the unit of the labels.
        region: Two corners of a box ``[[x, y, z], [x, y, z]]`` [m] over which the objective is
            averaged. None: the box of the training transmitters, or a box for each of several
            floors.
        known: True: the model's receivers stay; False: they are ignored.
        frequency: Carrier [Hz]; None: the training links' carrier, of several the middle one.
        progress: False hides progress bars.

    Raises:
        ValueError: The model has no levels, no intervals or no new receivers; an option is out of
            range, or a place is impossible.

    Example:
        >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
        >>> plan = gaigs.place(model, [[3.0, 0.2, 2.0], [1.0, 3.0, 2.0]], threshold=-45.0)
        >>> bool(plan.scores[1] >= plan.scores[0])  # more places are covered
        True
    """
    scene = scalar_scene(model, "a placement")
    check_type("count", count, int)
    check_type("known", known, bool)
    if not isinstance(threshold, int | float) or not math.isfinite(threshold):
        raise ValueError(f"threshold must be a finite level, got {threshold}")
    sites = candidate_places(scene, candidates).unique(dim=0)
    if not len(sites):
        raise ValueError("candidates must be one place or more, got none")
    if not 1 <= count <= len(sites):
        raise ValueError(f"count must be 1 to {len(sites)}, the candidates, got {count}")
    area = survey_places(model, region, None).candidates  # (g, 3)
    rules: dict[str, Callable[..., Coverage | LocationError]] = {
        "coverage": partial(Coverage, threshold=float(threshold)),
        "mean": MeanLevel,
        "locate": partial(LocationError, places=area),
    }
    if objective not in rules:
        got = suggest(objective, rules)
        raise ValueError(f"objective must be one of {', '.join(rules)}, got {got}")
    standing = scene.positions(area) if known else area[:0]
    frequency = scene.middle_frequency if frequency is None else frequency

    rows = []
    deviation_rows = []
    # Existing receivers by number, then candidates by position.
    for receiver in track([*range(len(standing)), *sites], "predicted receivers"):
        # An interval brings the deviation, whatever its level.
        estimate = model.predict(area, receiver=receiver, frequency=frequency, interval=0.5)
        rows.append(estimate.value.double().cpu())  # (g,)
        deviation_rows.append(estimate.std.double().cpu())
    rule = rules[objective](torch.stack(rows), torch.stack(deviation_rows))  # (k + c, g) each
    chosen, qualities = choose(rule, len(standing), count)
    if objective == "mean" and not len(standing):
        qualities[0] = math.nan  # no receiver, no level
    return SitePlan(
        sites[chosen - len(standing)],
        standing,
        area,
        qualities,
        objective,
        float(threshold),
        scene.task.unit,
        scene.frame,
    )


def candidate_places(scene: Scene, candidates: object, usual: int = 64) -> Float[Tensor, "c 3"]:
    """Places [m] of the ``candidates`` argument of ``place``: given, or points along the walls.

    Args:
        candidates: Places, a distance between them [m], or None.
        usual: Number of points along the walls for None.
    """
    if candidates is not None and np.ndim(candidates):
        return as_positions("candidates", candidates).reshape(-1, 3)
    x, y = torch.stack(scene.box)[:, :2].T.numpy()  # lower and upper coordinate of each
    corners_x = x[[0, 1, 1, 0, 0]]  # once around, back to the first corner
    corners_y = y[[0, 0, 1, 1, 0]]
    sides = np.hypot(np.diff(corners_x), np.diff(corners_y))
    walked = np.append(0, sides.cumsum())  # way from the first corner to each [m]
    perimeter = walked[-1]
    spacing = perimeter / usual if candidates is None else candidates
    if not perimeter / 10_000 <= spacing < np.inf:
        least = f"{perimeter / 10_000:.2g}"
        raise ValueError(f"candidates must be {least} m apart or more, got {candidates} m")
    ways = np.arange(0, perimeter - 1e-6, spacing)  # the end is the first place again
    wall_x = np.interp(ways, walked, corners_x)
    wall_y = np.interp(ways, walked, corners_y)
    height = np.full(len(ways), scene.positions(scene.lower)[:, 2].median())
    return torch.from_numpy(np.stack((wall_x, wall_y, height), 1)).float()
