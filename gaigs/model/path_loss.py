"""Log-distance path loss: signal strength as a function of distance alone."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.links import known_links
from gaigs.model import Model, Prediction
from gaigs.registry import register


@register("model", "path_loss")
class PathLoss(Model):
    """Level T - 10 gamma log10(distance / 1 m) for each receiver; NaN before ``fit``.

    Labels are RSSI [dBm], or any scalar. T and gamma are fitted by least squares. Exponents gamma
    from a few readings scatter widely, so they are shrunk towards the mean of all receivers
    (``shrunk``). A receiver whose links are equally long gets this mean. If no receiver has an
    exponent, it is 2, as in free space. Negative exponents are kept; distance hardly explains such
    levels. Distances below 0.1 m count as 0.1 m, since the law fails within about a wavelength. If
    a receiver's place is estimated, the logarithm is averaged over the region in which it may
    stand, so there is no peak in its middle.

    Raises:
        ValueError: A label is more than one real number.

    Source: Rappaport, Wireless Communications, 2nd edition, section 4.9; DerSimonian and Laird,
    Meta-analysis in clinical trials, 1986.
    """

    any_receiver = True
    of_receivers = ("levels", "exponents")
    regions: Tensor

    def __init__(self, scene: Scene):
        super().__init__(scene)
        if not scene.task.is_scalar:
            raise ValueError(
                "model 'path_loss' predicts one real number a link, not labels of task "
                f"{scene.task.name!r}; take mean or knn"
            )
        self.register_buffer("levels", torch.full((scene.radios,), torch.nan))  # T [dBm]
        self.register_buffer("exponents", torch.full((scene.radios,), torch.nan))  # gamma
        # Deviations of estimated places [m].
        self.register_buffer("regions", torch.zeros(len(scene.receivers)))

    def fit(self, links: Links) -> None:
        """Fits level and exponent of each receiver, ``without_gross_errors``.

        A receiver without links gets the means of levels and exponents.
        """
        self._fit_lines(without_gross_errors(links))

    def _fit_lines(self, links: Links) -> None:
        """``fit`` to links of which none has a gross error."""
        if links.uncertainties is not None:
            self.regions.copy_(links.uncertainties)
        known = known_links(links, any_receiver=True)
        laws = []  # results of the fit at each receiver with links
        for index in filter(len, known):
            query, labels = links.query[index], links.labels[index].double()
            decades = self._decades(query.transmitters.double(), query.receivers)
            # Least squares of y - mean(y) = gamma x, with x = -10 (decades - mean(decades)).
            level, centre = labels.mean(), decades.mean()
            labels = labels - level
            x = -10 * (decades - centre)
            # With lengths in a ratio below 1.01, an exponent larger by 1 changes labels by less
            # than 0.05 dB.
            is_spread = 10 ** (decades.max() - decades.min()) >= 1.01
            weight = x.square().sum() * is_spread
            exponent = x @ labels / weight if is_spread else weight  # 0 without a spread
            errors = (labels - exponent * x).square().sum()
            freedom = len(index) - 1 - is_spread.to(weight)  # degrees of freedom of the errors
            laws.append(torch.stack((level, centre, exponent, weight, errors, freedom)))
        levels, centres, exponents, weights, errors, freedom = torch.stack(laws, 1)
        # Variance of the labels about their laws, common to all receivers.
        noise = errors.sum() / freedom.sum() if freedom.sum() else errors.new_tensor(torch.nan)
        exponents = shrunk(exponents, weights, noise)
        levels = levels + 10 * exponents * centres  # T: the level at decades of 0, 1 m
        has_links = torch.tensor([len(index) for index in known]) > 0
        for buffer, fitted in ((self.levels, levels), (self.exponents, exponents)):
            buffer[has_links] = fitted.to(buffer)
            buffer[~has_links] = fitted.mean().to(buffer)

    def forward(self, batch: Batch) -> Prediction:
        decades = self._decades(batch.query.transmitters, batch.query.receivers)
        radios = self.scene.radio_of(batch.query.receivers)
        return Prediction(self.levels[radios] - 10 * self.exponents[radios] * decades, {})

    def take_receivers(self, scene: Scene, known: Tensor | None = None) -> None:
        """Replaces the receivers by new ones at known places."""
        self.regions = self.regions.new_zeros(len(scene.receivers))

    def _decades(
        self, transmitters: Float[Tensor, "b 3"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """log10(distance / 1 m), averaged over the region in which the receiver may stand."""
        positions = self.scene.positions(transmitters)[receivers]  # (b, 3)
        lengths = (transmitters - positions).norm(dim=-1).clamp_min(0.1)
        # The mean of ln r² over a normal region is ln(0.56 deviation²) at its middle, where 0.56 is
        # exp(-Euler's constant), and ln d² far away. The logarithm of the sum has both limits.
        regions = self.regions[receivers].to(lengths)
        return (lengths.square() + 0.56 * regions.square()).log10() / 2

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # Older checkpoints have no regions.
        state_dict.setdefault(f"{prefix}regions", torch.zeros_like(self.regions))
        super()._load_from_state_dict(state_dict, prefix, *args)


def shrunk(
    exponents: Float[Tensor, " r"], weights: Float[Tensor, " r"], noise: Float[Tensor, ""]
) -> Float[Tensor, " r"]:
    """Exponents shrunk towards their mean, as far as chance explains their scatter.

    Args:
        exponents: Exponents fitted by least squares.
        weights: Inverse variances of their errors, for noise of variance 1; 0 without an exponent.
        noise: Variance of the labels about the law; NaN if too few labels show it. All exponents
            then become their weighted mean.

    Returns:
        Exponents; 2 (free space) if no receiver has one.
    """
    total = weights.sum()
    if not total:
        return torch.full_like(exponents, 2)
    mean = weights @ exponents / total
    if noise.isnan():
        return torch.full_like(exponents, mean.item())
    noise = noise.clamp_min(1e-12)
    # Variance of the true exponents (DerSimonian and Laird, 1986), with the squares Q of fitted
    # ones about their mean and the weights w: (Q - (r - 1) noise) / (sum w - sum w² / sum w).
    squares = weights @ (exponents - mean).square()
    expected_squares = ((weights > 0).sum() - 1) * noise  # if all true exponents are equal
    variance = (squares - expected_squares) / (total - weights.square().sum() / total)
    variance = variance.nan_to_num(0, posinf=0).clamp_min(0)
    # A fitted exponent has the variance of the true ones plus noise / w about their mean.
    precisions = weights / (variance * weights + noise)
    shares = variance * precisions  # of the variance that is not noise, 0 to 1
    common = precisions @ exponents / precisions.sum()
    return shares * exponents + (1 - shares) * common
