"""Ray tracing as a model: its fields against Sionna RT's and a plain transcription, its rooms, its
calibration.
"""

import functools
import importlib
import itertools
import math
import shutil
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import splatting
import torch
from gaigs_sionna.meshes import THICKNESS, Cuboid, edges
from gaigs_sionna.rooms import ROOMS
from scipy.constants import epsilon_0, speed_of_light
from splatting import composed, repository

import gaigs
from gaigs import runs
from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import load, synthetic
from gaigs.data.synthetic.image_source import MATERIALS
from gaigs.io.meshes import wavefront_obj
from gaigs.registry import registry
from gaigs.testing import check_model, example_links

ROOT = Path(__file__).parents[2]
CARRIER = 5e9
OPTIONS = {
    "name": "ray_tracing", "room": "built_in", "mesh": None, "materials": {}, "frequency": None, "depth": 2,
    "rays": 2000,
}  # fmt: skip
WALLS = {"floor": "brick", "west wall": "mat-itu_wood", "others": "concrete"}


@functools.cache
def module(name):
    """A module of the plug-in."""
    with repository():
        registry("model").get("ray_tracing")
    return importlib.import_module(f"gaigs_ray_tracing.{name}")


def build(scene, calibrate=True, **options):
    return splatting.build("model", OPTIONS | {"calibrate": calibrate} | options, scene=scene)


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A file of a hall in which all that ``example_links`` has stands, with a metal chest in it."""
    shell = Cuboid("hall", WALLS["others"], (-0.5, -0.5, -0.2), (6.5, 4.6, 3.0)).mesh()
    parts = [
        replace(shell, name="floor", material=WALLS["floor"], faces=(shell.faces[0],)),
        replace(shell, name="west wall", material=WALLS["west wall"], faces=(shell.faces[4],)),
        replace(shell, name="others", faces=tuple(shell.faces[k] for k in (1, 2, 3, 5))),
        Cuboid("chest", "metal", (2.6, 1.2, -0.1), (3.2, 1.7, 0.6), 20.0).mesh(),
    ]
    file = tmp_path_factory.mktemp("hall") / "hall.obj"
    file.write_text(wavefront_obj(parts))
    return file


# --- the rendering equation ---


def slab(epsilon, thickness, cosine, frequency):
    """ITU-R P.2040-3: reflection TE, TM and passage TE, TM of a slab in air."""
    root = np.sqrt(epsilon - (1 - cosine**2))
    te = (cosine - root) / (cosine + root)
    tm = (epsilon * cosine - root) / (epsilon * cosine + root)
    q = 2 * math.pi * thickness * frequency / speed_of_light * root
    found = []
    for r in (te, tm):
        inside = 1 - r**2 * np.exp(-2j * q)
        found.append((r * (1 - np.exp(-2j * q)) / inside, (1 - r**2) * np.exp(-1j * q) / inside))
    (r_te, t_te), (r_tm, t_tm) = found
    return r_te, r_tm, t_te, t_tm


def unit(vector):
    return vector / np.linalg.norm(vector)


def meridian(direction):
    """The unit vector down the meridian, across a direction."""
    x, y, z = direction
    flat = math.hypot(x, y)
    return np.array([x * z / flat, y * z / flat, -flat])


def transcribed(points, normals, kinds, epsilons, thicknesses, frequency):
    """The vertical field that a path brings, by following the field's vector from point to point."""
    way = [unit(b - a) for a, b in itertools.pairwise(points)]
    field = meridian(way[0]).astype(complex)
    for k, (normal, kind) in enumerate(zip(normals, kinds, strict=True)):
        here, after = way[k], way[k + 1]
        r_te, r_tm, t_te, t_tm = slab(epsilons[k], thicknesses[k], abs(here @ normal), frequency)
        across = unit(np.cross(here, normal))
        te, tm = field @ across, field @ np.cross(across, here)
        if kind == "reflected":
            field = r_te * te * across + r_tm * tm * np.cross(across, after)
        else:
            field = t_te * te * across + t_tm * tm * np.cross(across, here)
    return field @ meridian(way[-1])


