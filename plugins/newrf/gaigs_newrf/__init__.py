"""NeWRF: a radiance field of radio waves along the directions from which they arrive."""

from collections.abc import Mapping

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn
from torch.nn.functional import normalize, pad, softplus

from gaigs.core.phases import array_sign
from gaigs.core.propagation import free_space
from gaigs.core.query import Batch
from gaigs.core.scene import Scene, check_elements, check_one_carrier, direct_waves
from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.splatting.tokenizer.euclidean import MAX_OCTAVE, fourier_features
from gaigs_newrf.arrivals import find_origins

MARGIN = 0.5
"""Share of the longest edge of the box of transmitters and receiver. Arrivals lie in that box,
enlarged on each side by its own size and by so much: that holds the images behind walls that stand
up to half of this outside the box."""

MOST_LINKS = 256
"""Most links of a receiver in which arrivals are searched."""

DENSITY = -5.0
"""Where the network's densities start, before the softplus: waves are to come through before
anything is learnt.
"""

LOUD = 0.99
"""Share of the training channels that shall be no stronger than the network's tanh can make a
single path.
"""


def render(
    fields: Complex[Tensor, "b k i e"],
    depths: Float[Tensor, "b k i"],
    distances: Float[Tensor, "b k i"],
    frequencies: Float[Tensor, " s"],
    sign: int = -1,
) -> Complex[Tensor, "b e s"]:
    """Channels, the sums of the waves from all samples i along all rays k:

        sum_k sum_i F_i c / (4 pi f z_i) alpha_i prod_{j<i} (1 - alpha_j) exp(-j 2 pi f z_i / c)

    with alpha = 1 - exp(-depth). The phase is that of the whole distance z_i.

    Args:
        fields: Field F that a sample sends towards the antenna.
        depths: Optical depth of each sample's step; a ray's last one may be infinite.
        distances: Distance z from the antenna [m].
        frequencies: Subcarriers f [Hz].
        sign: Sign of phases.

    Source: NeWRF, 2024.
    """
    passed = torch.exp(-pad(depths[..., :-1].cumsum(-1), (1, 0)))
    weights = -torch.expm1(-depths) * passed  # (b, k, i)
    waves = free_space(distances[..., None], frequencies.to(distances.device), sign).to(fields)
    sent = (weights[..., None] * fields).flatten(1, 2)  # (b, k i, e)
    return sent.mT @ waves.flatten(1, 2)


class Field(nn.Module):
    """A network from place and direction to density, and to the field sent in that direction.

    Args:
        features: Widths of the features of place and direction.
        width, layers: Width and number of layers; the input joins again behind the fourth layer.
        elements: Number of elements, each with a field.
    """

    def __init__(self, features: tuple[int, int], width: int, layers: int, elements: int):
        super().__init__()
        places, views = features
        self.joint = 4
        inputs = [places, *[width] * (layers - 1)]
        if layers > self.joint:
            inputs[self.joint] += places
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.density = nn.Linear(width, 1)
        nn.init.constant_(self.density.bias, DENSITY)
        self.send = nn.Sequential(
            nn.Linear(width + views, width), nn.ReLU(), nn.Linear(width, 2 * elements)
        )

    def forward(
        self, places: Float[Tensor, "*batch features"], views: Float[Tensor, "*batch features"]
    ) -> tuple[Float[Tensor, "*batch"], Complex[Tensor, "*batch e"]]:
        """Density, as optical depth of a usual step; and fields, parts within -1..1 by tanh."""
        hidden = places
        for number, layer in enumerate(self.layers):
            if number == self.joint:
                hidden = torch.cat((places, hidden), -1)
            hidden = layer(hidden).relu()
        sent = self.send(torch.cat((hidden, views), -1))
        # torch has no complex numbers of bfloat16 (trainer.precision=bf16-mixed).
        sent = sent.to(torch.promote_types(sent.dtype, torch.float32)).tanh()
        real, imaginary = sent.chunk(2, -1)
        return softplus(self.density(hidden)[..., 0]), torch.complex(real, imaginary)


