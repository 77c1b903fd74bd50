"""Contents of the viewer for one model, as JSON values for its page."""

import base64
import math
import threading
import warnings
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.query import Query, as_positions, evenly
from gaigs.core.task import Task
from gaigs.core.task.scalar import with_unit
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.model import Model
from gaigs.planes.learnt_room import LearntPlane, Matter
from gaigs.report.csi import decibels, impulse_response
from gaigs.splatting.gaussians import SH_DC, Gaussians


class Shown(NamedTuple):
    """Predictions of a model and their uncertainty, on the CPU."""

    value: Tensor
    std: Tensor | None  # their deviations; None if the model states none
    # Expected signal-to-noise ratio of channels [dB]; None if the model states none.
    snr_db: Tensor | None


class Contents:
    """One model, and some of its links for comparison.

    Args:
        model: A trained, fitted or loaded model.
        links: Data of the model; None: true walls and test links are not shown.
        title: Name above the picture.
        points: Points along the longer side of a slice of the radio map, and number of places
            predicted at a time.
        compared: Largest number of test links that are shown with their errors.

    Raises:
        ValueError: The links have other receivers or another task than the model.
    """

    def __init__(
        self,
        model: Model,
        links: Links | None = None,
        title: str = "",
        points: int = 48,
        compared: int = 100,
    ):
        if links is not None:
            check_fit(links, model.scene)
        self.model = model
        self.links = links
        self.title = title
        self.points = points
        self.scene = model.scene
        self.task: Any = model.scene.task
        self.kind = kind_of(self.task)
        self.frequency = self.scene.middle_frequency
        self.interval = None
        if model.calibration is not None and model.calibration.gives(0.5):
            self.interval = 0.5
        self.last: tuple[tuple, Contents] | None = None  # receiver and position of ``moved``
        self.lock = threading.Lock()  # models hold what they compute for a moment
        self.tests = torch.zeros(0, dtype=torch.long)
        if links is not None and links.held_out is None:
            self.tests = evenly(links.split.test, compared)

    @property
    def has_map(self) -> bool:
        """True for labels that give one level a link: RSSI, and the power of channels."""
        return self.kind in ("level", "channel")

    @cached_property
    def compared(self) -> tuple[Tensor, Tensor]:
        """Labels and predictions of the displayed test links."""
        with self.lock:
            batches = self.model.predict_batches(self.links.query[self.tests])
            return self.links.labels[self.tests], torch.cat([part.cpu() for part in batches])

    def facts(self) -> dict:
        """Axes, units, room, Gaussians, receivers and errors of links.

        They do not depend on the place of the dragged transmitter.
        """
        quantity = with_unit(self.task.quantity, self.task.unit)
        with self.lock:
            gaussians = self.model.primitives
            room = self.model.learnt_room()
        splats: dict[str, dict] = {}
        if gaussians is not None:
            splats["gaussians"] = gaussian_splats(gaussians)
        if room is not None and room.matter is not None:
            splats["obstacles"] = obstacle_splats(room.matter)
        facts: dict[str, Any] = {
            "title": self.title,
            "task": self.task.name,
            "kind": self.kind,
            "carrier": self.frequency if len(self.scene.frequencies) > 1 else None,
            "quantity": quantity,
            "map": {"level": quantity, "channel": "power [dB]"}.get(self.kind or ""),
            "box": plain(torch.stack((self.scene.lower, self.scene.upper))),
            "height": self.scene.height,
            "receivers": [receiver_facts(receiver) for receiver in self.scene.receivers],
            "movable": bool(self.model.any_receiver),
            "edges": [],
            "places": [],
            "planes": [] if room is None else [plane_facts(plane) for plane in room.planes],
            "splats": splats,
            "tests": self.test_facts() if len(self.tests) else None,
        }
        if self.kind == "spectrum":
            facts["elevations"] = plain(self.task.directions.elevations.rad2deg())
            facts["azimuths"] = plain(self.task.directions.azimuths.rad2deg())
        if self.links is not None:
            known = self.links.query.transmitters[evenly(self.links.split.train, 1000)]
            facts["edges"] = plain(self.links.edges)
            facts["places"] = plain(known.unique(dim=0))
        return facts

    def test_facts(self) -> dict:
        """Places and scores of the displayed test links."""
        query = self.links.query[self.tests]
        labels, values = self.compared
        scores = self.task.scores(labels, values)[self.task.monitor]
        title = self.task.pair_score
        if self.kind == "level":
            title = with_unit("error", self.task.error_unit)
        return {
            "places": plain(query.transmitters),
            "receivers": query.receivers.tolist(),
            "scores": plain(scores),
            "title": title,
            "rises": bool(self.task.higher_is_better),
        }

    @torch.no_grad()
    def answer(self, place: list[float], receiver: int, step: int = 1) -> dict:
        """Prediction, its deviation, and paths, for a transmitter at a place [m].

        Args:
            place: Position [m].
            receiver: Number of the receiver; levels cover all receivers.
            step: Rows and columns from one shown pixel of a spectrum to the next.
        """
        # The page shows levels of all receivers at once.
        shown = self._estimate(torch.tensor([place]), None if self.kind == "level" else receiver)
        value = shown.value
        std = shown.std
        answer: dict[str, Any] = {}
        if self.kind == "level":
            answer["levels"] = plain(value[0])
            answer["stds"] = None if std is None else plain(std[0])
        elif self.kind == "spectrum":
            answer["image"] = grey(value[0], step)
            answer["std"] = None if std is None else grey(std[0], 2 * step)  # it is smooth
        elif self.kind == "channel":
            answer["curves"] = {"predicted": self._curve(value[0], int(loudest(value[0])))}
            answer["level"] = plain(level(value)[0])
            answer["std"] = None if std is None else plain(level(std)[0])
            snr = shown.snr_db
            answer["snr"] = None if snr is None else plain(snr[0].clamp_max(140))
        names = [antenna.name for antenna in self.scene.receivers]
        query, _ = Query.from_positions(
            [place], receiver, self.frequency, names, self.scene.frequencies
        )
        with self.lock:
            paths = self.model.learnt_paths(query)
        answer["paths"] = [
            {"points": plain(path.points), "power": plain(path.power_db)} for path in paths
        ]  # power [dB] relative to the strongest path
        return answer | {"place": plain(place)}

    def moved(self, receiver: int, position: list[float]) -> "Contents":
        """The model with a single receiver, moved to another position [m].

        Raises:
            ValueError: The model predicts only for its training receivers.
        """
        key = receiver, *position
        if self.last is None or self.last[0] != key:
            unmoved = self.scene.receivers[receiver]
            new_position = as_positions("receiver", position).to(unmoved.pose.position)
            moved = replace(unmoved, pose=replace(unmoved.pose, position=new_position))
            with self.lock:
                model = self.model.at_receivers([moved])
            self.last = key, Contents(model, points=self.points)  # for the next requests of a drag
        return self.last[1]

    def answer_at(self, place: list[float], receiver: int, position: list[float]) -> dict:
        """``answer`` with one receiver moved to another position [m]."""
        answer = self.moved(receiver, position).answer(place, 0)
        if self.kind == "level":
            # The page shows levels of all receivers: the others' come from the unmoved model.
            unmoved = self.answer(place, receiver)
            for name in ("levels", "stds"):
                all_values = unmoved[name]
                moved_value = answer[name]  # of the moved receiver alone, a list of one
                if all_values is None or moved_value is None:
                    answer[name] = None
                else:
                    before, after = all_values[:receiver], all_values[receiver + 1 :]
                    answer[name] = [*before, *moved_value, *after]
        return answer

    def slice(self, height: float, receiver: int) -> dict:
        """The radio map over the training transmitters and receivers at a height [m]."""
        lower, upper = (corner[:2].double().numpy() for corner in self.scene.box)
        pitch = float((upper - lower).max()) / self.points  # edge of a cell [m]
        columns, rows = np.maximum(np.ceil((upper - lower) / pitch).astype(int), 1)
        x = lower[0] + pitch * (np.arange(columns) + 0.5)
        y = lower[1] + pitch * (np.arange(rows) + 0.5)
        heights = np.full((rows, columns), height)
        places = np.stack((*np.meshgrid(x, y), heights), -1).astype(np.float32)
        points = torch.from_numpy(places.reshape(-1, 3))  # (rows columns, 3)
        # In blocks, so that other requests, as of a drag, get the lock between them.
        blocks = [self._estimate(block, receiver).value for block in points.split(self.points)]
        values = torch.cat(blocks)
        if values.is_complex():
            values = level(values)
        return {"x": plain(x), "y": plain(y), "height": plain(height), "values": plain(values)}

    def comparison(self, number: int, step: int = 1) -> dict:
        """Label and prediction of a displayed test link; ``step`` is as for ``answer``."""
        labels, values = self.compared
        value = values[number]
        # If the task ignores the phase of channels, the label takes the phase of the prediction.
        label = self.task.align(labels[number : number + 1], values[number : number + 1])[0]
        if self.kind == "level":
            return {"label": plain(label), "prediction": plain(value)}
        if self.kind == "spectrum":
            return {"label": grey(label, step), "prediction": grey(value, step)}
        if self.kind == "channel":
            element = int(loudest(label))
            predicted = self._curve(value, element)
            return {"curves": {"predicted": predicted, "measured": self._curve(label, element)}}
        return {}

    def _estimate(self, points: Float[Tensor, "b 3"], receiver: int | None) -> Shown:
        """Predictions for transmitters at places [m] at one receiver, or at all if it is None."""
        options = {
            "frequency": self.frequency,
            "batch_size": self.points,
            "interval": self.interval,
        }
        with warnings.catch_warnings():
            # A transmitter may be dragged anywhere.
            warnings.simplefilter("ignore", ExtrapolationWarning)
            with self.lock:
                predicted: Any = self.model.predict(points, receiver, **options)
        if self.interval is None:
            return Shown(predicted.cpu(), None, None)
        snr_db = predicted.snr_db
        snr_db = None if snr_db is None else snr_db.cpu()
        return Shown(predicted.value.cpu(), predicted.std.cpu(), snr_db)

    def _curve(self, channel: Tensor, element: int) -> dict:
        """Curve of a channel: |h| [dB] over delay [ns] at an element.

        A channel with one subcarrier is drawn over the elements.
        """
        if channel.shape[1] == 1:
            x = np.arange(1, len(channel) + 1)
            responses = channel[:, 0].numpy()
            xlabel = "element"
            ylabel = "|h| [dB]"
        else:
            response = channel[element].numpy()
            delays, responses = impulse_response(response, self.task.frequencies.numpy())
            x = 1e9 * delays
            xlabel = "delay [ns]"
            ylabel = f"|impulse response| [dB], element {element + 1}"
        levels = np.maximum(decibels(responses), -240.0)  # JSON has no infinity
        return {"x": plain(x), "y": plain(levels), "xlabel": xlabel, "ylabel": ylabel}


