"""Search for planes in spectra: interference in the covariances of the array's elements locates them."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor, nn
from torch.nn import functional

from gaigs.antenna import Array
from gaigs.data import Links
from gaigs.geometry import Pose
from gaigs.placement.mirrored.reflections import (
    all_sequences,
    fold,
    images,
    polarised,
    reflect,
    reflection_points,
    square_normals,
    tangents,
)
from gaigs.propagation import NEAREST, fresnel
from gaigs.query import Query

MATERIAL = complex(4.0, -0.3)
"""Relative permittivity of all planes: between wood and concrete."""

FLOOR = 0.01
"""Share of a link's squared covariances below which an error hardly counts."""

SURE = 2.0
"""Least fall of the mean log error by which a plane moves [standard errors]."""

FAINT = 1e-3
"""Share of the power below which paths of several reflections are left out."""

STRANGE = 0.01
"""Share of a spectrum that its array cannot explain, from which on the search is left out. Measured spectra have 0.001,
powers in place of amplitudes 0.05."""

TILE = 0.025
"""Half the width of a tile of the periodogram [rad]: over some metres, lengths are linear within it."""

TURN = 0.16
"""Step of a turn in the periodogram [wavelengths over the places' mean distance from the pivot]: about 2 rad."""


@dataclass(frozen=True)
class ReceiverLags:
    """Covariances of one receiver's elements at some training links.

    Attributes:
        places: Transmitters (b, 3) [m].
        lags: At each of ``array.lags``, over the power (b, l).
        frequencies: Of the carriers (b,) [Hz].
        pose, array: Of the receiver.
    """

    places: Float[Tensor, "b 3"]
    lags: Complex[Tensor, "b l"]
    frequencies: Float[Tensor, " b"]
    pose: Pose
    array: Array

    def some(self, index: object) -> "ReceiverLags":
        """The same of some links."""
        parts = {name: getattr(self, name)[index] for name in ("places", "lags", "frequencies")}
        return replace(self, **parts)

    @property
    def wavenumbers(self) -> Float[Tensor, " b"]:
        """[rad/m]."""
        return 2 * math.pi / speed_of_light * self.frequencies

    def steering(self, ways: Float[Tensor, "b n 3"]) -> Complex[Tensor, "b n e"]:
        """Phases at the elements of waves from directions in the array's frame."""
        turns = ways[..., :2] @ self.array.elements.to(ways)[:, :2].T * self.wavenumbers[:, None, None]
        return torch.polar(torch.ones_like(turns), turns)

    def seen(self, points: Float[Tensor, "b n 3"]) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n"]]:
        """Directions to points in the array's frame, and distances [m]."""
        ways = self.pose.local(points)
        lengths = ways.norm(dim=-1).clamp_min(NEAREST)
        return ways / lengths[..., None], lengths

    def paths(self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]) -> tuple[Tensor, Tensor, Tensor]:
        """Fields (b, n), steering (b, n, e) and lengths (b, n) [m] of all paths."""
        normals, offsets = planes[:, :3], planes[:, 3]
        points = images(self.places, sequences, normals, offsets)
        folded = fold(points, self.pose.position.expand(len(self.places), 3), sequences, normals, offsets)
        ways, lengths = self.seen(points[-1])
        gains = folded.exists * self.array.gain(ways) / lengths
        gains = folded.reflected(
            gains.to(torch.complex128), lambda bounce: reflection(normals[bounce.planes], bounce.cosines)
        )
        phases = -self.wavenumbers[:, None] * lengths
        return gains * torch.polar(torch.ones_like(phases), phases), self.steering(ways), lengths

    def sums(self, fields: Tensor, steering: Tensor, lengths: Tensor, bandwidth: float) -> Complex[Tensor, "b l"]:
        """Covariances of interfering paths, as of ``LagPooling``."""
        if bandwidth:
            likeness = torch.sinc(bandwidth / speed_of_light * (lengths[:, :, None] - lengths[:, None]))
            together = fields[:, :, None] * fields[:, None].conj() * likeness
            covariances = steering.mT @ together @ steering.conj()
        else:
            waves = (fields[:, None] @ steering).mT
            covariances = waves @ waves.mH
        _, pairs, counts = self.array.lags
        flat = covariances.flatten(1)
        return flat.new_zeros(len(flat), len(counts)).index_add(1, pairs, flat) / counts

    def doubts(self, name: str) -> list[str]:
        """A sentence if the direct path shows in another direction than geometry says."""
        _, pairs, _ = self.array.lags
        matrices = self.lags[:, pairs].view(-1, len(self.array), len(self.array))
        ways = self.seen(self.places[:, None])[0]
        shares = {}
        for turn, flip in itertools.product(range(4), (1, -1)):
            turned = torch.view_as_real(torch.view_as_complex(ways[..., :2].contiguous()) * 1j**turn)
            turned = torch.cat((turned[..., :1], flip * turned[..., 1:], ways[..., 2:]), -1)
            steering = self.steering(turned)[:, 0]
            share = torch.einsum("bi,bij,bj->b", steering.conj(), matrices, steering).real / len(self.array) ** 2
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

    def left(self, model: Complex[Tensor, "b l"]) -> tuple[Complex[Tensor, "b l"], Float[Tensor, " b"]]:
        """What a model of the covariances leaves, with the best scale of each link, and the model's square."""
        counts = self.array.lags[2]
        square = (counts * model.abs().square()).sum(1).clamp_min(1e-30)
        scales = ((counts * (model.conj() * self.lags).real).sum(1) / square).clamp_min(1e-12 / square.sqrt())
        return self.lags / scales[:, None] - model, square

    def one_more(self, paths: tuple[Tensor, Tensor, Tensor], bandwidth: float) -> tuple[Tensor, Tensor]:
        """The wave of one more path beside known ones: its interference with each (b, n, e), and their lengths.

        Without a bandwidth it is the same for a path of any length: one sum (b, 1, e).
        """
        fields, steering, lengths = paths
        rest, square = self.left(self.sums(fields, steering, lengths, bandwidth))
        matrices = rest[:, self.array.lags[1]].view(-1, len(self.array), len(self.array))
        waves = (matrices @ steering.mT).mT * fields[..., None] / square[:, None, None]
        return (waves, lengths) if bandwidth else (waves.sum(1, keepdim=True), lengths[:, :1])

    def periodogram(
        self,
        waves: Complex[Tensor, "b n e"],
        lengths: Float[Tensor, "b n"],
        bandwidth: float,
        plane: Float[Tensor, "4"],
        pivot: Float[Tensor, "3"],
        axes: Float[Tensor, "2 3"],
        moves: Float[Tensor, " m"],
        turns: Float[Tensor, " t"],
    ) -> Float[Tensor, "m t t"]:
        """Likeness of the reflection at planes about one to the waves of one more path.

        Planes are moved by ``moves`` [m] and turned about the pivot [m] towards two axes by ``turns`` [rad].
        """
        normal, offset = plane[:3], plane[3]
        here, there = self.pose.position @ normal - offset, self.places @ normal - offset
        points = reflect(self.places, normal, offset)
        ways, own = (part[:, 0] for part in self.seen(points[:, None]))
        units = functional.normalize(points - self.pose.position, dim=1)
        cosines = units @ normal
        near = torch.minimum(here.abs(), there.abs()) < moves[-1]  # planes of the tile are on either side
        gains = self.array.gain(ways) / own * ((here * there > 0) | near) * reflection(normal, cosines.abs())
        likeness = torch.sinc(bandwidth / speed_of_light * (lengths - own[:, None]))
        left = (waves * likeness[..., None]).sum(1)
        heard = (self.steering(ways[:, None])[:, 0].conj() * left).sum(1) * gains.conj()
        heard = heard * torch.polar(torch.ones_like(own), self.wavenumbers * own)
        sizes = heard.abs()
        loud = sizes[sizes > 0]
        heard = heard / (sizes + loud.median()) if len(loud) else heard  # so that no link rules
        aside = self.places - pivot
        slopes = [2 * cosines] + [-2 * (aside @ axis) * cosines - 2 * there * (units @ axis) for axis in axes]
        phases = [
            self.wavenumbers[:, None] * slope[:, None] * steps
            for slope, steps in zip(slopes, (moves, turns, turns), strict=True)
        ]
        first, second, third = (torch.polar(torch.ones_like(phase), phase) for phase in phases)
        both = ((heard[:, None] * first)[:, :, None] * second[:, None]).flatten(1)
        return (both.T @ third).real.view(len(moves), len(turns), len(turns))


