"""Predictions with their uncertainty, and the names of their axes."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.core.results import library, plot
from gaigs.core.task import Axis


class Asked(NamedTuple):
    """The request of a prediction: names and coordinates of its axes."""

    positions: Float[Tensor, "*places 3"]  # positions of the transmitters (..., 3) [m]
    # Names of the receivers, (k,) if the prediction has an axis of receivers, otherwise one for
    # each position (...).
    receivers: ndarray
    has_axis: bool  # True if the prediction has an axis of receivers
    axes: Mapping[str, Axis]  # axes of a label
    # Name and unit of a value.
    quantity: str
    unit: str

    @property
    def dimensions(self) -> tuple[str, ...]:
        """Names of the axes of a value; axes of a grid of places are ``place_0``, ``place_1``."""
        count = self.positions.ndim - 1
        places = ["place"] if count == 1 else [f"place_{axis}" for axis in range(count)]
        return (*places, *["receiver"] * self.has_axis, *self.axes)


class EstimateParts(NamedTuple):
    """Tensors of an ``Estimate``."""

    value: Tensor
    std: Tensor
    lower: Tensor | None
    upper: Tensor | None
    radius: Tensor | None = None
    snr_db: Tensor | None = None


class Estimate(EstimateParts):
    """A prediction with its uncertainty, from ``model.predict(x, interval=0.9)``; a tuple of
    tensors shaped as the value.

    Attributes:
        value: The prediction of ``predict`` without an interval.
        std: Standard deviation of the label about the value, in the label's unit; for a channel
            the standard deviation of the complex error. This and the following attributes are NaN
            at elements that an array lacks.
        lower, upper: Ends of the interval that holds the label with the requested probability; None
            for channels.
        radius: Radius of a disc about the value that holds the channel with this probability, in
            the label's unit; None for other labels.
        snr_db: Expected signal-to-noise ratio of each link's channel [dB], without the axes of
            elements and subcarriers; None for other labels.
        asked: Names and coordinates of the tensors' axes; None if unknown. No item of the tuple.

    Example:
        >>> model = gaigs.train("knn", gaigs.links("synthetic_rssi", transmitters=100))
        >>> found = model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]], interval=0.9)
        >>> found.upper.shape, bool((found.lower < found.value).all())  # places, receivers
        (torch.Size([2, 4]), True)
    """

    asked: Asked | None = None

    def about(self, asked: Asked) -> "Estimate":
        """The estimate itself, after its axes are set."""
        self.asked = asked
        return self

    plot = plot

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with ``value``, ``std``, ... by places, receivers and axes of a
        label, with their coordinates.

        Raises:
            ImportError: Xarray is not installed.
            ValueError: The estimate is not from ``model.predict``.
        """
        if self.asked is None:
            raise ValueError("only estimates of model.predict know their places")
        asked = self.asked
        dimensions = asked.dimensions
        places = dimensions[: asked.positions.ndim - 1]
        coordinates = {}
        for number, name in enumerate("xyz"):
            values = asked.positions[..., number].cpu().numpy()
            coordinates[name] = (places, values, {"units": "m"})
        axes = ("receiver",) if asked.has_axis else places
        coordinates["receiver"] = (axes, asked.receivers)
        sizes = dict(zip(dimensions, self.value.shape, strict=True))
        for name, axis in asked.axes.items():  # an array may have fewer elements than another
            coordinates[name] = ((name,), axis.values[: sizes[name]], {"units": axis.unit})
        variables = {}
        for name in self._fields:
            part = getattr(self, name)
            if part is not None:
                unit = {"units": "dB" if name == "snr_db" else asked.unit}
                variables[name] = (dimensions[: part.ndim], part.cpu().numpy(), unit)
        title = {"title": f"{asked.quantity} predicted by gaigs"}
        return library("xarray", "to_xarray").Dataset(variables, coordinates, title)
