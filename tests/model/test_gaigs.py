"""The splatting pipeline: what it predicts, by which parameters, and what it refuses."""

from dataclasses import replace

import pytest
import torch

from gaigs.data import Split
from gaigs.geometry import covariances
from gaigs.model import Batch
from gaigs.model.gaigs import GaussianSplatting
from gaigs.registry import registry
from gaigs.testing import example_links, rasterize_densely
from gaigs.training.batches import take

EUCLIDEAN = {"gaussian_octaves": [-3, 2], "transmitter_octaves": [-2, 4], "hidden": 16, "width": 8}
PARTS = {
    "tokenizer": {"name": "multiview", "ga": {"name": "ga"}, "euclidean": {"name": "euclidean", **EUCLIDEAN}},
    "projection": {"name": "mercator"},
    "rasterizer": {"name": "torch"},
    "pooling": {"name": "spectrum", "channels": 2},
    "gaussians": {"count": 40, "near": 2.0, "far": 5.0, "spread": 1.0, "opacity": 0.1, "signal": 1.0},
}
ALL = ["rotation", "scale", "signal", "opacity", "attenuation"]


@pytest.fixture
def links():
    return example_links()


@pytest.fixture
def batch(links):
    return take(links, torch.tensor([0, 2, 4]))


@pytest.fixture
def build(links):
    def build(heads=ALL, **parts):
        torch.manual_seed(0)
        mapping = {"width": 16, "attenuation_layers": 1, "signal_layers": 1, "heads": heads}
        model = GaussianSplatting(links.scene, **(PARTS | parts), mapping=mapping)
        with torch.no_grad():  # as after some training
            model.gaussians.log_scales.add_(0.5 * torch.randn(40, 3))
            for head in model.mapping.heads.values():
                head.weight.normal_(std=0.1)
        return model

    return build


def test_it_is_the_papers_pipeline_step_by_step(build, batch, links):
    model = build()
    gaussians, pose = model.gaussians, links.receivers[0].pose
    tokens = model.tokenizer(gaussians.means, gaussians.opacities, batch.transmitters)
    residuals = model.mapping(tokens)
    quats = torch.nn.functional.normalize(gaussians.quats) + residuals.delta_quats
    matrices = covariances(quats, gaussians.log_scales.exp() + residuals.delta_scales)
    signal = 0.28209479 * (gaussians.signal + residuals.delta_signal)[..., 0]  # times the constant spherical harmonic
    opacities = (gaussians.opacity_logits.sigmoid() + residuals.delta_opacities).clamp(0, 1)
    splats = model.projection.project(gaussians.means, matrices, pose)
    plane = model.projection.plane(links.grid.elevations, links.grid.azimuths)
    image, _ = rasterize_densely(splats, signal, opacities, residuals.attenuations, plane)
    label, penalties = model(batch)
    # A handful of pixels may stand where a splat is just cut off.
    assert ((label - image.norm(dim=1)).abs() < 1e-4).double().mean() > 0.998
    torch.testing.assert_close(penalties, {"opacity": residuals.delta_opacities.square().mean()})


def test_gradients_reach_all_parameters(build, batch):
    model = build()
    label, penalties = model(batch)
    (label.square().mean() + penalties["opacity"]).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_where_gaussians_stand_is_learnt_from_the_image_alone(build, batch):
    model = build()
    tokens = model.mapping(
        model.tokenizer(model.gaussians.means.detach(), model.gaussians.opacities, batch.transmitters)
    )
    assert tokens.delta_opacities.requires_grad
    _, penalties = model(batch)
    penalties["opacity"].backward()
    assert all(parameter.grad is None for parameter in model.gaussians.parameters())


@pytest.mark.parametrize("heads", [[], ["signal"], ["opacity"], ["attenuation"], ["rotation"], ["signal", "opacity"]])
def test_without_some_heads_it_predicts_and_trains(build, batch, heads):
    model = build(heads)
    label, penalties = model(batch)
    assert label.shape == batch.labels.shape
    assert list(penalties) == (["opacity"] if "opacity" in heads else [])
    label.square().mean().backward()
    assert model.gaussians.means.grad.any()
    same = torch.allclose(label[0], label[1], rtol=0, atol=1e-6)
    assert same == (not heads)  # only the heads tell transmitters apart


def test_only_deformed_gaussians_need_a_footprint_for_each_transmitter(build, batch):
    for heads, sets in ((["signal", "opacity", "attenuation"], 1), (["rotation"], 3), (["scale"], 3)):
        splats, *_ = build(heads).render_arguments(batch)
        assert splats.covariances2d.shape == (sets, 40, 2, 2)


def test_every_receiver_has_a_view_of_its_own(build, links):
    model = build()
    here, there = (model.predict(links.transmitters[:3], receiver) for receiver in (0, 1))
    assert (here - there).abs().max() > 0.01


