"""Receivers and the elements of their antennas."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from gaigs.core.geometry import Pose


def differences(places: Float[Tensor, "e 3"]) -> tuple[Float[Tensor, "l 3"], Int[Tensor, " pairs"]]:
    """The l distinct vectors between places, and the number of each pair's vector.

    Vectors are rounded to nine decimals. A pair (i, j) has the vector place i minus place j. Pairs
    are ordered by i, then by j.
    """
    apart = (places[:, None] - places).flatten(0, 1).round(decimals=9)  # (e x e, 3)
    return torch.unique(apart, dim=0, return_inverse=True)


@dataclass(frozen=True)
class Array:
    """A receiver's antenna: one or several separately fed elements.

    Attributes:
        elements: Positions in the array's own frame (e, 3) [m].
        pattern: Field pattern of each element: ``isotropic``, or ``cosine``. A cosine pattern is
            the cosine of the angle to the array's normal, and 0 behind the array.

    Example:
        >>> len(gaigs.Array.planar(4, 4, pitch=0.16)), len(gaigs.Array.single())
        (16, 1)
    """

    elements: Tensor
    pattern: str = "isotropic"
    patterns: ClassVar[tuple[str, ...]] = ("isotropic", "cosine")

    def __post_init__(self) -> None:
        if self.pattern not in self.patterns:
            one = ", ".join(self.patterns)
            raise ValueError(f"an array's pattern must be one of {one}, got {self.pattern!r}")
        if self.elements.ndim != 2 or self.elements.shape[1] != 3 or not len(self.elements):
            raise ValueError(
                "an array's elements must be (e, 3) positions [m], got "
                f"{tuple(self.elements.shape)}"
            )

    @classmethod
    def single(cls) -> "Array":
        return cls(torch.zeros(1, 3, dtype=torch.float32))

    @classmethod
    def planar(cls, rows: int, columns: int, pitch: float, pattern: str = "isotropic") -> "Array":
        """Elements in the array's x-y plane, centred, column by column: y varies fastest.

        Args:
            rows, columns: Numbers of elements along y and along x.
            pitch: Distance between neighbouring elements [m].
            pattern: Field pattern of each element, ``isotropic`` or ``cosine``.
        """
        if rows < 1 or columns < 1 or not 0 < pitch < math.inf:
            raise ValueError(
                f"an array must have at least 1 x 1 elements at a positive pitch, got {rows} x "
                f"{columns} at {pitch} m"
            )

        def steps(count):
            return (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * pitch

        x, y = torch.meshgrid(steps(columns), steps(rows), indexing="ij")
        return cls(torch.stack((x, y, 0 * x), -1).flatten(0, 1), pattern)

    def __len__(self) -> int:
        return len(self.elements)

    @functools.cached_property
    def is_point(self) -> bool:
        """True for one isotropic element in the middle: the orientation does not matter."""
        return len(self) == 1 and self.pattern == "isotropic" and not self.elements.any()

    @functools.cached_property
    def lags(self) -> tuple[Float[Tensor, "l 3"], Int[Tensor, " pairs"], Float[Tensor, " l"]]:
        """Lags, the distinct vectors between two elements, over which covariances are averaged.

        The covariance of a field depends on lags alone. A 4 x 4 array has 49 lags.

        Returns:
            The lags [m], float64; the number of each pair's lag; and the number of pairs at each
            lag, float64.
        """
        # Cached tensors of inference mode could not be saved for a later backward pass.
        with torch.inference_mode(False):
            steps, pairs = differences(self.elements.clone().double())
            return steps, pairs, torch.bincount(pairs).double()

    def by_lag(self, covariances: Complex[Tensor, "b e e"]) -> Complex[Tensor, "b l"]:
        """Mean covariance of the pairs of elements at each of ``lags``."""
        _, pairs, counts = self.lags
        sums = covariances.new_zeros(len(covariances), len(counts))  # (b, l)
        sums = sums.index_add(1, pairs.to(covariances.device), covariances.flatten(1))
        return sums / counts.to(covariances.real)

    def gain(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Field gain of an element towards unit vectors in the array's frame."""
        if self.pattern == "cosine":
            return directions[..., 2].clamp(min=0)
        return torch.ones_like(directions[..., 2])


@dataclass(frozen=True)
class Receiver:
    """An antenna array or gateway: its name in files and tables, its pose and its antenna.

    Attributes:
        band: Lowest and highest frequency that the antenna receives [Hz], the highest excluded.
            Channels are 0 at subcarriers outside the band. By default the band is unlimited.

    Example:
        >>> pose = gaigs.Pose.from_xyzw([1.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])
        >>> len(gaigs.Receiver("door", pose, gaigs.Array.planar(4, 4, pitch=0.16)).array)
        16
    """

    name: str
    pose: Pose
    array: Array = field(default_factory=Array.single)
    band: tuple[float, float] = (0.0, math.inf)

    def __post_init__(self) -> None:
        low, high = self.band
        if not 0 <= low < high:
            raise ValueError(
                f"the band of receiver {self.name!r} must be two ascending frequencies [Hz], got "
                f"{self.band}"
            )
        axes = self.pose.rotation.double()
        # NaN is no rotation either, nor a mirror, whose determinant is -1.
        if not (
            (axes.mT @ axes - torch.eye(3).to(axes)).abs().max() <= 1e-3
            and torch.linalg.det(axes) > 0
        ):
            wanted = "a rotation, whose orthonormal columns are the array's axes"
            raise ValueError(
                f"the pose of receiver {self.name!r} must have {wanted}, got {axes.tolist()}"
            )

    def hears(self, frequencies: Float[Tensor, " s"]) -> Bool[Tensor, " s"]:
        """True for frequencies [Hz] that are within the receiver's band."""
        return (frequencies >= self.band[0]) & (frequencies < self.band[1])


def lacking(
    receivers: Sequence[Receiver],
    index: Int[Tensor, " b"],
    count: int,
    frequencies: Float[Tensor, " s"],
) -> Bool[Tensor, "b e s"]:
    """True where a link's receiver lacks the element, or the subcarrier is outside its band.

    Args:
        receivers: All receivers.
        index: Number of each link's receiver.
        count: Number e of elements of a channel. The last ones are missing in smaller arrays.
        frequencies: Subcarriers [Hz].
    """
    sizes = torch.tensor([len(receiver.array) for receiver in receivers])
    hears = torch.stack([receiver.hears(frequencies.cpu()) for receiver in receivers])  # (r, s)
    exists = torch.arange(count) < sizes[:, None]  # (r, e)
    absent = ~(exists[..., None] & hears[:, None])  # (r, e, s)
    return absent.to(index.device)[index.long()]
