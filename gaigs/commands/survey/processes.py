"""Gaussian processes over places, for survey plans."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.query import evenly
from gaigs.kriging.kernel import LIMIT, Process, kernel
from gaigs.kriging.links import reception_probability
from gaigs.model import Model
from gaigs.registry import name_of


def processes_of(model: Model) -> list[Process]:
    """The processes of a model's receivers; a ``ValueError`` for a model without processes."""
    processes = []
    for receiver in range(len(model.scene.receivers)):
        process = model.process_at(receiver)
        if process is not None:
            processes.append(process)
    if not processes:
        raise ValueError(
            f"model {name_of(model)!r} has no Gaussian process over places, which plans a survey\n"
            "train model=gaussian_process, or for RSSI and spectra any model with kriging=true"
        )
    return processes


def default_process(
    points: Float[Tensor, "g 3"], length: float = 0.25, nugget: float = 0.6
) -> Process:
    """A process without readings, for a survey before the first measurement.

    Its mean is unknown, so that a plan spreads places evenly over the points' box.

    Args:
        points: Candidates and other places [m].
        length: Correlation length over the diagonal of the box.
        nugget: Variance of the noise over the variance of the process.
    """
    diagonal = (points.amax(0) - points.amin(0)).norm().item()
    metres = length * diagonal or 1.0

    def covariances(a: Tensor, b: Tensor) -> Tensor:
        return 100 + kernel(a, b, metres)  # a constant of variance 100 is as good as unknown

    return Process(covariances, points[:0], points[:0, 0], nugget)


def with_trend(process: Process, receiver: Float[Tensor, "3"] | None) -> Process:
    """The process plus an unknown trend, which readings also have to determine.

    The trend is a + b (decades - middle), with normal a and b of twice the standard deviation of a
    reading, a typical difference between receivers of one survey. The decades are decimal
    logarithms of the distance to the receiver, their middle is the mean over readings. The trend
    adds scale² (1 + (decades - middle) (decades' - middle)) to a covariance.

    Args:
        receiver: Position of the receiver [m]; None: the trend is the constant a.
    """
    first = process.places[:1]
    variance = float(process.covariances(first, first)[0, 0] + process.noise)  # of a reading
    scale = 2 * variance**0.5  # standard deviation of a and b

    def decades(places: Tensor) -> Tensor:
        """Decimal logarithms of distances to the receiver [m], at least 0.1 m (n,)."""
        return (places[:, :3] - receiver).norm(dim=1).clamp_min(0.1).log10()

    middle = decades(process.places).mean() if receiver is not None else 0.0

    def covariances(a: Tensor, b: Tensor) -> Tensor:
        products = torch.ones(len(a), len(b), dtype=a.dtype, device=a.device)
        if receiver is not None:
            products = products + torch.outer(decades(a) - middle, decades(b) - middle)
        return process.covariances(a, b) + scale**2 * products

    return replace(process, covariances=covariances)


def posterior(process: Process, places: Float[Tensor, "g d"]) -> Float[Tensor, "g g"]:
    """Covariances of the process at places, given its readings, at most ``LIMIT`` of them."""
    rows = evenly(torch.arange(len(process.places)), LIMIT).to(process.places.device)
    # With K = L L' of the readings and k between readings and places, ``whitened`` is L^-1 k.
    whitened, _ = process.whitened(places, rows)  # (readings, g)
    return process.covariances(places, places) - whitened.mT @ whitened


def reception_chances(
    processes: Sequence[Process], points: Float[Tensor, "g d"]
) -> Float[Tensor, "r g"]:
    """Probability that each receiver receives a point, from the measured places around it.

    Only measured places at the carrier of the points count, or else at the nearest carrier. Without
    measured places all probabilities are 1.

    Args:
        processes: Process of each receiver, with its readings.
        points: x, y and z [m], and one of the carrier, see ``gaigs.kriging.links.coordinates``.
    """
    places = torch.cat([process.places for process in processes])  # (k, d)
    if not len(places):
        return points.new_ones(len(processes), len(points))
    counts = torch.tensor([len(process.places) for process in processes])
    receivers = torch.repeat_interleave(counts).to(places.device)  # (k,)
    carrier_distances = (places[:, 3:] - points[:1, 3:]).abs().sum(1)
    at_carrier = carrier_distances <= carrier_distances.min() + 1e-6
    known, rows = places[at_carrier, :3].unique(dim=0, return_inverse=True)
    is_received = known.new_zeros(len(known), len(processes))
    is_received[rows, receivers[at_carrier]] = 1
    for receiver, process in enumerate(processes):
        if process.is_part:  # its other readings may be at any place, so it counts everywhere
            is_received[:, receiver] = 1
    return reception_probability(points, known, is_received, is_received.mean(0)).mT


def mean_of_received(values: Float[Tensor, "r g"], chances: Float[Tensor, "r g"]) -> float:
    """Mean over receivers and places, weighted by the probability of reception (``chances``)."""
    return ((values * chances).sum() / chances.sum()).item()
