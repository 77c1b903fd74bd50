"""Random phases are noticed in the training channels; phases that geometry explains are not taken
for random.
"""

import functools
import logging
from dataclasses import replace

import pytest
import torch

import gaigs
from gaigs.core.phases import array_sign, strange_parts, unknown_phase
from gaigs.core.scene import direct_waves
from gaigs.core.task.csi import Csi
from gaigs.data import divide
from gaigs.model.kriging import Kriging
from gaigs.registry import registry

SPLIT = {"name": "random", "seed": 0}
each = pytest.mark.parametrize("phase", Csi.phases)


@functools.cache  # tests change copies
def simulated(phase):
    return gaigs.links("synthetic_csi", transmitters=60, subcarriers=8, phase=phase)


def undeclared(links, labels=None):
    """The same links with phases declared as known, divided anew."""
    task = Csi(links.task.elements, links.task.frequencies)
    return divide(
        replace(links, task=task, labels=links.labels if labels is None else labels, remarks="a"),
        SPLIT,
    )


@each
def test_a_random_phase_is_noticed_and_its_option_named(phase, caplog):
    for conjugate in (False, True):
        links = simulated(phase)
        with caplog.at_level(logging.WARNING):
            remarks = undeclared(
                links, links.labels.conj().resolve_conj() if conjugate else None
            ).remarks
        if phase == "known":
            assert (remarks, caplog.text) == ("a", "")
        else:
            assert remarks.startswith("a; channels have no phase in common")
            assert f"set data.phase={phase}, or check" in remarks
            assert caplog.text.count(f"data.phase={phase},") == 1 + conjugate


def test_a_declared_phase_is_a_remark_without_a_warning(caplog):
    assert simulated("per_link").remarks == "phase of each link unknown, and removed in every score"
    assert "phase, delay and gain of each link unknown" in simulated("per_link_and_delay").remarks
    assert not caplog.text


@pytest.mark.parametrize("what", ["noise", "reflection", "few"])
def test_channels_unlike_the_direct_wave_tell_nothing(what):
    links = simulated("per_link" if what == "few" else "known")
    labels, query, task = links.labels.to(torch.complex128), links.query, links.task
    waves = direct_waves(links.scene, query, task.frequencies)
    if what == "noise":
        labels = torch.randn(
            labels.shape, dtype=labels.dtype, generator=torch.Generator().manual_seed(0)
        )
    if what == "reflection":  # by a wall behind the transmitters, which hides the direct path
        images = query.transmitters * torch.tensor([-1.0, 1.0, 1.0]) + torch.tensor(
            [14.0, 0.0, 0.0]
        )
        labels = direct_waves(links.scene, replace(query, transmitters=images), task.frequencies)
    count = 4 if what == "few" else len(labels)
    parts = (part[:count] for part in (labels, waves, query.receivers))
    assert unknown_phase(*parts, task.frequencies) is None


def test_random_delays_declared_as_phases_alone_are_noticed():
    links = simulated("per_link_and_delay")
    task = Csi(links.task.elements, links.task.frequencies, "per_link")
    links = divide(replace(links, task=task), SPLIT)
    words = "no delay in common, as if each packet had its own; set data.phase=per_link_and_delay"
    assert words in links.remarks
    assert any(words in doubt for doubt in gaigs.describe(links).suspicious)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("delay", "gateway1 has a response of its front end, 1 numbers over the band"),
        ("elements", "gateway1 has a response of its front end"),
        ("order", "phases of the channels do not follow the direct distance"),
    ],
)
def test_phases_that_geometry_does_not_explain_are_noticed(what, words, caplog):
    links = simulated("known")
    labels, frequencies = links.labels, links.task.frequencies
    if what == "delay":
        labels = labels * torch.exp(-2j * torch.pi * 5e-9 * frequencies).to(labels)
    if what == "elements":
        labels = labels * torch.exp(1j * torch.arange(16.0))[:, None]
    if what == "order":
        labels = labels.roll(1, 0)
    remarks = undeclared(links, labels).remarks
    assert words in remarks
    if what == "order":  # a response explains the others
        assert words in caplog.text
        assert remarks.count(";") == 2
    else:
        assert remarks.count(";") == 1


def test_places_in_one_direction_say_nothing_of_elements():
    links = simulated("known")
    task, receivers = links.task, torch.zeros(60, dtype=torch.long)
    waves = torch.ones(60, *task.shape, dtype=torch.complex128)
    turns = torch.polar(torch.ones(16), torch.arange(16.0))[:, None]
    assert strange_parts(turns * waves, waves, receivers, task.frequencies, -1) == {}


@each
def test_the_sign_of_the_array_shows_through_what_is_unknown(phase):
    links = simulated(phase)
    waves = direct_waves(links.scene, links.query, links.task.frequencies)
    for labels, sign in ((links.labels, -1), (links.labels.conj().resolve_conj(), 1)):
        labels = labels.to(torch.complex128)
        assert array_sign(labels, waves, links.task.frequencies) == sign
        assert links.task.phase_sign(labels, waves, links.query.receivers) == sign


def turned(links, seed=0):
    """The same links with another random phase each, and another delay and gain where they are
    unknown.
    """
    generator = torch.Generator().manual_seed(seed)
    angles, delays, gains = (
        2 * torch.rand(3, len(links), 1, 1, generator=generator, dtype=torch.float64) - 1
    )
    offsets = links.task.frequencies - links.task.frequencies.mean()
    if links.task.phase == "per_link":
        delays, gains = 0 * delays, 0 * gains
    angles = torch.pi * angles + 2e-9 * torch.pi * delays * offsets
    labels = links.labels * torch.polar(2 ** gains.expand_as(angles), angles)
    return replace(links, labels=labels.to(torch.complex64))


def trained(links):
    """A model as it is before its training, kriged."""
    torch.manual_seed(0)
    model = registry("model").build(
        {"name": "gaigs", "gaussians": {"count": 5}, "trend": "friis"}, scene=links.scene
    )
    model.fit(links)
    return Kriging(links.scene, model.eval(), {"name": "mean"})


@pytest.mark.parametrize("phase", Csi.phases[1:])
@pytest.mark.parametrize("name", ["friis", "knn", "mean", "gaussian_process", "kriging"])
def test_what_is_unknown_of_the_training_links_changes_no_score(name, phase):
    links = simulated(phase)
    scores = []
    for own in (links, turned(links)):
        model = (
            trained(own) if name == "kriging" else registry("model").build(name, scene=own.scene)
        )
        model.fit(own)
        values = model.predict(links.query[links.split.test])
        scores.append(links.task.scores(links.labels[links.split.test], values)["snr_aligned_db"])
    torch.testing.assert_close(*scores, rtol=0, atol=0.02)
