"""Conformal intervals: quantiles of the errors at links that the predicting model has not seen."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Inexact, Int
from torch import Tensor

from gaigs.calibration.estimate import Estimate
from gaigs.calibration.new_receivers import NewReceivers, quantile
from gaigs.core.query import Query, evenly, thin_labels
from gaigs.core.task import Task
from gaigs.io import FAR
from gaigs.kriging.links import nearest_places


@dataclass(frozen=True)
class Calibration:
    """Quantiles of a model's errors at links that it has not seen, in groups of links.

    Here an error is an absolute error over the standard deviation that the model states. The
    interval of level p in a group of n links is the quantile p (n + 1) / n of its errors. It then
    holds a new link's label with probability p, if links are exchangeable. For labels of several
    values n is ``effective_count``, so the probability is about p.

    Each receiver is a group if all receivers have at least 100 links. If a model states no
    deviations, and errors rise with the distance to the receiver's nearest known place, links are
    also grouped by this distance. Pixels of a spectrum are also grouped by their predicted
    amplitude, see ``bin_numbers``.

    Source: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005.
    """

    edges: Float[Tensor, "r e"]  # distances between groups (r or 1, g - 1) [m]
    amplitudes: Float[Tensor, " a"]  # edges of the predicted amplitudes (bins - 1,)
    counts: Int[Tensor, " g"]  # number of links in each group (groups,)
    # Quantiles of the errors for intervals of levels 0 to 1 (groups, bins, steps + 1).
    quantiles: Float[Tensor, "g b q"]
    sizes: Float[Tensor, "g b"]  # root mean square of the errors (groups, bins)
    # Known links, for the distance; empty with one group of distances.
    places: Float[Tensor, "k 3"]
    receivers: Int[Tensor, " k"]
    lowest: Float[Tensor, ""]  # least possible label
    # Relative width of intervals at each receiver without links, 0 at others; None: every receiver
    # has links.
    widths: Float[Tensor, " w"] | None = None
    # Calibration for receivers without links. Its errors are those at each receiver when a model
    # predicts it by the mean of the other receivers. None if receivers are too few.
    elsewhere: "Calibration | None" = None
    # Parameters of the covariance of level errors, see ``gaigs.model.adapted``.
    scatter: Float[Tensor, " n"] | None = None

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
        new: NewReceivers | None = None,
        steps: int = 200,
    ) -> "Calibration":
        """Computes the calibration from links that models predicted without knowing them.

        Args:
            task: Task of the labels.
            labels, values: Labels of the links and their predictions.
            deviations: Standard deviations that the model states.
            query: The links.
            near: Distance of each link to the nearest place that its predicting model knows [m];
                None if the model states deviations, which need no groups of distances.
            known: Links that the calibrated model knows.
            new: Receivers of the links if they count as new: all errors at one are then dependent.
            steps: Number of levels whose quantiles are stored. A level between two stored ones
                uses the higher one.
        """
        labels, values, deviations = thinned(task, labels, values, deviations)
        scale = _shaped(deviations, values)  # (n, m)
        errors = (labels - values).abs() / scale  # (n, m)
        exists = ~scale.isnan()  # False at elements that an array lacks
        groups = group_links(query, known, near, errors)
        bins = bin_numbers(values)
        levels = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
        shape = len(groups.counts), len(bins.amplitudes) + 1  # (groups, bins)
        quantiles = errors.new_zeros(*shape, steps + 1, dtype=torch.float64)
        sizes = errors.new_zeros(shape, dtype=torch.float64)
        for group in range(shape[0]):
            for number in range(shape[1]):
                # A bin without pixels in a group uses the errors of all groups. This occurs with
                # receivers in different surroundings.
                in_bin = bins.numbers == number
                inside = in_bin & (groups.numbers == group)[:, None] & exists
                inside = inside if inside.any() else in_bin & exists
                inside = inside if inside.any() else exists
                ordered = errors[inside].double().sort().values
                sizes[group, number] = ordered.square().mean().sqrt()
                if new is None:
                    bounds = link_quantiles(ordered, errors, inside, levels)
                else:
                    bounds = new.quantiles(errors, inside, levels)
                quantiles[group, number] = bounds
        if not groups.edges.shape[1]:
            known = known[:0]
        lowest = torch.tensor(task.lowest, dtype=torch.float64)
        return cls(
            groups.edges,
            bins.amplitudes,
            groups.counts,
            quantiles,
            sizes,
            known.transmitters,
            known.receivers,
            lowest,
        )

    def at_receivers(self, count: int) -> "Calibration | None":
        """The calibration for ``count`` receivers without links; None if there is none."""
        new = self.elsewhere
        return None if new is None else replace(new, widths=torch.ones(count), elsewhere=new)

    def estimate(self, value: Tensor, deviations: Tensor, query: Query, level: float) -> Estimate:
        """The interval of predictions at one level.

        Args:
            value: Predictions (b, *shape).
            deviations: Deviations that the model states (b,) or (b, *shape).
            query: Links of the predictions.
            level: Probability with which an interval holds the label.

        Raises:
            ValueError: A group has too few links for the level, or receivers without links are not
                calibrated.
        """
        return self.estimates(value, deviations, query, [level])[0]

    def estimates(
        self, value: Tensor, deviations: Tensor, query: Query, levels: Sequence[float]
    ) -> list[Estimate]:
        """``estimate`` at several levels, which share the search for the nearest known places."""
        widths = query.receivers.new_zeros(len(query)).to(value.real)
        if self.widths is not None:
            widths = self.widths.to(widths)[query.receivers]  # (b,)
        is_new = widths > 0
        if not is_new.any():
            return self._estimates(value, deviations, query, levels)
        if self.elsewhere is None:
            raise ValueError(
                "no intervals at receivers without links: three receivers with held-out links "
                "calibrate them"
            )
        # Deviations that the model states hold for receivers with links only. Their NaN marks
        # elements that an array lacks.
        usual = _shaped(usual_deviations(value) * widths, value)
        usual = usual.masked_fill(_shaped(deviations, value).isnan(), math.nan)
        at_new = self.elsewhere._estimates(value, usual, query, levels)
        if is_new.all():
            return at_new
        # Only receivers with links have groups. New ones borrow a group; its result is not used.
        receivers = torch.where(is_new, query.receivers[~is_new][0], query.receivers)
        at_known = self._estimates(value, deviations, replace(query, receivers=receivers), levels)

        def choose(new: Tensor | None, known: Tensor | None) -> Tensor | None:
            """Values ``new`` at new receivers, ``known`` at the others; None stays None."""
            if new is None or known is None:
                return None
            mask = is_new.reshape(-1, *[1] * (new.ndim - 1))
            return torch.where(mask, new, known)

        return [Estimate(*map(choose, *pair)) for pair in zip(at_new, at_known, strict=True)]

    def _estimates(
        self, value: Tensor, deviations: Tensor, query: Query, levels: Sequence[float]
    ) -> list[Estimate]:
        """``estimates`` at receivers with links."""
        groups = self._groups_of(query)
        return [self._estimate(value, deviations, groups, level) for level in levels]

    def _estimate(
        self, value: Tensor, deviations: Tensor, groups: Int[Tensor, " b"], level: float
    ) -> Estimate:
        """The interval of predictions; ``groups`` has the number of each link's group."""
        self._check_counts(groups, level)
        # Number of each value's cell (group and amplitude bin) in the flattened quantiles.
        cells = groups.reshape(-1, *[1] * (value.ndim - 1))
        amplitudes = self.amplitudes.to(value.real)
        if len(amplitudes):
            cells = cells * (len(amplitudes) + 1) + torch.bucketize(value.contiguous(), amplitudes)
        scale = _shaped(deviations, value)
        step = math.ceil(level * self.steps - 1e-9)  # of the next stored level
        half_width = scale * self.quantiles[..., step].flatten().to(scale).take(cells)
        std = scale * self.sizes.flatten().to(scale).take(cells)
        if not value.is_complex():
            lower = (value - half_width).clamp_min(self.lowest.item())
            # A model may predict less than the least possible label.
            return Estimate(value, std, torch.minimum(lower, value), value + half_width)
        is_absent = std.isnan()  # elements that an array lacks
        power = value.masked_fill(is_absent, 0).abs().square().flatten(1).sum(1)  # (b,)
        error_power = std.masked_fill(is_absent, 0).abs().square().flatten(1).sum(1)  # (b,)
        snr_db = 10 * (power / error_power).log10()
        return Estimate(value, std, None, None, half_width, snr_db)

    def _groups_of(self, query: Query) -> Int[Tensor, " b"]:
        """Number of each link's group, by receiver and distance."""
        receivers = query.receivers
        rows = receivers if len(self.edges) > 1 else torch.zeros_like(receivers)
        edge_count = self.edges.shape[1]
        groups = rows * (edge_count + 1)
        if edge_count:
            places = self.places.to(query.transmitters)
            near = nearest(query, places, self.receivers.to(receivers))  # (b,) [m]
            groups = groups + torch.searchsorted(self.edges.to(near)[rows], near[:, None])[:, 0]
        return groups

    def _check_counts(self, groups: Int[Tensor, " b"], level: float) -> None:
        """Raises a ``ValueError`` if a link's group is too small for intervals of a level."""
        counts = self.counts.to(groups)[groups]
        needed = fewest(level)
        if len(counts) and (available := int(counts.min())) < needed:
            raise ValueError(
                f"an interval of {100 * level:g} % needs {needed} links to calibrate it, "
                f"the model has {available}\n"
                "ask for a narrower interval, or give more links: to a look-up known ones, "
                "else by split.validation"
            )

    @property
    def steps(self) -> int:
        """Number of the levels of the stored quantiles, without 0."""
        return self.quantiles.shape[-1] - 1

    @property
    def mean_error(self) -> float:
        """Mean absolute error over the deviation that the model states, by the stored quantiles.

        The mean is slightly too large, since quantiles p (n + 1) / n are stored.
        """
        return torch.trapezoid(self.quantiles, dx=1 / self.steps).mean().item()

    def gives(self, level: float) -> bool:
        """True if every group has enough links for intervals of this level."""
        is_new = self.widths is not None and bool((self.widths > 0).any())
        gives_new = not is_new or (self.elsewhere is not None and self.elsewhere.gives(level))
        return gives_new and fewest(level) <= int(self.counts.min())

    def state(self) -> dict[str, Any]:
        """Plain tensors for a checkpoint."""
        state = {}
        for name in self.__dataclass_fields__:
            part = getattr(self, name)
            if part is not None:
                state[name] = part.cpu() if isinstance(part, Tensor) else part.state()
        return state

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "Calibration":
        """The inverse of ``state``."""
        new = state.get("elsewhere")
        return cls(**{**state, "elsewhere": None if new is None else cls.from_state(new)})


