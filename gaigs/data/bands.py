"""Subcarriers held out for the test: other parts of the band, or another band."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gaigs.core.query import check_carrier
from gaigs.core.task.csi import Csi
from gaigs.data import Links, kept_links


def hold_out_band(
    links: Links, band_train: Sequence[float] | None, band_test: Sequence[float] | None
) -> Links:
    """Channels with the subcarriers of one band, whose ``held_out`` have those of another.

    Args:
        links: Channels at all subcarriers.
        band_train: Lowest and highest subcarrier to train and validate on [Hz]; None: all, and none
            is held out.
        band_test: Lowest and highest subcarrier to test on [Hz], less those to train on; None: all
            the others.

    Raises:
        ValueError: A band is not two carriers in ascending order, or has no subcarrier.
    """
    if band_train is None:
        if band_test is not None:
            raise ValueError("data.band_test needs data.band_train, the subcarriers to train on")
        return links
    task: Csi = links.task
    chosen = _within(task, "band_train", band_train)
    others = ~chosen & (
        torch.tensor(True) if band_test is None else _within(task, "band_test", band_test)
    )
    if not others.any():
        raise ValueError(
            f"data.band_train={[*band_train]} leaves no subcarrier to test on; choose a narrower band"
        )
    own, rest = task.frequencies[chosen], task.frequencies[others]
    heard = [
        part.abs().amax((1, 2)) > 0
        for part in (links.labels[..., chosen], links.labels[..., others])
    ]
    kept = heard[0] & heard[1]
    if silent := int((~kept).sum()):
        remarks = "; ".join(
            filter(None, (links.remarks, f"{silent} that are zero in a band are left out"))
        )
        links = replace(kept_links(links, kept), remarks=remarks)
    carriers = torch.full((len(links),), (own.min() + own.max()).item() / 2)
    links = replace(links, query=replace(links.query, frequencies=carriers))
    part = lambda which, some: replace(
        links, labels=links.labels[..., which], task=Csi(task.elements, some, task.phase)
    )
    return replace(part(chosen, own), held_out=part(others, rest))


def _within(task: Csi, option: str, band: Sequence[float]) -> Tensor:
    """True for each subcarrier in a band, to the precision of float64."""
    check_carrier(f"data.{option}", torch.tensor(band, dtype=torch.float64))
    if len(band) != 2 or not band[0] <= band[1]:
        raise ValueError(
            f"data.{option} must be the lowest and the highest subcarrier [Hz], got {[*band]}"
        )
    found = (task.frequencies >= band[0] * (1 - 1e-9)) & (task.frequencies <= band[1] * (1 + 1e-9))
    if not found.any():
        span = f"{task.frequencies.min():.7g} to {task.frequencies.max():.7g} Hz"
        raise ValueError(f"data.{option}={[*band]} has no subcarrier; they lie from {span}")
    return found
