"""The splatting pipeline: predictions, parameters, refused options."""

from dataclasses import replace

import pytest
import torch
from contracts.rasterizer import rasterize_densely
from pipeline import MEAN_POWER, NONE, PARTS, SOFTMAX, trained, two_branch, watch
from torch import nn

from gaigs.core.geometry import Grid, semi_axes
from gaigs.core.query import Query
from gaigs.data import Split
from gaigs.model.gaigs import GaussianSplatting
from gaigs.registry import registry
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.placement import Placement
from gaigs.testing import check_model, example_links


def excite(model, query):
    """Residuals of the Gaussians at their places."""
    gaussians = model.gaussians
    placed = Placed(gaussians.means.detach()[None])
    return model.deformation(
        model.tokenizer(placed, gaussians.opacities.detach(), query), placed, query
    )


def test_the_pipeline_equals_the_papers_step_by_step(build, batch, links):
    model = build()
    gaussians, pose = model.gaussians, links.receivers[0].pose
    residuals = excite(model, batch.query)
    quats = torch.nn.functional.normalize(gaussians.quats) + residuals.delta_quats
    axes = semi_axes(quats, gaussians.log_scales.exp() + residuals.delta_scales)
    signal = (
        0.28209479 * (gaussians.signal + residuals.delta_signal)[..., 0]
    )  # times the constant spherical harmonic
    opacities = (gaussians.opacity_logits.sigmoid() + residuals.delta_opacities).clamp(0, 1)
    splats = model.projection.project(gaussians.means, axes, pose)
    plane = model.projection.plane(links.task.directions)
    image, _ = rasterize_densely(splats, signal, opacities, residuals.attenuations, plane)
    value, penalties = model(batch)
    # A handful of pixels may stand where a splat is just cut off.
    assert ((value - image.norm(dim=1)).abs() < 1e-4).double().mean() > 0.998
    torch.testing.assert_close(penalties, {"opacity": residuals.delta_opacities.square().mean()})


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
@pytest.mark.parametrize("heads", [["signal", "opacity"], None])
def test_the_model_contract_holds(task, heads):
    deformation = two_branch(heads) if heads else {"name": "none"}
    pooling = {
        "spectrum": PARTS["pooling"],
        "rssi": SOFTMAX,
        "csi": {"name": "element_sum", "grid": [6, 12]},
    }[task]
    trend = {"rssi": {"name": "path_loss"}, "csi": {"name": "friis"}}.get(task)

    def build(scene):
        torch.manual_seed(0)
        return GaussianSplatting(
            scene, **(PARTS | {"deformation": deformation, "pooling": pooling, "trend": trend})
        )

    check_model(build, example_links(task))


def test_harmonics_are_of_the_direction_in_which_a_transmitter_sees_a_gaussian(build, batch):
    model = build(gaussians=PARTS["gaussians"] | {"degree": 1}, deformation={"name": "none"})
    gaussians, places = model.gaussians, batch.query.transmitters
    nn.init.normal_(gaussians.signal)
    with torch.no_grad():
        gaussians.means[3] = places[0]  # which sees it in no direction
    value = model(batch).value
    value.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in gaussians.parameters())
    seen = gaussians.means.detach() - places[:, None]
    x, y, z = (seen / seen.norm(dim=-1, keepdim=True)).nan_to_num().movedim(-1, 0)
    dc, *bands = gaussians.signal.detach().clone().unbind(-1)
    # 3 ** 0.5 is the first degree's factor over that of the constant harmonic.
    sent = dc + 3**0.5 * sum(
        part[..., None] * band for part, band in zip((-y, z, -x), bands, strict=True)
    )
    gaussians.degree = 0
    for row, own in enumerate(sent):
        with torch.no_grad():
            gaussians.signal[..., 0] = own
        one = replace(batch, query=batch.query[row : row + 1])
        torch.testing.assert_close(value[row], model(one).value[0], rtol=0, atol=1e-4)


