"""The plug-in of this repository, found as a user finds it: from the working directory, by name."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array
from gaigs.core.geometry import Grid, Rays
from gaigs.core.propagation import bartlett, min_max
from gaigs.core.query import Batch, Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.registry import registry
from gaigs.testing import example_links

ROOT = Path(__file__).parents[2]
SCENE = example_links().scene
GRID = SCENE.task.directions
SOMEWHERE = torch.tensor([[1.0, 2.0, 0.5], [3.0, 1.0, 1.5]])
OPTIONS = {"rows": 4, "columns": 4, "pitch": 0.5, "octaves": [-1, 1], "width": 16, "layers": 1}


@pytest.fixture
def build(monkeypatch):
    """Builds the model with other options, or for another scene."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", sys.path[:])  # the registry appends to it

    def build(scene=SCENE, **options):
        torch.manual_seed(0)
        return registry("model").build({"name": "array_response"} | OPTIONS | options, scene=scene)

    return build


def seen_in(grid):
    """The scene with labels in other directions."""
    return replace(SCENE, task=Spectrum(grid.elevations, grid.azimuths, "none"))


def answering(model, fields):
    """The model, its network made to answer with given fields (elements,) at every receiver."""
    last = model.network[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.cat((fields.real, fields.imag)).expand(model.fields).flatten())
    return model


@pytest.mark.parametrize("seed", range(3))
def test_the_label_is_the_simulators_for_the_same_fields(build, seed):
    grid, array = Grid.degrees(), Array.planar(4, 4, 0.5)
    fields = torch.randn(16, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed))
    predicted = answering(build(seen_in(grid)), fields).predict(SOMEWHERE[:1], 0)
    # In units of wavelengths, at the frequency at which a wavelength is 1 m.
    expected = min_max(bartlett(fields[None, :, None], grid, array, speed_of_light)).float()
    torch.testing.assert_close(predicted, expected, rtol=0, atol=1e-5)


def test_at_a_pitch_of_one_wavelength_lobes_repeat(build):
    # cos az cos el is 1/2 and -1/2 there: one period of the pattern, 1 / pitch, apart.
    scene = seen_in(Grid.degrees([60, 1, 90], [0, 90, 180]))
    fields = torch.randn(16, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    spectra = [
        answering(build(scene, pitch=p), fields).predict(SOMEWHERE[:1], 0)[0] for p in (1.0, 0.5)
    ]
    apart = [abs(float(spectrum[0, 0] - spectrum[0, 2])) for spectrum in spectra]
    assert apart[0] < 1e-5 < 0.1 < apart[1]


def test_the_gradient_is_that_of_the_plain_formula(build):
    model = build().double()
    grid = GRID.to(torch.float64)
    batch = Batch(Query(SOMEWHERE.double(), torch.tensor([1, 1])), grid)
    weights = torch.randn(
        2, *grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )

    outputs = []
    hook = model.network.register_forward_hook(
        lambda module, inputs, output: outputs.append(output)
    )
    value = model(batch).value
    hook.remove()
    (found,) = torch.autograd.grad((value * weights).sum(), outputs[0])

    again = outputs[0].detach().requires_grad_()
    fields = torch.complex(*again.unflatten(1, (2, 2, 16))[:, 1].unbind(1))
    elevations, azimuths = torch.meshgrid(grid.elevations, grid.azimuths, indexing="ij")
    steps = torch.arange(4, dtype=torch.float64) - 1.5
    along_x = torch.exp(-1j * math.pi * steps[:, None, None] * azimuths.cos() * elevations.cos())
    along_y = torch.exp(-1j * math.pi * steps[:, None, None] * azimuths.sin() * elevations.cos())
    plain = min_max(
        torch.einsum("bij,iac,jac->bac", fields.unflatten(1, (4, 4)), along_x, along_y).abs()
    )
    (expected,) = torch.autograd.grad((plain * weights).sum(), again)
    torch.testing.assert_close(value, plain, rtol=0, atol=1e-6)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_any_directions_get_the_arrays_answer(build):
    fields = torch.randn(16, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    model = answering(build(), fields)
    (whole,), query = model.predict(SOMEWHERE[:1], 0), Query(SOMEWHERE[:1], torch.tensor([0]))
    chosen = torch.tensor([600, 3, 77, 3])
    (rays,) = model(Batch(query, GRID.flatten()[chosen])).value
    torch.testing.assert_close(rays, whole.flatten()[chosen], rtol=0, atol=1e-5)
    (unasked,) = model(Batch(query)).value
    assert torch.equal(unasked, whole)
    # Between pixels, and below the horizon, where a planar array sees the mirror image of the half
    # above.
    elevations, azimuths = torch.tensor([0.3, -0.3, 1.0]), torch.tensor([0.123, 0.123, 4.0])
    (between,) = model(Batch(query, Rays(elevations, azimuths))).value
    steps = torch.cartesian_prod(torch.arange(4) - 1.5, torch.arange(4) - 1.5)
    cosines = torch.stack((azimuths.cos() * elevations.cos(), azimuths.sin() * elevations.cos()))

    def amplitudes(cosines):
        return (fields[:, None] * torch.exp(-1j * math.pi * (steps @ cosines))).sum(0).abs()

    pixels = GRID.flatten().vectors()[:, :2].T
    low, high = amplitudes(pixels).aminmax()
    torch.testing.assert_close(
        between, (amplitudes(cosines) - low) / (high - low), rtol=0, atol=1e-4
    )
    assert between[0] == between[1]
