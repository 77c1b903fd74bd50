"""Kriged strengths of paths against dense solutions in numpy, and in a model of mirrored paths."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist

from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Split
from gaigs.kriging.paths import Equations, PathField, PathProcess, conjugate_gradients
from gaigs.model.kriging import Kriging
from gaigs.model.mirrored import MirroredSplatting
from gaigs.testing import example_links

PROCESS = PathProcess(2.0, 0.1, 0.4)


def draw(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=(*shape, 2)) @ [1, 1j]


def solved(places, fields, labels, residuals):
    channels = [torch.from_numpy(part)[..., None] for part in (fields, labels, residuals)]
    found = PathField()

    def margins(part):
        return channels[0][part]

    found.solve(Equations.of(torch.from_numpy(places), margins, *channels[1:]), PROCESS)
    return found


def dense(places, asked, fields, labels, residuals):
    """Covariances of the processes with the residuals, and of the residuals."""
    n, powers = (
        fields.shape[1],
        (np.abs(residuals) ** 2).mean(1) + 1e-4 * (np.abs(labels) ** 2).mean(1),
    )

    def each(a, b):
        return np.kron(PROCESS.deviation**2 * np.exp(-cdist(a, b) / PROCESS.length), np.eye(n))

    matrix = block_diag(*(part.T for part in fields))
    noise = np.diag(np.repeat(PROCESS.nugget * powers, labels.shape[1]))
    return each(asked, places) @ matrix.conj().T, matrix @ each(
        places, places
    ) @ matrix.conj().T + noise


def test_strengths_are_the_dense_solution():
    """Of more links than one part; two of them at one place."""
    places, asked = (
        np.random.default_rng(0).uniform(0, 5, (70, 3)),
        np.random.default_rng(1).uniform(0, 5, (4, 3)),
    )
    places[1] = places[0]
    fields, labels = draw(70, 3, 8), draw(70, 8, seed=1)
    residuals = draw(70, 8, seed=2) * 10.0 ** np.random.default_rng(3).uniform(
        -3, 0, (70, 1)
    )  # some in shadow
    found = solved(places, fields, labels, residuals)(torch.from_numpy(asked), PROCESS)
    towards, covariances = dense(places, asked, fields, labels, residuals)
    expected = (towards @ np.linalg.solve(covariances, residuals.flatten())).reshape(4, 3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_variances_of_resolved_paths_are_the_dense_ones():
    places, asked = (
        np.random.default_rng(0).uniform(0, 5, (20, 3)),
        np.random.default_rng(1).uniform(0, 5, (4, 3)),
    )
    fields = np.linalg.qr(draw(20, 8, 3))[0].swapaxes(1, 2) * np.array([2, 1, 0.3])[:, None]
    labels = draw(20, 8, seed=1)
    field = solved(places, fields, labels, labels)
    with torch.device("meta"):  # all that is made must stand where the places are, as on a GPU
        found = field.variances(torch.from_numpy(asked), PROCESS)
    towards, covariances = dense(places, asked, fields, labels, labels)
    known = np.einsum("ij,ji->i", towards, np.linalg.solve(covariances, towards.conj().T)).real
    np.testing.assert_allclose(found, (PROCESS.deviation**2 - known).reshape(4, 3), rtol=1e-4)


def test_conjugate_gradients_stop_at_their_tolerance():
    root, right, calls = torch.from_numpy(draw(30, 30)), torch.from_numpy(draw(30, seed=1)), []
    matrix = root @ root.mH + 5 * torch.eye(30)

    def times(x):
        return calls.append(0) or matrix @ x

    x = conjugate_gradients(times, lambda rest: rest, right)
    assert 1e-9 < (matrix @ x - right).norm() / right.norm() <= 1.1e-6
    assert len(calls) < 100
    assert not conjugate_gradients(times, lambda rest: rest, 0 * right).any()


# --- in a model of mirrored paths ---


def made(smooth=0.0, noise=0.0, phase="known", validation=20):
    """Links whose paths deviate smoothly from a model's, with noise, and the model."""
    links = example_links("csi")
    generator = torch.Generator().manual_seed(0)
    places = torch.tensor([6.0, 4.0, 2.0]) * torch.rand(120, 3, generator=generator)
    task = Csi(4, links.task.frequencies, phase)
    split = Split("made up", *torch.arange(120).split((80, validation, 40 - validation)))
    query = Query(places, torch.zeros(120, dtype=torch.long))
    links = replace(
        links, query=query, receivers=links.receivers[:1], rows=None, split=split, task=task
    )
    links = replace(links, labels=torch.zeros(120, *task.shape, dtype=torch.complex64))
    torch.manual_seed(0)
    placement = {"name": "mirrored", "order": 1, "planes": 6, "obstacles": 0}
    model = MirroredSplatting(links.scene, placement=placement)
    model.placement.enable_phases(0.12)
    labels, margins = model.predict(links.query), model.margins(links.query)
    waves = (places @ torch.randn(3, margins.shape[1], generator=generator) / 3).cos()
    labels = labels + smooth * (waves[..., None, None] * margins).sum(1)
    labels = labels + noise * labels.abs().mean() * torch.randn(
        labels.shape, dtype=labels.dtype, generator=generator
    )
    if phase != "known":
        labels = 1e4 ** (phase == "per_link_and_delay") * labels  # whose gain is unknown
        labels = (
            labels
            * torch.polar(torch.ones(120), 6 * torch.rand(120, generator=generator))[:, None, None]
        )
    return replace(links, labels=labels), model


