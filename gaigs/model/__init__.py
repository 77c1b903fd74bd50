"""Models predict a task's value from transmitter, receiver, carrier and, for spectra, directions."""

import copy
import itertools
import math
import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, overload

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.calibration import Calibration, Estimate
from gaigs.core.antenna import lacking
from gaigs.core.geometry import Directions, ExtrapolationWarning
from gaigs.core.query import ROUNDING, Batch, Query, as_directions, as_receivers, as_subcarriers
from gaigs.core.scene import Scene
from gaigs.core.stages import track
from gaigs.data import Links
from gaigs.kriging.kernel import Process
from gaigs.kriging.links import PART
from gaigs.model import checkpoint
from gaigs.registry import check_type, name_of, registry
from gaigs.registry.torch_modes import usual_modes
from gaigs.splatting.gaussians import Gaussians

NUMBERS, MOST = 2**17, 1024
"""Numbers of labels that a prediction computes at a time, and most links; 16 links at least."""


class Prediction(NamedTuple):
    """A model's answer to a batch.

    Attributes:
        value: (b, *shape) of the task, or of the batch's directions.
        penalties: Scalars added to the loss, by name; means over the batch's places.
    """

    value: Tensor
    penalties: Mapping[str, Tensor] = {}


class Model(nn.Module):
    """The contract of kind ``model``: ``forward`` takes a ``Batch`` and gives a ``Prediction``.

    The state dict has all that ``predict`` needs. A model with parameters is trained. One without
    is a look-up: it learns in ``fit`` only, see ``LookUp``. A model may also have the methods of
    ``OptionalMethods``.

    Args:
        scene: Receivers and task.

    Attributes:
        trained_by: Name of the component of kind ``training`` that trains it.
        learning_rates: Default learning rate of each parameter group; ``training.learning_rates``
            overrides it.
        penalty_weights: Default weight of each penalty; ``training.penalties`` overrides it.
        chunk: Largest number of pairs of a link and a direction evaluated at a time; None: whole
            labels. Training sees as many as ``training.thinning`` leaves.
        revisions: Fractions of the training after which ``OptionalMethods.revise`` is called.
        any_frequency: True if channels are a function of frequency, read from
            ``scene.task.frequencies``.
        configuration: Options that a registered model was made with; ``save`` stores them.
        calibration: What intervals are made of; None if no validation links have measured the
            model's errors.
        known_places: Keys of the training and validation places, ``Query.place_keys``; None if
            these are unknown.

    Example:
        >>> class Nearest(gaigs.Model):
        ...     \"\"\"The label of the nearest training place.\"\"\"
        ...
        ...     def fit(self, links):
        ...         train = links.split.train
        ...         self.places, self.values = links.query[train].transmitters, links.labels[train]
        ...
        ...     def forward(self, batch):
        ...         near = torch.cdist(batch.query.transmitters, self.places).argmin(1)
        ...         return gaigs.model.Prediction(self.values[near], {})
        >>> links = gaigs.links("synthetic", transmitters=20, order=0)
        >>> model = Nearest(links.scene)
        >>> model.fit(links)
        >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape  # places, receivers, rows, columns
        torch.Size([2, 1, 90, 360])
    """

    trained_by = "descent"
    learning_rates: Mapping[str, float] = {"network": 1.6e-2}
    penalty_weights: Mapping[str, float] = {}
    chunk: int | None = None
    revisions: tuple[float, ...] = ()
    predicts_untrained: bool = False
    any_frequency: bool = False
    primitives: Gaussians | None = None
    calibration: Calibration | None = None
    known_places: Tensor | None = None

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene

    @property
    def device(self) -> torch.device:
        """The device of the model's tensors; the CPU for a look-up without."""
        tensors = itertools.chain(self.parameters(), self.buffers())
        return next((tensor.device for tensor in tensors), torch.device("cpu"))

    def fit(self, links: Links) -> None:
        """Learns from the training links without gradients; by default nothing.

        Raises:
            ValueError: A receiver has no training or validation links.
        """

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the names in ``learning_rates``."""
        return {"network": list(self.parameters())}

    def save(self, path: str | Path) -> None:
        """Writes the model into one file, which ``gaigs.load`` reads anywhere, without the data.

        Raises:
            ValueError: The model has no state, such as a look-up before its fit; or a part has no
                registered name.
            OSError: The file cannot be written; an earlier file stays as it was.

        Example:
            >>> links = gaigs.links("synthetic_rssi", transmitters=50)
            >>> gaigs.train("path_loss", links).save("room.ckpt")
            >>> gaigs.load("room.ckpt").predict([[1.0, 2.0, 1.5]], receiver="west").shape
            torch.Size([1])
        """
        checkpoint.save(self, path)

    def calibrate(self, state: Mapping[str, Tensor] | None) -> None:
        """Takes the state of a calibration from a checkpoint; None if it has none."""
        self.calibration = None if state is None else Calibration(**state)

    @torch.no_grad()
    def evaluate(self, batch: Batch) -> Tensor:
        """Values (b, *shape) of a batch in all its directions, ``chunk`` pairs of a link and a
        direction at a time.
        """
        if self.chunk is None or batch.directions is None:
            return self(batch).value
        rays = batch.directions.flatten()
        (count,) = rays.shape
        values = []
        for query in batch.query.parts(max(1, self.chunk // count)):
            parts = (rays[start : start + self.chunk] for start in range(0, count, self.chunk))
            asked = [replace(batch, query=query, directions=part, labels=None) for part in parts]
            value = torch.cat([self(part).value for part in asked], 1)
            values.append(value.unflatten(1, batch.directions.shape))
        return torch.cat(values)

    @overload
    def predict(
        self, transmitters: object, *options: Any, interval: None = None, **named: Any
    ) -> Tensor: ...
    @overload
    def predict(
        self, transmitters: object, *options: Any, interval: float, **named: Any
    ) -> Estimate: ...
    def predict(  # type: ignore[misc]
        self,
        transmitters: object,
        receiver: object = None,
        frequency: object = None,
        batch_size: int | None = None,
        directions: Directions | None = None,
        frequencies: object = None,
        interval: float | None = None,
    ) -> Tensor | Estimate | dict:
        """Values for transmitters anywhere: a query, or a point, a list of points, or a grid.

        Args:
            transmitters: Positions (..., 3), world frame [m], anything that becomes a float tensor;
                or a whole query.
            receiver: Name or index of the receiver, or of that of each position; None: all
                receivers.
            frequency: Carrier, one for all or one for each position, from 1e4 to 3e11 Hz; None: the
                training links' only carrier.
            batch_size: Links computed at a time, of all receivers at least those of one position;
                None: as many as have ``NUMBERS`` numbers together.
            directions: Directions to predict; None: the label's own, if it has directions.
            frequencies: Subcarriers of channels to predict (s,) [Hz], also ones that no label had;
                None: the label's own. A model without ``any_frequency``, such as ``knn``, gives the
                values of its nearest subcarriers.
            interval: Probability with which an interval holds the label, between 0 and 1, e.g. 0.9;
                None: values alone.

        Returns:
            Values (..., receivers, *shape), of the axes of the positions, of all receivers in the
            order of ``model.scene.receivers``, of a single one too, and of the task's shape. With
            ``receiver`` (..., *shape); of a query (b, *shape). They are scaled as the training
            labels (``model.scene.task.normalisation``), on the model's device. With an interval an
            ``Estimate``: the value, its standard deviation, and the interval's ends. Where arrays
            have different numbers of elements, channels of all receivers are a dictionary by name;
            channels of a named receiver have the elements of its array.

        Warns:
            ExtrapolationWarning: A position is farther from the training transmitters' box than the
                diagonal of this box and the receivers, or a frequency is outside the training
                links' band, or subcarriers are farther from the band of the labels than it is wide,
                or the values are those of other subcarriers. Not for a query.

        Raises:
            ValueError: The batch size is less than 1, or a position, receiver, frequency or
                direction is impossible; or the labels have no subcarriers; or the model had too few
                validation links for the interval.

        Example:
            >>> model = gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0))
            >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape
            torch.Size([2, 1, 90, 360])
            >>> few = gaigs.Grid.degrees(elevations=range(10, 90, 10), azimuths=range(0, 360, 10))
            >>> model.predict([1.0, 2.0, 1.5], receiver=0, directions=few).shape
            torch.Size([8, 36])
            >>> channels = gaigs.train("friis", gaigs.links("synthetic_csi", transmitters=20, order=0))
            >>> channels.predict([1.0, 2.0, 1.5], frequencies=[6.8e9, 6.9e9]).shape
            torch.Size([1, 16, 2])
            >>> levels = gaigs.train("gaussian_process", gaigs.links("synthetic_rssi", transmitters=100))
            >>> low, high = levels.predict([1.0, 2.0, 1.5], interval=0.9)[2:4]  # [dBm], of each receiver
            >>> low.shape, bool((low < high).all())
            (torch.Size([4]), True)
        """
        check_type("interval", interval, float | None)
        if interval is not None and not 0 < interval < 1:
            raise ValueError(
                f"interval must be a probability between 0 and 1 such as 0.9, got {interval!r}"
            )
        if interval is not None and self.calibration is None:
            raise ValueError(
                "the model has no intervals: no held-out links have measured its errors\n"
                "train it with split.validation above 0, on two places, runs or blocks or more, without data.band_train"
            )
        parts, shape = self._values(
            transmitters, receiver, frequency, batch_size, directions, frequencies, interval
        )
        heard = transmitters.receivers if isinstance(transmitters, Query) else receiver
        if interval is None:
            return self._arranged(torch.cat([*parts]), shape, heard)
        joined = (None if part[0] is None else torch.cat(part) for part in zip(*parts, strict=True))
        found = [None if part is None else self._arranged(part, shape, heard) for part in joined]
        if isinstance(found[0], dict):
            return {name: Estimate(*(part and part[name] for part in found)) for name in found[0]}
        return Estimate(*found)

    def predict_batches(
        self,
        transmitters: object,
        receiver: object = None,
        frequency: object = None,
        batch_size: int | None = None,
        directions: Directions | None = None,
        frequencies: object = None,
    ) -> Iterator[Any]:
        """The values of ``predict`` for a list of positions, a batch at a time, each computed when
        it is asked for.

        A batch is (b, receivers, *shape), with a receiver (b, *shape). Arguments, warnings and
        errors are those of ``predict``, and come at once. The positions of a grid are in the order
        of ``reshape(-1, 3)``; the last batch may be smaller.
        """
        parts, shape = self._values(
            transmitters, receiver, frequency, batch_size, directions, frequencies
        )
        heard = transmitters.receivers if isinstance(transmitters, Query) else receiver
        last = shape[-1:] if heard is None else ()  # the receivers
        return (
            self._arranged(part, (len(part) // math.prod(last), *last), heard) for part in parts
        )

    def _arranged(self, values: Tensor, axes: tuple[int, ...], receiver: object) -> Any:
        """Values of links (b, ...) with the axes of ``Query.from_positions``.

        Where arrays have different numbers of elements, a dictionary by receiver or, of one
        receiver, its own elements.
        """
        receivers, values = self.scene.receivers, values.reshape((*axes, *values.shape[1:]))
        if not self.lacks_elements:
            return values
        is_channel = values.ndim > len(axes)
        own = lambda part, one: part[..., : len(one.array), :] if is_channel else part
        if receiver is None:
            return {
                one.name: own(values.select(len(axes) - 1, k), one)
                for k, one in enumerate(receivers)
            }
        number = as_receivers(receiver, [one.name for one in receivers])
        return values if number.ndim else own(values, receivers[int(number)])

    @property
    def lacks_elements(self) -> bool:
        """True for channels if an array has fewer elements than another one."""
        smallest = min(len(one.array) for one in self.scene.receivers)
        return smallest < self.scene.task.elements

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> "Model":
        """A copy of a model with ``any_frequency`` whose labels have other subcarriers [Hz]."""
        scene = replace(self.scene, task=self.scene.task.at_frequencies(frequencies))
        other = copy.deepcopy(self)
        for part in other.modules():
            if hasattr(part, "scene"):
                part.scene = scene
        return other

    def _values(
        self, transmitters, receiver, frequency, batch_size, directions, frequencies, interval=None
    ) -> tuple[Iterator[Any], tuple[int, ...]]:
        """Values, or estimates of an interval, for the checked arguments of ``predict``, a batch at
        a time; and the links' axes, see ``Query.from_positions``."""
        scene = self.scene
        directions = as_directions(directions, scene.task.directions, scene.task.name)
        names = [receiver.name for receiver in scene.receivers]
        query, shape = Query.from_positions(
            transmitters, receiver, frequency, names, scene.frequencies
        )
        every = (
            shape[-1] if receiver is None and not isinstance(transmitters, Query) else 1
        )  # links of each position
        model, chosen, messages = self, None, []
        if frequencies is not None:
            if not scene.task.is_channel:
                raise ValueError(
                    f"labels of task {scene.task.name!r} have no subcarriers; leave frequencies out"
                )
            asked = as_subcarriers(frequencies)
            apart, chosen = (scene.task.frequencies - asked[:, None]).abs().min(1)
            is_known = (apart <= 1e-9 * asked).all()  # float64 computes them no better
            if not is_known and self.any_frequency:
                model, chosen = self.at_frequencies(asked), None
                low, high = scene.task.frequencies.aminmax()
                beyond = max(low - asked.min(), asked.max() - high).item()
                if beyond > high - low:
                    messages = [
                        f"subcarriers are up to {beyond:.4g} Hz beyond those with labels, which span "
                        f"{high - low:.4g} Hz: phases may be off"
                    ]
            elif not is_known:
                messages = [
                    f"values are those of the nearest subcarriers with labels, up to {apart.max():.7g} Hz away"
                ]
        if not isinstance(transmitters, Query):
            for message in messages + extrapolations(query[::every], scene):
                warnings.warn(
                    message, ExtrapolationWarning, stacklevel=3
                )  # names the line that called ``predict``
        check_type("batch_size", batch_size, int | None)
        if batch_size is None:
            batch_size = min(MOST, max(16, NUMBERS // math.prod(model.scene.task.shape)))
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1 link, got {batch_size}")
        batch_size = max(1, batch_size // every) * every
        query, directions = (
            query.to(self.device),
            None if directions is None else directions.to(self.device),
        )
        count = math.ceil(len(query) / batch_size)
        parts = track(query.parts(batch_size), "predictions", count, is_fixed=True)
        batches = (Batch(part, directions) for part in parts)
        if interval is not None:
            if messages or model is not self:
                raise ValueError(
                    "intervals are those of the labels' own subcarriers; leave frequencies out"
                )
            estimates = (self._estimate(batch, float(interval)) for batch in batches)
            pick = lambda part: (
                part if part is None or part.ndim < 3 or chosen is None else part[..., chosen]
            )
            return (Estimate(*map(pick, estimate)) for estimate in estimates), shape
        values = map(model._answer, batches)
        return values if chosen is None else (part[..., chosen] for part in values), shape

    @usual_modes()
    @torch.no_grad()
    def _answer(self, batch: Batch) -> Tensor:
        """Values of a batch in evaluation mode; the mode stays as it was."""
        training = self.training
        self.eval()
        try:
            return self.evaluate(batch)
        finally:
            self.train(training)

    @usual_modes()
    def _estimate(self, batch: Batch, interval: float) -> Estimate:
        value = self._answer(batch)
        assert self.calibration is not None
        return self.calibration.estimate(value, self.spread(batch, value), batch.query, interval)

    @torch.no_grad()
    def spread(self, batch: Batch, value: Tensor) -> Tensor:
        """Standard deviation of the labels as the model knows it, (b,) or of each number; a
        calibration scales it.

        By default 1, of channels the root mean square of each link's value. It is NaN at elements
        that a receiver's array lacks, which have no error.
        """
        found = call_optional(self, "deviations", batch)
        if found is None and value.is_complex():
            found = value.abs().square().flatten(1).mean(1).sqrt()
        found = torch.ones(len(value), device=value.device) if found is None else found
        if self.lacks_elements:
            absent = lacking(self.scene.receivers, batch.query.receivers, value.shape[1])[..., None]
            if found.ndim == 1:  # over all numbers, of which those that are absent are 0
                found = (found / (1 - absent.to(found).mean((1, 2))).sqrt())[:, None, None]
            found = found.expand(value.shape).masked_fill(absent, math.nan)
        return found


class OptionalMethods(Protocol):
    """Methods that a model may have beside those of ``Model``; ``call_optional`` calls one if it is
    there.
    """

    def facts(self) -> dict[str, object]:
        """Entries of ``metrics.json`` beside the model's sizes; plain values by name."""

    def rendering(self, batch: Batch) -> Callable[[], object]:
        """The rendering alone of a batch, to be timed."""

    def learnt_room(self, links: Links | None = None) -> object:
        """The room learnt from the links, a ``gaigs.planes.learnt_room.LearntRoom`` for figures;
        without links that of the state alone."""

    def learnt_paths(self, query: Query) -> object:
        """The strongest paths of some links together, a list of
        ``gaigs.planes.room_paths.LearntPath``.
        """

    def export(self, folder: Path) -> None:
        """Writes files for other programs into a run's folder."""

    def process_at(self, receiver: int) -> Process | None:
        """The Gaussian process of a receiver's labels, which plans surveys."""

    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations of the labels (b,), root mean squares over all their numbers, or of
        each number (b, *shape); but for a common factor."""

    def refit(self, links: Links) -> None:
        """As ``fit``, for some of the links of an earlier fit, whose choices may stay; it may be
        faster.
        """

    def revise(
        self, number: int, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]
    ) -> str:
        """Changes the model between two training steps, such as by a search, and gives a sentence
        for the log.

        ``number`` is an index into ``Model.revisions``. The batches are some training links,
        thinned as in a step, and some validation links. Parameters keep their shapes, and the state
        dict has every decision.
        """


def call_optional(model: Model, method: str, *arguments: object) -> Any:
    """Result of a model's method of ``OptionalMethods``; None if the model has no such method."""
    return getattr(model, method)(*arguments) if hasattr(model, method) else None


class LookUp(Model):
    """Base of a model that keeps its known links: they are its state, with the attributes of the
    names ``learnt``.

    It answers on the processor.

    Attributes:
        links: Links, or a batch of the known ones; None before the fit.
        known: Numbers of each receiver's known links.
        learnt: Names of attributes with plain values that ``fit`` sets.
    """

    links: Links | Batch | None = None
    known: Sequence[Tensor] = ()
    learnt: tuple[str, ...] = ()

    def _apply(self, *_: Any) -> "LookUp":
        return self

    def get_extra_state(self) -> dict:
        """Known links and ``learnt``; labels in bytes if all are 255ths from 0 to 1, as of 8-bit
        images.
        """
        if self.links is None:
            raise ValueError(f"model {name_of(self)!r} has no links to save; fit it first")
        index, labels = torch.cat([*self.known]), []
        for part in index.split(PART):
            values = self.links.labels[part]
            levels = (255 * values.real).round().clamp(0, 255).to(torch.uint8)
            labels.append(levels if (levels / 255 == values).all() else values)
        learnt = {name: getattr(self, name) for name in self.learnt}
        return {"query": vars(self.links.query[index]), "labels": labels, **learnt}

    def set_extra_state(self, state: dict) -> None:
        """Takes the state of a fitted look-up."""
        labels = [part / 255 if part.dtype == torch.uint8 else part for part in state["labels"]]
        self.links = Batch(Query(**state["query"]), None, torch.cat(labels))
        receivers = self.links.query.receivers
        self.known = [
            (receivers == number).nonzero()[:, 0] for number in range(len(self.scene.receivers))
        ]
        for name in self.learnt:
            setattr(self, name, state[name])


class Wrapper(Model):
    """Base of a model around an ``underlying`` one, whose room, Gaussians, rendering and files are
    its own.
    """

    @property
    @abstractmethod
    def underlying(self) -> Model:
        """The model within, such as the trend of kriging."""

    @property
    def primitives(self) -> Gaussians | None:  # type: ignore[override]
        return self.underlying.primitives

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        return call_optional(self.underlying, "rendering", batch)

    def learnt_room(self, links: Links | None = None) -> Any:
        return call_optional(self.underlying, "learnt_room", links)

    def learnt_paths(self, query: Query) -> Any:
        return call_optional(self.underlying, "learnt_paths", query)

    def export(self, folder: Path) -> None:
        call_optional(self.underlying, "export", folder)


def extrapolations(query: Query, scene: Scene) -> list[str]:
    """Sentences on positions farther from the training transmitters' box than the scene's extent,
    and on carriers outside the training links' band."""
    messages, points = [], query.transmitters
    distances = (points - points.clamp(scene.lower.to(points), scene.upper.to(points))).norm(dim=-1)
    if count := int((distances > scene.extent).sum()):
        messages.append(
            f"{count} of {len(points)} positions are up to {distances.amax():.3g} m outside the box of the training "
            f"transmitters, which with the receivers is {scene.extent:.3g} m across: nothing was measured near there"
        )
    if query.frequencies is not None and scene.has_band:
        asked, (low, high) = (
            query.frequencies.double(),
            scene.frequencies.double()[[0, -1]].tolist(),
        )
        outside = asked[(asked < low * (1 - ROUNDING)) | (asked > high * (1 + ROUNDING))]
        if len(outside):
            span = " to ".join(dict.fromkeys((f"{outside.amin():.7g}", f"{outside.amax():.7g}")))
            messages.append(
                f"{len(outside)} of {len(asked)} positions are asked at {span} Hz, outside the training links' band of "
                f"{low:.7g} to {high:.7g} Hz: nothing was measured there"
            )
    return messages


def build_trend(trend: str | Mapping | Model, scene: Scene) -> Model:
    """The model that is a trend; errors name the option ``model.trend``."""
    try:
        return registry("model").build(trend, scene=scene)
    except ValueError as error:
        raise ValueError(f"model.trend: {error}") from error