@pytest.mark.parametrize("seed", range(4))
def test_gains_are_those_of_a_field_that_is_followed_from_point_to_point(tracer, seed, monkeypatch):
    """Random surfaces that a random path meets; the plug-in is given its points alone."""
    fields, tracing = module("fields"), module("tracer")
    rng = np.random.default_rng(seed)
    kinds = [("reflected", "passed")[k] for k in rng.integers(2, size=3)]
    points, normals = [rng.normal(size=3)], []
    way = unit(rng.normal(size=3))
    for kind in kinds:
        points.append(points[-1] + rng.uniform(0.5, 3) * way)
        normal = unit(rng.normal(size=3))
        normals.append(normal)
        way = way - 2 * (way @ normal) * normal if kind == "reflected" else way
    points.append(points[-1] + rng.uniform(0.5, 3) * way)
    names = rng.permutation(sorted(MATERIALS))[:3]
    epsilons, thicknesses = (
        rng.uniform(1.5, 8, 3) - 1j * rng.uniform(0.01, 2, 3),
        rng.uniform(0.005, 0.2, 3),
    )

    sheets = []
    for k, (point, normal) in enumerate(zip(points[1:-1], normals, strict=True)):
        along = unit(np.cross(normal, rng.normal(size=3)))
        corners = [
            point + u * along + v * np.cross(normal, along) for u, v in ((-1, -1), (1, -1), (0, 2))
        ]
        sheets.append(
            f"o sheet{k}\nusemtl {names[k]}\n" + "".join("v {} {} {}\n".format(*c) for c in corners)
        )
    text = "".join(
        f"{sheet}f {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k, sheet in enumerate(sheets)
    )
    known = {str(name): str(name) for name in names}
    own = tracing.Tracer(text, known, points[-1][None], CARRIER, 3, 100)
    types = np.array([[{"reflected": 1, "passed": 4}[kind] for kind in kinds]])
    traced = own._paths(
        points[0][None], points[-1][None], np.ones(1, complex), types, np.arange(3)[None], np.zeros((1, 3), int),
        np.array(points[1:-1])[None],
    )  # fmt: skip
    order = [sorted(names).index(name) for name in names]
    media = fields.Slabs(
        torch.from_numpy(epsilons[np.argsort(order)]),
        torch.from_numpy(thicknesses[np.argsort(order)]),
        CARRIER,
    )
    paths = fields.padded([traced], torch.from_numpy(points[-1]))
    (gain,) = fields.gains(paths, media)[0].tolist()
    expected = transcribed(points, normals, kinds, epsilons, thicknesses, CARRIER)
    assert gain == pytest.approx(expected, abs=1e-5)
    length = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(points))
    np.testing.assert_allclose(paths.images[0, 0], points[-1] - length * way, atol=1e-5)


def test_fields_are_those_of_sionna(tracer, monkeypatch):
    """Reflected and passed paths in a room with a leaning wall and furniture, field by field."""
    tracing, fields, rooms = module("tracer"), module("fields"), module("rooms")
    room = ROOMS["slanted"]
    known = rooms.known_materials(room.meshes(), {})
    receiver, places = (
        room.pose().position,
        [(3.6, 2.9, 0.8), (1.5, 3.2, 0.7)],
    )  # the first behind a screen of glass
    own = tracing.Tracer(
        wavefront_obj(room.meshes()), known, receiver[None].double().numpy(), CARRIER, 2, 2000
    )
    heard, follow = [], own._paths
    monkeypatch.setattr(own, "_paths", lambda *given: heard.append(given) or follow(*given))
    links = [link for (link,) in own._trace(places)]
    ((_, _, expected, types, *_),) = heard
    paths = fields.padded(links, receiver)
    real, c, d = np.array([MATERIALS[known[name]] for name in sorted(known)]).T
    epsilons = real - 1j * c * (CARRIER / 1e9) ** d / (2 * math.pi * CARRIER * epsilon_0)
    thicknesses = torch.tensor(
        [THICKNESS[known[name]] for name in sorted(known)], dtype=torch.float64
    )
    found = fields.gains(paths, fields.Slabs(torch.from_numpy(epsilons), thicknesses, CARRIER))
    lengths = (paths.images - receiver).norm(dim=-1)
    arrived = (found * speed_of_light / CARRIER / (4 * math.pi * lengths))[
        paths.strengths != 0
    ].numpy()
    assert (types == 1).any()
    assert (types == 4).any()
    assert (types == 8).any(), "diffracted ones are among them"
    np.testing.assert_allclose(arrived, expected, rtol=0, atol=1e-4 * abs(expected).max())


