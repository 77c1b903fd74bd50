"""Splits of any number of links, in rows of any length, anywhere in space."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import seeds

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.registry import registry

OPTIONS = {"blocks": {"edge": st.floats(1e-3, 1e3)}, "runs": {"length": st.integers(1, 2**62)}}
OPTIONS |= {"sparse": {"train": st.integers(1, 300)}, "official": {"length": st.integers(1, 9)}}
"""Options of a split beside its fractions."""


def make(count, seed, is_ordered, size):
    """Links to one receiver in rows of one to three, in the order of measurement or not."""
    generator = torch.Generator().manual_seed(seed)
    rows = (
        torch.arange(count)
        if is_ordered
        else torch.randint(0, count, (count,), generator=generator)
    )
    where = size * torch.rand(count, 3, generator=generator)[rows]
    return Links(
        query=Query(where, torch.zeros(count, dtype=torch.long)),
        receivers=(Receiver("gateway1", Pose(torch.zeros(3), torch.eye(3))),),
        labels=torch.linspace(-80, -40, count),
        task=Rssi(),
        rows=rows,
        official=lambda: (torch.arange(0, count, 2), torch.arange(1, count, 2)),
    )


shapes = st.tuples(
    st.integers(1, 120), seeds, st.booleans(), st.sampled_from([0.0, 1e-3, 3.0, 1e4])
)


@pytest.mark.parametrize("name", registry("split").names())
@given(shapes, st.data(), st.floats(0.01, 0.99), st.floats(0, 0.9), st.integers(0, 2**63 - 1))
def test_parts_are_disjoint_cover_and_repeat(name, shape, data, test, validation, seed):
    links = make(*shape)
    options = {key: data.draw(strategy) for key, strategy in OPTIONS.get(name, {}).items()}
    options |= {"validation": validation, "seed": seed} | (
        {} if name == "official" else {"test": test}
    )

    def build():
        return registry("split").build({"name": name} | options, links=links)

    try:
        split = build()
    except ValueError:
        return
    parts = split.train, split.validation, split.test
    for part, again in zip(parts, (build().train, build().validation, build().test), strict=True):
        assert torch.equal(part, again)
        assert (part.diff() > 0).all()
    everything = torch.cat(parts)
    assert len(everything.unique()) == len(everything)
    assert everything.ge(0).all()
    assert everything.lt(len(links)).all()
    if name != "sparse":
        assert len(everything) == len(links)
    assert len(split.train) or not len(links)
    if name != "official":
        rows = [set(links.rows[part].tolist()) for part in parts]
        assert not rows[0] & rows[1] | rows[0] & rows[2] | rows[1] & rows[2]
