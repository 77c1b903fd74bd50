"""Terms of path loss beside the logarithm of the distance: break point, antenna lobes, height."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.links import folds_of
from gaigs.processes import torch_threads

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TermOptions:
    """Options of ``PathTerms``."""

    names: tuple[str, ...] = ("break point", "lobes", "height")  # of the terms
    # Largest harmonic of the azimuth: lobes of 60 degrees and wider, as sector antennas have.
    harmonics: int = 6
    breaks: int = 15  # number of break points tried, at quantiles of a receiver's distances
    # Prior deviation of the change of slope at a break point, over the deviation of the levels
    # about their law [1 / decade].
    slope: float = 5.0
    alike: float = 10.0  # number of readings that count as one, since neighbours share shadows
    errors: float = 3.0  # least fall of the held-out error by a term [standard errors]
    least: float = 0.01  # least fall over the error itself: a smaller one is not worth a term


class Solution(NamedTuple):
    """Coefficients of n terms, fitted once for each fold from the readings outside of it.

    Attributes:
        coefficients: Coefficients from the readings outside of each fold.
        variances: Squared standard errors of the coefficients over the variance of a reading.
        numbers: Index of the break point chosen for each fold, among the candidates.
    """

    coefficients: Float[Tensor, "f n"]
    variances: Float[Tensor, "f n"]
    numbers: Int[Tensor, " f"]


class PathTerms(nn.Module):
    """Corrections of a path-loss law at each receiver, by terms that lower held-out errors.

    With azimuth a and elevation e of the transmitter, seen from the receiver in the world's frame,
    and its height h from -1 to 1 in the box of the links, a level at distance d is corrected by

        c0 + c1 log10 d + sum over q of (a_q cos q a + b_q sin q a)
        + c2 h + c3 sin e + c4 (3 sin² e - 1) / 2 + c5 max(0, log10 d - log10 d0).

    d0 is the break point. Coefficients have a normal prior, whose deviation falls with the harmonic
    q of a lobe. Terms (lobes, height, break point) are added one by one, at all receivers.

    Source: Feuerstein et al., Path loss, delay spread, and outage models as functions of antenna
    height, 1994 (break point); Hoerl and Kennard, Ridge regression, 1970.
    """

    used: Tensor  # True for terms in use, in the order of ``options.names`` (3,)
    breaks: Tensor  # log10 of the distance d0 of each receiver (r,)
    regions: Tensor  # standard deviation of each receiver's position (r,) [m], as in ``path_loss``
    # c0, c1, a_1, b_1, a_2 .. c5 of each receiver (r, n).
    coefficients: Tensor
    deviations: Tensor  # their standard errors (r, n)
    # Errors of the links of ``fit``, with terms fitted without each link's fold (n,); None before.
    unseen: Tensor | None = None
    added: str | None = None  # terms that ``fit`` added, with held-out errors; None: no term
    options = TermOptions()
    of_receivers = ("breaks", "coefficients", "deviations")

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        self.register_buffer("used", torch.zeros(3, dtype=torch.bool))
        breaks = torch.zeros(scene.radios, dtype=torch.float64)
        self.register_buffer("breaks", breaks)
        self.register_buffer("regions", breaks.new_zeros(len(scene.receivers)))
        for name in ("coefficients", "deviations"):
            self.register_buffer(
                name, breaks.new_zeros(len(breaks), self.options.harmonics * 2 + 6)
            )

    def forward(
        self, transmitters: Float[Tensor, "b 3"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Corrections in the label's unit."""
        radios = self.scene.radio_of(receivers)
        columns = self._columns(transmitters, receivers, self.breaks[radios, None])  # (b, n)
        return (columns * self.coefficients[radios]).sum(1).to(transmitters)

    @torch_threads(1)  # more take longer for small matrices
    def fit(self, links: Links, errors: Float[Tensor, " k"], chooses: bool) -> None:
        """Fits the coefficients to ``errors``, the residuals of a path-loss law at known links.

        With ``chooses`` the terms are chosen first. A receiver without links gets the means of the
        other receivers' coefficients.
        """
        if links.uncertainties is not None:
            self.regions.copy_(links.uncertainties)
        index = links.split.known
        query = links.query[index]
        transmitters, receivers = query.transmitters, query.receivers
        if chooses:
            self._choose(transmitters, receivers, errors, folds_of(links, index))
            self.unseen = errors.new_zeros(len(links)).index_copy(0, index, self.unseen)
        radios = self.scene.radio_of(receivers)
        for radio in radios.unique().tolist():
            rows = radios == radio
            columns, candidates = self._candidates(transmitters[rows], receivers[rows])
            single_fold = 0 * radios[rows]
            solution = self._solve(columns, errors[rows], single_fold, self.used)
            self.breaks[radio] = candidates[solution.numbers[0]]
            self.coefficients[radio] = solution.coefficients[0] * self.used.any()
            variances = solution.variances[0] * errors[rows].square().mean()
            self.deviations[radio] = variances.sqrt()
        has_no_links = radios.bincount(minlength=len(self.breaks)) == 0
        for values in (self.breaks, self.coefficients, self.deviations):
            values[has_no_links] = values[~has_no_links].mean(0)

    def take_receivers(self, scene: Scene, known: Tensor | None = None) -> None:
        """Replaces the receivers by new ones, whose places are known exactly."""
        self.regions = self.regions.new_zeros(len(scene.receivers))

    def facts(self) -> Mapping[str, object]:
        """Terms in use, and the median distance of the break points [m]."""
        pairs = zip(self.options.names, self.used.tolist(), strict=True)
        terms = ", ".join(name for name, used in pairs if used)
        facts: dict[str, object] = {"terms": terms or "none"}
        return facts | ({"break_m": 10 ** self.breaks.median().item()} if self.used[0] else {})

    def _choose(
        self,
        transmitters: Float[Tensor, "k 3"],
        receivers: Int[Tensor, " k"],
        errors: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
    ) -> None:
        """Adds terms one by one, while the error of held-out places falls significantly."""
        self.used.zero_()
        self.added = None
        _, places, counts = transmitters.unique(dim=0, return_inverse=True, return_counts=True)
        # The law was fitted to all readings: an advantage that terms have to make up for.
        self.unseen = errors
        while not self.used.all():
            trials = []
            for number in (~self.used).nonzero()[:, 0].tolist():
                used = self.used.index_fill(0, torch.tensor(number), True)
                trials.append((self._held_out(transmitters, receivers, errors, folds, used), used))
            held_out, used = min(trials, key=lambda trial: trial[0].abs().mean().item())
            falls = self.unseen.abs() - held_out.abs()
            # Errors of readings at one place are similar, so each place counts by its mean.
            place_falls = falls.new_zeros(len(counts)).index_add(0, places, falls) / counts
            standard_error = place_falls.std() / len(counts) ** 0.5
            is_clear = place_falls.mean() > self.options.errors * standard_error
            if not is_clear or falls.mean() < self.options.least * self.unseen.abs().mean():
                return
            self.used.copy_(used)
            self.unseen = held_out
            change = f"{errors.abs().mean():.2f} -> {held_out.abs().mean():.2f}"
            self.added = f"{self.facts()['terms']}; held-out error {change}"

    def _held_out(
        self,
        transmitters: Float[Tensor, "k 3"],
        receivers: Int[Tensor, " k"],
        errors: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
        used: Bool[Tensor, " t"],
    ) -> Float[Tensor, " k"]:
        """Errors of readings after correction by terms that were fitted without their fold."""
        corrected = errors.clone()
        radios = self.scene.radio_of(receivers)
        for radio in radios.unique().tolist():
            rows = radios == radio
            columns, _ = self._candidates(transmitters[rows], receivers[rows])  # (k, m)
            _, fold = folds[rows].unique(return_inverse=True)  # numbered from 0 (k,)
            if not fold.any():
                continue  # a single fold has no other readings
            solution = self._solve(columns, errors[rows], fold, used)
            chosen = self._columns_with_break(solution.numbers[fold])  # (k, n)
            corrections = columns.gather(1, chosen) * solution.coefficients[fold]  # (k, n)
            corrected[rows] -= corrections.sum(1)
        return corrected

    def _solve(
        self,
        columns: Float[Tensor, "k m"],
        levels: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
        used: Bool[Tensor, " t"],
    ) -> Solution:
        """Coefficients fitted to the readings outside of each fold, at the best break point.

        A single fold is fitted to its own readings.

        Args:
            columns: Factors of the coefficients, with all candidate break points.
            levels: Levels to which terms are fitted.
            folds: Fold of each reading, from 0.
            used: True for the terms in use.
        """
        # Normal equations of ridge regression: (X'X + P) c = X'y, from sums over readings.
        both = torch.cat((columns, levels[:, None]), 1)  # X and y (k, m + 1)
        parts = [both[folds == fold] for fold in range(int(folds.max()) + 1)]
        grams = torch.stack([part.T @ part for part in parts])  # (f, m + 1, m + 1), of each fold
        sums = grams.sum(0) - grams if len(grams) > 1 else grams  # of all other folds
        options = self.options
        orders = torch.arange(1, options.harmonics + 1).double().repeat_interleave(2)
        # Precisions P of the prior, in units of a reading's; level and slope are nearly free.
        free = orders.new_full((2,), 1e-3)
        of_lobes = options.alike * orders.square()
        of_heights = orders.new_full((3,), options.alike)
        of_break = of_heights[:1] / options.slope**2
        prior = torch.cat((free, of_lobes, of_heights, of_break))  # (n,)
        # ``used`` has the break point first, the columns have it last.
        widths = torch.tensor([len(orders), 3, 1])
        is_used = torch.cat((used.new_ones(2), used[[1, 2, 0]].repeat_interleave(widths)))
        kept = is_used.nonzero()[:, 0]  # (p,)
        trials = []
        for number in range(options.breaks if used[0] else 1):
            chosen = self._columns_with_break(torch.tensor([number]))[0, kept]
            products = sums[:, chosen, -1]  # X'y (f, p)
            gram = sums[:, chosen][:, :, chosen] + prior[kept].diag()  # (f, p, p)
            inverse = torch.linalg.inv(gram)
            solved = (inverse @ products[..., None])[..., 0]  # c (f, p)
            explained = (solved * products).sum(1)  # fall of the squared errors (f,)
            trials.append((explained, solved, inverse.diagonal(dim1=1, dim2=2)))
        explained, solved, variances = (torch.stack(part) for part in zip(*trials, strict=True))
        numbers = explained.argmax(0)  # of the best break point for each fold (f,)
        each_fold = torch.arange(len(numbers))
        zeros = solved.new_zeros(len(numbers), len(prior))
        coefficients = zeros.index_copy(1, kept, solved[numbers, each_fold])
        errors = zeros.index_copy(1, kept, options.alike * variances[numbers, each_fold])
        return Solution(coefficients, errors, numbers)

    def _columns_with_break(self, numbers: Int[Tensor, " f"]) -> Int[Tensor, "f n"]:
        """Indices of the columns of ``_candidates`` that remain with each of some break points.

        Columns of the break points follow all others, and one of them remains.
        """
        others = torch.arange(self.coefficients.shape[1] - 1).expand(len(numbers), -1)  # (f, n - 1)
        of_break = others[:, -1:] + 1 + numbers[:, None]
        return torch.cat((others, of_break), 1)

    def _candidates(
        self, transmitters: Float[Tensor, "k 3"], receivers: Int[Tensor, " k"]
    ) -> tuple[Float[Tensor, "k m"], Float[Tensor, " j"]]:
        """``_columns`` with all break points tried at one receiver, and these break points."""
        no_breaks = self.breaks.new_zeros(len(receivers), 0)
        decades = self._columns(transmitters, receivers, no_breaks)[:, 1]
        shares = torch.linspace(0.05, 0.95, self.options.breaks).double()
        candidates = decades.quantile(shares)
        breaks = candidates.expand(len(receivers), -1)  # (k, j)
        return self._columns(transmitters, receivers, breaks), candidates

    def _columns(
        self,
        transmitters: Float[Tensor, "b 3"],
        receivers: Int[Tensor, " b"],
        breaks: Float[Tensor, "b j"],
    ) -> Float[Tensor, "b m"]:
        """Factors of coefficients: 1, decades, lobes, heights, decades beyond each break point.

        ``breaks`` has the break points of each link [log10 of a distance in m].
        """
        positions = self.scene.positions(transmitters)[receivers]
        ways = (transmitters - positions).double()  # (b, 3)
        # As in ``path_loss``: the region of an estimated position, and at least 0.1 m.
        regions = 0.56 * self.regions[receivers].square()
        lengths = (ways.square().sum(1) + regions).sqrt().clamp_min(0.1)
        decades = lengths.log10()[:, None]
        orders = torch.arange(1, self.options.harmonics + 1).to(ways)
        turns = torch.atan2(ways[:, 1], ways[:, 0])[:, None] * orders  # (b, harmonics)
        lobes = torch.stack((turns.cos(), turns.sin()), 2).flatten(1)  # (b, 2 harmonics)
        # Heights are limited to the box of the links, where they were fitted.
        low, high = self.scene.lower[2].to(ways), self.scene.upper[2].to(ways)
        height = transmitters[:, 2].to(ways).clamp(low, high) - (low + high) / 2
        height = height / ((high - low) / 2).clamp_min(1e-3)
        sine = ways[:, 2] / lengths
        heights = torch.stack((height, sine, (3 * sine.square() - 1) / 2), 1)
        beyond = (decades - breaks).clamp_min(0)  # (b, j)
        return torch.cat((torch.ones_like(decades), decades, lobes, heights, beyond), 1)


def report_terms(trend: nn.Module) -> None:
    """Logs the terms that the ``PathTerms`` of a trend have added, if any."""
    terms = getattr(trend, "terms", None)
    if isinstance(terms, PathTerms) and terms.added:
        log.info("trend beyond path loss: %s %s", terms.added, terms.scene.task.error_unit)