def test_the_ray_tracers_own_labels_come_back(tracer):
    """Spectra of a room that Sionna RT simulated, from other places at a time and the other end of
    each path.
    """
    links = load(
        {"name": "sionna", "room": "slanted", "transmitters": 10},
        {"name": "official", "validation": 0},
    )
    model = build(links.scene, calibrate=False, room="slanted", depth=3, rays=5000)
    model.fit(links)
    scores = links.task.scores(links.labels, model.predict(links.query))["ssim"]
    assert scores.median() > 0.98


# --- the contract ---


@pytest.mark.parametrize("calibrate", [True, False])
@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_it_keeps_the_contract_of_models(tracer, hall, task, calibrate):
    links = example_links(task, carrier=None if task == "csi" else CARRIER)
    check_model(lambda scene: build(scene, calibrate, mesh=str(hall)), links)


def test_a_checkpoint_needs_neither_the_mesh_nor_the_data(tracer, hall, tmp_path):
    links, file = example_links("csi"), tmp_path / "mine.obj"
    shutil.copy(hall, file)
    model = build(links.scene, mesh=str(file))
    model.fit(links)
    file.unlink()
    twin = build(Scene.from_state(links.scene.state()), mesh=str(file))
    twin.load_state_dict(model.state_dict())
    assert torch.equal(twin.predict(links.query), model.predict(links.query))
    assert (
        twin.facts()["materials"].keys()
        == model.facts()["materials"].keys()
        == {*WALLS.values(), "metal"}
    )


def test_places_of_the_data_are_traced_once_and_few_others_are_kept(tracer, hall, monkeypatch):
    links = example_links("rssi", carrier=CARRIER)
    model = build(links.scene, mesh=str(hall))
    model.fit(links)
    own = model._tracer(CARRIER)
    traced, trace = [], own._trace
    monkeypatch.setattr(own, "_trace", lambda places: traced.append(len(places)) or trace(places))
    monkeypatch.setattr(module("tracer"), "MOST", 4)  # two places, for two receivers
    model.predict(links.query)
    assert traced == []
    elsewhere = torch.tensor([[1.0, 1.1, 1.2], [1.3, 1.4, 1.5], [1.0, 1.1, 1.2]])
    first = model.predict(elsewhere, 0)
    assert torch.equal(model.predict(elsewhere, receiver=0), first)
    assert traced == [2]
    model.predict(elsewhere[0] + 0.1)
    assert len(own.others) == 1


# --- the tasks ---


def test_levels_are_fitted_to_the_training_links(tracer, hall):
    links = example_links("rssi", carrier=CARRIER)
    model = build(links.scene, calibrate=False, mesh=str(hall))
    model.fit(links)
    before = model.predict(links.query)
    louder = replace(links, labels=before + torch.where(links.query.receivers == 0, 7.0, -3.0))
    model.fit(louder)
    torch.testing.assert_close(model.predict(links.query), louder.labels, rtol=0, atol=1e-3)


def test_a_receiver_without_training_links_has_the_others_gain(tracer, hall):
    links = example_links("rssi", carrier=CARRIER)
    links = replace(links, receivers=(*links.receivers, replace(links.receivers[0], name="new")))
    model = build(links.scene, calibrate=False, mesh=str(hall))
    model.fit(links)
    gains = model.log_gains[:, 0]
    assert gains[-1] == gains[:-1].median()
    assert gains[-1] != 0


