import pytest
import torch


def random_versor(algebra, count, generator):
    """The product of ``count`` random unit vectors: one mirrors, two rotate, translate or boost,
    three do both.
    """
    versor = torch.nn.functional.one_hot(torch.tensor(0), algebra.size).double()
    while count:
        vector = algebra.grade(
            torch.randn(algebra.size, generator=generator, dtype=torch.float64), 1
        )
        square = algebra.inner(vector, vector)
        if (
            square.abs() > 0.5 * vector.square().sum()
        ):  # nearly null vectors make boosts beyond float64
            versor = algebra.product(versor, vector / square.abs().sqrt())
            count -= 1
    return versor


@pytest.fixture
def make_versor():
    return random_versor


@pytest.fixture
def check_equivariance():
    """Asserts that ``function(*multivectors) -> (multivectors, invariants)`` commutes with mirrors
    and motions.
    """

    def check(algebra, function, *multivectors):
        generator = torch.Generator().manual_seed(7)
        result, invariants = function(*multivectors)
        for count in (1, 2, 3, 4):
            versor = random_versor(algebra, count, generator)
            moved, unmoved = function(*(algebra.sandwich(versor, x) for x in multivectors))
            expected = algebra.sandwich(versor, result)
            assert not torch.allclose(expected, result, rtol=1e-3), (
                "nothing moves, so the check would prove nothing"
            )
            torch.testing.assert_close(moved, expected, rtol=1e-8, atol=1e-8)
            torch.testing.assert_close(unmoved, invariants, rtol=1e-8, atol=1e-8)

    return check
