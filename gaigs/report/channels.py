"""Complex channels beside their predictions: over frequency, and as impulse responses over delay."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Complex, Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.report.style import COLUMN, MARKERS, PAGE, SKY, STYLE

DEPTH = 60
"""How far below the label's peak magnitudes are shown [dB]."""

FEW = 32
"""Most subcarriers that are marked one by one."""

OVERSAMPLING = 4
"""Delays for each that the bandwidth resolves, so that no peak falls between two."""

DELAYS = 256, 2**14
"""Fewest and most delays of an impulse response, however few or unevenly spaced the subcarriers are."""

FAINT = 25
"""A panel of an impulse response ends where all that follows is so far below the label's peak [dB]."""

LABEL = 48
"""Characters for which an axis of one column has room."""

LOOKS = {
    "predicted": {"color": SKY, "linewidth": 2.4, "markersize": 5},
    "measured": {"color": "0.1", "linewidth": 0.8, "markersize": 2},
}
"""A thin dark line upon a broad pale one: both are seen where they lie upon each other, in grey print too."""


def magnitudes_and_phases(
    labels: Complex[ndarray, "k e s"],
    predictions: Complex[ndarray, "k e s"],
    snr: Float[ndarray, "k"],
    names: Sequence[str],
    frequencies: Float[ndarray, "s"],
) -> Figure:
    """Magnitude and phase over frequency, one link a row, at the element where the label is strongest.

    Args:
        labels: Measured channels.
        predictions: Predicted ones, in the same unit.
        snr: Score of each prediction [dB].
        names: What to call each row.
        frequencies: Of the subcarriers, in any order [Hz].
    """
    order = np.argsort(frequencies)
    frequencies = frequencies[order]
    scale, unit = (1e9, "GHz") if frequencies[-1] >= 1e9 else (1e6, "MHz")
    mark = {"marker": "o"} if len(frequencies) <= FEW else {}
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 1.35 * len(labels) + 0.7), layout="constrained")
        axes = figure.subplots(len(labels), 2, sharex=True, squeeze=False)
        rows = zip(axes, labels[..., order], predictions[..., order], _titles(labels, snr, names), strict=True)
        for (magnitude, phase), label, prediction, (title, element) in rows:
            pair = np.stack((prediction[element], label[element]))
            levels, angles = _decibels(pair), np.rad2deg(np.angle(pair))
            for name, level, angle in zip(LOOKS, levels, angles, strict=True):
                look = LOOKS[name] | {"label": name} | mark
                magnitude.plot(frequencies / scale, level, **look)
                _draw_phase(phase, frequencies / scale, angle, **look)
            magnitude.set(title=title, ylabel="|h| [dB]", ylim=_limits(levels))
            phase.set(ylabel="phase [deg]", ylim=(-190, 190))
            phase.yaxis.set_major_locator(MultipleLocator(90))
        for ax in axes.flat:
            ax.grid()
            ax.ticklabel_format(axis="x", style="plain", useOffset=False)
            ax.locator_params(axis="x", nbins=5)
        for ax in axes[-1]:
            ax.set_xlabel(f"frequency [{unit}]")
        figure.legend(handles=axes[0, 0].lines[::-1], loc="outside lower center", ncols=2)
    return figure


def impulse_responses(
    labels: Complex[ndarray, "k e s"],
    predictions: Complex[ndarray, "k e s"],
    snr: Float[ndarray, "k"],
    names: Sequence[str],
    frequencies: Float[ndarray, "s"],
) -> Figure:
    """Magnitude over delay, relative to the label's peak, at the element where the label is strongest.

    The impulse response is the Fourier sum over the subcarriers, weighted by a Hann window over the band. It repeats
    after one over the spacing of the subcarriers, so one such period is computed, by their median spacing. It begins
    before 0 by what the window blurs a path at 0, at most a quarter of the period; a panel ends where nothing follows
    but what is ``FAINT``.

    Args:
        labels: Measured channels.
        predictions: Predicted ones, in the same unit.
        snr: Score of each prediction [dB].
        names: What to call each panel.
        frequencies: Of the subcarriers, in any order, evenly spaced or not [Hz].

    Raises:
        ValueError: There are not two different frequencies.
    """
    delays = _delays(frequencies)
    titles = _titles(labels, snr, names)
    pairs = np.stack([(guess[e], label[e]) for label, guess, (_, e) in zip(labels, predictions, titles, strict=True)])
    levels = _decibels(_fourier_sum(_hann(frequencies) * pairs, frequencies, delays))  # (k, 2, delays)
    levels -= levels[:, 1:].max(-1, keepdims=True)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 2.7), layout="constrained")
        axes = figure.subplots(1, len(labels), sharey=True, squeeze=False)[0]
        for ax, pair, (title, _) in zip(axes, levels, titles, strict=True):
            for name, level in zip(LOOKS, pair, strict=True):
                ax.plot(1e9 * delays, level, **LOOKS[name], label=name)
            last = delays[(pair > -FAINT).any(0)].max()
            end = min(last + 0.1 * (last - delays[0]), delays[-1])
            ax.set(xlabel="delay [ns]", xlim=(1e9 * delays[0], 1e9 * end), title=title.replace(", ", "\n", 1))
            ax.locator_params(axis="x", nbins=5)
            ax.grid()
        axes[0].set(ylabel="|impulse response|, Hann window\n[dB relative to the label's peak]", ylim=_limits(levels))
        figure.legend(handles=axes[0].lines[::-1], loc="outside lower center", ncols=2)
    return figure


