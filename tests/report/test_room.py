"""The room and its Gaussians, read back from their artists."""

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from scipy.integrate import quad

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links, Split
from gaigs.planes.learnt_room import LearntPlane, LearntRoom, Matter
from gaigs.planes.room_paths import LearntPath
from gaigs.report.room import paths, room
from gaigs.splatting.gaussians import SH_DC, Gaussians
from gaigs.testing import example_links


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def links(train, test=None, receivers=None, rotation=None, edges=None):
    """One training and one test link; a receiver with a rotation is an array."""
    places = torch.as_tensor(np.stack((train, train if test is None else test))).float()
    turn, array = (
        (np.eye(3), Array.single()) if rotation is None else (rotation, Array.planar(1, 2, 0.1))
    )
    place, turn = (
        torch.as_tensor(part).float() for part in (train if receivers is None else receivers, turn)
    )
    split = Split("made", torch.tensor([0]), torch.zeros(0, dtype=torch.long), torch.tensor([1]))
    edges = torch.zeros(0, 2, 3) if edges is None else torch.tensor(edges)
    query, receiver = (
        Query(places, torch.zeros(2, dtype=torch.long)),
        Receiver("one", Pose(place, turn), array),
    )
    return Links(query, (receiver,), torch.zeros(2), Rssi(), split=split, edges=edges)


def gaussians(strengths, generator):
    made = Gaussians(example_links().scene, (0.1, 1.5), 1, count=len(strengths))
    with torch.no_grad():
        made.means.copy_(torch.randn(made.means.shape, generator=generator))
        made.quats.copy_(torch.randn(made.quats.shape, generator=generator))
        made.log_scales.copy_((0.1 + torch.rand(made.log_scales.shape, generator=generator)).log())
        made.opacity_logits.fill_(40.0)
        made.signal.copy_((strengths / SH_DC).reshape(made.signal.shape))
    return made


def test_gaussians_are_ellipses_of_one_standard_deviation():
    generator = torch.Generator().manual_seed(2)
    strengths = torch.rand(20, generator=generator)
    some = gaussians(strengths, generator)
    sigma, means = some.covariances.detach(), some.means.detach()
    figure = room(links(np.zeros(3), rotation=np.eye(3)), some)
    figure.draw_without_rendering()
    order = strengths.argsort()
    for ax, view in zip(figure.axes, ([0, 1], [0, 2]), strict=False):
        (ellipses,) = (artist for artist in ax.collections if isinstance(artist, EllipseCollection))
        np.testing.assert_allclose(
            ellipses.get_array(), strengths[order], rtol=1e-6
        )  # the strongest last, so on top
        np.testing.assert_allclose(ellipses.get_offsets(), means[order][:, view])
        for k, index in enumerate(order):
            angle = np.deg2rad(ellipses.get_angles()[k])
            major = ellipses.get_widths()[k] / 2 * np.array([np.cos(angle), np.sin(angle)])
            minor = ellipses.get_heights()[k] / 2 * np.array([-np.sin(angle), np.cos(angle)])
            flat = sigma[index][view][:, view].numpy()
            np.testing.assert_allclose(
                np.outer(major, major) + np.outer(minor, minor), flat, atol=1e-5
            )


def test_room_shows_the_strongest_gaussians_and_keeps_everyone_in_sight(rng):
    strengths = torch.from_numpy(rng.permutation(650)).float()
    many = gaussians(strengths, torch.Generator().manual_seed(0))
    edges = [[[-7.0, 0, 0], [-7.0, 1, 0]]]
    plan, side, bar = room(
        links([4.0, 0, 0], [0, -5.0, 0], [0, 0, 6.0], np.eye(3), edges), many
    ).axes
    ellipses = next(artist for artist in plan.collections if isinstance(artist, EllipseCollection))
    assert ellipses.get_array().min() == pytest.approx(50)
    assert bar.get_ylabel() == "|signal| × opacity, 600 strongest of 650 Gaussians"
    assert plan.get_xlim()[0] < -7 < 4 < plan.get_xlim()[1]
    assert plan.get_ylim()[0] < -5
    assert side.get_ylim()[1] > 6
    walls = next(artist for artist in side.collections if isinstance(artist, LineCollection))
    np.testing.assert_array_equal(walls.get_segments()[0], [[-7, 0], [-7, 0]])


