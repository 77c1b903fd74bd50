"""Mirrored Gaussians in the pipeline: with the room's walls they predict as the simulator."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from pipeline import NONE, PARTS
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Split
from gaigs.data.simulation import patch_arrays, rss_dbm
from gaigs.data.synthetic import POSE, ROOM, place, respond_in_parts, spectra
from gaigs.data.synthetic.image_source import permittivity
from gaigs.model.friis import Friis
from gaigs.model.gaigs import GaussianSplatting
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes import revision
from gaigs.testing import check_model, example_links

CARRIER, BANDWIDTH = 6.4896e9, 499.2e6
EMPTY = replace(ROOM, furniture=())
MIRRORED = {"name": "mirrored", "planes": 6, "order": 2, "obstacles": 0}
OPTIONS = PARTS | NONE | {
    "gaussians": None,
    "placement": MIRRORED,
    "projection": None,
    "rasterizer": None,
    "pooling": "path_spectrum",
}  # fmt: skip
FREQUENCIES = CARRIER + torch.linspace(-2e7, 2e7, 5, dtype=torch.float64)


def build(links, **options):
    torch.manual_seed(0)
    return MirroredSplatting(links.scene, **(OPTIONS | options))


def walled(model):
    """The model with planes and materials of the built-in room; each path has a single direction."""
    placement = model.placement
    with torch.no_grad():
        for wall, material in enumerate(EMPTY.walls):
            axis, side = divmod(wall, 2)
            normal, offset = (
                torch.eye(3)[axis] * (1 if side else -1),
                EMPTY.size[axis] if side else 0.0,
            )
            placement.place(wall, torch.tensor([*normal, offset]))
            epsilon = permittivity(material, CARRIER)
            placement.log_permittivities[wall] = math.log(epsilon.real - 1)
            placement.log_conductivities[wall] = math.log(-epsilon.imag)
        placement.log_extents.fill_(20.0)
        placement.log_spreads.fill_(-10.0)
        placement.log_blurs.fill_(-10.0)
    return model


def links_of(labels, task, receiver, bandwidth=None):
    count = len(labels)
    return Links(
        query=Query(
            place(count, 0), torch.zeros(count, dtype=torch.long), torch.full((count,), CARRIER)
        ),
        receivers=(receiver,),
        labels=labels,
        task=task,
        split=Split(
            "most", torch.arange(count - 2), torch.arange(0), torch.arange(count - 2, count)
        ),
        bandwidth=bandwidth,
    )


def simulated(places, receiver, offsets, order):
    return torch.cat([*respond_in_parts(EMPTY, places, receiver, CARRIER, offsets, order)])


def room_spectra(spectrum, count=12):
    grid, receiver = (
        Grid.degrees(range(1, 91, 3), range(0, 360, 6)),
        patch_arrays([POSE], CARRIER)[0],
    )
    labels = spectra(EMPTY, place(count, 0), receiver, grid, spectrum, CARRIER, BANDWIDTH, 2)
    task = Spectrum(grid.elevations, grid.azimuths)
    return links_of(labels, task, receiver, BANDWIDTH if spectrum == "band" else 0.0)


@pytest.mark.parametrize(
    ("spectrum", "powers", "waves"), [("band", 0.03, 0.004), ("carrier", 0.08, 0.005)]
)
def test_with_the_rooms_walls_it_predicts_the_labels(spectrum, powers, waves):
    """Powers lack interference; phases lack the waves' curvature over the array alone."""
    links = room_spectra(spectrum)
    model = walled(build(links))
    batch = links.batch(torch.arange(12))
    with torch.no_grad():
        missing = (model(batch).value - batch.labels).abs().mean()
        model.placement.enable_phases(speed_of_light / CARRIER)
        errors = (model(batch).value - batch.labels).abs()
    assert waves < missing < powers
    assert errors.mean() < waves
    assert errors.max() < 0.04


BENT = Array(torch.tensor([[0, 0, 0], [0.02, -0.01, 0.03], [-0.3, 0.2, 0.1], [0.01, 0.4, -0.2]]))
"""An array that lies in no plane, over half a metre wide."""