class Groups(NamedTuple):
    """Links in groups by receiver and distance."""

    # Distances that separate the groups of a receiver, or of all receivers (r or 1, g - 1) [m].
    edges: Float[Tensor, "r e"]
    numbers: Int[Tensor, " n"]  # group of each link
    counts: Int[Tensor, " g"]  # number of links in each group (groups,)


def group_links(
    query: Query,
    known: Query,
    near: Float[Tensor, " n"] | None,
    errors: Float[Tensor, "n m"],
    enough: int = 100,
    most: int = 4,
) -> Groups:
    """Groups of links, see ``Calibration``.

    Args:
        query, known, near: As for ``Calibration.of``.
        errors: Errors of the links over their deviations.
        enough: Least number of links of a group.
        most: Largest number of groups by distance.
    """
    receivers = query.receivers
    count = int(torch.cat((receivers, known.receivers)).max()) + 1
    links = receivers.bincount(minlength=count)  # (r,)
    # Each receiver is a row of groups, or all receivers together are one row.
    has_rows = links.min() >= enough and count > 1
    rows = receivers if has_rows else torch.zeros_like(receivers)
    apart = torch.zeros(len(rows), dtype=torch.float64)  # distance to the nearest place
    groups = 1
    if near is not None:
        apart = near.clamp_max(FAR)
        groups = max(1, min(most, int(rows.bincount().min()) // enough))
    while True:  # equal distances may leave a group with few links
        levels = torch.arange(1, groups, dtype=torch.float64) / groups
        row_numbers = range(int(rows.max()) + 1)
        row_edges = [apart[rows == row].quantile(levels) for row in row_numbers]
        edges = torch.stack(row_edges)  # (r, groups - 1)
        numbers = rows * groups + torch.searchsorted(edges[rows], apart[:, None])[:, 0]  # (n,)
        counts = numbers.bincount(minlength=len(edges) * groups)
        if groups == 1:
            return Groups(edges, numbers, counts)
        squares = []
        for group in range(len(counts)):
            squares.append(errors[numbers == group].square().nanmean())
        # Distances are useful only if errors rise with them.
        rises = (torch.stack(squares).view(-1, groups).diff() > 0).all()
        if counts.min() >= enough // 2 and rises:
            return Groups(edges, numbers, counts)
        groups -= 1


class Bins(NamedTuple):
    """The bin of each label value, by its predicted amplitude."""

    amplitudes: Float[Tensor, " a"]  # edges of the bins (bins - 1,)
    numbers: Int[Tensor, "n m"]  # bin of each value of each link


def bin_numbers(values: Inexact[Tensor, "n m"], most: int = 8) -> Bins:
    """Bins of predictions by their amplitude, since errors are larger at high amplitudes.

    Scalar labels and channels have one bin. Spectra have ``most`` bins with equal numbers of
    pixels. The number of bins is halved until at least ``fewest(0.9)`` links have pixels in each.
    """
    amplitudes = (values.abs() if values.is_complex() else values).double()  # (n, m)
    sample = amplitudes.flatten()[evenly(torch.arange(amplitudes.numel()), 10**6)]
    is_spectrum = amplitudes.shape[1] > 1 and not values.is_complex()
    count = most if is_spectrum else 1
    while True:
        edges = sample.quantile(torch.arange(1, count, dtype=torch.float64) / count)
        bins = torch.bucketize(amplitudes, edges)  # (n, m)
        links = torch.stack([(bins == number).any(1).sum() for number in range(count)])
        if count == 1 or links.min() >= fewest(0.9):
            return Bins(edges, bins)
        count //= 2


def link_quantiles(
    ordered: Float[Tensor, " k"],
    errors: Float[Tensor, "n m"],
    inside: Bool[Tensor, "n m"],
    levels: Float[Tensor, " q"],
    level: float = 0.9,
) -> Float[Tensor, " q"]:
    """Bounds of a group's errors for intervals of each level, the quantiles p (n + 1) / n.

    Args:
        ordered: Errors of the group's label values, ascending.
        errors: Errors of all label values.
        inside: True for the label values of the group.
        levels: Levels p of the intervals.
        level: Level at which n, the ``effective_count``, is taken for all levels.
    """
    is_held = (errors <= quantile(ordered, levels.new_tensor(level))) & inside
    count = effective_count(is_held.sum(1), inside.sum(1))
    # A new link is one of n + 1 exchangeable ones.
    return quantile(ordered, levels * (1 + 1 / count))


def effective_count(held: Int[Tensor, " n"], counts: Int[Tensor, " n"]) -> float:
    """Number of independent label values that would calibrate an interval as well as n links do.

    Errors of values in one link depend on each other. The result is therefore less than the number
    of all values, and at least about the number of links.

    Args:
        held: Number of each link's values that are within the interval.
        counts: Number of each link's values.
    """
    total = counts.sum().double()
    weights = counts / total  # (n,)
    held_shares = held / total  # (n,)
    share = held_shares.sum().item()
    effective_links = 1 / weights.square().sum().item()  # n if all links have equal counts
    scatter = (held_shares - share * weights).square().sum().item()
    # A share p of n independent numbers has the variance p (1 - p) / n, which is solved for n. The
    # estimate of this variance is the scatter with Bessel's correction, 1 / (1 - 1 / links).
    bessel = 1 - 1 / effective_links
    return max(effective_links, share * (1 - share) * bessel / max(scatter, 1e-12))


def fewest(level: float) -> int:
    """Smallest number of links n that calibrates an interval of level p: p (n + 1) / n <= 1."""
    # 0.9 / (1 - 0.9) is above 9 by rounding.
    return math.ceil(level / (1 - level) - 1e-9)


def usual_deviations(value: Tensor) -> Float[Tensor, " b"]:
    """Deviations for a model that states none: 1, or the root mean square of each channel."""
    if value.is_complex():
        return value.abs().square().flatten(1).mean(1).sqrt()
    return torch.ones(len(value), device=value.device)


def nearest(
    query: Query, places: Float[Tensor, "k 3"], receivers: Int[Tensor, " k"]
) -> Float[Tensor, " b"]:
    """Distance of each link to its receiver's nearest known place [m]; infinite without one."""
    near = torch.full((len(query),), math.inf, dtype=torch.float64, device=places.device)
    for receiver in query.receivers.unique().tolist():
        asked = (query.receivers == receiver).nonzero()[:, 0]
        known = places[receivers == receiver].double()  # (k, 3)
        if len(known):
            near[asked] = nearest_places(query.transmitters[asked], known, 1).apart[:, 0]
    return near


def _shaped(deviations: Tensor, values: Tensor) -> Tensor:
    """Deviations (b,) or (b, *shape) in the shape of the values, each above 0."""
    axes = [1] * (values.ndim - deviations.ndim)
    shaped = deviations.reshape(*deviations.shape, *axes).to(values.real)
    return shaped.clamp_min(torch.finfo(shaped.dtype).tiny).expand(values.shape)


class Thinned(NamedTuple):
    """Labels, predictions and deviations of links, thinned to m values by ``thin_labels``."""

    labels: Inexact[Tensor, "n m"]
    values: Inexact[Tensor, "n m"]
    deviations: Float[Tensor, " n ..."]


def thinned(
    task: Task,
    labels: Inexact[Tensor, " n *shape"],
    values: Inexact[Tensor, " n *shape"],
    deviations: Float[Tensor, " n ..."],
) -> Thinned:
    """Thins labels, predictions and deviations alike; labels are first aligned to predictions.

    Deviations (n,), one for each link, stay as they are.
    """
    if deviations.ndim > 1:
        deviations = thin_labels(deviations)
    # In parts, since an alignment takes several times the memory of the labels.
    aligned = []
    for some_labels, some_values in zip(labels.split(64), values.split(64), strict=True):
        aligned.append(thin_labels(task.align(some_labels, some_values)))
    return Thinned(torch.cat(aligned), thin_labels(values), deviations)