def kind_of(task: Task) -> str | None:
    """The page's kind of labels: spectrum, level or channel; None if it cannot draw them."""
    if task.directions is not None:
        return "spectrum"
    if task.is_scalar:
        return "level"
    return "channel" if task.is_channel else None


def receiver_facts(receiver: Receiver) -> dict:
    """Name, place and axes of a receiver."""
    pose = receiver.pose
    return {
        "name": receiver.name,
        "place": plain(pose.position),
        "axes": plain(pose.rotation.mT),
    }


def plane_facts(plane: LearntPlane) -> dict:
    """Number, fraction of the received power, and corners of a learnt plane."""
    return {
        "number": plane.number,
        "share": plain(plane.share),
        "corners": plain(plane.corners),
    }


def gaussian_splats(gaussians: Gaussians, most: int = 3000) -> dict:
    """The ``most`` strongest Gaussians in the page's form, and the number of all."""
    with torch.no_grad():
        # The first coefficient is the mean signal over all directions, up to the factor ``SH_DC``.
        amplitudes = SH_DC * gaussians.signal[..., 0].norm(dim=-1)  # (n,)
        strengths = gaussians.opacities * amplitudes
        strongest = strengths.topk(min(most, len(strengths))).indices
        columns = gaussians.means, gaussians.covariances, gaussians.opacities, strengths
        arrays = [column[strongest].cpu().numpy() for column in columns]
    return splats(*arrays) | {"total": len(strengths)}


