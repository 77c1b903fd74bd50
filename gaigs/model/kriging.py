"""Kriging of a trained model: what it leaves over at the known links is predicted by a Gaussian process over places."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.data import Links, Split
from gaigs.gaussians import Gaussians
from gaigs.kriging.fit import LIMIT, PART, Hyperparameters, damping, likeliest, norms, numbers_of
from gaigs.kriging.links import at_directions, coordinates, distances, evenly, known_links
from gaigs.model import Model, Prediction
from gaigs.query import Batch
from gaigs.registry import register, registry
from gaigs.report.shapes import LearntRoom
from gaigs.scene import Scene

SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Shares of the trained model that are tried; of equally likely ones the first is taken."""

WEIGHTS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Weights of the kriged value beside the trained model's that are tried; of equally good ones the first is taken."""

ASKED = 1000
"""By how many held-out links length and noise are chosen once the share is: a trained model leaves little over that
places tell, and by few links that seems to be what their chance is."""

LEFT, MOST = 5e-4, 256
"""Share of the residuals' energy that their principal components may leave out, and how many there are at most: SSIM
sees little beyond, but ten times as much it does."""

BATCH = 64
"""Links predicted at a time."""

EXACT = 512
"""Up to so many links or numbers of a label the components are exact; of more, by random projections."""