def test_gaussians_beside_a_placements_own_send_alike(build):
    placement = {"name": "mirrored", "planes": 6, "order": 1, "obstacles": 0}
    parts = {
        "name": "mirrored",
        "placement": placement,
        "gaussians": PARTS["gaussians"] | {"degree": 2},
    }
    with pytest.raises(ValueError, match=r"placement 'mirrored' needs gaussians\.degree=0, got 2"):
        registry("model").build(PARTS | NONE | parts, scene=example_links().scene)


def test_where_gaussians_stand_is_learnt_from_the_image_alone(build, batch):
    model = build()
    assert excite(model, batch.query).delta_opacities.requires_grad
    _, penalties = model(batch)
    penalties["opacity"].backward()
    assert all(parameter.grad is None for parameter in model.gaussians.parameters())


@pytest.mark.parametrize(
    "heads", [[], ["signal"], ["opacity"], ["attenuation"], ["rotation"], ["signal", "opacity"]]
)
def test_without_some_heads_it_predicts_and_trains(build, batch, heads):
    model = build(heads)
    value, penalties = model(batch)
    assert value.shape == batch.labels.shape
    assert list(penalties) == (["opacity"] if "opacity" in heads else [])
    value.square().mean().backward()
    assert model.gaussians.means.grad.any()
    same = torch.allclose(value[0], value[1], rtol=0, atol=1e-6)
    assert same == (not heads)  # only the heads tell transmitters apart


def test_without_deformation_there_is_no_tokenizer(build, batch):
    # Nor does the configuration of one matter.
    model = build(**NONE, tokenizer={"name": "nobody"})
    assert model.tokenizer is None
    assert {name.split(".")[0] for name, _ in model.named_parameters()} == {"gaussians"}
    value, penalties = model(batch)
    assert penalties == {}
    assert torch.equal(value[0], value[1])
    value.square().mean().backward()
    assert all(parameter.grad.any() for parameter in model.parameters())
    assert "network" not in model.parameter_groups()


def test_only_deformed_gaussians_need_a_footprint_for_each_transmitter(build, batch):
    drawn = []
    for heads, sets in (
        (["signal", "opacity", "attenuation"], 1),
        (["rotation"], 3),
        (["scale"], 3),
    ):
        model = build(heads)
        watch(model, drawn)
        model(batch)
        (arguments,) = drawn
        assert arguments[0].factors.shape == (sets, 40, 3)
        drawn.clear()


def test_every_receiver_has_a_view_of_its_own(build, links):
    model = build()
    here, there = (model.predict(links.query.transmitters[:3], receiver) for receiver in (0, 1))
    assert (here - there).abs().max() > 0.01


# --- parts that look at more than the transmitter ---


class Drift(Placement):
    """Gaussians that are carried along by half of the way to the transmitter."""

    def forward(self, gaussians, query):
        return Placed(gaussians.means + query.transmitters[:, None] / 2)


class SeesReceivers(nn.Module):
    """Tokens that are the receiver's number."""

    sees_receivers = True
    scene_width, gaussian_width, transmitter_width = 1, 0, 0

    def __init__(self):
        super().__init__()
        self.rows = []

    def forward(self, placed, opacities, query):
        self.rows.append(len(query))
        nothing = placed.means.new_zeros(placed.means.shape[1], 0)
        return Tokens(
            query.receivers[:, None].to(placed.means),
            nothing,
            placed.means.new_zeros(len(query), 0),
        )


@pytest.fixture
def strangers(monkeypatch):
    """The registered names of the two."""
    monkeypatch.setitem(registry("placement")._registered, "drift", Drift)
    monkeypatch.setitem(registry("tokenizer")._registered, "sees_receivers", SeesReceivers)


