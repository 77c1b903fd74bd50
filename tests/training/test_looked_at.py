"""What a step looks at of its batch: which directions, and places moved by jitter."""

from dataclasses import replace

import pytest
import torch
from fitting import fit, make_links, make_module
from lightning.pytorch.callbacks import Callback

from gaigs.directions import Rays
from gaigs.query import Query


@pytest.fixture(scope="module")
def links():
    return make_links()


@pytest.fixture
def module(links):
    return make_module(links)


class Recorder(Callback):
    """First row and column, and loss of every step."""

    def __init__(self):
        self.offsets, self.losses = [], []

    def on_train_batch_end(self, trainer, module, outputs, *_):
        rows, columns = (torch.rad2deg(x).round().int() for x in vars(module.model.batch.directions).values())
        assert rows.tolist() == list(range(int(rows[0]), 24, 3))
        assert columns.tolist() == list(range(int(columns[0]), 30, 3))
        self.offsets.append((int(rows[0]), int(columns[0])))
        self.losses.append(outputs["loss"].item())


def test_rows_and_columns_are_random_but_follow_from_seed_and_step(module, links, tmp_path):
    first, again, other = Recorder(), Recorder(), Recorder()
    fit(module, links, tmp_path, 30, first)
    torch.manual_seed(99)
    fit(make_module(links), links, tmp_path, 30, again)
    fit(make_module(links, seed=1), links, tmp_path, 30, other)
    assert first.offsets == again.offsets
    assert first.losses == again.losses
    assert first.offsets != other.offsets
    assert set(first.offsets) == {(row, column) for row in range(3) for column in range(3)}


def test_rays_are_random_pixels_of_all_links_alike(links, tmp_path):
    seen = []

    class Rayed(Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, _):
            rays, prediction = module.model.batch.directions, module.model.prediction
            assert isinstance(rays, Rays)
            rows, columns = (torch.rad2deg(x).round().long() for x in (rays.elevations, rays.azimuths))
            assert len({*zip(rows.tolist(), columns.tolist(), strict=True)}) == 50
            labels = batch.labels[:, rows, columns]
            assert prediction.value.shape == labels.shape == (4, 50)
            mae = (labels - prediction.value).abs().mean().item()
            expected = mae + 0.5 * prediction.penalties["gain"].item()
            assert outputs["loss"].item() == pytest.approx(expected, rel=1e-5)
            seen.append((30 * rows + columns).tolist())

    trainer = fit(make_module(links, thinning={"rays": 50}), links, tmp_path, 12, Rayed())
    assert len({tuple(sorted(rays)) for rays in seen}) == 12
    assert len({ray for rays in seen for ray in rays}) > 350, "of 720; 50 of them 12 times leave 303 out on average"
    assert "validation/ssim" in trainer.callback_metrics, "whole spectra, which have windows"


@pytest.mark.parametrize(
    ("thinning", "message"),
    [
        ({"strid": 3}, r"training\.thinning has no option 'strid' \(did you mean 'stride'\?\); it has: stride, rays"),
        ({"stride": 0}, r"training\.thinning\.stride must be in 1\.\.8 for this grid, got 0"),
        ({"stride": 9}, r"training\.thinning\.stride must be in 1\.\.8 for this grid, got 9"),
        ({"rays": 721}, r"training\.thinning\.rays must be in 1\.\.720 for this grid, with stride=1, got 721"),
        ({"rays": 5, "stride": 2}, "with stride=1, got 5 and stride 2"),
    ],
)
def test_thinning_refuses(links, thinning, message):
    with pytest.raises(ValueError, match=message):
        make_module(links, thinning=thinning)


# --- jitter ---


@pytest.fixture
def at_step(monkeypatch):
    """What a module makes of a batch at some step, without a trainer."""

    def prepare(module, batch, step):
        with monkeypatch.context() as patch:
            patch.setattr(type(module), "global_step", step)
            return module.prepare(batch)

    return prepare


@pytest.fixture
def crowd(links):
    """Links by threes at one place; the third of them has another carrier."""
    query = Query(
        links.query.transmitters[torch.arange(12) // 3],
        torch.arange(12) % 2,
        torch.tensor([1e9, 1e9, 1.1e9]).repeat(4),
    )
    return replace(links.batch(torch.arange(12)), query=query)


def test_jitter_moves_each_place_as_a_whole_and_anew_in_every_step(links, crowd, at_step):
    module, before = make_module(links, jitter=0.1), crowd.query.transmitters.clone()
    moved = [at_step(module, crowd, step) for step in range(400)]
    moves = torch.stack([batch.query.transmitters for batch in moved]) - before
    assert torch.equal(moves[:, 0::3], moves[:, 1::3]), "one place, one carrier"
    assert (moves[:, 0::3] != moves[:, 2::3]).all(), "another carrier is another place"
    independent = moves.unflatten(1, (4, 3))[:, :, 1:].flatten()
    # Of 9,600 draws the deviation is known to 1 / sqrt(19200) = 0.7 %, and their mean to 0.1 / sqrt(9600).
    assert independent.std().item() == pytest.approx(0.1, rel=0.03)
    assert abs(independent.mean().item()) < 0.004
    assert len(independent.unique()) > 9500
    assert torch.equal(crowd.query.transmitters, before), "the data stay where they are"
    for batch in moved[:3]:
        assert torch.equal(batch.query.receivers, crowd.query.receivers)
        assert torch.equal(batch.query.frequencies, crowd.query.frequencies)


def test_jitter_follows_from_seed_and_step(links, crowd, at_step):
    draw = lambda seed, step: at_step(make_module(links, jitter=0.1, seed=seed), crowd, step).query.transmitters
    assert torch.equal(draw(0, 3), draw(0, 3))
    assert not torch.equal(draw(0, 3), draw(1, 3))
    assert not torch.equal(draw(0, 3), draw(0, 4))


def test_without_jitter_places_are_as_measured(module, crowd, at_step):
    assert torch.equal(at_step(module, crowd, 5).query.transmitters, crowd.query.transmitters)


def test_validation_knows_no_jitter(links, tmp_path):
    module = make_module(links, jitter=5.0)
    fit(module, links, tmp_path, 5)
    assert torch.equal(module.model.batch.query.transmitters, links.query.transmitters[10:11])
