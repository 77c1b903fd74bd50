"""The score of planes by channels with few values, summed coherently over places."""

import itertools
import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn import functional

from gaigs.planes.channel_links import SLABS, ChannelData, ReceiverChannels
from gaigs.planes.field_room import FieldFit, FieldRoom, group_places
from gaigs.planes.frame import mean_bounces
from gaigs.planes.search import Candidate, GridRatings, Score, descend
from gaigs.splatting.placement.mirrored.reflections import reflect


class FieldScore(Score[FieldRoom]):
    """Score of planes by the power that an image explains with one gain for all places.

    With a separate gain at each place, any plane would explain a channel of one value. A common
    gain makes a few hundred places one large array, over which the phases of a wrong plane do not
    fit. Powers are summed over receivers and groups of places, whose relative phases are unknown.

    Args:
        data: Training channels with a common phase.
        price: Smallest fall of the sum of log squared errors over all channel values by a true
            plane. The best of n false planes reaches about log n.
        chunk: Number of waves computed at a time.
        upright: Cosine of the largest tilt, 3.6 degrees, at which a plane is also tried vertical or
            along an axis.

    Attributes:
        groups: Number of groups of places in the ratings of a grid.
        rated: True for bands whose links rate planes.

    Source: Mallat and Zhang, Matching pursuits with time-frequency dictionaries, 1993.
    """

    def __init__(
        self,
        data: ChannelData,
        price: float = 12.0,
        chunk: int = 4_000_000,
        upright: float = 0.998,
    ):
        self.data = data
        self.upright = upright
        self.fit = FieldFit(data)
        self.price = price / self.fit.count
        self.chunk = chunk
        self.groups = 1
        self.rated = torch.ones(len(self.fit.bands), dtype=torch.bool)
        # Metal, whose reflection is equal at all angles.
        self.mirror = torch.tensor([0.0, math.log(1e6), 0.0], dtype=torch.float64)

    def error(self, room: FieldRoom) -> float:
        errors = self.fit.leave_out(room)
        return self.fit.mean_log(errors).item() + self.price * len(room.planes)

    # --- ratings ---

    def rate(self, room: FieldRoom, grid: Float[Tensor, "n k 4"]) -> GridRatings:
        """Ratings of planes by the ``rated`` bands.

        The grid is rated with incoherent groups of places. The returned function rates single
        planes by all places coherently. The expected rating of noise is 1 for each receiver and
        group.
        """
        ratings = self._explain(room, grid.flatten(0, 1), self.groups)
        return GridRatings(
            ratings.view(grid.shape[:2]), lambda planes: self._explain(room, planes, 1)
        )

    def _explain(
        self, room: FieldRoom, planes: Float[Tensor, "c 4"], groups: int
    ) -> Float[Tensor, " c"]:
        """Power that the image in each plane explains, summed over receivers and groups of places.

        A matched filter: |sum conj(wave) residual|² / sum |wave|², over residuals of mean power 1.
        """
        errors = self.fit.leave_out(room)
        # The derivative of log(|error|² + mean) limits the weight of large errors.
        power = errors.abs().square()
        errors = errors / (power + power.mean())
        total = torch.zeros(len(planes))
        for number, receiver in enumerate(self.data.receivers):
            if not self.rated[self.fit.band_numbers[number]]:
                continue
            at_receiver = self.fit.owner == number
            power = errors[at_receiver].abs().square().mean()
            shape = receiver.flat.shape  # (b, k)
            normalised = (errors[at_receiver] / power.sqrt()).to(torch.complex64).view(shape)
            scale = self.fit.scale[at_receiver].float().view(shape)[:, :1]  # (b, 1)
            member = functional.one_hot(group_places(receiver.places, groups)).float()  # (b, g)
            step = max(1, self.chunk // len(receiver.places))
            for rows in torch.arange(len(planes)).split(step):
                part = planes[rows].float()
                sums = torch.zeros((), dtype=torch.complex64)
                size = torch.zeros(())
                waves = self._waves(receiver, part)
                # One channel value (element and subcarrier) at a time, to save memory.
                for (cosine, sine, amplitude), values in zip(waves, normalised.mT, strict=True):
                    weights = scale * member
                    real = weights * values.real[:, None]
                    imaginary = weights * values.imag[:, None]
                    # conj(wave) error: (cos + j sin) (real + j imaginary).
                    along = cosine @ real - sine @ imaginary  # (c, g)
                    across = cosine @ imaginary + sine @ real
                    sums = sums + torch.complex(along, across)
                    size = size + amplitude.square() @ (scale * weights)
                explained = sums.abs().square() / size.clamp_min(1e-20)
                total[rows] += explained.sum(1)
        return total.to(planes)

    @staticmethod
    def _waves(
        receiver: ReceiverChannels, planes: Float[Tensor, "c 4"]
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yields the images' waves for each element and subcarrier.

        A wave is three tensors (c, b): real part, negative imaginary part and amplitude.
        """
        normals, offsets = planes[:, :3], planes[:, 3:]
        places = receiver.places.float()
        heights = normals @ places.mT - offsets  # (c, b)
        for element in receiver.elements.float():
            products = heights * (normals @ element[:, None] - offsets)
            # The squared distance of an image is the place's, and four times the heights' product.
            direct = (places - element).square().sum(1)
            lengths = (direct + 4 * products).clamp_min(1e-4).sqrt()
            amplitude = (products > 0) / lengths  # 0 for a plane between the ends
            for frequency in receiver.frequencies.tolist():
                phases = lengths * (2 * math.pi * frequency / speed_of_light)
                yield phases.cos() * amplitude, phases.sin() * amplitude, amplitude

    # --- changes of a room ---

    def add(self, room: FieldRoom, candidate: Candidate) -> FieldRoom | None:
        before = self.error(room)
        # A new plane has no gain yet, so the room's kriging holds for it.
        kriged = self.fit.krige(room, self.fit.waves(room.planes, room))
        trials = []
        # Bands that do not show the plane may still receive paths at it.
        uses = [self.rated] if self.rated.all() else [self.rated, torch.ones_like(self.rated)]
        choices = self._same_image_planes(room, candidate.plane)
        for plane, slab, used in itertools.product(choices, (SLABS[1], self.mirror), uses):
            if not self.data.frame.is_like(room.planes, plane).any():
                start = room.with_plane(plane, slab, used)
                larger = self.fit.fit_gains(start, 5, kriged=kriged)
                errors = kriged.leave_out(self.fit.residual(larger))
                trials.append((self.fit.mean_log(errors).item(), larger))
        trials.sort(key=lambda trial: trial[0])
        polished = [self.descend(larger, 12) for _, larger in trials[:2]]
        best = min(polished, key=self.error, default=None)
        return best if best is not None and self.error(best) < before else None

    def _same_image_planes(
        self, room: FieldRoom, plane: Float[Tensor, "4"]
    ) -> list[Float[Tensor, "4"]]:
        """A candidate plane, and the planes that give its image together with a known plane.

        With a single receiver position, an image of second order resembles the image in one further
        plane. The true plane may therefore be one that reflects before or after a known plane.
        """
        planes = [plane]
        position = self.data.receivers[0].position
        if any((receiver.position != position).any() for receiver in self.data.receivers):
            return planes
        image = reflect(position, plane[:3], plane[3])
        for known in room.planes:
            normal, offset = known[:3], known[3]
            planes.append(bisect(position, reflect(image, normal, offset)))
            planes.append(bisect(reflect(position, normal, offset), image))
        return [plane for plane in planes if plane.isfinite().all()]

    def remove(self, room: FieldRoom, number: int) -> FieldRoom:
        return self.fit.fit_gains(room.without_plane(number), 5)

    def refine(self, room: FieldRoom) -> FieldRoom:
        return self.descend(room, 40)

    def square(self, room: FieldRoom) -> FieldRoom:
        """The room with small tilts removed, by turns to the vertical or to the coordinate axes.

        The room is unchanged if this raises the error by more than chance explains. By chance each
        fitted angle lowers the sum of log errors over n values by up to log(n) / 2.

        Source: Schwarz, Estimating the dimension of a model, 1978.
        """
        normals = room.planes[:, :3]
        level = functional.normalize(normals * normals.new_tensor([1.0, 1.0, 0.0]), dim=1)
        along = torch.eye(3).to(normals)[normals.abs().argmax(1)] * normals.sign()  # (w, 3)
        is_square = (normals * along).sum(1) > self.upright
        is_level = (normals * level).sum(1) > self.upright
        squared = torch.where(is_level[:, None], level, normals)
        squared = torch.where(is_square[:, None], along, squared)
        # Planes turn about the points where they reflect.
        pivots = mean_bounces(self.data.receivers, room.planes)
        offsets = room.planes[:, 3] + ((squared - normals) * pivots).sum(1)
        start = room._replace(planes=torch.cat((squared, offsets[:, None]), 1))
        trial = self.descend(self.fit.fit_gains(start, 5), 40, turns=0.0)
        saved = torch.where(is_square, 2, is_level.long()).sum().item()
        chance = saved * math.log(self.fit.count) / (2 * self.fit.count)
        return trial if self.error(trial) < self.error(room) + chance else room

    def descend(self, room: FieldRoom, steps: int, turns: float = 0.4) -> FieldRoom:
        """The room after gradient descent of its planes, with gains fitted again in each step.

        ``steps`` and ``turns`` are as for ``search.descend``.

        Source: Golub and Pereyra, 1973.
        """
        current = room
        kriged = self.fit.krige(room, self.fit.waves(room.planes, room))
        step = 0

        def loss(planes: Float[Tensor, "w 4"]) -> Float[Tensor, ""]:
            nonlocal current, kriged, step
            waves = self.fit.waves(planes, room)
            with torch.no_grad():
                current = self.fit.fit_gains(current, 1, waves.detach(), kriged)
            step += 1
            if step % 5 == 0:  # it changes little
                kriged = self.fit.krige(current, waves)
            return self.fit.mean_log(kriged.whiten(self.fit.residual(current, waves)))

        rate = 0.1 * self.data.wavelength
        planes = descend(loss, self.data.receivers, room.planes, [], steps, rate, turns)[0]
        moved = self.fit.fit_gains(current._replace(planes=planes), 4)
        return min(room, moved, key=self.error)


def bisect(one: Float[Tensor, "3"], other: Float[Tensor, "3"]) -> Float[Tensor, "4"]:
    """The plane of symmetry of two points; NaN for equal points."""
    normal = (other - one) / (other - one).norm()
    return torch.cat((normal, (normal @ (one + other) / 2)[None]))
