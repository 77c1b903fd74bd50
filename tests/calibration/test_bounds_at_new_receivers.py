"""Bounds of errors at receivers without links."""

import math

import pytest
import torch

from gaigs.calibration.new_receivers import NewReceivers


def drawn(receivers, links, kind):
    """Errors at receivers, each of which errs as a whole (receivers, links)."""
    normal = torch.randn(receivers, links, dtype=torch.float64)
    common = torch.randn(receivers, 1, dtype=torch.float64)
    if kind == "levels":  # a gain and what is left [dB]
        return (4 * common + 4 * normal).abs()
    return (0.7 * common + 1.5 * normal).exp()  # shadows: most links err little, a few much


@pytest.mark.parametrize("kind", ["levels", "channels"])
@pytest.mark.parametrize(("count", "taught"), [(2, 0), (3, 0), (5, 0), (8, 0), (8, 6), (8, 7)])
def test_bounds_hold_their_share_at_one_more_receiver(kind, count, taught):
    torch.manual_seed(0)
    shares = []
    for _ in range(150):
        errors = drawn(count, 60, kind)
        errors[:taught] *= 0.5  # the room fits these
        receivers = torch.arange(count).repeat_interleave(60)
        new = NewReceivers(receivers, receivers < taught)
        errors = errors.reshape(-1, 1)
        levels = torch.tensor([0.9], dtype=torch.float64)
        bound = new.quantiles(errors, torch.ones_like(errors, dtype=torch.bool), levels)
        shares.append((drawn(8, 200, kind) <= bound).double().mean().item())
    assert 0.85 < sum(shares) / len(shares) < 0.96


def test_bounds_rise_with_the_level_and_without_scatter_are_those_of_links():
    errors = torch.linspace(0, 1, 101, dtype=torch.float64).repeat(4)[:, None]
    receivers = torch.arange(4).repeat_interleave(101)
    inside = torch.ones_like(errors, dtype=torch.bool)
    levels = torch.linspace(0, 1, 21, dtype=torch.float64)
    bounds = NewReceivers(receivers, receivers < 0).quantiles(errors, inside, levels)
    torch.testing.assert_close(bounds, levels, atol=0.02, rtol=0)
    errors[receivers == 0] *= 3
    wide = NewReceivers(receivers, receivers < 0).quantiles(errors, inside, levels)
    assert (wide.diff() >= 0).all()
    assert wide[18] > bounds[18]


def test_fitted_receivers_count_for_scatter_alone_unless_others_err_less():
    torch.manual_seed(1)
    errors = drawn(6, 100, "channels").reshape(-1, 1)
    receivers = torch.arange(6).repeat_interleave(100)
    inside = torch.ones_like(errors, dtype=torch.bool)
    levels = torch.tensor([0.9], dtype=torch.float64)

    def bound(factor, taught):
        scaled = torch.where((receivers < 4)[:, None], errors * factor, errors)
        return NewReceivers(receivers, receivers < taught).quantiles(scaled, inside, levels).item()

    assert math.isclose(bound(0.1, 4), bound(0.01, 4))
    # Others that err less by chance do not narrow the bound below that of all.
    assert bound(100.0, 4) > errors[receivers < 4].quantile(0.9)


def test_receivers_without_numbers_do_not_count():
    errors = drawn(3, 50, "levels").reshape(-1, 1)
    receivers = torch.arange(3).repeat_interleave(50)
    levels = torch.tensor([0.5, 0.9], dtype=torch.float64)
    inside = (receivers < 2)[:, None]
    found = NewReceivers(receivers, receivers < 0).quantiles(errors, inside, levels)
    two = NewReceivers(receivers[:100], receivers[:100] < 0)
    assert torch.equal(found, two.quantiles(errors[:100], inside[:100], levels))
