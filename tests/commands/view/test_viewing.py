"""Pages, answers and the server of the viewer, and the page in a real browser."""

import base64
import gzip
import json
import re
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import torch

import gaigs
from gaigs.commands.view import View, contents_of, side_by_side
from gaigs.commands.view.contents import Contents
from gaigs.commands.view.server import server
from gaigs.model.ensemble import Ensemble
from gaigs.testing import example_links

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples/room.ckpt"


@pytest.fixture(scope="module")
def links():
    return {task: example_links(task) for task in ("spectrum", "rssi", "csi")}


@pytest.fixture(scope="module")
def levels(links):
    return gaigs.train("path_loss", links["rssi"])


@pytest.fixture(scope="module")
def mirrored():
    return gaigs.load(EXAMPLE)


def pixels(image):
    changes = np.frombuffer(base64.b64decode(image["changes"]), np.uint8)
    return np.cumsum(changes, dtype=np.uint8).reshape(image["rows"], -1)


def content(page):
    packed = re.search(r'<script id="content"[^>]*>([^<]*)<', page)[1]
    return json.loads(
        gzip.decompress(base64.b64decode(packed)), parse_constant=lambda name: pytest.fail(name)
    )


def test_a_spectrum_and_its_paths_are_the_models(mirrored):
    place = [1.0, 1.2, 1.1]
    answer = Contents(mirrored).answer(place, 0, step=2)
    expected = mirrored.predict([place])[0, 0, ::2, ::2].clamp(0, 1)
    np.testing.assert_allclose(pixels(answer["image"]) / 255, expected, atol=0.5 / 255 + 1e-6)
    strongest, *others = answer["paths"]
    assert others
    assert strongest["power"] == 0
    assert all(-30 <= path["power"] <= 0 for path in others)
    receiver = mirrored.scene.receivers[0].pose.position
    for path in answer["paths"]:
        np.testing.assert_allclose(
            [path["points"][0], path["points"][-1]], [place, receiver.tolist()], atol=1e-3
        )


def test_an_ensemble_shows_the_room_of_its_first_member(mirrored):
    both = Contents(Ensemble(mirrored.scene, [mirrored, mirrored])), Contents(mirrored)
    planes, alone = (shown.facts()["planes"] for shown in both)
    assert planes == alone != []
    assert len({json.dumps(shown.answer([1.0, 1.2, 1.1], 0)["paths"]) for shown in both}) == 1


def test_levels_deviations_and_map_are_the_models(levels):
    shown, names = Contents(levels), [receiver.name for receiver in levels.scene.receivers]
    answer = shown.answer([1.0, 1.2, 1.1], 0)
    for name, level, std in zip(names, answer["levels"], answer["stds"], strict=True):
        estimate = levels.predict([1.0, 1.2, 1.1], name, interval=0.5)
        assert (level, std) == pytest.approx((estimate.value.item(), estimate.std.item()), abs=1e-3)
    floor = shown.slice(0.7, 1)
    x, y, values = (np.array(floor[name]) for name in ("x", "y", "values"))
    row, column = 2, len(x) - 1
    asked = [[x[column], y[row], 0.7]]
    assert values[row * len(x) + column] == pytest.approx(
        levels.predict(asked, names[1]).item(), abs=0.05
    )


def test_one_thread_at_a_time_uses_the_model(mirrored, monkeypatch):
    links, uses = gaigs.links("synthetic", transmitters=20, order=0), []
    shown = Contents(mirrored, links)
    for name in ("learnt_room", "learnt_paths", "evaluate"):
        own = getattr(type(mirrored), name)

        def watched(*given, own=own, name=name):
            return uses.append((name, shown.lock.locked())) or own(*given)

        monkeypatch.setattr(type(mirrored), name, watched)
    shown.answer([1.0, 1.2, 1.1], 0)
    shown.facts()
    assert {*uses} == {("learnt_room", True), ("learnt_paths", True), ("evaluate", True)}


def test_a_channels_impulse_response_peaks_at_the_direct_path(links):
    model = gaigs.train("friis", links["csi"])
    place, receiver = torch.tensor([1.0, 1.2, 1.1]), model.scene.receivers[0].pose.position
    curve = Contents(model).answer(place.tolist(), 0)["curves"]["predicted"]
    spacing = 1e9 / (
        len(model.scene.task.frequencies) * np.diff(model.scene.task.frequencies).min()
    )
    delay = 1e9 * (place - receiver).norm().item() / 299792458
    assert curve["x"][int(np.argmax(curve["y"]))] == pytest.approx(delay, abs=spacing)


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_a_file_has_all_answers(task, links):
    view = gaigs.view(gaigs.train("mean", links[task]), links[task])
    found = content(view.page(view.stored(places=8, fewest=4)))
    (facts,), stored = found["runs"], found["stored"]
    (run,) = stored["runs"]
    receivers = len(facts["receivers"])
    assert len(run["answers"]) == len(stored["places"])
    assert {len(row) for row in run["answers"]} == {receivers}
    assert len(run["maps"]) == (0 if task == "spectrum" else len(stored["heights"]))
    assert len(run["links"]) == len(facts["tests"]["scores"]) == len(links[task].split.test)
    scores = links[task].task.scores(*view.contents[0].compared)[links[task].task.monitor]
    np.testing.assert_allclose(facts["tests"]["scores"], scores, atol=2e-3)


