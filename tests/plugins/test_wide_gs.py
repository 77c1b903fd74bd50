"""WideGS: what it is made of, and that both of its networks see the carrier."""

from dataclasses import replace

import pytest
import torch
from splatting import build, check_task, composed, repository, run

from gaigs.data import load
from gaigs.data.nerf2_spectrum import write
from gaigs.gaussians import Placed
from gaigs.query import Query
from gaigs.testing import check_model, example_links

CARRIERS = torch.tensor([2.4e9, 5.0e9, 28e9])
SMALL = ("model=wide_gs", "gaussians.count=40", "deformation.width=16", "rasterizer=torch")


@pytest.fixture
def links():
    """Spectra of three carriers."""
    links = example_links()
    return replace(links, query=replace(links.query, frequencies=CARRIERS[torch.arange(24) % 3]))


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_it_keeps_the_contract_of_models(task):
    check_task(task, *SMALL)


def test_it_keeps_the_contract_with_several_carriers(links):
    config = composed(*SMALL)["model"]
    check_model(lambda scene: build("model", config, scene=scene), links)


def test_both_networks_see_the_carrier(links):
    model = build("model", composed(*SMALL)["model"], scene=links.scene)
    with torch.no_grad():
        for head in model.deformation.heads.values():
            head.weight.normal_()
    query = Query(links.query.transmitters[:1].expand(3, 3), torch.zeros(3, dtype=torch.long), CARRIERS)
    placed = Placed(model.gaussians.means.detach()[None])
    residuals = model.deformation(model.tokenizer(placed, model.gaussians.opacities, query), placed, query)
    for part in (residuals.attenuations, residuals.delta_signal):
        for i, j in ((0, 1), (1, 2)):
            assert (part[i] - part[j]).abs().max() > 1e-3
    assert residuals.delta_quats is residuals.delta_scales is residuals.delta_opacities is None


def test_carriers_in_between_are_predicted_and_a_missing_one_is_asked_for(links):
    model = build("model", composed(*SMALL)["model"], scene=links.scene)
    low, between = (model.predict(links.query.transmitters[0], 0, frequency) for frequency in (2.4e9, 3.5e9))
    assert (low - between).abs().max() > 1e-3
    with pytest.raises(ValueError, match="3 carriers"):
        model.predict(links.query.transmitters[0], 0)


def test_one_carrier_is_no_input(links):
    links = replace(links, query=replace(links.query, frequencies=CARRIERS[:1].expand(24)))
    one, several = (
        build("model", composed(*SMALL)["model"], scene=scene).tokenizer.network[0].in_features
        for scene in (links.scene, replace(links.scene, frequencies=CARRIERS))
    )
    assert one < several


@pytest.mark.parametrize(
    ("chosen", "pooling", "width"),
    [
        ((), "spectrum", 128),
        (("data=synthetic_rssi",), "softmax_attention", 64),
        (("+experiment=rssi",), "softmax_attention", 64),
        (("+experiment=csi",), "element_sum", 64),
    ],
)
def test_it_is_itself_with_every_task(chosen, pooling, width):
    config = composed("model=wide_gs", *chosen)["model"]
    assert (config["name"], config["tokenizer"]["name"]) == ("wide_gs", "euclidean")
    assert config["deformation"]["heads"] == ["signal", "attenuation"]
    assert (config["pooling"]["name"], config["deformation"]["width"]) == (pooling, width)


def test_a_run_on_a_folder_with_the_carrier_of_each_link(tmp_path, monkeypatch):
    room = composed("data=synthetic", "data.transmitters=15", "data.order=1", "data.frequency=[2.4e9,5.0e9]")
    with repository():
        write(tmp_path / "room", load(room["data"], room["split"]))
    overrides = (f"data.root={tmp_path / 'room'}", "training.thinning.stride=8")
    _, metrics, loaded = run(tmp_path / "run", monkeypatch, *SMALL, "data=nerf2_spectrum", *overrides)
    assert "2 carriers of freq.txt, 2400 to 5000 MHz" in metrics["data"]
    assert metrics["models"].keys() == {"wide_gs", "mean"}
    assert loaded.scene.frequencies.tolist() == pytest.approx([2.4e9, 5.0e9])
