"""Searches for planes with fewer steps of descent, which are most of their time."""

import pytest

from gaigs.planes import channel_score, field_score, free_strengths
from gaigs.planes.search import descend


@pytest.fixture
def half_the_steps(monkeypatch):
    """Half of the steps find planes of these small rooms as well."""

    def fewer(loss, receivers, planes, others, steps, rate, *turns):
        return descend(loss, receivers, planes, others, (steps + 1) // 2, rate, *turns)

    for module in (channel_score, field_score, free_strengths):
        monkeypatch.setattr(module, "descend", fewer)
