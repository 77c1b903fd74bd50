"""Levels beyond the logarithm of the distance: a break point, an antenna's lobes, and heights."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gaigs.core.scene import Scene

TERMS = ("break point", "lobes", "height")
"""Terms that ``PathTerms`` may have."""


@dataclass(frozen=True)
class TermOptions:
    """Options of ``PathTerms``.

    Attributes:
        harmonics: Largest harmonic of the azimuth: lobes of 60 degrees and wider, as of sectors.
        breaks: Candidates of a break point, quantiles of a receiver's distances.
        slope: Prior deviation of the change of slope at a break point, over the deviation of the
            levels about their law [1 / decade].
        alike: Readings that count as one: neighbours share their shadows.
        errors: Least fall of the held-out error by a term [standard errors].
        least: Least fall over the error itself: a smaller one is not worth a term.
    """

    harmonics: int = 6
    breaks: int = 15
    slope: float = 5.0
    alike: float = 10.0
    errors: float = 3.0
    least: float = 0.01


class Moments(NamedTuple):
    """Sums over a receiver's readings without each fold, for least squares.

    Attributes:
        squares: Of levels (f,).
        products: Of columns with levels (f, m).
        grams: Of columns with columns (f, m, m).
    """

    squares: Float[Tensor, " f"]
    products: Float[Tensor, "f m"]
    grams: Float[Tensor, "f m m"]


class Solution(NamedTuple):
    """Coefficients without each fold.

    Attributes:
        coefficients: Of the columns with the best break point (f, n).
        variances: Their squared errors over the variance of a reading (f, n).
        numbers: Number of the break point among its candidates (f,).
    """

    coefficients: Float[Tensor, "f n"]
    variances: Float[Tensor, "f n"]
    numbers: Int[Tensor, " f"]


class PathTerms(nn.Module):
    """Corrections of a path-loss law at each receiver, of the terms that held-out readings want.

    With azimuth a and elevation e of the transmitter, seen from the receiver in the world's frame,
    and its height h from -1 to 1 in the box of the links, a level is corrected by

        c0 + c1 log10 d + c2 max(0, log10 d - log10 d0) + sum over q of (a_q cos q a + b_q sin q a)
        + c3 h + c4 sin e + c5 (3 sin² e - 1) / 2.

    The second line's sum are the lobes, the third line is the height. Coefficients have a normal
    prior, that of a lobe falls with its harmonic. Terms are added one by one while they lower the
    error of held-out places clearly; all receivers have the same ones.

    Attributes:
        used: True for terms in use, in the order of ``TERMS`` (3,).
        breaks: Logarithm of the distance d0 of each receiver (r,) [log10 m].
        coefficients: c0, c1, c2, a_q and b_q by harmonic, c3 .. c5 of each receiver (r, n).
        deviations: Standard errors of the coefficients (r, n).
        unseen: What the last choice leaves over of each reading, fitted without its fold; None
            before. Errors of readings that were seen are too small.

    Source: Feuerstein et al., Path loss, delay spread, and outage models as functions of antenna
    height, 1994 (break point); Hoerl and Kennard, Ridge regression, 1970.
    """

    used: Tensor
    breaks: Tensor
    coefficients: Tensor
    deviations: Tensor
    options = TermOptions()
    unseen: Tensor | None = None

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        count = len(scene.receivers)
        columns = 3 + 2 * self.options.harmonics + 3
        self.register_buffer("used", torch.zeros(len(TERMS), dtype=torch.bool))
        self.register_buffer("breaks", torch.zeros(count, dtype=torch.float64))
        zeros = torch.zeros(count, columns, dtype=torch.float64)
        self.register_buffer("coefficients", zeros)
        self.register_buffer("deviations", zeros.clone())

    def forward(
        self, transmitters: Float[Tensor, "b 3"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Corrections in the label's unit."""
        if not self.used.any():
            return transmitters.new_zeros(len(transmitters))
        columns = self._columns(transmitters, receivers, self.breaks[receivers, None])  # (b, n)
        return (columns * self.coefficients[receivers]).sum(1).to(transmitters)

    def fit(
        self,
        transmitters: Float[Tensor, "k 3"],
        receivers: Int[Tensor, " k"],
        errors: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
        chooses: bool = True,
    ) -> str | None:
        """Chooses terms, and fits their coefficients.

        Args:
            transmitters, receivers: Of the known readings.
            errors: Levels less the law.
            folds: Readings are held out with all of their fold.
            chooses: False if the terms stay as they are.

        Returns:
            What was added, with held-out errors, for the log; None: nothing.
        """
        added = None
        if chooses:
            added = self._choose(transmitters, receivers, errors, folds)
        self.coefficients.zero_()
        self.deviations.zero_()
        if not self.used.any():
            return None
        for receiver in receivers.unique().tolist():
            rows = (receivers == receiver).nonzero()[:, 0]
            columns, candidates = self._candidates(transmitters[rows], receivers[rows])
            moments = sums(columns, errors[rows], torch.zeros_like(rows), 0)
            solution = self._solve(moments, self.used)
            self.breaks[receiver] = candidates[solution.numbers[0]]
            self.coefficients[receiver] = solution.coefficients[0]
            noise = errors[rows].square().mean()
            self.deviations[receiver] = (solution.variances[0] * noise).sqrt()
        return added

    def facts(self) -> Mapping[str, object]:
        """Terms in use, and the median distance of the break points [m]."""
        names = [name for name, used in zip(TERMS, self.used.tolist(), strict=True) if used]
        facts: dict[str, object] = {"terms": ", ".join(names) or "none"}
        if self.used[0]:
            facts["break_m"] = 10 ** self.breaks.median().item()
        return facts

    def _choose(
        self,
        transmitters: Float[Tensor, "k 3"],
        receivers: Int[Tensor, " k"],
        errors: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
    ) -> str | None:
        """Adds terms one by one, see the class; returns as ``fit``."""
        self.used.zero_()
        _, places = transmitters.unique(dim=0, return_inverse=True)
        counts = places.bincount()
        # The law was fitted to all readings: an advantage that a term has to make up for.
        least = start = errors.abs()
        self.unseen = errors
        while not self.used.all():
            trials = []
            for number in (~self.used).nonzero()[:, 0].tolist():
                used = self.used.index_fill(0, torch.tensor(number), True)
                trials.append((self._held_out(transmitters, receivers, errors, folds, used), used))
            left, used = min(trials, key=lambda trial: trial[0].abs().mean().item())
            best = left.abs()
            # Readings at one place err together: their mean counts.
            falls = torch.zeros(len(counts)).double().index_add(0, places, least - best) / counts
            chance = falls.std() / len(counts) ** 0.5 if len(counts) > 1 else torch.inf
            fall = (least - best).mean()
            is_clear = falls.mean() > self.options.errors * chance
            if not is_clear or fall < self.options.least * least.mean():
                break
            self.used.copy_(used)
            least, self.unseen = best, left
        if not self.used.any():
            return None
        return f"{self.facts()['terms']}; held-out error {start.mean():.2f} -> {least.mean():.2f}"

    def _held_out(
        self,
        transmitters: Float[Tensor, "k 3"],
        receivers: Int[Tensor, " k"],
        errors: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
        used: Bool[Tensor, " t"],
    ) -> Float[Tensor, " k"]:
        """Errors that terms leave over, fitted without the reading's fold."""
        left = torch.zeros_like(errors)
        for receiver in receivers.unique().tolist():
            rows = (receivers == receiver).nonzero()[:, 0]
            columns, candidates = self._candidates(transmitters[rows], receivers[rows])
            _, fold = folds[rows].unique(return_inverse=True)
            moments = sums(columns, errors[rows], fold, int(fold.max()) + 1)
            solution = self._solve(moments, used)
            shown = self._shown(len(candidates), solution.numbers[fold])  # (k, n)
            corrections = (columns.gather(1, shown) * solution.coefficients[fold]).sum(1)
            left[rows] = errors[rows] - corrections
        return left

    def _solve(self, moments: Moments, used: Bool[Tensor, " t"]) -> Solution:
        """Most likely coefficients of the used terms, with the break point of the least cost."""
        harmonics, alike = self.options.harmonics, self.options.alike
        orders = torch.arange(1, harmonics + 1).double().repeat_interleave(2)
        # Precisions of the prior, in units of a reading's; level and slope are nearly free.
        free = orders.new_tensor([1e-3, 1e-3, alike / self.options.slope**2])
        prior = torch.cat((free, alike * orders.square(), alike * orders.new_ones(3)))
        widths = torch.tensor([1, 2 * harmonics, 3])
        is_used = torch.cat((torch.ones(2, dtype=torch.bool), used.repeat_interleave(widths)))
        kept = is_used.nonzero()[:, 0]
        count = moments.products.shape[1] - len(prior) + 1
        trials = []
        for number in range(count if used[0] else 1):
            shown = self._shown(count, torch.tensor([number]))[0, kept]
            gram = moments.grams[:, shown][:, :, shown] + prior[kept].diag()  # (f, p, p)
            inverse = torch.linalg.inv(gram)
            solved = (inverse @ moments.products[:, shown, None])[..., 0]  # (f, p)
            costs = moments.squares - (solved * moments.products[:, shown]).sum(1)
            trials.append((costs, solved, inverse.diagonal(dim1=1, dim2=2)))
        numbers = torch.stack([trial[0] for trial in trials]).argmin(0)  # (f,)
        folds = torch.arange(len(numbers))
        parts = []
        for part in (1, 2):
            best = torch.stack([trial[part] for trial in trials])[numbers, folds]  # (f, p)
            parts.append(best.new_zeros(len(best), len(prior)).index_copy(1, kept, best))
        return Solution(parts[0], alike * parts[1], numbers)

    def _shown(self, count: int, numbers: Int[Tensor, " f"]) -> Int[Tensor, "f n"]:
        """Columns of ``_candidates`` with one break point each."""
        rest = torch.arange(2 * self.options.harmonics + 3) + 2 + count
        first = torch.arange(2).expand(len(numbers), 2)
        return torch.cat((first, 2 + numbers[:, None], rest.expand(len(numbers), -1)), 1)

    def _candidates(
        self, transmitters: Float[Tensor, "k 3"], receivers: Int[Tensor, " k"]
    ) -> tuple[Float[Tensor, "k m"], Float[Tensor, " j"]]:
        """Columns with all candidates of the break point of one receiver, and these candidates."""
        decades = self._columns(transmitters, receivers, self.breaks[:0].expand(len(receivers), 0))
        shares = torch.linspace(0.05, 0.95, self.options.breaks).double()
        candidates = decades[:, 1].quantile(shares)
        return self._columns(transmitters, receivers, candidates.expand(len(receivers), -1)), (
            candidates
        )

    def _columns(
        self,
        transmitters: Float[Tensor, "b 3"],
        receivers: Int[Tensor, " b"],
        breaks: Float[Tensor, "b j"],
    ) -> Float[Tensor, "b m"]:
        """What coefficients multiply: 1, decades, decades beyond each break, lobes, heights."""
        positions = self.scene.positions(transmitters)[receivers]
        steps = (transmitters - positions).double()  # (b, 3)
        # As of the law, distances below 0.1 m count as 0.1 m.
        lengths = steps.norm(dim=1).clamp_min(0.1)
        decades = lengths.log10()[:, None]
        orders = torch.arange(1, self.options.harmonics + 1).to(steps)
        turns = torch.atan2(steps[:, 1], steps[:, 0])[:, None] * orders  # (b, harmonics)
        lobes = torch.stack((turns.cos(), turns.sin()), 2).flatten(1)
        # Heights end with the box: a law of them is not known beyond.
        low, high = self.scene.lower[2].to(steps), self.scene.upper[2].to(steps)
        height = transmitters[:, 2].to(steps).clamp(low, high) - (low + high) / 2
        height = height / ((high - low) / 2).clamp_min(1e-3)
        sine = steps[:, 2] / lengths
        heights = torch.stack((height, sine, (3 * sine.square() - 1) / 2), 1)
        beyond = (decades - breaks).clamp_min(0)
        return torch.cat((torch.ones_like(decades), decades, beyond, lobes, heights), 1)


def sums(
    columns: Float[Tensor, "k m"], levels: Float[Tensor, " k"], folds: Int[Tensor, " k"], count: int
) -> Moments:
    """Sums over all readings but those of each of ``count`` folds; over all if it is 0."""
    parts = []
    for fold in range(max(1, count)):
        rows = folds != fold if count else slice(None)
        part, known = columns[rows], levels[rows]
        parts.append((known.square().sum(), known @ part, part.T @ part))
    return Moments(*(torch.stack(part) for part in zip(*parts, strict=True)))