def test_room_draws_the_axes_of_arrays_as_seen_from_above_and_aside():
    point, rotation = np.array([1.0, 2, 3]), np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    plan, side = room(links(point + 4, point, point, rotation)).axes
    arrows = {text.get_text(): np.subtract(text.get_position(), text.xy) for text in plan.texts}
    assert set(arrows) == {"x", "z"}  # y points at the reader
    assert arrows["x"][0] == 0 > arrows["x"][1]
    assert arrows["z"][0] < 0 == arrows["z"][1]
    assert {text.get_text() for text in side.texts} == {"y", "z"}
    assert not room(links(point + 4, point, point)).axes[0].texts


# --- the learnt room ---

BOX = np.array([6.0, 4.0, 3.0])
POINT = np.array([1.0, 1, 1])


def face(number, axis, side, share):
    """A face of ``BOX``."""
    others = [k for k in range(3) if k != axis]
    corners = np.zeros((4, 3))
    corners[:, axis] = side * BOX[axis]
    corners[:, others] = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * BOX[others]
    return LearntPlane(number, corners, (2 * side - 1) * np.eye(3)[axis], share)


@pytest.fixture
def walls():
    shares = 0.4, 0.1, 0.08, 0.05, 0.02, 0.0002
    return [face(k, k % 3, float(k < 3), share) for k, share in enumerate(shares)]


def drawn(ax, kind):
    return next(artist for artist in ax.collections if isinstance(artist, kind))


def labels(ax):
    return {text.get_text() for text in ax.texts}


def test_planes_are_drawn_edge_on_and_as_wide_as_they_are_strong(walls):
    plan, side = room(links(POINT), learnt=LearntRoom(walls, None, [])).axes
    assert labels(plan) == {"0: 40 %", "1: 10 %", "3: 5 %", "4: 2 %"}
    assert labels(side) == {
        "0: 40 %",
        "2: 8 %",
        "3: 5 %",
    }  # y points at the reader; the floor carries nothing
    for ax, up in ((plan, 1), (side, 2)):
        outlines = drawn(ax, PolyCollection)
        widths = outlines.get_linewidths()
        assert [*widths] == sorted(widths, reverse=True)
        assert widths[0] > 1.5 * widths[1]
        for path in outlines.get_paths():
            assert np.ptp(path.vertices, 0).min() == 0  # a line
        assert ax.get_xlim()[0] < 0 < 6 < ax.get_xlim()[1]
        assert ax.get_ylim()[0] < 0 < BOX[up] < ax.get_ylim()[1]


def test_an_oblique_plane_is_seen_in_both_views():
    corners = np.array([(0.0, 4, 0), (6, 4, 0), (6, 1, 3), (0, 1, 3)])
    plane = LearntPlane(7, corners, np.array([0, 1, 1]) / np.sqrt(2), 0.3)
    for ax, view in zip(
        room(links(POINT), learnt=LearntRoom([plane], None, [])).axes, ([0, 1], [0, 2]), strict=True
    ):
        (path,) = drawn(ax, PolyCollection).get_paths()
        np.testing.assert_array_equal(path.vertices[:4], corners[:, view])


def test_labels_of_planes_keep_clear_of_each_other(walls):
    close = [
        plane._replace(number=plane.number + 6, corners=1.01 * plane.corners) for plane in walls
    ]
    doubled = [*walls, *close]
    figure = room(links(POINT), learnt=LearntRoom(doubled, None, []))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    for ax in figure.axes:
        boxes = [text.get_window_extent(canvas.get_renderer()) for text in ax.texts]
        assert len(boxes) in (8, 6)
        overlaps = [(a, b) for i, a in enumerate(boxes) for b in boxes[:i] if a.overlaps(b)]
        assert not overlaps


