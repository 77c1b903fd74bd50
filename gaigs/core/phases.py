"""Phases of measured channels: their sign, their alignment to waves, and whether links have one in
common.
"""

import math

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

TELLING = 5
"""Fewest links of a receiver that show a sign of the phases; with fewer, chance decides."""

MANY = 30
"""Fewest links a receiver that tell random phases, and phases that geometry does not explain, from
chance.
"""

LEAST = 0.01
"""Least share of the power that the direct wave keeps in a mean over links, beside that of chance.
"""

ALIKE = 0.7
"""Least share of a mean response that elements or subcarriers have in common; of calibrated arrays
it is 0.99.
"""


def phase_sign(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
) -> int:
    """The sign with which the phases of channels follow the direct distance: -1 or 1; 0 for
    neither.

    Divided by free space, a direct path alone is the same number at all links of a receiver. For
    each sign, the mean over links keeps a share of the power, by chance about 1 / links. The larger
    share wins if it exceeds 0.01 plus four times that of chance: never with fewer than ``TELLING``
    links a receiver. ``waves`` are ``direct_waves`` of the same links with the sign -1.
    """
    kept, heard = {}, max(1, int((channels.abs().amax((1, 2)) > 0).sum()))
    for sign in (-1, 1):
        responses = common_responses(channels, waves, receivers, sign)
        powers = [
            (receivers == k).sum() * response.abs().square().mean()
            for k, response in responses.items()
        ]
        kept[sign] = float(sum(powers)) / heard
    best = max(kept, key=kept.__getitem__)
    chance = len(receivers.unique()) / len(receivers)
    return best if kept[best] > LEAST + 4 * chance else 0


def common_responses(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    sign: int,
) -> dict[int, Complex[Tensor, "e s"]]:
    """Mean of each receiver's channels over free space, by its number; arguments are as for
    ``phase_sign``.

    It is one number for all elements and subcarriers, as far as their places and frequencies are
    true.
    """
    relative, phases = _relative(channels, waves), waves.angle()
    still = relative * torch.polar(torch.ones_like(phases), sign * phases)
    return {
        receiver: still[receivers == receiver].mean(0) for receiver in receivers.unique().tolist()
    }


def strange_parts(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
    sign: int,
) -> dict[int, tuple[bool, bool, float | None]]:
    """Receivers at which the direct wave has fixed phases or strengths that geometry does not
    explain.

    Of each the result says whether elements have them, whether subcarriers do, and the delay [s]
    that explains the latter if one does. A receiver counts with ``MANY`` links or more that have a
    direct wave, its elements if the waves come from directions that they tell apart: from one
    direction, reflections look the same. Other arguments are as for ``phase_sign``.
    """
    found = {}
    for receiver, response in common_responses(channels, waves, receivers, sign).items():
        own, shown = receivers == receiver, response.abs().square().mean().item()
        count, heard = int(own.sum()), (waves[receivers == receiver] != 0).any(2).any(0)
        if count < MANY or shown < LEAST + 4 / count:
            continue
        response, turns = response[heard], waves[own][:, heard].sgn()
        power = response.abs().square().mean() * (
            1 - (1 - shown) / count / shown
        )  # without that of chance
        if response.mean().abs().square() > ALIKE * power:
            continue
        by_element, by_subcarrier = (
            response.mean(axis).abs().square().mean() < ALIKE * power for axis in (0, 1)
        )
        aside = (turns * turns.mean(1, keepdim=True).sgn().conj()).mean(0).abs().square().mean()
        elements, subcarriers, delay = bool(by_element and aside < 0.5), bool(by_subcarrier), None
        if subcarriers:
            rates = 2 * math.pi * (frequencies - frequencies.mean())
            late = _best_delays(response.sum(0), rates)
            if (
                response * torch.polar(torch.ones_like(rates), late * rates)
            ).mean().abs().square() > ALIKE * power:
                delay = -sign * late.item()
        if elements or subcarriers:
            found[receiver] = elements, subcarriers, delay
    return found


