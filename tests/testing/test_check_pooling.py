"""The check of poolings finds what is broken."""

import pytest
import torch

from gaigs.pooling import Pooling, sphere
from gaigs.pooling.path_rssi import PathRssi
from gaigs.pooling.spectrum import SpectrumPooling
from gaigs.testing import check_pooling, example_links

LINKS = {task: example_links(task) for task in ("spectrum", "rssi", "csi")}


class Root(SpectrumPooling):
    def forward(self, image, query):
        return image.square().sum(1).sqrt()


class Relative(SpectrumPooling):
    def forward(self, image, query):
        return super().forward(image, query) / image.abs().max()


class Flattened(SpectrumPooling):
    def forward(self, image, query):
        return super().forward(image, query).flatten(1)


class Windowed(SpectrumPooling):
    """Weighs the pixels of a grid by their row, and so those of a list alike."""

    def forward(self, image, query):
        return super().forward(image, query) * torch.linspace(1, 2, image.shape[2]).to(image)[:, None]


class Upended(SpectrumPooling):
    zone = (1.0, -1.0)


class Power(Pooling):
    """Mean power in dB, without a floor."""

    channels = 2

    def __init__(self):
        super().__init__()
        self.grid = sphere("pooling.grid", [4, 8])

    def level(self, image):
        return 10 * image.square().sum(1).mean((1, 2)).log10()

    def forward(self, image, query):
        return self.level(image.to(torch.promote_types(image.dtype, torch.float32)))


class Floored(Power):
    def level(self, image):
        return 10 * (image.square().sum(1).mean((1, 2)) + 1e-2).log10()


class Narrow(Floored):
    def forward(self, image, query):
        return self.level(image).to(torch.promote_types(image.dtype, torch.float32))


class Coarse(Floored):
    def forward(self, image, query):
        return super().forward(image, query).to(image.dtype)


class Clamped(Power):
    def level(self, image):
        return 20 * image.square().sum(1).mean((1, 2)).sqrt().clamp(min=1e-3).log10()


class Forgetful(Floored):
    """Fits a level that its state dict does not hold."""

    loudest = 0.0

    def fit(self, links):
        self.loudest = links.labels.max().item()

    def level(self, image):
        return super().level(image) + self.loudest


@pytest.mark.parametrize(
    ("build", "task", "message"),
    [
        (lambda scene: Root(2), "spectrum", "the gradient of a silent map must be finite"),
        (lambda scene: Relative(2), "spectrum", "a value must not depend on the other maps"),
        (lambda scene: Flattened(2), "spectrum", r"the value must be of shape \(3, 18, 36\), got \(3, 648\)"),
        (lambda scene: Windowed(2), "spectrum", "a list of rays must have the values of their pixels"),
        (lambda scene: Upended(2), "spectrum", "zone must be two elevations"),
        (
            lambda scene: SpectrumPooling(2),
            "rssi",
            "labels of task 'rssi' have no directions, so the pooling must have a grid",
        ),
        (lambda scene: Power(), "rssi", "the value of silence must be finite"),
        (lambda scene: Clamped(), "rssi", "the gradient of a silent map must be finite"),
        (lambda scene: Narrow(), "rssi", "the value of 12 decades in float16 must be finite"),
        (
            lambda scene: Coarse(),
            "rssi",
            "the value of a silent map in float16 must be torch.float32, got torch.float16",
        ),
        (lambda scene: Forgetful(), "rssi", "all that it takes in fit must be in the state dict"),
        (lambda scene: Floored(), "csi", r"the value must be of shape \(3, 4, 5\), got \(3,\)"),
    ],
)
def test_a_broken_pooling_is_found(build, task, message):
    with pytest.raises(AssertionError, match=message):
        check_pooling(build, LINKS[task])


class Unfloored(PathRssi):
    def read(self, received, query, directions=None):
        return 10 * received[:, received.shape[1] // 2].real.log10()


class Loudest(PathRssi):
    def read(self, received, query, directions=None):
        return super().read(received / received.abs().max(), query)


class Whispering(PathRssi):
    def read(self, received, query, directions=None):
        return super().read(received, query)[:, None]


class Single(PathRssi):
    channels = 1


class Beamed(Pooling):
    """The power of a map of its own, spread over the directions of a spectrum."""

    def __init__(self, scene, asks=True):
        super().__init__()
        self.scene, self.asks, self.grid = scene, asks, sphere("pooling.grid", [4, 8])

    def spread(self, level, directions):
        own = self.scene.task.directions
        values = level[:, None, None] * own.vectors()[..., 2].to(level)
        if directions is None:
            return values
        return level[:, None] * (directions.vectors()[..., 2] if self.asks else own.vectors()[0, 0, 2]).to(level)

    def forward(self, image, query, directions=None):
        return self.spread(image.square().mean((1, 2, 3)), directions)


@pytest.mark.parametrize(
    ("pooling", "message"),
    [
        (Unfloored, "the value of silence must be finite"),
        (Loudest, "a value must not depend on the other paths"),
        (Whispering, r"the value must be of shape \(3,\), got \(3, 1\)"),
        (Single, "paths have 2 channels, real and imaginary part, got 1"),
    ],
)
def test_a_broken_pooling_of_paths_is_found(pooling, message):
    with pytest.raises(AssertionError, match=message):
        check_pooling(pooling, LINKS["rssi"])


def test_a_pooling_with_a_map_of_its_own_gives_the_directions_asked_for():
    links = example_links("spectrum", 5e9)
    check_pooling(Beamed, links)
    with pytest.raises(AssertionError, match="fewer directions must get the same values"):
        check_pooling(lambda scene: Beamed(scene, asks=False), links)


def test_a_pooling_with_a_noise_floor_keeps_the_contract():
    check_pooling(lambda scene: Floored(), LINKS["rssi"])
