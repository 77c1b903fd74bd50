"""Levels on the streets of a city, predicted with and without its buildings.

``python benchmarks/site.py trace SCENE FOLDER`` traces a scene of Sionna RT (munich, etoile,
florence) with reflection and diffraction, at 3.5 GHz, from four masts on roofs and two at walls to
streets at 1.5 m, cells of 5 m within 250 m of the middle. It writes ``survey.csv``,
``gateways.csv`` and ``buildings.geojson``, and needs ``pip install sionna-rt shapely`` and libLLVM
(plugins/sionna/README.md); not gaigs.

``python benchmarks/site.py score FOLDER [FOLDER ...]`` prints the MAE [dB] over the test links of a
Gaussian process and of its trend, with and without buildings, for splits of random places and of
blocks.
"""

import argparse
import csv
import json
from pathlib import Path

import numpy as np

SPLITS = {
    "random, 10 %": {"split": "random", "test": 0.9},
    "blocks 50 m": {"split": "blocks", "edge": 50.0},
    "blocks 100 m": {"split": "blocks", "edge": 100.0},
}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_subparsers(dest="part", required=True)
    tracing = parts.add_parser("trace")
    tracing.add_argument("scene")
    tracing.add_argument("folder", type=Path)
    tracing.add_argument("--samples", type=float, default=5e6, help="rays from each mast")
    tracing.add_argument("--seed", type=int, default=0, help="of the masts' places")
    scoring = parts.add_parser("score")
    scoring.add_argument("folders", type=Path, nargs="+")
    scoring.add_argument("--seeds", type=int, default=1, help="of the splits, from 0")
    options = parser.parse_args()
    if options.part == "trace":
        trace(options.scene, options.folder, int(options.samples), options.seed)
    else:
        score(options.folders, options.seeds)


