"""Models predict a task's value from who sends, who hears, at which frequency and, for spectra, in which directions."""

import math
import reprlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs import checkpoint
from gaigs.data import Links
from gaigs.directions import Directions, Grid, Rays
from gaigs.gaussians import Gaussians
from gaigs.geometry import ExtrapolationWarning
from gaigs.query import CARRIERS, Batch, Query, as_numbers, as_positions, check_carrier
from gaigs.registry import check_type, registry
from gaigs.report.shapes import LearntRoom
from gaigs.scene import Scene

ROUNDING = 1e-6
"""Relative difference up to which two carriers are the same: float32 and seven printed digits round by less."""

INDICES = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""What an index of a receiver may be."""


class Prediction(NamedTuple):
    """What a model gives for a batch.

    Attributes:
        value: (b, *shape) of the task, or of the directions that the batch asks for.
        penalties: Scalars to be added to the loss, by name; means over the batch's places.
    """

    value: Tensor
    penalties: dict[str, Tensor]


class Model(nn.Module):
    """The contract of kind ``model``: ``forward`` takes a ``Batch`` and gives a ``Prediction``.

    A model with parameters is trained, and all that ``predict`` needs is in its state dict. One without parameters, a
    look-up, learns in ``fit`` alone and is not stored.

    Args:
        scene: Receivers and task.

    Attributes:
        trained_by: The component of kind ``training`` that trains it.
        chunk: Most pairs of a link and a direction that are evaluated at a time; None: whole labels, whatever their
            size. Training sees whatever ``training.thinning`` leaves.
        configuration: Of a registered one the options that it was made with; ``save`` stores it.

    Example:
        >>> class Nearest(gaigs.Model):
        ...     \"\"\"What the nearest training place has.\"\"\"
        ...
        ...     def fit(self, links):
        ...         train = links.split.train
        ...         self.places, self.values = links.query[train].transmitters, links.labels[train]
        ...
        ...     def forward(self, batch):
        ...         near = torch.cdist(batch.query.transmitters, self.places).argmin(1)
        ...         return self.values[near], {}
        >>> links = gaigs.links("synthetic", transmitters=20, order=0)
        >>> model = Nearest(links.scene)
        >>> model.fit(links)
        >>> model(links.batch(links.split.test))[0].shape
        torch.Size([4, 90, 360])
    """

    trained_by = "descent"
    chunk: int | None = None

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene

    # --- training ---

    def fit(self, links: Links) -> None:
        """Takes what can be computed from the training links at once; by default nothing."""

    @property
    def predicts_untrained(self) -> bool:
        """Whether ``fit`` alone makes it a predictor, so that the start of the training counts as a candidate."""
        return False

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the name of the learning rate they follow."""
        return {"network": list(self.parameters())}

    @property
    def primitives(self) -> Gaussians | None:
        """The Gaussians that density control changes and figures draw; None for a model without."""
        return None

    @property
    def revisions(self) -> tuple[float, ...]:
        """After which shares of the training ``revise`` is called; by default never."""
        return ()

    def revise(self, number: int, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]) -> str:
        """Changes the model between two steps in ways that gradients cannot, such as by a search.

        Parameters keep their shapes, and all that it decides is in the state dict.

        Args:
            number: Which of ``revisions``, from 0.
            train: Some training links, thinned as the training's steps are.
            validation: Some validation links; None where nothing is held out.
            loss: Of the model as it stands, on a batch.

        Returns:
            What it did, in a sentence for the log.
        """
        raise NotImplementedError

    # --- what a run reports of it ---

    def facts(self) -> dict[str, object]:
        """What ``metrics.json`` says of the model, beside its sizes; by default nothing."""
        return {}

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        """What of a prediction is rendering alone, to be timed; None for a model that renders nothing."""
        return None

    def learnt_room(self, links: Links) -> LearntRoom | None:
        """What figures show of the room it has learnt from these links; None for a model that learns nothing of it."""
        return None

    def export(self, folder: Path) -> None:
        """Writes files for other programs into a run's folder; by default none."""

    def save(self, path: str | Path) -> None:
        """Writes the model into one file, which ``gaigs.load`` reads anywhere, without the data.

        Raises:
            ValueError: It is a look-up, whose links are its whole state; or a part of it has no registered name.
            OSError: The file cannot be written; what was there before stands.

        Example:
            >>> links = gaigs.links("synthetic_rssi", transmitters=50)
            >>> gaigs.train("path_loss", links).save("room.ckpt")
            >>> gaigs.load("room.ckpt").predict([[1.0, 2.0, 1.5]], receiver="west").shape
            torch.Size([1])
        """
        checkpoint.save(self, path)

    # --- prediction ---

    @torch.no_grad()
    def evaluate(self, batch: Batch) -> Tensor:
        """Values of a batch in all the directions it asks for, at most ``chunk`` pairs of link and direction at a time.

        Returns:
            (b, *shape), on the batch's device.
        """
        if self.chunk is None or batch.directions is None:
            return self(batch).value
        rays = batch.directions.flatten()
        (count,) = rays.shape
        links = max(1, self.chunk // count)
        values = []
        for query in batch.query.parts(links):
            parts = (rays[start : start + self.chunk] for start in range(0, count, self.chunk))
            asked = [replace(batch, query=query, directions=part, labels=None) for part in parts]
            value = torch.cat([self(part).value for part in asked], 1)
            values.append(value.unflatten(1, batch.directions.shape))
        return torch.cat(values) if values else self(batch).value

    def predict(
        self,
        transmitters: Query | Float[Tensor, "*points 3"],
        receiver: int | str | Int[Tensor, "*points"] = 0,
        frequency: float | Float[Tensor, "*points"] | None = None,
        batch_size: int = 16,
        directions: Directions | None = None,
    ) -> Tensor:
        """Values for transmitters anywhere: a query, or a point, a list of them, or a grid.

        Args:
            transmitters: Positions, world frame [m], anything that becomes a float tensor, nearer than 1e5 m to the
                origin on each axis as positions of data sets are; or a whole query.
            receiver: Name, or index into the scene's receivers; or the index of each position's receiver.
            frequency: Carrier, one for all or one for each position, from 1e4 to 3e11 Hz as those of data sets are;
                None is the training links' own where they have one carrier or none.
            batch_size: Links worked on at a time.
            directions: Those to predict, where the label has directions; None: the label's own.

        Returns:
            For each position a value of the task's shape, scaled as the training labels were
            (``model.scene.task.normalisation``); on the device of the model.

        Warns:
            ExtrapolationWarning: A position is farther from the box of the training transmitters than this box and the
                receivers are across, or a frequency is outside the training links' band. Of a query nothing is said.

        Raises:
            TypeError: The batch size is no whole number, or the directions are none.
            ValueError: The positions are not (..., 3) real numbers, or one is not finite or too far away; there is no
                such receiver; a frequency is out of range, is another than the training links' only one, or is missing
                where they have several; the batch size is less than 1; directions are asked for where the label has
                none, or are no angles in radians; or a query is given with a receiver or a frequency beside it.

        Example:
            >>> model = gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0))
            >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape
            torch.Size([2, 90, 360])
            >>> few = gaigs.Grid.degrees(elevations=range(10, 90, 10), azimuths=range(0, 360, 10))
            >>> model.predict([1.0, 2.0, 1.5], directions=few).shape
            torch.Size([8, 36])
        """
        query, shape, directions = self._ask(transmitters, receiver, frequency, batch_size, directions)
        parts = [*query.parts(batch_size)] or [query]
        values = torch.cat([self._answer(part, directions) for part in parts])
        return values.reshape(shape + values.shape[1:])

    def predict_batches(
        self,
        transmitters: Query | Float[Tensor, "*points 3"],
        receiver: int | str | Int[Tensor, "*points"] = 0,
        frequency: float | Float[Tensor, "*points"] | None = None,
        batch_size: int = 16,
        directions: Directions | None = None,
    ) -> Iterator[Tensor]:
        """What ``predict`` gives, a batch at a time, for more positions than memory holds values of.

        Args:
            transmitters, receiver, frequency, batch_size, directions: As for ``predict``.

        Returns:
            Values (b, *shape) of one batch of positions after the other, those of a grid in the order of
            ``reshape(-1, 3)``; the last batch may be smaller. Each is computed when it is asked for.

        Warns:
            ExtrapolationWarning: As of ``predict``, at once.

        Raises:
            TypeError, ValueError: As of ``predict``, at once.
        """
        query, _, directions = self._ask(transmitters, receiver, frequency, batch_size, directions)
        return (self._answer(part, directions) for part in query.parts(batch_size))

    @torch.no_grad()
    def _answer(self, query: Query, directions: Directions | None) -> Tensor:
        """Values of a query in evaluation mode; the mode stays what it was."""
        training = self.training
        self.eval()
        try:
            return self.evaluate(Batch(query, directions))
        finally:
            self.train(training)

    def _ask(
        self, transmitters, receiver, frequency, batch_size, directions
    ) -> tuple[Query, tuple[int, ...], Directions | None]:
        """The query that positions stand for, their shape, and the directions asked for; on the model's device."""
        check_type("batch_size", batch_size, int)
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1 link, got {batch_size}")
        is_query = isinstance(transmitters, Query)
        if is_query:
            if frequency is not None or not isinstance(receiver, int) or receiver:
                raise ValueError("a query says itself who hears at which frequency; leave receiver and frequency out")
            query = transmitters
            transmitters, receiver, frequency = query.transmitters, query.receivers, query.frequencies
        own = self.scene.task.directions
        if directions is not None and not isinstance(directions, Directions):
            raise TypeError(
                "directions must be a gaigs.directions.Grid or gaigs.directions.Rays, or None for the label's own, got "
                f"{type(directions).__name__}"
            )
        if directions is not None and own is None:
            raise ValueError(f"labels of task {self.scene.task.name!r} have no directions; leave directions out")
        directions = own if directions is None else as_directions(directions)
        transmitters = as_positions("transmitters", transmitters)
        shape = transmitters.shape[:-1]
        points = transmitters.reshape(-1, 3)
        receivers = self._index(receiver, shape).to(points.device)
        query = Query(points, receivers, self._frequencies(frequency, shape))
        device = next((tensor.device for tensor in self.state_dict().values()), torch.device("cpu"))
        if not is_query:
            self._warn_of_far(points)
            self._warn_of_other_band(query)
        return query.to(device), shape, None if directions is None else directions.to(device)

    def _warn_of_far(self, points: Float[Tensor, "b 3"]) -> None:
        """Warns of positions farther from the training transmitters' box than this box and the receivers are across."""
        lower, upper = self.scene.lower.to(points), self.scene.upper.to(points)
        distances = (points - points.clamp(lower, upper)).norm(dim=-1)
        if count := int((distances > self.scene.extent).sum()):
            warnings.warn(
                f"{count} of {len(points)} positions are up to {distances.amax():.3g} m outside the box of the "
                f"training transmitters, which with the receivers is {self.scene.extent:.3g} m across: nothing was "
                "measured near there",
                ExtrapolationWarning,
                stacklevel=4,
            )

    def _warn_of_other_band(self, query: Query) -> None:
        """Warns of carriers below the training links' lowest or above their highest."""
        if query.frequencies is None or not self.scene.has_band:
            return
        asked, (low, high) = query.frequencies.double(), self.scene.frequencies.double()[[0, -1]].tolist()
        outside = asked[(asked < low * (1 - ROUNDING)) | (asked > high * (1 + ROUNDING))]
        if len(outside):
            first, last = f"{outside.amin():.7g}", f"{outside.amax():.7g}"
            span = first if first == last else f"{first} to {last}"
            warnings.warn(
                f"{len(outside)} of {len(asked)} positions are asked at {span} Hz, outside the training links' band of "
                f"{low:.7g} to {high:.7g} Hz: nothing was measured there",
                ExtrapolationWarning,
                stacklevel=4,
            )

    def _frequencies(self, frequency, shape: tuple[int, ...]) -> Float[Tensor, "b"] | None:
        """The carrier of each position [Hz]."""
        known = self.scene.frequencies.cpu().float()
        if frequency is None:
            if len(known) > 1:
                raise ValueError(
                    f"the training links have {len(known)} carriers, {known[0]:.7g} to {known[-1]:.7g} Hz; say which "
                    "with frequency=..."
                )
            return known[0].expand(shape).reshape(-1) if len(known) else None
        frequency = as_numbers("a frequency", frequency, "a carrier in Hz")
        low, high = CARRIERS
        for wrong in frequency[~((frequency >= low) & (frequency <= high))][:1].tolist():
            check_carrier("a frequency", wrong)
        if frequency.ndim and frequency.shape != shape:
            raise ValueError(
                f"frequencies must be one, or one for each of the {tuple(shape)} positions, got "
                f"{tuple(frequency.shape)}"
            )
        if len(known) < 2 and not (len(known) and torch.isclose(frequency, known[0], rtol=ROUNDING).all()):
            carrier = f"one carrier, {known[0]:.7g} Hz" if len(known) else "no carrier that is known"
            raise ValueError(f"the training links have {carrier}, which says nothing of others; leave frequency out")
        return frequency.expand(shape).reshape(-1)

    def _index(self, receiver: int | str | Tensor, shape: tuple[int, ...]) -> Int[Tensor, "n"]:
        """The index of each position's receiver."""
        names = [receiver.name for receiver in self.scene.receivers]
        expected = f"receiver must be one of {', '.join(f'{i} = {name}' for i, name in enumerate(names))}"
        try:
            index = torch.as_tensor(names.index(receiver) if isinstance(receiver, str) else receiver)
        except (ValueError, TypeError, RuntimeError, OverflowError):  # no such name, or what is no index
            raise ValueError(f"{expected}, got {reprlib.repr(receiver)}") from None
        if index.dtype not in INDICES:
            given = repr(receiver) if not index.ndim else f"{tuple(index.shape)} of {index.dtype}"
            raise ValueError(f"{expected}, got {given}")
        index = index.long()
        wrong = index[(index < 0) | (index >= len(names))]
        if len(wrong):
            raise ValueError(f"{expected}, got {wrong[0]}")
        if index.ndim and index.shape != shape:
            raise ValueError(
                f"receivers must be one, or one for each of the {tuple(shape)} positions, got {tuple(index.shape)}"
            )
        return index.expand(shape).reshape(-1)


def as_directions(directions: Directions) -> Directions:
    """Directions that a model can be asked for: lists of angles [rad], in float32.

    Raises:
        ValueError: An angle is no number, or too large to be one in radians; or rays have not one of either each.
    """
    angles = {}
    # Azimuths are periodic, and a few turns are no mistake; those of a circle in degrees are more. 1e-4 is for angles
    # that somebody has rounded.
    for name, most in (("elevations", math.pi / 2), ("azimuths", 20 * math.pi)):
        expected = f"{name} must be a list of angles from {-most:.4f} to {most:.4f} rad"
        angles[name] = values = as_numbers(name, getattr(directions, name), expected.partition("be ")[2])
        if values.ndim != 1:
            raise ValueError(f"{expected}, got shape {tuple(values.shape)}")
        if len(wrong := values[~(values.abs() <= most + 1e-4)]):
            raise ValueError(f"{expected}, got {wrong[0]:g}; Grid.degrees takes degrees")
    counts = [len(values) for values in angles.values()]
    if isinstance(directions, Rays) and counts[0] != counts[1]:
        raise ValueError(
            f"rays must have as many elevations as azimuths, got {counts[0]} and {counts[1]}; Grid has rows"
        )
    return (Rays if isinstance(directions, Rays) else Grid)(**angles)


def build_trend(trend: str | Mapping | Model, scene: Scene) -> Model:
    """The model that a trend is, or that its name or configuration stands for.

    Raises:
        ValueError: It names none, or that model cannot be made so.
    """
    is_known = trend in registry("model").names() if isinstance(trend, str) else True
    if not is_known or (isinstance(trend, Mapping) and "name" not in trend):
        raise ValueError(f"model.trend must have the name of a model, such as mean, got {trend!r}")
    return registry("model").build(trend, scene=scene)