@register("model", "kriging")
class Kriging(Model):
    """weight (share trend + (1 - share) fallback + z) + (1 - weight) trend, z the kriged residual.

    The trend is a trained model, the fallback one that is fitted at once. z is the mean of a Gaussian process over
    places with the Matern-1/2 kernel, as in ``gaigs.model.gaussian_process``. Share, length and noise are those with
    which the validation links are likeliest, each given the training links around it. So at a share of 0 it is that
    process, and far from all known links it is trend and fallback alone. Likelihood is no score: the weight is that of
    ``WEIGHTS`` with which the validation links, predicted from the training links, score best. Residuals of channels
    are damped as in ``gaigs.model.gaussian_process``.

    A checkpoint holds it whole, in a compact form: residuals as a few principal components. Of a receiver with more
    than ``LIMIT`` known links an even part is looked at.

    It is made from a trained model by ``kriging=true``, and is not trained itself.

    Args:
        trend: The trained model, or its configuration where a state is to be loaded.
        fallback: Configuration of the model that takes what the share leaves; None: each receiver's mean label.

    Raises:
        ValueError: There is no trend, or the fallback has to be trained or needs its data.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7 and 5.4.2.
    """

    def __init__(self, scene: Scene, trend: dict | Model | None = None, fallback: dict | None = None):
        super().__init__(scene)
        if trend is None:
            raise ValueError(
                "model 'kriging' needs a trained model, of whose labels it predicts what is left over; choose that "
                "model, and set kriging=true"
            )
        self.trend = trend if isinstance(trend, Model) else registry("model").build(trend, scene=scene)
        self.fallback_options = {"name": "mean"} if fallback is None else fallback
        self.fallback = registry("model").build(self.fallback_options, scene=scene)
        if not self.fallback.state_dict() or [*self.fallback.parameters()]:
            raise ValueError(
                f"the fallback of kriging must be fitted at once and stored in a checkpoint, and "
                f"{self.fallback_options['name']} is not; take mean, path_loss or friis as the trend of "
                "gaussian_process in task.baselines"
            )
        self.chunk, self.trained_by = self.trend.chunk, self.trend.trained_by
        for name in ("share", "weight", "length", "noise", "scale"):
            value = 1.0 if name in ("share", "weight") else math.nan
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))
        self.fields = nn.ModuleList(Field(scene) for _ in scene.receivers)

    # --- fitting ---

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Kriges what the trend leaves over, which must be trained.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        links = thinned(links)
        values = predicted(self.trend, links, known(links))
        self.choose(links, values)
        self.solve(links, values)

    @torch.no_grad()
    def choose(self, links: Links, values: Tensor) -> float:
        """Fits the fallback, and takes the likeliest share, length and noise.

        Args:
            links: At most ``LIMIT`` known ones of each receiver.
            values: What the trend predicts for the links of ``known``, in their order (k, *shape).

        Returns:
            Root mean square of what the trend leaves over at training links, over that at validation links; much below
            1 where it has learnt its places by heart. NaN where nothing validates.
        """
        self.fallback.fit(links)
        numbers = numbers_of(self.scene)
        thin = lambda labels: labels.reshape(len(labels), -1)[:, numbers]
        index = known(links)
        rows = index.new_zeros(len(links)).index_copy(0, index, torch.arange(len(index)))
        over, apart = [], []  # labels and trend, less the fallback
        for part in torch.arange(len(index)).split(PART):
            fallback = predicted(self.fallback, links, index[part])
            over.append(thin(links.labels[index[part]] - fallback))
            apart.append(thin(values[part] - fallback))
        over, apart = torch.cat(over), torch.cat(apart)

        def likeliest_of(share: float, **options: int) -> tuple[Hyperparameters, float]:
            left = over - share * apart
            if left.is_complex():
                sizes = norms(left), norms(thin(links.labels[index]))
                left = left * damping(*sizes, links.query.receivers[index])[:, None]
            return likeliest(self.scene, links, known_links(links), lambda some: left[rows[some]], **options)

        found = {share: likeliest_of(share) for share in SHARES}
        share = min(SHARES, key=lambda share: found[share][1])
        process, _ = likeliest_of(share, most=ASKED) if share else found[share]
        self._set(share, process)
        left = (over - apart).abs().square().mean(1)
        train, validation = left.tensor_split([len(links.split.train)])
        return (train.mean() / validation.mean()).sqrt().item()

    @torch.no_grad()
    def solve(self, links: Links, values: Tensor) -> None:
        """Takes what is left over at the known links; arguments as for ``choose``, which comes first."""
        index, share = known(links), self.share.item()
        own = links.query.receivers[index]
        for receiver, field in enumerate(self.fields):
            rows = (own == receiver).nonzero()[:, 0]
            residuals = torch.empty(len(rows), *self.scene.task.shape, dtype=self.scene.task.dtype)
            for part in torch.arange(len(rows)).split(PART):
                some = index[rows[part]]
                fallback = predicted(self.fallback, links, some)
                residuals[part] = links.labels[some] - share * values[rows[part]] - (1 - share) * fallback
            if residuals.is_complex():
                sizes = norms(residuals), norms(links.labels[index[rows]])
                residuals = residuals * damping(*sizes, own[rows])[:, None, None]
            places = coordinates(self.scene, links.query[index[rows]], self.process.scale)
            field.solve(places, residuals, self.process)

    def without_validation(self, links: Links, values: Tensor) -> "Kriging":
        """The same of the training links alone, to be scored on the validation links; arguments as for ``choose``.

        Share, length and noise are this model's.
        """
        split = links.split
        unseen = replace(links, split=Split(split.name, split.train, split.validation[:0], split.validation))
        twin = Kriging(self.scene, self.trend, self.fallback_options)
        twin._set(self.share.item(), self.process)
        twin.fallback.fit(unseen)
        twin.solve(unseen, values[: len(split.train)])
        return twin.to(self.share.device)

    @torch.no_grad()
    def weigh(self, links: Links, values: Tensor, blind: "Kriging") -> None:
        """Takes the weight with which the validation links score best, and gives it to ``blind`` too.

        Args:
            links, values: As for ``choose``.
            blind: What ``without_validation`` gives.
        """
        task, index = links.task, links.split.validation
        if not len(index):
            return
        labels, trend, kriged = links.labels[index], values[len(links.split.train) :], predicted(blind, links, index)
        score = lambda weight: task.scores(labels, trend + weight * (kriged - trend))[task.monitor].mean().item()
        sign = 1 if task.higher_is_better else -1
        best = max(WEIGHTS, key=lambda weight: sign * score(weight))
        self.weight.fill_(best)
        blind.weight.fill_(best)

    @property
    def process(self) -> Hyperparameters:
        """Length, noise and scale."""
        scale = self.scale.item() if self.scene.has_band else None
        return Hyperparameters(self.length.item(), self.noise.item(), scale)

    def _set(self, share: float, process: Hyperparameters) -> None:
        self.share.fill_(share)
        self.length.fill_(process.length)
        self.noise.fill_(process.noise)
        self.scale.fill_(math.nan if process.scale is None else process.scale)

    # --- prediction ---

    def forward(self, batch: Batch) -> Prediction:
        query, share, weight, value = batch.query, self.share.item(), self.weight.item(), 0
        trend = self.trend(batch).value if share > 0 or weight < 1 else None
        if weight == 0:
            return Prediction(trend, {})
        if share > 0:
            value = share * trend
        if share < 1:
            value = value + (1 - share) * self.fallback(batch).value
        places = coordinates(self.scene, query, self.scale if self.scene.has_band else None)
        added = torch.zeros_like(value)
        for receiver in query.receivers.unique().tolist():
            own = query.receivers == receiver
            added[own] = self.fields[receiver](places[own], self.length, batch)
        value = value + added
        return Prediction(value if weight == 1 else trend + weight * (value - trend), {})

    # --- what a run reports of it: the trend's ---

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return self.trend.parameter_groups()

    @property
    def primitives(self) -> Gaussians | None:
        return self.trend.primitives

    def facts(self) -> dict[str, object]:
        """The trend's, and as ``kriging`` share, length, noise, scale, and how much is kept."""
        kept = {
            "links": sum(len(field.places) for field in self.fields),
            "components": max(len(field.components) for field in self.fields),
        }
        chosen = {"weight": self.weight.item(), "share": self.share.item()}
        return self.trend.facts() | {"kriging": chosen | self.process.facts() | kept}

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        return self.trend.rendering(batch)

    def learnt_room(self, links: Links) -> LearntRoom | None:
        return self.trend.learnt_room(links)

    def export(self, folder: Path) -> None:
        self.trend.export(folder)


