"""Checks of subcarriers without geometry: guards and nulls, and the order."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.core.antenna import lacking
from gaigs.core.query import evenly
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Sample
from gaigs.io.tables import shortened


def constant_subcarriers(links: Any) -> Bool[Tensor, " s"]:
    """True for each guard or null subcarrier: all links have the same value there, at each element.

    Values that differ from 0 only by rounding count as equal. With fewer than five links no
    subcarrier is constant.
    """
    count = len(links.task.frequencies)
    chosen = torch.arange(count)
    few = evenly(torch.arange(len(links)), 64)
    # A few links exclude most subcarriers, so that all links are read at the others only.
    for index in (few, torch.arange(len(links))):
        values = links.labels[index]
        receivers = links.query.receivers[index]
        # True where the array of a link's receiver lacks the element or the subcarrier.
        absent = lacking(links.receivers, receivers, values.shape[1], links.task.frequencies)
        absent = absent[..., chosen]  # (n, e, k)
        strengths = values.abs().amax((1, 2))[:, None, None]
        values = values[..., chosen]
        # The value of the first link that has the element and the subcarrier.
        first_link = absent.int().argmin(0, keepdim=True)  # (1, e, k)
        first = values.gather(0, first_link)
        is_same = ((values == first) | absent).all(0).all(0)  # (k,)
        is_faint = (values.abs() <= 1e-6 * strengths).all(0).all(0)  # 0 but for rounding
        chosen = chosen[is_same | is_faint]
        if not len(chosen) or len(index) < 5:
            return torch.zeros(count, dtype=torch.bool)
    return torch.zeros(count, dtype=torch.bool).index_fill(0, chosen, True)


def constant_sentence(constant: Bool[Tensor, " s"], frequencies: Float[Tensor, " s"]) -> str:
    """A sentence that lists the constant subcarriers; {} stands for a verb."""
    named = shortened([f"{carrier / 1e9:.6g}" for carrier in frequencies[constant].tolist()])
    return (
        f"{int(constant.sum())} of {len(constant)} subcarriers have one value in every link, {{}}: "
        f"{named} GHz"
    )


def check_constant_subcarriers(links: Any) -> Iterator[Finding]:
    """A finding about ``constant_subcarriers``."""
    constant = constant_subcarriers(links)
    if constant.any() and not constant.all():
        text = constant_sentence(constant, links.task.frequencies)
        yield Finding(
            "constant subcarriers", text.format("as guard or null subcarriers"), "leave them out"
        )


def check_powers(sample: Sample) -> Iterator[Finding]:
    """A finding about subcarriers whose power is 30 dB from the median, such as pilots."""
    powers = sample.labels.abs().square().mean((0, 1)).clamp_min(1e-300)  # (s,)
    odd = (10 * (powers / powers.median()).log10()).abs() > 30
    if len(sample.labels) >= 5 and odd.any():
        named = shortened([f"{carrier / 1e9:.6g}" for carrier in sample.frequencies[odd].tolist()])
        text = (
            f"{int(odd.sum())} of {len(odd)} subcarriers are 30 dB or more from the usual one in "
            f"power: {named} GHz"
        )
        yield Finding(
            "power of subcarriers", text, "leave them out if they are guards, or scale them alike"
        )


def order_of_subcarriers(sample: Sample) -> Finding | None:
    """A finding if channels jump within the band, and continue from its end to its start.

    The order of an FFT has this property. A jump is a low correlation of neighbouring subcarriers.
    Phases and delays of links do not change this correlation. None if the order seems right.
    """
    order = sample.frequencies.argsort()
    count = len(order)
    values = sample.labels[:, :8, order]
    if count < 8 or values.shape[:2].numel() < 64:
        return None
    powers = values.abs().square().mean((1, 2), keepdim=True)
    values = values / torch.where(powers > 0, powers, 1).sqrt()
    # Phase from each subcarrier to the next; the last step leads from the band's end to its start.
    steps = values.roll(-1, 2) * values.conj()  # (n, e, s)
    # A link's delay turns all its steps by one angle, which is removed.
    turn = steps.sum((1, 2), keepdim=True).sgn().conj()  # (n, 1, 1)
    single = (steps * turn).sum((0, 1)).abs()  # (s,)
    # Where a subcarrier is left out between two, the phase turns twice as far.
    double = (steps * turn**2).sum((0, 1)).abs()  # (s,)
    likeness = torch.maximum(single, double) / steps.abs().sum((0, 1)).clamp_min(1e-300)
    usual = likeness.median().item()
    around = likeness[-1].item()  # from the last subcarrier to the first
    jump = int(likeness[:-1].argmin())
    least = likeness[jump].item()
    bound = min(usual, around) - 0.3
    if not (usual > 0.6 and around > 0.6 and (likeness < bound).sum() == 1 and least < bound):
        return None
    after = jump + 1
    mend = f"h = np.roll(h, {-after}, axis=-1)"
    if after == math.ceil(count / 2):
        mend = "h = np.fft.fftshift(h, axes=-1)"
    elif after == count // 2:
        mend = "h = np.fft.ifftshift(h, axes=-1)"
    if not torch.equal(order, torch.arange(count)):
        mend = "frequencies = np.sort(frequencies)"
    text = (
        f"channels jump at subcarrier {after} of {count}, with a correlation of {least:.2f}, and "
        f"go on from the last subcarrier to the first, with {around:.2f}: FFT order?"
    )
    return Finding(
        "order of subcarriers",
        text,
        mend,
        read=least,
        fits=around,
        score="correlation of subcarriers",
    )
