"""Every registered name of every kind keeps its contract, with the options of its configuration file."""

import math
from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import nn

from gaigs import configuration
from gaigs.data import nerf2_spectrum
from gaigs.model import Model, Prediction
from gaigs.pooling.softmax_attention import SoftmaxAttention
from gaigs.pooling.spectrum import Spectrum
from gaigs.projection.equirectangular import Equirectangular
from gaigs.projection.mercator import Mercator
from gaigs.rasterizer.torch import TorchRasterizer
from gaigs.registry import registry
from gaigs.testing import (
    check_data,
    check_model,
    check_pooling,
    check_projection,
    check_rasterizer,
    check_tokenizer,
    example_links,
)
from gaigs.tokenizer import Tokens
from gaigs.tokenizer.euclidean import EuclideanTokenizer

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]
SMALL = {"synthetic": ["data.transmitters=12", "data.order=1"], "gaigs": ["gaussians.count=60", "mapping.width=16"]}
"""What makes a component quick to check."""

every = lambda kind: pytest.mark.parametrize("name", registry(kind).names())
on_every_device = pytest.mark.parametrize("device", DEVICES)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def configured(kind, name, *overrides):
    """The configuration of a name as the command line would have it."""
    configuration.install()
    with initialize_config_dir(str(configuration.conf_dir()), version_base="1.3"):
        config = compose("config", [f"{kind}={name}", *SMALL.get(name, []), *overrides])
    return OmegaConf.to_container(config[kind], resolve=True)


# --- the contracts ---


@every("data")
def test_data(name, tmp_path):
    overrides = []
    match name:
        case "nerf2_spectrum":
            nerf2_spectrum.write(tmp_path, registry("data").build(configured("data", "synthetic")))
            overrides = [f"data.root={tmp_path}"]
        case "nerf2_rssi":
            (tmp_path / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k},{k % 3},1\n" for k in range(12)))
            readings = "".join(f"-6{k},-100\n-5{k},-70\n" for k in range(6))
            (tmp_path / "gateway_rssi.csv").write_text(f"one,two\n{readings}")
            (tmp_path / "gateway_position.yml").write_text("one: [0, 0, 2]\ntwo: [5, 1, 2]\n")
            for part, rows in (("train", range(9)), ("test", range(9, 12))):
                (tmp_path / f"{part}_index.txt").write_text("".join(f"{row}\n" for row in rows))
            overrides = [f"data.root={tmp_path}", "data.split.length=2"]
        case "rssi_csv":
            rows = "".join(f"{k},{k % 3},1,{5 * (k % 2)},1,2,-6{k % 10}\n" for k in range(20))
            (tmp_path / "room.csv").write_text("tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm\n" + rows)
            overrides = [f"data.file={tmp_path / 'room.csv'}"]
    check_data(registry("data").build(configured("data", name, *overrides)))


@every("tokenizer")
@on_every_device
def test_tokenizer(name, device):
    scene = example_links().scene
    check_tokenizer(registry("tokenizer").build(configured("tokenizer", name), scene=scene), scene, device)


@every("projection")
@on_every_device
def test_projection(name, device):
    check_projection(registry("projection").build(configured("projection", name), pixel=math.radians(1)), device)


@every("rasterizer")
@on_every_device
def test_rasterizer(name, device):
    if name == "opencl" and device != "cpu":
        pytest.skip("works on the CPU's tensors")
    try:
        rasterizer = registry("rasterizer").build(configured("rasterizer", name))
    except RuntimeError as error:
        if "needs an OpenCL driver" not in str(error):
            raise
        pytest.skip(str(error))
    check_rasterizer(rasterizer, device)


@every("pooling")
@on_every_device
def test_pooling(name, device):
    config = configured("pooling", name)
    check_pooling(lambda grid: registry("pooling").build(config, grid=grid), device)


@on_every_device
def test_learnt_pooling(device):
    check_pooling(lambda grid: SoftmaxAttention(temperature=0.5, prior=0.1, learn=True), device)


LABELS = {"path_loss": ["rssi"], "array_response": ["spectrum"]}
"""The kinds of label that a model takes, where it does not take both."""


@pytest.mark.parametrize(
    ("name", "label"),
    [(name, label) for name in registry("model").names() for label in LABELS.get(name, ["spectrum", "rssi"])],
)
@on_every_device
def test_model(name, label, device):
    parts = ["model=gaigs_rssi", "pooling=softmax_attention"] if (name, label) == ("gaigs", "rssi") else []
    config = configured("model", name, *parts)
    links = example_links()
    if label == "rssi":
        links = replace(links, labels=-60 - 10 * torch.rand(len(links.transmitters)), grid=None)
    check_model(lambda scene: registry("model").build(config, scene=scene), links, device)


