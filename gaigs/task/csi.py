"""Channel state information: a complex channel at each element of the receiver's array and each subcarrier."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.registry import register
from gaigs.task import Metric, Task, check_values, need_samples, stored_scores

HIGHEST = 140.0
"""No SNR is told beyond this [dB]: complex64 resolves nothing finer, and a perfect prediction has no finite one."""

EXAMPLES = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
"""Which channels are shown, by their rank in SNR."""


@register("task", "csi")
class Csi(Task):
    """Complex channels (elements, subcarriers), linear amplitudes in the data's own unit.

    SNR [dB] = -10 log10(|h - h'|² / |h|²) over a link's elements and subcarriers; ``snr_aligned_db`` is that after the
    global phase of the prediction that suits the label best, as where receiver and transmitter share no clock.

    Args:
        elements: Of the receivers' arrays; 1 for single antennas.
        frequencies: Of the subcarriers (s,) [Hz]; absolute.

    Raises:
        ValueError: There is no element or subcarrier, or a frequency is not positive and finite.

    Source: NeWRF, 2024, and NeRF², 2023, "Evaluation".
    """

    name, quantity = "csi", "channel"
    watched, larger_is_better = "snr_db", True
    pair_score = "SNR [dB]"
    dtype = torch.complex64
    normalisation = "linear amplitude, in the data's own unit"

    def __init__(self, elements: int, frequencies: Float[Tensor, "s"]):
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
            "snr_aligned_db_median": Metric("median SNR, phase removed [dB]", True),
            "snr_aligned_db_mean": Metric("mean SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p10": Metric("p10 SNR, phase removed [dB]", True, is_brief=False),
            "snr_aligned_db_p90": Metric("p90 SNR, phase removed [dB]", True, is_brief=False),
        }

    def scores(self, labels: Complex[Tensor, "k e s"], values: Complex[Tensor, "k e s"]) -> dict[str, Tensor]:
        """SNR of each link, with its phase and without [dB].

        Raises:
            ValueError: As for every task; or a label is zero throughout, and has no SNR.
        """
        check_values(labels, values, self.shape, "channels")
        h, guess = (part.detach().cpu().to(torch.complex128).flatten(1) for part in (labels, values))
        power = h.abs().square().sum(1)
        if (power == 0).any():
            raise ValueError(
                f"labels must not be zero throughout, got {int((power == 0).sum())} such channels; leave them out"
            )
        phase = torch.polar(torch.ones_like(power), (guess.conj() * h).sum(1).angle())
        return {
            name: -10 * ((h - turned).abs().square().sum(1) / power).clamp(min=10 ** (-HIGHEST / 10)).log10()
            for name, turned in (("snr_db", guess), ("snr_aligned_db", phase[:, None] * guess))
        }

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Median, mean and percentiles over the links (linear interpolation) of both scores."""
        need_samples(scores["snr_db"])
        numbers = []
        for snr in (scores["snr_db"], scores["snr_aligned_db"]):
            p10, median, p90 = torch.quantile(snr, snr.new_tensor([0.1, 0.5, 0.9])).tolist()
            numbers += [median, snr.mean().item(), p10, p90]
        return dict(zip(self.metrics(), numbers, strict=True))

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """3 dB more, as half of the difference's power is left."""
        return {name: (score + 10 * math.log10(2)).clamp(max=HIGHEST) for name, score in scores.items()}

    def figures(self, folder: Path, links) -> dict:
        """Magnitude, phase and impulse response of the 10th, 50th and 90th percentile, and how SNR is distributed."""
        from gaigs.report.channels import impulse_responses, magnitudes_and_phases  # matplotlib is slow to import
        from gaigs.report.curves import cdf

        with np.load(folder / "predictions.npz") as run:
            prefix = f"{self.watched}_"
            scores = {name.removeprefix(prefix): run[name] for name in run.files if name.startswith(prefix)}
            labels, predictions = run["labels"], run["prediction"]
        own = next(iter(scores.values()))
        order = np.argsort(own)
        names = {order[round(rank * (len(own) - 1))]: name for name, rank in EXAMPLES.items()}
        shown = list(names)
        examples = labels[shown], predictions[shown], own[shown], list(names.values()), self.frequencies.numpy()
        figures = {"channels": magnitudes_and_phases(*examples)}
        if len(self.frequencies) > 1:
            figures["impulse_response"] = impulse_responses(*examples)
        return figures | {"snr_cdf": cdf(scores, "SNR [dB]", "channels", links.split.name, (None, None))}

    @classmethod
    def compared(cls, files: Mapping[str, Path], split: str) -> dict:
        """How SNR is distributed."""
        from gaigs.report.curves import cdf  # matplotlib is slow to import

        return {"cdf": cdf(stored_scores(files, cls.watched), "SNR [dB]", "channels", split, (None, None))}
