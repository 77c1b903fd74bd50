"""Faint waves, and paths at an array: silence, extreme footprints, zero or one path."""

from dataclasses import replace

import pytest
import torch
from precision import DTYPES, require_same

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose, magnitudes, polar
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.splatting.pooling.paths import ReceivedPaths, element_fields
from gaigs.testing import example_links

FAINT = [0.0, 1e-45, 1e-42, 1e-39, 1.2e-38, 1e-30, 1.0, 1e30]


@pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
@pytest.mark.parametrize("amplitude", FAINT)
@pytest.mark.parametrize("count", [1, 3, 8, 17])
def test_faint_waves_have_gradients(dtype, amplitude, count):
    amplitudes = torch.full((count,), amplitude, dtype=dtype).requires_grad_()
    phases = torch.arange(count, dtype=dtype).requires_grad_()
    waves = polar(amplitudes, phases)
    back = magnitudes(waves)
    torch.testing.assert_close(back, amplitudes, rtol=1e-5, atol=2e-38)
    (waves.real.sum() + waves.imag.sum() + back.sum()).backward()
    assert amplitudes.grad.isfinite().all()
    assert phases.grad.isfinite().all()
    if amplitude > 1e-37:
        turned = torch.autograd.grad(magnitudes(polar(amplitudes, phases)).sum(), amplitudes)[0]
        torch.testing.assert_close(turned, torch.ones_like(turned))


def test_nan_shows_in_waves():
    broken = torch.tensor([torch.nan, 1.0])
    assert polar(broken, torch.zeros(2))[0].isnan()
    assert magnitudes(torch.complex(broken, torch.zeros(2)))[0].isnan()
    assert magnitudes(torch.complex(torch.zeros(2), broken))[0].isnan()


N, B = 9, 2
generator = torch.Generator().manual_seed(0)
CENTRES = torch.rand(B, N, 2, generator=generator) - 0.5
WIDTHS = {
    "points": torch.zeros(3),
    "narrow": torch.tensor([1e-3, 0, 1e-3]),
    "of all widths": torch.logspace(-2, 1.5, N)[None, :, None] * torch.tensor([1.0, 0.3, 1.0]),
    "wider than all directions": torch.tensor([30.0, 10.0, 30.0]),
    "long and thin": torch.tensor([10.0, 5.0, 1e-6]),
}
WAVES = {"silent": 0.0, "denormal": 1e-42, "faint": 1e-18, "loud": 1e10}
CASES = [(widths, "loud", N) for widths in WIDTHS] + [("narrow", waves, N) for waves in WAVES]
CASES += [("narrow", "loud", 1), ("narrow", "loud", 0)]


@pytest.mark.parametrize(("widths", "waves", "n"), CASES)
@pytest.mark.parametrize("coherence", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("bandwidth", [None, 0.0, 1e9])
def test_paths_at_an_array(widths, waves, n, coherence, bandwidth):
    array = Array.planar(3, 3, 0.03)
    receiver = Receiver("here", Pose(torch.zeros(3), torch.eye(3)), array)
    size = WAVES[waves]
    amplitudes = size * torch.randn(
        B, N, dtype=torch.complex64, generator=torch.Generator().manual_seed(1)
    )
    lengths = torch.linspace(0, 50, B * N).view(B, N)
    # Number 4 stands on the array's middle, number 5 on an element, number 6 next to it.
    ahead = (1 - CENTRES.square().sum(-1, keepdim=True)).sqrt()
    points = torch.linspace(0.1, 30, N)[:, None] * torch.cat((CENTRES, ahead), -1)
    points[:, 4:7] = torch.tensor([[0.0, 0, 0], [0.03, -0.03, 0], [0.03, 0.03, 1e-5]])
    axes = points.norm(dim=-1)[..., None, None] * torch.diag_embed(WIDTHS[widths].expand(1, N, 3))

    def ask(pooling, points, axes, amplitudes, lengths, coherences):
        carriers, offsets = (
            lengths.new_full((B,), 5e9),
            lengths.new_tensor([[-1e7, 0, 1e7]]).expand(B, 3),
        )
        band = None if bandwidth is None else lengths.new_tensor(bandwidth)
        paths = ReceivedPaths(
            points, axes, amplitudes, lengths, coherences, band, receiver, carriers
        )
        fields, lags = element_fields(paths, offsets), pooling.sum_paths(paths)
        return (fields, lags) if size <= 1 else (fields / size, lags / size**2)

    pooling = PathRssi(replace(example_links("rssi", 5e9).scene, receivers=(receiver,)))
    leaves = points, axes, amplitudes, lengths
    require_same(ask, pooling, *(leaf[:, :n] for leaf in leaves), torch.full((n,), coherence))