@pytest.mark.parametrize(
    "array", [Array.planar(2, 2, speed_of_light / CARRIER / 2), BENT], ids=["planar", "bent"]
)
def test_with_the_rooms_walls_it_predicts_channels(array):
    """Also 100 MHz away, at subcarriers that no label had."""
    receiver = Receiver("gateway1", POSE, array)
    both = FREQUENCIES, FREQUENCIES[1:] + 1e8
    labels = [
        simulated(place(12, 0), receiver, part - CARRIER, 2).to(torch.complex64) for part in both
    ]
    links = links_of(labels[0], Csi(4, FREQUENCIES), receiver)
    model = walled(build(links, pooling="path_csi"))
    model.placement.enable_phases(speed_of_light / CARRIER)
    for expected, frequencies in zip(labels, both, strict=True):
        found = model.predict(links.query, frequencies=frequencies)
        assert found.dtype == torch.complex64
        noise = (found - expected).abs().square().sum((1, 2)) / expected.abs().square().sum((1, 2))
        assert -10 * noise.log10().mean() > 45


def test_the_search_of_channels_starts_from_the_users_walls(monkeypatch):
    receiver = Receiver("gateway1", POSE, BENT)
    labels = simulated(place(12, 0), receiver, FREQUENCIES - CARRIER, 1).to(torch.complex64)
    links = links_of(labels, Csi(4, FREQUENCIES), receiver)
    model = walled(build(links, pooling="path_csi"))
    model.placement.walls = "walls.obj"
    walls = model.placement.planes[model.placement.used].clone()
    search = Mock(side_effect=StopIteration)
    monkeypatch.setattr("gaigs.model.mirrored.ChannelSearch", search)
    with pytest.raises(StopIteration):
        model._fit_channels(links, links.task, model.pooling)
    assert len(walls) == 6
    torch.testing.assert_close(search.call_args.args[-1], walls)


@pytest.mark.parametrize("conjugated", [False, True])
@pytest.mark.parametrize(
    "array", [Array.planar(2, 2, 0.02, "cosine"), BENT], ids=["planar", "bent"]
)
def test_channels_start_from_free_space(array, conjugated):
    """Those of few numbers, as ``friis`` has it: gain and phase of each of two receivers, in either
    time convention.
    """
    poses = POSE, replace(POSE, position=torch.tensor([4.0, 3.0, 2.0]))
    receivers = tuple(Receiver(f"gateway{k}", pose, array) for k, pose in enumerate(poses))
    offsets, places, gains = FREQUENCIES[:1] - CARRIER, place(60, 0), (3e-3j, 50.0 - 20j)
    each = [simulated(places, receiver, offsets, 1) for receiver in receivers]
    each = [gain * waves for gain, waves in zip(gains, each, strict=True)]
    labels = torch.stack(each, 1).flatten(0, 1).to(torch.complex64)
    links = Links(
        query=Query(places.repeat_interleave(2, 0), torch.arange(2).repeat(60)),
        receivers=receivers,
        labels=labels.conj().resolve_conj() if conjugated else labels,
        task=Csi(4, FREQUENCIES[:1]),
        split=Split("most", torch.arange(80), torch.arange(80, 100), torch.arange(100, 120)),
    )
    fixed = MIRRORED | {"obstacles": 9, "fixed": True}  # without a search
    model = build(links, pooling="path_csi", placement=fixed)
    model.fit(links)
    free_space = Friis(links.scene)
    split = links.split
    free_space.fit(
        replace(links, split=Split("train", split.train, split.validation[:0], split.validation))
    )
    assert model.predicts_untrained
    with torch.no_grad():
        found, expected = (part(links.batch(split.test)).value for part in (model, free_space))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3 * expected.abs().max().item())
    model.placement.enable_reflections()
    with torch.no_grad():
        assert (
            model(links.batch(split.test)).value - expected
        ).abs().max() > 0.1 * expected.abs().max()


