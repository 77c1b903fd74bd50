"""The posterior over candidate places, and places and regions from it."""

import math
import warnings
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.calibration import fewest
from gaigs.commands.locate.candidates import Candidates
from gaigs.commands.locate.fingerprints import Fingerprints
from gaigs.commands.locate.likelihood import log_likelihood, mismatch
from gaigs.commands.locate.location import Location, joined
from gaigs.commands.locate.prediction_map import fingerprints
from gaigs.commands.locate.tracks import track
from gaigs.commands.locate.values import as_fingerprints
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.stages import with_progress
from gaigs.data import Links
from gaigs.kriging.links import distances
from gaigs.model import Model
from gaigs.registry import check_type


@with_progress
@torch.no_grad()
def locate(
    model: Model | Fingerprints,
    value: object,
    links: Links | None = None,
    region: object = None,
    unknown_power: bool = False,
    step: float | None = None,
    level: float = 0.9,
    *,
    progress: bool = True,
) -> Location:
    """Places where transmitters may be, from their labels at the receivers.

    Args:
        model: A model with intervals, or its ``fingerprints``. With these a transmission takes a
            few milliseconds.
        value: A label for each of r receivers (r, *shape), or of n transmissions (n, r, *shape), in
            the unit of the training labels; with one receiver also (*shape) or (n, *shape). A
            mapping gives labels (*shape) or (n, *shape) by receiver name. A receiver has received
            nothing if its label is NaN, a channel of zeros, or missing in the mapping. Only in a
            track may all receivers have missed a transmission.
        links, region: As for ``fingerprints``.
        unknown_power: True if the power of each transmission is unknown: its labels share an offset
            [dB] or a factor of amplitudes. Channels are always compared without their power and
            phase.
        step: Standard deviation of the move along each axis between transmissions of a track [m];
            None: transmissions are independent.
        level: Probability with which the region holds the transmitter. Held-out fingerprints
            calibrate the region, with ``step`` as a walk among their places. A level of 0.9 needs 9
            of them. With fewer, or without links, the posterior sets the region, which is often too
            small.
        progress: False hides progress bars.

    Raises:
        ValueError: ``value`` has another shape than the labels, all receivers have missed a
            transmission outside a track, or an option is impossible.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> prints = gaigs.fingerprints(gaigs.train("knn", links), links, points=500)
        >>> walk = [[-50.0, -48.0, -55.0, -61.0], [-51.0, -47.0, -56.0, -60.0]]  # [dBm]
        >>> found = gaigs.locate(prints, walk, step=0.5)
        >>> found.mean.shape, found.region.shape == (2, len(found.places))
        (torch.Size([2, 3]), True)

    Source: Haeberlen et al., Practical robust localization over large-scale 802.11 wireless
    networks, 2004, for the posterior over places; Rabiner, A tutorial on hidden Markov models,
    1989, for tracks.
    """
    if isinstance(model, Fingerprints):
        if links is not None or region is not None:
            raise ValueError("fingerprints have their links and region; leave links and region out")
        prints = model
    else:
        prints = fingerprints(model, links, region)
    values = as_fingerprints(value, prints, step is not None)
    if not prints.task.shape and not unknown_power:
        excess = excess_of(values, prints)
        if excess is not None:
            unit = prints.task.error_unit
            warnings.warn(
                f"readings are up to {excess:.3g} {unit} beyond all predicted ones; "
                "check their unit, and leave out what was not heard",
                ExtrapolationWarning,
                stacklevel=4,  # as for a radio map
            )
    return posterior(prints, values, unknown_power, step, level)


def excess_of(
    values: Float[Tensor, "n r 1"], prints: Fingerprints, deviations: float = 5.0
) -> float | None:
    """Largest distance of received levels from the range of all predictions; None if plausible.

    Args:
        values: Levels of n transmissions at r receivers, in the label's unit. The result has this
            unit.
        deviations: Largest plausible distance, in standard deviations of the predictions. Half the
            range of the predictions is plausible, too.
    """
    lowest, highest = prints.values.aminmax()
    excesses = torch.maximum(values - highest, lowest - values)  # (n, r, 1)
    excess = excesses.nan_to_num(0).max()  # NaN: not received
    allowed = max(deviations * prints.deviations.max(), (highest - lowest) / 2)
    return excess.item() if excess > allowed else None


