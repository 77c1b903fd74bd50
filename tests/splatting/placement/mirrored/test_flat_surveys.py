"""Surveys that span no height, or no side: what they say of planes across."""

import pytest
import torch

import gaigs
from gaigs.model.mirrored import MirroredSplatting


def survey(heights, receivers, places=None):
    """Links at random places of given heights, or at other places."""
    generator = torch.Generator().manual_seed(0)
    places = 8 * torch.rand(60, 3, generator=generator) if places is None else places
    places[:, 2] = torch.as_tensor(heights)
    levels = -40 - 20 * torch.cdist(places, torch.tensor(receivers)).log10()
    levels += 2 * torch.randn(levels.shape, generator=generator)
    return gaigs.links(task="rssi", transmitters=places, receivers=receivers, labels=levels)


def started(links, tmp_path):
    """Facts and exported room of a model before its training."""
    model = MirroredSplatting(links.scene)
    model.fit(links)
    model.export(tmp_path)
    return model.facts(), (tmp_path / "planes.obj").read_text()


HIGH = [[1.0, 1.0, 2.2], [7.0, 2.0, 2.2], [4.0, 7.0, 2.2]]


def across(facts, axis):
    return [plane for plane in facts["planes"] if abs(plane["normal"][axis]) > 0.9]


def test_no_height_from_places_at_one_height(tmp_path):
    facts, text = started(survey(1.0, [[x, y, 1.0] for x, y, _ in HIGH]), tmp_path)
    assert not across(facts, 2)
    assert len(across(facts, 0)) == len(across(facts, 1)) == 2
    assert facts["unseen"] == ["height not seen: all places at 1.00 m"]
    assert "# height not seen: all places at 1.00 m\n" in text


def test_no_side_from_places_on_a_line(tmp_path):
    line = torch.stack((torch.linspace(0, 8, 60), torch.full((60,), 3.0), torch.zeros(60)), 1)
    facts, _ = started(survey(1.0, [[-1.0, 3.0, 1.0], [9.0, 3.0, 1.0]], line), tmp_path)
    assert not across(facts, 1) + across(facts, 2)
    assert facts["unseen"] == [
        "y not seen: all places at 3.00 m",
        "height not seen: all places at 1.00 m",
    ]


def test_a_floor_may_be_a_ceiling_where_receivers_stand_at_another_height(tmp_path):
    facts, text = started(survey(1.0, HIGH), tmp_path)
    assert len(across(facts, 2)) == 2
    for plane in across(facts, 2):
        heights = [plane[name] * plane["normal"][2] for name in ("offset_m", "other_offset_m")]
        assert sum(heights) == pytest.approx(3.2, abs=0.05)
    assert "may stand at 3.20 m - h" in facts["unseen"][0]
    assert " m or " in text


@pytest.mark.parametrize("places", ["places", "receivers"])
def test_different_heights_on_one_end_are_enough(places, tmp_path):
    heights = torch.linspace(0.5, 2.0, 60) if places == "places" else 1.0
    receivers = HIGH if places == "places" else [[1.0, 1.0, 1.0], [7.0, 2.0, 2.2]]
    facts, text = started(survey(heights, receivers), tmp_path)
    assert len(across(facts, 2)) == 2
    assert "unseen" not in facts
    assert "seen" not in text.partition("# normal")[0]
