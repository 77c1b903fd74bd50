"""The links that look-ups learn from."""

from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links


def known_links(links: Links) -> list[Int[Tensor, "k"]]:
    """Those of each receiver that are not held out for the test.

    Raises:
        ValueError: A receiver has none.
    """
    known = [links.known(receiver) for receiver in range(len(links.receivers))]
    deaf = [receiver.name for receiver, index in zip(links.receivers, known, strict=True) if not len(index)]
    if deaf:
        raise ValueError(
            f"each receiver must have links to train or validate on, but on split {links.split.name!r} there are none "
            f"of {', '.join(deaf)}; choose another split, or leave the receiver out of the data"
        )
    return known
