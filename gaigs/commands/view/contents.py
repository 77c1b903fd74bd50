"""What the viewer shows of one model, in plain numbers for its page."""

import base64
import math
import threading
import warnings
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.query import Query, evenly
from gaigs.core.task.scalar import with_unit
from gaigs.data import Links
from gaigs.data.compatibility import check_fit
from gaigs.model import Model
from gaigs.report.csi import decibels, impulse_response
from gaigs.splatting.gaussians import SH_DC

COMPARED = 100
"""Most test links that are shown with their errors."""

STRONGEST = 3000
"""Most Gaussians that are shown."""

POINTS = 48
"""Points along the longer side of a slice of the radio map; places that are predicted at a time."""

LEAST = 1e-12
"""Amplitude that counts as 0: levels end at -240 dB."""


class Contents:
    """One model, and some of its links for comparison.

    Args:
        model: A trained, fitted or loaded model.
        links: Its data; None: no true walls and no test links are shown.
        title: Name above the picture.

    Raises:
        ValueError: The links have other receivers or another task than the model.
    """

    def __init__(self, model: Model, links: Links | None = None, title: str = ""):
        if links is not None:
            check_fit(links, model.scene)
        self.model, self.links, self.title, self.scene = model, links, title, model.scene
        self.task: Any = model.scene.task
        kinds = {"spectrum": self.task.directions is not None, "level": self.task.is_scalar}
        kinds["channel"] = self.task.is_channel
        self.kind = next((kind for kind, fits in kinds.items() if fits), None)
        self.frequency = self.scene.middle_frequency
        self.interval = (
            0.5 if model.calibration is not None and model.calibration.gives(0.5) else None
        )
        self.lock = threading.Lock()  # models hold what they compute for a moment
        self.tests = torch.zeros(0, dtype=torch.long)
        if links is not None and links.held_out is None:
            self.tests = evenly(links.split.test, COMPARED)

    @property
    def has_map(self) -> bool:
        """True for labels that give one level a link: RSSI, and the power of channels."""
        return self.kind in ("level", "channel")

    @cached_property
    def compared(self) -> tuple[Tensor, Tensor]:
        """Labels and predictions of the shown test links."""
        with self.lock:
            batches = self.model.predict_batches(self.links.query[self.tests])
            return self.links.labels[self.tests], torch.cat([part.cpu() for part in batches])

    def facts(self) -> dict:
        """All that does not depend on the transmitter: axes and units, room, Gaussians, receivers,
        errors of links.
        """
        quantity = with_unit(self.task.quantity, self.task.unit)
        facts: dict[str, Any] = {
            "title": self.title,
            "task": self.task.name,
            "kind": self.kind,
            "carrier": self.frequency if len(self.scene.frequencies) > 1 else None,
            "quantity": quantity,
            "map": {"level": quantity, "channel": "power [dB]"}.get(self.kind or ""),
            "box": plain(torch.stack((self.scene.lower, self.scene.upper))),
            "height": self.scene.height,
            "receivers": [
                {"name": one.name, "place": plain(one.pose.position), "axes": plain(one.pose.rotation.mT)}
                for one in self.scene.receivers
            ],
            "edges": [], "places": [], "planes": [], "splats": {}, "tests": None,
        }  # fmt: skip
        if self.kind == "spectrum":
            grid = self.task.directions
            facts |= {
                name: plain(getattr(grid, name).rad2deg()) for name in ("elevations", "azimuths")
            }
        if self.links is not None:
            known = self.links.query.transmitters[evenly(self.links.split.train, 1000)].unique(
                dim=0
            )
            facts |= {"edges": plain(self.links.edges), "places": plain(known)}
        with self.lock:
            gaussians, learnt = self.model.primitives, self.model.learnt_room()
        if gaussians is not None:
            with torch.no_grad():
                strengths = gaussians.opacities * SH_DC * gaussians.signal[..., 0].norm(dim=-1)
                strongest = strengths.topk(min(STRONGEST, len(strengths))).indices
                parts = gaussians.means, gaussians.covariances, gaussians.opacities, strengths
                facts["splats"]["gaussians"] = splats(
                    *(part[strongest].cpu().numpy() for part in parts)
                )
                facts["splats"]["gaussians"]["total"] = len(strengths)
        if learnt is not None:
            facts["planes"] = [
                {"number": one.number, "share": plain(one.share), "corners": plain(one.corners)}
                for one in learnt.planes
            ]
            if learnt.matter is not None:
                centres, widths, densities = learnt.matter
                losses = (
                    densities * math.sqrt(2 * math.pi) * np.exp(np.log(widths).mean(1))
                )  # through the middle [dB]
                covariances = widths[:, :, None] ** 2 * np.eye(3)
                facts["splats"]["obstacles"] = splats(
                    centres, covariances, 1 - 10 ** (-losses / 10), losses
                )
        if len(self.tests):
            query, (labels, values) = self.links.query[self.tests], self.compared
            scores = self.task.scores(labels, values)[self.task.monitor]
            facts["tests"] = {
                "places": plain(query.transmitters),
                "receivers": query.receivers.tolist(),
                "scores": plain(scores),
                "title": with_unit("error", self.task.error_unit)
                if self.kind == "level"
                else self.task.pair_score,
                "rises": bool(self.task.higher_is_better),
            }
        return facts

    @torch.no_grad()
    def answer(self, place: list[float], receiver: int, step: int = 1) -> dict:
        """Prediction, its deviation, and paths, of a transmitter at a place [m].

        Args:
            step: Every so many rows and columns of a spectrum.
        """
        answer: dict[str, Any] = {}
        value, std, snr = self._estimate(
            torch.tensor([place]), None if self.kind == "level" else receiver
        )
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
            answer["snr"] = None if snr is None else plain(snr[0].clamp_max(140))
        query, _ = Query.from_positions(
            [place], receiver, self.frequency, self._names, self.scene.frequencies
        )
        with self.lock:
            paths = self.model.learnt_paths(query)
        answer["paths"] = [
            {"points": plain(path.points), "power": plain(path.power_db)} for path in paths
        ]
        return answer | {"place": plain(place)}

    def slice(self, height: float, receiver: int) -> dict:
        """The radio map over the training transmitters and receivers at a height [m]."""
        lower, upper = (corner[:2].double().numpy() for corner in self.scene.box)
        pitch = float((upper - lower).max()) / POINTS
        counts = np.maximum(np.ceil((upper - lower) / pitch).astype(int), 1)
        x, y = (
            low + pitch * (np.arange(count) + 0.5) for low, count in zip(lower, counts, strict=True)
        )
        places = np.stack((*np.meshgrid(x, y), np.full((len(y), len(x)), height)), -1).astype(
            np.float32
        )
        # In parts, so that a drag need not wait for the whole map.
        parts = torch.from_numpy(places.reshape(-1, 3)).split(POINTS)
        found = torch.cat([self._estimate(part, receiver)[0] for part in parts])
        values = level(found) if found.is_complex() else found
        return {"x": plain(x), "y": plain(y), "height": plain(height), "values": plain(values)}

    def comparison(self, number: int, step: int = 1) -> dict:
        """Label and prediction of a shown test link; ``step`` as of ``answer``."""
        label, value = (part[number : number + 1] for part in self.compared)
        label = self.task.align(label, value)[0]
        value = value[0]
        if self.kind == "level":
            return {"label": plain(label), "prediction": plain(value)}
        if self.kind == "spectrum":
            return {"label": grey(label, step), "prediction": grey(value, step)}
        if self.kind == "channel":
            element = int(loudest(label))
            return {
                "curves": {
                    "predicted": self._curve(value, element),
                    "measured": self._curve(label, element),
                }
            }
        return {}

    @property
    def _names(self) -> list[str]:
        return [receiver.name for receiver in self.scene.receivers]

    def _estimate(
        self, points: Float[Tensor, "b 3"], receiver: Any
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Values, deviations and expected SNR [dB], on the CPU; None if the model has none."""
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", ExtrapolationWarning
            )  # a transmitter may be dragged anywhere
            options = {"frequency": self.frequency, "batch_size": POINTS, "interval": self.interval}
            with self.lock:
                found: Any = self.model.predict(points, receiver, **options)
        parts = (found.value, found.std, found.snr_db) if self.interval else (found, None, None)
        return tuple(None if part is None else part.cpu() for part in parts)  # type: ignore[return-value]

    def _curve(self, channel: Tensor, element: int) -> dict:
        """Magnitude [dB] over delay [ns] at an element; of one subcarrier over the elements."""
        if channel.shape[1] == 1:
            x, responses = np.arange(1, len(channel) + 1), channel[:, 0].numpy()
            names = "element", "|h| [dB]"
        else:
            delays, responses = impulse_response(
                channel[element].numpy(), self.task.frequencies.numpy()
            )
            x, names = (
                1e9 * delays,
                ("delay [ns]", f"|impulse response| [dB], element {element + 1}"),
            )
        return {
            "x": plain(x),
            "y": plain(np.maximum(decibels(responses), 20 * math.log10(LEAST))),
            "xlabel": names[0],
            "ylabel": names[1],
        }


def plain(values: Any) -> Any:
    """Numbers for JSON: four significant digits, at least three decimals below 10,000."""
    array = np.asarray(
        values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64
    )
    largest = float(np.abs(array).max(initial=1e-30))
    return np.round(array, max(3, 3 - math.floor(math.log10(largest)))).tolist()


def grey(image: Float[Tensor, "rows columns"], step: int = 1) -> dict:
    """An image as bytes, 255 for an amplitude of 1, by their changes from pixel to pixel, which
    pack well.
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
    """Gaussians by the upper triangles of their covariances [m²]."""
    rows, columns = np.triu_indices(3)
    parts = {"means": means, "covariances": covariances[:, rows, columns], "opacities": opacities}
    return {name: plain(part) for name, part in parts.items()} | {"strengths": plain(strengths)}


def loudest(channel: Tensor) -> Tensor:
    """The element with the most power."""
    return channel.abs().square().sum(1).argmax()


def level(channels: Tensor) -> Tensor:
    """Mean power of channels (b, elements, subcarriers) [dB]."""
    return 10 * channels.abs().square().flatten(1).mean(1).clamp_min(LEAST**2).log10()
