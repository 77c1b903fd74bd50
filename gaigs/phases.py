"""Phases of measured channels: their sign, their alignment to waves, and whether links have one in common."""

import math

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

TELLING = 5
"""Fewest links of a receiver that show a sign of the phases; with fewer, chance decides."""


def phase_sign(
    channels: Complex[Tensor, "k e s"], waves: Complex[Tensor, "k e s"], receivers: Int[Tensor, " k"]
) -> int:
    """The sign with which the phases of channels follow the direct distance: -1 or 1; 0 for neither.

    Divided by free space, a direct path alone is the same number at all links of a receiver. For each sign, the mean
    over links keeps a share of the power, by chance about 1 / links. The larger share wins if it exceeds 0.01 plus four
    times that of chance: never with fewer than ``TELLING`` links a receiver. ``waves`` are ``direct_waves`` of the same
    links with the sign -1.
    """
    relative, phases = _relative(channels, waves), waves.angle()
    kept = {-1: 0.0, 1: 0.0}
    for receiver in receivers.unique().tolist():
        own = receivers == receiver
        for sign in kept:
            still = relative[own] * torch.polar(torch.ones_like(phases[own]), sign * phases[own])
            kept[sign] += int(own.sum()) * still.mean(0).abs().square().mean().item()
    total = relative.abs().square().mean().item() * len(receivers)
    best = max(kept, key=kept.__getitem__)
    chance = len(receivers.unique()) / len(receivers)
    return best if kept[best] > (0.01 + 4 * chance) * total else 0


def array_sign(
    channels: Complex[Tensor, "k e s"], waves: Complex[Tensor, "k e s"], frequencies: Float[Tensor, " s"] | None = None
) -> int:
    """The sign with which phases follow the direct distance from one element or subcarrier of a link to another.

    It shows even where each link has a random phase in common; with ``frequencies`` [Hz], a random delay too. The sign,
    -1 or 1, keeps more power in the mean over elements and subcarriers; -1 where neither does. Other arguments are as
    for ``phase_sign``.
    """
    relative, phases = _relative(channels, waves), waves.angle()
    kept = []
    for sign in (-1, 1):
        still = relative * torch.polar(torch.ones_like(phases), sign * phases)
        kept.append((still * alignment(still, torch.ones_like(still), frequencies)).mean((1, 2)).abs().square().sum())
    return 1 if kept[1] > kept[0] else -1


def alignment(
    channels: Complex[Tensor, "*#k e s"],
    waves: Complex[Tensor, "*#k e s"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> Complex[Tensor, "*k 1 s"]:
    """Factors of magnitude 1 that turn channels onto waves by the best phase in common; complex128, without gradients.

    With ``frequencies`` [Hz] they are those of the best phase and delay: exp(j (phi + 2 pi f tau)). Delays repeat with
    one over the median spacing of the subcarriers; the least is within half of that period.
    """
    with torch.no_grad():
        cross = (channels.to(torch.complex128) * waves.to(torch.complex128).conj()).sum(-2)
        turns = torch.ones_like(cross)
        if frequencies is not None and len(frequencies) > 1:
            rates = 2 * math.pi * (frequencies - frequencies.mean()).to(cross.real)
            turns = torch.polar(turns.real, _best_delays(cross, rates)[..., None] * rates)
        total = (cross * turns).sum(-1, keepdim=True)
        return (turns * torch.where(total == 0, 1, total.conj().sgn()))[..., None, :]


def _best_delays(cross: Complex[Tensor, "*k s"], rates: Float[Tensor, " s"]) -> Float[Tensor, "*k"]:
    """Delays t [s] with the largest |sum over s of cross exp(j rates t)|, by a grid and Newton's method."""
    ordered = rates.sort().values
    span, spacing = (ordered[-1] - ordered[0]).item(), ordered.diff().median().item()
    step = math.pi / 2 / (span + spacing)
    count = min(4 * math.ceil(span / spacing + 1), 2**16)
    grid = step * (torch.arange(count, device=rates.device) - count // 2).to(rates)
    steering = torch.polar(torch.ones_like(rates[:, None] * grid), rates[:, None] * grid)
    delays = grid[(cross @ steering).abs().argmax(-1)]
    for _ in range(4):
        turned = cross * torch.polar(torch.ones_like(cross.real), delays[..., None] * rates)
        value, slope, bend = (((1j * rates) ** power * turned).sum(-1) for power in range(3))
        first = (value.conj() * slope).real
        second = slope.abs().square() + (value.conj() * bend).real
        delays = delays - torch.where(second < 0, first / second, 0).clamp(-step, step)
    return delays


def unknown_phase(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
) -> str | None:
    """The ``data.phase`` of channels that resemble the direct wave within each link, but by no phase in common.

    A link's likeness is the share of its power that the direct wave explains after the best phase, at chance one over
    the numbers of a channel. If its mean is at least a half, 3 dB, and the phases of a receiver's links are as random
    as by chance, this is ``per_link``; after the best phase and delay ``per_link_and_delay``. None if the phases agree,
    if the direct wave explains too little to say, or with fewer than 30 links a receiver. ``waves`` are
    ``direct_waves`` of the same links.
    """
    chance = len(receivers.unique()) / max(len(receivers), 1)
    if chance > 1 / 30:
        return None
    numbers, elements = channels[0].numel(), channels.shape[1]
    normalised = _normalised(channels.to(torch.complex128))
    # A single reflection resembles the direct wave but for a delay, unless an array sees its direction.
    for phase, rates, is_telling in (
        ("per_link", None, numbers >= 8),
        ("per_link_and_delay", frequencies, numbers >= 16 and elements >= 4),
    ):
        if not is_telling:
            continue
        likeness, agreement = [], []
        for wave in (_normalised(waves), _normalised(waves.conj())):
            turns = alignment(normalised, wave, rates)
            likeness.append((wave.conj() * normalised * turns).mean((1, 2)).abs().square().mean().item())
            plain = (wave.conj() * normalised).mean((1, 2))
            sums = [plain[own].sum().abs() for own in (receivers == k for k in receivers.unique())]
            agreement.append((sum(sums) / plain.abs().sum()).item())
        if max(agreement) > 3 * math.sqrt(chance):
            return None
        if max(likeness) >= 0.5:
            return phase
    return None


def _relative(channels: Complex[Tensor, "k e s"], waves: Complex[Tensor, "k e s"]) -> Complex[Tensor, "k e s"]:
    """Channels over the waves' magnitudes, of a mean power of 1 each; 0 at elements without a wave."""
    strengths = waves.abs()
    return _normalised(channels * (strengths > 0) / torch.where(strengths > 0, strengths, 1))


def _normalised(channels: Complex[Tensor, "k e s"]) -> Complex[Tensor, "k e s"]:
    """Channels of a mean power of 1 each; channels of 0 stay 0."""
    powers = channels.abs().square().mean((1, 2), keepdim=True)
    return channels / torch.where(powers > 0, powers, 1).sqrt()
