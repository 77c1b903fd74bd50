"""The checks of placements and poolings find faults."""

import pytest
import torch
from contracts.faults import broken, fed, field, having
from torch import nn

from gaigs.splatting.gaussians import Placed
from gaigs.splatting.placement import Placement
from gaigs.splatting.pooling import Pooling, sphere
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.splatting.pooling.spectrum import SpectrumPooling
from gaigs.testing import check_placement, check_pooling, example_links

LINKS = {task: example_links(task) for task in ("spectrum", "rssi", "csi")}
SCENE = LINKS["rssi"].scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


# --- placements ---


class Halfway(Placement):
    """Between the Gaussian and each transmitter, along a path of known length."""

    def forward(self, gaussians, query):
        means = (gaussians.means + query.transmitters[:, None]) / 2
        return Placed(means, 2 * (means - query.transmitters[:, None]).norm(dim=-1))


class Mirror(Placement):
    """A Gaussian of its own at the image of each transmitter in the floor, before any free ones."""

    has_own = True
    keeps_free = True

    def __init__(self):
        super().__init__()
        self.log_loss = nn.Parameter(torch.zeros(()))

    def forward(self, gaussians, query):
        b, count = len(query), 0 if gaussians is None or not self.keeps_free else len(gaussians)
        images = query.transmitters[:, None] * query.transmitters.new_tensor([1, 1, -1])
        ones, own = images.new_ones(b, 1 + count), images.new_ones(1)
        free = gaussians if count else None

        def beside(mine, theirs, axis):
            return mine if free is None else torch.cat((mine, theirs()), axis)

        return Placed(
            means=beside(images, lambda: free.means.expand(b, -1, -1), 1),
            lengths=beside(images.norm(dim=-1), lambda: ones[:, 1:], 1),
            quats=beside(images.new_tensor([[1.0, 0, 0, 0]]), lambda: free.unit_quats, 0),
            scales=beside(images.new_ones(b, 1, 3), lambda: free.scales.expand(b, -1, -1), 1),
            opacities=beside(own, lambda: free.opacities, 0),
            signal=beside(images.new_tensor([[[1.0], [0.0]]]), lambda: free.signal, 0),
            gains=torch.complex(self.log_loss.exp() * ones, ones),
            coherences=images.new_ones(1 + count) / 2,
            bandwidth=own[0] * 1e8,
        )


def shifted(placed, _, query):
    return placed._replace(means=placed.means + 0.1 * len(query))


def weighted_by_receiver(placed, _, query):
    return placed._replace(gains=placed.gains * (1 + query.receivers[:, None]))


@pytest.mark.parametrize(
    ("placement", "message"),
    [
        (
            broken(Halfway, lambda placed, *_: placed.means),
            "a placement must give a Placed, got Tensor",
        ),
        (
            broken(Halfway, field("means", lambda part: part[0])),
            r"means must be of shape \(3, 40, 3\), got \(40, 3\)",
        ),
        (broken(Halfway, shifted), "means must not depend on the other queries"),
        (broken(Halfway, field("lengths", lambda part: -part)), r"lengths must lie in \[0, inf\]"),
        (
            broken(Halfway, field("lengths", lambda part: (0 * part).sqrt())),
            "the gradient of transmitters must be fin",
        ),
        (having(Mirror, keeps_free=False), "the free Gaussians, 40, must be among .*, got 1"),
        (having(Mirror, parameter_groups=lambda self: {}), "must be in one of parameter_groups"),
        (
            broken(Mirror, field("signal", lambda part: None)),
            "must be given together, and signal is missing",
        ),
        (broken(Mirror, field("quats", lambda part: 2 * part)), "quats must be of length 1"),
        (broken(Mirror, field("scales", lambda part: 0 * part)), "scales must be positive"),
        (
            broken(Mirror, field("opacities", lambda part: 2 * part)),
            r"opacities must lie in \[0, 1\]",
        ),
        (
            broken(Mirror, field("gains", lambda part: part.real)),
            "gains must be torch.complex64, got .*; convert it by .to",
        ),
        (
            broken(Mirror, weighted_by_receiver),
            "gains must not depend on the receiver unless sees_receivers",
        ),
        (
            broken(Mirror, field("bandwidth", lambda part: part.expand(41))),
            r"bandwidth must be of shape \(\), got",
        ),
    ],
)
def test_a_faulty_placement_is_found(placement, message):
    with pytest.raises(AssertionError, match=message):
        check_placement(placement(), SCENE)


