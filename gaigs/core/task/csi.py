"""Channel state information: a complex channel at each element and each subcarrier."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from gaigs.core.phases import alignment, array_sign, phase_sign
from gaigs.core.task import Axis, Metric, Task, check_values, need_samples
from gaigs.registry import check_type, register

HIGHEST = 140.0
"""Highest reported SNR [dB], the resolution of complex64.

A perfect prediction has no finite SNR.
"""


@register("task", "csi")
class Csi(Task):
    """Complex channels (elements, subcarriers), linear amplitudes in the unit of the data.

    Scores of a link, with error e = h - h' over its elements and subcarriers:

    - SNR [dB], -10 log10(|e|² / |h|²). ``snr_aligned_db`` is the SNR after the best common phase of
      the prediction, for a receiver and a transmitter without a common clock. If ``phase`` is not
      known, only the aligned SNR exists, and all scores use the aligned error.
    - SINAD [dB], 10 log10((|h|² + |e|²) / |e|²), at least 0. Its mean is monitored: a few links in
      deep shadow, with an SNR of -50 dB, would dominate a mean SNR.

    All links together have an NMSE [dB], 10 log10(sum |e|² / sum |h|²). Strong links dominate it.

    Args:
        elements: Number of elements of the largest array; 1 for single antennas. Labels are 0 at
            the missing elements of a smaller array.
        frequencies: Absolute frequencies of the subcarriers (s,) [Hz].
        phase: ``known``; ``per_link`` if each link has a random phase; ``per_link_and_delay`` if
            each link also has a random delay and gain. Elements and subcarriers of a link share
            them.

    Raises:
        ValueError: There is no element or subcarrier, a frequency is not positive and finite, or
            the phase is unknown.

    Source: NeWRF, 2024, and NeRF², 2023, "Evaluation".
    """

    name, quantity = "csi", "channel"
    monitor, higher_is_better = "sinad_db", True
    dtype = torch.complex64
    normalisation = "linear amplitude, in the data's own unit"
    phases = ("known", "per_link", "per_link_and_delay")

    def __init__(
        self,
        elements: int,
        frequencies: Float[Tensor, " s"] | Float[np.ndarray, " s"] | Sequence[float],
        phase: str = "known",
    ):
        check_type("elements", elements, int)
        frequencies = torch.as_tensor(frequencies, dtype=torch.float64)
        if elements < 1:
            raise ValueError(f"a channel needs at least one element, got {elements}")
        if not len(frequencies) or not ((frequencies > 0) & frequencies.isfinite()).all():
            given = frequencies.tolist()[:3]
            raise ValueError(
                f"subcarriers must have positive, finite frequencies [Hz], got {given}"
            )
        if len(frequencies.unique()) < len(frequencies):
            raise ValueError(
                "subcarriers must have different frequencies, got one twice; leave it out"
            )
        if phase not in self.phases:
            raise ValueError(f"data.phase must be {' or '.join(self.phases)}, got {phase!r}")
        self.elements = elements
        self.frequencies = frequencies
        self.phase = phase

    @property
    def shape(self) -> tuple[int, int]:
        return self.elements, len(self.frequencies)

    @property
    def compared_by(self) -> str:
        return "snr_db" if self.phase == "known" else "snr_aligned_db"

    @property
    def pair_score(self) -> str:
        return "SNR [dB]" if self.phase == "known" else "SNR, phase removed [dB]"

    @property
    def trends(self) -> tuple[str, ...]:
        return ("friis",)

    def axes(self) -> dict[str, Axis]:
        """Numbers of elements, and subcarriers [Hz]."""
        numbers = np.arange(self.elements, dtype=np.int32)
        frequencies = self.frequencies.double().numpy()
        return {"element": Axis(numbers), "subcarrier": Axis(frequencies, "Hz")}

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> "Csi":
        return Csi(self.elements, frequencies)

    def options(self) -> dict:
        return {"elements": self.elements, "frequencies": self.frequencies, "phase": self.phase}

    def align(
        self, labels: Complex[Tensor, "#k e s"], values: Complex[Tensor, "#k e s"]
    ) -> Complex[Tensor, "k e s"]:
        """Labels aligned to predictions: unknown phases, delays and gains are removed.

        ``per_link`` aligns the phase of each link, ``per_link_and_delay`` also its delay and power.
        Labels then have the power of the predictions, and gradients pass through it. So a loss
        relative to the label's power does not depend on the scale of the predictions.
        """
        if self.phase == "known":
            return labels
        turned = labels * self._turns(labels, values).to(labels)
        if self.phase == "per_link":
            return turned
        label_sizes = turned.to(torch.complex128).flatten(1).norm(dim=1)  # (k,)
        value_sizes = values.to(torch.complex128).flatten(1).norm(dim=1)  # (k,)
        # Links whose label or prediction is 0 keep their scale, with a gain of 1.
        are_nonzero = (label_sizes > 0) & (value_sizes > 0)
        wanted = torch.where(are_nonzero, value_sizes, 1)
        gains = wanted / torch.where(are_nonzero, label_sizes, 1)  # (k,)
        return turned * gains[:, None, None].to(turned.real)

    def fingerprint(self, values: Complex[Tensor, "k e s"]) -> Float[Tensor, "k m"]:
        """Correlations over elements and over subcarriers, relative to the link's power.

        Both change slowly with the place; phases do not.
        """
        power = values.abs().square().sum((1, 2), keepdim=True)  # (k, 1, 1)
        covariances = values @ values.mH / power  # (k, e, e)
        rows, columns = torch.triu_indices(self.elements, self.elements)
        between = covariances[:, rows, columns]  # (k, pairs)
        # Wiener and Khinchin: the autocorrelation over subcarriers is the transform of the power
        # spectrum; twice the length keeps it from wrapping around.
        count = len(self.frequencies)
        spectra = torch.fft.fft(values, 2 * count).abs().square()  # (k, e, 2 s)
        correlations = torch.fft.ifft(spectra).sum(1)  # (k, 2 s)
        lags = correlations[:, :count] / power[:, 0]  # (k, s)
        if self.phase == "per_link_and_delay":  # a delay turns the phase from lag to lag
            lags = lags.abs().to(lags)
        parts = torch.cat((between, lags), 1)  # (k, pairs + s)
        return super().fingerprint(torch.cat((parts.real, parts.imag), 1))

    def phase_sign(
        self,
        labels: Complex[Tensor, "k e s"],
        waves: Complex[Tensor, "k e s"],
        receivers: Int[Tensor, " k"],
    ) -> int:
        """The sign with which phases follow path lengths, -1 or 1; 0 if neither fits.

        Arguments are as for ``gaigs.core.phases.phase_sign``.
        """
        if self.phase == "known":
            return phase_sign(labels, waves, receivers)
        return array_sign(labels, waves, self._rates)

    @property
    def _rates(self) -> Float[Tensor, " s"] | None:
        """Frequencies that multiply unknown delays in phases [Hz]; None if delays are known."""
        return self.frequencies if self.phase == "per_link_and_delay" else None

    def _turns(
        self, labels: Complex[Tensor, "#k e s"], values: Complex[Tensor, "#k e s"]
    ) -> Complex[Tensor, "k 1 s"]:
        """Factors of ``alignment`` that rotate labels onto predictions."""
        return alignment(labels, values, self._rates)

    @classmethod
    def metrics(cls) -> dict[str, Metric]:
        return {
            "snr_db_median": Metric("median SNR [dB]", True),
            "snr_db_mean": Metric("mean SNR [dB]", True),
            "snr_db_p10": Metric("p10 SNR [dB]", True, is_brief=False),
            "snr_db_p90": Metric("p90 SNR [dB]", True, is_brief=False),
            "snr_aligned_db_median": Metric("median SNR, phase removed [dB]", True),
            "snr_aligned_db_mean": Metric("mean SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p10": Metric("p10 SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p90": Metric("p90 SNR, phase removed [dB]", True, is_brief=False),
            "sinad_db_mean": Metric("mean SINAD [dB]", True, is_brief=False),
            "nmse_db": Metric("NMSE [dB]", False),
        }

    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """SNR, aligned SNR and SINAD [dB], and the powers of error and label.

        The plain SNR is missing unless ``phase`` is known.

        Raises:
            ValueError: A label is zero throughout, so its SNR is undefined.
        """
        check_values(labels, values, self.shape, "channels")
        h = labels.detach().cpu().to(torch.complex128)  # (k, e, s)
        guess = values.detach().cpu().to(torch.complex128)  # h'
        power = h.abs().square().sum((1, 2))  # (k,)
        silent = int((power == 0).sum())
        if silent:
            raise ValueError(
                f"labels must not be zero throughout, got {silent} such channels; leave them out"
            )
        # The prediction is turned onto the label: the inverse of the label's turn.
        aligned = self._turns(h, guess).conj() * guess
        if self.phase == "per_link_and_delay":
            # The gain of the least squared error; a prediction of zeros keeps its scale.
            guess_power = guess.abs().square().sum((1, 2))  # (k,)
            products = (aligned.conj() * h).sum((1, 2)).real
            gains = products / torch.where(guess_power > 0, guess_power, 1)
            aligned = gains[:, None, None] * aligned
        plain_error = (h - guess).abs().square().sum((1, 2))  # (k,)
        aligned_error = (h - aligned).abs().square().sum((1, 2))
        error = plain_error if self.phase == "known" else aligned_error
        scores = {"snr_db": -decibels(plain_error, power)} if self.phase == "known" else {}
        return scores | {
            "snr_aligned_db": -decibels(aligned_error, power),
            "sinad_db": -decibels(error, power + error),
            "error_power": error,
            "label_power": power,
        }

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Median, mean and percentiles of the SNRs, mean SINAD, and the NMSE of all links.

        Percentiles are interpolated linearly.
        """
        need_samples(scores["label_power"])
        numbers: dict[str, float] = {}
        for name in ("snr_db", "snr_aligned_db"):
            if name in scores:
                levels = scores[name].new_tensor([0.1, 0.5, 0.9])
                p10, median, p90 = torch.quantile(scores[name], levels).tolist()
                numbers[f"{name}_median"] = median
                numbers[f"{name}_mean"] = scores[name].mean().item()
                numbers[f"{name}_p10"] = p10
                numbers[f"{name}_p90"] = p90
        numbers["sinad_db_mean"] = scores["sinad_db"].mean().item()
        numbers["nmse_db"] = decibels(
            scores["error_power"].sum(), scores["label_power"].sum()
        ).item()
        return {name: numbers[name] for name in self.metrics() if name in numbers}

    def logged(self, means: dict[str, float]) -> dict[str, float]:
        """The mean scores, with the NMSE instead of the powers."""
        error = torch.tensor(means["error_power"], dtype=torch.float64)
        power = torch.tensor(means["label_power"], dtype=torch.float64)
        scores = {name: mean for name, mean in means.items() if not name.endswith("_power")}
        return scores | {"nmse_db": decibels(error, power).item()}

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """The scores at half the error power, an SNR higher by 3 dB."""
        error = scores["error_power"] / 2
        power = scores["label_power"]
        ratios = {
            name: (score + 10 * math.log10(2)).clamp(max=HIGHEST)
            for name, score in scores.items()
            if name.startswith("snr")
        }
        return ratios | {
            "sinad_db": -decibels(error, power + error),
            "error_power": error,
            "label_power": power,
        }


def decibels(error: Float[Tensor, "*k"], power: Float[Tensor, "*k"]) -> Float[Tensor, "*k"]:
    """Ratio of an error's power to a label's power [dB]; at least -``HIGHEST``."""
    return 10 * (error / power).clamp(min=10 ** (-HIGHEST / 10)).log10()
