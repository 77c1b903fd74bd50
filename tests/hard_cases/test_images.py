"""Placements, also of plug-ins, with planes and transmitters in degenerate positions."""

import pytest
import torch
from precision import build, require_same, widen
from test_contracts import composed
from torch.nn import functional

from gaigs.core.query import Query
from gaigs.registry import registry
from gaigs.splatting.placement.mirrored.reflections import all_sequences, fold, images
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians

LINKS = {
    "rssi": example_links("rssi", 5e9),
    "spectrum": example_links("spectrum", 5e9),
    "csi": example_links("csi"),
}
SCENE = LINKS["spectrum"].scene
receiver = SCENE.receivers[0].pose.position
middle = (SCENE.lower + SCENE.upper) / 2
X, Y, Z = torch.eye(3).tolist()
slanted = functional.normalize(torch.tensor([1.0, -2.0, 0.5]), dim=0)

PLANES = {
    "as they start": [],
    "parallel": [(X, 5.0), (X, 6.0), (X, -1.0), (X, 7.0), (X, 5.5), (X, 8.0)],
    "coincident": [(X, 5.0)] * 6,
    "coincident, facing each other": [(X, 5.0), ([-1.0, 0.0, 0.0], -5.0)] * 3,
    "nearly parallel": [([1.0, 1e-5 * k, -1e-5 * k], 5.0 + 1e-3 * k) for k in range(6)],
    "through the receiver": [
        (slanted.tolist(), float(slanted @ receiver)),
        *[(axis, 4.0) for axis in (X, Y, Z)],
    ],
    "all through the receiver": [
        (axis, float(receiver @ torch.tensor(axis))) for axis in (X, Y, Z, X, Y, Z)
    ],
    "through the middle": [
        (axis, float(middle @ torch.tensor(axis))) for axis in (X, Y, Z, X, Y, Z)
    ],
    "a million metres away": [(X, 1e6), (Y, -1e6), (Z, 1e6)],
    "at the origin": [(X, 0.0), (Y, 0.0), (Z, 0.0)],
}
PLACES = {
    "somewhere": torch.stack((middle, SCENE.lower + 0.3, SCENE.upper - 0.2)),
    "on the receiver": receiver.expand(3, 3),
    "beside the receiver": receiver + torch.tensor([[1e-6, 0, 0], [0, 1e-4, 0], [0, 0, 1e-7]]),
    "on a plane": torch.stack((torch.tensor([5.0, 1, 1]), torch.tensor([0.0, 0, 0]), middle)),
    "on the receiver's height": torch.stack(
        [torch.tensor([x, 1.0, float(receiver[2])]) for x in (1.0, 2.0, 3.0)]
    ),
    "right below the receiver": receiver - torch.tensor([[0, 0, 0.5], [0, 0, 1.0], [0, 0, 2.0]]),
    "behind the planes": torch.tensor([[50.0, 1, 1], [-50.0, 2, 1], [1.0, 1, -70]]),
}
CASES = [(planes, "somewhere") for planes in PLANES]
CASES += [
    (planes, places) for planes in ("parallel", "all through the receiver") for places in PLACES
]
CASES += [("as they start", places) for places in PLACES if places != "somewhere"]
DIGITS = 2e-6
"""Rounding of an image, of its longest path."""


def laid(placement, planes):
    """The placement with these planes, each a normal and an offset [m]; all in use."""
    if planes and hasattr(placement, "place"):
        for number, (normal, offset) in enumerate(planes):
            placement.place(
                number, torch.tensor([*functional.normalize(torch.tensor(normal), dim=0), offset])
            )
        placement.kept.copy_(placement.sequences_of(torch.arange(len(planes))))
    return placement


