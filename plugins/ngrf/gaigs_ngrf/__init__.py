"""nGRF: complex channels as a direct sum over 3-D Gaussians, without an image plane."""

import itertools
import math
from collections.abc import Mapping

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from gaigs.core.geometry import polar, quaternions_to_rotations
from gaigs.core.phases import array_sign
from gaigs.core.propagation import fit_gain, free_space
from gaigs.core.query import Batch
from gaigs.core.scene import Scene, check_elements, check_one_carrier, direct_waves
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.splatting.tokenizer.euclidean import fourier_features, learnable_octaves, octaves

ATTENUATION = -5.0
"""Start of the attenuation before its softplus: 0.007 /m."""


class NGrf(Model):
    """Channel = sum over Gaussians of weight x complex strength x wave to the antenna that moves.

        h_e(p, f) = g sum_i w_i(p) s_i 2 sigmoid(a_i) exp(j phi_i - alpha_i d_i)
                        G_m(r_ie) G_f(d_i) / G_m(d_i)
        w_i(p) = exp(-(p - mu_i)' Sigma_i^-1 (p - mu_i) / 2)
        d_i = |p - mu_i|    r_ie = |p - mu_i - Q_i x_e|

    with the wave of free space G, at the middle m of the band from element to element: an array
    must be small against the speed of light over the bandwidth. Amplitude a, phase phi and
    attenuation alpha [1/m] are from a network of [features of mu_i, features of p]. Gaussians add
    up without order or occlusion.

    The paper moves the receiver. Here transmitters move, and by reciprocity p is the transmitter.
    Each receiver has Gaussians of its own. A Gaussian is an image of the receiver: its quaternion Q
    turns the covariance and the places x_e of the array's elements. The first Gaussian of a
    receiver starts on it, the others at random.

    Args:
        scene: Receivers and task.
        count: Number of Gaussians of each receiver.
        margin: Margin of the box in which Gaussians start, around transmitters and receivers, as a
            share of the longest edge.
        scale: Standard deviation of the Gaussians at the start, as a share of the scene's extent.
        strength: Standard deviation of s at the start; the first Gaussian has s = 1.
        width, layers: Width and number of the network's layers.

    Raises:
        ValueError: The labels are not channels, or of several carriers; an array has another number
            of elements than the labels; an option is out of range.

    Source: nGRF (Umer et al., arXiv 2508.11668); the README says which parts are ours.
    """

    learning_rates: Mapping[str, float] = {
        "means": 1e-3, "quats": 1e-3, "log_scales": 5e-3, "strengths": 1e-2, "network": 1.6e-2
    }  # fmt: skip

    def __init__(
        self,
        scene: Scene,
        count: int,
        margin: float,
        scale: float,
        strength: float,
        width: int,
        layers: int,
    ):
        super().__init__(scene)
        check_elements("model 'ngrf'", scene)
        check_one_carrier("model 'ngrf'", scene)
        for option, number in (("count", count), ("width", width), ("layers", layers)):
            if number < 1:
                raise ValueError(f"model.{option} must be at least 1, got {number}")
        for option, value in (("margin", margin), ("scale", scale), ("strength", strength)):
            if not 0 < value <= 1e6:
                raise ValueError(f"model.{option} must be more than 0 and at most 1e6, got {value}")
        receivers = scene.positions(scene.lower)
        lower, upper = scene.box
        beyond = margin * (upper - lower).max()
        means = lower - beyond + (upper - lower + 2 * beyond) * torch.rand(len(receivers), count, 3)
        means[:, 0] = receivers
        strengths = strength * math.sqrt(0.5) * torch.randn(len(receivers), count, 2)
        strengths[:, 0] = torch.tensor([1.0, 0.0])
        log_scales = torch.full((len(receivers), count, 3), math.log(scale * scene.extent))
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.means = nn.Parameter(means)
        self.strengths = nn.Parameter(strengths)
        self.quats = nn.Parameter(upright.repeat(len(receivers), count, 1))
        self.log_scales = nn.Parameter(log_scales)
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        frequencies = octaves("octaves", *learnable_octaves(scene))
        self.register_buffer("frequencies", frequencies, persistent=False)
        elements = []
        for receiver in scene.receivers:
            offsets = receiver.array.elements
            elements.append(offsets @ receiver.pose.rotation.mT.to(offsets))
        # Elements along the world's axes (r, e, 3) [m].
        self.register_buffer("elements", torch.stack(elements).to(means), persistent=False)
        self.register_buffer("gains", torch.ones(len(receivers), dtype=torch.complex64))
        self.register_buffer("sign", torch.tensor(-1))
        sizes = [6 * (1 + 2 * len(self.frequencies)), *[width] * layers]
        hidden: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(sizes):
            hidden += [nn.Linear(inputs, outputs), nn.ReLU()]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 3))
        nn.init.zeros_(self.network[-1].weight)
        nn.init.zeros_(self.network[-1].bias)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the sign of phases, and each receiver's gain g over free space, to the training
        channels.
        """
        train = links.split.train
        labels = links.labels[train].to(torch.complex128)
        query = links.query[train]
        waves = direct_waves(self.scene, query, self.scene.task.frequencies)
        sign = self.scene.task.phase_sign(labels, waves, query.receivers)
        self.sign.fill_(sign or array_sign(labels, waves))
        waves = waves if self.sign < 0 else waves.conj()
        for receiver in query.receivers.unique().tolist():
            rows = query.receivers == receiver
            self.gains[receiver] = fit_gain(labels[rows], waves[rows]).to(self.gains)

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        which = query.receivers
        means = self.means[which]  # (b, n, 3)
        rotations = quaternions_to_rotations(self.quats)[which]  # (b, n, 3, 3)
        offsets = query.transmitters[:, None] - means
        whitened = (offsets[..., None, :] @ rotations)[..., 0, :] / self.log_scales[which].exp()
        weights = (-0.5 * whitened.square().sum(-1)).exp()  # w (b, n)
        strengths = torch.view_as_complex(self.strengths)[which]
        sources = self._excited(means, query.transmitters, offsets) * weights * strengths
        # From each element's image to the transmitter (b, n, e, 3).
        elements = (self.elements[which][:, None] @ rotations.mT).double()
        ways = offsets.double()[:, :, None] - elements
        lengths = offsets.double().norm(dim=-1, keepdim=True)  # d (b, n, 1)
        frequencies = self.scene.task.frequencies.to(ways)
        middle = frequencies.mean()
        sign = int(self.sign)
        band = free_space(lengths, frequencies, sign).to(sources)  # (b, n, s)
        # From element to element, waves differ as at the middle of the band (b, n, e).
        ratios = free_space(ways.norm(dim=-1), middle, sign) / free_space(lengths, middle, sign)
        scaled = sources * self.gains[which, None]
        channels = scaled[:, None] * ratios.mT.to(sources) @ band  # (b, e, s)
        return Prediction(channels, {})

    def _excited(
        self,
        means: Float[Tensor, "b n 3"],
        places: Float[Tensor, "b 3"],
        offsets: Float[Tensor, "b n 3"],
    ) -> Complex[Tensor, "b n"]:
        """Factors 2 sigmoid(a) exp(j phi - alpha d) of the Gaussians, from the network."""
        features = fourier_features(means.detach() - self.middle, self.frequencies)
        moving = fourier_features(places - self.middle, self.frequencies)
        moving = moving[:, None].expand_as(features)  # (b, n, features)
        values = self.network(torch.cat((features, moving), -1))
        # torch has no complex numbers of bfloat16 (trainer.precision=bf16-mixed).
        values = values.to(torch.promote_types(values.dtype, torch.float32))
        amplitudes, phases, attenuations = values.unbind(-1)
        passed = (-softplus(attenuations + ATTENUATION) * offsets.norm(dim=-1)).exp()
        return polar(2 * amplitudes.sigmoid() * passed, phases)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        names = [name for name in self.learning_rates if name != "network"]
        groups = {name: [getattr(self, name)] for name in names}
        return groups | {"network": list(self.network.parameters())}

    def facts(self) -> dict[str, object]:
        """Number of Gaussians of all receivers together."""
        count = self.means.shape[0] * self.means.shape[1]
        return {"num_gaussians": count, "num_gaussians_start": count}