def test_channels_of_order_0_need_no_planes():
    links = example_links("csi")
    model = build(links, pooling="path_csi", placement=MIRRORED | {"order": 0})
    model.fit(links)
    assert model.predict(links.query).isfinite().all()


def test_obstacles_stay_where_a_few_numbers_tell_nothing():
    receiver = Receiver("rx", POSE, Array(torch.zeros(1, 3)))
    offsets = torch.zeros(1, dtype=torch.float64)
    labels = simulated(place(20, 0), receiver, offsets, 1).to(torch.complex64)
    task = Csi(1, torch.tensor([CARRIER], dtype=torch.float64))
    links = links_of(labels, task, receiver)
    model = build(links, pooling="path_csi", placement=MIRRORED | {"obstacles": 5})
    model.fit(links)
    placement = model.placement
    assert placement.receiver_gains.requires_grad
    assert not any(part.requires_grad for part in placement.obstacles.parameters())


def test_with_the_rooms_walls_it_predicts_signal_strength():
    """Relative to that at a metre of free space; paths interfere by a decibel or two."""
    receiver = Receiver("gateway1", POSE)
    offsets = torch.linspace(-BANDWIDTH / 2, BANDWIDTH / 2, 201, dtype=torch.float64)
    rss = rss_dbm(simulated(place(12, 0), receiver, offsets, 2)).float()
    links = links_of(rss, Rssi(), receiver, BANDWIDTH)
    model = walled(build(links, pooling={"name": "path_rssi", "floor_db": -100.0}))
    at_a_metre = 20 * math.log10(speed_of_light / CARRIER / (4 * math.pi))
    with torch.no_grad():
        powers = model(links.batch(torch.arange(12))).value + at_a_metre
        model.placement.enable_phases(speed_of_light / CARRIER)
        band = model(links.batch(torch.arange(12))).value + at_a_metre
    assert 0.5 < (powers - rss).abs().mean() < 2
    assert (band - rss).abs().mean() < 0.1


@pytest.mark.parametrize("draws_map", [True, False])
@pytest.mark.parametrize("gaussians", [None, PARTS["gaussians"]])
def test_the_model_contract_holds(draws_map, gaussians):
    placement = MIRRORED | {"planes": 7, "obstacles": 3, "order": 1}
    parts = {"gaussians": gaussians, "placement": placement}
    if draws_map:
        parts |= {"projection": "mercator", "rasterizer": "torch", "pooling": "array_response"}
    links = example_links("spectrum", 5e9)

    def make(scene):
        torch.manual_seed(1)
        return MirroredSplatting(scene, **(OPTIONS | parts))

    check_model(make, links)


def test_levels_need_no_carrier():
    """Powers of a single element are the same at any frequency."""
    pooling = {"name": "path_rssi", "floor_db": -60.0}
    unknown, known = example_links("rssi"), example_links("rssi", 5e9)
    model = build(unknown, pooling=pooling)
    other = build(known, pooling=pooling)
    other.load_state_dict(model.state_dict())
    index = torch.arange(6)
    torch.testing.assert_close(model(unknown.batch(index)).value, other(known.batch(index)).value)
    check_model(
        lambda scene: build(replace(unknown, receivers=scene.receivers), pooling=pooling), unknown
    )


def test_paths_to_several_gateways_are_summed_at_once():
    links = example_links("rssi", 5e9)
    model = build(links, pooling="path_rssi")
    model.placement.enable_phases(0.06)
    batch = links.batch(torch.arange(12))
    assert model.pooling.is_same_for_all
    together = model(batch).value
    model.pooling.is_same_for_all = False
    torch.testing.assert_close(model(batch).value, together)


def test_gradients_reach_all_that_paths_have():
    links = room_spectra("band", count=5)
    model = build(links, placement=MIRRORED | {"obstacles": 5})
    model.placement.enable_phases(speed_of_light / CARRIER)
    value, penalties = model(links.batch(torch.arange(5)))
    assert list(penalties) == ["obstacles"]
    (value.square().mean() + penalties["obstacles"]).backward()
    # Spectra are scaled to their range, and no box has been found.
    silent = {"placement.receiver_gains", "placement.obstacles.box_depths"}
    for name, parameter in model.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any() or name in silent, name


