"""Spatial spectra: an amplitude in each direction of a grid."""

import math

import numpy as np
import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

from gaigs.geometry import Grid
from gaigs.query import Batch
from gaigs.registry import register
from gaigs.task import Metric, Task, Thinning, check_values, need_samples

SSIM_WINDOW = 7
"""Edge of scikit-image's default uniform window [pixels]."""


@register("task", "spectrum")
class Spectrum(Task):
    """Amplitudes in [0, 1], one a pixel: row = elevation, column = azimuth.

    Args:
        elevations: Of the rows, in the array's frame [rad].
        azimuths: Of the columns, in the array's frame [rad].
        normalisation: Scale of the labels, in words of docs/data.md.

    Source: the protocol of GAI-GS, "Evaluation"; Wang et al., Image Quality Assessment, 2004.
    """

    name, quantity = "spectrum", "amplitude"
    monitor, higher_is_better = "ssim", True
    pair_score = "SSIM"
    normalisation = ""

    def __init__(self, elevations: Float[Tensor, " rows"], azimuths: Float[Tensor, " columns"], normalisation: str):
        self.directions = Grid(elevations, azimuths)
        self.normalisation = normalisation

    @property
    def shape(self) -> tuple[int, int]:
        return self.directions.shape

    def options(self) -> dict:
        grid = self.directions
        return {"elevations": grid.elevations, "azimuths": grid.azimuths, "normalisation": self.normalisation}

    @classmethod
    def metrics(cls) -> dict[str, Metric]:
        return {
            "ssim_median": Metric("median SSIM", True),
            "ssim_mean": Metric("mean SSIM", True, is_brief=False),
            "ssim_p10": Metric("p10 SSIM", True, is_brief=False),
            "ssim_p90": Metric("p90 SSIM", True, is_brief=False),
            "mae": Metric("MAE", False),
        }

    def scores(
        self, labels: Float[Tensor, "k rows columns"], values: Float[Tensor, "k rows columns"]
    ) -> dict[str, Tensor]:
        """SSIM and mean absolute error of each predicted spectrum.

        SSIM is scikit-image's with its default window and ``data_range=1``, computed in float64. The training loss uses
        another window, so the two differ and have different names. Values outside [0, 1] are scored as they are.

        Raises:
            ValueError: As for every task; or spectra are smaller than the SSIM's window.
        """
        if min(self.shape) < SSIM_WINDOW:
            raise ValueError(
                f"SSIM needs spectra of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, got {self.shape}; "
                "use a finer grid"
            )
        check_values(labels, values, self.shape, "spectra")
        labels, values = labels.detach().cpu().double(), values.detach().cpu().double()
        pairs = zip(labels.numpy(), values.numpy(), strict=True)
        ssim = [structural_similarity(label, value, data_range=1.0) for label, value in pairs]
        return {"ssim": torch.tensor(ssim, dtype=torch.float64), "mae": (labels - values).abs().mean((1, 2))}

    def averaged(self, scores: dict[str, Tensor]) -> dict[str, Tensor]:
        """SSIM s becomes 2 s / (1 + s), below 0 becomes 0; absolute errors fall by the root of 2.

        The SSIM of two labels with the same mean that scatter about a pattern is the pattern's share s of the variance.
        That of the pattern and one label is 2 s / (1 + s). A mean over windows of unlike s is less (Jensen).
        """
        shares = scores["ssim"].clamp(min=0)
        return {"ssim": 2 * shares / (1 + shares), "mae": scores["mae"] / math.sqrt(2)}

    def summarise(self, scores: dict[str, Tensor]) -> dict[str, float]:
        """Median, mean and percentiles of SSIM over the samples (linear interpolation), and the mean of MAE."""
        ssim, mae = scores["ssim"], scores["mae"]
        need_samples(ssim)
        p10, median, p90 = torch.quantile(ssim, ssim.new_tensor([0.1, 0.5, 0.9])).tolist()
        numbers = median, ssim.mean().item(), p10, p90, mae.mean().item()
        return dict(zip(self.metrics(), numbers, strict=True))

    def thinning(self, stride: int = 1, rays: int | None = None) -> Thinning:
        """Every ``stride``-th row and column, with random first ones, or ``rays`` random pixels.

        Neighbouring pixels of a spectrum are far closer than the array resolves.

        Args:
            stride: Step of the rows and columns.
            rays: Number of random pixels, drawn in each step and the same for all links of a batch; None for a grid.

        Raises:
            ValueError: An option is out of range, or both are given.
        """
        rows, columns = self.shape
        coarsest = min(rows, columns) // 3  # which leaves the SSIM loss its smallest window
        if not 1 <= stride <= coarsest:
            raise ValueError(f"training.thinning.stride must be in 1..{coarsest} for this grid, got {stride}")
        if rays is not None and not (1 <= rays <= rows * columns and stride == 1):
            raise ValueError(
                f"training.thinning.rays must be in 1..{rows * columns} for this grid, with stride=1, got {rays} and "
                f"stride {stride}"
            )

        def grid(batch: Batch, generator: torch.Generator) -> Batch:
            row, column = torch.randint(stride, (2,), generator=generator).tolist()
            rows, columns = slice(row, None, stride), slice(column, None, stride)
            return Batch(
                batch.query, batch.directions.thin(rows, columns), batch.labels[:, rows, columns], batch.shares
            )

        def scattered(batch: Batch, generator: torch.Generator) -> Batch:
            chosen = torch.randperm(rows * columns, generator=generator)[:rays].to(batch.labels.device)
            return Batch(
                batch.query, batch.directions.flatten()[chosen], batch.labels.flatten(1)[:, chosen], batch.shares
            )

        return grid if rays is None else scattered

    def packed(self, values: Float[Tensor, "k rows columns"]) -> np.ndarray:
        """float16, which is precise enough for an image."""
        return values.half().numpy()

    def stored(self, labels: Tensor, values: Tensor, scores: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """``ssim``."""
        return {"ssim": scores["ssim"].numpy()}
