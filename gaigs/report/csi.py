"""Figures of complex channels: over frequency, as impulse responses over delay, and their errors by
power.
"""

import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex, Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.report.curves import LABEL, cdf
from gaigs.report.figures import Examples, TaskFigures, own_scores, read_examples, scores_of_systems
from gaigs.report.style import COLUMN, MARKERS, PAGE, SKY, STYLE, looks

LOOKS = {
    "predicted": {"color": SKY, "linewidth": 2.4, "markersize": 5},
    "measured": {"color": "0.1", "linewidth": 0.8, "markersize": 2},
}
"""A thin dark line upon a broad pale one: both are visible where they coincide, in grey print too.
"""


class CsiFigures(TaskFigures):
    """Example channels, the distribution of SNR, and the power of errors."""

    def of_run(self, task: Csi, folder: Path, links: Links) -> dict[str, Figure]:
        file, split, kind = folder / "predictions.npz", links.split.name, task.compared_by
        scores, errors, powers = (
            own_scores(file, name) for name in (kind, "error_power", "label_power")
        )
        shown, frequencies = read_examples(file, kind), task.frequencies.numpy()
        labels = task.align(*(torch.from_numpy(part) for part in (shown.labels, shown.predictions)))
        shown = shown._replace(labels=labels.numpy())
        figures = {"channels": magnitudes_and_phases(shown, frequencies)}
        if len(frequencies) > 1:
            figures["impulse_response"] = impulse_responses(shown, frequencies)
        figures["error_power"] = error_against_power(next(iter(powers.values())), errors, split)
        return figures | {"snr_cdf": cdf(scores, task.pair_score, "channels", split, (None, None))}

    def of_systems(
        self, task: type[Csi], files: Mapping[str, Path], split: str
    ) -> dict[str, Figure]:
        kind, title = "snr_db", "SNR [dB]"
        if not own_scores(next(iter(files.values())), kind):  # of unknown phase
            kind, title = "snr_aligned_db", "SNR, phase removed [dB]"
        return {"cdf": cdf(scores_of_systems(files, kind), title, "channels", split, (None, None))}


def magnitudes_and_phases(shown: Examples, frequencies: Float[ndarray, " s"]) -> Figure:
    """Magnitude and phase over frequency [Hz], one link a row, at the element where the label is
    strongest.
    """
    labels, predictions = shown.labels, shown.predictions
    order = np.argsort(frequencies)
    frequencies = frequencies[order]
    scale, unit = (1e9, "GHz") if frequencies[-1] >= 1e9 else (1e6, "MHz")
    mark = {"marker": "o"} if len(frequencies) <= 32 else {}
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 1.35 * len(labels) + 0.7), layout="constrained")
        axes = figure.subplots(len(labels), 2, sharex=True, squeeze=False)
        rows = zip(axes, labels[..., order], predictions[..., order], _titles(shown), strict=True)
        for (magnitude, phase), label, prediction, (title, element) in rows:
            pair = np.stack((prediction[element], label[element]))
            levels, angles = decibels(pair), np.rad2deg(np.angle(pair))
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


def impulse_responses(shown: Examples, frequencies: Float[ndarray, " s"]) -> Figure:
    """Magnitude over delay, relative to the label's peak, at the element where the label is
    strongest.

    The impulse response is the Fourier sum over the subcarriers, weighted by a Hann window over the
    band. Its period is one over the median spacing of the subcarriers. One period is drawn. It
    begins before 0 by the width of the window's main lobe, at most a quarter of the period. A panel
    ends where all that follows is 25 dB below the label's peak.

    Args:
        shown: Channels (k, elements, subcarriers) and their SNR [dB].
        frequencies: Of the subcarriers, in any order, evenly spaced or not, at least two [Hz].
    """
    titles, links = _titles(shown), zip(shown.labels, shown.predictions, strict=True)
    pairs = np.stack(
        [(guess[e], label[e]) for (label, guess), (_, e) in zip(links, titles, strict=True)]
    )
    delays, responses = impulse_response(pairs, frequencies)
    levels = decibels(responses)  # (k, 2, delays)
    levels -= levels[:, 1:].max(-1, keepdims=True)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 2.7), layout="constrained")
        axes = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
        for ax, pair, (title, _) in zip(axes, levels, titles, strict=True):
            for name, level in zip(LOOKS, pair, strict=True):
                ax.plot(1e9 * delays, level, **LOOKS[name], label=name)
            last = delays[(pair > -25).any(0)].max()
            end = min(last + 0.1 * (last - delays[0]), delays[-1])
            ax.set(
                xlabel="delay [ns]",
                xlim=(1e9 * delays[0], 1e9 * end),
                title=title.replace(", ", "\n", 1),
            )
            ax.locator_params(axis="x", nbins=5)
            ax.grid()
        axes[0].set(
            ylabel="|impulse response|, Hann window\n[dB relative to the label's peak]",
            ylim=_limits(levels),
        )
        figure.legend(handles=axes[0].lines[::-1], loc="outside lower center", ncols=2)
    return figure


