"""The map of a model's predictions, which ``locate`` compares with received labels."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.commands.locate.candidates import even_candidates, near_candidates
from gaigs.commands.locate.fingerprints import (
    Fingerprints,
    at_carrier,
    receptions,
    transmissions,
)
from gaigs.commands.locate.likelihood import UnseenPrints, choose_likelihood, independent, mismatch
from gaigs.core import stages
from gaigs.core.geometry import ExtrapolationWarning, even_places
from gaigs.core.query import as_positions, evenly
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.kriging.links import reception_probability
from gaigs.model import Model
from gaigs.registry import check_instance, check_type
from gaigs.split import rows_of


@stages.with_progress
@torch.no_grad()
def fingerprints(
    model: Model,
    links: Links | None = None,
    region: object = None,
    frequency: float | None = None,
    points: int | None = None,
    *,
    progress: bool = True,
) -> Fingerprints:
    """The map of predictions that ``locate`` compares with received labels.

    One map serves many transmissions.

    Args:
        model: A trained, fitted or loaded model with intervals.
        links: Links that the model was trained on. Transmitters are then likely where known places
            are dense. Held-out links calibrate the likelihood and the size of regions. None: all
            places are equally likely, and errors of a label's values count as independent, which
            makes regions too small.
        region: Two corners of a box ``[[x, y, z], [x, y, z]]`` [m] in which all places are equally
            likely; None: the box of the training transmitters.
        frequency: Carrier [Hz]. Without a ``region`` it must be a carrier of the training links.
            None: their carrier; of several the middle one.
        points: Number of candidate places. None: 20,000, or as many as the model predicts in a
            minute.
        progress: False hides progress bars.

    Raises:
        ValueError: The model has no intervals, or an option is impossible.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=500)
        >>> gaigs.locate(prints, [-50.0, -48.0, float("nan"), -61.0]).mean.shape
        torch.Size([1, 3])
    """
    check_instance("model", model, Model)
    check_type("points", points, int | None)
    if links is not None:
        check_instance("links", links, Links)
        check_fit(links, model.scene)
    if points is not None and points < 2:
        raise ValueError(f"points must be at least 2 candidates, got {points}")
    box = box_of(model, region)
    frequency = model.scene.middle_frequency if frequency is None else frequency
    points = affordable_points(model, box, frequency) if points is None else points
    if links is None:
        maker = MapMaker(box, region is not None, points, frequency)
        prints = maker.make(model, torch.zeros(0, dtype=torch.long))
        return along(prints, [])
    known = at_carrier(links, frequency, "train", "validation")
    if region is None and not len(known):
        carriers = ", ".join(f"{carrier:.7g}" for carrier in model.scene.frequencies.tolist())
        raise ValueError(
            f"frequency must be that of known links, {carriers} Hz, got {frequency:.7g}; "
            "or give a region"
        )
    maker = MapMaker(box, region is not None, points, frequency, links)
    prints = maker.make(model, known)
    folds = held_out_folds(maker, model, known)
    trials = trials_of(folds)
    prints = along(prints, [fold.errors for fold in folds])
    return choose_likelihood(prints, trials) if trials else prints


def box_of(model: Model, region: object) -> Float[Tensor, "2 3"]:
    """Corners of the region [m], or of the box of the training transmitters if it is None."""
    if region is None:
        return torch.stack((model.scene.lower, model.scene.upper))
    box = as_positions("region", region).reshape(-1, 3)
    if len(box) != 2:
        raise ValueError(
            f"region must be two corners [[x, y, z], [x, y, z]] [m], got {len(box)} points"
        )
    return box


def affordable_points(
    model: Model,
    box: Float[Tensor, "2 3"],
    frequency: float | None,
    most: int = 20_000,
    fewest: int = 1000,
    seconds: float = 60.0,
) -> int:
    """Number of places that a model predicts in ``seconds``, from ``fewest`` to ``most``."""
    places = even_places(box[0], box[1], 512)
    predicted(model, places[:2], frequency)  # the first prediction compiles and loads
    start = time.perf_counter()
    predicted(model, places, frequency)
    places_a_second = len(places) / (time.perf_counter() - start)
    return min(most, max(fewest, int(seconds * places_a_second)))


class Predicted(NamedTuple):
    """Predictions of a model at places, for all receivers."""

    values: Float[Tensor, "g r m"]  # as ``Task.fingerprint`` gives them
    deviations: Float[Tensor, "g r"]  # standard deviations of labels of one number; else 1


def predicted(model: Model, places: Float[Tensor, "g 3"], frequency: float | None) -> Predicted:
    """Fingerprints that a model predicts for transmitters at places [m] and a carrier [Hz]."""
    task = model.scene.task
    count = len(model.scene.receivers)
    batch_size = 8192  # links
    if task.shape:  # arrays take more memory; a look-up reads all its known labels for each batch
        batch_size = 64 if model.is_trained else 512
    options: dict[str, Any] = {"frequency": frequency, "batch_size": batch_size}
    values = []
    deviations = []
    # Candidates may lie outside the box of the training transmitters.
    with warnings.catch_warnings(action="ignore", category=ExtrapolationWarning):
        batches = places.split(max(1, batch_size // count))
        for batch in stages.track(batches, "fingerprints"):
            shape = len(batch), count
            transmitters = batch[:, None].expand(-1, count, 3)  # (places, receivers, 3)
            receivers = torch.arange(count).expand(shape)
            if task.shape:
                labels = model.predict(transmitters, receivers, **options).cpu().flatten(0, 1)
                deviations.append(torch.ones(shape))
            else:
                # An interval brings the standard deviation, whatever its level.
                estimate = model.predict(transmitters, receivers, interval=0.5, **options)
                labels = estimate.value.cpu().flatten()
                deviations.append(estimate.std.cpu())
            values.append(task.fingerprint(labels).unflatten(0, shape))
    return Predicted(torch.cat(values), torch.cat(deviations))


@dataclass(frozen=True)
class MapMaker:
    """Makes maps of models that were trained on all links or on a part of them."""

    box: Float[Tensor, "2 3"]  # corners of the box of the candidates [m]
    is_region: bool  # True if all places in the box are equally likely
    points: int  # number of candidates
    frequency: float | None  # carrier [Hz]; None if unknown
    links: Links | None = None  # links with a split; None for a map of the model alone

    def make(self, model: Model, known: Int[Tensor, " k"]) -> Fingerprints:
        """The map of a model trained on ``known`` links (their indices).

        Its ``axes`` are unit vectors, until ``along`` replaces them. Its candidates are a grid, or
        lie near the known places if there are links and no region.
        """
        scene = model.scene
        if self.is_region:
            candidates = even_candidates(self.box, self.points)
        elif self.links is None:
            candidates = even_candidates(self.box, self.points, scene.floors)
        else:
            candidates = near_candidates(self.box, self.points, scene.floors, self.links, known)
        values, deviations = predicted(model, candidates.places, self.frequency)
        reception_probabilities = torch.full(values.shape[:2], 0.5)
        if len(known) and self.has_whole_transmissions():
            known_places, is_received = receptions(self.links, known)
            reception_probabilities = reception_probability(
                candidates.places, known_places, is_received, prior=0.5
            )
        return Fingerprints(
            scene.task,
            self.frequency,
            [receiver.name for receiver in scene.receivers],
            candidates,
            torch.eye(values.shape[2]),
            values,
            deviations,
            reception_probabilities,
            frame=scene.frame,
        )

    def has_whole_transmissions(self) -> bool:
        """True if no transmission has both known links and test links.

        A missing link then means that the receiver has not received the transmission.
        """
        rows = rows_of(self.links)
        known = rows[at_carrier(self.links, self.frequency, "train", "validation")]
        tested = rows[at_carrier(self.links, self.frequency, "test")]
        return not torch.isin(known, tested).any()

    def contains(self, places: Float[Tensor, "n 3"]) -> Tensor:
        """True for places in the box (n,)."""
        return ((places >= self.box.amin(0)) & (places <= self.box.amax(0))).all(1)


class PrintFold(NamedTuple):
    """Held-out fingerprints of one fold."""

    prints: Fingerprints  # map of a model that does not know them
    values: Float[Tensor, "n r m"]  # their values
    truth: Float[Tensor, "n 3"]  # their places [m]
    # Values less predictions, also of fingerprints outside the region.
    errors: Float[Tensor, "k r m"]

    def half(self, number: int) -> "PrintFold":
        """The fold with every second fingerprint, from the first (0) or the second (1) on."""
        return PrintFold(self.prints, *(part[number::2] for part in self[1:]))


def held_out_folds(
    maker: MapMaker,
    model: Model,  # the model that knows all
    known: Int[Tensor, " k"],  # known links at the carrier of the map
    most: int = 500,  # largest number of fingerprints of a fold whose errors give the axes
    located: int = 200,  # largest number of them that are located
    enough: int = 300,  # number of located fingerprints after which no fold is added
) -> list[PrintFold]:
    """Held-out fingerprints by fold, each with the map of a model trained without them.

    A single fold is halved, so that each half calibrates the other.
    """
    links = maker.links
    rows = rows_of(links)  # number of each link's transmission
    folds: list[PrintFold] = []
    # Each fold: a model without the held-out links, and the indices of these and its own links.
    for unseen, held_out, trained in stages.track(model.unseen(links), "folds", model.fold_count):
        unseen.calibration = model.calibration
        # All known links of a transmission are held out if one of them is.
        is_held_out = torch.isin(rows[known], rows[held_out])
        values, truth = transmissions(links, known[is_held_out])
        chosen = evenly(torch.arange(len(truth)), most)
        trained = trained[torch.isin(trained, known)]
        if len(chosen) and (len(trained) or maker.is_region):
            errors = values[chosen] - predicted(unseen, truth[chosen], maker.frequency).values
            if maker.is_region:  # values to locate come from the region
                chosen = chosen[maker.contains(truth[chosen])]
            prints = maker.make(unseen, trained)
            folds.append(PrintFold(prints, values[chosen], truth[chosen], errors))
        located_count = sum(min(len(fold.truth), located) for fold in folds)
        if located_count >= enough:
            break
    if len(folds) == 1 and len(folds[0].values) > 1:
        return [folds[0].half(0), folds[0].half(1)]
    return folds


def trials_of(folds: Sequence[PrintFold], most: int = 200) -> list[UnseenPrints]:
    """Up to ``most`` held-out fingerprints of each fold, compared with the fold's map."""
    trials = []
    for number, fold in enumerate(folds):
        # Axes come from the other folds: axes from the errors of a fold would make just these
        # errors look small.
        errors_of_others = [other.errors for other in (*folds[:number], *folds[number + 1 :])]
        prints = along(fold.prints, errors_of_others)
        chosen = evenly(torch.arange(len(fold.truth)), most)
        if len(chosen):
            values = fold.values[chosen] @ prints.axes
            differences = [mismatch(prints, values, unknown) for unknown in (False, True)]
            trials.append(UnseenPrints(prints, differences, fold.truth[chosen]))
    return trials


def along(prints: Fingerprints, errors: Sequence[Float[Tensor, "_ r m"]]) -> Fingerprints:
    """The map with predictions along axes on which errors of a label's values are independent.

    Args:
        errors: Errors of held-out fingerprints by fold, NaN where nothing was received. If empty,
            the deviations of predictions from their mean replace errors.
    """
    if not prints.task.shape:
        return replace(prints, axes=torch.eye(1))
    if not errors:
        errors = [prints.values - prints.values.mean(0)]
    label_errors = torch.cat([*errors]).flatten(0, 1)  # (n r, m)
    axes = independent(label_errors[~label_errors.isnan().any(1)])
    return replace(prints, axes=axes, values=prints.values @ axes)
