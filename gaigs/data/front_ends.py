"""Responses of front ends, learnt from the training links of a data set."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.front_ends import FrontEnd, FrontEndFit, FrontEndOptions
from gaigs.core.scene import Scene, direct_gains, direct_waves
from gaigs.core.task.csi import Csi


class FrontEnds(NamedTuple):
    """Learnt responses of the receivers' front ends."""

    # Factors of each receiver's channels, 1 where nothing was learnt.
    responses: Complex[Tensor, "r e s"]
    # Standard deviations of their complex numbers, 0 where nothing was learnt.
    errors: Float[Tensor, "r e s"]
    remark: str  # what was learnt


def learn_responses(links: Any, options: FrontEndOptions | None = None) -> FrontEnds | None:
    """Responses of the receivers' front ends, learnt from the training links.

    A receiver gets a response if it improves the score of free space at training places that are
    left out of the fit. None if no receiver gets one.
    """
    options = options or FrontEndOptions()
    task = links.task
    train = links.split.train
    shape = (len(links.receivers), *task.shape)
    responses = torch.ones(shape, dtype=torch.complex64)
    errors = torch.zeros(shape)
    sentences = []
    for receiver, antenna in enumerate(links.receivers):
        heard = antenna.hears(task.frequencies)  # subcarriers in the receiver's band
        rows = train[links.query.receivers[train] == receiver]
        rows = rows[links.labels[rows].abs().amax((1, 2)) > 0]  # links with a signal
        # Number of each link's place.
        places = links.query[rows].transmitters.unique(dim=0, return_inverse=True)[1]
        count = len(antenna.array)
        if len(places.unique()) < options.fewest_places or count * heard.sum() < 2:
            continue
        fit = _better_sign(links, rows, antenna, options)
        chosen = fit.choose(places)
        if chosen is None:
            continue
        front_end, freedom, before, after = chosen
        responses[receiver, :count, heard] = front_end.response.to(responses)
        errors[receiver, :count, heard] = front_end.errors.to(errors)
        sentences.append(
            f"{antenna.name} has a response of its front end, {freedom}: "
            f"{task.monitor} of free space at places left out {before:.1f} -> {after:.1f}, "
            f"{_summary(front_end)}"
        )
    if not sentences:
        return None
    return FrontEnds(responses, errors, "; ".join(sentences))


def _better_sign(
    links: Any, rows: Tensor, antenna: Receiver, options: FrontEndOptions
) -> FrontEndFit:
    """The fit of a front end with the sign of the phases that explains the channels better.

    Args:
        rows: Training links to the receiver.
        antenna: The receiver; only subcarriers in its band are fitted.
    """
    count = len(antenna.array)
    heard = antenna.hears(links.task.frequencies)
    task = Csi(links.task.elements, links.task.frequencies[heard], links.task.phase)
    labels = links.labels[rows, :count][..., heard]
    query = links.query[rows]
    scene = Scene(links.receivers, torch.zeros(3), torch.zeros(3), 0.0, task)
    fits = []
    for sign in (-1, 1):
        waves = direct_waves(scene, query, task.frequencies, sign)
        waves = direct_gains(scene, query)[:, None, None] * waves
        fits.append(FrontEndFit(labels, waves[:, :count], task, options))
    return max(fits, key=lambda fit: fit.likeness())


def _summary(front_end: FrontEnd) -> str:
    """Range of a response's level and its relative error, in words [dB]."""
    levels = 20 * front_end.response.abs().clamp_min(1e-6).log10()
    error = 20 * (front_end.errors.norm() / front_end.response.norm()).log10()
    return f"{levels.min():.1f} to {levels.max():.1f} dB, error {error:.0f} dB"
