"""The check of placements finds what is broken."""

from typing import ClassVar

import pytest
import torch
from torch import nn

from gaigs.placement import Placed, Placement
from gaigs.testing import check_placement, example_links

SCENE = example_links("rssi").scene


class Halfway(Placement):
    """Between the Gaussian and each transmitter, along a path of known length."""

    def forward(self, gaussians, query):
        means = (gaussians.means + query.transmitters[:, None]) / 2
        return Placed(means, 2 * (means - query.transmitters[:, None]).norm(dim=-1))


class Bare(Halfway):
    def forward(self, gaussians, query):
        return super().forward(gaussians, query).means


class Shared(Halfway):
    def forward(self, gaussians, query):
        return super().forward(gaussians, query)._replace(means=gaussians.means)


class Crowded(Halfway):
    def forward(self, gaussians, query):
        placed = super().forward(gaussians, query)
        return placed._replace(means=placed.means + 0.1 * len(query))


class Backwards(Halfway):
    def forward(self, gaussians, query):
        placed = super().forward(gaussians, query)
        return placed._replace(lengths=-placed.lengths)


class Kinked(Halfway):
    def forward(self, gaussians, query):
        placed = super().forward(gaussians, query)
        return placed._replace(lengths=(0 * placed.lengths).sqrt())


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (Bare, "a placement must give a Placed, got Tensor"),
        (Shared, r"means must be \(1 or 3, 40, 3\), got \(40, 3\)"),
        (Crowded, "means must not depend on the other queries"),
        (Backwards, "lengths must not be negative"),
        (Kinked, r"the gradient of gaussians\.means must be finite"),
    ],
)
def test_a_broken_placement_is_found(placement, message):
    check_placement(Halfway(), SCENE)
    with pytest.raises(AssertionError, match=message):
        check_placement(placement(), SCENE)


class Mirror(Placement):
    """A Gaussian of its own at the image of each transmitter in the floor, before the free ones, if there are any."""

    has_own = True
    changes: ClassVar[dict] = {}

    def __init__(self):
        super().__init__()
        self.log_loss = nn.Parameter(torch.zeros(()))

    def forward(self, gaussians, query):
        b = len(query)
        means = query.transmitters[:, None] * query.transmitters.new_tensor([1, 1, -1])
        ones = means.new_ones(1)
        placed = Placed(
            means=means,
            lengths=means.norm(dim=-1),
            quats=means.new_tensor([[1.0, 0, 0, 0]]),
            scales=means.new_ones(b, 1, 3),
            opacities=ones,
            signal=means.new_tensor([[[1.0], [0.0]]]),
            gains=torch.complex(*(self.log_loss.exp() * means.new_ones(2, b, 1))),
            coherences=ones / 2,
            bandwidth=ones[0] * 1e8,
        )
        if gaussians is not None:
            placed = self.beside(placed, gaussians)
        return placed._replace(**{name: change(placed, query) for name, change in self.changes.items()})

    def beside(self, placed, gaussians):
        b, free = len(placed.means), len(gaussians)
        ones = placed.means.new_ones(b, free)
        return Placed(
            means=torch.cat((placed.means, gaussians.means.expand(b, -1, -1)), 1),
            lengths=torch.cat((placed.lengths, ones), 1),
            quats=torch.cat((placed.quats, gaussians.unit_quats)),
            scales=torch.cat((placed.scales, gaussians.scales.expand(b, -1, -1)), 1),
            opacities=torch.cat((placed.opacities, gaussians.opacities)),
            signal=torch.cat((placed.signal, gaussians.signal)),
            gains=torch.cat((placed.gains, torch.complex(ones, ones)), 1),
            coherences=torch.cat((placed.coherences, ones[0] if b else placed.means.new_ones(free))),
            bandwidth=placed.bandwidth,
        )


class Alone(Mirror):
    """Forgets the free ones."""

    def beside(self, placed, gaussians):
        return placed


class Ungrouped(Mirror):
    def parameter_groups(self):
        return {}


def changed(field, change):
    return type("Changed", (Mirror,), {"changes": {field: change}})


def heard_by(placed, query):
    return placed.gains * (1 + query.receivers[:, None])


def of_all(placed, query):
    return placed.coherences / (1 + len(query))


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (Alone, "the free Gaussians, 40, must be among those that are placed, got 1"),
        (Ungrouped, "each parameter must stand in one of parameter_groups"),
        (changed("signal", lambda placed, query: None), "must be given together, and signal is missing"),
        (changed("quats", lambda placed, query: 2 * placed.quats), "quats must be of length 1"),
        (changed("scales", lambda placed, query: 0 * placed.scales), "scales must be positive"),
        (changed("opacities", lambda placed, query: 2 * placed.opacities), r"opacities must lie in \[0, 1\]"),
        (changed("gains", lambda placed, query: placed.gains.real), "gains must be torch.complex64 as its input"),
        (changed("gains", heard_by), "gains must not depend on the receiver unless sees_receivers says so"),
        (changed("coherences", of_all), "coherences must not depend on the other queries"),
        (changed("coherences", lambda placed, query: -placed.coherences), r"coherences must lie in \[0, 1\]"),
        (
            changed("bandwidth", lambda placed, query: placed.coherences),
            r"bandwidth must be of shape \(\), got \(41,\)",
        ),
        (changed("bandwidth", lambda placed, query: -placed.bandwidth), "bandwidth must not be negative"),
    ],
)
def test_a_broken_placement_with_gaussians_of_its_own_is_found(placement, message):
    check_placement(Mirror(), SCENE)
    with pytest.raises(AssertionError, match=message):
        check_placement(placement(), SCENE)