def posterior(
    prints: Fingerprints,
    values: Float[Tensor, "n r m"],
    unknown_power: bool,
    step: float | None,
    level: float,
) -> Location:
    """Places and regions of transmissions from their fingerprints, by the options of ``locate``.

    Each of the n transmissions has m values at each receiver, from ``Task.fingerprint``.

    Raises:
        ValueError: ``level`` or ``step`` is out of range.
    """
    check_type("level", level, float)
    check_type("step", step, float | None)
    if not 0 < level < 1:
        raise ValueError(f"level must be a probability between 0 and 1 such as 0.9, got {level!r}")
    if step is not None and not 0 < step < math.inf:
        raise ValueError(f"step must be above 0 m, got {step!r}")
    step = step if len(values) > 1 else None  # one value is no track
    drop = conformal_drop(prints, unknown_power, step, level)
    is_calibrated = prints.held_out_count >= fewest(level)
    # Blocks limit memory: the steps below take 60 bytes for each transmission and candidate, the
    # result 9. A track needs all of its transmissions at once.
    block_size = 64 if step is None else len(values)
    locations = []
    for block in values.split(block_size):
        difference = mismatch(prints, block @ prints.axes, unknown_power)
        candidates = prints.candidates
        log_likelihoods = log_likelihood(difference, prints.degrees, prints.temper)  # (n, g)
        log_posterior = log_likelihoods + candidates.prior  # up to a constant
        if step is not None:
            is_received = ~block.isnan().all((1, 2))
            candidates, log_posterior = track(candidates, log_posterior, step, is_received)
        locations.append(located(candidates, log_posterior, level, drop, is_calibrated))
    return replace(joined(locations), frame=prints.frame)


def conformal_drop(
    prints: Fingerprints, unknown_power: bool, step: float | None, level: float
) -> Float[Tensor, ""] | None:
    """Drop of the log posterior density from its maximum to the edge of a region.

    A region has all candidates within this drop, so that it holds the transmitter with probability
    ``level``. Held-out fingerprints determine the drop; without them the result is None.
    """
    drops = prints.drops(unknown_power, step)  # ascending
    count = prints.held_out_count
    if not count:
        return None
    # Split conformal prediction takes the quantile level (n + 1) / n of n held-out values. In a
    # track they are repeated, so that there are more drops than values.
    rank = math.ceil(level * (count + 1) / count * len(drops))
    return drops[min(rank, len(drops)) - 1]


def located(
    candidates: Candidates,
    logarithms: Float[Tensor, "n g"],
    level: float,
    drop: Float[Tensor, ""] | None,
    is_calibrated: bool,
) -> Location:
    """Places and regions of n transmissions.

    Args:
        candidates: The g candidate places.
        logarithms: Logarithms of the posteriors, up to a constant for each transmission.
        level: Probability with which a region holds the transmitter.
        drop: Drop of the log density to the edge of a region, from ``conformal_drop``; None: the
            posterior sets the edge.
        is_calibrated: True if the drop alone sets a region; otherwise the posterior may enlarge it.
    """
    places = candidates.places
    probabilities = torch.softmax(logarithms, 1)
    # Posterior density = likelihood times prior density. ``prior`` is the probability of a
    # candidate, which is no density: candidates are denser where transmitters are likelier.
    log_densities = logarithms - candidates.prior + candidates.density  # (n, g)
    order = log_densities.argsort(1, descending=True)
    # The highest densities that hold the level together: a candidate is inside if the candidates
    # above it hold less.
    ordered = probabilities.gather(1, order)
    is_inside = ordered.cumsum(1) - ordered < level
    region = torch.zeros_like(order, dtype=torch.bool).scatter(1, order, is_inside)
    if drop is not None:
        highest = log_densities.gather(1, order[:, :1])  # (n, 1)
        is_within_drop = log_densities >= highest - drop
        region = is_within_drop if is_calibrated else is_within_drop | region
    # Blocks limit the memory of distances.
    medians = [geometric_median(places, block) for block in probabilities.split(64)]
    return Location(
        places,
        probabilities,
        mean=(probabilities @ places.double()).float(),
        median=torch.cat(medians),
        likeliest=places[order[:, 0]],
        region=region,
        sizes=(region * candidates.prior.softmax(0)).sum(1),
        calibrated=is_calibrated,
    )


def geometric_median(
    places: Float[Tensor, "g 3"],
    probabilities: Float[Tensor, "n g"],
    tolerance: float = 1e-3,
    steps: int = 100,
) -> Float[Tensor, "n 3"]:
    """Places with the lowest mean distance from the candidates, for each row of probabilities.

    Args:
        places: Candidates [m].
        probabilities: Weights of the candidates in the mean.
        tolerance: Largest change of a coordinate in the last step [m]. Smaller distances count as
            this distance, since a candidate may coincide with the median.

    Source: Weiszfeld, Sur le point pour lequel la somme des distances de n points donnés est
    minimum, 1937.
    """
    places = places.double()
    median = probabilities @ places
    for _ in range(steps):
        # Weiszfeld's step: the mean of the places with weights probability / distance.
        weights = probabilities / distances(median, places).clamp_min(tolerance)  # (n, g)
        previous = median
        median = weights @ places / weights.sum(1, keepdim=True)
        if (median - previous).abs().max() < tolerance:
            break
    return median.float()
