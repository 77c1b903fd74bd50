"""Figures of complex channels: over frequency, over delay, and their errors by power."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Inexact
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.report.curves import cdf
from gaigs.report.figures import TaskFigures
from gaigs.report.predictions import Examples, own_scores, read_examples, scores_of_systems
from gaigs.report.style import COLUMN, MARKERS, PAGE, SKY, STYLE, ask, looks, new_figure, wrapped


class CsiFigures(TaskFigures):
    """Example channels, the distribution of SNR, and the power of errors."""

    def of_run(self, task: Csi, folder: Path, links: Links) -> dict[str, Figure]:
        file = folder / "predictions.npz"
        split = links.split.name
        frequencies = task.frequencies.numpy()
        scores = own_scores(file, task.compared_by)
        powers_of_errors = own_scores(file, "error_power")
        powers = next(iter(own_scores(file, "label_power").values()))
        shown = read_examples(file, task.compared_by)
        predictions = torch.from_numpy(shown.predictions)
        labels = task.align(torch.from_numpy(shown.labels), predictions)
        shown = shown._replace(labels=labels.numpy())
        figures = {"channels": magnitudes_and_phases(shown, frequencies)}
        if len(frequencies) > 1:
            figures["impulse_response"] = impulse_responses(shown, frequencies)
        if links.front_ends is not None:
            responses = links.front_ends.responses.numpy()
            errors = links.front_ends.errors.numpy()
            names = [receiver.name for receiver in links.receivers]
            known: Any = links.task
            figures["front_end"] = front_ends(responses, errors, known.frequencies.numpy(), names)
        figures["error_power"] = error_against_power(powers, powers_of_errors, split)
        return figures | {
            "snr_cdf": cdf(scores, task.pair_score, "channels", split, (None, None), True)
        }

    def of_systems(
        self, task: type[Csi], files: Mapping[str, Path], split: str
    ) -> dict[str, Figure]:
        score, title = "snr_db", "SNR [dB]"
        if not own_scores(next(iter(files.values())), score):  # channels of unknown phase
            score, title = "snr_aligned_db", "SNR, phase removed [dB]"
        scores = scores_of_systems(files, score)
        return {"cdf": cdf(scores, title, "channels", split, (None, None), True)}


def _looks(marker: str = "") -> dict[str, dict[str, Any]]:
    """Matplotlib's options for the curves ``prediction`` and ``label``.

    A thin dark line is drawn over a broad pale one. Both are visible where they coincide, also in
    grey print.
    """
    broad = {"color": SKY, "linewidth": 2.4, "markersize": 5}
    thin = {"color": "0.1", "linewidth": 0.8, "markersize": 2}
    looks = {}
    for name, look in (("prediction", broad), ("label", thin)):
        looks[name] = look | {"label": name, "marker": marker}
    return looks


def magnitudes_and_phases(shown: Examples, frequencies: Float[ndarray, " s"]) -> Figure:
    """Magnitude and phase of channels over frequency [Hz], a row of panels for each link.

    Each channel is drawn at the label's strongest element.
    """
    order = np.argsort(frequencies)
    frequencies = frequencies[order]
    unit = "GHz" if frequencies[-1] >= 1e9 else "MHz"
    across = frequencies / (1e9 if unit == "GHz" else 1e6)
    looks = _looks("o" if len(frequencies) <= 32 else "")
    with rc_context(STYLE):
        height = 1.35 * len(shown.labels) + 0.95
        figure = new_figure(PAGE, height)
        axes = figure.subplots(len(shown.labels), 2, sharex=True, squeeze=False)
        rows = zip(axes, _pairs(shown)[..., order], _titles(shown), strict=True)
        for (magnitude, phase), pair, title in rows:
            levels = decibels(pair)
            angles = np.rad2deg(np.angle(pair))
            for look, level, angle in zip(looks.values(), levels, angles, strict=True):
                magnitude.plot(across, level, **look)
                # A line with a gap where the phase wraps.
                jumps = np.flatnonzero(np.abs(np.diff(angle)) > 180) + 1
                x = np.insert(across, jumps, np.nan)
                phase.plot(x, np.insert(angle, jumps, np.nan), **look)
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
        over = " over frequency" if len(frequencies) > 1 else ""
        ask(figure, f"Do predicted channels follow the labels{over}?")
    return figure


def front_ends(
    responses: Complex[ndarray, "r e s"],
    errors: Float[ndarray, "r e s"],
    frequencies: Float[ndarray, " s"],
    names: Sequence[str],
) -> Figure:
    """Level and phase of receivers' front ends over frequency, a line for each element.

    Bands show plus and minus one standard error. Receivers without a response have no row. The
    ``responses`` are complex gains; ``errors``, their standard errors, are 0 for elements that an
    array lacks.
    """
    rows = [number for number, error in enumerate(errors) if error.any()]
    order = np.argsort(frequencies)
    across = frequencies[order] / 1e9
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 1 + 1.8 * len(rows)), layout="constrained")
        axes = figure.subplots(len(rows), 2, sharex=True, squeeze=False)
        for (level_axes, phase_axes), row in zip(axes, rows, strict=True):
            for response, error in zip(
                responses[row][:, order], errors[row][:, order], strict=True
            ):
                if not error.any():  # an element that the array lacks
                    continue
                # To first order a relative error is one of ln |R|, and of the phase [rad].
                relative = error / np.abs(response)
                phase = np.unwrap(np.angle(response))
                curves = (
                    (level_axes, decibels(response), 20 / np.log(10) * relative),
                    (phase_axes, np.rad2deg(phase), np.rad2deg(relative)),
                )
                for ax, curve, width in curves:
                    (line,) = ax.plot(across, curve, linewidth=0.8)
                    band = curve - width, curve + width
                    ax.fill_between(across, *band, color=line.get_color(), alpha=0.2, linewidth=0)
            level_axes.set(title=f"front end of {names[row]}", ylabel="|R| [dB]")
            phase_axes.set(ylabel="phase of R [deg]")
        for ax in axes.flat:
            ax.grid()
        for ax in axes[-1]:
            ax.set_xlabel("frequency [GHz]")
    return figure


def impulse_responses(shown: Examples, frequencies: Float[ndarray, " s"]) -> Figure:
    """Magnitude of impulse responses over delay, relative to the label's peak.

    Channels are drawn at the label's strongest element, by ``impulse_response``. A panel ends where
    all later delays are 25 dB below the label's peak.

    Args:
        shown: Channels (k, elements, subcarriers) and their SNR [dB].
        frequencies: At least two subcarriers, in any order and spacing [Hz].
    """
    delays, responses = impulse_response(_pairs(shown), frequencies)
    levels = decibels(responses)  # (k, 2, delays), prediction and label
    levels -= levels[:, 1:].max(-1, keepdims=True)
    titles = _titles(shown)
    with rc_context(STYLE):
        figure = new_figure(PAGE, 2.95)
        axes = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
        for ax, pair, title in zip(axes, levels, titles, strict=True):
            for look, level in zip(_looks().values(), pair, strict=True):
                ax.plot(1e9 * delays, level, **look)
            last = delays[(pair > -25).any(0)].max()
            end = min(last + 0.1 * (last - delays[0]), delays[-1])
            ax.set(xlabel="delay [ns]", xlim=(1e9 * delays[0], 1e9 * end))
            ax.set_title(title.replace(", ", "\n", 1))
            ax.locator_params(axis="x", nbins=5)
            ax.grid()
        axes[0].set_ylabel("|impulse response|, Hann window\n[dB relative to the label's peak]")
        axes[0].set_ylim(_limits(levels))
        figure.legend(handles=axes[0].lines[::-1], loc="outside lower center", ncols=2)
        ask(figure, "At which delays do paths arrive?")
    return figure


def _strongest(shown: Examples) -> list[int]:
    """The element with the most power of each label."""
    powers = (np.abs(shown.labels) ** 2).sum(-1)  # (k, elements)
    return powers.argmax(-1).tolist()


def _pairs(shown: Examples) -> Complex[ndarray, "k 2 s"]:
    """Prediction and label of each link at the label's strongest element."""
    rows = np.arange(len(shown.labels))
    elements = _strongest(shown)
    return np.stack((shown.predictions[rows, elements], shown.labels[rows, elements]), 1)


