"""Gaussian processes of scalar labels, one for each receiver, with normal or Student's t noise."""

import hashlib
import math
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.core.scene import Scene
from gaigs.kriging.kernel import SMOOTHNESSES, Process, matern, resize
from gaigs.kriging.likelihood import (
    Choice,
    Conditional,
    conditional,
    covariances,
    expected_factors,
    log_density,
)
from gaigs.kriging.links import distances, scaled
from gaigs.kriging.local_mixture import LocalMixtures
from gaigs.kriging.neighbours import HeldOutReadings, Nearest, Readings
from gaigs.kriging.scalar_fit import HeldOutCost, ScalarFit, ScalarOptions, maximise
from gaigs.kriging.tiles import Merged, Tiles, merged
from gaigs.processes import in_threads


class ScalarProcess(nn.Module):
    """Residuals y = z + noise of a trend; z is a Gaussian process over places at each receiver.

    Each receiver has three hyperparameters: a correlation length [m], and standard deviations of z
    and of the noise in the label's unit. Their logarithms scatter about common means as Student's
    t, since one receiver may be far noisier than the others. All receivers share the kernel
    (Matern-1/2 or -3/2) and the kind of noise (normal, or Student's t). All hyperparameters
    maximise the likelihood of held-out readings, each given the readings around it.

    Student's t is a normal distribution whose variance is random. Expectation and maximisation give
    each reading its own noise variance. So a reading that disagrees with those around it has little
    weight.

    Length and noise may also differ from place to place, see ``LocalMixture``. This is chosen if
    held-out readings are significantly likelier; then ``weights`` are not used.

    Attributes:
        options: Options of the fit and of predictions.
        logarithms: Logarithms of length, deviation of the signal and of the noise at each receiver
            (r, 3).
        choice: The fields of ``Choice`` as numbers (4,).
        places: Places of the known readings (k, d), see ``coordinates`` of scale 1.
        receivers, values: Receivers and residuals of the known readings (k,).
        variances: Variance of the noise of each known reading (k,).
        weights: Inverse covariance matrix of a receiver's readings times their values (k,). They
            are 0 at receivers with ``tiles``, and at all but the first of merged readings.
        tiles: Parts of the readings of receivers with more places than ``options.together``.
        asked: Rows of the readings that the last ``fit`` held out.
        is_solved: False after a lazy ``solve``, until ``weights`` are computed.
        kept: Means and variances of local mixtures, by a digest of their places and receivers.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2 and
    5.4.2; Lange, Little and Taylor, Robust statistical modeling using the t distribution, 1989.
    """

    options = ScalarOptions()
    is_solved = True
    logarithms: Tensor
    choice: Tensor
    places: Tensor
    receivers: Tensor
    values: Tensor
    variances: Tensor
    weights: Tensor

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        empty = torch.zeros(0, dtype=torch.float64)
        self.register_buffer("logarithms", empty.new_zeros(scene.radios, 3))
        self.register_buffer("choice", empty.new_tensor(Choice()))
        self.register_buffer("places", empty.new_zeros(0, 3 + scene.has_band + 3 * scene.one_radio))
        self.register_buffer("receivers", empty.long())
        for name in ("values", "variances", "weights"):
            self.register_buffer(name, empty.clone())
        self.tiles = Tiles()
        self.asked = empty.long()
        self.kept: dict[bytes, tuple[Tensor, Tensor]] = {}

    # --- predictions ---

    def forward(
        self, places: Float[Tensor, "b d"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Mean of z at b places."""
        if self._choice.is_local:
            return self._moments(places, receivers, is_asked=True)[0]
        if not self.is_solved:
            if len(places) * self.options.few < len(self.places):

                def near_means(part: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
                    return self._near(places[part], receivers[part], self.options.local).means

                parts = torch.arange(len(places)).split(self.options.size // 4)
                return torch.cat(in_threads(near_means, parts))
            self._solve()
        means = places.new_zeros(len(places))
        scale = self._choice.scale
        all_places = scaled(self.places, scale)
        last: tuple[Tensor, Tensor, Tensor] | None = None
        for receiver in receivers.unique().tolist():
            asked, known = receivers == receiver, self.receivers == receiver
            of_receiver = partial(self._covariances, receiver=receiver)
            tiles = self.tiles.numbers(scaled(places[asked], scale), all_places, known)
            if len(tiles):
                solve = partial(self._solved, receiver=receiver)
                means[asked] = self.tiles.mean(
                    places[asked], tiles, self.places, of_receiver, solve
                )
            else:
                ends = scaled(places[asked], scale), all_places[known]
                # Receivers with readings at the same places share distances.
                if last is None or not all(map(torch.equal, ends, last)):
                    last = (*ends, distances(*ends))
                length, signal, _ = self.logarithms[receiver].exp()
                towards = matern(last[2], length, self._choice.smoothness)
                means[asked] = towards @ (signal**2 * self.weights[known])
        return means

    def _moments(
        self,
        places: Float[Tensor, "b d"],
        receivers: Int[Tensor, " b"],
        is_asked: bool = False,
        most: int = 128,
    ) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Means and variances of local mixtures at places.

        The results of the last ``most`` calls are cached, since a batch needs them twice. Means are
        always computed, since callers measure their time.
        """
        content = [part.cpu().numpy().tobytes() for part in (places, receivers)]
        key = hashlib.sha256(b"".join(content)).digest()
        if is_asked or key not in self.kept:
            mixture = self._mixtures.at(places, receivers)
            self.kept[key] = mixture.mean, mixture.variance
            if len(self.kept) > most:
                del self.kept[next(iter(self.kept))]
        mean, variance = self.kept[key]
        return mean.to(places), variance.to(places)

    def _solved(self, readings: Merged, receiver: int) -> Float[Tensor, " j"]:
        """Inverse covariance matrix of j readings of a receiver, times their values."""
        places = self.places[readings.rows]
        between = self._covariances(places, places, receiver)
        between.diagonal().add_(readings.variances)
        factor = torch.linalg.cholesky(between)
        return torch.cholesky_solve(readings.values[:, None], factor)[:, 0]

    def deviations(
        self, places: Float[Tensor, "b d"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Standard deviations of new readings: z given the known readings, plus noise."""
        if self._choice.is_local:
            return self._moments(places, receivers)[1].sqrt()
        variances = places.new_zeros(len(places))
        most = self.options.many if self.is_solved else 0
        is_many = self.receivers.bincount(minlength=len(self.logarithms)) > most
        for receiver in receivers.unique().tolist():
            rows = (receivers == receiver).nonzero()[:, 0]
            process = self.at(receiver)
            variances[rows] = process.noise
            for part in rows.split(self.options.size) if not is_many[receiver] else ():
                whitened, _ = process.whitened(places[part])
                signal = (2 * self.logarithms[receiver, 1]).exp()
                variances[part] += (signal - whitened.square().sum(0)).clamp_min(0)
        # All receivers together: readings at the same places share a search for neighbours.
        near_many = is_many[receivers].nonzero()[:, 0]

        def near_variances(part: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
            near = self._near(places[part], receivers[part], self.options.around)
            return near.variances.clamp_min(0)

        parts = near_many.split(4 * self.options.size)
        variances[near_many] += torch.cat(in_threads(near_variances, parts))
        return variances.sqrt()

    def _near(
        self,
        places: Float[Tensor, "b d"],
        receivers: Int[Tensor, " b"],
        count: int,
        folds: tuple[Tensor, Tensor] | tuple[()] = (),
    ) -> Conditional:
        """Prediction of z from the ``count`` nearest readings of each place.

        ``folds`` are the folds of the places and of the readings; a place uses other folds only.
        """
        readings = self._readings._replace(count=count)
        around = readings.around(places, receivers, readings.nearest(places, receivers, *folds))
        hyperparameters, choice = self.logarithms.exp(), self._choice
        between = covariances(around, hyperparameters, choice)  # (b, count + 1, count + 1)
        values, variances = self.values[around.rows], self.variances[around.rows]  # (b, count)
        if not self.is_solved and not math.isinf(choice.degrees):
            noises = hyperparameters[receivers, 2].square()
            of_readings = between[:, :-1, :-1]
            rounds = self.options.rounds
            factors = expected_factors(of_readings, values, noises, choice.degrees, rounds)
            variances = noises[:, None] * factors
        return conditional(between, values, variances)

    def at(self, receiver: int) -> Process:
        """The process of one receiver, with its known readings."""
        known = self.receivers == receiver
        degrees = self.choice[1].item()
        noise = math.exp(2 * self.logarithms[receiver, 2].item())
        # The variance of Student's t over its squared scale.
        noise *= 1.0 if math.isinf(degrees) else degrees / (degrees - 2)
        of_receiver = partial(self._covariances, receiver=receiver)
        return Process(of_receiver, self.places[known], self.variances[known], noise)

    def facts(self) -> dict[str, float]:
        """Entries of ``metrics.json``; length and nugget are medians over receivers."""
        length, signal, noise = self.logarithms.exp().unbind(1)
        smoothness, degrees, scale, is_local = self.choice.tolist()
        facts = {
            "length_m": length.median().item(),
            "nugget": (noise / signal).square().median().item(),
            "smoothness": smoothness,
            "degrees_of_freedom": 0.0 if math.isinf(degrees) else degrees,
        }
        facts |= {} if math.isnan(scale) else {"frequency_scale_m": scale}
        return facts | ({"local_mixtures": 1.0} if is_local else {})

    # --- fit ---

    def fit(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        candidates: Sequence[Float[Tensor, " k"]],
        folds: Int[Tensor, " k"],
        most: int = 600,
    ) -> int:
        """Chooses residuals, kernel and noise by the likelihood of held-out readings.

        Args:
            places, receivers: Places and receivers of the known readings.
            candidates: Residuals of the known readings, for each trend that is tried.
            folds: Fold of each reading. A fold is held out as a whole.
            most: Number of held-out readings to which the hyperparameters of single receivers are
                fitted. Half as many choose residuals, kernel and noise.

        Returns:
            Index of the chosen residuals.
        """
        self.places, self.receivers = places, receivers
        every = torch.arange(len(places))
        few = self._readings.held_out(every, folds, most // 2)
        fits = [self._maximise(values, few, Choice()) for values in candidates]
        index = min(range(len(fits)), key=lambda number: fits[number].cost)
        values, best = candidates[index], fits[index]
        for choice in self._choices()[1:]:  # the fits above have the first
            choice = choice._replace(scale=best.choice.scale)
            tried = self._maximise(values, few, choice, best.logarithms)
            best = min(best, tried, key=lambda fit: fit.cost)
        held = self._readings.held_out(every, folds, most)
        self.asked = torch.cat((few.rows, held.rows))
        self._take(self._maximise(values, held, best.choice, best.logarithms, has_deviations=True))
        self.solve(places, receivers, values, is_lazy=True)
        self.choice[3] = self._is_local(folds)
        return index

    def _is_local(self, folds: Int[Tensor, " k"]) -> bool:
        """True if held-out readings are significantly likelier with local mixtures."""
        rows, options = self.asked.unique(), self._mixtures.options
        values, receivers = self.values[rows], self.receivers[rows]
        asked = self.places[rows], receivers
        held = folds[rows], folds
        local = self._mixtures.at(*asked, *held).log_density(values)
        near = self._near(*asked, options.neighbours, held)
        noises, degrees = (2 * self.logarithms[receivers, 2]).exp(), self._choice.degrees
        gains = local - log_density(values - near.means, near.variances, noises, degrees)
        return bool(gains.mean() > options.errors * gains.std() / len(gains) ** 0.5)

    def _choices(self) -> list[Choice]:
        """Kernels with normal noise, then with Student's t."""
        choices = []
        for degrees in (math.inf, self.options.degrees):
            choices += [Choice(smoothness, degrees) for smoothness in SMOOTHNESSES]
        return choices

    def fit_count(self, candidates: int) -> int:
        """Number of maximisations in a ``fit`` with this number of candidate residuals."""
        return candidates + len(self._choices())

    def hold_out(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        folds: Int[Tensor, " k"],
        held: Int[Tensor, " h"] | None = None,
        most: int = 300,
    ) -> list[HeldOutReadings]:
        """Chooses the readings that the fits of ``refit`` predict from the others.

        Args:
            places, receivers: Known readings, as for ``fit``.
            folds: Fold of each reading. The first fit predicts a reading from the other folds.
            held: Rows of the readings that a second fit predicts from all others, such as the
                validation links. None: no second fit.
            most: Approximate number of readings that a fit predicts; up to four times as many if
                receivers would have fewer than 16 each.
        """
        self.places, self.receivers = places, receivers
        every = torch.arange(len(places))
        groups = [self._readings.held_out(every, folds, most)]
        if held is not None:
            is_held = torch.isin(every, held).long()
            groups.append(self._readings.held_out(held, is_held, most))
        return groups

    def refit(self, values: Float[Tensor, " k"], groups: Sequence[HeldOutReadings]) -> float:
        """Fits lengths and deviations again from their present values; kernel and noise stay.

        The mean over receivers of the first fit is the prior of the second, which may have few
        readings and would otherwise overfit.

        Args:
            values: Residuals of the known readings.
            groups: Readings that each fit holds out, from ``hold_out``.

        Returns:
            Negative log posterior of the last fit.
        """
        prior = None
        for held in groups:
            fit = self._maximise(values, held, self._choice, self.logarithms, True, prior)
            self._take(fit)
            prior = fit.logarithms.mean(0)
        return fit.cost

    def solve(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        values: Float[Tensor, " k"],
        is_lazy: bool = False,
    ) -> None:
        """Stores the residuals of known readings, and computes their weights for predictions.

        ``fit`` has chosen the hyperparameters before. With ``is_lazy`` the weights are computed at
        the first prediction of many places; few places are predicted from the readings around them.
        """
        self.places, self.receivers, self.values = places, receivers, values.clone()
        self.variances = (2 * self.logarithms[receivers, 2]).exp()
        self.is_solved = self._choice.is_local
        self.weights = torch.zeros_like(values)
        self.tiles.clear()  # of former readings
        self.kept.clear()
        if not is_lazy and not self.is_solved:
            self._solve()

    def _save_to_state_dict(self, *args):
        if not self.is_solved:  # a loaded process counts as solved
            self._solve()
        super()._save_to_state_dict(*args)

    def _solve(self) -> None:
        """Computes ``weights`` and ``tiles`` of the known readings."""
        places, receivers, values = self.places, self.receivers, self.values
        self.is_solved = True
        self.variances = self.variances * self._factors(values)
        for receiver in receivers.unique().tolist():
            known = (receivers == receiver).nonzero()[:, 0]
            readings = Merged(known, self.values[known], self.variances[known])
            if len(known) > self.options.together:
                one_each = merged(places[known], *readings[1:])
                readings = one_each._replace(rows=known[one_each.rows])
            if len(readings.rows) > self.options.together:
                self.tiles.add(scaled(places[readings.rows], self._choice.scale), readings)
            else:
                self.weights[readings.rows] = self._solved(readings, receiver)

    def take(self, other: "ScalarProcess") -> None:
        """Copies another process's hyperparameters; means need another ``solve``."""
        # A NaN, the scale of a single carrier, would differ from itself.
        choices = [choice.nan_to_num() for choice in (self.choice, other.choice)]
        if torch.equal(self.logarithms, other.logarithms) and torch.equal(*choices):
            return  # mixtures in the cache stay valid
        # Kernel and noise are alike; local mixtures have no use for the variances of readings.
        is_alike = torch.equal(self.choice[:2], other.choice[:2]) or other._choice.is_local
        before = self.logarithms
        self.logarithms, self.choice = other.logarithms, other.choice
        self.kept.clear()
        if is_alike:  # variances change as those of their receivers' noise, in column 2
            ratios = (2 * (self.logarithms - before)[self.receivers, 2]).exp()
            self.variances = self.variances * ratios
        else:  # readings that disagree count less with one noise than with another
            noises = (2 * self.logarithms[self.receivers, 2]).exp()
            self.variances = noises * self._factors(self.values)

    @property
    def _choice(self) -> Choice:
        smoothness, degrees, scale, is_local = self.choice.tolist()
        return Choice(smoothness, degrees, scale, is_local > 0)

    @property
    def _mixtures(self) -> LocalMixtures:
        return LocalMixtures(self._readings, self.values, self.logarithms, self._choice)

    @property
    def _readings(self) -> Readings:
        return Readings(self.scene, self.places, self.receivers, self.options.neighbours)

    def _take(self, fit: ScalarFit) -> None:
        self.logarithms = fit.logarithms
        self.choice = torch.tensor(fit.choice, dtype=torch.float64)

    def _maximise(
        self,
        values: Float[Tensor, " k"],
        held: HeldOutReadings,
        choice: Choice,
        start: Float[Tensor, "r 3"] | None = None,
        has_deviations: bool = False,
        prior: Float[Tensor, " 3"] | None = None,
    ) -> ScalarFit:
        cost = HeldOutCost(self.scene, values, held, choice, has_deviations, prior, self.options)
        return maximise(cost, start)

    def _factors(self, values: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        """Noise variance of each known reading over its receiver's (k,); 1 for normal noise.

        With Student's t of nu degrees of freedom, this ratio is (nu + E e² / variance) / (nu + 1).
        The expected square E e² of the reading's noise follows from the readings around it and
        their ratios, so both are updated in turn.
        """
        choice = self._choice
        factors = torch.ones_like(values)
        if math.isinf(choice.degrees):
            return factors
        options = self.options
        near = options.around if len(values) > options.large else options.neighbours
        readings = self._readings._replace(count=near + 1)
        rows = torch.arange(len(values), device=values.device)
        every = readings.nearest(self.places, self.receivers)
        every.exists.logical_and_(every.rows != rows[:, None])  # without the reading itself
        noises = (2 * self.logarithms[self.receivers, 2]).exp()
        for _ in range(self.options.rounds):
            squares = partial(self._noise_squares, every, values, noises * factors)
            parts = in_threads(squares, rows.split(self.options.size))
            factors = (choice.degrees + torch.cat(parts) / noises) / (choice.degrees + 1)
        return factors

    def _noise_squares(
        self,
        nearest: Nearest,
        values: Float[Tensor, " k"],
        variances: Float[Tensor, " k"],
        rows: Int[Tensor, " n"],
    ) -> Float[Tensor, " n"]:
        """Expected squares of the noise of n readings, given the ``nearest`` readings of each."""
        near = Nearest(nearest.rows[rows], nearest.exists[rows])
        around = self._readings.around(self.places[rows], self.receivers[rows], near)
        between = covariances(around, self.logarithms.exp(), self._choice)
        means, of_process, *_ = conditional(between, values[around.rows], variances[around.rows])
        # The reading's deviation from its neighbours is shared between process and noise.
        shares = variances[rows] / (of_process + variances[rows])
        return (shares * (values[rows] - means)).square() + of_process * shares

    def _covariances(
        self, a: Float[Tensor, "m d"], b: Float[Tensor, "n d"], receiver: int
    ) -> Float[Tensor, "m n"]:
        length, signal, _ = self.logarithms[receiver].exp()
        smoothness, scale = self._choice.smoothness, self._choice.scale
        apart = distances(scaled(a, scale), scaled(b, scale))
        return signal**2 * matern(apart, length, smoothness)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        choice = f"{prefix}choice"
        if choice in state_dict:  # older checkpoints have no entry for local mixtures
            missing = len(self.choice) - len(state_dict[choice])
            state_dict[choice] = torch.nn.functional.pad(state_dict[choice], (0, missing))
        self.kept.clear()
        resize(self, state_dict, prefix, "places", "receivers", "values", "variances", "weights")
        super()._load_from_state_dict(state_dict, prefix, *args)