class LagSearch(nn.Module):
    """Moves planes to where reflections explain the interference that spectra show.

    A spectrum gives back the covariances of the array's elements (``Beamformer.lags``). Their largest part is the
    direct path. Another path shows in its interference with those that are known: the residual covariances times their
    fields are that path's wave, with a phase that follows from its length. So the sum of these waves over all links, a
    periodogram over offset and two tilts, proposes planes. Lengths are linear within a tile of it. The error of the
    covariances decides between proposals, after a descent on it. The strongest plane comes first.

    It is a module, as a part of its model whose calls ``gaigs.training.revision`` times: each error is one call.

    Args:
        links: Their training links count; of the task ``spectrum``.
        frequencies: Carrier of each link [Hz].
        covariances: Function from labels and their query to lags, each label's up to a scale, and the share of each
            label that they do not explain.
        order: Largest number of reflections of a path; more than 2 count as 2, as longer paths hardly locate a plane.
        most: Links that count, of all receivers together; of each at least 20.

    Source: ours; Van Trees, Optimum Array Processing, 2002, section 2.4, for the covariances.
    """

    def __init__(
        self,
        links: Links,
        frequencies: Float[Tensor, " n"],
        covariances: Callable[[Tensor, Query], tuple[Tensor, Tensor]],
        order: int,
        most: int = 300,
    ):
        super().__init__()
        self.order, self.receivers, self.doubts = min(order, 2), [], []
        self.wavelength = speed_of_light / frequencies.max().item()
        train, query = links.split.train, links.query
        numbers = query.receivers[train].unique().tolist()
        for number in numbers:
            own = train[query.receivers[train] == number]
            own = own[torch.linspace(0, len(own) - 1, min(len(own), max(20, most // len(numbers)))).round().long()]
            lags, left = covariances(links.labels[own], query[own])
            powers = lags[:, lags.shape[1] // 2].real
            heard, receiver = powers > 0, links.receivers[number]
            pose = receiver.pose.to(torch.zeros((), dtype=torch.float64))
            everything = ReceiverLags(
                query.transmitters[own].double(),
                lags / powers[:, None],
                frequencies[own].double(),
                pose,
                receiver.array,
            )
            if left.median() > STRANGE:
                self.doubts.append(
                    f"the array of {receiver.name} does not explain {left.median():.0%} of its spectra\n"
                    "check frequency, elements and directions, and that labels are amplitudes, not powers or dB"
                )
            elif heard.any():
                self.receivers.append(everything.some(heard))
                self.doubts += self.receivers[-1].doubts(receiver.name)
        count = sum(len(receiver.places) for receiver in self.receivers)
        self.few = [receiver.some(slice(None, None, max(1, round(count / 100)))) for receiver in self.receivers]

    @torch.no_grad()
    def run(self, planes: Float[Tensor, "w 4"], bandwidth: float, reach: float) -> Float[Tensor, "w 4"]:
        """The planes, each searched twice: up to ``reach`` [m] on either side of where it is, and 4 degrees.

        Towards normals that are square to others it may turn by 18 degrees. ``bandwidth`` is that over which powers are
        averaged [Hz].
        """
        planes, self.bandwidth = planes.double(), bandwidth
        if not len(planes) or not self.receivers:
            return planes
        for _ in range(2):
            for k in self.by_strength(planes):
                planes = self.moved(planes, k, reach)
            everything = torch.ones(len(planes), dtype=torch.bool)
            polished = self.polish(planes, everything, 40, 3e-3)
            gains = self(planes, self.receivers) - self(polished, self.receivers)
            planes = polished if is_sure(gains) else planes
        return planes

    def sequences(self, planes: Float[Tensor, "w 4"]) -> Int[Tensor, "n order"]:
        """All sequences but those of several reflections that are faint."""
        sequences = all_sequences(len(planes), self.order)
        powers = self.powers(planes, sequences)
        return sequences[((sequences >= 0).sum(1) <= 1) | (powers > FAINT * powers.sum())]

    def by_strength(self, planes: Float[Tensor, "w 4"]) -> list[int]:
        """Numbers of the planes, strongest single reflection first."""
        return self.powers(planes, all_sequences(len(planes), 1)[1:]).argsort(descending=True).tolist()

    def powers(self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]) -> Float[Tensor, " n"]:
        return torch.cat([part.paths(planes, sequences)[0].abs().square() for part in self.few]).mean(0)

    def forward(
        self, planes: Float[Tensor, "w 4"], receivers: list[ReceiverLags], sequences: Tensor | None = None
    ) -> Float[Tensor, " b"]:
        """Log of the share of each link's squared covariances that paths do not explain: none must rule."""
        sequences = self.sequences(planes) if sequences is None else sequences
        logs = []
        for receiver in receivers:
            rest, square = receiver.left(receiver.sums(*receiver.paths(planes, sequences), self.bandwidth))
            error = (receiver.array.lags[2] * rest.abs().square()).sum(1)
            logs.append((error / (error + square) + FLOOR).log())
        return torch.cat(logs)

    def moved(self, planes: Float[Tensor, "w 4"], k: int, reach: float) -> Float[Tensor, "w 4"]:
        """The planes with plane k where the error is least: near its own normal, or square to another plane."""
        trials, (pivot,) = [planes], self.pivots(planes[k, None])
        for number, normal in enumerate(square_normals(planes[:, :3], k)):
            offset = float(planes[k, 3] + (normal - planes[k, :3]) @ pivot)
            for plane in self.proposals(planes, k, normal, offset, reach, 0 if number else 1):
                trials.append(torch.cat((planes[:k], plane[None], planes[k + 1 :])))
        sequences = self.sequences(planes)

        def rated(tried: Float[Tensor, "w 4"]) -> tuple[float, Tensor, Tensor]:
            errors = self(tried, self.receivers, sequences)
            return errors.mean().item(), tried, errors

        rates = [rated(tried) for tried in trials]
        _, best, _ = min(rates, key=lambda rate: rate[0])
        rates.append(rated(self.polish(best, torch.arange(len(planes)) == k, 10, 4e-3)))
        _, best, errors = min(rates, key=lambda rate: rate[0])
        return best if is_sure(rates[0][2] - errors) else planes

    def pivots(self, planes: Float[Tensor, "w 4"]) -> Float[Tensor, "w 3"]:
        """Mean point at which each plane reflects [m]: turned about it, a plane changes the lengths least."""
        ends = [(part.places, part.pose.position.expand_as(part.places)) for part in self.few]
        return torch.cat([reflection_points(*pair, planes) for pair in ends]).mean(0)

    def proposals(
        self, planes: Float[Tensor, "w 4"], k: int, normal: Float[Tensor, "3"], offset: float, reach: float, tilts: int
    ) -> list[Float[Tensor, "4"]]:
        """Planes in place of plane k, near a normal and an offset [m]: at most eight maxima of the periodogram.

        ``tilts`` is the number of tiles on either side of the normal, in both directions.
        """
        sequences = self.sequences(planes)
        sequences = sequences[(sequences != k).all(1)]
        half = min(self.wavelength, reach)  # of a tile [m]
        (about,) = self.pivots(torch.cat((normal, normal.new_tensor([offset])))[None])
        spread = torch.cat([part.places - about for part in self.few]).norm(dim=1).mean().item()
        turns = 2 * math.ceil(TILE / min(TILE / 5, TURN * self.wavelength / spread)) + 1
        steps = torch.linspace(-half, half, 19).double(), torch.linspace(-TILE, TILE, turns).double()
        starts = torch.linspace(-reach, reach, 2 * math.ceil(reach / half / 2) + 1).double()
        centres = 2 * TILE * torch.arange(-tilts, tilts + 1).double()
        axes = torch.stack(tangents(normal))
        waves = [receiver.one_more(receiver.paths(planes, sequences), self.bandwidth) for receiver in self.receivers]
        found = []
        for a, b, start in itertools.product(centres, centres, starts):
            centre = functional.normalize(normal + a * axes[0] + b * axes[1], dim=0)
            plane = torch.cat((centre, (centre @ about + start)[None]))
            (pivot,) = self.pivots(plane[None])
            own = axes - (axes @ centre)[:, None] * centre
            tile = sum(
                receiver.periodogram(*parts, self.bandwidth, plane, pivot, own, *steps)
                for receiver, parts in zip(self.receivers, waves, strict=True)
            )
            best = tile.flatten().topk(2)
            for score, *at in zip(best.values.tolist(), *torch.unravel_index(best.indices, tile.shape), strict=True):
                move, first, second = steps[0][at[0]], steps[1][at[1]], steps[1][at[2]]
                turned = functional.normalize(centre + first * own[0] + second * own[1], dim=0)
                found.append((score, torch.cat((turned, (turned @ pivot + move)[None])), pivot))
        found.sort(key=lambda trial: -trial[0])
        kept: list[Tensor] = []
        for score, plane, pivot in found:
            if score <= 0 or len(kept) == 8:
                break
            apart = [plane - other for other in kept]
            if all(
                gap[:3].norm() > TILE / 4 or (gap[3] - gap[:3] @ pivot).abs() > self.wavelength / 4 for gap in apart
            ):
                kept.append(plane)
        return kept

    @torch.enable_grad()
    def polish(
        self, planes: Float[Tensor, "w 4"], moves: Bool[Tensor, " w"], steps: int, rate: float
    ) -> Float[Tensor, "w 4"]:
        """Descends on the error with some planes, which turn about their pivots."""
        pivots, sequences = self.pivots(planes), self.sequences(planes)
        heights = planes[:, 3] - (planes[:, :3] * pivots).sum(1)
        axes = torch.stack([torch.stack(tangents(normal)) for normal in planes[:, :3]])
        shifts = torch.zeros(len(planes), 3, dtype=torch.float64, requires_grad=True)

        def now() -> Float[Tensor, "w 4"]:
            some = shifts * moves[:, None]
            # Lengths change by about twice a shift [m], and by some metres times a turn [rad].
            normals = functional.normalize(planes[:, :3] + 0.4 * (some[:, 1:, None] * axes).sum(1), dim=1)
            return torch.cat((normals, ((normals * pivots).sum(1) + heights + some[:, 0])[:, None]), 1)

        optimizer = torch.optim.Adam([shifts])
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = rate * 0.05 ** (step / steps)
            optimizer.zero_grad()
            self(now(), self.few, sequences).mean().backward()
            optimizer.step()
        return now().detach()


def is_sure(gains: Float[Tensor, " b"]) -> bool:
    """True if the mean gain of two links or more is ``SURE``."""
    return len(gains) > 1 and bool(gains.mean() > SURE * gains.std() / math.sqrt(len(gains)))


def reflection(normals: Float[Tensor, "*#n 3"], cosines: Float[Tensor, "*n"]) -> Complex[Tensor, "*n"]:
    """Reflection coefficients of planes of ``MATERIAL``."""
    return polarised(normals, *fresnel(MATERIAL, cosines.clamp_min(1e-3)))
