"""Phases of measured channels: sign convention, alignment to waves, and fixed offsets."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

TELLING = 5
"""Fewest links of a receiver that show a sign of the phases; with fewer, chance decides."""

MANY = 30
"""Fewest links of a receiver that show random phases, or phases that geometry does not explain."""


class StrangeParts(NamedTuple):
    """Elements and subcarriers of a receiver whose phases or gains differ from geometry."""

    elements: bool
    subcarriers: bool
    delay: float | None  # delay that explains the subcarriers [s]; None if none does


def phase_sign(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    least_share: float = 0.01,
) -> int:
    """Sign with which the phases of channels follow the direct distance, -1 or 1; 0 for neither.

    A channel divided by free space of the right sign has a constant part: the direct path. The mean
    over the links of a receiver keeps this part of the power. Random phases would keep a fraction
    of about 1 / links of the power. The sign that keeps more power wins if its fraction exceeds
    ``least_share`` plus four times the random fraction. Fewer than ``TELLING`` links a receiver
    always give 0.

    Args:
        channels: Channels of the links.
        waves: ``direct_waves`` of the links with the sign -1.
        receivers: Receiver of each link.
        least_share: Smallest fraction of the power that the mean keeps.
    """
    received = max(1, int((channels.abs().amax((1, 2)) > 0).sum()))  # links with a signal
    shares = {}  # fraction of the power that the means keep, by sign
    for sign in (-1, 1):
        powers = []
        for receiver, response in common_responses(channels, waves, receivers, sign).items():
            links = (receivers == receiver).sum()
            powers.append(links * response.abs().square().mean())
        shares[sign] = float(sum(powers)) / received
    best = max(shares, key=shares.__getitem__)
    chance = len(receivers.unique()) / len(receivers)  # the random fraction
    return best if shares[best] > least_share + 4 * chance else 0


def common_responses(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    sign: int,
) -> dict[int, Complex[Tensor, "e s"]]:
    """Mean over links of channels divided by free space, by the number of the receiver.

    The mean is the same at all elements and subcarriers if the given elements and frequencies are
    right. Arguments are as for ``phase_sign``.
    """
    relative = _without_phases_of(waves, _relative(channels, waves), sign)
    responses = {}
    for receiver in receivers.unique().tolist():
        responses[receiver] = relative[receivers == receiver].mean(0)  # (e, s)
    return responses


def strange_parts(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
    sign: int,
    common_share: float = 0.7,
    least_share: float = 0.01,
) -> dict[int, StrangeParts]:
    """Receivers whose elements or subcarriers have fixed phases or gains unlike geometry's.

    Receivers with fewer than ``MANY`` links, or without a direct wave, are left out. Elements count
    only if the directions of the direct waves differ from link to link: with one direction,
    reflections would look the same.

    Args:
        channels, waves, receivers, least_share: As for ``phase_sign``.
        frequencies: Subcarriers [Hz].
        sign: Sign of the channels' phases.
        common_share: Smallest fraction of a response's power in its mean over elements, or over
            subcarriers. Calibrated arrays reach 0.99.
    """
    strange = {}
    for receiver, response in common_responses(channels, waves, receivers, sign).items():
        at_receiver = receivers == receiver
        links = int(at_receiver.sum())
        # Fraction of the links' power in their mean; random phases keep 1 / links.
        share = response.abs().square().mean().item()
        if links < MANY or share < least_share + 4 / links:
            continue
        exists = (waves[at_receiver] != 0).any(0)  # (e, s)
        has_element = exists.any(1)
        in_band = exists.any(0)
        response = response[has_element][:, in_band]
        directions = waves[at_receiver][:, has_element][..., in_band].sgn()  # (links, e, s)
        # The power of the mean response without the part that chance leaves in it.
        by_chance = (1 - share) / links / share
        power = response.abs().square().mean() * (1 - by_chance)
        if response.mean().abs().square() > common_share * power:
            continue
        over_subcarriers = response.mean(1).abs().square().mean()
        over_elements = response.mean(0).abs().square().mean()
        # Elements resolve directions if the waves' phases between them differ from link to link.
        # ``alike`` is 1 for one direction of all links.
        between_elements = directions * directions.mean(1, keepdim=True).sgn().conj()
        alike = between_elements.mean(0).abs().square().mean()
        elements = bool(over_elements < common_share * power and alike < 0.5)
        subcarriers = bool(over_subcarriers < common_share * power)
        delay = None
        if subcarriers:
            subset = frequencies[in_band]
            rates = 2 * math.pi * (subset - subset.mean())  # [rad/s]
            advance = _best_delays(response.sum(0), rates)  # [s]
            aligned = response * torch.polar(torch.ones_like(rates), advance * rates)
            if aligned.mean().abs().square() > common_share * power:
                delay = -sign * advance.item()
        if elements or subcarriers:
            strange[receiver] = StrangeParts(elements, subcarriers, delay)
    return strange


def array_sign(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> int:
    """Sign, -1 or 1, with which phases follow the distance over elements and subcarriers.

    Each link may have a random phase and, with ``frequencies`` [Hz], a random delay. Channels
    divided by free space of the right sign keep more power in the mean over elements and
    subcarriers. The sign is -1 if both signs keep the same power. Other arguments are as for
    ``phase_sign``.
    """
    relative = _relative(channels, waves)
    powers = []
    for sign in (-1, 1):
        divided = _without_phases_of(waves, relative, sign)
        aligned = divided * alignment(divided, torch.ones_like(divided), frequencies)
        powers.append(aligned.mean((1, 2)).abs().square().sum())
    return 1 if powers[1] > powers[0] else -1


def alignment(
    channels: Complex[Tensor, "*#k e s"],
    waves: Complex[Tensor, "*#k e s"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> Complex[Tensor, "*k 1 s"]:
    """Factors of magnitude 1 that rotate channels onto waves by the best common phase.

    With ``frequencies`` [Hz] the factors are exp(j (phi + 2 pi f tau)) with the best delay tau. A
    delay is ambiguous by one over the median spacing of the subcarriers; tau is the one nearest to
    0. The result is complex128 and has no gradient.
    """
    with torch.no_grad():
        products = channels.to(torch.complex128) * waves.to(torch.complex128).conj()
        cross = products.sum(-2)  # over elements (*k, s)
        turns = torch.ones_like(cross)
        if frequencies is not None and len(frequencies) > 1:
            rates = 2 * math.pi * (frequencies - frequencies.mean()).to(cross.real)  # [rad/s]
            delays = _best_delays(cross, rates)  # (*k,) [s]
            turns = torch.polar(turns.real, delays[..., None] * rates)
        # The best common phase makes the sum over elements and subcarriers real and positive.
        total = (cross * turns).sum(-1, keepdim=True)  # (*k, 1)
        common = torch.where(total == 0, 1, total.conj().sgn())
        return (turns * common)[..., None, :]


def _best_delays(cross: Complex[Tensor, "*k s"], rates: Float[Tensor, " s"]) -> Float[Tensor, "*k"]:
    """Delays t [s] with the largest |sum over s of cross exp(j rates t)|.

    ``rates`` are angular frequencies [rad/s], ``cross`` products of channels and conjugate waves.
    """
    ordered = rates.sort().values
    span = (ordered[-1] - ordered[0]).item()
    spacing = ordered.diff().median().item()
    # A grid of a quarter of the resolution, over one period of the delay.
    step = math.pi / 2 / (span + spacing)
    count = min(4 * math.ceil(span / spacing + 1), 2**16)
    grid = step * (torch.arange(count, device=rates.device) - count // 2).to(rates)
    angles = rates[:, None] * grid  # (s, grid)
    steering = torch.polar(torch.ones_like(angles), angles)
    delays = grid[(cross @ steering).abs().argmax(-1)]
    for _ in range(4):  # Newton's method on half the square of the magnitude
        turned = cross * torch.polar(torch.ones_like(cross.real), delays[..., None] * rates)
        # Derivatives of the sum, then of |sum|² / 2.
        value = turned.sum(-1)
        slope = (1j * rates * turned).sum(-1)
        bend = ((1j * rates) ** 2 * turned).sum(-1)
        first = (value.conj() * slope).real
        second = slope.abs().square() + (value.conj() * bend).real
        # At most a step of the grid, and only where the magnitude has a maximum nearby.
        delays = delays - torch.where(second < 0, first / second, 0).clamp(-step, step)
    return delays


def unknown_phase(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
    declared: str = "known",
) -> str | None:
    """The value of ``data.phase`` that fits channels with random phases; otherwise None.

    The likeness of a link is the fraction of its power that the direct wave explains after the best
    phase. Random channels have a likeness of one over elements times subcarriers. The result is
    ``per_link`` if the mean likeness is at least a half (3 dB) and the phases of a receiver's links
    are random. The result is ``per_link_and_delay`` if the same holds after the best phase and
    delay.

    Args:
        channels, waves, receivers: As for ``phase_sign``.
        frequencies: Subcarriers [Hz].
        declared: The phase that the user declares; a likeness of a quarter confirms it.

    Returns:
        The phase. None if phases are not random, if the declared phase is confirmed, if the direct
        wave explains too little, or with fewer than ``MANY`` links a receiver.
    """
    chance = len(receivers.unique()) / max(len(receivers), 1)
    if chance > 1 / MANY:
        return None
    numbers = channels[0].numel()
    elements = channels.shape[1]
    normalised = _normalised(channels.to(torch.complex128))
    # A single reflection resembles the direct wave but for a delay, unless an array sees its
    # direction.
    for phase, delayed_frequencies, is_telling in (
        ("per_link", None, numbers >= 8),
        ("per_link_and_delay", frequencies, numbers >= 16 and elements >= 4),
    ):
        if not is_telling:
            continue
        likeness = []
        agreement = []  # of the phases of a receiver's links: 1 if equal, about 0 if random
        for wave in (_normalised(waves), _normalised(waves.conj())):  # for both signs of phases
            turns = alignment(normalised, wave, delayed_frequencies)
            aligned = (wave.conj() * normalised * turns).mean((1, 2))  # (k,)
            likeness.append(aligned.abs().square().mean().item())
            plain = (wave.conj() * normalised).mean((1, 2))  # (k,)
            sums = [plain[receivers == receiver].sum().abs() for receiver in receivers.unique()]
            agreement.append((sum(sums) / plain.abs().sum()).item())
        if max(agreement) > 3 * math.sqrt(chance):  # more than random phases would agree
            return None
        if phase == declared:
            if max(likeness) >= 0.25:
                return None
        elif max(likeness) >= 0.5:
            return phase
    return None


def _without_phases_of(
    waves: Complex[Tensor, "k e s"], channels: Complex[Tensor, "k e s"], sign: int
) -> Complex[Tensor, "k e s"]:
    """Channels with the phases of waves removed.

    The waves have the sign -1, the channels' phases have ``sign``.
    """
    # A wave has the phase -p, and a channel the phase sign p, with p = 2 pi distance / wavelength.
    phases = waves.angle()
    return channels * torch.polar(torch.ones_like(phases), sign * phases)


def _relative(
    channels: Complex[Tensor, "k e s"], waves: Complex[Tensor, "k e s"]
) -> Complex[Tensor, "k e s"]:
    """Channels over the waves' magnitudes, with a mean power of 1; 0 where a wave is 0."""
    strengths = waves.abs()
    has_wave = strengths > 0
    return _normalised(channels * has_wave / torch.where(has_wave, strengths, 1))


def _normalised(channels: Complex[Tensor, "k e s"]) -> Complex[Tensor, "k e s"]:
    """Channels scaled to a mean power of 1 each; channels of 0 stay 0."""
    powers = channels.abs().square().mean((1, 2), keepdim=True)
    return channels / torch.where(powers > 0, powers, 1).sqrt()
