"""RF-3DGS: its two stages, the rooms that it reads, and its rendering against a plain float64
transcription.
"""

import math

import numpy as np
import pytest
import torch
from contracts.rasterizer import rasterize_densely
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree
from scipy.special import sph_harm_y
from splatting import build, composed, repository, run

from gaigs.core.geometry import semi_axes
from gaigs.registry import registry
from gaigs.splatting.gaussians import SH_DC
from gaigs.testing import check_model, example_links

with repository():
    registry("model").get("rf_3dgs")  # which puts the package in reach
    from gaigs_rf_3dgs.geometry import read_geometry

LINKS = example_links()
SMALL = ("data=synthetic", "model=rf_3dgs", "gaussians.count=40", "rasterizer=torch")
FROZEN = ("means", "quats", "log_scales")
SQUARE = ["v 0 0 1", "v 4 0 1", "v 4 2 1", "v 0 2 1"]


def model_of(links=LINKS, fitted=True, **options):
    model = build("model", composed(*SMALL)["model"] | options, scene=links.scene)
    if fitted:
        model.fit(links)
    return model


def in_second_stage(model):
    message = model.revise(0, None, None, None)
    with torch.no_grad():
        torch.nn.init.normal_(model.gaussians.signal, generator=torch.Generator().manual_seed(1))
    return model, message


@pytest.fixture
def write(tmp_path):
    """Writes a file of lines."""

    def write(name, lines):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        return tmp_path / name

    return write


# --- the contract ---


@pytest.mark.parametrize("degree", [0, 3])
def test_it_keeps_the_contract_of_models(degree):
    gaussians = composed(*SMALL)["model"]["gaussians"] | {"degree": degree}
    check_model(
        lambda scene: build(
            "model", composed(*SMALL)["model"] | {"gaussians": gaussians}, scene=scene
        ),
        LINKS,
    )


def test_with_a_file_too(write):
    file = write("room.csv", [f"{x},{y},{z}" for x in range(4) for y in range(3) for z in range(2)])
    config = composed(*SMALL)["model"] | {"geometry": str(file)}
    check_model(lambda scene: build("model", config, scene=scene), LINKS)


# --- its stages ---


def test_it_trains_in_two_stages_and_comes_back_from_its_checkpoint(tmp_path, monkeypatch):
    options = "data.transmitters=30", "model.first_stage=0.5"
    config, metrics, model = run(
        tmp_path, monkeypatch, *SMALL, *options, "trainer.val_check_interval=4"
    )
    assert config["pooling"] == {"name": "spectrum", "channels": 1}
    assert (metrics["stage"], metrics["geometry"]) == (2, "training spectra")
    assert model.stage == 2
    assert model.gaussians.degree == 3
    assert not any(getattr(model.gaussians, name).requires_grad for name in FROZEN)
    assert model.gaussians.signal[..., 1:].abs().amin() > 0
    # The geometry is that in which the first stage ended.
    last = torch.load(tmp_path / "last.ckpt", weights_only=True)["state_dict"]
    assert all(
        torch.equal(last[f"model.gaussians.{name}"], getattr(model.gaussians, name))
        for name in FROZEN
    )


def test_density_control_ends_with_the_first_stage(tmp_path, monkeypatch):
    density = "{every: 1, start: 1, stop: 9, gradient: 0.0, split_angle: 0.3, opacity: 0.0, max_count: 50}"
    options = "data.transmitters=30", "model.first_stage=0.5", f"training.density={density}"
    _, metrics, model = run(tmp_path, monkeypatch, *SMALL, *options, "trainer.val_check_interval=4")
    assert metrics["num_gaussians_start"] == 40
    assert metrics["num_gaussians"] == len(model.gaussians) == 50
    assert model.stage == 2


def test_at_first_all_transmitters_excite_the_same():
    model = model_of()
    batch = LINKS.batch(torch.tensor([0, 2, 4]))  # of one receiver
    value = model(batch).value
    torch.testing.assert_close(value[1:], value[:1].expand(2, -1, -1))
    value.sum().backward()
    assert model.gaussians.means.grad.abs().max() > 0
    assert model.gaussians.signal.grad[..., 1:].abs().max() == 0
    assert model.facts()["stage"] == 1


