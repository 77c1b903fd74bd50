"""Intervals of predictions, by conformal prediction on links that the predicting model has not
seen.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Inexact, Int
from torch import Tensor

from gaigs.core.query import Query, evenly, thin_labels
from gaigs.core.task import Task
from gaigs.io import FAR
from gaigs.kriging.links import distances

ENOUGH = 100
"""Links that a group needs for intervals of its own."""

BINS = 8
"""Groups of a spectrum's pixels by their predicted amplitude: where it is high, errors are larger.
"""

USUAL = 0.9
"""Level at which shares of links scatter, for the intervals of all levels."""

STEPS = 200
"""Levels of the stored quantiles of errors; one in between has the next higher."""


class Estimate(NamedTuple):
    """A prediction with its uncertainty, from ``model.predict(x, interval=0.9)``; tensors shaped as
    the value.

    Attributes:
        value: The prediction of ``predict`` without an interval.
        std: Standard deviation of the label about it, in the label's unit; of channels that of the
            complex error. NaN, as what follows, at elements that an array lacks.
        lower, upper: Ends of the interval, which holds the label with the asked probability; None
            for channels.
        radius: Of channels, that of a disc about the value which holds the channel with this
            probability, in the label's unit; else None.
        snr_db: Of channels, the expected signal-to-noise ratio of each link's prediction [dB],
            without the axes of elements and subcarriers; else None.

    Example:
        >>> model = gaigs.train("knn", gaigs.links("synthetic_rssi", transmitters=100))
        >>> found = model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]], interval=0.9)
        >>> found.upper.shape, bool((found.lower < found.value).all())  # places, receivers
        (torch.Size([2, 4]), True)
    """

    value: Tensor
    std: Tensor
    lower: Tensor | None
    upper: Tensor | None
    radius: Tensor | None = None
    snr_db: Tensor | None = None


@dataclass(frozen=True)
class Calibration:
    """Quantiles of the absolute errors at links not seen over a model's own deviation, in groups.

    Links are in one group per receiver where each has at least ``ENOUGH`` of them; of a model that
    states no deviation also by the distance to the nearest known place of their receiver, if errors
    rise with it. Pixels of a spectrum are in ``BINS`` groups by their predicted amplitude too, or
    in fewer with pixels of more links each. A group of n links has an interval of level p by the
    quantile p (n + 1) / n of its errors: it then holds a new link's label with probability p, if
    links are exchangeable. Of labels of several numbers, n is the number of single ones whose share
    within an interval of level ``USUAL`` would scatter as much, so they are held with a probability
    of about p.

    Attributes:
        edges: Of the distances (r or 1, g - 1) [m].
        amplitudes: Edges of the predicted amplitudes (bins - 1,).
        counts: Links of each group (groups,).
        quantiles: Of the errors, for intervals of levels 0 to 1 (groups, bins, ``STEPS`` + 1).
        sizes: Root mean square of the errors (groups, bins).
        places, receivers: Of the known links, for the distance; empty with one group of distances.
        lowest: Least possible label.

    Source: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005; by groups of
    links: Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer hierarchical
    models, 2022.
    """

    edges: Float[Tensor, "r e"]
    amplitudes: Float[Tensor, " a"]
    counts: Int[Tensor, " g"]
    quantiles: Float[Tensor, "g b q"]
    sizes: Float[Tensor, "g b"]
    places: Float[Tensor, "k 3"]
    receivers: Int[Tensor, " k"]
    lowest: Float[Tensor, ""]

    @classmethod
    def of(
        cls,
        task: Task,
        labels: Inexact[Tensor, " n *shape"],
        values: Inexact[Tensor, " n *shape"],
        deviations: Float[Tensor, " n ..."],
        query: Query,
        near: Float[Tensor, " n"] | None,
        known: Query,
    ) -> "Calibration":
        """From links that were predicted by models that do not know them.

        Args:
            deviations: As the model states them.
            near: Distance of each link to the nearest place that its predicting model knows [m];
                None if the model states deviations, which need no groups of distances.
            known: Links that the calibrated model knows.
        """
        labels, values, deviations = thinned(task, labels, values, deviations)
        scale = _shaped(deviations, values)
        errors, exists = (labels - values).abs() / scale, ~scale.isnan()
        count = int(torch.cat((query.receivers, known.receivers)).max()) + 1
        heard = query.receivers.bincount(minlength=count)
        rows = (
            query.receivers
            if heard.min() >= ENOUGH and count > 1
            else torch.zeros_like(query.receivers)
        )
        apart = torch.zeros(len(rows), dtype=torch.float64) if near is None else near.clamp_max(FAR)
        groups = 1 if near is None else max(1, min(4, int(rows.bincount().min()) // ENOUGH))
        while True:  # equal distances may leave a group with few links
            levels = torch.arange(1, groups, dtype=torch.float64) / groups
            edges = torch.stack(
                [apart[rows == row].quantile(levels) for row in range(int(rows.max()) + 1)]
            )
            own = rows * groups + torch.searchsorted(edges[rows], apart[:, None])[:, 0]
            counts = own.bincount(minlength=len(edges) * groups)
            squares = torch.stack(
                [errors[own == group].square().nanmean() for group in range(len(counts))]
            )
            if groups == 1 or (
                counts.min() >= ENOUGH // 2 and (squares.view(-1, groups).diff() > 0).all()
            ):
                break
            groups -= 1
        numbers = (values.abs() if values.is_complex() else values).double()
        some = numbers.flatten()[evenly(torch.arange(numbers.numel()), 10**6)]
        most = BINS if numbers.shape[1] > 1 and not values.is_complex() else 1
        while True:  # a bin with pixels of few links would have their errors alone
            amplitudes = some.quantile(torch.arange(1, most, dtype=torch.float64) / most)
            bins = torch.bucketize(numbers, amplitudes)
            links = torch.stack([(bins == bin_).any(1).sum() for bin_ in range(most)])
            if most == 1 or links.min() >= fewest(USUAL):
                break
            most //= 2
        quantiles = errors.new_zeros(
            len(counts), len(amplitudes) + 1, STEPS + 1, dtype=torch.float64
        )
        sizes = quantiles[..., 0].clone()
        levels = torch.linspace(0, 1, STEPS + 1, dtype=torch.float64)
        for group in range(len(counts)):
            for bin_ in range(len(amplitudes) + 1):
                # A bin without pixels in a group, as of receivers in different surroundings, has
                # those of all groups.
                inside = (bins == bin_) & (own == group)[:, None] & exists
                inside = inside if inside.any() else (bins == bin_) & exists
                inside = inside if inside.any() else exists
                found = errors[inside].double().sort().values
                held = (errors <= quantile(found, levels.new_tensor(USUAL))) & inside
                quantiles[group, bin_] = quantile(
                    found, levels * (1 + 1 / effective_count(held.sum(1), inside.sum(1)))
                )
                sizes[group, bin_] = found.square().mean().sqrt()
        known = known if groups > 1 else known[:0]
        lowest = torch.tensor(task.lowest, dtype=torch.float64)
        return cls(
            edges, amplitudes, counts, quantiles, sizes, known.transmitters, known.receivers, lowest
        )

    def estimate(self, value: Tensor, deviations: Tensor, query: Query, level: float) -> Estimate:
        """The interval of some predictions; raises a ``ValueError`` where it needs more links."""
        rows = query.receivers if len(self.edges) > 1 else torch.zeros_like(query.receivers)
        own = rows * (self.edges.shape[1] + 1)
        if self.edges.shape[1]:
            near = nearest(
                query, self.places.to(query.transmitters), self.receivers.to(query.receivers)
            )
            own = own + torch.searchsorted(self.edges.to(near)[rows], near[:, None])[:, 0]
        counts = self.counts.to(own)[own]
        need = fewest(level)
        if len(counts) and (few := int(counts.min())) < need:
            raise ValueError(
                f"an interval of {100 * level:g} % needs {need} links to calibrate it, the model has {few}\n"
                "ask for a narrower interval, or give more links: to a look-up known ones, else by split.validation"
            )
        cells, amplitudes = own.reshape(-1, *[1] * (value.ndim - 1)), self.amplitudes.to(value.real)
        if len(amplitudes):
            cells = cells * (len(amplitudes) + 1) + torch.bucketize(value.contiguous(), amplitudes)
        scale, rank = _shaped(deviations, value), math.ceil(level * STEPS - 1e-9)
        half, std = (
            scale * table.flatten().to(scale).take(cells)
            for table in (self.quantiles[..., rank], self.sizes)
        )
        if value.is_complex():
            exists = [part.masked_fill(std.isnan(), 0) for part in (value, std)]
            powers, errors = (part.abs().square().flatten(1).sum(1) for part in exists)
            return Estimate(value, std, None, None, half, 10 * (powers / errors).log10())
        lower = (value - half).clamp_min(self.lowest.item())
        # Some models predict less than the least label.
        return Estimate(value, std, torch.minimum(lower, value), value + half)

    @property
    def mean_error(self) -> float:
        """Mean absolute error over the model's own deviation; of labels of one number, of which few
        calibrate, a little too large."""
        return torch.trapezoid(self.quantiles, dx=1 / STEPS).mean().item()

    def gives(self, level: float) -> bool:
        """True if every group has enough links for intervals of a level."""
        return fewest(level) <= int(self.counts.min())

    def state(self) -> dict[str, Tensor]:
        """Plain tensors for a checkpoint; ``Calibration(**state)`` makes it anew."""
        return {name: getattr(self, name).cpu() for name in self.__dataclass_fields__}


def quantile(numbers: Float[Tensor, " n"], levels: Float[Tensor, "*q"]) -> Float[Tensor, "*q"]:
    """The least of n sorted numbers that are not below a share of them."""
    ranks = (levels * len(numbers) - 1e-9).ceil().long()
    return numbers[(ranks - 1).clamp(0, len(numbers) - 1)]


def effective_count(held: Int[Tensor, " n"], counts: Int[Tensor, " n"]) -> float:
    """Number of single numbers whose share within an interval would scatter as that of links with
    ``counts`` numbers.

    ``held`` of them are within; a link's numbers err together, though less than one number with
    itself.
    """
    weights, parts = counts / counts.sum().double(), held / counts.sum().double()
    share, links = parts.sum().item(), 1 / weights.square().sum().item()
    scatter = (parts - share * weights).square().sum().item()
    return max(links, share * (1 - share) * (1 - 1 / links) / max(scatter, 1e-12))


def fewest(level: float) -> int:
    """Fewest links that give an interval of a level; 0.9 / (1 - 0.9) is above 9 by rounding."""
    return math.ceil(level / (1 - level) - 1e-9)


def nearest(
    query: Query, places: Float[Tensor, "k 3"], receivers: Int[Tensor, " k"]
) -> Float[Tensor, " b"]:
    """Distance of each link to the nearest known place of its receiver [m]; infinite without one."""
    found = torch.full((len(query),), math.inf, dtype=torch.float64, device=places.device)
    for receiver in query.receivers.unique().tolist():
        asked, known = (
            (query.receivers == receiver).nonzero()[:, 0],
            places[receivers == receiver].double(),
        )
        for part in asked.split(1024) if len(known) else ():
            found[part] = distances(query.transmitters[part].double(), known).amin(1)
    return found


def holds(estimate: Estimate, labels: Inexact[Tensor, " k *shape"]) -> Bool[Tensor, " k *shape"]:
    """True for each number of aligned labels that is within its interval."""
    if estimate.radius is not None:
        return (labels - estimate.value).abs() <= estimate.radius
    return (estimate.lower <= labels) & (labels <= estimate.upper)  # type: ignore[operator]


def interval_scores(
    labels: Inexact[Tensor, " k *shape"], half: Estimate, most: Estimate
) -> dict[str, Float[Tensor, " k"]]:
    """Scores of each link's intervals of 50 % and 90 %: shares of its aligned numbers inside,
    width, CRPS and -log p.

    The last two are those of a normal distribution with the estimate's ``std``; of channels those
    of real and imaginary parts. CRPS has the label's unit.

    Source: Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation, 2007.
    """
    value, std = most.value, most.std
    errors = labels - value
    inside = holds(half, labels), holds(most, labels)
    width = 2 * most.radius if most.radius is not None else most.upper - most.lower
    if errors.is_complex():
        errors, std = (
            torch.view_as_real(errors),
            (std / math.sqrt(2))[..., None].expand(*std.shape, 2),
        )
    # A deviation of 0, where the model is exact, has the least that float32 tells from it.
    std = std.double().clamp_min(torch.finfo(torch.float32).tiny)
    z = errors.double() / std
    density = torch.exp(-z.square() / 2) / math.sqrt(2 * math.pi)
    crps = std * (z * torch.erf(z / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi))
    nll = z.square() / 2 + std.log() + math.log(2 * math.pi) / 2
    parts = {
        "coverage_50": inside[0],
        "coverage_90": inside[1],
        "width_90": width,
        "crps": crps,
        "nll": nll,
    }
    means = {}
    for name, part in parts.items():
        of_numbers = (
            part.double().reshape(*value.shape, -1).mean(-1).masked_fill(most.std.isnan(), math.nan)
        )
        means[name] = of_numbers[..., None].flatten(1).nanmean(1)
    return means


def summarise_intervals(scores: dict[str, Tensor]) -> dict[str, float]:
    """Means over links, and the standard errors of both coverages, ``coverage_50_error`` and
    ``coverage_90_error``.

    The errors are those of the test's links and of the ``calibration_links`` together, both placed
    alike; NaN with one place. ``places`` has the number of each link's place, from 0: errors of one
    place depend on each other, those of different ones count as independent. If all links have one
    share, places scatter as the level says.

    Source: Cameron and Miller, A practitioner's guide to cluster-robust inference, 2015.
    """
    numbers = {}
    for name, score in scores.items():
        if name == "places":
            continue
        numbers[name] = score.mean().item()
        if name.startswith("coverage"):
            sums, level = (
                scores["places"].long().bincount(score - score.mean()),
                int(name[-2:]) / 100,
            )
            links = 1 / len(score) + 1 / scores["calibration_links"].mean().item()
            spread = sums.square().sum().item() / len(score) * len(sums) / max(len(sums) - 1, 1)
            if score.min() == score.max():
                spread = level * (1 - level) * len(score) / len(sums)
            numbers[f"{name}_error"] = math.sqrt(spread * links) if len(sums) > 1 else math.nan
    return numbers


def _shaped(deviations: Tensor, values: Tensor) -> Tensor:
    """Deviations of links, or of all their numbers, in the shape of the values; above 0."""
    shaped = deviations.reshape(*deviations.shape, *[1] * (values.ndim - deviations.ndim)).to(
        values.real
    )
    return shaped.clamp_min(torch.finfo(shaped.dtype).tiny).expand(values.shape)


def thinned(
    task: Task,
    labels: Inexact[Tensor, " n *shape"],
    values: Inexact[Tensor, " n *shape"],
    deviations: Tensor,
) -> tuple[Inexact[Tensor, "n m"], Inexact[Tensor, "n m"], Tensor]:
    """Aligned labels, predictions and, unless there is one for each link, deviations by
    ``thin_labels``.
    """
    deviations = thin_labels(deviations) if deviations.ndim > 1 else deviations
    pairs = zip(
        labels.split(64), values.split(64), strict=True
    )  # an alignment takes several times the memory
    aligned = [thin_labels(task.align(*pair)) for pair in pairs]
    return torch.cat(aligned), thin_labels(values), deviations