def _titles(shown: Examples) -> list[tuple[str, int]]:
    """The title of each link, and its element with the most power."""
    count = shown.labels.shape[1]
    elements = (np.abs(shown.labels) ** 2).sum(-1).argmax(-1)
    return [
        (
            f"{name}, SNR {score:.1f} dB"
            + (f", element {element + 1} of {count}" if count > 1 else ""),
            int(element),
        )
        for name, score, element in zip(shown.names, shown.scores, elements, strict=True)
    ]


def decibels(amplitudes: Complex[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Magnitudes [dB]; of 0 it is -inf, which leaves a gap in a line."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(amplitudes))


def _limits(levels: Float[ndarray, "... 2 n"]) -> tuple[float, float]:
    """Range of an axis [dB]: all of predictions and labels, but nothing 60 dB or more below a
    label's peak.
    """
    lowest, highest = levels[np.isfinite(levels)].min(), levels.max()
    lowest = max(lowest, levels[..., 1, :].max() - 60)
    rim = max(1.0, 0.05 * (highest - lowest))
    return float(lowest - rim), float(highest + rim)


def _draw_phase(
    ax: Axes, frequencies: Float[ndarray, " s"], angles: Float[ndarray, " s"], **look
) -> None:
    """A line with a gap where the phase [deg] wraps."""
    jumps = np.flatnonzero(np.abs(np.diff(angles)) > 180) + 1
    ax.plot(np.insert(frequencies, jumps, np.nan), np.insert(angles, jumps, np.nan), **look)


def impulse_response(
    channels: Complex[ndarray, "... s"], frequencies: Float[ndarray, " s"]
) -> tuple[Float[ndarray, " d"], Complex[ndarray, "... d"]]:
    """Delays [s], and the impulse response at them: the windowed mean over subcarriers of h exp(2
    pi i f tau).
    """
    spacing, start = np.median(np.diff(np.unique(frequencies))), frequencies.min()
    lowest, highest = (
        start - spacing,
        frequencies.max() + spacing,
    )  # so that both end subcarriers count
    band = highest - lowest
    # Four delays for each that the band resolves, so that no peak falls between two.
    count = int(np.clip(np.ceil(4 * band / spacing), 256, 2**14))
    delays = np.arange(count) / (count * spacing) - min(2 / band, 0.25 / spacing)
    windowed = channels * np.sin(np.pi * (frequencies - lowest) / band) ** 2
    turns = 2j * np.pi * (frequencies - start)
    parts = [
        windowed @ np.exp(np.outer(turns, part))
        for part in np.array_split(delays, -(-count // 256))
    ]
    return delays, np.concatenate(parts, -1) / len(frequencies)


def error_against_power(
    powers: Float[ndarray, " k"], errors: Mapping[str, Float[ndarray, " k"]], split: str
) -> Figure:
    """Power of each test link's error over that of its channel, of the own model (first) and the
    best baseline.
    """
    own, *others = errors
    baselines = sorted(
        (name for name in others if name != f"{own}_trend"), key=lambda name: errors[name].sum()
    )
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, COLUMN), layout="constrained")
        ax = figure.subplots()
        x = 10 * np.log10(powers)
        ax.axline(
            (x.max(), x.max()), slope=1, color="0.75", linewidth=0.8, zorder=0, label="SNR 0 dB"
        )
        for order, (name, look) in enumerate(zip([own, *baselines[:1]], MARKERS, strict=False)):
            error = np.maximum(
                errors[name], 1e-14 * powers
            )  # of an SNR of 140 dB, the highest reported
            nmse = 10 * np.log10(error.sum() / powers.sum())
            look = look | {
                "linestyle": "",
                "markersize": 3,
                "zorder": 3 - order,
                "color": looks(errors)[name][0],
            }
            ax.plot(x, 10 * np.log10(error), **look, label=f"{name}, NMSE {nmse:.1f} dB")
        lower, upper = x.min() - 5, x.max() + 5  # of a few links, too, the line of 0 dB has a slope
        label = textwrap.fill(f"power of the channel [dB], split {split}", LABEL)
        ax.set(xlabel=label, ylabel="power of the error [dB]", xlim=(lower, upper))
        ax.grid()
        ax.legend()
    return figure