@pytest.mark.parametrize("kind", [Halfway, Mirror])
def test_sound_placements_keep_the_contract(kind):
    check_placement(kind(), SCENE)


# --- poolings ---


class Power(Pooling):
    """Mean power of a map in dB, over a floor."""

    floor = 1e-2

    def __init__(self, scene):
        super().__init__()
        self.scene, self.grid = scene, sphere("pooling.grid", [4, 8])

    def forward(self, image, query, directions=None):
        image = image.to(torch.promote_types(image.dtype, torch.float32))
        return 10 * (image.square().sum(1).mean((1, 2)) + self.floor).log10()


class Beamed(Power):
    """The power of a map of its own, spread over the directions of a spectrum."""

    def forward(self, image, query, directions=None):
        level = image.square().mean((1, 2, 3))
        heights = (directions or self.scene.task.directions).vectors()[..., 2].to(level)
        return level.reshape(-1, *[1] * heights.ndim) * heights


class OfMap(SpectrumPooling):
    def __init__(self, scene):
        super().__init__(2)


def windowed(value, image, query):
    return value * torch.linspace(1, 2, image.shape[2]).to(image)[:, None]


def clamped(value, image, query):
    return 20 * image.to(value.dtype).square().sum(1).mean((1, 2)).sqrt().clamp(min=1e-3).log10()


def narrow(value, image, query):
    return 10 * (image.square().sum(1).mean((1, 2)) + 1e-2).log10().to(value.dtype)


@pytest.mark.parametrize(
    ("pooling", "task", "message"),
    [
        (
            broken(OfMap, lambda value, image, _: image.square().sum(1).sqrt()),
            "spectrum",
            "of silent maps must be fin",
        ),
        (
            broken(OfMap, lambda v, image, _: v / image.abs().max()),
            "spectrum",
            "must not depend on the other maps",
        ),
        (
            broken(OfMap, lambda v, *_: v.flatten(1)),
            "spectrum",
            r"the value must be of shape \(3, 18, 36\), got",
        ),
        (
            broken(OfMap, windowed),
            "spectrum",
            "a list of rays must have the values of their pixels",
        ),
        (having(OfMap, zone=(1.0, -1.0)), "spectrum", "zone must be two elevations"),
        (OfMap, "rssi", "labels of task 'rssi' need a pooling with a grid"),
        (having(Power, floor=0.0), "rssi", "the value of silence must be finite"),
        (broken(Power, clamped), "rssi", "the gradient of silent maps must be finite"),
        (broken(Power, narrow), "rssi", "the value of 12 decades in float16 must be finite"),
        (
            broken(Power, lambda v, image, _: v.to(image.dtype)),
            "rssi",
            "a silent map in float16 must be torch.float32",
        ),
        (
            having(Power, fit=lambda self, links: setattr(self, "floor", 2.0)),
            "rssi",
            "state dict must restore it",
        ),
        (Power, "csi", r"the value must be of shape \(3, 4, 5\), got \(3,\)"),
        (
            fed(PathRssi, lambda heard, *_: (heard / heard.abs().max(), *_), "read"),
            "rssi",
            "depend on the other paths",
        ),
        (
            broken(PathRssi, lambda v, *_: v[:, None], "read"),
            "rssi",
            r"the value must be of shape \(3,\), got \(3, 1\)",
        ),
        (having(PathRssi, channels=1), "rssi", "paths have 2 channels, got channels 1"),
        (
            broken(Beamed, lambda v, *_: v[:, None] if v.ndim == 2 else v),
            "spectrum",
            "fewer directions must get",
        ),
    ],
)
def test_a_faulty_pooling_is_found(pooling, task, message):
    with pytest.raises(AssertionError, match=message):
        check_pooling(pooling, LINKS[task])


@pytest.mark.parametrize(("pooling", "task"), [(Beamed, "spectrum"), (Power, "rssi")])
def test_sound_poolings_keep_the_contract(pooling, task):
    check_pooling(pooling, LINKS[task])
