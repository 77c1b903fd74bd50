"""The base class of kind ``model``."""

import copy
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, overload

import torch
from jaxtyping import Complex
from torch import Tensor, nn

from gaigs.calibration import Calibration, Estimate
from gaigs.calibration.conformal import usual_deviations
from gaigs.calibration.held_out import LOOK_UP_FOLDS, Unseen, held_out_folds
from gaigs.core.antenna import lacking
from gaigs.core.geometry import Directions, ExtrapolationWarning
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.core.stages import track
from gaigs.data import Links
from gaigs.kriging.kernel import Process
from gaigs.kriging.links import single_readings
from gaigs.model import checkpoint
from gaigs.model.movable import Movable
from gaigs.model.requests import (
    Request,
    as_known_subcarriers,
    as_new_receiver,
    check_interval,
    is_same,
    lacks_numbers,
    usual_batch_size,
)
from gaigs.registry import check_type
from gaigs.registry.torch_modes import usual_modes
from gaigs.splatting.gaussians import Gaussians


class Prediction(NamedTuple):
    """A model's answer to a batch.

    Attributes:
        value: Predicted labels (b, *shape); the pixels are the batch's directions.
        penalties: Scalars by name that are added to the loss; means over the batch's places.
    """

    value: Tensor
    penalties: Mapping[str, Tensor] = {}


