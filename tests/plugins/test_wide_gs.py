"""WideGS: both of its networks see the carrier."""

from dataclasses import replace

import pytest
import torch
from splatting import build, composed, repository, run

from gaigs.core.query import Query
from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.splatting.gaussians import Placed
from gaigs.testing import example_links

CARRIERS = torch.tensor([2.4e9, 5.0e9, 28e9])
SMALL = ("model=wide_gs", "gaussians.count=40", "deformation.width=16", "rasterizer=torch")


@pytest.fixture
def links():
    """Spectra of three carriers."""
    links = example_links()
    return replace(links, query=replace(links.query, frequencies=CARRIERS[torch.arange(24) % 3]))


def test_both_networks_see_the_carrier(links):
    model = build("model", composed(*SMALL)["model"], scene=links.scene)
    with torch.no_grad():
        for head in model.deformation.heads.values():
            head.weight.normal_()
    query = Query(
        links.query.transmitters[:1].expand(3, 3), torch.zeros(3, dtype=torch.long), CARRIERS
    )
    placed = Placed(model.gaussians.means.detach()[None])
    residuals = model.deformation(
        model.tokenizer(placed, model.gaussians.opacities, query), placed, query
    )
    for part in (residuals.attenuations, residuals.delta_signal):
        for i, j in ((0, 1), (1, 2)):
            assert (part[i] - part[j]).abs().max() > 1e-3
    assert residuals.delta_quats is residuals.delta_scales is residuals.delta_opacities is None


def test_a_run_on_a_folder_with_the_carrier_of_each_link(tmp_path, monkeypatch):
    room = composed(
        "data=synthetic", "data.transmitters=15", "data.order=1", "data.frequency=[2.4e9,5.0e9]"
    )
    with repository():
        write(tmp_path / "room", load(room["data"], room["split"]))
    overrides = (f"data.root={tmp_path / 'room'}", "training.thinning.stride=8")
    _, metrics, loaded = run(
        tmp_path / "run", monkeypatch, *SMALL, "data=nerf2_spectrum", *overrides
    )
    assert "2 carriers of freq.txt, 2400 to 5000 MHz" in metrics["data"]
    assert metrics["models"].keys() == {"wide_gs", "mean"}
    assert loaded.scene.frequencies.tolist() == pytest.approx([2.4e9, 5.0e9])