# --- and the checks can fail ---


class Skewed(Mercator):
    def jacobian(self, points):
        return super().jacobian(points) * torch.tensor([[1.0], [1.001]]).to(points)


class Unclamped(Equirectangular):
    def jacobian(self, points):
        azimuth, elevation = super().jacobian(points).unbind(-2)
        azimuth = nn.functional.normalize(azimuth, dim=-1) / points[..., :2].norm(dim=-1, keepdim=True)
        return torch.stack((azimuth, elevation), -2)


class Shifted(Equirectangular):
    def plane(self, elevations, azimuths):
        plane = super().plane(elevations, azimuths)
        return replace(plane, v=plane.v + 1e-6)


class Hiding(Mercator):
    def project(self, means, covariances, receiver):
        splats = super().project(means, covariances, receiver)
        return replace(splats, visible=splats.depths < 100)


@pytest.mark.parametrize(
    ("projection", "message"),
    [
        (Skewed, "jacobian must be the derivative of coordinates"),
        (Unclamped, "covariances2d at hard places must be finite"),
        (Shifted, "plane.v must be coordinates' v"),
        (Hiding, "only what sits on the receiver is hidden"),
    ],
)
def test_a_broken_projection_is_found(projection, message):
    with pytest.raises(AssertionError, match=message):
        check_projection(projection(0.02))


def unwrapped(splats, signal, opacities, attenuations, plane):
    return TorchRasterizer()(splats, signal, opacities, attenuations, replace(plane, period=None))


def unsorted(splats, *others):
    return TorchRasterizer()(replace(splats, depths=torch.zeros_like(splats.depths)), *others)


def clear(splats, signal, opacities, attenuations, plane):
    return TorchRasterizer()(splats, signal, opacities, None, plane)


def frozen(splats, *others):
    return TorchRasterizer()(replace(splats, means2d=splats.means2d.detach()), *others)


def culling(splats, signal, opacities, attenuations, plane):
    return TorchRasterizer()(splats, signal.nan_to_num(), opacities, attenuations, plane)


def single(splats, signal, opacities, *others):
    return (result.float() for result in TorchRasterizer()(splats, signal, opacities, *others))


def mixing(splats, signal, opacities, *others):
    image, left = TorchRasterizer()(splats, signal, opacities, *others)
    return image + 0 * left[:, None] + (image - image.detach().mean(0)) * 0 + 1e-2 * (len(image) - 2), left


@pytest.mark.parametrize(
    ("rasterizer", "message"),
    [
        (unwrapped, "random: map must be that of the formula"),
        (unsorted, "random: map must be that of the formula"),
        (clear, "attenuations: map must be that of the formula"),
        (frozen, "random: gradient of means2d must be that of the formula"),
        (culling, "NaN in signal must show as NaN in the map"),
        (single, r"random: map must be torch.float64 as its input, got torch.float32"),
        (mixing, "random: a map must not depend on other transmitters"),
    ],
)
def test_a_broken_rasterizer_is_found(rasterizer, message):
    with pytest.raises(AssertionError, match=message):
        check_rasterizer(rasterizer)


class Normalising(EuclideanTokenizer):
    def forward(self, means, opacities, transmitters):
        tokens = super().forward(means, opacities, transmitters)
        return tokens._replace(transmitters=tokens.transmitters - tokens.transmitters.mean(0))


class Deaf(EuclideanTokenizer):
    def forward(self, means, opacities, transmitters):
        return super().forward(means, opacities, 0 * transmitters)


class Swapped(EuclideanTokenizer):
    def forward(self, means, opacities, transmitters):
        scene, gaussians, transmitters = super().forward(means, opacities, transmitters)
        return Tokens(transmitters, gaussians, scene)


class Noisy(EuclideanTokenizer):
    def forward(self, means, opacities, transmitters):
        return super().forward(means + torch.rand_like(means), opacities, transmitters)


@pytest.mark.parametrize(
    ("tokenizer", "message"),
    [
        (Normalising, "the token transmitters must not depend on the other transmitters"),
        (Deaf, "tokens must tell two transmitters apart"),
        (Swapped, r"the token scene must be of shape \(3, 0\), got \(3, 8\)"),
        (Noisy, "two calls must give the same tokens"),
    ],
)
def test_a_broken_tokenizer_is_found(tokenizer, message):
    scene = example_links().scene
    options = {"gaussian_octaves": (-1, 1), "transmitter_octaves": (-1, 1), "hidden": 8, "width": 8}
    with pytest.raises(AssertionError, match=message):
        check_tokenizer(tokenizer(scene, **options), scene)