class Field(nn.Module):
    """What is added at one receiver.

    With k known links and residuals of q principal components: places (k, d) [m], see ``coordinates``; weights (k, q),
    the components' scores over the covariances of the links; components (q, *shape) in half precision, of complex ones
    real and imaginary part last. Sizes are those of the data, and are taken over from a state that is loaded.

    Args:
        scene: Receivers and task.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        task = scene.task
        self.scene = scene
        parts = (2,) if task.dtype.is_complex else ()
        self.register_buffer("places", torch.zeros(0, 3 + scene.has_band, dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(0, 0, dtype=task.dtype))
        self.register_buffer("components", torch.zeros(0, *task.shape, *parts, dtype=torch.float16))
        self.register_buffer("widened", torch.zeros(0, *task.shape, dtype=task.dtype), persistent=False)

    def solve(self, places: Float[Tensor, "k d"], residuals: Tensor, process: Hyperparameters) -> None:
        """Takes residuals (k, *shape) at their places."""
        components = principal(residuals.flatten(1) if residuals.ndim > 1 else residuals[:, None])
        if components.is_complex():
            components = torch.view_as_real(components)
        shape = (len(components), *self.components.shape[1:])
        # Laid out as a state that is loaded: else products would be rounded otherwise.
        laid_out = functools.partial(torch.clone, memory_format=torch.contiguous_format)
        self.components = laid_out(components.reshape(shape).to(self.components))
        self._widen()
        # Scores of the components as they are rounded, so that one for the next makes up for it.
        kept = self.widened.cpu().reshape(len(components), -1)
        residuals = residuals.reshape(len(residuals), -1)
        wide = torch.promote_types(kept.dtype, torch.float64)
        gram, cross = (kept @ kept.mH).to(wide), (residuals @ kept.mH).to(wide)
        scores = torch.linalg.solve(gram, cross, left=False)
        covariances = distances(places, places).div_(-process.length).exp_()
        covariances.diagonal().add_(process.noise)
        factor = torch.linalg.cholesky(covariances)
        self.weights = laid_out(torch.cholesky_solve(scores, factor.to(wide)).to(self.weights))
        self.places = laid_out(places.to(self.places))

    def forward(self, places: Float[Tensor, "b d"], length: Tensor, batch: Batch) -> Tensor:
        """What is added at some places, in the directions that a batch asks for."""
        covariances = distances(places, self.places).div_(-length).exp_()
        components = at_directions(self.widened, batch, self.scene)
        return torch.tensordot(covariances.to(self.weights) @ self.weights, components, 1)

    def _widen(self) -> None:
        """The components in the task's precision, in which products are fast."""
        components = self.components.float()
        self.widened = torch.view_as_complex(components) if self.weights.is_complex() else components

    def _load_from_state_dict(self, state_dict, prefix, *args):
        for name in ("places", "weights", "components"):
            stored = state_dict.get(f"{prefix}{name}")
            if stored is not None:
                own = getattr(self, name)
                setattr(self, name, own.new_empty(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._widen()


def principal(residuals: Float[Tensor, "k m"]) -> Float[Tensor, "q m"]:
    """The first principal components, as few as leave out at most ``LEFT`` of the energy; the largest number of each
    is 1."""
    if min(residuals.shape) <= EXACT:
        _, values, components = torch.linalg.svd(residuals, full_matrices=False)
    else:
        with torch.random.fork_rng(devices=[]):  # a run that is resumed must go on as if it had not stopped
            torch.manual_seed(0)
            _, values, columns = torch.svd_lowrank(residuals, q=MOST + 16)
        components = columns.mH
    energy = residuals.abs().square().sum()
    left = energy - values.square().cumsum(0)
    components = components[: min(int((left > LEFT * energy).sum()) + 1, MOST)]
    return components / components.abs().amax(1, keepdim=True)


def known(links: Links) -> Int[Tensor, "k"]:
    """Training and validation links, in this order."""
    return torch.cat((links.split.train, links.split.validation))


def predicted(model: Model, links: Links, index: Int[Tensor, "k"]) -> Float[Tensor, "k *shape"]:
    """What a model says of some links, on the CPU."""
    return torch.cat([model.predict(links.query[part], batch_size=BATCH).cpu() for part in index.split(BATCH)])


def thinned(links: Links) -> Links:
    """The same with at most ``LIMIT`` known links of each receiver, evenly spread over them."""
    chosen = torch.cat([evenly(index, LIMIT) for index in known_links(links)])
    train, validation, test = links.split.parts().values()
    parts = (part[torch.isin(part, chosen)] for part in (train, validation))
    return replace(links, split=Split(links.split.name, *parts, test))
