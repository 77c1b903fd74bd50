"""Bands of channels: several bands, and subcarriers held out for the test."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gaigs.core.antenna import Receiver
from gaigs.core.query import Query, check_carrier
from gaigs.core.task.csi import Csi
from gaigs.data import Links, kept_links
from gaigs.io.tables import number_places


def hold_out_band(
    links: Links, band_train: Sequence[float] | None, band_test: Sequence[float] | None
) -> Links:
    """The channels in one band, with the same links in another band as ``held_out``.

    Args:
        band_train: Lowest and highest subcarrier to train and validate on [Hz]. None: all
            subcarriers, and nothing is held out.
        band_test: Lowest and highest subcarrier to test on [Hz], without the subcarriers of
            ``band_train``. None: all other subcarriers.

    Raises:
        ValueError: A band is not two frequencies in ascending order, or has no subcarrier.
    """
    if band_train is None:
        if band_test is not None:
            raise ValueError("data.band_test needs data.band_train, the subcarriers to train on")
        return links
    task: Csi = links.task
    chosen = _within(task, "band_train", band_train)
    others = ~chosen
    if band_test is not None:
        others &= _within(task, "band_test", band_test)
    if not others.any():
        raise ValueError(
            f"data.band_train={[*band_train]} leaves no subcarrier to test on; "
            "choose a narrower band"
        )
    # A link needs a signal to train on and a signal to test on.
    has_both = _has_signal(links, chosen) & _has_signal(links, others)  # (n,)
    if silent := int((~has_both).sum()):
        remark = f"{silent} that are zero in a band are left out"
        remarks = f"{links.remarks}; {remark}" if links.remarks else remark
        links = replace(kept_links(links, has_both), remarks=remarks)
    trained = task.frequencies[chosen]
    carriers = torch.full((len(links),), (trained.min() + trained.max()).item() / 2)
    links = replace(links, query=replace(links.query, frequencies=carriers))
    return replace(_at(links, chosen), held_out=_at(links, others))


def in_bands(parts: Sequence[Links], gap: float = 1.2) -> Links:
    """Channels of several bands, where each receiver counts as one radio for each band.

    A band ends where the next frequency is more than ``gap`` times higher. Four or more evenly
    spaced subcarriers of a part are never divided. Links of one place share a row.

    Args:
        parts: Channels of one site, for example one part for each band. Receivers at one place are
            the same receiver.
        gap: Largest ratio of neighbouring frequencies within a band.

    Raises:
        ValueError: Parts have different phases, or different subcarriers or arrays within a band.
    """
    frequencies = torch.cat([part.task.frequencies for part in parts]).unique()  # ascending (s,)
    is_end = frequencies[1:] > gap * frequencies[:-1]  # (s - 1,)
    for part in parts:
        sweep = part.task.frequencies.sort().values
        steps = sweep.diff()
        # Coarse steps of one sweep, such as of an ultra-wideband sounder, are one band.
        if len(sweep) > 3 and steps.max() < 1.01 * steps.min():
            is_end &= (frequencies[1:] <= sweep[0]) | (frequencies[:-1] >= sweep[-1])
    ends = is_end.nonzero()[:, 0]
    if len(parts) == 1 and not len(ends):
        return parts[0]
    phases = {part.task.phase for part in parts}
    if len(phases) > 1:
        raise ValueError(f"all bands must have one data.phase, got {sorted(phases)}")
    # Limits half-way on a logarithmic scale, so that each frequency is in a band.
    inner = (frequencies[ends] * frequencies[ends + 1]).sqrt()
    limits = [0.0, *inner.tolist(), math.inf]
    pieces = []  # the links of one receiver in one band each
    for part, band in itertools.product(parts, itertools.pairwise(limits)):
        pieces += list(_pieces(part, band, frequencies))
    elements = max(piece.labels.shape[1] for piece in pieces)
    padded = []  # smaller arrays get elements with channels of 0
    for piece in pieces:
        padded.append(pad(piece.labels, (0, 0, 0, elements - piece.labels.shape[1])))
    names = _name([piece.receivers[0] for piece in pieces], frequencies if len(ends) else None)
    receivers: dict[str, Receiver] = {}
    for piece, name in zip(pieces, names, strict=True):
        receiver = piece.receivers[0]
        known = receivers.setdefault(name, replace(receiver, name=name))
        if not torch.equal(known.array.elements, receiver.array.elements):
            raise ValueError(f"{name} has two arrays in one band; give one of them another place")
    transmitters = torch.cat([piece.query.transmitters for piece in pieces])
    numbers = torch.tensor([[*receivers].index(name) for name in names])
    counts = torch.tensor([*map(len, pieces)])
    carrier = (frequencies[0] + frequencies[-1]).item() / 2
    remarks = [part.remarks for part in parts]
    remarks.append(f"{len(ends) + 1} bands: {', '.join(receivers)}")
    return Links(
        query=Query(
            transmitters,
            numbers.repeat_interleave(counts),
            torch.full((len(transmitters),), carrier),
        ),
        receivers=tuple(receivers.values()),
        labels=torch.cat(padded),
        task=Csi(elements, frequencies, phases.pop()),
        rows=number_places(transmitters.tolist())[1],
        remarks="; ".join(filter(None, remarks)),
    )


def _pieces(
    part: Links, band: tuple[float, float], frequencies: Float[Tensor, " s"]
) -> Iterator[Links]:
    """The links of each receiver of a part in one band, with labels at all subcarriers.

    Labels are 0 outside the band. Receivers without a signal in the band are left out.

    Args:
        band: Lower and upper limit [Hz].
        frequencies: Subcarriers of all parts [Hz].
    """
    for number, antenna in enumerate(part.receivers):
        receiver = replace(antenna, band=band)
        in_part = receiver.hears(part.task.frequencies)
        is_received = (part.labels[..., in_part] != 0).flatten(1).any(1)
        links = kept_links(part, is_received & (part.query.receivers == number))
        if not len(links):
            continue
        given = part.task.frequencies[in_part].sort()  # ascending, as ``frequencies``
        in_all = receiver.hears(frequencies)
        if not torch.equal(given.values, frequencies[in_all]):
            raise ValueError(
                f"files of one band must have the same subcarriers, got {len(given.values)} of "
                f"{int(in_all.sum())} near {given.values[0] / 1e9:.4g} GHz; join their arrays, or "
                "leave the others out"
            )
        labels = links.labels.new_zeros(*links.labels.shape[:2], len(frequencies))
        labels[..., in_all] = links.labels[..., in_part][..., given.indices]
        yield replace(links, receivers=(receiver,), labels=labels)


def _name(receivers: Sequence[Receiver], frequencies: Float[Tensor, " s"] | None) -> list[str]:
    """Names ``rx0``, ``rx1`` ... by place and, with frequencies [Hz], by band: ``rx0 2.4 GHz``."""
    places = [receiver.pose.position.tolist() for receiver in receivers]
    names = []
    for receiver, place in zip(receivers, number_places(places)[1], strict=True):
        name = f"rx{place}"
        if frequencies is not None:
            middle = frequencies[receiver.hears(frequencies)].mean().item()
            name += f" {middle / 1e9:.4g} GHz"
        names.append(name)
    return names


def _within(task: Csi, option: str, band: Sequence[float]) -> Bool[Tensor, " s"]:
    """True for each subcarrier in a band, to the precision of float64."""
    check_carrier(f"data.{option}", torch.tensor(band, dtype=torch.float64))
    if len(band) != 2 or not band[0] <= band[1]:
        raise ValueError(
            f"data.{option} must be the lowest and the highest subcarrier [Hz], got {[*band]}"
        )
    low, high = band
    is_above = task.frequencies >= low * (1 - 1e-9)
    is_within = is_above & (task.frequencies <= high * (1 + 1e-9))
    if not is_within.any():
        span = f"{task.frequencies.min():.7g} to {task.frequencies.max():.7g} Hz"
        raise ValueError(f"data.{option}={[*band]} has no subcarrier; they lie from {span}")
    return is_within


def _has_signal(links: Links, subcarriers: Bool[Tensor, " s"]) -> Bool[Tensor, " n"]:
    """True for links whose label differs from 0 at one of the ``subcarriers`` or more."""
    return links.labels[..., subcarriers].abs().amax((1, 2)) > 0


def _at(links: Links, subcarriers: Bool[Tensor, " s"]) -> Links:
    """Links with labels at these ``subcarriers`` only."""
    task: Csi = links.task
    part = Csi(task.elements, task.frequencies[subcarriers], task.phase)
    return replace(links, labels=links.labels[..., subcarriers], task=part)
