"""Path loss less the loss by buildings and terrain: coefficients of a law, checkpoints, kriging on top."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import torch
from rasterio import Affine
from scipy.special import fresnel

import gaigs
from gaigs.core.roofs import obstruct
from gaigs.model.site import Site, shared_coefficients


def write_buildings(file, shift=0.0):
    features = []
    for x in (30, 70):
        ring = [[x, 20], [x + 12, 20], [x + 12, 60], [x, 60], [x, 20]]
        ring = [[a + shift, b] for a, b in ring]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"height": 18.0}, "geometry": geometry})
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(file)


@pytest.fixture
def site(tmp_path):
    """Two masts, 300 places, 15 dB behind a building, a law of its own for each mast, 1 dB of
    noise."""
    file = write_buildings(tmp_path / "buildings.geojson")
    draw = torch.Generator().manual_seed(0)
    places = torch.rand(300, 3, generator=draw) * torch.tensor([110.0, 80.0, 0.0])
    places[:, 2] = 1.5
    is_inside = (places[:, 1] > 20) & (places[:, 1] < 60)
    is_inside &= ((places[:, 0] - 36).abs() < 7) | ((places[:, 0] - 76).abs() < 7)
    places = places[~is_inside]
    masts = torch.tensor([[2.0, 40.0, 9.0], [56.0, 3.0, 6.0]])
    probe = Site(gaigs.links("synthetic_rssi", transmitters=20).scene, file)
    lengths = (places[:, None] - masts).norm(dim=-1)
    labels = torch.tensor([-30.0, -38.0]) - 10 * torch.tensor([2.0, 2.6]) * lengths.log10()
    labels += torch.randn(labels.shape, generator=draw)
    links = gaigs.links(
        task="rssi",
        transmitters=places.numpy(),
        receivers=masts.numpy(),
        labels=labels.numpy(),
        split="random",
    )
    model = Site(links.scene, file)
    roofs = model._read_roofs(links)
    starts = links.scene.positions(places)[links.query.receivers]
    blocked = obstruct(roofs, starts, links.query.transmitters, 0.15)[:, 0]
    assert 0.2 < blocked.mean() < 0.8
    assert probe.losses.isnan().all()
    links.labels.sub_(15 * blocked)
    return links, file


def test_the_loss_behind_buildings_and_both_laws_are_found(site):
    links, file = site
    model = Site(links.scene, file)
    model.fit(links)
    assert (model.losses >= 0).all()
    assert model.law.exponents.tolist() == pytest.approx([2.0, 2.6], abs=0.25)
    test = links.split.test
    error = (model.predict(links.query[test]) - links.labels[test]).abs().mean()
    assert error < 1.3  # the noise alone has 0.8 dB
    without = gaigs.registries["model"].build("path_loss", scene=links.scene)
    without.fit(links)
    assert error < (without.predict(links.query[test]) - links.labels[test]).abs().mean() - 2


def test_a_process_over_the_site_loads_without_the_file(site, tmp_path):
    links, file = site
    options = {"name": "gaussian_process", "trend": {"name": "site", "buildings": file}}
    model = gaigs.registries["model"].build(options, scene=links.scene)
    model.fit(links)
    model.save(tmp_path / "site.ckpt")
    Path(file).unlink()
    loaded = gaigs.load(tmp_path / "site.ckpt")
    torch.testing.assert_close(loaded.predict(links.query), model.predict(links.query))


def test_buildings_of_another_frame_are_named(site, tmp_path):
    links, _ = site
    file = write_buildings(tmp_path / "far.geojson", shift=5e5)
    with pytest.raises(ValueError, match=r"are far from the links, .*\ngive both in one frame"):
        Site(links.scene, file).fit(links)


def test_roofs_below_all_paths_are_a_warning(site, caplog):
    links, file = site
    text = Path(file).read_text().replace("18.0", "0.5")
    Path(file).write_text(text)
    Site(links.scene, file).fit(links)
    assert "no roof is above the direct path of any link" in caplog.text


@pytest.fixture
def hills(tmp_path):
    """Two masts and 400 places about a ridge of 40 m, 1,400 m above the sea; 1 dB of noise.

    Heights of masts and places are above the ground. Fresnel's integrals give the loss behind the
    ridge.
    """
    draw = np.random.default_rng(0)
    places = np.column_stack((draw.uniform(0, (1000, 600), (400, 2)), np.full(400, 1.5)))
    masts = np.array([[20.0, 300.0, 10.0], [900.0, 100.0, 10.0]])

    def ground(x):
        return 1400 + 40 * np.exp(-0.5 * ((x - 500) / 15) ** 2)

    crest = 1440.0
    labels = np.empty((400, 2))
    for column, mast in enumerate(masts):
        start, end = mast[2] + ground(mast[0]), places[:, 2] + ground(places[:, 0])
        along = (500 - mast[0]) / (places[:, 0] - mast[0])  # share of the path before the ridge
        lengths = np.hypot(places[:, 0] - mast[0], places[:, 1] - mast[1])
        labels[:, column] = -30 - (22 + 4 * column) * np.log10(lengths)
        between = (along > 0.05) & (along < 0.95)
        above = (crest - start - along * (end - start))[between]
        before = (along * lengths)[between]
        behind = lengths[between] - before
        sine, cosine = fresnel(above * np.sqrt(2 / 0.15 * (1 / before + 1 / behind)))
        loss = -20 * np.log10(np.hypot(1 - cosine - sine, cosine - sine) / 2)
        labels[between, column] -= loss.clip(0)
    labels += draw.standard_normal(labels.shape)
    file = tmp_path / "ground.tif"
    columns = ground(-100 + 5 * (np.arange(240) + 0.5)).astype(np.float32)
    with rasterio.open(
        file,
        "w",
        driver="GTiff",
        height=160,
        width=240,
        count=1,
        dtype="float32",
        transform=Affine(5, 0, -100, 0, -5, 700),
    ) as raster:
        raster.write(np.tile(columns, (160, 1)), 1)
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=masts, labels=labels, split="random"
    )
    return links, str(file)


def test_the_loss_behind_a_ridge_is_found_and_loads_without_the_file(hills, tmp_path):
    links, file = hills
    model = Site(links.scene, terrain=file)
    model.fit(links)
    assert model.is_lifted
    test = links.split.test
    error = (model.predict(links.query[test]) - links.labels[test]).abs().mean()
    without = gaigs.registries["model"].build("path_loss", scene=links.scene)
    without.fit(links)
    before = (without.predict(links.query[test]) - links.labels[test]).abs().mean()
    assert error < before / 2
    model.save(tmp_path / "site.ckpt")
    Path(file).unlink()
    loaded = gaigs.load(tmp_path / "site.ckpt")
    torch.testing.assert_close(loaded.predict(links.query), model.predict(links.query))


@pytest.mark.parametrize(("first", "percent"), [(0, 53), (120, 47)], ids=["west", "east"])
def test_ends_beyond_the_terrain_are_a_warning(first, percent, hills, caplog):
    links, file = hills
    with rasterio.open(file) as raster:
        part = raster.read(window=((0, 160), (first, first + 120)))
        profile = raster.profile | {"width": 120}
    profile["transform"] = Affine(5, 0, -100 + 5 * first, 0, -5, 700)
    with rasterio.open(file, "w", **profile) as raster:
        raster.write(part)
    Site(links.scene, terrain=file).fit(links)
    assert f"no height of the ground at {percent} % of the ends" in caplog.text


def test_ends_below_the_ground_are_a_warning(hills, caplog):
    links, file = hills
    Site(links.scene, terrain=file, above_ground=False).fit(links)
    assert "100 % of the ends of links are over 2 m below the ground" in caplog.text


def test_a_map_must_be_given(hills):
    with pytest.raises(ValueError, match="needs a map\ngive buildings, a GeoJSON file, terrain"):
        Site(hills[0].scene)


def test_coefficients_are_not_negative_and_a_constant_feature_has_none():
    draw = torch.Generator().manual_seed(0)
    lengths = 10 * torch.rand(200, generator=draw).double() + 1
    features = torch.rand(200, 2, generator=draw).double()
    labels = -30 - 20 * lengths.log10() - 4 * features[:, 0] + features[:, 1]
    columns = torch.cat((labels[:, None], -features, -torch.ones(200, 1, dtype=torch.float64)), 1)
    receivers = torch.zeros(200, dtype=torch.long)
    found = shared_coefficients(columns, lengths, receivers)
    assert found[0] == pytest.approx(4, abs=0.5)
    assert found[1:].tolist() == [0, 0]


def test_images_are_refused(tmp_path):
    scene = gaigs.links("synthetic", transmitters=20, order=0).scene
    with pytest.raises(ValueError, match="one real number a link"):
        Site(scene, "buildings.geojson")