def ask_placed(gaussians):
    def ask(module, transmitters):
        receivers = torch.arange(len(transmitters)) % 2
        query = Query(transmitters, receivers, transmitters.new_full((len(transmitters),), 5e9))
        own = None if gaussians is None else widen(gaussians, transmitters.dtype)
        placed = module(own, query)
        if placed.gains is None:
            return placed
        # Within float32's digits a point may be on either side of a plane: only finite gains are
        # required there.
        assert placed.gains.isfinite().all()
        ends = (
            torch.stack((transmitters, module.scene.positions(transmitters)[receivers]))
            - module.middle
        )
        heights = (ends @ module.normals.T - module.offsets).abs()
        sure = (heights[:, :, module.used] > 1e-5).all(-1).all(0)[:, None]
        return placed._replace(gains=placed.gains - torch.where(sure, 0, placed.gains.detach()))

    return ask


@pytest.mark.parametrize("name", registry("placement").names())
@pytest.mark.parametrize(
    ("task", "planes", "places"),
    [("spectrum", *case) for case in CASES] + [(task, *CASES[0]) for task in ("rssi", "csi")],
)
def test_placed_gaussians_are_those_of_float64(name, task, planes, places):
    scene = LINKS[task].scene
    options = (
        ["placement.planes=6", "placement.order=2", "placement.obstacles=3"]
        if name == "mirrored"
        else []
    )
    placement = laid(build("placement", name, *options, scene=scene, channels=2), PLANES[planes])
    gaussians = example_gaussians(scene, 5)
    far = 1e6 if planes == "a million metres away" else 0.0
    placed = require_same(ask_placed(gaussians), placement, PLACES[places], within=8 * DIGITS * far)
    assert len(placed)


@pytest.mark.parametrize("planes", [name for name in PLANES if name != "as they start"])
@pytest.mark.parametrize("places", PLACES)
def test_folded_paths_are_as_long_as_straight_lines_to_images(planes, places):
    order = 3  # with those of fewer reflections
    sequences = all_sequences(len(PLANES[planes]), order)
    normals = functional.normalize(torch.tensor([normal for normal, _ in PLANES[planes]]), dim=1)
    offsets = torch.tensor([offset for _, offset in PLANES[planes]])

    def ask(_, transmitters, normals, offsets):
        seen = images(transmitters, sequences, normals, offsets)
        receivers = receiver.to(transmitters).expand_as(transmitters)
        return seen, receivers, fold(seen, receivers, sequences, normals, offsets)

    far = 1e6 if planes == "a million metres away" else 0.0
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [part.to(dtype).requires_grad_() for part in (PLACES[places], normals, offsets)]
        seen, receivers, folded = ask(None, *leaves)
        ends = [*seen, folded.start, folded.end, folded.cosines]
        assert all(end.isfinite().all() for end in ends)
        gradients = torch.autograd.grad(sum(end.mean() for end in ends), leaves)
        assert all(gradient.isfinite().all() for gradient in gradients)
        straight = (seen[-1] - receivers[:, None]).norm(dim=-1)
        legs = (folded.end - folded.start).norm(dim=-1)
        # A line is bent between its ends, and its far end then moves from one image to the next.
        reach = max((image - receivers[:, None]).norm(dim=-1).max().item() for image in seen)
        assert legs.max() <= 1.001 * (1 + 2 * order) * reach
        totals = torch.zeros_like(straight).index_add(1, folded.path, legs)
        bound = 1e-3 if dtype == torch.float32 else 1e-6
        assert (totals - straight)[folded.exists].abs().max() <= bound * max(
            1.0, straight.max().item()
        )
        results.append((seen[-1], folded.exists))
    (single, _), (double, _) = results
    assert (single - double).abs().max() <= DIGITS * order * max(
        50.0, far, double.abs().max().item()
    )


@pytest.mark.parametrize("planes", PLANES)
def test_phases_of_many_mirrors_are_those_of_float64(planes):
    if planes == "a million metres away":
        pytest.skip("float32 has no such digits")
    scene = LINKS["spectrum"].scene
    config = composed(
        "placement=mirrored", "placement.planes=6", "placement.order=3", "placement.obstacles=0"
    )
    torch.manual_seed(0)
    placement = registry("placement").build(config["placement"], scene=scene, channels=2)
    laid(placement, PLANES[planes]).enable_phases(0.06)
    require_same(ask_placed(None), placement, PLACES["somewhere"], tolerance=5e-3)
