"""Channels over frequency and delay, read back from their artists."""

import numpy as np
import pytest

from gaigs.report.csi import impulse_responses, magnitudes_and_phases
from gaigs.report.predictions import Examples

EVEN = 2.4e9 + 1e6 * np.arange(64)
GAP = np.delete(EVEN, [31, 32, 50])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def random(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def path(frequencies, delay, amplitude=1.0):
    """A channel of a single path, (1, 1, s)."""
    return (amplitude * np.exp(-2j * np.pi * delay * frequencies))[None, None]


def lines(ax):
    return {line.get_label(): line for line in ax.lines}


def draw(function, labels, predictions, frequencies, snr=None, names=None):
    count = len(labels)
    snr = np.zeros(count) if snr is None else snr
    return function(
        Examples(labels, predictions, snr, names or [f"row {i}" for i in range(count)]), frequencies
    )


def test_magnitude_and_phase_are_those_of_the_strongest_element(rng):
    labels, predictions = random(rng, 2, 3, 40), random(rng, 2, 3, 40)
    labels[0, 2] *= 4
    labels[1, 0] *= 4
    predictions[0, 1] *= 100  # which the label's own strength decides, not the prediction's
    frequencies = 2.4e9 + 1e6 * np.arange(40)
    figure = draw(
        magnitudes_and_phases,
        labels,
        predictions,
        frequencies,
        np.array([-2.5, 20.0]),
        ["worst", "best"],
    )
    assert [ax.get_title() for ax in figure.axes[::2]] == [
        "worst, SNR -2.5 dB, element 3 of 3",
        "best, SNR 20.0 dB, element 1 of 3",
    ]
    for row, element in enumerate((2, 0)):
        magnitude, phase = figure.axes[2 * row : 2 * row + 2]
        for name, channel in (("label", labels), ("prediction", predictions)):
            x, y = lines(magnitude)[name].get_data()
            np.testing.assert_allclose(x, frequencies / 1e9)
            np.testing.assert_allclose(10 ** (y / 20), np.abs(channel[row, element]))
            x, y = lines(phase)[name].get_data()
            drawn = np.isfinite(x)
            np.testing.assert_allclose(x[drawn], frequencies / 1e9)
            np.testing.assert_allclose(
                np.exp(1j * np.deg2rad(y[drawn])),
                channel[row, element] / abs(channel[row, element]),
            )
        assert (magnitude.get_ylabel(), phase.get_ylabel()) == ("|h| [dB]", "phase [deg]")
    assert [ax.get_xlabel() for ax in figure.axes] == ["", "", "frequency [GHz]", "frequency [GHz]"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["label", "prediction"]


def test_a_turning_phase_has_gaps_instead_of_falls():
    frequencies = 5e9 + 1e6 * np.arange(100)
    label = path(frequencies, 50e-9)  # five turns
    figure = draw(magnitudes_and_phases, label, label, frequencies)
    _, phase = figure.axes[1].lines[0].get_data()
    assert np.isnan(phase).sum() == 5
    steps = np.diff(phase)
    np.testing.assert_allclose(steps[np.isfinite(steps)], -360 * 50e-9 * 1e6, atol=1e-3)
    assert figure.axes[1].get_ylim()[0] <= -180 < 180 <= figure.axes[1].get_ylim()[1]


def test_frequencies_may_come_in_any_order(rng):
    order = rng.permutation(64)
    label, prediction = random(rng, 1, 1, 64), random(rng, 1, 1, 64)
    for function in (magnitudes_and_phases, impulse_responses):
        sorted_, shuffled = (
            draw(function, label[..., index], prediction[..., index], EVEN[index])
            for index in (np.arange(64), order)
        )
        for ax, other in zip(sorted_.axes, shuffled.axes, strict=True):
            for name in ("label", "prediction"):
                np.testing.assert_allclose(
                    lines(ax)[name].get_xydata(), lines(other)[name].get_xydata(), atol=1e-6
                )


def test_a_prediction_of_nothing_is_drawn_as_nothing(rng):
    label = random(rng, 1, 1, 64)
    for function in (magnitudes_and_phases, impulse_responses):
        ax = draw(function, label, 0 * label, EVEN).axes[0]
        assert np.isneginf(lines(ax)["prediction"].get_ydata()).all()
        measured = lines(ax)["label"].get_ydata()
        assert ax.get_ylim()[0] > measured.max() - 60 - 10


def test_deep_fades_do_not_squeeze_the_rest(rng):
    label = random(rng, 1, 1, 64)
    prediction = label.copy()
    prediction[..., 5] *= 1e-12
    (magnitude, _) = draw(magnitudes_and_phases, label, prediction, EVEN).axes
    low, high = magnitude.get_ylim()
    measured = lines(magnitude)["label"].get_ydata()
    assert measured.max() < high
    assert measured.max() - 60 - 5 < low < measured.max() - 60 + 5


@pytest.mark.parametrize(
    "frequencies", [EVEN, GAP, EVEN[:5], 2.4e9 + 7e7 * np.random.default_rng(1).random(90)]
)
@pytest.mark.parametrize("delay", [0.0, 0.13e-6, 0.5e-6])
def test_a_path_peaks_at_its_delay_and_height(frequencies, delay):
    label, prediction = path(frequencies, 0.3e-6), path(frequencies, delay, 0.1)
    (ax,) = draw(impulse_responses, label, prediction, frequencies).axes
    x, y = lines(ax)["prediction"].get_data()
    near = abs(x - 1e9 * delay) < 400
    assert x[near][y[near].argmax()] == pytest.approx(
        1e9 * delay, abs=2
    )  # ns, of 15 or more that the band resolves
    assert y.max() == pytest.approx(-20, abs=0.1)
    x, y = lines(ax)["label"].get_data()
    assert (x[y.argmax()], y.max()) == (pytest.approx(300, abs=2), 0)
    assert ax.get_xlabel() == "delay [ns]"
    assert ax.get_ylabel() == "|impulse response|, Hann window\n[dB relative to the label's peak]"


def test_evenly_spaced_subcarriers_give_the_inverse_fourier_transform(rng):
    label, prediction = random(rng, 2, 64)
    (ax,) = draw(impulse_responses, label[None, None], prediction[None, None], EVEN).axes
    x, measured = lines(ax)["label"].get_data()
    count = len(x)
    np.testing.assert_allclose(np.diff(x), 1000 / count)  # one period of 1 us in all
    assert -1000 / 32 < x[0] < 0
    window = np.hanning(66)[1:-1]
    truth = [
        np.abs(
            np.fft.ifft(
                window * channel * np.exp(2j * np.pi * (EVEN - EVEN[0]) * 1e-9 * x[0]), count
            )
        )
        for channel in (label, prediction)
    ]
    np.testing.assert_allclose(10 ** (measured / 20), truth[0] / truth[0].max(), atol=1e-9)
    predicted = lines(ax)["prediction"].get_ydata()
    np.testing.assert_allclose(10 ** (predicted / 20), truth[1] / truth[0].max(), atol=1e-9)


def test_two_bands_far_apart_do_not_take_all_memory():
    frequencies = np.concatenate((2.4e9 + 1e3 * np.arange(4), 5e9 + 1e3 * np.arange(4)))
    label = path(frequencies, 0.0)
    (ax,) = draw(impulse_responses, label, label, frequencies).axes
    x = lines(ax)["label"].get_xdata()
    assert len(x) == 2**14
    assert x[-1] - x[0] == pytest.approx(1e6, rel=1e-3)  # one over the median spacing, 1 ms


def test_a_panel_shows_what_is_above_the_faint_and_not_much_more():
    labels = np.concatenate((path(EVEN, 0.1e-6), path(EVEN, 0.1e-6)))
    predictions = np.concatenate((path(EVEN, 0.1e-6), path(EVEN, 0.6e-6, 0.2)))
    first, second = draw(impulse_responses, labels, predictions, EVEN).axes
    assert 110 < first.get_xlim()[1] < 250
    assert 610 < second.get_xlim()[1] < 750
    for ax in (first, second):
        for line in ax.lines:
            x, y = line.get_data()
            assert x[y > -25].max() < ax.get_xlim()[1]
        assert ax.get_xlim()[0] == pytest.approx(x[0])
    assert first.get_title() == "row 0\nSNR 0.0 dB"