class NeWrf(Model):
    """Channels from a field that stands still, seen along rays from the antenna that moves.

    NeWRF has a transmitter that stands still, antennas at many places, and measured directions of
    arrival there. Here the receivers stand still and transmitters are at many places. A channel is
    the same both ways, so rays go from the transmitter's place, and each receiver has a field of
    its own, in which each of its elements sends. No data set of gaigs has directions of arrival.
    They are estimated from the delays in the training channels: ``find_origins`` gives points at
    which a receiver's images seem to stand, the receiver itself first, and from any place rays go
    towards them. Samples are spread evenly from the antenna to the point, and the last one, on it,
    lets nothing through: no second pass has to find where along the ray the wave begins.

    Args:
        scene: Receivers and task.
        arrivals: Number of rays from each place.
        samples: Number of samples along a ray.
        octaves: Number of the features sin 2^k x and cos 2^k x of positions [m], k from 0.
        view_octaves: Number of such features of directions.
        width, layers: Width and number of the network's layers.

    Raises:
        ValueError: The labels are no channels, or have one subcarrier or several carriers; an array
            has another number of elements than the labels; an option is out of range.

    Source: NeWRF, 2024.
    """

    learning_rates: Mapping[str, float] = {"network": 1e-3}
    any_frequency = True

    def __init__(
        self,
        scene: Scene,
        arrivals: int,
        samples: int,
        octaves: int,
        view_octaves: int,
        width: int,
        layers: int,
    ):
        super().__init__(scene)
        check_elements("model 'newrf'", scene)
        if len(scene.task.frequencies) < 2:
            raise ValueError(
                "model 'newrf' estimates arrivals from delays, which a single subcarrier does not "
                "tell; take another model"
            )
        check_one_carrier("model 'newrf'", scene)
        for option, value, least in (
            ("arrivals", arrivals, 1),
            ("samples", samples, 2),
            ("octaves", octaves, 0),
            ("view_octaves", view_octaves, 0),
            ("width", width, 1),
            ("layers", layers, 1),
        ):
            if value < least:
                raise ValueError(f"model.{option} must be at least {least}, got {value}")
            if option.endswith("octaves") and value > MAX_OCTAVE:
                raise ValueError(f"model.{option} must be at most {MAX_OCTAVE}, got {value}")
        lower, upper = scene.lower, scene.upper
        self.register_buffer("middle", (lower + upper) / 2)
        self.register_buffer("steps", (torch.arange(samples) + 1) / samples, persistent=False)
        self.register_buffer("place_frequencies", 2.0 ** torch.arange(octaves), persistent=False)
        view_frequencies = 2.0 ** torch.arange(view_octaves)
        self.register_buffer("view_frequencies", view_frequencies, persistent=False)
        origins = scene.positions(lower)[:, None].expand(-1, arrivals, -1)
        self.register_buffer("origins", origins.clone())
        self.register_buffer("unit", torch.ones(()))
        self.register_buffer("sign", torch.tensor(-1))
        # A density of 1 is an optical depth of 1 over the step of a ray as long as the box.
        self.density = samples / (upper - lower).norm().item()
        features = 3 * (1 + 2 * octaves), 3 * (1 + 2 * view_octaves)
        self.fields = nn.ModuleList(
            Field(features, width, layers, scene.task.elements) for _ in scene.receivers
        )

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Takes the sign of phases, the unit of strength and the origins of waves from the training
        channels.
        """
        train = links.split.train
        frequencies = self.scene.task.frequencies
        labels = links.labels[train].to(torch.complex128)
        query = links.query[train]
        waves = direct_waves(self.scene, query, frequencies)
        sign = self.scene.task.phase_sign(labels, waves, query.receivers)
        self.sign.fill_(sign or array_sign(labels, waves))
        ratios = (labels.abs().square().sum((1, 2)) / waves.abs().square().sum((1, 2))).sqrt()
        self.unit.copy_(ratios.quantile(LOUD))
        falling = labels if self.sign < 0 else labels.conj()  # phases fall with the distance
        for receiver, antenna in enumerate(self.scene.receivers):
            rows = (query.receivers == receiver).nonzero()[:, 0]
            if not len(rows):
                continue
            rows = rows[torch.linspace(0, len(rows) - 1, min(MOST_LINKS, len(rows))).long()]
            places = query.transmitters[rows].double()
            first = antenna.pose.position.double()
            lower = torch.minimum(self.scene.lower.double(), first)
            upper = torch.maximum(self.scene.upper.double(), first)
            beyond = upper - lower + MARGIN * (upper - lower).max()
            region = torch.stack((lower - beyond, upper + beyond))
            count = self.origins.shape[1]
            origins = find_origins(falling[rows], places, frequencies, first, region, count)
            self.origins[receiver] = origins.to(self.origins)

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        by_receiver = []
        values = []
        # Without links the first receiver gives an empty value of a label's shape.
        for receiver in query.receivers.unique().tolist() or [0]:
            links = (query.receivers == receiver).nonzero()[:, 0]
            values.append(self._march(query.transmitters[links], receiver))
            by_receiver.append(links)
        # Several processes train together, and each must have a gradient of all fields.
        idle = sum(0 * parameter.sum() for parameter in self.parameters()) if self.training else 0
        order = torch.cat(by_receiver).argsort()
        return Prediction(torch.cat(values)[order] + idle, {})

    def _march(self, places: Float[Tensor, "b 3"], receiver: int) -> Complex[Tensor, "b e s"]:
        """Channels between places and one receiver."""
        ways = self.origins[receiver] - places[:, None]  # (b, k, 3)
        lengths = ways.double().norm(dim=-1)
        points = places[:, None, None] - self.middle + ways[:, :, None] * self.steps[:, None]
        # At the very origin there is no direction: the vector 0 stands for it.
        views = fourier_features(normalize(ways, dim=-1), self.view_frequencies)
        views = views[:, :, None].expand(-1, -1, len(self.steps), -1)  # (b, k, i, features)
        features = fourier_features(points, self.place_frequencies)
        densities, fields = self.fields[receiver](features, views)
        steps = (lengths / len(self.steps)).to(densities)
        depths = self.density * steps[..., None] * densities[..., :-1]
        depths = pad(depths, (0, 1), value=torch.inf)  # the last sample lets nothing through
        distances = lengths[..., None] * self.steps.double()
        frequencies = self.scene.task.frequencies
        return self.unit * render(fields, depths, distances, frequencies, int(self.sign))