def test_then_the_geometry_is_frozen_and_the_signal_begins_anew():
    model = model_of()
    before = {
        name: getattr(model.gaussians, name).detach().clone()
        for name in (*FROZEN, "opacity_logits")
    }
    message = model.revise(0, None, None, None)
    assert message == "geometry of 40 Gaussians frozen; harmonics of degree 3 from here on"
    assert all(torch.equal(getattr(model.gaussians, name), old) for name, old in before.items())
    signal = model.gaussians.signal
    assert torch.equal(signal[..., 1:], torch.zeros(40, 1, 15))
    torch.testing.assert_close(SH_DC * signal[..., 0], torch.full((40, 1), 0.5))
    batch = LINKS.batch(torch.tensor([0, 2, 4]))
    model(batch).value[0].sum().backward()
    assert all(getattr(model.gaussians, name).grad is None for name in FROZEN)
    assert signal.grad.abs().amax((0, 1)).min() > 0
    assert model.gaussians.opacity_logits.grad.abs().max() > 0


def test_weights_bring_their_stage_with_them():
    late, _ = in_second_stage(model_of())
    early = model_of()
    early.load_state_dict(late.state_dict())
    assert early.gaussians.degree == 3
    assert not early.gaussians.means.requires_grad
    early.load_state_dict(model_of().state_dict())
    assert early.gaussians.degree == 0
    assert early.gaussians.means.requires_grad


@torch.no_grad()
def test_the_rendering_equation_is_splattings_with_harmonics_towards_the_transmitter():
    model, _ = in_second_stage(model_of().double())
    gaussians, batch = model.gaussians, LINKS.batch(torch.tensor([1, 3]))
    query = batch.query
    query.transmitters = query.transmitters.double()
    signal = np.zeros((2, 40, 1))
    for b, place in enumerate(query.transmitters.numpy()):
        for i, (mean, own) in enumerate(
            zip(gaussians.means.numpy(), gaussians.signal[:, 0].numpy(), strict=True)
        ):
            x, y, z = (mean - place) / np.linalg.norm(mean - place)
            for n in range(4):
                for m in range(-n, n + 1):
                    wave = sph_harm_y(n, abs(m), math.acos(z), math.atan2(y, x))
                    term = (
                        wave.real if m == 0 else math.sqrt(2) * (wave.real if m > 0 else wave.imag)
                    )
                    signal[b, i] += own[n**2 + n + m] * term
    axes = semi_axes(gaussians.quats, gaussians.scales)[None]
    splats = model.projection.project(gaussians.means, axes, LINKS.receivers[1].pose)
    grid = LINKS.task.directions
    opacities = gaussians.opacities.expand(2, -1)
    plane = model.projection.plane(grid.to(torch.float64))
    image, _ = rasterize_densely(splats, torch.from_numpy(signal), opacities, None, plane)
    torch.testing.assert_close(model(batch).value, image[:, 0].abs(), rtol=0, atol=1e-9)


# --- rooms from files ---


@pytest.mark.parametrize("heading", [[], ["x,y,z"]])
def test_points_of_a_table(write, heading):
    corners = [[x, y, z] for x in (0, 3) for y in (0, 4) for z in (0, 2)]
    found = read_geometry(
        write("room.csv", [*heading, *(",".join(map(str, row)) for row in corners)]), 100
    )
    assert sorted(found.means.tolist()) == corners
    # The three nearest of each corner are 2 m, 3 m and the diagonal of both away.
    torch.testing.assert_close(
        found.log_scales.exp(), torch.full((8, 3), math.sqrt((4 + 9 + 13) / 3))
    )
    assert found.opacity_logits is None


def test_of_many_points_some_are_drawn(write):
    found = read_geometry(write("room.csv", [f"{k},{k * k},0" for k in range(50)]), 20)
    assert len(found.means.unique(dim=0)) == 20
    torch.testing.assert_close(found.means[:, 1], found.means[:, 0] ** 2)


def test_points_that_are_there_twice_have_a_width(write):
    found = read_geometry(write("room.csv", ["1,2,3"] * 9), 20)
    torch.testing.assert_close(found.log_scales.exp(), torch.full((9, 3), 1e-3))


@pytest.mark.parametrize(
    "faces",
    [["f 1 2 3 4"], ["f 1/1/1 2/2/2 3/3/3", "f -4 -2 -1"], ["f 1//1 2//1 3//1 4//1  # the floor"]],
)
def test_a_mesh_is_sampled_evenly(write, faces):
    torch.manual_seed(0)
    means = read_geometry(write("room.obj", [*SQUARE, "vn 0 0 1", *faces]), 4000).means
    assert torch.equal(means[:, 2], torch.ones(4000))
    cells = means[:, 0].long() * 4 + (2 * means[:, 1]).long()
    counts = cells.bincount(minlength=16)
    assert len(counts) == 16
    assert (counts - 250).abs().max() < 80  # five standard deviations