def _titles(shown: Examples) -> list[str]:
    """Rank, score and drawn element of each link."""
    count = shown.labels.shape[1]
    titles = []
    for name, score, element in zip(shown.names, shown.scores, _strongest(shown), strict=True):
        place = f", element {element + 1} of {count}" if count > 1 else ""
        titles.append(f"{name}, SNR {score:.1f} dB{place}")
    return titles


def decibels(amplitudes: Inexact[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Magnitudes [dB]; -inf for 0, which leaves a gap in a line."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(amplitudes))


def _limits(levels: Float[ndarray, "... 2 n"]) -> tuple[float, float]:
    """Range of an axis [dB]: all curves, down to 60 dB below the highest label.

    Args:
        levels: Curves of predictions and labels, the label last of each pair.
    """
    highest = levels.max()
    peak = levels[..., 1, :].max()  # of the labels
    lowest = max(levels[np.isfinite(levels)].min(), peak - 60)
    rim = max(1.0, 0.05 * (highest - lowest))
    return float(lowest - rim), float(highest + rim)


def impulse_response(
    channels: Complex[ndarray, "... s"], frequencies: Float[ndarray, " s"]
) -> tuple[Float[ndarray, " d"], Complex[ndarray, "... d"]]:
    """The impulse response of channels: mean over subcarriers of w(f) h(f) exp(2 pi i f tau).

    The window w is a Hann window over the band. The delays tau span one period, which is one over
    the median spacing of the subcarriers. They start before 0 by the width of the window's main
    lobe, at most a quarter of the period.

    Args:
        channels: Channels h at the subcarriers.
        frequencies: Subcarriers f, two or more [Hz].

    Returns:
        Delays tau [s], and the response at them.
    """
    start = frequencies.min()
    spacing = np.median(np.diff(np.unique(frequencies)))
    # The window is 0 one spacing outside of the band, so that both end subcarriers count.
    lowest = start - spacing
    highest = frequencies.max() + spacing
    band = highest - lowest
    # Four delays for each that the band resolves, so that no peak falls between two.
    count = int(np.clip(np.ceil(4 * band / spacing), 256, 2**14))
    first_delay = -min(2 / band, 0.25 / spacing)
    delays = np.arange(count) / (count * spacing) + first_delay
    window = np.sin(np.pi * (frequencies - lowest) / band) ** 2
    windowed = channels * window
    turns = 2j * np.pi * (frequencies - start)  # the phase at delay 0 is arbitrary
    # At most 256 delays at a time, as the Fourier matrix (subcarriers, delays) takes much memory.
    blocks = []
    for delay_block in np.array_split(delays, -(-count // 256)):
        blocks.append(windowed @ np.exp(np.outer(turns, delay_block)))
    return delays, np.concatenate(blocks, -1) / len(frequencies)


def error_against_power(
    powers: Float[ndarray, " k"], errors: Mapping[str, Float[ndarray, " k"]], split: str
) -> Figure:
    """Power of each test link's error against the power of its channel.

    The run's model and the baseline with the least power of errors are drawn.

    Args:
        powers: Power of each channel, linear.
        errors: Power of each error by model, linear; the run's model first.
        split: Name of the split.
    """
    model, *others = errors
    baselines = [name for name in others if name != f"{model}_trend"]
    baselines.sort(key=lambda name: errors[name].sum())
    colours = looks(errors)
    x = 10 * np.log10(powers)
    with rc_context(STYLE):
        figure = new_figure(COLUMN, COLUMN)
        ax = figure.subplots()
        line = {"color": "0.75", "linewidth": 0.8, "zorder": 0, "label": "SNR 0 dB"}
        ax.axline((x.max(), x.max()), slope=1, **line)
        models = zip([model, *baselines[:1]], MARKERS, strict=False)
        for order, (name, look) in enumerate(models):
            # An SNR of 140 dB is the highest reported.
            error = np.maximum(errors[name], 1e-14 * powers)
            nmse = 10 * np.log10(error.sum() / powers.sum())
            look = look | {"linestyle": "", "markersize": 3, "zorder": 3 - order}
            look["color"], _ = colours[name]
            ax.plot(x, 10 * np.log10(error), **look, label=f"{name}, NMSE {nmse:.1f} dB")
        # With a few links, too, the line of 0 dB has a slope.
        ax.set_xlim(x.min() - 5, x.max() + 5)
        ax.set_xlabel("power of the channel [dB]")
        ax.set_ylabel("power of the error [dB]")
        ax.grid()
        ax.legend()
        ask(figure, "Are weak channels predicted, too?", wrapped(f"split {split}", 70))
    return figure