# --- refusals ---


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"projection": "mercator"},
            "'path_spectrum' takes paths, and no map is projected or rasterized\nleave out",
        ),
        (
            {"pooling": "spectrum"},
            "'spectrum' takes a map, which needs a projection and a rasterizer\nset proj",
        ),
        (
            {"pooling": "path_rssi"},
            r"'path_rssi' gives \(\), not labels of task 'spectrum', \(18, 36\);",
        ),
        (
            {"placement": {"name": "free"}},
            r"takes placement=mirrored, got free; take \+experiment=mirrored",
        ),
    ],
)
def test_parts_that_do_not_go_together_are_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        build(example_links("spectrum", 5e9), **parts)


def test_mirrored_gaussians_are_refused_under_the_papers_name():
    links = example_links("spectrum", 5e9)
    with pytest.raises(
        ValueError, match=r"placement 'mirrored' makes another predictor; set model=mirrored"
    ):
        GaussianSplatting(links.scene, **OPTIONS)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_refused(dtype):
    links = room_spectra("band", 4)
    model, batch = build(links), links.batch(links.split.train)
    with (
        torch.autocast("cpu", torch.bfloat16),
        pytest.raises(ValueError, match=r"set trainer\.precision to 32-true"),
    ):
        model(batch)
    with pytest.raises(ValueError, match=r"set trainer\.precision to 32-true"):
        model.to(dtype)(batch)


# --- revisions ---


@torch.no_grad()
def test_phases_come_with_planes_that_move():
    receiver, offsets = (
        Receiver("gateway1", POSE),
        torch.linspace(-BANDWIDTH / 2, BANDWIDTH / 2, 51).double(),
    )
    rss = rss_dbm(simulated(place(12, 0), receiver, offsets, 1)).float()
    links = links_of(
        rss - 20 * math.log10(speed_of_light / CARRIER / (4 * math.pi)), Rssi(), receiver
    )
    pooling = {"name": "path_rssi", "floor_db": -100.0}
    model = walled(build(links, placement=MIRRORED | {"order": 1}, pooling=pooling))
    placement, batch = model.placement, links.batch(torch.arange(12))

    def loss(batch):
        return (model(batch).value - batch.labels).abs().mean().item()

    assert model.revise(2, batch, None, loss).startswith("phases count; planes moved by ")
    assert placement.coherent
    placement.log_bandwidth.fill_(math.log(BANDWIDTH))
    placement.kept &= placement.sequences_of(torch.tensor([2]))
    batch = replace(batch, labels=model(batch).value)
    placement.origin[2, 3] += 0.02
    wrong = loss(batch)
    (moved,) = revision.move_planes(model, batch, speed_of_light / CARRIER, 0.0)
    assert abs(moved + 0.02) < speed_of_light / CARRIER / 10
    assert loss(batch) < 0.2 * wrong
    assert model.revise(4, batch, batch, loss).endswith(f"-> {loss(batch):.4f}")


@torch.no_grad()
def test_tilted_plane_is_turned_square_to_the_others():
    links, wavelength = room_spectra("carrier", 24), speed_of_light / CARRIER
    model, batch = walled(build(links)), links.batch(torch.arange(24))
    planes = model.placement.origin
    right = planes.clone()
    planes[0, :3] = torch.nn.functional.normalize(
        planes[0, :3] + torch.tensor([0.0, 0.06, 0.04]), dim=0
    )
    planes[0, 3] += 0.05
    revision.move_planes(model, batch, wavelength, 0.0)
    torch.testing.assert_close(planes, right, rtol=0, atol=wavelength / 20)