@contextmanager
def serving(view):
    with server(view.page(), view.contents, 0) as started:
        threading.Thread(target=started.serve_forever, args=(0.05,), daemon=True).start()
        try:
            yield f"http://127.0.0.1:{started.server_port}/"
        finally:
            started.shutdown()


def test_the_server_answers_and_says_what_is_wrong(levels):
    with serving(View([Contents(levels)])) as url:
        answer = json.load(urlopen(f"{url}answer?run=0&place=1,1.2,1.1&receiver=0"))
        assert answer["levels"] == Contents(levels).answer([1.0, 1.2, 1.1], 0)["levels"]
        with pytest.raises(HTTPError) as error:
            urlopen(f"{url}answer?run=0&place=nan,1,1&receiver=0")
        assert error.value.code == 400
        assert "must be finite" in json.load(error.value)["error"]


def test_a_receiver_may_stand_elsewhere(levels, links):
    place, elsewhere = [1.0, 1.2, 1.1], [3.0, 2.0, 2.0]
    with serving(View([Contents(levels)])) as url:
        at = "receiver=1&at=3,2,2"
        own = json.load(urlopen(f"{url}answer?run=0&place=1,1.2,1.1&receiver=1"))["levels"]
        moved = json.load(urlopen(f"{url}answer?run=0&place=1,1.2,1.1&{at}"))["levels"]
        values = json.load(urlopen(f"{url}slice?run=0&height=1&{at}"))["values"]
        with pytest.raises(HTTPError) as error:
            urlopen(f"{url}answer?run=0&place=1,1,1&receiver=1&at=nan,1,1")
        assert "must be finite" in json.load(error.value)["error"]
    receiver = gaigs.Receiver("south", gaigs.Pose.at(elsewhere))
    expected = levels.at_receivers([receiver])
    assert moved[1] == pytest.approx(expected.predict(place).item(), abs=0.1)
    assert abs(moved[1] - own[1]) > 0.5
    assert moved[:1] + moved[2:] == own[:1] + own[2:]
    assert values == Contents(expected).slice(1.0, 0)["values"]
    knn = gaigs.train("knn", links["rssi"])
    assert not Contents(knn).facts()["movable"]
    with pytest.raises(ValueError, match="own receivers alone"):
        Contents(knn).answer_at(place, 1, elsewhere)


def test_the_server_answers_to_names_of_this_machine_alone(levels):
    """A page of another name, which its owner makes lead to this machine, must read nothing."""
    with serving(View([Contents(levels)])) as url:
        for host in ("localhost", "LOCALHOST:80", "127.0.0.1:8080", "[::1]:8080"):
            assert urlopen(Request(url, headers={"Host": host})).status == 200
        for host in (
            "evil.example",
            "localhost.evil.example:8080",
            "127.0.0.1.evil.example",
            "[",
            "",
        ):
            with pytest.raises(HTTPError) as error:
                urlopen(
                    Request(f"{url}answer?run=0&place=1,1,1&receiver=0", headers={"Host": host})
                )
            assert error.value.code == 403
            assert (
                error.value.read()
                == b"this server answers to the names localhost and 127.0.0.1 alone\n"
            )


def test_a_port_in_use_is_named(levels):
    view = View([Contents(levels)])
    with serving(view) as url:
        port = int(url.rstrip("/").rsplit(":", 1)[1])
        with pytest.raises(OSError, match=f"port {port} cannot be opened"):
            view.serve(port)


def test_two_runs_have_the_same_receivers(levels, mirrored):
    with pytest.raises(ValueError, match="must have the same receivers, got"):
        gaigs.view(levels, other=mirrored)
    assert len(side_by_side([Contents(levels), Contents(levels)])) == 2


def test_the_example_predicts(mirrored):
    assert EXAMPLE.stat().st_size < 1e6
    links = gaigs.links("synthetic")
    test = links.split.test[:8]
    values = mirrored.predict(links.query[test])
    assert links.task.scores(links.labels[test], values)["ssim"].median() > 0.9
    shown = contents_of(EXAMPLE).facts()
    assert shown["planes"]
    assert shown["splats"]["obstacles"]
    assert shown["tests"] is None