@pytest.mark.parametrize("heads", [["signal"], ["rotation", "opacity", "attenuation"]])
def test_gaussians_that_move_are_rendered_for_each_query(build, links, strangers, heads):
    model = build(heads, placement={"name": "drift"}, tokenizer=PARTS["tokenizer"]["euclidean"])
    index = torch.tensor([3, 0, 2, 1, 0])
    value = model(links.batch(index)).value
    means = model.gaussians.means.detach().clone()
    model.placement = registry("placement").build({"name": "free"})
    for i, one in zip(index, value, strict=True):
        batch = links.batch(i[None])
        with torch.no_grad():
            model.gaussians.means.copy_(means + batch.query.transmitters / 2)
        torch.testing.assert_close(one, model(batch).value[0], rtol=0, atol=1e-5)
    assert torch.equal(value[1], value[4])  # the same link twice
    assert (value[1] - value[3]).abs().max() > 0.01


def test_gaussians_that_move_train_and_are_timed(build, links, strangers):
    model = build(
        ["signal"], placement={"name": "drift"}, tokenizer=PARTS["tokenizer"]["euclidean"]
    )
    batch = links.batch(torch.tensor([0, 1, 2, 3]))
    model(batch).value.square().mean().backward()
    assert model.gaussians.means.grad.any()
    assert len(model.rendering(batch)()) == 2  # those to the first link's receiver, one by one
    assert model(links.batch(torch.zeros(0, dtype=torch.long))).value.shape == (0, 18, 36)


def test_a_tokenizer_that_sees_receivers_has_a_row_for_each_link(build, links, strangers):
    links.query.transmitters[1::2] = links.query.transmitters[
        ::2
    ].clone()  # both receivers hear the same places
    model = build(["signal"], tokenizer={"name": "sees_receivers"})
    value = model(links.batch(torch.tensor([0, 1, 2, 3, 1]))).value
    assert model.tokenizer.rows == [4]
    # One hears the same from everywhere, as these tokens know of nothing else.
    torch.testing.assert_close(value[0], value[2], rtol=0, atol=1e-5)
    for i, one in zip((0, 1), value, strict=False):
        torch.testing.assert_close(
            one, model(links.batch(torch.tensor([i]))).value[0], rtol=0, atol=1e-5
        )
    # And the token tells the receivers apart, not only their view.
    changed = links.batch(torch.tensor([1]))
    model.tokenizer.forward = lambda placed, opacities, query: Tokens(
        torch.zeros(1, 1), placed.means.new_zeros(40, 0), torch.zeros(1, 0)
    )
    assert (model(changed).value[0] - value[1]).abs().max() > 1e-3


# --- received signal strength ---


@pytest.fixture
def readings():
    """Two receivers, who hear the same places; one place is heard twice by the first."""
    links = example_links("rssi")
    places, receivers = torch.rand(6, 3), torch.tensor([0, 1])
    transmitters = torch.cat((places.repeat_interleave(2, 0), places[:1]))
    n = len(transmitters)
    split = Split("all", torch.arange(n), torch.arange(0), torch.arange(n))
    query = Query(transmitters, torch.cat((receivers.repeat(6), receivers[:1])))
    return replace(links, query=query, labels=-60 - 9 * torch.rand(n), rows=None, split=split)


@pytest.fixture
def rssi(readings):
    torch.manual_seed(0)
    options = PARTS | {"pooling": SOFTMAX, "trend": {"name": "path_loss"}}
    model = GaussianSplatting(
        readings.scene, **options, deformation=two_branch(["signal", "opacity"])
    )
    model.fit(readings)
    return model


def test_rssi_is_the_pooled_map_on_top_of_the_trend(rssi, readings):
    batch = readings.batch(torch.tensor([0, 2, 4]))  # all of the first receiver
    drawn = []
    watch(rssi, drawn)
    value = rssi(batch).value
    (arguments,) = drawn
    image, _ = rasterize_densely(*arguments)
    assert image.shape == (3, 1, 4, 8)
    assert arguments[4].shape == (4, 8)
    trend = registry("model").build({"name": "path_loss"}, scene=readings.scene)
    trend.fit(readings)
    pooled = rssi.pooling(image.float(), batch.query)
    assert (pooled.abs() > 0.1).all()
    torch.testing.assert_close(value, trend(batch).value + pooled - rssi.level, rtol=0, atol=1e-3)


