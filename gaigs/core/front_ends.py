"""Front ends: a receiver's factor for each element and subcarrier, the same in all its links."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from gaigs.core.phases import alignment
from gaigs.core.propagation import fit_gain
from gaigs.core.query import evenly


class Shape(NamedTuple):
    """Number of degrees of freedom of a response over elements and over subcarriers."""

    count: int  # free numbers over the band
    # True if elements share these numbers, up to a complex gain of each; False if each has its own.
    is_separable: bool

    def __str__(self) -> str:
        over = "common to" if self.is_separable else "of each of"
        return f"{self.count} numbers over the band {over} the elements"


class FrontEnd(NamedTuple):
    """The response of a receiver's front end."""

    # Factor of each element and subcarrier, of mean power 1. The common phase of all factors is
    # arbitrary. If delays of links are unknown, the common delay is arbitrary, too.
    response: Complex[Tensor, "e s"]
    # Standard deviation of each complex factor, by the scatter of the links.
    errors: Float[Tensor, "e s"]
    explained: float  # mean share of a link's power that response and direct wave explain


class Chosen(NamedTuple):
    """A front end with its shape, and its effect on free space at places left out of the fit.

    Scores are the task's monitored ones, averaged over places.
    """

    front_end: FrontEnd
    shape: Shape
    before: float  # score without the front end
    after: float  # score with it


@dataclass(frozen=True)
class FrontEndOptions:
    """Conditions under which a receiver gets a response."""

    fewest_places: int = 12  # at fewer places reflections do not average out
    # Least gain of free space's mean score at places left out [dB]; without a front end it is
    # within 0.02 dB in the built-in room.
    least_gain: float = 0.2
    deviations: float = 2.0  # least gain in its standard errors
    counts: tuple[int, ...] = (1, 2, 4, 8, 16, 32)  # numbers over the band to choose from
    folds: int = 4  # parts of the places, each left out once
    floor: float = 1e-3  # least error of a link relative to its power, so that none decides alone
    rounds: int = 6  # turns of alignment and mean; the first ones suffice but for strong ripples
    # Numbers of the links that choose, and of those that are fitted.
    most: tuple[int, int] = (2**17, 2**23)


