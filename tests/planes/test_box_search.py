"""Boxes that explain shadows."""

import pytest
import torch

from gaigs.planes.box_search import BoxSearch, ChannelErrors, LevelErrors
from gaigs.splatting.placement.mirrored.obstacles import passes_box
from gaigs.splatting.placement.mirrored.reflections import fold

CORNERS = torch.tensor([[2.0, 1.0, 0.0], [2.4, 2.6, 1.8]])
LOSS = 2.0  # [Np]


@pytest.fixture
def links():
    """Direct paths from places outside a box to six receivers along the walls of a room."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(60, 3, generator=generator) * torch.tensor([4.8, 3.8, 1.8])
    places = places[~((places > CORNERS[0]) & (places < CORNERS[1])).all(1)]
    receivers = torch.tensor(
        [[0, 1, 1], [0, 3, 2], [5, 1, 2], [5, 3, 1], [2, 0, 1.5], [3, 4, 1]], dtype=torch.float
    )
    sent = places.repeat(len(receivers), 1)
    heard = receivers.repeat_interleave(len(places), 0)
    sequences = torch.zeros(1, 0, dtype=torch.long)
    paths = fold([sent[:, None]], heard, sequences, torch.zeros(0, 3), torch.zeros(0))
    return paths, sent, heard


def search(links, depths):
    """The boxes found for channels of one number that these depths dim."""
    paths, sent, heard = links
    fields = torch.ones(len(sent), 1, 1, 1, dtype=torch.complex64)
    errors = ChannelErrors.of(fields, (-depths).exp()[:, None, None].to(fields))
    return BoxSearch(paths, errors, torch.cat((sent, heard))).run()


def test_box_is_found_from_the_links_that_it_dims(links):
    _, sent, heard = links
    blocked = passes_box(sent, heard, CORNERS)
    (box,) = search(links, LOSS * blocked.float())
    assert box.loss == pytest.approx(LOSS, rel=0.05)
    found = passes_box(sent, heard, box.corners)
    assert (found == blocked).float().mean() > 0.98
    # No path tells how low or how deep the box reaches beyond its neighbours.
    assert (box.corners - CORNERS)[:, :2].abs().max() < 0.3


def test_links_in_the_open_have_no_box(links):
    generator = torch.Generator().manual_seed(1)
    assert search(links, 0.2 * torch.rand(len(links[1]), generator=generator)) == []


@pytest.mark.parametrize("looks", [0, 3, 40, 400])
def test_search_ends_with_the_time(links, monkeypatch, looks):
    _, sent, heard = links
    asked = []

    def is_up():
        asked.append(len(asked))
        return len(asked) > looks

    monkeypatch.setattr("gaigs.core.stages.is_up", is_up)
    search(links, LOSS * passes_box(sent, heard, CORNERS).float())
    assert len(asked) == looks + 1


def test_errors_are_those_of_the_sum_of_paths():
    generator = torch.Generator().manual_seed(2)
    fields = torch.randn(5, 4, 2, 3, generator=generator, dtype=torch.complex64)
    channels = torch.randn(5, 2, 3, generator=generator, dtype=torch.complex64)
    depths = torch.rand(5, 4, generator=generator)
    rest = channels - torch.einsum("bnes,bn->bes", fields, (-depths).exp().to(fields))
    share = rest.abs().square().sum((1, 2)) / channels.abs().square().sum((1, 2))
    expected = (share / 1e-3).log1p() - (share * 1e-3).log1p()
    torch.testing.assert_close(ChannelErrors.of(fields, channels)(depths), expected)


def test_levels_find_the_box_whatever_the_gains_of_receivers(links):
    paths, sent, heard = links
    blocked = passes_box(sent, heard, CORNERS)
    _, receivers = heard.unique(dim=0, return_inverse=True)
    powers = (sent - heard).square().sum(1, keepdim=True).reciprocal()
    clear = 10 * powers[:, 0].log10() + 5 * receivers
    levels = clear - 20 * LOSS * blocked / torch.tensor(10.0).log()
    search = BoxSearch(paths, LevelErrors(powers, levels, receivers), torch.cat((sent, heard)))
    (box,) = search.run()
    assert box.loss == pytest.approx(LOSS, rel=0.1)
    assert (passes_box(sent, heard, box.corners) == blocked).float().mean() > 0.97
    assert search.gain([box]) > 0.1
    # Receivers in the open do not confirm it.
    proof = BoxSearch(paths, LevelErrors(powers, clear, receivers), torch.cat((sent, heard)))
    assert proof.gain([box]) < 0
