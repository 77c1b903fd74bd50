import functools

import pytest
import torch

import gaigs
from gaigs.core.propagation import bartlett


def cloud(n=5, b=None, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)

    def draw(*shape):
        return torch.rand(*([b] if b else []), n, *shape, generator=generator, dtype=dtype)

    return {
        "means": draw(3) * 2 + 1, "quats": draw(4) - 0.5, "scales": draw(3) * 0.3 + 0.1, "opacities": draw() * 0.8,
        "signal": draw(2) - 0.5, "attenuations": draw() * 0.5 + 0.5,
    }  # fmt: skip


POSE = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
COARSE = gaigs.Grid.degrees(elevations=range(5, 90, 10), azimuths=range(0, 360, 20))


def test_a_map_has_right_gradients_to_all_tensors():
    tensors = {name: value.requires_grad_() for name, value in cloud(n=3).items()}
    grid = gaigs.Grid.degrees(elevations=range(10, 90, 30), azimuths=range(0, 360, 90))

    def draw(*values):
        inputs = dict(zip(tensors, values, strict=True))
        return gaigs.rasterize(
            **inputs, receiver=POSE, grid=grid, projection="mercator", rasterizer="torch"
        )

    image, left = draw(*tensors.values())
    assert (image.shape, left.shape) == ((2, 3, 4), (3, 4))
    assert torch.autograd.gradcheck(draw, tuple(tensors.values()), atol=1e-5)


@pytest.mark.parametrize(
    "batched", [["signal"], ["means"], ["quats", "scales"], ["means", "opacities", "attenuations"]]
)
def test_a_batch_is_its_maps_one_by_one(batched):
    single, many = cloud(), cloud(b=3)
    inputs = {name: many[name] if name in batched else single[name] for name in single}
    draw = functools.partial(gaigs.rasterize, receiver=POSE, grid=COARSE, rasterizer="torch")
    image, left = draw(**inputs)
    for row in range(3):
        own, passed = draw(
            **{name: value[row] if name in batched else value for name, value in inputs.items()}
        )
        torch.testing.assert_close(image[row], own)
        torch.testing.assert_close(left[row], passed)


def test_rays_are_pixels_of_the_grid():
    inputs = cloud()
    grid, _ = gaigs.rasterize(**inputs, receiver=POSE, grid=COARSE, pixel=0.1, rasterizer="torch")
    rays, left = gaigs.rasterize(
        **inputs, receiver=POSE, grid=COARSE.flatten(), pixel=0.1, rasterizer="torch"
    )
    assert left.shape == (9 * 18,)
    torch.testing.assert_close(rays, grid.flatten(1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quats": torch.ones(4, 4)}, r"quats must have 5 rows of 4, got \(4, 4\)"),
        (
            {"opacities": torch.ones(5)},
            "opacities must be real numbers of means' torch.float64, got torch.float32",
        ),
        (
            {"signal": torch.ones(2, 5, 1).double(), "means": torch.ones(3, 5, 3).double()},
            "one number of transmitters",
        ),
        (
            {"opacities": torch.full((5,), 1.5).double()},
            r"opacities must lie in \[0, 1\], got 1.5; pass them through a",
        ),
        (
            {"attenuations": -torch.ones(3, 5).double()},
            r"attenuations must lie in \[0, 1\], got -1",
        ),
        (
            {"scales": -torch.ones(5, 3).double()},
            r"scales must lie in \[0, inf\], got -1; take their exp first",
        ),
        ({"grid": COARSE.flatten()}, "pixel must be given for rays"),
        (
            {"grid": gaigs.Grid(torch.arange(1.0, 90.0), torch.arange(360.0))},
            "Grid.degrees takes degrees",
        ),
        ({"rasterizer": "torhc"}, r"unknown rasterizer 'torhc' \(did you mean 'torch'\?\)"),
        (
            {"projection": "direction_cosine", "grid": gaigs.Grid.degrees(range(-40, 50, 10))},
            "below the array's plane",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        gaigs.rasterize(
            **({**cloud(), "receiver": POSE, "grid": COARSE, "rasterizer": "torch"} | changes)
        )


def test_the_beamformer_is_the_sum_over_elements_and_has_a_gradient_in_its_nulls():
    array, wavelength = gaigs.Array.planar(2, 3, pitch=0.1), 299792458.0 / 1e9
    waves = torch.randn(2, 6, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    phases = 2j * torch.pi / wavelength * (array.elements @ COARSE.flatten().vectors().double().T)
    direct = torch.einsum("bnf,nk->bfk", waves, torch.exp(-phases)).abs().square().mean(1).sqrt()
    torch.testing.assert_close(
        bartlett(waves, COARSE, array, 1e9).flatten(1), direct, atol=1e-7, rtol=1e-6
    )
    torch.testing.assert_close(
        bartlett(waves[0], COARSE.flatten(), array, 1e9), direct[0], atol=1e-7, rtol=1e-6
    )
    silent = torch.zeros(1, 6, 1, dtype=torch.complex128, requires_grad=True)
    bartlett(silent, COARSE, array, 1e9).sum().backward()
    assert torch.equal(silent.grad, torch.zeros_like(silent))
    with pytest.raises(ValueError, match=r"of 6 elements, got torch.complex128 \(2, 5, 3\)"):
        bartlett(waves[:, :5], COARSE, array, 1e9)