@pytest.mark.parametrize("conjugated", [False, True])
def test_gains_and_the_sign_of_phases_are_fitted_to_channels(tracer, hall, conjugated):
    links = example_links("csi")
    model = build(links.scene, calibrate=False, mesh=str(hall))
    model.fit(links)
    channels = model.predict(links.query)
    if conjugated:
        channels = channels.conj().resolve_conj()
    gains = torch.tensor([3.0 * np.exp(0.5j), 0.1 * np.exp(-2j)]).to(torch.complex64)
    model.fit(replace(links, labels=gains[links.query.receivers][:, None, None] * channels))
    expected = gains[links.query.receivers][:, None, None] * channels
    torch.testing.assert_close(model.predict(links.query), expected, rtol=1e-4, atol=1e-6)


def test_readings_of_an_unknown_band_add_powers(tracer, hall):
    """Their carrier is an option, too, as such data say none."""
    links = example_links("rssi")
    with pytest.raises(ValueError, match="each link must have a frequency"):
        build(links.scene, mesh=str(hall)).fit(links)
    model = build(links.scene, calibrate=False, mesh=str(hall), frequency=CARRIER)
    model.fit(links)
    model.log_gains.zero_()
    found = model.predict(links.query[:4])
    fields = module("fields")
    for row in range(4):
        receiver = int(links.query.receivers[row])
        position = links.receivers[receiver].pose.position
        paths = fields.padded(
            model._tracer(CARRIER).find(links.query.transmitters[row : row + 1], receiver), position
        )
        lengths = (paths.images - position).norm(dim=-1)
        fields_of = (
            fields.gains(paths, model.slabs(CARRIER)).abs()
            * speed_of_light
            / CARRIER
            / (4 * math.pi * lengths)
        )
        assert found[row].item() == pytest.approx(
            10 * math.log10(fields_of.square().sum().item()), abs=1e-3
        )


def test_where_no_path_leads_a_reading_is_low_and_finite(tracer, hall):
    links = example_links("rssi", carrier=CARRIER)
    model = build(links.scene, calibrate=False, mesh=str(hall))
    model.fit(links)
    model.log_gains.zero_()
    assert model.predict([2.9, 1.45, 0.3], 0).item() == pytest.approx(-150)  # in the chest


# --- calibration ---


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_descent_finds_what_the_walls_are_made_of(tracer, hall, task):
    links = example_links(task, carrier=None if task == "csi" else CARRIER)
    model = build(links.scene, mesh=str(hall))
    model.fit(links)
    walls = list(model.known).index("concrete")
    with torch.no_grad():
        model.log_permittivities[walls], model.log_conductivities[walls] = 0.15, 0.4
        links = replace(links, labels=model.predict(links.query))
        model.log_permittivities.zero_()
        model.log_conductivities.zero_()
    batch = Batch(links.query, links.task.directions)
    optimizer, errors = (
        torch.optim.Adam([model.log_permittivities, model.log_conductivities], lr=0.02),
        [],
    )
    for _ in range(60):
        error = (model(batch).value - links.labels).abs().square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.05 * errors[0]
    assert model.log_permittivities[walls].item() == pytest.approx(0.15, abs=0.05)
    assert model.log_conductivities[walls].item() == pytest.approx(0.4, abs=0.2)
    materials = model.facts()["materials"]
    assert materials["concrete"]["permittivity"] > MATERIALS["concrete"][0] + 0.3
    assert materials["metal"]["permittivity"] == 1


# --- rooms ---