def array_sign(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> int:
    """The sign with which phases follow the direct distance from one element or subcarrier of a
    link to another.

    It shows even where each link has a random phase in common; with ``frequencies`` [Hz], a random
    delay too. The sign, -1 or 1, keeps more power in the mean over elements and subcarriers; -1
    where neither does. Other arguments are as for ``phase_sign``.
    """
    relative, phases = _relative(channels, waves), waves.angle()
    kept = []
    for sign in (-1, 1):
        still = relative * torch.polar(torch.ones_like(phases), sign * phases)
        kept.append(
            (still * alignment(still, torch.ones_like(still), frequencies))
            .mean((1, 2))
            .abs()
            .square()
            .sum()
        )
    return 1 if kept[1] > kept[0] else -1


def alignment(
    channels: Complex[Tensor, "*#k e s"],
    waves: Complex[Tensor, "*#k e s"],
    frequencies: Float[Tensor, " s"] | None = None,
) -> Complex[Tensor, "*k 1 s"]:
    """Factors of magnitude 1 that turn channels onto waves by the best phase in common; complex128,
    without gradients.

    With ``frequencies`` [Hz] they are those of the best phase and delay: exp(j (phi + 2 pi f tau)).
    Delays repeat with one over the median spacing of the subcarriers; the least is within half of
    that period.
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
    """Delays t [s] with the largest |sum over s of cross exp(j rates t)|, by a grid and Newton's
    method.
    """
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
    declared: str = "known",
) -> str | None:
    """The ``data.phase`` of channels that resemble the direct wave within each link, but by no
    phase in common.

    A link's likeness is the share of its power that the direct wave explains after the best phase,
    at chance one over the numbers of a channel. If its mean is at least a half, 3 dB, and the
    phases of a receiver's links are as random as by chance, this is ``per_link``; after the best
    phase and delay ``per_link_and_delay``. None if the phases agree, if the direct wave explains
    too little to say, or with fewer than 30 links a receiver. With the ``declared`` phase a quarter
    is enough: it stays. ``waves`` are ``direct_waves`` of the same links.
    """
    chance = len(receivers.unique()) / max(len(receivers), 1)
    if chance > 1 / MANY:
        return None
    numbers, elements = channels[0].numel(), channels.shape[1]
    normalised = _normalised(channels.to(torch.complex128))
    # A single reflection resembles the direct wave but for a delay, unless an array sees its
    # direction.
    for phase, rates, is_telling in (
        ("per_link", None, numbers >= 8),
        ("per_link_and_delay", frequencies, numbers >= 16 and elements >= 4),
    ):
        if not is_telling:
            continue
        likeness, agreement = [], []
        for wave in (_normalised(waves), _normalised(waves.conj())):
            turns = alignment(normalised, wave, rates)
            likeness.append(
                (wave.conj() * normalised * turns).mean((1, 2)).abs().square().mean().item()
            )
            plain = (wave.conj() * normalised).mean((1, 2))
            sums = [plain[own].sum().abs() for own in (receivers == k for k in receivers.unique())]
            agreement.append((sum(sums) / plain.abs().sum()).item())
        if max(agreement) > 3 * math.sqrt(chance):
            return None
        if phase == declared:
            if max(likeness) >= 0.25:
                return None
        elif max(likeness) >= 0.5:
            return phase
    return None


def _relative(
    channels: Complex[Tensor, "k e s"], waves: Complex[Tensor, "k e s"]
) -> Complex[Tensor, "k e s"]:
    """Channels over the waves' magnitudes, of a mean power of 1 each; 0 at elements without a wave."""
    strengths = waves.abs()
    return _normalised(channels * (strengths > 0) / torch.where(strengths > 0, strengths, 1))


def _normalised(channels: Complex[Tensor, "k e s"]) -> Complex[Tensor, "k e s"]:
    """Channels of a mean power of 1 each; channels of 0 stay 0."""
    powers = channels.abs().square().mean((1, 2), keepdim=True)
    return channels / torch.where(powers > 0, powers, 1).sqrt()