def test_obstacles_are_shown_by_what_they_take_along_the_line_of_sight(walls, rng):
    matter = Matter(
        rng.uniform(1, 3, (3, 3)), rng.uniform(0.2, 0.6, (3, 3)), np.array([5.0, 10.0, 20.0])
    )
    figure = room(links(POINT), learnt=LearntRoom(walls, matter, []))
    plan, side, bar = figure.axes
    assert bar.get_ylabel() == "fitted loss by obstacles along the line of sight [dB]"

    def density(point):
        return (
            matter.densities * np.exp(-(((point - matter.centres) / matter.widths) ** 2).sum(1) / 2)
        ).sum()

    for ax, up, along in ((plan, 1, 2), (side, 2, 1)):
        (image,) = ax.images
        losses, (left, right, bottom, top) = image.get_array(), image.get_extent()
        rows, columns = losses.shape
        for row, column in ((rows // 2, columns // 3), (rows // 3, columns // 2)):
            point = np.zeros(3)
            point[0] = left + (column + 0.5) * (right - left) / columns
            point[up] = bottom + (row + 0.5) * (top - bottom) / rows
            axis = np.eye(3)[along]
            expected, _ = quad(lambda t, point=point, axis=axis: density(point + t * axis), -4, 8)
            assert losses[row, column] == pytest.approx(expected, rel=1e-6)
        assert image.get_clim()[0] == 0


def test_boxes_take_their_loss_wherever_the_line_of_sight_meets_them(walls):
    corners = np.array([[x, y, z] for x in (1.0, 2.0) for y in (1.0, 3.0) for z in (0.0, 1.5)])
    gaussians = np.full((1, 3), 2.0), np.full((1, 3), 0.5), np.zeros(1)
    matter = Matter(*gaussians, corners[None], np.array([6.0]))
    plan, side, _ = room(links(POINT), learnt=LearntRoom(walls, matter, [])).axes
    for ax, area in ((plan, 2.0), (side, 1.5)):
        (image,) = ax.images
        losses, (left, right, bottom, top) = image.get_array(), image.get_extent()
        pixel = (right - left) * (top - bottom) / losses.size
        assert {*np.unique(losses)} == {0.0, 6.0}
        assert (losses == 6).sum() * pixel == pytest.approx(area, rel=0.05)


def test_obstacles_that_take_next_to_nothing_stay_pale(walls):
    matter = Matter(np.full((1, 3), 2.0), np.full((1, 3), 0.5), np.array([0.01]))
    plan, *_ = room(links(POINT), learnt=LearntRoom(walls, matter, [])).axes
    assert plan.images[0].get_clim() == (0, 1)


def test_paths_are_drawn_from_end_to_end_the_strongest_on_top(walls):
    ends = np.array([1.0, 1, 1]), np.array([5.0, 3, 2])
    routes = [
        LearntPath(np.stack(ends), 0.0),
        LearntPath(np.stack((ends[0], [6.0, 2.5, 1.75], ends[1])), -9.0),
        LearntPath(np.stack((ends[0], [2.0, 4, 1.5], [6.0, 3.5, 1.9], ends[1])), -24.0),
    ]
    edges = [[[-7.0, 0, 0], [-7.0, 1, 0]]]
    plan, side, bar = paths(
        links(POINT, receivers=ends[1], edges=edges), LearntRoom(walls, None, routes)
    ).axes
    assert plan.figure.get_suptitle() == "How does the signal from (1.00, 1.00, 1.00) m arrive?"
    assert bar.get_ylabel() == "power over that of the strongest path [dB]"
    assert plan.get_xlim()[0] < -7
    for ax, view in ((plan, [0, 1]), (side, [0, 2])):
        true, folded = (artist for artist in ax.collections if isinstance(artist, LineCollection))
        assert len(true.get_segments()) == 1
        assert [*folded.get_array()] == [-24, -9, 0]
        assert folded.get_clim() == (-24, 0)
        for segment, route in zip(folded.get_segments(), routes[::-1], strict=True):
            np.testing.assert_array_equal(segment, route.points[:, view])
        assert [*folded.get_linewidths()] == sorted(folded.get_linewidths())
        marks = {line.get_label(): line.get_xydata()[0].tolist() for line in ax.lines}
        assert marks == {"receivers": ends[1][view].tolist(), "transmitter": ends[0][view].tolist()}
    assert {"0: 40 %", "1: 10 %", "3: 5 %", "4: 2 %"} == labels(plan)


def test_walls_have_a_place_in_the_legend_if_there_are_any():
    def words(edges):
        return [
            text.get_text()
            for text in room(links(POINT, receivers=np.array([5.0, 4, 2]), edges=edges))
            .legends[0]
            .get_texts()
        ]

    assert "walls and furniture" in words([[[0.0, 0, 0], [1, 0, 0]]])
    assert "walls and furniture" not in words(np.zeros((0, 2, 3)))


def test_a_single_path_has_a_scale_of_its_own():
    route = LearntPath(np.array([[1.0, 1, 1], [2, 2, 2]]), 0.0)
    figure = paths(links(POINT), LearntRoom([], None, [route]))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "receivers",
        "transmitter",
    ]
    plan, *_ = figure.axes
    folded = [artist for artist in plan.collections if isinstance(artist, LineCollection)][-1]
    assert folded.get_clim() == (-10, 0)
