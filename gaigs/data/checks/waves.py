"""How well the direct wave explains channels: coherently over links, within each link, and by
power.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.core.phases import alignment
from gaigs.core.query import evenly
from gaigs.data.checks.distance import explained
from gaigs.data.checks.hypotheses import Sample


class Turned(NamedTuple):
    """Channels of unit power, and the direct wave's phases exp(-j 2 pi f d / c)."""

    channels: Complex[Tensor, "n e s"]
    waves: Complex[Tensor, "n e s"]
    frequencies: Float[Tensor, " s"]

    def still(self) -> tuple[Complex[Tensor, "n e s"], Complex[Tensor, "n e s"]]:
        """Channels without the direct wave's phase, for each sign that it may have."""
        return self.channels * self.waves.conj(), self.channels * self.waves


def direct_distances(sample: Sample) -> Float[Tensor, "n e"]:
    """Distances of each link's transmitter from the elements of its receiver [m]; lacking ones are
    in its middle.
    """
    elements = pad_sequence([*sample.elements], batch_first=True)  # (r, e, 3)
    places = sample.positions[:, None] + torch.einsum("rwa,rea->rew", sample.rotations, elements)
    return (sample.transmitters[:, None] - places[sample.receivers]).norm(dim=-1)


def turned(sample: Sample, elements: int = 8, subcarriers: int = 6) -> Turned:
    """Channels and direct waves at some elements and subcarriers, evenly spread, which show the
    geometry as well.
    """
    chosen = evenly(torch.arange(sample.labels.shape[1]), elements)
    tones = evenly(torch.arange(len(sample.frequencies)), subcarriers)
    phases = direct_distances(sample)[:, chosen, None] * (
        -2 * math.pi / speed_of_light * sample.frequencies[tones]
    )
    sizes = torch.tensor([len(array) for array in sample.elements])[sample.receivers]
    channels = sample.labels[:, chosen][..., tones] * (chosen < sizes[:, None])[..., None]
    powers = channels.abs().square().mean((1, 2), keepdim=True)
    channels = channels / torch.where(powers > 0, powers, 1).sqrt()
    return Turned(channels, torch.polar(torch.ones_like(phases), phases), sample.frequencies[tones])


def has_extent(sample: Sample) -> bool:
    """True unless distances differ by less than a wavelength, or an array is smaller than a tenth
    of one.
    """
    wavelength = speed_of_light / sample.frequencies.mean()
    distances = (sample.transmitters - sample.positions[sample.receivers]).norm(dim=1)
    extents = [(array.amax(0) - array.amin(0)).norm() for array in sample.elements]
    return bool(distances.std() > wavelength) and not any(
        0 < extent < wavelength / 10 for extent in extents
    )


def without_geometry(sample: Sample) -> Sample:
    """The same channels of transmitters and elements in the middle of their receiver: waves without
    a phase.
    """
    points = tuple(torch.zeros_like(array) for array in sample.elements)
    return replace(sample, transmitters=sample.positions[sample.receivers], elements=points)


def shares(sample: Sample, is_calibrated: bool = False) -> Float[Tensor, "2 r"]:
    """Share of the power that the direct wave keeps in each receiver's mean over links, for each
    sign of its phase.

    That of chance is taken off. Unless arrays are calibrated, each element and subcarrier may have
    a phase of its own, the same in all links.
    """
    counts, found = sample.receivers.bincount(minlength=len(sample.positions)), []
    for still in turned(sample).still():
        if is_calibrated:
            still = still.mean((1, 2), keepdim=True)
        totals = still.new_zeros(len(counts), *still.shape[1:]).index_add(
            0, sample.receivers, still
        )
        powers = totals.abs().square().mean((1, 2)) / counts.clamp_min(1)  # n |mean|^2, by chance 1
        found.append((powers - 1) / (counts - 1).clamp_min(1) * (counts > 1))
    return torch.stack(found)


def coherence(sample: Sample, is_calibrated: bool = False) -> float:
    """Mean of ``shares`` over the links, with the sign that suits better."""
    counts = sample.receivers.bincount(minlength=len(sample.positions)).double()
    return (shares(sample, is_calibrated) @ counts / counts.sum()).max().item()


def likeness(sample: Sample) -> float:
    """Share of the power that the direct wave explains after the best phase of each link.

    Each element and subcarrier may have a phase of its own, the same in all links.
    """
    found = []
    for still in turned(sample).still():
        explained = 0.0
        for receiver in sample.receivers.unique():
            own = still[sample.receivers == receiver].flatten(1)  # (k, m)
            common = torch.ones_like(own[0])
            for _ in range(3):  # the power method for the first singular vector
                common = own.mH @ (own @ common)
            explained += (
                (own @ common).abs().square().sum() / common.abs().square().sum().clamp_min(1e-300)
            ).item()
        found.append(explained / still.numel())
    return max(found)


def aligned_likeness(sample: Sample) -> float:
    """Share of the power that the direct wave explains after the best phase and delay of each link."""
    parts = turned(sample, subcarriers=16)
    kept = [
        still * alignment(still, torch.ones_like(still), parts.frequencies)
        for still in parts.still()
    ]
    return max(still.mean((1, 2)).abs().square().mean().item() for still in kept)


def level_share(sample: Sample) -> float:
    """Share of the spread of the channels' mean powers that the law of distance explains."""
    powers = sample.labels.abs().square().mean((1, 2)).clamp_min(1e-300)
    return explained(replace(sample, labels=10 * powers.log10()))
