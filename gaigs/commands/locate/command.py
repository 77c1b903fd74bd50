"""The command ``locate``: options, files and figures."""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from gaigs.calibration import fewest
from gaigs.commands.locate.figures import error_figure, posterior_figure
from gaigs.commands.locate.fingerprints import Fingerprints, at_carrier, transmissions
from gaigs.commands.locate.location import Location, write_columns
from gaigs.commands.locate.neighbours import neighbours, without_power
from gaigs.commands.locate.posterior import locate, posterior
from gaigs.commands.locate.prediction_map import fingerprints
from gaigs.commands.locate.values import read_value
from gaigs.data import Links
from gaigs.io.files import write_text
from gaigs.registry import call
from gaigs.report import style
from gaigs.runs import links_of, load


def run(config: dict, folder: Path) -> None:
    """Locates the transmitters of a file of received values, or a finished run's test transmitters.

    Writes ``locate.csv`` and ``locate.png`` into a folder, for test transmitters also
    ``locate.json``.
    """
    model = load(config["folder"], config["trust"])
    links = links_of(config["folder"], config["trust"])
    options = dict(config["locate"])
    value = options.pop("value")
    if isinstance(value, str):
        value = read_value(Path(value), links)
    map_options = {name: options.pop(name) for name in ("region", "frequency", "points")}
    start = time.perf_counter()
    prints = call("locate", fingerprints, map_options, model=model, links=links)
    seconds = time.perf_counter() - start
    if value is None:
        location = locate_test(prints, links, options, folder, seconds)
    else:
        location = call("locate", locate, options, model=prints, value=value)
        folder.mkdir(parents=True, exist_ok=True)
        location.save(folder / "locate.csv")
        style.save(posterior_figure(location, options["level"]), folder / "locate.png")
        print(location.summary())
    if not location.calibrated:
        needed = fewest(options["level"])
        print(
            f"regions are not calibrated: {prints.held_out_count} fingerprints are held out, "
            f"and {needed} needed"
        )
    if location.frame is not None:
        print(f"easting and northing are those of EPSG:{location.frame.epsg}")
    print(f"results: {folder}")


def locate_test(
    prints: Fingerprints, links: Links, options: Mapping, folder: Path, map_seconds: float
) -> Location:
    """Locates the test transmitters of a run, by predictions and by nearest neighbours.

    Writes ``locate.json``, ``locate.csv`` and ``locate.png`` into the folder, and prints errors.

    ``map_seconds`` is the time in which ``prints`` was made [s]. A ``ValueError`` is raised without
    test links at its carrier.
    """
    test = at_carrier(links, prints.frequency, "test")
    if not len(test):
        raise ValueError(
            "the run has no test links at this carrier; take another split or locate.frequency"
        )
    known = transmissions(links, at_carrier(links, prints.frequency, "train", "validation"))
    values, truth = transmissions(links, test)
    start = time.perf_counter()
    location = call("locate", posterior, options, prints=prints, values=values)
    seconds = time.perf_counter() - start

    _, groups = known.places.unique(dim=0, return_inverse=True)
    known_values = known.values
    if options["unknown_power"]:
        values = without_power(values)
        known_values = without_power(known_values)
    knn_places = neighbours(values, known_values, known.places, groups)
    estimates = {
        "mean": location.mean,
        "median": location.median,
        "likeliest": location.likeliest,
        "knn": knn_places,
    }
    errors = {name: (places - truth).norm(dim=1) for name, places in estimates.items()}
    numbers = summary(location, truth, errors, options["level"])
    numbers["locate"]["milliseconds"] = 1e3 * seconds / len(truth)
    numbers |= {
        "transmissions": len(truth),
        "candidates": len(prints.values),
        "map_seconds": map_seconds,
        "calibrated": location.calibrated,
        "task": links.task.name,
        "split": links.split.name,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "locate.json", json.dumps(numbers, indent=2) + "\n")
    columns = coordinates(truth) | location.columns() | coordinates(knn_places, "knn_")
    columns |= {f"{name}_error": error for name, error in errors.items()}
    write_columns(folder / "locate.csv", columns)
    drawn = error_figure(truth, location.mean, known.places, errors)
    style.save(drawn, folder / "locate.png")
    shown = []
    for name in ("locate", "knn"):
        scores = numbers[name]
        shown.append(f"median {scores['median_m']:.3g} m, mean {scores['mean_m']:.3g} m")
    print(f"{len(truth)} transmitters: {'; nearest neighbours '.join(shown)}")
    return location


def summary(
    location: Location,
    truth: Float[Tensor, "n 3"],
    errors: Mapping[str, Float[Tensor, " n"]],
    level: float,
) -> dict[str, Any]:
    """Scores of located test transmitters by the name of the estimate, for ``locate.json``.

    Each estimate has its median and mean error [m]. The mean place is named ``locate``. It also has
    the fraction of transmitters inside their regions, and the mean prior probability of a region.

    Args:
        errors: Errors by the estimate's name, such as ``median`` or ``knn`` [m].
        level: Probability with which a region holds its transmitter.
    """
    numbers: dict[str, Any] = {"locate": {}}
    for name, error in errors.items():
        key = "locate" if name == "mean" else name
        numbers[key] = {"median_m": error.median().item(), "mean_m": error.mean().item()}
    percent = f"{100 * level:g}"
    numbers["locate"] |= {
        f"region_{percent}": location.holds(truth).double().mean().item(),
        f"share_{percent}": location.sizes.mean().item(),
    }
    return numbers


def coordinates(places: Float[Tensor, "n 3"], prefix: str = "") -> dict[str, Tensor]:
    """Columns x, y and z of places [m] by name, such as ``knn_x`` with the prefix ``knn_``."""
    return {f"{prefix}{axis}": places[:, k] for k, axis in enumerate("xyz")}
