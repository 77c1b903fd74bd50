"""Responses of front ends: learnt, applied and left out."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

import gaigs
from gaigs.data import divide
from gaigs.model import checkpoint
from gaigs.registry import registry
from gaigs.report.csi import front_ends

ELEMENTS, SUBCARRIERS = 4, 30
ELEMENT_STEPS = torch.tensor([-0.5, 0.5, 1.0, 1.0], dtype=torch.float64)


def invented(elements=ELEMENTS, subcarriers=SUBCARRIERS):
    """Ripples of some decibels, a bent phase, and a gain and phase of each element."""
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(-1, 1, subcarriers, dtype=torch.float64)
    levels = 2.5 * (3 * x + 0.4).cos() + 1.5 * (7 * x).sin() - 2 * x**2  # [dB]
    levels = levels + 1.5 * torch.randn(elements, 1, generator=generator).double()
    turns = 2 * math.pi * torch.rand(elements, 1, generator=generator).double()
    phases = 1.2 * x**2 + 0.8 * (4 * x).sin() + turns
    response = torch.polar(10 ** (levels / 20), phases)
    return response / response.abs().square().mean().sqrt()


def room_channels(transmitters, elements, frequencies):
    """Places in a box room, and their waves: direct, and by walls and floor."""
    generator = torch.Generator().manual_seed(2)
    size = torch.tensor([6.0, 5.0, 3.0], dtype=torch.float64)
    places = size * torch.rand(transmitters, 3, generator=generator).double()
    images = [(places, 1.0)]
    for axis in range(3):
        for wall in (0.0, size[axis].item()):
            image = places.clone()
            image[:, axis] = 2 * wall - image[:, axis]
            images.append((image, -0.4))
    channels = 0
    for image, gain in images:
        distances = torch.cdist(image, elements)[..., None]  # (n, e, 1)
        phases = -2 * math.pi / speed_of_light * distances * frequencies
        channels = channels + torch.polar(gain / (distances * frequencies), phases)
    return places, channels


def measured(folder, phase, response, transmitters=48, is_divided=True):
    """Links of ``csi_npz`` with a response, and with a phase and delay of each link."""
    frequencies = torch.linspace(5.0e9, 5.1e9, SUBCARRIERS, dtype=torch.float64)
    offsets = 0.03 * torch.eye(3, dtype=torch.float64)[[0, 0, 1, 2]] * ELEMENT_STEPS[:, None]
    receiver = torch.tensor([1.0, 1.5, 1.2], dtype=torch.float64)
    offsets = offsets[: len(response)]
    places, channels = room_channels(transmitters, receiver + offsets, frequencies)
    generator = torch.Generator().manual_seed(1)
    phases = 2 * math.pi * torch.rand(transmitters, 1, 1, generator=generator).double()
    if phase == "per_link_and_delay":
        delays = 50e-9 * torch.rand(transmitters, 1, 1, generator=generator).double()
        phases = phases + 2 * math.pi * delays * (frequencies - frequencies.mean())
    turns = torch.polar(torch.ones_like(phases), phases * (phase != "known"))
    file = folder / f"{phase}.npz"
    np.savez(
        file,
        tx=places.numpy(),
        rx=receiver.numpy()[None],
        frequencies=frequencies.numpy(),
        h=(channels * turns * response).numpy(),
        elements=offsets.numpy(),
    )
    if not is_divided:
        return registry("data").build({"name": "csi_npz", "file": str(file), "phase": phase})
    return gaigs.links("csi_npz", file=file, phase=phase)


@pytest.fixture(scope="module")
def links(tmp_path_factory):
    return measured(tmp_path_factory.mktemp("known"), "known", invented())


def score(model, links):
    return gaigs.evaluate(gaigs.train(model, links), links, baselines=[]).models[model]


@pytest.mark.parametrize("phase", ["known", "per_link", "per_link_and_delay"])
def test_the_response_is_found_and_explains_channels(phase, tmp_path):
    response = invented()
    links = measured(tmp_path, phase, response)
    learnt, errors = links.front_ends.responses[0], links.front_ends.errors[0]
    guess = learnt.to(response)
    if phase == "per_link_and_delay":
        guess = links.task.align(guess[None], response[None])[0]
    guess = guess * (guess.conj() * response).sum().sgn()
    off = (guess - response).abs()
    assert off.norm() / response.norm() < 0.1
    assert (off / errors).square().mean().sqrt() < 2
    assert "rx0 has a response of its front end" in links.remarks
    assert gaigs.describe(links).findings == ()

    plain = score("friis", replace(links, front_ends=None))["snr_aligned_db_median"]
    own = score("friis", links)["snr_aligned_db_median"]
    assert own > plain + 1
    assert own > score("mean", links)["snr_aligned_db_median"]
    assert score("gaussian_process", links)["snr_aligned_db_median"] > plain + 1


def test_one_antenna_with_a_filter_is_above_free_space_and_the_mean(tmp_path):
    """As a Wi-Fi radio of few places reports them: a random phase and delay of each link."""
    links = measured(tmp_path, "per_link_and_delay", invented(1), transmitters=39)
    median = "snr_aligned_db_median"
    least = max(
        score("friis", replace(links, front_ends=None))[median] + 1, score("mean", links)[median]
    )
    for name in ("friis", "gaussian_process"):
        assert score(name, links)[median] > least
    options = {"max_steps": 20, "enable_progress_bar": False}
    mirrored = gaigs.train("mirrored", links, **options)
    assert gaigs.evaluate(mirrored, links, baselines=[]).models["mirrored"][median] > least


def test_without_a_filter_nothing_is_learnt(tmp_path):
    links = measured(tmp_path, "per_link", torch.ones(ELEMENTS, SUBCARRIERS).double())
    assert links.front_ends is None
    assert links.scene.responses is None
    assert "responses" not in links.scene.state()


def test_checkpoints_keep_responses_and_other_subcarriers_interpolate_them(links, tmp_path):
    model = gaigs.train("friis", links)
    model.save(tmp_path / "room.ckpt")
    loaded = gaigs.load(tmp_path / "room.ckpt")
    place = links.query.transmitters[:1]
    torch.testing.assert_close(loaded.predict(place), model.predict(place))
    few = links.task.frequencies[:10:3]
    chosen = model.predict(place, frequencies=few)
    torch.testing.assert_close(chosen, model.predict(place)[..., :10:3])
    content = checkpoint.read(tmp_path / "room.ckpt")[checkpoint.KEY]["scene"]
    assert content["responses"].shape == (1, ELEMENTS, SUBCARRIERS)


@pytest.mark.parametrize("model", ["gaigs", "mirrored"])
def test_channels_of_models_stand_behind_the_front_end(model, links):
    options = {"max_steps": 1, "enable_progress_bar": False}
    if model == "mirrored":
        options["order"] = 0  # without a search for planes
    trained = gaigs.train(model, links, kriging=False, **options)
    place = links.query.transmitters[:2]
    behind = trained.predict(place)
    for part in trained.modules():
        if hasattr(part, "scene"):
            part.scene = replace(part.scene, responses=None)
    expected = trained.predict(place) * links.front_ends.responses
    torch.testing.assert_close(behind, expected, rtol=1e-4, atol=1e-9)


def test_guard_carriers_of_one_constant_are_left_out(tmp_path):
    links = measured(tmp_path, "per_link", invented())
    labels = links.labels.clone()
    strongest = labels.abs().max()
    file = tmp_path / "guarded.npz"
    with np.load(tmp_path / "per_link.npz") as stored:
        arrays = dict(stored)
    guarded = np.full((*labels.shape[:2], SUBCARRIERS), 1000 * strongest, dtype=np.complex64)
    guarded[..., 3:-4] = arrays["h"][..., 3:-4]
    guarded[..., 15] = 0
    np.savez(file, **arrays | {"h": guarded})
    links = gaigs.links("csi_npz", file=file, phase="per_link")
    assert links.task.shape == (ELEMENTS, SUBCARRIERS - 8)
    assert "8 of 30 subcarriers have one value in every link" in links.remarks
    assert links.front_ends.responses.shape == (1, ELEMENTS, SUBCARRIERS - 8)


def test_the_figure_has_a_row_of_a_receiver_with_a_response(links):
    learnt, errors, _ = links.front_ends
    responses = torch.cat((torch.ones_like(learnt), learnt)).numpy()
    deviations = torch.cat((torch.zeros_like(errors), errors)).numpy()
    names = ["plain", "filtered"]
    figure = front_ends(responses, deviations, links.task.frequencies.numpy(), names)
    level, phase = figure.axes
    assert level.get_title() == "front end of filtered"
    assert len(level.lines) == len(phase.lines) == ELEMENTS


@pytest.mark.parametrize("phase", ["known", "per_link_and_delay"])
def test_arrays_of_different_sizes_have_responses(phase, tmp_path):
    links = measured(tmp_path, phase, invented(), is_divided=False)
    small = replace(
        links.receivers[0], name="small", array=gaigs.Array(links.receivers[0].array.elements[:2])
    )
    labels = torch.cat((links.labels, links.labels))
    labels[len(links) :, 2:] = 0
    transmitters = links.query.transmitters.repeat(2, 1)
    numbers = torch.arange(2).repeat_interleave(len(links))
    both = replace(
        links,
        receivers=(*links.receivers, small),
        labels=labels,
        query=gaigs.Query(transmitters, numbers),
        rows=None,
    )
    both = divide(both, {"name": "random", "test": 0.2})
    responses = both.front_ends.responses
    assert (responses[:, 0] != 1).all()
    assert (responses[1, 2:] == 1).all()
    assert (both.front_ends.errors[1, 2:] == 0).all()
    assert (
        score("friis", both)["sinad_db_mean"]
        > 1 + score("friis", replace(both, front_ends=None))["sinad_db_mean"]
    )


@pytest.mark.parametrize("power", [-60, 60])
def test_subcarriers_of_another_power_are_named_in_spite_of_a_response(power, tmp_path):
    response = invented()
    response[:, :2] *= 10 ** (power / 20)
    links = measured(tmp_path, "known", response)
    assert links.front_ends is not None
    assert "2 of 30 subcarriers are 30 dB or more from the usual one in power" in links.remarks
