"""Exported radio maps and predictions, as other programs read them."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import torch
from scipy.io import netcdf_file

import gaigs
from gaigs.core.geometry import Frame
from gaigs.core.task.csi import Csi
from gaigs.report.formats import figure_formats

CORNER = Frame(32632, 500_000.0, 0.0)
"""Where the central meridian of UTM zone 32 meets the equator: 9 degrees east, 0 degrees north."""


@pytest.fixture(scope="module")
def rssi():
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0)
    return gaigs.train("path_loss", links), links


@pytest.fixture
def on_map(rssi):
    model, _ = rssi
    inside = model.scene
    first, *others = inside.receivers
    model.scene = replace(
        inside, frame=CORNER, receivers=(replace(first, name="Küche & Flur"), *others)
    )
    yield model
    model.scene = inside


def rows(file):
    with open(file, newline="", encoding="utf-8") as text:
        return [*csv.DictReader(text)]


# --- radio maps ---


def test_a_geotiff_has_each_value_at_its_place(on_map, tmp_path):
    floor = gaigs.radio_map(on_map, pitch=0.5)
    gaigs.export(on_map, tmp_path / "floor.tif", pitch=0.5)
    with tifffile.TiffFile(tmp_path / "floor.tif") as file:
        bands, tags, names = (
            file.asarray(),
            file.geotiff_metadata,
            file.pages[0].tags["GDAL_METADATA"].value,
        )
    (width, height, _), (*_, left, top, _) = tags["ModelPixelScale"], tags["ModelTiepoint"]
    assert tags["ProjectedCSTypeGeoKey"] == 32632
    assert names.count("<Item") == len(bands) == 2 * len(floor.receivers)
    assert "Küche &amp; Flur: RSSI [dBm]" in names
    for row, column in ((0, 0), (3, 5), (-1, 2)):
        east, north = CORNER.x + floor.x[column], CORNER.y + floor.y[row]
        pixel = int((top - north) // height), int((east - left) // width)
        np.testing.assert_allclose(bands[0::2, *pixel], floor.values[:, row, column], rtol=1e-5)
        np.testing.assert_allclose(bands[1::2, *pixel], floor.deviations[:, row, column], rtol=1e-5)


def test_geojson_is_in_longitude_and_latitude(on_map, tmp_path):
    floor = gaigs.radio_map(on_map, pitch=0.5)
    gaigs.export(on_map, tmp_path / "floor.geojson", pitch=0.5)
    features = json.loads((tmp_path / "floor.geojson").read_text())["features"]
    assert len(features) == floor.values[0].size
    row, column = np.flatnonzero(floor.y == 0.0)[0], np.flatnonzero(floor.x == 0.0)[0]
    point = features[row * len(floor.x) + column]
    assert point["geometry"]["coordinates"] == pytest.approx([9.0, 0.0], abs=1e-8)
    assert point["properties"]["south"] == pytest.approx(floor.values[1, row, column], abs=1e-3)
    assert point["properties"]["south deviation"] == pytest.approx(
        floor.deviations[1, row, column], abs=1e-3
    )
    north = features[(row + 2) * len(floor.x) + column]["geometry"]["coordinates"]
    assert north == pytest.approx(
        [9.0, 1.0 / 110_574 / 0.9996], abs=1e-8
    )  # a metre of a meridian, scaled by UTM


def test_geojson_has_a_key_for_each_value_of_each_receiver(rssi, tmp_path):
    model, _ = rssi
    inside = model.scene
    names = ["ap", "ap deviation", "ap deviation deviation", "ap value"]
    model.scene = replace(
        inside,
        receivers=tuple(map(lambda one, name: replace(one, name=name), inside.receivers, names)),
    )
    gaigs.export(model, tmp_path / "floor.geojson", pitch=1.0)
    floor = gaigs.radio_map(model, pitch=1.0)
    model.scene = inside
    (first, *_) = json.loads((tmp_path / "floor.geojson").read_text())["features"]
    assert len(first["properties"]) == 8
    for number, name in enumerate(names):
        assert first["properties"][f"{name} value"] == pytest.approx(
            floor.values[number, 0, 0], abs=1e-3
        )
        assert first["properties"][f"{name} deviation"] == pytest.approx(
            floor.deviations[number, 0, 0], abs=1e-3
        )


def test_netcdf_has_axes_units_and_the_coordinate_system(on_map, tmp_path):
    floor = gaigs.radio_map(on_map, pitch=0.5, height=1.2)
    gaigs.export(on_map, tmp_path / "floor.nc", pitch=0.5, height=1.2)
    with netcdf_file(tmp_path / "floor.nc", mmap=False) as file:
        found = file.variables
        assert found["value"].dimensions == ("receiver", "y", "x")
        np.testing.assert_allclose(found["value"][:], floor.values, rtol=1e-6)
        np.testing.assert_allclose(found["deviation"][:], floor.deviations, rtol=1e-6)
        assert b"".join(found["receiver"][1]).rstrip(b"\0") == b"south"
        assert (found["value"].units, found["deviation"].units) == (b"dBm", b"dB")
        assert found["x"].standard_name == b"projection_x_coordinate"
        np.testing.assert_allclose(found["x"][:], CORNER.x + floor.x)
        assert found["z"].getValue() == pytest.approx(1.2)
        assert found["crs"].grid_mapping_name == b"transverse_mercator"


def test_maps_without_a_place_on_earth_say_so(rssi, tmp_path, caplog):
    model, _ = rssi
    for suffix in ("tif", "geojson", "nc"):
        caplog.clear()
        gaigs.export(model, tmp_path / f"floor.{suffix}", pitch=1.0)
        assert f"floor.{suffix} has no coordinate system" in caplog.text
    with tifffile.TiffFile(tmp_path / "floor.tif") as file:
        assert "GeoKeyDirectoryTag" not in file.pages[0].tags
    (first, *_) = json.loads((tmp_path / "floor.geojson").read_text())["features"]
    assert first["geometry"]["coordinates"] == gaigs.radio_map(model, pitch=1.0).x[:1].tolist() * 2


def test_figures_are_pages(rssi, tmp_path, monkeypatch):
    monkeypatch.setattr("gaigs.report.style.DPI", 60)
    model, _ = rssi
    with figure_formats("svg"):  # those of reports, not of exports
        names = [path.name for path in gaigs.export(model, tmp_path / "floor.PNG", pitch=1.0)]
    assert names == ["floor.PNG"], "the deviation of this model is the same everywhere"
    assert {path.name for path in tmp_path.iterdir()} == {*names}
    gaigs.export(model, tmp_path / "floor.PDF", pitch=1.0)
    assert (tmp_path / "floor.PDF").read_bytes().count(b"/Type /Page ") == 1


# --- predictions ---


def test_places_are_heard_by_each_receiver(rssi, tmp_path):
    model, _ = rssi
    gaigs.export(model, tmp_path / "places.csv", [[1.0, 2.0, 1.5], [2.0, 1.0, 0.5]], interval=0.5)
    table = rows(tmp_path / "places.csv")
    assert [(row["x"], row["receiver"]) for row in table[3:6]] == [
        ("1", "north"),
        ("2", "west"),
        ("2", "south"),
    ]
    found = model.predict([2.0, 1.0, 0.5], "south", interval=0.5)
    for name, value in (("value", found.value), ("deviation", found.std), ("upper", found.upper)):
        assert float(table[5][name]) == pytest.approx(value.item(), rel=1e-5)


def test_a_receivers_name_is_no_formula(on_map, tmp_path):
    first, *others = on_map.scene.receivers
    on_map.scene = replace(on_map.scene, receivers=(replace(first, name="=HYPERLINK(A1)"), *others))
    gaigs.export(on_map, tmp_path / "places.csv", [[1.25, 2.0, 1.5]])
    assert rows(tmp_path / "places.csv")[0]["receiver"] == "'=HYPERLINK(A1)"


def test_places_on_a_map_have_easting_and_northing(on_map, tmp_path):
    gaigs.export(on_map, tmp_path / "places.csv", [[1.25, 2.0, 1.5]])
    assert [rows(tmp_path / "places.csv")[0][name] for name in ("x", "easting", "northing")] == [
        "1.25",
        "500001.25",
        "2",
    ]


def test_channels_of_test_links_stand_beside_their_labels(tmp_path, caplog):
    links = gaigs.links("synthetic_csi", transmitters=20, subcarriers=3, order=0)
    model = gaigs.train("friis", links)
    model.calibration = None
    for suffix in ("csv", "nc"):
        gaigs.export(model, tmp_path / f"test.{suffix}", links)
    assert "has values alone" in caplog.text
    test = links.split.test
    labels, values = links.labels[test], model.predict(links.query[test])
    table = rows(tmp_path / "test.csv")
    assert len(table) == labels.numel()
    row = table[1 * 16 * 3 + 5 * 3 + 2]
    assert (row["element"], float(row["subcarrier"])) == ("5", links.task.frequencies[2].item())
    for name, whole in (("value", values), ("measured", labels)):
        assert complex(float(row[f"{name}_real"]), float(row[f"{name}_imag"])) == pytest.approx(
            whole[1, 5, 2].item()
        )
    with netcdf_file(tmp_path / "test.nc", mmap=False) as file:
        found = file.variables
        assert found["value_imag"].dimensions == ("link", "element", "subcarrier")
        np.testing.assert_array_equal(found["value_imag"][:], values.imag)
        np.testing.assert_array_equal(found["measured_real"][:], labels.real)
        np.testing.assert_allclose(found["z"][:], links.query.transmitters[test, 2])


def test_held_out_subcarriers_stand_beside_their_labels(tmp_path):
    links = gaigs.links("synthetic_csi", transmitters=20, subcarriers=4, order=0)
    band = links.task.frequencies[:2].tolist()
    links = gaigs.links("synthetic_csi", transmitters=20, subcarriers=4, order=0, band_train=band)
    gaigs.export(gaigs.train("friis", links), tmp_path / "test.csv", links)
    labels, row = links.held_out.labels[links.split.test], rows(tmp_path / "test.csv")[1]
    assert float(row["subcarrier"]) == links.held_out.task.frequencies[1].item()
    assert float(row["measured_real"]) == pytest.approx(labels[0, 0, 1].real.item())


def test_spectra_have_axes_in_degrees(tmp_path):
    links = gaigs.links("synthetic", transmitters=20, order=0)
    model = gaigs.train("mean", links)
    gaigs.export(model, tmp_path / "places.nc", torch.tensor([1.0, 2.0, 1.5]))
    with netcdf_file(tmp_path / "places.nc", mmap=False) as file:
        assert file.variables["value"].shape == (1, 90, 360)
        np.testing.assert_allclose(file.variables["azimuth"][[0, 90]], [0, 90], atol=1e-4)


@pytest.mark.parametrize(
    ("file", "options", "message"),
    [
        ("floor.shp", {}, r"must end with one of \.tif, .*\.xml, .deepmimo, got 'floor.shp'"),
        ("floor", {}, "got 'floor'"),
        ("test.csv", {}, r"predictions take places: positions \[m\], a query, or links"),
        ("test.csv", {"places": torch.zeros(0, 3)}, "predictions take one place or more"),
        ("test.csv", {"places": [[1.0, 2.0]]}, r"places must be \(\.\.\., 3\) positions"),
        (
            "test.nc",
            {"places": [[1.0, 2.0, 1.0]], "interval": 1.0},
            "interval must be a probability between 0 and 1",
        ),
        ("room.glb", {}, "a learnt room takes a model 'mirrored', got 'path_loss'"),
    ],
)
def test_impossible_exports_are_refused(file, options, message, rssi, tmp_path):
    with pytest.raises(ValueError, match=message):
        gaigs.export(rssi[0], tmp_path / file, **options)
    assert not [*tmp_path.iterdir()]


def test_the_command_exports_a_run(tmp_path, capsys):
    words = (
        "+experiment=rssi",
        "model=path_loss",
        "data.transmitters=30",
        "data.order=0",
        "baselines=[]",
    )
    gaigs.run(gaigs.compose(*words), tmp_path / "run")
    command = ("command=export", f"folder={tmp_path / 'run'}", "export.pitch=1")
    for chosen in (["csv"], ["nc"], ["nc", "export.places=[[1,2,1.5]]"]):
        gaigs.run(
            gaigs.compose(*command, f"export.format={chosen[0]}", *chosen[1:]), tmp_path / "out"
        )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"predictions.csv", "radio_map.nc", "predictions.nc"}
    with np.load(tmp_path / "run/predictions.npz") as run:
        table = rows(tmp_path / "out/predictions.csv")
        np.testing.assert_allclose(
            [float(row["value"]) for row in table], run["prediction"], rtol=1e-5
        )
        np.testing.assert_allclose(
            [float(row["measured"]) for row in table], run["labels"], rtol=1e-5
        )
    assert "results: " in capsys.readouterr().out
    for wrong, message in (
        ([], "needs export.format"),
        (["export.format=dxf"], "must end with one of"),
    ):
        with pytest.raises(ValueError, match=message):
            gaigs.run(gaigs.compose(*command, *wrong), tmp_path / "out")
    with pytest.raises(ValueError, match="needs the folder of a finished run"):
        gaigs.run(gaigs.compose("command=export"), tmp_path / "out")


def test_channels_have_no_rows_of_elements_that_an_array_lacks(tmp_path):
    pose = gaigs.Pose.from_xyzw([0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])
    receivers = [
        gaigs.Receiver(f"a{k}", pose, gaigs.Array.planar(1, k, pitch=0.06)) for k in (1, 2)
    ]
    channels = np.ones((20, 2, 2, 3)) + 1j
    channels[:, 0, 1] = 0
    places = np.random.default_rng(0).uniform(1, 4, (20, 3))
    task = Csi(2, [2.40e9, 2.41e9, 2.42e9])
    links = gaigs.links(task=task, transmitters=places, receivers=receivers, labels=channels)
    gaigs.export(gaigs.train("mean", links), tmp_path / "channels.csv", links)
    found = {(row["receiver"], row["element"]) for row in rows(tmp_path / "channels.csv")}
    assert found == {("a1", "0"), ("a2", "0"), ("a2", "1")}


def test_the_command_exports_places_of_a_file_from_a_checkpoint(rssi, tmp_path):
    rssi[0].save(tmp_path / "room.ckpt")
    (tmp_path / "places.csv").write_text("x,y,z\n1.5,2,1\n")
    words = ("command=export", f"folder={tmp_path / 'room.ckpt'}", "export.format=csv")
    gaigs.run(gaigs.compose(*words, f"export.places={tmp_path / 'places.csv'}"), tmp_path / "out")
    assert {row["x"] for row in rows(tmp_path / "out/predictions.csv")} == {"1.5"}
    with pytest.raises(FileNotFoundError, match="holds no run"):  # its test links
        gaigs.run(gaigs.compose(*words), tmp_path / "out")
