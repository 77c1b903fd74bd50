"""Measures of how well the direct wave explains channels: phases over links, or powers."""

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


class FewWaves(NamedTuple):
    """Channels of unit power at few elements and subcarriers, and the direct wave there.

    The wave is exp(-j 2 pi f d / c) at distance d, without the loss of free space.
    """

    channels: Complex[Tensor, "n e s"]
    waves: Complex[Tensor, "n e s"]
    frequencies: Float[Tensor, " s"]

    def without_waves(self) -> tuple[Complex[Tensor, "n e s"], Complex[Tensor, "n e s"]]:
        """Channels divided by the waves' phases, and by the opposite phases."""
        return self.channels * self.waves.conj(), self.channels * self.waves


def direct_distances(sample: Sample) -> Float[Tensor, "n e"]:
    """Distances from transmitters to elements [m].

    For elements that a smaller array lacks, the distance is to its receiver's position.
    """
    elements = pad_sequence([*sample.elements], batch_first=True)  # (r, e, 3)
    # Offsets along the world's axes.
    offsets = torch.einsum("rwa,rea->rew", sample.rotations, elements)  # (r, e, 3)
    places = sample.positions[:, None] + offsets
    return (sample.transmitters[:, None] - places[sample.receivers]).norm(dim=-1)


def waves_at_few(sample: Sample, elements: int = 8, subcarriers: int = 6) -> FewWaves:
    """Channels and direct waves at a few elements and subcarriers, evenly spread.

    Args:
        elements: Largest number of elements.
        subcarriers: Largest number of subcarriers.
    """
    chosen = evenly(torch.arange(sample.labels.shape[1]), elements)
    tones = evenly(torch.arange(len(sample.frequencies)), subcarriers)
    # Phase -2 pi f d / c of a wave at distance d.
    wavenumbers = -2 * math.pi / speed_of_light * sample.frequencies[tones]  # (s,)
    phases = direct_distances(sample)[:, chosen, None] * wavenumbers  # (n, e, s)
    sizes = torch.tensor([len(array) for array in sample.elements])[sample.receivers]
    exists = (chosen < sizes[:, None])[..., None]  # (n, e, 1)
    channels = sample.labels[:, chosen][..., tones] * exists
    powers = channels.abs().square().mean((1, 2), keepdim=True)
    channels = channels / torch.where(powers > 0, powers, 1).sqrt()
    return FewWaves(
        channels, torch.polar(torch.ones_like(phases), phases), sample.frequencies[tones]
    )


def has_extent(sample: Sample) -> bool:
    """True if distances and arrays are large enough to show phases.

    Distances must have a standard deviation above a wavelength. Arrays with an extent must have at
    least a tenth of a wavelength.
    """
    wavelength = speed_of_light / sample.frequencies.mean()
    for array in sample.elements:
        extent = (array.amax(0) - array.amin(0)).norm()
        if 0 < extent < wavelength / 10:
            return False
    distances = (sample.transmitters - sample.positions[sample.receivers]).norm(dim=1)
    return bool(distances.std() > wavelength)


def without_geometry(sample: Sample) -> Sample:
    """The same channels with all transmitters and elements at the middle of their receiver."""
    points = tuple(torch.zeros_like(array) for array in sample.elements)
    return replace(sample, transmitters=sample.positions[sample.receivers], elements=points)


def shares(sample: Sample, is_calibrated: bool = False) -> Float[Tensor, "2 r"]:
    """Fraction of power in each receiver's mean channel, after division by the direct wave.

    The two rows are for the two signs of the wave's phase. The mean is over links, and the fraction
    expected by chance is subtracted. Each element and subcarrier has its own mean, since an unknown
    phase of the element or subcarrier may be common to all links.

    Args:
        is_calibrated: True to take one mean over all elements and subcarriers.
    """
    counts = sample.receivers.bincount(minlength=len(sample.positions))
    by_sign = []
    for unwound in waves_at_few(sample).without_waves():
        if is_calibrated:
            unwound = unwound.mean((1, 2), keepdim=True)
        totals = unwound.new_zeros(len(counts), *unwound.shape[1:])
        totals = totals.index_add(0, sample.receivers, unwound)  # (r, e, s)
        # |sum|^2 / n over n links of power 1: it is 1 by chance, and n for equal phases.
        powers = totals.abs().square().mean((1, 2)) / counts.clamp_min(1)  # (r,)
        by_sign.append((powers - 1) / (counts - 1).clamp_min(1) * (counts > 1))
    return torch.stack(by_sign)


def coherence(sample: Sample, is_calibrated: bool = False) -> float:
    """Mean of ``shares`` over the links, with the better sign."""
    counts = sample.receivers.bincount(minlength=len(sample.positions)).double()
    by_sign = shares(sample, is_calibrated) @ counts / counts.sum()  # (2,)
    return by_sign.max().item()


def likeness(sample: Sample) -> float:
    """Fraction of power that the direct wave explains after the best phase for each link.

    Each element and subcarrier may have a further phase, the same in all links.
    """
    by_sign = []
    for unwound in waves_at_few(sample).without_waves():
        power = 0.0
        for receiver in sample.receivers.unique():
            links = unwound[sample.receivers == receiver].flatten(1)  # (k, m)
            # The pattern v of phases common to all links A is the first right singular vector, by
            # the power method.
            common = torch.ones_like(links[0])
            for _ in range(3):
                common = links.mH @ (links @ common)
            # Power of the links along the pattern, |A v|^2 / |v|^2.
            size = common.abs().square().sum().clamp_min(1e-300)
            power += ((links @ common).abs().square().sum() / size).item()
        by_sign.append(power / unwound.numel())
    return max(by_sign)


def aligned_likeness(sample: Sample) -> float:
    """Fraction of power that the direct wave explains after each link's best phase and delay."""
    few = waves_at_few(sample, subcarriers=16)
    by_sign = []
    for unwound in few.without_waves():
        aligned = unwound * alignment(unwound, torch.ones_like(unwound), few.frequencies)
        by_sign.append(aligned.mean((1, 2)).abs().square().mean().item())
    return max(by_sign)


def level_share(sample: Sample) -> float:
    """Fraction of the variance of the channels' mean powers that the law of distance explains."""
    powers = sample.labels.abs().square().mean((1, 2)).clamp_min(1e-300)
    return explained(replace(sample, labels=10 * powers.log10()))
