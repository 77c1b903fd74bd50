"""Checks of received levels: units, signs, marks, and the law of distance."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data.checks.finding import Finding
from gaigs.data.readings import marks_of
from gaigs.io.tables import shortened


def check_levels(links: Any) -> Iterator[Finding]:
    """Findings about signs, marks, constant and equal receivers, and the law of distance."""
    query, names = links.query, [receiver.name for receiver in links.receivers]
    stands = torch.stack([receiver.pose.position for receiver in links.receivers])
    given = torch.ones(len(names), dtype=torch.bool)
    if links.uncertainties is not None:
        given = links.uncertainties == 0
    values = links.labels[torch.arange(len(links))].double()
    if positive := int((values > 0).sum()):
        yield Finding("sign of levels", f"{positive} levels are above 0 dBm", "was a sign lost?")
    for mark in marks_of(values[:, None].numpy()):
        text = f"{int((values == mark).sum())} levels are {mark:g} dBm"
        yield Finding("mark of not heard", text, "does it mean not heard?")
    places, which = query.transmitters.unique(dim=0, return_inverse=True)
    table = torch.full((len(names), len(places)), math.nan, dtype=torch.float64)
    table[query.receivers, which] = values
    heard = ~table.isnan()
    constant = [k for k in range(len(names)) if heard[k].sum() >= 5 and table[k][heard[k]].unique().numel() == 1]
    if constant:
        yield Finding("constant levels", f"levels are constant at {shortened([names[k] for k in constant])}")
    first: dict[bytes, int] = {}
    for k in set(range(len(names))) - {*constant}:
        other = first.setdefault(np.nan_to_num(table[k].numpy()).tobytes(), k)
        if other != k and heard[k].sum() >= 3:
            yield Finding("equal receivers", f"{names[other]} and {names[k]} have the same levels")
    own = given.nonzero()[:, 0]
    if len(own) < 3:
        return
    usual, exponents = misfit(table, heard, places, stands, own)
    if rising := [names[k] for k, slope in zip(own.tolist(), exponents, strict=True) if slope > 5]:
        text = f"levels rise with the distance from {shortened(rising)}"
        yield Finding("exchanged receivers", text, "are names or places exchanged?")
    others = {"x and y are exchanged": stands[:, [1, 0, 2]]}
    for factor in (1e-3, 1e-2, 0.3048, 1 / 0.3048, 1e2, 1e3):
        others[f"coordinates are times {factor:.4g}"] = stands * factor
    errors = {name: misfit(table, heard, places, moved, own)[0] for name, moved in others.items()}
    name, error = min(errors.items(), key=lambda pair: pair[1])
    if error < 0.85 * usual:
        text = f"levels follow the distance to {error:.2g} dB instead of {usual:.2g} dB if the receivers' {name}"
        yield Finding(
            "coordinates of receivers", text, read=usual, fits=error, score="error about the law of distance [dB]"
        )


def misfit(
    table: Float[Tensor, "r n"], heard: Tensor, places: Float[Tensor, "n 3"], stands: Float[Tensor, "r 3"], own: Tensor
) -> tuple[float, list[float]]:
    """Root mean square error of a + b log10(distance) at some receivers, and b of each [dB per decade]."""
    errors, slopes = [], []
    decades = torch.cdist(stands.double(), places.double()).clamp_min(0.1).log10()
    for k in own.tolist():
        x, y = decades[k][heard[k]], table[k][heard[k]]
        if len(x) < 10:
            slopes.append(0.0)
            continue
        x, y = x - x.mean(), y - y.mean()
        slopes.append(((x @ y) / x.square().sum().clamp_min(1e-12)).item())
        errors.append(y - min(slopes[-1], 0.0) * x)  # levels fall with the distance
    return (torch.cat(errors).square().mean().sqrt().item() if errors else 0.0), slopes