def test_fewer_directions_get_the_values_of_all(build, batch):
    model = build()
    thin = batch.thin(slice(1, None, 3), slice(2, None, 4))
    torch.testing.assert_close(model(thin).label, model(batch).label[:, 1::3, 2::4], rtol=0, atol=1e-5)


def test_groups_name_what_learning_rates_are_given_for(build):
    groups = build().parameter_groups()
    assert list(groups) == ["means", "quats", "log_scales", "opacity_logits", "signal", "network"]
    assert all(len(group) == 1 for name, group in groups.items() if name != "network")


# --- predict ---


def test_batches_do_not_change_predictions(build, links):
    model = build()
    together = model.predict(links.transmitters, batch_size=24)
    for size in (1, 5, 100):
        torch.testing.assert_close(model.predict(links.transmitters, batch_size=size), together, rtol=0, atol=1e-5)
    assert torch.equal(together, model.predict(links.transmitters, batch_size=24))


def test_predict_takes_lists_and_leaves_the_mode(build):
    model = build().train()
    labels = model.predict([[1, 2, 1.5], [0, 0, 0]], 1)
    assert model.training
    assert labels.shape == (2, 18, 36)
    assert not labels.requires_grad
    assert labels.isfinite().all()
    assert model.eval().predict([[1, 2, 1.5]]).shape == (1, 18, 36)
    assert not model.training
    assert model.predict(torch.zeros(0, 3)).shape == (0, 18, 36)


def test_predict_takes_points_grids_and_receivers_of_any_kind(build):
    model, points = build(), torch.rand(2, 3, 3)
    each = torch.stack([model.predict(points.flatten(0, 1), receiver) for receiver in (0, 1)])
    close = lambda found, true: torch.testing.assert_close(found, true, rtol=0, atol=1e-5)
    close(model.predict(points, "gateway1"), each[1].unflatten(0, (2, 3)))
    close(model.predict(points[1, 2], 1), each[1, 5])
    receivers = torch.tensor([0, 1, 1, 0, 1, 0])
    close(model.predict(points.flatten(0, 1), receivers), each[receivers, torch.arange(6)])


# --- received signal strength ---


@pytest.fixture
def readings(links):
    """Two receivers, who hear the same places; one place is heard twice by the first."""
    places, receivers = torch.rand(6, 3), torch.tensor([0, 1])
    transmitters = torch.cat((places.repeat_interleave(2, 0), places[:1]))
    n = len(transmitters)
    split = Split("all", torch.arange(n), torch.arange(0), torch.arange(n))
    index = torch.cat((receivers.repeat(6), receivers[:1]))
    return replace(
        links, transmitters=transmitters, receiver_index=index, labels=-60 - 9 * torch.rand(n), grid=None, split=split
    )


@pytest.fixture
def rssi(readings):
    torch.manual_seed(0)
    mapping = {"width": 16, "attenuation_layers": 1, "signal_layers": 1, "heads": ["signal", "opacity"]}
    pooling = {"name": "softmax_attention", "temperature": 0.3, "prior": 0.2}
    options = PARTS | {"pooling": pooling, "grid": [4, 8], "reference": {"name": "path_loss"}, "mapping": mapping}
    model = GaussianSplatting(readings.scene, **options)
    model.fit(readings)
    return model


def test_rssi_is_the_pooled_map_on_top_of_the_reference(rssi, readings):
    batch = take(readings, torch.tensor([0, 2, 4]))  # all of the first receiver
    image, _ = rssi.rasterizer(*rssi.render_arguments(batch))
    assert image.shape == (3, 1, 4, 8)
    reference = registry("model").build({"name": "path_loss"}, scene=readings.scene)
    reference.fit(readings)
    pooled = rssi.pooling(image)
    assert (pooled.abs() > 0.1).all()
    torch.testing.assert_close(rssi(batch).label, reference(batch).label + pooled - rssi.level)


@pytest.mark.parametrize("pooling", [{"temperature": 0.3, "prior": 0.2}, {"channels": 2, "floor_db": -60.0}])
def test_the_training_starts_from_the_reference(rssi, readings, pooling):
    name = "mean_power" if "channels" in pooling else "softmax_attention"
    torch.manual_seed(3)
    mapping = {"width": 16, "attenuation_layers": 1, "signal_layers": 1, "heads": ["signal"]}
    options = PARTS | {"pooling": {"name": name, **pooling}, "grid": [4, 8], "reference": {"name": "mean"}}
    model = GaussianSplatting(readings.scene, **options, mapping=mapping)
    model.fit(readings)
    everything = take(readings, torch.arange(13))
    corrections = model(everything).label - model.reference(everything).label
    assert corrections.mean().abs() < 1e-3
    assert model.level.abs() > 0.01


