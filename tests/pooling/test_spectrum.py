"""The magnitude of a real or complex map."""

import pytest
import torch

from gaigs.pooling.spectrum import SpectrumPooling
from gaigs.query import Query

QUERY = Query(torch.zeros(3, 3), torch.zeros(3, dtype=torch.long))


def test_two_channels_are_the_magnitude_of_a_complex_number():
    image = torch.randn(3, 2, 4, 5)
    torch.testing.assert_close(SpectrumPooling(2)(image, QUERY), torch.complex(image[:, 0], image[:, 1]).abs())


def test_one_channel_is_its_magnitude():
    image = torch.randn(3, 1, 4, 5)
    assert torch.equal(SpectrumPooling(1)(image, QUERY), image[:, 0].abs())


@pytest.mark.parametrize("channels", [0, 3, -1])
def test_other_numbers_of_channels_are_refused(channels):
    with pytest.raises(ValueError, match=f"1 real or 2 complex channels, got channels={channels}"):
        SpectrumPooling(channels)