class Root(Spectrum):
    def forward(self, image):
        return image.square().sum(1).sqrt()


class Relative(Spectrum):
    def forward(self, image):
        return super().forward(image) / image.abs().max()


class Flat(Spectrum):
    def forward(self, image):
        return super().forward(image).flatten(1)


class Power(Spectrum):
    """Mean power in dB, without a floor."""

    def level(self, image):
        return 10 * image.square().sum(1).mean((1, 2)).log10()

    def forward(self, image):
        return self.level(image.to(torch.promote_types(image.dtype, torch.float32)))


class Floored(Power):
    def level(self, image):
        return 10 * (image.square().sum(1).mean((1, 2)) + 1e-2).log10()


class Narrow(Floored):
    def forward(self, image):
        return self.level(image).to(torch.promote_types(image.dtype, torch.float32))


class Coarse(Floored):
    def forward(self, image):
        return super().forward(image).to(image.dtype)


class Clamped(Power):
    def level(self, image):
        return 20 * image.square().sum(1).mean((1, 2)).sqrt().clamp(min=1e-3).log10()


@pytest.mark.parametrize(
    ("pooling", "message"),
    [
        (Root, "the gradient of a silent map must be finite"),
        (Relative, "a label must not depend on the other maps"),
        (Flat, r"the label must be of shape \(3, 5, 8\), got \(3, 40\)"),
        (Power, "the gradient of a silent map must be finite"),
        (Clamped, "the gradient of a silent map must be finite"),
        (Narrow, "the label of 12 decades in float16 must be finite"),
        (Coarse, "the label of a silent map in float16 must be torch.float32, got torch.float16"),
    ],
)
def test_a_broken_pooling_is_found(pooling, message):
    with pytest.raises(AssertionError, match=message):
        check_pooling(lambda grid: pooling(2))


def test_a_pooling_with_a_noise_floor_keeps_the_contract():
    check_pooling(lambda grid: Floored(2))


class Grey(Model):
    """The same grey in all directions, learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        self.grey = nn.Parameter(torch.full((), 0.5))

    def forward(self, batch):
        return Prediction(self.grey * batch.transmitters.new_ones(len(batch.transmitters), *batch.grid.shape), {})


class Stuck(Grey):
    def parameter_groups(self):
        return {"network": []}


class Fixed(Grey):
    def forward(self, batch):
        return Prediction(self.grey.new_ones(len(batch.transmitters), *self.scene.grid.shape) * self.grey, {})


class Forgetful(Grey):
    def fit(self, links):
        self.level = links.labels.mean()

    def forward(self, batch):
        return Prediction(super().forward(batch).label * getattr(self, "level", 1.0), {})


class Crowded(Grey):
    def forward(self, batch):
        return Prediction(super().forward(batch).label * len(batch.transmitters), {})


class Silent(Grey):
    def forward(self, batch):
        return Prediction(
            (self.grey * batch.transmitters.new_zeros(()).expand(len(batch.transmitters), 18, 36)).sqrt(), {}
        )


class Trusting(Grey):
    def predict(self, transmitters, receiver=0, batch_size=16):
        return torch.full((len(transmitters), 18, 36), 0.5)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Stuck, "each parameter must stand in one of parameter_groups"),
        (Fixed, "fewer directions must get the same values"),
        (Forgetful, "all that predict needs must be in the state dict"),
        (Crowded, "the batch size must not change predictions"),
        (Silent, "the gradient of grey must be finite"),
        (Trusting, "a grid of positions must give a grid of predictions"),
    ],
)
def test_a_broken_model_is_found(model, message):
    check_model(Grey, example_links())
    with pytest.raises(AssertionError, match=message):
        check_model(model, example_links())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transmitters": torch.zeros(24, 3, dtype=torch.float64)}, "transmitters must be torch.float32"),
        ({"transmitters": torch.full((24, 3), torch.nan)}, "transmitters must be finite"),
        ({"receiver_index": torch.full((24,), 2)}, "receiver_index must point into receivers"),
        ({"labels": torch.full((24, 18, 36), 1.5)}, r"spectra must lie in \[0, 1\]"),
        ({"labels": torch.zeros(24, 36, 18)}, r"labels must be of shape \(9, 18, 36\), got \(9, 36, 18\)"),
        ({"split": replace(example_links().split, test=torch.arange(3))}, "no link may stand twice"),
        ({"split": replace(example_links().split, test=torch.arange(24, 26))}, "must point at the 24 links"),
    ],
)
def test_broken_links_are_found(changes, message):
    check_data(example_links())
    with pytest.raises(AssertionError, match=message):
        check_data(replace(example_links(), **changes))
