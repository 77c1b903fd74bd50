"""Labels as the images that networks draw: a spectrum in fewer pixels, a level in one, a channel in
two colours.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.geometry import Directions, Grid
from gaigs.core.propagation import strength
from gaigs.core.scene import Scene, direct_waves
from gaigs.data import Links

LARGEST = 90.0
"""No pixel is larger [deg]: at least two rows are left of the sphere's upper half."""

PART = 256
"""Labels held in memory at a time: a spectrum takes 130 KB."""


class LabelImage(nn.Module):
    """A label as an image, of mean 0 and variance 1 over the training links.

    | label | rows | columns | channels |
    |---|---|---|---|
    | spectrum | elevations | azimuths | 1 |
    | one number a link | 1 | 1 | 1 |
    | complex channel | elements | subcarriers | 2: real and imaginary part |

    A spectrum's image has every k-th row and column of the label, and is interpolated linearly
    between them. Complex labels are scaled by the amplitude of free space at the median link, times
    their ``strength`` over free space, which no single link decides. They are not shifted, as 0 has
    no phase.

    Args:
        scene: Receivers and task of the labels.
        pixel: Largest distance from one row or column of a spectrum's image to the next [deg]; the
            label's own if that is larger.

    Attributes:
        shape: Channels, rows, columns.
        grid: Directions of the pixels; None for labels without directions.

    Raises:
        ValueError: ``pixel`` is not positive, or larger than ``LARGEST``.
    """

    def __init__(self, scene: Scene, pixel: float):
        super().__init__()
        if not 0 < pixel <= LARGEST:
            raise ValueError(
                f"model.pixel must be above 0 and at most {LARGEST:g} [deg], got {pixel}"
            )
        self.scene = scene
        self.task = scene.task
        self.grid = None
        shape = scene.task.shape
        rows = shape[0] if len(shape) > 1 else 1
        columns = math.prod(shape) // rows
        if scene.task.directions is not None:
            grid = scene.task.directions
            self.grid = grid.thin(every(grid.elevations, pixel), every(grid.azimuths, pixel))
            rows, columns = self.grid.shape
        self.shape = (2 if scene.task.dtype.is_complex else 1, rows, columns)
        self.register_buffer("mean", torch.tensor(0.0))
        self.register_buffer("scale", torch.tensor(1.0))

    def fit(self, links: Links) -> None:
        """Takes mean and scale from the training links."""
        if self.task.dtype.is_complex:
            labels = links.labels[links.split.train]
            query = links.query[links.split.train]
            waves = direct_waves(self.scene, query, self.task.frequencies, at_elements=False)
            waves = waves.expand_as(labels)
            usual = waves.abs().square().mean((1, 2)).sqrt().quantile(0.5).item()
            self.scale.fill_(usual * strength(labels, waves, query.receivers))
            return
        total, power, count = 0.0, 0.0, 0
        for index in links.split.train.split(PART):
            labels = links.labels[index]
            labels = labels.to(torch.promote_types(labels.dtype, torch.float64))
            total += labels.sum().item()
            power += labels.square().sum().item()
            count += labels.numel()
        mean = total / count
        variance = power / count - mean**2
        self.mean.fill_(mean)
        self.scale.fill_(math.sqrt(variance) if variance > 0 else 1.0)  # labels may all be the same

    def values(
        self, images: Float[Tensor, "b channels rows columns"], directions: Directions | None
    ) -> Tensor:
        """The labels of images (b, *shape).

        Args:
            directions: Directions of spectra; None: all of the label.
        """
        # torch has no complex numbers of bfloat16 (trainer.precision=bf16-mixed).
        images = images.to(torch.promote_types(images.dtype, torch.float32))
        images = images * self.scale + self.mean
        if self.grid is not None:
            return interpolate(images[:, 0], self.grid, directions or self.task.directions)
        numbers = torch.complex(*images.unbind(1)) if self.task.dtype.is_complex else images
        return numbers.reshape(len(images), *self.task.shape)

    def images(
        self, labels: Tensor, directions: Directions | None
    ) -> Float[Tensor, "b channels rows columns"]:
        """The images of labels. Images of spectra have a pixel for each direction of the labels.

        Raises:
            ValueError: The labels are of single directions, which make no image.
        """
        if self.grid is not None and not isinstance(directions, Grid):
            raise ValueError(
                "a network that looks at labels needs rows and columns, and training.thinning.rays "
                "draws single directions; set training.thinning.rays=null"
            )
        channels, rows, columns = self.shape if self.grid is None else (1, *directions.shape)
        numbers = torch.view_as_real(labels).movedim(-1, 1) if labels.is_complex() else labels
        scaled = (numbers - self.mean) / self.scale
        return scaled.reshape(len(labels), channels, rows, columns)

    def own_images(
        self, labels: Tensor, directions: Directions | None
    ) -> Float[Tensor, "b channels rows columns"]:
        """The images of labels, of spectra interpolated to the pixels of ``grid``."""
        images = self.images(labels, directions)
        if self.grid is None:
            return images
        return interpolate(images[:, 0], directions, self.grid)[:, None]


def every(angles: Float[Tensor, " n"], pixel: float) -> slice:
    """Slice of every k-th of even ``angles`` [rad], at most a ``pixel`` [deg] apart."""
    pitch = (angles.max() - angles.min()).item() / max(len(angles) - 1, 1)
    # A hundredth more: four rows of a degree in float32 may be more than 4 degrees apart.
    return slice(None, None, max(1, int(1.01 * math.radians(pixel) / pitch)) if pitch else 1)


def interpolate(
    values: Float[Tensor, "b rows columns"], grid: Grid, directions: Directions
) -> Float[Tensor, "b ..."]:
    """Values of a grid, interpolated linearly in some directions.

    Directions beyond the first or last row get the values of that row. Azimuths go round: the last
    column is beside the first one.
    """
    rows = shares(grid.elevations, directions.elevations).to(values)
    columns = shares(grid.azimuths, directions.azimuths, period=2 * math.pi).to(values)
    if isinstance(directions, Grid):
        return rows @ values @ columns.mT
    return (rows @ values * columns).sum(-1)


def shares(
    known: Float[Tensor, " n"], angles: Float[Tensor, " k"], period: float | None = None
) -> Float[Tensor, "k n"]:
    """Weights of values at known angles in the interpolated value at each angle [rad], float64.

    Args:
        period: Period of the angles [rad]; None: angles beyond the known ones count as the last.
    """
    count = len(known)
    known, order = known.double().sort()
    angles = angles.to(known)
    if period is None:
        angles = angles.clamp(known[0], known[-1])
    else:
        angles = known[0] + (angles - known[0]).remainder(period)
        known = torch.cat((known, known[:1] + period))
        order = torch.cat((order, order[:1]))
    if len(known) == 1:
        return torch.ones_like(angles)[:, None]
    above = torch.searchsorted(known, angles, right=True).clamp(max=len(known) - 1)
    share = (angles - known[above - 1]) / (known[above] - known[above - 1])
    weights = angles.new_zeros(len(angles), count)
    weights.scatter_add_(1, order[above - 1][:, None], 1 - share[:, None])
    return weights.scatter_add_(1, order[above][:, None], share[:, None])