def test_a_mesh_without_faces_is_its_points(write):
    means = read_geometry(write("room.obj", SQUARE), 9).means
    assert sorted(means.tolist()) == [[0, 0, 1], [0, 2, 1], [4, 0, 1], [4, 2, 1]]


@pytest.mark.parametrize("key", ["vertex_indices", "vertex_index", None])
def test_a_ply_of_points_or_of_a_mesh(tmp_path, key):
    vertices = np.array(
        [(0, 0, 1), (4, 0, 1), (4, 2, 1), (0, 2, 1)], [(axis, "f4") for axis in "xyz"]
    )
    elements = [PlyElement.describe(vertices, "vertex")]
    if key:
        faces = np.empty(1, [(key, object)])
        faces[key][0] = np.array([0, 1, 2, 3], "i4")
        elements.append(
            PlyElement.describe(faces, "face", val_types={key: "i4"}, len_types={key: "u1"})
        )
    PlyData(elements).write(str(tmp_path / "room.ply"))
    means = read_geometry(tmp_path / "room.ply", 30).means
    assert len(means) == (30 if key else 4)
    assert torch.equal(means[:, 2], torch.ones(len(means)))
    assert means[:, :2].amin() >= 0
    assert means[:, 0].max() > 2


def test_splats_keep_their_shapes(tmp_path):
    splats = model_of().gaussians
    with torch.no_grad():
        splats.opacity_logits.copy_(splats.means[:, 0])
        splats.log_scales.copy_(splats.means)
    splats.save_ply(tmp_path / "photographs.ply")
    model = model_of(geometry=str(tmp_path / "photographs.ply"))
    nearest = torch.from_numpy(
        cKDTree(splats.means.detach()).query(model.gaussians.means.detach())[1]
    )
    assert nearest.sort().values.tolist() == [*range(40)]
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert torch.equal(getattr(model.gaussians, name), getattr(splats, name)[nearest]), name
    assert model.gaussians.signal.shape == (40, 1, 16)


def test_with_a_file_there_is_no_first_stage(write, tmp_path, monkeypatch):
    file = write("room.obj", [*SQUARE, "f 1 2 3 4"])
    options = "data.transmitters=30", f"model.geometry={file}"
    _, metrics, model = run(tmp_path / "run", monkeypatch, *SMALL, *options)
    file.unlink()  # it is in the checkpoint
    assert (metrics["stage"], metrics["geometry"], metrics["num_gaussians"]) == (2, "room.obj", 40)
    assert torch.equal(model.gaussians.means[:, 2], torch.ones(40))
    assert model.gaussians.opacity_logits.std() > 0


# --- refusals ---


def test_several_processes(monkeypatch):
    model = model_of()
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    with pytest.raises(
        ValueError, match=r"which one process can do, not 2; set trainer\.devices=1"
    ):
        model.train()(LINKS.batch(torch.arange(2)))
    assert model.eval().predict([[1.0, 1.0, 1.0]]).isfinite().all()


@pytest.mark.parametrize(
    ("name", "lines", "message"),
    [
        ("room.stl", [""], r"must be a .csv, .obj or .ply, got room.stl"),
        ("room.csv", ["x,y,z"], r"room\.csv: no positions below the header"),
        ("room.csv", ["0,0,0", "1,1,1", "2,2,2"], "at least 4 Gaussians, got 3"),
        (
            "room.csv",
            ["0,0,0", "1,nan,1"],
            "line 2: expected a finite number, got 'nan' in column y",
        ),
        ("room.obj", ["v 0 0 wall"], "line 1: expected numbers x y z, got 'v 0 0 wall'"),
        ("room.obj", [*SQUARE, "f 1 2 9"], "a face of three vertices or more of the 4 before it"),
        ("room.obj", [*SQUARE, "f 1 1 1"], "at least 4 Gaussians, got 0"),
        ("room.ply", ["solid"], "expected a .ply file of vertices x, y, z"),
    ],
)
def test_files_that_hold_no_room(write, name, lines, message):
    with pytest.raises(ValueError, match=message):
        read_geometry(write(name, lines), 10)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no geometry at .*room\.ply; set model\.geometry to"
    ):
        model_of(geometry=str(tmp_path / "room.ply"))
