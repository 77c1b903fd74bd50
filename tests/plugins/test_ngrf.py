"""nGRF: its sum against a float64 transcription, its start in free space, and its gradients."""

import cmath
import itertools
import math
from dataclasses import replace

import pytest
import torch
from splatting import build, composed

from gaigs.core.geometry import quaternions_to_rotations
from gaigs.core.query import Batch, Query
from gaigs.core.scene import direct_waves
from gaigs.testing import example_links

LIGHT = 299792458.0
LINKS = example_links("csi")
SMALL = ("model=ngrf", "model.count=3", "model.width=8", "model.layers=2")


def make(**changes):
    return build(
        "model", composed("data=synthetic_csi", *SMALL)["model"] | changes, scene=LINKS.scene
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_channels_are_the_sum_over_the_gaussians_of_the_receiver(sign):
    model = make().double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(
                0.3 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            )
    model.sign.fill_(sign)
    model.gains.copy_(torch.tensor([2.0 + 1.0j, -0.5j]))
    query = LINKS.query[torch.tensor([0, 1, 2])]
    query = replace(query, transmitters=query.transmitters.double())
    outputs = []
    model.network.register_forward_hook(lambda _, inputs, output: outputs.append(output))
    with torch.no_grad():
        found = model(Batch(query)).value
    frequencies = LINKS.task.frequencies.tolist()
    middle = sum(frequencies) / len(frequencies)
    expected = torch.zeros_like(found)
    turns = quaternions_to_rotations(model.quats)
    for b, i in itertools.product(range(3), range(3)):
        r = int(query.receivers[b])
        receiver, mean, turn = LINKS.receivers[r], model.means[r, i], turns[r, i]
        offset = query.transmitters[b] - mean
        covariance = turn @ torch.diag(model.log_scales[r, i].exp().square()) @ turn.T
        weight = math.exp(-0.5 * (offset @ torch.linalg.solve(covariance, offset)).item())
        amplitude, phase, attenuation = outputs[0][b, i].tolist()
        loss = math.log1p(math.exp(attenuation - 5)) * offset.norm().item()
        source = weight * complex(*model.strengths[r, i].tolist()) * complex(model.gains[r])
        source *= 2 / (1 + math.exp(-amplitude)) * cmath.exp(1j * phase - loss)
        for (e, element), (s, f) in itertools.product(
            enumerate(receiver.array.elements), enumerate(frequencies)
        ):
            place = mean + turn @ (receiver.pose.rotation.double() @ element.double())
            length = (query.transmitters[b] - place).norm().item()
            cycles = (middle * length + (f - middle) * offset.norm().item()) / LIGHT
            wave = cmath.exp(sign * 2j * math.pi * cycles) * LIGHT / (4 * math.pi * f * length)
            expected[b, e, s] += source * wave
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("sign", [-1, 1])
def test_alone_at_the_start_the_first_gaussian_is_free_space(sign):
    waves = direct_waves(LINKS.scene, LINKS.query, LINKS.task.frequencies, sign)
    links = replace(LINKS, labels=(3j * waves).to(torch.complex64))
    model = make(count=1, scale=1e3)
    model.fit(links)
    assert model.sign == sign
    found = model(Batch(LINKS.query)).value
    passed = found / links.labels  # the attenuation at the start
    assert passed.real.min() > 0.9
    assert passed.imag.abs().max() < 0.02  # by the delay across the array


@pytest.mark.parametrize("attenuation", [0.0, 101.0], ids=["clear", "denormal amplitude"])
def test_gradients_are_finite_on_a_gaussian_and_beyond_all_hearing(attenuation):
    model = make()
    with torch.no_grad():
        model.network[-1].bias[2] = attenuation
    place = LINKS.receivers[0].pose.position
    query = Query(
        torch.stack((place, place + place.new_tensor([1.0, 0, 0]), place + 1e3)),
        torch.zeros(3).long(),
    )
    model(Batch(query)).value.abs().sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())