class FrontEndFit:
    """Fit of a front end's response to the links of one receiver.

    A link is h = g R w exp(j (phi + 2 pi f tau)) + error. R is the response, w the direct wave, and
    g a positive gain. The phase phi and the delay tau are 0 if the task's phase is known.
    Reflections are part of the error; their mean over places vanishes.

    The likelihood is maximised in turns. The first turn fits phi, tau and g of each link. The
    second turn fits R as the mean of h / w, with links weighted by their inverse errors.

    Args:
        labels: Channels of the links.
        waves: ``direct_waves`` of the same links.
        task: The task of the labels, a ``gaigs.core.task.csi.Csi``.

    Source: ours; the turns are by Gerchberg and Saxton (1972), for unknown phases.
    """

    def __init__(
        self,
        labels: Complex[Tensor, "n e s"],
        waves: Complex[Tensor, "n e s"],
        task: Any,
        options: FrontEndOptions,
    ):
        self.labels = _unit(labels)
        self.waves = _unit(waves)
        self.task = task
        self.options = options

    def at(self, index: Int[Tensor, " k"]) -> "FrontEndFit":
        """The fit to the links of ``index`` alone."""
        return FrontEndFit(self.labels[index], self.waves[index], self.task, self.options)

    def start(self, shape: Shape) -> FrontEnd:
        """The front end that explains most of several fits with different starts.

        With known phases the only start is the mean of the labels relative to direct waves. With
        unknown phases such a mean vanishes, and the starts are 1 and four single links.
        """
        strengths = self.waves.abs()
        relative = self.labels * self.waves.conj() / torch.where(strengths > 0, strengths, 1)
        starts = [relative.mean(0)]  # (e, s)
        if self.task.phase != "known":
            single = evenly(torch.arange(len(relative)), 4)
            starts = [torch.ones_like(starts[0]), *relative[single]]
        front_ends = [self.run(shape, start) for start in starts]
        return max(front_ends, key=lambda front_end: front_end.explained)

    def run(self, shape: Shape, response: Complex[Tensor, "e s"]) -> FrontEnd:
        """The front end after turns of alignment and weighted mean, starting at ``response``."""
        response = self._normal(self._smooth(response, shape))
        for _ in range(self.options.rounds):
            model = response * self.waves  # (n, e, s)
            aligned = _unit(self.task.align(self.labels, model))
            sizes = model.abs().square().sum((1, 2))  # (n,)
            products = (model.conj() * aligned).sum((1, 2)).real  # (n,)
            gains = (products / sizes.clamp_min(1e-30)).clamp_min(0)
            residuals = aligned - gains[:, None, None] * model  # (n, e, s)
            errors = residuals.abs().square().sum((1, 2))  # (n,)
            weights = (gains / errors.clamp_min(self.options.floor))[:, None, None]
            # R of least squares: sum v h conj(w) / sum v g |w|², with the weights v = g / |error|².
            power = (weights * gains[:, None, None] * self.waves.abs().square()).sum(0)  # (e, s)
            scale = torch.where(power > 0, power, 1)
            ratio = (weights * aligned * self.waves.conj()).sum(0) / scale  # (e, s)
            ratio = torch.where(power > 0, ratio, 1)
            response = self._normal(self._smooth(ratio, shape))
        # The sandwich estimator: each link's residual as it enters R, smoothed like R.
        parts = weights * residuals * self.waves.conj() / scale  # (n, e, s)
        basis = self._basis(ratio, shape.count)
        smooth_parts = parts @ basis.conj() @ basis.mT
        scatter = smooth_parts.abs().square().sum(0).sqrt()  # (e, s)
        return FrontEnd(response, scatter, (1 - errors).mean().item())

    def likeness(self) -> float:
        """Fraction of the power of at most 64 links that a response of many numbers explains."""
        thinned = self.at(evenly(torch.arange(len(self.labels)), 64))
        return thinned.start(Shape(max(self.options.counts), True)).explained

    def choose(self, places: Int[Tensor, " n"]) -> Chosen | None:
        """The front end of the shape with the best score at places left out of its fit.

        ``places`` are the numbers of the links' places. The result is None if every shape gains
        less than ``least_gain`` over free space.
        """
        options = self.options
        has_array = self.labels.shape[1] > 1
        subcarriers = self.labels.shape[2]
        # No more numbers over the band than subcarriers.
        counts = sorted({min(count, subcarriers) for count in options.counts})
        shapes = [Shape(count, True) for count in counts]
        if has_array:
            shapes += [Shape(count, False) for count in counts]
        choosing = evenly(torch.arange(len(self.labels)), self._most(options.most[0]))
        chooser = self.at(choosing)
        places = places[choosing]
        start = chooser.start(Shape(counts[-1], True)).response
        free_space = chooser.left_out(places, None, start)  # scores of the places
        best = None
        # The largest shapes first: where the first two (for an array three) do not gain, the others
        # need no look.
        for number, shape in enumerate(sorted(shapes, key=lambda shape: -shape.count)):
            scores = chooser.left_out(places, shape, start)
            gains = scores - free_space
            standard_error = gains.std() / math.sqrt(len(gains))
            if gains.mean() > max(options.least_gain, options.deviations * standard_error):
                if best is None or scores.mean() > best[0]:
                    best = scores.mean().item(), shape
            elif number == 1 + has_array and best is None:
                return None
        if best is None:
            return None
        after, shape = best
        fitting = evenly(torch.arange(len(self.labels)), self._most(options.most[1]))
        front_end = self.at(fitting).run(shape, start)
        return Chosen(front_end, shape, free_space.mean().item(), after)

    def left_out(
        self, places: Int[Tensor, " n"], shape: Shape | None, start: Complex[Tensor, "e s"]
    ) -> Float[Tensor, " p"]:
        """Mean score at each of p places of free space times a response of this shape.

        The response is fitted to links in other folds of places. Without a shape the response is 1.

        Args:
            places: Number of each link's place.
            shape: Shape of the response.
            start: Response at the start of each fit.
        """
        distinct, number = places.unique(return_inverse=True)
        order = torch.randperm(len(distinct), generator=torch.Generator().manual_seed(0))
        fold = order[number] % self.options.folds  # (n,)
        scores = self.labels.new_zeros(len(places)).real
        for tested_fold in range(self.options.folds):
            tested = (fold == tested_fold).nonzero()[:, 0]
            fitted = self.at((fold != tested_fold).nonzero()[:, 0])
            response = torch.ones_like(start)
            if shape is not None:
                response = fitted.run(shape, start).response
            gain = fit_gain(fitted.labels, response * fitted.waves)
            values = gain * response * self.waves[tested]
            # The task has the elements of the largest array; smaller arrays have zeros.
            padding = (0, 0, 0, self.task.elements - values.shape[1])
            labels = torch.nn.functional.pad(self.labels[tested], padding)
            values = torch.nn.functional.pad(values, padding)
            scores[tested] = self.task.scores(labels, values)[self.task.monitor]
        totals = scores.new_zeros(len(distinct)).index_add(0, number, scores)
        return totals / number.bincount()

    def _most(self, numbers: int) -> int:
        """Number of links that together have ``numbers`` channel values; at least 64."""
        return max(64, numbers // self.labels[0].numel())

    def _smooth(self, response: Complex[Tensor, "e s"], shape: Shape) -> Complex[Tensor, "e s"]:
        """The response of this shape that is nearest to ``response``."""
        basis = self._basis(response, shape.count)
        smooth = response @ basis.conj() @ basis.mT  # projection on the basis
        if shape.is_separable and len(response) > 1:
            # The nearest product of a gain of each element and one function of frequency.
            left, sizes, right = torch.linalg.svd(smooth, full_matrices=False)
            smooth = sizes[0] * left[:, :1] * right[:1]
        return smooth

    def _basis(self, response: Complex[Tensor, "e s"], count: int) -> Complex[Tensor, "s k"]:
        """``count`` orthonormal polynomials over the band, times the common delay of a response.

        The polynomials describe a smooth response only after its delay is removed.
        """
        frequencies = self.task.frequencies
        basis = _polynomials(frequencies, count).to(response)
        if len(frequencies) > count:  # otherwise the basis is complete without the delay
            turns = alignment(response, torch.ones_like(response), frequencies)  # (1, s)
            basis = turns.conj().mT * basis
        return basis

    def _normal(self, response: Complex[Tensor, "e s"]) -> Complex[Tensor, "e s"]:
        """The response scaled to a mean power of 1; without its delay if delays are unknown."""
        if self.task.phase == "per_link_and_delay":
            ones = torch.ones_like(response)
            response = response * alignment(response, ones, self.task.frequencies)
        return response / response.abs().square().mean().sqrt().clamp_min(1e-30)


def _polynomials(frequencies: Float[Tensor, " s"], count: int) -> Float[Tensor, "s k"]:
    """Orthonormal polynomials of degrees 0 to ``count`` - 1 over the band.

    A QR decomposition makes Chebyshev polynomials, cos(n arccos x), orthonormal at the subcarriers.
    """
    middle = (frequencies.min() + frequencies.max()) / 2
    half = (frequencies.max() - middle).clamp_min(1)
    angles = ((frequencies - middle) / half).clamp(-1, 1).acos()
    return torch.linalg.qr((angles[:, None] * torch.arange(count)).cos()).Q


def _unit(channels: Complex[Tensor, "n e s"]) -> Complex[Tensor, "n e s"]:
    """Channels of total power 1 in complex128; zeros stay 0."""
    wide = channels.to(torch.complex128)
    sizes = wide.flatten(1).norm(dim=1)[:, None, None]
    return wide / torch.where(sizes > 0, sizes, 1)
