"""All systems of ``plugins``: contract, choices by task, a short run, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from splatting import DATA, build, composed, links_of, run

from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.core.task.scalar import Scalar
from gaigs.core.task.spectrum import Spectrum
from gaigs.testing import check_model

IMAGES = "model.octaves=[-2,0] model.pixel=20"
SPLATS = "gaussians.count=40 deformation.width=16"
SMALL = {
    "array_response": "model.rows=4 model.columns=4 model.pitch=0.5 model.octaves=[-1,1] model.width=16 model.layers=1",
    "mlp": f"model.widths=[6,5] model.dropout=0.25 {IMAGES}",
    "fire": f"model.widths=[8,7,6] model.latent=3 {IMAGES}",
    "dcgan": f"model.width=2 model.noise=3 {IMAGES}",
    "wrf_kan": f"model.widths=[5,4] model.intervals=4 {IMAGES}",
    "nerf2": "model.samples=4 model.rays=[2,4] model.octaves=2 model.width=8 model.layers=3",
    "nerf_apt": "model.samples=4 model.rays=[3,8] model.octaves=2 model.widths=[2,3,4]",
    "newrf": "model.arrivals=3 model.samples=4 model.octaves=2 model.width=8 model.layers=5",
    "ngrf": "model.count=3 model.width=8 model.layers=2",
    "gsrf": "model.count=60",
    "rf_3dgs": "gaussians.count=40",
    "swift_wrf": "model.count=40 model.width=16 model.layers=3",
    **dict.fromkeys(("wide_gs", "wrf_gs", "wrf_gs_plus"), SPLATS),
}
TASKS = {
    "array_response": ["spectrum"],
    "rf_3dgs": ["spectrum"],
    "swift_wrf": ["spectrum"],
    "newrf": ["csi"],
    "ngrf": ["csi"],
}
CARRIERS = (2.4e9, 5.0e9, 5.8e9)


class Delay(Scalar):
    name, quantity, unit, error_unit = "delay", "delay", "ns", "ns"


def configured(name, task):
    small = SMALL.get(name, "").split()
    # The choices of a run, whose configuration then differs by values alone.
    return composed(f"data={DATA[task]}", f"model={name}", *small, "rasterizer=torch")


def make(name, scene, task="spectrum", **options):
    return build("model", configured(name, task)["model"] | options, scene=scene)


@pytest.mark.parametrize(
    ("name", "task"),
    [
        (name, task)
        for name in SMALL
        for task in TASKS.get(name, DATA)
        # Two have the parts of wide_gs but for the deformation, which reads no task.
        if task == "spectrum" or name not in ("wrf_gs", "wrf_gs_plus")
    ],
)
def test_systems_keep_the_contract_of_models(name, task):
    check_model(lambda scene: make(name, scene, task), links_of(task))


@pytest.mark.parametrize("name", ["mlp", "fire", "wrf_kan", "swift_wrf", "wide_gs"])
def test_systems_keep_the_contract_at_several_carriers(name):
    links = links_of("spectrum", CARRIERS)
    check_model(lambda scene: make(name, scene), links)
    model, place = make(name, links.scene), links.query.transmitters[0]
    low, between = (model.predict(place, 0, frequency) for frequency in (2.4e9, 5.2e9))
    assert (low - between).abs().max() > 1e-5
    with pytest.raises(ValueError, match="3 carriers"):
        model.predict(place, 0)


def chosen(name):
    """Loss of spectra, levels and channels."""
    levels = {"dcgan": "absolute", "gsrf": "gsrf"}.get(name, "squared")
    spectra = {
        "fire": "squared",
        "nerf2": "squared",
        "nerf_apt": "squared",
        "dcgan": "absolute",
        "gsrf": "gsrf",
    }
    return dict(
        zip(DATA, (spectra.get(name, "l1_ssim"), levels, "log_relative_error"), strict=True)
    )


@pytest.mark.parametrize("name", SMALL)
def test_a_run_stores_the_model_that_it_scores(name, tmp_path, monkeypatch):
    tasks = TASKS.get(name, DATA)
    assert {task: configured(name, task)["loss"]["name"] for task in tasks} == {
        t: chosen(name)[t] for t in tasks
    }
    task = tasks[0] if name in TASKS else ("spectrum", "rssi", "csi")[len(name) % 3]
    thin = {"spectrum": ["training.thinning.stride=8"]}.get(task, [])
    words = (f"data={DATA[task]}", f"model={name}", *SMALL[name].split(), *thin)
    config, metrics, model = run(tmp_path, monkeypatch, *words)
    assert config["training"]["name"] == ("adversarial" if name == "dcgan" else "descent")
    assert [*metrics["models"]] == [name, "mean"]
    with np.load(tmp_path / "predictions.npz") as stored:
        query = Query(torch.tensor(stored["transmitters"]), torch.tensor(stored["receiver"]))
        frequencies = (
            model.scene.frequencies[:1].expand(len(query)) if len(model.scene.frequencies) else None
        )
        again = model.predict(replace(query, frequencies=frequencies)).numpy()
        scale = 255 if stored["prediction"].dtype == np.uint8 else 1
        np.testing.assert_allclose(
            stored["prediction"] / scale, again, rtol=1e-3, atol=1e-3 if scale == 1 else 1
        )


@pytest.mark.parametrize(
    ("words", "pooling"),
    [
        ((), None),
        (("+experiment=rssi",), "softmax_attention"),
        (("+experiment=csi",), "element_sum"),
    ],
)
@pytest.mark.parametrize(
    ("name", "deformation", "own"),
    [
        ("wide_gs", "two_branch", "spectrum"),
        ("wrf_gs", "two_stage", "clamped"),
        ("wrf_gs_plus", "amplitude_phase", "spectrum"),
    ],
)
def test_splatting_systems_keep_their_networks_for_every_task(
    name, deformation, own, words, pooling
):
    config = composed(f"model={name}", *words)["model"]
    assert (config["name"], config["deformation"]["name"]) == (name, deformation)
    assert config["pooling"]["name"] == (pooling or own)


# --- refusals ---

LEAST = {
    "nerf2": {"samples": 2, "octaves": 0, "width": 2, "layers": 2},
    "nerf_apt": {"octaves": 0},
    "newrf": {
        "arrivals": 1,
        "samples": 2,
        "octaves": 0,
        "view_octaves": 0,
        "width": 1,
        "layers": 1,
    },
    "ngrf": {"count": 1, "width": 1, "layers": 1},
    "fire": {"latent": 1},
    "dcgan": {"width": 1, "noise": 1},
    "wrf_kan": {"intervals": 1},
    "gsrf": {"degree": 0, "count": 1},
    "swift_wrf": {"count": 1, "width": 1, "layers": 1},
    "ray_tracing": {"rays": 1},
    "array_response": {"width": 1, "layers": 0},
}


@pytest.mark.parametrize(
    ("name", "option"), [(name, option) for name in LEAST for option in LEAST[name]]
)
def test_sizes_below_the_least_are_refused(name, option):
    least, task = LEAST[name][option], TASKS.get(name, ["spectrum"])[0]
    with pytest.raises(
        ValueError, match=rf"model\.{option} must be (of )?at least {least}.*, got {least - 1}"
    ):
        make(name, links_of(task).scene, task, **{option: least - 1})


@pytest.mark.parametrize(
    ("name", "option", "least"),
    [("wrf_gs", o, n) for o, n in (("width", 2), ("layers", 2), ("view_octaves", 0))]
    + [("wrf_gs_plus", "width", 1), ("wrf_gs_plus", "layers", 2)],
)
def test_sizes_of_deformations_below_the_least_are_refused(name, option, least):
    deformation = configured(name, "spectrum")["deformation"] | {option: least - 1}
    with pytest.raises(
        ValueError, match=rf"deformation\.{option} must be at least {least}, got {least - 1}"
    ):
        build(
            "deformation",
            deformation,
            scene=links_of("spectrum").scene,
            channels=2,
            tokenizer_widths=(0, 3, 3),
        )


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("nerf2", {"far": 0.0}, r"model.far must be positive \[m\] or null, got 0"),
        (
            "nerf2",
            {"frequency": -1.0},
            r"model\.frequency must be a carrier in Hz, from 10000 to 3e\+11, got -1",
        ),
        ("nerf2", {"octaves": 200}, "model.octaves must be at least 0 and at most 30, got 200"),
        ("nerf_apt", {"samples": 6}, r"multiples of 4, of at least 2 rows, got 6 and \[3, 8\]"),
        ("nerf_apt", {"rays": [3, 10]}, r"multiples of 4, of at least 2 rows, got 4 and \[3, 10\]"),
        ("nerf_apt", {"rays": [1, 8]}, r"multiples of 4, of at least 2 rows, got 4 and \[1, 8\]"),
        ("nerf_apt", {"rays": [8]}, r"model.rays must be \[rows, columns\], got \[8\]"),
        (
            "nerf_apt",
            {"widths": [4, 4]},
            r"model.widths must be three numbers of at least 2, got \[4, 4\]",
        ),
        ("nerf_apt", {"widths": [1, 4, 4]}, "three numbers of at least 2"),
        (
            "mlp",
            {"octaves": [2, 1]},
            r"model\.octaves must be \[lowest, highest\] within -30..30, got \[2, 1\]",
        ),
        ("mlp", {"pixel": 0.0}, r"model\.pixel must be above 0 and at most 90 \[deg\], got 0\.0"),
        ("mlp", {"widths": []}, r"model\.widths must be of at least 1, got \[\]"),
        ("mlp", {"dropout": 1.0}, r"model\.dropout must be in \[0, 1\), got 1\.0"),
        ("fire", {"widths": [4, 0, 4]}, r"model\.widths must be of at least 1"),
        ("gsrf", {"radius": 0.0}, "model.radius must be positive"),
        ("ngrf", {"scale": 0.0}, "model.scale must be more than 0 and at most 1e6, got 0"),
        ("gsrf", {"count": 1}, "a point for each of the 2 receivers"),
        ("gsrf", {"margin": 0.0}, "model.margin must be positive"),
        (
            "gsrf",
            {"pooling": {"name": "spectrum", "channels": 1}},
            "pooling 'spectrum' takes 1 real channel",
        ),
        ("gsrf", {"pooling": None}, "no pooling for labels of task 'spectrum'; use another model"),
        (
            "swift_wrf",
            {"octaves": [2, 1]},
            r"model\.octaves must be \[lowest, highest\] within -30..30, got \[2, 1\]",
        ),
        (
            "array_response",
            {"rows": 1, "columns": 1},
            "at least 2 elements, got model.rows=1, model.columns=1",
        ),
        ("array_response", {"pitch": 0.0}, r"model\.pitch must be positive \[wavelengths\], got 0"),
        (
            "array_response",
            {"octaves": [2, 1]},
            r"\[lowest, highest\] within -30..30, got \[2, 1\]",
        ),
        ("rf_3dgs", {"first_stage": 0.0}, r"model\.first_stage must lie between 0 and 1"),
        ("rf_3dgs", {"first_stage": 1.0}, r"model\.first_stage must lie between 0 and 1"),
        (
            "ray_tracing",
            {"room": "nerf2_spectrum"},
            "must know the room: one of built_in, l_shape, slanted, furnished",
        ),
        ("ray_tracing", {"depth": 0}, r"model\.depth must be in 1\.\.8, got 0"),
        (
            "ray_tracing",
            {"frequency": -1.0},
            r"model\.frequency must be a carrier in Hz, from 10000 to 3e\+11, got -1",
        ),
    ],
)
def test_options_out_of_range_are_refused(name, options, message):
    task = TASKS.get(name, ["spectrum"])[0]
    with pytest.raises(ValueError, match=message):
        make(name, links_of(task).scene, task, **options)


def of_task(task):
    return links_of(task).scene


def seen_in(elevations):
    scene = of_task("spectrum")
    return replace(
        scene, task=Spectrum(torch.tensor(elevations), scene.task.directions.azimuths, "none")
    )


@pytest.mark.parametrize(
    ("name", "scene", "message"),
    [
        *((name, links_of("spectrum", CARRIERS[:2]).scene, "learns one carrier, and the training links have 2")
          for name in ("array_response", "nerf2", "nerf_apt", "gsrf")),
        ("newrf", links_of("csi", CARRIERS[:2]).scene, "learns one carrier, and the training links have 2"),
        ("ngrf", links_of("csi", CARRIERS[:2]).scene, "learns one carrier, and the training links have 2"),
        ("ngrf", of_task("rssi"), "gives complex channels, not labels of task 'rssi'"),
        ("newrf", of_task("rssi"), "gives complex channels, not labels of task 'rssi'"),
        ("newrf", replace(of_task("csi"), task=Csi(4, torch.tensor([2.4e9]))), "a single subcarrier"),
        ("array_response", of_task("csi"), "predicts spectra"),
        ("rf_3dgs", of_task("rssi"), "learns from spectra, not labels of task 'rssi'"),
        ("swift_wrf", of_task("rssi"), "labels of task 'rssi' have no directions; take another model"),
        ("swift_wrf", seen_in([0.5]), r"needs labels of two elevations or more, got \(1, \d+\) directions"),
        ("gsrf", of_task("rssi"), "labels of task 'rssi' have no directions"),
        ("gsrf", seen_in([0.5]), r"needs labels of two elevations or more, got them from 0\.5 to 0\.5 rad"),
        ("nerf2", replace(of_task("rssi"), task=Delay()), "these labels are of task 'delay'; take another model"),
        ("ray_tracing", replace(of_task("rssi"), task=Delay()), "not labels of task 'delay'"),
    ],
)  # fmt: skip
def test_labels_and_carriers_that_do_not_suit_are_refused(name, scene, message):
    with pytest.raises(ValueError, match=message):
        make(name, scene, *TASKS.get(name, ["spectrum"]))


@pytest.mark.parametrize("name", ["nerf2", "gsrf"])
def test_levels_below_those_of_an_amplitude_of_0_are_refused(name):
    links = links_of("rssi")
    with pytest.raises(ValueError, match="gives levels above -100 dBm, and a training label is -1"):
        make(name, links.scene, "rssi").fit(replace(links, labels=links.labels - 60))