def obstacle_splats(matter: Matter) -> dict:
    """Obstacles in the page's form; opacity is the fraction of power that a central path loses."""
    # The integral of a Gaussian density over a line through its centre, in the mean direction.
    mean_widths = np.exp(np.log(matter.widths).mean(1))  # geometric [m]
    gaussian_losses = matter.densities * math.sqrt(2 * math.pi) * mean_widths  # [dB]
    gaussian_covariances = matter.widths[:, :, None] ** 2 * np.eye(3)
    # A box becomes the Gaussian with its mean and covariance. An axis of half length s has the
    # variance s² / 3. The sum of squared offsets of 8 corners is 8 s², thus the division by 24.
    middles = matter.boxes.mean(1)
    offsets = matter.boxes - middles[:, None]  # (m, 8 corners, 3)
    box_covariances = np.einsum("mci,mcj->mij", offsets, offsets) / 24
    covariances = np.concatenate((gaussian_covariances, box_covariances))
    losses = np.concatenate((gaussian_losses, matter.losses))  # [dB]
    centres = np.concatenate((matter.centres, middles))
    return splats(centres, covariances, 1 - 10 ** (-losses / 10), losses)


def plain(values: Any) -> Any:
    """Numbers for JSON, rounded: the largest to four significant digits, or to three decimals."""
    if isinstance(values, Tensor):
        values = values.detach().cpu()
    array = np.asarray(values, dtype=np.float64)
    largest = float(np.abs(array).max(initial=1e-30))
    decimals = max(3, 3 - math.floor(math.log10(largest)))
    return np.round(array, decimals).tolist()