def test_the_command_writes_a_file(levels, tmp_path):
    levels.save(tmp_path / "levels.ckpt")
    options = {
        "view.out": str(tmp_path / "levels.html"),
        "folder": str(tmp_path / "levels.ckpt"),
        "threads": 1,
    }
    gaigs.run(gaigs.compose("command=view", **options), tmp_path)
    assert content((tmp_path / "levels.html").read_text())["runs"][0]["title"] == "levels"


# --- in a browser ---


@pytest.fixture(scope="module")
def browser():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        from browser import Browser, lacking
    finally:
        sys.path.pop(0)
    if reason := lacking():
        pytest.skip(reason)
    with Browser(900, 600) as opened:
        yield opened


PIXEL = """
const box = viewer.runs[0].canvas.getBoundingClientRect();
const [x, y] = viewer.state.camera.project(arguments_, box.width, box.height);
return [box.x + x, box.y + y];
"""


def pixel(browser, place):
    return browser.run(PIXEL.replace("arguments_", place))


@pytest.mark.parametrize("is_served", [True, False], ids=["server", "file"])
def test_a_drag_changes_the_picture(is_served, browser, links, levels, tmp_path):
    view = gaigs.view(levels, links["rssi"])
    with serving(view) as url:
        if not is_served:
            view.save(tmp_path / "room.html")
            url = (tmp_path / "room.html").as_uri()
        browser.open(url)
        browser.wait(
            "window.viewer && viewer.ready && "
            "viewer.runs[0].drawing.layers.get('map').numbers.length"
        )
        pictures, before = (
            browser.run("return viewer.pictures"),
            browser.run("return viewer.state.place"),
        )
        canvases = "viewer.runs[0].canvas, document.querySelector('.results canvas')"
        shown = f"viewer.runs[0].drawFrame(); return [{canvases}].map(canvas => canvas.toDataURL())"
        scene, plot = browser.run(shown)
        x, y = pixel(browser, "viewer.state.place")
        browser.drag((x, y), *((x + 20 * step, y) for step in range(1, 6)), pause=30)
        browser.wait(f"viewer.pictures > {pictures} && viewer.latencies.length")
        after = browser.run("return viewer.state.place")
        assert after != before
        assert after[2] == pytest.approx(before[2])
        moved = browser.run(shown)
        assert moved[0] != scene
        assert moved[1] != plot
        link = "viewer.runs[0].facts.tests.places[viewer.runs[0].facts.tests.receivers.indexOf(0)]"
        place = pixel(browser, link)
        browser.drag(tuple(place), tuple(place))
        browser.wait("document.querySelector('.results').textContent.includes('measured')")
    assert not [line for line in browser.log() if not line.startswith(("WARNING", "INFO"))]


def test_the_map_follows_the_receiver(browser, levels):
    with serving(gaigs.view(levels)) as url:
        browser.open(url)
        drawn = "viewer.runs[0].drawing.layers.get('map').numbers"
        browser.wait(f"window.viewer && viewer.ready && {drawn}.length")
        sums = f"[...{drawn}].reduce((a, b) => a + b)"
        before = browser.run(f"return {sums}")
        place = browser.run("return viewer.runs[0].facts.receivers[0].place")
        x, y = pixel(browser, "viewer.runs[0].facts.receivers[0].place")
        browser.drag((x, y), *((x + 20 * step, y) for step in range(1, 6)), pause=30)
        browser.wait(f"viewer.state.stand && {sums} !== {before}")
        assert browser.run("return viewer.runs[0].facts.receivers[0].place") != place
        typed = "const field = document.getElementById('stand'); field.value = '3, 2, 1.5';"
        browser.run(f"{typed} field.dispatchEvent(new Event('change'))")
        assert browser.run("return viewer.state.stand") == [3, 2, 1.5]
    assert not [line for line in browser.log() if not line.startswith(("WARNING", "INFO"))]


def test_two_runs_share_the_transmitter(browser, levels, tmp_path):
    gaigs.view(levels, other=levels).save(tmp_path / "two.html")
    browser.open((tmp_path / "two.html").as_uri())
    browser.wait("window.viewer && viewer.ready")
    browser.run("move(viewer.source.stored.places[0])")
    browser.wait("viewer.pictures > 1")
    places = browser.run("return viewer.runs.map(run => run.place)")
    stored = browser.run("return viewer.source.stored.places[0]")
    assert len(places) == 2
    np.testing.assert_allclose(places, [stored, stored], atol=1e-3)
