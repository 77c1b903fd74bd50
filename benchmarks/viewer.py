"""Time from a drag of the transmitter to its picture: python benchmarks/viewer.py RUN ...
[--picture PNG].

Serves each run or checkpoint, opens it in headless Chromium, which draws without a graphics card,
and drags the transmitter through the room. A row has the median time of the model's answer alone
and, from the mouse's move to the picture, median and 95th percentile.
"""

import argparse
import statistics
import threading
import time
from pathlib import Path

from browser import Browser
from PIL import Image

import gaigs
from gaigs.commands.view import View, contents_of
from gaigs.commands.view.server import server

DRAGS = 40
WINDOW = 1200, 860  # pixels


def place_on_screen(browser: Browser) -> list[float]:
    """The transmitter's pixel in the window."""
    return browser.run(
        "const box = viewer.runs[0].canvas.getBoundingClientRect();"
        "const [x, y] = viewer.state.camera.project(viewer.state.place, box.width, box.height);"
        "return [box.x + x, box.y + y];"
    )


def drags(browser: Browser, count: int) -> list[float]:
    """Times of drags back and forth [ms]."""
    browser.wait("viewer.ready")
    time.sleep(1)  # the radio map is drawn
    x, y = place_on_screen(browser)
    browser.run("viewer.latencies.length = 0")
    steps = [(x + 6 * (k if k < count / 2 else count - k), y) for k in range(1, count)]
    browser.drag((x, y), *steps, pause=150)
    return browser.run("return viewer.latencies")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="+", help="run folders or checkpoints")
    parser.add_argument(
        "--data", help="reader of the links that checkpoints are shown with, such as synthetic"
    )
    parser.add_argument("--picture", type=Path, help="PNG of the last view")
    arguments = parser.parse_args()
    print("| run | answer [ms] | drag to picture, median [ms] | 95 % [ms] |\n|---|---|---|---|")
    for source in arguments.sources:
        view = View([contents_of(source)])
        if arguments.data:
            view = gaigs.view(gaigs.load(source), gaigs.links(arguments.data))
        (contents,) = view.contents
        with server(view.page(), view.contents, 0) as serving, Browser(*WINDOW) as browser:
            threading.Thread(target=serving.serve_forever, daemon=True).start()
            browser.open(f"http://127.0.0.1:{serving.server_port}")
            times = drags(browser, DRAGS)
            if arguments.picture:
                if arguments.data:
                    browser.run("choose(0, 0)")
                    time.sleep(1)
                browser.picture(arguments.picture)
                picture = (
                    Image.open(arguments.picture)
                    .convert("RGB")
                    .quantize(256, Image.Quantize.FASTOCTREE)
                )
                picture.save(arguments.picture, optimize=True)
            serving.shutdown()
        own = []
        for place in (
            contents.scene.lower + (contents.scene.upper - contents.scene.lower) * k / 20
            for k in range(20)
        ):
            start = time.perf_counter()
            contents.answer(place.tolist(), 0)
            own.append(1000 * (time.perf_counter() - start))
        numbers = (
            statistics.median(own),
            statistics.median(times),
            statistics.quantiles(times, n=20)[-1],
        )
        print(
            f"| {Path(source).name} |",
            " | ".join(f"{number:.0f}" for number in numbers),
            "|",
            flush=True,
        )


if __name__ == "__main__":
    main()