def test_the_built_in_room_is_the_simulated_one():
    rooms = module("rooms")
    meshes = rooms.find_meshes("synthetic_rssi", None)

    def lines(segments):
        return {tuple(sorted(tuple(round(x, 4) for x in end) for end in line)) for line in segments}

    shell = [mesh for mesh in meshes if mesh.name == "room"]
    furniture = [mesh for mesh in meshes if mesh.name != "room"]
    assert lines(edges(furniture).tolist()) < lines(synthetic.edges(synthetic.ROOM).tolist())
    assert sorted((mesh.material, len(mesh.faces)) for mesh in shell) == [
        ("brick", 1),
        ("concrete", 4),
        ("glass", 1),
    ]
    known = rooms.known_materials(meshes, {})
    assert {box.name for box in synthetic.ROOM.furniture} < known.keys()
    assert known["refrigerator"] == "metal"


WALL = '<bsdf type="itu-radio-material" id="wall"><string name="type" value="{}"/></bsdf>'
LEAF = '<shape type="{}" id="leaf">{}<ref id="wall" name="bsdf"/></shape>'
FAR = LEAF.format("ply", '<string name="filename" value="far.ply"/>')
PLY = """ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z
element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1e9 0 0\n0 1 0\n3 0 1 2\n"""


def scene(material, shape):
    return f'<scene version="2.1.0">{WALL.format(material)}{shape}</scene>'


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("room.obj", "v 0 0", "line 1: expected numbers x y z, got 'v 0 0'"),
        (
            "room.obj",
            "v 0 0 0\nf 1 2 3",
            "line 2: expected a face of three vertices or more of the 1 before it",
        ),
        (
            "room.obj",
            "v 0 0 nan\nv 0 1 0\nv 1 0 0\nf 1 2 3",
            "line 1: expected numbers x y z, got 'v 0 0 nan'",
        ),
        ("room.obj", "v 0 0 0", "must hold surfaces, and holds none"),
        ("room.stl", "solid", r"model\.mesh must be a file \.obj, \.ply, \.xml, got .*room\.stl"),
        ("room.ply", "no mesh", r"expected a \.ply file of vertices"),
        ("room.xml", "no mesh", "must be a scene that Sionna RT"),
        (
            "room.xml",
            scene("wood", LEAF.format("rectangle", "")),
            "shape '.*', must be a mesh of type ply or obj",
        ),
        (
            "room.xml",
            scene("gold", LEAF.format("rectangle", "")),
            "must be a scene that Sionna RT reads, .*gold",
        ),
        (
            "room.xml",
            scene("wood", "<shape>"),
            "must be a scene that Sionna RT reads, and is not: ",
        ),
        ("room.xml", scene("wood", FAR), "shape .*: expected positions"),
    ],
)
def test_a_damaged_file_gives_one_line(tmp_path, tracer, name, text, message):
    (tmp_path / "far.ply").write_text(PLY)
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        module("rooms").find_meshes("none", str(tmp_path / name))
    assert "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match=r"no mesh at nowhere\.ply"):
        module("rooms").find_meshes("none", "nowhere.ply")


@pytest.mark.parametrize(
    ("data", "room"),
    [
        (("data=synthetic",), "synthetic"),
        (("+experiment=rssi",), "synthetic_rssi"),
        (("+experiment=csi",), "synthetic_csi"),
        (("data=sionna", "data.room=l_shape"), "l_shape"),
        (("data=sionna_rssi",), "furnished"),
    ],
)
def test_data_say_which_room_it_is(data, room):
    config = composed(*data, "model=ray_tracing")["model"]
    assert config["room"] == room
    module("rooms").check_room(room)


