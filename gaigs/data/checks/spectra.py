"""Checks of spatial spectra: constant ones, and directions that do not point to the transmitters."""

from collections.abc import Iterator
from typing import Any

import torch

from gaigs.data.checks.finding import Finding
from gaigs.task.spectrum import SSIM_WINDOW


def check_spectra(links: Any) -> Iterator[Finding]:
    """Findings about spectra.

    Raises:
        ValueError: All spectra are constant, or too small for SSIM.
    """
    yield from check_extremes(links)


def check_extremes(links: Any) -> Iterator[Finding]:
    """Counts of constant spectra, and of min-max spectra without a pixel of 0 or of 1."""
    task, labels = links.task, links.labels
    if min(task.shape) < SSIM_WINDOW:
        rows, columns = task.shape
        raise ValueError(f"spectra must have {SSIM_WINDOW} x {SSIM_WINDOW} pixels or more, got {rows} x {columns}")
    parts = (labels[index].flatten(1) for index in torch.arange(len(labels)).split(256))
    low, high = torch.cat([torch.stack((part.amin(1), part.amax(1)), 1) for part in parts]).T
    constant = low == high
    if constant.all():
        raise ValueError(f"a spectrum must have pixels of different values; all {len(labels)} are constant")
    lacking = torch.zeros_like(constant)
    if task.normalisation.startswith("min-max"):
        lacking = ((low != 0) | (high != 1)) & ~constant
    for which, defect in ((constant, "are constant"), (lacking, "lack a pixel of 0 or of 1")):
        if which.any():
            first = int(which.nonzero()[0])
            span = f"{low[first]:.3g} to {high[first]:.3g}"
            yield Finding(
                "range of spectra",
                f"{int(which.sum())} of {len(labels)} spectra {defect}, first that of link {first}, {span}",
            )
