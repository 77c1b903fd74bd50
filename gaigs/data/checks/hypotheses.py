"""Possible conventions of data, and how well each explains the labels."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import evenly


@dataclass(frozen=True)
class Sample:
    """Links, evenly spread over the data, in a form that hypotheses change."""

    index: Int[Tensor, " n"]  # numbers of the links among all
    transmitters: Float[Tensor, "n 3"]  # positions of the links' transmitters [m]
    receivers: Int[Tensor, " n"]  # number of each link's receiver
    positions: Float[Tensor, "r 3"]  # positions of the receivers [m]
    rotations: Float[Tensor, "r 3 3"]  # the receivers' axes in the world frame, as columns
    # Offsets of each receiver's elements along its own axes [m].
    elements: tuple[Float[Tensor, "_ 3"], ...]
    frequencies: Float[Tensor, " s"]  # subcarriers of channels [Hz]; empty for other tasks
    labels: Tensor  # one a link, of the task's shape

    @property
    def local(self) -> Float[Tensor, "n 3"]:
        """Transmitters in the frame of their receiver [m]."""
        offsets = self.transmitters - self.positions[self.receivers]  # (n, 3)
        return torch.einsum("nw,nwa->na", offsets, self.rotations[self.receivers])

    def at(self, index: Int[Tensor, " k"]) -> "Sample":
        """The sample's links at these positions in the sample."""
        return replace(
            self,
            index=self.index[index],
            transmitters=self.transmitters[index],
            receivers=self.receivers[index],
            labels=self.labels[index],
        )

    def thinned(self, most: int) -> "Sample":
        """At most ``most`` of the links, evenly spread."""
        return self.at(evenly(torch.arange(len(self.labels)), most))


class Hypothesis(NamedTuple):
    """A possible convention of the data."""

    name: str
    change: Callable[[Sample], Sample]  # gives the sample as read by the convention
    mend: str  # line of numpy that corrects the data


def sample_of(links: Any, most: int) -> Sample:
    """At most ``most`` links, evenly spread over all but test links, in double precision."""
    known = torch.arange(len(links)) if links.split is None else links.split.known.sort().values
    return sample_at(links, evenly(known, most))


def sample_at(links: Any, index: Int[Tensor, " n"]) -> Sample:
    """The links with these numbers as a sample, in double precision."""
    poses = [receiver.pose for receiver in links.receivers]
    labels = links.labels[index]
    return Sample(
        index=index,
        transmitters=links.query.transmitters[index].double(),
        receivers=links.query.receivers[index],
        positions=torch.stack([pose.position for pose in poses]).double(),
        rotations=torch.stack([pose.rotation for pose in poses]).double(),
        elements=tuple(receiver.array.elements.double() for receiver in links.receivers),
        frequencies=(
            torch.zeros(0) if links.task.frequencies is None else links.task.frequencies
        ).double(),
        labels=labels.to(torch.complex128 if labels.is_complex() else torch.float64),
    )
