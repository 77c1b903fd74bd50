"""Terms of a trend beyond the logarithm of the distance, found in masts that were made up."""

from dataclasses import replace

import pytest
import torch

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Batch, Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links, Split
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.path_loss import PathLoss
from gaigs.model.shaped_path_loss import ShapedPathLoss

MASTS = torch.tensor([[0.0, 0.0, 30.0], [400.0, 100.0, 25.0]])
BREAK = 200.0  # [m]


def survey(*terms, noise=3.0, count=500, seed=0):
    """Levels at two masts with some terms on the law of path loss; a fifth of the places test."""
    generator = torch.Generator().manual_seed(seed)
    box = torch.tensor([1000.0, 1000.0, 120.0])
    places = (torch.rand(count, 3, generator=generator) - 0.5) * box + torch.tensor([0, 0, 60.0])
    transmitters = places.repeat(2, 1)
    receivers = torch.arange(2).repeat_interleave(count)
    steps = transmitters - MASTS[receivers]
    lengths = steps.norm(dim=1)
    levels = -30 - 25 * lengths.log10()
    azimuths = torch.atan2(steps[:, 1], steps[:, 0])
    if "break point" in terms:
        levels = levels - 20 * (lengths / BREAK).log10().clamp_min(0)
    if "lobes" in terms:  # a sector towards 0 and 60 degrees, 12 dB stronger than at its back
        levels = levels + 6 * (azimuths - torch.pi / 3 * receivers).cos()
    if "height" in terms:  # 10 dB from the ground to 120 m
        levels = levels + 10 * transmitters[:, 2] / 120
    levels = levels + noise * torch.randn(len(levels), generator=generator)
    parts = torch.arange(count) % 5
    train, validation, test = ((parts < 3), (parts == 3), (parts == 4))
    index = [part.repeat(2).nonzero()[:, 0] for part in (train, validation, test)]
    masts = []
    for number, place in enumerate(MASTS):
        masts.append(Receiver(f"mast{number}", Pose(place, torch.eye(3))))
    split = Split("made up", *index)
    return Links(Query(transmitters, receivers), tuple(masts), levels, Rssi(), split=split)


def fitted(links, model=ShapedPathLoss):
    trend = model(links.scene)
    trend.fit(links)
    return trend


def mean_error(model, links):
    test = links.split.test
    return (model(Batch(links.query[test])).value - links.labels[test]).abs().mean().item()


@pytest.mark.parametrize(
    "terms", [(), ("break point",), ("lobes",), ("height",), ("break point", "lobes", "height")]
)
def test_terms_are_found_and_only_those(terms):
    links = survey(*terms)
    trend = fitted(links)
    assert trend.facts()["terms"] == (", ".join(terms) or "none")
    error, of_law = mean_error(trend, links), mean_error(fitted(links, PathLoss), links)
    assert error < of_law - 0.1 if terms else error == of_law
    assert error < 2.75  # the noise alone has 2.4 dB


def test_coefficients_are_within_their_errors():
    terms = fitted(survey("break point", "lobes", "height", noise=2.0, count=800)).terms
    assert (10**terms.breaks).tolist() == pytest.approx([BREAK, BREAK], rel=0.25)
    harmonics = terms.options.harmonics
    columns = [5 + 2 * harmonics, *range(2, 2 + 2 * harmonics), 2 + 2 * harmonics]
    true = torch.zeros(2, len(columns), dtype=torch.float64)
    true[:, 0] = -20  # the change of the slope
    turns = torch.pi / 3 * torch.arange(2)
    true[:, 1] = 6 * turns.cos()
    true[:, 2] = 6 * turns.sin()
    true[:, -1] = 5
    errors = (terms.coefficients[:, columns] - true) / terms.deviations[:, columns]
    assert errors.abs().max() < 3
    assert terms.deviations[:, columns[1:]].max() < 3  # [dB]: errors that say something


def test_lines_of_the_log(caplog):
    links = survey("lobes")
    with caplog.at_level("INFO", logger="gaigs.kriging.path_terms"):
        GaussianProcess(links.scene, trend={"name": "shaped_path_loss"}).fit(links)
    (line,) = caplog.messages
    assert line.startswith("trend beyond path loss: lobes; held-out error ")
    assert line.endswith(" dB")


def test_a_refit_keeps_the_terms_and_fits_their_numbers():
    links = survey("lobes")
    trend = fitted(links)
    before = trend.terms.coefficients.clone()
    few = replace(links, split=links.split.only(links.split.train[::2]))
    trend.refit(few)
    assert trend.facts()["terms"] == "lobes"
    assert not torch.equal(trend.terms.coefficients, before)


def test_unseen_errors_are_larger_than_seen_ones():
    links = survey("lobes", count=60)
    trend = fitted(links)
    index = links.split.known
    seen = (links.labels[index] - trend(Batch(links.query[index])).value).square().mean()
    unseen = trend.terms.unseen[index].square().mean()
    assert seen < 0.98 * unseen


def test_a_process_of_before_loads_without_terms():
    links = survey("lobes")
    old = GaussianProcess(links.scene)
    old.fit(links)
    state = old.get_extra_state()
    law = fitted(links, PathLoss)
    state["trends"][1] = dict(law.state_dict())
    new = GaussianProcess(links.scene)
    new.set_extra_state(state)
    batch = Batch(links.query[:5])
    torch.testing.assert_close(new.trends[1](batch).value, law(batch).value)


def test_few_or_equal_readings_give_the_law():
    links = survey(count=10)
    trend, law = fitted(links), fitted(links, PathLoss)
    batch = Batch(links.query)
    torch.testing.assert_close(trend(batch).value, law(batch).value)
    assert trend.facts() == {"terms": "none"}