def grey(image: Float[Tensor, "rows columns"], step: int = 1) -> dict:
    """Every ``step``-th row and column of an image, in the page's encoding.

    Pixels are bytes, 255 for an amplitude of 1. Each is stored as its difference from the previous
    pixel, since differences compress well.
    """
    levels = (255 * image[::step, ::step].clamp(0, 1)).round().to(torch.uint8).numpy()
    changes = np.diff(levels.ravel(), prepend=np.uint8(0))
    return {
        "rows": len(levels),
        "step": step,
        "changes": base64.b64encode(changes.tobytes()).decode(),
    }


def splats(
    means: Float[ndarray, "n 3"],
    covariances: Float[ndarray, "n 3 3"],
    opacities: Float[ndarray, " n"],
    strengths: Float[ndarray, " n"],
) -> dict:
    """Gaussians as JSON lists of the page; of covariances [m²] only the upper triangles."""
    rows, columns = np.triu_indices(3)
    return {
        "means": plain(means),
        "covariances": plain(covariances[:, rows, columns]),
        "opacities": plain(opacities),
        "strengths": plain(strengths),
    }


def loudest(channel: Tensor) -> Tensor:
    """Number of the element of a channel (elements, subcarriers) with the most power."""
    return channel.abs().square().sum(1).argmax()


def level(channels: Tensor) -> Tensor:
    """Mean power of channels (b, elements, subcarriers) [dB]; at least -240 dB, for JSON."""
    power = channels.abs().square().flatten(1).mean(1)  # (b,)
    return 10 * power.clamp_min(1e-12**2).log10()
