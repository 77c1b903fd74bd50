"""Subcarriers held out for the test, and predictions at subcarriers that no label had."""

import json

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.testing import example_links

OPTIONS = {"transmitters": 20, "subcarriers": 8, "order": 0}
WHOLE = gaigs.links("synthetic_csi", **OPTIONS)
FREQUENCIES = WHOLE.task.frequencies
LOWER = FREQUENCIES[[0, 3]].tolist()


def test_a_band_trains_and_the_others_test():
    links = gaigs.links("synthetic_csi", **OPTIONS, band_train=LOWER)
    assert torch.equal(links.task.frequencies, FREQUENCIES[:4])
    assert torch.equal(links.held_out.task.frequencies, FREQUENCIES[4:])
    assert torch.equal(torch.cat((links.labels, links.held_out.labels), -1), WHOLE.labels)
    assert (links.query.frequencies == sum(LOWER) / 2).all()
    assert links.split.name.endswith(
        "trained at 6.24 .. 6.453943 GHz, tested at 6.525257 .. 6.7392 GHz"
    )
    far = gaigs.links(
        "synthetic_csi", **OPTIONS, band_train=LOWER, band_test=FREQUENCIES[[2, 6]].tolist()
    )
    assert torch.equal(far.held_out.task.frequencies, FREQUENCIES[4:7])


@pytest.mark.parametrize(
    ("bands", "message"),
    [
        (
            {"band_train": [6.24, 6.45]},
            "data.band_train must be a carrier in Hz, .* got 6.24; in GHz?",
        ),
        (
            {"band_train": LOWER[::-1]},
            "data.band_train must be the lowest and the highest subcarrier",
        ),
        (
            {"band_train": [1e9, 2e9]},
            "data.band_train=.* has no subcarrier; they lie from 6.24e.09 to 6.7392e.09 Hz",
        ),
        ({"band_train": [1e9, 9e9]}, "data.band_train=.* leaves no subcarrier to test on"),
        ({"band_train": LOWER, "band_test": LOWER}, "leaves no subcarrier to test on"),
        ({"band_test": LOWER}, "data.band_test needs data.band_train"),
    ],
)
def test_bands_without_subcarriers_are_refused(bands, message):
    with pytest.raises(ValueError, match=message):
        gaigs.links("synthetic_csi", **OPTIONS, **bands)


def test_a_run_scores_the_held_out_band(tmp_path):
    """Of all models, beside each test link's own channel at the nearest subcarrier for training."""
    words = (
        "+experiment=csi",
        "model=friis",
        "kriging=false",
        "data.transmitters=20",
        "data.order=0",
    )
    config = gaigs.compose(
        *words, f"data.band_train={LOWER}", "data.subcarriers=8", "split.validation=0.2"
    )
    metrics = gaigs.run(config, tmp_path)
    assert list(metrics["models"]) == [
        "friis",
        "mean",
        "knn",
        "gaussian_process",
        "nearest_frequency",
    ]
    assert metrics["models"]["friis"]["snr_db_median"] > 30, "a room without walls is free space"
    assert metrics["models"]["gaussian_process"] == metrics["models"]["friis"]
    test = WHOLE.split.test
    held_out = gaigs.links("synthetic_csi", **OPTIONS, band_train=LOWER).held_out
    expected = held_out.task.scores(WHOLE.labels[test][..., 4:], WHOLE.labels[test][..., [3] * 4])[
        "snr_db"
    ]
    assert metrics["models"]["nearest_frequency"]["snr_db_median"] == pytest.approx(
        expected.median().item(), abs=0.5
    )
    with np.load(tmp_path / "predictions.npz") as stored:
        np.testing.assert_allclose(stored["snr_db_nearest_frequency"], expected, rtol=1e-5)
        np.testing.assert_array_equal(stored["labels"], WHOLE.labels[test][..., 4:])
    assert (
        "nearest_frequency" not in json.loads((tmp_path / "metrics.json").read_text())["validation"]
    )


def trained(name, links):
    torch.manual_seed(0)
    model = gaigs.registries["model"].build({"name": name}, scene=links.scene)
    model.fit(links)
    return model


def test_a_look_up_gives_its_nearest_subcarrier_and_says_so():
    model = trained("knn", WHOLE)
    places = WHOLE.query.transmitters[:3]
    asked = [FREQUENCIES[-1].item() + 1e8, FREQUENCIES[2].item() - 2e6]
    with pytest.warns(
        ExtrapolationWarning, match=r"nearest subcarriers with labels, up to 1e\+08 Hz away"
    ):
        found = model.predict(places, frequencies=asked)
    assert torch.equal(found, model.predict(places)[..., [-1, 2]])
    (part,) = model.predict_batches(places, frequencies=FREQUENCIES[1:2])
    assert torch.equal(part, model.predict(places)[..., 1:2])


@pytest.mark.parametrize(
    ("frequencies", "message"),
    [
        (6.4, "frequencies must be a carrier in Hz, .* got 6.4; in GHz?"),
        ([5e9, 5e9], "frequencies must be different subcarriers"),
        ([], "frequencies must be different subcarriers"),
        ([[5e9], [6e9]], r"frequencies must be .* got shape \(2, 1\)"),
        ("low", "frequencies must be different subcarriers .* in real numbers"),
    ],
)
def test_frequencies_out_of_range_are_refused(frequencies, message):
    with pytest.raises(ValueError, match=message):
        trained("friis", WHOLE).predict([1.0, 2.0, 1.5], frequencies=frequencies)


def test_other_labels_have_no_subcarriers():
    model = trained("mean", example_links("rssi"))
    with pytest.raises(
        ValueError, match="labels of task 'rssi' have no subcarriers; leave frequencies out"
    ):
        model.predict([1.0, 2.0, 1.5], frequencies=5e9)