def _titles(labels: Complex[ndarray, "k e s"], snr: Float[ndarray, "k"], names: Sequence[str]) -> list[tuple[str, int]]:
    """What stands above each link, and its element with the most power."""
    count = labels.shape[1]
    elements = (np.abs(labels) ** 2).sum(-1).argmax(-1)
    return [
        (f"{name}, SNR {score:.1f} dB" + (f", element {element + 1} of {count}" if count > 1 else ""), int(element))
        for name, score, element in zip(names, snr, elements, strict=True)
    ]


def _decibels(amplitudes: Complex[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Magnitudes [dB]; -inf, which leaves a gap in a line, where there is none."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(amplitudes))


def _limits(levels: Float[ndarray, "... 2 n"]) -> tuple[float, float]:
    """What is shown of predictions and labels [dB]: all of both, but nothing ``DEPTH`` or more below a label's peak."""
    lowest, highest = levels[np.isfinite(levels)].min(), levels.max()
    lowest = max(lowest, levels[..., 1, :].max() - DEPTH)
    rim = max(1.0, 0.05 * (highest - lowest))
    return lowest - rim, highest + rim


def _draw_phase(ax: Axes, frequencies: Float[ndarray, "s"], angles: Float[ndarray, "s"], **look) -> None:
    """A line with a gap where the phase [deg] goes round."""
    jumps = np.flatnonzero(np.abs(np.diff(angles)) > 180) + 1
    ax.plot(np.insert(frequencies, jumps, np.nan), np.insert(angles, jumps, np.nan), **look)


def _delays(frequencies: Float[ndarray, "s"]) -> Float[ndarray, "d"]:
    """Delays of an impulse response [s]: one period, from somewhat before 0 on."""
    spacings = np.diff(np.unique(frequencies))
    if not len(spacings):
        raise ValueError(
            f"an impulse response takes at least two different frequencies, got {frequencies.tolist()}; draw "
            "magnitudes and phases alone"
        )
    spacing, band = np.median(spacings), _band(frequencies)
    fewest, most = DELAYS
    count = int(np.clip(np.ceil(OVERSAMPLING * np.ptp(band) / spacing), fewest, most))
    lobe = 2 / np.ptp(band)  # half the width of the Hann window's main lobe
    return np.arange(count) / (count * spacing) - min(lobe, 0.25 / spacing)


def _band(frequencies: Float[ndarray, "s"]) -> Float[ndarray, "2"]:
    """Where the window ends [Hz]: one median spacing outside the subcarriers, so that both end ones count."""
    spacing = np.median(np.diff(np.unique(frequencies)))
    return np.array((frequencies.min() - spacing, frequencies.max() + spacing))


def _hann(frequencies: Float[ndarray, "s"]) -> Float[ndarray, "s"]:
    lowest, highest = _band(frequencies)
    return np.sin(np.pi * (frequencies - lowest) / (highest - lowest)) ** 2


def _fourier_sum(
    spectra: Complex[ndarray, "... s"], frequencies: Float[ndarray, "s"], delays: Float[ndarray, "d"]
) -> Complex[ndarray, "... d"]:
    """Mean over the subcarriers of spectrum times exp(2 pi i f tau), f from the lowest on; some delays at a time."""
    turns = 2j * np.pi * (frequencies - frequencies.min())
    parts = np.array_split(delays, -(-len(delays) // 256))
    return np.concatenate([spectra @ np.exp(np.outer(turns, part)) for part in parts], -1) / len(frequencies)


def error_against_power(powers: Float[ndarray, "k"], errors: Mapping[str, Float[ndarray, "k"]], split: str) -> Figure:
    """Power of each test link's error over the power of its channel, of two models; NMSE of all links in the key.

    Links that lie above the line have an error larger than their channel. Those to the right rule the NMSE.

    Args:
        powers: Of the labels, linear, all above 0.
        errors: Powers of the errors by model, the run's own first; that and the baseline of the least NMSE are drawn.
        split: Name of the split.
    """
    own, *others = errors
    baselines = sorted((name for name in others if name != f"{own}_trend"), key=lambda name: errors[name].sum())
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, COLUMN), layout="constrained")
        ax = figure.subplots()
        x = 10 * np.log10(powers)
        ax.axline((x.max(), x.max()), slope=1, color="0.75", linewidth=0.8, zorder=0, label="SNR 0 dB")
        for order, (name, look) in enumerate(zip([own, *baselines[:1]], MARKERS, strict=False)):
            error = np.maximum(errors[name], 1e-14 * powers)  # of an SNR of 140 dB, the highest reported
            nmse = 10 * np.log10(error.sum() / powers.sum())
            look = look | {
                "linestyle": "",
                "markersize": 3,
                "zorder": 3 - order,
                "label": f"{name}, NMSE {nmse:.1f} dB",
            }
            ax.plot(x, 10 * np.log10(error), **look)
        lower, upper = x.min() - 5, x.max() + 5  # of a few links, too, the line of 0 dB has a slope
        label = textwrap.fill(f"power of the channel [dB], split {split}", LABEL)
        ax.set(xlabel=label, ylabel="power of the error [dB]", xlim=(lower, upper))
        ax.grid()
        ax.legend()
    return figure