@torch.no_grad()
@pytest.mark.parametrize("phase", ["known", "per_link"])
def test_plane_of_channels_moves_to_its_phases(phase):
    """Also if their phase is unknown, one is silent, and all are faint."""
    receiver, places = Receiver("gateway1", POSE, BENT), place(24, 0)
    labels = 1e-21 * simulated(places, receiver, FREQUENCIES[:1] - CARRIER, 1)
    if phase == "per_link":
        labels = -labels
    labels[5] = 0
    links = links_of(labels.to(torch.complex64), Csi(4, FREQUENCIES[:1], phase), receiver)
    model = walled(build(links, pooling="path_csi", placement=MIRRORED | {"order": 1}))
    model.placement.enable_phases(speed_of_light / CARRIER)
    model.placement.receiver_gains.fill_(math.log(1e-21))
    right = model.placement.origin.clone()
    model.placement.origin[2, 3] += 0.02
    revision.move_planes(model, links.batch(torch.arange(24)), speed_of_light / CARRIER, 0.0)
    torch.testing.assert_close(model.placement.origin, right, rtol=0, atol=0.006)


def test_a_search_by_phases_is_bounded_in_a_large_room(monkeypatch, caplog):
    links = room_spectra("band", 6)
    model, reaches = build(links), []
    monkeypatch.setattr(
        revision, "move_plane", lambda *arguments: reaches.append(arguments[2]) or 0.0
    )
    caplog.set_level("INFO")
    for least in (0.2, 1000.0):
        revision.move_planes(model, links.batch(torch.arange(4)), 0.06, least)
    assert {*reaches} == {4 * 0.06, 50 * 0.06}
    assert "planes are searched within 3 m, not 1e+03 m" in caplog.text


def test_fixed_planes_do_not_move_and_unknown_carriers_have_no_phases():
    links = room_spectra("band", 6)
    model, batch = build(links, placement=MIRRORED | {"fixed": True}), links.batch(torch.arange(4))
    before = model.placement.offsets
    lines = [model.revise(number, batch, None, lambda batch: 1.0) for number in (0, 2)]
    assert lines == ["planes stay where they are", "phases count"]
    torch.testing.assert_close(model.placement.offsets, before)
    links = example_links("rssi")
    pooling = {"name": "path_rssi", "floor_db": -60.0}
    line = build(links, pooling=pooling).revise(
        2, links.batch(torch.arange(4)), None, lambda batch: 1.0
    )
    assert line == "frequencies are unknown, so powers add to the end"


@pytest.mark.parametrize("widest", [1000.0, 1.0])
def test_levels_of_a_wide_site_are_not_searched_for_phases(widest, monkeypatch):
    monkeypatch.setattr(MirroredSplatting, "widest", widest)
    links = example_links("rssi")
    carriers = torch.full((len(links),), CARRIER)
    links = replace(links, query=replace(links.query, frequencies=carriers))
    model = build(links, pooling={"name": "path_rssi", "floor_db": -60.0})
    model.fit(links)
    assert (model.levels is None) == model.is_wide == model.settles == (widest == 1.0)
    if model.is_wide:
        line = model.revise(2, links.batch(torch.arange(4)), None, lambda batch: 1.0)
        assert line == "the box is too wide for phases, so powers add to the end"
    fixed = build(
        links,
        pooling={"name": "path_rssi", "floor_db": -60.0},
        placement=MIRRORED | {"fixed": True},
    )
    fixed.fit(links)
    assert fixed.levels is None
    assert fixed.is_wide == model.is_wide


def test_a_loaded_model_exports_its_planes(tmp_path):
    links = room_spectra("band")
    model = build(links)
    model.load_state_dict(walled(build(links)).state_dict())
    model.export(tmp_path)
    vertices = [
        line.split()[1:]
        for line in (tmp_path / "planes.obj").read_text().splitlines()
        if line[:2] == "v "
    ]
    vertices = torch.tensor([[float(value) for value in vertex] for vertex in vertices])
    assert torch.allclose(vertices.amin(0), torch.zeros(3), atol=1e-3)
    assert torch.allclose(vertices.amax(0), torch.tensor(EMPTY.size), atol=1e-3)