def test_links_of_several_receivers_come_out_in_their_order(rssi, readings):
    index = torch.randperm(13)
    together = rssi(take(readings, index)).label
    alone = torch.cat([rssi(take(readings, i[None])).label for i in index])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-4)


def test_a_place_is_mapped_once_for_all_who_hear_it(rssi, readings):
    asked = []
    rssi.mapping.register_forward_pre_hook(lambda _, arguments: asked.append(len(arguments[0].transmitters)))
    rssi(take(readings, torch.arange(13)))
    assert asked == [6]


def test_a_pooling_for_other_labels_is_refused(build, readings):
    softmax = {"name": "softmax_attention", "temperature": 0.3, "prior": 0.2}
    with pytest.raises(ValueError, match="labels are spectra, so the pooling must give maps, and softmax_att"):
        build(pooling=softmax)
    options = {"grid": [4, 8], "reference": {"name": "mean"}, "mapping": {}}
    with pytest.raises(ValueError, match="labels are RSSI, so the pooling must give numbers, and spectrum does not"):
        GaussianSplatting(readings.scene, **PARTS | options)


def test_a_projection_that_folds_the_sphere_is_refused(readings):
    softmax = {"name": "softmax_attention", "temperature": 0.3, "prior": 0.2}
    options = {"pooling": softmax, "grid": [4, 8], "reference": {"name": "mean"}, "mapping": {}}
    with pytest.raises(ValueError, match="below the array's plane, which direction_cosine folds"):
        GaussianSplatting(readings.scene, **PARTS | options | {"projection": {"name": "direction_cosine"}})


@pytest.mark.parametrize("grid", [[2.5, 3], [6, 12, 3], [True, 4]])
def test_a_map_takes_two_whole_numbers(readings, grid):
    with pytest.raises(ValueError, match=r"model\.grid must be \[rows, columns\], two whole numbers, got"):
        GaussianSplatting(readings.scene, **PARTS | {"grid": grid, "reference": {"name": "mean"}, "mapping": {}})


def test_a_look_up_is_no_reference(readings):
    options = {"grid": [4, 8], "reference": {"name": "knn", "k": 3}, "mapping": {}}
    with pytest.raises(ValueError, match="a checkpoint can store, and knn is a look-up"):
        GaussianSplatting(readings.scene, **PARTS | options)


@pytest.mark.parametrize("options", [{"grid": [4, 8]}, {"reference": {"name": "mean"}}])
def test_spectra_have_a_grid_of_their_own_and_no_reference(build, options):
    with pytest.raises(ValueError, match=rf"model\.{next(iter(options))} must be given for RSSI and null for spectra"):
        build(**options)


@pytest.mark.parametrize(
    ("transmitters", "receiver", "message"),
    [
        ([1.0, 2], 0, r"\(..., 3\) positions \[m\], got shape \(2,\)"),
        ([[1.0, 2]], 0, r"got shape \(1, 2\)"),
        ([[1.0, 2, 3], [0, float("nan"), 1]], 0, r"must be finite, got \[0.0, nan, 1.0\] in row 1"),
        ([[1.0, float("inf"), 3]], 0, "must be finite"),
        ([[1.0, 2, 3]], 2, "must be one of 0 = gateway0, 1 = gateway1, got 2"),
        ([[1.0, 2, 3]], -1, "got -1"),
        ([[1.0, 2, 3]], "gateway2", "must be one of 0 = gateway0, 1 = gateway1, got 'gateway2'"),
        ([[1.0, 2, 3]], True, "must be one of 0 = gateway0, 1 = gateway1, got True"),
        ([[1.0, 2, 3]], ["gateway0"], r"must be one of 0 = gateway0, 1 = gateway1, got \['gateway0'\]"),
        ([[1.0, 2, 3]], torch.tensor([0, 1]), r"one for each of the \(1,\) positions, got \(2,\)"),
    ],
)
def test_impossible_questions_are_refused(build, transmitters, receiver, message):
    with pytest.raises(ValueError, match=message):
        build([]).predict(transmitters, receiver)


def test_gaussians_that_become_nan_are_not_hidden(build, links):
    model = build()
    with torch.no_grad():
        model.gaussians.means[3] = torch.nan
    assert model.predict(links.transmitters[:1]).isnan().any()


def test_a_batch_moves_and_thins(batch):
    moved = batch.to(torch.device("meta"))
    assert {moved.transmitters.device.type, moved.labels.device.type, moved.grid.azimuths.device.type} == {"meta"}
    bare = replace(batch, labels=None, grid=None).to(torch.device("meta"))
    assert bare == Batch(bare.transmitters, bare.receivers, None, None)
