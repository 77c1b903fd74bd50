"""Spatial spectra: an amplitude in each direction of a grid."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, as_directions
from gaigs.core.task import Metric, Task, Thinning, check_values, need_samples
from gaigs.registry import register

SSIM_WINDOW = 7
"""Edge of scikit-image's default uniform window [pixels]."""

MIN_MAX = "min-max of each spectrum's amplitude"
"""Normalisation of the measured sets: (s - min s) / (max s - min s) over one spectrum s."""


@register("task", "spectrum")
class Spectrum(Task):
    """Spectra of amplitudes in [0, 1], with rows of elevation and columns of azimuth.

    Args:
        elevations: Elevations of the rows in the array's frame [rad].
        azimuths: Azimuths of the columns in the array's frame [rad].
        normalisation: Scale of the labels, in words of docs/data.md. By default each spectrum is
            scaled to a minimum of 0 and a maximum of 1.

    Source: the protocol of GAI-GS, "Evaluation"; Wang et al., Image Quality Assessment, 2004.
    """

    name, quantity = "spectrum", "amplitude"
    monitor, higher_is_better = "ssim", True
    pair_score = "SSIM"
    normalisation = ""
    lowest, limits = 0.0, (0.0, 1.0)

    def __init__(
        self,
        elevations: Float[Tensor, " rows"] | Float[np.ndarray, " rows"] | Sequence[float],
        azimuths: Float[Tensor, " columns"] | Float[np.ndarray, " columns"] | Sequence[float],
        normalisation: str = MIN_MAX,
    ):
        grid = Grid(
            torch.as_tensor(elevations, dtype=torch.float32),
            torch.as_tensor(azimuths, dtype=torch.float32),
        )
        # Checks the angles. The second grid says that labels of this task have directions.
        self.directions: Grid = as_directions(grid, grid, self.name)
        self.normalisation = normalisation

    @property
    def shape(self) -> tuple[int, int]:
        return self.directions.shape

    def options(self) -> dict:
        grid = self.directions
        return {
            "elevations": grid.elevations,
            "azimuths": grid.azimuths,
            "normalisation": self.normalisation,
        }

    @classmethod
    def metrics(cls) -> dict[str, Metric]:
        return {
            "ssim_median": Metric("median SSIM", True),
            "ssim_mean": Metric("mean SSIM", True, is_brief=False),
            "ssim_p10": Metric("p10 SSIM", True, is_brief=False),
            "ssim_p90": Metric("p90 SSIM", True, is_brief=False),
            "mae": Metric("MAE", False),
        }

    def scores(self, labels: Tensor, values: Tensor) -> dict[str, Tensor]:
        """SSIM and mean absolute error of each predicted spectrum.

        SSIM is scikit-image's with its default window and ``data_range=1``, in float64. The
        training loss has another window. Values outside [0, 1] are not clipped.

        Raises:
            ValueError: Spectra are smaller than the window.
        """
        if min(self.shape) < SSIM_WINDOW:
            window = f"{SSIM_WINDOW} x {SSIM_WINDOW}"
            raise ValueError(f"SSIM needs at least {window} pixels, got {self.shape}")
        check_values(labels, values, self.shape, "spectra")
        labels = labels.detach().cpu().double()  # (k, rows, columns)
        values = values.detach().cpu().double()
        pairs = zip(labels.numpy(), values.numpy(), strict=True)
        ssim = [structural_similarity(label, value, data_range=1.0) for label, value in pairs]
        return {
            "ssim": torch.tensor(ssim, dtype=torch.float64),
            "mae": (labels - values).abs().mean((1, 2)),
        }

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """Scores of the mean of many spectra as a prediction of each.

        An SSIM of s becomes 2 s / (1 + s), an SSIM below 0 becomes 0, and absolute errors fall by
        the root of 2. The reason is that the SSIM of two noisy labels is the fraction s of their
        variance that comes from their common pattern. The SSIM of this pattern with one label is
        2 s / (1 + s).
        """
        shares = scores["ssim"].clamp(min=0)
        return {"ssim": 2 * shares / (1 + shares), "mae": scores["mae"] / math.sqrt(2)}

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Median, mean and percentiles of SSIM over the samples, and the mean of MAE.

        Percentiles are interpolated linearly.
        """
        ssim = scores["ssim"]
        need_samples(ssim)
        p10, median, p90 = torch.quantile(ssim, ssim.new_tensor([0.1, 0.5, 0.9])).tolist()
        numbers = (median, ssim.mean().item(), p10, p90, scores["mae"].mean().item())
        return dict(zip(self.metrics(), numbers, strict=True))

    def thinning(self, stride: int = 1, rays: int | None = None) -> Thinning:
        """Every ``stride``-th row and column, or ``rays`` random pixels, the same for all links.

        The first row and column are drawn in each step. Such a thinning loses little, since
        neighbouring pixels are much closer than the resolution of the array. A small grid keeps at
        least three rows and columns.
        """
        rows, columns = self.shape
        if stride < 1:
            raise ValueError(f"training.thinning.stride must be at least 1, got {stride}")
        # Three rows and columns are the smallest window of the SSIM loss.
        stride = max(1, min(stride, min(rows, columns) // 3))
        pixels = rows * columns
        if rays is not None and not (1 <= rays <= pixels and stride == 1):
            raise ValueError(
                f"training.thinning.rays must be in 1..{pixels} with stride=1, "
                f"got {rays}, stride {stride}"
            )

        def grid(batch: Batch, generator: torch.Generator) -> Batch:
            row, column = torch.randint(stride, (2,), generator=generator).tolist()
            every_row = slice(row, None, stride)
            every_column = slice(column, None, stride)
            directions = batch.directions.thin(every_row, every_column)
            labels = batch.labels[:, every_row, every_column]
            return replace(batch, directions=directions, labels=labels)

        def scattered(batch: Batch, generator: torch.Generator) -> Batch:
            order = torch.randperm(pixels, generator=generator)
            chosen = order[:rays].to(batch.labels.device)  # (rays,)
            directions = batch.directions.flatten()[chosen]
            labels = batch.labels.flatten(1)[:, chosen]  # (k, rays)
            return replace(batch, directions=directions, labels=labels)

        return grid if rays is None else scattered

    def packed(self, values: Float[Tensor, "k rows columns"]) -> np.ndarray:
        return values.half().numpy()

    def stored(
        self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]
    ) -> dict[str, np.ndarray]:
        """The array ``ssim``, the similarity of each prediction."""
        return {"ssim": scores["ssim"].numpy()}