def trace(name, folder, samples, seed, half=250.0, cell=5.0, weakest=-130.0):
    """Writes the files of a scene; path gains below ``weakest`` [dB] are not heard."""
    import shapely
    import sionna.rt as rt

    scene = rt.load_scene(getattr(rt.scene, name), merge_shapes=False)
    footprints, roofs = buildings_of(scene)
    print(f"{name}: {len(roofs)} buildings", flush=True)
    box = scene.mi_scene.bbox()
    middle = np.array(box.min + box.max).ravel()[:2] / 2
    masts = masts_near(footprints, roofs, middle, seed)
    scene = rt.load_scene(getattr(rt.scene, name))
    scene.frequency = 3.5e9
    single = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.tx_array = scene.rx_array = single
    for key, place in masts.items():
        scene.add(rt.Transmitter(key, [*map(float, place)]))
    radio_map = rt.RadioMapSolver()(
        scene,
        center=[*map(float, middle), 1.5],
        orientation=[0, 0, 0],
        size=[2 * half, 2 * half],
        cell_size=[cell, cell],
        samples_per_tx=samples,
        max_depth=3,
        refraction=False,
        diffraction=True,
    )
    centers = radio_map.cell_centers.numpy().reshape(-1, 3)
    gains = radio_map.path_gain.numpy().reshape(len(masts), -1)
    levels = 10 * np.log10(np.maximum(gains, 1e-30)).T  # (cells, masts)
    tree = shapely.STRtree(footprints)
    within = tree.query(shapely.points(centers[:, :2]), predicate="dwithin", distance=1.0)[0]
    is_street = np.ones(len(centers), dtype=bool)
    is_street[within] = False
    is_street &= (levels >= weakest).any(1)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "survey.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "y", "z", *masts])
        for place, row in zip(centers[is_street], levels[is_street], strict=True):
            texts = [f"{level:.2f}" if level >= weakest else "" for level in row]
            writer.writerow([*(f"{number:.3f}" for number in place), *texts])
    with (folder / "gateways.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "x", "y", "z"])
        for key, place in masts.items():
            writer.writerow([key, *(f"{number:.3f}" for number in place)])
    features = []
    for shape, roof in zip(footprints, roofs, strict=True):
        geometry = json.loads(shapely.to_geojson(shape))
        features.append(
            {"type": "Feature", "properties": {"height": round(roof, 2)}, "geometry": geometry}
        )
    content = {"type": "FeatureCollection", "features": features}
    (folder / "buildings.geojson").write_text(json.dumps(content))
    print(f"{folder}: {is_street.sum()} places, {len(masts)} masts, {len(features)} buildings")


def buildings_of(scene):
    """Footprints and heights [m]: each building's triangles projected on the ground, and the mean
    height of its roof by area.
    """
    import shapely

    triangles = {}
    for key, item in scene.objects.items():
        if item.radio_material.name in ("concrete", "terrain"):  # the ground
            continue
        vertices = np.array(item.mi_mesh.vertex_positions_buffer()).reshape(-1, 3)
        faces = np.array(item.mi_mesh.faces_buffer()).reshape(-1, 3)
        triangles.setdefault(key.rsplit("-", 1)[0], []).append(vertices[faces])
    footprints = []
    roofs = []
    for parts in triangles.values():
        corners = np.concatenate(parts)  # (t, 3, 3)
        flat = shapely.polygons(corners[..., :2])
        areas = shapely.area(flat)
        tops = corners[..., 2].mean(1)
        # Walls have no area from above; floors are no roofs.
        is_roof = (areas > 0.1) & (tops > 1.0)
        if not is_roof.any():
            continue
        shape = shapely.union_all(flat[is_roof], grid_size=0.05).simplify(0.1)
        if shape.area < 4.0:
            continue
        footprints.append(shape)
        roofs.append(float(tops[is_roof] @ areas[is_roof] / areas[is_roof].sum()))
    return footprints, roofs


def masts_near(footprints, roofs, middle, seed, reach=200.0):
    """Places [m] of four masts 3 m above roofs' edges and two 1 m before walls, 8 m high."""
    import shapely

    draw = np.random.default_rng(seed)
    middles = np.array([shape.centroid.coords[0] for shape in footprints])
    is_near = (np.linalg.norm(middles - middle, axis=1) < reach) & (np.array(roofs) > 10)
    masts = {}
    for number, index in enumerate(draw.permutation(is_near.nonzero()[0])):
        kind = "roof" if number % 3 < 2 else "wall"
        shape = footprints[index]
        outline = shape.buffer(-1.0 if kind == "roof" else 1.0).boundary
        if outline.is_empty:
            continue
        spot = outline.interpolate(draw.uniform(), normalized=True)
        if kind == "wall" and shapely.dwithin(footprints, spot, 0.9).any():
            continue
        height = roofs[index] + 3.0 if kind == "roof" else 8.0
        taken = sum(name.startswith(kind) for name in masts)
        if taken < (4 if kind == "roof" else 2):
            masts[f"{kind}{taken + 1}"] = (spot.x, spot.y, height)
    return masts


def score(folders, seeds):
    """Prints the table."""
    import gaigs

    print("| scene | split | trend alone, no buildings | with | process, no buildings | with |")
    print("|---|---|---|---|---|---|")
    for folder in folders:
        buildings = {"name": "site", "buildings": str(folder / "buildings.geojson")}
        models = (
            {"name": "path_loss"},
            buildings,
            {"name": "gaussian_process", "trend": None},
            {"name": "gaussian_process", "trend": buildings},
        )
        for title, split in SPLITS.items():
            errors = np.zeros((seeds, len(models)))
            for seed in range(seeds):
                links = gaigs.links(
                    "rssi_wide",
                    file=str(folder / "survey.csv"),
                    gateways=str(folder / "gateways.csv"),
                    frequency=3.5e9,
                    seed=seed,
                    **split,
                )
                for column, options in enumerate(models):
                    model = gaigs.registries["model"].build(options, scene=links.scene)
                    model.fit(links)
                    test = links.split.test
                    values = model.predict(links.query[test])
                    errors[seed, column] = (values - links.labels[test]).abs().mean()
            numbers = " | ".join(f"{error:.2f}" for error in errors.mean(0))
            print(f"| {folder.name} | {title} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
