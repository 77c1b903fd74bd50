"""Wrong levels among the known ones, which must not move a fit; and strange ones that are a part of
the room.
"""

import pytest
import torch

import gaigs
from gaigs.core.query import Batch
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.path_loss import PathLoss

RECEIVERS = torch.tensor([[0.0, 0.0, 2.0], [12.0, 8.0, 2.0]])
PLACES = torch.rand(80, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor(
    [12.0, 8.0, 1.0]
)


def survey(change=None):
    """Levels with shadowing, some of them changed by ``change`` [dB] (80, 2)."""
    levels = -40 - 20 * torch.cdist(PLACES, RECEIVERS).log10()
    levels += 3 * torch.randn(80, 2, generator=torch.Generator().manual_seed(4))
    levels = levels if change is None else levels + change
    return gaigs.links(
        task="rssi",
        transmitters=PLACES,
        receivers=RECEIVERS,
        labels=levels,
        test_rows=range(60, 80),
    )


def wrong(number, size):
    return torch.zeros(80, 2).index_put((torch.tensor(number), torch.tensor(1)), torch.tensor(size))


def test_clean_levels_all_count():
    links = survey()
    assert without_gross_errors(links).split.known.tolist() == links.split.known.tolist()


@pytest.mark.parametrize("model", [PathLoss, GaussianProcess])
@pytest.mark.parametrize("size", [70.0, -100.0])
def test_one_wrong_level_does_not_move_a_fit(model, size, monkeypatch):
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(iterations=5))

    def error(links):
        one = model(links.scene)
        one.fit(links)
        test = links.split.test
        return (one(Batch(links.query[test])).value - survey().labels[test]).abs().mean().item()

    usual = error(survey())
    for number in (5, 40):
        assert error(survey(wrong(number, size))) == pytest.approx(usual, abs=0.05)


def test_levels_with_neighbours_like_them_are_a_part_of_the_room():
    """A corner behind a metal wall: nine of 60 places with 40 dB less."""
    corner = (PLACES[:60, :2] - torch.tensor([12.0, 0.0])).norm(dim=1).argsort()[:9]
    change = torch.zeros(80, 2).index_fill(0, corner, -40.0)
    links = survey(change)
    assert len(without_gross_errors(links).split.known) == len(links.split.known)