class Model(Movable):
    """Base class of kind ``model``: ``forward`` maps a ``Batch`` to a ``Prediction``.

    The state dict has everything that ``predict`` needs. A model with parameters is trained. A
    model without parameters is a look-up, which learns only in ``fit``, see ``LookUp``.

    Args:
        scene: Receivers and task.

    Attributes:
        trained_by: Name of the component of kind ``training`` that trains it.
        learning_rates: Default learning rate of each parameter group; ``training.learning_rates``
            overrides it.
        penalty_weights: Default weight of each penalty; ``training.penalties`` overrides it.
        chunk: Largest number of (link, direction) pairs evaluated at a time, except in a training;
            None: whole labels.
        revisions: Fractions of the training after which ``revise`` is called.
        settles: True if no later revision will lower errors suddenly. A training may then stop
            early if its extrapolated errors stay above those of a path-loss model.
        second_start: Options of a second training from another start; the validation score chooses
            between both. Empty for one training.
        predicts_untrained: True if predictions before the first step are scored, too.
        any_frequency, any_receiver: See ``Movable``.
        configuration: Options of a registered model; ``save`` stores them.
        calibration: Error quantiles for intervals; None if no validation links measured errors.
        known_places: Keys of the training and validation places, ``Query.place_keys``; None if
            unknown.
        links: Known links of a look-up.

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
        >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape  # places first
        torch.Size([2, 1, 90, 360])
    """

    trained_by = "descent"
    learning_rates: Mapping[str, float] = {"network": 1.6e-2}
    penalty_weights: Mapping[str, float] = {}
    chunk: int | None = None
    revisions: tuple[float, ...] = ()
    settles: bool = False
    second_start: Mapping[str, Any] = {}
    predicts_untrained: bool = False
    primitives: Gaussians | None = None
    calibration: Calibration | None = None
    known_places: Tensor | None = None
    links: Links | Batch | None = None

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene

    @property
    def device(self) -> torch.device:
        """The device of the model's tensors; the CPU for a look-up without tensors."""
        tensors = itertools.chain(self.parameters(), self.buffers())
        return next((tensor.device for tensor in tensors), torch.device("cpu"))

    @property
    def is_trained(self) -> bool:
        """True if a model has parameters to train, not only parameters that ``fit`` sets."""
        return any(parameter.requires_grad for parameter in self.parameters())

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
        """Sets the calibration from a checkpoint's state; None if it has none."""
        self.calibration = None if state is None else Calibration.from_state(state)

    @torch.no_grad()
    def evaluate(self, batch: Batch) -> Tensor:
        """Predicted labels (b, *shape), with ``chunk`` (link, direction) pairs at a time."""
        if self.chunk is None or batch.directions is None:
            return self(batch).value
        rays = batch.directions.flatten()
        (count,) = rays.shape
        values = []
        for query in batch.query.parts(max(1, self.chunk // count)):
            chunks = []
            for start in range(0, count, self.chunk):
                some_rays = rays[start : start + self.chunk]
                chunk = replace(batch, query=query, directions=some_rays, labels=None)
                chunks.append(self(chunk).value)
            value = torch.cat(chunks, 1)  # (links, rays)
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
        """Predicted labels for transmitters at a point, a list or a grid of points, or for a query.

        Args:
            transmitters: Positions (..., 3), world frame [m], of any type that converts to a float
                tensor; or a ``Query``.
            receiver: Name or index of one receiver, or one for each position; None: all receivers.
                A model with ``any_receiver`` also takes a ``Receiver``, ``Pose`` or position [m]
                without measurements, see ``at_receivers``.
            frequency: Carrier, one for all or one for each position, from 1e4 to 3e11 Hz; None: the
                training links' only carrier.
            batch_size: Largest number of links computed at a time, but at least all links of one
                position. None: links with 2^17 numbers together.
            directions: Directions to predict; None: the label's directions, if it has any.
            frequencies: Subcarriers of channels to predict (s,) [Hz], possibly new ones; None: the
                label's subcarriers. A model without ``any_frequency``, such as ``knn``, returns the
                values of its nearest subcarriers.
            interval: Probability with which an interval holds the label, between 0 and 1, e.g. 0.9;
                None: no interval.

        Returns:
            Values (..., receivers, *shape): axes of the positions, receivers in the order of
            ``model.scene.receivers``, and the task's shape. With ``receiver`` they are (...,
            *shape), for a query (b, *shape). They are scaled like the training labels
            (``model.scene.task.normalisation``), on the model's device. With an interval the result
            is an ``Estimate``: the value, its standard deviation, and the interval's ends. If
            arrays have different numbers of elements, channels of all receivers are a dictionary by
            name. Channels of a named receiver have the elements of its array.

        Warns:
            ExtrapolationWarning: A position is outside the training transmitters' box by more than
                the diagonal of the box of transmitters and receivers; a frequency is outside the
                training links' band; subcarriers are farther from the labels' band than its width;
                or the values are of other subcarriers. A query gives no warning.

        Raises:
            ValueError: The batch size is less than 1; a position, receiver, frequency or direction
                is impossible; the labels have no subcarriers; or the model had too few validation
                links for the interval.

        Example:
            >>> model = gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0))
            >>> model.predict([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]).shape
            torch.Size([2, 1, 90, 360])
            >>> few = gaigs.Grid.degrees(elevations=range(10, 90, 10), azimuths=range(0, 360, 10))
            >>> model.predict([1.0, 2.0, 1.5], receiver=0, directions=few).shape
            torch.Size([8, 36])
            >>> links = gaigs.links("synthetic_csi", transmitters=20, order=0)
            >>> channels = gaigs.train("friis", links)
            >>> channels.predict([1.0, 2.0, 1.5], frequencies=[6.8e9, 6.9e9]).shape
            torch.Size([1, 16, 2])
            >>> links = gaigs.links("synthetic_rssi", transmitters=100)
            >>> levels = gaigs.train("gaussian_process", links)
            >>> low, high = levels.predict([1.0, 2.0, 1.5], interval=0.9)[2:4]  # [dBm]
            >>> low.shape, bool((low < high).all())
            (torch.Size([4]), True)
        """
        check_type("interval", interval, float | None)
        model, receiver = self._located(receiver, transmitters)
        scene = model.scene
        if interval is not None:
            calibrations = self.calibration, model.calibration
            check_interval(interval, calibrations, scene, frequencies, model.any_frequency)
        request = model._request(transmitters, receiver, frequency, directions, frequencies)
        if interval is None:
            values = torch.cat([*model._values(request, batch_size)])
            return request.arranged(values, scene)
        batches = model._estimates(request, batch_size, float(interval))
        fields = []
        for parts in zip(*batches, strict=True):
            joined = None if parts[0] is None else torch.cat(parts)
            fields.append(None if joined is None else request.arranged(joined, scene))
        return request.estimates(fields, scene)

    def to_xarray(self, transmitters: object, interval: float | None = None, **named: Any) -> Any:
        """The result of ``predict``, with the same arguments, as an ``xarray.Dataset``.

        If arrays have different numbers of elements, the result is a dictionary by receiver.
        """
        model, receiver = self._located(named.pop("receiver", None), transmitters)
        options = (named.get(name) for name in ("frequency", "directions", "frequencies"))
        answer = model.predict(transmitters, receiver, interval=interval, **named)  # type: ignore
        return model._request(transmitters, receiver, *options).to_xarray(answer, model.scene)

    def predict_batches(
        self,
        transmitters: object,
        receiver: object = None,
        frequency: object = None,
        batch_size: int | None = None,
        directions: Directions | None = None,
        frequencies: object = None,
    ) -> Iterator[Any]:
        """The values of ``predict`` for a list of positions, each batch computed on request.

        A batch is (b, receivers, *shape), with a receiver (b, *shape). Arguments, warnings and
        errors are as for ``predict``, and are checked at once. Positions of a grid are in the order
        of ``reshape(-1, 3)``; the last batch may be smaller.
        """
        model, receiver = self._located(receiver, transmitters)
        request = model._request(transmitters, receiver, frequency, directions, frequencies)
        values = model._values(request, batch_size)
        last = request.axes[-1:] if request.receiver is None else ()  # axis of the receivers
        count = math.prod(last)
        return (request.arranged(part, model.scene, (len(part) // count, *last)) for part in values)

    def _located(self, receiver: object, transmitters: object) -> tuple[Any, object]:
        """Returns the model for a receiver, a copy if it is new, and its name or index there."""
        new = as_new_receiver(receiver, self.scene, transmitters)
        if new is None:
            return self, receiver
        for number, known in enumerate(self.scene.receivers):
            if known.name == new.name and is_same(known, new):
                return self, number
        return self.at_receivers([new]), 0

    def _request(
        self,
        transmitters: object,
        receiver: object,
        frequency: object,
        directions: Directions | None,
        frequencies: object,
    ) -> Request:
        """The checked arguments of ``predict``; warnings point to the caller's line."""
        subcarriers = as_known_subcarriers(frequencies, self.scene, self.any_frequency)
        request = Request.of(self.scene, transmitters, receiver, frequency, directions, subcarriers)
        for message in request.warnings:
            warnings.warn(message, ExtrapolationWarning, stacklevel=3)
        return request

    def _values(self, request: Request, batch_size: int | None) -> Iterator[Tensor]:
        """Values of the links (b, *shape), a batch at a time."""
        exchanged, columns, _ = request.subcarriers
        model = self if exchanged is None else self.at_frequencies(exchanged)
        values = map(model._answer, model._batches(request, batch_size))
        return values if columns is None else (part[..., columns] for part in values)

    def _estimates(
        self, request: Request, batch_size: int | None, interval: float
    ) -> Iterator[Estimate]:
        """Estimates of the links at the requested subcarriers, a batch at a time."""
        columns = request.subcarriers.columns

        def chosen(part: Tensor | None) -> Tensor | None:
            has_columns = part is not None and part.ndim > 2 and columns is not None
            return part[..., columns] if has_columns else part  # type: ignore[index]

        for batch in self._batches(request, batch_size):
            estimate = self._estimate(batch, interval)
            yield Estimate(*map(chosen, estimate))  # type: ignore[arg-type]

    def _batches(self, request: Request, batch_size: int | None) -> Iterator[Batch]:
        """The links of a request, a batch at a time; all receivers of a position together."""
        check_type("batch_size", batch_size, int | None)
        if batch_size is None:
            batch_size = usual_batch_size(self.scene.task.shape)
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1 link, got {batch_size}")
        size = max(1, batch_size // request.links_per_position) * request.links_per_position
        query = request.query.to(self.device)
        directions = request.directions
        if directions is not None:
            directions = directions.to(self.device)
        count = math.ceil(len(query) / size)
        parts = track(query.parts(size), "predictions", count, is_fixed=True)
        return (Batch(part, directions) for part in parts)

    @usual_modes()
    @torch.no_grad()
    def _answer(self, batch: Batch) -> Tensor:
        """Values of a batch in evaluation mode; the mode is restored."""
        training = self.training
        self.eval()
        try:
            return self.evaluate(batch)
        finally:
            self.train(training)

    @usual_modes()
    def _estimate(self, batch: Batch, interval: float) -> Estimate:
        """Values of a batch with their intervals, from the calibration."""
        value = self._answer(batch)
        assert self.calibration is not None
        query = self.scene.by_radio(batch.query)
        return self.calibration.estimate(value, self.spread(batch, value), query, interval)

    @torch.no_grad()
    def spread(self, batch: Batch, value: Tensor) -> Tensor:
        """Standard deviations (b,) or (b, *shape) of the labels, before a calibration scales them.

        They are ``deviations`` or, if these are None, ``usual_deviations``. They are NaN at missing
        elements of an array and outside a receiver's band, where there is no error.
        """
        deviations = self.deviations(batch)
        if deviations is None:
            deviations = usual_deviations(value)
        if not lacks_numbers(self.scene):
            return deviations
        task = self.scene.task
        receivers = batch.query.receivers
        absent = lacking(self.scene.receivers, receivers, task.elements, task.frequencies)
        if deviations.ndim == 1:
            # Root mean squares over all numbers of a label, where absent numbers count as 0.
            present = 1 - absent.to(deviations).mean((1, 2))  # share of the numbers (b,)
            deviations = (deviations / present.sqrt())[:, None, None]
        return deviations.expand(value.shape).masked_fill(absent, math.nan)

    def facts(self) -> dict[str, Any]:
        """Entries of ``metrics.json`` besides the model's sizes; plain values by name."""
        return {}

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        """A function that only renders a batch, for timing; None for a model without rendering."""
        return None

    def learnt_room(self, links: Links | None = None) -> Any:
        """The learnt room, a ``gaigs.planes.learnt_room.LearntRoom``; None if no room is learnt.

        Paths of the ``links`` outline planes; without links, paths from places over the scene.
        """
        return None

    def learnt_paths(self, query: Query) -> list:
        """The strongest paths of some links, each a ``gaigs.planes.learnt_room.LearntPath``."""
        return []

    def export(self, folder: Path) -> None:
        """Writes files for other programs into a run's folder; by default writes nothing."""

    def revise(
        self, number: int, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]
    ) -> str:
        """Changes the model between two training steps, such as by a search.

        Parameters keep their shapes, and the state dict records every decision.

        Args:
            number: Index into ``revisions``.
            train: Some training links, thinned as in a step.
            validation: Some validation links.
            loss: Loss of the model on a batch.

        Returns:
            A sentence for the log.
        """
        return "nothing is revised"

    def deviations(self, batch: Batch) -> Tensor | None:
        """Standard deviations (b, *shape) of the labels up to a common factor; None if unknown.

        They may also be (b,), root mean squares over the values of a label.
        """
        return None

    def process_at(self, receiver: int) -> Process | None:
        """The Gaussian process of a receiver's labels, for surveys; None without one."""
        return None

    @property
    def has_margins(self) -> bool:
        """True if ``margins`` is defined: a model of channels with known paths."""
        return False

    def margins(self, query: Query) -> Complex[Tensor, "b n e s"]:
        """Prior standard deviation of the channel of each of n paths, for kriging."""
        raise ValueError("the model has no paths of channels; ask has_margins first")

    def refit(self, links: Links) -> None:
        """Fits again to similar links; to save time, choices of the earlier fit may stay."""
        self.fit(links)

    def take_hyperparameters(self, other: "Model") -> None:
        """Copies the parameters of ``deviations`` from a similar model; by default nothing."""

    @property
    def fold_count(self) -> int:
        """Largest number of models that ``unseen`` yields."""
        return 1 if self.is_trained else LOOK_UP_FOLDS

    def unseen(self, links: Links) -> Iterator[Unseen]:
        """Yields models like this one, each with links that it has not been trained on.

        A look-up is fitted again without each fold of the known links, and so are estimated places
        of receivers. A trained model comes with the validation links, although these have chosen
        its training step. Repeated readings count once. Folds end with the time limit of a run.
        """
        if not self.is_trained:
            for fold in held_out_folds(links):
                yield Unseen(self.refitted(fold.rest), fold.asked, fold.rest.split.train)
        elif len(links.split.validation):
            asked = single_readings(links, links.split.validation)
            yield Unseen(self, asked, links.split.train)

    def refitted(self, links: Links) -> "Model":
        """A copy that ``refit`` fits to links."""
        scene = replace(self.scene, receivers=links.receivers)  # whose places may be estimated
        # Known links are large and unchanged, so they are not copied.
        memo: dict[int, Any] = {id(self.links): self.links, id(self.scene): scene}
        memo[id(self.calibration)] = self.calibration
        copied = copy.deepcopy(self, memo)
        copied.refit(links)
        return copied
