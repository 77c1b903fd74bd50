"""Search for planes in spectra: a Hough transform, and interference in the covariances of the
array's elements.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn import functional

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose, sinc
from gaigs.core.propagation import NEAREST, fresnel
from gaigs.core.query import Query, evenly
from gaigs.core.stages import is_up, track
from gaigs.data import Links
from gaigs.planes.plane_search import PlaneSearch
from gaigs.splatting.gaussians import fibonacci_lattice
from gaigs.splatting.placement.mirrored.reflections import (
    all_sequences,
    fold,
    images,
    polarised,
    reflect,
    seen_from,
    square_normals,
    tangents,
)

MATERIAL = complex(4.0, -0.3)
"""Relative permittivity of all planes: between wood and concrete."""

FLOOR = 0.01
"""Share of a spectrum's variance below which an error hardly counts."""

SURE = 2.0
"""Least fall of the mean log error by which a plane moves [standard errors]."""

BLOCKED = 0.1
"""Rise of a link's log error by which a path counts as blocked there: without it, any plane
explains some links.
"""

GAIN = 0.03
"""Least fall of the mean log error by a further plane."""

REACH = 0.08
"""Distance over which a plane is moved on either side [diagonals of the room]."""

BANDS = 0.01, 1.0, 3.0, 10.0, 30.0, 100.0
"""Bandwidths that are tried, where it is unknown [speed of light over the room's diagonal]."""

FAINT = 1e-3
"""Share of the power below which paths of several reflections are left out."""

WIDEST = 50.0
"""Largest distance over which a plane is searched by phases [wavelengths]: a thousand errors for
each normal.
"""

STRANGE = 0.01
"""Share of a spectrum that its array cannot explain, from which on the search is left out. Measured
spectra have 0.001, powers in place of amplitudes 0.05."""

BEYOND = 0.15
"""Largest distance of a plane from all transmitters and receivers [diagonals of the room]."""

PAIRS = 16
"""Most pairs of a receiver and a carrier: each costs a periodogram."""

TILE = 0.025
"""Half the width of a tile of the periodogram [rad]: over some metres, lengths are linear within
it.
"""

TURN = 0.16
"""Step of a turn in the periodogram [wavelengths over the places' mean distance from the pivot]:
about 2 rad.
"""

DIRECTIONS = Grid.degrees(range(4, 90, 8), range(0, 360, 15)).flatten().vectors()
"""Directions in which spectra are compared: 4 x 4 elements resolve no more."""