def test_the_map_is_that_of_the_whole_sphere(rssi, readings):
    drawn = []
    watch(rssi, drawn)
    rssi(readings.batch(torch.tensor([0])))
    plane = rssi.projection.plane(Grid.sphere(4, 8))
    assert torch.equal(drawn[0][4].u, plane.u)
    assert torch.equal(drawn[0][4].v, plane.v)


@pytest.mark.parametrize("pooling", [SOFTMAX, MEAN_POWER], ids=["softmax_attention", "mean_power"])
def test_the_training_starts_from_the_trend(readings, pooling):
    torch.manual_seed(3)
    options = PARTS | {
        "pooling": pooling,
        "trend": {"name": "mean"},
        "deformation": two_branch(["signal"]),
    }
    model = GaussianSplatting(readings.scene, **options)
    assert model.predicts_untrained
    model.fit(readings)
    everything = readings.batch(torch.arange(13))
    corrections = model(everything).value - model.trend(everything).value
    assert corrections.mean().abs() < 1e-3
    assert model.level.abs() > 0.01
    level = model.level.clone()
    model.fit(readings)
    torch.testing.assert_close(model.level, level, rtol=0, atol=1e-4)


def test_a_place_is_mapped_once_for_all_who_hear_it(rssi, readings):
    asked = []
    rssi.deformation.register_forward_pre_hook(
        lambda _, arguments: asked.append(len(arguments[0].transmitters))
    )
    rssi(readings.batch(torch.arange(13)))
    assert asked == [6]


# --- complex channels ---


def test_channels_are_the_trend_and_the_waves_of_the_map():
    links = example_links("csi")
    torch.manual_seed(0)
    options = PARTS | {
        "pooling": {"name": "element_sum", "grid": [6, 12]},
        "trend": {"name": "friis"},
    }
    model = trained(GaussianSplatting(links.scene, **options, deformation=two_branch(["signal"])))
    model.fit(links)
    assert model.level == 0  # waves have no level
    batch, drawn = links.batch(torch.tensor([0, 2])), []
    watch(model, drawn)
    value = model(batch).value
    assert value.dtype == torch.complex64
    image, _ = rasterize_densely(*drawn[0])
    assert image.shape == (2, 10, 6, 12)  # real and imaginary parts of five subcarriers
    waves = model.pooling(image.float(), batch.query)
    scale = value.abs().max().item()
    assert waves.abs().max() > 1e-3 * scale
    torch.testing.assert_close(value, model.trend(batch).value + waves, rtol=0, atol=1e-4 * scale)


# --- refused options ---


def test_a_pooling_for_other_labels_is_refused(build, readings):
    with pytest.raises(
        ValueError,
        match=r"'softmax_attention' gives \(\), not labels of task 'spectrum', \(18, 36\)",
    ):
        build(pooling=SOFTMAX)
    with pytest.raises(
        ValueError, match="labels of task 'rssi' have no directions; take the task's own pooling"
    ):
        build(scene=readings.scene)
    with pytest.raises(
        ValueError, match="'element_sum' gives complex channels, not labels of task 'spectrum'"
    ):
        build(pooling={"name": "element_sum", "grid": [4, 8]})


def test_a_projection_that_folds_the_sphere_is_refused(readings):
    options = PARTS | NONE | {"pooling": SOFTMAX, "projection": {"name": "direction_cosine"}}
    with pytest.raises(ValueError, match="below the array's plane, which direction_cosine folds"):
        GaussianSplatting(readings.scene, **options)


@pytest.mark.parametrize("name", ["knn", "gaussian_process"])
def test_look_ups_are_refused_as_trends(readings, name):
    trend = {"name": name} | ({"k": 3} if name == "knn" else {})
    with pytest.raises(ValueError, match=f"task.trend.name cannot be {name}; take mean"):
        GaussianSplatting(readings.scene, **PARTS | NONE | {"pooling": SOFTMAX, "trend": trend})