def test_files_of_all_kinds_hold_the_same_room(tracer, hall, tmp_path):
    from plyfile import PlyData, PlyElement

    rooms = module("rooms")
    expected = rooms.find_meshes("none", str(hall))
    shapes = []
    for k, mesh in enumerate(expected):
        corners = np.array(
            [tuple(corner) for corner in mesh.vertices], dtype=[(axis, "f4") for axis in "xyz"]
        )
        faces = np.array(
            [(face,) for face in mesh.triangles()], dtype=[("vertex_indices", "i4", (3,))]
        )
        elements = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(elements).write(tmp_path / f"{k}.ply")
        (found,) = rooms.find_meshes("none", str(tmp_path / f"{k}.ply"))
        assert (found.material, found.faces) == ("unnamed", tuple(mesh.triangles()))
        np.testing.assert_allclose(found.vertices, mesh.vertices, atol=1e-6)
        kind = mesh.material.removeprefix("mat-itu_")
        shapes.append(
            f'<bsdf type="itu-radio-material" id="mat{k}"><string name="type" value="{kind}"/>'
            f'<float name="thickness" value="0.1"/></bsdf><shape type="ply" id="mesh-{k}">'
            f'<string name="filename" value="{k}.ply"/><ref id="mat{k}" name="bsdf"/></shape>'
        )
    (tmp_path / "hall.xml").write_text(f'<scene version="2.1.0">{"".join(shapes)}</scene>')
    found = rooms.find_meshes("none", str(tmp_path / "hall.xml"))
    assert len(found) == len(expected)

    def lines(meshes):
        return sorted(sorted(map(tuple, line)) for line in edges(meshes).round(decimals=4).tolist())

    assert lines(found) == lines(expected)
    chosen = {f"mat{k}": "wood" for k in range(len(expected))}
    assert rooms.known_materials(found, {name: chosen[name] for name in chosen}) == chosen


def test_an_obj_has_faces_of_many_corners_counted_from_either_end():
    rooms = module("rooms")
    text = (
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0  # a comment\nf 1/1 2/2 3/3 4/4\nusemtl glass\nf -4 -3 "
        "-2\n"
    )
    first, second = rooms.read_obj(text, "file")
    assert (first.material, first.faces) == ("unnamed", ((0, 1, 2, 3),))
    assert (second.material, second.faces, second.vertices[2]) == ("glass", ((0, 1, 2),), (1, 1, 0))


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({}, r"material 'paint' must be one of concrete, .*: \+model\.materials\.paint=concrete"),
        ({"paint": "gold"}, "material 'paint' must be one of .*, got 'gold'"),
        ({"paint": "wood", "rug": "wood"}, "model.materials has rug, and the materials are paint"),
    ],
)
def test_unknown_materials_are_refused(chosen, message):
    rooms = module("rooms")
    meshes = rooms.read_obj("usemtl paint\nv 0 0 0\nv 0 1 0\nv 1 0 0\nf 1 2 3", "file")
    with pytest.raises(ValueError, match=message):
        rooms.known_materials(meshes, chosen)
    assert rooms.known_materials(meshes, {"paint": "wood"}) == {"paint": "wood"}


# --- refusals ---


def test_a_missing_package_gives_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    links = example_links("rssi", carrier=CARRIER)
    model = build(links.scene)
    monkeypatch.setattr(metadata, "version", missing)
    with pytest.raises(ImportError, match=r"need sionna-rt: pip install sionna-rt"):
        model.fit(links)


# --- a whole run ---


def test_a_run_stores_the_materials(tracer, tmp_path):
    config = composed(
        "+experiment=csi", "model=ray_tracing", "model.depth=2", "model.rays=2000", "data.transmitters=14",
        "data.subcarriers=3", "trainer.max_steps=4", "trainer.val_check_interval=2", "trainer.accelerator=cpu",
        "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false", "training.batch_size=4",
        "baselines=[{name: mean}]",
    )  # fmt: skip
    with repository():
        metrics = runs.run(config, tmp_path / "run")
        model = gaigs.load(tmp_path / "run/best.ckpt")
    assert (
        metrics["models"]["ray_tracing"]["snr_db_median"]
        > metrics["models"]["mean"]["snr_db_median"] + 1
    )
    assert metrics["materials"].keys() == set(model.known)
    assert metrics["num_parameters"] == 2 * len(model.known) + 2
    with np.load(tmp_path / "run/predictions.npz") as kept:
        np.testing.assert_allclose(
            model.predict(kept["transmitters"], 0), kept["prediction"], atol=1e-7
        )