@dataclass(frozen=True)
class ReceiverLags:
    """Covariances of one receiver's elements at some training links of one carrier.

    Attributes:
        places: Transmitters (b, 3) [m].
        lags: At each of ``array.lags``, over the power (b, l).
        frequency: Of the carrier [Hz].
        pose, array: Of the receiver.
    """

    places: Float[Tensor, "b 3"]
    lags: Complex[Tensor, "b l"]
    frequency: float
    pose: Pose
    array: Array

    def some(self, index: object) -> "ReceiverLags":
        """The same of some links."""
        return replace(self, places=self.places[index], lags=self.lags[index])

    @property
    def position(self) -> Float[Tensor, "3"]:
        return self.pose.position

    @property
    def wavenumber(self) -> float:
        """[rad/m]."""
        return 2 * math.pi / speed_of_light * self.frequency

    @cached_property
    def elements(self) -> Float[Tensor, "e 2"]:
        return self.array.elements[:, :2].to(self.places)

    @cached_property
    def counts(self) -> Float[Tensor, " l"]:
        return self.array.lags[2].to(self.places)

    @cached_property
    def shapes(self) -> Float[Tensor, "b k"]:
        return self.shape_of(self.lags)

    @cached_property
    def basis(self) -> Float[Tensor, "m k"]:
        """Contribution of the real and the imaginary part of each lag from 0 on to the power in
        ``DIRECTIONS``.
        """
        half = len(self.counts) // 2
        weights = self.counts[half:] * torch.where(torch.arange(half + 1) > 0, 2, 1)
        phases = self.wavenumber * (
            self.array.lags[0][half:].to(self.places) @ DIRECTIONS.to(self.places).T
        )
        return torch.cat((phases.cos() * weights[:, None], phases.sin() * weights[:, None]))

    def shape_of(self, lags: Complex[Tensor, "b l"]) -> Float[Tensor, "b k"]:
        """Amplitudes in ``DIRECTIONS`` with a mean of 0 and a norm of 1: labels have lost their
        scale.
        """
        later = lags[:, lags.shape[1] // 2 :]
        later = later / later[:, :1].real.clamp_min(1e-12)
        powers = torch.cat((later.real, later.imag), 1) @ self.basis
        amplitudes = powers.clamp_min(1e-4).sqrt()  # of a mean power of e²
        amplitudes = amplitudes - amplitudes.mean(1, keepdim=True)
        return amplitudes / amplitudes.norm(dim=1, keepdim=True).clamp_min(1e-6)

    def errors(self, lags: Complex[Tensor, "b l"]) -> Float[Tensor, " b"]:
        """Log of the share of each spectrum's variance that a model's lags do not explain."""
        alike = (self.shape_of(lags) * self.shapes).sum(1).clamp_min(0)
        return (1 - alike.square() + FLOOR).log()

    def slopes(self, lags: Complex[Tensor, "b l"]) -> Complex[Tensor, "b e e"]:
        """Negative gradient M of the errors by the covariances: a further wave x lowers them by x'
        M x, and by 2 Re x' M y where it interferes with a wave y of the model."""
        with torch.enable_grad():
            lags = lags.detach().requires_grad_()
            self.errors(lags).sum().backward()
        half = len(self.counts) // 2
        slopes = -lags.grad[:, half:]
        slopes[:, 1:] /= 2  # ``shape_of`` reads one of two opposite lags
        slopes = torch.cat((slopes[:, 1:].conj().flip(1), slopes), 1) / self.counts
        return slopes[:, self.array.lags[1]].view(-1, len(self.array), len(self.array))

    def steering(self, ways: Float[Tensor, "*b d"]) -> Complex[Tensor, "*b e"]:
        """Phases at the elements of waves from directions in the array's frame, whose z does not
        matter.
        """
        turns = self.wavenumber * (ways[..., :2] @ self.elements.T)
        return torch.polar(torch.ones_like(turns), turns)

    def seen(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b"]]:
        """Directions to points in the array's frame, and distances [m]."""
        ways = (points - self.pose.position) @ self.pose.rotation
        lengths = ways.norm(dim=-1).clamp_min(NEAREST)
        return ways / lengths[..., None], lengths

    def paths(
        self,
        planes: Float[Tensor, "w 4"],
        sequences: Int[Tensor, "n order"],
        passing: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Fields (b, n), steering (b, n, e) and lengths (b, n) [m] of all paths.

        ``passing`` (b, w + 1) is the share of the direct path's field that obstacles let through,
        then that at each plane; true and false for all and nothing.
        """
        normals, offsets = planes[:, :3], planes[:, 3]
        points = images(self.places, sequences, normals, offsets)
        folded = fold(
            points, self.pose.position.expand(len(self.places), 3), sequences, normals, offsets
        )
        ways, lengths = self.seen(points[-1])
        gains = folded.exists * self.array.gain(ways) / lengths
        if passing is not None:
            own = torch.cat((passing[:, 1:], torch.ones_like(passing[:, :1])), 1)  # -1 is the last
            own = own[:, sequences].prod(2)
            own[:, 0] = passing[:, 0]
            gains = gains * own
        reflections = reflection(folded.normals, folded.cosines)
        gains = folded.reflected(torch.complex(gains, torch.zeros_like(gains)), reflections)
        phases = -self.wavenumber * lengths
        return gains * torch.polar(torch.ones_like(phases), phases), self.steering(ways), lengths

    def sums(
        self, fields: Tensor, steering: Tensor, lengths: Tensor, bandwidth: float
    ) -> Complex[Tensor, "b l"]:
        """Covariances of interfering paths, as of ``LagPooling``."""
        if bandwidth:
            likeness = sinc(bandwidth / speed_of_light * (lengths[:, :, None] - lengths[:, None]))
            together = fields[:, :, None] * fields[:, None].conj() * likeness
            covariances = steering.mT @ together @ steering.conj()
        else:
            waves = (fields[:, None] @ steering).mT
            covariances = waves @ waves.mH
        flat = covariances.flatten(1)
        return (
            flat.new_zeros(len(flat), len(self.counts)).index_add(1, self.array.lags[1], flat)
            / self.counts
        )

    def doubts(self, name: str) -> list[str]:
        """A sentence if the direct path shows in another direction than geometry says."""
        _, pairs, _ = self.array.lags
        matrices = self.lags[:, pairs].view(-1, len(self.array), len(self.array))
        ways, _ = self.seen(self.places)
        shares = {}
        for turn, flip in itertools.product(range(4), (1, -1)):
            turned = torch.view_as_real(torch.view_as_complex(ways[:, :2].contiguous()) * 1j**turn)
            turned = torch.cat((turned[:, :1], flip * turned[:, 1:], ways[:, 2:]), -1)
            steering = self.steering(turned)
            share = (
                torch.einsum("bi,bij,bj->b", steering.conj(), matrices, steering).real
                / len(self.array) ** 2
            )
            shares[turn, flip] = share.median().item()
        (turn, flip), best = max(shares.items(), key=lambda item: item[1])
        if best < 0.4 or shares[0, 1] > best - 0.2:
            return []
        words = f"turned by {90 * turn} degrees" if turn else ""
        words += " and " * bool(turn and flip < 0) + "counted clockwise" * (flip < 0)
        return [
            f"the direct path explains {shares[0, 1]:.0%} of the spectra of {name}, "
            f"{best:.0%} if azimuths were {words}\ncheck the receiver's orientation and the azimuths of the data"
        ]

    def one_more(
        self, paths: tuple[Tensor, Tensor, Tensor], bandwidth: float
    ) -> tuple[Tensor, Tensor]:
        """The wave of one more path beside known ones: its interference with each (b, n, e), and
        their lengths.

        Without a bandwidth it is the same for a path of any length: one sum (b, 1, e).
        """
        fields, steering, lengths = paths
        waves = (self.slopes(self.sums(*paths, bandwidth)) @ steering.mT).mT * fields[..., None]
        return (waves, lengths) if bandwidth else (waves.sum(1, keepdim=True), lengths[:, :1])

    def single(self, planes: Float[Tensor, "c 4"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Directions, lengths, fields without a phase and cosines of single reflections (b, c)."""
        normals, offsets = planes[:, :3], planes[:, 3]
        here, there = self.pose.position @ normals.T - offsets, self.places @ normals.T - offsets
        ways, lengths = self.seen(self.places[:, None] - 2 * there[..., None] * normals)
        cosines = -(here + there) / lengths
        gains = self.array.gain(ways) / lengths * (here * there > 0)
        return ways, lengths, gains * reflection(normals, cosines.abs()), cosines

    def likeness(
        self,
        waves: Complex[Tensor, "b n e"],
        lengths: Float[Tensor, "b n"],
        bandwidth: float,
        planes: Float[Tensor, "c 4"],
        pivots: Float[Tensor, "c 3"],
        axes: Float[Tensor, "2 3"],
    ) -> tuple[Complex[Tensor, "c b"], Float[Tensor, "c b 3"]]:
        """Likeness of the reflection at each plane to the waves of one more path; and by how much
        its phase turns if the plane moves [rad/m], or turns about its pivot [m] towards two
        axes."""
        ways, own, gains, cosines = (part.transpose(0, 1) for part in self.single(planes))
        alike = sinc(bandwidth / speed_of_light * (lengths - own[..., None]))
        left = torch.einsum("cbn,bne->cbe", alike.to(waves), waves)
        heard = (self.steering(ways).conj() * left).sum(2) * gains.conj()
        heard = heard * torch.polar(torch.ones_like(own), self.wavenumber * own)
        sizes = heard.abs()
        medians = (
            torch.where(sizes > 0, sizes, math.nan)
            .nanmedian(1, keepdim=True)
            .values.nan_to_num(1.0)
        )
        heard = heard / (sizes + medians)  # so that no link rules
        normals, offsets = planes[:, None, :3], planes[:, None, 3]
        there = (self.places * normals).sum(-1) - offsets
        units = functional.normalize(
            reflect(self.places, normals, offsets) - self.pose.position, dim=2
        )
        turned = (self.places - pivots[:, None]) @ axes.T * cosines[..., None] + there[
            ..., None
        ] * (units @ axes.T)
        return heard, 2 * self.wavenumber * torch.cat((cosines[..., None], -turned), 2)


def periodogram(
    heard: Complex[Tensor, " b"],
    rates: Float[Tensor, "b 3"],
    moves: Float[Tensor, " m"],
    turns: Float[Tensor, " t"],
) -> Float[Tensor, "m 2*t-1 2*t-1"]:
    """``ReceiverLags.likeness`` in all, at planes that are moved by ``moves`` [m] and turned
    towards two axes by ``turns`` [rad], from 0 up, and their negatives, in ascending order."""
    phases = rates[:, :1] * moves
    moved = heard[:, None] * torch.polar(torch.ones_like(phases), phases)
    # Turns to both sides have the same products of cosines and sines, but for their signs.
    sides = rates[:, 1:, None] * turns
    (cos, other_cos), (sin, other_sin) = sides.cos().unbind(1), sides.sin().unbind(1)
    size = len(turns), len(moves), len(turns)
    total = lambda part, one, other: (
        (other.T @ (part[:, :, None] * one[:, None]).flatten(1)).view(size).movedim(0, 2)
    )
    even, odd = total(moved.real, cos, other_cos), total(moved.real, sin, other_sin)
    one, two = total(moved.imag, sin, other_cos), total(moved.imag, cos, other_sin)
    rows = []
    for sign in (-1, 1):
        near, far = even - sign * one, sign * odd + two  # even and odd in the second turn
        rows.append(torch.cat(((near + far).flip(2)[..., :-1], near - far), 2))
    return torch.cat((rows[0].flip(1)[:, :-1], rows[1]), 1)


@dataclass(frozen=True)
class Found:
    """Planes of the room, and which paths are open at each link.

    Attributes:
        planes: Normals and offsets (w, 4) [m].
        open: For each link the direct path, then all paths at each plane (b, w + 1).
        errors: Of each link, with ``BLOCKED`` where the last plane that was moved is not open (b,).
    """

    planes: Float[Tensor, "w 4"]
    open: Bool[Tensor, "b v"]
    errors: Float[Tensor, " b"]


class Peak(NamedTuple):
    """Maximum of a periodogram: its height, a plane, and the point about which the plane was turned
    [m].
    """

    score: float
    plane: Float[Tensor, "4"]
    pivot: Float[Tensor, "3"]

    def is_apart(self, other: "Peak", wavelength: float) -> bool:
        """True unless one main lobe holds both."""
        gap = self.plane - other.plane
        return bool(
            gap[:3].norm() > TILE / 4 or (gap[3] - gap[:3] @ self.pivot).abs() > wavelength / 4
        )


class LagSearch(PlaneSearch):
    """Planes whose reflections explain spectra.

    A spectrum gives back the covariances of the array's elements (``Beamformer.lags``), so a model
    is compared with it at once, with one material and without obstacles. A plane is moved to where
    a periodogram over offset and two tilts is highest: the slope of the error by the covariances,
    times the waves of known paths, is the wave of one more path, and its phase follows from its
    length. Lengths are linear within a tile. The error decides between the proposals. At each link
    the paths at a plane may be blocked, for a price. Further planes come from a Hough transform
    over normals and offsets, by their power alone.

    Args:
        links: Their training links count; of the task ``spectrum``.
        frequencies: Carrier of each link [Hz].
        covariances: Function from labels and their query to lags, each label's up to a scale, and
            the share of each label that they do not explain.
        order: Largest number of reflections of a path; more than 2 count as 2, as longer paths
            hardly locate a plane.
        most: Links that count, of all receivers and carriers together; of each at least 20.

    Source: ours; Van Trees, Optimum Array Processing, 2002, section 2.4, for the covariances;
    Hough, Method and means for recognizing complex patterns, 1962.
    """

    def __init__(
        self,
        links: Links,
        frequencies: Float[Tensor, " n"],
        covariances: Callable[[Tensor, Query], tuple[Tensor, Tensor]],
        order: int,
        most: int = 150,
    ):
        self.order, self.doubts = min(order, 2), []
        for own, carrier, pose, receiver in self.parts(links, frequencies, most):
            lags, left = covariances(links.labels[own], links.query[own])
            powers = lags[:, lags.shape[1] // 2].real
            heard = powers > 0
            if not heard.any():
                continue
            places, lags = (
                links.query.transmitters[own] - self.middle,
                (lags / powers[:, None]).to(torch.complex64),
            )
            if left.median() > STRANGE:
                self.doubts.append(
                    f"the array of {receiver.name} does not explain {left.median():.0%} of its spectra\n"
                    "check frequency, elements and directions, and that labels are amplitudes, not powers or dB"
                )
            else:
                self.receivers.append(
                    ReceiverLags(places[heard], lags[heard], carrier, pose, receiver.array)
                )
                self.doubts += self.receivers[-1].doubts(receiver.name)
        self.doubts = list(dict.fromkeys(self.doubts))

    def parts(
        self, links: Links, frequencies: Float[Tensor, " n"], most: int
    ) -> Iterator[tuple[Int[Tensor, " b"], float, Pose, Receiver]]:
        """Training links, carrier, pose about the room's middle and receiver, of each receiver and
        carrier.
        """
        self.receivers: list[ReceiverLags] = []
        self.wavelength = speed_of_light / frequencies.max().item()
        train, query = links.split.train, links.query
        used = query.receivers[train].unique()
        super().__init__(
            torch.cat((query.transmitters[train], links.scene.positions(query.transmitters)[used]))
        )
        heard = torch.stack(
            (query.receivers[train].double(), frequencies[train].double()), 1
        ).unique(dim=0)
        pairs = heard[evenly(torch.arange(len(heard)), PAIRS)].tolist()
        for number, carrier in pairs:
            receiver = links.receivers[int(number)]
            own = train[(query.receivers[train] == number) & (frequencies[train] == carrier)]
            own = evenly(own, max(20, most // len(pairs)))
            pose = replace(receiver.pose, position=receiver.pose.position - self.middle).to(
                self.points
            )
            yield own, carrier, pose, receiver

    @torch.no_grad()
    def run(
        self, planes: Float[Tensor, "w 4"], bandwidth: float | None, most: int
    ) -> Float[Tensor, "v 4"]:
        """The planes, each moved twice by up to ``REACH`` and 18 degrees, and others, at most as
        many as ``most``.

        ``bandwidth`` is that over which powers are averaged [Hz]. If it is unknown, it becomes that
        with which moving the strongest plane leaves least, or a carrier if moving all planes leaves
        less with it: one plane among others in the wrong places hardly interferes.
        """
        if not len(planes) or not self.receivers:
            return planes
        count = sum(len(receiver.places) for receiver in self.receivers)
        everywhere = torch.ones(count, len(planes) + 1).bool()
        start = Found(
            seen_from(planes.double(), self.middle).float(), everywhere, torch.zeros(count)
        )
        trials, strongest = (
            [],
            int(self.powers(start.planes, all_sequences(len(planes), 1)[1:]).argmax()),
        )
        choices = self.bandwidths(bandwidth)
        for self.bandwidth in choices:
            left = self.moved(start, strongest).errors.mean().item() if len(choices) > 1 else 0.0
            trials.append((left, self.bandwidth))
        moved = []
        for self.bandwidth in dict.fromkeys((min(trials)[1], choices[0])):
            found = self.around(start)
            moved.append((found.errors.mean().item(), self.bandwidth, found))
        _, self.bandwidth, found = min(moved, key=lambda trial: trial[0])
        found = self.around(self.with_more(found, most))
        return seen_from(found.planes.double(), -self.middle)

    def bandwidths(self, known: float | None) -> list[float]:
        """The bandwidth, or those to try [Hz]: from a carrier to a band in which hardly two paths
        interfere.
        """
        return (
            [rooms * speed_of_light / self.diagonal for rooms in BANDS]
            if known is None
            else [known]
        )

    def around(self, found: Found) -> Found:
        """Each plane moved, the strongest first; then all together."""
        singles = all_sequences(len(found.planes), 1)[1:]
        for k in track(
            self.powers(found.planes, singles).argsort(descending=True).tolist(), "search of planes"
        ):
            if is_up():
                break
            found = self.moved(found, k)
        direct = [
            self.errors(found.planes, self.opened(found.open, 0, is_open))
            for is_open in (True, False)
        ]
        found = replace(found, open=self.opened(found.open, 0, direct[0] <= direct[1] + BLOCKED))
        planes = self.polish(found)
        gains = self.errors(found.planes, found.open) - self.errors(planes, found.open)
        return replace(found, planes=planes) if is_sure(gains) else found

    def with_more(self, found: Found, most: int) -> Found:
        """Further planes, one after the other, as long as the errors fall by ``GAIN``."""
        normals = torch.cat((fibonacci_lattice(200, 0.0, math.pi / 2).float(), torch.eye(3)))
        grid = self.grid(normals, 60, BEYOND).flatten(0, 1)
        for _ in track(range(most - len(found.planes)), "search of planes"):
            if is_up():
                break
            before, trials = self.errors(found.planes, found.open), []
            for plane in self.candidates(found, grid):
                tried = (
                    torch.cat((found.planes, plane[None])),
                    torch.cat((found.open, found.open[:, :1] | True), 1),
                )
                trials.append(self.moved(Found(*tried, before), len(found.planes)))
            best = min(trials, key=lambda trial: trial.errors.mean().item(), default=found)
            if not (before - best.errors).mean() >= GAIN or best is found:
                break
            found = best
        return found

    @staticmethod
    def opened(
        open_: Bool[Tensor, "b v"], column: int, value: Tensor | bool
    ) -> Bool[Tensor, "b v"]:
        changed = open_.clone()
        changed[:, column] = value
        return changed

    def each(self, passing: Tensor) -> list[tuple[ReceiverLags, Tensor]]:
        """Receivers, and what passes at their links (c, v); see ``ReceiverLags.paths``."""
        parts = passing.split([len(receiver.places) for receiver in self.receivers])
        return list(zip(self.receivers, parts, strict=True))

    def sequences(self, planes: Float[Tensor, "w 4"]) -> Int[Tensor, "n order"]:
        """All sequences but those of several reflections that are faint."""
        sequences = all_sequences(len(planes), self.order)
        powers = self.powers(planes, sequences)
        return sequences[((sequences >= 0).sum(1) <= 1) | (powers > FAINT * powers.sum())]

    def powers(
        self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]
    ) -> Float[Tensor, " n"]:
        parts = [receiver.some(slice(None, None, 4)) for receiver in self.receivers]
        return torch.cat([part.paths(planes, sequences)[0].abs().square() for part in parts]).mean(
            0
        )

    def errors(
        self,
        planes: Float[Tensor, "w 4"],
        open_: Bool[Tensor, "b v"],
        sequences: Tensor | None = None,
        every: int = 1,
    ) -> Float[Tensor, " c"]:
        """Log of what paths leave of each link, or of every second one: none must rule."""
        sequences = self.sequences(planes) if sequences is None else sequences
        logs = []
        for receiver, own in self.each(open_):
            part = receiver.some(slice(None, None, every))
            logs.append(
                part.errors(part.sums(*part.paths(planes, sequences, own[::every]), self.bandwidth))
            )
        return torch.cat(logs)

    def candidates(self, found: Found, grid: Float[Tensor, "k 4"]) -> list[Float[Tensor, "4"]]:
        """Planes whose reflections add power where it lacks, see ``best``."""
        side = torch.linspace(-1, 1, 33)
        plane_waves = torch.cartesian_prod(side, side)
        maps, sequences = [], self.sequences(found.planes)
        for receiver, own in self.each(found.open):
            slopes = receiver.slopes(
                receiver.sums(*receiver.paths(found.planes, sequences, own), self.bandwidth)
            )
            steering = receiver.steering(plane_waves)
            maps.append(((steering.conj() @ slopes) * steering).sum(-1).real.view(-1, 1, 33, 33))
        scores = torch.cat([self.scores(maps, part) for part in grid.split(4000)])
        return [
            plane
            for plane, _ in self.best(
                grid, scores, lambda near: self.scores(maps, near), found.planes
            )
        ]

    def scores(
        self, maps: list[Float[Tensor, "b 1 k k"]], planes: Float[Tensor, "c 4"]
    ) -> Float[Tensor, " c"]:
        """Fall of the errors by the power of one more reflection, over the norm of that power."""
        total, square = planes.new_zeros(2, len(planes))
        for receiver, lack in zip(self.receivers, maps, strict=True):
            ways, _, gains, _ = receiver.single(planes)
            powers = gains.abs().square()
            at = ways[..., [1, 0]][:, None]  # ``grid_sample`` takes the column first
            total += (powers * functional.grid_sample(lack, at, align_corners=True)[:, 0, 0]).sum(0)
            _, direct = receiver.seen(receiver.places)
            square += (powers * direct.square()[:, None]).square().sum(0)
        return total / square.sqrt().clamp_min(1e-6)

    # --- phases ---

    def moved(self, found: Found, k: int) -> Found:
        """Plane k where the error is least: near its own normal, or square to another plane; and
        where it is open.
        """
        others = torch.arange(len(found.planes)) != k
        known, own = found.planes[others], found.open[:, torch.cat((others.new_ones(1), others))]
        sequences = self.sequences(known)
        pairs = [
            (receiver, receiver.paths(known, sequences, part)) for receiver, part in self.each(own)
        ]
        waves = [receiver.one_more(paths, self.bandwidth) for receiver, paths in pairs]
        blocked = self.errors(known, own, sequences) + BLOCKED
        trials = [found.planes]
        for normal in square_normals(found.planes[:, :3], k):
            for peak in self.peaks(waves, normal, found.planes[k]):
                trials.append(
                    torch.cat((found.planes[:k], peak.plane[None], found.planes[k + 1 :]))
                )
        everywhere, sequences = self.opened(found.open, k + 1, True), self.sequences(found.planes)
        errors = torch.stack([self.errors(tried, everywhere, sequences) for tried in trials])
        least = torch.minimum(errors, blocked)
        best = int(least.mean(1).argmin())
        best = best if is_sure(least[0] - least[best]) else 0
        return Found(
            trials[best], self.opened(found.open, k + 1, errors[best] < blocked), least[best]
        )

    def peaks(
        self,
        waves: list[tuple[Tensor, Tensor]],
        normal: Float[Tensor, "3"],
        plane: Float[Tensor, "4"],
    ) -> list[Peak]:
        """Planes near a normal in place of one: at most six maxima of the periodogram."""
        (about,), reach = (
            self.pivots(plane[None]),
            min(REACH * self.diagonal, WIDEST * self.wavelength),
        )
        half = min(self.wavelength, reach)  # of a tile [m]
        spread = (
            torch.cat([part.places - about for part in self.receivers]).norm(dim=1).mean().item()
        )
        count = math.ceil(TILE / max(min(TILE / 5, TURN * self.wavelength / spread), TILE / 20)) + 1
        moves, turns = torch.linspace(-half, half, 19), torch.linspace(0, TILE, count)
        every = torch.cat((-turns.flip(0)[:-1], turns))
        axes = torch.stack(tangents(normal))
        starts = normal @ about + torch.linspace(-reach, reach, 2 * math.ceil(reach / half / 2) + 1)
        centres = torch.cat((normal.expand(len(starts), 3), starts[:, None]), 1)
        pivots, found = self.pivots(centres), []
        pairs = zip(self.receivers, waves, strict=True)
        parts = (part.likeness(*own, self.bandwidth, centres, pivots, axes) for part, own in pairs)
        heard, rates = (torch.cat(part, 1) for part in zip(*parts, strict=True))
        for pivot, wave, rate in zip(pivots, heard, rates, strict=True):
            tile = periodogram(wave, rate, moves, turns)
            best = tile.flatten().topk(2)
            for score, *at in zip(
                best.values.tolist(), *torch.unravel_index(best.indices, tile.shape), strict=True
            ):
                move, first, second = moves[at[0]], every[at[1]], every[at[2]]
                turned = functional.normalize(normal + first * axes[0] + second * axes[1], dim=0)
                found.append(Peak(score, torch.cat((turned, (turned @ pivot + move)[None])), pivot))
        found.sort(key=lambda peak: -peak.score)
        kept: list[Peak] = []
        for peak in found:
            if peak.score <= 0 or len(kept) == 6:
                break
            if all(peak.is_apart(other, self.wavelength) for other in kept):
                kept.append(peak)
        return kept

    def polish(self, found: Found) -> Float[Tensor, "w 4"]:
        """Descends on the error at every second link with all planes."""
        sequences = self.sequences(found.planes)
        loss = lambda planes: self.errors(planes, found.open, sequences, every=2).mean()
        return self.descend(loss, found.planes, [], 40, 3e-3)[0]


def is_sure(gains: Float[Tensor, " b"]) -> bool:
    """True if the mean gain of two links or more is ``SURE``."""
    return len(gains) > 1 and bool(gains.mean() > SURE * gains.std() / math.sqrt(len(gains)))


def reflection(
    normals: Float[Tensor, "*#n 3"], cosines: Float[Tensor, "*n"]
) -> Complex[Tensor, "*n"]:
    """Reflection coefficients of planes of ``MATERIAL``."""
    return polarised(normals, *fresnel(MATERIAL, cosines.clamp_min(1e-3)))
