"""Subcarriers held out for the test: other parts of the band, or another band."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gaigs.core.query import check_carrier
from gaigs.core.task.csi import Csi
from gaigs.data import Links, kept_links


def hold_out_band(
    links: Links, band_train: Sequence[float] | None, band_test: Sequence[float] | None
) -> Links:
    """Channels with the subcarriers of one band, whose ``held_out`` have another band's.

    Args:
        band_train: Lowest and highest subcarrier to train and validate on [Hz]; None for all, with
            none held out.
        band_test: Lowest and highest subcarrier to test on [Hz], except those to train on; None for
            all others.

    Raises:
        ValueError: A band is not two carriers in ascending order, or has no subcarrier.
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
    has_both = _has_signal(links, chosen) & _has_signal(links, others)  # (n,)
    if silent := int((~has_both).sum()):
        remark = f"{silent} that are zero in a band are left out"
        remarks = f"{links.remarks}; {remark}" if links.remarks else remark
        links = replace(kept_links(links, has_both), remarks=remarks)
    trained = task.frequencies[chosen]
    carriers = torch.full((len(links),), (trained.min() + trained.max()).item() / 2)
    links = replace(links, query=replace(links.query, frequencies=carriers))
    return replace(_at(links, chosen), held_out=_at(links, others))


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
    return links.labels[..., subcarriers].abs().amax((1, 2)) > 0


def _at(links: Links, subcarriers: Bool[Tensor, " s"]) -> Links:
    """Links with the labels of some subcarriers."""
    task: Csi = links.task
    part = Csi(task.elements, task.frequencies[subcarriers], task.phase)
    return replace(links, labels=links.labels[..., subcarriers], task=part)
