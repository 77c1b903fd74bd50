"""Channel state information: a complex channel at each element of the receiver's array and each subcarrier."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.registry import register
from gaigs.task import Metric, Task, check_values, need_samples

HIGHEST = 140.0
"""Highest reported SNR [dB]: the resolution of complex64; a perfect prediction has no finite SNR."""


@register("task", "csi")
class Csi(Task):
    """Complex channels (elements, subcarriers), linear amplitudes in the data's own unit.

    Scores of a link, with error e = h - h' over its elements and subcarriers:

    - SNR [dB], -10 log10(|e|² / |h|²). ``snr_aligned_db`` is the SNR after the best global phase of the prediction,
      for a receiver and a transmitter without a common clock.
    - SINAD [dB], 10 log10((|h|² + |e|²) / |e|²), at least 0. Its mean is monitored: a few links in deep shadow, with
      an SNR of -50 dB, would dominate a mean SNR.

    All links together have an NMSE [dB], 10 log10(sum |e|² / sum |h|²), in which strong links count most.

    Args:
        elements: Of the receivers' arrays; 1 for single antennas.
        frequencies: Of the subcarriers (s,) [Hz]; absolute.

    Raises:
        ValueError: There is no element or subcarrier, or a frequency is not positive and finite.

    Source: NeWRF, 2024, and NeRF², 2023, "Evaluation".
    """

    name, quantity = "csi", "channel"
    monitor, compared_by, higher_is_better = "sinad_db", "snr_db", True
    pair_score = "SNR [dB]"
    dtype = torch.complex64
    normalisation = "linear amplitude, in the data's own unit"

    def __init__(self, elements: int, frequencies: Float[Tensor, " s"]):
        if elements < 1:
            raise ValueError(f"a channel needs at least one element, got {elements}")
        if not len(frequencies) or not ((frequencies > 0) & frequencies.isfinite()).all():
            raise ValueError(f"subcarriers must have positive, finite frequencies [Hz], got {frequencies.tolist()[:3]}")
        if len(frequencies.unique()) < len(frequencies):
            raise ValueError("subcarriers must have different frequencies, got one twice; leave it out")
        self.elements, self.frequencies = elements, frequencies.double()

    @property
    def shape(self) -> tuple[int, int]:
        return self.elements, len(self.frequencies)

    def options(self) -> dict:
        return {"elements": self.elements, "frequencies": self.frequencies}

    @classmethod
    def metrics(cls) -> dict[str, Metric]:
        return {
            "snr_db_median": Metric("median SNR [dB]", True),
            "snr_db_mean": Metric("mean SNR [dB]", True),
            "snr_db_p10": Metric("p10 SNR [dB]", True, is_brief=False),
            "snr_db_p90": Metric("p90 SNR [dB]", True, is_brief=False),
            "sinad_db_mean": Metric("mean SINAD [dB]", True, is_brief=False),
            "nmse_db": Metric("NMSE [dB]", False),
            "snr_aligned_db_median": Metric("median SNR, phase removed [dB]", True),
            "snr_aligned_db_mean": Metric("mean SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p10": Metric("p10 SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p90": Metric("p90 SNR, phase removed [dB]", True, is_brief=False),
        }

    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """SNR of each link, with its phase and without, SINAD [dB], and the powers of error and label.

        A label that is zero throughout has no SNR, and is a ``ValueError``.
        """
        check_values(labels, values, self.shape, "channels")
        h, guess = (part.detach().cpu().to(torch.complex128).flatten(1) for part in (labels, values))
        power = h.abs().square().sum(1)
        if silent := int((power == 0).sum()):
            raise ValueError(f"labels must not be zero throughout, got {silent} such channels; leave them out")
        phase = torch.polar(torch.ones_like(power), (guess.conj() * h).sum(1).angle())
        error, aligned = ((h - turned).abs().square().sum(1) for turned in (guess, phase[:, None] * guess))
        return {
            "snr_db": -decibels(error, power),
            "snr_aligned_db": -decibels(aligned, power),
            "sinad_db": -decibels(error, power + error),
            "error_power": error,
            "label_power": power,
        }

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Median, mean and percentiles of both SNRs (linear interpolation), mean SINAD, and the NMSE of all links."""
        need_samples(scores["snr_db"])
        numbers = []
        for snr in (scores["snr_db"], scores["snr_aligned_db"]):
            p10, median, p90 = torch.quantile(snr, snr.new_tensor([0.1, 0.5, 0.9])).tolist()
            numbers += [median, snr.mean().item(), p10, p90]
        nmse = decibels(scores["error_power"].sum(), scores["label_power"].sum())
        between = scores["sinad_db"].mean().item(), nmse.item()
        return dict(zip(self.metrics(), [*numbers[:4], *between, *numbers[4:]], strict=True))

    def logged(self, means: dict[str, float]) -> dict[str, float]:
        """The mean scores, with the NMSE in place of the powers."""
        error, power = (torch.tensor(means[name], dtype=torch.float64) for name in ("error_power", "label_power"))
        kept = {name: mean for name, mean in means.items() if not name.endswith("_power")}
        return kept | {"nmse_db": decibels(error, power).item()}

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """Half of the error's power: 3 dB more."""
        error, power = scores["error_power"] / 2, scores["label_power"]
        snr = {name: scores[name] + 10 * math.log10(2) for name in ("snr_db", "snr_aligned_db")}
        snr = {name: score.clamp(max=HIGHEST) for name, score in snr.items()}
        return snr | {"sinad_db": -decibels(error, power + error), "error_power": error, "label_power": power}


def decibels(error: Float[Tensor, "*k"], power: Float[Tensor, "*k"]) -> Float[Tensor, "*k"]:
    """An error's power over a label's [dB]; at least -``HIGHEST``."""
    return 10 * (error / power).clamp(min=10 ** (-HIGHEST / 10)).log10()
