"""Search for planes in spectra: measured links of each receiver, the bandwidth, and the planes."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query, evenly
from gaigs.data import Links
from gaigs.planes.frame import RoomFrame
from gaigs.planes.lag_score import LagOptions, LagRoom, LagScore, LinkPaths
from gaigs.planes.lags import ReceiverLags
from gaigs.planes.search import PlaneSearch
from gaigs.splatting.gaussians import fibonacci_lattice


class LinkGroup(NamedTuple):
    """Training links of one receiver at one carrier."""

    rows: Int[Tensor, " b"]
    carrier: float  # [Hz]
    pose: Pose  # of the receiver, from the middle of the room
    receiver: Receiver


def frame_of(links: Links) -> RoomFrame:
    """The frame of the training transmitters and their receivers."""
    train = links.split.train
    transmitters = links.query.transmitters
    used = links.query.receivers[train].unique()
    receivers = links.scene.positions(like=transmitters)[used]
    return RoomFrame(torch.cat((transmitters[train], receivers)))


def group_links(
    links: Links, frequencies: Float[Tensor, " n"], frame: RoomFrame, most: int, pairs: int
) -> list[LinkGroup]:
    """Training links in groups by receiver and carrier.

    Groups, and links in them, are evenly thinned to the numbers allowed.

    Args:
        links: Links, of which the training links are used.
        frequencies: Carrier of each link [Hz].
        frame: Frame of the poses.
        most: Approximate number of links in total; each group has at least 20, or all of its links.
        pairs: Largest number of groups.
    """
    train = links.split.train
    numbers = links.query.receivers[train]
    carriers = frequencies[train]
    existing = torch.stack((numbers.double(), carriers.double()), 1).unique(dim=0)  # (pairs, 2)
    chosen = existing[evenly(torch.arange(len(existing)), pairs)].tolist()
    size = max(20, most // len(chosen))
    groups = []
    for number, carrier in chosen:
        receiver = links.receivers[int(number)]
        rows = train[(numbers == number) & (carriers == carrier)]
        pose = replace(receiver.pose, position=receiver.pose.position - frame.middle)
        groups.append(LinkGroup(evenly(rows, size), carrier, pose.to(frame.points), receiver))
    return groups


class LagSearch:
    """Search for planes whose reflections explain spectra, with ``LagScore``.

    Args:
        links: Links of task ``spectrum``, of which the training links are used.
        frequencies: Carrier of each link [Hz].
        lags_of: Function from labels and their query to the covariances of each label at the
            array's lags, up to a factor, and to the fraction of each label that these do not
            explain.
        order: Largest number of reflections of a path; more than 2 count as 2.
        most: As for ``group_links``.
        options: Options of the search.

    Attributes:
        doubts: Sentences for the log, on signs of wrong geometry in the data.
        paths: Paths at the receivers whose spectra their arrays explain.

    Source: ours.
    """

    def __init__(
        self,
        links: Links,
        frequencies: Float[Tensor, " n"],
        lags_of: Callable[[Tensor, Query], tuple[Tensor, Tensor]],
        order: int,
        most: int = 150,
        options: LagOptions | None = None,
    ):
        self.options = options or LagOptions()
        self.frame = frame_of(links)
        self.wavelength = speed_of_light / frequencies.max().item()
        doubts: list[str] = []
        receivers: list[ReceiverLags] = []
        for group in group_links(links, frequencies, self.frame, most, self.options.pairs):
            lags, unexplained = lags_of(links.labels[group.rows], links.query[group.rows])
            powers = lags[:, lags.shape[1] // 2].real
            is_received = powers > 0
            if not is_received.any():
                continue
            if unexplained.median() > self.options.strange:
                doubts.append(
                    f"the array of {group.receiver.name} does not explain "
                    f"{unexplained.median():.0%} of its spectra\n"
                    "check frequency, elements and directions, "
                    "and that labels are amplitudes, not powers or dB"
                )
                continue
            places = links.query.transmitters[group.rows] - self.frame.middle
            lags = (lags / powers[:, None]).to(torch.complex64)
            receiver = ReceiverLags(
                places[is_received],
                lags[is_received],
                group.carrier,
                group.pose,
                group.receiver.array,
            )
            receivers.append(receiver)
            doubts += receiver.describe_doubts(group.receiver.name)
        self.doubts = list(dict.fromkeys(doubts))
        self.use(receivers, order)

    def use(self, receivers: list[ReceiverLags], order: int) -> None:
        """Sets the receivers of the search, and the largest number of reflections of a path."""
        self.paths = LinkPaths(self.frame, receivers, self.wavelength, order, self.options.faint)
        self.score = LagScore(self.paths, self.options)
        self.search = PlaneSearch(self.frame, self.score)

    @property
    def receivers(self) -> list[ReceiverLags]:
        return self.paths.receivers

    @property
    def bandwidth(self) -> float:
        """Band over which powers are averaged [Hz]; set by ``run``."""
        return self.paths.bandwidth

    @torch.no_grad()
    def run(
        self, planes: Float[Tensor, "w 4"], bandwidth: float | None, most: int
    ) -> Float[Tensor, "v 4"]:
        """Planes in the world frame: the given ones, moved, and then further ones.

        A plane moves twice, each time by up to 8 % of the diagonal and 18 degrees.

        Args:
            planes: Initial planes, in the world frame.
            bandwidth: Band over which powers are averaged [Hz]. None: see ``_choose_bandwidth``.
            most: Largest number of planes.
        """
        if not len(planes) or not self.receivers:
            return planes
        count = sum(len(receiver.places) for receiver in self.receivers)
        everywhere = torch.ones(count, len(planes) + 1).bool()
        start = LagRoom(self.frame.from_world(planes).float(), everywhere, torch.zeros(count))
        room = self._choose_bandwidth(start, list_bandwidths(bandwidth, self.frame, self.options))
        room = self.move_around(self.find_more(room, most))
        return self.frame.to_world(room.planes.double())

    def _choose_bandwidth(self, start: LagRoom, choices: list[float]) -> LagRoom:
        """Sets the bandwidth to the best of ``choices`` [Hz]; returns the room with planes moved.

        First the strongest plane alone is moved with each choice. The choice with the smallest
        error is then compared with the first choice, nearly a single carrier, after moves of all
        planes, since interference hardly shows while other planes are wrong.
        """
        best = choices[0]
        if len(choices) > 1:
            strongest = self.paths.sort_by_strength(start.planes)[0]
            trials = []
            for choice in choices:
                self.paths.bandwidth = choice
                moved = self.score.move(start, strongest)
                trials.append((self.score.error(moved), choice))
            _, best = min(trials)
        rooms = {}
        for choice in dict.fromkeys((best, choices[0])):
            self.paths.bandwidth = choice
            rooms[choice] = self.move_around(start)
        self.paths.bandwidth = min(rooms, key=lambda choice: self.score.error(rooms[choice]))
        return rooms[self.paths.bandwidth]

    def move_around(self, room: LagRoom) -> LagRoom:
        """The room after a move of each plane, the strongest first, and a descent of all planes."""
        numbers = self.paths.sort_by_strength(room.planes)
        room = self.search.sweep(room, numbers, "search of planes")
        return self.score.refine(room)

    def find_more(self, room: LagRoom, most: int) -> LagRoom:
        """The room after the addition of planes, one after the other, to at most ``most``."""
        normals = torch.cat((fibonacci_lattice(200, 0.0, math.pi / 2).float(), torch.eye(3)))
        grid = self.frame.grid(normals, 60, self.options.margin)
        return self.search.grow(room, most, lambda room: self.search.extend(room, grid))


def list_bandwidths(known: float | None, frame: RoomFrame, options: LagOptions) -> list[float]:
    """The known bandwidth, or bandwidths to try [Hz]."""
    if known is not None:
        return [known]
    return [rooms * speed_of_light / frame.diagonal for rooms in options.bands]