def errors(model, links):
    test = links.split.test
    return links.task.scores(links.labels[test], model.predict(links.query[test]))[
        "error_power"
    ].sum()


@torch.no_grad()
@pytest.mark.parametrize("passing", [1.0, 0.5, 0.01])
def test_margins_are_largest_where_obstacles_block_a_part(passing, monkeypatch):
    links, model = made()
    clear = model.predict(links.query)
    model.placement.obstacles = torch.nn.Identity()

    def depths(obstacles, folded, strengths):
        return torch.full_like(strengths.real, -math.log(passing))

    monkeypatch.setattr(model.placement, "_depths", depths)
    torch.testing.assert_close(
        model.margins(links.query).sum(1), (passing * (1 - passing) + 0.1) * clear
    )


@pytest.mark.parametrize("phase", ["known", "per_link", "per_link_and_delay"])
def test_smooth_strengths_are_kriged(phase):
    links, trend = made(smooth=0.4, phase=phase)
    model = Kriging(links.scene, trend)
    model.fit(links)
    assert model.facts()["kriging"]["weight"] == 1
    assert errors(model, links) < 0.9 * errors(trend, links)
    fresh = Kriging(links.scene, trend)
    fresh.load_state_dict(model.state_dict())
    assert torch.equal(fresh.predict(links.query), model.predict(links.query))


def test_variance_grows_away_from_known_places():
    links, trend = made(smooth=0.4)
    model = Kriging(links.scene, trend)
    model.fit(links)
    variance = model.deviations(links.batch(torch.arange(5))).square()
    assert variance.shape == (5, *links.task.shape)
    assert (variance > 0).all()
    process = model.posterior.process
    places = links.query.transmitters[:5].double()
    near, far = (model.posterior.fields[0].variances(at, process) for at in (places, places + 20))
    assert (near < far).all()
    torch.testing.assert_close(far, torch.full_like(far, process.deviation**2), rtol=1e-2, atol=0)
    trend.double()
    double = model.deviations(links.batch(torch.arange(5))).square()
    torch.testing.assert_close(double, variance, rtol=1e-3, atol=0)


@pytest.mark.parametrize(("smooth", "noise", "validation"), [(0.0, 1.0, 20), (0.4, 0.0, 0)])
def test_noise_is_not_kriged_nor_links_without_validation(smooth, noise, validation):
    links, trend = made(smooth, noise, validation=validation)
    model = Kriging(links.scene, trend)
    model.fit(links)
    assert model.weight == 0
    assert torch.equal(model.predict(links.query), trend.predict(links.query))


def test_labels_are_kriged_where_paths_explain_less(caplog):
    """Of dense places whose phases no plane explains."""
    links, trend = made()
    places = links.query.transmitters / 100
    labels = torch.polar(torch.ones(120), 30 * places.sum(1))[:, None, None] * trend.predict(
        links.query
    ).mean(0)
    links = replace(links, query=replace(links.query, transmitters=places), labels=labels)
    model = Kriging(links.scene, trend, {"name": "friis"})
    model.fit(links)
    assert "paths do not explain the channels" in caplog.text
    assert errors(model, links) < 0.1 * errors(trend, links)
    fresh = Kriging(links.scene, trend, {"name": "friis"})
    fresh.load_state_dict(model.state_dict())
    assert torch.equal(fresh.predict(links.query), model.predict(links.query))
    assert model.deviations(links.batch(torch.arange(5))).shape == (5,)


@pytest.mark.parametrize("by_paths", [True, False])
def test_halves_of_the_validation_links_keep_what_all_of_them_chose(by_paths, monkeypatch):
    links, trend = made()
    model = Kriging(links.scene, trend, {"name": "friis"})
    model.krige(links, by_paths=by_paths)
    # Each half would choose the other.
    monkeypatch.setattr("gaigs.model.kriging.is_surely_better", lambda *_, **__: by_paths)
    assert [one.posterior.by_paths for one, *_ in model.unseen(links)] == [by_paths] * 2
