import pytest
import torch

from gaigs.core.query import Query
from gaigs.splatting.pooling.spectrum import SpectrumPooling


def test_values_are_magnitudes_of_real_or_complex_maps():
    image, query = (
        torch.randn(3, 2, 4, 5),
        Query(torch.zeros(3, 3), torch.zeros(3, dtype=torch.long)),
    )
    torch.testing.assert_close(
        SpectrumPooling(2)(image, query), torch.complex(image[:, 0], image[:, 1]).abs()
    )
    assert torch.equal(SpectrumPooling(1)(image[:, :1], query), image[:, 0].abs())
    with pytest.raises(ValueError, match="1 real or 2 complex channels, got channels=3"):
        SpectrumPooling(3)
